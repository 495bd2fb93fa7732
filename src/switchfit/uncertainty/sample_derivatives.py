"""Derivatives of the fitted values at all samples, and the Gauss-Newton matrix that follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.problem.losses import influence
from switchfit.problem.problem import Problem
from switchfit.uncertainty.sensitivity import Sensitivity


class SampleDerivatives(NamedTuple):
    """All samples that are not missing, S over all experiments.

    Attributes
    ----------
    experiment : (S,) int
    item : (S,) int
        Index of the Measurements in the experiment.
    residual, weight, influence : (S,)
        Fitted minus measured, ``1 / sigma**2`` (1 if sigma is unknown), and rho' of the loss (`problem.losses`).
    derivative : (S, d)
        Derivative of the fitted value in theta.
    """

    experiment: NDArray[np.intp]
    item: NDArray[np.intp]
    residual: FloatArray
    weight: FloatArray
    influence: FloatArray
    derivative: FloatArray

    @property
    def scores(self) -> FloatArray:
        """Gradients of the costs of all samples, ``rho' w r D h``, if no sigma is a parameter: (S, d)."""
        return (self.influence * self.weight * self.residual)[:, None] * self.derivative


def collect_sample_derivatives(problem: Problem, sensitivities: Sequence[Sensitivity]) -> SampleDerivatives:
    """Return the residuals of all samples and the derivatives of the fitted values.

    Parameters
    ----------
    problem : Problem
        With Measurements and no reference signals; no delay of it is a parameter.
    sensitivities : sequence of Sensitivity, one per experiment
    """
    columns: list[tuple[NDArray[Any], ...]] = []
    for e, (experiment, found) in enumerate(zip(problem.experiments, sensitivities, strict=True)):
        first = 0
        for k, item in enumerate(experiment.measurements):
            points, there = found.at(item.seen_times), ~np.isnan(item.values)
            channels = slice(first, first + item.values.shape[1])
            first = channels.stop
            sigma = item.noise(problem.name_parameters(found.theta, e))
            residual = (points.outputs[:, channels] - np.nan_to_num(item.values))[there]
            weight = np.ones(len(residual)) if sigma is None else sigma[there] ** -2.0
            # rho' of the loss: how much of a residual counts for the gradient.
            pull = influence(item.loss, item.loss_scale, weight * residual**2)
            places = np.full(len(residual), e), np.full(len(residual), k)
            columns.append((*places, residual, weight, pull, points.outputs_d[:, channels][there]))
    return SampleDerivatives(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def build_gauss_newton(problem: Problem, theta: FloatArray, samples: SampleDerivatives) -> FloatArray:
    """Return the Gauss-Newton matrix of the samples and the priors at theta: (d, d).

    A sample contributes ``rho' w (D h)' D h``, and ``2 (D log sigma)' D log sigma`` if its sigma is a parameter: the
    Fisher information of normal noise, which has nothing between sigma and the rest.

    Parameters
    ----------
    problem : Problem
        No delay of it is a parameter.
    theta : (d,)
    samples : SampleDerivatives
        At theta.
    """
    counts, weight = count_values_by_sigma(problem), samples.influence * samples.weight
    # In log sigma each sample has the information 2, in sigma 2 / sigma^2.
    of_sigma = 2.0 * counts / np.where(counts > 0, theta, 1.0) ** 2
    information = np.diag(problem.unknowns.priors.evaluate(theta, gauss_newton=True)[2] + of_sigma)
    return information + samples.derivative.T @ (weight[:, None] * samples.derivative)


def count_values_by_sigma(problem: Problem) -> FloatArray:
    """Return of how many values each unknown is the sigma: (d,)."""
    counts = np.zeros(len(problem.theta_names))
    for run in problem.experiments:
        for item in run.measurements:
            for values, name in zip(item.values.T, item.sigma_names, strict=False):
                span = None if name is None else problem.unknowns.parameters.get(run.parameter_map.get(name, name))
                if span is not None:  # it is not fixed
                    counts[span] += np.count_nonzero(~np.isnan(values))
    return counts
