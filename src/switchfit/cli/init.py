"""``switchfit init``: a problem to begin with."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from switchfit.cli import command, files, terminal
from switchfit.cli.options import argument, option

NewFolder = Annotated[str, argument("NAME", "Folder to create.")]

FirstLog = Annotated[
    Path | None, option("--from", metavar="LOG", help="Log to begin with, of any format. Default: an example.")
]


@command.command("quiet")
def init(name: NewFolder, log: FirstLog = None) -> None:
    """Create a problem to begin with, ready to fit.

    Writes a folder with a problem file, its model and data. With --from the time column and up to three channels of
    the log are chosen, with a first model that suits any log: each channel approaches a level, another one from an
    estimated time on. Comments say what to change. A log of more than 20 MB is not copied. Nothing is overwritten.
    """
    from switchfit.cli.first_problem import write_first_problem
    from switchfit.report.problem import write_experiments

    folder = Path(name)
    written = write_first_problem(folder, log)
    loaded = files.load(folder / "problem.toml")
    terminal.print_text("\n".join(["Written", *(f"  {path}" for path in written), ""]))
    terminal.print_text(write_experiments(loaded.problem.experiments))
    problem, out = shlex.quote(str(folder / "problem.toml")), shlex.quote(str(folder / "out"))
    terminal.print_text(f"\nNext\n  switchfit check {problem}\n  switchfit fit {problem} --out {out}\n")
    terminal.print_text(f"Then put your own modes into {folder / 'model.py'}.")
