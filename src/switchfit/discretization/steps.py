"""Functions of a row for explicit and implicit methods, and a whole step."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.discretization import implicit_rows, rows
from switchfit.discretization.model import Density, Field
from switchfit.discretization.tableaus import Tableau

Array = jax.Array


class RowFunctions(NamedTuple):
    """Functions that compute and differentiate the stages of a method: see `switchfit.discretization.rows`."""

    stages: Callable[..., rows.Stages]
    tangent: Callable[..., rows.Tangent]
    adjoint: Callable[..., rows.Adjoint]


def row_functions(tableau: Tableau, *, in_loop: bool = False) -> RowFunctions:
    """Return the functions of a row: those of explicit methods, or those that solve coupled stage equations.

    With `in_loop`, the stages of explicit methods are computed by `loop_over_stages`.
    """
    if tableau.coupled:
        return RowFunctions(implicit_rows.stages, implicit_rows.tangent, implicit_rows.adjoint_of_pull)
    return RowFunctions(loop_over_stages if in_loop else rows.stages, rows.tangent, rows.adjoint)


def loop_over_stages(
    tableau: Tableau, f: Callable[[Array, Array], Array], start: Array, end: Array, x: Array
) -> rows.Stages:
    """Compute the stages of an explicit method as `rows.stages` does, in a loop: arrays (s,), (s, n), (s, n).

    The vector field is then once in the program, not once per stage. Where it is differentiated twice through the
    stages, a program compiles in a third of the time (vehicle: 3.2 s in place of 12.0 s forward, 8.8 s by JAX alone)
    and runs 1.2 to 2.2 times as long; with derivatives of the vector field alone there is little to gain.
    """
    h = end - start

    def stage(slopes: Array, given: tuple[Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        j, row, c = given
        t, X = start + c * h, x + h * (row @ slopes)
        return lax.dynamic_update_index_in_dim(slopes, f(t, X), j, 0), (t, X)

    s = len(tableau.b)
    given = jnp.arange(s), jnp.asarray(tableau.a), jnp.asarray(tableau.c)
    slopes, (times, states) = lax.scan(stage, jnp.zeros((s, *x.shape)), given)
    return rows.Stages(times, states, slopes)


def step(
    tableau: Tableau,
    f: Field,
    ell: Density | None,
    start: Array,
    end: Array,
    x: Array,
    p: Array,
    *,
    in_loop: bool = False,
) -> tuple[Array, Array]:
    """Return the state after one step and the running cost it adds: (n,) and (), 0 if ell is None."""
    h = end - start
    found = row_functions(tableau, in_loop=in_loop).stages(tableau, lambda t, x: f(t, x, p), start, end, x)
    after = rows.end_of_row(tableau, h, x, found.slopes)
    if ell is None:
        return after, jnp.zeros(())
    densities = jax.vmap(ell, in_axes=(0, 0, None))(jnp.stack(found.times), jnp.stack(found.states), p)
    return after, rows.cost_of_row(tableau, h, list(densities))
