"""Switches hidden inside a function: a parameter that changes the cost while its derivative is zero everywhere.

``jnp.where(t < p["t_on"], a, b)`` makes the cost jump, from one step of the integrator to the next, as ``t_on`` passes;
between the jumps it is constant, and so the derivative, which is right, says nothing. An optimiser would leave such a
parameter where it is, without a word.
"""

from __future__ import annotations

import numpy as np

from switchfit.data import FloatArray
from switchfit.evaluate import Evaluator

CHANGES = (1e-3, 1e-2, 0.1, 0.5, -1e-3, -1e-2, -0.1, -0.5)
"""Parts of a parameter, or of the range between its bounds where it is 0, by which it is changed."""

CHANGED = 1e-9
"""Part of the cost that is no rounding."""


def refuse_hidden_switches(evaluator: Evaluator, theta: FloatArray, gradient: FloatArray) -> None:
    """ValueError for a parameter whose derivative is exactly 0 although the cost depends on it.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    gradient : (d,)
        At theta. Nothing is evaluated where no entry is 0.
    """
    unknowns = evaluator.problem.unknowns
    is_time = np.isin(np.arange(len(theta)), np.concatenate([*unknowns.times, np.zeros(0)]))
    suspects = np.flatnonzero((gradient == 0.0) & ~is_time)
    if not suspects.size:
        return
    base = evaluator(theta, matrix="none").cost
    hidden = [unknowns.names[i] for i in suspects if _hidden(evaluator, theta, int(i), base)]
    if hidden:
        name = hidden[0].partition("[")[0]
        raise ValueError(
            f"the cost changes with {', '.join(hidden)}, but its derivative is zero wherever it was tried: a function "
            f'decides by comparing with it, as in jnp.where(t < p["{name}"], a, b), and derivatives do not see where '
            "such a switch happens. If it is a moment, make it a transition time: a mode for a and a mode for b, both "
            "in mode_sequence, and its guess in transition_times. Otherwise use something smooth, or fix it."
        )


def _hidden(evaluator: Evaluator, theta: FloatArray, i: int, base: float) -> bool:
    """Whether the cost differs where unknown i is changed, its derivative being 0 there too."""
    unknowns = evaluator.problem.unknowns
    lower, upper = unknowns.lower[i], unknowns.upper[i]
    size = abs(theta[i]) or (upper - lower if np.isfinite(upper - lower) else 1.0)
    differs = False
    for change in CHANGES:
        moved = theta.copy()
        moved[i] = np.clip(theta[i] + change * size, lower, upper)
        there = evaluator(moved, matrix="none")
        if not np.isfinite(there.cost):
            continue
        if there.gradient[i] != 0.0:
            return False
        differs = differs or abs(there.cost - base) > CHANGED * max(abs(base), abs(there.cost))
    return differs
