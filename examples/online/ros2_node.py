"""A ROS 2 node that says whether the wheels of a robot slip, since when, and by how much.

It subscribes to positions (nav_msgs/Odometry on /odometry/gps) and commands (geometry_msgs/TwistStamped on /cmd_vel),
and publishes the mode as JSON (std_msgs/String on /wheels). Run it where ROS 2 is installed:

    python examples/online/ros2_node.py

`Adapter` turns messages into samples; it needs no ROS, and takes recorded messages as well.
"""

from __future__ import annotations

import json

import jax.numpy as jnp
import numpy as np

import switchfit as sf

SIGMA = 0.03  # m, of a position
WINDOW = 20.0  # s


def move(slips):
    """Return a mode: the commanded speed along the heading, or less of it where the wheels slip."""

    def f(t, x, p, u):
        speed = u["vx"] * (1.0 - slips * p["slip"])
        return jnp.stack([speed * jnp.cos(x[2]), speed * jnp.sin(x[2]), u["wz"]])

    return f


def make_problem(x=0.0, y=0.0, yaw=0.0):
    """Return the problem of a robot that begins at a place, with a heading that is about known."""
    system = sf.HybridSystem(
        {"grip": move(0.0), "slip": move(1.0)}, [0.0] * 3, state_names=("x", "y", "yaw"), state_units=("m", "m", "rad")
    )
    places = sf.Measurements(
        [], np.empty((0, 2)), observe=lambda t, x, p: x[:2], sigma=SIGMA, names=("x", "y"), units=("m", "m")
    )
    commands = sf.Input([0.0], {"vx": [0.0], "wz": [0.0]}, kind="hold")
    start = [sf.Parameter(x, prior=sf.Normal(x, SIGMA)), sf.Parameter(y, prior=sf.Normal(y, SIGMA))]
    start.append(sf.Parameter(yaw, prior=sf.Normal(yaw, 0.2)))
    run = sf.Experiment(places, ("grip",), t0=0.0, initial_state=start, inputs=commands)
    return sf.Problem(system, run, {"slip": sf.Parameter(0.3, lower=0.0, upper=1.0, unit="1")})


class Adapter:
    """Turns messages into samples: times in seconds since the first position, and the command that holds then."""

    def __init__(self):
        self.start = None
        self.command = {"vx": 0.0, "wz": 0.0}

    def take_command(self, message):
        """Keep a command, a TwistStamped."""
        twist = message.twist
        self.command = {"vx": float(twist.linear.x), "wz": float(twist.angular.z)}

    def take_odometry(self, message):
        """Return t, y and u of a position, an Odometry."""
        stamp = message.header.stamp
        now = stamp.sec * 10**9 + stamp.nanosec  # whole nanoseconds: a float has not enough digits
        self.start = now if self.start is None else self.start
        place = message.pose.pose.position
        return (now - self.start) / 1e9, {"x": float(place.x), "y": float(place.y)}, dict(self.command)


class Follower:
    """An adapter with an estimator, which begins at the first position."""

    def __init__(self, **settings):
        self.adapter, self.online, self.settings = Adapter(), None, {"window": WINDOW} | settings

    def take_odometry(self, message):
        """Return what is known after a position; None after the first one."""
        t, y, u = self.adapter.take_odometry(message)
        if self.online is None:
            q = message.pose.pose.orientation
            yaw = float(np.arctan2(2 * (q.w * q.z + q.x * q.y), q.w**2 + q.x**2 - q.y**2 - q.z**2))
            self.online = sf.OnlineEstimator(make_problem(y["x"], y["y"], yaw), **self.settings)
            return None
        return self.online.update(t, y, u=u)


def describe(now):
    """Return what is published."""
    slip = {"value": float(now.parameters["slip"]), "error": float(now.standard_errors["slip"])}
    return json.dumps({"t": now.time, "mode": now.mode, "since": now.since, "slip": slip, "status": now.status.name})


def main():
    """Run the node until Ctrl-C."""
    import rclpy
    from geometry_msgs.msg import TwistStamped
    from nav_msgs.msg import Odometry
    from std_msgs.msg import String

    rclpy.init()
    node, follower = rclpy.create_node("wheels"), Follower(budget=0.05)
    publisher = node.create_publisher(String, "/wheels", 10)

    def follow(message):
        try:
            now = follower.take_odometry(message)
        except ValueError as error:  # a message that comes too late, or twice
            node.get_logger().warning(str(error))
            return
        if now is not None:
            publisher.publish(String(data=describe(now)))

    node.create_subscription(TwistStamped, "/cmd_vel", follower.adapter.take_command, 10)
    node.create_subscription(Odometry, "/odometry/gps", follow, 10)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
