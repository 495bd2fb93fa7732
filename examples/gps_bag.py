"""A ROS 2 bag of a simulated drive, with late fixes that jump: what docs/gps-ros.md fits.

The robot turns from 8 s to 14 s at 0.25 rad/s. Its antenna is 0.4 m ahead of its centre, a fix is 0.2 s old when it is
stamped, and every twentieth one jumps.
"""

import numpy as np
import pymap3d
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_HUMBLE)
Time, Header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
Vector3, Twist = store.types["geometry_msgs/msg/Vector3"], store.types["geometry_msgs/msg/Twist"]
TwistStamped, Status = store.types["geometry_msgs/msg/TwistStamped"], store.types["sensor_msgs/msg/NavSatStatus"]
NavSatFix = store.types["sensor_msgs/msg/NavSatFix"]
rng = np.random.default_rng(0)
seconds = np.arange(0.0, 24.0, 0.1)
ticks = np.linspace(0.0, 24.0, 4801)
heading = 0.5 + 0.25 * np.clip(ticks - 8.0, 0.0, 6.0)
speed = 1.5 + 0.3 * np.sin(0.4 * ticks)
east = np.cumsum(speed * np.cos(heading)) * 0.005 + 0.4 * np.cos(heading)  # of the antenna
north = np.cumsum(speed * np.sin(heading)) * 0.005 + 0.4 * np.sin(heading)
noise = rng.normal(0.0, 0.02, (2, len(seconds)))
noise[:, 10::20] += rng.normal(0.0, 5.0, noise[:, 10::20].shape)
with Writer("drive", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
    fixes = bag.add_connection("/fix", NavSatFix.__msgtype__, typestore=store)
    commands = bag.add_connection("/cmd_vel", TwistStamped.__msgtype__, typestore=store)
    for k, second in enumerate(seconds):
        stamp = 1_700_000_000 * 10**9 + int(second * 1e9)
        header = Header(Time(*divmod(stamp, 10**9)), "base")
        now, then = round(second / 0.005), max(round((second - 0.2) / 0.005), 0)
        place = pymap3d.enu2geodetic(east[then] + noise[0, k], north[then] + noise[1, k], 0, 48.1, 11.6, 520)
        covariance = np.diag([0.0004, 0.0004, 0.5]).ravel()
        fix = NavSatFix(header, Status(0, 1), *map(float, place), covariance, 2)
        bag.write(fixes, stamp, store.serialize_cdr(fix, NavSatFix.__msgtype__))
        twist = TwistStamped(header, Twist(Vector3(float(speed[now]), 0.0, 0.0), Vector3(0.0, 0.0, 0.0)))
        bag.write(commands, stamp, store.serialize_cdr(twist, TwistStamped.__msgtype__))
