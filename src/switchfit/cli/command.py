"""The decorator of commands: it adds the common options, such as --json and --debug, and reports errors."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Annotated

import typer

from switchfit.cli.errors import report_errors
from switchfit.cli.terminal import asked_options

COMMON = {
    "json": Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else, to stdout.")],
    "quiet": Annotated[
        bool, typer.Option("--quiet", "-q", help="Print nothing but errors; the exit code tells the result.")
    ],
    "verbose": Annotated[bool, typer.Option("--verbose", "-v", help="Say on stderr what is being done, step by step.")],
    "debug": Annotated[bool, typer.Option("--debug", help="Show the full traceback of an error.")],
}
"""Options of which a command has some, and --debug in any case."""


def command(*options: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command some of the common options, and runs it in `report_errors`."""
    names = (*options, "debug")

    def decorate(run: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(run)
        def run_command(**given: object) -> None:
            # A set that all of the command line reads: passing it through every function that prints would make each
            # signature longer. It is cleared for tests, which run several commands in one process.
            asked_options.update(name for name in names if given.pop(name))
            try:
                with report_errors():
                    run(**given)
            finally:
                asked_options.clear()

        kind = inspect.Parameter.KEYWORD_ONLY
        added = [inspect.Parameter(name, kind, default=False, annotation=COMMON[name]) for name in names]
        # Annotations are text (PEP 563) in the commands' modules, and typer would evaluate them in this one, where
        # their names mean nothing.
        own = inspect.signature(run, eval_str=True)
        run_command.__signature__ = own.replace(parameters=[*own.parameters.values(), *added])  # type: ignore[attr-defined]
        return run_command

    return decorate
