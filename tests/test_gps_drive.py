"""A simulated drive with all that GPS does, written to a bag, read back and fitted: it ends at the truth.

The heading is not measured, the antenna is not where the vehicle's origin is, positions come late against the wheel
encoders, some fixes jump by metres, and the yaw of the inertial unit wraps. The vehicle drives on firm ground and then
on ice, where it turns about other centers.
"""

from datetime import UTC, datetime

import jax.numpy as jnp
import numpy as np
import pymap3d
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import switchfit as sf
from switchfit.models import differential_drive

START = datetime(2024, 5, 1, 12, 0, 0, tzinfo=UTC)
EPOCH = int(START.timestamp()) * 10**9
ORIGIN = (48.1, 11.6, 520.0)
END, RADIUS, FIRM, ANTENNA = 30.0, 0.165, 0.6, (0.35, 0.1)
TRUTH = {"ice": 17.3, "y": 1.1, "x_v": -0.25, "delay": 0.17, "theta": 2.6}
"""When the ice begins (s), centers of rotation on it (m), delay of the positions (s), heading at the start (rad)."""
TICKS = np.arange(0.0, END + 0.01, 0.05)
WHEELS = np.stack(
    [6.0 + 1.5 * np.sin(0.7 * TICKS) - 0.8 * np.cos(0.31 * TICKS), 6.5 - 1.5 * np.sin(0.7 * TICKS)], axis=1
)
JUMPS, JUMP, NOISE = 0.05, 4.0, 0.03
"""Part of the fixes that jump, by how much (m), and the noise of the others (m)."""


def drive():
    """Positions of the antenna and heading every millisecond, by exact arcs: encoders hold their speeds for 50 ms."""
    step = 1e-3
    times = np.arange(0.0, END + step / 2, step)
    speeds = RADIUS * WHEELS[np.minimum((times[:-1] / 0.05 + 1e-9).astype(int), len(TICKS) - 1)]
    icy = times[:-1] >= TRUTH["ice"] - 1e-9
    width = np.where(icy, 2 * TRUTH["y"], FIRM)
    turn, ahead = (speeds[:, 1] - speeds[:, 0]) / width, speeds.mean(1)
    aside = np.where(icy, -TRUTH["x_v"] * turn, 0.0)
    heading = TRUTH["theta"] + np.concatenate([[0.0], np.cumsum(turn) * step])
    middle = 0.5 * (heading[1:] + heading[:-1])
    chord = np.sinc(turn * step / 2 / np.pi)  # an arc's chord over its length
    east = np.cumsum(step * chord * (ahead * np.cos(middle) - aside * np.sin(middle)))
    north = np.cumsum(step * chord * (ahead * np.sin(middle) + aside * np.cos(middle)))
    path = np.stack([np.concatenate([[0.0], part]) for part in (east, north)], axis=1)
    cos, sin = np.cos(heading), np.sin(heading)
    return (
        times,
        path + np.stack([ANTENNA[0] * cos - ANTENNA[1] * sin, ANTENNA[0] * sin + ANTENNA[1] * cos], 1),
        heading,
    )


def receive(rate, seed):
    """Times and positions that the receiver states: late, noisy, some far off."""
    _, path, _ = drive()
    random = np.random.default_rng(seed)
    stamps = np.arange(1.0, END - 0.5, 1.0 / rate)
    at = np.round(1e3 * (stamps - TRUTH["delay"])).astype(int)
    fixes = path[at] + random.normal(0.0, NOISE, (len(at), 2))
    jumping = random.random(len(at)) < JUMPS
    return stamps, fixes + jumping[:, None] * random.normal(0.0, JUMP, (len(at), 2))


def globe(east, north):
    return [float(value) for value in pymap3d.enu2geodetic(east, north, 0.0, *ORIGIN)]


