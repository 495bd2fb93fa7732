"""Padded lengths of arrays, so that experiments of similar size share one compiled program."""

from __future__ import annotations

from collections.abc import Sequence

LONGEST_PADDING = 2.0
"""Largest ratio of a common padded length to the own length of a run. Runs with a common length share a program:
compiling one costs as much as some thousand evaluations, while a row of padding costs as much as any other row."""


def pad_length(length: int) -> int:
    """Return `length` rounded up to four significant bits: at most an eighth too long, few distinct values."""
    # Four significant bits, at least a multiple of 8: 1000 becomes 1024, 1100 becomes 1152.
    unit = 1 << max(int(length).bit_length() - 4, 3)
    return -(-length // unit) * unit


def choose_common_lengths(lengths: Sequence[int]) -> list[int]:
    """Return padded lengths from `pad_length`, with as few distinct ones as `LONGEST_PADDING` allows."""
    padded = [pad_length(length) for length in lengths]
    common: dict[int, int] = {}
    # The longest first: a shorter one takes the smallest common length so far, if that is at most twice its own.
    for length in sorted(set(padded), reverse=True):
        shared = min(common.values(), default=0)
        common[length] = shared if 0 < shared <= LONGEST_PADDING * length else length
    return [common[length] for length in padded]
