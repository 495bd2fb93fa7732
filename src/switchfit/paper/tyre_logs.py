"""Logs of a vehicle on tyres of the Magic Formula, whose wheel speeds are a choice.

The paper does not print its own wheel speeds.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.simulation import simulate
from switchfit.fit.trajectory import Trajectory
from switchfit.models.magic_formula import magic_formula
from switchfit.models.tyre_forces import MAGIC_FORMULA
from switchfit.paper.vehicle import HORIZON, TRUTH, position, positions_at, simulate_drive
from switchfit.problem.data import Data
from switchfit.problem.experiment import Experiment
from switchfit.problem.inputs import Input
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem

TYRE_LOG_START = (5.0, 10.0, 0.8)

#: Times (s) of the commands to the wheels of the Magic Formula vehicle to turn and to stop turning, as in the paper.
COMMANDED = (5.0, 10.0)

#: Time (s) in which the wheels reach a commanded difference of speed.
RISE = 0.6

#: Speed (m/s) of the treads on one side above and on the other below the mean while it turns.
DIFFERENTIAL = 0.17

WHEEL_RADIUS = 0.15


def wheel_speeds(
    differential: float = DIFFERENTIAL, stick_force: float = 15.0, *, rise: float = RISE, fall: float = RISE
) -> Input:
    """Return wheel speeds of the Magic Formula vehicle (rad/s), which are a choice: the paper does not print its own.

    The mean speed of the treads is the forward speed of (18) with the paper's torques, mu = 0.7 and slip from 5 to 10 s
    (with reset at re-stick, so that it drives straight on). From 5 to 10 s, wheels 1 and 4 are faster by `differential`
    and 2 and 3 slower; the difference rises within `rise` and falls within `fall` (s).
    """
    # The speed of (18), which has no tyres, is what the wheels are told to drive at on average.
    path = simulate_drive((*COMMANDED, TRUTH[2]), stick_force=stick_force, restick="reset")
    theta = path.states[:, 4]
    forward = np.cos(theta) * path.states[:, 1] + np.sin(theta) * path.states[:, 3]
    knots = [0.0, COMMANDED[0], COMMANDED[0] + rise, COMMANDED[1], COMMANDED[1] + fall, HORIZON]
    # Knots of the ramps are nodes: an input that is linear between them has no other kinks.
    times = np.unique(np.concatenate([np.arange(0.0, HORIZON + 0.05, 0.1).round(1), knots]))
    mean = np.interp(times, path.times, forward)
    extra = np.interp(times, knots, [0.0, 0.0, differential, differential, 0.0, 0.0])
    treads = np.stack([mean + extra, mean - extra, mean - extra, mean + extra], axis=1)
    return Input(times, treads / WHEEL_RADIUS, kind="linear")


def on_tyres(data: Data, speeds: Input, parameters: dict[str, Any] | None = None) -> Problem:
    """Return the Magic Formula vehicle under given wheel speeds; `parameters` are its coefficients, by default the
    published ones.
    """
    run = Experiment(data, ("drive",), (), 0.0, HORIZON, inputs=speeds)
    coefficients = dict(MAGIC_FORMULA) if parameters is None else parameters
    return Problem(magic_formula(wheel_radius=WHEEL_RADIUS), run, coefficients, solver="stiff")


def log_on_tyres(times: FloatArray, speeds: Input) -> tuple[FloatArray, Trajectory]:
    """Return positions (K, 2) of the Magic Formula vehicle at `times`, and its trajectory."""
    path = simulate(on_tyres(Measurements(times, np.zeros((len(times), 2)), position), speeds))
    return positions_at(path, times), path
