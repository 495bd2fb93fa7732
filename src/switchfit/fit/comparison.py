"""Measured and fitted values side by side, for each of the data of an experiment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.simulation import Simulation
from switchfit.fit.trajectory import Trajectory, build_trajectory, select_visible
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.problem import Problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.validation.objects import set_fields
from switchfit.runtime.presentation import format_line, join_first


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured and fitted values, for one of the data of one experiment.

    Attributes
    ----------
    kind : "measurements" or "reference"
    names : tuple of str, one per channel
    times, measured, fitted : (K,), (K, q), (K, q)
        At the sample times; for a reference signal at the nodes of the mesh. NaN where a sample is missing.
    sigma : (K, q) or None where unknown
    curve_times, curve : (L,), (L, q)
        The fitted output at all nodes, for plots.
    downweighted : (K, q) of bool, or None
        Which residuals a robust loss treats as outliers: those larger than its `loss_scale`; None without such a loss.
    weights : (q,) or None
        Weights of the channels of a reference signal, the diagonal of its weight matrix; None for measurements.
    units : tuple of str
        Unit of each channel: as given with the data, or else that of the state of the same name; "" if unknown.

    See Also
    --------
    Estimate.comparisons, Trajectory

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> comparison = fit.comparisons[0][0]
    >>> comparison.names, comparison.residuals.shape
    (('thermometer',), (24, 1))
    >>> comparison.rmse.round(2)
    array([0.14])
    """

    kind: str
    names: tuple[str, ...]
    times: FloatArray
    measured: FloatArray
    fitted: FloatArray
    sigma: FloatArray | None
    curve_times: FloatArray
    curve: FloatArray
    downweighted: NDArray[np.bool_] | None = None
    weights: FloatArray | None = None
    units: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        set_fields(self, units=self.units or ("",) * len(self.names))

    def __repr__(self) -> str:
        return format_line(self, self.kind, join_first(self.names), f"{len(self.times)} times")

    @property
    def residuals(self) -> FloatArray:
        """Measured minus fitted: (K, q)."""
        return self.measured - self.fitted

    @property
    def rmse(self) -> FloatArray:
        """Root mean square of the residuals of each channel: (q,); NaN without samples."""
        known = np.isfinite(self.measured)
        squares = np.where(known, self.residuals, 0.0) ** 2
        return np.sqrt(squares.sum(0) / np.where(known.any(0), known.sum(0), np.nan))


def find_delay(comparison: Comparison, trajectory: Trajectory) -> float:
    """Return by how much the samples of a comparison are late: they see the state of an earlier time.

    Parameters
    ----------
    comparison : Comparison
    trajectory : Trajectory
        Of its experiment.
    """
    return float(comparison.curve_times[0] - trajectory.times[0])


def compare(
    evaluator: Evaluator, theta: FloatArray
) -> tuple[tuple[Trajectory, ...], tuple[tuple[Comparison, ...], ...]]:
    """Return the trajectories and comparisons of all experiments at theta (d,), on the meshes of an evaluator."""
    problem, simulations = evaluator.problem, evaluator.simulate(theta)
    trajectories = tuple(build_trajectory(problem, e, simulation) for e, simulation in enumerate(simulations))
    pairs = enumerate(zip(simulations, trajectories, strict=True))
    return trajectories, tuple(tuple(_list_comparisons(problem, e, theta, *pair)) for e, pair in pairs)


def _list_comparisons(
    problem: Problem, e: int, theta: FloatArray, simulation: Simulation, trajectory: Trajectory
) -> Iterator[Comparison]:
    """Compare measured with fitted for each reference signal and each Measurements."""
    run, times = problem.experiments[e], trajectory.times
    curves = select_visible(simulation, simulation.y_before, simulation.y_after)
    known = dict(zip(trajectory.state_names, trajectory.state_units, strict=True))
    first = measured = 0
    for item in (*run.references, *run.measurements):
        q = item.signal.channels if isinstance(item, ReferenceSignal) else item.values.shape[1]
        channels = slice(first, first + q)
        first += q
        curve = curves[:, channels]
        default = trajectory.state_names if item.observe is None else tuple(f"y{k + 1}" for k in range(q))
        label = tuple(item.names or default)
        units = tuple(item.units or ()) or tuple(known.get(name, "") for name in label)
        if isinstance(item, ReferenceSignal):
            weights = np.diag(item.weights).copy()
            yield Comparison(
                "reference", label, times, item.signal(times), curve, None, times, curve, None, weights, units
            )
        else:
            named = problem.name_parameters(theta, e)
            fitted = simulation.seen[measured][: len(item.times)]
            measured += 1
            delay = float(named[item.delay]) if isinstance(item.delay, str) else item.delay
            sigma = item.noise(named)
            beyond = None
            if item.loss != "linear" and sigma is not None:
                beyond = np.abs(np.nan_to_num(item.values - fitted)) > item.loss_scale * sigma
            moments = times + delay  # time stamps of the sensor
            yield Comparison(
                "measurements", label, item.times, item.values, fitted, sigma, moments, curve, beyond, None, units
            )
