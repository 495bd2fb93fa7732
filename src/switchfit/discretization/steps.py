"""Functions of a row for explicit and implicit methods, and a whole step."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from switchfit.discretization import implicit_rows, rows
from switchfit.discretization.model import Density, Field
from switchfit.discretization.tableaus import Tableau

Array = jax.Array


class RowFunctions(NamedTuple):
    """Functions that compute and differentiate the stages of a method: see `switchfit.discretization.rows`."""

    stages: Callable[..., rows.Stages]
    tangent: Callable[..., rows.Tangent]
    adjoint: Callable[..., rows.Adjoint]


def row_functions(tableau: Tableau) -> RowFunctions:
    """Return the functions of a row: those of explicit methods, or those that solve coupled stage equations."""
    if tableau.coupled:
        return RowFunctions(implicit_rows.stages, implicit_rows.tangent, implicit_rows.adjoint)
    return RowFunctions(rows.stages, rows.tangent, rows.adjoint)


def step(
    tableau: Tableau, f: Field, ell: Density | None, start: Array, end: Array, x: Array, p: Array
) -> tuple[Array, Array]:
    """Return the state after one step and the running cost it adds: (n,) and (), 0 if ell is None."""
    h = end - start
    found = row_functions(tableau).stages(tableau, lambda t, x: f(t, x, p), start, end, x)
    after = rows.end_of_row(tableau, h, x, found.slopes)
    if ell is None:
        return after, jnp.zeros(())
    densities = [ell(t, X, p) for t, X in zip(found.times, found.states, strict=True)]
    return after, rows.cost_of_row(tableau, h, densities)
