"""Loops over the rows of a segment, forward and backward.

Rows are numbered by ``cell + segment``: each transition cuts one cell in two. Row r leads from state r to state r + 1:

    cells      |     0     |     1     |     2     |       nodes t_0 .. t_3, one transition tau in cell 1
    rows       |     0     |  1  |  2  |     3     |       segment 0: rows 0 and 1, segment 1: rows 2 and 3
    states     0           1    2           3     4       `x`, Z; x(tau+) is in "reset_x" if there is a reset map

The mode of a segment, and the reset map and other functions of a transition, are read at run time, so that all
sequences of a library share a program. Segments that a sequence does not need are idle: they begin and end at tf.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from switchfit.discretization.model import AT_TRANSITIONS
from switchfit.discretization.tableaus import STIFF
from switchfit.engine.native.kernels import CurvatureFunction
from switchfit.engine.native.llvm.lines import Operand, Value
from switchfit.engine.native.loops.writer import Pointers, Writer
from switchfit.engine.native.sizes import Order

ROW_KINDS = "inner", "end"
"""Rows that do not move with theta, and those beside a transition, which do."""

OF_STAGES = "kept", "X", "XZ"
"""Parts of the scratch space that belong to the stages of a row."""

NATIVE_NEWTON_ITERATIONS = 15
"""Largest number of Newton's iterations; where it converges at all, the sharpest models take 10."""


def start_row(writer: Writer, found: Pointers, segment: Value, cell: Value) -> Pointers:
    """Emit where the row of a segment in a cell starts: its time, the first node of the cell, the signals there.

    `first` says whether it is the first one of its segment, `begins` whether it begins with a transition; `opens` is
    the derivative of its start.
    """
    first = cell.equals(writer.get("i64", found["first_cell"], segment))
    begins, origin = first & (segment > 0), writer.get("double", found["nodes"], cell)
    return {
        "first": first,
        "begins": begins,
        "origin": origin,
        "start": first.choose(writer.get("double", found["bounds"], segment), origin),
        "opens": _units(writer, found, begins, segment),
        "signal": writer.at(found["signals"], cell, 4 * writer.sizes.signals),
    }


def _units(writer: Writer, found: Pointers, moves: Value, index: Value) -> Value:
    """Emit the address of the derivative of a transition time if it moves, else of zeros."""
    return writer.at(found["units"], moves.choose(index, 0), writer.sizes.width)


def _row_pointers(writer: Writer, found: Pointers, segment: Value, cell: Value, last: Value) -> tuple[Pointers, Value]:
    """Emit the pointers of the row of a segment in a cell; return them with the case of `_row_cases`."""
    # Rows are numbered by cell + segment, as in `mesh.build_rows`; states by the row that they are before, so that the
    # state after row r is state r + 1.
    place, row, ends = start_row(writer, found, segment, cell), cell + segment, cell.equals(last)
    # The last segment ends at tf, which is no transition: its last row does not move.
    closes, after = ends & (segment < writer.sizes.N), row + 1
    finishes = writer.get("double", found["bounds"], segment + 1)
    end = ends.choose(finishes, writer.get("double", found["nodes"], cell + 1))
    times = writer.allocate("double", 3)
    for k, value in enumerate((place["start"], end, place["origin"])):
        writer.put(value, times, k)
    pointers = place | {"row": times, "closes": _units(writer, found, closes, segment + 1)}
    # `jump` is read at the end of the row, `late` and `costate` belong to its start.
    pointers |= writer.at_row(found, after, "jump") | writer.at_row(found, row, "late", "costate", "x", "Z", *OF_STAGES)
    pointers |= writer.at_row(found, after, "x", "Z", suffix="_after")
    # Case 2 mode + kind: only rows beside a transition have the code for times that move.
    kind = (place["begins"] | closes).to("i64")
    return found | pointers, writer.get("i64", found["modes"], segment) * len(ROW_KINDS) + kind


def count_rows(writer: Writer, found: Pointers) -> Value:
    """Emit the number of rows."""
    return writer.get("i64", found["first_cell"], writer.sizes.N + 1) + (writer.sizes.N + 1)


def _row_cases(writer: Writer, case: Value) -> Iterator[tuple[int, str]]:
    """Emit a switch among the modes and `KINDS` of rows."""
    for k in writer.cases(case, len(ROW_KINDS) * len(writer.library.modes)):
        yield k // len(ROW_KINDS), ROW_KINDS[k % len(ROW_KINDS)]


def write_newton(writer: Writer, name: str) -> str:
    """Write the loop over Newton's iterations, which are calls of a function; J is NaN too if it does not converge."""
    count, names = len(STIFF.b) * writer.sizes.n, (*writer.module.pointers[name], "J")
    parameters = writer.begin(f"void @solve_{name}({', '.join(f'ptr %{key}' for key in names)})")
    writer.module.pointers[f"solve_{name}"] = names
    given = dict(zip(names, parameters, strict=True))
    # k = 0 is X_j = x, so that the first iteration is a linearly implicit step.
    writer.zero(given["increments"], count)
    # 1: the iteration before the first was not small; two in a row count as converged.
    writer.store(1.0, given["newton"])
    with writer.loop(0, NATIVE_NEWTON_ITERATIONS):
        writer.call(name, given)
        # Returns as soon as it has converged; what follows the loop is the case that it has not.
        with writer.when(writer.get("double", given["newton"], 1).differs(0.0)):
            writer.line("ret void")
    for pointer in (given["J"], *(writer.at(given["increments"], k) for k in range(count))):
        writer.store(float("nan"), pointer)
    return writer.end()


