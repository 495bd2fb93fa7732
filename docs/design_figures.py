"""The pictures of the page on experiment design, from the code on it and from examples/manoeuvre."""

from __future__ import annotations

import runpy
from pathlib import Path

from page_blocks import run_blocks

EXAMPLE = Path(__file__).parent.parent / "examples" / "manoeuvre" / "manoeuvre.py"


def draw(folder: Path) -> None:
    """Write design.svg and manoeuvre.svg."""
    folder.mkdir(exist_ok=True)
    names = run_blocks("design.md")
    names["sf"].design(names["problem"], samples=4).plot().savefig(folder / "design.svg")
    example = runpy.run_path(str(EXAMPLE))
    example["plot"](example["find"]()).savefig(folder / "manoeuvre.svg")
