"""The picture of the page on fishing, made by examples/fishing when the documentation is built."""

from __future__ import annotations

import runpy
from pathlib import Path

EXAMPLE = Path(__file__).parent.parent / "examples" / "fishing" / "fishing.py"


def draw(folder: Path) -> None:
    """Write fishing.svg."""
    folder.mkdir(exist_ok=True)
    example = runpy.run_path(str(EXAMPLE))
    example["plot"](example["find"](example["make_problem"]())).savefig(folder / "fishing.svg")
