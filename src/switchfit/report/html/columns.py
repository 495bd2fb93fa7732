"""The numbers of the figures of a run, by the names of the sources that the page's script puts them into.

The script keeps what sliders move (t, y0.., x, left, right) as fit_t, fit_y0.. as well.

Runs that show the same channels share one drawing: building a figure takes Bokeh a tenth of a second, its numbers a
thousandth. Tangents and bands are float32.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from switchfit.fit.result import Fit
from switchfit.report.dates import format_estimate
from switchfit.report.html.curves import Curves
from switchfit.report.numbers import format_unit
from switchfit.report.plane import find_plane
from switchfit.report.text import format_end
from switchfit.uncertainty.residuals import correct_errors, find_transition_intervals

Columns = Mapping[str, Any]


def collect_sources(fit: Fit, e: int, curves: Sequence[Curves], colours: Mapping[str, str]) -> dict[str, Columns]:
    """Return the numbers of the figures of one run.

    Parameters
    ----------
    fit : Fit
    e : int, from 0
        Which run.
    curves : sequence of Curves
    colours : mapping of mode to colour
    """
    sources = {"modes": list_spans(fit, e, colours), "transitions": list_transitions(fit, e)}
    for c, own in enumerate(curves):
        sources[f"curve-{c}"] = list_curve(own)
        if own.kind != "states":
            sources[f"samples-{c}"] = list_samples(own)
    return sources


def list_curve(curves: Curves) -> Columns:
    """Return what is fitted: t, mode, y0.., bands, tangents d{place}_{k}.

    Parameters
    ----------
    curves : Curves
    """
    data: dict[str, Any] = {"t": curves.times, "mode": curves.modes.tolist()}
    for k in range(len(curves.names)):
        data[f"y{k}"] = curves.values[:, k]
        if curves.band is not None:
            data |= {f"lo{k}": curves.band[:, k, 0].astype("f4"), f"hi{k}": curves.band[:, k, 1].astype("f4")}
        data |= {f"d{place}_{k}": slope[:, k].astype("f4") for place, slope in curves.tangents.items()}
    if find_plane(curves.names, curves.units) is not None:
        breaks = np.isnan(curves.times)
        data["size"] = np.where(np.concatenate([[False], breaks[:-1]]), 13.0, 0.0).astype("f4")
    return data


def list_samples(curves: Curves) -> Columns:
    """Return what is measured: t, m0.., residuals y0.., sigma s0.., outliers o0.., tangents of the residuals.

    Parameters
    ----------
    curves : Curves
    """
    data: dict[str, Any] = {"t": curves.sample_times}
    residuals = curves.measured - curves.fitted
    for k in range(len(curves.names)):
        data |= {f"m{k}": curves.measured[:, k], f"y{k}": residuals[:, k]}
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
    modes, left, right = zip(*fit.trajectories[e].mode_spans, strict=True)
    places = [-1, *fit.transition_places[e].tolist(), fit.final_places[e]]
    return {
        "left": np.array(left),
        "right": np.array(right),
        "colour": [colours[mode] for mode in modes],
        "left_place": places[: len(modes)],
        "right_place": places[1 : len(modes) + 1],
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
        value, error = format_estimate(t.time, np.nan if t.index is None else errors[t.index], dated)
        unit = format_unit(t.unit) if dated is None or error else ""
        values.append(" ".join(part for part in (value, error, unit) if part))
        low, high = (format_end(end, ends, dated) for end in ends)
        shown.append(f"{low} to {high}" if low and high else "not known")
    return {
        "x": np.array([t.time for t in own], dtype=float),
        "low": intervals[:, 0],
        "high": intervals[:, 1],
        "name": [t.name for t in own],
        "value": values,
        "interval": shown,
        "modes": [f"{t.before} → {t.after}" for t in own],
        "place": [-1 if t.index is None else t.index for t in own],
    }
