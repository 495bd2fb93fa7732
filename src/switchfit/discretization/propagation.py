"""The forward pass as a JAX function: the states at all rows of the mesh, with reset maps.

It discretizes equation (1) of the paper by a scan over the rows; JAX differentiates it as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
from jax import Array, lax

from switchfit.arrays import Traced
from switchfit.discretization.mesh import MeshRows, build_rows, find_row_ending_cell
from switchfit.discretization.model import Model
from switchfit.discretization.runge_kutta import Tableau
from switchfit.discretization.signals import Piece
from switchfit.discretization.steps import step
from switchfit.discretization.tableaus import EXPLICIT, STIFF_BESIDE_EXPLICIT

Found = TypeVar("Found")


class Path(NamedTuple):
    """One simulation: the R rows of `layout`.

    Attributes
    ----------
    layout : MeshRows
    pieces : Piece with origin (R,) and coefficients (R, 4, S)
    before, after : (R, n), state at the start and at the end of each row
    times : (R, s), of the stages of each row
    stages : (R, s, n), states X_j there
    """

    layout: MeshRows
    pieces: Piece
    before: Array
    after: Array
    times: Array
    stages: Array

    def at_transition(self, i: int) -> tuple[Array, Array]:
        """Return tau_i and x(tau_i-), before the reset map, of transition i (from 0): (), (n,)."""
        # The last row of the segment before: its state is x(tau-), to which guards, costs and reset maps refer.
        last = self.layout.first_row[i + 1] - 1
        return self.layout.end[last], self.after[last]

    def at_samples(self, cell: Array) -> Array:
        """Return the state at the ends of the given cells (K,), the one before a jump: (K, n)."""
        return pick_at_cells(self.layout, self.before, self.after, cell)


def pick_at_cells(layout: MeshRows, before: Array, after: Array, cell: Array) -> Array:
    """Pick the values at the ends of cells (K,), t0 for cell -1, from those before and after the rows (R, ...)."""
    return jnp.concatenate([before[:1], after])[find_row_ending_cell(layout.first_cell, cell) + 1]


def switch_mode(
    model: Model, segment: Array | int, branch: Callable[[int], Callable[..., Found]], *operands: Traced
) -> Found:
    """Call ``branch(mode)(*operands)`` for the mode that is active in a segment, directly if there is only one."""
    count = len(model.structure.modes)
    if count == 1:
        return branch(0)(*operands)
    return lax.switch(model.mode_of_segment[segment], [branch(mode) for mode in range(count)], *operands)


def switch_method(
    model: Model, segment: Array, branch: Callable[[Tableau], Callable[..., Found]], *operands: Traced
) -> Found:
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
        x = _apply_reset(model, tau, x, p, segment, opens)
        # Behind the reset map: a costate at the start of a row is that of x(tau+).
        x = x if nudge is None else x + nudge
        after, *found = switch_mode(model, segment, through, *row, x)
        return after, (x, after, *found)

    given = (layout.segment, layout.opens, nudges, layout.start, layout.end, pieces)
    _, columns = lax.scan(advance, model.initial_state(p), given)
    return Path(layout, pieces, *columns)


def _apply_reset(model: Model, tau: Array, x: Array, p: Array, segment: Array, opens: Array) -> Array:
    """Return x(tau+), ``R(tau, x(tau-), p)`` where a row opens a segment whose transition has a reset map."""
    resets = model.structure.resets
    if not resets:
        return x
    # Branch 0 is no reset; branch k that of the k-th transition which has one.
    which = jnp.zeros(model.structure.N + 1, dtype=int).at[jnp.array(resets) + 1].set(jnp.arange(1, len(resets) + 1))
    branches = [lambda t, x: x] + [lambda t, x, i=i: model.reset(i)(t, x, p) for i in resets]
    times = jnp.concatenate([tau[:1], tau])
    return lax.switch(jnp.where(opens, which[segment], 0), branches, times[segment], x)
