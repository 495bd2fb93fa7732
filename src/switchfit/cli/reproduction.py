"""``switchfit rerun``, a saved fit once more, and ``switchfit paper``, the paper's experiments."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from switchfit.cli import terminal
from switchfit.cli.app import Debug, Folder, Json, Quiet, SavedPath, option, print_list


def rerun(
    saved: SavedPath,
    folder: Folder = None,
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Fit again what a saved estimate was made from, and compare the answers.

    The problem is the one that was saved with the estimate; data and models are read from where they were. What has
    changed since, by its hash or its version, is said first. Exit code 0: the answer is the same; 1: it is another one;
    2: it cannot be run again.
    """
    with terminal.report_errors(debug, json=json, quiet=quiet):
        from switchfit.io.saved_files import check_saved

        check_saved(saved)
        from switchfit.cli.fitting import estimate_problem
        from switchfit.io.rerun import compare_fits, prepare_rerun

        prepared = prepare_rerun(saved, folder)
        print_list("Changed since", prepared.changes)
        estimate = estimate_problem(prepared.loaded, prepared.loaded.options, prepare_figures=False)
        answers = compare_fits(prepared, estimate)
        terminal.print_text(answers.text)
        terminal.print_json({"same": answers.same, "changes": list(prepared.changes), "text": answers.text})
        if not answers.same:
            raise typer.Exit(terminal.NOT_CONVERGED)


PaperFolder = Annotated[Path, typer.Option(metavar="DIR", help="Folder for figures, results.json and table.md.")]
Quick = Annotated[bool, typer.Option("--quick", help="Fewer repetitions: two minutes instead of fifteen.")]
Part = Annotated[
    str | None,
    option(metavar="NAME", help="One part: lti, magic-formula, convergence, noise, trials or horizon."),
]


def paper(
    out: PaperFolder = Path("paper"),
    quick: Quick = False,
    only: Part = None,
    debug: Debug = False,
) -> None:
    """Reproduce the paper's experiments and figures.

    Every experiment and figure of Miller and Murphey, with its numbers beside ours. An interrupted run resumes when
    the same command is run again.
    """
    os.environ.setdefault("MPLBACKEND", "Agg")
    with terminal.report_errors(debug):
        from switchfit.paper import run
        from switchfit.paper.runner import TABLE
        from switchfit.runtime.errors import InputError

        terminal.make_folder(out)
        try:
            run(out, quick=quick, only=only, say=terminal.print_note)
        except KeyboardInterrupt:
            terminal.fail("interrupted; run the same command again to resume.", terminal.INTERRUPTED)
        except OSError as error:
            raise InputError(f"{out} cannot be written: {error.strerror}; name another with --out.") from error
        terminal.print_text((out / TABLE).read_text(encoding="utf-8"))
        terminal.print_note(f"written to {out}")
