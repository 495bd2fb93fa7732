"""Many hypotheses on the mode sequence of one experiment, propagated by JAX: a map over them, where machine code fails.

The equations are those of `switchfit.engine.native.hypothesis_kernels`; implicit steps are possible too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from switchfit.discretization.arguments import Arguments, Samples
from switchfit.discretization.model import Model, Piece, apply_weights
from switchfit.discretization.nodes import get_end_cost
from switchfit.discretization.rows import combine, end_of_row
from switchfit.discretization.steps import row_functions
from switchfit.discretization.tableaus import EXPLICIT, EXPLICIT_ERROR
from switchfit.engine.protocol import Column, Engine, Hypotheses, Limits, Tolerances
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache

Array = jax.Array

MOST_PARTS = 64
"""Largest number of steps in a cell."""

SMALLEST_RATE = 1e-30
"""Square of the rate of a guard below which it says nothing on the time."""


class _State(NamedTuple):
    """One hypothesis: J (), g (D,), H (D, D); p (M,), and how far birth times and p have moved (D,); x (n,), Z (n, D);
    and the largest error of a step in this block ().
    """

    J: Array
    g: Array
    H: Array
    p: Array
    moved: Array
    x: Array
    Z: Array
    error: Array


class _Data(NamedTuple):
    """What does not change along the log.

    Attributes
    ----------
    arguments : Arguments
    at_node : one (G + 1,) int for each Measurements: its sample at each node, -1 without one
    jumps : (G + 1, A) int, places of the maps that act at each node, -1 for none
    tolerances : (3,)
    """

    arguments: Arguments
    at_node: tuple[Array, ...]
    jumps: Array
    tolerances: Array


class JaxHypotheses:
    """Propagates hypotheses by JAX; see `switchfit.engine.protocol.HypothesisEngine`.

    Parameters
    ----------
    structure : Structure
    arguments : Arguments
    times : (G + 1,) array
    jumps : sequence of (int, int)
        Node of each jump at a known time, ascending, and the place of its map in the library.
    reason : str
        Why JAX does it.
    """

    def __init__(
        self,
        structure: Structure,
        arguments: Arguments,
        times: FloatArray,
        jumps: Sequence[tuple[int, int]],
        reason: str,
    ) -> None:
        self.engine = Engine("jax", reason)
        self._library, self._births, self._cells = structure.library, structure.transitions, len(times) - 1
        nodes = np.arange(self._cells + 1)
        at_node = []
        for samples in arguments.samples:
            found = np.full(len(nodes), -1)
            real = np.flatnonzero(np.asarray(samples.weight).any(1))
            found[np.asarray(samples.cell)[real] + 1] = real
            at_node.append(found)
        acts = [[which for node, which in jumps if node == here] for here in nodes.tolist()]
        most = max(map(len, acts))
        table = np.array([act + [-1] * (most - len(act)) for act in acts], dtype=np.int64).reshape(len(nodes), most)
        self._data = _Data(arguments, tuple(at_node), table, np.zeros(3))  # type: ignore[arg-type]

    def begin(
        self,
        p: FloatArray,
        start: Hypotheses,
        tolerances: Tolerances,
        limits: Limits | None,
    ) -> Hypotheses:
        """Return the hypothesis at t0."""
        self._data = self._data._replace(tolerances=np.array(tolerances))  # type: ignore[arg-type]
        self._limits = limits
        with use_float64(), use_compilation_cache():
            given = start.costs[0], start.gradients[0], start.matrices[0], np.asarray(p)
            state = _begin(self._data, *given, library=self._library, births=self._births)
            return _view(jax.tree.map(lambda value: value[None], state))

    def advance(self, parents: Hypotheses, children: NDArray[np.int64], first: int, last: int) -> Hypotheses:
        """Return the children at node `last` of parents at node `first`."""
        count = len(children)
        padded = np.zeros((_pad_count(count), children.shape[1]), dtype=np.int64)
        padded[:count] = children
        padded[count:] = children[:1]
        chosen = padded[:, Column.PARENT]
        states = _State(*(np.asarray(values)[chosen] for values in parents.records))  # type: ignore[arg-type]
        with use_float64(), use_compilation_cache():

            def attempt(parts: int) -> _State:
                found: _State = _advance(
                    self._data, states, padded, first, last, parts, library=self._library, births=self._births
                )
                return found

            return self._finish(self._refine(attempt), last, count)

    def replay(
        self,
        start: Hypotheses,
        p: FloatArray,
        counts: NDArray[np.int64],
        children: NDArray[np.int64],
        times: FloatArray,
        last: int,
    ) -> Hypotheses:
        """Return hypotheses propagated anew from t0 to a node."""
        count = len(counts)
        rows = np.minimum(np.arange(_pad_count(count)), count - 1)
        given = [np.asarray(a)[rows] for a in (start.costs, start.gradients, start.matrices, p, start.moved)]
        births = [np.asarray(a)[rows] for a in (counts, children, times)]
        with use_float64(), use_compilation_cache():

            def attempt(parts: int) -> _State:
                found: _State = _replay(
                    self._data, *given, *births, last, parts, library=self._library, births=self._births
                )
                return found

            return self._finish(self._refine(attempt), last, count)

    def _refine(self, attempt: Callable[[int], _State]) -> _State:
        """Return the result of the fewest steps in a cell whose estimated errors are small enough."""
        parts = 1
        while True:
            found = attempt(parts)
            if parts >= MOST_PARTS or bool(np.all(np.asarray(found.error) <= 1.0)):
                return found
            parts *= 4

    def _finish(self, found: _State, last: int, count: int) -> Hypotheses:
        """Return the first `count` states, with the terminal costs at the last node, and moved to the minimum."""
        if last == self._cells:
            found = _end(self._data, found, library=self._library, births=self._births)
        if self._limits is not None:
            found = _recentre(found, *self._limits)
        return _view(_State(*(value[:count] for value in found)))


def _pad_count(count: int) -> int:
    """Return the next power of two, at least 8: a program is compiled for each."""
    return 2 ** int(np.ceil(np.log2(max(count, 8))))


def _view(state: _State) -> Hypotheses:
    J, g, H, p, moved, x, Z, _ = (np.array(value) for value in state)
    scores = np.full(len(J), np.nan)
    there = np.isfinite(J) & np.isfinite(g).all(1) & np.isfinite(H).all((1, 2))
    for k in np.flatnonzero(there):
        try:
            half = np.linalg.solve(np.linalg.cholesky(H[k]), g[k])
        except np.linalg.LinAlgError:
            continue
        scores[k] = J[k] - 0.5 * half @ half
    return Hypotheses(scores, J, g, H, moved, x, Z, (J, g, H, p, moved, x, Z, np.zeros(len(J))))


def _directions(model: Model, births: int) -> Array:
    """Return the derivatives of p along (births, p): (M, D)."""
    M = model.structure.M
    return jnp.concatenate([jnp.zeros((M, births)), jnp.eye(M)], axis=1)


def _add(state: _State, cost: Array, in_x: Array, in_p: Array, second: Array, P: Array) -> _State:
    """Add a cost of (x, p): its value, first derivatives, and second ones (n + M, n + M) along (x, p)."""
    along = jnp.concatenate([state.Z, P])
    return state._replace(J=state.J + cost, g=state.g + in_x @ state.Z + in_p @ P, H=state.H + along.T @ second @ along)


def _add_second_order(state: _State, cost: Callable[[Array, Array], Array], p: Array, P: Array) -> _State:
    """Add a cost with its second derivatives."""
    n = state.x.shape[0]

    def joint(v: Array) -> Array:
        return cost(v[:n], v[n:])

    v = jnp.concatenate([state.x, p])
    gradient = jax.grad(joint)(v)
    return _add(state, cost(state.x, p), gradient[:n], gradient[n:], jax.hessian(joint)(v), P)


def _pass_node(model: Model, data: _Data, state: _State, node: Array, P: Array, active: Array) -> _State:
    """Return a hypothesis after the samples and the jumps at a node, if `active`."""
    p = state.p
    for k, (samples, at_node) in enumerate(zip(data.arguments.samples, data.at_node, strict=True)):
        i = jnp.where(active, at_node[node], -1)
        weight = jnp.where(i >= 0, samples.weight[i], 0.0)
        sample = Samples(samples.cell[i], samples.time[i], samples.value[i], weight)
        cost = partial(model.sample_cost, k, sample)
        jacobian = jnp.concatenate(jax.jacfwd(partial(model.sample_residual, k, sample), (0, 1))(state.x, p), axis=1)
        second = jacobian.T @ apply_weights(model.sample_information(k, sample, state.x, p), jacobian)
        if model.structure.measurements[k].sigma:
            s_p = jax.jacfwd(lambda p, k=k, sample=sample: model.log_sigma(k, sample, p))(p)
            n = state.x.shape[0]
            second = second.at[n:, n:].add(2.0 * s_p.T @ s_p)
        g_x, g_p = jax.grad(cost, (0, 1))(state.x, p)
        state = _add(state, cost(state.x, p), g_x, g_p, second, P)
    for a in range(data.jumps.shape[1]):
        which = jnp.where(active, data.jumps[node, a], -1)
        unmoved = jnp.zeros(state.Z.shape[1])
        state = _reset(model, state, which, data.arguments.nodes[node], unmoved, p, P)
    return state


def _reset(model: Model, state: _State, which: Array, t: Array, moves: Array, p: Array, P: Array) -> _State:
    """Return a hypothesis after a reset map of the library, at a time with the derivative `moves` (D,)."""

    def apply(k: int) -> Callable[[Array, Array], tuple[Array, Array]]:
        def jump(x: Array, Z: Array) -> tuple[Array, Array]:
            R = model.reset(k)
            R_t, R_x, R_p = jax.jacfwd(R, (0, 1, 2))(t, x, p)
            return R(t, x, p), R_x @ Z + R_p @ P + R_t[:, None] * moves[None]

        return jump

    branches = [lambda x, Z: (x, Z), *(apply(k) for k in range(len(model.structure.reset_maps)))]
    x, Z = lax.switch(which + 1, branches, state.x, state.Z)
    return state._replace(x=x, Z=Z)


def _be_born(model: Model, data: _Data, state: _State, child: Array, cell: Array, t: Array, P: Array) -> _State:
    """Return a hypothesis after a change of its mode at a time of a cell; itself where the child does not change it."""
    p, piece = state.p, Piece(data.arguments.nodes[cell], data.arguments.signals[cell])
    modes = range(len(model.structure.modes))
    slopes = [lambda x, k=k: (model.field(k, piece)(t, x, p), model.density(k, piece)(t, x, p)) for k in modes]
    moves = jnp.zeros(state.Z.shape[1]).at[child[Column.SLOT]].set(1.0)
    f, ell = lax.switch(child[Column.BEFORE], slopes, state.x)
    born = state._replace(Z=state.Z + f[:, None] * moves[None], g=state.g + ell * moves)
    for k in range(len(model.structure.guards)):
        guard = model.guard(k)
        c_t, c_x, c_p = jax.grad(guard, (0, 1, 2))(t, born.x, p)
        along = c_x @ born.Z + c_p @ P + c_t * moves
        weight = data.tolerances[2] / ((c_x @ f + c_t) ** 2 + SMALLEST_RATE)
        weight, c = jnp.where(child[Column.GUARD] == k, weight, 0.0), guard(t, born.x, p)
        J, g, H = 0.5 * weight * c**2, weight * c * along, weight * jnp.outer(along, along)
        born = born._replace(J=born.J + J, g=born.g + g, H=born.H + H)
    for k, function in enumerate(model.structure.transition_costs):
        if function is None:
            continue

        def cost(t: Array, x: Array, p: Array, function: Any = function) -> Array:
            return function(t, x, model.parameters(p))

        g_t, g_x, g_p = jax.grad(cost, (0, 1, 2))(t, born.x, p)
        v_d = jnp.concatenate([moves[None], born.Z, P])

        def joint(v: Array, cost: Any = cost, n: int = state.x.shape[0]) -> Array:
            return cost(v[0], v[1 : 1 + n], v[1 + n :])

        second = jax.hessian(joint)(jnp.concatenate([t[None], born.x, p]))
        counts = jnp.where(child[Column.TRANSITION_COST] == k, 1.0, 0.0)
        born = born._replace(
            J=born.J + counts * cost(t, born.x, p),
            g=born.g + counts * (g_t * moves + g_x @ born.Z + g_p @ P),
            H=born.H + counts * (v_d.T @ second @ v_d),
        )
    born = _reset(model, born, child[Column.RESET_MAP], t, moves, p, P)
    f, ell = lax.switch(child[Column.AFTER], slopes, born.x)
    born = born._replace(Z=born.Z - f[:, None] * moves[None], g=born.g - ell * moves)
    changes = child[Column.BEFORE] != child[Column.AFTER]
    return jax.tree.map(lambda new, old: jnp.where(changes, new, old), born, state)


def _take_step(
    model: Model, data: _Data, state: _State, mode: Array, cell: Array, start: Array, end: Array, P: Array
) -> _State:
    """Return a hypothesis after one step inside a cell."""
    p, piece = state.p, Piece(data.arguments.nodes[cell], data.arguments.signals[cell])

    def through(k: int) -> Callable[[_State], _State]:
        tableau = model.tableaus[k]
        row = row_functions(tableau)

        def step(state: _State) -> _State:
            f, h = model.field(k, piece), end - start
            found = row.stages(tableau, lambda t, x: f(t, x, p), start, end, state.x)
            points = list(zip(found.times, found.states, strict=True))
            jacobians = [jax.jacfwd(f, (1, 2))(t, X, p) for t, X in points]
            forcing = [f_p @ P for _, f_p in jacobians]

            def along(Z: Array, forcing: list[Array]) -> tuple[list[Array], Array]:
                found_d = row.tangent(tableau, h, found.slopes, [J[0] for J in jacobians], forcing, Z, None)
                return found_d.states, found_d.after

            stages_d, after_d = jax.vmap(along, in_axes=(1, 1), out_axes=1)(state.Z, forcing)
            error = state.error
            if tableau is EXPLICIT:
                rtol, smallest, _ = data.tolerances
                absolute = jnp.abs(h * jnp.asarray(combine(EXPLICIT_ERROR, found.slopes)))
                error = jnp.maximum(error, jnp.max(absolute / (rtol * (smallest + jnp.abs(state.x)))))  # NaN remains
            if model.has_running_cost:
                for b, (t, X), X_d in zip(tableau.b.tolist(), points, stages_d, strict=True):
                    at_stage = _add_running_cost(model, state._replace(x=X, Z=X_d), piece, t, h * b, p, P)
                    state = state._replace(J=at_stage.J, g=at_stage.g, H=at_stage.H)
            return state._replace(x=end_of_row(tableau, h, state.x, found.slopes), Z=after_d, error=error)

        return step

    return lax.switch(mode, [through(k) for k in range(len(model.structure.modes))], state)


def _take_steps(
    model: Model, data: _Data, state: _State, mode: Array, cell: Array, begin: Array, end: Array, parts: Array, P: Array
) -> _State:
    """Return a hypothesis after `parts` steps between two times of a cell."""

    def part(k: Array, state: _State) -> _State:
        at = [begin + (end - begin) * (place / parts) for place in (k, k + 1)]
        return _take_step(model, data, state, mode, cell, at[0], at[1], P)

    return lax.fori_loop(0, parts, part, state)


def _add_running_cost(model: Model, state: _State, piece: Piece, t: Array, weight: Array, p: Array, P: Array) -> _State:
    """Add the running costs at a stage; those of reference signals with their Gauss-Newton matrix."""
    for function in model.structure.running:

        def cost(x: Array, p: Array, function: Any = function) -> Array:
            return weight * function(t, x, model.parameters(p))

        state = _add_second_order(state, cost, p, P)
    for residual, W in zip(model.reference_residuals(piece), model.arguments.weights, strict=True):
        r = residual(t, state.x, p)
        r_x, r_p = jax.jacfwd(residual, (1, 2))(t, state.x, p)
        Wr, r_d = weight * apply_weights(W, r), jnp.concatenate([r_x, r_p], axis=1)
        second = weight * r_d.T @ apply_weights(W, r_d)
        state = _add(state, 0.5 * r @ Wr, Wr @ r_x, Wr @ r_p, second, P)
    return state


@partial(jax.jit, static_argnames=("library", "births"))
def _begin(data: _Data, J: Array, g: Array, H: Array, p: Array, *, library: Structure, births: int) -> _State:
    model = Model(library, data.arguments)
    P = _directions(model, births)
    x0 = model.initial_state
    state = _State(J, g, H, p, jnp.zeros(g.shape), x0(p), jax.jacfwd(x0)(p) @ P, jnp.zeros(()))
    return _pass_node(model, data, state, jnp.zeros((), int), P, jnp.ones((), bool))


@partial(jax.jit, static_argnames=("library", "births"))
def _advance(
    data: _Data,
    states: _State,
    children: Array,
    first: Array,
    last: Array,
    parts: Array,
    *,
    library: Structure,
    births: int,
) -> _State:
    model = Model(library, data.arguments)
    P, nodes = _directions(model, births), data.arguments.nodes

    def advance(state: _State, child: Array) -> _State:
        state = _be_born(model, data, state, child, first, nodes[first], P)

        def cell(c: Array, state: _State) -> _State:
            state = _take_steps(model, data, state, child[Column.AFTER], c, nodes[c], nodes[c + 1], parts, P)
            return _pass_node(model, data, state, c + 1, P, jnp.ones((), bool))

        return lax.fori_loop(first, last, cell, state._replace(error=jnp.zeros(())))

    return jax.vmap(advance)(states, children)


@partial(jax.jit, static_argnames=("library", "births"))
def _replay(
    data: _Data,
    J: Array,
    g: Array,
    H: Array,
    p: Array,
    moved: Array,
    counts: Array,
    children: Array,
    times: Array,
    last: Array,
    parts: Array,
    *,
    library: Structure,
    births: int,
) -> _State:
    """Propagate B hypotheses from t0 to a node, with births at any times; see `HypothesisEngine.replay`."""
    model = Model(library, data.arguments)
    P, nodes, x0 = _directions(model, births), data.arguments.nodes, model.initial_state

    def replay(
        J: Array, g: Array, H: Array, p: Array, moved: Array, counts: Array, children: Array, times: Array
    ) -> _State:
        state = _State(J, g, H, p, moved, x0(p), jax.jacfwd(x0)(p) @ P, jnp.zeros(()))
        state = _pass_node(model, data, state, jnp.zeros((), int), P, jnp.ones((), bool))

        def cell(c: Array, at: tuple[_State, Array, Array]) -> tuple[_State, Array, Array]:
            state, mode, birth = at
            end = nodes[c + 1]

            def is_born(inside: tuple[_State, Array, Array, Array]) -> Array:
                _, _, birth, _ = inside
                return (birth < counts[0]) & (times[jnp.minimum(birth, births - 1)] < end)

            def change(inside: tuple[_State, Array, Array, Array]) -> tuple[_State, Array, Array, Array]:
                state, mode, birth, begin = inside
                tau, child = times[birth], children[birth]
                state = _take_steps(model, data, state, mode, c, begin, tau, parts, P)
                return _be_born(model, data, state, child, c, tau, P), child[Column.AFTER], birth + 1, tau

            state, mode, birth, begin = lax.while_loop(is_born, change, (state, mode, birth, nodes[c]))
            state = _take_steps(model, data, state, mode, c, begin, end, parts, P)
            return _pass_node(model, data, state, c + 1, P, jnp.ones((), bool)), mode, birth

        return lax.fori_loop(0, last, cell, (state, counts[1], jnp.zeros((), counts.dtype)))[0]

    return jax.vmap(replay)(J, g, H, p, moved, counts, children, times)


@partial(jax.jit, static_argnames=("library", "births"))
def _end(data: _Data, states: _State, *, library: Structure, births: int) -> _State:
    """Add the terminal costs."""
    model = Model(library, data.arguments)
    cost = get_end_cost(model)
    if cost is None:
        return states
    P = _directions(model, births)
    zero = jnp.zeros(())
    return jax.vmap(lambda state: _add_second_order(state, lambda x, p: cost(zero, x, p), state.p, P))(states)


@jax.jit
def _recentre(states: _State, low: Array, high: Array, most: Array) -> _State:
    """Move the point of linearisation to the minimum of the cost, within the limits: p first, then the birth times."""

    def move(state: _State) -> _State:
        L = jnp.linalg.cholesky(state.H)
        reduced = jax.scipy.linalg.solve_triangular(L, state.g, lower=True)
        D = len(state.moved)

        def entry(i: Array, d: Array) -> Array:
            k = D - 1 - i  # L'd = -reduced from its last row upwards, each entry within its limits
            step = jnp.clip(-(reduced[k] + L[:, k] @ d) / L[k, k], -most[k], most[k])
            return d.at[k].set(jnp.clip(state.moved[k] + step, low[k], high[k]) - state.moved[k])

        d = lax.fori_loop(0, D, entry, jnp.zeros(D))
        after = state.g + state.H @ d
        J, x = state.J + 0.5 * (state.g + after) @ d, state.x + state.Z @ d
        p = state.p + d[D - len(state.p) :]
        moved = state._replace(J=J, g=after, p=p, moved=state.moved + d, x=x)
        there = jnp.isfinite(J) & jnp.isfinite(x).all()
        return jax.tree.map(lambda new, old: jnp.where(there, new, old), moved, state)

    return jax.vmap(move)(states)
