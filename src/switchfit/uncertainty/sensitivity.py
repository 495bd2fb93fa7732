"""Sensitivities of states and outputs along a trajectory: exact first derivatives of the discretized system.

The derivative of x at a *fixed* time t jumps where a transition time passes t. With X^i the jump of the vector field,
equation (8), it is 0 in tau_i just before the transition and -X^i just after. At a transition both are given, one with
the state before it and one with the state after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Mesh
from switchfit.engine.choice import engine_of
from switchfit.engine.protocol import Simulation, Tangents
from switchfit.engine.run import runs_of
from switchfit.fit.trajectory import select_visible
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.losses import influence
from switchfit.problem.problem import Problem


class Points(NamedTuple):
    """Values and their derivatives at L times.

    Attributes
    ----------
    times : (L,)
    states, states_d : (L, n), (L, n, d)
    outputs, outputs_d : (L, Q), (L, Q, d)
        Outputs of the reference signals, then of the Measurements, in order.
    """

    times: FloatArray
    states: FloatArray
    states_d: FloatArray
    outputs: FloatArray
    outputs_d: FloatArray


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """States and outputs of one experiment and their derivatives in theta.

    Attributes
    ----------
    simulation : Simulation
        With derivatives in the experiment's own unknowns.
    places : (D,) int
        Indices of these unknowns in theta, -1 for fixed ones.
    d : int
        Length of theta.
    """

    simulation: Simulation
    places: NDArray[np.intp]
    d: int

    @property
    def nodes(self) -> Points:
        """Points at all nodes in order, as in `Trajectory`: each transition occurs twice, before and after it."""
        s, along = self.simulation, self._tangents
        columns = (s.start, s.end), (s.before, s.after), along[:2], (s.y_before, s.y_after), along[2:]
        times, states, states_d, outputs, outputs_d = (select_visible(s, *pair) for pair in columns)
        return Points(times, states, self._spread_over_theta(states_d), outputs, self._spread_over_theta(outputs_d))

    def at(self, times: FloatArray) -> Points:
        """Return the sensitivity at nodes (K,) of the mesh; at a transition, that just before it, as for a sample."""
        s, along = self.simulation, self._tangents
        row = s.row_ending(np.searchsorted(s.nodes, times) - 1)

        def pick(before: FloatArray, after: FloatArray) -> FloatArray:
            first = (row < 0).reshape(-1, *[1] * (after.ndim - 1))
            return np.where(first, before[:1], after[row])

        states, outputs = pick(s.before, s.after), pick(s.y_before, s.y_after)
        derivatives = [self._spread_over_theta(pick(*pair)) for pair in (along[:2], along[2:])]
        return Points(np.asarray(times, dtype=np.float64), states, derivatives[0], outputs, derivatives[1])

    @property
    def _tangents(self) -> Tangents:
        if self.simulation.tangents is None:
            raise ValueError("the simulation has no derivatives: pass tangents=True.")
        return self.simulation.tangents

    def _spread_over_theta(self, derivative: FloatArray) -> FloatArray:
        """Return derivatives in theta (..., d) from those in the experiment's own unknowns (..., D)."""
        own = self.places >= 0
        full = np.zeros((*derivative.shape[:-1], self.d))
        # Two names of the model may refer to one parameter: both count.
        np.add.at(np.moveaxis(full, -1, 0), self.places[own], np.moveaxis(derivative, -1, 0)[own])
        return full


def compute_sensitivity(problem: Problem, e: int, theta: FloatArray, mesh: Mesh) -> Sensitivity:
    """Return states and outputs of experiment e at theta, and their derivatives in theta, on the nodes of a mesh.

    Parameters
    ----------
    problem : Problem
    e : int
        Index of the experiment, from 0.
    theta : (d,)
    mesh : Mesh
        It must have all sample times and knots as nodes.
    """
    run = runs_of(problem)[e]
    engine = engine_of(run, run.build_arguments(mesh), mesh)
    return build_sensitivity(problem, e, engine.simulate(*run.vectors(theta), tangents=True))


def build_sensitivity(problem: Problem, e: int, simulation: Simulation) -> Sensitivity:
    """Return the sensitivity of experiment e from a simulation with derivatives.

    Parameters
    ----------
    problem : Problem
    e : int, from 0
    simulation : Simulation
    """
    return Sensitivity(simulation, problem.places[e], len(problem.theta_names))


