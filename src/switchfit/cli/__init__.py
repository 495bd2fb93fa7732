"""The command line: a module for each command, ``switchfit --help`` for the list.

Exit codes: 0 converged and the verdict is good or doubtful, 1 not converged or bad (the result is still written),
2 wrong input, 3 an error of switchfit itself, 130 interrupted by Ctrl-C. Only typer is imported here; the numerical
parts are imported when a command needs them, so that ``--help`` is fast.
"""

import gc
import os
import sys
from collections.abc import Iterable
from importlib import import_module
from typing import Annotated

import typer

__all__ = ["main"]

YOUNG_OBJECTS = 200_000
"""New objects after which Python looks for garbage. With its own threshold of 700, a tenth of the processor time of a
cold fit goes into searching imported modules and traces, none of which is garbage."""

COMMANDS = {
    "fit": "fit",
    "modes": "modes",
    "validate": "validation",
    "compare": "comparison",
    "online": "online",
    "init": "init",
    "examples": "examples",
    "check": "check",
    "simulate": "simulation",
    "design": "experiment_design",
    "paper": "paper",
}
"""Commands and their modules, in the order of --help."""


def _build_app(names: Iterable[str] = COMMANDS) -> typer.Typer:
    """Return the command line with some commands, whose modules are imported."""
    app = typer.Typer(
        name="switchfit",
        help="""When did it switch, and what were the parameters? Fits switched models to logs.

        Begin with `switchfit init NAME --from LOG`, or with one of `switchfit examples`.
        """,
        no_args_is_help=True,
        add_completion=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_collect_options)
    for name in names:
        app.command()(getattr(import_module(f"switchfit.cli.{COMMANDS[name]}"), name))
    return app


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        from switchfit.cli.terminal import print_text

        print_text(f"switchfit {version('switchfit')}")
        raise typer.Exit


def _collect_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Entry point of the ``switchfit`` command."""
    gc.set_threshold(YOUNG_OBJECTS, 20, 100)
    # pydantic would look for plugins in the metadata of every installed package, which takes 10 to 20 ms.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # The module of one command alone is imported if its name is the first argument.
    asked = [name for name in sys.argv[1:2] if name in COMMANDS]
    try:
        _build_app(asked or COMMANDS)(prog_name="switchfit")
    finally:
        gc.freeze()  # else Python searches all that is imported for garbage when it exits: 20 to 80 ms


def __getattr__(name: str) -> object:
    """Return the whole command line as ``app``, built when it is first used (PEP 562)."""
    if name != "app":
        raise AttributeError(f"module 'switchfit.cli' has no attribute {name!r}", name=name)
    return globals().setdefault(name, _build_app())
