"""Validation: how well the fitted parameters predict another run, with all that is uncertain counted.

Chi-square is ``z . z``, z being the residuals without the part that the error of the fitted parameters makes
(`switchfit.strategy.whitening`). With sigma unknown both in the fit and here, ``z . z / (n s^2)`` is compared with F of
(n, degrees of freedom of the fit).

Where sigmas are unknowns of the fit, chi-square is ``(1 - k / m) z . z``; over n it is compared with F of (n, m - k).
The error of their logarithms (covariance L) adds ``4 c' L c`` to the variance of ``z . z``, c being the numbers of
values of each sigma; F has that variance, about, if ``m = n^2 / (2 c' L c)``. The fit's k other unknowns make sigma too
small; if the fit has N > m values, the part m / N of k counts. For one sigma without a prior m is N, and all is exactly
as with sigma unknown. For several sigmas this is Satterthwaite's approximation ([1]_); a prior on sigma makes m larger.

The fit in per cent is that of [2]_.

References
----------
.. [1] F. E. Satterthwaite, An approximate distribution of estimates of variance components, Biometrics 2 (1946)
   110-114.
.. [2] L. Ljung, System Identification: Theory for the User, 2nd ed., Prentice Hall 1999, chapter 16.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.comparison import Comparison, compare
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Trajectory
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_level
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_names
from switchfit.problem.variants import fix_unknowns
from switchfit.runtime import special
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Displayed, Figure, draw_figure, format_line, join_first
from switchfit.strategy.choice import find_best_fit
from switchfit.strategy.input_correlation import InputCorrelation, correlate_inputs
from switchfit.strategy.other_run import build_other_problem
from switchfit.strategy.whitening import whiten_residuals
from switchfit.uncertainty.chi_square import CLEARLY_OFF, UNLIKELY_AS_NOISE
from switchfit.uncertainty.corrected_errors import measure_widening
from switchfit.uncertainty.doubts import Level
from switchfit.uncertainty.explained_variance import HALF, explain_all, explain_channel
from switchfit.uncertainty.findings import Finding
from switchfit.uncertainty.judged_fit import JudgedFit
from switchfit.uncertainty.prediction import Prediction, build_prediction
from switchfit.uncertainty.residuals import ResidualDiagnostics, diagnose_runs, list_channels
from switchfit.uncertainty.sample_derivatives import count_values_by_sigma
from switchfit.uncertainty.sensitivity import compute_sensitivities
from switchfit.uncertainty.verdict import Verdict, build_verdict


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
    refit: JudgedFit | None = field(repr=False)
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
        # Unknowns that neither fit estimated, such as a parameter that was fixed there, keep their errors: factor 1.
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
        return _judge_validation(self)

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


def validate(estimate: JudgedFit, other: Any, *, refit: Sequence[str] | None = None) -> Validation:
    """Return how well the parameters of an estimate predict another run, see `Estimate.validate`.

    Parameters
    ----------
    estimate : JudgedFit
    other : Experiment, list of Experiment, Problem, Measurements or Log
    refit : sequence of str, optional
    """
    problem = build_other_problem(estimate, other)
    # An array parameter has several entries of theta, under one name in `estimate.parameters`.
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
        # The parameters of the fit are constants while the run's own unknowns are estimated; how their error acts on
        # these is linearised afterwards (`whiten_residuals`).
        held = [name for name in problem.theta_names if name not in asked]
        found = find_best_fit(fix_unknowns(problem, held))
        theta[np.isin(problem.theta_names, found.theta_names)] = found.theta
    evaluator = Evaluator(problem, theta)
    trajectories, comparisons = compare(evaluator, theta)
    sensitivities = compute_sensitivities(evaluator, theta)
    noise = _choose_noise(estimate, problem)
    whitened = whiten_residuals(estimate, problem, sensitivities, comparisons, kept, found, noise)
    residuals, chi_square, freedom, covariance = whitened
    noise_freedom, scale = _judge_noise(estimate, problem, theta, covariance, found)
    # Diagnostics read residuals as measured less fitted. Here these are the whitened z; and weights of a robust loss
    # belonged to the others.
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
        inputs=tuple(correlate_inputs(problem, diagnostics)),
    )


def _choose_noise(estimate: JudgedFit, problem: Problem) -> float:
    """Return what residuals are divided by where sigma is unknown: 1 where it is known, NaN where nothing says it."""
    if problem.is_sigma_known:
        return 1.0
    return float(np.sqrt(estimate.residual_variance)) if estimate.sigma_known is False else np.nan


def _judge_noise(
    estimate: JudgedFit, problem: Problem, theta: FloatArray, covariance: FloatArray, refit: JudgedFit | None
) -> tuple[float, float]:
    """Return the degrees of freedom with which the fit knows the noise, and by what chi-square is multiplied.

    NaN if a sigma was estimated from the run itself, or as many unknowns as values.
    """
    # F of (n, freedom of the fit): residuals are divided by the noise that the fit has found.
    if problem.is_sigma_known is False:
        return estimate.freedom, 1.0
    counts = count_values_by_sigma(problem)
    names = [name for name, count in zip(problem.theta_names, counts, strict=True) if count]
    # A sigma that was chosen to suit these residuals makes chi-square n, whatever the model is worth.
    if refit is not None and set(names) & set(refit.theta_names):
        return np.nan, np.nan
    # c / sigma: turns the covariance of theta into c'L c of the logarithms.
    slope = counts / np.where(counts > 0, theta, 1.0)
    variance = float(slope @ covariance @ slope) if names else 0.0
    if variance == 0:
        return np.inf, 1.0
    # F of (n, m) has, about, the variance of z . z: m = n^2 / (2 c'L c), as in the header.
    m = sum(item.count for item in problem.measurements) ** 2 / (2 * variance)
    # k, the unknowns of the fit besides the sigmas; a sigma with a prior has a sample of its own, and takes none.
    others = estimate.samples - estimate.freedom - sum(name not in estimate.priors for name in names)
    k = others * min(m / estimate.samples, 1.0)
    return (m - k, 1 - k / m) if m > k else (np.nan, np.nan)


def _judge_validation(found: Validation) -> Verdict:
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
    # Of many samples chi-square rejects a model that is right to a per cent: it must be clearly too large as well.
    too_far = (
        is_tested and found.probability < UNLIKELY_AS_NOISE and found.chi_square > (1 + CLEARLY_OFF) * found.freedom
    )
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
    # Bonferroni: of so many tests one is unlikely by chance.
    tested = [test for test in found.inputs if test.probability < UNLIKELY_AS_NOISE / len(found.inputs)]
    if tested:
        against.append(Finding("doubtful", Issue("input not explained", tuple(t.input for t in tested))))
    return build_verdict(against)
