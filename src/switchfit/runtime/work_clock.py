"""A clock that stands still while programs are compiled, to measure how long the work itself takes.

JAX reports the duration of its compilations to a listener, which is registered when this module is imported.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from jax import monitoring

from switchfit.runtime.jax_internals import COMPILE_EVENTS

_compiled = [0.0]


def measure_work() -> float:
    """Return a time in seconds, as of a clock that stands still while programs are compiled."""
    return time.perf_counter() - _compiled[0]


@contextmanager
def stop_clock() -> Iterator[None]:
    """Let the clock of `measure_work` stand still."""
    began = time.perf_counter()
    try:
        yield
    finally:
        _compiled[0] += time.perf_counter() - began


def _count_compilation(event: str, duration_secs: float, **kwargs: str | int) -> None:
    # Whatever thread compiles: the clock is that of a limit of time for the whole process.
    if event in COMPILE_EVENTS:
        _compiled[0] += duration_secs


monitoring.register_event_duration_secs_listener(_count_compilation)
