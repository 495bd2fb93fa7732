"""The picture of the page on tosses, from a fit; the documentation draws it when it is built."""

from __future__ import annotations

import runpy
from pathlib import Path

import switchfit as sf

EXAMPLE = Path(__file__).parent.parent / "examples" / "toss" / "release.py"


def draw(folder: Path) -> None:
    """Write release.svg."""
    folder.mkdir(exist_ok=True)
    problem = runpy.run_path(str(EXAMPLE))["make_problem"]()
    sf.estimate(problem).plot().savefig(folder / "release.svg")
