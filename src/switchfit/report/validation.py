"""Text and figure of the validation of a fit on another run."""

from __future__ import annotations

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.report import fit_figure, panels, selection, times
from switchfit.report.residuals import format_probability
from switchfit.report.style import SMALL
from switchfit.report.tables import Table, format_table, join_sections, wrap_text
from switchfit.report.wording import ALLOWED
from switchfit.runtime.presentation import Figure, draw_figure, format_text
from switchfit.strategy.validation import Validation, convert_to_percent
from switchfit.uncertainty.explained_variance import explain_channel
from switchfit.uncertainty.residuals import list_channels


@format_text.register(Validation)
def write_validation(found: Validation) -> str:
    """Return the verdict, what was kept and what was estimated, and a row for each channel.

    Parameters
    ----------
    found : Validation
    """
    errors, names, rows = found.corrected_standard_errors, found.theta_names, []
    refit = () if found.refit is None else found.refit.theta_names
    known = zip(names, found.theta, errors, found.problem.unknowns.units, strict=True)
    for (name, value, error, unit), run in zip(known, times.list_dated(found.problem), strict=True):
        shown, spread = times.format_estimate(float(value), float(error), run)
        # Three origins: kept from the fit, this run's own, or given and not estimated.
        origin = "estimated from this run" if name in refit else "as given"
        origin = "kept from the fit" if name in found.kept else origin
        rows.append([name, shown, spread if spread != "held" else "", unit, origin])
    sections = [wrap_text(str(found.verdict)), format_table(rows, "<>><<")]
    if not np.array_equal(errors, found.standard_errors, equal_nan=True):
        sections.append([ALLOWED])
    sections.append(["Channels", *format_table(*_tabulate_predicted(found))])
    if np.isfinite(found.chi_square):
        kind = "" if np.isinf(found.noise_freedom) else f", F with {found.freedom} and {found.noise_freedom:.4g}"
        chi_square = f"chi² {found.chi_square:.4g} for {found.freedom} degrees of freedom"
        sections.append([f"{chi_square}, the error of the parameters included: P = {found.probability:.2g}{kind}"])
    if found.inputs:
        tests = [(test.channel, test.input, format_probability(test.probability)) for test in found.inputs]
        columns = ["residuals of", "and input", "P(none)"]
        sections.append(["Correlation with inputs", *format_table(tests, "<<>", columns)])
    return join_sections(*sections)


def _tabulate_predicted(found: Validation) -> Table:
    """Return a row for each channel: how much of it is predicted, and the tests of its residuals."""
    rows, titles = [], ["", "values", "fit (%)", "R²", "rms error", "lag 1", "P(white)"]
    tests = dict(zip(found.residuals.labels, found.residuals.channels, strict=True))
    for label, _, comparison, k in list_channels(found.comparisons, found.run_names):
        explained, test = explain_channel(comparison, k), tests.get(label)
        white = "" if test is None else format_probability(test.whiteness)
        count = int(np.isfinite(comparison.measured[:, k]).sum())
        shares = [f"{convert_to_percent(explained):.1f}", f"{explained:.4f}"]
        lag = "" if test is None else f"{test.correlation:+.2f}"
        rows.append([label, f"{count}", *shares, f"{comparison.rmse[k]:.3g}", lag, white])
    return Table(rows, "<" + ">" * 6, titles)


@draw_figure.register(Validation)
def plot_validation(found: Validation, *, level: float = 0.95) -> Figure:
    """Draw measured against predicted for each channel with bands, and the residuals below.

    Parameters
    ----------
    found : Validation
        Of more than ten runs the first ten are shown.
    level : float, between 0 and 1
    """
    runs = range(min(len(found.comparisons), selection.MOST_DRAWN_RUNS))
    intervals = {e: _find_intervals(found, e, level) for e in runs}
    figure = fit_figure.plot_runs(found, intervals, dict(enumerate(found.predictions)), level=level, label="predicted")
    for e, block in enumerate(figure.subfigs):
        # Every other panel has residuals. A run without data has no fit to be written.
        for panel, (comparison, k) in zip(block.axes[::2], panels.list_outputs(found, e), strict=False):
            text = f"fit {convert_to_percent(explain_channel(comparison, k)):.1f} %"
            panel.annotate(text, (0.01, 0.97), xycoords="axes fraction", va="top", fontsize=SMALL)
    return figure


def _find_intervals(found: Validation, e: int, level: float) -> FloatArray:
    """Return the interval of each transition time of one run, NaN where it is not estimated: (N, 2)."""
    transitions = [begin for _, begin, _ in found.trajectories[e].mode_spans[1:]]
    places = found.problem.unknowns.times[e][: len(transitions)]
    half = found.quantile(level) * np.append(found.corrected_standard_errors, np.nan)[places]  # the last: not estimated
    return np.stack([transitions - half, transitions + half], axis=-1)
