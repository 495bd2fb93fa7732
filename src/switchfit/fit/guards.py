"""State-triggered transitions: their times as functions of the other unknowns.

A guard makes tau_i a function of the other unknowns q: ``c(tau(q), q) = 0``. By the implicit function theorem
``D tau = -C_tau^-1 C_q``, and with the multipliers ``lam = -C_tau^-T D_tau J`` the derivatives of ``J(tau(q), q)`` are

    D J = D_q J + lam C_q,      D² J = Z' D² (J + lam . c) Z,   Z = (-C_tau^-1 C_q; I).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.fit.evaluator import Evaluator, evaluator_of
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.problem.validation import as_instance, join_names, shorten
from switchfit.runtime.presentation import format_line, join_first

ITERATIONS = 60
#: Newton steps below this part of a transition time are rounding.
NEGLIGIBLE = 4 * np.finfo(float).eps
#: Part of the way to the next transition that one step may take.
ROOM = 0.9


@dataclass(frozen=True, eq=False)
class GuardedEvaluation:
    """Cost and derivatives in the unknowns that guards leave free, r of them.

    Attributes
    ----------
    theta : (d,), with the guarded transition times on their guards
    names : tuple of str, the r free unknowns
    cost : J
    gradient : (r,)
    hessian : (r, r)
    times : (g,), the guarded transition times
    times_slope : (g, r), their derivatives

    See Also
    --------
    evaluate_on_guards, Evaluation

    Examples
    --------
    >>> import numpy as np
    >>> import switchfit as sf
    >>> one = np.ones(1)
    >>> found = sf.GuardedEvaluation(np.array([0.45, 9.8]), ("g",), 2.0, one, np.eye(1), 0.45 * one, -0.02 * np.eye(1))
    >>> found.names, found.cost
    (('g',), 2.0)
    """

    theta: FloatArray
    names: tuple[str, ...]
    cost: float
    gradient: FloatArray
    hessian: FloatArray
    times: FloatArray
    times_slope: FloatArray

    def __repr__(self) -> str:
        return format_line(self, f"J = {self.cost:.9g}", join_first(self.names))


def evaluate_on_guards(problem: Problem, theta: ArrayLike | None = None) -> GuardedEvaluation:
    """Evaluate cost, exact gradient and exact Hessian with guarded transitions where their guards put them.

    Parameters
    ----------
    problem : Problem
        With guards; every guarded transition time must be free.
    theta : (d,) array_like, optional
        The guarded times in it are where the search for them begins. The initial guess if left out.

    Returns
    -------
    GuardedEvaluation

    Raises
    ------
    ValueError
        Without guards, or if no transition times near `theta` meet them.
    TypeError
        If an argument is of the wrong type.

    See Also
    --------
    evaluate, HybridSystem

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> import switchfit as sf
    >>> fall = lambda t, x, p: jnp.array([x[1], -p["g"]])
    >>> rest = lambda t, x, p: jnp.zeros(2)
    >>> guards = {("fall", "rest"): lambda t, x, p: x[0]}
    >>> system = sf.HybridSystem({"fall": fall, "rest": rest}, [1.0, 0.0], guards=guards)
    >>> run = sf.Experiment(sf.TerminalCost(lambda x, p: x[1] ** 2), ("fall", "rest"), (0.4,), 0.0, 1.0)
    >>> found = sf.evaluate_on_guards(sf.Problem(system, run, {"g": 9.81}))
    >>> found.names, found.times.round(3)
    (('g',), array([0.452]))
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    find_guarded_places(problem)  # an error where there are no guards
    evaluator = evaluator_of(problem)
    at = on_guards(evaluator, problem.check_theta(theta))
    evaluator = Evaluator(problem, at)  # a mesh for where the transitions really are
    at = on_guards(evaluator, at)
    guarded = find_guarded_places(problem)
    free = np.setdiff1d(np.arange(len(at)), guarded)
    rows = guard_rows(problem)
    # Implicit function theorem on the guards, C being their Jacobian, g the guarded times and f the free unknowns:
    #     S = -C_g^-1 C_f,  lam = -C_g^-T J_g,  Z = (1, S),  gradient Z'J',  Hessian Z' D^2 (J + lam . c) Z
    here = evaluator.constrained(at)
    C = here.jacobian[rows]
    slope: FloatArray = np.asarray(-np.linalg.solve(C[:, guarded], C[:, free]), dtype=np.float64)
    multipliers = np.zeros(len(problem.constraint_names))
    multipliers[rows] = -np.linalg.solve(C[:, guarded].T, here.gradient[guarded])
    Z = np.zeros((len(at), len(free)))
    Z[free, np.arange(len(free))] = 1.0
    Z[guarded] = slope
    return GuardedEvaluation(
        theta=at,
        names=tuple(problem.theta_names[k] for k in free),
        cost=here.cost,
        gradient=here.gradient @ Z,
        hessian=Z.T @ evaluator.constrained(at, multipliers=multipliers).hessian @ Z,
        times=at[guarded],
        times_slope=slope,
    )


