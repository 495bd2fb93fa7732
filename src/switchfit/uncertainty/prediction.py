"""Confidence bands of the fitted states and outputs, and prediction bands of new samples.

They follow from the delta method: with X the exact derivative of a state or an output in theta at time t and C the
covariance of theta, its standard error is sqrt(X C X'), and that of a new sample is sqrt(X C X' + sigma^2) ([1]_). The
bands hold at each time separately, not for the whole curve at once. Where residuals are correlated, C is the corrected
covariance, as the standard errors of the table of unknowns are: with independent noise assumed, the band of a curve
would be too narrow by the same factor. sigma is not changed.

At a transition X jumps (see `switchfit.uncertainty.sensitivity`): just before it the state does not depend on that
transition time, just after it does. The linear approximation assumes that the active mode is that of the fit, which may
be wrong within two standard errors of a transition time.

After tf the last mode goes on: the problem is simulated with a later tf. Bands there contain the uncertainty of the
unknowns and the noise of a sample. They do not contain that of the model: no mode may follow, and the model has no
process noise.

References
----------
.. [1] G. A. F. Seber, C. J. Wild, Nonlinear Regression, Wiley 1989, section 5.1.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.fit.comparison import find_delay
from switchfit.fit.simulation import read_times
from switchfit.meshes.refinement import refine_mesh
from switchfit.problem.experiment import show_time
from switchfit.problem.origin import Origin
from switchfit.problem.parameter import Parameter
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_index, as_level
from switchfit.problem.validation.messages import unit_suffix
from switchfit.problem.validation.objects import as_instance
from switchfit.runtime.frames import Tabular
from switchfit.runtime.presentation import Figure, draw_figure, format_html, format_line, join_first
from switchfit.uncertainty.judged_fit import JudgedFit
from switchfit.uncertainty.sensitivity import Points, compute_sensitivity


@dataclass(frozen=True, eq=False)
class Prediction(Tabular):
    """States and outputs of one experiment with their standard errors.

    Attributes
    ----------
    times : (K,) array, in `time_unit`
    states, state_errors : (K, n)
    outputs, output_errors : (K, q)
        Outputs of the Measurements; their standard errors, as those of the states from the corrected covariance where
        residuals are correlated.
    noise : (K, q)
        Standard deviation of one sample: sigma (that of the sample nearest in time, if it varies); if sigma is unknown,
        the root of the residual variance.
    state_names, state_units, output_names : tuple of str
    time_unit : str
        Unit of the experiment's times.
    fit : Fit or Validation
        With the covariance and the quantiles.
    experiment : int
        Index of the experiment, from 0.
    origin : Origin or None
        The date at which times are 0; None where they are no dates.
    corrected : bool
        Whether the errors are wider than for independent residuals, because residuals are correlated.

    See Also
    --------
    predict, Estimate.plot

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> prediction = fit.predict([1.0, 4.0])
    >>> prediction.states.shape, prediction.output_names
    ((2, 1), ('thermometer',))
    >>> prediction.state_errors.round(2)
    array([[0.02],
           [0.05]])
    """

    times: FloatArray
    states: FloatArray
    state_errors: FloatArray
    outputs: FloatArray
    output_errors: FloatArray
    noise: FloatArray
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    output_names: tuple[str, ...]
    time_unit: str
    fit: Any = field(repr=False)
    experiment: int = 0
    origin: Origin | None = None
    corrected: bool = False

    @property
    def dates(self) -> list[datetime] | None:
        """The times as dates in the experiment's time zone; None where they are no dates."""
        return None if self.origin is None else self.origin.to_dates(self.times, self.time_unit)

    def _repr_html_(self) -> str:
        return format_html(self)

    def __repr__(self) -> str:
        times = f"{len(self.times)} times"
        if len(self.times):
            times += f" from {self.times.min():.6g} to {self.times.max():.6g}{unit_suffix(self.time_unit)}"
        return format_line(self, join_first(self.output_names or self.state_names), times)

    def state_band(self, level: float = 0.95) -> FloatArray:
        """Return the confidence band of the states at each time: (K, n, 2).

        See Also
        --------
        Prediction.output_band, predict

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.predict([1.0, 4.0]).state_band(0.95).round(1)
        array([[[8.2, 8.3]],
        <BLANKLINE>
               [[8.5, 8.7]]])
        """
        return _build_band(self.states, self.fit.quantile(level) * self.state_errors)

    def output_band(self, level: float = 0.95) -> FloatArray:
        """Return the confidence band of the outputs, of their mean without noise, at each time: (K, q, 2).

        See Also
        --------
        Prediction.prediction_band, predict

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.predict([1.0, 4.0]).output_band(0.95).round(1)
        array([[[8.2, 8.3]],
        <BLANKLINE>
               [[8.5, 8.7]]])
        """
        return _build_band(self.outputs, self.fit.quantile(level) * self.output_errors)

    def prediction_band(self, level: float = 0.95) -> FloatArray:
        """Return the prediction band of a new sample at each time, noise included: (K, q, 2).

        See Also
        --------
        Prediction.output_band, predict

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.predict([1.0, 4.0]).prediction_band(0.95).round(1)
        array([[[7.9, 8.7]],
        <BLANKLINE>
               [[8.2, 9. ]]])
        """
        return _build_band(self.outputs, self.fit.quantile(level) * np.hypot(self.output_errors, self.noise))

    def plot(self, *, level: float = 0.95) -> Figure:
        """Draw the outputs over time with both bands, beside what was measured.

        Parameters
        ----------
        level : float, between 0 and 1
            Level of the bands.

        See Also
        --------
        predict, Estimate.plot

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> len(fit.predict(np.linspace(0.0, 9.0, 200)).plot().axes)
        1
        """
        return draw_figure(self, level=as_level(level))


