"""``switchfit paper``: the paper's experiments."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from switchfit.cli.app import Debug
from switchfit.cli.terminal import INTERRUPTED, fail, make_folder, print_note, print_text, report_errors


def paper(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for figures, results.json and table.md.")] = Path(
        "paper"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer repetitions: two minutes instead of fifteen.")] = False,
    only: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="One part: lti, magic-formula, convergence, noise, trials or horizon.",
            show_default=False,
        ),
    ] = None,
    debug: Debug = False,
) -> None:
    """Reproduce the paper's experiments and figures.

    Every experiment and figure of Miller and Murphey, with its numbers beside ours. An interrupted run resumes when
    the same command is run again.
    """
    os.environ.setdefault("MPLBACKEND", "Agg")
    with report_errors(debug):
        from switchfit.paper import run
        from switchfit.paper.runner import TABLE
        from switchfit.runtime.errors import InputError

        make_folder(out)
        try:
            run(out, quick=quick, only=only, say=print_note)
        except KeyboardInterrupt:
            fail("interrupted; run the same command again to resume.", INTERRUPTED)
        except OSError as error:
            raise InputError(f"{out} cannot be written: {error.strerror}; name another with --out.") from error
        print_text((out / TABLE).read_text(encoding="utf-8"))
        print_note(f"written to {out}")
