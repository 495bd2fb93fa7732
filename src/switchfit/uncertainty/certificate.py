"""Checks of the numbers of a fit, computed from the fit and not taken from the optimizer.

Check derivatives at any theta: Taylor remainders, and the paper's equations against the discretized cost.

Find the combinations of unknowns that the data determine badly, and test them by evaluating J along them.

The Hessian scaled to unit curvature of each unknown, ``S H S`` with ``S = diag(H)^(-1/2)``, does not depend on units:
its eigenvalues would all be 1 if every unknown were determined independently of the others. An eigenvector v with a
small eigenvalue lambda is a badly determined combination: a step of length s along ``S v`` changes J by lambda s^2 / 2.

A statement such as "tau_2 later and mu lower leaves J as it is" is made for the step at which the quadratic form
predicts that J rises by `Identifiability.rise`. J is evaluated there on both sides, and the result is what is printed.
If J rises by more than twice the prediction, since the valley bends, the step is halved until it does not.

Before a fit, the same is done with noise-free data simulated at the first guess: the cost is 0 there, its gradient
vanishes, and its exact Hessian is the Gauss-Newton matrix (the expected information).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Evaluation
from switchfit.fit.evaluator import Evaluator, evaluator_of, is_covered_by_paper, measure_variation
from switchfit.fit.result import Fit, Kink, compute_scaled_spectrum, moves_by_itself
from switchfit.fit.solution import refuse_hidden_switches
from switchfit.fit.trajectory import compare, replace_values
from switchfit.optimize import Status
from switchfit.optimize.curvature import null_space
from switchfit.problem.comparisons import find_bends
from switchfit.problem.constraints import ActiveConstraint
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem, require_unknowns
from switchfit.problem.reads import find_unread
from switchfit.problem.validation.objects import as_flag, as_instance
from switchfit.runtime import special
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed, format_line, join_first

LARGEST_GAP = 1e-4
"""Largest relative gap between the paper's equations and the discretized cost's derivatives by integration error.

