"""The examples of online estimation: the simulated vehicle, the surfaces, the Husky, and the ROS 2 node."""

import json
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace as Fields

import numpy as np
import pytest

import switchfit as sf

EXAMPLES = Path(__file__).parent.parent / "examples"


def list_messages():
    """A drive of 12 s with a turn: commands 20 times a second, positions 10 times; from 5 s on slip is 0.4."""
    rng, place, yaw = np.random.default_rng(0), np.array([3.0, -2.0]), 0.4
    for k in range(241):
        t = k / 20
        turns, speed = 0.1 * (t >= 2.0), 1.5 * (0.6 if t >= 5.0 else 1.0)
        if k % 2 == 0:
            stamp = Fields(sec=1_700_000_000 + k // 20, nanosec=k % 20 * 50_000_000)
            x, y = place + 0.03 * rng.standard_normal(2)
            turned = Fields(x=0.0, y=0.0, z=np.sin(0.5 * yaw), w=np.cos(0.5 * yaw))
            pose = Fields(position=Fields(x=x, y=y, z=0.0), orientation=turned)
            yield Fields(header=Fields(stamp=stamp), pose=Fields(pose=pose))
        yield Fields(twist=Fields(linear=Fields(x=1.5), angular=Fields(z=turns)))
        for _ in range(10):  # to the next command
            place = place + 0.005 * speed * np.array([np.cos(yaw), np.sin(yaw)])
            yaw += 0.005 * turns


def test_messages_give_samples_and_modes():
    """Times in seconds since the first position, the command that holds then; the slip is found, and when it began."""
    node = runpy.run_path(str(EXAMPLES / "online" / "ros2_node.py"))
    adapter, follower, samples, said = node["Adapter"](), node["Follower"](), [], []
    for message in list_messages():
        if hasattr(message, "twist"):
            adapter.take_command(message)
            follower.adapter.take_command(message)
        else:
            samples.append(adapter.take_odometry(message))
            said.append(follower.take_odometry(message))
    np.testing.assert_allclose([t for t, _, _ in samples], 0.1 * np.arange(121), atol=1e-12)
    assert samples[0][2] == {"vx": 0.0, "wz": 0.0}, "before the first command"
    assert samples[30][2] == {"vx": 1.5, "wz": 0.1}
    last = json.loads(node["describe"](said[-1]))
    assert (last["mode"], last["status"]) == ("slip", "TRACKING")
    assert last["since"] == pytest.approx(5.0, abs=0.15)
    assert last["slip"]["value"] == pytest.approx(0.4, abs=4 * last["slip"]["error"])
    alarms = [now.alarm for now in said[1:] if now.alarm is not None]
    assert [alarm.mode for alarm in alarms] == ["slip"]


def test_vehicle():
    """When it is known that the vehicle slips: as the page says."""
    example = runpy.run_path(str(EXAMPLES / "online" / "online.py"))
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
    drive = example["chain"]()
    log = sf.replay(example["make_problem"](drive), **example["SETTINGS"])
    times = log.now.transition_times
    assert len(times) == 10
    assert (log.delays(times - 0.1) < 1.7).all(), "0.1 s: what the first guess of a time may be off"
    assert len(log.retracted) == len(log.alarms) - len(times) <= 2
    ratios = np.array(example["measure_ratios"](drive, times))
    assert ratios[1::2].max() < 0.08 < ratios[::2].min()
