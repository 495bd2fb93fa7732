"""The discretized system as JAX functions: the states at all rows of the mesh, cost and constraints.

JAX differentiates them as they are. `engine.jax` has the programs.

The stages of a row as JAX differentiates them, for explicit and implicit methods, and a whole step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from switchfit.discretization import rows
from switchfit.discretization.mesh import Rows, Samples, build_rows, find_row_ending_cell
from switchfit.discretization.model import Field, Model, Piece, list_transition_functions
from switchfit.discretization.rows import EXPLICIT, STIFF_BESIDE_EXPLICIT, Tableau, combine

Array = jax.Array

Slope = Callable[[Array, Array], Array]
"""``f(t, x) -> (n,)``: a vector field at one p."""


NEWTON_ITERATIONS = 12

CONVERGED = 1e-8
"""Largest change in the last iteration of Newton's method, relative to the largest state: a row of which more is left
is NaN. Where the slope jumps within a row, as where friction stops a body, the method may jump from side to side."""


def compute_stages(tableau: Tableau, f: Slope, start: Array, end: Array, x: Array) -> rows.Stages:
    """Compute the stages of a row as arrays (s,), (s, n), (s, n); those of an explicit method in a loop.

    The vector field is then once in the program, not once per stage: with second derivatives, a program compiles in a
    half to a sixth of the time, and runs 0.3 to 1.5 times as long.
    """
    h = end - start
    if tableau.coupled:
        return _solve_stages(tableau, f, start, h, x)

    def stage(slopes: Array, given: tuple[Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        j, row, c = given
        t, X = start + c * h, x + h * (row @ slopes)
        return lax.dynamic_update_index_in_dim(slopes, f(t, X), j, 0), (t, X)

    s = len(tableau.b)
    given = jnp.arange(s), jnp.asarray(tableau.a), jnp.asarray(tableau.c)
    slopes, (times, states) = lax.scan(stage, jnp.zeros((s, *x.shape)), given)
    return rows.Stages(times, states, slopes)


def _solve_stages(tableau: Tableau, f: Slope, start: Array, h: Array, x: Array) -> rows.Stages:
    """Compute the stages of an implicit row by Newton's method in ``Z = X - x``.

    `jax.lax.custom_root` supplies the derivatives of the solution by the implicit function theorem, to any order.
    """
    s, n = tableau.coupled, x.shape[0]
    a, times = tableau.a[:s, :s], start + tableau.c[:s] * h

    # Z_j = h sum_l a_jl f(t_l, x + Z_l): small differences to x keep their digits, as Hairer and Wanner II, section
    # IV.8.
    def residual(Z: Array) -> Array:
        return Z - h * (a @ jax.vmap(f)(times, x[None] + Z))

    # `custom_root` asks for D residual y = right at the solution, which is linear in y: its Jacobian is the matrix.
    def solve(function: Callable[[Array], Array], at: Array, right: Array) -> Array:
        jacobian = jax.jacfwd(function)(at).reshape(s * n, s * n)
        return jnp.linalg.solve(jacobian, right.reshape(-1)).reshape(s, n)

    def newton(function: Callable[[Array], Array], guess: Array) -> Array:
        def correct(_: int, found: tuple[Array, Array]) -> tuple[Array, Array]:
            change = solve(function, found[0], function(found[0]))
            return found[0] - change, jnp.abs(change).max()

        Z, change = lax.fori_loop(0, NEWTON_ITERATIONS, correct, (guess, jnp.inf))
        # NaN where the last change is not small: J is then NaN, and the point refused.
        return jnp.where(change <= CONVERGED * (jnp.abs(x).max() + jnp.abs(Z).max()), Z, jnp.nan)

    zeros = jnp.zeros((s, n))
    Z = lax.custom_root(residual, zeros, newton, lambda linear, right: solve(linear, zeros, right))
    X = x[None] + Z
    # Only decides which of two equal slopes is used: it has no derivative.
    f_x = lax.stop_gradient(jax.jacfwd(partial(f, start))(x))
    # Z = a k, so that the increments are k = a^-1 Z.
    K = rows.choose_slopes(h, list(np.linalg.inv(a) @ Z), list(jax.vmap(f)(times, X)), f_x, jnp)
    # Stages behind the coupled ones repeat the last of these, with weight zero: see `Tableau.pad`.
    behind = len(tableau.b) - s
    return rows.Stages(*(jnp.stack([*values, *[values[-1]] * behind]) for values in (times, X, K)))


def step(tableau: Tableau, f: Field, start: Array, end: Array, x: Array, p: Array) -> tuple[Array, rows.Stages]:
    """Return the state after one step, (n,), and its stages."""
    found = compute_stages(tableau, lambda t, x: f(t, x, p), start, end, x)
    return x + (end - start) * combine(tableau.b, found.slopes), found


class Path(NamedTuple):
    """One simulation: the R rows of `layout`.

    Attributes
    ----------
    layout : Rows
    pieces : Piece with origin (R,) and coefficients (R, 4, S)
    before, after : (R, n), state at the start and at the end of each row
    times : (R, s), of the stages of each row
    stages : (R, s, n), states X_j there
    """

    layout: Rows
    pieces: Piece
    before: Array
    after: Array
    times: Array
    stages: Array

    def at_transition(self, i: int) -> tuple[Array, Array]:
        """Return tau_i and x(tau_i-), before the reset map, of transition i (from 0): (), (n,)."""
        last = self.layout.first_row[i + 1] - 1
        return self.layout.end[last], self.after[last]

    def at_samples(self, cell: Array) -> Array:
        """Return the state at the ends of the given cells (K,), the one before a jump: (K, n)."""
        return pick_at_cells(self.layout, self.before, self.after, cell)


def pick_at_cells(layout: Rows, before: Array, after: Array, cell: Array) -> Array:
    """Pick the values at the ends of cells (K,), t0 for cell -1, from those before and after the rows (R, ...)."""
    return jnp.concatenate([before[:1], after])[find_row_ending_cell(layout.first_cell, cell) + 1]


def switch_mode(model: Model, segment: Array | int, branch: Callable[[int], Callable[..., Any]], *operands: Any) -> Any:
    """Call ``branch(mode)(*operands)`` for the mode that is active in a segment, directly if there is only one."""
    count = len(model.structure.modes)
    if count == 1:
        return branch(0)(*operands)
    return lax.switch(model.mode_of_segment[segment], [branch(mode) for mode in range(count)], *operands)


def switch_method(model: Model, segment: Array, branch: Callable[[Tableau], Callable[..., Any]], *operands: Any) -> Any:
    """Call ``branch(tableau)(*operands)`` for the method of the steps in a segment, directly if all modes have one.

    For what depends on the method alone: its program does not grow with the number of modes.
    """
    if model.structure.has_one_method:
        return branch(model.tableaus[0])(*operands)
    implicit = jnp.asarray(model.structure.implicit)[model.mode_of_segment[segment]]
    branches = branch(STIFF_BESIDE_EXPLICIT), branch(EXPLICIT)
    return lax.cond(implicit, *branches, *operands)


def propagate(model: Model, tau: Array, p: Array, side: Array, nudges: Array | None = None) -> Path:
    """Integrate from t0 to tf: equation (1), with reset maps at the transitions.

    `nudges` (R, n) are added to the states at the starts of rows: the derivatives of the cost in them are costates.
    """
    layout = build_rows(model.arguments.nodes, tau, model.structure.fix_sides(side, jnp))
    pieces = Piece(model.arguments.nodes[layout.cell], model.arguments.signals[layout.cell])

    def through(mode: int) -> Callable[..., tuple[Array, ...]]:
        def row(start: Array, end: Array, piece: Piece, x: Array) -> tuple[Array, ...]:
            after, found = step(model.tableaus[mode], model.field(mode, piece), start, end, x, p)
            return after, found.times, found.states

        return row

    # A scan over rows, not over segments: where a transition is, and so the rows of a segment, is known at run time
    # only.
    def advance(x: Array, given: tuple[Any, ...]) -> tuple[Array, tuple[Array, ...]]:
        segment, opens, nudge, *row = given
        x = apply_reset(model, tau, x, p, segment, opens)
        x = x if nudge is None else x + nudge
        after, *found = switch_mode(model, segment, through, *row, x)
        return after, (x, after, *found)

    given = (layout.segment, layout.opens, nudges, layout.start, layout.end, pieces)
    _, columns = lax.scan(advance, model.initial_state(p), given)
    return Path(layout, pieces, *columns)


def apply_reset(model: Model, tau: Array, x: Array, p: Array, segment: Array, opens: Array) -> Array:
    """Return x(tau+), ``R(tau, x(tau-), p)`` where a row opens a segment whose transition has a reset map."""
    resets = model.structure.resets
    if not resets:
        return x
    # Branch 0 is no reset; branch k that of the k-th transition which has one.
    which = jnp.zeros(model.structure.N + 1, dtype=int).at[jnp.array(resets) + 1].set(jnp.arange(1, len(resets) + 1))
    branches = [lambda t, x: x] + [lambda t, x, i=i: model.reset(i)(t, x, p) for i in resets]
    times = jnp.concatenate([tau[:1], tau])
    return lax.switch(jnp.where(opens, which[segment], 0), branches, times[segment], x)


def compute_path_cost(model: Model, path: Path, p: Array) -> Array:
    """Return the cost J of the discretized system, of (2) and of the samples: ()."""
    return integrate_running_cost(model, path, p) + add_sample_costs(model, path, p) + add_point_costs(model, path, p)


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

    return (weigh_stages(model, path.layout) * map_stages(model, path, ell, path.stages)).sum()


def map_stages(model: Model, path: Path, function: Callable[..., Any], states: Array) -> Any:
    """Return the values ``function(mode, piece, t, x)`` at all stages: (R, s, ...); `states` are (R, s, n).

    The function may depend on the mode only by whether it is the rest after a free tf.
    """

    def of_mode(mode: int) -> Callable[..., Any]:
        return jax.vmap(partial(function, mode), in_axes=(None, 0, 0))

    rows = path.pieces, path.times, states
    if not model.structure.has_free_tf:
        return jax.vmap(of_mode(0))(*rows)
    return lax.map(lambda given: switch_mode(model, given[0], of_mode, *given[1]), (path.layout.segment, rows))


def weigh_stages(model: Model, layout: Rows) -> Array:
    """Return the weight ``h b_j`` of each stage in an integral over its row: (R, s)."""
    of_modes = jnp.asarray(np.stack([tableau.b for tableau in model.tableaus]))
    return (layout.end - layout.start)[:, None] * of_modes[model.mode_of_segment][layout.segment]


def add_point_costs(model: Model, path: Path, p: Array) -> Array:
    """Return the sum of the costs at transitions and at the end: ()."""
    total = jnp.zeros(())
    for i, cost in list_transition_functions(model, "transition_costs"):
        total = total + cost(*path.at_transition(i), p)
    return total + model.terminal(path.after[-1], p)


def add_sample_costs(model: Model, path: Path, p: Array) -> Array:
    """Return the sum of the costs of all discrete samples."""
    total = jnp.zeros(())
    for k in range(len(model.arguments.samples)):
        total = total + jax.vmap(lambda s, x, k=k: model.sample_cost(k, s, x, p))(*see_samples(model, path, k, p)).sum()
    return total


def see_samples(model: Model, path: Path, k: int, p: Array) -> tuple[Samples, Array]:
    """Return the samples of the k-th Measurements, with the times of the states that late ones saw, and these states:
    (K, n).
    """
    samples = model.arguments.samples[k]
    if model.structure.measurements[k].delay is None:
        return samples, path.at_samples(samples.cell)
    _, segment, piece, start, before = find_late_rows(model, path, k, p)
    late = jax.vmap(partial(step_to_late_sample, model, k), in_axes=(0, 0, 0, 0, 0, None))
    return late(samples, segment, piece, start, before, p)


def find_late_rows(model: Model, path: Path, k: int, p: Array) -> tuple[Array, Array, Piece, Array, Array]:
    """Return the rows with ``start < t - delay <= end`` for the late samples of the k-th Measurements.

    Returns
    -------
    row, segment : (K,) int
    piece : Piece, of K rows
    start, x : (K,), (K, n), start of the row and the state there
    """
    layout, samples = path.layout, model.arguments.samples[k]
    # The row is found by search, which has no derivative; the time inside it is differentiated in
    # `step_to_late_sample`.
    times = lax.stop_gradient(jax.vmap(lambda s: model.correct_delay(k, s, p).time)(samples))
    ends = lax.stop_gradient(layout.end)
    row = jnp.minimum(jnp.searchsorted(ends, times), ends.shape[0] - 1)
    piece = jax.tree.map(lambda a: a[row], path.pieces)
    return row, layout.segment[row], piece, layout.start[row], path.before[row]


def step_to_late_sample(
    model: Model, k: int, sample: Samples, segment: Array, piece: Piece, start: Array, x: Array, p: Array
) -> tuple[Samples, Array]:
    """Return one late sample with the time of the state that it saw, and that state, one step from `start`: (n,)."""
    there = model.correct_delay(k, sample, p)

    def through(mode: int) -> Callable[..., Array]:
        return lambda time, start, x: step(model.tableaus[mode], model.field(mode, piece), start, time, x, p)[0]

    return there, switch_mode(model, segment, through, there.time, start, x)
