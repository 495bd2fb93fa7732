"""Fits of data that are simulated at a truth and perturbed by drawn noise.

All fits share meshes that resolve the trajectories at the start and at the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.batch.layout import Varying
from switchfit.batch.programs import Limits
from switchfit.batch.study import Study
from switchfit.discretization.mesh import Mesh
from switchfit.fit.comparison import compare
from switchfit.fit.local_fit import REFINEMENTS
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.halving import ORDER_OF_METHODS, halve_rows
from switchfit.meshes.integration_error import LARGEST_INTEGRATION_ERROR, cost_error
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_array
from switchfit.problem.validation.messages import shorten
from switchfit.problem.variants import replace_values

DrawNoise = Callable[[np.random.Generator, FloatArray, Measurements], ArrayLike]
Noise = float | ArrayLike | DrawNoise | None

Values = dict[tuple[int, int], FloatArray]
"""Values of data that are simulated, by the experiment and the place among its data: (K, q), or (R, K, q) of R runs."""


def build_study(
    problem: Problem, truth: FloatArray, begin: FloatArray, noise: Noise, seed: int, limits: Limits
) -> tuple[SimulatedStudy, float]:
    """Return fits of simulated data, to be done by `repeat`, and the integration error at the truth.

    Parameters
    ----------
    problem, noise, seed : as of `monte_carlo`
    truth, begin : (d,)
        Where the data are simulated, and where every fit begins.
    limits : Limits
    """
    clean = _simulate_clean(problem, truth)
    drawn = noise if callable(noise) else _find_spreads(problem, truth, noise, clean)
    study = SimulatedStudy(problem, [], begin[None], limits, seed, drawn, clean)
    # The meshes depend on sample times, not on values: those of run 0 serve all.
    study.meshes, error = _build_meshes(study.problem_of(0), truth, begin)
    return study, error


def _simulate_clean(problem: Problem, truth: FloatArray) -> Values:
    """Return what data would be without noise."""
    found: Values = {}
    # On half the steps, so that the error of the simulation is far below that of the fits' own mesh.
    comparisons = compare(Evaluator(problem, truth).divide(2), truth)[1]
    for e, (experiment, run) in enumerate(zip(problem.experiments, comparisons, strict=True)):
        places = [k for k, item in enumerate(experiment.data) if isinstance(item, Measurements)]
        if not places or any(comparison.kind != "measurements" for comparison in run):
            raise ValueError("monte_carlo simulates Measurements: every run needs some, and none a ReferenceSignal.")
        found |= {(e, k): comparison.fitted for k, comparison in zip(places, run, strict=True)}
    return found


def _find_spreads(problem: Problem, truth: FloatArray, noise: float | ArrayLike | None, clean: Values) -> Values:
    """Return the standard deviations of the noise of all data, (K, q) each."""
    found = {}
    for (e, k), values in clean.items():
        item, sigma = problem.experiments[e].data[k], noise
        # A sigma that is a parameter has its value at the truth.
        if sigma is None:
            sigma = item.noise(problem.name_parameters(truth, e))
        if sigma is None:
            raise ValueError(
                "noise must be given, since the data have no sigma from which to draw: a standard deviation, one for "
                "each channel, or a function."
            )
        try:
            found[e, k] = np.broadcast_to(np.asarray(sigma, dtype=float), values.shape)
        except ValueError as error:
            raise ValueError(f"noise of shape {np.shape(sigma)} does not fit data of shape {values.shape}.") from error
        if not np.all(np.isfinite(found[e, k]) & (found[e, k] >= 0)):
            raise ValueError(f"noise must be zero or positive; got {shorten(sigma)}.")
    return found


def _build_meshes(problem: Problem, truth: FloatArray, start: FloatArray) -> tuple[list[Mesh], float]:
    """Return meshes that resolve the trajectories at the start and at the truth, and the integration error at the
    truth.

    A mode that is active in another part of the horizon at the start would run over cells that are far too long for it,
    and lead somewhere else altogether.
    """
    finer = 1.0
    thetas = (truth,) if np.array_equal(start, truth) else (start, truth)
    for attempt in range(REFINEMENTS + 1):
        evaluator = Evaluator(problem, *thetas, finer=finer)
        fine = halve_rows(evaluator, truth).cost(truth)
        # Without noise J vanishes at the truth; then the error is measured against J where the fits begin.
        error = cost_error(problem, fine, evaluator(truth).cost, evaluator(start).cost)
        # No finer than rtol asks for. NaN, where J cannot be evaluated, ends the loop as well.
        excess = error / max(LARGEST_INTEGRATION_ERROR, problem.rtol)
        if not excess > 1 or attempt == REFINEMENTS:
            break
        # The error falls with the power of the order; 10 % more, since it is an estimate.
        finer *= 1.1 * excess ** (1 / ORDER_OF_METHODS)
    return evaluator.meshes, float(error)


@dataclass
class SimulatedStudy(Study):
    """The runs of a Monte Carlo study.

    Attributes
    ----------
    noise : callable, or Values
        The function of the user, or standard deviations.
    clean : Values
        As of `_simulate_clean`.
    """

    noise: DrawNoise | Values
    clean: Values

    def draw_run(self, run: int) -> Values:
        """Return the values of one run."""
        # A generator a run: draws do not depend on which chunk, thread or machine does it.
        rng, drawn = np.random.default_rng([self.seed, run]), {}
        for (e, k), clean in self.clean.items():
            if callable(self.noise):
                # A copy: a function that adds noise in place would change the clean data of all later runs.
                noisy = self.noise(rng, clean.copy(), self.problem.experiments[e].data[k])
                values = as_array(noisy, "what noise(rng, clean, item) returns")
            else:
                values = clean + self.noise[e, k] * rng.standard_normal(clean.shape)
            is_finite = bool(np.isfinite(values).all())
            if values.shape != clean.shape or not is_finite:
                raise ValueError(
                    f"noise must give finite values of shape {clean.shape}; got shape {values.shape}"
                    f"{'' if is_finite else ', not all finite,'} in run {run}."
                )
            drawn[e, k] = values
        return drawn

    def problem_of(self, run: int) -> Problem:
        """Return the problem with the data of one run."""
        return replace_values(self.problem, self.draw_run(run))

    def stack_data(self, runs: Iterable[int]) -> tuple[Varying, dict[int, Exception]]:
        """Return the data of some runs, and the errors of those whose noise cannot be drawn, by their places."""
        drawn, errors = [], {}
        for place, run in enumerate(runs):
            try:
                drawn.append(self.draw_run(run))
            except Exception as error:  # listed: it must not end the other runs
                # A row for the program, whose result is thrown away (`clear_fit`).
                drawn.append(self.clean)
                errors[place] = error
        return self.stack_values({key: np.stack([values[key] for values in drawn]) for key in self.clean}), errors

    def stack_values(self, values: Values) -> Varying:
        """Return noisy values (R, K, q) of all data as leaves of the arguments."""
        # Values stand among the leaves of JAX's tree of arguments: the same tree of places says which.
        (leaves, places), changed = self.leaves, {}
        for e, experiment in enumerate(self.problem.experiments):
            measured = [(k, item) for k, item in enumerate(experiment.data) if isinstance(item, Measurements)]
            for samples, (k, item) in zip(places[e].samples, measured, strict=True):
                own, leaf = values[e, k], samples.value
                # The arrays of a program are padded to a common length; beyond the samples the weights are 0, and so
                # are missing values.
                changed[leaf] = np.zeros((len(own), *leaves[leaf].shape))
                changed[leaf][:, : len(item.times)] = np.where(np.isnan(item.values), 0.0, own)
        return changed
