"""The examples of online estimation: the simulated vehicle, the surfaces, the Husky, and the ROS 2 node with a bag."""

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(scope="module")
def node():
    return runpy.run_path(str(EXAMPLES / "online" / "ros2_node.py"))


def write_bag(folder):
    """A drive of 12 s with a turn: commands 20 times a second, positions 10 times; from 5 s on slip is 0.4."""
    rosbag2, typesys = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    names = ("Point", "Quaternion", "Pose", "PoseWithCovariance", "Vector3", "Twist", "TwistWithCovariance")
    point, quaternion, pose, with_covariance, vector, twist, twist_with = (
        store.types[f"geometry_msgs/msg/{name}"] for name in names
    )
    time, header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    odometry, stamped = store.types["nav_msgs/msg/Odometry"], store.types["geometry_msgs/msg/TwistStamped"]
    rng, place, yaw, rate = np.random.default_rng(0), np.array([3.0, -2.0]), 0.4, 0.1
    still = twist(vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    with rosbag2.Writer(folder, version=9) as bag:
        kinds = {"/odometry/gps": odometry, "/cmd_vel": stamped}
        opened = {topic: bag.add_connection(topic, kind.__msgtype__, typestore=store) for topic, kind in kinds.items()}
        for k in range(241):
            t = k / 20
            stamp = 1_700_000_000 * 10**9 + int(t * 1e9)
            head = header(time(*divmod(stamp, 10**9)), "map")
            turns = rate if t >= 2.0 else 0.0
            if k % 2 == 0:
                noisy = place + 0.03 * rng.standard_normal(2)
                turned = quaternion(0.0, 0.0, np.sin(0.5 * yaw), np.cos(0.5 * yaw))
                there = with_covariance(pose(point(*noisy.tolist(), 0.0), turned), np.zeros(36))
                message = odometry(head, "base", there, twist_with(still, np.zeros(36)))
                bag.write(opened["/odometry/gps"], stamp, store.serialize_cdr(message, odometry.__msgtype__))
            command = stamped(head, twist(vector(1.5, 0.0, 0.0), vector(0.0, 0.0, turns)))
            bag.write(opened["/cmd_vel"], stamp + 1, store.serialize_cdr(command, stamped.__msgtype__))
            for _ in range(10):  # to the next command
                speed = 1.5 * (0.6 if t >= 5.0 else 1.0)
                place = place + 0.005 * speed * np.array([np.cos(yaw), np.sin(yaw)])
                yaw += 0.005 * turns
    return folder


def test_recorded_messages_give_samples_and_modes(node, tmp_path):
    """Times in seconds since the first position, the command that holds then; the slip is found, and when it began."""
    highlevel = pytest.importorskip("rosbags.highlevel")
    typesys = pytest.importorskip("rosbags.typesys")
    bag, samples, said = write_bag(tmp_path / "bag"), [], []
    adapter, follower = node["Adapter"](), node["Follower"]()
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with highlevel.AnyReader([bag], default_typestore=store) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == "/cmd_vel":
                adapter.take_command(message)
                follower.adapter.take_command(message)
            else:
                samples.append(adapter.take_odometry(message))
                said.append(follower.take_odometry(message))
    np.testing.assert_allclose([t for t, _, _ in samples], 0.1 * np.arange(121), atol=1e-12)
    assert samples[0][2] == {"vx": 0.0, "wz": 0.0}, "before the first command"
    assert samples[30][2] == {"vx": 1.5, "wz": 0.1}
    assert set(samples[0][1]) == {"x", "y"}
    assert said[0] is None
    last = json.loads(node["describe"](said[-1]))
    assert (last["mode"], last["status"]) == ("slip", "TRACKING")
    assert last["since"] == pytest.approx(5.0, abs=0.15)
    assert last["slip"]["value"] == pytest.approx(0.4, abs=4 * last["slip"]["error"])
    assert last["slip"]["error"] < 0.05
    alarms = [now.alarm for now in said[1:] if now.alarm is not None]
    assert [alarm.mode for alarm in alarms] == ["slip"]
    assert alarms[0].time < 6.0


def test_vehicle():
    """When it is known that the vehicle slips: as the page says."""
    example = runpy.run_path(str(EXAMPLES / "online" / "online.py"))
    import switchfit as sf

    log = sf.replay(example["simulate"](0), window=6.0)
    assert log.now.mode_sequence == ("stick", "slip", "stick")
    assert (log.delays(example["SLIPS"]) <= [0.9, 0.6]).all()
    assert abs(log.now.parameters["mu"] - 0.7) < 4 * log.now.standard_errors["mu"]


@pytest.mark.parametrize("name", ["green_table_00", pytest.param("green_table_24", marks=pytest.mark.slow)])
def test_surfaces(name, monkeypatch):
    """The border is known within half a second, without another alarm."""
    monkeypatch.syspath_prepend(str(EXAMPLES / "terrain"))
    example = runpy.run_path(str(EXAMPLES / "terrain" / "online.py"))
    log = example["follow"](name, 50.0)
    delays, others = example["count"](log, example["BORDERS"][name])
    assert delays[0] < 0.5
    assert others == 0
    sys.modules.pop("terrain", None)


def test_husky_drive():
    """Ten changes of how fast it turns are known after at most 1.6 s; the lidar, which is not used, agrees."""
    example = runpy.run_path(str(EXAMPLES / "online" / "husky.py"))
    import switchfit as sf

    drive = example["chain"]()
    log = sf.replay(example["make_problem"](drive), **example["SETTINGS"])
    times = log.now.transition_times
    assert len(times) == 10
    assert (log.delays(times - 0.1) < 1.7).all(), "0.1 s: what the first guess of a time may be off"
    assert len(log.retracted) == len(log.alarms) - len(times) <= 2
    ratios = np.array(example["measure_ratios"](drive, times))
    assert ratios[1::2].max() < 0.08 < ratios[::2].min()
