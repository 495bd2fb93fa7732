"""The error for everything that is wrong with a file somebody wrote."""

from __future__ import annotations


class InputError(ValueError):
    """Something given is wrong; the message names the file and the key or line, what was given, and what to do."""


def get_first_line(error: BaseException) -> str:
    """Return an exception in one line: its type and the first line of its message."""
    message = str(error).strip().splitlines()
    return f"{type(error).__name__}: {message[0]}" if message else type(error).__name__
