"""Limit of time of a search: it ends at the next evaluation of J, or where a callback says so."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from switchfit.optimize import IterationRecord

_is_late: ContextVar[Callable[[], bool]] = ContextVar("is_late", default=bool)
callback_of_search: ContextVar[Callable[[IterationRecord], object] | None] = ContextVar("callback", default=None)


class OutOfTimeError(Exception):
    """The time budget of a search is spent."""


@contextmanager
def limit_time(
    seconds: float, clock: Callable[[], float], callback: Callable[[IterationRecord], object] | None = None
) -> Iterator[None]:
    """Let searches inside the context end after so many seconds of a clock, or with that around it, or where a
    callback, called with each iteration of their fits, returns true.
    """
    # A limit inside another one, as of a fit in a search, ends with that around it as well.
    end, around = clock() + seconds, _is_late.get()
    token = _is_late.set(lambda: clock() > end or around())
    called = callback_of_search.set(callback or callback_of_search.get())
    try:
        yield
    finally:
        _is_late.reset(token)
        callback_of_search.reset(called)


def is_late() -> bool:
    """Return whether the time budget is spent."""
    # A context variable: a search in one thread does not limit what others do.
    return _is_late.get()()


def check_time() -> None:
    """Raise an OutOfTimeError once the time budget is spent. What takes long asks again and again."""
    if is_late():
        raise OutOfTimeError
