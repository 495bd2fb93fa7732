"""JSON documents: files with a "format" and a "version" that are checked when they are read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from switchfit.runtime.files import write_atomically

# --- files ------------------------------------------------------------------------------------------------------------


def write_document(content: dict[str, Any], path: Path) -> None:
    """Write JSON to a file, whole or not at all.

    Parameters
    ----------
    content : dict
    path : Path
    """
    write_atomically(_lay_out(content) + "\n", path)


def read_document(path: Path, what: str, form: str, version: int) -> dict[str, Any]:
    """Return the JSON object in a file, with its "format" and its "version" checked, as of `parse_document`."""
    return parse_document(path.read_bytes(), path, what, form, version)  # OSError names the file


def parse_document(text: bytes, path: Path, what: str, form: str, version: int) -> dict[str, Any]:
    """Return a JSON object, with its "format" and its "version" checked.

    Parameters
    ----------
    text : bytes
    path : Path
        Where it was read, for messages.
    what : str
        What the file should be, with its article, for messages.
    form : str
        The "format" that it must have.
    version : int
        The one that can be read.

    Raises
    ------
    ValueError
        If it is not valid JSON, of another format or of another version.
    """
    try:
        content = json.loads(text.decode())
    # RecursionError: a file of nothing but opening brackets.
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not {what}: it is not valid JSON ({error}).") from error
    if not isinstance(content, dict) or content.get("format") != form:
        raise ValueError(f'{path} is not {what}: it has no entry "format": "{form}" at its top.')
    if (given := content.get("version")) != version:
        raise ValueError(
            f"{path} is {what} of version {given!r}; this switchfit reads version {version}. Read it with the "
            "switchfit that wrote it."
        )
    return content


def _lay_out(value: object, indent: str = "") -> str:
    """Return JSON with one entry of an object or one row of an array on a line."""
    deeper = indent + "  "
    if isinstance(value, dict) and value:
        entries = [f"{json.dumps(name)}: {_lay_out(entry, deeper)}" for name, entry in value.items()]
    elif isinstance(value, list) and any(isinstance(entry, (dict, list)) for entry in value):
        entries = [_lay_out(entry, deeper) for entry in value]
    else:
        # Numbers that are not finite have become strings before (`json_records`): one here is a mistake, not "NaN" in a
        # file that other programs refuse.
        return json.dumps(value, allow_nan=False, ensure_ascii=False)
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    return f"{opening}\n{deeper}" + f",\n{deeper}".join(entries) + f"\n{indent}{closing}"
