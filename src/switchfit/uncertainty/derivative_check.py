"""Check derivatives at any theta: Taylor remainders, and the paper's equations against the discretized cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Evaluation
from switchfit.meshes.evaluator import Evaluator, evaluator_of, is_covered_by_paper
from switchfit.meshes.halving import halve_cells
from switchfit.problem.comparisons import find_bends
from switchfit.problem.problem import Problem, require_unknowns
from switchfit.problem.validation.objects import as_flag, as_instance
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed, format_line

LARGEST_GAP = 1e-4
"""Largest relative gap between the paper's equations and the discretized cost's derivatives by integration error.

Integration error closes as the steps shrink, a wrong derivative does not. So a larger gap counts only if it is still
there with half the steps. They are needed where a mode is moderately stiff: Omega, equation (12), decays at the sum of
two rates of the state, so that the longest steps that are stable for the state (``|lambda| h`` up to 3.3) are up to
twice too long for Omega, which then grows without bound (LuGre friction: a gap of 1e67, and 1e-6 with half the steps).
"""


@dataclass(frozen=True, eq=False)
class DerivativeCheck(Printed):
    """Taylor table and gaps between the methods; print it.

    Attributes
    ----------
    steps : (S,) array
        Step lengths h.
    remainders : (S, 3) array
        ``|J(theta + h v) - J|``, the same minus ``h g.v``, and the same minus ``h^2/2 v'Hv``.
    orders : (S - 1, 3) array
        Observed orders in h, which are 1, 2 and 3 if J, g and H are right; NaN where a remainder is rounding.
    theta : (d,) array
    stiff : bool
        With the stiff solver, the gaps are reported but do not count: the paper's adjoints have boundary layers of
        their own at transitions and samples, which a mesh refined for the state does not resolve.
    gradient_gap, hessian_gap : float
        Relative gap between the paper's equations (6)-(17) and the discretized cost's exact derivatives; with half the
        steps if it is above 1e-4 without: integration error of the paper's adjoints closes then, a wrong derivative
        does not. Infinite if the paper's equations overflow, NaN if not checked.
    switch : str
        Which function compares an unknown with an input or the time, and where; empty if none does.

    See Also
    --------
    check_derivatives, Certificate

    Examples
    --------
    >>> problem = heater_problem()

    >>> check = sf.check_derivatives(problem)
    >>> check.passed
    True
    >>> [round(order) for order in check.observed_orders]
    [1, 2, 3]
    """

    steps: FloatArray
    remainders: FloatArray
    orders: FloatArray
    theta: FloatArray
    stiff: bool
    gradient_gap: float = np.nan
    hessian_gap: float = np.nan
    switch: str = ""

    def __repr__(self) -> str:
        orders = ", ".join(f"{order:.2f}" for order in self.observed_orders)
        return format_line(self, "passed" if self.passed else "failed", f"observed orders {orders}")

    @property
    def observed_orders(self) -> tuple[float, ...]:
        """Median order of each remainder over the steps at which it is not yet rounding; NaN if it always is."""
        finite = [order[np.isfinite(order)] for order in self.orders.T]
        return tuple(float(np.median(each)) if len(each) else np.nan for each in finite)

    @property
    def passed(self) -> bool:
        """Whether the orders are 1, 2, 3 within 0.25, or not observable, and the methods agree to 1e-4.

        False where J is not finite.
        """
        return not self.failures

    @property
    def failures(self) -> tuple[Issue, ...]:
        """What failed; empty if nothing did. Where J is not finite or jumps, nothing can be said about derivatives."""
        if not np.isfinite(self.remainders).all():
            return (Issue("cost not finite"),)
        if not are_orders_right(self.observed_orders[:1]):
            return (Issue("cost not continuous"),)
        wrong = Issue("hidden switch", (self.switch,)) if self.switch else Issue("derivatives of another cost")
        found = [] if are_orders_right(self.observed_orders) else [wrong]
        largest = max(self.gradient_gap, self.hessian_gap)
        if largest > LARGEST_GAP and not self.stiff:  # False if not checked: NaN
            found.append(Issue("derivative gap", figures={"gap": largest}))
        return tuple(found)


UNCHECKED = DerivativeCheck(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), stiff=False)
"""Of derivatives that were not checked: gaps and orders are NaN, and nothing failed."""


def check_derivatives(problem: Problem, theta: ArrayLike | None = None, *, paper: bool = True) -> DerivativeCheck:
    """Check the gradient and the Hessian of a problem against its cost, and two methods against each other.

    Parameters
    ----------
    problem : Problem
    theta : (d,) array_like, optional
        The initial guess if left out. Transition times that lie on a node of the mesh, or on the time that a late
        sample sees, are moved off it, since derivatives jump there.
    paper : bool, optional
        Whether to compare with the paper's equations too, which JAX takes seconds to compile. Without it the gaps are
        NaN.

    Returns
    -------
    DerivativeCheck
        Print it, or look at ``.passed``.

    Raises
    ------
    ValueError
        For a theta of the wrong shape or order.
    TypeError
        If an argument is of the wrong type.

    See Also
    --------
    evaluate, Certificate

    Examples
    --------
    >>> problem = heater_problem()

    >>> sf.check_derivatives(problem).passed
    True
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    require_unknowns(problem)
    at = problem.check_theta(theta)
    # The mesh of the first guess may be far too coarse elsewhere, and integration error would look like wrong adjoints.
    # At the first guess the meshes are those of the fit, made once.
    evaluator = evaluator_of(problem) if theta is None else Evaluator(problem, at)
    return compare_derivatives(evaluator, at, paper=as_flag(paper, "paper"))


