"""The memory of a program: its table of pointers, accumulators and scratch space.

The table, which calls from Python and from XLA share, holds, in the order of `MemoryLayout.names`, the arguments, the
accumulators and the scratch space. Sizes count doubles; those of the scratch space grow with the number of rows.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any, NamedTuple

from numpy.typing import NDArray

from switchfit.discretization.model import AT_TRANSITIONS
from switchfit.discretization.tableaus import EXPLICIT, STIFF
from switchfit.engine.native.elimination import count_factors
from switchfit.engine.native.scalars.graph import CHECKED
from switchfit.engine.native.sizes import Order, Sizes
from switchfit.problem.structure import Structure

STAGES = len(EXPLICIT.b)
"""Stages of a row, or stages and slopes of an implicit one, that have memory."""

MOST_KEPT_VALUES = 2
"""Values of functions that are kept at most at each stage, in n: as many as sines and cosines of all states."""

PROGRAM_ARGUMENTS = (
    *("nodes", "signals", "c", "p", "bounds", "first_cell", "modes", "resets"),
    *AT_TRANSITIONS,
    *("multipliers", "units"),
)
"""Arguments: nodes (G + 1,), signals (G, 4, S), constants, p (M,); the transition times between t0 and tf (N + 2,);
the cell in which each segment begins, then the last cell (N + 2,); the mode of each segment (N + 1,); the index of the
reset map and of the function of each kind at each transition, -1 without one (N,); multipliers of all constraints; the
derivatives of the transition times, after a row of zeros (D + 1, width). Cells, modes and indices are 64-bit integers.
"""

SAMPLE_ARGUMENTS = ("cell", "time", "value", "weight", "segment", "seen")
"""Arguments of each Measurements: the cell at whose end a sample lies, or that holds a late sample, (K,); times (K,),
values (K, q), weights (K, q); the segment that holds a late sample, (K,); results: the time at which a late sample saw
the state, and this state, (K, 1 + n)."""

ZEROED = ("jump", "late")
"""Parts of the scratch space that start at zero, as the accumulators do; others are written before they are read."""


def get_address(array: NDArray[Any]) -> int:
    """Return the address of the first entry of an array."""
    buffer: Any = array
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(buffer))  # a quarter of the time of `ctypes.data`
    except (TypeError, ValueError):  # it is read-only, not contiguous, or empty
        return int(array.ctypes.data)


def _count_kept(library: Structure, n: int, order: Order) -> int:
    """Return how many doubles a row keeps at most for its backward step."""
    has_factors = order > Order.COST and any(library.implicit)
    return STAGES * MOST_KEPT_VALUES * n + (count_factors(n, len(STIFF.b)) if has_factors else 0)


def has_jumps(library: Structure) -> bool:
    """Return whether the costate may jump at the end of a row: at samples and nodes of transitions."""
    return bool(library.measurements) or any(getattr(library, kind) for kind in AT_TRANSITIONS)


class MemoryLayout(NamedTuple):
    """Layout of the memory of a program.

    Attributes
    ----------
    constraint_rows : the rows of constraints: those of guards, one per transition, come first, "end" is the first
        terminal one, and "count" the number of all
    arguments : names of `PROGRAM_ARGUMENTS` and, with the number of each Measurements, of `SAMPLE_ARGUMENTS`
    sums : sizes of the accumulators, which start at zero: they are the results
    memory : sizes of the parts of the scratch space, each a fixed one and what every row adds; late samples have a row
        of their own behind all others
    """

    constraint_rows: dict[str, int]
    arguments: list[str]
    sums: dict[str, int]
    memory: dict[str, tuple[int, int]]

    @property
    def names(self) -> list[str]:
        """The names in its table."""
        return [*self.arguments, *self.sums, *self.memory]


@lru_cache(maxsize=64)
def layout_of(library: Structure, sizes: Sizes, order: Order) -> MemoryLayout:
    """Return the layout of the memory of a program with derivatives of an order."""
    n, N, width = sizes.n, sizes.N, sizes.width
    end = N if library.guards else 0
    count = end + sizes.m
    derivatives = int(order > Order.COST)
    resets, jumps = int(bool(library.reset_maps)), int(has_jumps(library))
    implicit = int(any(library.implicit))
    late = int(any(sensor.delay is not None for sensor in library.measurements))
    # A row keeps what its backward step reads: the states of its stages, with the slopes of an implicit row behind
    # them; their tangents; functions of the C library and factors.
    of_row = {"X": STAGES * n, "XZ": STAGES * n * width, "kept": _count_kept(library, n, order)}
    # psi is among the sums since it starts at zero: nothing follows tf. The backward sweep leaves psi(t0) in it.
    sums = {"psi": n, "J": 1, "g": width, "H": sizes.D * width}
    sums |= {"constraints": count, "jacobian": count * width, "errors": n, CHECKED: 1}
    # State r is the one before row r, so that there is one more state than rows; late samples have their own row, and
    # a state at its end, behind them all. A part that this order does not need has no room for each row:
    # `Writer.at_row` then gives the same address for all rows.
    memory = {
        "x": (n + n * late, n),
        # Apart from the states of rows: simulations show x(tau-) and x(tau+), and derivatives need both.
        "reset_x": (N * n * resets, 0),
        "Z": (n * width * (1 + late), n * width * derivatives),
        "reset_Z": (N * n * width * resets, 0),
        **{name: (size * late, size * derivatives) for name, size in of_row.items()},
        "jump": (n, n * derivatives * jumps),
        "late": (0, n * derivatives * late),
        "costate": (0, n * derivatives),
        "increments": (len(STIFF.b) * n * implicit, 0),
        "newton": (2 * implicit, 0),
        # Of one row at a time: its backward step writes them, and the functions of curvature behind it read them.
        "entries": (STAGES * (1 + n + sizes.M) ** 2, 0),
        "length": (width, 0),
    }
    of_samples = [f"{name} {k}" for k in range(len(library.measurements)) for name in SAMPLE_ARGUMENTS]
    return MemoryLayout({"end": end, "count": count}, [*PROGRAM_ARGUMENTS, *of_samples], sums, memory)
