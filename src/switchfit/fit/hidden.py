"""Switches hidden inside a function: a parameter that changes the cost while its derivative is zero everywhere.

``jnp.where(t < p["t_on"], a, b)`` makes the cost jump each time ``t_on`` passes a stage of the integrator. Between the
jumps the cost is constant, so that its derivative is zero, correctly. An optimizer would leave such a parameter at its
guess without any warning. If the parameter has another effect too, its derivative is that of the other effect alone,
and the line search fails at a jump. Jumps are therefore looked for after a line search has failed.
"""

from __future__ import annotations

import numpy as np

from switchfit.engine.protocol import Matrix
from switchfit.fit.evaluator import Evaluator
from switchfit.optimize.diagnosis import Finding, find_jump
from switchfit.problem.data import FloatArray
from switchfit.runtime.errors import HiddenSwitchError

CHANGES = (1e-3, 1e-2, 0.1, 0.5, -1e-3, -1e-2, -0.1, -0.5)
"""Relative changes of a parameter that are tried; if it is 0, relative to the range between its bounds."""

KEPT = 0.02
"""Part of a jump that must remain on meshes with cells of a quarter of the length."""

SMALLEST_JUMP = 1e-5
"""Smallest jump, relative to the cost: far from the data, where trajectories are unstable, J is so steep that it seems
to jump by less."""

CHANGED = 1e-9
"""Smallest relative change of the cost that is not rounding."""


def refuse_hidden_switches(
    evaluator: Evaluator, theta: FloatArray, gradient: FloatArray, matrix: Matrix = "none"
) -> None:
    """Raise ValueError for a parameter whose derivative is exactly 0 although the cost depends on it.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    gradient : (d,)
        Gradient at theta. If no entry is 0, nothing is evaluated.
    matrix : {"exact", "gauss-newton", "none"}
        What is evaluated beside the gradient: by what a fit has compiled already.
    """
    if gradient.all():
        return
    unknowns = evaluator.problem.unknowns
    suspects = np.flatnonzero((gradient == 0.0) & ~unknowns.is_time).tolist()
    if not suspects:
        return
    base = evaluator(theta, matrix=matrix).cost
    hidden = [i for i in suspects if _is_hidden(evaluator, theta, i, base, matrix)]
    if hidden:
        spans = unknowns.parameters.items()
        name = next((name for name, span in spans if span.start <= hidden[0] < span.stop), unknowns.names[hidden[0]])
        shown = ", ".join(unknowns.names[i] for i in hidden)
        raise HiddenSwitchError(
            f"the cost changes with {shown}, but its derivative is zero at all points tried: {_write_advice(name)}"
        )


def refuse_jumps(evaluator: Evaluator, theta: FloatArray) -> None:
    """Raise ValueError for a parameter in which the cost jumps, although its derivative is correct between the jumps.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
        Point at which a line search has failed.
    """
    unknowns = evaluator.problem.unknowns
    for name, span in unknowns.parameters.items():
        for i in range(span.start, span.stop):
            jump = _find_jump(evaluator, theta, i)
            if jump is not None and _is_jump_of_model(evaluator, theta, i, jump[1]):
                place, finding = jump
                raise HiddenSwitchError(
                    f"the cost jumps from {finding.before:.8g} to {finding.after:.8g} where {unknowns.names[i]} passes "
                    f"{place:.8g}, which its derivative does not show: {_write_advice(name)}"
                )


def _write_advice(name: str) -> str:
    """Return how a function uses such a parameter, and what to write instead."""
    return (
        f'a function switches by comparing with it, as in jnp.where(t < p["{name}"], a, b), and derivatives do not '
        "include such a switch. If it is a time, make it a transition time: a mode for a and a mode for b, both in "
        "mode_sequence, and its guess in transition_times; for its other effects, keep a parameter of its own. "
        "Otherwise use a smooth function, or fix the parameter."
    )


def _find_jump(evaluator: Evaluator, theta: FloatArray, i: int) -> tuple[float, Finding] | None:
    """Find where the cost jumps as unknown i changes, with the costs on both sides; None without a jump."""
    lower, upper = evaluator.problem.unknowns.lower[i], evaluator.problem.unknowns.upper[i]

    def line(value: float) -> tuple[float, float] | None:
        moved = theta.copy()
        moved[i] = value
        here = evaluator(moved, matrix="none")
        slope = float(here.gradient[i])
        return (here.cost, slope) if np.isfinite(here.cost) and np.isfinite(slope) else None

    size = abs(theta[i]) or (upper - lower if np.isfinite(upper - lower) else 1.0)
    here = line(float(theta[i]))
    for change in CHANGES:
        end = float(np.clip(theta[i] + change * size, lower, upper))
        if end != theta[i] and here is not None:
            low, high = min(end, float(theta[i])), max(end, float(theta[i]))
            there = line(end)
            # Relative to the larger of the two costs: at a perfect fit, J itself is rounding.
            noise = CHANGED * max(abs(here[0]), 0.0 if there is None else abs(there[0]))
            finding = find_jump(line, low, high, noise)
            if finding is not None:
                return finding.at, finding
    return None


def _is_jump_of_model(evaluator: Evaluator, theta: FloatArray, i: int, finding: Finding) -> bool:
    """Return whether a jump is that of the model, and not of a mesh so coarse that J is steeper than its derivative.

    On meshes with four times as many steps, a model with a hidden switch jumps at other points, and by about a quarter.
    """
    size = abs(finding.after - finding.before)
    if size < SMALLEST_JUMP * max(abs(finding.before), abs(finding.after)):
        return False
    again = _find_jump(evaluator.divide(4), theta, i)
    return again is not None and abs(again[1].after - again[1].before) >= KEPT * size


def _is_hidden(evaluator: Evaluator, theta: FloatArray, i: int, base: float, matrix: Matrix) -> bool:
    """Return whether the cost changes with unknown i while its derivative is 0 at the changed values too."""
    unknowns = evaluator.problem.unknowns
    lower, upper = unknowns.lower[i], unknowns.upper[i]
    size = abs(theta[i]) or (upper - lower if np.isfinite(upper - lower) else 1.0)
    differs = False
    for change in CHANGES:
        moved = theta.copy()
        moved[i] = np.clip(theta[i] + change * size, lower, upper)
        there = evaluator(moved, matrix=matrix)
        if not np.isfinite(there.cost):
            continue
        if there.gradient[i] != 0.0:
            return False
        differs = differs or abs(there.cost - base) > CHANGED * max(abs(base), abs(there.cost))
    return differs
