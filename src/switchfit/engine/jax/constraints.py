"""Equality constraints: guards at transitions, ``g_i(tau_i, x(tau_i-), p) = 0``, and conditions on the final state.

Their values and first derivatives follow from the forward sweep. Their second derivatives are only ever needed in the
sum ``weights . c`` of a Lagrangian: each is a cost at a transition or at the end, so that one backward sweep over the
cost with these terms beside it gives them all (`switchfit.engine.jax.second_order.adjoint_hessian`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from switchfit.discretization.model import Model
from switchfit.engine.jax.first_order import FirstOrder, parameter_directions

Array = jax.Array


def constraints(model: Model, first: FirstOrder, tau: Array, p: Array) -> tuple[Array, Array]:
    """Values c (m,) and derivatives (m, D): guards in the order of their transitions, then the terminal ones."""
    path, X = first.path, first.tangents
    P = parameter_directions(model)
    values, rows = [jnp.zeros(0)], [jnp.zeros((0, P.shape[1]))]
    for i in model.structure.guarded:
        x, x_d = path.before_transition(i), X.before_transition(path.layout, i)
        value, (g_t, g_x, g_p) = jax.value_and_grad(model.guard(i), argnums=(0, 1, 2))(tau[i], x, p)
        values.append(value[None])
        rows.append((g_x @ x_d + g_p @ P).at[i].add(g_t)[None])
    if model.structure.terminal_constraints:
        x, x_d = path.after[-1, -1], X.after[-1, -1]
        psi_x, psi_p = jax.jacfwd(model.terminal_constraint, argnums=(0, 1))(x, p)
        values.append(model.terminal_constraint(x, p))
        rows.append(psi_x @ x_d + psi_p @ P)
    return jnp.concatenate(values), jnp.concatenate(rows)


def augmented(
    model: Model, first: FirstOrder, tau: Array, p: Array, multipliers: Array, penalty: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """The augmented Lagrangian ``J + multipliers . c + 1/2 penalty . c**2``: what its Hessian takes beside the cost.

    Returns its value (), its gradient (D,), the weights of the constraints in its Hessian (m,), and c and its
    derivatives, (m,) and (m, D).
    """
    c, A = constraints(model, first, tau, p)
    weights = multipliers + penalty * c
    return first.cost + multipliers @ c + 0.5 * penalty @ c**2, first.gradient + weights @ A, weights, c, A
