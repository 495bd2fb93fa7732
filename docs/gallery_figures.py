"""The figure of the room in the gallery of the landing page; the other figures there are those of their pages."""

from __future__ import annotations

import runpy
from pathlib import Path

import switchfit as sf

EXAMPLE = Path(__file__).parent.parent / "examples" / "own_model.py"


def draw(folder: Path) -> None:
    """Write room.svg."""
    folder.mkdir(exist_ok=True)
    sf.estimate(runpy.run_path(str(EXAMPLE))["problem"]).plot().savefig(folder / "room.svg")