def compare_derivatives(evaluator: Evaluator, theta: FloatArray, *, paper: bool) -> DerivativeCheck:
    """Return remainders of J with its gradient and Hessian along a random direction, near theta but off the nodes, and
    the gaps to the paper's equations there if these are asked for.
    """
    # J is smooth between nodes only: across one its derivatives jump, and Taylor orders would say nothing.
    at = _move_off_nodes(evaluator, theta)
    base = evaluator(at)
    # Every unknown takes part, changing J by about as much as the others: with one direction along an axis of large
    # curvature, an error in the others would drown. The seed makes a check repeatable.
    direction = np.random.default_rng(0).choice([-1.0, 1.0], size=len(at)) * _choose_scales(base, at)
    largest = _find_room(evaluator, at, direction)
    # Halved steps: a remainder of order k falls by 2^k, so that log2 of the ratio is k.
    steps: FloatArray = largest * 0.5 ** np.arange(8.0)
    zeroth = np.array([evaluator(at + h * direction).cost for h in steps]) - base.cost
    first = zeroth - steps * (base.gradient @ direction)
    second = first - 0.5 * steps**2 * (direction @ base.hessian @ direction)
    remainders = np.abs(np.stack([zeroth, first, second], axis=1))
    # J has a relative rounding error of many operations, not of one; below a thousand of them the ratio is random.
    rounding = remainders < 1e3 * np.finfo(float).eps * max(abs(base.cost), float(remainders.max()))
    with np.errstate(divide="ignore", invalid="ignore"):
        orders = np.where(rounding[1:], np.nan, np.log2(remainders[:-1] / remainders[1:]))
    gaps = measure_closing_gap(evaluator, at) if paper else (np.nan, np.nan)
    switch = next(iter(find_bends(evaluator.problem).values()), "")
    return DerivativeCheck(steps, remainders, orders, at, evaluator.takes_implicit_steps, *gaps, switch)


def are_orders_right(observed: tuple[float, ...]) -> bool:
    """Return whether the orders are at least 1, 2, 3 within 0.25, or not observable because of rounding."""
    return all(order > k - 0.25 or np.isnan(order) for k, order in enumerate(observed, start=1))


