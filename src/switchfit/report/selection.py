"""Which of many unknowns, experiments and entries a report or a figure shows."""

from __future__ import annotations

from collections.abc import Collection, Sequence, Sized

from switchfit.fit.result import Fit
from switchfit.uncertainty.explained_variance import rank_runs

MOST_DRAWN_RUNS = 10
"""Experiments that one figure shows."""

SCREEN = {"experiments": 3, "channels": 6, "unknowns": 10, "fixed": 4, "directions": 1, "others": 3}
"""Largest number of entries of each section, about 40 lines for most fits; the others are counted."""


def select_unknowns(is_time: Sequence[bool], most: int, marked: Collection[int] = ()) -> list[int]:
    """Return the indices of the unknowns that are listed, in their order.

    If there are more than `most`, those that are marked come first. Then come the transition times, which are what is
    asked for, unless they fill more than half of the table, as those of many runs do; then parameters.

    Parameters
    ----------
    is_time : sequence of bool
        Of each unknown, whether it is a transition time.
    most : int
    marked : collection of int, optional
    """
    # Sorted twice: by rank to choose, then by place to list them in the order of theta.
    few = 2 * sum(is_time) <= most
    return sorted(sorted(range(len(is_time)), key=lambda i: (i not in marked, is_time[i] != few))[:most])


def count_worst(shown: Sized, every: Sized, what: str) -> str:
    """Return of how many the worst are shown; "" if all are.

    Parameters
    ----------
    shown, every : sized
    what : str
        The plural of what they are.
    """
    return f"the worst {len(shown)} of {len(every)} {what}" if len(shown) < len(every) else ""


def choose_runs(fit: Fit, most: int = MOST_DRAWN_RUNS) -> list[int]:
    """Return the indices of the experiments that one figure shows: all of them, or those that are explained worst.

    Parameters
    ----------
    fit : Fit
    most : int, optional
        Number of them.
    """
    return rank_runs(fit)[:most] if len(fit.trajectories) > most else list(range(len(fit.trajectories)))
