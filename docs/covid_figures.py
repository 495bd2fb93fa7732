"""The picture of the page on the epidemic, made by examples/covid when the documentation is built."""

from __future__ import annotations

import runpy
from pathlib import Path

import switchfit as sf

EXAMPLE = Path(__file__).parent.parent / "examples" / "covid" / "covid.py"


def draw(folder: Path) -> None:
    """Write covid.svg."""
    folder.mkdir(exist_ok=True)
    example = runpy.run_path(str(EXAMPLE))
    estimate = sf.estimate(example["make_problem"]())
    dates = {f"tau_{k}": estimate.profile(f"tau_{k}").interval() for k in (1, 2, 3)}
    example["plot"](estimate, dates).savefig(folder / "covid.svg")
