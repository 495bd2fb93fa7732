"""The pictures of the page on uncertainty, made by examples/uncertainty.py's fit when the documentation is built."""

from __future__ import annotations

import runpy
from pathlib import Path

import switchfit as sf

EXAMPLE = Path(__file__).parent.parent / "examples" / "uncertainty.py"


def draw(folder: Path) -> None:
    """Write fit.svg and profile.svg."""
    folder.mkdir(exist_ok=True)
    estimate = sf.estimate(runpy.run_path(str(EXAMPLE))["problem"])
    estimate.plot().savefig(folder / "fit.svg")
    estimate.profile("tau_1").plot().savefig(folder / "profile.svg")
