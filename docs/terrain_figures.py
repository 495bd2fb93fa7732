"""The picture of the page on two surfaces, made by examples/terrain when the documentation is built."""

from __future__ import annotations

import runpy
from pathlib import Path

EXAMPLE = Path(__file__).parent.parent / "examples" / "terrain" / "terrain.py"


def draw(folder: Path) -> None:
    """Write terrain.svg."""
    folder.mkdir(exist_ok=True)
    example = runpy.run_path(str(EXAMPLE))
    searches = {name: example["find"](name, max_switches=2) for name in (*example["GREEN"], *example["GRAY"])}
    example["plot"](searches).savefig(folder / "terrain.svg")
