"""Validation: how well the fitted parameters predict another run, with all that is uncertain counted.

Chi-square is ``z . z``, z being the residuals without the part that the error of the fitted parameters makes
(`switchfit.strategy.validation`). With sigma unknown both in the fit and here, ``z . z / (n s^2)`` is compared with F
of (n, degrees of freedom of the fit).

Where sigmas are unknowns of the fit, chi-square is ``(1 - k / m) z . z``; over n it is compared with F of (n, m - k).
The error of their logarithms (covariance L) adds ``4 c' L c`` to the variance of ``z . z``, c being the numbers of
values of each sigma; F has that variance, about, if ``m = n^2 / (2 c' L c)``. The fit's k other unknowns make sigma too
small; if the fit has N > m values, the part m / N of k counts. For one sigma without a prior m is N, and all is exactly
as with sigma unknown. For several sigmas this is Satterthwaite's approximation ([4]_); a prior on sigma makes m larger.

The problem of another run from a fit: its parameters, and what the run says of itself.

Residuals of another run without the correlation that the error of the fitted parameters makes.

With residuals and derivatives in units of sigma, e the noise of the new run, dp the error of the fitted parameters
(covariance C) and G the derivative of the new run's own unknowns, which were fitted to it, the residuals are

    r = M (e - X dp),      M = I - G G^+,      cov r = M + (M X) C (M X)'.

In a linear model ``z = (I + M X C X' M)^(-1/2) r`` has the covariance M: chi-square is ``z . z``, with as many degrees
of freedom as values less own unknowns ([1]_, section 3.9, prediction of several new observations). Tests of whiteness
are made of z, since the error of the parameters, which is common to all samples, correlates the residuals r.

References
----------
.. [1] G. A. F. Seber, A. J. Lee, Linear Regression Analysis, 2nd ed., Wiley 2003, chapters 3 and 5.
.. [2] T. Soderstrom, P. Stoica, System Identification, Prentice Hall 1989, section 11.2 (tests of cross-correlation).
.. [3] L. Ljung, System Identification: Theory for the User, 2nd ed., Prentice Hall 1999, chapter 16 (fit in per cent).
.. [4] F. E. Satterthwaite, An approximate distribution of estimates of variance components, Biometrics 2 (1946)
   110-114.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.estimation.estimator import Estimate
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Fit, invert
from switchfit.fit.trajectory import Comparison, Trajectory, compare
from switchfit.problem.data import count_from
from switchfit.problem.dates import Dates
from switchfit.problem.experiment import Experiment, show_time
from switchfit.problem.measurements import Measurements
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_level
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_names
from switchfit.problem.validation.tables import list_columns
from switchfit.runtime import special
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Displayed, Figure, draw_figure, format_line, join_first, validate_on
from switchfit.strategy.choice import estimate as fit_problem
from switchfit.strategy.known_order import fix_unknowns
from switchfit.uncertainty.prediction import (
    Prediction,
    Sensitivity,
    build_prediction,
    collect_sample_derivatives,
    compute_sensitivities,
    count_values_by_sigma,
)
from switchfit.uncertainty.residuals import (
    CLEARLY_OFF,
    FEWEST,
    HALF,
    UNLIKELY,
    ResidualDiagnostics,
    diagnose_runs,
    explain_all,
    explain_channel,
    list_channels,
    measure_widening,
)
from switchfit.uncertainty.verdict import Finding, Level, Verdict, build_verdict

NEGLIGIBLE = 1e-10
"""Singular value of the derivative of the own unknowns, relative to the largest, of a direction that does nothing."""


def build_other_problem(estimate: Estimate, other: Any) -> Problem:
    """Return the problem of another run, in which the parameters of a fit begin at their fitted values, without priors.

    Parameters
    ----------
    estimate : Estimate
    other : Experiment, list of Experiment, Problem, Measurements or Log
    """
    if isinstance(other, Problem):
        given, runs = other, list(other.experiments)
    else:
        given = estimate.evaluator_at_solution().problem
        runs = list(other) if isinstance(other, (list, tuple)) else [other]
        if not runs or not all(isinstance(item, Experiment) for item in runs):
            runs = [_build_experiment(estimate, given, other)]
    parameters = {}
    for name, parameter in given.parameters.items():
        if name in estimate.parameters:
            value = estimate.parameters[name]
            bounds = {"lower": np.minimum(parameter.lower, value), "upper": np.maximum(parameter.upper, value)}
            held = parameter.fixed or name in estimate.fixed
            parameter = replace(parameter, value=value, **bounds, prior=None, fixed=held)
        parameters[name] = parameter
    return replace(given, experiments=runs, parameters=parameters)


def _build_experiment(estimate: Estimate, problem: Problem, other: Any) -> Experiment:
    """Return the only experiment of a fit with the data of another log."""
    run, given = problem.experiments[0], list(other) if isinstance(other, (list, tuple)) else [other]
    items = run.measurements
    is_log = list_columns(other) is not None and hasattr(other, "times")
    if not is_log and not (given and all(isinstance(item, Measurements) for item in given)):
        raise TypeError(
            "validate needs another run: an sf.Experiment or a list of them, an sf.Problem, sf.Measurements or a log; "
            f"got {shorten(other)}."
        )
    if len(problem.experiments) > 1 or run.inputs is not None or len(items) != len(run.data):
        raise ValueError(
            "another log has measurements alone, but the fit has several experiments, inputs, or other data than "
            "sf.Measurements: give validate an sf.Experiment, which says what the other run is."
        )
    if is_log:
        given = [_read_channels(other, item) for item in items]
    if len(given) != len(items):
        raise ValueError(f"the fit has {len(items)} Measurements; got {len(given)} for the other run.")
    data = _count_dates([_complete(new, item) for new, item in zip(given, items, strict=True)], run)
    first, last = min(item.seen_times[0] for item in data), max(item.times[-1] for item in data)
    t0 = first if "t0" in run.taken_from_data else run.t0
    times = estimate.transition_times[0]
    if np.any(np.diff([t0, *times, last]) <= 0):
        times = np.linspace(t0, last, len(run.mode_sequence) + 1)[1:-1]
    guesses = tuple(
        replace(tau, value=np.clip(time, tau.lower, tau.upper), prior=None)
        for tau, time in zip(run.transition_times, times, strict=True)
    )
    return replace(run, data=data, t0=t0, tf=run.tf if run.has_free_tf else last, transition_times=guesses)


def _count_dates(data: list[Measurements], run: Experiment) -> list[Measurements]:
    """Return Measurements of another log with dates as numbers since the origin of the run of the fit."""
    dated = [item for item in data if isinstance(item.times, Dates)]
    if dated and run.origin is None:
        raise ValueError(
            "the other log has dates, and the times of the fit are numbers: give validate an sf.Experiment, whose "
            "origin says at which date its times are 0."
        )
    counted = data if run.origin is None else [count_from(item, run.origin, run.time_unit) for item in data]
    if dated and "t0" not in run.taken_from_data and min(item.times[0] for item in counted) > run.end:
        raise ValueError(
            f"the other log begins at {dated[0].times[0]!r}, after the end of the fit's horizon at "
            f"{show_time(run, run.end)}: give validate an sf.Experiment, which says when the other run begins."
        )
    return counted


def _read_channels(log: Any, like: Measurements) -> Measurements:
    """Return the Measurements of a log's columns that are called like the channels of others."""
    if like.names is None:
        raise ValueError(
            "the channels of the fit have no names by which to find the columns of the log: give its Measurements "
            "names, or give validate sf.Measurements."
        )
    missing = [name for name in like.names if name not in log]
    if missing:
        raise ValueError(f"the log has no column {join_names(missing)}; it has {join_names(list(log.columns))}.")
    values = np.stack([np.asarray(log[name], dtype=np.float64) for name in like.names], axis=1)
    return Measurements(log.times, values, names=like.names)


