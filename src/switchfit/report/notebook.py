"""How results and problems show themselves in a notebook: a few lines of HTML with a small figure.

They need no extra: a table is written here and not by a template.
"""

from __future__ import annotations

import base64
import io
import sys
from collections.abc import Sequence
from html import escape

import numpy as np

from switchfit.batch.fits import Fits
from switchfit.estimation.estimator import Estimate
from switchfit.modes.result import ModeSearch
from switchfit.problem.problem import Problem
from switchfit.report.batch import LEVEL_COLOURS, tabulate_study
from switchfit.report.formats import (
    Table,
    describe_origin,
    format_time,
    format_unit,
    list_dated,
)
from switchfit.report.plot import plot_fit
from switchfit.report.text import SCREEN, select_unknowns, tabulate_unknowns
from switchfit.report.validation import tabulate_models, tabulate_predicted, write_best
from switchfit.runtime.presentation import Figure, format_html
from switchfit.strategy.comparison import ModelComparison
from switchfit.strategy.validation import Validation
from switchfit.uncertainty.prediction import Prediction
from switchfit.uncertainty.profiles import Profile
from switchfit.uncertainty.verdict import Verdict

DOTS = 64
"""Dots per inch of the figures."""
LARGEST_FIGURE = 4
"""Experiments up to which an estimate shows its figure; with more of them it is no small one."""
MOST_ROWS = 10
"""Experiments or channels in a table."""


@format_html.register(Estimate)
def show_estimate(estimate: Estimate) -> str:
    """Return the verdict, the table of the unknowns, and the figure.

    Parameters
    ----------
    estimate : Estimate
    """
    table, note = tabulate_unknowns(estimate, shown := select_unknowns(estimate, SCREEN.unknowns))
    more = len(estimate.theta) - len(shown)
    notes = [f"And {more} more unknowns."] if more else []
    notes += [note] if note else []
    few = len(estimate.trajectories) <= LARGEST_FIGURE
    figure = write_figure(plot_fit(estimate, bands=False), "measured and fitted") if few else ""
    return f"<div>{write_verdict_line(estimate.verdict)}{write_table(table)}{write_notes(notes)}{figure}</div>"


@format_html.register(Problem)
def show_problem(problem: Problem) -> str:
    """Return the experiments, and the unknowns with their first guesses and bounds.

    Parameters
    ----------
    problem : Problem
    """
    runs, rows = [], []
    for number, experiment in enumerate(problem.experiments, start=1):
        ends = experiment.ends_of_modes(experiment.initial_times)
        samples = sum(getattr(item, "count", 0) for item in experiment.data)
        modes = " → ".join(experiment.mode_sequence)
        horizon = f"{format_time(ends[0], experiment)} to {format_time(ends[-1], experiment)}"
        unit = describe_origin(experiment) or format_unit(experiment.time_unit)
        name = experiment.name or str(number)
        runs.append([name, modes, horizon, unit, f"{samples}" if samples else ""])
    own = problem.unknowns
    columns = zip(own.names, own.initial, own.lower, own.upper, own.units, own.priors.texts(), strict=True)
    for run, (name, value, lower, upper, unit, prior) in zip(list_dated(problem), columns, strict=True):
        bounds = [format_time(bound, run) if np.isfinite(bound) else "" for bound in (lower, upper)]
        rows.append([name, format_time(value, run), *bounds, "" if run else format_unit(unit), prior])
    first = Table(runs, "<<<<>", ["experiment", "modes", "horizon", "", "samples"])
    second = Table(rows, "<>>><<", ["unknown", "first guess", "lower", "upper", "", "prior"])
    return f"<div>{write_table(first, most=MOST_ROWS)}{write_table(second, most=2 * SCREEN.unknowns)}</div>"


@format_html.register(Fits)
def show_fits(fits: Fits) -> str:
    """Return the verdict, the table of the study, and its figure.

    Parameters
    ----------
    fits : Fits
    """
    table, note = tabulate_study(fits)
    written = write_table(table) if table.rows else ""
    figure = write_figure(fits.plot(), "the fits") if len(fits) else ""
    return f"<div>{write_verdict_line(fits.verdict)}{written}{write_notes(note.splitlines())}{figure}</div>"


