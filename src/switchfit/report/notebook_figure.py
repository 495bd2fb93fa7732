"""The matplotlib Figure that switchfit makes: a notebook shows it without pyplot, and its legend fits its width.

Import this only where matplotlib is needed.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

from matplotlib import rcParams
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.legend import Legend

NOTEBOOK_FIGURE_DPI = 96
"""Dots per inch in a notebook."""

LETTER, HANDLE = 0.55, 4.8
"""Widths of a letter, and of what is beside the text of an entry, in sizes of the font."""


def fit_legend(labels: list[str], inches: float, most: int, fontsize: str | float) -> dict[str, Any]:
    """Return settings of a legend with as many columns of its widest entry as a width has room for.

    Parameters
    ----------
    labels : list of str
    inches : float
        The width.
    most : int
        Largest number of columns.
    fontsize : str or float
    """
    size = FontProperties(size=fontsize).get_size_in_points()
    # An estimate: the exact width is known only after drawing.
    widest = size * (HANDLE + LETTER * max(map(len, labels), default=0))
    return {"fontsize": size, "ncols": min(most, max(int(72 * inches / widest), 1)), "frameon": False}


class NotebookFigure(Figure):
    """A matplotlib Figure that shows itself in a notebook, whether or not pyplot is imported."""

    legend_drawn: Legend | None = None
    legend_settings: Mapping[str, Any]

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=NOTEBOOK_FIGURE_DPI)
        return picture.getvalue()

    def draw_legend(self, handles: Mapping[str, Artist], *, most: int = 4, **settings: Any) -> None:
        """Draw the legend of all axes, with as many columns as the width has room for, also after it changes.

        Parameters
        ----------
        handles : mapping of label to handle
        most : int, optional
            Largest number of columns.
        settings
            Others of ``Figure.legend``.
        """
        # matplotlib cannot wrap the columns of a legend by itself: too many of them run out of the figure.
        look = fit_legend(list(handles), self.get_figwidth(), most, rcParams["legend.fontsize"])
        self.legend_settings = {"handles": handles, "most": most, **settings}
        self.legend_drawn = self.legend(list(handles.values()), list(handles), **look, **settings)

    def set_size_inches(self, w: float | tuple[float, float], h: float | None = None, forward: bool = True) -> None:
        """Set the size in inches, and draw the legend in the columns that it has room for."""
        super().set_size_inches(w, h, forward)
        if self.legend_drawn is not None and self.legend_drawn in self.legends:
            # Its entries and settings are remembered, since a legend does not tell all of them.
            self.legend_drawn.remove()
            self.draw_legend(**self.legend_settings)
