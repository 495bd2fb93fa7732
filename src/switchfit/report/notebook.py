"""How results and problems show themselves in a notebook: a few lines of HTML with a small figure.

They need no extra: a table is written here and not by a template.
"""

from __future__ import annotations

import base64
import io
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from switchfit.batch.fits import Fits
from switchfit.estimation.estimator import Estimate
from switchfit.problem.problem import Problem
from switchfit.report.batch import LEVEL_COLOURS
from switchfit.report.dates import describe_origin, format_time, format_unknown, list_dated_unknowns
from switchfit.report.numbers import format_unit
from switchfit.report.plot import plot_fit
from switchfit.report.tables import Table
from switchfit.report.text import SCREEN, select_unknowns, tabulate_unknowns
from switchfit.runtime.presentation import format_html
from switchfit.uncertainty.profiles import Profile

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS = 64
"""Dots per inch of the figures."""
LARGEST_FIGURE = 4
"""Experiments up to which an estimate shows its figure; with more of them it is no small one."""
MOST_EXPERIMENTS = 10


@format_html.register(Estimate)
def show_estimate(estimate: Estimate) -> str:
    """Return the verdict, the table of the unknowns, and the figure.

    Parameters
    ----------
    estimate : Estimate
    """
    verdict = estimate.verdict
    table, note = tabulate_unknowns(estimate, shown := select_unknowns(estimate, SCREEN.unknowns))
    more = len(estimate.theta) - len(shown)
    colour = LEVEL_COLOURS[verdict.level]
    style = f"border-left: 4px solid {colour}; padding-left: 0.6em"
    parts = [f'<p style="{style}">{escape(str(verdict))}</p>', write_table(table)]
    parts += [f"<p>And {more} more unknowns.</p>"] if more else []
    parts += [f"<p>{escape(note)}</p>"] if note else []
    if len(estimate.trajectories) <= LARGEST_FIGURE:
        parts.append(write_figure(plot_fit(estimate), "measured and fitted"))
    return f"<div>{''.join(parts)}</div>"


@format_html.register(Problem)
def show_problem(problem: Problem) -> str:
    """Return the experiments, and the unknowns with their first guesses and bounds.

    Parameters
    ----------
    problem : Problem
    """
    runs = [["experiment", "modes", "horizon", "", "samples"]]
    for number, experiment in enumerate(problem.experiments, start=1):
        ends = experiment.ends_of_modes(experiment.initial_times)
        samples = sum(getattr(item, "count", 0) for item in experiment.data)
        modes = " → ".join(experiment.mode_sequence)
        horizon = f"{format_time(ends[0], experiment)} to {format_time(ends[-1], experiment)}"
        unit = describe_origin(experiment) or format_unit(experiment.time_unit)
        name = experiment.name or str(number)
        runs.append([name, modes, horizon, unit, f"{samples}" if samples else ""])
    unknowns = problem.unknowns
    rows = [["unknown", "first guess", "lower", "upper", "", "prior"]]
    columns = zip(
        unknowns.names,
        unknowns.initial,
        unknowns.lower,
        unknowns.upper,
        unknowns.units,
        unknowns.priors.texts(),
        strict=True,
    )
    for run, (name, value, lower, upper, unit, prior) in zip(list_dated_unknowns(problem), columns, strict=True):
        bounds = [format_unknown(bound, run) if np.isfinite(bound) else "" for bound in (lower, upper)]
        rows.append([name, format_unknown(value, run), *bounds, "" if run else format_unit(unit), prior])
    parts = []
    for lines, most, alignment in ((runs, MOST_EXPERIMENTS, "<<<<>"), (rows, 2 * SCREEN.unknowns, "<>>><<")):
        parts.append(write_table(Table(lines[: most + 1], alignment)))
        more = len(lines) - 1 - most
        parts += [f"<p>And {more} more.</p>"] if more > 0 else []
    return f"<div>{''.join(parts)}</div>"


@format_html.register(Fits)
def show_fits(fits: Fits) -> str:
    """Return how many fits ended how.

    Parameters
    ----------
    fits : Fits
    """
    return f"<pre>{escape(str(fits))}</pre>"


@format_html.register(Profile)
def show_profile(profile: Profile) -> str:
    """Return the estimate with its intervals, and the figure.

    Parameters
    ----------
    profile : Profile
    """
    figure = write_figure(profile.plot(), f"profile likelihood of {profile.name}")
    return f"<div><pre>{escape(str(profile))}</pre>{figure}</div>"


def write_table(table: Table) -> str:
    """Return a table as HTML, its first row as header; columns without an entry are left out.

    Parameters
    ----------
    table : Table
    """

    def write_row(row: list[str], tag: str) -> str:
        cells = []
        for k in table.columns:
            side = "right" if table.alignment[k] == ">" else "left"
            cells.append(f'<{tag} style="text-align: {side}">{escape(row[k])}</{tag}>')
        return f"<tr>{''.join(cells)}</tr>"

    head, *rows = (list(row) for row in table.rows)
    body = "".join(write_row(row, "td") for row in rows)
    return f"<table><thead>{write_row(head, 'th')}</thead><tbody>{body}</tbody></table>"


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
