"""J over two unknowns, and the joint confidence region of two unknowns by likelihood ratio.

With J_p(u, v) the smallest cost with two unknowns held at u and v, a joint confidence region is

    2 (J_p(u, v) - J) / s^2 <= threshold,      s^2 = 1 or, with sigma unknown, 2 J / (n - d),

with the quantile of chi-square with 2 degrees of freedom as threshold or, with sigma unknown, twice that of F with 2
and n - d. Where residuals are correlated, s^2 is multiplied by the square of the larger of the factors by which the
standard errors of the two are corrected ([1]_, "vertical" adjustment). Laplace's approximation is the ellipse of the
same threshold in the covariance of the two. Both reach beyond the intervals of the single unknowns, since they hold for
the two together.

References
----------
.. [1] R. E. Chandler, S. Bate, Inference for clustered data using the independence loglikelihood, Biometrika 94 (2007)
   167-183.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from switchfit.fit.result import Fit
from switchfit.fit.solution import constraints_of, minimize_cost
from switchfit.optimize import Status
from switchfit.optimize.constraints import LinearConstraints
from switchfit.problem.data import FloatArray
from switchfit.problem.validation import as_callable, as_count, as_level, as_name, join_names, shorten
from switchfit.runtime.progress import Progress, show_progress
from switchfit.uncertainty.profiles import check_has_profile
from switchfit.uncertainty.residuals import measure_widening

FEWEST_POINTS = 5
WIDE = 5.0
"""Standard errors to each side that a map of the cost shows."""
MARGIN = 1.5
"""Size of the first grid of a region, relative to the intervals of the two unknowns."""
ENLARGEMENTS = 4
"""Largest number of times that the grid is enlarged because the region reaches its edge."""
ITERATIONS = 60
"""Largest number of iterations of one fit with two unknowns held."""


@dataclass(frozen=True, eq=False)
class CostGrid:
    """The cost over two unknowns.

    Attributes
    ----------
    names, units : (str, str)
    x, y : (P,), (Q,)
        Values of the first and the second unknown.
    costs : (Q, P)
        NaN where constraints forbid the point, or the model cannot be integrated.
    optimum : (float, float)
        The estimate.
    cost : float
        J there.
    bounds : (2, 2)
        Lower and upper bound of each of the two.
    """

    names: tuple[str, str]
    units: tuple[str, str]
    x: FloatArray
    y: FloatArray
    costs: FloatArray
    optimum: tuple[float, float]
    cost: float
    bounds: FloatArray


@dataclass(frozen=True, eq=False)
class JointRegion:
    """The joint confidence region of two unknowns.

    Attributes
    ----------
    grid : CostGrid
        The smallest costs with the two unknowns held.
    level : float
    threshold : float
        Of the likelihood ratio.
    scale : float
        s^2, by which the cost is divided; larger where residuals are correlated.
    ellipse : (L, 2) or None
        Laplace's approximation; None where an unknown is held by a kink, and its variance is 0.
    corrected : bool
        Whether both allow for correlated residuals.
    """

    grid: CostGrid
    level: float
    threshold: float
    scale: float
    ellipse: FloatArray | None
    corrected: bool = False

    @property
    def ratio(self) -> FloatArray:
        """The likelihood ratio on the grid: (Q, P)."""
        return 2 * (self.grid.costs - self.grid.cost) / self.scale


def find_pair(fit: Fit, first: str, second: str) -> tuple[int, int]:
    """Return the places in theta of two different unknowns.

    Parameters
    ----------
    fit : Fit
    first, second : str
        Of `theta_names`.

    Raises
    ------
    ValueError
        If one does not exist, or they are the same.
    """
    for argument, name in (("first", first), ("second", second)):
        if as_name(name, argument) not in fit.theta_names:
            raise ValueError(f"there is no unknown {shorten(name)}; the unknowns are {join_names(fit.theta_names)}.")
    if first == second:
        raise ValueError(f"first and second must be two different unknowns; got {shorten(first)} twice.")
    return fit.theta_names.index(first), fit.theta_names.index(second)


def compute_joint_threshold(fit: Fit, level: float) -> float:
    """Return the threshold of the likelihood ratio of two unknowns: of chi-square, or twice F if sigma is unknown.

    Parameters
    ----------
    fit : Fit
    level : float, between 0 and 1
    """
    outside = 1 - as_level(level)
    if fit.sigma_known is not False:
        return float(-2 * np.log(outside))
    freedom = max(fit.freedom, 1)
    return float(freedom * (outside ** (-2 / freedom) - 1))


def compute_ellipse(covariance: FloatArray, threshold: float, points: int = 120) -> FloatArray | None:
    """Return the ellipse ``z' C^-1 z = threshold`` about 0, (points, 2); None unless C (2, 2) is positive definite.

    Parameters
    ----------
    covariance : (2, 2)
    threshold : float
    points : int
    """
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(root).all():
        return None
    angles = np.linspace(0, 2 * np.pi, points)
    return np.sqrt(threshold) * np.stack([np.cos(angles), np.sin(angles)], axis=1) @ root.T


def compute_cost_grid(estimate: Any, first: str, second: str, *, points: int = 41) -> CostGrid:
    """Return J over two unknowns, all others held at the estimate.

    Parameters
    ----------
    estimate : Estimate
    first, second : str
    points : int
        Along each axis.
    """
    fit: Fit = estimate
    pair = find_pair(fit, first, second)
    points = as_count(points, "points", at_least=FEWEST_POINTS)
    evaluator = estimate.evaluator_at_solution()
    constraints = constraints_of(evaluator.problem)
    axes = [np.linspace(*_choose_span(fit, k), points) for k in pair]
    costs = np.full((points, points), np.nan)
    theta = fit.theta.copy()
    for i, j in np.ndindex(points, points):
        theta[list(pair)] = axes[0][j], axes[1][i]
        if not _is_feasible(constraints, theta):
            continue
        try:
            cost = evaluator.cost(theta)
        except ValueError:  # the model cannot be integrated there
            continue
        costs[i, j] = cost if np.isfinite(cost) else np.nan
    return _build_grid(fit, pair, axes, costs)


def _choose_span(fit: Fit, k: int) -> tuple[float, float]:
    """Return the values of an unknown that a map shows: some standard errors to each side, inside its bounds."""
    value, error = float(fit.theta[k]), float(fit.standard_errors[k])
    low, high = float(fit.lower[k]), float(fit.upper[k])
    if not (np.isfinite(error) and error > 0):
        error = (high - low) / (2 * WIDE) if np.isfinite(high - low) else 0.04 * (abs(value) or 1.0)
    return max(value - WIDE * error, low), min(value + WIDE * error, high)


def _build_grid(fit: Fit, pair: tuple[int, int], axes: list[FloatArray], costs: FloatArray) -> CostGrid:
    a, b = pair
    bounds = np.stack([fit.lower, fit.upper], axis=1)[[a, b]]
    names, units = (fit.theta_names[a], fit.theta_names[b]), (fit.theta_units[a], fit.theta_units[b])
    return CostGrid(names, units, axes[0], axes[1], costs, (float(fit.theta[a]), float(fit.theta[b])), fit.cost, bounds)


def _is_feasible(constraints: LinearConstraints, theta: FloatArray) -> bool:
    slack = constraints.A @ theta - constraints.b
    inside = np.all((constraints.lower <= theta) & (theta <= constraints.upper))
    return bool(inside and np.all(slack >= -1e-12 * (1 + np.abs(constraints.b))))


def compute_region(
    estimate: Any,
    first: str,
    second: str,
    *,
    level: float = 0.95,
    points: int = 21,
    callback: Progress | None = None,
) -> JointRegion:
    """Return the joint confidence region of two unknowns: all others are fitted again at each point of a grid.

    Parameters
    ----------
    estimate : Estimate
        Its cost must consist of `Measurements` alone.
    first, second : str
    level : float, between 0 and 1
    points : int
        Along each axis.
    callback : callable, optional
        ``callback(done, total)`` after each fit; a true return value stops: the rest of the grid is then NaN.

    Raises
    ------
    ValueError
        For an estimate without a noise model, its problem or a minimum, and for an unknown without an interval.
    """
    fit: Fit = estimate
    pair = find_pair(fit, first, second)
    points = as_count(points, "points", at_least=FEWEST_POINTS)
    threshold = compute_joint_threshold(fit, level)
    if callback is not None:
        as_callable(callback, "callback", "a function callback(done, total)", arguments=2)
    evaluator = estimate.evaluator_at_solution()
    check_has_profile(fit)
    widening = float(measure_widening(fit)[list(pair)].max())
    spans = [_find_reach(estimate, k, level, threshold, widening) for k in pair]
    bounds = [(float(fit.lower[k]), float(fit.upper[k])) for k in pair]
    scale = widening**2 * (fit.residual_variance if fit.sigma_known is False else 1.0)
    report, end = show_progress(callback, f"Region of {first} and {second}")
    stopped: list[bool] = []

    def stops(done: int, total: int) -> bool:
        if report(done, total):
            stopped.append(True)
        return bool(stopped)

    try:
        for attempt in range(ENLARGEMENTS + 1):
            axes = [np.linspace(*span, points) for span in spans]
            costs = _fit_grid(fit, evaluator, pair, axes, stops)
            inside = 2 * (costs - fit.cost) / scale <= threshold
            open_sides = [[inside[:, 0].any(), inside[:, -1].any()], [inside[0].any(), inside[-1].any()]]
            wider = [_enlarge(*part) for part in zip(spans, bounds, open_sides, strict=True)]
            if wider == spans or stopped or attempt == ENLARGEMENTS:
                break
            spans = wider
    finally:
        end()
    grid = _build_grid(fit, pair, axes, costs)
    around = compute_ellipse(widening**2 * fit.covariance[np.ix_(pair, pair)], threshold)
    ellipse = None if around is None else np.array(grid.optimum) + around
    return JointRegion(grid, level, threshold, scale, ellipse, widening > 1.0)


def _find_reach(estimate: Any, k: int, level: float, threshold: float, widening: float) -> tuple[float, float]:
    """Return the values of an unknown on the first grid: its interval, wider by a margin and for two unknowns."""
    low, high = estimate.confidence_intervals(level)[k]
    value = float(estimate.theta[k])
    half = MARGIN * widening * max(high - value, value - low) * np.sqrt(threshold) / estimate.quantile(level)
    if not (np.isfinite(half) and half > 0):
        raise ValueError(
            f"{estimate.theta_names[k]} has no interval, as it is held or not determined: there is no region of it. "
            "Choose another unknown."
        )
    return max(value - half, float(estimate.lower[k])), min(value + half, float(estimate.upper[k]))


def _enlarge(span: tuple[float, float], bounds: tuple[float, float], is_open: list[Any]) -> tuple[float, float]:
    """Return the span, enlarged by half of it where the region reaches its end, up to the bounds."""
    more = 0.5 * (span[1] - span[0])
    return (
        max(span[0] - more, bounds[0]) if is_open[0] else span[0],
        min(span[1] + more, bounds[1]) if is_open[1] else span[1],
    )


def _fit_grid(fit: Fit, evaluator: Any, pair: tuple[int, int], axes: list[FloatArray], report: Progress) -> FloatArray:
    """Return the smallest cost with two unknowns held at each point of a grid, outwards from the estimate."""
    constraints = constraints_of(evaluator.problem)
    both = list(pair)
    centre = fit.theta[both]
    size = np.array([axis[-1] - axis[0] for axis in axes])
    shape = len(axes[1]), len(axes[0])
    costs = np.full(shape, np.nan)
    found: dict[tuple[int, int], FloatArray] = {}
    here = fit.covariance[np.ix_(both, both)]
    slope = np.zeros((len(fit.theta), 2))  # along which the other unknowns follow, to first order
    if np.isfinite(fit.covariance[:, both]).all() and np.linalg.cond(here) < 1e12:
        slope = fit.covariance[:, both] @ np.linalg.inv(here)
    places = sorted(np.ndindex(*shape), key=lambda p: _measure_distance(p, axes, centre, size))
    for done, (i, j) in enumerate(places):
        point = np.array([axes[0][j], axes[1][i]])
        near = [found[q] for q in ((i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1)) if q in found]
        starts = [fit.theta + slope @ (point - centre), *near[:2], fit.theta]
        best = None
        for start in starts:
            best = _fit_held(fit, evaluator, constraints, both, point, start)
            if best is not None:
                break
        if best is not None:
            found[i, j], costs[i, j] = best
        if report(done + 1, len(places)):
            break
    return costs


def _measure_distance(place: tuple[int, ...], axes: list[FloatArray], centre: FloatArray, size: FloatArray) -> float:
    i, j = place
    return float(np.hypot(*((np.array([axes[0][j], axes[1][i]]) - centre) / size)))


def _fit_held(
    fit: Fit,
    evaluator: Any,
    constraints: LinearConstraints,
    both: list[int],
    point: FloatArray,
    start: FloatArray,
) -> tuple[FloatArray, float] | None:
    """Return theta and J with two unknowns held, fitted from a start; None if it is not feasible or the fit fails."""
    start = np.clip(start, constraints.lower, constraints.upper)
    start[both] = point
    if not _is_feasible(constraints, start):
        return None
    if len(start) == len(both):
        try:
            cost = evaluator.cost(start)
        except ValueError:
            return None
        return (start, cost) if np.isfinite(cost) else None
    lower, upper = constraints.lower.copy(), constraints.upper.copy()
    lower[both] = upper[both] = point
    held = replace(constraints, lower=lower, upper=upper)
    try:
        result = minimize_cost(evaluator, start, "exact", fit.tolerance, ITERATIONS, constraints=held)
    except ValueError:  # infeasible by rounding, or the model cannot be integrated
        return None
    if result.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return (result.theta, result.cost) if np.isfinite(result.cost) else None
