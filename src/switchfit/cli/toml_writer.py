"""Write tables as TOML."""

from __future__ import annotations

import datetime
import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

NESTED_TABLES = {"parameters", "inputs", "library", "successions", "options"}
"""Tables with a line for each key; others stand in one line."""

NESTED_LISTS = {"experiments", "data", "jumps"}
"""Lists with a table for each entry."""

BARE = re.compile(r"[A-Za-z0-9_-]+")
"""Keys that need no quotation marks."""


def write_table(table: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the lines of a table: first what stands in a line, then the tables in it.

    Parameters
    ----------
    table : mapping
    path : tuple of str, optional
        Keys of the tables that it is in, and its own.
    """
    # TOML has no end of a table: keys that stand behind [inner] would belong to it, so that plain values come first.
    nested = {key: value for key, value in table.items() if _is_nested(key, value)}
    for key, value in table.items():
        if key not in nested:
            yield f"{_write_key(key)} = {write_value(value)}"
    for key, value in nested.items():
        inner = (*path, key)
        name = ".".join(map(_write_key, inner))
        if isinstance(value, Mapping):
            yield from ("", f"[{name}]", *write_table(value, inner))
        else:
            for entry in value:
                yield from ("", f"[[{name}]]", *write_table(entry, inner))


def _is_nested(key: str, value: object) -> bool:
    """Return whether a value is a table of its own, or a list of them; not so a parameter with the name of a list."""
    return (
        isinstance(value, Mapping)
        if key in NESTED_TABLES
        else key in NESTED_LISTS and isinstance(value, list) and value != []
    )


def _write_key(key: str) -> str:
    return key if BARE.fullmatch(key) else _write_text(key)


def _write_text(text: str) -> str:
    """Return a basic string of TOML, which differs from one of JSON in that 0x7f must be escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def write_value(value: object) -> str:
    """Return a value as it stands in a line.

    Parameters
    ----------
    value : bool, str, date, time, number, or a mapping or sequence of these
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _write_text(value)
    if isinstance(value, (datetime.date, datetime.time)):
        return value.isoformat()
    if isinstance(value, Mapping):
        entries = ", ".join(f"{_write_key(key)} = {write_value(entry)}" for key, entry in value.items())
        return f"{{ {entries} }}" if entries else "{}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(write_value, value))}]"
    return repr(value)  # inf, nan and exponents are written by Python as TOML has them
