"""``switchfit design``: which experiment tells most?"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal

from switchfit.cli import terminal
from switchfit.cli.app import (
    Debug,
    FigureFormat,
    Json,
    ProblemPath,
    Quiet,
    Verbose,
    fail_for_refused,
    load,
    option,
    output_folder,
    print_list,
    write_figure,
)

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
Names = Annotated[str | None, option(metavar="A,B", help="Unknowns that count. Default: all.")]
Samples = Annotated[int | None, option(metavar="COUNT", help="Most samples of each sensor. Default: all of the file.")]
Sensors = Annotated[int | None, option(metavar="COUNT", help="Most sensors. Default: all of the file.")]
Starts = Annotated[int | None, option(metavar="COUNT", help="Inputs at random to begin from. Default: 8.")]
Seed = Annotated[int | None, option(metavar="NUMBER", help="Of these. Default: 0.")]


def design(
    problem: ProblemPath,
    out: OutputFolder = None,
    criterion: Criterion = None,
    names: Names = None,
    samples: Samples = None,
    sensors: Sensors = None,
    starts: Starts = None,
    seed: Seed = None,
    figures: FigureFormat = "png",
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Find the experiment that will determine unknowns best.

    Chooses inputs within limits, sample times and sensors of the last run of the file, at the first guess of the
    unknowns, and prints the standard errors to expect. [design] of the problem file says what is free; options override
    it. The values of the run's data are not used: a log with the possible times and zeros will do.

    Exit code 0: all unknowns that count can be estimated with the design. 1: some cannot. 2: the input is wrong.
    """
    with terminal.report_errors(debug, json=json, quiet=quiet, verbose=verbose):
        loaded = load(problem)
        import switchfit as sf
        from switchfit.io.result_json import summarize_design

        terminal.make_folder(out)
        print_list("Logs", [issue for issue in loaded.issues if issue.kind != "log: constant"])
        given: dict[str, Any] = {"criterion": criterion, "samples": samples, "sensors": sensors, "starts": starts}
        given |= {"seed": seed, "names": None if names is None else [name.strip() for name in names.split(",")]}
        table = loaded.contents.design
        settings = {} if table is None else table.model_dump(exclude_none=True)
        plan = sf.design(loaded.problem, **settings | {key: value for key, value in given.items() if value is not None})
        terminal.print_text(plan)
        terminal.print_json(summarize_design(plan) | {"out": out})
        if out is not None:
            _write(plan, out, figures)
        fail_for_refused(loaded.issues)
        if lost := [name for name in plan.names if name in plan.undetermined]:
            terminal.end_unreliable(f"{', '.join(lost)} cannot be estimated from such an experiment.")


def _write(plan: Any, folder: Path, figures: str) -> None:
    """Write table, design and figure, and the input and the samples as CSV."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    terminal.write_file(folder / "design.txt", f"{plan}\n")
    with terminal.explain_write_errors(folder / "design.json") as path:
        plan.save(path)
    write_figure(plan, folder / f"design.{figures}")
    knots = plan.problem.experiments[plan.experiment].inputs
    if knots is not None:
        rows = zip(knots.times, *plan.inputs.values(), strict=True)
        lines = [",".join(("t", *plan.inputs)), *(",".join(map(repr, map(float, row))) for row in rows)]
        terminal.write_file(folder / "input.csv", "\n".join(lines) + "\n")
    lines = ["sensor,t"] + [f'"{name}",{float(time)!r}' for name, times in plan.sample_times.items() for time in times]
    terminal.write_file(folder / "samples.csv", "\n".join(lines) + "\n")
    terminal.print_note(f"written to {folder}")
