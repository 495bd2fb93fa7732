"""Profile likelihoods: the cost as a function of one unknown, with all others fitted again.

With J_p(v) the smallest cost at theta_k = v, the signed root of the likelihood ratio,

    zeta(v) = sign(v - theta_k) sqrt(2 (J_p(v) - J) / s^2),      s^2 = 1 or, with sigma unknown, 2 J / (n - d),

is standard normal at the true value to first order, Student's t with n - d degrees of freedom where sigma is unknown,
so that ``|zeta| <= quantile`` is a confidence region ([1]_, [2]_). For a linear model zeta is the straight line
``(v - theta_k) / standard error``, and the region is the quadratic interval. The curvature of zeta shows the error of
that interval.

Where residuals are correlated, zeta is too large by the factor by which standard errors are too small; on request the
threshold is multiplied by it ([3]_, "vertical" adjustment).

The points are computed in `switchfit.uncertainty.profiles`.

The points of a profile: march outwards in equal steps of zeta, look for further minima, find crossings.

zeta, the signed root of the likelihood ratio, is nearly linear in the unknown, so
that its crossing of the quantile is found in a few more fits than the march has made. Where the next point lies, and
where the other unknowns begin there, follows from the derivatives at the point before, as of all profiles
(`switchfit.uncertainty.walks`); then the others are fitted, with the unknown's lower and upper bound set to its value.
All fits use the compiled program of the original one, on its meshes with halved cells, which follow.

References
----------
.. [1] D. M. Bates, D. G. Watts, Nonlinear Regression Analysis and Its Applications, Wiley 1988, chapter 6.
.. [2] W. Q. Meeker, L. A. Escobar, Teaching about approximate confidence regions based on maximum likelihood
   estimation, The American Statistician 49 (1995) 48-53.
.. [3] R. E. Chandler, S. Bate, Inference for clustered data using the independence loglikelihood, Biometrika 94 (2007)
   167-183.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.accuracy import Follower
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Fit
from switchfit.fit.solution import minimize_cost
from switchfit.optimize import Status
from switchfit.optimize.qp import nearest_feasible
from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.validation import as_callable, as_flag, as_instance, as_level, as_name, join_names, shorten
from switchfit.runtime.frames import Tabular
from switchfit.runtime.presentation import Displayed, Drawn, draw_figure, format_line
from switchfit.runtime.progress import Progress, show_progress
from switchfit.uncertainty.residuals import measure_widening
from switchfit.uncertainty.walks import (
    Derivatives,
    eliminate_others,
    find_first_root,
    list_sample_times,
    list_transitions,
)

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
        self.scale = fit.variance_scale
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


@dataclass(frozen=True, eq=False)
class Profile(Tabular, Displayed):
    """Profile likelihood of one unknown: print it, plot it, or get intervals at any level.

    Attributes
    ----------
    name, unit : str
    value : float
        The estimate.
    standard_error : float
        Standard error from the exact Hessian, as if residuals were independent; 0 if the unknown is held, NaN if it is
        not known.
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
        return np.array([self.trace.compute_zeta(q) for q in self.trace.points])

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

    @cached_property
    def widening(self) -> float:
        """Factor by which correlated residuals make the standard error and the intervals too small; 1 without them."""
        return float(measure_widening(self.fit)[self.fit.theta_names.index(self.name)])

    @property
    def lower_cost(self) -> FloatArray | None:
        """Unknowns (d,) with a cost below that of the estimate, if any were found: start a new fit there."""
        best = min(self.trace.points, key=lambda q: q.cost)
        better = best.cost < self.trace.centre.cost - 1e-6 * self.trace.scale
        return best.theta.copy() if better else None

    def regions(self, level: float | None = None, *, corrected: bool = False) -> list[tuple[float, float]]:
        """Return all confidence intervals found at a level: one, unless the profile has several minima.

        They take the residuals as independent, unless `corrected`.

        Parameters
        ----------
        level : float, optional
            Between 0 and 1; that of the profile if left out. The profile is followed further if necessary.
        corrected : bool, optional
            Whether to allow for correlated residuals, as `Estimate.corrected_standard_errors` does: the threshold of
            zeta is multiplied by `widening`.

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
        threshold *= self.widening if as_flag(corrected, "corrected") else 1.0
        try:
            for side in (-1, 1):
                self.trace.march(side, threshold)
            return self.trace.find_regions(threshold)
        except KeyboardInterrupt:
            return [(np.nan, np.nan)]

    def interval(self, level: float | None = None, *, corrected: bool = False) -> tuple[float, float]:
        """Return the likelihood-ratio confidence interval that contains the estimate: (low, high).

        It takes the residuals as independent, unless `corrected`.

        Parameters
        ----------
        level : float, optional
        corrected : bool, optional
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
        regions = self.regions(level, corrected=corrected)
        return next((r for r in regions if not (r[0] > self.value or r[1] < self.value)), regions[0])

    def plot(self, *, ax: Drawn | None = None) -> Drawn:
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
    fit = as_instance(estimate, "estimate", Fit, "what sf.estimate returns: fit the problem first")
    if as_name(name, "name") not in fit.theta_names:
        raise ValueError(f"there is no unknown {shorten(name)}; the unknowns are {join_names(fit.theta_names)}.")
    level = as_level(level)
    if callback is not None:
        as_callable(callback, "callback", "a function callback(done, total)", arguments=2)
    evaluator = estimate.evaluator_at_solution()
    check_has_profile(fit)
    threshold = fit.quantile(level)
    index = fit.theta_names.index(name)
    runs = [e for e, place in list_transitions(evaluator.problem) if place == index]  # that of a transition time
    times = list_sample_times(evaluator.problem, fit.theta, runs[0]) if runs else np.zeros(0)
    trace = Trace(fit, evaluator, index)
    with show_progress(callback, f"Profile of {name}") as report:
        # Of as many fits as a profile usually takes.
        trace.should_stop = lambda: bool(report(trace.fits, max(2 * (STEPS + LOOK_AHEAD + 2), trace.fits)))
        try:
            for side in (-1, 1):
                trace.march(side, threshold)
            trace.find_regions(threshold)  # its points too are there from now on: tables, figure and repr agree
        except KeyboardInterrupt:
            trace.interrupted = True
    trace.should_stop = lambda: False
    error = float(fit.standard_errors[index])
    return Profile(name, fit.theta_units[index], trace.centre.value, error, level, fit, times, trace)


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
