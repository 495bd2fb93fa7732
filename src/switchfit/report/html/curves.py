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
from switchfit.problem.data import FloatArray, Measurements, ReferenceSignal
from switchfit.report.numbers import format_unit, get_unit
from switchfit.report.plot import replace_infinities
from switchfit.uncertainty.sensitivity import Sensitivity, compute_sensitivity

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
    sensitivity = _find_sensitivity(estimate, e)
    trajectory, comparisons = estimate.trajectories[e], estimate.comparisons[e]
    nodes = None if sensitivity is None else sensitivity.nodes
    times = trajectory.times if nodes is None else nodes.times
    segments = np.concatenate([[0], np.flatnonzero(np.diff(times) == 0) + 1, [len(times)]])
    if len(segments) != len(trajectory.pieces):  # a mode without duration: other meshes have other nodes there
        times, nodes, segments = trajectory.times, None, trajectory.pieces
    modes = np.array([trajectory.modes[start] for start in trajectory.pieces[:-1]])
    kept, breaks = _thin(segments, points)
    all_modes = np.repeat(modes, np.diff(segments))[kept]
    covariance = estimate.corrected_covariance if np.isfinite(estimate.standard_errors).all() else None

    def at_nodes(values: FloatArray) -> FloatArray:
        """Thin values at the nodes (L, ...), and break them at transitions."""
        return replace_infinities(np.insert(values[kept], breaks, np.nan, axis=0))

    def in_theta(derivatives: FloatArray | None) -> dict[int, FloatArray]:
        return {} if derivatives is None else {i: at_nodes(derivatives[..., i]) for i in places}

    def band_of(values: FloatArray, derivatives: FloatArray | None) -> FloatArray | None:
        if derivatives is None or covariance is None:
            return None
        half = np.sqrt(np.maximum(np.einsum("lqi,ij,lqj->lq", derivatives, covariance, derivatives), 0.0))
        half = estimate.quantile(0.95) * half
        return at_nodes(np.stack([values - half, values + half], axis=-1))

    def make(names: Sequence[str], values: FloatArray, slopes: FloatArray | None, late: float, **others: Any) -> Curves:
        return Curves(
            names=tuple(names),
            times=np.insert(times[kept], breaks, np.nan) + late,
            values=at_nodes(values),
            modes=np.insert(all_modes.astype(object), breaks, "").astype(str),
            tangents=in_theta(slopes),
            band=band_of(values, slopes),
            **others,
        )

    found, first = [], 0
    for comparison, item in zip(comparisons, _list_items(estimate, e), strict=True):
        channels = slice(first, first := first + len(comparison.names))
        values = comparison.curve if nodes is None else nodes.outputs[:, channels]
        slopes = None if nodes is None else nodes.outputs_d[:, channels]
        delay = _find_delay(estimate, e, item)
        late = float(comparison.curve_times[0] - trajectory.times[0])
        drawn = np.arange(0, len(comparison.times), max(-(-len(comparison.times) // MOST_SAMPLES), 1))
        if comparison.kind == "reference":
            drawn = kept if len(comparison.times) == len(times) else drawn
        moved = _find_sample_slopes(comparison, sensitivity, item, channels, drawn, late, delay)
        found.append(
            make(
                comparison.names,
                values,
                slopes,
                late,
                units=tuple(get_unit(comparison, k, trajectory) for k in range(len(comparison.names))),
                kind=comparison.kind,
                sample_times=comparison.times[drawn],
                measured=replace_infinities(comparison.measured[drawn]),
                fitted=replace_infinities(comparison.fitted[drawn]),
                sigma=None if comparison.sigma is None else replace_infinities(comparison.sigma[drawn]),
                outliers=None if comparison.downweighted is None else comparison.downweighted[drawn],
                sample_tangents={} if moved is None else {i: replace_infinities(moved[..., i]) for i in places},
                delay=delay,
                left_out=len(comparison.times) - len(drawn) if comparison.kind == "measurements" else 0,
            )
        )
    measured = {name for comparison in comparisons for name in comparison.names}
    hidden = [k for k, name in enumerate(trajectory.state_names) if name not in measured]
    if hidden:
        values = trajectory.states[:, hidden] if nodes is None else nodes.states[:, hidden]
        slopes = None if nodes is None else nodes.states_d[:, hidden]
        names, units = ([part[k] for k in hidden] for part in (trajectory.state_names, trajectory.state_units))
        found.append(make(names, values, slopes, 0.0, units=tuple(map(format_unit, units))))
    return found


def _thin(segments: NDArray[np.intp], points: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return which nodes are kept, the ends of all segments among them, and before which of these a curve breaks."""
    stride = max(-(-int(segments[-1]) // points), 1)
    parts = [
        np.unique(np.concatenate([np.arange(start, end, stride), [end - 1]]))
        for start, end in itertools.pairwise(segments.tolist())
    ]
    return np.concatenate(parts), np.cumsum([len(part) for part in parts])[:-1]


def _find_sensitivity(estimate: Estimate, e: int) -> Sensitivity | None:
    """Return the derivatives of one run; None where there is no model, or no room."""
    if estimate.problem is None or not estimate.has_room_for_sensitivities():
        return None
    evaluator = estimate.evaluator_at_solution()
    return compute_sensitivity(estimate.problem, e, estimate.theta, evaluator.meshes[e])


def _list_items(estimate: Estimate, e: int) -> list[Any]:
    """Return the data of a run in the order of its comparisons; None for each where the problem is not there."""
    if estimate.problem is None:
        return [None] * len(estimate.comparisons[e])
    data = estimate.problem.experiments[e].data
    return [d for d in data if isinstance(d, ReferenceSignal)] + [d for d in data if isinstance(d, Measurements)]


def _find_delay(estimate: Estimate, e: int, item: Any) -> int:
    """Return the place in theta of the delay of a sensor; -1 where it is known."""
    problem = estimate.problem
    if problem is None or not isinstance(item, Measurements) or not isinstance(item.delay, str):
        return -1
    name = problem.experiments[e].parameter_map.get(item.delay, item.delay)
    return estimate.theta_names.index(name) if name in estimate.theta_names else -1


def _find_sample_slopes(
    comparison: Comparison,
    sensitivity: Sensitivity | None,
    item: Any,
    channels: slice,
    drawn: NDArray[np.intp],
    late: float,
    delay: int,
) -> FloatArray | None:
    """Return the derivatives of what is fitted at the samples that are drawn: (K, Q, d)."""
    if sensitivity is None:
        return None
    if comparison.kind == "reference":
        nodes = sensitivity.nodes
        return nodes.outputs_d[drawn][:, channels] if len(nodes.times) == len(comparison.times) else None
    if late == 0.0 and delay < 0:
        return sensitivity.at(comparison.times[drawn]).outputs_d[:, channels]
    nodes = sensitivity.nodes
    slopes, values = nodes.outputs_d[:, channels], nodes.outputs[:, channels]
    nearest = np.clip(np.searchsorted(nodes.times, comparison.times[drawn] - late), 1, len(nodes.times) - 1)
    found = slopes[nearest].copy()
    if delay >= 0:
        step = nodes.times[nearest] - nodes.times[nearest - 1]
        rise = values[nearest] - values[nearest - 1]
        found[..., delay] -= np.divide(rise, step[:, None], out=np.zeros_like(rise), where=step[:, None] > 0)
    return found