def add_curvature(writer: Writer, curvature: CurvatureFunction, given: Pointers, moving: bool) -> None:
    """Emit the calls that add the second derivatives of a row to H.

    For a row that moves, the derivative of its length is added too.
    """
    n, width = writer.sizes.n, writer.sizes.width
    # Gauss-Newton has no h' x V': V is linear in the costate and in ell, which are of the size of the residuals.
    if moving and writer.order == Order.HESSIAN:
        writer.call("length", given)
    for j in curvature.stages:
        entries, tangents = writer.at(given["entries"], j * curvature.size), writer.at(given["XZ"], j * n * width)
        writer.call(curvature.name, given | {"entries": entries, "XZ": tangents})


def find_reset(writer: Writer, found: Pointers, segment: Value, opens: Value) -> tuple[Value, Pointers]:
    """Emit the index of the reset map at the start of a segment, -1 without one; return it with its pointers."""
    n, width = writer.sizes.n, writer.sizes.width
    # Without a transition the index is 0: the load stays inside the array, and its value is not used.
    safe = opens.choose(segment - 1, 0)
    # The map of a transition is differentiated at the time of that transition: its unit vector is row `segment`.
    return opens.choose(writer.get("i64", found["resets"], safe), -1), {
        "time": writer.at(found["bounds"], segment),
        "moves": writer.at(found["units"], segment, width),
        "x_after": writer.at(found["reset_x"], safe, n),
        "Z_after": writer.at(found["reset_Z"], safe, n * width),
    }


def choose_state(which: Value, given: Pointers, state: Pointers) -> Pointers:
    """Emit the choice of the state behind a reset map, if there is one, else the one before."""
    there = which >= 0
    return {name: there.choose(given[f"{name}_after"], state[name]) for name in ("x", "Z")}


def write_forward(writer: Writer) -> str:
    """Write a segment forward: its reset map, its rows, and the functions at its end."""
    _, segment = writer.begin("void @forward(ptr %table, i64 %segment)")
    found = writer.pointers()
    first, last = (writer.get("i64", found["first_cell"], k) for k in (segment, segment + 1))
    start = writer.at_row(found, first + segment, "x", "Z")
    if writer.library.reset_maps:
        which, given = find_reset(writer, found, segment, segment > 0)
        writer.call_one_of(which, len(writer.library.reset_maps), found | start | given, "reset_{}")
        start = choose_state(which, given, start)
    # Behind the modes: 0 or less if nothing is judged, 1 for the errors of rows, 2 for jumps inside them too.
    flag = writer.get("i64", found["modes"], writer.sizes.N + 1)
    mode, modes = writer.get("i64", found["modes"], segment), len(writer.library.modes)
    # Inclusive at both ends: the cell that a transition cuts is the last of one segment and the first of the next.
    with writer.loop(first, last + 1) as cell:
        given, case = _row_pointers(writer, found, segment, cell, last)
        # The first row begins behind the reset map, whose state is not among those of the rows.
        given |= {name: given["first"].choose(start[name], given[name]) for name in ("x", "Z")}
        for k, kind in _row_cases(writer, case):
            writer.take_step(k, f"forward_{kind}", given)
        for level, name in enumerate(("error_{}", "jump_{}") if writer.order > Order.COST else ()):
            writer.call_one_of((flag > level).choose(mode, -1), modes, given, name)
    after = last + segment + 1
    given = found | writer.at_row(found, after, "x", "Z")
    # Once per segment: what is not finite stays so to its end.
    writer.call("check_state", given)
    _call_transition_functions(writer, given, segment, last, after)
    return writer.end()


def _call_transition_functions(writer: Writer, found: Pointers, segment: Value, last: Value, after: Value) -> None:
    """Call the functions at the transition that ends a segment; behind the last one, the library has none."""
    next_ = segment + 1
    given = found | {
        "time": writer.at(found["bounds"], next_),
        "moves": writer.at(found["units"], next_, writer.sizes.width),
        "origin": writer.at(found["nodes"], last),
        "signal": writer.at(found["signals"], last, 4 * writer.sizes.signals),
        **writer.at_row(found, after, "jump"),
    }
    for kind in AT_TRANSITIONS:
        count = len(getattr(writer.library, kind))
        if kind == "guards" and count:
            given |= constraint_pointers(writer, found, segment)
        writer.call_one_of(writer.get("i64", found[kind], segment), count, given, f"{kind}_{{}}")


def constraint_pointers(writer: Writer, found: Pointers, row: Operand) -> Pointers:
    """Return pointers to the constraints from a row on."""
    return {
        "multiplier": writer.at(found["multipliers"], row),
        "constraint": writer.at(found["constraints"], row),
        "jacobian": writer.at(found["jacobian"], row, writer.sizes.width),
    }


def write_backward(writer: Writer, curvatures: Sequence[dict[str, CurvatureFunction]]) -> str:
    """Write a segment backward: its rows, then the reset map at its start; `curvatures` are those of `KINDS` for each
    mode.
    """
    _, segment = writer.begin("void @backward(ptr %table, i64 %segment)")
    found = writer.pointers()
    first, last = (writer.get("i64", found["first_cell"], k) for k in (segment, segment + 1))
    # Last row first. `psi` is one vector, which each row replaces by that at its start.
    with writer.loop(0, last - first + 1) as turn:
        given, case = _row_pointers(writer, found, segment, last - turn, last)
        for k, kind in _row_cases(writer, case):
            writer.call(f"backward_{kind}_{k}", given)
            add_curvature(writer, curvatures[k][kind], given, moving=kind == "end")
    if writer.library.reset_maps:
        state = writer.at_row(found, first + segment, "x", "Z")
        which, given = find_reset(writer, found, segment, segment > 0)
        # psi(tau+), which the first row of the segment has left, becomes psi(tau-) for the last row of the one before.
        writer.call_one_of(which, len(writer.library.reset_maps), found | state | given, "reset_{}_back")
    return writer.end()
