"""Bags of ROS 1 and ROS 2, and MCAP files: the messages of one topic as channels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from switchfit.io.logs.geodesy import SIGMA
from switchfit.io.logs.libraries import import_library
from switchfit.io.logs.log import Event, Log, Options
from switchfit.io.logs.tables import stack_records
from switchfit.problem.validation import shorten
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors
from switchfit.runtime.issue import Issue

SECOND = 10**9
"""Nanoseconds."""
FAR = 86_400 * SECOND
"""By how much stamps of headers may differ from the clock of the recorder; beyond, they are of another clock."""
LONGEST_ARRAY = 36
"""Entries of an array in a message that become channels; longer ones are pictures and scans."""

Record = dict[str, float]


class _Kind(NamedTuple):
    """How a type of message becomes channels."""

    read: Callable[[Any], Record]
    units: dict[str, str]


def read_bag(path: Path, options: Options) -> Log:
    """Read the messages of one topic; the stamps of their headers are the times.

    Parameters
    ----------
    path : Path
        A ``.bag`` of ROS 1, a ``.mcap`` or ``.db3``, or the folder of a bag of ROS 2.
    options : Options
        The topic may be left out where there is one with numbers.

    Raises
    ------
    InputError
        If the bag cannot be read, or the topic is missing or has no numbers.
    """
    what = f"{path}: a ROS bag"
    highlevel = import_library("rosbags.highlevel", "ros", what)
    typesys = import_library("rosbags.typesys", "ros", what)
    with explain_read_errors(path):
        path.stat()
    store = typesys.get_typestore(typesys.Stores.LATEST)
    try:
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            return _read_topic(path, reader, options.topic)
    except InputError:
        raise
    except Exception as error:  # damaged bags fail in many ways
        raise InputError(f"{path} cannot be read as a ROS bag: {error or type(error).__name__}") from error


def _read_topic(path: Path, reader: Any, topic: str | None) -> Log:
    connections = _choose_connections(path, reader.connections, topic)
    kind = _KINDS.get(connections[0].msgtype)
    start = reader.start_time
    records: list[Record] = []
    texts: list[tuple[int, str]] = []
    stamps: list[int] = []
    received: list[int] = []
    for connection, time, data in reader.messages(connections=connections):
        message = reader.deserialize(data, connection.msgtype)
        received.append(time)
        stamps.append(_read_stamp(message))
        records.append(kind.read(message) if kind else _flatten(message))
        if isinstance(getattr(message, "data", None), str):
            texts.append((time, message.data))
    if not records:
        raise InputError(f"{path}: topic {connections[0].topic} has no messages; there is nothing to read.")
    has_stamps = any(stamps)
    clock, offset = _choose_clock(stamps if has_stamps else received, start)
    values = stack_records(records)
    units = {name: _find_unit(kind, name) for name in values}
    issues = () if has_stamps else (Issue("log: no stamps", (str(path), connections[0].topic)),)
    return Log(
        times=clock,
        values=values,
        units=units,
        time_unit="s",
        source=f"{path} ({connections[0].topic})",
        issues=issues,
        events=tuple(Event((time - start) / SECOND, connections[0].topic, text) for time, text in texts),
        offset=offset,
        rows=np.arange(1, len(clock) + 1),
        place="message",
        time_name="stamp" if has_stamps else "received",
        has_positions=kind is not None and kind.read is _read_fix,
    )


def _choose_connections(path: Path, connections: Sequence[Any], topic: str | None) -> list[Any]:
    """Return the connections of a topic; if none is named, of the only one that is known or has messages."""
    types = {connection.topic: connection.msgtype for connection in connections if connection.msgcount}
    listed = ", ".join(f"{name} ({kind.replace('/msg/', '/')})" for name, kind in sorted(types.items())) or "none"
    if topic is None:
        known = [name for name, kind in types.items() if kind in _KINDS] or list(types)
        if len(known) != 1:
            raise InputError(f"{path} has several topics, name one: topic = ... They are {listed}.")
        topic = known[0]
    chosen = [connection for connection in connections if connection.topic == topic]
    if not chosen:
        raise InputError(f"{path} has no topic {shorten(topic)}; its topics are {listed}.")
    return chosen


def _read_stamp(message: Any) -> int:
    """Return the stamp of a header in nanoseconds; 0 without a header."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * SECOND + int(stamp.nanosec)


def _choose_clock(stamps: Sequence[int], start: int) -> tuple[Any, float]:
    """Return seconds since the bag began, which all topics of a bag share, and when that was.

    Stamps of another clock, as those of a simulation, are left as they are.
    """
    near = abs(stamps[0] - start) < FAR
    zero = start if near else 0
    return np.array([stamp - zero for stamp in stamps], dtype=np.int64) / SECOND, zero / SECOND


def _find_unit(kind: _Kind | None, name: str) -> str:
    if kind is None:
        return ""
    return kind.units.get(name) or kind.units.get(f"*.{name.rpartition('.')[2]}", "")


# --- types of messages ------------------------------------------------------------------------------------------------


