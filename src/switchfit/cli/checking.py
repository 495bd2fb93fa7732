"""``switchfit check``, ``simulate`` and ``design``: a problem without a fit."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from switchfit.cli import terminal
from switchfit.cli.terminal import option, output_folder

if TYPE_CHECKING:
    from switchfit.fit.trajectory import Trajectory


def check(
    problem: terminal.ProblemPath,
    no_run: Annotated[
        bool, typer.Option("--no-run", help="Read the problem file and its data; run no Python file that it names.")
    ] = False,
    full: Annotated[
        bool,
        typer.Option("--full", help="List all runs and unknowns, and compare with the paper's equations too: seconds."),
    ] = False,
    json: terminal.Json = False,
    quiet: terminal.Quiet = False,
    verbose: terminal.Verbose = False,
    debug: terminal.Debug = False,
) -> None:
    """Check a problem without fitting it.

    Shows the data, the unknowns and the steps of the integrator, whether the derivatives are right, and what the data
    determine at the first guess.

    Exit code 0: the derivatives are right. 1: they are not. 2: the input is wrong.
    """
    with terminal.report_errors(debug, json=json, quiet=quiet, verbose=verbose):
        if no_run:
            _check_files(problem, full)
            return
        from switchfit.io.problem_file import load_problem

        loaded = load_problem(problem)
        import switchfit as sf
        from switchfit.fit.evaluator import evaluator_of
        from switchfit.io.command_line import describe, describe_steps, summarize_check
        from switchfit.report.uncertainty import write_orders

        terminal.print_text(f"{describe(loaded.problem, full=full)}\n")
        terminal.print_list("Logs", loaded.issues)
        terminal.print_text(f"{describe_steps(loaded.problem, full=full)}\n")
        evaluator = evaluator_of(loaded.problem)
        if terminal.is_verbose():
            terminal.print_note(evaluator.engine)
        derivatives = sf.check_derivatives(loaded.problem, paper=full)
        short = f"Derivatives of J along a random direction\n  {write_orders(derivatives)}"
        terminal.print_text(f"{derivatives if full else short}\n")
        found = sf.identifiability(loaded.problem)
        terminal.print_text(found)
        terminal.print_json(
            summarize_check(evaluator, derivatives, found) | {"issues": [str(issue) for issue in loaded.issues]}
        )
        terminal.fail_for_refused(loaded.issues)
        if not derivatives.passed:
            raise typer.Exit(terminal.NOT_CONVERGED)


def _check_files(problem: Path, full: bool) -> None:
    """Print the parts of a problem that are known without running a Python file."""
    from switchfit.io.problem_file import read_experiments

    runs = read_experiments(problem)
    from switchfit.io.command_line import describe_experiments

    if runs.experiments:
        terminal.print_text(f"{describe_experiments(runs.experiments, full=full)}\n")
        terminal.print_list("Logs", runs.issues)
    terminal.print_text("No Python file was run: modes, states, functions and names of parameters are not checked.")
    names = [run.name for run in runs.experiments]
    terminal.print_json({"runs": names, "issues": [str(issue) for issue in runs.issues]})
    terminal.fail_for_refused(runs.issues)


OutputFile = Annotated[Path | None, option(metavar="FILE.csv", help="CSV file to write; required without --json.")]
Times = Annotated[
    str,
    option(
        metavar="STEP",
        help="A step, such as 0.1: a grid from t0 to tf; or 'samples': the times of the data. Default: the "
        "integrator's steps.",
    ),
]


def simulate(
    problem: terminal.ProblemPath,
    out: OutputFile = None,
    times: Times = "",
    json: terminal.Json = False,
    quiet: terminal.Quiet = False,
    debug: terminal.Debug = False,
) -> None:
    """Integrate the model at the first guess.

    Writes times, modes and states as CSV. The column of times is named t, or for example "t (min)" if the
    experiments' time_unit is "min" instead of "s". Where times are dates, a column "date" has them, in the time zone of
    the experiment.
    """
    if out is None and not json:
        terminal.fail("name the file to write with --out FILE.csv, or give --json to print the trajectories.")
    with terminal.report_errors(debug, json=json, quiet=quiet):
        from switchfit.io.problem_file import load_problem

        loaded = load_problem(problem)
        import switchfit as sf
        from switchfit.io.command_line import choose_times, tabulate_trajectory

        given = [choose_times(times, experiment) for experiment in loaded.problem.experiments]
        runs = [sf.simulate(loaded.problem, experiment=e, times=when) for e, when in enumerate(given)]
        names = loaded.problem.run_names
        terminal.print_json({"runs": [tabulate_trajectory(*named) for named in zip(names, runs, strict=True)]})
        if out is None:
            return
        table = _write_table(names, runs)
        terminal.make_folder(out.parent)
        terminal.write_file(out, table)


def _write_table(names: Sequence[str], runs: Sequence[Trajectory]) -> str:
    """Return trajectories as CSV: a row for each node or time, with the run, the mode and the states."""
    units = {run.time_unit for run in runs}
    if len(units) > 1:
        raise ValueError(
            f"the experiments have times in different units ({', '.join(sorted(units))}), and one column of the "
            "CSV file would mix them: give each its own problem file."
        )
    (unit,) = units
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\r\n")
    dated = any(run.origin is not None for run in runs)
    columns = ["t" if unit == "s" else f"t ({unit})", *(["date"] if dated else [])]
    table.writerow(["experiment", *columns, "mode", *runs[0].state_names])
    for name, run in zip(names, runs, strict=True):
        dates = [""] * len(run.times) if run.dates is None else [date.isoformat() for date in run.dates]
        for t, date, mode, x in zip(run.times.tolist(), dates, run.modes, run.states.tolist(), strict=True):
            table.writerow([name, t, *([date] if dated else []), mode, *x])
    return text.getvalue()


OutputFolder = Annotated[
    Path | None,
    output_folder("design.txt, design.json, design.png, and the designed input and sample times as CSV"),
]
Criterion = Annotated[
    Literal["D", "A", "E"] | None,
    option(
        help="What of the covariance is made small: D, its determinant, the default; A, its trace; E, its largest "
        "eigenvalue."
    ),
]
Samples = Annotated[int | None, option(metavar="COUNT", help="Most samples of each sensor. Default: all of the file.")]


def design(
    problem: terminal.ProblemPath,
    out: OutputFolder = None,
    criterion: Criterion = None,
    samples: Samples = None,
    figures: terminal.FigureFormat = "png",
    json: terminal.Json = False,
    quiet: terminal.Quiet = False,
    verbose: terminal.Verbose = False,
    debug: terminal.Debug = False,
) -> None:
    """Find the experiment that will determine unknowns best.

    Chooses inputs within limits, sample times and sensors of the last run of the file, at the first guess of the
    unknowns, and prints the standard errors to expect. [design] of the problem file says what is free; options override
    it. The values of the run's data are not used: a log with the possible times and zeros will do.

    Exit code 0: all unknowns that count can be estimated with the design. 1: some cannot. 2: the input is wrong.
    """
    with terminal.report_errors(debug, json=json, quiet=quiet, verbose=verbose):
        from switchfit.io.problem_file import load_problem

        loaded = load_problem(problem)
        import switchfit as sf
        from switchfit.io.command_line import summarize_design

        terminal.make_folder(out)
        terminal.print_list("Logs", [issue for issue in loaded.issues if issue.kind != "log: constant"])
        table = loaded.contents.design
        settings = {} if table is None else table.model_dump(exclude_none=True)
        settings |= terminal.select_given(criterion=criterion, samples=samples)
        plan = sf.design(loaded.problem, **settings)
        terminal.print_text(plan)
        terminal.print_json(summarize_design(plan) | {"out": out})
        if out is not None:
            _write(plan, out, figures)
        terminal.fail_for_refused(loaded.issues)
        if lost := [name for name in plan.names if name in plan.undetermined]:
            terminal.end_unreliable(f"{', '.join(lost)} cannot be estimated from such an experiment.")


def _write(plan: Any, folder: Path, figures: str) -> None:
    """Write table, design and figure, and the input and the samples as CSV."""
    from switchfit.io.result_tables import write_rows, zip_rows

    terminal.write_result(plan, folder / "design", figures, saved=True)
    knots = plan.problem.experiments[plan.experiment].inputs
    if knots is not None:
        terminal.write_file(folder / "input.csv", write_rows(zip_rows({"t": knots.times, **plan.inputs})))
    samples = [{"sensor": name, "t": time} for name, times in plan.sample_times.items() for time in times]
    terminal.write_file(folder / "samples.csv", write_rows(samples, ("sensor", "t")))
    terminal.print_note(f"written to {folder}")
