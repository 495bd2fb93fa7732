"""Profile likelihoods: the cost as a function of one unknown, with all others fitted again.

With J_p(v) the smallest cost at theta_k = v, the signed root of the likelihood ratio,

    zeta(v) = sign(v - theta_k) sqrt(2 (J_p(v) - J) / s^2),      s^2 = 1 or, with sigma unknown, 2 J / (n - d),

is standard normal at the true value to first order, Student's t with n - d degrees of freedom where sigma is unknown,
so that ``|zeta| <= quantile`` is a confidence region ([1]_, [2]_). For a linear model zeta is the straight line
``(v - theta_k) / standard error``, and the region is the quadratic interval. The curvature of zeta shows the error of
that interval.

All computations here use zeta. It is nearly linear, so that it predicts the next step, and its crossing of the quantile
is found in a few more evaluations. An evaluation is one more fit, started at the result of a neighboring one, with the
unknown's lower and upper bound set to v; it uses the compiled program of the original fit.

References
----------
.. [1] D. M. Bates, D. G. Watts, Nonlinear Regression Analysis and Its Applications, Wiley 1988, chapter 6.
.. [2] W. Q. Meeker, L. A. Escobar, Teaching about approximate confidence regions based on maximum likelihood
   estimation, The American Statistician 49 (1995) 48-53.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, linprog, minimize_scalar

from switchfit.engine.adaptive import refine_mesh
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Fit
from switchfit.fit.solution import constraints_of, minimize_cost
from switchfit.optimize import Status, solve_qp
from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.problem import Problem
from switchfit.problem.validation import as_callable, as_level, as_name, join_names, shorten
from switchfit.runtime.frames import Tabular
from switchfit.runtime.presentation import draw_figure, format_html, format_line, format_text
from switchfit.runtime.progress import Progress, show_progress
from switchfit.uncertainty.piecewise import list_sample_times

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

End = Literal["crossed", "limit", "flat", "failed", "stopped"]

STEPS = 5
"""Points between the estimate and the crossing of the threshold, on each side."""
BEYOND = 1.15
"""The march continues until zeta is this many times the threshold ..."""
LOOK_AHEAD = 3
"""... and then adds this many points for a second region, each twice as far out as the one before; twice as many while
the cost falls outwards."""
MOST_POINTS = 60
"""Largest number of points on one side."""
LONGEST_GROWTH = 2.5
"""Largest ratio of a step to the one before."""
FAR = 1e2
"""A side is flat if the threshold is not crossed up to this many times the unknown's size or its standard error."""
HALVINGS = 8
"""Largest number of times that a step is reduced because a fit fails or zeta rises too much."""
LARGE_ERROR = 1e-2
"""Integration error of zeta^2, as a part of the threshold, above which the mesh is refined."""
MOST_KINKS = 10
"""Largest number of sample times at which a profile is evaluated, to show the kinks there."""
ITERATIONS = 100
"""Largest number of iterations of one fit along the profile."""


@dataclass(frozen=True, eq=False)
class Point:
    """One fit with the unknown held at `value`; `slope` is the derivative of its cost in that value."""

    value: float
    cost: float
    slope: float
    theta: FloatArray
    converged: bool


