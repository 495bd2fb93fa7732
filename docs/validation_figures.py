"""The pictures of the page on validation, from the code on it, when the documentation is built."""

from __future__ import annotations

from pathlib import Path

from page_blocks import run_blocks


def draw(folder: Path) -> None:
    """Write forecast.svg and validation.svg."""
    folder.mkdir(exist_ok=True)
    names = run_blocks("validation.md")
    names["forecast_figure"].savefig(folder / "forecast.svg")
    names["check_figure"].savefig(folder / "validation.svg")
