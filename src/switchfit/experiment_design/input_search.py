"""Inputs that lower the criterion, by L-BFGS-B between limits, with the exact gradient, from many starts.

JAX differentiates the sensitivities of all samples, forward in theta, backward in the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from switchfit.arrays import FloatArray, Traced
from switchfit.discretization.arguments import Arguments, build_arguments, split_by_cell
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import propagate
from switchfit.discretization.sampled_states import see_samples
from switchfit.experiment_design.criterion import Criterion
from switchfit.experiment_design.nominal import SIDES, Nominal
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache

LARGEST_SMOOTH_POWER = 20.0
"""Largest power while inputs are optimised: m has a kink where the largest eigenvalue changes places with the next."""

UNUSABLE = 1e3
"""log m of a design whose trajectory cannot be integrated."""


class Background(NamedTuple):
    """What does not change while an input is looked for; D unknowns of the run, d of the problem.

    Attributes
    ----------
    arguments : Arguments
        On the mesh of the run.
    cells : (G, 4, K)
        The signal of each knot whose value is 1, as cubics in the cells of the mesh.
    theta : (D,), transition times and p of the run
    taken : tuple of (K,), 1 for samples that are taken and 0 for others, one for each sensor
    others : (d, d), information of priors and other runs
    places : (d, D) of 0 and 1, which unknown of the problem is which of the run
    criterion : Criterion
    """

    arguments: Arguments
    cells: Traced
    theta: Traced
    taken: tuple[Any, ...]
    others: Traced
    places: Traced
    criterion: Criterion


@partial(jax.jit, static_argnames=("structure", "power"))
def differentiate_criterion(
    inputs: Array, at: Background, *, structure: Structure, power: float
) -> tuple[Array, Array]:
    """Return log m, as of `Criterion.rate`, and its derivatives in an input at its knots, (K, q)."""

    def rate(inputs: Array) -> Array:
        # The signal is linear in its values at the knots: cubics of unit inputs, times the table.
        model = Model(structure, at.arguments._replace(signals=jnp.einsum("gck,kq->gcq", at.cells, inputs)))

        def inform(side: Array) -> Array:
            # Forward in a few unknowns, where the whole is differentiated backward in the many values of the input.
            slopes, weights = jax.jacfwd(partial(_see, model, side), has_aux=True)(at.theta)
            own = jnp.zeros((at.theta.size, at.theta.size))
            for taken, (C, L), w in zip(at.taken, slopes, weights, strict=True):
                # sum C'C / sigma^2 of the samples that are taken, and 2 (D log sigma)' D log sigma of a sigma that is a
                # parameter.
                own += jnp.einsum("k,kqd,kq,kqe->de", taken, C, w, C) + 2.0 * jnp.einsum("k,kqd,kqe->de", taken, L, L)
            return own

        # One side after the other in a loop: the program is compiled once, not twice as large.
        own = jax.lax.map(inform, jnp.array(SIDES, dtype=float)).mean(0)
        return at.criterion.rate(at.others + at.places @ own @ at.places.T, power, jnp)[0]

    return jax.value_and_grad(rate)(inputs)


def _see(model: Model, side: Array, theta: Array) -> tuple[list[tuple[Array, Array]], list[Array]]:
    """Return the values of all samples of each sensor and log sigma, (K, q) each; and the weights ``1 / sigma**2``."""
    p = theta[model.structure.N :]
    path = propagate(model, theta[: model.structure.N], p, side)
    found, weights = [], []
    for k, sensor in enumerate(model.structure.measurements):
        samples, states = see_samples(model, path, k, p)
        values = jax.vmap(partial(model.sample_residual, k), in_axes=(0, 0, None))(samples, states, p)
        logs = jnp.zeros_like(values)
        if sensor.sigma:
            logs = jax.vmap(partial(model.log_sigma, k), in_axes=(0, None))(samples, p)
        found.append((values, logs))
        weights.append(samples.weight * jnp.exp(-2.0 * logs))
    return found, weights


def improve_input(
    here: Nominal,
    criterion: Criterion,
    power: float,
    taken: Sequence[NDArray[np.bool_]],
    limits: tuple[FloatArray, FloatArray],
    starts: Sequence[FloatArray],
) -> FloatArray:
    """Return the best values of the input at its knots, (K, q).

    Parameters
    ----------
    here : Nominal
        On whose mesh.
    criterion : Criterion
    power : float
    taken : sequence of (K,) bool, one for each sensor
        Samples that are taken.
    limits : lower and upper, (K, q)
    starts : sequence of (K, q) arrays
    """
    from scipy.optimize import minimize  # here, since importing it takes longer than most fits

    lower, width = limits[0], limits[1] - limits[0]
    free, background, structure = width > 0, _describe(here, criterion, taken), here.evaluator.structures[here.e]

    def place(x: FloatArray) -> FloatArray:
        table = lower.copy()
        # The optimiser's variables are in [0, 1]: inputs of any unit have one scale.
        table[free] += x * width[free]
        return table

    def rate(x: FloatArray) -> tuple[float, FloatArray]:
        value, slope = differentiate_criterion(place(x), background, structure=structure, power=power)
        slope = np.asarray(slope * width)[free]
        # Flat and high: the line search of L-BFGS-B comes back from where the model cannot be integrated.
        return (float(value), slope) if np.isfinite([value, *slope]).all() else (UNUSABLE, np.zeros_like(slope))

    found = []
    with use_float64(), use_compilation_cache():
        for start in starts:
            x = np.clip((start - lower)[free] / width[free], 0.0, 1.0)
            found.append(minimize(rate, x, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * len(x)))
    # Local optima of several starts; the lowest is taken.
    return place(min(found, key=lambda end: end.fun).x)


def _describe(here: Nominal, criterion: Criterion, taken: Sequence[NDArray[np.bool_]]) -> Background:
    """Return what does not change."""
    problem, e, mesh = here.problem, here.e, here.evaluator.meshes[here.e]
    run, mesh = problem.experiments[e], mesh.pad_to(1 << mesh.cells.bit_length())  # few lengths: few programs
    # One channel for each knot, with 1 there and 0 at all others.
    knots = replace(run.inputs, values=np.eye(len(run.inputs.times)), units=None)
    (own, mine), (tau, p) = problem.own_places[e], problem.vectors(here.theta, e)
    places = np.zeros((len(here.theta), len(problem.places[e])))
    places[mine, own] = 1.0
    lengths = zip(taken, problem.sample_lengths[e], strict=True)
    return Background(
        arguments=build_arguments(problem, e, mesh),
        cells=split_by_cell(knots.signal(run.t0, run.end), mesh),
        theta=np.append(tau, p),
        # Padded as the samples in the arguments are, whose lengths are rounded up for the program.
        taken=tuple(np.pad(each.astype(float), (0, length - len(each))) for each, length in lengths),
        others=here.candidates.others,
        places=places,
        criterion=criterion,
    )
