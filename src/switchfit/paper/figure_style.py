"""Style of the paper's figures: sizes, colours, symbols and axes."""

from __future__ import annotations

from switchfit.runtime.presentation import Axes
from switchfit.runtime.presentation import Figure as Figure

#: Width of a figure over one and over two columns (inches).
COLUMN, PAGE = 3.5, 7.16

#: Dark, middle and light, so that they differ in gray too; lines also differ in their dashes.
DARK, RED, BLUE, LIGHT = "#222222", "#b2182b", "#4a7fb5", "#b5b5b5"

SYMBOLS = {"tau_1": r"$\tau_1$", "tau_2": r"$\tau_2$", "mu": r"$\mu$"}


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure with small type."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def tidy(ax: Axes, xlabel: str, ylabel: str, *, letter: str = "") -> None:
    """Set labels at a size for one column, a thin frame, and the letter of the panel."""
    ax.set_xlabel(xlabel, fontsize=8)
    ax.set_ylabel(ylabel, fontsize=8)
    ax.tick_params(labelsize=7)
    ax.spines[["top", "right"]].set_visible(False)
    if letter:
        ax.set_title(letter, loc="left", fontsize=8)
