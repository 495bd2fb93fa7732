"""Costs and constraints at transitions and at the end, ``c = 0``.

Values and first derivatives of constraints follow from the forward sweep. Their second derivatives are only ever
needed in the sum ``weights . c`` of a Lagrangian. Each of its terms is a cost at a transition or at the end, so that
one backward sweep over the cost with these terms added gives them all.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from switchfit.discretization.model import Model
from switchfit.discretization.nodes import (
    NodeFunction,
    get_end_constraints,
    get_end_cost,
    list_constraints_at_transitions,
    list_costs_at_transitions,
)
from switchfit.engine.jax.forward_sweep import Forward, parameter_directions

Array = jax.Array


def terms_at_transitions(model: Model, weights: Array | None) -> list[tuple[int, NodeFunction]]:
    """Return the terms of ``J + weights . c`` at transitions, each with its transition; c only with `weights` (m,)."""
    if weights is None:
        return list_costs_at_transitions(model)
    constraints = enumerate(list_constraints_at_transitions(model))
    weighted = [(i, lambda t, x, p, w=weights[k], c=c: w * c(t, x, p)) for k, (i, c) in constraints]
    return list_costs_at_transitions(model) + weighted


def terms_at_end(model: Model, weights: Array | None) -> list[NodeFunction]:
    """Return the terms of ``J + weights . c`` at the end; c only with `weights` (m,)."""
    cost, constraints = get_end_cost(model), get_end_constraints(model)
    terms = [] if cost is None else [cost]
    if weights is not None and constraints is not None:
        own = weights[len(list_constraints_at_transitions(model)) :]
        terms.append(lambda t, x, p: own @ constraints(t, x, p))
    return terms


def constraints(model: Model, first: Forward, p: Array) -> tuple[Array, Array]:
    """Return the values (m,) and derivatives (m, D) of all constraints: at transitions, then at the end."""
    path, X = first.path, first.tangents
    P = parameter_directions(model)
    values, rows = [jnp.zeros(0)], [jnp.zeros((0, P.shape[1]))]
    for i, function in list_constraints_at_transitions(model):
        value, (c_t, c_x, c_p) = jax.value_and_grad(function, argnums=(0, 1, 2))(*path.at_transition(i), p)
        values.append(value[None])
        rows.append((c_x @ X.before_transition(path.layout, i) + c_p @ P).at[i].add(c_t)[None])
    at_end = get_end_constraints(model)
    if at_end is not None:
        c_x, c_p = jax.jacfwd(at_end, argnums=(1, 2))(*path.at_end(), p)
        values.append(at_end(*path.at_end(), p))
        rows.append(c_x @ X.after[-1, -1] + c_p @ P)
    return jnp.concatenate(values), jnp.concatenate(rows)
