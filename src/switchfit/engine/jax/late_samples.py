"""Late samples, with a delay d that is a parameter: they see the state at ``s_k = t_k - d``.

The nodes of the mesh are fixed. The state at s_k comes from one Runge-Kutta step of its own, from the start of the row
that holds s_k to s_k itself; this step is part of the discretized system, and its derivatives are exact. A sample thus
is a cost of (start of the row, state there, p), with s_k a function of p; the start moves with tau_i where the row
opens a mode. All derivatives are computed in forward mode, sample by sample.

Where s_k passes a transition, J has a kink, as where a transition passes a sample; where it passes a node of the mesh,
J has a kink of the size of the integration error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.discretization.arguments import Samples
from switchfit.discretization.model import Model, Piece
from switchfit.discretization.propagation import Path, find_late_rows, flatten_rows, step_to_late_sample

Array = jax.Array

SAMPLES_AT_ONCE = 1024
"""Samples that are differentiated together: bounds the memory of long logs."""


class Anchors(NamedTuple):
    """Rows from whose start the K late samples of one `Measurements` are computed.

    Attributes
    ----------
    row : (K,) int, flat index
    segment : (K,) int
    starts_at : (K,) int, index (from 0) of the transition time at which the row starts, else -1
    piece : Piece
    start, x : (K,), (K, n), start of the row and the state there
    """

    row: Array
    segment: Array
    starts_at: Array
    piece: Piece
    start: Array
    x: Array


def anchors(model: Model, path: Path, k: int, p: Array) -> Anchors:
    """Return the rows and states from which the samples of the k-th Measurements are computed."""
    row, segment, piece, start, x = find_late_rows(model, path, k, p)
    return Anchors(row, segment, flatten_rows(path.layout.starts_at)[row], piece, start, x)


def _costs(model: Model, k: int) -> Callable[..., Array]:
    """Return the cost of one late sample as a function of (start, x, p)."""

    def cost(sample: Samples, segment: Array, piece: Piece, start: Array, x: Array, p: Array) -> Array:
        there, x_s = step_to_late_sample(model, k, sample, segment, piece, start, x, p)
        return model.sample_cost(k, there, x_s, p)

    return cost


def _map_samples(function: Callable[..., Any], *given: Any) -> Any:
    """Map ``function(sample, anchor, ...)`` over all samples."""
    return lax.map(lambda of_sample: function(*of_sample), given, batch_size=SAMPLES_AT_ONCE)


def late_gradients(
    model: Model, at: Anchors, k: int, samples: Samples, p: Array
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return the cost (K,) of each sample, and its derivatives (K,), (K, n), (K, M) in (start of row, x there, p)."""
    cost = _costs(model, k)

    def one(sample: Samples, at: Anchors) -> tuple[Array, tuple[Array, Array, Array]]:
        def of(start: Array, x: Array, p: Array) -> tuple[Array, Array]:
            value = cost(sample, at.segment, at.piece, start, x, p)
            return value, value

        gradient, value = jax.jacfwd(of, argnums=(0, 1, 2), has_aux=True)(at.start, at.x, p)
        return value, gradient

    return _map_samples(one, samples, at)


def _along(model: Model, at: Anchors, x_d: Array, p: Array, e: Array) -> tuple[Array, Array, Array]:
    """Return ``(start, x, p)`` of one sample at ``theta + e``, to first order in e (D,); x_d is that of x, (n, D)."""
    start_d = (jnp.arange(e.shape[0]) == at.starts_at).astype(float)
    return at.start + start_d @ e, at.x + x_d @ e, p + e[model.structure.N :]


def late_curvature(model: Model, at: Anchors, x_d: Array, k: int, samples: Samples, p: Array) -> Array:
    """Return ``D^2 L_k (Z_k, Z_k)`` summed over the samples, Z_k the derivative of (start, x, p) in theta: (D, D).

    `x_d` (K, n, D) is the derivative of x.
    """
    cost = _costs(model, k)

    def one(sample: Samples, at: Anchors, x_d: Array) -> Array:
        def along(e: Array) -> Array:
            return cost(sample, at.segment, at.piece, *_along(model, at, x_d, p, e))

        return jax.jacfwd(jax.jacfwd(along))(jnp.zeros(x_d.shape[-1]))

    return _map_samples(one, samples, at, x_d).sum(0)


def late_gauss_newton(model: Model, at: Anchors, x_d: Array, k: int, samples: Samples, p: Array) -> Array:
    """Return the Gauss-Newton matrix of the samples: (D, D)."""

    def one(sample: Samples, at: Anchors, x_d: Array) -> Array:
        def along(e: Array) -> tuple[Array, Array]:
            start, x, q = _along(model, at, x_d, p, e)
            there, x_s = step_to_late_sample(model, k, sample, at.segment, at.piece, start, x, q)
            return model.sample_residual(k, there, x_s, q), model.sample_information(k, there, x_s, q)

        zero = jnp.zeros(x_d.shape[-1])
        r_d, _ = jax.jacfwd(along)(zero)
        H = r_d.T @ (along(zero)[1][:, None] * r_d)
        if model.structure.measurements[k].sigma:
            s_d = jax.jacfwd(lambda e: model.log_sigma(k, sample, p + e[model.structure.N :]))(zero)
            H = H + 2.0 * s_d.T @ s_d
        return H

    return _map_samples(one, samples, at, x_d).sum(0)


def late_state_derivatives(model: Model, at: Anchors, k: int, samples: Samples, p: Array) -> tuple[Any, Any]:
    """Return first and second derivatives of each sample's cost in (x, p), x the state at the start of its row.

    Returns
    -------
    (D1, Dp) : (K, n), (K, M)
    ((D1D1, DpD1), (D1Dp, DpDp)) : (K, n, n), (K, n, M), (K, M, n), (K, M, M)
    """
    cost = _costs(model, k)

    def one(sample: Samples, at: Anchors) -> tuple[Any, Any]:
        def of(x: Array, p: Array) -> Array:
            return cost(sample, at.segment, at.piece, at.start, x, p)

        first = jax.jacfwd(of, argnums=(0, 1))
        return first(at.x, p), jax.jacfwd(first, argnums=(0, 1))(at.x, p)

    return _map_samples(one, samples, at)
