"""Why a line search failed: what J is like along the direction, and which unknowns have to do with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from switchfit.optimize.algebra import NOISE, FloatArray
from switchfit.optimize.diagnosis import Finding, find_reason, measure_noise, wrong_slope
from switchfit.optimize.direction import Direction
from switchfit.optimize.feasibility import move
from switchfit.optimize.point import Oracle, Sample
from switchfit.optimize.state import State, curvature_at


def explain_failure(oracle: Oracle, state: State, direction: Direction) -> Finding:
    """Find what J is like along the direction that failed, and which coordinates make it so."""
    problem, theta = oracle.problem, state.point.theta
    noise = NOISE * max(abs(state.point.cost), 0.01 * state.cost_scale)

    def line(fraction: float) -> tuple[float, float] | None:
        if fraction == 0.0 and not problem.equalities:
            return state.point.cost, direction.slope
        sample = oracle.sample(theta + fraction * direction.step, 1)
        return None if sample is None else _along(sample, state, direction.step)

    found = find_reason(line, noise, min(problem.breakpoints.next_on(theta, direction.step), 1.0))
    at = theta + found.at * direction.step
    if found.kind == "wrong slope":
        return replace(found, entries=_wrong_entries(oracle, state, noise))
    if found.kind == "jump":
        return replace(found, places=_who_jumps(oracle, theta, direction.step, found))
    if found.kind == "not finite":
        return replace(found, places=tuple((i, float(at[i])) for i in np.flatnonzero(direction.step).tolist()))
    if found.kind == "kink":
        bent = _who_bends(oracle, theta, direction.step, found)
        return replace(found, places=tuple((i, float(at[i])) for i in bent))
    if found.kind == "rounding":
        return replace(found, noise=noise)
    curvature = curvature_at(problem, state, state.point.active).spectrum.eigenvalues
    positive = curvature.size > 0 and curvature[0] > 0.0
    return replace(found, condition=float(curvature[-1] / curvature[0]) if positive else np.inf)


def is_below_rounding(oracle: Oracle, state: State, direction: Direction) -> bool:
    """Return whether the decrease that a step still promises is below the rounding error of J.

    This error is a part of J or, where J is a small difference of large terms, as at a perfect fit, more. The largest J
    seen is a bound on it, which says little where the start was far away: between the two the error is measured.
    """
    smallest, largest = 10 * NOISE * abs(state.point.cost), 10 * NOISE * state.cost_scale
    if not smallest < direction.reduction <= largest:
        return direction.reduction <= smallest

    def line(fraction: float) -> float | None:
        sample = oracle.first(move(oracle.problem, state.point.theta, fraction * direction.step, state.scale))
        return None if sample is None else sample.lagrangian(state.point.forces)[0]

    return direction.reduction <= 10 * measure_noise(line)


def _along(sample: Sample, state: State, step: FloatArray) -> tuple[float, float]:
    """Return J and its slope along a step (d,); those of the Lagrangian where there are equality constraints."""
    cost, gradient = sample.lagrangian(state.point.forces)
    return cost, float(gradient @ step)


def _wrong_entries(oracle: Oracle, state: State, noise: float) -> tuple[tuple[int, float, float], ...]:
    """Find up to four coordinates whose derivative is not that of J: (coordinate, derivative, difference quotient)."""
    theta, problem = state.point.theta, oracle.problem
    wrong = []
    for i in np.flatnonzero(problem.constraints.movable):
        for sign in (1.0, -1.0):
            unit = np.zeros(theta.size)
            unit[i] = sign * 0.01 * max(abs(theta[i]), problem.size[i], 1e-3)

            def line(fraction: float, unit: FloatArray = unit) -> tuple[float, float] | None:
                sample = oracle.sample(theta + fraction * unit, 1)
                return None if sample is None else _along(sample, state, unit)

            smooth = min(problem.breakpoints.next_on(theta, unit), 1.0)
            measured = wrong_slope(line, noise, smooth)
            if measured is not None:
                stated = state.point.plus.gradient[i]
                wrong.append((int(i), float(stated), float(measured / unit[i])))
                break
    return tuple(wrong[:4])


def _who_bends(oracle: Oracle, theta: FloatArray, step: FloatArray, found: Finding) -> list[int]:
    """Find the coordinates along which the derivative of J jumps at a kink on the line."""
    width = max(2.0**-40 * found.at, 1e-15)
    sides = [oracle.sample(theta + (found.at + w) * step, 1) for w in (-width, width)]
    moving = np.flatnonzero(step).tolist()
    if sides[0] is None or sides[1] is None:
        return moving[:4]
    jumps = np.abs((sides[1].gradient - sides[0].gradient) * step)
    return [i for i in moving if jumps[i] > 0.1 * jumps.max()][:4]


def _who_jumps(oracle: Oracle, theta: FloatArray, step: FloatArray, found: Finding) -> tuple[tuple[int, float], ...]:
    """Find the coordinate whose change by a hair across a jump of J makes it jump, and its value there.

    Up to four coordinates that the step moves, where none of them does so alone.
    """
    width = max(2.0**-40 * found.at, 1e-15)
    before, after = theta + (found.at - width) * step, theta + (found.at + width) * step
    base, half = oracle.sample(before, 1), 0.5 * abs(found.after - found.before)
    for i in np.flatnonzero(before != after):
        moved = before.copy()
        moved[i] = after[i]
        there = oracle.sample(moved, 1)
        if base is not None and there is not None and abs(there.cost - base.cost) > half:
            return ((int(i), float(after[i])),)
    return tuple((int(i), float(after[i])) for i in np.flatnonzero(step)[:4])