class Trace:
    """The points of a profile; it adds points where they are needed.

    Attributes
    ----------
    points : list of Point
        Ascending in value, the estimate among them.
    ends : dict
        How the march to the lower (-1) and to the upper (+1) side ended.
    jumps : list of float
        Values at which the threshold was crossed by a jump: the minimum in the other unknowns ends there.
    interrupted : bool
        Whether the profile was interrupted: no more points are added.
    coarse : bool
        Whether the mesh is too coarse at the ends.
    """

    def __init__(self, fit: Fit, evaluator: Evaluator, index: int) -> None:
        self.fit, self.evaluator, self.index = fit, evaluator, index
        self.constraints = constraints_of(evaluator.problem)
        self.scale = fit.residual_variance if fit.sigma_known is False else 1.0
        value = float(fit.theta[index])
        self.centre = Point(value, evaluator(fit.theta).cost, 0.0, fit.theta, True)
        self.points = [self.centre]
        self.ends: dict[int, End] = {}
        self.fits = 0
        self.limits = {side: self._find_limit(side) for side in (-1, 1)}
        self.interrupted = False
        self.jumps: list[float] = []
        self.coarse = False
        self.should_stop: Callable[[], bool] = lambda: False

    # --- properties of points

    def zeta(self, point: Point) -> float:
        """Return the signed root of the likelihood ratio; 0 where the cost is below that of the estimate."""
        root = np.sqrt(max(2 * (point.cost - self.centre.cost) / self.scale, 0.0))
        return float(root if point.value > self.centre.value else -root)

    def side(self, side: int) -> list[Point]:
        """Return the points of one side from the estimate outwards, the estimate first."""
        chosen = [q for q in self.points if side * (q.value - self.centre.value) >= 0]
        return sorted(chosen, key=lambda q: side * q.value)

    @property
    def best(self) -> Point:
        """The point with the lowest cost."""
        return min(self.points, key=lambda q: q.cost)

    # --- adding points

    def _find_limit(self, side: int) -> float:
        """Return the limit that the constraints set to the unknown on one side."""
        k, c = self.index, self.constraints
        coupled = np.flatnonzero(np.any(c.A != 0, axis=0))
        if k not in coupled:
            return float((c.lower if side < 0 else c.upper)[k])
        objective = np.where(coupled == k, -float(side), 0.0)
        bounds = np.stack([c.lower, c.upper], axis=1)[coupled]
        found = linprog(objective, -c.A[:, coupled], -c.b, bounds=bounds)
        # The centre is feasible; rounding of the linear program must not put a limit on the wrong side of it.
        return side * max(side * float(found.x[coupled == k][0]), side * float(self.fit.theta[k]))

    def _find_feasible(self, target: FloatArray, inside: FloatArray) -> FloatArray | None:
        """Return the feasible point nearest to `target` with the same value of the unknown, given a feasible point
        `inside` with another value.

        None if no point is feasible, which rounding may cause at a limit.
        """
        k, c = self.index, self.constraints
        value = target[k]
        moved = np.clip(target, c.lower, c.upper)
        moved[k] = value
        if np.all(c.A @ moved >= c.b):
            return moved
        # Other unknowns move only as far as the constraints force them: a quadratic program in them, which starts on
        # the line from `inside` to a feasible point at the limit. It is feasible since the constraints are convex.
        side = 1 if value > inside[k] else -1
        extreme = self._find_extreme(side, inside)
        span = extreme[k] - inside[k]
        start = inside + (0.0 if span == 0 else (value - inside[k]) / span) * (extreme - inside)
        start[k] = value
        others = np.arange(len(start)) != k
        size = np.maximum(np.abs(target), 1.0)[others]
        normals = np.concatenate([c.A[:, others], np.eye(len(size)), -np.eye(len(size))])
        slack = np.concatenate([c.A @ start - c.b, (start - c.lower)[others], (c.upper - start)[others]])
        finite = np.isfinite(slack)
        offset = (start - target)[others]
        step = solve_qp(offset / size**2, np.diag(1 / size**2), normals[finite], -np.maximum(slack[finite], 0.0)).step
        start[others] = np.clip(start[others] + step, c.lower[others], c.upper[others])
        violated = c.A @ start - c.b
        return start if np.all(violated >= -1e-9 * (1 + np.abs(c.b))) else None

    def _find_extreme(self, side: int, inside: FloatArray) -> FloatArray:
        """Return a feasible point at the limit; unknowns that no constraint couples with this one are unchanged."""
        c = self.constraints
        coupled = np.flatnonzero(np.any(c.A != 0, axis=0))
        objective = np.where(coupled == self.index, -float(side), 0.0)
        bounds = np.stack([c.lower, c.upper], axis=1)[coupled]
        found = inside.copy()
        found[coupled] = linprog(objective, -c.A[:, coupled], -c.b, bounds=bounds).x
        return found

    def _fit(self, value: float, start: FloatArray) -> Point | None:
        """Return the point at `value`, fitted from `start`; None if the fit fails."""
        lower, upper = self.constraints.lower.copy(), self.constraints.upper.copy()
        lower[self.index] = upper[self.index] = value
        held = replace(self.constraints, lower=lower, upper=upper)
        self.fits += 1
        tolerance = self.fit.tolerance
        try:
            result = minimize_cost(self.evaluator, start, "exact", tolerance, ITERATIONS, constraints=held)
        except ValueError:  # infeasible by rounding
            return None
        if result.status is Status.INTERRUPTED or self.should_stop():
            raise KeyboardInterrupt
        if not np.isfinite(result.cost):
            return None
        # The other unknowns are optimal, so that they contribute nothing to the derivative.
        slope = float(result.gradient[self.index])
        good = result.status.successful
        return Point(value, result.cost, slope, result.theta, good)

    def add(self, value: float, near: Point, before: Point | None = None) -> Point | None:
        """Add a point, fitted from a neighbor or from the line through two neighbors; None if all fits fail."""
        k = self.index
        starts = []
        if before is not None and before.value != near.value:
            slope = (near.theta - before.theta) / (near.value - before.value)
            starts.append(near.theta + (value - near.value) * slope)
        starts += [near.theta.copy(), self.centre.theta.copy()]
        best: Point | None = None
        for start in starts:
            start[k] = value
            feasible = self._find_feasible(start, near.theta)
            found = None if feasible is None else self._fit(value, feasible)
            if found is not None and (
                best is None or (not found.converged, found.cost) < (not best.converged, best.cost)
            ):
                best = found
            if best is not None and best.converged and not self._is_suspicious(best, near):
                break
        if best is not None:
            self._insert(best)
        return best

    def _is_suspicious(self, point: Point, near: Point) -> bool:
        """Return whether zeta rose so much faster than a straight line that this may be another, higher minimum."""
        distance, reached = abs(point.value - self.centre.value), abs(near.value - self.centre.value)
        if reached > 0:
            expected = abs(self.zeta(near)) * distance / reached
        else:
            error = float(self.fit.standard_errors[self.index])
            expected = distance / error if np.isfinite(error) and error > 0 else np.inf
        return abs(self.zeta(point)) > 1.5 * expected + 0.5

    def _insert(self, point: Point) -> None:
        self.points = sorted([q for q in self.points if q.value != point.value] + [point], key=lambda q: q.value)

    # --- marching

    def march(self, side: int, threshold: float) -> None:
        """Add points on one side until zeta has crossed the threshold, or cannot cross it."""
        if self.interrupted or self.ends.get(side) in ("limit", "flat", "failed"):
            return
        spacing = threshold / STEPS
        points = self.side(side)
        if len(points) > 1 and abs(self.zeta(points[-1])) >= BEYOND * threshold:
            self.ends[side] = "crossed"
            return
        step = abs(points[-1].value - points[-2].value) if len(points) > 1 else self._choose_first_step(side, spacing)
        ahead = 0
        self.ends[side] = "stopped"
        for _ in range(MOST_POINTS):
            last = points[-1]
            height = abs(self.zeta(last))
            if last.value == self.limits[side]:
                self.ends[side] = "crossed" if abs(self.zeta(last)) >= threshold else "limit"
                return self._add_minima(side)
            if height >= BEYOND * threshold:
                self.ends[side] = "crossed"
                if ahead >= LOOK_AHEAD * (1 + (side * last.slope < 0)):
                    return self._add_minima(side)
                ahead += 1
                step = abs(last.value - self.centre.value)
            elif abs(last.value - self.centre.value) > self._far:
                self.ends[side] = "flat"
                return
            new = self._add_next(side, points, step, spacing, threshold, looking=ahead > 0)
            if new is None:
                self.ends[side] = "crossed" if height >= threshold else "failed"
                return self._add_minima(side)
            if new.cost < last.cost - 1e-9 * abs(last.cost):
                self._sweep_inward(side)
            points = self.side(side)
            gained = abs(self.zeta(new)) - height
            growth = spacing / gained if gained > 0 else LONGEST_GROWTH
            step = abs(new.value - last.value) * float(np.clip(growth, 0.4, LONGEST_GROWTH))
        self.ends[side] = "flat" if self.ends[side] == "stopped" else self.ends[side]

    def _add_next(
        self, side: int, points: list[Point], step: float, spacing: float, threshold: float, *, looking: bool
    ) -> Point | None:
        """Return the next point outwards; the step is shortened if a fit fails or zeta rises too much."""
        last = points[-1]
        before = points[-2] if len(points) > 1 else self._along_covariance(last)
        limit = self.limits[side]
        for attempt in range(HALVINGS):
            value = last.value + side * step
            if side * (value - limit) >= 0 or abs(value - limit) < 1e-3 * step:
                value = limit
            if value == last.value:
                return None
            new = self.add(value, last, before)
            if new is not None and new.converged:
                gained = abs(self.zeta(new)) - abs(self.zeta(last))
                if looking or gained <= 2.5 * spacing or attempt == HALVINGS - 1:
                    return new
                if abs(self.zeta(new)) > 2 * threshold:
                    self.points = [q for q in self.points if q is not new]
                else:
                    self._fill(last, new, spacing)
                    return new
                step *= float(np.clip(spacing / gained, 0.05, 0.5))
            elif new is not None:
                self.points = [q for q in self.points if q is not new]
                step *= 0.5
            else:
                step *= 0.5
            if step <= 1e-9 * max(abs(last.value), abs(self.centre.value), 1e-300):
                return None
        return None

    def _fill(self, inner: Point, outer: Point, spacing: float) -> None:
        """Add points between two, evenly spaced in zeta if zeta is linear."""
        count = int(abs(self.zeta(outer) - self.zeta(inner)) / spacing)
        previous: Point = inner
        for part in np.arange(1, count) / count:
            found = self.add(inner.value + float(part) * (outer.value - inner.value), previous)
            previous = found if found is not None else previous

    def _add_minima(self, side: int) -> None:
        """Add points at minima between points far apart, where the slopes show one."""
        points = self.side(side)[1:]
        for inner, outer in pairwise(points):
            if side * inner.slope < 0 < side * outer.slope:
                near = min((inner, outer), key=lambda q: q.cost)

                def cost(value: float, near: Point = near) -> float:
                    found = self.add(value, near)
                    return np.inf if found is None else found.cost

                bounds = sorted((inner.value, outer.value))
                minimize_scalar(
                    cost, bounds=bounds, method="bounded", options={"xatol": 1e-3 * (bounds[1] - bounds[0])}
                )

    def _sweep_inward(self, side: int) -> None:
        """Follow a branch of lower cost from its outer end inwards, as long as it remains lower."""
        outer, *inward = self.side(side)[:0:-1]
        for inner in inward:
            start = outer.theta.copy()
            start[self.index] = inner.value
            feasible = self._find_feasible(start, outer.theta)
            found = None if feasible is None else self._fit(inner.value, feasible)
            if found is None or not found.converged or found.cost >= inner.cost - 1e-9 * abs(inner.cost):
                return
            self._insert(found)
            outer = found

    def _along_covariance(self, centre: Point) -> Point | None:
        """Return a second point on the tangent of the profile's path at the estimate: theta moves along C e_k."""
        column = self.fit.covariance[:, self.index]
        if not (np.isfinite(column).all() and column[self.index] > 0):
            return None
        theta = centre.theta - column / column[self.index]
        return Point(float(theta[self.index]), np.nan, np.nan, theta, True)

    def _choose_first_step(self, side: int, spacing: float) -> float:
        """Return the step after which zeta should equal the spacing: from the standard error, or at a kink or a bound
        from the slope.
        """
        k, size = self.index, self._size
        error = self.fit.standard_errors[k]
        if np.isfinite(error) and error > 0:
            return float(spacing * error)
        derivative = self.evaluator(self.centre.theta, side).gradient[k]
        rate = 2 * max(side * float(derivative), 0.0) / self.scale  # of zeta^2
        return min(spacing**2 / rate, 0.1 * size) if rate > 0 else 1e-2 * size

    @property
    def _size(self) -> float:
        """Typical size of the unknown: its feasible range, or its value."""
        span = self.limits[1] - self.limits[-1]
        return float(span if np.isfinite(span) else abs(self.centre.value) or 1.0)

    @property
    def _far(self) -> float:
        error = self.fit.standard_errors[self.index]
        return FAR * max(abs(self.centre.value) or 1.0, float(error) if np.isfinite(error) else 0.0)

    # --- crossings of the threshold

    def find_crossing(self, a: Point, b: Point, threshold: float) -> float:
        """Return where |zeta| equals the threshold, between two neighboring points on different sides of it."""
        found = {a.value: a, b.value: b}
        inner = min((a, b), key=lambda q: abs(q.value - self.centre.value))

        def excess(value: float) -> float:
            point = found.get(value) or self.add(value, min(found.values(), key=lambda q: abs(q.value - value)))
            if point is None:  # use the nearest point that could be fitted
                point = min(found.values(), key=lambda q: abs(q.value - value))
            found[value] = point
            return abs(self.zeta(point)) - threshold

        precision = 1e-7 * max(abs(b.value - a.value), abs(inner.value - self.centre.value))
        root = float(brentq(excess, a.value, b.value, xtol=max(precision, 1e-300), rtol=1e-12))
        if min(abs(abs(self.zeta(q)) - threshold) for q in found.values()) > 1e-3 * threshold:
            self.jumps.append(root)
        return root

    def regions(self, threshold: float) -> list[tuple[float, float]]:
        """Return all intervals found in which |zeta| is at most the threshold, ascending; open ends are infinite."""
        points = list(self.points)
        inside = [abs(self.zeta(q)) <= threshold for q in points]
        low = self._get_open_end(-1) if inside[0] else None
        found: list[tuple[float, float]] = []
        for a, b, a_in, b_in in zip(points[:-1], points[1:], inside[:-1], inside[1:], strict=True):
            if a_in != b_in:
                edge = self.find_crossing(a, b, threshold)
                if b_in:
                    low = edge
                elif low is not None:
                    found.append((low, edge))
                    low = None
        return found if low is None else [*found, (low, self._get_open_end(1))]

    def _get_open_end(self, side: int) -> float:
        """Return the end of a region on a side where the threshold was not crossed."""
        end, last = self.ends.get(side, "stopped"), self.side(side)[-1].value
        if end in ("limit", "crossed"):
            return last
        return float(side * np.inf) if end == "flat" else float("nan")

    def edges(self, threshold: float) -> list[Point]:
        """Return, on each side, the first point beyond the threshold, or the last one below it."""
        sides = [self.side(side) for side in (-1, 1)]
        return [next((q for q in points if abs(self.zeta(q)) >= threshold), points[-1]) for points in sides]

    def integration_error(self, threshold: float) -> float:
        """Return the largest integration error of zeta^2 at the edges of the threshold, by halving all steps."""
        fine = self.evaluator.halved
        base = fine.cost(self.centre.theta) - self.centre.cost
        ends = self.edges(threshold)
        return max(abs(fine.cost(q.theta) - q.cost - base) * 2 / self.scale for q in ends)

    def add_kinks(self, times: FloatArray, threshold: float) -> None:
        """Add points at the sample times up to the threshold, where the slope may jump, unless there are many."""
        low, high = (q.value for q in self.edges(threshold))
        inside = times[(times > low) & (times < high)]
        for time in inside if len(inside) <= MOST_KINKS else ():
            if all(q.value != time for q in self.points):
                nearest = int(np.argmin([abs(q.value - time) for q in self.points]))
                self.add(float(time), self.points[nearest])


