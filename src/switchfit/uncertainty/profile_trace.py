"""The points of a profile: march outwards in equal steps of zeta, look for further minima, find crossings.

zeta, the signed root of the likelihood ratio (`switchfit.uncertainty.profiles`), is nearly linear in the unknown, so
that its crossing of the quantile is found in a few more fits than the march has made. Where the next point lies, and
where the other unknowns begin there, follows from the derivatives at the point before, as of all profiles
(`switchfit.uncertainty.walks`); then the others are fitted, with the unknown's lower and upper bound set to its value.
All fits use the compiled program of the original one, on its meshes with halved cells, which follow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from switchfit.fit.evaluator import Evaluator
from switchfit.fit.following import Follower
from switchfit.fit.result import Fit
from switchfit.fit.solution import minimize_cost
from switchfit.optimize import Status
from switchfit.optimize.qp import nearest_feasible
from switchfit.problem.data import FloatArray
from switchfit.uncertainty.walks import Derivatives, eliminate_others, find_first_root

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
    """One fit with the unknown held at `value`; slope and curvature of the profile, and how the others follow (d,)."""

    value: float
    cost: float
    slope: float
    curvature: float
    theta: FloatArray
    follow: FloatArray
    converged: bool

    def predict(self, value: float) -> tuple[FloatArray, float]:
        """Return all unknowns, and the cost, near by."""
        step = value - self.value
        cost = self.cost + step * (self.slope + 0.5 * step * self.curvature)
        return self.theta + np.nan_to_num(step * self.follow), cost


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
    """

    def __init__(self, fit: Fit, evaluator: Evaluator, index: int) -> None:
        self.fit, self.evaluator, self.index = fit, evaluator.halved, index
        self.follower = Follower(self.evaluator)
        self.constraints = evaluator.problem.constraints
        self.scale = fit.residual_variance if fit.sigma_known is False else 1.0
        self.starts = {side: self._describe(fit.theta, self.follower(fit.theta, side), True) for side in (-1, 1)}
        self.centre = self.starts[1]
        self.points = [self.centre]
        self.ends: dict[int, End] = {}
        self.fits = 0
        self.limits = {side: self._find_limit(side) for side in (-1, 1)}
        self.interrupted = False
        self.jumps: list[float] = []
        self.should_stop: Callable[[], bool] = lambda: False

    # --- properties of points

    def measure_zeta(self, cost: float) -> float:
        """Return the size of the root of the likelihood ratio; 0 where the cost is below that of the estimate."""
        return float(np.sqrt(max(2 * (cost - self.centre.cost) / self.scale, 0.0)))

    def compute_zeta(self, point: Point) -> float:
        """Return the signed root of the likelihood ratio of a point."""
        size = self.measure_zeta(point.cost)
        return size if point.value > self.centre.value else -size

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

        # Rows join the unknown with others, such as the order of times: its limit is a linear programme in these.
        objective = np.where(coupled == k, -float(side), 0.0)
        bounds = np.stack([c.lower, c.upper], axis=1)[coupled]
        found = linprog(objective, -c.A[:, coupled], -c.b, bounds=bounds)
        # The centre is feasible; rounding of the linear program must not put a limit on the wrong side of it.
        return side * max(side * float(found.x[coupled == k][0]), side * float(self.fit.theta[k]))

    def _describe(self, theta: FloatArray, found: Any, converged: bool) -> Point:
        """Return the point at theta, where the other unknowns are optimal: its slope is the derivative of the cost."""
        k, c = self.index, self.constraints
        others = (theta > c.lower) & (theta < c.upper) & found.hessian.any(axis=1)
        others[k] = False
        # The Schur complement of `walks`: curvature H_kk - H_ko H_oo^-1 H_ok, and the others follow by -H_oo^-1 H_ok.
        at = Derivatives(np.array([found.cost]), found.gradient[None], found.hessian[None])
        _, _, (curvature,), _, (follow,) = eliminate_others(at, np.array([k]), others[None])
        follow = -follow
        follow[k] = 1.0
        return Point(float(theta[k]), found.cost, float(found.gradient[k]), float(curvature), theta, follow, converged)

    def _fit(self, value: float, start: FloatArray) -> Point | None:
        """Return the point at `value`, fitted from the feasible point nearest to a start; None if the fit fails."""
        lower, upper = self.constraints.lower.copy(), self.constraints.upper.copy()
        lower[self.index] = upper[self.index] = value
        held = replace(self.constraints, lower=lower, upper=upper)
        self.fits += 1
        try:
            begin = nearest_feasible(held, np.clip(start, lower, upper))
            result = minimize_cost(
                self.evaluator,
                begin,
                "exact",
                self.fit.tolerance,
                ITERATIONS,
                constraints=held,
                follower=self.follower,
            )
        except ValueError:  # infeasible by rounding
            return None
        if result.status is Status.INTERRUPTED or self.should_stop():
            raise KeyboardInterrupt
        return self._describe(result.theta, result, result.status.successful) if np.isfinite(result.cost) else None

    def add(self, value: float, near: Point) -> Point | None:
        """Add a point, fitted from what a neighbor predicts; None if all fits fail.

        Where they fail, or zeta rises so much more than predicted that this may be another, higher minimum, the
        unknowns of the neighbor and of the estimate are tried too.
        """
        predicted, cost = near.predict(value)
        most = 1.5 * self.measure_zeta(cost) + 0.5
        best: Point | None = None
        for start in (predicted, near.theta, self.centre.theta):
            found = self._fit(value, start)
            if found is not None:
                best = min((q for q in (best, found) if q is not None), key=lambda q: (not q.converged, q.cost))
            if best is not None and best.converged and not self.measure_zeta(best.cost) > most:
                break
        if best is not None:
            self._insert(best)
        return best

    def _insert(self, point: Point) -> None:
        self.points = sorted([q for q in self.points if q.value != point.value] + [point], key=lambda q: q.value)

    # --- marching

    def march(self, side: int, threshold: float) -> None:
        """Add points on one side until zeta has crossed the threshold, or cannot cross it."""
        if self.interrupted or self.ends.get(side) in ("limit", "flat", "failed"):
            return
        if self.measure_zeta(self.list_side(side)[-1].cost) >= BEYOND * threshold:
            self.ends[side] = "crossed"
            return
        ahead, self.ends[side] = 0, "stopped"
        for _ in range(MOST_POINTS):
            last = self.list_side(side)[-1]
            height, distance = self.measure_zeta(last.cost), abs(last.value - self.centre.value)
            step, most = self._choose_step(side, last, threshold / STEPS), height + 2.5 * threshold / STEPS
            if last.value == self.limits[side]:
                self.ends[side] = "crossed" if height >= threshold else "limit"
                break
            if height >= BEYOND * threshold:
                self.ends[side] = "crossed"
                if ahead >= LOOK_AHEAD * (1 + (side * last.slope < 0)):
                    break
                ahead, step, most = ahead + 1, distance, np.inf
            elif distance > self._far:
                self.ends[side] = "flat"
                break
            new = self._add_next(side, last, step, most)
            if new is None:
                self.ends[side] = "crossed" if height >= threshold else "failed"
                break
            if new.cost < last.cost - 1e-9 * abs(last.cost):
                self._sweep_inward(side)
        self.ends[side] = "flat" if self.ends[side] == "stopped" else self.ends[side]
        self._add_minima(side)

    def _choose_step(self, side: int, last: Point, spacing: float) -> float:
        """Return the step after which zeta should have risen by the spacing, by the derivatives."""
        points = self.list_side(side)
        here = last if len(points) > 1 else self.starts[side]
        # zeta^2 = 2 (J_p - J_0) / scale, so that zeta + spacing is reached where slope x + curvature x^2 / 2 has risen
        # by this.
        rise = 0.5 * self.scale * (self.measure_zeta(here.cost) + spacing) ** 2 - (here.cost - self.centre.cost)
        step = float(find_first_root(np.array(rise), np.array(side * here.slope), np.array(here.curvature)))
        if len(points) > 1:
            return min(step, LONGEST_GROWTH * abs(last.value - points[-2].value))
        return step if np.isfinite(step) else 1e-2 * self._size

    def _add_next(self, side: int, last: Point, step: float, most: float) -> Point | None:
        """Return the next point outwards; the step is halved while a fit fails or zeta is above `most`."""
        limit = self.limits[side]
        near = last if last is not self.centre else self.starts[side]
        for attempt in range(1, HALVINGS + 1):
            value = last.value + side * step
            if side * (value - limit) > -1e-3 * step:
                value = limit
            new = self.add(value, near)
            if new is not None and new.converged and (attempt == HALVINGS or self.measure_zeta(new.cost) <= most):
                return new
            self.points = [q for q in self.points if q is not new]
            step *= 0.5
        return None

    def _add_minima(self, side: int) -> None:
        """Add points at minima between points far apart, where the slopes show one."""
        from scipy.optimize import minimize_scalar

        for inner, outer in pairwise(self.list_side(side)[1:]):
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

        # zeta is nearly linear in the unknown: a root finder by secants needs a few fits.
        precision = 1e-7 * max(abs(b.value - a.value), abs(inner.value - self.centre.value))
        root = float(brentq(excess, a.value, b.value, xtol=max(precision, 1e-300), rtol=1e-12))
        # No fit came near the threshold: zeta jumps over it where the minimum in the other unknowns ends.
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

    def add_kinks(self, times: FloatArray, threshold: float) -> None:
        """Add points at the sample times up to the threshold, where the slope may jump, unless there are many."""
        low, high = (q.value for q in self.find_edges(threshold))
        inside = times[(times > low) & (times < high)]
        for time in inside if len(inside) <= MOST_KINKS else ():
            if all(q.value != time for q in self.points):
                nearest = int(np.argmin([abs(q.value - time) for q in self.points]))
                self.add(float(time), self.points[nearest])
