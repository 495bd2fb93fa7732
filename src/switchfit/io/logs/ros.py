"""Bags of ROS 1 and ROS 2, and MCAP files: the messages of one topic as channels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from switchfit.io.logs.columns import build_log
from switchfit.io.logs.local_frame import LOCAL_CHANNELS, SIGMA_CHANNELS
from switchfit.io.logs.log import Event, Log
from switchfit.io.logs.options import Options
from switchfit.io.logs.refusals import explain_damage
from switchfit.problem.validation.messages import shorten
from switchfit.runtime.errors import InputError
from switchfit.runtime.extras import import_library
from switchfit.runtime.issue import Issue

SECOND = 10**9
"""Nanoseconds."""

LARGEST_CLOCK_DIFFERENCE = 86_400 * SECOND
"""By how much stamps of headers may differ from the clock of the recorder; beyond, they are of another clock, as that
of a simulation, and stay as they are."""

LONGEST_ARRAY = 36
"""Entries of an array in a message that become channels; longer ones are pictures and scans."""

Record = dict[str, float]
"""The channels of one message."""

Message: TypeAlias = Any
"""A message as rosbags deserializes it, with an attribute for each field of its type."""

Connection: TypeAlias = Any
"""Where the messages of one topic and type stand in a bag; rosbags has a class of its own for each kind of bag."""

_POSE = ("x", "y", "z", "", "", "yaw")

_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
"""Channels of the diagonal of a covariance."""

_UNITS = {"latitude": "deg", "longitude": "deg", "altitude": "m", "yaw": "rad"}
_UNITS |= {"position": "rad", "velocity": "rad/s", "effort": "N m"} | dict.fromkeys(
    ("x", "y", "z", *LOCAL_CHANNELS), "m"
)
_UNITS |= {f"{s}{axis}": unit for axis in "xyz" for s, unit in (("v", "m/s"), ("w", "rad/s"), ("a", "m/s^2"))}
"""Of the channels of known types of messages."""


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
    highlevel = import_library("rosbags.highlevel", what, "'switchfit[ros]'")
    typesys = import_library("rosbags.typesys", what, "'switchfit[ros]'")
    with explain_damage(path, "a ROS bag"):
        store = typesys.get_typestore(typesys.Stores.LATEST)
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            return _read_topic(path, reader, options)


def _read_topic(path: Path, reader: Connection, options: Options) -> Log:
    # One topic may have several connections, one for each node that publishes it; their messages come in order of time.
    connections = _choose_connections(path, reader.connections, options.topic)
    kind, topic = connections[0].msgtype, connections[0].topic
    # A type that is not known still has numbers: each gets a channel by its path in the message.
    read = _READERS.get(kind, _flatten)
    start = reader.start_time

    def unpack(connection: Connection, time: int, data: bytes) -> tuple[int, int, Record, Event | None]:
        message = reader.deserialize(data, connection.msgtype)
        text = getattr(message, "data", None)
        event = Event((time - start) / SECOND, topic, text) if isinstance(text, str) else None
        return time, _read_stamp(message), read(message), event

    found = [unpack(*given) for given in reader.messages(connections=connections)]
    if not found:
        raise InputError(f"{path}: topic {topic} has no messages; there is nothing to read.")
    received, stamps, records, events = zip(*found, strict=True)
    # Stamps say when something was measured, times of receipt when it was written: they differ by the delay of the
    # network, which a fit would take for one of the robot. A header with all stamps 0 was never filled in.
    has_stamps = any(stamps)
    moments = np.array(stamps if has_stamps else received)
    zero = (
        start if abs(int(moments[0]) - start) < LARGEST_CLOCK_DIFFERENCE else 0
    )  # all topics of a bag count from its begin
    names = dict.fromkeys(name for record in records for name in record)
    values = {name: np.array([record.get(name, np.nan) for record in records], dtype=np.float64) for name in names}
    # sigma_x has the unit of x, wheel.position that of position.
    quantities = {name: name.rpartition(".")[2].removeprefix("sigma_") for name in values}
    units = {name: _UNITS.get(quantity, "") for name, quantity in quantities.items() if kind in _READERS}
    issues = () if has_stamps else (Issue("log: no stamps", (str(path), topic)),)
    name = "stamp" if has_stamps else "received"
    columns = {**values, name: (moments - zero) / SECOND}
    log = build_log(f"{path} ({topic})", columns, units | {name: "s"}, options._replace(time=name, keep_epoch=True))
    said = tuple(filter(None, events))
    return replace(
        log, offset=zero / SECOND, issues=issues, events=said, place="message", has_positions=read is _read_fix
    )


def _choose_connections(path: Path, connections: Sequence[Connection], topic: str | None) -> list[Connection]:
    """Return the connections of a topic; if none is named, of the only one that is known or has messages."""
    types = {connection.topic: connection.msgtype for connection in connections if connection.msgcount}
    listed = ", ".join(f"{name} ({kind.replace('/msg/', '/')})" for name, kind in sorted(types.items())) or "none"
    if topic is None:
        known = [name for name, kind in types.items() if kind in _READERS] or list(types)
        if len(known) != 1:
            raise InputError(f"{path} has several topics, name one: topic = ... They are {listed}.")
        topic = known[0]
    chosen = [connection for connection in connections if connection.topic == topic]
    if not chosen:
        raise InputError(f"{path} has no topic {shorten(topic)}; its topics are {listed}.")
    return chosen


def _read_stamp(message: Message) -> int:
    """Return the stamp of a header in nanoseconds; 0 without a header."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * SECOND + int(stamp.nanosec)


