"""Where everything lies that machine code reads and writes: one description for calls from Python and from XLA.

The table of pointers holds, in the order of `pointers`, first what is given, then the sums, then the memory in between,
then for each Measurements what `OF_SAMPLES` lists. Lengths count doubles; those of the memory grow with the rows.
"""

from __future__ import annotations

from typing import NamedTuple

from switchfit.discretization.nodes import AT_TRANSITIONS
from switchfit.engine.native.kernels import STAGES, has_jumps
from switchfit.engine.native.scalars import CHECKED
from switchfit.engine.native.templates import Order, Sizes
from switchfit.problem.structure import Structure

GIVEN = (
    *("nodes", "signals", "c", "p", "bounds", "first_cell", "modes", "resets"),
    *(kind.name for kind in AT_TRANSITIONS),
    *("multipliers", "penalties", "units"),
)
"""What is given: nodes (G + 1,), signals (G, 4, S), constants, p (M,); the transition times between t0 and tf (N + 2,);
the cell in which each segment begins, then the last cell (N + 2,); the mode of each segment (N + 1,); which reset map
and which function of each kind a transition has, -1 for none (N,); multipliers and penalties of all constraints; the
derivatives of the transition times, after a row of zeros (D + 1, width)."""

WHOLE_NUMBERS = ("first_cell", "modes", "resets", *(kind.name for kind in AT_TRANSITIONS))
"""What of it are integers of 64 bits."""

OF_SAMPLES = ("cell", "time", "value", "weight", "segment")
"""What is given for each Measurements: the cell at whose end a sample is, or that holds it if it is late; (K,), (K,),
(K, q), (K, q); and the segment that holds a late one."""

WHOLE_OF_SAMPLES = ("cell", "segment")


class Length(NamedTuple):
    """A size, in doubles, that grows with the number of rows."""

    fixed: int
    each_row: int = 0

    def at(self, rows: int) -> int:
        """Return the size for a number of rows."""
        return self.fixed + self.each_row * rows


def constraint_rows(library: Structure, sizes: Sizes) -> dict[str, int]:
    """Return where the constraints of each kind begin among all: a row a transition each; "end" the terminal ones.

    The count of all stands under "count".
    """
    first, count = {}, 0
    for kind in AT_TRANSITIONS:
        if kind.constraint and getattr(library, kind.name):
            first[kind.name] = count
            count += sizes.N
    return first | {"end": count, "count": count + sizes.m}


def sums(library: Structure, sizes: Sizes) -> dict[str, int]:
    """Return the lengths of what an evaluation adds up, and begins with zeros: the results."""
    count = constraint_rows(library, sizes)["count"]
    return {
        "psi": sizes.n,
        "J": 1,
        "g": sizes.width,
        "H": sizes.D * sizes.width,
        "constraints": count,
        "jacobian": count * sizes.width,
        CHECKED: 1,
    }


def memory(library: Structure, sizes: Sizes, order: Order) -> dict[str, Length]:
    """Return the lengths of what lies between the parts of an evaluation."""
    n, N, width = sizes.n, sizes.N, sizes.width
    second, first = int(order >= Order.HESSIAN), int(order >= Order.GRADIENT)
    resets, jumps = int(bool(library.reset_maps)), int(has_jumps(library))
    late = int(any(sensor.delay is not None for sensor in library.measurements))
    return {
        "states": Length(n, n),
        "reset_states": Length(N * n * resets),
        "tangents": Length(n * width, n * width * second),
        "reset_tangents": Length(N * n * width * resets),
        "stages": Length(0, STAGES * n * first),
        "stage_tangents": Length(0, STAGES * n * width * second),
        "jumps": Length(n, n * first * jumps),
        "late": Length(0, n * first * late),
        "entries": Length(STAGES * (1 + n + sizes.M) ** 2),
        "length": Length(width),
        "late_row": Length(3 * late),
        "late_closes": Length(width * late),
        "late_stages": Length(STAGES * n * late),
        "late_stage_tangents": Length(STAGES * n * width * late),
        "late_state": Length(n * late),
        "late_tangent": Length(n * width * late),
        "late_psi": Length(n * late),
        "late_J": Length(late),
    }


ZEROED = ("jumps", "late")
"""What of the memory begins with zeros."""


def pointers(library: Structure, sizes: Sizes, order: Order) -> tuple[str, ...]:
    """Return the names of the pointers in the table, but for those of the samples."""
    return (*GIVEN, *sums(library, sizes), *memory(library, sizes, order))
