"""``switchfit simulate``: the model at the first guess, as a table."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Annotated

import typer

from switchfit.cli.app import Debug, ProblemPath, load
from switchfit.cli.terminal import make_folder, report_errors, write_file


def simulate(
    problem: ProblemPath,
    out: Annotated[Path, typer.Option(metavar="FILE.csv", help="CSV file to write.", show_default=False)],
    debug: Debug = False,
) -> None:
    """Integrate the model at the first guess and write time, mode and states as CSV.

    The column of times is named t, or for example "t (min)" if the experiments' time_unit is "min" instead of "s".
    """
    with report_errors(debug):
        loaded = load(problem)
        import switchfit as sf

        runs = [sf.simulate(loaded.problem, experiment=e) for e in range(len(loaded.problem.experiments))]
        units = {run.time_unit for run in runs}
        if len(units) > 1:
            raise ValueError(
                f"the experiments have times in different units ({', '.join(sorted(units))}), and one column of the "
                "CSV file would mix them: give each its own problem file."
            )
        (unit,) = units
        make_folder(out.parent)

        text = io.StringIO()
        table = csv.writer(text, lineterminator="\r\n")
        table.writerow(["experiment", "t" if unit == "s" else f"t ({unit})", "mode", *runs[0].state_names])
        for k, run in enumerate(runs):
            name = loaded.problem.experiments[k].name or f"run{k + 1}"
            for t, mode, x in zip(run.times.tolist(), run.modes, run.states.tolist(), strict=True):
                table.writerow([name, t, mode, *x])
        write_file(out, text.getvalue())
