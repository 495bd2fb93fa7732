"""Shared by all parts: lines of the table, and the style of figures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from switchfit.runtime.presentation import Axes
from switchfit.runtime.presentation import Figure as Figure

Found = dict[str, Any]
Say = Callable[[str], None]

#: Width of a figure over one and over two columns (inches).
COLUMN, PAGE = 3.5, 7.16
#: Dark, middle and light, so that they differ in gray too; lines also differ in their dashes.
DARK, RED, BLUE, LIGHT = "#222222", "#b2182b", "#4a7fb5", "#b5b5b5"
SYMBOLS = {"tau_1": r"$\tau_1$", "tau_2": r"$\tau_2$", "mu": r"$\mu$"}


class Row(NamedTuple):
    """One line of the table of results."""

    claim: str
    paper: str
    ours: str
    remark: str = ""


class Part(Protocol):
    """A module that reproduces one part of the paper."""

    TITLE: str

    def compute(self, quick: bool, folder: Path, say: Say) -> Found:
        """Return the results, as they are written to JSON; long studies store finished runs in `folder`."""
        ...

    def draw(self, found: Found) -> dict[str, Figure]:
        """Return the figures by file name."""
        ...

    def rows(self, found: Found) -> list[Row]:
        """Return the lines of the table."""
        ...


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure with small type."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def tidy(ax: Axes, xlabel: str, ylabel: str, *, letter: str = "") -> Axes:
    """Set labels at a size for one column, a thin frame, and the letter of the panel."""
    ax.set_xlabel(xlabel, fontsize=8)
    ax.set_ylabel(ylabel, fontsize=8)
    ax.tick_params(labelsize=7)
    ax.spines[["top", "right"]].set_visible(False)
    if letter:
        ax.set_title(letter, loc="left", fontsize=8)
    return ax


def conditions(found: Found) -> str:
    """Return the second-order sufficient conditions of one fit, in words."""
    if not found["sufficient"]:
        return "not satisfied"
    return f"satisfied: ‖DJ‖ = {found['gradient_norm']:.0e}, smallest eigenvalue {found['smallest_eigenvalue']:.3g}"
