"""``switchfit compare``: models that were fitted to the same data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import switchfit as sf
from switchfit.cli import command, errors, files, options, terminal
from switchfit.cli.options import argument, output_folder

SavedPaths = Annotated[
    list[Path],
    argument("ESTIMATE.json", "Two or more, written by switchfit fit --out.", exists=True, dir_okay=False),
]

ComparisonFolder = Annotated[Path | None, output_folder("comparison.txt")]


@command.command("json", "quiet")
def compare(
    saved: SavedPaths,
    out: ComparisonFolder = None,
    folder: options.Folder = None,
) -> None:
    """Compare models that were fitted to the same data.

    Prints a row for each saved estimate, the best one first: unknowns, likelihood, AICc, BIC. Each is named by its
    file, or by its folder if the files are named alike.

    Exit code 0: all fits converged. 1: one did not, and its likelihood may be too small. 2: the input is wrong, such as
    fits to different data.
    """
    from switchfit.cli.saved_estimates import load_with_problem
    from switchfit.cli.summaries import summarize_comparison
    from switchfit.io.logs.files import name_files

    files.make_folder(out)
    # Usually all are called estimate.json: then the folders tell them apart.
    names = name_files(saved)
    estimates, changes = [], []
    for name, path in zip(names, saved, strict=True):
        estimate, changed = load_with_problem(path, folder)
        estimates.append(estimate)
        changes += [f"{name}: {change}" for change in changed]
    terminal.print_list("Changed since", changes)
    found = sf.compare(estimates, names=names)
    files.show(found, summarize_comparison(found) | {"changes": changes}, out, "comparison", "")
    failed = [name for name, estimate in zip(names, estimates, strict=True) if not estimate.status.successful]
    if failed:
        errors.end_unreliable(
            f"not converged: {', '.join(failed)}; fit these again, their likelihoods may be too small."
        )
