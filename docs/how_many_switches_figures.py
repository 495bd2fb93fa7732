"""The picture of the page on the number of switches: the search of examples/covid, when the documentation is built."""

from __future__ import annotations

from pathlib import Path

import switchfit as sf
from switchfit.io.problem_file.loading import load_problem

EXAMPLE = Path(__file__).parent.parent / "examples" / "covid" / "search.toml"


def draw(folder: Path) -> None:
    """Write number-of-changes.svg."""
    folder.mkdir(exist_ok=True)
    loaded = load_problem(EXAMPLE, searched=True)
    search = sf.find_modes(loaded.problem, max_switches=5, **loaded.library)
    search.plot().savefig(folder / "number-of-changes.svg")
