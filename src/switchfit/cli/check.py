"""``switchfit check``: a problem without a fit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import switchfit as sf
from switchfit.cli import command, errors, files, options, terminal


@command.command("json", "quiet", "verbose")
def check(
    problem: options.ProblemPath,
    no_run: Annotated[
        bool, typer.Option("--no-run", help="Read the problem file and its data; run no Python file that it names.")
    ] = False,
    full: Annotated[
        bool,
        typer.Option("--full", help="List all runs and unknowns, and compare with the paper's equations too: seconds."),
    ] = False,
) -> None:
    """Check a problem without fitting it.

    Shows the data, the unknowns and the steps of the integrator, whether the derivatives are right, and what the data
    determine at the first guess.

    Exit code 0: the derivatives are right. 1: they are not. 2: the input is wrong.
    """
    if no_run:
        _check_files(problem, full)
        return
    loaded = files.load(problem)
    from switchfit.cli.summaries import summarize_check
    from switchfit.meshes.evaluator import evaluator_of
    from switchfit.report.certificate import write_orders
    from switchfit.report.problem import write_problem, write_steps

    terminal.print_text(f"{write_problem(loaded.problem, full=full)}\n")
    terminal.print_list("Logs", loaded.issues)
    # Building the evaluator makes the mesh and compiles: from here on the model has run.
    evaluator = evaluator_of(loaded.problem)
    terminal.print_text(f"{write_steps(evaluator, full=full)}\n")
    if terminal.is_asked("verbose"):
        terminal.print_note(evaluator.engine)
    # The paper's equations take seconds, the Taylor remainders of J a moment.
    derivatives = sf.check_derivatives(loaded.problem, paper=full)
    short = f"Derivatives of J along a random direction\n  {write_orders(derivatives)}"
    terminal.print_text(f"{derivatives if full else short}\n")
    found = sf.identifiability(loaded.problem)
    terminal.print_text(found)
    terminal.print_json(
        summarize_check(evaluator, derivatives, found) | {"issues": [str(issue) for issue in loaded.issues]}
    )
    errors.fail_for_refused(loaded.issues)
    if not derivatives.passed:
        raise typer.Exit(errors.EXIT_NOT_CONVERGED)


def _check_files(problem: Path, full: bool) -> None:
    """Print the parts of a problem that are known without running a Python file."""
    from switchfit.io.problem_file.loading import read_experiments

    # The same steps as of a whole problem, up to the model: logs are read and cut, units and horizons are known.
    runs = read_experiments(problem)
    from switchfit.report.problem import write_experiments

    if runs.experiments:
        terminal.print_text(f"{write_experiments(runs.experiments, full=full)}\n")
        terminal.print_list("Logs", runs.issues)
    terminal.print_text("No Python file was run: modes, states, functions and names of parameters are not checked.")
    names = [run.name for run in runs.experiments]
    terminal.print_json({"runs": names, "issues": [str(issue) for issue in runs.issues]})
    errors.fail_for_refused(runs.issues)
