"""Timing: sides of a comparison take turns, so that a busy machine slows all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

BLOCK = 6
"""Calls in a turn; the first, which finds the caches filled by the others, does not count."""


@dataclass(frozen=True)
class Timing:
    """Seconds of one call: median, minimum and quartiles over `count` calls."""

    median: float
    minimum: float
    lower: float
    upper: float
    count: int

    @classmethod
    def of(cls, seconds: list[float]) -> Timing:
        """Statistics of measured times."""
        lower, median, upper = np.percentile(seconds, [25, 50, 75])
        return cls(float(median), min(seconds), float(lower), float(upper), len(seconds))


def take_turns(calls: dict[str, Callable[[], object]], repetitions: int, block: int = BLOCK) -> dict[str, Timing]:
    """Time every call at least `repetitions` times, in turns of `block` calls; all are warmed up first."""
    for call in calls.values():
        call()
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    while min(len(taken) for taken in seconds.values()) < repetitions:
        for name, call in calls.items():
            for k in range(block):
                began = time.perf_counter()
                call()
                if k > 0 or block == 1:
                    seconds[name].append(time.perf_counter() - began)
    return {name: Timing.of(taken) for name, taken in seconds.items()}


def ms(seconds: float) -> str:
    """Milliseconds to three digits."""
    return f"{seconds * 1e3:.3g} ms"


def turns_within(calls: dict[str, Callable[[], object]], seconds: float, rounds: int = 5) -> dict[str, Timing]:
    """Time calls of very different lengths: each gets `seconds` in all, in `rounds` turns, and at least one call.

    All must be warm. As in `take_turns` the first call of a turn does not count, where a turn has several.
    """
    alone = {name: _seconds_of(call) for name, call in calls.items()}
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds):
        for name, call in calls.items():
            if turn * alone[name] > seconds:  # too slow for another turn
                continue
            block = int(min(max(seconds / rounds / alone[name], 1), 200))
            measured = [_seconds_of(call) for _ in range(block)]
            taken[name] += measured[1:] if block > 1 else measured
    return {name: Timing.of(measured) for name, measured in taken.items()}


def _seconds_of(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began
