"""The Figure that switchfit makes: a notebook shows it without pyplot, and its legend has room in any width."""

from __future__ import annotations

import io
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

from matplotlib import rcParams
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.legend import Legend

DOTS = 96
"""Dots per inch in a notebook."""
LETTER, HANDLE = 0.55, 4.8
"""Widths of a letter, and of what is beside the text of an entry, in sizes of the font."""


def count_columns(labels: list[str], width: float, most: int) -> int:
    """Return how many columns of a legend a width has room for.

    Parameters
    ----------
    labels : list of str
    width : float
        In sizes of the font.
    most : int
    """
    columns = min(most, max(len(labels), 1))
    while columns > 1 and _measure_legend(labels, columns) > width:
        columns -= 1
    return columns


def _measure_legend(labels: list[str], columns: int) -> float:
    """Return the width of a legend in sizes of its font; matplotlib fills it column by column."""
    rows, longer = divmod(len(labels), columns)
    ends = [k * rows + min(k, longer) for k in range(columns + 1)]
    parts = [labels[begin:end] for begin, end in pairwise(ends)]
    return sum(HANDLE + LETTER * max(map(len, part), default=0) for part in parts)


class NotebookFigure(Figure):
    """A matplotlib Figure that shows itself in a notebook, whether or not pyplot is imported."""

    legend_drawn: Legend | None = None
    legend_settings: Mapping[str, Any]

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=DOTS)
        return picture.getvalue()

    def draw_legend(self, handles: Mapping[str, Any], *, most: int = 4, **settings: Any) -> Legend:
        """Draw the legend of all axes, with as many columns as the width has room for, also after it changes.

        Parameters
        ----------
        handles : mapping of label to handle
        most : int, optional
            Largest number of columns.
        settings
            Others of ``Figure.legend``.
        """
        # In points, so that it stays the same where the size is changed outside of a context with other fonts.
        size = FontProperties(size=settings.get("fontsize", rcParams["legend.fontsize"])).get_size_in_points()
        settings["fontsize"] = size
        self.legend_settings = {"handles": handles, "most": most, **settings}
        columns = count_columns(list(handles), 72 * self.get_figwidth() / size, most)
        legend = self.legend(list(handles.values()), list(handles), frameon=False, ncols=columns, **settings)
        self.legend_drawn = legend
        return legend

    def set_size_inches(self, w: Any, h: float | None = None, forward: bool = True) -> None:
        """Set the size in inches, and draw the legend in the columns that it has room for."""
        super().set_size_inches(w, h, forward)
        before = self.legend_drawn
        if before is not None and before in self.legends:
            before.remove()
            self.draw_legend(**self.legend_settings).get_title().set_color(before.get_title().get_color())
