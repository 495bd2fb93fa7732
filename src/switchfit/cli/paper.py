"""``switchfit paper``: the paper's experiments and figures."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from switchfit.cli import command, errors, files, terminal
from switchfit.cli.options import option

PaperFolder = Annotated[Path, typer.Option(metavar="DIR", help="Folder for figures, results.json and table.md.")]
Quick = Annotated[bool, typer.Option("--quick", help="Fewer repetitions: two minutes instead of fifteen.")]

Part = Annotated[
    str | None, option(metavar="NAME", help="One part: lti, magic-formula, convergence, noise, trials or horizon.")
]


@command.command()
def paper(out: PaperFolder = Path("paper"), quick: Quick = False, only: Part = None) -> None:
    """Reproduce the paper's experiments and figures.

    Every experiment and figure of Miller and Murphey, with its numbers beside ours. An interrupted run resumes when
    the same command is run again.
    """
    # Before anything imports matplotlib: a backend with windows fails on a machine without a display.
    os.environ.setdefault("MPLBACKEND", "Agg")
    from switchfit.paper.runner import TABLE_FILE as TABLE
    from switchfit.paper.runner import run

    files.make_folder(out)
    try:
        run(out, quick=quick, only=only, say=terminal.print_note)
    except KeyboardInterrupt:
        errors.fail("interrupted; run the same command again to resume.", errors.EXIT_INTERRUPTED)
    terminal.print_text((out / TABLE).read_text(encoding="utf-8"))
    terminal.print_note(f"written to {out}")