def _complete(new: Measurements, like: Measurements) -> Measurements:
    """Return Measurements with what is left out in them taken from others, where the channels are as many."""
    if new.values.shape[1] != like.values.shape[1]:
        raise ValueError(
            f"the Measurements of the fit have {like.values.shape[1]} channels, those of the other run "
            f"{new.values.shape[1]}."
        )
    names = ("sigma", "observe", "names", "units")
    left_out = {name: getattr(like, name) for name in names if getattr(new, name) is None}
    if "sigma" in left_out:
        if isinstance(like.sigma, np.ndarray) and like.sigma.ndim == 2:
            raise ValueError(
                "sigma differs from sample to sample in the fit: give the Measurements of the other run their "
                "own sigma."
            )
        left_out |= {"loss": like.loss, "loss_scale": like.loss_scale}
    return replace(new, delay=new.delay or like.delay, **left_out)


def whiten_residuals(
    estimate: Estimate,
    problem: Problem,
    sensitivities: Sequence[Sensitivity],
    comparisons: Sequence[Sequence[Comparison]],
    kept: Mapping[str, int],
    refit: Estimate | None,
    noise: float,
) -> tuple[list[list[FloatArray]], float, int, FloatArray]:
    """Return residuals without the correlation that the error of the parameters makes, and what follows from them.

    They are in the units of the data, as the comparisons; then come chi-square, its degrees of freedom, and the
    covariance of theta of the other run, (d, d). Where the noise or the covariance of the fit is unknown, a loss is
    robust, or a delay is a parameter, the residuals as they are, and NaN for chi-square and covariance.

    Parameters
    ----------
    estimate : Estimate
        The fit.
    problem : Problem
        Of the other run.
    sensitivities : sequence of Sensitivity, one for each experiment
    comparisons : sequence of sequences of Comparison, one for each experiment
    kept : mapping of str to int
        Unknowns that come from the fit, and where they are in theta of the other run.
    refit : Estimate or None
        Estimation of the other unknowns.
    noise : float
        What residuals are divided by where sigma is unknown; 1 where it is known.
    """
    d = len(problem.theta_names)
    found = [[c.residuals.copy() for c in run] for run in comparisons]
    freedom = sum(item.count for item in problem.measurements)
    Z = np.zeros((d, 0))
    if refit is not None:
        where = np.flatnonzero(np.isin(problem.theta_names, refit.theta_names))
        Z = np.zeros((d, refit.free_basis.shape[1]))
        Z[where] = refit.free_basis
        freedom += len(refit.priors) - Z.shape[1]
    here = [i for name, i in kept.items() if name in estimate.theta_names]
    there = [estimate.theta_names.index(problem.theta_names[i]) for i in here]
    C = np.zeros((d, d))
    C[np.ix_(here, here)] = estimate.covariance[np.ix_(there, there)]
    # Residuals over sigma are then no normal numbers, or their derivatives are not known. A sigma may be a parameter.
    robust = any(item.loss != "linear" for item in problem.measurements) or problem.estimates_delays
    if robust or problem.is_sigma_known is None or not (np.isfinite(C).all() and np.isfinite(noise)):
        return found, np.nan, freedom, np.full((d, d), np.nan)
    samples = collect_sample_derivatives(problem, sensitivities)
    sigma = noise * samples.weight**-0.5
    X, r = samples.derivative / sigma[:, None], -samples.residual / sigma
    if refit is not None and refit.priors:
        rows, error = _weigh_priors(problem, refit)
        X, r = np.vstack([X, rows]), np.append(r, -error)
    z, follow, alone = _remove_error(X, r, Z, C)
    for e, run in enumerate(comparisons):
        measured = [k for k, c in enumerate(run) if c.kind == "measurements"]
        for k, item in enumerate(measured):
            own = (samples.experiment == e) & (samples.item == k)
            found[e][item][np.isfinite(run[item].residuals)] = (z[: len(sigma)] * sigma)[own]
    if refit is not None:
        # The exact Hessian, as of any fit: a transition time at which the vector field does not jump has no first
        # derivative, and would have no error.
        exact = invert(refit, refit.hessian, noise**2) * noise**2
        if np.isfinite(exact).all():
            alone = np.zeros((d, d))
            alone[np.ix_(where, where)] = exact
    return found, float(z @ z), freedom, follow @ follow.T + alone


