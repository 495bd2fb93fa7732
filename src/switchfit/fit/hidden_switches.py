"""Switches hidden inside a function: a parameter changes the cost while its derivative is zero everywhere.

``jnp.where(t < p["t_on"], a, b)`` makes the cost jump each time ``t_on`` passes a stage of the integrator. Between the
jumps the cost is constant, so that its derivative is zero, correctly. An optimizer would leave such a parameter at its
guess without any warning. If the parameter has another effect too, its derivative is that of the other effect alone:
then the line search fails at a jump, and `switchfit.fit.termination` says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Matrix
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.comparisons import find_comparisons
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import HiddenSwitchError

HIDDEN_CHANGES = (1e-3, 1e-2, 0.1, 0.5, -1e-3, -1e-2, -0.1, -0.5)
"""Relative changes of a parameter that are tried; if it is 0, relative to the range between its bounds."""

CHANGED = 1e-9
"""Smallest relative change of the cost that is not rounding."""


def refuse_hidden_switches(
    evaluator: Evaluator, theta: FloatArray, gradient: FloatArray, matrix: Matrix = "none"
) -> None:
    """Raise HiddenSwitchError for a parameter whose derivative is exactly 0 although the cost depends on it.

    The message names the place where a function compares with the parameter, if one is found in its trace.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    gradient : (d,)
        Gradient at theta. If no entry is 0, nothing is evaluated.
    matrix : {"exact", "gauss-newton", "none"}
        What is evaluated beside the gradient: by what a fit has compiled already.
    """
    unknowns = evaluator.problem.unknowns
    # Exactly 0: a derivative that is merely small is no sign of a switch, and each suspect costs evaluations.
    suspects = np.flatnonzero((gradient == 0.0) & ~unknowns.is_time).tolist()
    if not suspects:
        return
    base = evaluator(theta, matrix=matrix).cost
    hidden = [i for i in suspects if _is_hidden(evaluator, theta, i, base, matrix)]
    if hidden:
        shown = ", ".join(unknowns.names[i] for i in hidden)
        seen = f"the cost changes with {shown}, but its derivative is zero at all points tried"
        comparison = next(filter(None, map(find_comparisons(evaluator.problem).get, hidden)), None)
        if comparison is None:
            raise HiddenSwitchError(
                f"{seen}, so that no fit can estimate it: let the model depend on it smoothly, or fix it."
            )
        raise HiddenSwitchError(
            f"{seen}: {comparison}, and derivatives do not include such a switch. If it is a time, make it a "
            "transition time: a mode for each side of it, both in mode_sequence, and its guess in transition_times. If "
            "it is a level that a state passes, give that transition a guard. Otherwise use a smooth function, or fix "
            "it."
        )


def list_changes(problem: Problem, theta: FloatArray, i: int, changes: Sequence[float]) -> Iterator[FloatArray]:
    """Yield theta with unknown i changed by parts of its size, or of the range between its bounds if it is 0."""
    lower, upper = problem.unknowns.lower[i], problem.unknowns.upper[i]
    size = abs(theta[i]) or (upper - lower if np.isfinite(upper - lower) else 1.0)
    for change in changes:
        moved = theta.copy()
        moved[i] = np.clip(theta[i] + change * size, lower, upper)
        yield moved


def _is_hidden(evaluator: Evaluator, theta: FloatArray, i: int, base: float, matrix: Matrix) -> bool:
    """Return whether the cost changes with unknown i while its derivative is 0 at the changed values too."""
    differs = False
    for moved in list_changes(evaluator.problem, theta, i, HIDDEN_CHANGES):
        there = evaluator(moved, matrix=matrix)
        if not np.isfinite(there.cost):
            continue
        # It has a derivative elsewhere, as where a mode that reads it has collapsed here: a fit can find it.
        if there.gradient[i] != 0.0:
            return False
        differs = differs or abs(there.cost - base) > CHANGED * max(abs(base), abs(there.cost))
    return differs
