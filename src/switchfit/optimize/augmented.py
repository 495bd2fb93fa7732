"""Equality constraints for the optimiser: augmented Lagrangian.

The problem is to minimise J(theta) subject to c(theta) = 0 and to the linear constraints of `minimize`. In turn

1. ``L = J + lam . c + 1/2 rho . c²`` is minimised by `minimize`, which keeps its linear constraints and kinks;
2. ``lam`` becomes ``lam + rho c``, and rho grows where c did not shrink enough.

With second derivatives of c in the Hessian every such minimisation after the first takes a step or two, and c shrinks
by a factor that is inversely proportional to rho each time.

References
----------
J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, section 17.3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from switchfit.optimize.algebra import FloatArray
from switchfit.optimize.dense import Dense, split_space
from switchfit.optimize.matrix import Curvature, Spectrum, diagonal_scaling
from switchfit.optimize.sqp import minimize
from switchfit.optimize.status import Callback, IterationRecord, Result, Status

#: The first penalty, in units of the curvature of J along the constraints.
PENALTY = 10.0
#: The penalty grows this much where a constraint shrinks by less than SHRINK.
GROWTH, SHRINK = 10.0, 0.1
#: Largest penalty in those units: beyond it rounding of c is seen in the gradient.
LARGEST_PENALTY = 1e6
#: A constraint is met where c is below this part of what changing the unknowns by their own size makes of it, ...
MET = 1e-9
#: ... and it is tried to get below this.
WANTED = 1e-14
OUTER_ITERATIONS = 40


class Constrained(Protocol):
    """What the caller's function returns at theta: J, and c (m,) with derivatives (m, d), beside L and its own."""

    @property
    def cost(self) -> float: ...
    @property
    def gradient(self) -> FloatArray: ...
    @property
    def value(self) -> float: ...
    @property
    def slope(self) -> FloatArray: ...
    @property
    def hessian(self) -> FloatArray: ...
    @property
    def constraints(self) -> FloatArray: ...
    @property
    def jacobian(self) -> FloatArray: ...


Evaluate = Callable[[FloatArray, int, FloatArray, FloatArray], Constrained]
"""``evaluate(theta, side, multipliers (m,), penalty (m,))``."""


@dataclass(frozen=True)
class _Lagrangian:
    """L as a cost for `minimize`."""

    cost: float
    gradient: FloatArray
    hessian: FloatArray


@dataclass(frozen=True, eq=False)
class ConstrainedResult:
    """Outcome of `minimize_constrained`.

    Attributes
    ----------
    result : Result
        Its cost and gradient are those of J, its Hessian that of J + multipliers . c, its optimality the KKT residual,
        and its free directions those that the constraints leave.
    constraints, multipliers : (m,)
    """

    result: Result
    constraints: FloatArray
    multipliers: FloatArray