def _remove_error(
    X: FloatArray, r: FloatArray, Z: FloatArray, C: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return z (n,); a root of the covariance of theta that follows from C, (d, d); and that of the own unknowns alone.

    Parameters
    ----------
    X : (n, d)
        Derivatives of the residuals r (n,), in sigmas.
    Z : (d, k)
        Directions of the own unknowns that were fitted: G = X Z.
    C : (d, d)
        Covariance of the fitted parameters.
    """
    left, size, right = np.linalg.svd(X @ Z, full_matrices=False)
    does = size > NEGLIGIBLE * size.max(initial=0.0)
    Q, root = left[:, does], Z @ (right[does].T / size[does])  # Z G^+ = root Q', M = I - Q Q'
    values, vectors = np.linalg.eigh(C)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    U = X @ half
    # With M X C^(1/2) = W s V', cov r = M + W s^2 W': (I + W s^2 W')^(-1/2) is I + W (1 / sqrt(1 + s^2) - 1) W'.
    W, s, _ = np.linalg.svd(U - Q @ (Q.T @ U), full_matrices=False)
    r = r - Q @ (Q.T @ r)  # a fit that ended at a kink or a bound leaves a part
    z = r + W @ ((1 / np.sqrt(1 + s**2) - 1) * (W.T @ r))
    return z, half - root @ (Q.T @ U), root @ root.T  # own unknowns follow the error of the parameters


def _weigh_priors(problem: Problem, refit: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return the priors of own unknowns as further residuals: their derivatives (m, d), and their values (m,)."""
    where = np.flatnonzero(np.isin(problem.theta_names, refit.theta_names))
    priors = PriorTerms(*(values[where] for values in problem.unknowns.priors))
    _, g, h = priors.evaluate(refit.theta, gauss_newton=True)  # of r = g / sqrt(h), whose derivative is sqrt(h)
    has, root = h > 0, np.sqrt(h[h > 0])
    rows = np.zeros((len(root), len(problem.theta_names)))
    rows[np.arange(len(root)), where[has]] = root
    return rows, g[has] / root


class InputCorrelation(NamedTuple):
    """Whether the residuals of one channel depend on one input.

    Attributes
    ----------
    channel, input : str
    probability : float
        Of so large a correlation at lags 0 to `lags`, in samples, if there is none; NaN for fewer than 20 values or an
        input that is constant.
    lags : int

    See Also
    --------
    Validation

    Examples
    --------
    >>> sf.InputCorrelation("speed", "torque", probability=0.4, lags=5).input
    'torque'
    """

    channel: str
    input: str
    probability: float
    lags: int


@dataclass(frozen=True, eq=False)
class Validation(Displayed):
    """How well the parameters of a fit predict another run; print it for the report.

    Attributes
    ----------
    fit : Fit
        The fit whose parameters these are.
    problem : Problem
        The other run, with the parameters of the fit.
    theta_names : tuple of str
        Its unknowns: its own, and the parameters that were kept.
    theta : (d,)
    kept : tuple of str
        Unknowns that come from the fit.
    covariance : (d, d)
        Of theta: for parameters that of the fit, for own unknowns what follows from it and from the new data. NaN if
        the fit has none.
    refit : Estimate or None
        The estimation of the own unknowns; None if nothing was estimated.
    run_names : tuple of str
    trajectories : tuple of Trajectory, one for each experiment
    comparisons : tuple of tuples of Comparison, one tuple for each experiment
    chi_square : float
        Sum of the squared residuals over what is expected of them, the error of the parameters included; NaN if the
        noise or the covariance of the fit is unknown, a loss is robust, a delay is a parameter, a sigma was estimated
        from this run, or with reference signals.
    freedom : int
        Its degrees of freedom: values less own unknowns that were estimated.
    sigma_known : bool or None
        Whether the noise is known; None with other data than Measurements.
    residual_variance : float
        Variance of the noise by which residuals are divided where sigma is unknown: that of the fit.
    noise_freedom : float
        Degrees of freedom with which the fit knows the noise; infinite where no sigma was estimated.
    residuals : ResidualDiagnostics
        Tests of the residuals, those of `chi_square` where there is one.
    inputs : tuple of InputCorrelation
        Tests of the residuals of each channel with each input.

    See Also
    --------
    Estimate.validate : returns it.

    Examples
    --------
    >>> problem = heater_problem()

    Fit every other reading, and predict the rest with the parameter and the transition time of its own:

    >>> log = problem.experiments[0].data[0]
    >>> halves = [sf.Measurements(log.times[k::2], log.values[k::2], sigma=0.2) for k in (0, 1)]
    >>> runs = [sf.Experiment(half, ("on", "off"), (2.0,), 0.0, 6.0) for half in halves]
    >>> found = sf.estimate(sf.Problem(problem.system, runs[0], problem.parameters)).validate(runs[1])
    >>> round(found.percent), round(found.explained, 3)
    (96, 0.999)
    >>> print(found.verdict)
    Good: the fitted parameters predict 99.87 % of the variance (fit 96.4 %; chi² 3.94 for 11 degrees of freedom).
    """

    fit: Fit = field(repr=False)
    problem: Problem = field(repr=False)
    theta_names: tuple[str, ...]
    theta: FloatArray
    kept: tuple[str, ...]
    covariance: FloatArray = field(repr=False)
    refit: Estimate | None = field(repr=False)
    run_names: tuple[str, ...]
    trajectories: tuple[Trajectory, ...] = field(repr=False)
    comparisons: tuple[tuple[Comparison, ...], ...] = field(repr=False)
    chi_square: float
    freedom: int
    sigma_known: bool | None
    residual_variance: float
    noise_freedom: float
    residuals: ResidualDiagnostics = field(repr=False)
    inputs: tuple[InputCorrelation, ...] = ()

    @property
    def explained(self) -> float:
        """R²: share of the variance of all channels that is predicted, each in units of its sigma."""
        return explain_all(self.comparisons)

    @property
    def percent(self) -> float:
        """Fit in per cent, ``100 (1 - |y - predicted| / |y - mean|)`` over all channels; 100 at best."""
        return convert_to_percent(self.explained)

    @property
    def channels(self) -> dict[str, float]:
        """Fit in per cent of each channel, by its name, and that of its run if there are several."""
        channels = list_channels(self.comparisons, self.run_names)
        return {label: convert_to_percent(explain_channel(comparison, k)) for label, _, comparison, k in channels}

    @property
    def standard_errors(self) -> FloatArray:
        """Standard errors of theta, as if residuals were independent: (d,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def corrected_standard_errors(self) -> FloatArray:
        """Standard errors of theta that allow for correlated residuals, of `corrected_covariance`: (d,)."""
        return np.sqrt(np.diag(self.corrected_covariance))

    @cached_property
    def corrected_covariance(self) -> FloatArray:
        """Covariance of theta that allows for correlated residuals, of which the bands are made: (d, d).

        Parameters of the fit have the standard errors that are corrected there. Those of own unknowns are widened by
        the largest factor of these and of their own estimation, since both errors are in them.
        """
        known = dict(zip(self.fit.theta_names, measure_widening(self.fit), strict=True))
        widest = max((known[name] for name in self.kept if name in known), default=1.0)
        if self.refit is not None:
            factors = measure_widening(self.refit)
            known |= {n: max(f, widest) for n, f in zip(self.refit.theta_names, factors, strict=True)}
        each = np.array([known.get(name, 1.0) for name in self.theta_names])
        return np.asarray(each[:, None] * self.covariance * each)

    @property
    def probability(self) -> float:
        """Probability of such a chi-square, or a larger one, if model and noise are right; NaN without."""
        if not np.isfinite(self.chi_square) or self.freedom <= 0:
            return np.nan
        if np.isinf(self.noise_freedom):
            return float(special.chdtrc(self.freedom, self.chi_square))
        return float(special.fdtrc(self.freedom, self.noise_freedom, self.chi_square / self.freedom))

    @cached_property
    def verdict(self) -> Verdict:
        """Whether the parameters hold for the other run: good, doubtful or bad, and why. Print it for one line."""
        return judge_validation(self)

    @cached_property
    def predictions(self) -> tuple[Prediction, ...]:
        """The predicted curves with their bands, one for each experiment; empty if the fit has no covariance."""
        if not np.isfinite(self.covariance).all():
            return ()
        found = enumerate(compute_sensitivities(Evaluator(self.problem, self.theta), self.theta))
        return tuple(build_prediction(self, self.problem, e, each.nodes) for e, each in found)

    def quantile(self, level: float) -> float:
        """Return the two-sided quantile of bands, that of the fit.

        See Also
        --------
        Prediction.prediction_band

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> round(fit.validate(fit.problem).quantile(0.95), 2)
        1.96
        """
        return self.fit.quantile(level)

    def plot(self, *, level: float = 0.95) -> Figure:
        """Draw measured against predicted with bands, and the residuals below.

        Parameters
        ----------
        level : float, between 0 and 1
            Level of the bands, and of the intervals of transition times.

        See Also
        --------
        Estimate.plot

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> len(fit.validate(fit.problem).plot().axes)
        2
        """
        figure: Figure = draw_figure(self, level=as_level(level))
        return figure

    def __repr__(self) -> str:
        fits = (f"{name} {percent:.1f} %" for name, percent in self.channels.items())
        return format_line(self, self.verdict.level, f"fit of {join_first(fits)}")


def convert_to_percent(explained: float) -> float:
    """Return the fit in per cent, ``100 (1 - sqrt(1 - R²))``.

    Parameters
    ----------
    explained : float
        R².
    """
    return float(100 * (1 - np.sqrt(1 - explained)))


@validate_on.register(Estimate)
def validate(estimate: Estimate, other: Any, *, refit: Sequence[str] | None = None) -> Validation:
    """Return how well the parameters of an estimate predict another run, see `Estimate.validate`.

    Parameters
    ----------
    estimate : Estimate
    other : Experiment, list of Experiment, Problem, Measurements or Log
    refit : sequence of str, optional
    """
    problem = build_other_problem(estimate, other)
    spans = [span for name, span in problem.unknowns.parameters.items() if name in estimate.parameters]
    kept = {problem.theta_names[i]: i for span in spans for i in range(span.start, span.stop)}
    own = [name for name in problem.theta_names if name not in kept]
    asked = own if refit is None else list(as_names(refit, "refit", "a sequence of names of unknowns"))
    unknown = [name for name in asked if name not in own]
    if unknown:
        raise ValueError(
            f"refit names {shorten(unknown[0])}, which is no unknown of the other run's own; these are "
            f"{join_names(own)}. Parameters of the fit are kept."
        )
    theta, found = problem.initial_theta, None
    if asked:
        held = [name for name in problem.theta_names if name not in asked]
        found = fit_problem(fix_unknowns(problem, held))
        theta[np.isin(problem.theta_names, found.theta_names)] = found.theta
    evaluator = Evaluator(problem, theta)
    trajectories, comparisons = compare(evaluator, theta)
    sensitivities = compute_sensitivities(evaluator, theta)
    noise = _choose_noise(estimate, problem)
    whitened = whiten_residuals(estimate, problem, sensitivities, comparisons, kept, found, noise)
    residuals, chi_square, freedom, covariance = whitened
    noise_freedom, scale = _judge_noise(estimate, problem, theta, covariance, found)
    judged = [
        [replace(c, measured=c.fitted + z, downweighted=None) for c, z in zip(run, shown, strict=True)]
        for run, shown in zip(comparisons, residuals, strict=True)
    ]
    diagnostics = diagnose_runs(judged, problem.run_names, trajectories)
    return Validation(
        fit=estimate,
        problem=problem,
        theta_names=problem.theta_names,
        theta=theta,
        kept=tuple(kept),
        covariance=covariance,
        refit=found,
        run_names=problem.run_names,
        trajectories=trajectories,
        comparisons=comparisons,
        chi_square=chi_square * scale,
        freedom=freedom,
        sigma_known=problem.is_sigma_known,
        residual_variance=noise**2,
        noise_freedom=noise_freedom,
        residuals=diagnostics,
        inputs=tuple(_correlate_inputs(problem, diagnostics)),
    )


def _choose_noise(estimate: Estimate, problem: Problem) -> float:
    """Return what residuals are divided by where sigma is unknown: 1 where it is known, NaN where nothing says it."""
    if problem.is_sigma_known:
        return 1.0
    return float(np.sqrt(estimate.residual_variance)) if estimate.sigma_known is False else np.nan


def _judge_noise(
    estimate: Estimate, problem: Problem, theta: FloatArray, covariance: FloatArray, refit: Estimate | None
) -> tuple[float, float]:
    """Return the degrees of freedom with which the fit knows the noise, and by what chi-square is multiplied.

    NaN if a sigma was estimated from the run itself, or as many unknowns as values.
    """
    if problem.is_sigma_known is False:
        return estimate.freedom, 1.0
    counts = count_values_by_sigma(problem)
    names = [name for name, count in zip(problem.theta_names, counts, strict=True) if count]
    if refit is not None and set(names) & set(refit.theta_names):
        return np.nan, np.nan
    slope = counts / np.where(counts > 0, theta, 1.0)
    variance = float(slope @ covariance @ slope) if names else 0.0
    if variance == 0:
        return np.inf, 1.0
    m = sum(item.count for item in problem.measurements) ** 2 / (2 * variance)
    others = estimate.samples - estimate.freedom - sum(name not in estimate.priors for name in names)
    k = others * min(m / estimate.samples, 1.0)
    return (m - k, 1 - k / m) if m > k else (np.nan, np.nan)


def _correlate_inputs(problem: Problem, diagnostics: ResidualDiagnostics) -> list[InputCorrelation]:
    """Test the residuals of each channel with each input of its run."""
    found = []
    for label, channel in zip(diagnostics.labels, diagnostics.channels, strict=True):
        run = problem.experiments[channel.experiment]
        if run.inputs is None:
            continue
        values = run.inputs.signal(run.t0, run.end)(channel.times)
        width = values.shape[1]
        names = run.inputs.names or (("u",) if width == 1 else tuple(f"u{k + 1}" for k in range(width)))
        for name, u in zip(names, values.T, strict=True):
            lags = len(channel.autocorrelation)
            found.append(InputCorrelation(label, name, correlate(channel.values, u, lags), lags))
    return found


def correlate(z: FloatArray, u: FloatArray, lags: int) -> float:
    """Return the probability of the correlation of residuals z (n,) with an input u (n,) at lags 0 to `lags`, or of a
    larger one, if z is white and independent of u; NaN for fewer than 20 values, or if u does not vary.

    With Phi the input at these lags, each less its mean, ``z' Phi (Phi' Phi)^+ Phi' z / (z' z / n)`` is chi-square with
    the rank of Phi degrees of freedom.

    Parameters
    ----------
    z, u : (n,)
    lags : int
    """
    if len(z) < FEWEST:
        return np.nan
    Phi = np.stack([u[lags - k : len(u) - k] for k in range(lags + 1)], axis=1)
    Phi = Phi - Phi.mean(axis=0)
    left, size, _ = np.linalg.svd(Phi, full_matrices=False)
    kept: NDArray[np.bool_] = size > 1e-8 * max(float(np.abs(u).max(initial=0.0)), 1e-300) * np.sqrt(len(u))
    if not kept.any():
        return np.nan
    inner = z[lags:]
    square = float(inner @ inner) / len(inner)
    statistic = float(np.sum((left[:, kept].T @ inner) ** 2)) / square if square > 0 else 0.0
    return float(special.chdtrc(int(kept.sum()), statistic))


def judge_validation(found: Validation) -> Verdict:
    """Return the verdict on a validation.

    Parameters
    ----------
    found : Validation
    """
    explained = found.explained
    figures: dict[str, float | tuple[float, ...]] = {
        "explained": explained,
        "percent": found.percent,
        "chi-square": found.chi_square,
        "freedom": float(found.freedom),
        "probability": found.probability,
    }
    against: list[Finding] = []
    if found.refit is not None and not found.refit.status.successful:
        names = tuple(name for name in found.theta_names if name not in found.kept)
        against.append(Finding("bad", Issue("own unknowns not converged", names), ("give a better guess",)))
    is_tested = np.isfinite(found.probability)
    too_far = is_tested and found.probability < UNLIKELY and found.chi_square > (1 + CLEARLY_OFF) * found.freedom
    if too_far or not (is_tested or explained >= HALF):
        level: Level = "doubtful" if explained >= HALF else "bad"
        against.append(Finding(level, Issue("predicts badly", (), figures), ("look at plot",)))
    else:
        against.append(Finding("good", Issue("predicts", (), figures)))
    if found.freedom <= 0:
        against.append(Finding("doubtful", Issue("nothing left to test")))
    labels = [label for label, own in zip(found.residuals.labels, found.residuals.correlated, strict=True) if own]
    if labels:
        against.append(Finding("doubtful", Issue("prediction errors correlated", tuple(labels))))
    tested = [test for test in found.inputs if test.probability < UNLIKELY / len(found.inputs)]
    if tested:
        against.append(Finding("doubtful", Issue("input not explained", tuple(t.input for t in tested))))
    return build_verdict(against)
