"""The figures of the page on the paper, from docs/measured/paper.json; the documentation draws them when built."""

from __future__ import annotations

import json
from pathlib import Path

from switchfit.paper.parts import PARTS

HERE = Path(__file__).parent


def draw(folder: Path) -> None:
    """Write every figure as SVG."""
    results = json.loads((HERE / "measured" / "paper.json").read_text(encoding="utf-8"))
    folder.mkdir(exist_ok=True)
    for name, entry in results.items():
        for title, figure in PARTS[name].draw(entry["found"]).items():
            figure.savefig(folder / f"{title}.svg")
