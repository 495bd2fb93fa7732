"""Files of a command: the problem that it loads, the folder that it makes, the result that it writes."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from switchfit.cli.terminal import print_json, print_note, print_text
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import write_atomically

if TYPE_CHECKING:
    from switchfit.io.problem_file.building import ProblemFile

FIGURE_DPI = 150
"""Dots per inch of a figure."""


Result: TypeAlias = Any
"""A result of the library, which has text. It has ``plot`` where a format of figures is given, ``save`` where it is to
be saved: the command knows which of its results have them."""


def load(
    problem: Path,
    out: Path | None = None,
    *,
    log: Path | None = None,
    searched: bool = False,
    streamed: bool = False,
) -> ProblemFile:
    """Load a problem file as `load_problem` does, and create the folder for the results."""
    from switchfit.io.problem_file.loading import load_problem

    loaded = load_problem(problem, log, searched=searched, streamed=streamed)
    make_folder(out)
    return loaded


def make_folder(folder: Path | None) -> None:
    """Create a folder, with those above it, unless it exists or none is asked for."""
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)


def write_result(result: Result, stem: Path, figures: str, *, saved: bool = False) -> None:
    """Write the text of a result, its figure if `figures` names a format, and the result itself if it is to be saved.

    The files differ in their endings. Say where they are.
    """
    write_atomically(f"{result}\n", stem.with_suffix(".txt"))
    if saved:
        result.save(stem.with_suffix(".json"))
    if figures:
        write_figure(result, stem.with_suffix(f".{figures}"))
    print_note(f"written to {stem.parent}")


def show(
    result: Result, summary: dict[str, Any], out: Path | None, name: str, figures: str, *, saved: bool = False
) -> None:
    """Print a result, and write it as `write_result` does, if there is a folder for it."""
    print_text(result)
    if out is not None:
        write_result(result, out / name, figures, saved=saved)
    print_json(summary | {"out": out})


def write_figure(result: Result, path: Path) -> None:
    """Write the figure of a result; the ending of the name is its format."""
    # A machine without a display; figures are drawn without pyplot, but a user's model file may import it.
    os.environ.setdefault("MPLBACKEND", "Agg")
    content = io.BytesIO()
    result.plot().savefig(content, format=path.suffix[1:], dpi=FIGURE_DPI)
    write_atomically(content.getvalue(), path)


def refuse_existing(folder: Path, argument: str) -> None:
    """Raise InputError for a new folder that has something in it, or is a file.

    Parameters
    ----------
    folder : Path
    argument : str
        The argument that names it.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} exists already, and nothing is overwritten: give another {argument}.")
