"""Derivatives by JAX that tests compare with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.problem.functions import use_float64


def differentiate(function: Callable[[Any], Any], at: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value, gradient and Hessian of a function of an array or a number, in float64 and one program."""

    def evaluate(at):
        return function(at), jax.grad(function)(at), jax.hessian(function)(at)

    with use_float64():
        value, gradient, hessian = jax.jit(evaluate)(jnp.asarray(at, dtype=jnp.float64))
    return np.asarray(value), np.asarray(gradient), np.asarray(hessian)
