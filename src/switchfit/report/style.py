"""The style that all figures share: colours, widths of lines, sizes of text, labels with units.

One rule holds for every plot. A plot of one axes takes ``ax``: given an ``ax``, it draws there and returns it; without
one, it makes a Figure and returns that. A plot of several panels returns a Figure. Nothing touches pyplot or any other
global state.

matplotlib is imported where a figure is made: it takes longer to load than half of switchfit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from switchfit.report.numbers import label_quantity
from switchfit.report.times import Timed, label_time
from switchfit.runtime.presentation import Axes, Figure

if TYPE_CHECKING:
    from matplotlib.artist import Artist

    from switchfit.report.notebook_figure import NotebookFigure

Drawn = TypeVar("Drawn", bound="Axes | Figure")

MODE_COLOURS = ("#eef4fb", "#f9dfbf", "#e2f2df", "#e9d0e2", "#faf7d4", "#c9dfe1", "#ececec", "#dcc9b6")
"""Light, and of different lightness one after the other, so that they differ in grey too."""

LINE_COLOURS = ("#3b82c4", "#e08a1e", "#3f9b4b", "#9b5fb5", "#b8a400", "#1f9aa0", "#8a8a8a", "#a0643c")
"""Of the same modes in the same hues, for lines and for thin shades: to be told apart on white and on black."""

FIT_COLOUR, DATA_COLOUR, REFERENCE_COLOUR, TRANSITION_COLOUR, SHADE_COLOUR = (
    "#b2182b",
    "#222222",
    "#777777",
    "#333333",
    "#4a7fb5",
)
"""What is fitted, what was measured, what it is compared with, lines in time, and regions of confidence."""

GROUP_COLOURS = ("#b2182b", "#4a7fb5", "#e0a030", "#5c9e5c", "#8a5fa3", "#777777")
"""Of things that are told apart, such as minima; the last is for all others."""

LINE, THIN = 1.5, 0.9
"""Widths of curves, and of lines that help to read them, in points."""

SMALL = "small"
"""Size of names, notes and legends in axes: relative, so that ``font.size`` of matplotlib scales all text."""


def make_figure(width: float, height: float) -> NotebookFigure:
    """Return an empty figure of a size in inches, whose parts do not overlap.

    Parameters
    ----------
    width, height : float
    """
    from switchfit.report.notebook_figure import NotebookFigure

    return NotebookFigure(figsize=(width, height), layout="constrained")


def open_axes(ax: Axes | None, size: tuple[float, float] = (6.4, 4.2)) -> tuple[Axes | Figure, Axes]:
    """Return what a plot of one axes returns, and the axes in which it draws: those given, or those of a new figure.

    Parameters
    ----------
    ax : matplotlib.axes.Axes or None
    size : (width, height)
        Of the new figure in inches.

    Raises
    ------
    TypeError
        If `ax` is something else.
    """
    from matplotlib.axes import Axes

    # A figure without pyplot: nothing is left in its list of open figures, and no window is opened.
    if ax is None:
        figure = make_figure(*size)
        return figure, figure.subplots()
    if not isinstance(ax, Axes):
        raise TypeError(f"ax must be a matplotlib Axes; got {type(ax).__name__}.")
    return ax, ax


def collect_handles(axes: Iterable[Axes]) -> dict[str, Artist]:
    """Return the entries of one legend for several axes, by label: of equal labels the first.

    Parameters
    ----------
    axes : iterable of matplotlib.axes.Axes
    """
    handles: dict[str, Artist] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    return handles


def draw_legend_above(ax: Axes, *, title: str = "") -> None:
    """Draw the legend of an axes above it, with as many columns as it has room for.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    title : str, optional
    """
    from switchfit.report.notebook_figure import fit_legend

    if handles := collect_handles([ax]):
        look = fit_legend(list(handles), ax.bbox.width / ax.figure.dpi, 4, SMALL)
        look |= {"title_fontsize": look["fontsize"], "loc": "lower right", "bbox_to_anchor": (1.0, 1.0)}
        ax.legend(handles.values(), handles.keys(), title=title, borderaxespad=0.2, **look)


def draw_level(
    ax: Axes, text: str, y: float, side: Literal["left", "right"], *, colour: str = REFERENCE_COLOUR, line: str = "--"
) -> None:
    """Draw a horizontal line with its name above one of its ends.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    text : str
    y : float
    side : {"left", "right"}
    colour : str, optional
    line : str, optional
        Its style.
    """
    ax.axhline(y, color=colour, linestyle=line, linewidth=THIN)
    look: dict[str, Any] = {"ha": side, "va": "bottom", "fontsize": SMALL, "color": colour}
    ax.annotate(text, (0.01 if side == "left" else 0.995, y), xycoords=("axes fraction", "data"), **look)


def label_axis(ax: Axes, run: Timed, name: str = "time") -> None:
    """Label an axis of times; where they are dates, put its ticks at dates. What is drawn remains in numbers.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    run : Timed
    name : str, optional
    """
    ax.set_xlabel(label_time(run, name))
    if run.origin is not None:
        from switchfit.report.date_axis import DateFormatter, DateLocator

        # Ticks alone: positions on the axis stay numbers, so that what is drawn with it needs no dates.
        locator = DateLocator(run.origin, run.time_unit)
        ax.xaxis.set_major_locator(locator)
        ax.xaxis.set_major_formatter(DateFormatter(locator))


def label_unknown_axis(ax: Axes, name: str, unit: str, run: Timed | None) -> None:
    """Label a horizontal axis of values of an unknown, with ticks at dates if it is a time of a run with dates.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    name, unit : str
    run : Timed or None
    """
    if run is not None:
        return label_axis(ax, run, name)
    ax.set_xlabel(label_quantity(name, unit))
    return ax.ticklabel_format(axis="x", useOffset=False)


def assign_colours(names: Iterable[str], palette: Sequence[str]) -> dict[str, str]:
    """Return a colour for each name, in the order of first occurrence.

    Parameters
    ----------
    names : iterable of str
    palette : sequence of str
    """
    return {name: palette[k % len(palette)] for k, name in enumerate(dict.fromkeys(names))}


def turn_off_formulas(drawn: Drawn) -> Drawn:
    """Let names stand as they are: matplotlib takes what is between two dollar signs as a formula, or fails.

    Parameters
    ----------
    drawn : matplotlib.axes.Axes or matplotlib.figure.Figure
    """
    from matplotlib.text import Text

    for text in drawn.findobj(Text):
        # Labels that matplotlib writes itself, such as powers of ten, must stay formulas.
        if "$" in text.get_text() and "\\mathdefault" not in text.get_text():  # as in ticks of matplotlib's own
            text.set_parse_math(False)
    return drawn
