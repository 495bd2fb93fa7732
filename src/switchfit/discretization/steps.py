"""The stages of a row as JAX differentiates them, for explicit and implicit methods, and a whole step."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.discretization import implicit_rows, rows
from switchfit.discretization.model import Density, Field
from switchfit.discretization.tableaus import Tableau

Array = jax.Array


def compute_stages(
    tableau: Tableau, f: Callable[[Array, Array], Array], start: Array, end: Array, x: Array
) -> rows.Stages:
    """Compute the stages of a row as arrays (s,), (s, n), (s, n); those of an explicit method in a loop.

    The vector field is then once in the program, not once per stage: with second derivatives, a program compiles in a
    half to a sixth of the time, and runs 0.3 to 1.5 times as long.
    """
    if tableau.coupled:
        found = implicit_rows.stages(tableau, f, start, end, x)
        return rows.Stages(*(jnp.stack(values) for values in found))
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
    tableau: Tableau, f: Field, ell: Density | None, start: Array, end: Array, x: Array, p: Array
) -> tuple[Array, Array]:
    """Return the state after one step and the running cost it adds: (n,) and (), 0 if ell is None."""
    h = end - start
    found = compute_stages(tableau, lambda t, x: f(t, x, p), start, end, x)
    after = rows.end_of_row(tableau, h, x, found.slopes)
    if ell is None:
        return after, jnp.zeros(())
    densities = jax.vmap(ell, in_axes=(0, 0, None))(found.times, found.states, p)
    return after, rows.cost_of_row(tableau, h, list(densities))
