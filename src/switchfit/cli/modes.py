"""``switchfit modes``: which modes were active, in which order, and when."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import switchfit as sf
from switchfit.cli import command, errors, files, interrupts, options, terminal
from switchfit.cli.options import option, output_folder
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import write_atomically

if TYPE_CHECKING:
    from switchfit.io.problem_file.building import ProblemFile
    from switchfit.modes.result import ModeSearch
    from switchfit.modes.search_run import SearchProgress

USABLE = {"FOUND", "UNIDENTIFIED", "AMBIGUOUS", "AT_LIMIT"}
"""Statuses of a search whose best sequence explains the data."""

ModesFolder = Annotated[
    Path | None, output_folder("modes.txt, modes.json, modes.png and best.toml, which switchfit fit reads")
]

MaxSwitches = Annotated[int, option(metavar="COUNT", help="Most switches of a run. Default: 8.")]

Criterion = Annotated[
    Literal["bic", "mbic", "aicc"], option(help="Price of a switch. bic, the default: log n; mbic: twice as much.")
]

Method = Annotated[
    Literal["auto", "beam", "insertion"],
    option(help="What proposes sequences. Default: auto, the beam for data if the model has machine code."),
]


@command.command("json", "quiet", "verbose")
def modes(
    problem: options.ProblemPath,
    out: ModesFolder = None,
    max_switches: MaxSwitches = 8,
    criterion: Criterion = "bic",
    method: Method = "auto",
    figures: options.FigureFormat = "png",
) -> None:
    """Find which modes were active, in which order, and when.

    Fits mode sequences of the model to the data, and prints the best with a table by number of switches. The [library]
    of the problem file says which sequences there may be. Ctrl-C ends the search after the current fit and keeps the
    best so far.

    Exit code 0: found, or ambiguous, or with as many switches as were allowed. 1: no sequence explains the data, the
    fit did not converge, or the search was interrupted; the best so far is still written. 2: the input is wrong.
    """
    settings: dict[str, Any] = {"max_switches": max_switches, "method": method, "criterion": criterion}
    loaded = files.load(problem, out, searched=True)
    from switchfit.cli.summaries import summarize_modes

    terminal.print_list("Logs", loaded.issues)
    search = _search(loaded, loaded.library | settings)
    # Before the text is printed, which names the file.
    best = None if out is None else _write_best(search, loaded, out)
    summary, drawn = summarize_modes(search) | {"problem_file": best}, figures if search.chosen else ""
    files.show(search, summary, out, "modes", drawn, saved=True)
    errors.fail_for_refused(loaded.issues)
    # The library admits no sequence: a mistake in the input, not a result.
    if search.status.name == "NO_SUCCESSION":
        errors.fail(search.message)
    if search.status.name not in USABLE:
        errors.end_unreliable("no mode sequence to rely on; the first line of the result says why, and what to do.")


def _search(loaded: ProblemFile, settings: dict[str, Any]) -> ModeSearch:
    """Call `switchfit.find_modes`, which shows a line on a terminal; Ctrl-C ends the search after the current fit."""

    def describe(progress: SearchProgress) -> str:
        best = " | ".join(" -> ".join(sequence) for sequence in progress.sequences) or "none"
        return f"{progress.stage}: {progress.fits} fits, J = {progress.cost:.6g}, {best}"

    with interrupts.stop_on_interrupt(describe, "fit") as report:
        return sf.find_modes(loaded.problem, callback=report, **settings)


def _write_best(search: ModeSearch, loaded: ProblemFile, folder: Path) -> Path | None:
    """Write the best mode sequence as a problem file; return its path, None if there is none."""
    from switchfit.cli.fitted_problem import write_fitted_problem

    if search.best is None:
        return None
    try:
        text = write_fitted_problem(loaded, search.best, folder)
    # A problem that is built in Python has no file that could be changed: the search itself is complete.
    except InputError as error:
        terminal.print_note(f"no best.toml: {error}")
        return None
    write_atomically(text, folder / "best.toml")
    return folder / "best.toml"
