"""Derivatives by JAX that tests compare with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.problem.functions import use_float64


def differentiate(function: Callable[[Any], Any], at: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value, gradient and Hessian of a function of an array or a number, in float64 and one program.

    Forward over forward: it compiles fastest.
    """

    def evaluate(at):
        value = function(at)
        return value, value

    def derive(at):
        gradient, value = jax.jacfwd(evaluate, has_aux=True)(at)
        return gradient, (value, gradient)

    with use_float64():
        hessian, (value, gradient) = jax.jit(jax.jacfwd(derive, has_aux=True))(jnp.asarray(at, dtype=jnp.float64))
    return np.asarray(value), np.asarray(gradient), np.asarray(hessian)
