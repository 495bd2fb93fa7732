"""The benchmark problem: the paper's simulated vehicle, from (tau_1, tau_2, mu) = (5, 9, 0.8) to (6, 10, 0.7)."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

import switchfit as sf
from switchfit.discretization.mesh import Mesh, build_rows
from switchfit.meshes.evaluator import Evaluator
from switchfit.models import skid_steer
from switchfit.problem.functions import use_float64

SEQUENCE = ("stick", "slip", "stick")
START, TRUTH, HORIZON = (5.0, 9.0), (6.0, 10.0), (0.0, 15.0)
MU_START, MU_TRUTH = 0.8, 0.7


def with_reference(cells: int | None = None) -> sf.Problem:
    """Cost 1/2 |x - x_m|^2, x_m a spline through the true trajectory, all six states.

    The knots of the spline, which are nodes of the mesh, are the steps in which the true trajectory was found, or
    divide the horizon into equal `cells`.
    """
    seen = sf.RunningCost(lambda t, x, p: 0.0)
    knots = None
    if cells is not None:
        knots = np.linspace(*HORIZON, cells + 1)
        seen = sf.Measurements(knots, np.zeros((len(knots), 6)))
    run = sf.Experiment(seen, SEQUENCE, TRUTH, *HORIZON)
    path = sf.simulate(sf.Problem(skid_steer(), run, {"mu": MU_TRUTH}))
    keep = np.append(True, np.diff(path.times) > 0)  # at a transition a trajectory has two entries
    if knots is not None:
        keep &= np.isin(path.times, knots)
    return _problem(sf.ReferenceSignal.from_samples(path.times[keep], path.states[keep]))


def without_reference() -> sf.Problem:
    """Cost 1/2 |x|^2: nothing but the dynamics costs time."""
    return _problem(sf.RunningCost(lambda t, x, p: 0.5 * (x @ x)))


def _problem(data: object) -> sf.Problem:
    run = sf.Experiment(data, SEQUENCE, START, *HORIZON)
    return sf.Problem(skid_steer(), run, {"mu": sf.Parameter(MU_START, lower=0.05, upper=2.0)})


@dataclass(frozen=True)
class Row:
    """One Runge-Kutta step as CasADi gets it.

    Attributes
    ----------
    mode : "stick" or "slip"
    start, end : times; `starts_at` and `ends_at` say which transition (from 0) they are, -1 for none
    origin : time from which the reference counts
    coefficients : (4, 6) of the reference in this row, lowest power first; zeros without a reference
    """

    mode: str
    start: float
    end: float
    starts_at: int
    ends_at: int
    origin: float
    coefficients: np.ndarray


def table_of_rows(evaluator: Evaluator, theta: np.ndarray) -> list[Row]:
    """The rows that switchfit steps through at theta, without its padding.

    A row of length zero beside a transition stays: its derivative does not vanish.
    """
    arguments = evaluator.arguments[0]
    with use_float64():
        layout = build_rows(arguments.nodes, np.asarray(theta[:2]), np.float64(1.0))
        layout = jax.tree.map(np.asarray, layout)
    signals = np.asarray(arguments.signals)
    nodes = np.asarray(arguments.nodes)
    table = []
    closes = np.append(layout.opens[1:], False)
    for row in np.flatnonzero((layout.end > layout.start) | layout.opens | closes):
        cell, segment = layout.cell[row], int(layout.segment[row])
        table.append(
            Row(
                SEQUENCE[segment],
                float(layout.start[row]),
                float(layout.end[row]),
                segment - 1 if layout.opens[row] else -1,
                segment if closes[row] else -1,
                float(nodes[cell]),
                signals[cell] if signals.shape[2] else np.zeros((4, 6)),
            )
        )
    return table


def evaluator_with(problem: sf.Problem, cells: int | None) -> Evaluator:
    """The problem on the mesh it chooses itself, or on one of equal `cells` (which must be those of a reference)."""
    if cells is None:
        return Evaluator(problem)
    return Evaluator(problem, meshes=[Mesh.from_times(np.linspace(*HORIZON, cells + 1))])
