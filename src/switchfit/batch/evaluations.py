"""Cost, gradient and Hessian of many fits at once, each with its own data: for the intervals of many estimates."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from switchfit.batch.layout import (
    CHUNK,
    Inputs,
    Layout,
    Varying,
    choose_layout,
    compile_for_layout,
    compile_once,
    give_data,
    pad_fits,
)
from switchfit.discretization.mesh import Mesh
from switchfit.fit.evaluator import Evaluator
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem

EVALUATIONS = 256
"""Evaluations in one call of the program; shorter calls are padded, which costs nothing."""

UNDEFINED = (ValueError, ArithmeticError, np.linalg.LinAlgError)
"""What a model raises where it is undefined."""


class Evaluations:
    """Cost, gradient and Hessian of any fits of a call with their own data, many at a time.

    Parameters
    ----------
    problem : Problem
    meshes : one an experiment
    varying : Varying
    room : int
        As of `fit_chunk`.

    Attributes
    ----------
    quick : bool
        Whether machine code evaluates them, in one program; otherwise they are evaluated one by one.
    """

    def __init__(self, problem: Problem, meshes: Sequence[Mesh], varying: Varying, room: int = 0) -> None:
        self.problem, self.varying, self.room = problem, varying, max(room, CHUNK)
        self.evaluator = Evaluator(problem, meshes=meshes)
        self.base = tuple(self.evaluator.arguments)
        self.layout = choose_layout(self.evaluator, varying.places)
        self.quick = self.layout.natively

    def __call__(
        self, fits: NDArray[np.intp], thetas: FloatArray, sides: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return costs (n,), gradients (n, d) and Hessians (n, d, d) at thetas (n, d), to one side (n,) of breakpoints.

        `fits` (n,) says whose data are taken. NaN where the model is undefined.
        """
        if not self.quick:
            n, d = thetas.shape
            J, g, H = np.full(n, np.nan), np.full((n, d), np.nan), np.full((n, d, d), np.nan)
            for s, (k, theta, side) in enumerate(zip(fits.tolist(), thetas, sides.tolist(), strict=True)):
                give_data(self.evaluator, self.base, self.varying, k)
                with suppress(*UNDEFINED):
                    found = self.evaluator(theta, side)
                    J[s], g[s], H[s] = found.cost, found.gradient, found.hessian
            return J, g, H
        calls = [slice(first, first + EVALUATIONS) for first in range(0, len(fits), EVALUATIONS)]
        parts = [self._run(fits[call], thetas[call], sides[call]) for call in calls]
        J, g, H = (np.concatenate(column) for column in zip(*parts, strict=True))
        return J, g, H

    def _run(self, fits: Any, thetas: FloatArray, sides: Any) -> tuple[FloatArray, ...]:
        with use_float64():
            padded = (pad_fits(each, EVALUATIONS) for each in (fits, thetas, np.asarray(sides, dtype=float)))
            given = Inputs.of(self.evaluator, self.layout), self._values, *padded, len(fits)
            with compile_once(self.layout, given):
                found = _evaluate_fits(*given, layout=self.layout)
        return tuple(np.asarray(each)[: len(fits)] for each in found)

    @cached_property
    def _values(self) -> tuple[jax.Array, ...]:
        """Return the data of all fits as arrays of JAX, which otherwise copies them in each call of the program."""
        return tuple(jnp.asarray(pad_fits(value, self.room)) for value in self.varying.values)


@compile_for_layout
def _evaluate_fits(
    inputs: Inputs,
    values: tuple[jax.Array, ...],
    fits: jax.Array,
    thetas: jax.Array,
    sides: jax.Array,
    count: jax.Array,
    *,
    layout: Layout,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return cost, gradient and Hessian of the first `count` fits at their thetas."""
    n, d = thetas.shape

    def one(s: jax.Array, found: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        new = inputs.evaluate(layout, [value[fits[s]] for value in values], thetas[s], sides[s])
        return tuple(all_.at[s].set(each) for all_, each in zip(found, new, strict=True))  # type: ignore[return-value]

    empty = jnp.zeros(n), jnp.zeros((n, d)), jnp.zeros((n, d, d))
    return lax.fori_loop(0, count, one, empty)
