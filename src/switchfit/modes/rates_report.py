"""Text and figure of insertion rates: which short pulse of which mode lowers J fastest."""

from __future__ import annotations

import numpy as np

from switchfit.modes.rates import Insertion
from switchfit.report import numbers, panels, style, tables
from switchfit.report import times as times_module
from switchfit.report.style import LINE, LINE_COLOURS, MODE_COLOURS, REFERENCE_COLOUR, SMALL, THIN
from switchfit.report.tables import format_table, wrap_text
from switchfit.report.times import format_time, label_time
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_text

LISTED_RATE_MINIMA = 3
"""Minima of each mode in a table of insertion rates, and in its figure."""


@format_text.register(Insertion)
def write_insertion(found: Insertion) -> str:
    """Return which pulse lowers J fastest, and the lowest minima of all modes.

    Parameters
    ----------
    found : Insertion
    """
    run, pulses = found.trajectory, found.minima(LISTED_RATE_MINIMA)
    text, rows = "No short pulse of any mode lowers J.", []
    if pulses:
        at = format_time(pulses[0].time, run) + times_module.suffix_time(run)
        speed = f"{-pulses[0].rate:.4g} per {run.time_unit} of its length"
        text = f"A short pulse of {pulses[0].mode} at {at} lowers J fastest: by {speed}."
    for pulse in pulses:
        # At a transition a time stands twice: the mode after it is interrupted, as the pulse begins there.
        interrupted = found.modes[int(found.active[np.flatnonzero(found.times == pulse.time)[-1]])]
        rows.append((pulse.mode, format_time(pulse.time, run), f"{pulse.rate:.4g}", interrupted))
    table = format_table(rows, "<>><", ["mode", label_time(run, "time"), "dJ / d length", "in"])
    return tables.join_sections(wrap_text(text), table)


@draw_figure.register(Insertion)
def plot_insertion(found: Insertion, *, ax: Axes | None = None) -> Axes | Figure:
    """Draw the rate of each mode over time, its lowest minima as dots, with the active modes shaded.

    Parameters
    ----------
    found : Insertion
    ax : matplotlib.axes.Axes, optional
    """
    (drawn, ax), run = style.open_axes(ax, (7.2, 3.8)), found.trajectory
    order = [*panels.choose_mode_colours([run]), *found.modes]
    colours, shades = (style.assign_colours(order, palette) for palette in (LINE_COLOURS, MODE_COLOURS))  # of one hue
    ax.axhline(0.0, color=REFERENCE_COLOUR, linewidth=THIN, zorder=2)
    for k, mode in enumerate(found.modes):
        rate = np.where(found.active == k, np.nan, found.rate[:, k])  # zero by definition
        if np.isfinite(rate).any():
            ax.plot(found.times, rate, "-", color=colours[mode], linewidth=LINE, label=f"pulse of {mode}", zorder=3)
            minima = [pulse for pulse in found.minima(LISTED_RATE_MINIMA) if pulse.mode == mode]
            times, rates = [pulse.time for pulse in minima], [pulse.rate for pulse in minima]
            ax.plot(times, rates, "o", markersize=4.5, color=colours[mode], zorder=4)
    panels.plot_modes(run, ax, colours=shades)
    ax.set_ylabel(numbers.label_quantity("dJ / d length of a pulse", f"1/{run.time_unit}"))
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="best", frameon=False, fontsize=SMALL)
    return style.turn_off_formulas(drawn)
