"""The Figure that switchfit makes: a notebook shows it without pyplot."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

DOTS = 96
"""Dots per inch in a notebook."""


class NotebookFigure(Figure):
    """A matplotlib Figure that shows itself in a notebook, whether or not pyplot is imported."""

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=DOTS)
        return picture.getvalue()
