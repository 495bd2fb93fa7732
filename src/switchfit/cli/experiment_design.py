"""``switchfit design``: the experiment that will determine unknowns best."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import switchfit as sf
from switchfit.cli import command, errors, files, options, terminal
from switchfit.cli.options import option, output_folder
from switchfit.runtime.files import write_atomically

if TYPE_CHECKING:
    from switchfit.experiment_design.result import Design

DesignFolder = Annotated[
    Path | None, output_folder("design.txt, design.json, design.png, and the designed input and sample times as CSV")
]

Criterion = Annotated[
    Literal["D", "A", "E"] | None,
    option(help="What is made small of the covariance: D, the determinant; A, the trace; E, the largest eigenvalue."),
]

Samples = Annotated[int | None, option(metavar="COUNT", help="Most samples of each sensor. Default: all of the file.")]


@command.command("json", "quiet", "verbose")
def design(
    problem: options.ProblemPath,
    out: DesignFolder = None,
    criterion: Criterion = None,
    samples: Samples = None,
    figures: options.FigureFormat = "png",
) -> None:
    """Find the experiment that will determine unknowns best.

    Chooses inputs within limits, sample times and sensors of the last run of the file, at the first guess of the
    unknowns, and prints the standard errors to expect. [design] of the problem file says what is free; options override
    it. The values of the run's data are not used: a log with the possible times and zeros will do.

    Exit code 0: all unknowns that count can be estimated with the design. 1: some cannot. 2: the input is wrong.
    """
    loaded = files.load(problem, out)
    from switchfit.cli.summaries import summarize_design

    # A log of zeros is constant on purpose: only its times are used.
    terminal.print_list("Logs", [issue for issue in loaded.issues if issue.kind != "log: constant"])
    table = loaded.contents.design
    settings = {} if table is None else table.model_dump(exclude_none=True)
    # What is asked for on the command line wins over [design] of the file.
    settings |= options.select_given(criterion=criterion, samples=samples)
    plan = sf.design(loaded.problem, **settings)
    files.show(plan, summarize_design(plan), out, "design", figures, saved=True)
    if out is not None:
        _write_plan(plan, out)
    errors.fail_for_refused(loaded.issues)
    # Unknowns that do not count, for which names leaves them out, may stay undetermined.
    if lost := [name for name in plan.names if name in plan.undetermined]:
        errors.end_unreliable(f"{', '.join(lost)} cannot be estimated from such an experiment.")


def _write_plan(plan: Design, folder: Path) -> None:
    """Write the input and the samples of a design as CSV."""
    from switchfit.cli.tables import write_rows, zip_rows

    knots = plan.problem.experiments[plan.experiment].inputs
    if knots is not None:
        write_atomically(write_rows(zip_rows({"t": knots.times, **plan.inputs})), folder / "input.csv")
    samples = [{"sensor": name, "t": time} for name, times in plan.sample_times.items() for time in times]
    write_atomically(write_rows(samples, ("sensor", "t")), folder / "samples.csv")
