"""Work that was done, by count: the same for the same input on any machine, however busy it is.

What takes time counts itself: rows evaluated in machine code or by JAX, steps of adaptive solves, hypotheses of a beam,
and the calls around them. Searches end when so much work is done, and not after so many seconds: their answers would
depend on what else the machine does. Compilation is no work: its result may be cached.
"""

from __future__ import annotations

import threading

ADDITIONS_PER_SECOND = 1e9
"""Additions that one core does in a second, to state amounts of work in seconds. A fit or search of a model with or
without corners takes 0.3 to 2.6 of these seconds in one of an idle core of 2026."""

CALL = 2e5
"""Additions in the time that a call in Python takes, with what it prepares: 0.2 ms, of an evaluation or a stretch."""

_done = threading.local()


def count_work(additions: float) -> None:
    """Add work of this thread.

    Parameters
    ----------
    additions : float
        The time of so many additions in machine code.
    """
    _done.additions = getattr(_done, "additions", 0.0) + additions


def measure_work() -> float:
    """Return the work of this thread so far, in seconds of a core that does `ADDITIONS_PER_SECOND`."""
    return float(getattr(_done, "additions", 0.0)) / ADDITIONS_PER_SECOND
