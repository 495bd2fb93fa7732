"""The picture of the page on the heaters, made by examples/heaters/heaters.py when the documentation is built."""

from __future__ import annotations

import runpy
from pathlib import Path

import switchfit as sf

EXAMPLE = Path(__file__).parent.parent / "examples" / "heaters" / "heaters.py"


def draw(folder: Path) -> None:
    """Write heaters.svg."""
    folder.mkdir(exist_ok=True)
    example = runpy.run_path(str(EXAMPLE))
    fits = {model: sf.estimate(example["make_problem"](model)) for model in ("balance", "power")}
    example["plot"](fits, example["read"]()[2]).savefig(folder / "heaters.svg")