@dataclass(frozen=True, eq=False)
class Profile(Tabular):
    """Profile likelihood of one unknown: print it, plot it, or get intervals at any level.

    Attributes
    ----------
    name, unit : str
    value : float
        The estimate.
    standard_error : float
        Standard error from the exact Hessian; 0 if the unknown is held, NaN if it is not known.
    level : float
        Confidence level up to which the profile was followed.
    fit : Fit
    sample_times : (K,)
        For a transition time the sample times of its run, less delays, where the slope of the profile may jump; empty
        otherwise.
    trace : Trace
        The points; it adds more when needed.

    See Also
    --------
    profile, Estimate.confidence_intervals

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> found = sf.profile(fit, "tau_1")
    >>> found.name, len(found.values) > 5
    ('tau_1', True)
    """

    name: str
    unit: str
    value: float
    standard_error: float
    level: float
    fit: Fit
    sample_times: FloatArray
    trace: Trace

    def __repr__(self) -> str:
        value = f"{self.name} = {self.value:.6g} ± {self.standard_error:.2g}{unit_suffix(self.unit)}"
        return format_line(self, value, f"{len(self.trace.points)} points")

    @property
    def values(self) -> FloatArray:
        """Values at which the unknown was held, ascending: (P,)."""
        return np.array([q.value for q in self.trace.points])

    @property
    def costs(self) -> FloatArray:
        """Smallest cost at each of the values: (P,)."""
        return np.array([q.cost for q in self.trace.points])

    @property
    def thetas(self) -> FloatArray:
        """All unknowns at each of the values: (P, d)."""
        return np.array([q.theta for q in self.trace.points])

    @property
    def zeta(self) -> FloatArray:
        """Signed root of the likelihood ratio at each of the values: (P,)."""
        return np.array([self.trace.zeta(q) for q in self.trace.points])

    @property
    def converged(self) -> NDArray[np.bool_]:
        """Which of the fits converged: (P,)."""
        return np.array([q.converged for q in self.trace.points])

    @property
    def ends(self) -> tuple[str, str]:
        """How the lower and the upper side ended.

        "crossed": the threshold was crossed; "limit": a bound or the order of the transition times was reached before;
        "flat": the cost does not rise, the unknown is not identifiable on this side; "failed": all fits further out
        failed; "stopped": interrupted.
        """
        return self.trace.ends.get(-1, "stopped"), self.trace.ends.get(1, "stopped")

    @property
    def lower_cost(self) -> FloatArray | None:
        """Unknowns (d,) with a cost below that of the estimate, if any were found: start a new fit there."""
        best = self.trace.best
        better = best.cost < self.trace.centre.cost - 1e-6 * self.trace.scale
        return best.theta.copy() if better else None

    def regions(self, level: float | None = None) -> list[tuple[float, float]]:
        """Return all confidence intervals found at a level: one, unless the profile has several minima.

        Parameters
        ----------
        level : float, optional
            Between 0 and 1; that of the profile if left out. The profile is followed further if necessary.

        Returns
        -------
        list of (low, high)
            If the threshold is not crossed on a side, the end is the limit that the constraints set, infinite if the
            cost does not rise, or NaN if the profile could not be followed.

        See Also
        --------
        profile, Profile.interval

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> len(sf.profile(fit, "k").regions(0.95))
        1
        """
        threshold = self.fit.quantile(self.level if level is None else level)
        try:
            for side in (-1, 1):
                self.trace.march(side, threshold)
            return self.trace.regions(threshold)
        except KeyboardInterrupt:
            return [(np.nan, np.nan)]

    def interval(self, level: float | None = None) -> tuple[float, float]:
        """Return the likelihood-ratio confidence interval that contains the estimate: (low, high).

        Parameters
        ----------
        level : float, optional
            As in `regions`.

        See Also
        --------
        profile, Profile.regions

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> [round(float(end), 2) for end in sf.profile(fit, "k").interval(0.95)]
        [0.38, 0.4]
        """
        regions = self.regions(level)
        return next((r for r in regions if not (r[0] > self.value or r[1] < self.value)), regions[0])

    def __str__(self) -> str:
        return format_text(self)

    def _repr_html_(self) -> str:
        return format_html(self)

    @overload
    def plot(self, *, ax: None = ...) -> Figure: ...
    @overload
    def plot(self, *, ax: Axes) -> Axes: ...
    def plot(self, *, ax: Axes | None = None) -> Axes | Figure:
        """Draw the likelihood ratio with its thresholds, and the quadratic approximation.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned.

        See Also
        --------
        profile

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> figure = sf.profile(fit, "k").plot()
        >>> len(figure.axes) > 0
        True
        """
        return draw_figure(self, ax=ax)


