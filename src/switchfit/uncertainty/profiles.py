"""Profile likelihoods: the cost as a function of one unknown, with all others fitted again.

With J_p(v) the smallest cost at theta_k = v, the signed root of the likelihood ratio,

    zeta(v) = sign(v - theta_k) sqrt(2 (J_p(v) - J) / s^2),      s^2 = 1 or, with sigma unknown, 2 J / (n - d),

is standard normal at the true value to first order, Student's t with n - d degrees of freedom where sigma is unknown,
so that ``|zeta| <= quantile`` is a confidence region ([1]_, [2]_). For a linear model zeta is the straight line
``(v - theta_k) / standard error``, and the region is the quadratic interval. The curvature of zeta shows the error of
that interval.

Where residuals are correlated, zeta is too large by the factor by which standard errors are too small; on request the
threshold is multiplied by it ([3]_, "vertical" adjustment).

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
from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Evaluation
from switchfit.fit.minimization import minimize_cost
from switchfit.fit.result import Fit
from switchfit.fit.solved_fit import SolvedFit
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.follower import Follower
from switchfit.meshes.halving import halve_cells
from switchfit.optimize import Result, Status
from switchfit.optimize.least_distance import nearest_feasible
from switchfit.problem.validation.arrays import as_level
from switchfit.problem.validation.messages import join_names, shorten, unit_suffix
from switchfit.problem.validation.names import as_name
from switchfit.problem.validation.objects import as_callable, as_flag, as_instance
from switchfit.runtime.frames import Tabular
from switchfit.runtime.presentation import Displayed, Drawn, draw_figure, format_line
from switchfit.runtime.progress import Progress, show_progress
from switchfit.uncertainty.corrected_errors import measure_widening
from switchfit.uncertainty.elimination import eliminate_others
from switchfit.uncertainty.profile_pieces import find_first_root
from switchfit.uncertainty.profile_trace import (
    CREEPING,
    FLAT_UP_TO_SIZES,
    HALVINGS_OF_STEP,
    ITERATIONS_OF_PROFILE_FIT,
    LONGEST_GROWTH,
    LOOK_AHEAD,
    MARCHED_BEYOND_THRESHOLD,
    MOST_POINTS_OF_SIDE,
    STEPS_TO_THRESHOLD,
    ProfilePoint,
    SideEnding,
    limit_unknowns,
)
from switchfit.uncertainty.walks import list_sample_times, list_transitions


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
    points : list of Point
        Ascending in value, the estimate among them; more are added when needed.
    fits : int
        How many were made for them.
    limits : dict of int to float
        The limit that the constraints set to the unknown on the lower (-1) and on the upper (+1) side.
    jumps : list of float
        Values at which the threshold was crossed by a jump: the minimum in the other unknowns ends there.

    See Also
    --------
    profile, Estimate.confidence_intervals

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> found = sf.profile(fit, "tau_1")
    >>> found.name, len(found.values) > 5
    ('tau_1', True)
    """

    def __init__(self, fit: Fit, evaluator: Evaluator, name: str, level: float) -> None:
        k = self._index = fit.theta_names.index(name)
        self.fit, self.name, self.level, self.unit = fit, name, level, fit.theta_units[k]
        self.value, self.standard_error = float(fit.theta[k]), float(fit.standard_errors[k])
        runs = [e for e, place in list_transitions(evaluator.problem) if place == k]  # that of a transition time
        self.sample_times = list_sample_times(evaluator.problem, fit.theta, runs[0]) if runs else np.zeros(0)
        self._constraints, self._scale = evaluator.problem.constraints, fit.variance_scale
        # On halved meshes: a profile compares values of J of different theta, whose integration errors differ.
        self._follower = Follower(halve_cells(evaluator))
        # At a kink the slopes to both sides differ: each side of the profile begins with its own.
        self._starts = {side: self._describe(fit.theta, self._follower(fit.theta, side), True) for side in (-1, 1)}
        self._centre = self._starts[1]
        self.points, self.fits = [self._centre], 0
        low, high = limit_unknowns(evaluator.problem)
        # The estimate is feasible: rounding must not put a limit on the wrong side of it.
        self.limits = {-1: float(min(low[k], self.value)), 1: float(max(high[k], self.value))}
        self.jumps: list[float] = []
        self._ends: dict[int, SideEnding] = {-1: "stopped", 1: "stopped"}
        self._interrupted = False
        self._should_stop: Callable[[], bool] = bool  # False; unlike a lambda, it can be pickled

    def __repr__(self) -> str:
        value = f"{self.name} = {self.value:.6g} ± {self.standard_error:.2g}{unit_suffix(self.unit)}"
        return format_line(self, value, f"{len(self.points)} points")

    @property
    def values(self) -> FloatArray:
        """Values at which the unknown was held, ascending: (P,)."""
        return np.array([q.value for q in self.points])

    @property
    def costs(self) -> FloatArray:
        """Smallest cost at each of the values: (P,)."""
        return np.array([q.cost for q in self.points])

    @property
    def thetas(self) -> FloatArray:
        """All unknowns at each of the values: (P, d)."""
        return np.array([q.theta for q in self.points])

    @property
    def zeta(self) -> FloatArray:
        """Signed root of the likelihood ratio at each of the values: (P,)."""
        return np.array([self._compute_zeta(q) for q in self.points])

    @property
    def converged(self) -> NDArray[np.bool_]:
        """Which of the fits converged: (P,)."""
        return np.array([q.converged for q in self.points])

    @property
    def ends(self) -> tuple[str, str]:
        """How the lower and the upper side ended.

        "crossed": the threshold was crossed; "limit": a bound or the order of the transition times was reached before;
        "flat": the cost does not rise, the unknown is not identifiable on this side; "failed": all fits further out
        failed; "stopped": interrupted.
        """
        return self._ends[-1], self._ends[1]

    @cached_property
    def widening(self) -> float:
        """Factor by which correlated residuals make the standard error and the intervals too small; 1 without them."""
        return float(measure_widening(self.fit)[self._index])

    @property
    def lower_cost(self) -> FloatArray | None:
        """Unknowns (d,) with a cost below that of the estimate, if any were found: start a new fit there."""
        best = min(self.points, key=lambda q: q.cost)
        # Lower by more than fits agree in: else each profile of a good fit would ask for another one.
        better = best.cost < self._centre.cost - 1e-6 * self._scale
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
        >>> fit = sf.estimate(heater_problem())

        >>> len(sf.profile(fit, "k").regions(0.95))
        1
        """
        threshold = self.fit.quantile(self.level if level is None else level)
        threshold *= self.widening if as_flag(corrected, "corrected") else 1.0
        return self._find_regions(threshold)

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
        >>> fit = sf.estimate(heater_problem())

        >>> figure = sf.profile(fit, "k").plot()
        >>> len(figure.axes) > 0
        True
        """
        return draw_figure(self, ax=ax)

    # --- properties of points

    def _measure_zeta(self, cost: float) -> float:
        """Return the size of the root of the likelihood ratio; 0 where the cost is below that of the estimate."""
        return float(np.sqrt(max(2 * (cost - self._centre.cost) / self._scale, 0.0)))

    def _compute_zeta(self, point: ProfilePoint) -> float:
        """Return the signed root of the likelihood ratio of a point."""
        size = self._measure_zeta(point.cost)
        return size if point.value > self.value else -size

    def _list_side(self, side: int) -> list[ProfilePoint]:
        """Return the points of one side from the estimate outwards, the estimate first, with its derivatives there."""
        beyond = [q for q in self.points if side * (q.value - self.value) > 0]
        return [self._starts[side], *beyond[::side]]

    # --- adding points

    def _describe(self, theta: FloatArray, found: Evaluation[FloatArray] | Result, converged: bool) -> ProfilePoint:
        """Return the point at theta, where the other unknowns are optimal: its slope is the derivative of the cost."""
        k, c = self._index, self._constraints
        others = (theta > c.lower) & (theta < c.upper) & found.hessian.any(axis=1)
        others[k] = False
        # The Schur complement of `walks`: curvature H_kk - H_ko H_oo^-1 H_ok, and the others follow by -H_oo^-1 H_ok.
        at = found.gradient[None], found.hessian[None], np.array([k]), others[None]
        (curvature,), _, (follow,) = eliminate_others(*at)
        follow = -follow
        follow[k] = 1.0
        return ProfilePoint(
            float(theta[k]), found.cost, float(found.gradient[k]), float(curvature), theta, follow, converged
        )

    def _fit(self, value: float, start: FloatArray) -> ProfilePoint | None:
        """Return the point at `value`, fitted from the feasible point nearest to a start; None if the fit fails."""
        lower, upper = self._constraints.lower.copy(), self._constraints.upper.copy()
        lower[self._index] = upper[self._index] = value
        held = replace(self._constraints, lower=lower, upper=upper)
        self.fits += 1
        try:
            begin = nearest_feasible(held, np.clip(start, lower, upper))
            result = minimize_cost(
                self._follower, begin, "exact", self.fit.tolerance, ITERATIONS_OF_PROFILE_FIT, constraints=held
            )
        except ValueError:  # infeasible by rounding
            return None
        if result.status is Status.INTERRUPTED or self._should_stop():
            raise KeyboardInterrupt
        if not np.isfinite(result.cost):
            return None
        # In a curved valley without an end, gradients may stay just above the tolerance while J no longer falls.
        creeps = result.status is Status.MAX_ITERATIONS
        fallen = result.history[len(result.history) // 2].cost - result.cost
        settled = result.status.successful or (creeps and fallen < CREEPING * self._scale)
        return self._describe(result.theta, result, settled)

    def _add(self, value: float, near: ProfilePoint) -> ProfilePoint | None:
        """Add a point, fitted from what a neighbor predicts; None if all fits fail.

        Where they fail, or zeta rises so much more than predicted that this may be another, higher minimum, the
        unknowns of the neighbor and of the estimate are tried too.
        """
        predicted, cost = near.predict(value)
        most = 1.5 * self._measure_zeta(cost) + 0.5
        best: ProfilePoint | None = None
        # The prediction suffices but for jumps to another minimum: then the neighbour's own unknowns, and at last the
        # estimate's.
        for start in (predicted, near.theta, self._centre.theta):
            found = self._fit(value, start)
            if found is not None:
                best = min((q for q in (best, found) if q is not None), key=lambda q: (not q.converged, q.cost))
            if best is not None and best.converged and not self._measure_zeta(best.cost) > most:
                break
        if best is not None:
            self._insert(best)
        return best

    def _insert(self, point: ProfilePoint) -> None:
        self.points = sorted([q for q in self.points if q.value != point.value] + [point], key=lambda q: q.value)

    # --- marching

    def _follow(self, side: int, threshold: float) -> None:
        """Add points on one side until zeta has crossed the threshold, or cannot cross it."""
        if self._interrupted or self._ends[side] in ("limit", "flat", "failed"):
            return
        if self._measure_zeta(self._list_side(side)[-1].cost) >= MARCHED_BEYOND_THRESHOLD * threshold:
            self._ends[side] = "crossed"
            return
        self._ends[side] = "stopped"
        self._ends[side] = self._march(side, threshold)
        self._add_minima(side)

    def _march(self, side: int, threshold: float) -> SideEnding:
        """Add points outwards; return how this ended."""
        ahead, size = 0, abs(self.value) or 1.0
        # Beyond this many sizes of the unknown, J that has not risen is taken for one that never does.
        far = FLAT_UP_TO_SIZES * (max(size, self.standard_error) if np.isfinite(self.standard_error) else size)
        for _ in range(MOST_POINTS_OF_SIDE):
            last = self._list_side(side)[-1]
            height, distance = self._measure_zeta(last.cost), abs(last.value - self.value)
            step, most = (
                self._choose_step(side, last, threshold / STEPS_TO_THRESHOLD),
                height + 2.5 * threshold / STEPS_TO_THRESHOLD,
            )
            if last.value == self.limits[side]:
                return "crossed" if height >= threshold else "limit"
            # Behind the threshold a look ahead: a second minimum there would be a second region. Where J falls again,
            # one more step.
            if height >= MARCHED_BEYOND_THRESHOLD * threshold:
                if ahead >= LOOK_AHEAD * (1 + (side * last.slope < 0)):
                    return "crossed"
                ahead, step, most = ahead + 1, distance, np.inf
            elif distance > far:
                return "flat"
            new = self._add_next(side, last, step, most)
            if new is None:
                return "crossed" if height >= threshold else "failed"
            # J of the others has fallen to a lower branch: points before it lay on the higher one, and are fitted again
            # from here.
            if new.cost < last.cost - 1e-9 * abs(last.cost):
                self._sweep_inward(side)
        return "crossed" if ahead else "flat"

    def _choose_step(self, side: int, last: ProfilePoint, spacing: float) -> float:
        """Return the step after which zeta should have risen by the spacing, by the derivatives."""
        points = self._list_side(side)
        # zeta^2 = 2 (J_p - J_0) / scale, so that zeta + spacing is reached where slope x + curvature x^2 / 2 has risen
        # by this.
        rise = 0.5 * self._scale * (self._measure_zeta(last.cost) + spacing) ** 2 - (last.cost - self._centre.cost)
        step = float(find_first_root(np.array(rise), np.array(side * last.slope), np.array(last.curvature)))
        if len(points) > 1:
            return min(step, LONGEST_GROWTH * abs(last.value - points[-2].value))
        # 1 % of the feasible range, or of the value.
        span = self.limits[1] - self.limits[-1]
        return step if np.isfinite(step) else 1e-2 * float(span if np.isfinite(span) else abs(self.value) or 1.0)

    def _add_next(self, side: int, last: ProfilePoint, step: float, most: float) -> ProfilePoint | None:
        """Return the next point outwards; the step is halved while a fit fails or zeta is above `most`, but where it
        jumps.
        """
        limit, before = self.limits[side], np.inf
        for attempt in range(1, HALVINGS_OF_STEP + 1):
            value = last.value + side * step
            if side * (value - limit) > -1e-3 * step:
                value = limit
            new = self._add(value, last)
            if new is not None and new.converged:
                zeta = self._measure_zeta(new.cost)
                if attempt == HALVINGS_OF_STEP or zeta <= most or zeta > 0.99 * before:  # as high as at twice the step
                    return new
                before = zeta
            self.points = [q for q in self.points if q is not new]
            step *= 0.5
        return None

    def _add_minima(self, side: int) -> None:
        """Add points at minima between points far apart, where the slopes show one."""
        from scipy.optimize import minimize_scalar

        for inner, outer in pairwise(self._list_side(side)[1:]):
            if side * inner.slope < 0 < side * outer.slope:
                near = min((inner, outer), key=lambda q: q.cost)

                def cost(value: float, near: ProfilePoint = near) -> float:
                    found = self._add(value, near)
                    return np.inf if found is None else found.cost

                bounds = sorted((inner.value, outer.value))
                minimize_scalar(
                    cost, bounds=bounds, method="bounded", options={"xatol": 1e-3 * (bounds[1] - bounds[0])}
                )

    def _sweep_inward(self, side: int) -> None:
        """Follow a branch of lower cost from its outer end inwards, as long as it remains lower."""
        outer, *inward = self._list_side(side)[:0:-1]
        for inner in inward:
            found = self._fit(inner.value, outer.theta)
            if found is None or not found.converged or found.cost >= inner.cost - 1e-9 * abs(inner.cost):
                return
            self._insert(found)
            outer = found

    # --- crossings of the threshold

    def _find_crossing(self, a: ProfilePoint, b: ProfilePoint, threshold: float) -> float:
        """Return where |zeta| equals the threshold, between two neighboring points on different sides of it."""
        found = [a, b]

        def excess(value: float) -> float:
            near = min(found, key=lambda q: abs(q.value - value))
            # If no fit succeeds, use the nearest point that could be fitted.
            point = near if near.value == value else self._add(value, near) or near
            found.append(point)
            return abs(self._compute_zeta(point)) - threshold

        from scipy.optimize import brentq

        # zeta is nearly linear in the unknown: a root finder by secants needs a few fits.
        # Relative to the interval, and to the distance from the estimate: a standard error has no more digits.
        precision = 1e-7 * max(abs(b.value - a.value), min(abs(q.value - self.value) for q in (a, b)))
        root = float(brentq(excess, a.value, b.value, xtol=max(precision, 1e-300), rtol=1e-12))
        # No fit came near the threshold: zeta jumps over it where the minimum in the other unknowns ends.
        if min(abs(abs(self._compute_zeta(q)) - threshold) for q in found) > 1e-3 * threshold:
            self.jumps.append(root)
        return root

    def _find_regions(self, threshold: float) -> list[tuple[float, float]]:
        """Return all intervals found in which |zeta| is at most the threshold, ascending; open ends are infinite."""
        for side in (-1, 1):
            self._follow(side, threshold)
        inside = [abs(self._compute_zeta(q)) <= threshold for q in self.points]
        pairs = zip(pairwise(self.points), pairwise(inside), strict=True)
        edges = [self._find_crossing(a, b, threshold) for (a, b), (here, there) in pairs if here != there]
        if inside[0]:
            edges.insert(0, self._get_open_end(-1))
        if inside[-1]:
            edges.append(self._get_open_end(1))
        return list(zip(edges[::2], edges[1::2], strict=True))

    def _get_open_end(self, side: int) -> float:
        """Return the end of a region on a side where the threshold was not crossed."""
        end, last = self._ends[side], self._list_side(side)[-1].value
        if end in ("limit", "crossed"):
            return last
        return float(side * np.inf) if end == "flat" else float("nan")


def profile(estimate: SolvedFit, name: str, *, level: float = 0.95, callback: Progress | None = None) -> Profile:
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
    >>> fit = sf.estimate(heater_problem())

    >>> [round(float(end), 1) for end in sf.profile(fit, "tau_1").interval(0.95)]
    [2.4, 2.5]
    """
    fit = as_instance(estimate, "estimate", SolvedFit, "what sf.estimate returns: fit the problem first")
    if as_name(name, "name") not in fit.theta_names:
        raise ValueError(f"there is no unknown {shorten(name)}; the unknowns are {join_names(fit.theta_names)}.")
    level = as_level(level)
    if callback is not None:
        as_callable(callback, "callback", "a function callback(done, total)", arguments=2)
    evaluator = fit.evaluator_at_solution()
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
    found = Profile(fit, evaluator, name, level)
    with show_progress(callback, f"Profile of {name}") as report:
        # Of as many fits as a profile usually takes.
        found._should_stop = lambda: bool(
            report(found.fits, max(2 * (STEPS_TO_THRESHOLD + LOOK_AHEAD + 2), found.fits))
        )
        try:
            found._find_regions(fit.quantile(level))
        except KeyboardInterrupt:
            found._interrupted = True
    found._should_stop = bool
    return found
