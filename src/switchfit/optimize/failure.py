"""Why a line search failed, in words: what J is like along the direction, and which unknowns have to do with it."""

from __future__ import annotations

import numpy as np

from switchfit.optimize.algebra import NOISE, FloatArray
from switchfit.optimize.diagnosis import Finding, find_reason, wrong_slope
from switchfit.optimize.direction import Direction
from switchfit.optimize.point import Oracle
from switchfit.optimize.state import State, curvature_at


def explain_failure(oracle: Oracle, state: State, direction: Direction) -> str:
    """What J is like along the direction that failed, in words."""
    problem, theta = oracle.problem, state.point.theta
    noise = NOISE * max(abs(state.point.cost), 0.01 * state.cost_scale)

    def line(fraction: float) -> tuple[float, float] | None:
        if fraction == 0.0:
            return state.point.cost, direction.slope
        sample = oracle.sample(theta + fraction * direction.step, 1)
        return None if sample is None else (sample.cost, float(sample.gradient @ direction.step))

    found = find_reason(line, noise, min(problem.breakpoints.next_on(theta, direction.step), 1.0))
    at = theta + found.at * direction.step
    if found.kind == "wrong slope":
        return (
            f"The gradient does not belong to the cost: along that direction it says {found.before:.3g}, differences "
            f"of the cost say {found.after:.3g}{_wrong_entries(oracle, state, noise)}. Check the derivatives."
        )
    if found.kind == "jump":
        who = _who_jumps(oracle, theta, direction.step, found, noise)
        return (
            f"The cost jumps from {found.before:.8g} to {found.after:.8g} where {who}. The optimiser needs a cost that "
            "is continuous there."
        )
    if found.kind == "kink":
        where = ", ".join(f"theta[{i}] = {at[i]:.8g}" for i in _who_bends(oracle, theta, direction.step, found))
        return (
            f"The derivatives are right, but there is a kink close by, near {where}: along that direction the slope "
            f"jumps from {found.before:.3g} to {found.after:.3g}. Start elsewhere, or fix what is at the kink there."
        )
    if found.kind == "rounding":
        return (
            "The derivatives are right, but what the cost can still fall along that direction is less than its "
            f"rounding error, {noise:.1e}. Scale the unknowns to be of size one, or ask for a larger tolerance."
        )
    curvature = curvature_at(problem, state, state.point.active).spectrum.eigenvalues
    condition = curvature[-1] / curvature[0] if curvature.size and curvature[0] > 0.0 else np.inf
    return (
        "The derivatives are right, but the cost has a narrow valley there (condition number of the scaled Hessian "
        f"{condition:.1e}). Start elsewhere, fix one of the unknowns that trade off, or take hessian='gauss-newton'."
    )


def _wrong_entries(oracle: Oracle, state: State, noise: float) -> str:
    """The coordinates whose derivative differences of J do not confirm, in words."""
    theta, problem = state.point.theta, oracle.problem
    wrong = []
    for i in np.flatnonzero(problem.constraints.movable):
        for sign in (1.0, -1.0):
            unit = np.zeros(theta.size)
            unit[i] = sign * 0.01 * max(abs(theta[i]), problem.size[i], 1e-3)

            def line(fraction: float, unit: FloatArray = unit) -> tuple[float, float] | None:
                sample = oracle.sample(theta + fraction * unit, 1)
                return None if sample is None else (sample.cost, float(sample.gradient @ unit))

            smooth = min(problem.breakpoints.next_on(theta, unit), 1.0)
            measured = wrong_slope(line, noise, smooth)
            if measured is not None:
                stated = state.point.plus.gradient[i]
                wrong.append(f"theta[{i}] (derivative {stated:.3g}, differences {measured / unit[i]:.3g})")
                break
    return f"; it is wrong in {', '.join(wrong[:4])}" if wrong else ""


def _who_bends(oracle: Oracle, theta: FloatArray, step: FloatArray, found: Finding) -> list[int]:
    """The coordinates along which the derivative of J jumps at a kink on the line."""
    width = max(2.0**-40 * found.at, 1e-15)
    sides = [oracle.sample(theta + (found.at + w) * step, 1) for w in (-width, width)]
    moving = np.flatnonzero(step).tolist()
    if sides[0] is None or sides[1] is None:
        return moving[:4]
    jumps = np.abs((sides[1].gradient - sides[0].gradient) * step)
    return [i for i in moving if jumps[i] > 0.1 * jumps.max()][:4]


def _who_jumps(oracle: Oracle, theta: FloatArray, step: FloatArray, found: Finding, noise: float) -> str:
    """The coordinate whose change by a hair across a jump of J makes it jump, in words."""
    width = max(2.0**-40 * found.at, 1e-15)
    before, after = theta + (found.at - width) * step, theta + (found.at + width) * step
    base = oracle.sample(before, 1)
    for i in np.flatnonzero(before != after) if base is not None else ():
        moved = before.copy()
        moved[i] = after[i]
        there = oracle.sample(moved, 1)
        if (
            base is not None
            and there is not None
            and abs(there.cost - base.cost) > 0.5 * abs(found.after - found.before)
        ):
            return f"theta[{i}] passes {after[i]:.8g}"
    return "the step passes " + ", ".join(f"theta[{i}] = {after[i]:.8g}" for i in np.flatnonzero(step)[:4])
