"""Profile likelihoods: the cost as a function of one unknown, with all others fitted again.

With J_p(v) the smallest cost at theta_k = v, the signed root of the likelihood ratio,

    zeta(v) = sign(v - theta_k) sqrt(2 (J_p(v) - J) / s^2),      s^2 = 1 or, with sigma unknown, 2 J / (n - d),

is standard normal at the true value to first order, Student's t with n - d degrees of freedom where sigma is unknown,
so that ``|zeta| <= quantile`` is a confidence region ([1]_, [2]_). For a linear model zeta is the straight line
``(v - theta_k) / standard error``, and the region is the quadratic interval. The curvature of zeta shows the error of
that interval.

Where residuals are correlated, zeta is too large by the factor by which standard errors are too small; on request the
threshold is multiplied by it ([3]_, "vertical" adjustment).

The points are computed in `switchfit.uncertainty.profile_trace`.

References
----------
.. [1] D. M. Bates, D. G. Watts, Nonlinear Regression Analysis and Its Applications, Wiley 1988, chapter 6.
.. [2] W. Q. Meeker, L. A. Escobar, Teaching about approximate confidence regions based on maximum likelihood
   estimation, The American Statistician 49 (1995) 48-53.
.. [3] R. E. Chandler, S. Bate, Inference for clustered data using the independence loglikelihood, Biometrika 94 (2007)
   167-183.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.result import Fit
from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.problem import Problem
from switchfit.problem.validation import as_callable, as_flag, as_level, as_name, join_names, shorten
from switchfit.runtime.frames import Tabular
from switchfit.runtime.presentation import Axes, Displayed, Figure, draw_figure, format_line
from switchfit.runtime.progress import Progress, show_progress
from switchfit.uncertainty.profile_trace import LOOK_AHEAD, STEPS, Trace
from switchfit.uncertainty.residuals import measure_widening
from switchfit.uncertainty.walks import list_sample_times


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
        best = self.trace.best
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
        trace.should_stop = partial(_wrap_callback, report, trace)
        for side in (-1, 1):
            trace.march(side, threshold)
        trace.add_kinks(times, threshold)
        trace.find_regions(threshold)  # its points too are there from now on: tables, figure and repr agree
    except KeyboardInterrupt:
        trace.interrupted = True
    finally:
        end()
        trace.should_stop = lambda: False
    error = float(fit.standard_errors[index])
    return Profile(name, fit.theta_units[index], trace.centre.value, error, level, fit, times, trace)


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
