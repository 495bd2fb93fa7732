"""The backward sweep: the derivative psi of the cost to go, row by row, and with it the gradient."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.discretization.mesh import find_row_ending_cell
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import add_point_costs, flatten_rows, switch_method
from switchfit.discretization.rows import Pull, length_factor, times_derivative
from switchfit.discretization.steps import row_functions
from switchfit.discretization.tableaus import Tableau
from switchfit.engine.jax.constraints import terms_at_end, terms_at_transitions
from switchfit.engine.jax.forward_sweep import Forward, StageJacobians, sample_gradients, sum_running_cost
from switchfit.engine.jax.late_samples import anchors, late_gradients

Array = jax.Array


class Costates(NamedTuple):
    """Derivatives of the cost to go.

    Attributes
    ----------
    start : (n,), at t0
    opened : (Q, n), at the start of each chunk, after a reset map that acts there
    before, after : (Q, C, n), at the start and at the end of each row
    w, mu : (Q, C, s, n), in the slopes K_j and in the stage states X_j of each row
    """

    start: Array
    opened: Array
    before: Array
    after: Array
    w: Array
    mu: Array


class Backward(NamedTuple):
    """Result of the backward sweep: the cost J, costates, and the derivatives in tau (N,) and in p (M,)."""

    cost: Array
    costates: Costates
    of_tau: Array
    of_p: Array

    @property
    def gradient(self) -> Array:
        """Derivative in theta: (D,)."""
        return jnp.concatenate([self.of_tau, self.of_p])


def backward_sweep(model: Model, first: Forward, p: Array, weights: Array | None = None) -> Backward:
    """Differentiate the cost backward, with ``weights . c`` of the constraints (m,) added if given.

    The costate jumps at samples, ``psi(t-) = psi(t+) + D_x ell_k``, at reset maps, ``psi(tau-) = psi(tau+) D_x R``, and
    by the derivatives of the terms at transitions and at the end.
    """
    layout, resets = first.path.layout, first.resets
    nodes = node_gradients(model, first, p, weights)

    def through(tableau: Tableau) -> Callable[..., Any]:
        adjoint = row_functions(tableau).adjoint

        def row(carried: tuple[Array, Array], given: tuple[Any, ...]) -> tuple[Any, tuple[Array, ...]]:
            psi, of_p = carried
            h, jacobians, jump, late = given
            psi = psi + jump
            found = adjoint(tableau, h, psi, pull_of(jacobians))
            before = found.before if late is None else found.before + late
            return (before, of_p + found.parameters), (before, psi, jnp.stack(found.slopes), jnp.stack(found.states))

        return lambda carried, operands: lax.scan(row, carried, operands, reverse=True)

    def chunk(carried: tuple[Array, Array], given: tuple[Any, ...]) -> tuple[Any, tuple[Array, ...]]:
        segment, opens, operands = given
        (opened, of_p), columns = switch_method(model, segment, through, carried, operands)
        psi = opened
        if resets is not None:
            psi = jnp.where(opens, opened @ resets.x[segment], opened)
            of_p = of_p + jnp.where(opens, opened @ resets.p[segment], 0.0)
        if nodes.transitions is not None:
            psi = psi + jnp.where(opens, nodes.transitions[segment], 0.0)
        return (psi, of_p), (opened, *columns)

    operands = (layout.end - layout.start, first.jacobians, nodes.ends, nodes.starts)
    given = (layout.segment, layout.opens, operands)
    (start, of_p), columns = lax.scan(chunk, (nodes.final, nodes.of_p), given, reverse=True)
    costates = Costates(start + nodes.first, *columns)
    of_tau = nodes.of_tau + row_ends_gradient(model, first, costates)
    if resets is not None:
        opened = costates.opened[layout.first_chunk]
        of_tau = of_tau + (opened * resets.t).sum(-1)[1:]
    of_p = of_p + jax.grad(lambda p: costates.start @ model.initial_state(p))(p)
    return Backward(nodes.cost + sum_running_cost(model, first), costates, of_tau, of_p)


class NodeGradients(NamedTuple):
    """Costs at nodes, without constraints, and their derivatives, with constraints.

    Attributes
    ----------
    cost : ()
    first : (n,), in x(t0), of samples there
    ends, starts : (Q, C, n), in the states at the ends of rows; at the starts, of late samples, None without any
    transitions : (N + 1, n), in the state before the transition that opens each segment; None if there are no terms
    final : (n,), in x(tf)
    of_tau, of_p : (N,), (M,), direct derivatives in tau and p
    """

    cost: Array
    first: Array
    ends: Array
    starts: Array | None
    transitions: Array | None
    final: Array
    of_tau: Array
    of_p: Array


def node_gradients(model: Model, first: Forward, p: Array, weights: Array | None) -> NodeGradients:
    """Differentiate the samples, and the terms of ``J + weights . c`` at transitions and at the end."""
    structure, path = model.structure, first.path
    Q, C, n = path.after.shape
    cost, of_tau, of_p = add_point_costs(model, path, p), jnp.zeros(structure.N), jnp.zeros(structure.M)
    ends, starts = jnp.zeros((Q * C + 1, n)), jnp.zeros((Q * C, n))  # entry 0 of `ends` is t0
    for k, samples in enumerate(model.arguments.samples):
        if structure.measurements[k].delay is None:
            values, (g_x, g_p) = sample_gradients(model, path, k, samples, p)
            ends = ends.at[find_row_ending_cell(path.layout, samples.cell) + 1].add(g_x)
        else:
            at = anchors(model, path, k, p)
            values, (g_start, g_x, g_p) = late_gradients(model, at, k, samples, p)
            starts = starts.at[at.row].add(g_x)
            # Entry 0 collects the rows that start at a node of the mesh, whose time is fixed.
            of_tau = of_tau + jnp.zeros(structure.N + 1).at[at.starts_at + 1].add(g_start)[1:]
        cost, of_p = cost + values.sum(), of_p + g_p.sum(0)
    transitions = jnp.zeros((structure.N + 1, n))
    terms = terms_at_transitions(model, weights)
    for i, term in terms:
        g_t, g_x, g_p = jax.grad(term, argnums=(0, 1, 2))(*path.at_transition(i), p)
        transitions = transitions.at[i + 1].add(g_x)
        of_tau, of_p = of_tau.at[i].add(g_t), of_p + g_p
    final = jnp.zeros(n)
    for term in terms_at_end(model, weights):
        g_x, g_p = jax.grad(term, argnums=(1, 2))(*path.at_end(), p)
        final, of_p = final + g_x, of_p + g_p
    late = any(sensor.delay is not None for sensor in structure.measurements)
    return NodeGradients(
        cost,
        ends[0],
        ends[1:].reshape(Q, C, n),
        starts.reshape(Q, C, n) if late else None,
        transitions if terms else None,
        final,
        of_tau,
        of_p,
    )


def pull_of(jacobians: StageJacobians) -> Pull:
    """Return the derivatives of ``w . f + hb ell`` at the stages of a row, given those of f and ell."""

    def pull(j: int, w: Array, hb: Array) -> tuple[Array, Array, Array]:
        at = jax.tree.map(lambda a: a[j], jacobians)
        of_t, of_x, of_p = (w * at.f_t).sum(), (w[:, None] * at.f_x).sum(0), (w[:, None] * at.f_p).sum(0)
        if at.l is None:
            return of_t, of_x, of_p
        return of_t + hb * at.l_t, of_x + hb * at.l_x, of_p + hb * at.l_p

    return pull


def rows_at_transitions(first: Forward) -> tuple[Array, Array]:
    """Return the flat indices and the segments of the rows that start (first) and that end (second) at each transition:
    (2, N), (2, N).
    """
    layout = first.path.layout
    before = jnp.arange(len(layout.last_row) - 1)
    rows = jnp.stack([layout.first_chunk[1:] * layout.start.shape[1], layout.last_row[:-1]])
    return rows, jnp.stack([before + 1, before])


def row_ends_gradient(model: Model, first: Forward, psi: Costates) -> Array:
    """Return the derivative of the cost in tau: ``V h' + sum_j (w_j . f + h b_j ell)_t t_j'`` of the two rows at it."""
    layout = first.path.layout
    if model.structure.N == 0:
        return jnp.zeros(0)

    def of_method(tableau: Tableau) -> Callable[..., Array]:
        def beside(k: Array, start_d: Array, end_d: Array) -> Array:
            h, at, slopes, after, w, mu = jax.tree.map(
                lambda a: flatten_rows(a)[k],
                (layout.end - layout.start, first.jacobians, first.path.slopes, psi.after, psi.w, psi.mu),
            )
            densities = list(jnp.zeros(len(tableau.b)) if at.l is None else at.l)
            direct = length_factor(tableau, after, mu, slopes, densities) * (end_d - start_d)
            pull = pull_of(at)
            times_d = times_derivative(tableau, start_d, end_d)
            return direct + sum(pull(j, w[j], h * b)[0] * times_d[j] for j, b in enumerate(tableau.b))

        return beside

    def one(row: Array, segment: Array, start_d: Array, end_d: Array) -> Array:
        return switch_method(model, segment, of_method, row, start_d, end_d)

    ends = jax.vmap(jax.vmap(one, in_axes=(0, 0, None, None)))
    starting, ending = jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])
    return ends(*rows_at_transitions(first), starting, ending).sum(0)
