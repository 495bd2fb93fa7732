"""Errors that callers distinguish by their class."""

from __future__ import annotations


class InputError(ValueError):
    """An input is wrong; the message names the file and the key or line, the value given, and what to do."""


class NotIntegrableError(ValueError):
    """The model cannot be integrated at a theta: it is undefined, grows without bound or takes too many steps."""


class HiddenSwitchError(ValueError):
    """The cost changes with a parameter whose derivative is zero, as where a function switches by comparing with it."""


def get_first_line(error: BaseException) -> str:
    """Return an exception in one line: its type and the first line of its message."""
    message = str(error).strip().splitlines()
    return f"{type(error).__name__}: {message[0]}" if message else type(error).__name__
