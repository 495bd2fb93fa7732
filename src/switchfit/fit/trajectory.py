"""Trajectories for people: the forward pass at any theta, as NumPy arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.choice import engine_of
from switchfit.engine.run import runs_of
from switchfit.engine.simulation import Simulation
from switchfit.fit.evaluator import Evaluator
from switchfit.meshes.refinement import refine_mesh_of_run
from switchfit.problem.experiment import Experiment, count_times, drop_jumps, show_time
from switchfit.problem.origin import Origin
from switchfit.problem.problem import Problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.validation.arrays import as_array, as_index
from switchfit.problem.validation.messages import unit_suffix
from switchfit.problem.validation.objects import as_instance, set_fields
from switchfit.runtime.frames import Tabular
from switchfit.runtime.presentation import format_line, join_first


@dataclass(frozen=True, eq=False)
class Trajectory(Tabular):
    """States over time.

    Attributes
    ----------
    times : (K,) array
        All nodes, in `time_unit`; each transition time and the time of each jump occur twice, with the state before and
        after.
    states : (K, n) array
    modes : (K,) array of str
        The mode that is active.
    segments : (N + 2,) int array
        Entries ``segments[i]:segments[i + 1]`` belong to the i-th entry of the mode sequence; at times that were asked
        for there may be none.
    state_names, state_units : tuple of str
    time_unit : str
        Unit of the experiment's times.
    origin : Origin or None
        The date at which times are 0; None where they are no dates.

    See Also
    --------
    simulate, Comparison

    Examples
    --------
    >>> problem = heater_problem()

    >>> path = sf.simulate(problem)
    >>> path.mode_spans
    [('on', 0.0, 2.0), ('off', 2.0, 6.0)]
    >>> path.states[-1].round(2)
    array([1.71])
    """

    times: FloatArray
    states: FloatArray
    modes: NDArray[np.str_]
    segments: NDArray[np.intp]
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    time_unit: str = "s"
    origin: Origin | None = None

    @property
    def dates(self) -> list[datetime] | None:
        """The times as dates in the experiment's time zone; None where they are no dates."""
        return None if self.origin is None else self.origin.to_dates(self.times, self.time_unit)

    def __repr__(self) -> str:
        modes = join_first((str(self.modes[k]) for k in self.segments[:-1] if k < len(self.modes)), 8)
        ends = f"{self.times[0]:.6g} to {self.times[-1]:.6g}{unit_suffix(self.time_unit)}" if len(self.times) else ""
        return format_line(self, join_first(self.state_names), f"modes {modes}", ends, f"{len(self.times)} nodes")

    @property
    def mode_spans(self) -> list[tuple[str, float, float]]:
        """Each mode of the sequence with the times at which it begins and ends.

        Of a simulation at given times the first and the last of them in the mode, without modes that have none.
        """
        return [
            (str(self.modes[a]), float(self.times[a]), float(self.times[b - 1]))
            for a, b in zip(self.segments[:-1], self.segments[1:], strict=True)
            if b > a
        ]

    @property
    def pieces(self) -> NDArray[np.intp]:
        """Where the continuous pieces begin, and K: as `segments`, divided at jumps too."""
        return np.union1d(self.segments, np.flatnonzero(np.diff(self.times) == 0) + 1)

    @property
    def jump_times(self) -> FloatArray:
        """Times of the jumps at known times, those at transitions apart."""
        return self.times[np.setdiff1d(self.pieces, self.segments)]


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