def _build_band(values: FloatArray, half: FloatArray) -> FloatArray:
    return np.stack([values - half, values + half], axis=-1)


def predict(estimate: JudgedFit, times: ArrayLike | None = None, *, experiment: int = 0) -> Prediction:
    """Return states and outputs at any times with their standard errors and bands.

    Times are those of the states: a sensor with a delay shows the output of time t at t + delay, where figures draw it.
    The bands leave out that an estimated delay is uncertain.

    Parameters
    ----------
    estimate : Estimate
    times : (K,) array_like, optional
        In any order, not before t0, in the experiment's time unit, or dates where its times are dates; at a transition,
        values are those just before it. After tf the last mode goes on, with the noise of the last sample. If left out,
        all nodes of the mesh up to tf, each transition twice: with the state before and after it.
    experiment : int, optional
        Index of the experiment, from 0.

    Returns
    -------
    Prediction

    Raises
    ------
    TypeError
        If `estimate` is not an estimate, or an argument is of the wrong type.
    ValueError
        For times before t0, or after tf where an input is not known or the model cannot be integrated; for an
        experiment that does not exist, or an estimate without a problem or without a covariance.

    See Also
    --------
    Prediction, simulate, Estimate.plot

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> prediction = sf.predict(fit, [1.0, 4.0])
    >>> prediction.outputs.round(1)
    array([[8.3],
           [8.6]])

    The log ends at 6 h; after it the heater stays off:

    >>> sf.predict(fit, [6.0, 9.0, 12.0]).prediction_band(0.95).round(1)[:, 0]
    array([[ 3.5,  4.3],
           [ 0.8,  1.6],
           [-0. ,  0.8]])
    """
    fit = as_instance(estimate, "estimate", JudgedFit, "what sf.estimate returns: fit the problem first")
    evaluator = fit.evaluator_at_solution()
    problem: Problem = evaluator.problem
    experiment = as_index(experiment, "experiment", len(problem.experiments))
    if times is None:
        points = fit.sensitivities[experiment].nodes
    else:
        asked = _check_times(times, problem, experiment)
        # Times beyond the mesh need another one; those inside are put in as nodes, so that nothing is interpolated.
        if asked.max() > fit.trajectories[experiment].times[-1]:
            points = _simulate_beyond(problem, experiment, fit.theta, asked)
        else:
            mesh = evaluator.meshes[experiment].insert(asked)
            points = compute_sensitivity(problem, experiment, fit.theta, mesh).at(asked)
    return build_prediction(fit, problem, experiment, points)


