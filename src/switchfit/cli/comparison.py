"""``switchfit validate``, a fit on another run, ``switchfit compare``, several fits to the same data, and
``switchfit paper``, the paper's experiments.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from switchfit.cli import terminal
from switchfit.cli.terminal import argument, option, output_folder

OtherRun = Annotated[Path, argument("LOG|PROBLEM.toml", "A log like the one that was fitted, or a problem file.")]
ValidationFolder = Annotated[Path | None, output_folder("validation.txt and validation.png")]
SavedPaths = Annotated[
    list[Path],
    argument("ESTIMATE.json", "Two or more, written by switchfit fit --out.", exists=True, dir_okay=False),
]
ComparisonFolder = Annotated[Path | None, output_folder("comparison.txt and comparison.png")]


def validate(
    saved: terminal.SavedPath,
    other: OtherRun,
    out: ValidationFolder = None,
    folder: terminal.Folder = None,
    figures: terminal.FigureFormat = "png",
    json: terminal.Json = False,
    quiet: terminal.Quiet = False,
    debug: terminal.Debug = False,
) -> None:
    """Check whether the parameters of a fit hold for another run.

    The parameters are those of the saved estimate. Only what is the other run's own is estimated from it: transition
    times, unknown initial states. A log is read as the one that was fitted: the same columns, modes and first guesses.
    If these differ, name a problem file for the other run; its parameters get the values of the fit.

    Exit code 0: the verdict is good or doubtful. 1: it is bad. 2: the input is wrong.
    """
    with terminal.report_errors(debug, json=json, quiet=quiet):
        from switchfit.estimation.estimator import Estimate
        from switchfit.io.command_line import summarize_validation
        from switchfit.io.saved_problem import list_changed_models, load_other_run

        estimate = Estimate.load(saved)
        given = estimate.provenance
        loaded = load_other_run(saved, given, other, folder)
        terminal.make_folder(out)
        changes = [] if given is None else list_changed_models(given, loaded)
        terminal.print_list("Changed since", changes)
        terminal.print_list("Logs", loaded.issues)
        found = estimate.validate(loaded.problem)
        _show(found, summarize_validation(found) | {"changes": changes, "out": out}, out, "validation", figures)
        terminal.fail_for_refused(loaded.issues)
        if found.verdict.level == "bad":
            terminal.end_unreliable("the parameters do not hold for this run; the first line of the result says why.")


def compare(
    saved: SavedPaths,
    out: ComparisonFolder = None,
    folder: terminal.Folder = None,
    figures: terminal.FigureFormat = "png",
    json: terminal.Json = False,
    quiet: terminal.Quiet = False,
    debug: terminal.Debug = False,
) -> None:
    """Compare models that were fitted to the same data.

    Prints a row for each saved estimate, the best one first: unknowns, likelihood, AICc, BIC. Each is named by its
    file, or by its folder if the files are named alike.

    Exit code 0: all fits converged. 1: one did not, and its likelihood may be too small. 2: the input is wrong, such as
    fits to different data.
    """
    with terminal.report_errors(debug, json=json, quiet=quiet):
        import switchfit as sf
        from switchfit.io.command_line import summarize_comparison
        from switchfit.io.logs import name_files
        from switchfit.io.saved_problem import load_with_problem

        terminal.make_folder(out)
        names = name_files(saved)
        estimates, changes = [], []
        for name, path in zip(names, saved, strict=True):
            estimate, changed = load_with_problem(path, folder)
            estimates.append(estimate)
            changes += [f"{name}: {change}" for change in changed]
        terminal.print_list("Changed since", changes)
        found = sf.compare(estimates, names=names)
        _show(found, summarize_comparison(found) | {"changes": changes, "out": out}, out, "comparison", figures)
        failed = [name for name, estimate in zip(names, estimates, strict=True) if not estimate.status.successful]
        if failed:
            terminal.end_unreliable(
                f"not converged: {', '.join(failed)}; fit these again, their likelihoods may be too small."
            )


def _show(found: Any, summary: dict[str, Any], folder: Path | None, name: str, figures: str) -> None:
    """Print a result, and write its text and its figure into a folder."""
    terminal.print_text(found)
    if folder is not None:
        terminal.write_result(found, folder / name, figures)
    terminal.print_json(summary)


PaperFolder = Annotated[Path, typer.Option(metavar="DIR", help="Folder for figures, results.json and table.md.")]
Quick = Annotated[bool, typer.Option("--quick", help="Fewer repetitions: two minutes instead of fifteen.")]
Part = Annotated[
    str | None, option(metavar="NAME", help="One part: lti, magic-formula, convergence, noise, trials or horizon.")
]


def paper(
    out: PaperFolder = Path("paper"),
    quick: Quick = False,
    only: Part = None,
    debug: terminal.Debug = False,
) -> None:
    """Reproduce the paper's experiments and figures.

    Every experiment and figure of Miller and Murphey, with its numbers beside ours. An interrupted run leaves the
    parts that are done; --only runs another one.
    """
    os.environ.setdefault("MPLBACKEND", "Agg")
    with terminal.report_errors(debug):
        from switchfit.paper import TABLE, run

        terminal.make_folder(out)
        try:
            run(out, quick=quick, only=only, say=terminal.print_note)
        except KeyboardInterrupt:
            terminal.fail("interrupted; run the parts that are missing by --only.", terminal.INTERRUPTED)
        terminal.print_text((out / TABLE).read_text(encoding="utf-8"))
        terminal.print_note(f"written to {out}")
