"""Read files: tables of measurements, models in Python files, problem files.

Where the examples are. This imports nothing that takes long, so that commands list them at once.
"""

from __future__ import annotations

from pathlib import Path

from switchfit.runtime.errors import InputError

PACKAGE = Path(__file__).parents[1]


def find_examples() -> Path:
    """Return the folder of the examples: inside the installed package, or that of a clone."""
    inside = PACKAGE / "examples"
    return inside if inside.is_dir() else PACKAGE.parents[1] / "examples"


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