def minimize_constrained(
    evaluate: Evaluate,
    theta0: FloatArray,
    names: tuple[str, ...],
    *,
    tolerance: float,
    max_iterations: int,
    scale: FloatArray,
    callback: Callback | None = None,
    **settings: Any,
) -> ConstrainedResult:
    """Minimise J subject to c = 0 and linear constraints.

    Parameters
    ----------
    evaluate : callable
        Returns a `Constrained`; `side` as of `minimize`.
    theta0 : (d,)
    names : what to call the m constraints in messages
    tolerance, max_iterations, callback : as of `minimize`; iterations count over all minimisations
    scale : (d,)
        theta0 in units whose zero means nothing: what the unknowns change by is measured by it.
    settings : the other arguments of `minimize`
    """
    m, d = len(names), len(theta0)
    theta: FloatArray = np.array(theta0, dtype=float)
    multipliers: FloatArray = np.zeros(m)
    first = evaluate(theta, 1, multipliers, np.zeros(m))
    size = np.where(scale != 0.0, np.abs(scale), 1.0)
    unit = _lengths(first.jacobian * size)
    curvature = float(np.max(np.abs(np.diag(first.hessian)) * size**2, initial=0.0))
    # Where J is flat, its change over the size of the unknowns.
    curvature = max(curvature, float(np.max(np.abs(first.gradient) * size, initial=0.0)), 1e-8)
    penalty = PENALTY * curvature / unit**2
    highest = penalty * LARGEST_PENALTY / PENALTY
    if np.isfinite(first.jacobian).all() and np.isfinite(first.gradient).all():
        found = np.linalg.lstsq((first.jacobian * size).T, first.gradient * size, rcond=None)[0]
        multipliers = -np.asarray(found, dtype=np.float64)

    history: list[IterationRecord] = []
    evaluations, before = 1, np.full(m, np.inf)
    for _ in range(OUTER_ITERATIONS):
        done = history[-1] if history else None
        result = minimize(
            lambda theta, side, lam=multipliers, rho=penalty: _lagrangian(evaluate(theta, side, lam, rho)),  # type: ignore[misc]  # mypy cannot infer the defaults
            theta,
            tolerance=tolerance,
            max_iterations=max(max_iterations - (done.iteration if done else 0), 0),
            callback=None if callback is None else lambda record, done=done: callback(record.continue_from(done)),  # type: ignore[misc]
            **settings,
        )
        numbered = [record.continue_from(done) for record in result.history]
        history += numbered[1:] if history else numbered
        evaluations += result.evaluations
        theta = result.theta
        if result.status in (Status.INTERRUPTED, Status.NONFINITE_START, Status.MAX_ITERATIONS):
            break
        c = evaluate(theta, 1, multipliers, penalty).constraints
        violation = np.abs(c) / unit
        if not violation.max() > WANTED or (violation.max() <= MET and violation.max() > SHRINK * before.max()):
            break
        multipliers = multipliers + penalty * c
        slow = violation > SHRINK * before
        if np.all(penalty[slow] >= highest[slow]) and slow.all():
            break
        penalty = np.where(slow, np.minimum(GROWTH * penalty, highest), penalty)
        before = violation
    return _finish(evaluate, result, history, evaluations, multipliers, names, unit, tolerance, d)


def _finish(
    evaluate: Evaluate,
    result: Result,
    history: list[IterationRecord],
    evaluations: int,
    multipliers: FloatArray,
    names: tuple[str, ...],
    unit: FloatArray,
    tolerance: float,
    d: int,
) -> ConstrainedResult:
    """Return the last minimisation's result in terms of J."""
    side = 1
    here = evaluate(result.theta, side, multipliers, np.zeros(len(names)))
    left = here.jacobian @ result.free_basis
    free = result.free_basis @ split_space(left)[0] if np.isfinite(left).all() else result.free_basis
    scaling = diagonal_scaling(Dense(here.hessian), np.zeros(d)) if np.isfinite(here.hessian).all() else np.ones(d)
    basis = np.linalg.qr(free * scaling[:, None])[0] if free.shape[1] else free
    values, vectors = np.linalg.eigh(basis.T @ (here.hessian / np.outer(scaling, scaling)) @ basis)
    violated = [
        (name, float(value))
        for name, value, size in zip(names, here.constraints, unit, strict=True)
        if not abs(value) <= MET * size
    ]
    status = result.status
    if violated and status not in (Status.INTERRUPTED, Status.NONFINITE_START, Status.MAX_ITERATIONS):
        status = Status.INFEASIBLE
    unscaled = np.linalg.eigvalsh(free.T @ here.hessian @ free)
    lowest = basis @ vectors[:, 0] / scaling if len(values) else np.zeros(d)
    length = max(float(np.linalg.norm(lowest)), np.finfo(float).tiny)
    spectrum = Spectrum(np.asarray(values), np.asarray(unscaled), lowest / length)
    final = replace(
        result,
        cost=here.cost,
        gradient=here.gradient,
        hessian=here.hessian,
        iterations=history[-1].iteration if history else 0,
        evaluations=evaluations,
        status=status,
        curvature=Curvature(free, spectrum.itself),
        history=tuple(history),
        violated=tuple(violated),
    )
    return ConstrainedResult(final, here.constraints, multipliers)


def _lagrangian(here: Constrained) -> _Lagrangian:
    return _Lagrangian(here.value, here.slope, here.hessian)


def _lengths(rows: FloatArray) -> FloatArray:
    """Return the norm of each row, 1 where it vanishes: (m,)."""
    norms = np.linalg.norm(rows, axis=1)
    return np.where(np.isfinite(norms) & (norms > 0.0), norms, 1.0)
