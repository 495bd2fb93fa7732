"""Check derivatives at any theta: Taylor remainders, and the paper's equations against the discretized cost."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from switchfit.engine.protocol import Evaluation
from switchfit.fit.evaluator import Evaluator, evaluator_of, is_covered_by_paper
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem, require_unknowns
from switchfit.problem.validation import as_flag, as_instance, as_seed
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed, format_line

LARGEST_GAP = 1e-4
"""Largest relative gap between the paper's equations and the discretized cost's derivatives by integration error.

Integration error closes as the steps shrink, a wrong derivative does not. So a larger gap counts only if it is still
there with half the steps. They are needed where a mode is moderately stiff: Omega, equation (12), decays at the sum of
two rates of the state, so that the longest steps that are stable for the state (``|lambda| h`` up to 3.3) are up to
twice too long for Omega, which then grows without bound (LuGre friction: a gap of 1e67, and 1e-6 with half the steps).
"""


class TaylorTable(NamedTuple):
    """Remainders of J along a direction: steps (S,), remainders (S, 3), observed orders (S - 1, 3), and theta (d,)."""

    steps: FloatArray
    remainders: FloatArray
    orders: FloatArray
    theta: FloatArray


def build_taylor_table(evaluator: Evaluator, theta: FloatArray, *, seed: int = 0) -> TaylorTable:
    """Return remainders of J with its gradient and Hessian along a random direction, near theta but off the nodes."""
    at = _move_off_nodes(evaluator, theta)
    base = evaluator(at)
    direction = np.random.default_rng(seed).choice([-1.0, 1.0], size=len(at)) * _choose_scales(base, at)
    largest = _find_room(evaluator, at, direction)
    steps: FloatArray = largest * 0.5 ** np.arange(8.0)
    remainders = np.array([_compute_remainders(evaluator, base, at, h, direction) for h in steps])
    rounding = remainders < 1e3 * np.finfo(float).eps * max(abs(base.cost), float(remainders.max()))
    with np.errstate(divide="ignore", invalid="ignore"):
        orders = np.where(rounding[1:], np.nan, np.log2(remainders[:-1] / remainders[1:]))
    return TaylorTable(steps, remainders, orders, at)


def estimate_orders(orders: FloatArray) -> tuple[float, ...]:
    """Return the median order of each remainder over the steps at which it is not yet rounding; NaN if it always is."""
    return tuple(_take_median(orders[:, k]) for k in range(3))


def are_orders_right(observed: tuple[float, ...]) -> bool:
    """Return whether the orders are at least 1, 2, 3 within 0.25, or not observable because of rounding."""
    return all(order > k - 0.25 or np.isnan(order) for k, order in enumerate(observed, start=1))


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
    gradient_gap, hessian_gap : float
        Relative gap between the paper's equations (6)-(17) and the discretized cost's exact derivatives; infinite if
        the paper's equations overflow, NaN if not checked.
    gradient_gap_halved, hessian_gap_halved : float
        The same with every step halved: smaller by ``2**order`` of the integrator, down to rounding. A large gap that
        closes here was integration error of the paper's adjoints, not a wrong derivative.
    theta : (d,) array
    stiff : bool
        With the stiff solver, the gaps are reported but do not count: the paper's adjoints have boundary layers of
        their own at transitions and samples, which a mesh refined for the state does not resolve.

    See Also
    --------
    check_derivatives, Certificate

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
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
    gradient_gap: float
    hessian_gap: float
    gradient_gap_halved: float
    hessian_gap_halved: float
    theta: FloatArray
    stiff: bool

    def __repr__(self) -> str:
        orders = ", ".join(f"{order:.2f}" for order in self.observed_orders)
        return format_line(self, "passed" if self.passed else "failed", f"observed orders {orders}")

    @property
    def observed_orders(self) -> tuple[float, ...]:
        """Median order of each remainder over the steps at which it is not yet rounding; NaN if it always is."""
        return estimate_orders(self.orders)

    @property
    def passed(self) -> bool:
        """Whether the orders are 1, 2, 3 within 0.25, or not observable, and the methods agree to 1e-4.

        They may agree with half the steps only. False where J is not finite.
        """
        return not self.failures

    @property
    def failures(self) -> tuple[Issue, ...]:
        """What failed; empty if nothing did. Where J is not finite, nothing can be said about its derivatives."""
        return tuple(self._find_failures())

    def _find_failures(self) -> Iterator[Issue]:
        if not np.isfinite(self.remainders).all():
            yield Issue("cost not finite")
            return
        if not are_orders_right(self.observed_orders):
            yield Issue("derivatives of another cost")
        halved = min(self.gradient_gap, self.gradient_gap_halved), min(self.hessian_gap, self.hessian_gap_halved)
        if max(halved) >= LARGEST_GAP and not self.stiff:  # False if not checked: NaN
            yield Issue("derivative gap", figures={"gap": max(halved)})


def check_derivatives(
    problem: Problem, theta: ArrayLike | None = None, *, seed: int = 0, paper: bool = True
) -> DerivativeCheck:
    """Check the gradient and the Hessian of a problem against its cost, and two methods against each other.

    Parameters
    ----------
    problem : Problem
    theta : (d,) array_like, optional
        The initial guess if left out. Transition times that lie on a node of the mesh, or on the time that a late
        sample sees, are moved off it, since derivatives jump there.
    seed : int, optional
        Seed of the random direction.
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
        For a theta of the wrong shape or order, or a negative seed.
    TypeError
        If an argument is of the wrong type.

    See Also
    --------
    evaluate, Certificate

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> problem = heater_problem()

    >>> sf.check_derivatives(problem).passed
    True
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    require_unknowns(problem)
    seed = as_seed(seed)
    at = problem.check_theta(theta)
    # The mesh of the first guess may be far too coarse elsewhere, and integration error would look like wrong adjoints.
    evaluator = evaluator_of(problem) if theta is None else Evaluator(problem, at)
    table = build_taylor_table(evaluator, at, seed=seed)
    at = table.theta
    gaps = halved = np.nan, np.nan
    if as_flag(paper, "paper"):
        fine = evaluator.halved
        gaps, halved = measure_derivative_gap(evaluator.pad_like(fine), at), measure_derivative_gap(fine, at)
    return DerivativeCheck(
        table.steps, table.remainders, table.orders, *gaps, *halved, at, evaluator.takes_implicit_steps
    )


