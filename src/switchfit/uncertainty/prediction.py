"""Confidence bands of the fitted states and outputs, and prediction bands of new samples.

They follow from the delta method: with X the exact derivative of a state or an output in theta at time t and C the
covariance of theta, its standard error is sqrt(X C X'), and that of a new sample is sqrt(X C X' + sigma^2) ([1]_). The
bands hold at each time separately, not for the whole curve at once.

At a transition X jumps (see `switchfit.uncertainty.sensitivity`): just before it the state does not depend on that
transition time, just after it does. The linear approximation assumes that the active mode is that of the fit, which may
be wrong within two standard errors of a transition time: `near_transition` marks these times.

References
----------
.. [1] G. A. F. Seber, C. J. Wild, Nonlinear Regression, Wiley 1989, section 5.1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Trajectory
from switchfit.problem.data import FloatArray, Measurements, ReferenceSignal
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.problem import Problem
from switchfit.problem.validation import as_array, as_index
from switchfit.runtime.presentation import format_line, join_first
from switchfit.uncertainty.sensitivity import Points, Sensitivity, compute_sensitivity

NEAR = 2.0
"""Distance from a transition time, in its standard errors, within which a band is unreliable."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """States and outputs of one experiment with their standard errors.

    Attributes
    ----------
    times : (K,) array, in `time_unit`
    states, state_errors : (K, n)
    outputs, output_errors : (K, q)
        Outputs of the reference signals, then of the Measurements; their standard errors.
    noise : (K, q)
        Standard deviation of one sample: sigma (that of the sample nearest in time, if it varies); if sigma is unknown,
        the root of the residual variance; NaN for reference signals.
    state_names, state_units, output_names : tuple of str
    time_unit : str
        Unit of the experiment's times.
    near_transition : (K,) bool
        Whether a time is within two standard errors of a transition time, where the bands ignore the other mode.
    fit : Fit

    See Also
    --------
    predict, Estimate.plot

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
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
    near_transition: NDArray[np.bool_]
    fit: Fit = field(repr=False)

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
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
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
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
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
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> fit.predict([1.0, 4.0]).prediction_band(0.95).round(1)
        array([[[7.9, 8.7]],
        <BLANKLINE>
               [[8.2, 9. ]]])
        """
        return _build_band(self.outputs, self.fit.quantile(level) * np.hypot(self.output_errors, self.noise))


def _build_band(values: FloatArray, half: FloatArray) -> FloatArray:
    return np.stack([values - half, values + half], axis=-1)


def predict(estimate: Any, times: ArrayLike | None = None, *, experiment: int = 0) -> Prediction:
    """Return states and outputs at any times with their standard errors and bands.

    Parameters
    ----------
    estimate : Estimate
    times : (K,) array_like, optional
        In any order, inside [t0, tf], in the experiment's time unit; at a transition, values are those just before it.
        If left out, all nodes of the mesh, each transition twice: with the state before and after it.
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
        For times outside the horizon, an experiment that does not exist, or an estimate without a problem or without
        a covariance.

    See Also
    --------
    Prediction, simulate, Estimate.plot

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> prediction = sf.predict(fit, [1.0, 4.0])
    >>> prediction.outputs.round(1)
    array([[8.3],
           [8.6]])
    >>> prediction.near_transition
    array([False, False])
    """
    fit: Fit = estimate
    if not isinstance(fit, Fit):
        raise TypeError(f"predict needs the result of sf.estimate; got {type(fit).__name__}. Fit the problem first.")
    evaluator = estimate.evaluator_at_solution()
    problem: Problem = evaluator.problem
    experiment = as_index(experiment, "experiment", len(problem.experiments))
    if times is None:
        points = estimate.sensitivities[experiment].nodes
    else:
        asked = _check_times(times, problem, experiment, fit.trajectories[experiment])
        mesh = evaluator.meshes[experiment].insert(asked)
        found: Sensitivity = compute_sensitivity(problem, experiment, fit.theta, mesh)
        points = found.at(asked)
    return _build_prediction(fit, problem, experiment, points)


def _build_prediction(fit: Fit, problem: Problem, e: int, points: Points) -> Prediction:
    covariance = fit.covariance
    if not np.isfinite(covariance).all():
        raise ValueError(
            "There are no bands without a covariance: the cost must consist of Measurements alone, with more values "
            "than unknowns, and the Hessian must be positive definite. The report says what is missing."
        )
    trajectory = fit.trajectories[e]
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
        _is_near_transition(fit, problem, e, points.times),
        fit,
    )


def _compute_errors(derivative: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return ``sqrt(X C X')`` of derivatives (K, q, d): (K, q)."""
    variance = np.einsum("kqd,de,kqe->kq", derivative, covariance, derivative)
    return np.sqrt(np.maximum(variance, 0.0))


def _get_noise(fit: Fit, problem: Problem, e: int, times: FloatArray) -> FloatArray:
    """Return the standard deviation of one sample of each output at each time: (K, q)."""
    columns = [np.full((len(times), q), np.nan) for _, q in problem.structures[e].references]
    for item, comparison in zip(_list_compared(problem, e), fit.comparisons[e], strict=True):
        if isinstance(item, Measurements):
            # Weights are 1 where sigma is unknown; a known sigma is scaled in the same way if another is unknown.
            unknown = 1.0 if fit.sigma_known else np.sqrt(fit.residual_variance)
            sigma = np.broadcast_to(1.0 if comparison.sigma is None else comparison.sigma, item.values.shape) * unknown
            columns.append(sigma[np.abs(times[:, None] - item.times[None]).argmin(1)])
    return np.concatenate([np.zeros((len(times), 0)), *columns], axis=1)


def _list_compared(problem: Problem, e: int) -> list[Any]:
    """Return the data of experiment e that have a comparison, in its order."""
    return [item for item in problem.experiments[e].data if isinstance(item, (Measurements, ReferenceSignal))]


def _is_near_transition(fit: Fit, problem: Problem, e: int, times: FloatArray) -> NDArray[np.bool_]:
    where = problem.unknowns.times[e]
    free = where[where >= 0]
    reach = NEAR * fit.standard_errors[free]
    return np.asarray((np.abs(times[:, None] - fit.theta[free][None]) <= reach[None]).any(1))


def _check_times(times: ArrayLike, problem: Problem, e: int, trajectory: Trajectory) -> FloatArray:
    asked = np.atleast_1d(as_array(times, "times"))
    t0, tf = trajectory.times[[0, -1]].tolist()
    if asked.ndim != 1 or asked.size == 0 or not np.isfinite(asked).all():
        raise ValueError(f"times must be finite numbers of shape (K,); got shape {asked.shape}.")
    outside = (asked < t0) | (asked > tf)
    if outside.any():
        unit = unit_suffix(problem.experiments[e].time_unit)
        raise ValueError(f"times must lie inside [t0, tf] = [{t0}, {tf}]{unit}; got {asked[outside][0]}.")
    return asked
