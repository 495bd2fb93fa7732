"""``switchfit simulate``: the model at the first guess, as a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import switchfit as sf
from switchfit.cli import command, files, options
from switchfit.cli.options import option
from switchfit.runtime.files import write_atomically

OutputFile = Annotated[Path, option("--out", metavar="FILE.csv", help="CSV file to write.")]

Times = Annotated[
    str,
    option(metavar="STEP", help="A step, such as 0.1, or 'samples': times of the data. Default: the integrator's."),
]


@command.command("quiet")
def simulate(problem: options.ProblemPath, out: OutputFile, times: Times = "") -> None:
    """Integrate the model at the first guess.

    Writes times, modes and states as CSV. The column of times is named t, or for example "t (min)" if the
    experiments' time_unit is "min" instead of "s". Where times are dates, a column "date" has them, in the time zone of
    the experiment.
    """
    loaded = files.load(problem)
    from switchfit.cli.trajectory_table import choose_times, write_trajectories

    # Checked for all experiments before the first one is integrated.
    given = [choose_times(times, experiment) for experiment in loaded.problem.experiments]
    runs = [sf.simulate(loaded.problem, experiment=e, times=when) for e, when in enumerate(given)]
    table = write_trajectories(loaded.problem.run_names, runs)
    files.make_folder(out.parent)
    write_atomically(table, out)
