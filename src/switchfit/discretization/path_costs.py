"""Cost and constraints of the discretized system on a path of states: running costs, samples, transitions, the end."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from switchfit.arrays import Traced
from switchfit.discretization.mesh import MeshRows
from switchfit.discretization.model import Model, list_transition_functions
from switchfit.discretization.propagation import Path, switch_mode
from switchfit.discretization.sampled_states import see_samples
from switchfit.discretization.signals import Piece


def compute_path_cost(model: Model, path: Path, p: Array) -> Array:
    """Return the cost J of the discretized system, of (2) and of the samples: ()."""
    return integrate_running_cost(model, path, p) + _add_sample_costs(model, path, p) + add_point_costs(model, path, p)


def compute_path_constraints(model: Model, path: Path, p: Array) -> Array:
    """Return the constraints: those at transitions, then those at the end: (m,)."""
    parts = [
        constraint(*path.at_transition(i), p)[None] for i, constraint in list_transition_functions(model, "guards")
    ]
    if model.structure.terminal_constraints:
        parts.append(model.terminal_constraint(path.after[-1], p))
    return jnp.concatenate([jnp.zeros(0), *parts])


def integrate_running_cost(model: Model, path: Path, p: Array) -> Array:
    """Return the integral of the running costs, ``sum h b_j ell(t_j, X_j)`` over all rows: ()."""
    if not model.has_running_cost:
        return jnp.zeros(())

    def ell(mode: int, piece: Piece, t: Array, x: Array) -> Array:
        return model.density(mode, piece)(t, x, p)

    # Equation (2) of the paper by the quadrature of the method itself: J is then the state of one more equation, and
    # has the same order as x.
    return (weigh_stages(model, path.layout) * map_stages(model, path, ell, path.stages)).sum()


def map_stages(model: Model, path: Path, function: Callable[..., Any], states: Array) -> Traced:
    """Return the values ``function(mode, piece, t, x)`` at all stages: (R, s, ...); `states` are (R, s, n).

    The function may depend on the mode only by whether it is the rest after a free tf.
    """

    def of_mode(mode: int) -> Callable[..., Any]:
        return jax.vmap(partial(function, mode), in_axes=(None, 0, 0))

    # The running cost has no mode: all rows at once. With a free tf the rows behind it are the rest, in which nothing
    # is to be counted, nor evaluated where it may not be defined; then row by row, for `lax.switch` inside `vmap` would
    # evaluate both.
    rows = path.pieces, path.times, states
    if not model.structure.has_free_tf:
        return jax.vmap(of_mode(0))(*rows)
    return lax.map(lambda given: switch_mode(model, given[0], of_mode, *given[1]), (path.layout.segment, rows))


def weigh_stages(model: Model, layout: MeshRows) -> Array:
    """Return the weight ``h b_j`` of each stage in an integral over its row: (R, s)."""
    of_modes = jnp.asarray(np.stack([tableau.b for tableau in model.tableaus]))
    return (layout.end - layout.start)[:, None] * of_modes[model.mode_of_segment][layout.segment]


def add_point_costs(model: Model, path: Path, p: Array) -> Array:
    """Return the sum of the costs at transitions and at the end: ()."""
    total = jnp.zeros(())
    # Costs at a transition are of the state before its reset map, as the guards are.
    for i, cost in list_transition_functions(model, "transition_costs"):
        total = total + cost(*path.at_transition(i), p)
    return total + model.terminal(path.after[-1], p)


def _add_sample_costs(model: Model, path: Path, p: Array) -> Array:
    """Return the sum of the costs of all discrete samples."""
    total = jnp.zeros(())
    for k in range(len(model.arguments.samples)):
        total = total + jax.vmap(lambda s, x, k=k: model.sample_cost(k, s, x, p))(*see_samples(model, path, k, p)).sum()
    return total
