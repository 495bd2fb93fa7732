"""State-triggered transitions: their times, and J, as functions of the unknowns that guards leave free.

A guard makes tau_i a function of the other unknowns q: ``c(tau(q), q) = 0``. By the implicit function theorem
``D tau = -C_tau^-1 C_q``, and with the multipliers ``lam = -C_tau^-T D_tau J`` the derivatives of ``J(tau(q), q)`` are

    D J = D_q J + lam C_q,      D² J = Z' D² (J + lam . c) Z,   Z = (-C_tau^-1 C_q; I).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.problem import Problem
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.objects import as_instance
from switchfit.runtime.presentation import format_line, join_first

NEWTON_STEPS_TO_GUARDS = 60

#: After a Newton step below this part of a transition time, its error is rounding.
NEGLIGIBLE_TIME_STEP = 1e-10

#: Part of the way to the next transition that one step may take.
PART_OF_WAY_TO_NEXT = 0.9


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
    evaluator, at = place_on_guards(problem, problem.check_theta(theta))
    guarded, rows = find_guards(problem)
    # lam = -C_g^-T J_g, gradient Z'J', Hessian Z' D^2 (J + lam . c) Z
    here = evaluator.constrained(at)
    Z = find_free_directions(problem, here.jacobian)
    multipliers = np.zeros(len(problem.constraint_names))
    multipliers[rows] = -np.linalg.solve(here.jacobian[np.ix_(rows, guarded)].T, here.gradient[guarded])
    return GuardedEvaluation(
        theta=at,
        names=tuple(name for k, name in enumerate(problem.theta_names) if k not in guarded),
        cost=here.cost,
        gradient=here.gradient @ Z,
        hessian=Z.T @ evaluator.constrained(at, multipliers=multipliers).hessian @ Z,
        times=at[guarded],
        times_slope=Z[guarded],
    )


def place_on_guards(problem: Problem, theta: FloatArray) -> tuple[Evaluator, FloatArray]:
    """Return theta with guarded transition times on their guards, and the problem on meshes for where they are.

    On the mesh of the first guess, the times of a stiff model miss their guards by more than their standard errors.

    Raises
    ------
    ValueError
        Without guards, or if no transition times near `theta` meet them.
    """
    near = _solve_guards(Evaluator(problem, theta), theta)
    evaluator = Evaluator(problem, near)
    return evaluator, _solve_guards(evaluator, near)


def find_free_directions(problem: Problem, jacobian: FloatArray) -> FloatArray:
    """Return the changes of theta that guards allow, one for each of the r unknowns that they leave free: (d, r).

    By the implicit function theorem, C being the Jacobian of the guards, g the guarded times and f the free unknowns,
    ``Z = (1, S)`` with ``S = -C_g^-1 C_f``.

    Parameters
    ----------
    problem : Problem
    jacobian : (m, d)
        Of all constraints.
    """
    guarded, rows = find_guards(problem)
    C, Z = jacobian[rows], np.delete(np.eye(jacobian.shape[1]), guarded, axis=1)
    Z[guarded] = -np.linalg.solve(C[:, guarded], np.delete(C, guarded, axis=1))
    return Z


def _solve_guards(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Move the guarded transition times of `theta` onto their guards, by Newton's method."""
    problem = evaluator.problem
    guarded, rows = find_guards(problem)
    for _ in range(NEWTON_STEPS_TO_GUARDS):
        here = evaluator.constrained(theta)
        c, C = here.constraints[rows], here.jacobian[np.ix_(rows, guarded)]
        if not (np.isfinite(c).all() and np.isfinite(C).all()) or np.linalg.cond(C) > 1e14:
            break
        step = np.zeros(len(theta))
        step[guarded] = -np.linalg.solve(C, c)
        # Shortened so that transitions stay in order: behind one another the guards are those of other states.
        theta = theta + _limit_step(problem, theta, step) * step
        if np.all(np.abs(step[guarded]) <= NEGLIGIBLE_TIME_STEP * np.maximum(np.abs(theta[guarded]), 1.0)):
            return theta
    near, names = shorten(theta[guarded].round(6)), join_names(problem.theta_names[k] for k in guarded)
    raise ValueError(
        f"No transition times near {near} put {names} on their guards: the state does not "
        "reach a guard there, or grazes it. Give transition_times nearer to where the guards vanish (sf.simulate shows "
        "the states), or another mode_sequence."
    )


def _limit_step(problem: Problem, theta: FloatArray, step: FloatArray) -> float:
    """Return the fraction of a step that keeps the transitions in order."""
    unknowns = problem.unknowns
    room, change = unknowns.A @ theta - unknowns.b, unknowns.A @ step
    closing = change < -1e-300
    return float(
        min(1.0, PART_OF_WAY_TO_NEXT * np.min(np.maximum(room[closing], 0.0) / -change[closing], initial=np.inf))
    )


def find_guards(problem: Problem) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the positions in theta of the guarded transition times, and those of their guards among the constraints.

    Raises
    ------
    ValueError
        Without guards, or if a guarded time is fixed.
    """
    places = [problem.places[e][list(s.guarded)] for e, s in enumerate(problem.structures)]
    first = np.cumsum([0, *problem.constraint_counts])
    rows = [first[e] + np.arange(len(s.guarded)) for e, s in enumerate(problem.structures)]
    found = np.concatenate(places).astype(np.intp)
    if len(found) == 0:
        raise ValueError("This problem has no guards: give sf.HybridSystem(guards={(before, after): g}).")
    if np.any(found < 0):
        raise ValueError("A transition with a guard cannot have a fixed time: its guard says when it happens.")
    return found, np.concatenate(rows).astype(np.intp)