class SampleDerivatives(NamedTuple):
    """All samples that are not missing, S over all experiments.

    Attributes
    ----------
    experiment : (S,) int
    item, channel : (S,) int
        Indices of the Measurements in the experiment, and of the channel in it.
    time, residual, weight : (S,)
        Sample time in the experiment's time unit, fitted minus measured, ``1 / sigma**2`` (1 if sigma is unknown).
    derivative : (S, d)
        Derivative of the fitted value in theta.
    """

    experiment: NDArray[np.intp]
    item: NDArray[np.intp]
    channel: NDArray[np.intp]
    time: FloatArray
    residual: FloatArray
    weight: FloatArray
    derivative: FloatArray


def collect_sample_derivatives(problem: Problem, sensitivities: Sequence[Sensitivity]) -> SampleDerivatives:
    """Return the residuals of all samples and the derivatives of the fitted values.

    Parameters
    ----------
    problem : Problem
    sensitivities : sequence of Sensitivity, one per experiment
    """
    d = len(problem.theta_names)
    columns: list[tuple[NDArray[Any], ...]] = []
    for e, (experiment, found) in enumerate(zip(problem.experiments, sensitivities, strict=True)):
        first = sum(q for _, q in problem.structures[e].references)
        items = [item for item in experiment.data if isinstance(item, Measurements)]
        for k, item in enumerate(items):
            q = item.values.shape[1]
            points = found.at(item.seen_times)
            there = ~np.isnan(item.values)
            where = np.argwhere(there)
            fitted, slope = points.outputs[:, first : first + q], points.outputs_d[:, first : first + q]
            columns.append(
                (
                    np.full(len(where), e),
                    np.full(len(where), k),
                    where[:, 1],
                    item.times[where[:, 0]],
                    (fitted - np.nan_to_num(item.values))[there],
                    item.weights[there],
                    slope[there],
                )
            )
            first += q
    if not columns:
        none = np.zeros(0, dtype=np.intp)
        return SampleDerivatives(none, none, none, np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, d)))
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
    weight = samples.weight.copy()
    information = np.diag(problem.unknowns.priors.evaluate(theta, gauss_newton=True)[2])
    for e, k, item in _list_measurements(problem):
        here = (samples.experiment == e) & (samples.item == k)
        noise = item.noise(problem.name_parameters(theta, e)) if item.sigma_names else None
        if noise is not None:
            weight[here] = noise[~np.isnan(item.values)] ** -2.0
            names = problem.experiments[e].parameter_map
            for channel, name in enumerate(item.sigma_names):
                span = None if name is None else problem.unknowns.parameters.get(names.get(name, name))
                if span is not None:  # it is not fixed
                    count = np.count_nonzero(samples.channel[here] == channel)
                    # In log sigma each sample has the information 2, in sigma 2 / sigma^2.
                    information[span, span] += 2.0 * count / theta[span] ** 2
        weight[here] *= influence(item.loss, item.loss_scale, weight[here] * samples.residual[here] ** 2)
    return information + samples.derivative.T @ (weight[:, None] * samples.derivative)


def sum_score_products(problem: Problem, samples: SampleDerivatives) -> FloatArray:
    """Return ``sum_k g_k g_k'``, g_k being the gradient of the cost of sample k: (d, d).

    With ``u = w r^2`` a sample costs ``1/2 C^2 rho(u / C^2)`` (`problem.losses`): ``g = rho'(u / C^2) w r D h``.

    Parameters
    ----------
    problem : Problem
        No sigma and no delay of it is a parameter.
    samples : SampleDerivatives
    """
    pull = samples.weight * samples.residual
    for e, k, item in _list_measurements(problem):
        here = (samples.experiment == e) & (samples.item == k)
        u = samples.weight[here] * samples.residual[here] ** 2
        pull[here] *= influence(item.loss, item.loss_scale, u)
    scores = pull[:, None] * samples.derivative
    return np.asarray(scores.T @ scores)


def _list_measurements(problem: Problem) -> list[tuple[int, int, Measurements]]:
    """Return each experiment's index, the index among its Measurements, and the Measurements."""
    return [
        (e, k, item)
        for e, experiment in enumerate(problem.experiments)
        for k, item in enumerate(item for item in experiment.data if isinstance(item, Measurements))
    ]
