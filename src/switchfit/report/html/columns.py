"""The numbers of the figures of a run, by the names of the sources that the page's script puts them into.

Runs that show the same channels share one drawing: building a figure takes Bokeh a tenth of a second, its numbers a
thousandth. Tangents and bands are float32.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.core.serialization import Serializer

from switchfit.report.html.curves import Curves
from switchfit.report.plane import find_plane
from switchfit.runtime import special
from switchfit.uncertainty.residuals import ChannelResiduals

HISTOGRAM_BINS = (6, 30)
MOST_QUANTILES = 500
MARGIN = 0.01
"""Part of the horizon that is shown before and after it."""

Columns = Mapping[str, Any]


@dataclass(frozen=True)
class ModeSpan:
    """A stretch of time in which a mode is active.

    Attributes
    ----------
    mode, colour : str
    left, right : float
    left_place, right_place : int
        Places in theta of the times at its ends; -1 where they are known.
    """

    mode: str
    colour: str
    left: float
    right: float
    left_place: int
    right_place: int


@dataclass(frozen=True)
class TransitionLine:
    """A transition time.

    Attributes
    ----------
    name, value, interval, modes : str
        As the tables have them.
    time, low, high : float
        With the ends of its interval; NaN where it has none.
    place : int
        In theta; -1 where it is known.
    """

    name: str
    value: str
    interval: str
    modes: str
    time: float
    low: float
    high: float
    place: int


@dataclass(frozen=True)
class FigureData:
    """What a drawing is filled with.

    Attributes
    ----------
    template : str
        Name of the drawing.
    sources : mapping of name to columns
    ranges : mapping of name to (start, end)
    moves : mapping of source to (channels, places in theta, place of a delay)
        What sliders move.
    """

    template: str
    sources: Mapping[str, Columns]
    ranges: Mapping[str, tuple[float, float]]
    moves: Mapping[str, tuple[int, list[int], int]]

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON, the columns as Bokeh writes those of its own sources."""
        sources = {
            name: Serializer(deferred=False).serialize(columns).content for name, columns in self.sources.items()
        }
        ranges = {name: {"start": start, "end": end} for name, (start, end) in self.ranges.items()}
        moves = {
            name: {"channels": channels, "places": places, "delay": delay}
            for name, (channels, places, delay) in self.moves.items()
        }
        return {"template": self.template, "sources": sources, "ranges": ranges, "moves": moves}


def collect_run(
    template: str, curves: Sequence[Curves], spans: Sequence[ModeSpan], lines: Sequence[TransitionLine]
) -> FigureData:
    """Return the numbers of the figures of one run.

    Parameters
    ----------
    template : str
    curves : sequence of Curves
    spans : sequence of ModeSpan
    lines : sequence of TransitionLine
    """
    first, last = spans[0].left, spans[-1].right
    sources: dict[str, Columns] = {"modes": list_spans(spans), "transitions": list_lines(lines)}
    moves = {}
    for c, own in enumerate(curves):
        sources[f"curve-{c}"] = list_curve(own)
        moves[f"curve-{c}"] = len(own.names), list(own.tangents), own.delay
        if own.kind != "states":
            sources[f"samples-{c}"] = list_samples(own)
            moves[f"samples-{c}"] = len(own.names), list(own.sample_tangents), -1
    margin = MARGIN * (last - first)
    return FigureData(template, sources, {"times": (first - margin, last + margin)}, moves)


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


def list_spans(spans: Sequence[ModeSpan]) -> Columns:
    """Return the modes: left, right, colour, the places in theta of the ends.

    Parameters
    ----------
    spans : sequence of ModeSpan
    """
    left, right = np.array([s.left for s in spans]), np.array([s.right for s in spans])
    return {
        "left": left,
        "right": right,
        "left_b": left,
        "right_b": right,
        "colour": [s.colour for s in spans],
        "left_place": [s.left_place for s in spans],
        "right_place": [s.right_place for s in spans],
    }


def list_lines(lines: Sequence[TransitionLine]) -> Columns:
    """Return the transitions: x, low, high, their texts and places in theta.

    Parameters
    ----------
    lines : sequence of TransitionLine
    """
    times = np.array([line.time for line in lines], dtype=float)
    texts = {name: [getattr(line, name) for line in lines] for name in ("name", "value", "interval", "modes", "place")}
    ends = {name: np.array([getattr(line, name) for line in lines], dtype=float) for name in ("low", "high")}
    return {"x": times, "x_b": times} | ends | texts


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
        FigureData(name, histogram, {}, {}),
        FigureData("quantiles", quantiles, {}, {}),
        FigureData("autocorrelation", correlogram, {"reach": (-reach, reach)}, {}),
    ]
