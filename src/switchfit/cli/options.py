"""Arguments and options that several commands take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.models import ArgumentInfo, OptionInfo


def option(*names: str, help: str, metavar: str | None = None) -> OptionInfo:
    """Return an option; its help says what holds without it."""
    found: OptionInfo = typer.Option(*names, metavar=metavar, help=help, show_default=False)
    return found


def argument(metavar: str, help: str, **more: Any) -> ArgumentInfo:
    """Return a positional argument."""
    found: ArgumentInfo = typer.Argument(metavar=metavar, help=help, show_default=False, **more)
    return found


def output_folder(content: str) -> OptionInfo:
    """Return the option --out for a folder with some content."""
    return option(metavar="DIR", help=f"Folder for {content}. Left out, nothing is written.")


ProblemPath = Annotated[Path, argument("PROBLEM.toml", "Problem file.")]


SavedPath = Annotated[
    Path, argument("ESTIMATE.json", "Written by switchfit fit --out.", exists=True, dir_okay=False, readable=True)
]


Folder = Annotated[
    Path | None,
    option(metavar="DIR", help="Where data and models are. Default: where they were, seen from ESTIMATE.json."),
]


FigureFormat = Annotated[
    Literal["png", "pdf", "svg"], option("--figures", help="Format of the figure in --out. Default: png.")
]


def select_given(**options: object) -> dict[str, Any]:
    """Return the options that are given; the others are None."""
    return {name: value for name, value in options.items() if value is not None}
