"""The memory of hypotheses: the record of each, a block of doubles, and the table that their machine code takes."""

from __future__ import annotations

from itertools import accumulate

from switchfit.discretization.tableaus import STIFF
from switchfit.engine.hypotheses import Column
from switchfit.engine.native.layout import STAGES
from switchfit.engine.native.scalars.graph import CHECKED
from switchfit.engine.native.sizes import Sizes

COLUMN_COUNT = len(Column)

PER_PLACE = 3
"""Hypotheses that `follow_order` keeps in each place of a given order of modes: as many as a beam of one sequence."""

WINDOW = 4
"""What limits the births at the end of a place, in doubles: how long its mode lasts at least, the times between which
the birth is, and how long the next mode lasts at least."""

HYPOTHESIS_POINTERS = "nodes", "signals", "c", "units", "tolerances", "low", "high", "most", "jump_first", "jump_map"
"""Pointers in the table, before those of the scratch space and of the samples. ``jump_first`` (G + 2,) has the place
in ``jump_map`` of the first jump at each node; ``low`` and ``high`` (D,) are the bounds of ``moved``, and ``most`` (D,)
is how far it may move at once."""

HYPOTHESIS_SAMPLE_POINTERS = ("first", "time", "value", "weight")
"""For each Measurements: the place of the first sample at each node (G + 2,), then as `layout.SAMPLE_ARGUMENTS`."""


def divide_record(sizes: Sizes) -> dict[str, slice]:
    """Return where the parts of a record are, in doubles.

    J : (), cost
    error : (), largest estimate of the error of a step since the last block, relative to the tolerances
    score : (), ``J - g' H^-1 g / 2``, the cost with all unknowns free, where the model is linear in them; NaN where H
        is not positive definite
    check : (), NaN once a value that was presumed finite is not
    parts : (), number of steps in a cell
    p, moved : (M,), the point of linearisation; (D,), how far the unknowns have moved there from where they began
    x, Z, g, H : (n,), (n, width), (width,), (D, width)
    """
    n, D, width = sizes.n, sizes.D, sizes.width
    # The order matters: what a step changes is J to `parts`, then x to H. p and `moved` between them stay, and a cell
    # that is tried again is restored by two copies; see `copy_changed` in `hypothesis_loops`.
    lengths = dict.fromkeys(("J", "error", "score", CHECKED, "parts"), 1) | {"p": sizes.M, "moved": D}
    lengths |= {"x": n, "Z": n * width, "g": width, "H": D * width}
    ends = accumulate(lengths.values())
    return {name: slice(end - length, end) for (name, length), end in zip(lengths.items(), ends, strict=True)}


def measure_record(sizes: Sizes) -> int:
    """Return the length of a record."""
    return divide_record(sizes)["H"].stop


def scratch_sizes(sizes: Sizes) -> dict[str, int]:
    """Return the sizes of the scratch space, in doubles: the eliminated [H; g'], the entries of g as they were
    eliminated, and what the straight-line functions exchange.
    """
    n, D, width = sizes.n, sizes.D, sizes.width
    # One scratch space for all hypotheses, which are propagated one after the other.
    lengths = {"rows": (D + 1) * width, "reduced": D, "K": n + 1}
    lengths |= {"XZ": STAGES * n * width, "entries": STAGES * (1 + n + sizes.M) ** 2}
    return lengths | {"increments": STIFF.coupled * n, "newton": 2}
