"""The pictures of the page on online estimation, made by its examples when the documentation is built."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import switchfit as sf

EXAMPLES = Path(__file__).parent.parent / "examples"


def draw(folder: Path) -> None:
    """Write online.svg and online-terrain.svg."""
    folder.mkdir(exist_ok=True)
    vehicle = runpy.run_path(str(EXAMPLES / "online" / "online.py"))
    sf.replay(vehicle["simulate"](0)).plot().savefig(folder / "online.svg")
    sys.path.insert(0, str(EXAMPLES / "terrain"))
    surfaces = runpy.run_path(str(EXAMPLES / "terrain" / "online.py"))
    sys.path.pop(0)
    surfaces["follow"]("green_table_24", 50.0).plot().savefig(folder / "online-terrain.svg")
