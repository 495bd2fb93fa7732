"""``switchfit modes``: which modes were active, in which order, and how often did they switch?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from switchfit.cli import terminal
from switchfit.cli.terminal import option, output_folder

if TYPE_CHECKING:
    from switchfit.io.problem_file.building import ProblemFile

USABLE = {"FOUND", "UNIDENTIFIED", "AMBIGUOUS", "AT_LIMIT"}
"""Statuses of a search whose best sequence explains the data."""


OutputFolder = Annotated[
    Path | None, output_folder("modes.txt, modes.json, modes.png and best.toml, which switchfit fit reads")
]
MaxSwitches = Annotated[int, option(metavar="COUNT", help="Most switches of a run. Default: 8.")]
Criterion = Annotated[
    Literal["bic", "mbic", "aicc", "cost"],
    option(help="Price of a switch. bic, the default: log n; mbic: twice as much; cost: --switch-cost."),
]
SwitchCost = Annotated[
    float | None, option(metavar="NUMBER", help="Cost of a switch in units of J; by it, --criterion is cost.")
]
Method = Annotated[
    Literal["auto", "beam", "insertion"],
    option(help="What proposes sequences. Default: auto, the beam for data if the model has machine code."),
]
Width = Annotated[int, option(metavar="COUNT", help="Hypotheses that the beam keeps. Default: 40.")]


def modes(
    problem: terminal.ProblemPath,
    out: OutputFolder = None,
    max_switches: MaxSwitches = 8,
    criterion: Criterion = "bic",
    switch_cost: SwitchCost = None,
    method: Method = "auto",
    width: Width = 40,
    figures: terminal.FigureFormat = "png",
    json: terminal.Json = False,
    quiet: terminal.Quiet = False,
    verbose: terminal.Verbose = False,
    debug: terminal.Debug = False,
) -> None:
    """Find which modes were active, in which order, and when.

    Fits mode sequences of the model to the data, and prints the best with a table by number of switches. The [library]
    of the problem file says which sequences there may be. Ctrl-C ends the search after the current fit and keeps the
    best so far.

    Exit code 0: found, or ambiguous, or with as many switches as were allowed. 1: no sequence explains the data, the
    fit did not converge, or the search was interrupted; the best so far is still written. 2: the input is wrong.
    """
    with terminal.report_errors(debug, json=json, quiet=quiet, verbose=verbose):
        settings: dict[str, Any] = {"max_switches": max_switches, "method": method, "width": width}
        settings |= {"criterion": criterion, "switch_cost": switch_cost}
        from switchfit.io.problem_file import load_problem

        loaded = load_problem(problem, searched=True)
        from switchfit.io.command_line import summarize_modes

        terminal.make_folder(out)
        terminal.print_list("Logs", loaded.issues)
        search = _search(loaded, loaded.library | settings)
        terminal.print_text(search)
        best = None if out is None else _write(search, loaded, out, figures)
        terminal.print_json(summarize_modes(search) | {"out": out, "problem_file": best})
        terminal.fail_for_refused(loaded.issues)
        if search.status.name == "NO_SUCCESSION":
            terminal.fail(search.message)
        if search.status.name not in USABLE:
            terminal.end_unreliable(
                "no mode sequence to rely on; the first line of the result says why, and what to do."
            )


def _search(loaded: ProblemFile, settings: dict[str, Any]) -> Any:
    """Call `switchfit.find_modes`, which shows a line on a terminal; Ctrl-C ends the search after the current fit."""
    import switchfit as sf

    def describe(progress: Any) -> str:
        best = " | ".join(" -> ".join(sequence) for sequence in progress.sequences) or "none"
        return f"{progress.stage}: {progress.fits} fits, J = {progress.cost:.6g}, {best}"

    with terminal.stop_on_interrupt(describe, "fit") as report:
        return sf.find_modes(loaded.problem, callback=report, **settings)


def _write(search: Any, loaded: ProblemFile, folder: Path, figures: str) -> Path | None:
    """Write table, search, figure and the best as a problem file; return the path of that, None without it."""
    from switchfit.io.problem_file.fitted import write_fitted_problem
    from switchfit.runtime.errors import InputError

    terminal.write_result(search, folder / "modes", figures if search.chosen else "", saved=True)
    best = None
    if search.best is not None:
        try:
            text = write_fitted_problem(loaded, search.best, folder)
        except InputError as error:
            terminal.print_note(f"no best.toml: {error}")
        else:
            best = folder / "best.toml"
            terminal.write_file(best, text)
    return best
