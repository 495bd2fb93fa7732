"""The picture of the ball that bounces, from the fit of examples/ball; drawn when the documentation is built."""

from __future__ import annotations

import runpy
from pathlib import Path

import switchfit as sf

EXAMPLE = Path(__file__).parent.parent / "examples" / "ball" / "ball.py"


def draw(folder: Path) -> None:
    """Write ball.svg."""
    folder.mkdir(exist_ok=True)
    example = runpy.run_path(str(EXAMPLE))
    estimate = sf.estimate(example["make_problem"]())
    example["plot"](estimate, sf.bootstrap(estimate, 200)).savefig(folder / "ball.svg")
