"""The pictures of the page on figures, from the code on it, when the documentation is built."""

from __future__ import annotations

import tempfile
from contextlib import chdir
from pathlib import Path

from page_blocks import run_blocks


def draw(folder: Path) -> None:
    """Write plots-NAME.svg for each NAME_figure of the page; what its blocks save goes elsewhere."""
    folder = folder.resolve()
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as elsewhere, chdir(elsewhere):
        names = run_blocks("figures.md")
    for name, figure in names.items():
        if name.endswith("_figure"):
            figure.savefig(folder / f"plots-{name.removesuffix('_figure')}.svg")