def profile(estimate: Any, name: str, *, level: float = 0.95, callback: Progress | None = None) -> Profile:
    """Return the profile likelihood of one parameter or transition time.

    Parameters
    ----------
    estimate : Estimate
        Its cost must consist of `Measurements` alone.
    name : str
        One of ``estimate.theta_names``.
    level : float, between 0 and 1
        Confidence level up to which the profile is followed; requests for a higher level continue it.
    callback : callable, optional
        ``callback(done, total)`` after each fit, where the total is a guess; a true return value stops, and so does
        Ctrl-C. The points computed so far are returned.

    Returns
    -------
    Profile

    Raises
    ------
    TypeError
        If `estimate` is not an estimate, or an argument is of the wrong type.
    ValueError
        For an unknown that is not in theta, an estimate that has no problem, did not converge or has no noise model,
        and for a problem with guards or terminal constraints.

    Notes
    -----
    Takes about twenty warm-started fits and compiles nothing, unless the mesh of the fit is too coarse at the ends of
    the profile.

    See Also
    --------
    Estimate.confidence_intervals, bootstrap, identifiability

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> [round(float(end), 1) for end in sf.profile(fit, "tau_1").interval(0.95)]
    [2.4, 2.5]
    """
    fit: Fit = estimate
    if not isinstance(fit, Fit):
        raise TypeError(f"profile needs the result of sf.estimate; got {type(fit).__name__}. Fit the problem first.")
    if as_name(name, "name") not in fit.theta_names:
        raise ValueError(f"there is no unknown {shorten(name)}; the unknowns are {join_names(fit.theta_names)}.")
    level = as_level(level)
    if callback is not None:
        as_callable(callback, "callback", "a function callback(done, total)", arguments=2)
    evaluator = estimate.evaluator_at_solution()
    check_has_profile(fit)
    threshold = fit.quantile(level)
    index = fit.theta_names.index(name)
    times = _list_kinks(evaluator.problem, fit.theta, index)
    report, end = show_progress(callback, f"Profile of {name}")
    trace = Trace(fit, evaluator, index)
    try:
        for _ in range(2):
            trace.should_stop = partial(_wrap_callback, report, trace)
            for side in (-1, 1):
                trace.march(side, threshold)
            trace.add_kinks(times, threshold)
            if trace.integration_error(threshold) <= LARGE_ERROR * threshold**2:
                break
            trace.coarse = True
            finer = _refine_mesh(evaluator.problem, trace, threshold) if trace.evaluator is evaluator else None
            if finer is None:
                break
            trace = Trace(fit, finer, index)
    except KeyboardInterrupt:
        trace.interrupted = True
    finally:
        end()
        trace.should_stop = lambda: False
    error = float(fit.standard_errors[index])
    return Profile(name, fit.theta_units[index], trace.centre.value, error, level, fit, times, trace)


