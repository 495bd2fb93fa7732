"""Read files: tables of measurements, models in Python files, problem files.

Where the examples are. This imports nothing else, so that commands list them at once.
"""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def find_examples() -> Path:
    """Return the folder of the examples: inside the installed package, or that of a clone."""
    inside = PACKAGE / "examples"
    return inside if inside.is_dir() else PACKAGE.parents[1] / "examples"