@format_html.register(Validation)
def show_validation(found: Validation) -> str:
    """Return the verdict, how much of each channel is predicted, and the figure.

    Parameters
    ----------
    found : Validation
    """
    table = tabulate_predicted(found)
    few = len(table.rows) <= LARGEST_FIGURE
    figure = write_figure(found.plot(), "measured and predicted") if few else ""
    return f"<div>{write_verdict_line(found.verdict)}{write_table(table, most=MOST_ROWS)}{figure}</div>"


@format_html.register(ModelComparison)
def show_models(found: ModelComparison) -> str:
    """Return which model is best, the table of the models, and the figure.

    Parameters
    ----------
    found : ModelComparison
    """
    table, figure = write_table(tabulate_models(found)), write_figure(found.plot(), "AICc and BIC of the models")
    return f"<div><p>{escape(write_best(found))}</p>{table}{figure}</div>"


@format_html.register(ModeSearch)
def show_search(search: ModeSearch) -> str:
    """Return the text of a search, and the figure if it has found a sequence.

    Parameters
    ----------
    search : ModeSearch
    """
    figure = write_figure(search.plot(), "criteria, best fit and mode probabilities") if search.chosen else ""
    return f"<div><pre>{escape(str(search))}</pre>{figure}</div>"


@format_html.register(Prediction)
def show_prediction(prediction: Prediction) -> str:
    """Return which outputs are predicted at which times, and the figure if they are few.

    Parameters
    ----------
    prediction : Prediction
    """
    shown = 0 < len(prediction.output_names) <= LARGEST_FIGURE and len(prediction.times) > 1
    figure = write_figure(prediction.plot(), "predicted, with bands") if shown else ""
    return f"<div><p>{escape(repr(prediction))}</p>{figure}</div>"


@format_html.register(Profile)
def show_profile(profile: Profile) -> str:
    """Return the estimate with its intervals, and the figure.

    Parameters
    ----------
    profile : Profile
    """
    figure = write_figure(profile.plot(), f"profile likelihood of {profile.name}")
    return f"<div><pre>{escape(str(profile))}</pre>{figure}</div>"


def write_notes(notes: Sequence[str]) -> str:
    """Return a paragraph for each note."""
    return "".join(f"<p>{escape(note)}</p>" for note in notes)


def write_verdict_line(verdict: Verdict) -> str:
    """Return a verdict as a paragraph with the colour of its level beside it.

    Parameters
    ----------
    verdict : Verdict
    """
    style = f"border-left: 4px solid {LEVEL_COLOURS[verdict.level]}; padding-left: 0.6em"
    return f'<p style="{style}">{escape(str(verdict))}</p>'


def write_table(table: Table, *, most: int = sys.maxsize) -> str:
    """Return a table as HTML; columns without an entry are left out.

    Parameters
    ----------
    table : Table
    most : int, optional
        Of more rows the first are shown, and the others counted.
    """
    head = f"<thead>{_write_row(table, table.titles, 'th')}</thead>" if table.titles else ""
    body = "".join(_write_row(table, row, "td") for row in table.rows[:most])
    more = len(table.rows) - most
    return f"<table>{head}<tbody>{body}</tbody></table>{write_notes([f'And {more} more.'] if more > 0 else [])}"


def _write_row(table: Table, row: Sequence[str], tag: str) -> str:
    sides = {k: "right" if table.alignment[k] == ">" else "left" for k in table.columns}
    cells = [f'<{tag} style="text-align: {side}">{escape(row[k])}</{tag}>' for k, side in sides.items()]
    return f"<tr>{''.join(cells)}</tr>"


def write_figure(figure: Figure, what: str) -> str:
    """Return a figure as an image inside the HTML.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    what : str
        What it shows, for those who do not see it.
    """
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=DOTS)
    content = base64.b64encode(picture.getvalue()).decode()
    return (
        f'<img alt="{escape(what)}" style="max-width: 100%; background: white" src="data:image/png;base64,{content}">'
    )
