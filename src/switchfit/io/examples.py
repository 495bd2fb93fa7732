"""Where the examples are. This imports nothing else, so that commands list them at once."""

from pathlib import Path

import switchfit


def find_examples() -> Path:
    """Return the folder of the examples: inside the installed package, or that of a clone."""
    package = Path(switchfit.__file__).parent
    inside = package / "examples"
    return inside if inside.is_dir() else package.parents[1] / "examples"
