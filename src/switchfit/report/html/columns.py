"""The numbers of the figures of a run, by the names of the sources that the page's script puts them into.

Runs that show the same channels share one drawing: building a figure takes Bokeh a tenth of a second, its numbers a
thousandth. Tangents and bands are float32.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from bokeh.core.serialization import Serializer

from switchfit.fit.result import Fit
from switchfit.report.dates import format_estimate
from switchfit.report.html.curves import Curves
from switchfit.report.numbers import format_unit
from switchfit.report.plane import find_plane
from switchfit.report.text import format_end
from switchfit.runtime import special
from switchfit.uncertainty.residuals import ChannelResiduals, correct_errors, find_transition_intervals

HISTOGRAM_BINS = (6, 30)
MOST_QUANTILES = 500
MARGIN = 0.01
"""Part of the horizon that is shown before and after it."""

Columns = Mapping[str, Any]


@dataclass(frozen=True)
class FigureData:
    """What a drawing is filled with.

    Attributes
    ----------
    template : str
        Name of the drawing.
    sources : mapping of name to columns
    ranges : mapping of name to start and end
    moves : mapping of source to its channels, places in theta, and place of a delay
        What sliders move.
    """

    template: str
    sources: Mapping[str, Columns] = field(default_factory=dict)
    ranges: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    moves: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON, the columns as Bokeh writes those of its own sources."""
        sources = {
            name: Serializer(deferred=False).serialize(columns).content for name, columns in self.sources.items()
        }
        return {"template": self.template, "sources": sources, "ranges": self.ranges, "moves": self.moves}


def collect_run(template: str, fit: Fit, e: int, curves: Sequence[Curves], colours: Mapping[str, str]) -> FigureData:
    """Return the numbers of the figures of one run.

    Parameters
    ----------
    template : str
    fit : Fit
    e : int, from 0
        Which run.
    curves : sequence of Curves
    colours : mapping of mode to colour
    """
    spans = fit.trajectories[e].mode_spans
    first, last = spans[0][1], spans[-1][2]
    sources: dict[str, Columns] = {"modes": list_spans(fit, e, colours), "transitions": list_transitions(fit, e)}
    moves = {}
    for c, own in enumerate(curves):
        sources[f"curve-{c}"] = list_curve(own)
        moves[f"curve-{c}"] = {"channels": len(own.names), "places": list(own.tangents), "delay": own.delay}
        if own.kind != "states":
            sources[f"samples-{c}"] = list_samples(own)
            moves[f"samples-{c}"] = {"channels": len(own.names), "places": list(own.sample_tangents), "delay": -1}
    margin = MARGIN * (last - first)
    return FigureData(template, sources, {"times": {"start": first - margin, "end": last + margin}}, moves)


def list_curve(curves: Curves) -> Columns:
    """Return what is fitted: t, mode, y0.., the same as bt, b0.. that no slider moves, bands, tangents d{place}_{k}.

    Parameters
    ----------
    curves : Curves
    """
    data: dict[str, Any] = {"t": curves.times, "bt": curves.times, "mode": curves.modes.tolist()}
    for k in range(len(curves.names)):
        data |= {f"y{k}": curves.values[:, k], f"b{k}": curves.values[:, k]}
        if curves.band is not None:
            data |= {f"lo{k}": curves.band[:, k, 0].astype("f4"), f"hi{k}": curves.band[:, k, 1].astype("f4")}
        data |= {f"d{place}_{k}": slope[:, k].astype("f4") for place, slope in curves.tangents.items()}
    if find_plane(curves.names, curves.units) is not None:
        breaks = np.isnan(curves.times)
        data["size"] = np.where(np.concatenate([[False], breaks[:-1]]), 13.0, 0.0).astype("f4")
    return data


def list_samples(curves: Curves) -> Columns:
    """Return what is measured: t, m0.., residuals y0.. and b0.., sigma s0.., outliers o0.., tangents of the residuals.

    Parameters
    ----------
    curves : Curves
    """
    data: dict[str, Any] = {"t": curves.sample_times}
    residuals = curves.measured - curves.fitted
    for k in range(len(curves.names)):
        data |= {f"m{k}": curves.measured[:, k], f"y{k}": residuals[:, k], f"b{k}": residuals[:, k]}
        if curves.sigma is not None:
            data |= {f"s{k}": curves.sigma[:, k], f"n{k}": -curves.sigma[:, k]}
        if curves.outliers is not None:
            data[f"o{k}"] = np.where(curves.outliers[:, k], curves.measured[:, k], np.nan)
        data |= {f"d{place}_{k}": -slope[:, k].astype("f4") for place, slope in curves.sample_tangents.items()}
    return data


