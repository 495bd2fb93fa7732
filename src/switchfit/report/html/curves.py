"""What the figures of one run show, thinned to what can be seen, with its derivatives in the unknowns that move it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.estimation.estimator import Estimate
from switchfit.fit.trajectory import Comparison
from switchfit.problem.data import FloatArray, Measurements
from switchfit.report.numbers import format_unit, get_unit
from switchfit.report.plot import has_bands, replace_infinities
from switchfit.uncertainty.prediction import predict
from switchfit.uncertainty.sensitivity import Points

MOST_POINTS, FEWEST_POINTS = 800, 80
"""Points of one curve: with more of them a figure looks the same."""
MOST_SAMPLES = 2000
"""Samples of one channel that are drawn."""
BUDGET = 300_000
"""Numbers that the curves of all runs may have together, with their derivatives: 1.6 MB in the page."""


@dataclass(frozen=True, eq=False)
class Curves:
    """One of the data of a run, or its states: a curve of Q channels over L times, and what was measured of it.

    Attributes
    ----------
    names, units : tuple of str, one a channel
    columns : sequence of int
        Their places among all outputs and then all states.
    times, values : (L,), (L, Q)
        With NaN where a transition breaks the curve.
    modes : (L,) of str
    tangents : mapping of place in theta to (L, Q)
        Derivatives of the values, at a fixed time.
    band : (L, Q, 2) or None
        95 % confidence band.
    kind : {"measurements", "reference", "states"}
        States have no samples.
    sample_times, measured, fitted : (K,), (K, Q), (K, Q)
    sigma : (K, Q) or None
    outliers : (K, Q) of bool or None
    sample_tangents : mapping of place in theta to (K, Q)
        Of what is fitted.
    delay : int
        Place in theta of the delay by which the curve moves in time; -1 where there is none to estimate.
    left_out : int
        Samples that are not drawn.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    columns: Sequence[int]
    times: FloatArray
    values: FloatArray
    modes: NDArray[np.str_]
    tangents: dict[int, FloatArray]
    band: FloatArray | None
    kind: str = "states"
    sample_times: FloatArray = field(default_factory=partial(np.zeros, 0))
    measured: FloatArray = field(default_factory=partial(np.zeros, 0))
    fitted: FloatArray = field(default_factory=partial(np.zeros, 0))
    sigma: FloatArray | None = None
    outliers: NDArray[np.bool_] | None = None
    sample_tangents: dict[int, FloatArray] = field(default_factory=dict)
    delay: int = -1
    left_out: int = 0


def list_places(estimate: Estimate, e: int) -> list[int]:
    """Return the places in theta of the unknowns that a run depends on; nothing where the model is not there.

    Parameters
    ----------
    estimate : Estimate
    e : int
    """
    if estimate.problem is None:
        return []
    places = estimate.problem.places[e]
    return sorted(set(places[places >= 0].tolist()))


def choose_points(estimate: Estimate, runs: Sequence[int], unknowns: int) -> int:
    """Return how many points a curve may have, so that all of them stay in the `BUDGET`.

    Parameters
    ----------
    estimate : Estimate
    runs : sequence of int
        Which are shown.
    unknowns : int
        That a run depends on, at most.
    """
    channels = sum(
        estimate.trajectories[e].states.shape[1] + sum(len(c.names) for c in estimate.comparisons[e]) for e in runs
    )
    return int(np.clip(BUDGET / max(channels * (unknowns + 4), 1), FEWEST_POINTS, MOST_POINTS))


