"""Checks of flags, instances, functions and paths; and the fields of frozen dataclasses while they are built."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np

from switchfit.arrays import Traced
from switchfit.problem.validation.messages import LONGEST_SHOWN_VALUE, shorten
from switchfit.problem.validation.names import as_sequence

T = TypeVar("T")


def set_fields(record: object, **values: object) -> None:
    """Set fields of a frozen dataclass while it is being built."""
    for name, value in values.items():
        object.__setattr__(record, name, value)


def as_flag(value: object, what: str) -> bool:
    """Return a truth value of Python or NumPy as a bool; numbers are not accepted."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{what} must be True or False; got {shorten(value)}.")
    return bool(value)


def as_instance(value: object, what: str, kind: type[T], form: str) -> T:
    """Return `value` if it is an instance of `kind`; messages use `form` as its name."""
    if not isinstance(value, kind):
        raise TypeError(f"{what} must be {form}; got {type(value).__name__}.")
    return value


def as_instances(value: object, what: str, kind: type[T], form: str) -> tuple[T, ...]:
    """Return an instance of `kind`, or a sequence of them, as a tuple; messages use `form` as the name of one."""
    form = f"{form} or a list of them"
    items = (value,) if isinstance(value, kind) else as_sequence(value, what, form)
    return tuple(as_instance(item, what, kind, form) for item in items)


def as_callable(value: object, what: str, form: str, *, arguments: int | None = None) -> Callable[..., Traced]:
    """Return a function, which must not be a class; messages use `form` as its name.

    Parameters
    ----------
    value : callable
    what : str
    form : str
        Such as ``"a function h(t, x, p)"``.
    arguments : int, optional
        Number of arguments with which it is called; checked if its signature is known.
    """
    # A class is callable: `observe=Sensor` in place of `Sensor()` would be traced as a constructor.
    if not callable(value) or isinstance(value, type):
        raise TypeError(f"{what} must be {form}; got {shorten(value)}.")
    misfit = None if arguments is None else find_misfit(value, range(arguments))
    if misfit is not None:
        raise TypeError(
            f"{what} must be {form}; got one that cannot be called with {arguments} argument(s): "
            f"it takes {str(misfit)[:LONGEST_SHOWN_VALUE]}."
        )
    return value


def find_misfit(function: Callable[..., object], arguments: Iterable[object]) -> inspect.Signature | None:
    """Return the signature of a function that cannot be called with some arguments; None if it can."""
    try:
        signature = inspect.signature(function)
    except Exception:  # functions written in C have none
        return None
    try:
        signature.bind(*arguments)
    except TypeError:
        return signature
    return None


def as_path(value: object, what: str) -> Path:
    """Return a path that is not empty."""
    text = os.fspath(value) if isinstance(value, (str, os.PathLike)) else None
    if not isinstance(text, str):
        raise TypeError(f"{what} must be a path (a string or a pathlib.Path); got {shorten(value)}.")
    if not text.strip() or "\0" in text:
        raise ValueError(f"{what} must be a path; got {shorten(value)}.")
    return Path(text)
