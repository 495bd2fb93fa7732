"""Logs of robots and other programs: each file is written here by its format's own writer, and read back."""

import io
import re
import struct
import sys
from datetime import UTC, datetime, timedelta
from functools import reduce

import gpxpy.gpx
import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pymap3d
import pynmea2
import pytest
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.io import savemat

import switchfit as sf
from switchfit.io.problem_file.loading import load_problem
from switchfit.runtime.errors import InputError

START = datetime(2024, 5, 1, 12, 0, 0, tzinfo=UTC)
EPOCH = int(START.timestamp())
TIMES = np.array([0.0, 0.25, 0.5, 1.0])
X = np.array([0.0, 1.0, 3.0, 6.0])
ORIGIN = (48.1, 11.6, 520.0)


def globe(east, north, up=0.0):
    """Latitude, longitude and altitude of a position in the local frame."""
    return [float(value) for value in pymap3d.enu2geodetic(east, north, up, *ORIGIN)]


# --- the local frame --------------------------------------------------------------------------------------------------


def test_a_metre_is_a_metre(tmp_path):
    """Against the radii of curvature of the ellipsoid, by hand."""
    a, e2, step = 6378137.0, 0.00669437999014, 1e-5
    latitude = np.deg2rad(48.0)
    root = np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    east, north = np.deg2rad(step) * np.array([a / root * np.cos(latitude), a * (1 - e2) / root**3])
    (tmp_path / "a.csv").write_text(f"t,lat,lon,alt\n0,48,11,0\n1,48,{11 + step},0\n2,{48 + step},11,5\n")
    log = sf.read_log(tmp_path / "a.csv", columns=["east", "north", "up"])
    np.testing.assert_allclose(log[["east", "north", "up"]], [[0, 0, 0], [east, 0, 0], [0, north, 5]], atol=1e-5)
    assert log.origin == (48, 11, 0)
    assert set(log.units.values()) == {"m"}


