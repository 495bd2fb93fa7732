"""Twenty steps of a Husky as one drive: when is it known that it turns slower than its wheels say, and how late?

The logs of examples/husky one after the other. The yaw rate of the IMU follows the difference of the wheel speeds, by a
factor that is two to three times smaller on some stretches, of which the drive tells nothing else. As a rate needs no
position, nothing has to be known at the joints. Whether what is declared is true, the lidar says, which the estimator
does not get. Run it:

    python examples/online/husky.py [--threshold 12] [--out DIR]
"""

from __future__ import annotations

import argparse
import runpy
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import switchfit as sf

STEPS = runpy.run_path(str(Path(__file__).parent.parent / "husky" / "husky.py"))
PERIOD, BLOCK = 0.05, 4  # s of a log; samples in a mean
SIGMA = 0.15  # rad/s, by which the means of 0.2 s are off the model
SETTINGS = {"window": 15.0, "min_duration": 0.5}


class Drive(NamedTuple):
    """Times (K,) and yaw rates (K,) by IMU and by lidar (rad/s), times (L,) and speeds (L, 2) of the wheels (rad/s)."""

    times: np.ndarray
    imu: np.ndarray
    lidar: np.ndarray
    wheel_times: np.ndarray
    wheels: np.ndarray


def chain():
    """Return the drive of all steps, one after the other."""
    parts, begin = [], 0.0
    for step in range(20):
        log = STEPS["read"](step)
        count = len(log["t_s"]) // BLOCK
        lidar = np.diff(log["yaw_rad"], append=log["yaw_rad"][-1]) / PERIOD
        means = (rate[: count * BLOCK].reshape(count, BLOCK).mean(axis=1) for rate in (log["imu_yaw"], lidar))
        wheel_times, wheels = STEPS["read_wheels"](log)
        times = begin + PERIOD * BLOCK * np.arange(1, count + 1)
        parts.append((times, *means, begin + wheel_times - STEPS["LATE"], wheels))
        begin += len(log["t_s"]) * PERIOD
    drive = Drive(*map(np.concatenate, zip(*parts, strict=True)))
    known = drive.wheel_times > 0.0
    return drive._replace(
        wheel_times=np.append(0.0, drive.wheel_times[known]), wheels=np.vstack([[0.0, 0.0], drive.wheels[known]])
    )


def turn(ratio):
    """Return the mode in which the yaw rate follows the difference of the wheel speeds by a factor."""

    def follow(t, x, p, u):
        return jnp.stack([(p[ratio] * (u[1] - u[0]) - x[0]) / p["lag"]])

    return follow


SYSTEM = sf.HybridSystem(
    {"usual": turn("usual_ratio"), "slow": turn("slow_ratio")}, [0.0], state_names=("yaw rate",), state_units=("rad/s",)
)


def make_problem(drive, sequence=("usual",), times=()):
    """Return the problem of the drive; all that it knows of the modes is that the robot turns as usual at first."""
    data = sf.Measurements(drive.times, drive.imu, sigma=SIGMA, names=("yaw rate",), units=("rad/s",))
    inputs = sf.Input(drive.wheel_times, drive.wheels)
    run = sf.Experiment(data, sequence, times, t0=0.0, tf=drive.times[-1], inputs=inputs)
    parameters = {
        "usual_ratio": sf.Parameter(0.13, lower=0.08, upper=0.2, unit="1"),
        "slow_ratio": sf.Parameter(0.05, lower=0.0, upper=0.08, unit="1"),
        "lag": sf.Parameter(0.2, fixed=True, unit="s"),
    }
    return sf.Problem(SYSTEM, run, parameters)


def measure_ratios(drive, times):
    """Return the factor between the difference of the wheel speeds and the yaw rate by lidar, in each segment."""
    at = np.searchsorted(drive.wheel_times, drive.times - PERIOD * BLOCK / 2, "right") - 1
    difference = np.diff(drive.wheels, axis=1)[at, 0]
    segments = np.searchsorted(times, drive.times)
    parts = ((difference[segments == k], drive.lidar[segments == k]) for k in range(len(times) + 1))
    return [(d @ rate) / (d @ d) for d, rate in parts]


def main():
    """Print a line for each change that stands at the end, and how many others were declared."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threshold", type=float, default=12.0)
    parser.add_argument("--out", type=Path, help="folder for the figure")
    given = parser.parse_args()
    drive = chain()
    log = sf.replay(make_problem(drive), threshold=given.threshold, **SETTINGS)
    whole = sf.estimate(make_problem(drive, log.now.mode_sequence, tuple(log.now.transition_times)), strategy="local")
    (times,), ratios = whole.transition_times, measure_ratios(drive, log.now.transition_times)
    print(f"{'mode':<7}{'since (s)':>10}{'known after (s)':>17}{'factor by lidar':>17}")
    delays = ["", *(f"{delay:.2f}" for delay in log.delays(times))]
    for mode, since, delay, ratio in zip(log.now.mode_sequence, (0.0, *times), delays, ratios, strict=True):
        print(f"{mode:<7}{since:>10.2f}{delay:>17}{ratio:>17.3f}")
    others = len(log.alarms) - int(np.isfinite(log.delays(times)).sum())
    print(f"other alarms: {others}; retracted: {len(log.retracted)}")
    print({name: round(float(value), 3) for name, value in whole.parameters.items()})
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
        log.plot().savefig(given.out / "husky.png")


if __name__ == "__main__":
    main()
