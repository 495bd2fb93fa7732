"""Results in a notebook: their text, and a small figure below it."""

from __future__ import annotations

import base64
import io
from collections.abc import Sized
from html import escape
from typing import Literal

from switchfit.problem.problem import Problem
from switchfit.runtime.presentation import Displayed, Figure, format_html, format_text
from switchfit.uncertainty.prediction import Prediction

SMALL_FIGURE_DPI = 64
"""Dots per inch of the figures in a notebook."""

MOST_PANELS_IN_NOTEBOOK = 4
"""Experiments or outputs up to which a result shows its figure; with more of them it is no small one."""


@format_html.register(Problem)
@format_html.register(Prediction)
@format_html.register(Displayed)
def show_result(result: object) -> str:
    """Return the text of a result, and its figure if it has a small one.

    Parameters
    ----------
    result : object
    """
    is_forecast = isinstance(result, Prediction)
    # Panels that the figure would have.
    size = len(getattr(result, "output_names" if is_forecast else "trajectories", ()))
    is_empty = (is_forecast and not size) or (isinstance(result, Sized) and not len(result))
    image = ""
    if hasattr(result, "plot") and not is_empty and size <= MOST_PANELS_IN_NOTEBOOK:
        source = embed_figure(result.plot(), dpi=SMALL_FIGURE_DPI)
        image = f'<img alt="the figure of the result" style="background: white" src="{source}">'
    text = repr(result) if is_forecast else format_text(result)
    return f"<div><pre>{escape(text)}</pre>{image}</div>"


def embed_figure(figure: Figure, *, dpi: float | Literal["figure"] = "figure", transparent: bool = False) -> str:
    """Return a figure as the source of an image.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    dpi, transparent
        As of ``Figure.savefig``.
    """
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=dpi, transparent=transparent)
    return f"data:image/png;base64,{base64.b64encode(picture.getvalue()).decode()}"