def on_guards(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Move the guarded transition times of `theta` onto their guards, by Newton's method.

    Raises
    ------
    ValueError
        If they cannot be.
    """
    problem = evaluator.problem
    guarded, rows = find_guarded_places(problem), guard_rows(problem)
    theta = theta.copy()
    for _ in range(ITERATIONS):
        here = evaluator.constrained(theta)
        c, C = here.constraints[rows], here.jacobian[np.ix_(rows, guarded)]
        if not (np.isfinite(c).all() and np.isfinite(C).all()) or np.linalg.cond(C) > 1e14:
            break
        step = np.zeros(len(theta))
        step[guarded] = -np.linalg.solve(C, c)
        if np.all(np.abs(step[guarded]) <= NEGLIGIBLE * np.maximum(np.abs(theta[guarded]), 1.0)):
            return theta
        # Shortened so that transitions stay in order: behind one another the guards are those of other states.
        theta = theta + _fraction(problem, theta, step) * step
    else:
        if np.all(np.abs(step[guarded]) <= 1e-10 * np.maximum(np.abs(theta[guarded]), 1.0)):
            return theta
    near, names = shorten(theta[guarded].round(6)), join_names(problem.theta_names[k] for k in guarded)
    raise ValueError(
        f"No transition times near {near} put {names} on their guards: the state does not "
        "reach a guard there, or grazes it. Give transition_times nearer to where the guards vanish (sf.simulate shows "
        "the states), or another mode_sequence."
    )


def place_on_near_guards(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Return `theta` on its guards as of `on_guards`, or as it is where there are none, or no such point is near.

    The optimizer may find one that is farther off.
    """
    if not any(structure.guarded for structure in evaluator.problem.structures):
        return theta
    with suppress(ValueError):
        return on_guards(evaluator, theta)
    return theta


def _fraction(problem: Problem, theta: FloatArray, step: FloatArray) -> float:
    """Return the fraction of a step that keeps the transitions in order."""
    unknowns = problem.unknowns
    slack, change = unknowns.A @ theta, unknowns.A @ step
    room = slack - unknowns.b
    closing = change < -1e-300
    return float(min(1.0, ROOM * np.min(np.maximum(room[closing], 0.0) / -change[closing], initial=np.inf)))


def find_guarded_places(problem: Problem) -> NDArray[np.intp]:
    """Return the positions in theta of the guarded transition times, in the order of the guards."""
    places = [problem.places[e][list(s.guarded)] for e, s in enumerate(problem.structures)]
    found = np.concatenate(places).astype(np.intp)
    if len(found) == 0:
        raise ValueError("This problem has no guards: give sf.HybridSystem(guards={(before, after): g}).")
    if np.any(found < 0):
        raise ValueError("A transition with a guard cannot have a fixed time: its guard says when it happens.")
    return found


def guard_rows(problem: Problem) -> NDArray[np.intp]:
    """Return the positions of the guards among the constraints."""
    rows, last = [], 0
    for count, structure in zip(problem.constraint_counts, problem.structures, strict=True):
        rows.append(last + np.arange(len(structure.guarded)))
        last += count
    return np.concatenate(rows).astype(np.intp)