def _refine_mesh(problem: Problem, trace: Trace, threshold: float) -> Evaluator | None:
    """Return the problem on meshes that resolve both ends of a profile too; None if these cannot be integrated."""
    thetas = [trace.centre.theta, *(q.theta for q in trace.edges(threshold))]
    try:
        meshes = [refine_mesh(problem, e, *thetas, finer=2.0) for e in range(len(problem.experiments))]
    except ValueError:
        return None
    return Evaluator(problem, meshes=meshes)


def _wrap_callback(report: Progress, trace: Trace) -> bool:
    """Report how many fits are done, of as many as a profile usually takes; return whether to stop."""
    return bool(report(trace.fits, max(2 * (STEPS + LOOK_AHEAD + 2), trace.fits)))


def check_has_profile(fit: Fit) -> None:
    """Raise ValueError unless a fit is a minimum with a noise model, as profiles and regions need."""
    if not fit.status.successful:
        raise ValueError(f"a profile begins at a minimum, and this fit has not found one: {fit.message}")
    if fit.constraints:
        raise ValueError(
            "a profile does not support guards and terminal constraints, without which its intervals would be too "
            "wide: use confidence_intervals or sf.monte_carlo."
        )
    if fit.sigma_known is None:
        raise ValueError("a profile needs a noise model: a cost of Measurements alone, with or without sigma.")
    if fit.sigma_known is False and fit.freedom < 1:
        raise ValueError(
            f"sigma is unknown and {fit.samples} values are too few to estimate it along with the unknowns."
        )


def _list_kinks(problem: Problem, theta: FloatArray, index: int) -> FloatArray:
    """Return the sample times of the run of which this unknown is a transition time; empty for a parameter."""
    for e, where in enumerate(problem.unknowns.times):
        if index in where:
            return list_sample_times(problem, theta, e)
    return np.zeros(0)
