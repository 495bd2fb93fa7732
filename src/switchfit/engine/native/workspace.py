"""Layout of the memory that machine code reads and writes, shared by calls from Python and from XLA.

The table of pointers holds, in the order of `pointers`, the arguments, the accumulators and the scratch space, then for
each Measurements what `OF_SAMPLES` lists. Sizes count doubles; those of the scratch space grow with the number of rows.
"""

from __future__ import annotations

from typing import NamedTuple

from switchfit.discretization.nodes import AT_TRANSITIONS
from switchfit.discretization.tableaus import STIFF
from switchfit.engine.native.kernels import STAGES, has_jumps, most_kept
from switchfit.engine.native.scalars import CHECKED
from switchfit.engine.native.templates import Order, Sizes
from switchfit.problem.structure import Structure

GIVEN = (
    *("nodes", "signals", "c", "p", "bounds", "first_cell", "modes", "resets"),
    *(kind.name for kind in AT_TRANSITIONS),
    *("multipliers", "units"),
)
"""Arguments: nodes (G + 1,), signals (G, 4, S), constants, p (M,); the transition times between t0 and tf (N + 2,);
the cell in which each segment begins, then the last cell (N + 2,); the mode of each segment (N + 1,); the index of the
reset map and of the function of each kind at each transition, -1 without one (N,); multipliers of all constraints; the
derivatives of the transition times, after a row of zeros (D + 1, width)."""

WHOLE_NUMBERS = ("first_cell", "modes", "resets", *(kind.name for kind in AT_TRANSITIONS))
"""Arguments that are 64-bit integers."""

OF_SAMPLES = ("cell", "time", "value", "weight", "segment")
"""Arguments of each Measurements: the cell at whose end a sample lies, or that holds a late sample, (K,); times (K,),
values (K, q), weights (K, q); the segment that holds a late sample, (K,)."""


def list_place_lengths(N: int) -> dict[str, int]:
    """Return the lengths of the arrays that say what is active where: modes, then functions at N transitions."""
    return {"modes": N + 1, "resets": N} | {kind.name: N for kind in AT_TRANSITIONS}


class Length(NamedTuple):
    """A size, in doubles, that grows with the number of rows."""

    fixed: int
    each_row: int = 0

    def at(self, rows: int) -> int:
        """Return the size for a number of rows."""
        return self.fixed + self.each_row * rows


def constraint_rows(library: Structure, sizes: Sizes) -> dict[str, int]:
    """Return the first row of each kind of constraints, one row per transition; "end" is the first terminal one.

    "count" is the number of all rows.
    """
    first, count = {}, 0
    for kind in AT_TRANSITIONS:
        if kind.constraint and getattr(library, kind.name):
            first[kind.name] = count
            count += sizes.N
    return first | {"end": count, "count": count + sizes.m}


def sums(library: Structure, sizes: Sizes) -> dict[str, int]:
    """Return the sizes of the accumulators, which start at zero: they are the results."""
    count = constraint_rows(library, sizes)["count"]
    return {
        "psi": sizes.n,
        "J": 1,
        "g": sizes.width,
        "H": sizes.D * sizes.width,
        "constraints": count,
        "jacobian": count * sizes.width,
        "errors": sizes.n,
        CHECKED: 1,
    }


def memory(library: Structure, sizes: Sizes, order: Order) -> dict[str, Length]:
    """Return the sizes of the parts of the scratch space."""
    n, N, width = sizes.n, sizes.N, sizes.width
    second, first = int(order >= Order.HESSIAN), int(order >= Order.GRADIENT)
    resets, jumps = int(bool(library.reset_maps)), int(has_jumps(library))
    implicit = int(any(library.implicit))
    late = int(any(sensor.delay is not None for sensor in library.measurements))
    return {
        "states": Length(n, n),
        "reset_states": Length(N * n * resets),
        "tangents": Length(n * width, n * width * second),
        "reset_tangents": Length(N * n * width * resets),
        "stages": Length(0, STAGES * n * first),
        "stage_tangents": Length(0, STAGES * n * width * second),
        "kept": Length(0, STAGES * most_kept(n) * first),
        "jumps": Length(n, n * first * jumps),
        "late": Length(0, n * first * late),
        "costates": Length(0, n * first),
        "increments": Length(len(STIFF.b) * n * implicit),
        "newton": Length(2 * implicit),
        "entries": Length(STAGES * (1 + n + sizes.M) ** 2),
        "length": Length(width),
        "late_row": Length(3 * late),
        "late_closes": Length(width * late),
        "late_stages": Length(STAGES * n * late),
        "late_stage_tangents": Length(STAGES * n * width * late),
        "late_kept": Length(STAGES * most_kept(n) * late),
        "late_state": Length(n * late),
        "late_tangent": Length(n * width * late),
        "late_psi": Length(n * late),
        "late_J": Length(late),
    }


class Layout(NamedTuple):
    """What `constraint_rows`, `sums` and `memory` return for one program and order, and the names in its table."""

    constraint_rows: dict[str, int]
    sums: dict[str, int]
    memory: dict[str, Length]
    pointers: tuple[str, ...]

    @classmethod
    def of(cls, library: Structure, sizes: Sizes, order: Order) -> Layout:
        """Build the layout of a program's order."""
        of_samples = [f"{name} {k}" for k in range(len(library.measurements)) for name in OF_SAMPLES]
        names = (*pointers(library, sizes, order), *of_samples)
        return cls(constraint_rows(library, sizes), sums(library, sizes), memory(library, sizes, order), names)


ZEROED = ("jumps", "late")
"""Parts of the scratch space that start at zero."""


def pointers(library: Structure, sizes: Sizes, order: Order) -> tuple[str, ...]:
    """Return the names of the pointers in the table, except those of the samples."""
    return (*GIVEN, *sums(library, sizes), *memory(library, sizes, order))
