"""The command line: a module for each group of commands, ``switchfit --help`` for the list.

Exit codes: 0 converged and the verdict is good or doubtful, 1 not converged or bad (the result is still written),
2 wrong input, 3 an error of switchfit itself, 130 interrupted by Ctrl-C. Only typer is imported here; the numerical
parts are imported when a command needs them, so that ``--help`` is fast.
"""

import gc
import os

from switchfit.cli.checking import check, design, simulate
from switchfit.cli.comparison import compare, paper, rerun, validate
from switchfit.cli.fitting import fit
from switchfit.cli.modes import modes
from switchfit.cli.online import online
from switchfit.cli.starting import examples, init
from switchfit.cli.terminal import app

__all__ = ["app", "main"]

YOUNG_OBJECTS = 200_000
"""New objects after which Python looks for garbage. With its own threshold of 700, a tenth of the processor time of a
cold fit goes into searching imported modules and traces, none of which is garbage."""

COMMANDS = (init, fit, modes, online, design, check, simulate, validate, compare, rerun, examples, paper)
"""In the order of --help."""

for _command in COMMANDS:
    app.command()(_command)


def main() -> None:
    """Entry point of the ``switchfit`` command."""
    gc.set_threshold(YOUNG_OBJECTS, 20, 100)
    # pydantic would look for plugins in the metadata of every installed package, which takes 10 to 20 ms.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    app(prog_name="switchfit")