def _read_fix(message: Any) -> Record:
    if message.status.status < 0:  # no fix
        return {"latitude": np.nan, "longitude": np.nan, "altitude": np.nan}
    found = {"latitude": message.latitude, "longitude": message.longitude, "altitude": message.altitude}
    variances = np.asarray(message.position_covariance)[[0, 4, 8]]
    if message.position_covariance_type > 0 and np.all(variances > 0):
        found |= dict(zip(SIGMA, np.sqrt(variances).tolist(), strict=True))
    return found


def _read_pose(pose: Any) -> Record:
    p = pose.position
    return {"x": p.x, "y": p.y, "z": p.z, "yaw": _find_yaw(pose.orientation)}


def _read_twist(twist: Any) -> Record:
    v, w = twist.linear, twist.angular
    return {"vx": v.x, "vy": v.y, "vz": v.z, "wx": w.x, "wy": w.y, "wz": w.z}


def _read_sigma(covariance: Any, names: Sequence[str], places: Sequence[int]) -> Record:
    """Return the square roots of variances that are given; 0 stands for one that is not known."""
    variances = np.asarray(covariance)[[7 * k for k in places]]
    return {f"sigma_{name}": float(np.sqrt(v)) for name, v in zip(names, variances, strict=True) if v > 0}


def _read_pose_with_covariance(pose: Any) -> Record:
    return {**_read_pose(pose.pose), **_read_sigma(pose.covariance, ("x", "y", "z", "yaw"), (0, 1, 2, 5))}


def _read_twist_with_covariance(twist: Any) -> Record:
    names = ("vx", "vy", "vz", "wx", "wy", "wz")
    return {**_read_twist(twist.twist), **_read_sigma(twist.covariance, names, range(6))}


def _read_odometry(message: Any) -> Record:
    return {**_read_pose_with_covariance(message.pose), **_read_twist_with_covariance(message.twist)}


def _read_imu(message: Any) -> Record:
    a, w = message.linear_acceleration, message.angular_velocity
    found = {"ax": a.x, "ay": a.y, "az": a.z, "wx": w.x, "wy": w.y, "wz": w.z}
    if message.orientation_covariance[0] != -1:  # -1: it has no orientation
        found["yaw"] = _find_yaw(message.orientation)
    return found


def _read_joints(message: Any) -> Record:
    found: Record = {}
    for field in ("position", "velocity", "effort"):
        samples = getattr(message, field)
        if len(samples) == len(message.name):
            found |= {f"{name}.{field}": float(s) for name, s in zip(message.name, samples, strict=True)}
    return found


def _find_yaw(q: Any) -> float:
    """Return the angle about the vertical axis of a quaternion; NaN for the zero quaternion, which is no rotation."""
    if q.x == q.y == q.z == q.w == 0.0:
        return np.nan
    return float(np.arctan2(2 * (q.w * q.z + q.x * q.y), q.w**2 + q.x**2 - q.y**2 - q.z**2))


def _flatten(message: Any, prefix: str = "") -> Record:
    """Return all numbers of a message by their names in it, such as ``"pose.position.x"``; headers are left out."""
    found: Record = {}
    for name in getattr(message, "__dataclass_fields__", ()):
        value = getattr(message, name)
        if name in ("header", "__msgtype__"):
            continue
        if isinstance(value, (bool, int, float, np.number, np.bool_)):
            found[prefix + name] = float(value)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and value.size <= LONGEST_ARRAY:
            found |= {f"{prefix}{name}.{k}": float(entry) for k, entry in enumerate(value.ravel())}
        elif hasattr(value, "__dataclass_fields__"):
            found |= _flatten(value, f"{prefix}{name}.")
    return found


_POSE = {"x": "m", "y": "m", "z": "m", "yaw": "rad"} | {f"sigma_{name}": "m" for name in "xyz"} | {"sigma_yaw": "rad"}
_TWIST = {f"{s}{v}{axis}": unit for axis in "xyz" for v, unit in (("v", "m/s"), ("w", "rad/s")) for s in ("", "sigma_")}
_FIX = {"latitude": "deg", "longitude": "deg", "altitude": "m"} | dict.fromkeys(SIGMA, "m")
_IMU = {f"a{axis}": "m/s^2" for axis in "xyz"} | {f"w{axis}": "rad/s" for axis in "xyz"} | {"yaw": "rad"}
_JOINTS = {"*.position": "rad", "*.velocity": "rad/s", "*.effort": "N m"}

_KINDS = {
    "sensor_msgs/msg/NavSatFix": _Kind(_read_fix, _FIX),
    "nav_msgs/msg/Odometry": _Kind(_read_odometry, _POSE | _TWIST),
    "geometry_msgs/msg/PoseStamped": _Kind(lambda m: _read_pose(m.pose), _POSE),
    "geometry_msgs/msg/Pose": _Kind(_read_pose, _POSE),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _Kind(lambda m: _read_pose_with_covariance(m.pose), _POSE),
    "geometry_msgs/msg/TwistStamped": _Kind(lambda m: _read_twist(m.twist), _TWIST),
    "geometry_msgs/msg/Twist": _Kind(_read_twist, _TWIST),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _Kind(lambda m: _read_twist_with_covariance(m.twist), _TWIST),
    "sensor_msgs/msg/Imu": _Kind(_read_imu, _IMU),
    "sensor_msgs/msg/JointState": _Kind(_read_joints, _JOINTS),
}
"""Types that are known; of all others, every number becomes a channel by its name in the message."""
