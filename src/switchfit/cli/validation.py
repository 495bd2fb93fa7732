"""``switchfit validate``: a fit on another run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from switchfit.cli import command, errors, files, options, terminal
from switchfit.cli.options import argument, output_folder

OtherRun = Annotated[Path, argument("LOG|PROBLEM.toml", "A log like the one that was fitted, or a problem file.")]
ValidationFolder = Annotated[Path | None, output_folder("validation.txt and validation.png")]


@command.command("json", "quiet")
def validate(
    saved: options.SavedPath,
    other: OtherRun,
    out: ValidationFolder = None,
    folder: options.Folder = None,
    figures: options.FigureFormat = "png",
) -> None:
    """Check whether the parameters of a fit hold for another run.

    The parameters are those of the saved estimate. Only what is the other run's own is estimated from it: transition
    times, unknown initial states. A log is read as the one that was fitted: the same columns, modes and first guesses.
    If these differ, name a problem file for the other run; its parameters get the values of the fit.

    Exit code 0: the verdict is good or doubtful. 1: it is bad. 2: the input is wrong.
    """
    from switchfit.cli.saved_estimates import list_changed_models, load_other_run
    from switchfit.cli.summaries import summarize_validation
    from switchfit.estimation.estimates import Estimate

    estimate = Estimate.load(saved)
    # The saved estimate is data alone: its problem is built again only as far as the other run needs it.
    loaded = load_other_run(saved, estimate.provenance, other, folder)
    files.make_folder(out)
    changes = list_changed_models(estimate.provenance, loaded)
    terminal.print_list("Changed since", changes)
    terminal.print_list("Logs", loaded.issues)
    found = estimate.validate(loaded.problem)
    files.show(found, summarize_validation(found) | {"changes": changes}, out, "validation", figures)
    errors.fail_for_refused(loaded.issues)
    if found.verdict.level == "bad":
        errors.end_unreliable("the parameters do not hold for this run; the first line of the result says why.")
