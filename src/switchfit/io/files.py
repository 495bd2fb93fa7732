"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import secrets
from pathlib import Path


def write_atomically(content: str | bytes, path: Path) -> None:
    """Write a new file beside `path`, which then takes its name; text as UTF-8.

    Raises
    ------
    OSError
        If the file cannot be written; an existing one is then left as it was.
    """
    path = path.resolve()  # a link stays one
    temporary = path.with_name(f".{path.name}-{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
