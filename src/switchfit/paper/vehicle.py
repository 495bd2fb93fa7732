"""The vehicle of Section V, equation (18): its problem, its simulated drives, and positions at 1 Hz."""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
import numpy as np

from switchfit.arrays import FloatArray, Traced
from switchfit.fit.simulation import simulate
from switchfit.fit.trajectory import Trajectory
from switchfit.models.skid_steer import skid_steer
from switchfit.problem.data import Data
from switchfit.problem.experiment import Experiment, Parameter
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.reference_signals import ReferenceSignal

SAMPLE_TIMES = np.arange(16.0)
VEHICLE_SEQUENCE = ("stick", "slip", "stick")
NAMES = ("tau_1", "tau_2", "mu")

#: Truth and start of the simulated problem, in the order of NAMES (s, s, 1).
TRUTH, DRIVE_START = (6.0, 10.0, 0.7), (5.0, 9.0, 0.8)

#: Horizon (s): the paper samples over 15 s.
HORIZON = 15.0

#: Cut-off (Hz) of the low-pass filter of 1 Hz positions; the paper gives none.
LOWPASS_HZ = 0.3

Restick = Literal["continuous", "reset"]


def position(t: Traced, x: Traced, p: Traced) -> Traced:
    """Return the position that GPS measures: (X, Y)."""
    return x[jnp.array([0, 2])]


def stick_slip(
    data: Data,
    start: tuple[float, ...] = DRIVE_START,
    *,
    tf: float = HORIZON,
    stick_force: float = 15.0,
    restick: Restick = "continuous",
) -> Problem:
    """Return the estimation problem of equation (18): transition times and mu from `data`; `start` has this order."""
    system = skid_steer(stick_forces=(stick_force,) * 4, restick=restick)
    # One mode more than transition times: of three numbers, two are times, and the modes are three.
    run = Experiment(data, VEHICLE_SEQUENCE[: len(start)], start[:-1], 0.0, tf)
    return Problem(system, run, {"mu": Parameter(start[-1], lower=0.05, upper=2.0, unit="1")})


def simulate_drive(
    theta: tuple[float, float, float] = TRUTH,
    *,
    tf: float = HORIZON,
    step: float = 0.1,
    stick_force: float = 15.0,
    restick: Restick = "continuous",
) -> Trajectory:
    """Simulate equation (18) at given transition times and mu, with a node every `step` seconds."""
    times = step * np.arange(round(tf / step) + 1)
    # Data of zeros: simulation needs their times alone, as nodes.
    nothing = Measurements(times, np.zeros((len(times), 6)))
    return simulate(stick_slip(nothing, theta, tf=tf, stick_force=stick_force, restick=restick))


def build_simulated_problem() -> Problem:
    """Return the simulated problem of Section V-A 2: the whole state of (18) at TRUTH is the reference signal."""
    path = simulate_drive()
    return stick_slip(ReferenceSignal.from_samples(path.times, path.states))


def positions_at(path: Trajectory, times: FloatArray) -> FloatArray:
    """Return positions (K, 2) at times that are nodes of the trajectory."""
    # A little before the time: a transition stands twice, and k * step is not exactly a node by rounding.
    nodes = np.searchsorted(path.times, np.asarray(times) - 1e-9)
    return path.states[nodes][:, [0, 2]]


def curve(path: Trajectory) -> FloatArray:
    """Return positions (K, 2) along a trajectory, a tenth of a second or less apart, for figures."""
    at = np.linspace(path.times[0], path.times[-1], 151)
    return np.stack([np.interp(at, path.times, path.states[:, i]) for i in (0, 2)], axis=1).round(4)


def gps_reference(times: FloatArray, positions: FloatArray) -> ReferenceSignal:
    """Return 1 Hz positions interpolated and low-pass filtered, as in the paper."""
    return ReferenceSignal.from_samples(times, positions, observe=position, lowpass_hz=LOWPASS_HZ, names=("X", "Y"))
