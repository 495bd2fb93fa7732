"""``switchfit simulate``: the model at the first guess, as a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from switchfit.cli.app import Debug, Json, ProblemPath, Quiet, load, option
from switchfit.cli.terminal import fail, make_folder, print_json, report_errors, write_file

if TYPE_CHECKING:
    from switchfit.fit.trajectory import Trajectory


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
    problem: ProblemPath,
    out: OutputFile = None,
    times: Times = "",
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Integrate the model at the first guess.

    Writes times, modes and states as CSV. The column of times is named t, or for example "t (min)" if the
    experiments' time_unit is "min" instead of "s". Where times are dates, a column "date" has them, in the time zone of
    the experiment.
    """
    if out is None and not json:
        fail("name the file to write with --out FILE.csv, or give --json to print the trajectories.")
    with report_errors(debug, json=json, quiet=quiet):
        loaded = load(problem)
        import switchfit as sf
        from switchfit.io.grid import choose_times
        from switchfit.io.result_json import tabulate_trajectory

        given = [choose_times(times, experiment) for experiment in loaded.problem.experiments]
        runs = [sf.simulate(loaded.problem, experiment=e, times=when) for e, when in enumerate(given)]
        names = loaded.problem.run_names
        print_json({"runs": [tabulate_trajectory(*named) for named in zip(names, runs, strict=True)]})
        if out is None:
            return
        table = _write_table(names, runs)
        make_folder(out.parent)
        write_file(out, table)


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
