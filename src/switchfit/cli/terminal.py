"""The terminal: what is printed.

stdout has the result alone: a report, or with --json one JSON value. Notes and errors go to stderr.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import typer

asked_options: set[str] = set()
"""Of --json, --quiet, --verbose and --debug those that the command which runs was given."""


def is_asked(name: str) -> bool:
    """Return whether --json, --quiet, --verbose or --debug was given."""
    return name in asked_options


def print_text(text: object) -> None:
    """Print a part of the result as text."""
    if not (is_asked("json") or is_asked("quiet")):
        _print(text)


def print_json(value: object) -> None:
    """Print the result as JSON, if it is asked for."""
    if is_asked("json"):
        _print(format_json(value))


def format_json(value: object) -> str:
    """Return a value as one line of JSON; numbers that are not finite are null."""
    # The json of Python writes NaN, which is no JSON. pydantic writes null, and is loaded already; arrays go through
    # `fallback`.
    from pydantic_core import to_json

    return to_json(value, inf_nan_mode="null", fallback=lambda array: array.tolist()).decode()


def print_note(text: object) -> None:
    """Print what the command does, to stderr."""
    if not is_asked("quiet"):
        _print(text, err=True)


def _print(text: object, *, err: bool = False) -> None:
    """Print to stdout or stderr; if its reader has closed it, as ``head`` does, print nothing from then on.

    The command continues: its files and its exit code do not depend on a reader.
    """
    try:
        typer.echo(text, err=err)
    except BrokenPipeError:
        stream = sys.stderr if err else sys.stdout
        # As the documentation of Python recommends: without it, the flush at exit fails again, with a traceback.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())  # buffered text is flushed there, at the latest when Python exits
        os.close(nowhere)


def print_error(message: object) -> None:
    """Print what is wrong, to stderr."""
    _print(f"switchfit: {message}", err=True)


def print_list(title: str, entries: Sequence[object]) -> None:
    """Print a title and a line for each entry, such as what is odd about logs; nothing without entries."""
    if entries:
        print_text("\n".join([title, *(f"  {entry}" for entry in entries), ""]))
