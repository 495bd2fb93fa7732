"""Text and figure of insertion rates."""

from __future__ import annotations

import numpy as np

from switchfit.modes.rates import Insertion
from switchfit.report import style
from switchfit.report.dates import format_time
from switchfit.report.plot import choose_mode_colours, plot_modes
from switchfit.report.style import LINE, LINE_COLOURS, MODE_COLOURS, REFERENCE, SMALL, THIN
from switchfit.report.tables import format_table, wrap_text
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_text

LISTED = 3
"""Minima of each mode in a table, and in a figure."""


@format_text.register(Insertion)
def write_insertion(found: Insertion) -> str:
    """Return which pulse lowers J fastest, the lowest minima of all modes, and what is not defined.

    Parameters
    ----------
    found : Insertion
    """
    run, pulses = found.trajectory, found.minima(LISTED)
    lines = []
    if pulses:
        best = pulses[0]
        at = format_time(best.time, run) + ("" if run.origin is not None else f" {run.time_unit}")
        speed = f"{-best.rate:.4g} per {run.time_unit} of its length"
        lines += wrap_text(f"A short pulse of {best.mode} at {at} lowers J fastest: by {speed}.")
        header = [("mode", "time" if run.origin is not None else f"time ({run.time_unit})", "dJ / d length", "in")]
        rows = [
            (pulse.mode, format_time(pulse.time, run), f"{pulse.rate:.4g}", _name_interrupted(found, pulse.time))
            for pulse in pulses
        ]
        lines += ["", *format_table([*header, *rows], "<>><")]
    else:
        lines.append("No short pulse of any mode lowers J.")
    undefined = [
        f"{mode} in {found.modes[m]}"
        for m in np.unique(found.active).tolist()
        for k, mode in enumerate(found.modes)
        if np.isnan(found.rate[found.active == m, k]).all()
    ]
    if undefined:
        text = f"Not defined, since a reset map or a guard is at its ends: a pulse of {', '.join(undefined)}."
        lines += ["", *wrap_text(text)]
    return "\n".join(lines)


def _name_interrupted(found: Insertion, time: float) -> str:
    """Return the mode that a pulse at one of the times interrupts."""
    return found.modes[int(found.active[np.flatnonzero(found.times == time)[-1]])]


@draw_figure.register(Insertion)
def plot_insertion(found: Insertion, *, ax: Axes | None = None) -> Axes | Figure:
    """Draw the rate of each mode over time, its lowest minima as dots, with the active modes shaded.

    Parameters
    ----------
    found : Insertion
    ax : matplotlib.axes.Axes, optional
    """
    return style.draw_on(ax, lambda ax: _draw(found, ax), (7.2, 3.8))


def _draw(found: Insertion, ax: Axes) -> Axes:
    run = found.trajectory
    order = [*choose_mode_colours([run]), *found.modes]
    colours, shades = (style.assign_colours(order, palette) for palette in (LINE_COLOURS, MODE_COLOURS))  # of one hue
    ax.axhline(0.0, color=REFERENCE, linewidth=THIN, zorder=2)
    for k, mode in enumerate(found.modes):
        rate = np.where(found.active == k, np.nan, found.rate[:, k])  # zero by definition
        if np.isfinite(rate).any():
            ax.plot(found.times, rate, "-", color=colours[mode], linewidth=LINE, label=f"pulse of {mode}", zorder=3)
            minima = [pulse for pulse in found.minima(LISTED) if pulse.mode == mode]
            times, rates = [pulse.time for pulse in minima], [pulse.rate for pulse in minima]
            ax.plot(times, rates, "o", markersize=4.5, color=colours[mode], zorder=4)
    plot_modes(run, ax, colours=shades)
    ax.set_ylabel(style.label_quantity("dJ / d length of a pulse", f"1/{run.time_unit}"))
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="best", frameon=False, fontsize=SMALL)
    return ax
