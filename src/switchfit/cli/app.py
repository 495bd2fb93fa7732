"""The command itself, the arguments that several commands take, and problem files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from switchfit.cli.terminal import BAD_INPUT, print_text

if TYPE_CHECKING:
    from switchfit.io.problem_file import ProblemFile
    from switchfit.runtime.issue import Issue

app = typer.Typer(
    name="switchfit",
    help="When did it switch, and what were the parameters? Fits switched models to measurements.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ProblemPath = Annotated[Path, typer.Argument(metavar="PROBLEM.toml", help="Problem file.", show_default=False)]
Debug = Annotated[bool, typer.Option("--debug", help="Show the full traceback of an error.")]


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print_text(f"switchfit {version('switchfit')}")
        raise typer.Exit


@app.callback()
def _collect_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


def load(problem: Path) -> ProblemFile:
    """Read a problem file."""
    from switchfit.io.problem_file import load_problem

    return load_problem(problem)


def print_issues(issues: Sequence[Issue]) -> None:
    """Print what is odd about logs."""
    if issues:
        print_text("\n".join(["Logs", *(f"  {issue}" for issue in issues), ""]))


def fail_for_refused(issues: Sequence[Issue]) -> None:
    """Name the logs that could not be used, and end with the exit code that says so."""
    refused = [issue for issue in issues if issue.kind == "log: refused"]
    for issue in refused:
        print_text(f"switchfit: {issue}", err=True)
    if refused:
        raise typer.Exit(BAD_INPUT)
