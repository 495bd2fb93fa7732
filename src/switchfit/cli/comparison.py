"""``switchfit validate``, a fit on another run, and ``switchfit compare``, several fits to the same data."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

from switchfit.cli import terminal
from switchfit.cli.app import (
    Debug,
    FigureFormat,
    Folder,
    Json,
    Quiet,
    SavedPath,
    argument,
    fail_for_refused,
    output_folder,
    print_list,
    write_figure,
)

OtherRun = Annotated[
    Path,
    argument("LOG|PROBLEM.toml", "The other run: a log like the one that was fitted, or a problem file."),
]
ValidationFolder = Annotated[Path | None, output_folder("validation.txt and validation.png")]
SavedPaths = Annotated[list[Path], argument("ESTIMATE.json", "Two or more, written by switchfit fit --out.")]
ComparisonFolder = Annotated[Path | None, output_folder("comparison.txt and comparison.png")]


def validate(
    saved: SavedPath,
    other: OtherRun,
    out: ValidationFolder = None,
    folder: Folder = None,
    figures: FigureFormat = "png",
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Check whether the parameters of a fit hold for another run.

    The parameters are those of the saved estimate. Only what is the other run's own is estimated from it: transition
    times, unknown initial states. A log is read as the one that was fitted: the same columns, modes and first guesses.
    If these differ, name a problem file for the other run; its parameters get the values of the fit.

    Exit code 0: the verdict is good or doubtful. 1: it is bad. 2: the input is wrong.
    """
    with terminal.report_errors(debug, json=json, quiet=quiet):
        from switchfit.io.saved_files import check_saved

        check_saved(saved)
        from switchfit.estimation.estimator import Estimate
        from switchfit.io.rerun import list_changed_files
        from switchfit.io.result_json import summarize_validation
        from switchfit.io.saved_fits import load_other_run

        estimate = Estimate.load(saved)
        given = estimate.provenance
        loaded = load_other_run(saved, given, other, folder)
        terminal.make_folder(out)
        changes = [] if given is None else list_changed_files(given, loaded, models_only=True)
        print_list("Changed since", changes)
        print_list("Logs", loaded.issues)
        found = estimate.validate(loaded.problem)
        _show(found, summarize_validation(found) | {"changes": changes, "out": out}, out, "validation", figures)
        fail_for_refused(loaded.issues)
        if found.verdict.level == "bad":
            terminal.end_unreliable("the parameters do not hold for this run; the first line of the result says why.")


def compare(
    saved: SavedPaths,
    out: ComparisonFolder = None,
    folder: Folder = None,
    figures: FigureFormat = "png",
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Compare models that were fitted to the same data.

    Prints a row for each saved estimate, the best one first: unknowns, likelihood, AICc, BIC. Each is named by its
    file, or by its folder if the files are named alike.

    Exit code 0: all fits converged. 1: one did not, and its likelihood may be too small. 2: the input is wrong, such as
    fits to different data.
    """
    if len(saved) < 2:
        terminal.fail("name two saved estimates or more: switchfit compare A/estimate.json B/estimate.json.")
    with terminal.report_errors(debug, json=json, quiet=quiet):
        from switchfit.io.saved_files import check_saved

        for path in saved:
            check_saved(path)
        import switchfit as sf
        from switchfit.io.logs.files import name_files
        from switchfit.io.rerun import list_changed_files
        from switchfit.io.result_json import summarize_comparison
        from switchfit.io.saved_fits import load_with_problem

        terminal.make_folder(out)
        names = name_files(saved)
        estimates, changes = [], []
        for name, path in zip(names, saved, strict=True):
            estimate, loaded = load_with_problem(path, folder)
            estimates.append(estimate)
            if estimate.provenance is not None:
                changes += [f"{name}: {change}" for change in list_changed_files(estimate.provenance, loaded)]
        print_list("Changed since", changes)
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
        os.environ.setdefault("MPLBACKEND", "Agg")
        terminal.write_file(folder / f"{name}.txt", f"{found}\n")
        write_figure(found, folder / f"{name}.{figures}")
        terminal.print_note(f"written to {folder}")
    terminal.print_json(summary)