def build_prediction(fit: Any, problem: Problem, e: int, points: Points) -> Prediction:
    """Return the prediction of experiment e from its sensitivity at some points.

    Parameters
    ----------
    fit : Fit or Validation
        Whose theta the covariance is of.
    problem : Problem
    e : int, from 0
    points : Points
    """
    if not np.isfinite(fit.covariance).all():
        raise ValueError(
            "There are no bands without a covariance: the cost must consist of Measurements alone, with more values "
            "than unknowns, and the Hessian must be positive definite. The report says what is missing."
        )
    covariance, trajectory = fit.corrected_covariance, fit.trajectories[e]
    names = [name for comparison in fit.comparisons[e] for name in comparison.names]
    return Prediction(
        points.times,
        points.states,
        _compute_errors(points.states_d, covariance),
        points.outputs,
        _compute_errors(points.outputs_d, covariance),
        _get_noise(fit, problem, e, points.times),
        trajectory.state_names,
        trajectory.state_units,
        tuple(names),
        trajectory.time_unit,
        fit,
        e,
        trajectory.origin,
        not np.array_equal(covariance, fit.covariance),
    )


def _simulate_beyond(problem: Problem, e: int, theta: FloatArray, times: FloatArray) -> Points:
    """Return states and outputs at times (K,), some of them after tf, with their derivatives in theta."""
    experiment = problem.experiments[e]
    last = float(times.max())
    if isinstance(experiment.tf, Parameter):
        raise ValueError(
            f"times must not lie after tf where tf is estimated: the system stops there; got {last:.6g}"
            f"{unit_suffix(experiment.time_unit)}."
        )
    # Data stay where they are: the last mode goes on with no transition to follow.
    longer = replace(experiment, tf=last)
    runs = [longer if k == e else run for k, run in enumerate(problem.experiments)]
    extended = replace(problem, experiments=runs)
    return compute_sensitivity(extended, e, theta, refine_mesh(extended, e, theta).insert(times)).at(times)


def _compute_errors(derivative: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return ``sqrt(X C X')`` of derivatives (K, q, d): (K, q)."""
    # X C X' may be -1e-20 by rounding where nothing is uncertain, as of a known initial state at t0.
    variance = np.einsum("kqd,de,kqe->kq", derivative, covariance, derivative)
    return np.sqrt(np.maximum(variance, 0.0))


def _get_noise(fit: Any, problem: Problem, e: int, times: FloatArray) -> FloatArray:
    """Return the standard deviation of one sample of each output at each time: (K, q)."""
    columns = [np.zeros((len(times), 0))]
    # Weights are 1 where sigma is unknown; a known sigma is scaled in the same way if another is unknown.
    unknown = 1.0 if fit.sigma_known else np.sqrt(fit.residual_variance)
    for item, comparison in zip(problem.experiments[e].measurements, fit.comparisons[e], strict=True):
        sigma = np.broadcast_to(1.0 if comparison.sigma is None else comparison.sigma, item.values.shape) * unknown
        # Nearest sample in time, by the times at which the sensor says what it has seen: hence the delay is added.
        halfway = 0.5 * item.times[1:] + 0.5 * item.times[:-1]
        columns.append(sigma[np.searchsorted(halfway, times + find_delay(comparison, fit.trajectories[e]))])
    return np.concatenate(columns, axis=1)


def _check_times(times: ArrayLike, problem: Problem, e: int) -> FloatArray:
    experiment = problem.experiments[e]
    asked = read_times(experiment, times)
    if asked.min() < experiment.t0:
        unit = unit_suffix(experiment.time_unit) if experiment.origin is None else ""
        start, first = show_time(experiment, experiment.t0), show_time(experiment, asked.min())
        raise ValueError(f"times must not lie before t0 = {start}{unit}, where the simulation begins; got {first}.")
    return asked
