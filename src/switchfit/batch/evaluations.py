"""Cost, gradient and Hessian of many fits at once, each with its own data: for the intervals of many estimates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from switchfit.uncertainty.walks import Derivatives

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
    redone : (R,) bool
        Fits that were done again, on meshes of their own.
    build_own : callable
        Returns the evaluator of such a fit.

    Attributes
    ----------
    quick : bool
        Whether machine code evaluates the others, in one program; otherwise they are evaluated one by one.
    """

    def __init__(
        self,
        problem: Problem,
        meshes: Sequence[Mesh],
        varying: Varying,
        room: int,
        redone: NDArray[np.bool_],
        build_own: Callable[[int], Evaluator],
    ) -> None:
        self.varying, self.room, self.redone, self.build_own = varying, max(room, CHUNK), redone, build_own
        self.evaluator = Evaluator(problem, meshes=meshes)
        self.base = tuple(self.evaluator.arguments)
        self.layout = choose_layout(self.evaluator, varying.places)
        self.quick = self.layout.natively
        self.own: dict[int, Evaluator] = {}

    def __call__(self, fits: NDArray[np.intp], thetas: FloatArray, sides: NDArray[np.int64]) -> Derivatives:
        """Return costs, gradients and Hessians at thetas (n, d), to one side (n,) of breakpoints.

        `fits` (n,) says whose data are taken. NaN where the model is undefined.
        """
        n, d = thetas.shape
        at = Derivatives(np.full(n, np.nan), np.full((n, d), np.nan), np.full((n, d, d), np.nan))
        alone = self.redone[fits] | (not self.quick)
        together = np.flatnonzero(~alone)
        for first in range(0, len(together), EVALUATIONS):
            call = together[first : first + EVALUATIONS]
            for all_, found in zip(at, self._run(fits[call], thetas[call], sides[call]), strict=True):
                all_[call] = found
        for s in np.flatnonzero(alone).tolist():
            with suppress(*UNDEFINED):
                here = self._prepare(int(fits[s]))(thetas[s], int(sides[s]))
                at.cost[s], at.gradient[s], at.hessian[s] = here.cost, here.gradient, here.hessian
        return at

    def _prepare(self, k: int) -> Evaluator:
        """Return an evaluator with the data of the k-th fit."""
        if not self.redone[k]:
            give_data(self.evaluator, self.base, self.varying, k)
            return self.evaluator
        if k not in self.own:
            self.own[k] = self.build_own(k)
        return self.own[k]

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
