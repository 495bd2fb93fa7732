"""Samples that are seen late by a delay d that is a parameter: the state at ``s_k = t_k - d``.

The nodes of the mesh stay where they are. The state at s_k comes from one Runge-Kutta step of its own, from the start
of the row that holds s_k to s_k itself; this step is part of the discretised system, and its derivatives are exact. A
sample thus is a cost of (start of the row, state there, p), with s_k a function of p; the start moves with tau_i where
the row opens a mode. Everything is found by forward differentiation, sample by sample.

Where s_k passes a transition, J has a kink, as where a transition passes a sample; where it passes a node of the mesh,
one of the size of the integration error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.discretization.arguments import Samples
from switchfit.discretization.model import Model, Piece
from switchfit.discretization.propagation import Path, by_row, row_holding, seen_late

Array = jax.Array

SAMPLES_AT_ONCE = 1024
"""Samples that are differentiated together: bounds the memory of long logs."""


class Anchors(NamedTuple):
    """Where the late samples of one `Measurements` start from, K of them.

    Attributes
    ----------
    row : (K,) int, flat index
    segment : (K,) int
    piece : Piece
    start, x : (K,), (K, n), start of the row and the state there
    start_d, x_d : (K, D), (K, n, D), their derivatives in theta
    """

    row: Array
    segment: Array
    piece: Piece
    start: Array
    x: Array
    start_d: Array
    x_d: Array


def anchors(model: Model, path: Path, before_d: Array, k: int, p: Array) -> Anchors:
    """Rows, states and tangents from which the samples of the k-th Measurements are seen.

    `before_d` (Q, C, n, D) is the derivative of the states at the starts of the rows.
    """
    layout = path.layout
    row, segment, piece, start, x = row_holding(model, path, k, p)
    index = jnp.arange(before_d.shape[-1])
    start_d = (by_row(layout.starts_at)[row][:, None] == index) * 1.0
    return Anchors(row, segment, piece, start, x, start_d, by_row(before_d)[row])


def _costs(model: Model, k: int) -> Callable[..., Array]:
    """Cost of one late sample as a function of (start, x, p)."""

    def cost(sample: Samples, segment: Array, piece: Piece, start: Array, x: Array, p: Array) -> Array:
        there, x_s = seen_late(model, k, sample, segment, piece, start, x, p)
        return model.sample_cost(k, there, x_s, p)

    return cost


def _each(function: Callable[..., Any], samples: Samples, at: Anchors) -> Any:
    """``function(sample, anchor)`` of all samples."""
    return lax.map(lambda given: function(*given), (samples, at), batch_size=SAMPLES_AT_ONCE)


def late_gradient(model: Model, at: Anchors, k: int, samples: Samples, p: Array, P: Array) -> tuple[Array, Array]:
    """Cost of the samples of the k-th Measurements and its derivative in theta: () and (D,)."""
    cost = _costs(model, k)

    def one(sample: Samples, at: Anchors) -> tuple[Array, Array]:
        def along(e: Array) -> Array:
            return cost(sample, at.segment, at.piece, at.start + at.start_d @ e, at.x + at.x_d @ e, p + P @ e)

        zero = jnp.zeros(P.shape[1])
        return along(zero), jax.jacfwd(along)(zero)

    values, gradients = _each(one, samples, at)
    return values.sum(), gradients.sum(0)


def late_curvature(model: Model, at: Anchors, k: int, samples: Samples, p: Array, P: Array) -> Array:
    """``D^2 L_k (Z_k, Z_k)``, Z_k the derivative of (start, x, p) in theta, summed over the samples: (D, D)."""
    cost = _costs(model, k)

    def one(sample: Samples, at: Anchors) -> Array:
        def along(e: Array) -> Array:
            return cost(sample, at.segment, at.piece, at.start + at.start_d @ e, at.x + at.x_d @ e, p + P @ e)

        return jax.jacfwd(jax.jacfwd(along))(jnp.zeros(P.shape[1]))

    return _each(one, samples, at).sum(0)


def late_gauss_newton(model: Model, at: Anchors, k: int, samples: Samples, p: Array, P: Array) -> Array:
    """Gauss-Newton matrix of the samples: (D, D)."""

    def one(sample: Samples, at: Anchors) -> Array:
        def along(e: Array) -> tuple[Array, Array]:
            q = p + P @ e
            given = (at.segment, at.piece, at.start + at.start_d @ e, at.x + at.x_d @ e, q)
            there, x_s = seen_late(model, k, sample, *given)
            return model.sample_residual(k, there, x_s, q), model.sample_information(k, there, x_s, q)

        zero = jnp.zeros(P.shape[1])
        r_d, _ = jax.jacfwd(along)(zero)
        H = r_d.T @ (along(zero)[1][:, None] * r_d)
        if model.structure.measurements[k].sigma:
            s_d = jax.jacfwd(lambda e: model.log_sigma(k, sample, p + P @ e))(zero)
            H = H + 2.0 * s_d.T @ s_d
        return H

    return _each(one, samples, at).sum(0)


def late_state_derivatives(model: Model, at: Anchors, k: int, samples: Samples, p: Array) -> tuple[Any, Any]:
    """First and second derivatives of each sample's cost in (x, p), x the state at the start of its row.

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

    return _each(one, samples, at)


def late_costates(model: Model, at: Anchors, k: int, samples: Samples, p: Array) -> Array:
    """Derivative of each sample's cost in the state at the start of its row: (K, n)."""
    cost = _costs(model, k)

    def one(sample: Samples, at: Anchors) -> Array:
        return jax.jacfwd(lambda x: cost(sample, at.segment, at.piece, at.start, x, p))(at.x)

    return _each(one, samples, at)