def _read_fix(message: Message) -> Record:
    position = ("latitude", "longitude", "altitude")
    # Receivers go on sending without a fix, with the last position or zeros.
    if message.status.status < 0:  # no fix
        return dict.fromkeys(position, np.nan)
    found = {name: getattr(message, name) for name in position}
    # The diagonal of a 3 by 3 matrix, east, north, up, in rows; type 0 says that it is unknown.
    variances = np.asarray(message.position_covariance)[[0, 4, 8]]
    if message.position_covariance_type > 0 and np.all(variances > 0):
        found |= dict(zip(SIGMA_CHANNELS, np.sqrt(variances).tolist(), strict=True))
    return found


def _read_motion(motion: Message) -> Record:
    """Return the channels of a pose or of a twist, and the square roots of variances that are given: 0 is unknown."""
    if hasattr(motion, "covariance"):
        names, inner = (_POSE, motion.pose) if hasattr(motion, "pose") else (_TWIST, motion.twist)
        # The diagonal of 6 by 6. Of the angles only yaw has a channel; its place is the last one.
        variances = zip(names, np.asarray(motion.covariance)[::7].tolist(), strict=True)
        return _read_motion(inner) | {f"sigma_{name}": float(np.sqrt(v)) for name, v in variances if name and v > 0}
    if hasattr(motion, "position"):
        p = motion.position
        return {"x": p.x, "y": p.y, "z": p.z, "yaw": _find_yaw(motion.orientation)}
    v, w = motion.linear, motion.angular
    return dict(zip(_TWIST, (v.x, v.y, v.z, w.x, w.y, w.z), strict=True))


def _read_imu(message: Message) -> Record:
    a, w = message.linear_acceleration, message.angular_velocity
    found = {"ax": a.x, "ay": a.y, "az": a.z, "wx": w.x, "wy": w.y, "wz": w.z}
    if message.orientation_covariance[0] != -1:  # -1: it has no orientation
        found["yaw"] = _find_yaw(message.orientation)
    return found


def _read_joints(message: Message) -> Record:
    found: Record = {}
    for field in ("position", "velocity", "effort"):
        samples = getattr(message, field)
        if len(samples) == len(message.name):
            found |= {f"{name}.{field}": float(s) for name, s in zip(message.name, samples, strict=True)}
    return found


def _find_yaw(q: Message) -> float:
    """Return the angle about the vertical axis of a quaternion; NaN for the zero quaternion, which is no rotation."""
    if q.x == q.y == q.z == q.w == 0.0:
        return np.nan
    # Yaw of the rotation z-y'-x'', which needs no normalised quaternion: both arguments scale alike.
    return float(np.arctan2(2 * (q.w * q.z + q.x * q.y), q.w**2 + q.x**2 - q.y**2 - q.z**2))


def _flatten(message: Message, prefix: str = "") -> Record:
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


_READERS: dict[str, Callable[[Message], Record]] = {
    "sensor_msgs/msg/NavSatFix": _read_fix,
    "sensor_msgs/msg/Imu": _read_imu,
    "sensor_msgs/msg/JointState": _read_joints,
    "nav_msgs/msg/Odometry": lambda m: _read_motion(m.pose) | _read_motion(m.twist),
    "geometry_msgs/msg/Pose": _read_motion,
    "geometry_msgs/msg/PoseStamped": lambda m: _read_motion(m.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _read_motion(m.pose),
    "geometry_msgs/msg/Twist": _read_motion,
    "geometry_msgs/msg/TwistStamped": lambda m: _read_motion(m.twist),
    "geometry_msgs/msg/TwistWithCovarianceStamped": lambda m: _read_motion(m.twist),
}
"""Types that are known; of all others, every number becomes a channel by its name in the message."""
