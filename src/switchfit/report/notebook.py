"""How results and problems show themselves in a notebook: their text, and a small figure below it."""

from __future__ import annotations

import base64
import io
from html import escape
from typing import Any

import numpy as np

from switchfit.batch.fits import Fits
from switchfit.problem.problem import Problem
from switchfit.report.formats import describe_origin, format_span, format_table, format_time, format_unit, list_dated
from switchfit.runtime.presentation import Displayed, Figure, format_html
from switchfit.uncertainty.prediction import Prediction

DOTS = 64
"""Dots per inch of the figures."""
LARGEST_FIGURE = 4
"""Experiments or outputs up to which a result shows its figure; with more of them it is no small one."""
MOST_ROWS = 20
"""Experiments or unknowns of a problem in a table."""


@format_html.register(Prediction)
@format_html.register(Displayed)
def show_result(result: Any) -> str:
    """Return the text of a result, and its figure if it has a small one.

    Parameters
    ----------
    result : object
        With a method ``plot()``.
    """
    figure = write_figure(result.plot()) if has_small_figure(result) else ""
    return f"<div><pre>{escape(str(result))}</pre>{figure}</div>"


def has_small_figure(result: Any) -> bool:
    """Return whether there is something to draw, and not too much.

    Parameters
    ----------
    result : object
    """
    if isinstance(result, Fits):
        return len(result) > 0
    if isinstance(result, Prediction):
        return 0 < len(result.output_names) <= LARGEST_FIGURE
    return len(getattr(result, "trajectories", ())) <= LARGEST_FIGURE


@format_html.register(Problem)
def show_problem(problem: Problem) -> str:
    """Return the experiments, and the unknowns with their first guesses and bounds.

    Parameters
    ----------
    problem : Problem
    """
    runs, rows = [], []
    for name, experiment in zip(problem.run_names, problem.experiments, strict=True):
        ends = experiment.ends_of_modes(experiment.initial_times)
        samples = sum(getattr(item, "count", 0) for item in experiment.data)
        horizon = f"{format_span(ends[0], ends[-1], experiment)} {describe_origin(experiment)}".rstrip()
        runs.append([name, " -> ".join(experiment.mode_sequence), horizon, f"{samples}" if samples else ""])
    own = problem.unknowns
    columns = zip(own.names, own.initial, own.lower, own.upper, own.units, own.priors.texts(), strict=True)
    for run, (name, value, lower, upper, unit, prior) in zip(list_dated(problem), columns, strict=True):
        bounds = [format_time(bound, run) if np.isfinite(bound) else "" for bound in (lower, upper)]
        rows.append([name, format_time(value, run), *bounds, "" if run else format_unit(unit), prior])
    lines = format_table(runs, "<<<>", ["experiment", "modes", "horizon", "samples"], most=MOST_ROWS)
    titles = ["unknown", "first guess", "lower", "upper", "", "prior"]
    lines += ["", *format_table(rows, "<>>><<", titles, most=MOST_ROWS)]
    text = escape("\n".join(lines))
    return f"<div><pre>{text}</pre></div>"


def write_figure(figure: Figure) -> str:
    """Return a figure as an image inside the HTML.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    """
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=DOTS)
    content = base64.b64encode(picture.getvalue()).decode()
    return f'<img alt="the figure of the result" style="background: white" src="data:image/png;base64,{content}">'