Integration error closes as the steps shrink, a wrong derivative does not. So a larger gap counts only if it is still
there with half the steps. They are needed where a mode is moderately stiff: Omega, equation (12), decays at the sum of
two rates of the state, so that the longest steps that are stable for the state (``|lambda| h`` up to 3.3) are up to
twice too long for Omega, which then grows without bound (LuGre friction: a gap of 1e67, and 1e-6 with half the steps).
"""

WEAK = 0.05
"""Scaled eigenvalues below this are reported: standard errors along them are 4.5 times those of each unknown alone."""

MOST = 3
"""Largest number of directions that are reported."""

NAMED = 0.2
"""Unknowns with less than this part of the largest weight in a direction are not named."""

UNDETERMINED = 1e-10
"""Scaled eigenvalues below this are zero."""

HALVINGS = 20
Cost = Callable[[FloatArray], float]

Meaning = Literal["noise", "1 % of J", "1 % of variation"]
"""Meaning of a rise of J: hidden by noise in 95 % of all cases, 1 % of J, or caused by a change of all measured values
by 1 % of their variation."""

LARGE_INTEGRATION_ERROR = 1e-6
"""Relative change of J or of a constraint by halving the steps, above which it counts as inaccurate."""

NEGATIVE = -1e-8
"""Eigenvalues of the scaled Hessian below this are negative curvature, not rounding."""


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
    evaluator = evaluator_of(problem) if theta is None else Evaluator(problem, at)
    return compare_derivatives(evaluator, at, paper=as_flag(paper, "paper"))


def compare_derivatives(evaluator: Evaluator, theta: FloatArray, *, paper: bool) -> DerivativeCheck:
    """Return remainders of J with its gradient and Hessian along a random direction, near theta but off the nodes, and
    the gaps to the paper's equations there if these are asked for.
    """
    at = _move_off_nodes(evaluator, theta)
    base = evaluator(at)
    direction = np.random.default_rng(0).choice([-1.0, 1.0], size=len(at)) * _choose_scales(base, at)
    largest = _find_room(evaluator, at, direction)
    steps: FloatArray = largest * 0.5 ** np.arange(8.0)
    zeroth = np.array([evaluator(at + h * direction).cost for h in steps]) - base.cost
    first = zeroth - steps * (base.gradient @ direction)
    second = first - 0.5 * steps**2 * (direction @ base.hessian @ direction)
    remainders = np.abs(np.stack([zeroth, first, second], axis=1))
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
    for i, breaks in enumerate(_list_breaks(evaluator, theta)):
        if len(breaks):
            nodes = np.unique(breaks)
            k = int(np.clip(np.searchsorted(nodes, theta[i], side="right") - 1, 0, len(nodes) - 2))
            moved[i] = 0.5 * (nodes[k] + nodes[k + 1])
    return moved


def _find_room(evaluator: Evaluator, theta: FloatArray, direction: FloatArray) -> float:
    """Return the largest step with every transition time in its cell, and each unknown changed little for its size."""
    room = 1e-2 * np.min(np.where(theta != 0, np.abs(theta), 1.0) / np.abs(direction))
    here, there = (_list_breaks(evaluator, at) for at in (theta, theta + direction))
    for i, breaks in enumerate(here):
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


@dataclass(frozen=True, eq=False)
class Direction:
    """A combination of the unknowns, and the rise of J along it.

    Attributes
    ----------
    eigenvalue : float
        Eigenvalue of the Hessian scaled to unit curvature of each unknown.
    weights : (d,)
        Its eigenvector, in scaled unknowns, the largest entry positive.
    change : (d,)
        The change of theta that was tried, a multiple of the scaled eigenvector, in the units of theta.
    rises : (float, float)
        Rise of J at theta + change and at theta - change; NaN at a point that is not feasible.
    names : tuple of str
        Unknowns with the largest weights, the largest first.

    See Also
    --------
    Identifiability, identifiability

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> worst = fit.identifiability.directions[0]
    >>> worst.names
    ('tau_1', 'k')
    >>> worst.summary
    'tau_1 and k trade off'
    """

    eigenvalue: float
    weights: FloatArray
    change: FloatArray
    rises: tuple[float, float]
    names: tuple[str, ...]

    def __repr__(self) -> str:
        return format_line(self, self.summary, f"scaled eigenvalue = {self.eigenvalue:.2g}")

    @property
    def summary(self) -> str:
        """The combination in words, such as "tau_2 and mu trade off"."""
        return str(Issue("trade off", self.names))


@dataclass(frozen=True, eq=False)
class Identifiability(Printed):
    """How well data determine the unknowns; print it.

    Attributes
    ----------
    theta_names, theta_units : tuple of str
    is_time : (d,) bool
        Which of the unknowns are transition times.
    rise : float
        Rise of J for which the changes are chosen.
    meaning : {"noise", "1 % of J", "1 % of variation"}
        Meaning of that rise: hidden by noise in 95 % of all cases, 1 % of J, or caused by a change of all measured
        values by 1 % of their variation.
    where : {"solution", "first guess"}
    cost : float
        J there, to which a rise is compared; NaN if it is not compared.
    eigenvalues : (k,)
        Eigenvalues, ascending, of the Hessian scaled to unit curvature of each unknown, on the free directions.
    without : tuple of str
        Unknowns on which the cost does not depend at all, to second order.
    held : tuple of str
        Unknowns that a constraint, a kink or a collapsed mode holds; they are not analyzed.
    directions : tuple of Direction
        The badly determined directions, at most three; the worst direction is always among them.
    tried : bool
        Whether J was evaluated along the directions.
    idle, unread, absent : tuple of str
        Unknowns on which the cost does not depend because modes have collapsed, because no function of the model reads
        them, or because they are read only by modes that do not occur, as in `Fit`.

    See Also
    --------
    identifiability, Direction, profile

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> found = fit.identifiability
    >>> found.condition_number < 100, found.undetermined
    (True, 0)
    """

    theta_names: tuple[str, ...]
    theta_units: tuple[str, ...]
    is_time: NDArray[np.bool_]
    rise: float
    meaning: Meaning
    where: Literal["solution", "first guess"]
    cost: float
    eigenvalues: FloatArray = field(default_factory=lambda: np.zeros(0))
    without: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    directions: tuple[Direction, ...] = ()
    tried: bool = False
    idle: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()

    def __repr__(self) -> str:
        worst = self.directions[0].summary if self.directions else ""
        return format_line(self, join_first(self.theta_names), f"condition number = {self.condition_number:.2g}", worst)

    @property
    def condition_number(self) -> float:
        """Condition number of the scaled Hessian; infinite if it is singular."""
        if not len(self.eigenvalues) or self.without or self.eigenvalues[0] <= UNDETERMINED:
            return np.inf if len(self.eigenvalues) or self.without else np.nan
        return float(self.eigenvalues[-1] / self.eigenvalues[0])

    @property
    def undetermined(self) -> int:
        """Number of combinations that the data do not determine at all."""
        return len(self.without) + int(np.sum(self.eigenvalues < UNDETERMINED))


def identifiability(subject: Any) -> Identifiability:
    """Return how well the data determine the unknowns, at the solution of a fit or, before any fit, at the first guess.

    Parameters
    ----------
    subject : Estimate or Problem

    Returns
    -------
    Identifiability

    Raises
    ------
    TypeError
        For anything else.
    ValueError
        If a parameter of the problem changes the cost while its derivative is zero: a switch hidden in a function.

    See Also
    --------
    profile, Estimate.correlation

    Examples
    --------
    >>> problem = heater_problem()

    >>> found = sf.identifiability(problem)
    >>> found.where, found.undetermined
    ('first guess', 0)
    """
    if isinstance(subject, Problem):
        return _analyse_first_guess(subject)
    if isinstance(subject, Fit):
        fit: Any = subject
        return analyse_solution(fit, None if fit.problem is None else fit.evaluator_at_solution())
    raise TypeError(f"identifiability needs an sf.Estimate or an sf.Problem; got {type(subject).__name__}.")


def analyse_solution(fit: Fit, evaluator: Evaluator | None) -> Identifiability:
    """Analyze the solution of a fit; without an evaluator, J is not evaluated along the directions.

    Parameters
    ----------
    fit : Fit
    evaluator : Evaluator or None
    """
    meaning: Meaning
    if fit.sigma_known is None:
        rise, meaning = 0.01 * abs(fit.cost), "1 % of J"
    else:
        scale = fit.variance_scale if fit.freedom > 0 else 1.0
        # The likelihood ratio 2 (J - J_0) / scale is at the square of the quantile there.
        rise, meaning = 0.5 * scale * fit.quantile(0.95) ** 2, "noise"
    about = Identifiability(fit.theta_names, fit.theta_units, fit.is_time, rise, meaning, "solution", fit.cost)
    about = replace(about, idle=fit.idle, unread=fit.unread, absent=fit.absent)
    cost = None if evaluator is None else _limit_cost(evaluator, fit.theta)
    return analyse(about, fit.hessian, fit.free_basis, fit.theta, cost)


def _analyse_first_guess(problem: Problem) -> Identifiability:
    """Analyze a problem at its first guess, with Measurements replaced by data simulated there."""
    theta, unknowns = problem.initial_theta, problem.unknowns
    own = evaluator_of(problem)
    refuse_hidden_switches(own, theta, own(theta).gradient)
    items = [item for run in problem.experiments for item in run.data]
    meaning: Meaning
    base = np.nan
    if all(isinstance(item, Measurements) for item in items):
        comparisons = compare(own, theta)[1]
        fitted = {(e, k): found.fitted for e, run in enumerate(comparisons) for k, found in enumerate(run)}
        clean = replace_values(problem, fitted)
        evaluator = Evaluator(clean, meshes=own.meshes)
        # If sigma is a parameter, J has no minimum without noise; its expected Hessian is the Gauss-Newton matrix.
        hessian = evaluator(theta, matrix="exact" if problem.is_least_squares else "gauss-newton").hessian
        if all(item.sigma is not None for item in items):
            rise, meaning = 0.5 * float(special.ndtri(0.975)) ** 2, "noise"
        else:
            rise, meaning = 1e-4 * float(measure_variation(clean).sum()), "1 % of variation"
    else:
        evaluator = own
        here = own(theta, matrix="gauss-newton")
        hessian, base = here.hessian, here.cost
        rise, meaning = 0.01 * abs(here.cost), "1 % of J"
    subject = unknowns.names, unknowns.units, unknowns.is_time
    about = Identifiability(*subject, rise, meaning, "first guess", base, **find_unread(problem)._asdict())
    # J of clean data has no slope, and guards no multipliers: its own curvature counts, along the guards.
    basis = null_space(own.constrained(theta).jacobian) if problem.constraint_names else np.eye(len(theta))
    return analyse(about, hessian, basis, theta, _limit_cost(evaluator, theta))


def _limit_cost(evaluator: Evaluator, centre: FloatArray) -> Cost:
    """Return J as a function of theta, NaN where bounds or the order of times are violated; not so at the centre, which
    may be on a constraint up to rounding.
    """

    def compute_cost(theta: FloatArray) -> float:
        is_allowed = theta is centre or bool(np.all(evaluator.problem.constraints.slack(theta) >= 0))
        return evaluator(theta).cost if is_allowed else np.nan

    return compute_cost


def analyse(
    about: Identifiability, hessian: FloatArray, basis: FloatArray, theta: FloatArray, cost: Cost | None
) -> Identifiability:
    """Return the badly determined directions of a Hessian, tested with the cost it belongs to.

    Parameters
    ----------
    about : Identifiability
        What is known before.
    hessian : (d, d)
    basis : (d, k)
        Orthonormal basis of the free directions.
    theta : (d,)
    cost : callable ``theta -> J``, or None
        NaN where theta is not feasible. With None, J is not evaluated along the directions.
    """
    names = np.array(about.theta_names, dtype=object)
    free = np.abs(basis).max(1, initial=0.0) > 1e-9
    about = replace(about, held=tuple(names[~free]), tried=cost is not None)
    if not free.any() or not np.isfinite(hessian).all():
        return about
    # Unknowns on which the cost does not depend at all are reported separately.
    without = moves_by_itself(basis) & np.all(hessian == 0.0, axis=1)
    values, vectors, size = compute_scaled_spectrum(hessian, basis)
    kept = ~(np.sum(vectors[without] ** 2, axis=0) > 0.5)
    values, vectors = values[kept], vectors[:, kept]
    shown = min(max(int(np.sum(values < WEAK)), 1), MOST)  # the worst in any case
    directions = []
    for value, v in zip(values[:shown].tolist(), vectors.T[:shown], strict=True):
        # An eigenvector has no sign of its own: the largest entry is made positive.
        v = v * np.sign(v[np.argmax(np.abs(v))])
        change, rises = _try_direction(size * v, value, theta, cost, about.rise)
        strong = [i for i in np.argsort(-np.abs(v), kind="stable") if abs(v[i]) > NAMED * np.abs(v).max()]
        directions.append(Direction(value, v, change, rises, tuple(names[strong])))
    return replace(about, eigenvalues=values, without=tuple(names[without]), directions=tuple(directions))


def _try_direction(
    direction: FloatArray, eigenvalue: float, theta: FloatArray, cost: Cost | None, rise: float
) -> tuple[FloatArray, tuple[float, float]]:
    """Return the change along a direction (d,) at which J should rise by `rise`, and its actual rises on both sides."""
    known = theta != 0
    # No unknown moves by more than its own size, if it is not zero.
    share = np.max(np.abs(direction[known] / theta[known]), initial=0.0)
    reach = 1.0 / float(share or np.max(np.abs(direction)))
    # J rises by eigenvalue length^2 / 2 along a unit vector of the scaled Hessian.
    length = min(np.sqrt(2 * rise / eigenvalue), reach) if eigenvalue > 0 else reach
    change = length * direction
    if cost is None or not rise > 0:
        return change, (np.nan, np.nan)
    here = cost(theta)
    rises = (np.nan, np.nan)
    for _ in range(HALVINGS):
        rises = cost(theta + change) - here, cost(theta - change) - here
        if np.fmax(*rises) <= 2 * rise:
            break
        change = 0.5 * change
    return change, rises


@dataclass(frozen=True)
class Certificate(Printed):
    """Checks of the numbers of a fit.

    Attributes
    ----------
    optimality : float
        KKT residual at the solution.
    smallest_eigenvalue : float
        Smallest eigenvalue of the Hessian on the free directions; if it is positive, the second-order sufficient
        condition holds. NaN if nothing is free.
    smallest_scaled_eigenvalue : float
        The same with each unknown scaled to unit curvature: 1 is perfectly determined, 0 is not determined at all.
    condition_number : float
        Condition number of that scaled Hessian.
    worst_unknowns : tuple of str
        Unknowns with the largest components in the worst-determined direction, the largest first.
    integration_error : float
        Largest relative change by halving all steps of J, the guards and the terminal constraints. For J it is relative
        to J, or to 1e-3 of the first J if that is more; for a constraint, to the sum of its changes over the ranges of
        the states in the run.
    gradient_gap, hessian_gap : float
        Relative gap between the paper's equations (6)-(17) and the exact derivatives of the discretized cost; with half
        the steps if it is above 1e-4 without (`DerivativeCheck` says why), NaN if not checked.
    taylor_orders : tuple of float
        Orders of the remainders of J, of J with its gradient and of J with its Hessian along a random direction: at
        least 1, 2, 3 if the derivatives are right (2, 2, 3 at a minimum, where the gradient vanishes); NaN if a
        remainder is rounding, or if not checked.
    active : tuple of ActiveConstraint
        Constraints that hold with equality, including collapsed modes and bounds.
    kinks : tuple of Kink
    failures : tuple of Issue
        Failed checks; empty if the certificate is good.
    integration_error_of : str
        The output that has the `integration_error`: "J", or the name of a guard or terminal constraint.

    See Also
    --------
    estimate, check_derivatives, Estimate.certificate

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> fit.certificate.failures
    ()
    >>> fit.certificate.integration_error < 1e-8
    True
    >>> fit.certificate.hessian_gap < 1e-5
    True
    """

    optimality: float
    smallest_eigenvalue: float
    smallest_scaled_eigenvalue: float
    condition_number: float
    worst_unknowns: tuple[str, ...]
    integration_error: float
    gradient_gap: float
    hessian_gap: float
    taylor_orders: tuple[float, ...]
    active: tuple[ActiveConstraint, ...]
    kinks: tuple[Kink, ...]
    failures: tuple[Issue, ...]
    integration_error_of: str = "J"

    @property
    def passed(self) -> bool:
        """Whether no check failed."""
        return not self.failures

    @property
    def worst_direction(self) -> str:
        """The worst-determined direction in words, such as "tau_2 and mu trade off"; "none" if nothing is free."""
        return str(Issue("trade off", self.worst_unknowns))


def certify(fit: Fit, evaluator: Evaluator | None) -> Certificate:
    """Check a fit.

    Parameters
    ----------
    fit : Fit
    evaluator : Evaluator or None
        Evaluator of its problem, with meshes refined at the solution. Without it, the paper's equations are not
        evaluated, and gaps and Taylor orders are NaN.

    Returns
    -------
    Certificate
    """
    found, Z = analyse_solution(fit, None), fit.free_basis
    scaled, is_known = found.eigenvalues, Z.shape[1] > 0 and np.isfinite(fit.hessian).all()
    check = UNCHECKED if evaluator is None else compare_derivatives(evaluator, fit.theta, paper=True)
    smallest = float(scaled[0]) if len(scaled) else np.nan
    return Certificate(
        optimality=fit.optimality,
        smallest_eigenvalue=float(np.linalg.eigvalsh(Z.T @ fit.hessian @ Z)[0]) if is_known else np.nan,
        smallest_scaled_eigenvalue=smallest,
        condition_number=found.condition_number if len(scaled) else np.inf,
        worst_unknowns=found.directions[0].names if found.directions else (),
        integration_error=fit.integration_error,
        integration_error_of=fit.integration_error_of,
        gradient_gap=check.gradient_gap,
        hessian_gap=check.hessian_gap,
        taylor_orders=check.observed_orders,
        active=fit.active,
        kinks=fit.kinks,
        failures=tuple(_find_failures(fit, smallest, check)),
    )


def _find_failures(fit: Fit, smallest: float, check: DerivativeCheck) -> Iterator[Issue]:
    """Return the checks that failed."""
    as_precise_as_possible = fit.status.successful and fit.status is not Status.CONVERGED
    if not as_precise_as_possible and not fit.optimality <= fit.tolerance:
        yield Issue("optimality", figures={"optimality": fit.optimality, "tolerance": fit.tolerance})
    if smallest < NEGATIVE:
        yield Issue("negative curvature", figures={"eigenvalue": smallest})
    if not fit.integration_error <= LARGE_INTEGRATION_ERROR:
        yield Issue("integration error", (fit.integration_error_of,), {"error": fit.integration_error})
    yield from (issue for issue in check.failures if issue.kind == "derivative gap")
    # The first order is not tested: at a minimum, the gradient vanishes.
    if not are_orders_right((np.nan, *check.observed_orders[1:])):
        orders = Issue("Taylor orders", figures={"orders": check.observed_orders})
        yield Issue("hidden switch", (check.switch,)) if check.switch else orders
