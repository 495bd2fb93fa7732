"""``switchfit check``: a problem without a fit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from switchfit.cli.app import Debug, Json, ProblemPath, Quiet, Verbose, fail_for_refused, load, print_list
from switchfit.cli.terminal import NOT_CONVERGED, is_verbose, print_json, print_note, print_text, report_errors


def check(
    problem: ProblemPath,
    no_run: Annotated[
        bool, typer.Option("--no-run", help="Read the problem file and its data; run no Python file that it names.")
    ] = False,
    full: Annotated[
        bool,
        typer.Option("--full", help="List all runs and unknowns, and compare with the paper's equations too: seconds."),
    ] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Check a problem without fitting it.

    Shows the data, the unknowns and the steps of the integrator, whether the derivatives are right, and what the data
    determine at the first guess.

    Exit code 0: the derivatives are right. 1: they are not. 2: the input is wrong.
    """
    with report_errors(debug, json=json, quiet=quiet, verbose=verbose):
        if no_run:
            _check_files(problem, full)
            return
        loaded = load(problem)
        import switchfit as sf
        from switchfit.fit.evaluator import evaluator_of
        from switchfit.io.result_json import summarize_check
        from switchfit.io.summary import describe, describe_steps
        from switchfit.report.uncertainty import write_orders

        print_text(f"{describe(loaded.problem, full=full)}\n")
        print_list("Logs", loaded.issues)
        print_text(f"{describe_steps(loaded.problem, full=full)}\n")
        evaluator = evaluator_of(loaded.problem)
        if is_verbose():
            print_note(evaluator.engine)
        derivatives = sf.check_derivatives(loaded.problem, paper=full)
        short = f"Derivatives of J along a random direction\n  {write_orders(derivatives)}"
        print_text(f"{derivatives if full else short}\n")
        found = sf.identifiability(loaded.problem)
        print_text(found)
        print_json(summarize_check(evaluator, derivatives, found) | {"issues": [str(issue) for issue in loaded.issues]})
        fail_for_refused(loaded.issues)
        if not derivatives.passed:
            raise typer.Exit(NOT_CONVERGED)


def _check_files(problem: Path, full: bool) -> None:
    """Print the parts of a problem that are known without running a Python file."""
    from switchfit.io.problem_file import read_experiments

    runs = read_experiments(problem)
    from switchfit.io.summary import describe_experiments

    if runs.experiments:
        print_text(f"{describe_experiments(runs.experiments, full=full)}\n")
        print_list("Logs", runs.issues)
    print_text("No Python file was run: modes, states, functions and names of parameters are not checked.")
    names = [run.name for run in runs.experiments]
    print_json({"runs": names, "issues": [str(issue) for issue in runs.issues]})
    fail_for_refused(runs.issues)
