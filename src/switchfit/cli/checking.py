"""``switchfit check``: a problem without a fit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from switchfit.cli.app import Debug, ProblemPath, fail_for_refused, load, print_issues
from switchfit.cli.terminal import NOT_CONVERGED, print_text, report_errors


def check(
    problem: ProblemPath,
    no_run: Annotated[
        bool, typer.Option("--no-run", help="Read the problem file and its data; run no Python file that it names.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Check a problem without fitting it: data, derivatives, identifiability at the first guess.

    Exit code 0: the derivatives are right; 1: they are not; 2: the input is wrong.
    """
    if no_run:
        with report_errors(debug):
            _check_files(problem)
        return
    with report_errors(debug):
        loaded = load(problem)
        import switchfit as sf
        from switchfit.io.summary import describe, describe_steps

        print_text(f"{describe(loaded.problem)}\n")
        print_issues(loaded.issues)
        print_text(f"{describe_steps(loaded.problem)}\n")
        derivatives = sf.check_derivatives(loaded.problem)
        print_text(f"{derivatives}\n")
        print_text(sf.identifiability(loaded.problem))
    fail_for_refused(loaded.issues)
    if not derivatives.passed:
        raise typer.Exit(NOT_CONVERGED)


def _check_files(problem: Path) -> None:
    """Print the parts of a problem that are known without running a Python file."""
    from switchfit.io.problem_file import read_experiments
    from switchfit.io.summary import describe_experiments

    runs = read_experiments(problem)
    if runs.experiments:
        print_text(f"{describe_experiments(runs.experiments)}\n")
        print_issues(runs.issues)
    print_text("No Python file was run: modes, states, functions and names of parameters are not checked.")
    fail_for_refused(runs.issues)
