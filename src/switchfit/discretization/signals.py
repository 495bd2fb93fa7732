"""Signals in one cell: inputs and references as cubics in the time since the first node of the cell."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero


class Piece(NamedTuple):
    """The signals in one cell: first node (), coefficients (4, S)."""

    origin: Array
    coefficients: Array

    def __call__(self, t: Array) -> Array:
        """All channels at time t: (S,)."""
        return _polynomial(t - self.origin, self.coefficients)

    def rate(self, t: Array) -> Array:
        """The derivatives of all channels at time t: (S,)."""
        return _polynomial(t - self.origin, jnp.arange(1.0, 4.0)[:, None] * self.coefficients[1:])


@jax.custom_jvp
def _polynomial(s: Array, c: Array) -> Array:
    """Return ``c[0] + c[1] s + c[2] s**2 + ...``: (S,).

    Its derivative in s is defined as a polynomial too. JAX would propagate a tangent in every direction through each
    step of Horner's scheme, which took a quarter of an evaluation with a reference signal. The coefficients are data,
    without tangents in all programs but those of `switchfit.experiment_design`, where an input is what is looked for.
    """
    value = c[-1]
    # Horner's scheme.
    for k in reversed(range(c.shape[0] - 1)):
        value = c[k] + s * value
    return value


def _polynomial_jvp(at: tuple[Array, Array], direction: tuple[Any, Any]) -> tuple[Array, Array]:
    (s, c), (s_d, c_d) = at, direction
    # `SymbolicZero`, not a product with zeros: where neither s nor c has a tangent, nothing is computed at all.
    powers = jnp.arange(1.0, c.shape[0])[:, None]
    slope = _polynomial(s, powers * c[1:]) if c.shape[0] > 1 else jnp.zeros_like(c[0])
    tangent = jnp.zeros_like(c[0]) if isinstance(s_d, SymbolicZero) else slope * s_d
    return _polynomial(s, c), tangent if isinstance(c_d, SymbolicZero) else tangent + _polynomial(s, c_d)


_polynomial.defjvp(_polynomial_jvp, symbolic_zeros=True)
