"""The curves and samples of one run in a page, thinned to what can be seen, with derivatives in the unknowns.

They are in columns by the names that the page's script puts into the sources of the figures. The script keeps what
sliders move (t, y0.., x, left, right) as fit_t, fit_y0.. as well. Tangents and bands are float32.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.comparison import Comparison, find_delay
from switchfit.fit.result import Fit
from switchfit.report.fit_figure import has_bands
from switchfit.report.numbers import format_unit, get_unit
from switchfit.report.panels import replace_infinities
from switchfit.report.plane import find_plane
from switchfit.report.times import format_estimate
from switchfit.report.unknowns import format_end
from switchfit.uncertainty.corrected_errors import correct_errors, find_transition_intervals
from switchfit.uncertainty.judged_fit import JudgedFit
from switchfit.uncertainty.prediction import predict
from switchfit.uncertainty.sensitivity import Points

MOST_POINTS_OF_CURVE, FEWEST_POINTS_OF_CURVE = 800, 80
"""Points of one curve: with more of them a figure looks the same."""

MOST_DRAWN_SAMPLES = 2000
"""Samples of one channel that are drawn."""

BUDGET = 300_000
"""Numbers that the curves of all runs may have together, with their derivatives: 1.6 MB in the page."""

Columns = Mapping[str, Any]
"""Numbers by the names that they have in the page."""


@dataclass(frozen=True, eq=False)
class Curves:
    """One of the data of a run, or its states: a curve of Q channels, and what was measured of it.

    Attributes
    ----------
    names, units : tuple of str, one a channel
    kind : {"measurements", "reference", "states"}
    curve : mapping of name to (L,)
        Times t, with NaN where a transition breaks the curve, and mode. Of channel k the values y{k}, the 95 %
        confidence band from lo{k} to hi{k}, if there is one, and the derivatives d{i}_{k} in theta[i] at a fixed time.
    samples : mapping of name to (K,)
        Empty for states. Times t; of channel k what is measured, m{k}, its residuals y{k}, sigma s{k} and n{k} = -s{k},
        outliers o{k}, and the derivatives d{i}_{k} of the residuals.
    left_out : int
        Samples that are not drawn.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    kind: str
    curve: Columns
    samples: Columns = field(default_factory=dict)
    left_out: int = 0


def list_places(estimate: JudgedFit, e: int) -> list[int]:
    """Return the places in theta of the unknowns that move the curves of a run; nothing where the model is not there.

    Delays move their curve in time, and are left out.

    Parameters
    ----------
    estimate : JudgedFit
    e : int
    """
    if estimate.problem is None:
        return []
    run, places = estimate.problem.experiments[e], estimate.problem.places[e]
    # By the name in the problem; a delay that is a number is no unknown, and in no name of theta.
    delays = [run.parameter_map.get(item.delay, item.delay) for item in run.measurements]
    return [place for place in sorted(set(places[places >= 0].tolist())) if estimate.theta_names[place] not in delays]


def choose_points(estimate: JudgedFit, runs: Sequence[int], unknowns: int) -> int:
    """Return how many points a curve may have, so that all of them stay in the `BUDGET`.

    Parameters
    ----------
    estimate : JudgedFit
    runs : sequence of int
        Which are shown.
    unknowns : int
        That a run depends on, at most.
    """
    states = sum(estimate.trajectories[e].states.shape[1] for e in runs)
    channels = states + sum(len(comparison.names) for e in runs for comparison in estimate.comparisons[e])
    return int(np.clip(BUDGET / max(channels * (unknowns + 4), 1), FEWEST_POINTS_OF_CURVE, MOST_POINTS_OF_CURVE))


