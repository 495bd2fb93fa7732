"""Table and figure of the tests of residuals: in time, autocorrelation, quantiles."""

from __future__ import annotations

import numpy as np

from switchfit.report import numbers, selection, style
from switchfit.report.style import FIT_COLOUR, LINE, SHADE_COLOUR, THIN, TRANSITION_COLOUR
from switchfit.report.tables import Table, format_table
from switchfit.runtime import special
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_text
from switchfit.uncertainty.residuals import ChannelResiduals, ResidualDiagnostics

MOST_DRAWN_CHANNELS = 10
"""Largest number of channels in one figure."""


@format_text.register(ResidualDiagnostics)
def write_diagnostics(diagnostics: ResidualDiagnostics) -> str:
    """Return a line for each channel, and the tests that fail.

    Parameters
    ----------
    diagnostics : ResidualDiagnostics
    """
    if not diagnostics.channels:
        return "No residuals: the cost has no Measurements."
    lines = ["Standardised residuals", *format_table(*tabulate_diagnostics(diagnostics))]
    return "\n".join([*lines, *(f"  - {issue}" for issue in diagnostics.issues)])


def tabulate_diagnostics(diagnostics: ResidualDiagnostics) -> Table:
    """Return a row for each channel.

    Parameters
    ----------
    diagnostics : ResidualDiagnostics
    """
    rows, titles = [], ["", "values", "rms", "mean", "lag 1", "worth", "P(white)", "beyond 4"]
    for label, channel in zip(diagnostics.labels, diagnostics.channels, strict=True):
        size = [f"{len(channel.values)}", f"{channel.rms:.3g}", f"{channel.mean:+.2f}"]
        correlation = [f"{channel.correlation:+.2f}", f"{channel.effective:.0f}"]
        tests = [format_probability(channel.whiteness), f"{channel.outliers}"]
        rows.append([label, *size, *correlation, *tests])
    return Table(rows, "<" + ">" * 7, titles)


def format_probability(value: float) -> str:
    """Return a probability as text; a dash if it is not known."""
    return "-" if np.isnan(value) else f"{value:.3f}" if value >= 5e-4 else f"{value:.0e}"


@draw_figure.register(ResidualDiagnostics)
def plot_diagnostics(diagnostics: ResidualDiagnostics, most: int = MOST_DRAWN_CHANNELS) -> Figure:
    """Draw a row for each channel: residuals in time, their autocorrelation, their quantiles against normal ones.

    Parameters
    ----------
    diagnostics : ResidualDiagnostics
    most : int, optional
        Of more channels, those are shown whose residuals widen the standard errors most, the worst first.
    """
    shown = list(zip(diagnostics.labels, diagnostics.channels, strict=True))
    if len(shown) > most:
        # By what they do to the standard errors, not by a test, which a long log fails for trifles.
        shown = sorted(shown, key=lambda pair: pair[1].widening, reverse=True)[:most]
    figure = style.make_figure(10.5, 0.5 + 2.5 * max(len(shown), 1))
    if not shown:
        figure.suptitle("No residuals: the cost has no Measurements")
        return figure
    figure.suptitle(selection.count_worst(shown, diagnostics.channels, "channels"), fontsize="medium")
    axes = figure.subplots(len(shown), 3, squeeze=False, width_ratios=[2.0, 1.2, 1.0])
    for row, (label, channel) in zip(axes, shown, strict=True):
        for ax, draw in zip(row, (_draw_in_time, _draw_autocorrelation, _draw_quantiles), strict=True):
            draw(channel, ax)
        row[0].set_ylabel(f"{numbers.wrap_quantity(label)}\nresidual / {'sigma' if channel.sigma_known else 'rms'}")
    for ax, title in zip(axes[0], ("Residuals in time", "Autocorrelation", "Quantiles"), strict=True):
        ax.set_title(title)
    for ax, label in zip(axes[-1, 1:], ("lag (samples)", "normal quantile"), strict=True):
        ax.set_xlabel(label)
    return style.turn_off_formulas(figure)


def _draw_in_time(channel: ChannelResiduals, ax: Axes) -> None:
    """Draw standardised residuals over time with lines at two standard deviations."""
    ax.axhline(0.0, color=FIT_COLOUR, linewidth=THIN)
    for side in (-2.0, 2.0):
        ax.axhline(side, color=TRANSITION_COLOUR, linewidth=THIN, linestyle=":")
    size = 3.5 if len(channel.values) <= 300 else 1.5
    ax.plot(channel.times, channel.values, "o", color=TRANSITION_COLOUR, markersize=size, markeredgewidth=0, alpha=0.8)
    style.label_axis(ax, channel)


def _draw_autocorrelation(channel: ChannelResiduals, ax: Axes) -> None:
    """Draw the autocorrelation against lag, with the limits within which that of white noise lies in 95 %."""
    limit = 1.96 / np.sqrt(max(len(channel.values), 1))
    ax.axhspan(-limit, limit, color=SHADE_COLOUR, alpha=0.15, linewidth=0)
    ax.axhline(0.0, color=TRANSITION_COLOUR, linewidth=THIN)
    lags = np.arange(1, len(channel.autocorrelation) + 1)
    ax.vlines(lags, 0.0, channel.autocorrelation, color=FIT_COLOUR, linewidth=LINE)
    ax.plot(lags, channel.autocorrelation, "o", color=FIT_COLOUR, markersize=4)
    # Never less than twice the limits: correlations that are noise look small.
    reach = max(1.3 * float(np.max(np.abs(channel.autocorrelation), initial=0.0)), 2 * limit)
    ax.set_ylim(-min(reach, 1.05), min(reach, 1.05))


def _draw_quantiles(channel: ChannelResiduals, ax: Axes) -> None:
    """Draw sorted standardised residuals against quantiles of the normal distribution: a straight line if normal."""
    n = len(channel.values)
    # Plotting positions (k - 1/2)/n.
    expected = special.ndtri((np.arange(1, n + 1) - 0.5) / n)
    ax.plot(expected[[0, -1]], expected[[0, -1]], "-", color=FIT_COLOUR, linewidth=THIN)
    ax.plot(expected, np.sort(channel.values), "o", color=TRANSITION_COLOUR, markersize=3, markeredgewidth=0)