def test_origin_and_columns_of_a_table(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,gps_lat,gps_lon,HDOP\n0,48,11,1.5\n1,,,\n2,48.001,11,2\n")
    assert sf.read_log(path).channels == ("gps_lat", "gps_lon", "HDOP")  # nothing is computed that is not asked for
    log = sf.read_log(path, origin=[48.001, 11], range_error=4)
    np.testing.assert_allclose(log["north"], [-111.2, np.nan, 0], atol=0.1)
    np.testing.assert_allclose(log["sigma_east"], np.array([1.5, np.nan, 2]) * 4 / np.sqrt(2))
    assert "up" not in log
    assert sf.read_log(path, columns=["sigma_north"], range_error=4).channels == ("sigma_north",)


# --- GPX and NMEA -----------------------------------------------------------------------------------------------------


def test_gpx(tmp_path):
    gpx, segment = gpxpy.gpx.GPX(), gpxpy.gpx.GPXTrackSegment()
    for t, x in zip(TIMES, X, strict=True):
        time = START + timedelta(seconds=t)
        segment.points.append(gpxpy.gpx.GPXTrackPoint(*globe(x, 2 * x), time, horizontal_dilution=1.2))
    gpx.tracks.append(gpxpy.gpx.GPXTrack())
    gpx.tracks[0].segments.append(segment)
    gpx.waypoints.append(gpxpy.gpx.GPXWaypoint(*ORIGIN[:2], time=START + timedelta(seconds=0.5), name="gate"))
    (tmp_path / "a.gpx").write_text(gpx.to_xml())
    log = sf.read_log(tmp_path / "a.gpx", range_error=5)
    np.testing.assert_array_equal(log.times, TIMES)
    assert (log.start, log.time_unit) == (START, "s")
    np.testing.assert_allclose(log[["east", "north"]], np.stack([X, 2 * X], axis=1), atol=1e-5)
    np.testing.assert_allclose(log["sigma_north"], 1.2 * 5 / np.sqrt(2))
    np.testing.assert_allclose(log.origin, ORIGIN, atol=1e-8)
    assert log.events == ((0.5, "waypoint", "gate"),)


def degrees(value, width):
    """ddmm.mmmmmmm of a number of degrees."""
    return f"{int(abs(value)):0{width}d}{60 * (abs(value) % 1):010.7f}"


def sentences(t, x, quality="1", status="A"):
    latitude, longitude, _ = globe(x, 2 * x)
    moment = START + timedelta(seconds=t)
    clock, day = f"{moment:%H%M%S}.{moment.microsecond // 10000:02d}", f"{moment:%d%m%y}"
    where = (degrees(latitude, 2), "N", degrees(longitude, 3), "E")
    return [
        pynmea2.GGA("GP", "GGA", (clock, *where, quality, "08", "1.1", "520.0", "M", "46.9", "M", "", "")),
        pynmea2.RMC("GP", "RMC", (clock, status, *where, "10.0", "26.6", day, "", "")),
        pynmea2.GST("GP", "GST", (clock, "1.0", "0.8", "0.4", "30.0", "0.5", "0.25", "1.5")),
    ]


@pytest.fixture
def read_nmea(tmp_path):
    def read(lines, name="a.nmea"):
        (tmp_path / name).write_text("\r\n".join(map(str, lines)))
        return sf.read_log(tmp_path / name)

    return read


@pytest.mark.parametrize("name", ["a.nmea", "a.log"])
def test_nmea(read_nmea, name):
    lines = [s for t, x in zip(TIMES, X, strict=True) for s in sentences(t, x)]
    lines.append(pynmea2.ZDA("GP", "ZDA", ("235959.00", "01", "02", "2024", "00", "00")))  # no position
    lines.append(pynmea2.RMC("GP", "RMC", ("", "V", "", "", "", "", "", "", "", "", "")))  # no time
    log = read_nmea(lines, name)
    np.testing.assert_allclose(log.times, TIMES, atol=2e-6)
    assert log.start == START
    np.testing.assert_allclose(log[["east", "north"]], np.stack([X, 2 * X], axis=1), atol=1e-3)
    np.testing.assert_array_equal(log[["sigma_east", "sigma_north", "sigma_up"]], [[0.25, 0.5, 1.5]] * 4)
    np.testing.assert_allclose(log["speed"], 10 * 1852 / 3600)
    assert (log.units["speed"], log.units["course"], log["quality"][0]) == ("m/s", "deg", 1)
    np.testing.assert_array_equal(log.rows, [1, 4, 7, 10])


def test_nmea_with_damage_and_without_a_fix(read_nmea):
    lines = [*sentences(0, 0), *sentences(1, 1, quality="0", status="V"), sentences(2, 2)[0]]
    log = read_nmea([*lines, str(sentences(3, 3)[0]).replace("520.0", "530.0"), "noise", "$GP"])
    np.testing.assert_allclose(log.times, [0, 1, 2], atol=2e-6)
    np.testing.assert_allclose(log["east"], [0, np.nan, 2], atol=1e-3)
    np.testing.assert_array_equal(log["sigma_east"], [0.25, 0.25, np.nan])
    said = [str(issue) for issue in log.issues if issue.kind == "log: damaged sentences"]
    assert "a.nmea, line 8 (and 1 more): no sentence, or with a wrong checksum; left out." in said[0]


@pytest.mark.parametrize(("dated", "first", "start"), [(0, 86399, None), (1, 0, START + timedelta(seconds=43199))])
def test_nmea_over_midnight(read_nmea, dated, first, start):
    """Without a date in its sentences, and with one in the second of them."""
    log = read_nmea([sentences(43199, -1)[0], sentences(43200, 0)[dated], sentences(43201, 1)[0]])
    np.testing.assert_array_equal(log.times, first + np.arange(3))
    assert log.start == start


# --- ROS --------------------------------------------------------------------------------------------------------------


def turned(place, yaw):
    """A quaternion."""
    return {f"{place}.z": np.sin(yaw / 2), f"{place}.w": np.cos(yaw / 2)}


COVARIANCES = {3: np.diag([0.04, 0.09, 0.25]).ravel(), 6: np.diag([0.01, 0.04, 0, 0, 0, 0.0025]).ravel()}
UNKNOWN = np.r_[-1.0, np.zeros(8)]

MESSAGES = {
    "/fix": ("sensor_msgs/msg/NavSatFix", lambda x: {
        **dict(zip(("latitude", "longitude", "altitude"), globe(x, 2 * x), strict=True)),
        "position_covariance": COVARIANCES[3], "position_covariance_type": 2,
    }),
    "/odom": ("nav_msgs/msg/Odometry", lambda x: turned("pose.pose.orientation", 0.1 * x) | {
        "pose.pose.position.x": x, "twist.twist.linear.x": x, "twist.twist.angular.z": 2 * x,
        "pose.covariance": COVARIANCES[6],
    }),
    "/pose": ("geometry_msgs/msg/PoseStamped", lambda x: turned("pose.orientation", 3.0) | {
        "pose.position.x": x, "pose.position.y": 1.0, "pose.position.z": 2.0,
    }),
    "/twist": ("geometry_msgs/msg/TwistStamped", lambda x: {"twist.linear.x": x, "twist.angular.z": -x}),
    "/cmd_vel": ("geometry_msgs/msg/Twist", lambda x: {"linear.x": x, "angular.z": -x}),
    "/force": ("geometry_msgs/msg/WrenchStamped", lambda x: {"wrench.force.x": x}),
    "/imu": ("sensor_msgs/msg/Imu", lambda x: turned("orientation", 0.5) | {
        "orientation_covariance": np.zeros(9) if x else UNKNOWN,
        "angular_velocity.z": x, "linear_acceleration.x": x, "linear_acceleration.z": 9.81,
    }),
    "/joints": ("sensor_msgs/msg/JointState", lambda x: {
        "name": ["hip", "knee"], "position": np.array([x, -x]), "velocity": np.array([1.0, x]),
    }),
    "/log": ("std_msgs/msg/String", lambda x: {"data": f"at {x:g}"}),
}  # fmt: skip
"""Types of topics, and the fields of a message that are not zero."""


def make_blank(store, kind):
    """A message of zeros, empty texts and empty sequences."""

    def fill(form):
        node, inside = form
        if node is Nodetype.NAME:
            return make_blank(store, inside)
        if node is Nodetype.BASE:
            return "" if inside[0] == "string" else 0
        (_, (name, *_)), count = inside
        return [] if name == "string" else np.zeros(count, name)

    _, fields = store.fielddefs[kind]
    return store.types[kind](**{name: fill(form) for name, form in fields})


def make_message(store, kind, stamp, fields):
    message = make_blank(store, kind)
    if hasattr(message, "header"):
        message.header.stamp = type(message.header.stamp)(*divmod(stamp, 10**9))
    for place, value in fields.items():
        *parts, name = place.split(".")
        setattr(reduce(getattr, parts, message), name, value)
    return message


LATE = 0.125
"""Seconds from the stamp to the recorder."""


def write_bag(path, kind, messages=MESSAGES, epoch=EPOCH):
    """Write a bag, and return what is to be read. The stamps of its messages count from the epoch."""
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    if kind == "ros1":
        writer, serialize = BagWriter(path), store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer, serialize = Writer(path, version=9, storage_plugin=plugin), store.serialize_cdr
    with writer:
        for topic, (type_name, fields) in messages.items():
            connection = writer.add_connection(topic, type_name, typestore=store)
            for t, x in zip(TIMES, X, strict=True):
                received = EPOCH * 10**9 + round((t + LATE) * 1e9)
                message = make_message(store, type_name, epoch * 10**9 + round(t * 1e9), fields(x))
                writer.write(connection, received, serialize(message, type_name))
    return next(path.glob("*.mcap")) if kind == "mcap" else path


@pytest.fixture(scope="module", params=["ros1", "ros2", "mcap"])
def bag(request, tmp_path_factory):
    name = "a.bag" if request.param == "ros1" else "a"
    return write_bag(tmp_path_factory.mktemp("bags") / name, request.param)


READ = {
    "/fix": {"east": X, "north": 2 * X, "sigma_east": 0.2, "sigma_north": 0.3, "sigma_up": 0.5},
    "/odom": {"x": X, "yaw": 0.1 * X, "vx": X, "wz": 2 * X, "sigma_x": 0.1, "sigma_y": 0.2, "sigma_yaw": 0.05},
    "/pose": {"x": X, "y": 1.0, "z": 2.0, "yaw": 3.0},
    "/twist": {"vx": X, "wz": -X},
    "/imu": {"yaw": [np.nan, 0.5, 0.5, 0.5], "ax": X, "az": 9.81, "wz": X},
    "/joints": {"hip.position": X, "knee.position": -X, "hip.velocity": 1.0, "knee.velocity": X},
    "/force": {"wrench.force.x": X, "wrench.torque.z": 0.0},  # not known: every number by its name in the message
}
UNITS = {"east": "m", "latitude": "deg", "yaw": "rad", "vx": "m/s", "wz": "rad/s", "az": "m/s^2"}
UNITS |= {"sigma_up": "m", "sigma_yaw": "rad", "knee.velocity": "rad/s"}


@pytest.mark.parametrize("topic", READ)
def test_messages(bag, topic):
    log = sf.read_log(bag, topic=topic)
    for name, expected in READ[topic].items():
        np.testing.assert_allclose(log[name], np.broadcast_to(expected, 4), atol=1e-5 if topic == "/fix" else 1e-12)
        assert log.units[name] == UNITS.get(name, log.units[name])
    np.testing.assert_allclose(log.times, TIMES - LATE, atol=1e-12)  # since the bag began, by the stamps of the headers
    assert log.start == START + timedelta(seconds=LATE)
    assert log.source.endswith(f"({topic})")
    assert {"sigma_z", "sigma_vx"}.isdisjoint(log.channels)  # a variance of 0 is one that is not known


def test_messages_without_stamps(bag):
    log = sf.read_log(bag, topic="/cmd_vel")
    np.testing.assert_allclose(log.times, TIMES, atol=1e-12)
    assert any("messages of /cmd_vel have no stamps; the times are those of the rec" in str(i) for i in log.issues)
    text = sf.read_log(bag, topic="/log")
    assert [event.text for event in text.events] == ["at 0", "at 1", "at 3", "at 6"]


def test_topics(bag, tmp_path):
    with pytest.raises(InputError, match=r"has no topic '/gps'; its topics are /cmd_vel \(geometry_msgs/Twist\), /fix"):
        sf.read_log(bag, topic="/gps")
    with pytest.raises(InputError, match=r"has several topics, name one: topic = \.\.\. They are /cmd_vel"):
        sf.read_log(bag)
    two = {name: MESSAGES[name] for name in ("/fix", "/log")}
    assert "east" in sf.read_log(write_bag(tmp_path / "b", "ros2", two))  # one with numbers


def test_no_fix_and_the_clock_of_a_simulation(tmp_path):
    kind, fields = MESSAGES["/fix"]
    lost = {"/fix": (kind, lambda x: fields(x) | {"status.status": -1 if x == 1.0 else 0})}
    log = sf.read_log(write_bag(tmp_path / "a", "ros2", lost, epoch=0))
    np.testing.assert_allclose(log["east"], [0, np.nan, 3, 6], atol=1e-5)
    np.testing.assert_array_equal(log.times, TIMES)
    assert log.start is None


# --- MATLAB and Parquet -----------------------------------------------------------------------------------------------


def write_73(path, contents):
    """Write a .mat file of version 7.3: HDF5 behind 512 bytes, arrays transposed, text as numbers."""

    def write(group, values):
        for name, value in values.items():
            if isinstance(value, dict):
                write(group.create_group(name), value)
            elif isinstance(value, str):
                group[name] = np.array([[ord(c)] for c in value], dtype=np.uint16)
                group[name].attrs["MATLAB_class"] = np.bytes_("char")
            else:
                group[name] = np.atleast_2d(value).T if np.ndim(value) > 1 else np.reshape(value, (1, -1))

    with h5py.File(path, "w", userblock_size=512) as file:
        write(file, contents)


def add_object_5(path, name, kind):
    """Add an object of MATLAB to a .mat file of version 5, which SciPy does not write: a name, a class, a number."""

    def element(code, data):
        return struct.pack("<II", code, len(data)) + data + bytes(-len(data) % 8)

    number = io.BytesIO()
    savemat(number, {"x": np.array([[0xDD000000], [2], [1], [1], [1], [1]], dtype=np.uint32)})
    flags = element(6, struct.pack("<II", 17, 0))
    parts = [element(1, text.encode()) for text in (name, "MCOS", kind)]
    with path.open("ab") as file:
        file.write(element(14, b"".join([flags, *parts, number.getvalue()[128:]])))


def add_object_73(path, name, kind):
    """Add an object of MATLAB to a .mat file of version 7.3."""
    with h5py.File(path, "a") as file:
        file[name] = np.array([[0xDD000000, 2, 1, 1, 1, 1]], dtype=np.uint32)
        file[name].attrs["MATLAB_class"] = np.bytes_(kind)
        file[name].attrs["MATLAB_object_decode"] = np.int32(3)


@pytest.fixture(params=["5", "7.3"])
def write_mat(request, tmp_path):
    def write(**contents):
        path = tmp_path / "a.mat"
        (savemat if request.param == "5" else write_73)(path, contents)
        return path

    return write


def test_vectors(write_mat):
    units = {"x": "m", "t": "s"}
    log = sf.read_log(write_mat(t=TIMES, x=X, matrix=np.stack([X, 2 * X], axis=1), gain=3.0, units=units))
    np.testing.assert_array_equal(log.times, TIMES)
    assert set(log.channels) == {"x", "matrix_1", "matrix_2"}
    np.testing.assert_array_equal(log[["x", "matrix_2"]], np.stack([X, 2 * X], axis=1))
    assert (log.units["x"], log.time_unit) == ("m", "s")


def test_structs(write_mat):
    drive = {"Time": TIMES, "Data": X, "signals": {"values": 2 * X}}
    path = write_mat(drive=drive, still={"t": TIMES, "x": X}, note="calibrated")
    log = sf.read_log(path, topic="drive")
    np.testing.assert_array_equal(log.times, TIMES)
    assert log.channels == ("Data", "signals.values")
    np.testing.assert_array_equal(log["signals.values"], 2 * X)
    assert log.source.endswith("a.mat (drive)")
    for topic, message in (
        (None, r"several structs with times \(drive, still\).*Name one: topic"),
        ("dive", r"has no struct 'dive' with times; those that have are drive, still"),
    ):
        with pytest.raises(InputError, match=message):
            sf.read_log(path, topic=topic)
    path = write_mat(x=X, y=X)
    with pytest.raises(InputError, match=r"a\.mat has no vector of times; its variables are x, y\. Name the one with"):
        sf.read_log(path)
    np.testing.assert_array_equal(sf.read_log(path, time="x")["y"], X)


@pytest.mark.parametrize(("write", "add_object"), [(savemat, add_object_5), (write_73, add_object_73)])
def test_objects_of_matlab(tmp_path, write, add_object):
    """They are passed over beside a log; where there is no other, the way to save them as numbers is said."""
    path = tmp_path / "a.mat"
    write(path, {"t": TIMES, "x": X})
    add_object(path, "first", "timeseries")
    add_object(path, "second", "string")
    log = sf.read_log(path)
    np.testing.assert_array_equal(log["x"], X)
    assert log.channels == ("x",)
    remedy = re.escape(r"s = struct('t', ts.Time, 'y', ts.Data); save('log.mat', '-struct', 's')")
    with pytest.raises(InputError, match=rf"has no struct 'first' with times; .* only MATLAB reads.*: {remedy}"):
        sf.read_log(path, topic="first")
    write(path, {"gain": 3.0})
    add_object(path, "ts", "timeseries")
    with pytest.raises(InputError, match=rf"a\.mat has no vector of times; .* only MATLAB reads.*: {remedy}"):
        sf.read_log(path)


def test_parquet(tmp_path):
    path = tmp_path / "a.parquet"
    fields = [
        pa.field("time", pa.float64(), metadata={"unit": "ms"}),
        pa.field("x", pa.int64(), metadata={"units": "m"}),
        pa.field("mode", pa.string()),
    ]
    columns = [pa.array(1e3 * TIMES), pa.array([0, None, 3, 6]), pa.array(list("abcd"))]
    pq.write_table(pa.table(columns, schema=pa.schema(fields)), path)
    log = sf.read_log(path)
    assert (log.channels, log.units, log.time_unit) == (("x",), {"x": "m"}, "ms")
    np.testing.assert_array_equal(log.times, 1e3 * TIMES)
    np.testing.assert_array_equal(log["x"], [0, np.nan, 3, 6])
    for time, message in (
        ("z", r"a\.parquet has no column 'z'; its columns are time, x, mode"),
        ("mode", r"a\.parquet: column 'mode' has neither numbers nor dates\. Name the"),
    ):
        with pytest.raises(InputError, match=message):
            sf.read_log(path, time=time)


def test_parquet_of_pandas(tmp_path):
    path = tmp_path / "a.parquet"
    table = pd.DataFrame({"x": X}, index=pd.Index(pd.Timestamp(START) + pd.to_timedelta(TIMES, unit="s"), name="time"))
    table.attrs["units"] = {"x": "m"}
    table.to_parquet(path)
    log = sf.read_log(path)
    np.testing.assert_array_equal(log.times, TIMES)
    assert (log.start, log.units) == (START, {"x": "m"})


# --- what cannot be read ----------------------------------------------------------------------------------------------

NO_FIX = "\n".join(str(s) for s in sentences(0, 0, "0", "V")).encode()
NO_TIMES = b'<gpx version="1.1" creator="a"><trk><trkseg><trkpt lat="1" lon="2"/></trkseg></trk></gpx>'


ONES, CENTRE = b"t,lat,lon\n0,1,1\n1,1,1\n", {"origin": [0, 0]}


@pytest.mark.parametrize(
    ("name", "content", "options", "message"),
    [
        ("a.gpx", NO_TIMES, {}, "has no track with times: of 1 points, none has a time"),
        ("a.gpx", b"<gpx><trk>", {}, "is no GPX file: "),
        ("a.nmea", NO_FIX, {}, "has no GGA, RMC or GNS sentence with a position"),
        ("a.mcap", b"no bag", {}, "cannot be read as a ROS bag: "),
        ("a.mat", b"x" * 700, {}, r"cannot be read as a \.mat file: "),
        ("a.parquet", b"PAR1", {}, "cannot be read as a Parquet file: "),
        # Nor positions in a local frame
        ("a.csv", ONES.replace(b"0,1,1", b"0,480000000,110000000"), CENTRE, ".*lat and lon must be in degrees; some"),
        ("a.csv", ONES.replace(b"1,1", b","), CENTRE, "has no position: all of lat and lon are missing"),
        ("a.csv", b"t,x,y\n0,1,2\n", CENTRE, "has no latitude and longitude; its columns are x, y"),
        ("a.csv", ONES, {"range_error": 3}, "has no channel hdop, of which range_error makes a sigma"),
        ("a.csv", ONES, {"range_error": 0}, "range_error must be positive"),
        ("a.csv", ONES, {"origin": [95, 0]}, r"origin must be \[latitude, longitude\] in degrees, or wi"),
    ],
)
def test_files_that_are_no_logs(name, content, options, message, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as raised:
        sf.read_log(tmp_path / name, **options)
    assert name in str(raised.value) or "must be" in message


@pytest.mark.parametrize(
    ("name", "extra", "option", "form"),
    [
        ("a.gpx", "gps", "time", "a GPX track"),
        ("a.nmea", "gps", "topic", "an NMEA 0183 log"),
        ("a.csv", None, "topic", "a table of text"),
        ("a.parquet", "parquet", "topic", "a Parquet file"),
        ("a.bag", "ros", "time", "a ROS bag"),
        ("a.mat", "matlab", None, ""),
    ],
)
def test_options_that_mean_nothing_and_libraries_that_are_missing(name, extra, option, form, tmp_path, monkeypatch):
    (tmp_path / name).write_bytes(b"\x89HDF\r\n\x1a\n" if extra == "matlab" else b"$")
    if option:
        message = rf"{name} is {form}, for which {option} means nothing; leave out {option}"
        with pytest.raises(InputError, match=message):
            sf.read_log(tmp_path / name, **{option: "x"})
    for module in ("gpxpy", "pynmea2", "rosbags.highlevel", "h5py", "pyarrow.parquet"):
        monkeypatch.setitem(sys.modules, module, None)
    if extra:
        with pytest.raises(InputError, match=rf"{name}: .* cannot be imported \(.*\): pip install 'switchfit\[{extra}"):
            sf.read_log(tmp_path / name)


def test_a_sigma_that_is_missing_with_its_value():
    """Where a receiver has no fix there is no sigma."""
    values, sigma = np.array([[0.0], [np.nan], [2.0]]), np.array([[0.1], [np.nan], [0.2]])
    data = sf.Measurements([0.0, 1.0, 2.0], values, sigma=sigma)
    np.testing.assert_allclose(data.weights[:, 0], [100.0, 0.0, 25.0])
    sigma[2] = np.nan
    with pytest.raises(ValueError, match=r"sigma must be .*; it is NaN at index \[2, 0\], and the value is not"):
        sf.Measurements([0.0, 1.0, 2.0], values, sigma=sigma)


# --- in problem files -------------------------------------------------------------------------------------------------


def test_topics_of_one_bag_in_a_problem_file(tmp_path):
    write_bag(tmp_path / "a", "ros2", {name: MESSAGES[name] for name in ("/fix", "/odom", "/cmd_vel")})
    go = "{'go': lambda t, x, p, u: p['k'] * u['v'] + 0 * x}"
    model = f"import switchfit as sf\nsystem = sf.HybridSystem({go}, [0.0], state_names=('east',))\n"
    (tmp_path / "model.py").write_text(model)
    (tmp_path / "problem.toml").write_text("""
model = "model.py:system"
parameters.k = 1.0
[experiments]
mode_sequence = ["go"]
transition_times = []
t0 = 0.0
data = { file = "a", topic = "/fix", columns = ["east"], window = [0.0, 2.0], sigma = ["sigma_east"] }
inputs = { file = "a", topic = "/cmd_vel", columns = { v = "vx" } }
""")
    (run,) = load_problem(tmp_path / "problem.toml").problem.experiments
    np.testing.assert_allclose(run.data[0].times, TIMES[1:] - LATE)
    np.testing.assert_allclose(run.data[0].values[:, 0], X[1:], atol=1e-5)
    np.testing.assert_allclose(run.data[0].sigma, 0.2)
    np.testing.assert_allclose(run.inputs.times, TIMES)
    assert run.inputs.units == ("m/s",)