def measure_derivative_gap(evaluator: Evaluator, theta: FloatArray) -> tuple[float, float]:
    """Return the relative gap of gradient and Hessian between the paper's equations and the discretized cost.

    NaN if the paper's equations do not cover the cost, infinite if they overflow. Each unknown is scaled to unit
    curvature. Near a minimum the gradient vanishes; its gap is then relative to the gradient after a change of all
    unknowns by 0.1 %.
    """
    if not is_covered_by_paper(evaluator.problem):
        return np.nan, np.nan
    # Two derivations that share nothing but the modes: optimise, then discretise, against the exact derivatives of what
    # is discretised.
    paper, discrete = evaluator(theta, method="adjoint"), evaluator(theta)
    scale = 1.0 / np.sqrt(np.maximum(np.abs(np.diag(discrete.hessian)), 1e-300))
    # In scaled unknowns the curvature is about 1: 0.1 % of all of them changes the gradient by 1e-3 |theta / scale|.
    small = 1e-3 * float(np.linalg.norm(theta / scale))
    scales = np.outer(scale, scale)
    return (
        _measure_gap(paper.gradient * scale, discrete.gradient * scale, small),
        _measure_gap(paper.hessian * scales, discrete.hessian * scales, 0.0),
    )


def measure_closing_gap(evaluator: Evaluator, theta: FloatArray) -> tuple[float, float]:
    """Return the gaps of `measure_derivative_gap`; where one is too large, the smaller ones with half the steps."""
    gaps = measure_derivative_gap(evaluator, theta)
    # NaN, the gap of what the paper does not cover, is not above anything.
    if not max(gaps) > LARGEST_GAP or evaluator.takes_implicit_steps:
        return gaps
    # An integration error falls with the steps; a wrong derivative has the same gap on both meshes.
    return min(gaps, measure_derivative_gap(halve_cells(evaluator), theta), key=max)


def _measure_gap(a: FloatArray, b: FloatArray, floor: float) -> float:
    """Return the norm of a - b relative to that of b, which is finite; infinite if a is not."""
    if not np.isfinite(a).all():
        return np.inf
    return float(np.linalg.norm(a - b)) / max(float(np.linalg.norm(b)), floor, 1e-300)


def _choose_scales(base: Evaluation, theta: FloatArray) -> FloatArray:
    """Return changes of the unknowns that each change J by about as much as the others."""
    curvature = np.abs(np.diag(base.hessian))
    typical = np.where(theta != 0, np.abs(theta), 1.0)
    return np.where(curvature > 0, 1.0 / np.sqrt(np.where(curvature > 0, curvature, 1.0)), typical)


def _move_off_nodes(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Return theta with each transition time in the middle of its cell, where J is smooth over the longest distance."""
    moved = theta.copy()
    for i, breaks in enumerate(_list_breaks(evaluator, theta)):
        if len(breaks):
            nodes = np.unique(breaks)
            k = int(np.clip(np.searchsorted(nodes, theta[i], side="right") - 1, 0, len(nodes) - 2))
            moved[i] = 0.5 * (nodes[k] + nodes[k + 1])
    return moved


def _find_room(evaluator: Evaluator, theta: FloatArray, direction: FloatArray) -> float:
    """Return the largest step with every transition time in its cell, and each unknown changed little for its size."""
    # 1 % of each unknown: beyond that a model that is exponential in one of them is no cubic any more.
    room = 1e-2 * np.min(np.where(theta != 0, np.abs(theta), 1.0) / np.abs(direction))
    here, there = (_list_breaks(evaluator, at) for at in (theta, theta + direction))
    for i, breaks in enumerate(here):
        # Breaks move too: the time that a late sample sees moves with the delay. What counts is how fast the unknown
        # and its break come nearer to each other along the direction.
        closing = np.maximum(np.abs(there[i] - breaks - direction[i]), 1e-300)
        room = min(room, np.min(0.9 * np.abs(breaks - theta[i]) / closing, initial=np.inf))
    return float(room)


def _list_breaks(evaluator: Evaluator, theta: FloatArray) -> list[FloatArray]:
    """Return where the derivatives of J in each unknown jump: of a transition time at the nodes of its run, and at the
    times that late samples see, which move with the delay; of any other nowhere.
    """
    found, problem = list(evaluator.breakpoints()), evaluator.problem
    for e, where in enumerate(problem.unknowns.times):
        for i in where[where >= 0].tolist():
            found[i] = np.append(found[i], problem.late_times(theta, e))
    return found
