"""The derivative of a criterion in the input of a run.

JAX differentiates the sensitivities of all samples, forward in theta, backward in the input. The information of a
sample is ``C' C / sigma**2`` with the sensitivities C (q, D) of its q values: it does not depend on what is measured.
That of a sigma which is a parameter is ``2 / sigma**2`` for each value, apart from everything else.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import propagate, see_samples
from switchfit.experiment_design.criterion import SIDES, Criterion
from switchfit.problem.structure import Structure

Array = jax.Array


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
    cells: Any
    theta: Any
    taken: tuple[Any, ...]
    others: Any
    places: Any
    criterion: Criterion


@partial(jax.jit, static_argnames=("structure", "power"))
def differentiate_criterion(
    inputs: Array, at: Background, *, structure: Structure, power: float
) -> tuple[Array, Array]:
    """Return log m, as of `Criterion.rate`, and its derivatives in an input at its knots, (K, q)."""

    def rate(inputs: Array) -> Array:
        model = Model(structure, at.arguments._replace(signals=jnp.einsum("gck,kq->gcq", at.cells, inputs)))

        def inform(side: Array) -> Array:
            slopes, weights = jax.jacfwd(partial(_see, model, side), has_aux=True)(at.theta)
            own = jnp.zeros((at.theta.size, at.theta.size))
            for taken, (C, L), w in zip(at.taken, slopes, weights, strict=True):
                own += jnp.einsum("k,kqd,kq,kqe->de", taken, C, w, C) + 2.0 * jnp.einsum("k,kqd,kqe->de", taken, L, L)
            return own

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
