"""The picture of the page on the Husky, made by examples/husky/husky.py when the documentation is built."""

from __future__ import annotations

import runpy
from pathlib import Path

import switchfit as sf

EXAMPLE = Path(__file__).parent.parent / "examples" / "husky" / "husky.py"


def draw(folder: Path) -> None:
    """Write husky.svg."""
    folder.mkdir(exist_ok=True)
    example = runpy.run_path(str(EXAMPLE))
    checks = []
    for settings in ({}, {"variant": "static", "late": 0.0}):
        fit = sf.estimate(example["make_problem"](**settings), strategy="local")
        checks.append(fit.validate(example["make_problem"](example["OTHER"], **settings)))
    example["plot"](*checks).savefig(folder / "husky.svg")