def collect_curves(estimate: JudgedFit, e: int, places: Sequence[int], points: int) -> list[Curves]:
    """Return the curves of one run: an entry for each of its data, then the states that are not measured by name.

    Parameters
    ----------
    estimate : JudgedFit
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
    # Indices of nodes, -1 for a break. All columns of a curve are thinned alike, since the script moves them together.
    kept = _thin(segments, points)
    modes = np.repeat(trajectory.modes[trajectory.pieces[:-1]], np.diff(segments))

    def at_nodes(values: FloatArray) -> FloatArray:
        """Thin values at the nodes (L,), and break them at transitions."""
        return replace_infinities(np.where(kept < 0, np.nan, values[kept]))

    def list_curve(columns: Sequence[int], late: float) -> dict[str, Any]:
        curve: dict[str, Any] = {"t": at_nodes(times) + late, "mode": np.where(kept < 0, "", modes[kept]).tolist()}
        for k, column in enumerate(columns):
            curve[f"y{k}"] = at_nodes(values[:, column])
            if band is not None:
                low, high = (at_nodes(edge).astype("f4") for edge in band[:, column].T)
                curve |= {f"lo{k}": low, f"hi{k}": high}
            if slopes is not None:
                curve |= {f"d{i}_{k}": at_nodes(slopes[:, column, i]).astype("f4") for i in places}
        return curve

    found, first = [], 0
    for comparison in estimate.comparisons[e]:
        names, units = comparison.names, [get_unit(comparison, k, trajectory) for k in range(len(comparison.names))]
        columns = range(first, first := first + len(names))
        late = find_delay(comparison, trajectory)
        count = len(comparison.times)
        # Every k-th sample, rounded up, so that there are never more than the most.
        drawn = np.arange(0, count, max(-(-count // MOST_DRAWN_SAMPLES), 1))
        curve = list_curve(columns, late)
        if find_plane(names, units) is not None:
            # A mark where a curve goes on after a break: at the transition.
            curve["size"] = np.where(np.roll(kept < 0, 1), 13.0, 0.0).astype("f4")
        # Samples are nodes, unless they are late. At a transition the derivative is that just before it.
        nearest = np.minimum(np.searchsorted(times, comparison.times[drawn] - late), len(times) - 1)
        samples = _list_samples(comparison, drawn, None if slopes is None else slopes[nearest][:, columns], places)
        left_out = count - len(drawn) if comparison.kind == "measurements" else 0
        found.append(Curves(names, tuple(units), comparison.kind, curve, samples, left_out))
    measured = {name for comparison in estimate.comparisons[e] for name in comparison.names}
    # States that no channel shows by name; the script has them, too, so that they move with the sliders.
    if hidden := [k for k, name in enumerate(trajectory.state_names) if name not in measured]:
        names, given = (tuple(own[k] for k in hidden) for own in (trajectory.state_names, trajectory.state_units))
        curve = list_curve([first + k for k in hidden], 0.0)
        found.append(Curves(names, tuple(map(format_unit, given)), "states", curve))
    return found


def _list_samples(
    comparison: Comparison, drawn: NDArray[np.intp], slopes: FloatArray | None, places: Sequence[int]
) -> Columns:
    """Return the columns of the samples that are drawn; the slopes (K, Q, d) are those of what is fitted."""
    columns: dict[str, Any] = {"t": comparison.times[drawn]}
    for k in range(len(comparison.names)):
        measured, fitted = (replace_infinities(own[drawn, k]) for own in (comparison.measured, comparison.fitted))
        columns |= {f"m{k}": measured, f"y{k}": measured - fitted}
        if comparison.sigma is not None:
            sigma = replace_infinities(comparison.sigma[drawn, k])
            columns |= {f"s{k}": sigma, f"n{k}": -sigma}
        if comparison.downweighted is not None:
            columns[f"o{k}"] = np.where(comparison.downweighted[drawn, k], measured, np.nan)
        if slopes is not None:
            columns |= {f"d{i}_{k}": -replace_infinities(slopes[:, k, i]).astype("f4") for i in places}
    return columns


def _stack_outputs_and_states(
    estimate: JudgedFit, e: int, nodes: Points | None
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


def _thin(segments: NDArray[np.intp], points: int) -> NDArray[np.intp]:
    """Return which nodes are kept, the ends of all segments among them, with -1 where a transition breaks a curve."""
    # The ends of segments are always kept: a curve that is cut short there would not meet its transition.
    stride = max(-(-int(segments[-1]) // points), 1)
    ends = itertools.pairwise(segments.tolist())
    parts = [np.unique(np.append(np.arange(start, end, stride), end - 1)) for start, end in ends]
    return np.concatenate([np.append(part, -1) for part in parts])[:-1]


def list_spans(fit: Fit, e: int, colours: Mapping[str, str]) -> Columns:
    """Return the modes of one run: left, right, colour, the places in theta of the ends, -1 where these are known.

    Parameters
    ----------
    fit : Fit
    e : int, from 0
    colours : mapping of mode to colour
    """
    modes, left, right = zip(*fit.trajectories[e].mode_spans, strict=True)
    places = [-1, *fit.transition_places[e].tolist(), fit.final_places[e]]
    ends = {"left_place": places[: len(modes)], "right_place": places[1 : len(modes) + 1]}
    return {"left": np.array(left), "right": np.array(right), "colour": [colours[mode] for mode in modes], **ends}


def list_transitions(fit: Fit, e: int) -> Columns:
    """Return the transitions of one run: x, ends of the interval, both as the table has them, places in theta.

    Parameters
    ----------
    fit : Fit
    e : int, from 0
    """
    errors, run, intervals = correct_errors(fit), fit.trajectories[e], find_transition_intervals(fit, e)
    own = [t for t in fit.transitions if t.experiment == e]
    values, shown = [], []
    for t, ends in zip(own, intervals, strict=True):
        value, error = format_estimate(t.time, np.nan if t.index is None else errors[t.index], run)
        unit = format_unit(t.unit) if run.origin is None or error else ""
        values.append(" ".join(filter(None, (value, error, unit))))
        low, high = (format_end(end, ends, run) for end in ends)
        shown.append(f"{low} to {high}" if low and high else "not known")
    numbers = {"x": np.array([t.time for t in own], dtype=float), "low": intervals[:, 0], "high": intervals[:, 1]}
    words: dict[str, Any] = {"name": [t.name for t in own], "modes": [f"{t.before} → {t.after}" for t in own]}
    words |= {"value": values, "interval": shown}
    return {**numbers, **words, "place": [-1 if t.index is None else t.index for t in own]}