def measure_derivative_gap(evaluator: Evaluator, theta: FloatArray) -> tuple[float, float]:
    """Return the relative gap of gradient and Hessian between the paper's equations and the discretized cost.

    NaN if the paper's equations do not cover the cost, infinite if they overflow. Each unknown is scaled to unit
    curvature. Near a minimum the gradient vanishes; its gap is then relative to the gradient after a change of all
    unknowns by 0.1 %.
    """
    if not is_covered_by_paper(evaluator.problem):
        return np.nan, np.nan
    paper, discrete = evaluator(theta, method="adjoint"), evaluator(theta)
    scale = 1.0 / np.sqrt(np.maximum(np.abs(np.diag(discrete.hessian)), 1e-300))
    small = 1e-3 * float(np.linalg.norm(theta / scale))
    scales = np.outer(scale, scale)
    return (
        _measure_gap(paper.gradient * scale, discrete.gradient * scale, small),
        _measure_gap(paper.hessian * scales, discrete.hessian * scales, 0.0),
    )


def measure_closing_gap(evaluator: Evaluator, theta: FloatArray) -> tuple[float, float]:
    """Return the gaps of `measure_derivative_gap`; where one is too large, the smaller ones with half the steps."""
    gaps = measure_derivative_gap(evaluator, theta)
    if not max(gaps) > LARGEST_GAP or evaluator.takes_implicit_steps:
        return gaps
    return min(gaps, measure_derivative_gap(evaluator.halved, theta), key=max)


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
    late = _list_late_times(evaluator, theta)
    for i, nodes in enumerate(evaluator.breakpoints()):
        if len(nodes):
            nodes = np.union1d(nodes, late[i]) if i in late else nodes
            k = int(np.clip(np.searchsorted(nodes, theta[i], side="right") - 1, 0, len(nodes) - 2))
            moved[i] = 0.5 * (nodes[k] + nodes[k + 1])
    return moved


def _find_room(evaluator: Evaluator, theta: FloatArray, direction: FloatArray) -> float:
    """Return the largest step with every transition time in its cell, and changes of unknowns small against their size.

    Nor may a transition pass the time that a late sample sees, which moves with the delay.
    """
    room = 1e-2 * np.min(np.where(theta != 0, np.abs(theta), 1.0) / np.abs(direction))
    for i, nodes in enumerate(evaluator.breakpoints()):
        if len(nodes):
            room = min(room, 0.9 * np.min(np.abs(nodes - theta[i])) / abs(direction[i]))
    late, moved = _list_late_times(evaluator, theta), _list_late_times(evaluator, theta + direction)
    for i, moments in late.items():
        closing = np.maximum(np.abs(moved[i] - moments - direction[i]), 1e-300)
        room = min(room, 0.9 * np.min(np.abs(moments - theta[i]) / closing))
    return float(room)


def _list_late_times(evaluator: Evaluator, theta: FloatArray) -> dict[int, FloatArray]:
    """Return the times that late samples see, by the transition times in theta of their runs."""
    problem = evaluator.problem
    found: dict[int, FloatArray] = {}
    for e, where in enumerate(problem.unknowns.times):
        moments = problem.late_times(theta, e)
        found |= {int(i): moments for i in where[where >= 0] if len(moments)}
    return found


def _compute_remainders(
    evaluator: Evaluator, base: Evaluation, theta: FloatArray, h: float, direction: FloatArray
) -> tuple[float, float, float]:
    zeroth = evaluator(theta + h * direction).cost - base.cost
    first = zeroth - h * base.gradient @ direction
    second = first - 0.5 * h**2 * direction @ base.hessian @ direction
    return abs(zeroth), abs(float(first)), abs(float(second))


def _take_median(orders: FloatArray) -> float:
    finite = orders[np.isfinite(orders)]
    return float(np.median(finite)) if len(finite) else np.nan