def list_spans(fit: Fit, e: int, colours: Mapping[str, str]) -> Columns:
    """Return the modes of one run: left, right, colour, the places in theta of the ends, -1 where these are known.

    Parameters
    ----------
    fit : Fit
    e : int, from 0
    colours : mapping of mode to colour
    """
    spans = fit.trajectories[e].mode_spans
    left, right = np.array([[begin, end] for _, begin, end in spans]).T
    places = [-1, *fit.transition_places[e].tolist(), fit.final_places[e]]
    return {
        "left": left,
        "right": right,
        "left_b": left,
        "right_b": right,
        "colour": [colours[mode] for mode, _, _ in spans],
        "left_place": places[: len(spans)],
        "right_place": places[1 : len(spans) + 1],
    }


def list_transitions(fit: Fit, e: int) -> Columns:
    """Return the transitions of one run: x, ends of the interval, both as the table has them, places in theta.

    Parameters
    ----------
    fit : Fit
    e : int, from 0
    """
    errors, run, intervals = correct_errors(fit), fit.trajectories[e], find_transition_intervals(fit, e)
    dated = None if run.origin is None else run
    own = [t for t in fit.transitions if t.experiment == e]
    values, shown = [], []
    for t, ends in zip(own, intervals, strict=True):
        spread = np.nan if t.index is None else errors[t.index]
        value, error = format_estimate(t.time, spread, dated)
        unit = format_unit(t.unit) if dated is None or error else ""
        values.append(" ".join(part for part in (value, error, unit) if part))
        low, high = (format_end(end, ends, dated) for end in ends)
        shown.append(f"{low} to {high}" if low and high else "not known")
    times = np.array([t.time for t in own], dtype=float)
    return {
        "x": times,
        "x_b": times,
        "low": intervals[:, 0],
        "high": intervals[:, 1],
        "name": [t.name for t in own],
        "value": values,
        "interval": shown,
        "modes": [f"{t.before} → {t.after}" for t in own],
        "place": [-1 if t.index is None else t.index for t in own],
    }


def collect_diagnostics(channel: ChannelResiduals) -> list[FigureData]:
    """Return the numbers of the histogram, of the quantiles and of the autocorrelation of one channel.

    Parameters
    ----------
    channel : ChannelResiduals
    """
    few, many = HISTOGRAM_BINS
    z, n = channel.values, len(channel.values)
    density, edges = np.histogram(z, bins=int(np.clip(np.sqrt(n), few, many)), density=True)
    grid = np.linspace(min(edges[0], -3.5), max(edges[-1], 3.5), 121)
    histogram = {
        "bars": {"left": edges[:-1], "right": edges[1:], "top": density},
        "normal": {"x": grid, "y": np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi)},
    }
    expected = special.ndtri((np.arange(1, n + 1) - 0.5) / n)
    kept = np.unique(np.linspace(0, n - 1, min(n, MOST_QUANTILES)).astype(int))
    ends = expected[[0, -1]]
    quantiles = {"line": {"x": ends, "y": ends}, "dots": {"x": expected[kept], "y": np.sort(z)[kept]}}
    limit = 1.96 / np.sqrt(max(n, 1))
    reach = min(max(1.3 * float(np.max(np.abs(channel.autocorrelation), initial=0.0)), 2 * limit), 1.05)
    lags = np.arange(1.0, channel.lags + 1)
    correlogram = {
        "limit": {"low": np.array([-limit]), "high": np.array([limit])},
        "lags": {"x": lags, "zero": np.zeros(len(lags)), "y": channel.autocorrelation},
    }
    name = "histogram-sigma" if channel.sigma_known else "histogram-rms"
    return [
        FigureData(name, histogram),
        FigureData("quantiles", quantiles),
        FigureData("autocorrelation", correlogram, {"reach": {"start": -reach, "end": reach}}),
    ]
