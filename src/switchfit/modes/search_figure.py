"""The figure of a search for the mode sequence: criteria, the best fit, and mode probabilities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.modes.ending_report import CRITERION_TITLES
from switchfit.modes.result import ModeSearch
from switchfit.modes.search_report import list_criteria
from switchfit.report import panels, style
from switchfit.report.style import FIT_COLOUR, LINE, LINE_COLOURS, MODE_COLOURS, REFERENCE_COLOUR, SMALL, THIN
from switchfit.runtime.presentation import Axes, Figure, draw_figure

DRAWN_PROBABILITY_TIMES = 400
"""Times at which mode probabilities are drawn."""

DRAWN_RUNS = 4
"""Experiments in a figure."""

INVISIBLE = 0.02
"""Probability up to which a mode is left out of a figure: a line's width."""


@draw_figure.register(ModeSearch)
def plot_search(search: ModeSearch) -> Figure:
    """Draw the criteria by number of switches, the best fit with its modes shaded, and the mode probabilities.

    Parameters
    ----------
    search : ModeSearch
    """
    best = search.best
    runs = range(0 if best is None else min(len(search.run_names), DRAWN_RUNS))
    figure = style.make_figure(8.0, 2.8 + 4.2 * max(len(runs), 1 if search.chosen else 0))
    axes = figure.subplots(1 + 2 * len(runs), 1, squeeze=False, height_ratios=[1.0, *([1.2, 0.6] * len(runs))])[:, 0]
    _plot_numbers(search, axes[0])
    colours = style.assign_colours(search.modes, MODE_COLOURS)
    for e, above, below in zip(runs, axes[1::2], axes[2::2], strict=True):
        if best is None:
            break
        panels.plot_comparison(*panels.list_outputs(best, e)[0], above)
        panels.plot_modes(best.trajectories[e], above, colours=colours)
        above.set_title(search.run_names[e] if len(search.run_names) > 1 else "", loc="left", fontsize=SMALL)
        t = np.linspace(search.starts[e], search.ends[e], DRAWN_PROBABILITY_TIMES)
        stack_probabilities(t, search.modes, search.mode_probability(t, experiment=e), below)
        style.label_axis(below, best.trajectories[e])
    return style.turn_off_formulas(figure)


def _plot_numbers(search: ModeSearch, ax: Axes) -> None:
    """Draw the criteria over the number of switches, each less its lowest."""
    numbers = [fit.switches for fit in search.fitted]
    colours = style.assign_colours([*CRITERION_TITLES, "criterion"], LINE_COLOURS)
    for name, label in list_criteria(search).items():
        values = np.array([getattr(fit, name) for fit in search.fitted])
        if np.isfinite(values).any():
            # Each criterion has a zero of its own; only differences mean something. Infinite ones are sequences that do
            # not fit.
            above = values - np.nanmin(np.where(np.isfinite(values), values, np.nan))
            ax.plot(numbers, above, "o-", color=colours[name], linewidth=LINE, markersize=4, label=label)
    if search.chosen:
        ax.axvline(search.chosen[0].switches, color=FIT_COLOUR, linewidth=THIN, zorder=0)
    # Linear where models compete, to 10 above the lowest; logarithmic for the thousands of those that miss a switch.
    ax.set_yscale("symlog", linthresh=10.0)
    ax.set_ylim(bottom=-1.0)
    ax.set_xlabel("number of switches")
    ax.set_ylabel("above the lowest")
    ax.locator_params(axis="x", integer=True)
    if ax.lines:
        ax.legend(fontsize=SMALL)


def stack_probabilities(t: FloatArray, modes: Sequence[str], probability: FloatArray, ax: Axes) -> None:
    """Draw probabilities over time, one upon the other, with a legend; modes without any are left out.

    Parameters
    ----------
    t : (K,)
    modes : sequence of str
    probability : (K, modes)
    ax : matplotlib.axes.Axes
    """
    colours = style.assign_colours(modes, LINE_COLOURS)
    # A library may have dozens of modes, most of which are never probable.
    drawn = [mode for mode, own in zip(modes, probability.max(axis=0), strict=True) if own > INVISIBLE]
    rows = [probability[:, modes.index(mode)] for mode in drawn]
    ax.stackplot(t, rows, labels=drawn, colors=[colours[mode] for mode in drawn], step="post", linewidth=0)
    ax.set_ylim(0.0, 1.0)
    ax.set_xlim(t[0], t[-1])
    ax.set_ylabel("probability")
    ax.axhline(0.5, color=REFERENCE_COLOUR, linewidth=THIN)
    style.draw_legend_above(ax)