def write_bag(folder, stamps, fixes):
    """A ROS 2 bag with fixes, encoders (20 Hz) and the yaw of an inertial unit (10 Hz), which wraps."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types

    def header(t):
        stamp = types["builtin_interfaces/msg/Time"](*divmod(EPOCH + round(t * 1e9), 10**9))
        return types["std_msgs/msg/Header"](stamp, "base")

    _, _, heading = drive()
    vector, none = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), np.zeros(9)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:

        def add(topic, kind, messages):
            connection = bag.add_connection(topic, kind, typestore=store)
            for t, message in messages:
                bag.write(connection, EPOCH + round(t * 1e9), store.serialize_cdr(message, kind))

        status, covariance = types["sensor_msgs/msg/NavSatStatus"](0, 1), np.diag([NOISE**2, NOISE**2, 0.1]).ravel()
        fix, joint, imu = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu"
        places = zip(stamps, fixes, strict=True)
        add("/fix", fix, ((t, types[fix](header(t), status, *globe(*xy), covariance, 2)) for t, xy in places))
        speeds, names, empty = zip(TICKS, WHEELS, strict=True), ["left", "right"], np.zeros(0)
        add("/wheels", joint, ((t, types[joint](header(t), names, np.zeros(2), w, empty)) for t, w in speeds))
        random, turns = np.random.default_rng(8), []
        for t in np.arange(0.0, END, 0.1):
            yaw = heading[round(1e3 * t)] - 0.4 + random.normal(0.0, 0.01)  # its own zero
            quaternion = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
            turns.append((t, types[imu](header(t), quaternion, none, vector, none, vector, none)))
        add("/imu", imu, turns)


def antenna(t, x, p):
    cos, sin = jnp.cos(x[2]), jnp.sin(x[2])
    return x[:2] + jnp.stack([p["ahead"] * cos - p["aside"] * sin, p["ahead"] * sin + p["aside"] * cos])


def make_problem(times, places, sigma, speeds, others=()):
    positions = sf.Measurements(
        times, places, observe=antenna, sigma=sigma, delay="delay", loss="huber", loss_scale=2.0
    )
    vehicle = differential_drive(radius=RADIUS, track=FIRM, y_l="y", y_r="right", x_v="x_v")
    start = [sf.Parameter(float(first)) for first in np.median(np.asarray(places)[:3], axis=0)]
    run = sf.Experiment(
        [positions, *others], ("grip", "slip"), (15.0,), 0.0, END, inputs=speeds,
        initial_state=[*start, sf.Parameter(2.0)],
    )  # fmt: skip
    parameters = {
        "y": sf.Parameter(0.6, lower=0.2, upper=5.0, unit="m"),
        "right": sf.Parameter(-0.6, lower=-5.0, upper=-0.2, unit="m"),
        "x_v": sf.Parameter(0.0, lower=-2.0, upper=2.0, unit="m"),
        "ahead": sf.Parameter(0.1, lower=-1.0, upper=1.0, unit="m"),
        "aside": sf.Parameter(0.0, lower=-1.0, upper=1.0, unit="m"),
        "delay": sf.Parameter(0.05, lower=0.0, upper=0.9, unit="s"),
    }
    if others:
        parameters["zero"] = 0.0
    return sf.Problem(vehicle, run, parameters)


EXPECTED = {
    "tau_1": TRUTH["ice"], "y": TRUTH["y"], "right": -TRUTH["y"], "x_v": TRUTH["x_v"], "ahead": ANTENNA[0],
    "aside": ANTENNA[1], "delay": TRUTH["delay"], "X(t0)": 0.0, "Y(t0)": 0.0, "theta(t0)": TRUTH["theta"],
}  # fmt: skip


def find_errors(fit):
    """Value less the truth of each unknown, a heading without full turns."""
    off = {name: dict(zip(fit.theta_names, fit.theta, strict=True))[name] - true for name, true in EXPECTED.items()}
    return off | {"theta(t0)": (off["theta(t0)"] + np.pi) % (2 * np.pi) - np.pi}


def check(fit):
    errors = dict(zip(fit.theta_names, fit.corrected_standard_errors, strict=True))
    for name, off in find_errors(fit).items():
        assert abs(off) < 3.5 * errors[name], (name, off, errors[name])
    assert errors["tau_1"] < 0.5
    return dict(zip(fit.theta_names, fit.theta, strict=True))


def test_bag_with_an_inertial_unit(tmp_path):
    stamps, fixes = receive(5, seed=0)
    write_bag(tmp_path / "drive", stamps, fixes)
    log = sf.read_log(tmp_path / "drive", topic="/fix", origin=ORIGIN)
    wheels = sf.read_log(tmp_path / "drive", topic="/wheels")
    turned = sf.read_log(tmp_path / "drive", topic="/imu")
    assert np.abs(np.diff(turned["yaw"])).max() > 6
    turned = sf.read_log(tmp_path / "drive", topic="/imu", repair="unwrap:yaw")
    assert np.abs(np.diff(turned["yaw"])).max() < 0.5
    np.testing.assert_allclose(log.times, stamps, atol=1e-6)
    compass = sf.Measurements(turned.times, turned["yaw"], observe=lambda t, x, p: x[2] + p["zero"], sigma=0.01)
    speeds = sf.Input(wheels.times, wheels[["left.velocity", "right.velocity"]].__array__(), kind="hold")
    sigma = log[["sigma_east", "sigma_north"]]
    fit = sf.estimate(make_problem(log.times, log[["east", "north"]], sigma, speeds, [compass]))
    values = check(fit)
    assert abs((values["zero"] + values["theta(t0)"] - TRUTH["theta"] + 0.4 + np.pi) % (2 * np.pi) - np.pi) < 0.02
