"""The points of a profile: march outwards in equal steps of zeta, look for further minima, find crossings.

zeta, the signed root of the likelihood ratio (`switchfit.uncertainty.profiles`), is nearly linear in the unknown, so
that it predicts the next step, and its crossing of the quantile is found in a few more fits. Each fit begins at the
result of a neighboring one, with the unknown's lower and upper bound set to its value; all use the compiled program of
the original fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Fit
from switchfit.fit.solution import minimize_cost
from switchfit.optimize import Status
from switchfit.optimize.qp import nearest_feasible
from switchfit.problem.data import FloatArray

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
        self.constraints = evaluator.problem.constraints
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

    def compute_zeta(self, point: Point) -> float:
        """Return the signed root of the likelihood ratio; 0 where the cost is below that of the estimate."""
        root = np.sqrt(max(2 * (point.cost - self.centre.cost) / self.scale, 0.0))
        return float(root if point.value > self.centre.value else -root)

    def list_side(self, side: int) -> list[Point]:
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
        from scipy.optimize import linprog  # here, since importing it takes longer than most fits

        objective = np.where(coupled == k, -float(side), 0.0)
        bounds = np.stack([c.lower, c.upper], axis=1)[coupled]
        found = linprog(objective, -c.A[:, coupled], -c.b, bounds=bounds)
        # The centre is feasible; rounding of the linear program must not put a limit on the wrong side of it.
        return side * max(side * float(found.x[coupled == k][0]), side * float(self.fit.theta[k]))

    def _fit(self, value: float, start: FloatArray) -> Point | None:
        """Return the point at `value`, fitted from the feasible point nearest to a start; None if the fit fails."""
        lower, upper = self.constraints.lower.copy(), self.constraints.upper.copy()
        lower[self.index] = upper[self.index] = value
        held = replace(self.constraints, lower=lower, upper=upper)
        self.fits += 1
        try:
            begin = nearest_feasible(held, np.clip(start, lower, upper))
            result = minimize_cost(self.evaluator, begin, "exact", self.fit.tolerance, ITERATIONS, constraints=held)
        except ValueError:  # infeasible by rounding
            return None
        if result.status is Status.INTERRUPTED or self.should_stop():
            raise KeyboardInterrupt
        if not np.isfinite(result.cost):
            return None
        # The other unknowns are optimal, so that they contribute nothing to the derivative.
        return Point(value, result.cost, float(result.gradient[self.index]), result.theta, result.status.successful)

    def add(self, value: float, near: Point, before: Point | None = None) -> Point | None:
        """Add a point, fitted from a neighbor or from the line through two neighbors; None if all fits fail."""
        starts = []
        if before is not None and before.value != near.value:
            slope = (near.theta - before.theta) / (near.value - before.value)
            starts.append(near.theta + (value - near.value) * slope)
        starts += [near.theta, self.centre.theta]
        best: Point | None = None
        for start in starts:
            found = self._fit(value, start)
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
            expected = abs(self.compute_zeta(near)) * distance / reached
        else:
            error = float(self.fit.standard_errors[self.index])
            expected = distance / error if np.isfinite(error) and error > 0 else np.inf
        return abs(self.compute_zeta(point)) > 1.5 * expected + 0.5

    def _insert(self, point: Point) -> None:
        self.points = sorted([q for q in self.points if q.value != point.value] + [point], key=lambda q: q.value)

    # --- marching

    def march(self, side: int, threshold: float) -> None:
        """Add points on one side until zeta has crossed the threshold, or cannot cross it."""
        if self.interrupted or self.ends.get(side) in ("limit", "flat", "failed"):
            return
        spacing = threshold / STEPS
        points = self.list_side(side)
        if len(points) > 1 and abs(self.compute_zeta(points[-1])) >= BEYOND * threshold:
            self.ends[side] = "crossed"
            return
        step = abs(points[-1].value - points[-2].value) if len(points) > 1 else self._choose_first_step(side, spacing)
        ahead = 0
        self.ends[side] = "stopped"
        for _ in range(MOST_POINTS):
            last = points[-1]
            height = abs(self.compute_zeta(last))
            if last.value == self.limits[side]:
                self.ends[side] = "crossed" if abs(self.compute_zeta(last)) >= threshold else "limit"
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
            points = self.list_side(side)
            gained = abs(self.compute_zeta(new)) - height
            growth = spacing / gained if gained > 0 else LONGEST_GROWTH
            step = abs(new.value - last.value) * float(np.clip(growth, 0.4, LONGEST_GROWTH))
        self.ends[side] = "flat" if self.ends[side] == "stopped" else self.ends[side]

    def _add_next(
        self, side: int, points: list[Point], step: float, spacing: float, threshold: float, *, looking: bool
    ) -> Point | None:
        """Return the next point outwards; the step is shortened if a fit fails or zeta rises too much."""
        last = points[-1]
        before = points[-2] if len(points) > 1 else self._step_along_covariance(last)
        limit = self.limits[side]
        for attempt in range(HALVINGS):
            value = last.value + side * step
            if side * (value - limit) >= 0 or abs(value - limit) < 1e-3 * step:
                value = limit
            if value == last.value:
                return None
            new, shorter = self.add(value, last, before), 0.5
            if new is not None and new.converged:
                zeta = abs(self.compute_zeta(new))
                gained = zeta - abs(self.compute_zeta(last))
                if looking or gained <= 2.5 * spacing or attempt == HALVINGS - 1:
                    return new
                if zeta <= 2 * threshold:
                    self._fill(last, new, spacing)
                    return new
                shorter = float(np.clip(spacing / gained, 0.05, 0.5))
            self.points = [q for q in self.points if q is not new]
            step *= shorter
            if step <= 1e-9 * max(abs(last.value), abs(self.centre.value), 1e-300):
                return None
        return None

    def _fill(self, inner: Point, outer: Point, spacing: float) -> None:
        """Add points between two, evenly spaced in zeta if zeta is linear."""
        count = int(abs(self.compute_zeta(outer) - self.compute_zeta(inner)) / spacing)
        previous: Point = inner
        for part in np.arange(1, count) / count:
            found = self.add(inner.value + float(part) * (outer.value - inner.value), previous)
            previous = found if found is not None else previous

    def _add_minima(self, side: int) -> None:
        """Add points at minima between points far apart, where the slopes show one."""
        from scipy.optimize import minimize_scalar

        points = self.list_side(side)[1:]
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
        outer, *inward = self.list_side(side)[:0:-1]
        for inner in inward:
            found = self._fit(inner.value, outer.theta)
            if found is None or not found.converged or found.cost >= inner.cost - 1e-9 * abs(inner.cost):
                return
            self._insert(found)
            outer = found

    def _step_along_covariance(self, centre: Point) -> Point | None:
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
            return abs(self.compute_zeta(point)) - threshold

        from scipy.optimize import brentq

        precision = 1e-7 * max(abs(b.value - a.value), abs(inner.value - self.centre.value))
        root = float(brentq(excess, a.value, b.value, xtol=max(precision, 1e-300), rtol=1e-12))
        if min(abs(abs(self.compute_zeta(q)) - threshold) for q in found.values()) > 1e-3 * threshold:
            self.jumps.append(root)
        return root

    def find_regions(self, threshold: float) -> list[tuple[float, float]]:
        """Return all intervals found in which |zeta| is at most the threshold, ascending; open ends are infinite."""
        points = list(self.points)
        inside = [abs(self.compute_zeta(q)) <= threshold for q in points]
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
        end, last = self.ends.get(side, "stopped"), self.list_side(side)[-1].value
        if end in ("limit", "crossed"):
            return last
        return float(side * np.inf) if end == "flat" else float("nan")

    def find_edges(self, threshold: float) -> list[Point]:
        """Return, on each side, the first point beyond the threshold, or the last one below it."""
        sides = [self.list_side(side) for side in (-1, 1)]
        return [next((q for q in points if abs(self.compute_zeta(q)) >= threshold), points[-1]) for points in sides]

    def measure_integration_error(self, threshold: float) -> float:
        """Return the largest integration error of zeta^2 at the edges of the threshold, by halving all steps."""
        fine = self.evaluator.halved
        base = fine.cost(self.centre.theta) - self.centre.cost
        ends = self.find_edges(threshold)
        return max(abs(fine.cost(q.theta) - q.cost - base) * 2 / self.scale for q in ends)

    def add_kinks(self, times: FloatArray, threshold: float) -> None:
        """Add points at the sample times up to the threshold, where the slope may jump, unless there are many."""
        low, high = (q.value for q in self.find_edges(threshold))
        inside = times[(times > low) & (times < high)]
        for time in inside if len(inside) <= MOST_KINKS else ():
            if all(q.value != time for q in self.points):
                nearest = int(np.argmin([abs(q.value - time) for q in self.points]))
                self.add(float(time), self.points[nearest])