def collect_curves(estimate: Estimate, e: int, places: Sequence[int], points: int) -> list[Curves]:
    """Return the curves of one run: an entry for each of its data, then the states that are not measured by name.

    Parameters
    ----------
    estimate : Estimate
    e : int
        Which run, from 0.
    places : sequence of int
        Unknowns whose derivatives are wanted.
    points : int
        Of one curve.
    """
    trajectory = estimate.trajectories[e]
    has_slopes = estimate.problem is not None and estimate.has_room_for_sensitivities()
    nodes = estimate.sensitivities[e].nodes if has_slopes else None
    times = trajectory.times if nodes is None else nodes.times
    segments = np.concatenate([[0], np.flatnonzero(np.diff(times) == 0) + 1, [len(times)]])
    if len(segments) != len(trajectory.pieces):  # a mode without duration: other meshes have other nodes there
        times, nodes, segments = trajectory.times, None, trajectory.pieces
    values, slopes, band = _stack_outputs_and_states(estimate, e, nodes)
    kept, breaks = _thin(segments, points)
    modes = np.repeat([trajectory.modes[start] for start in trajectory.pieces[:-1]], np.diff(segments))[kept]

    def at_nodes(values: FloatArray) -> FloatArray:
        """Thin values at the nodes (L, ...), and break them at transitions."""
        return replace_infinities(np.insert(values[kept], breaks, np.nan, axis=0))

    def make(columns: Sequence[int], late: float, **others: Any) -> Curves:
        return Curves(
            columns=columns,
            times=np.insert(times[kept], breaks, np.nan) + late,
            values=at_nodes(values[:, columns]),
            modes=np.insert(modes.astype(object), breaks, "").astype(str),
            tangents={} if slopes is None else {i: at_nodes(slopes[:, columns, i]) for i in places},
            band=None if band is None else at_nodes(band[:, columns]),
            **others,
        )

    found, first = [], 0
    for comparison, delay in zip(estimate.comparisons[e], _list_delays(estimate, e), strict=True):
        columns = range(first, first := first + len(comparison.names))
        late = float(comparison.curve_times[0] - trajectory.times[0])
        count = len(comparison.times)
        drawn = np.arange(0, count, max(-(-count // MOST_SAMPLES), 1))
        if comparison.kind == "reference" and count == len(times):
            drawn = kept
        moved = None if nodes is None else _find_sample_slopes(comparison, nodes, columns, drawn, late, delay)
        found.append(
            make(
                columns,
                late,
                names=comparison.names,
                units=tuple(get_unit(comparison, k, trajectory) for k in range(len(comparison.names))),
                kind=comparison.kind,
                sample_times=comparison.times[drawn],
                measured=replace_infinities(comparison.measured[drawn]),
                fitted=replace_infinities(comparison.fitted[drawn]),
                sigma=None if comparison.sigma is None else replace_infinities(comparison.sigma[drawn]),
                outliers=None if comparison.downweighted is None else comparison.downweighted[drawn],
                sample_tangents={} if moved is None else {i: replace_infinities(moved[..., i]) for i in places},
                delay=delay,
                left_out=count - len(drawn) if comparison.kind == "measurements" else 0,
            )
        )
    measured = {name for comparison in estimate.comparisons[e] for name in comparison.names}
    hidden = [k for k, name in enumerate(trajectory.state_names) if name not in measured]
    if hidden:
        names = tuple(trajectory.state_names[k] for k in hidden)
        units = tuple(format_unit(trajectory.state_units[k]) for k in hidden)
        found.append(make([first + k for k in hidden], 0.0, names=names, units=units))
    return found


def _stack_outputs_and_states(
    estimate: Estimate, e: int, nodes: Points | None
) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
    """Return all outputs and then all states of a run, their derivatives in theta, and their bands.

    Without derivatives those of the fit, and no bands; bands need a covariance as well.
    """
    if nodes is None:
        return np.hstack([*(c.curve for c in estimate.comparisons[e]), estimate.trajectories[e].states]), None, None
    values, slopes = np.hstack([nodes.outputs, nodes.states]), np.hstack([nodes.outputs_d, nodes.states_d])
    if not has_bands(estimate):
        return values, slopes, None
    prediction = predict(estimate, experiment=e)
    return values, slopes, np.hstack([prediction.output_band(), prediction.state_band()])


def _thin(segments: NDArray[np.intp], points: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return which nodes are kept, the ends of all segments among them, and before which of these a curve breaks."""
    stride = max(-(-int(segments[-1]) // points), 1)
    parts = [
        np.unique(np.concatenate([np.arange(start, end, stride), [end - 1]]))
        for start, end in itertools.pairwise(segments.tolist())
    ]
    return np.concatenate(parts), np.cumsum([len(part) for part in parts])[:-1]


def _list_delays(estimate: Estimate, e: int) -> list[int]:
    """Return the place in theta of the delay of each of the data of a run; -1 where it is known, or there is none."""
    if estimate.problem is None:
        return [-1] * len(estimate.comparisons[e])
    run = estimate.problem.experiments[e]
    delays = [item.delay for item in run.data if isinstance(item, Measurements)]
    names = [run.parameter_map.get(delay, delay) if isinstance(delay, str) else "" for delay in delays]
    references = len(estimate.comparisons[e]) - len(names)  # they come first, and are never late
    places = {name: i for i, name in enumerate(estimate.theta_names)}
    return [-1] * references + [places.get(name, -1) for name in names]


def _find_sample_slopes(
    comparison: Comparison, nodes: Points, columns: Sequence[int], drawn: NDArray[np.intp], late: float, delay: int
) -> FloatArray:
    """Return the derivatives of what is fitted at the samples that are drawn, all of them nodes unless late: (K, Q, d).

    At a transition, that just before it.
    """
    slopes, values = nodes.outputs_d[:, columns], nodes.outputs[:, columns]
    if comparison.kind == "reference" and len(comparison.times) == len(nodes.times):
        return slopes[drawn]
    nearest = np.clip(np.searchsorted(nodes.times, comparison.times[drawn] - late), 0, len(nodes.times) - 1)
    found = slopes[nearest].copy()
    if delay >= 0:
        before = np.maximum(nearest - 1, 0)
        step = (nodes.times[nearest] - nodes.times[before])[:, None]
        rise = values[nearest] - values[before]
        found[..., delay] -= np.divide(rise, step, out=np.zeros_like(rise), where=step > 0)
    return found
