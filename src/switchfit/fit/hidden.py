"""Switches hidden inside a function: a parameter that changes the cost while its derivative is zero everywhere.

``jnp.where(t < p["t_on"], a, b)`` makes the cost jump, from one step of the integrator to the next, as ``t_on`` passes;
between the jumps it is constant, and so the derivative, which is right, says nothing. An optimiser would leave such a
parameter where it is, without a word. Where the parameter has another effect besides, its derivative is that effect's
alone: the optimiser then walks until a jump stands in its way. Jumps are looked for where a line search has failed.
"""

from __future__ import annotations

import numpy as np

from switchfit.fit.evaluator import Evaluator
from switchfit.optimize.diagnosis import Finding, find_jump
from switchfit.problem.data import FloatArray

CHANGES = (1e-3, 1e-2, 0.1, 0.5, -1e-3, -1e-2, -0.1, -0.5)
"""Parts of a parameter, or of the range between its bounds where it is 0, by which it is changed."""

KEPT = 0.02
"""Part of a jump that there must still be on meshes with cells of a quarter of the length."""

SMALLEST_JUMP = 1e-5
"""Part of the cost that a jump has at least: far from the data, where trajectories are unstable, J is steep enough to
seem to jump by less."""

CHANGED = 1e-9
"""Part of the cost that is no rounding."""


def refuse_hidden_switches(evaluator: Evaluator, theta: FloatArray, gradient: FloatArray) -> None:
    """Raise ValueError for a parameter whose derivative is exactly 0 although the cost depends on it.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    gradient : (d,)
        At theta. Nothing is evaluated where no entry is 0.
    """
    if gradient.all():
        return
    unknowns = evaluator.problem.unknowns
    suspects = np.flatnonzero((gradient == 0.0) & ~unknowns.is_time).tolist()
    if not suspects:
        return
    base = evaluator(theta, matrix="none").cost
    hidden = [i for i in suspects if _is_hidden(evaluator, theta, i, base)]
    if hidden:
        spans = unknowns.parameters.items()
        name = next((name for name, span in spans if span.start <= hidden[0] < span.stop), unknowns.names[hidden[0]])
        shown = ", ".join(unknowns.names[i] for i in hidden)
        raise ValueError(
            f"the cost changes with {shown}, but its derivative is zero wherever it was tried: {_advice(name)}"
        )


def refuse_jumps(evaluator: Evaluator, theta: FloatArray) -> None:
    """Raise ValueError for a parameter at which the cost jumps although its derivative is right in between.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
        Where a line search has failed.
    """
    unknowns = evaluator.problem.unknowns
    for name, span in unknowns.parameters.items():
        for i in range(span.start, span.stop):
            jump = _jump(evaluator, theta, i)
            if jump is not None and _stays_on_a_finer_mesh(evaluator, theta, i, jump[1]):
                place, finding = jump
                raise ValueError(
                    f"the cost jumps from {finding.before:.8g} to {finding.after:.8g} where {unknowns.names[i]} passes "
                    f"{place:.8g}, which its derivative knows nothing of: {_advice(name)}"
                )


def _advice(name: str) -> str:
    """Return what a function does with such a parameter, and what to write instead."""
    return (
        f'a function decides by comparing with it, as in jnp.where(t < p["{name}"], a, b), and derivatives do not see '
        "where such a switch happens. If it is a moment, make it a transition time: a mode for a and a mode for b, "
        "both in mode_sequence, and its guess in transition_times; what else it does keeps a parameter of its own. "
        "Otherwise use something smooth, or fix it."
    )


def _jump(evaluator: Evaluator, theta: FloatArray, i: int) -> tuple[float, Finding] | None:
    """Find where the cost jumps as unknown i changes, and from what to what; None if no jump was seen."""
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
            # Measured by the larger of the two: where the fit is perfect, J itself is rounding.
            noise = CHANGED * max(abs(here[0]), 0.0 if there is None else abs(there[0]))
            finding = find_jump(line, low, high, noise)
            if finding is not None:
                return finding.at, finding
    return None


def _stays_on_a_finer_mesh(evaluator: Evaluator, theta: FloatArray, i: int, finding: Finding) -> bool:
    """Return whether a jump is one of the model: where the mesh is too coarse J may be steeper than its derivative.

    On meshes with four times as many steps the model jumps elsewhere, from step to step, and by about a quarter.
    """
    size = abs(finding.after - finding.before)
    if size < SMALLEST_JUMP * max(abs(finding.before), abs(finding.after)):
        return False
    again = _jump(evaluator.divide(4), theta, i)
    return again is not None and abs(again[1].after - again[1].before) >= KEPT * size


def _is_hidden(evaluator: Evaluator, theta: FloatArray, i: int, base: float) -> bool:
    """Return whether the cost differs where unknown i is changed, its derivative being 0 there too."""
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