def simulate(
    problem: Problem,
    theta: ArrayLike | None = None,
    *,
    times: ArrayLike | Literal["samples"] | None = None,
    experiment: int = 0,
) -> Trajectory:
    """Integrate the model to the problem's tolerances.

    Parameters
    ----------
    problem : Problem
    theta : (d,) array_like, optional
        In the order of ``problem.theta_names``; the initial guess if left out.
    times : (K,) array_like or "samples", optional
        Times that increase, inside [t0, tf], at which states are returned, as numbers, or as dates where the times of
        the experiment are dates; at a transition it is the state just before it. "samples": the times of the
        Measurements. All nodes of the mesh if left out, each transition twice. The steps that the tolerances need are
        taken whatever these times are.
    experiment : int, optional
        Index of the experiment, from 0.

    Returns
    -------
    Trajectory

    Raises
    ------
    ValueError
        For a theta of the wrong shape or order, times outside [t0, tf] or that do not increase, an experiment that does
        not exist, or a trajectory that cannot be integrated.
    TypeError
        If an argument is of the wrong type.

    See Also
    --------
    Trajectory, predict, evaluate

    Examples
    --------
    >>> problem = heater_problem()

    >>> path = sf.simulate(problem, [2.5, 0.4])
    >>> round(float(path.states.max()), 1)
    15.8
    >>> sf.simulate(problem, [2.5, 0.4], times=[0.0, 2.0, 4.0, 6.0]).states[:, 0].round(1)
    array([ 0. , 13.8,  8.7,  3.9])
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    experiment = as_index(experiment, "experiment", len(problem.experiments))
    checked = problem.check_theta(theta)
    asked = None if times is None else _check_times(problem, experiment, checked, times)
    run = runs_of(problem)[experiment]
    mesh = refine_mesh_of_run(run, checked)
    mesh = mesh if asked is None else mesh.insert(asked)
    simulation = engine_of(run, run.build_arguments(mesh), mesh).simulate(*run.vectors(checked), tangents=False)
    found = _build_trajectory(problem, experiment, simulation)
    if asked is None:
        return found
    # The first of two nodes at one time; a free tf that rounding has put before the last time is the last node.
    k = np.minimum(np.searchsorted(found.times, asked), len(found.times) - 1)
    segments = np.searchsorted(k, found.segments)
    return replace(found, times=found.times[k], states=found.states[k], modes=found.modes[k], segments=segments)


def read_times(experiment: Experiment, times: ArrayLike) -> FloatArray:
    """Return times that are asked for, numbers or dates, as numbers: (K,).

    Parameters
    ----------
    experiment : Experiment
    times : (K,) array_like

    Raises
    ------
    ValueError
        If they are not finite numbers of shape (K,), or none.
    """
    asked = np.atleast_1d(as_array(count_times(experiment, times), "times"))
    if asked.ndim != 1 or asked.size == 0 or not np.isfinite(asked).all():
        raise ValueError(f"times must be finite numbers of shape (K,); got shape {asked.shape}.")
    return asked


def _check_times(problem: Problem, e: int, theta: FloatArray, times: ArrayLike | Literal["samples"]) -> FloatArray:
    """Return the times at which a simulation is asked for, (K,)."""
    experiment = problem.experiments[e]
    t0, tf = problem.ends_of_modes(theta)[e][[0, -1]].tolist()
    if isinstance(times, str) and times == "samples":
        found = np.unique(np.concatenate([np.zeros(0), *(item.times for item in experiment.measurements)]))
        inside = found[(t0 <= found) & (found <= tf)]
        if not len(inside):
            raise ValueError(f"times='samples' needs Measurements, and experiment {e} has none; give times.")
        return inside
    asked = read_times(experiment, times)
    wrong = np.append(False, np.diff(asked) <= 0) | (asked < t0) | (asked > tf)
    if wrong.any():
        unit = unit_suffix(experiment.time_unit) if experiment.origin is None else ""
        ends = f"[{show_time(experiment, t0)}, {show_time(experiment, tf)}]{unit}"
        first = show_time(experiment, asked[wrong][0])
        raise ValueError(f"times must increase strictly inside [t0, tf] = {ends}; got {first}.")
    return asked


def compare(
    evaluator: Evaluator, theta: FloatArray
) -> tuple[tuple[Trajectory, ...], tuple[tuple[Comparison, ...], ...]]:
    """Return the trajectories and comparisons of all experiments at theta (d,), on the meshes of an evaluator."""
    problem, simulations = evaluator.problem, evaluator.simulate(theta)
    trajectories = tuple(_build_trajectory(problem, e, simulation) for e, simulation in enumerate(simulations))
    pairs = enumerate(zip(simulations, trajectories, strict=True))
    return trajectories, tuple(tuple(_list_comparisons(problem, e, theta, *pair)) for e, pair in pairs)


def replace_values(problem: Problem, values: Mapping[tuple[int, int], FloatArray]) -> Problem:
    """Return the problem with other values of some of its data; missing ones stay missing.

    Parameters
    ----------
    problem : Problem
    values : mapping of (int, int) to (K, q) array
        By the experiment, and the place of the `Measurements` among its data.
    """
    data = [list(run.data) for run in problem.experiments]
    for (e, k), own in values.items():
        item = data[e][k]
        data[e][k] = replace(item, values=np.where(np.isnan(item.values), np.nan, own))
    runs = [replace(run, data=items) for run, items in zip(problem.experiments, data, strict=True)]
    return replace(problem, experiments=runs)


def select_visible(simulation: Simulation, before: FloatArray, after: FloatArray) -> FloatArray:
    """Select the entries of a trajectory from the values at the starts and ends of all rows.

    These are the start of every segment, and the ends of all its rows that are not empty.
    """
    parts = []
    for rows in simulation.segments:
        parts += [before[rows][:1], after[rows][simulation.end[rows] > simulation.start[rows]]]
    return np.concatenate(parts)


def _build_trajectory(problem: Problem, e: int, simulation: Simulation) -> Trajectory:
    structure, system = problem.structures[e], problem.system
    moving = simulation.end > simulation.start
    counts = [1 + int(moving[rows].sum()) for rows in simulation.segments]
    if structure.jumps:  # a mode goes on after a jump
        starts = np.array(drop_jumps(problem.experiments[e], range(1, len(counts))), dtype=np.intp)
        counts = np.add.reduceat(counts, np.insert(starts, 0, 0)).tolist()
    modes = np.repeat(problem.experiments[e].mode_sequence, counts)
    names = tuple(system.state_names or (f"x{k + 1}" for k in range(structure.n)))
    units = tuple(system.state_units or ("",) * structure.n)
    return Trajectory(
        select_visible(simulation, simulation.start, simulation.end),
        select_visible(simulation, simulation.before, simulation.after),
        modes,
        np.cumsum([0, *counts]),
        names,
        units,
        problem.experiments[e].time_unit,
        problem.experiments[e].origin,
    )


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
