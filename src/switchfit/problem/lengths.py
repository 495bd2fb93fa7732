"""Lengths to which arrays are padded, so that experiments of similar size share one compiled program."""

from __future__ import annotations

from collections.abc import Sequence


def pad_length(length: int) -> int:
    """Return `length` rounded up to four significant bits: at most an eighth too long, few distinct values."""
    unit = 1 << max(int(length).bit_length() - 4, 3)
    return -(-length // unit) * unit


LONGEST_PADDING = 2.0
"""Runs of one problem share a length, and with it a program, where that makes none of them longer than this many times
its own. Compiling a program costs as much as some thousand evaluations, a row of padding as much as any other row."""


def choose_common_lengths(lengths: Sequence[int]) -> list[int]:
    """Return lengths out of `pad_length`, as few distinct ones as `LONGEST_PADDING` allows."""
    padded = [pad_length(length) for length in lengths]
    common: dict[int, int] = {}
    for length in sorted(set(padded), reverse=True):
        shared = min(common.values(), default=0)
        common[length] = shared if 0 < shared <= LONGEST_PADDING * length else length
    return [common[length] for length in padded]
