"""Segments forward and backward, with the loops over their rows, in hand-written LLVM IR."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from switchfit.discretization.nodes import AT_TRANSITIONS
from switchfit.discretization.tableaus import STIFF
from switchfit.engine.native.kernels import (
    BACKWARD,
    CONSTRAINT,
    CURVATURE,
    FORWARD,
    JUDGE,
    LENGTH,
    NEWTON,
    NODE,
    RESET,
    RESET_BACK,
    STAGES,
    STATES,
    Curvature,
    most_kept,
)
from switchfit.engine.native.llvm import literal
from switchfit.engine.native.templates import Order
from switchfit.engine.native.writer import TABLE, WHOLE, Writer, zero

KINDS = "inner", "end"
"""Rows that do not move with theta, and those beside a transition, which do."""


def start_row(writer: Writer, found: dict[str, str], segment: str, cell: str) -> dict[str, str]:
    """Emit where the row of a segment in a cell starts: its time, the first node of the cell, the signals there.

    `first` says whether it is the first one of its segment, `opens` whether it begins with a transition; `opening` is
    the derivative of its start.
    """
    first = writer.let(f"icmp eq i64 {cell}, {writer.load('i64', writer.at(found['first_cell'], segment))}")
    opens = writer.let(f"and i1 {first}, {writer.let(f'icmp sgt i64 {segment}, 0')}")
    begins = writer.load("double", writer.at(found["bounds"], segment))
    origin = writer.load("double", writer.at(found["nodes"], cell))
    return {
        "first": first,
        "opens": opens,
        "origin": origin,
        "start": writer.let(f"select i1 {first}, double {begins}, double {origin}"),
        "opening": _units(writer, found, opens, segment),
        "signal": writer.at(found["signals"], cell, 4 * writer.sizes.signals),
    }


def _units(writer: Writer, found: dict[str, str], moves: str, index: str) -> str:
    """Emit the address of the derivative of a transition time if it moves, else of zeros."""
    return writer.at(found["units"], writer.let(f"select i1 {moves}, i64 {index}, i64 0"), writer.sizes.width)


def row_pointers(writer: Writer, found: dict[str, str], cell: str, last: str) -> tuple[dict[str, str], str]:
    """Emit the pointers of the row of `%segment` in a cell; return them with the case of `row_cases`."""
    n, width = writer.sizes.n, writer.sizes.width
    # Rows are numbered by cell + segment, as in `mesh.build_rows`; states by the row that they are before, so that the
    # state after row r is state r + 1.
    place, row = start_row(writer, found, "%segment", cell), writer.let(f"add i64 {cell}, %segment")
    ends, next_ = writer.let(f"icmp eq i64 {cell}, {last}"), writer.let("add i64 %segment, 1")
    # The last segment ends at tf, which is no transition: its last row does not move.
    closes = writer.let(f"and i1 {ends}, {writer.let(f'icmp slt i64 %segment, {writer.sizes.N}')}")
    finishes = writer.load("double", writer.at(found["bounds"], next_))
    node = writer.load("double", writer.at(found["nodes"], writer.let(f"add i64 {cell}, 1")))
    end = writer.let(f"select i1 {ends}, double {finishes}, double {node}")
    for k, value in enumerate((place["start"], end, place["origin"])):
        writer.line(f"store double {value}, ptr {writer.at('%row', k)}")
    # Case 2 mode + kind: only rows beside a transition have the code for times that move.
    moves = writer.let(f"or i1 {place['opens']}, {closes}")
    kind = writer.let(f"zext i1 {moves} to i64")
    mode = writer.load("i64", writer.at(found["modes"], "%segment"))
    after = writer.let(f"add i64 {row}, 1")
    # `jump` is read at the end of the row, `late` and `costate` belong to its start.
    pointers = {
        "row": "%row",
        "first": place["first"],
        "signal": place["signal"],
        "opens": place["opening"],
        "closes": _units(writer, found, closes, next_),
        "kept": writer.at(found["kept"], row, STAGES * most_kept(n)),
        "X": writer.at(found["stages"], row, STAGES * n),
        "XZ": writer.at(found["stage_tangents"], row, STAGES * n * width),
        "jump": writer.at(found["jumps"], after, n),
        "late": writer.at(found["late"], row, n),
        "costate": writer.at(found["costates"], row, n),
    }
    here, there = state_pointers(writer, found, row), state_pointers(writer, found, after)
    pointers |= here | {f"{name}_after": pointer for name, pointer in there.items()}
    return found | pointers, writer.let(f"add i64 {writer.let(f'mul i64 {mode}, 2')}, {kind}")


def row_cases(writer: Writer, case: str) -> Iterator[tuple[int, str]]:
    """Emit a switch among the modes and `KINDS` of rows."""
    for k in writer.cases(case, len(KINDS) * len(writer.library.modes), "row"):
        yield k // len(KINDS), KINDS[k % len(KINDS)]


def state_pointers(writer: Writer, found: dict[str, str], index: str) -> dict[str, str]:
    """Return pointers to the state and its tangent at the end of a row, by its index."""
    n, width = writer.sizes.n, writer.sizes.width
    return {"x": writer.at(found["states"], index, n), "Z": writer.at(found["tangents"], index, n * width)}


NEWTON_ITERATIONS = 15
"""Largest number of Newton's iterations; where it converges at all, the sharpest models take 10."""

USUAL_ITERATIONS = 5
"""Iterations that count for the budget."""


def write_newton(writer: Writer, name: str, pointers: tuple[str, ...]) -> str:
    """Write the loop over Newton's iterations, which are calls of a function; J is NaN too if it does not converge."""
    count = len(STIFF.b) * writer.sizes.n
    given = {pointer: f"%{pointer}" for pointer in pointers}
    # k = 0 is X_j = x, so that the first iteration is a linearly implicit step.
    zero(writer, given["increments"], str(count))
    writer.line(f"store double {literal(1.0)}, ptr {given['newton']}")
    with writer.loop("0", str(NEWTON_ITERATIONS)):
        writer.call(name, pointers, given)
        flag = writer.load("double", writer.at(given["newton"], 1))
        writer.line(f"br i1 {writer.let(f'fcmp une double {flag}, 0.0')}, label %out, label %again")
        writer.label("again")
    for pointer in ("%J", *(writer.at(given["increments"], k) for k in range(count))):
        writer.line(f"store double {literal(float('nan'))}, ptr {pointer}")
    writer.line("br label %out")
    writer.label("out")
    return writer.end_function(f"void @solve_{name}({', '.join(f'ptr %{pointer}' for pointer in (*pointers, 'J'))})")


def solve_stages(writer: Writer, mode: int, given: dict[str, str]) -> None:
    """Emit the call that computes the increments of a row, if the mode takes implicit steps."""
    if writer.library.implicit[mode]:
        writer.line(f"call void @solve_newton_{mode}({', '.join(f'ptr {given[key]}' for key in (*NEWTON, 'J'))})")
        writer.work += USUAL_ITERATIONS * writer.module.work(f"newton_{mode}")


def estimate_row(writer: Writer, mode: int, curvature: Curvature) -> int:
    """Return the work of a row of a mode in an evaluation with second derivatives, in additions."""
    names = [f"forward_inner_{mode}", f"backward_inner_{mode}", *(curvature.name for _ in curvature.stages)]
    newton = USUAL_ITERATIONS * writer.module.work(f"newton_{mode}") if writer.library.implicit[mode] else 0
    return newton + sum(map(writer.module.work, names))


def write_forward_rows(writer: Writer) -> str:
    """Write the loop over all rows of a segment, forward, from the state `x` and its derivative `Z`."""
    writer.line("%row = alloca [3 x double]")
    found = writer.pointers()
    first, last, count = _find_cells(writer, found)
    # Behind the modes: 0 or less if nothing is judged, 1 for the errors of rows, 2 for jumps inside them too.
    flag = writer.load("i64", writer.at(found["modes"], writer.sizes.N + 1))
    mode, modes = writer.load("i64", writer.at(found["modes"], "%segment")), len(writer.library.modes)
    with writer.turns(count) as turn:
        given, case = row_pointers(writer, found, writer.let(f"add i64 {first}, {turn}"), last)
        # The first row begins behind the reset map, whose state is not among those of the rows.
        for name in ("x", "Z"):
            given[name] = writer.let(f"select i1 {given['first']}, ptr %{name}, ptr {given[name]}")
        for k, kind in row_cases(writer, case):
            solve_stages(writer, k, given)
            writer.call(f"forward_{kind}_{k}", FORWARD, given)
        for level, name in enumerate(("error", "jump") if writer.order >= Order.HESSIAN else ()):
            judges = writer.let(f"icmp sgt i64 {flag}, {level}")
            for k in writer.cases(writer.let(f"select i1 {judges}, i64 {mode}, i64 -1"), modes, name):
                writer.call(f"{name}_{k}", JUDGE, given)
    return writer.end_function(f"i1 @forward_rows({WHOLE}, ptr %x, ptr %Z)", returns=False)


def write_backward_rows(writer: Writer, curvatures: Sequence[dict[str, Curvature]]) -> str:
    """Write the loop over all rows of a segment, backward; `curvatures` are those of `KINDS` for each mode."""
    writer.line("%row = alloca [3 x double]")
    found = writer.pointers()
    _, last, count = _find_cells(writer, found)
    with writer.turns(count) as turn:
        given, case = row_pointers(writer, found, writer.let(f"sub i64 {last}, {turn}"), last)
        for k, kind in row_cases(writer, case):
            writer.call(f"backward_{kind}_{k}", BACKWARD, given)
            add_curvature(writer, curvatures[k][kind], given, moving=kind == "end")
    return writer.end_function(f"i1 @backward_rows({WHOLE})", returns=False)


def add_curvature(writer: Writer, curvature: Curvature, given: dict[str, str], moving: bool) -> None:
    """Emit the calls that add the second derivatives of a row to H.

    For a row that moves, the derivative of its length is added too.
    """
    n, width = writer.sizes.n, writer.sizes.width
    # Gauss-Newton has no h' x V': V is linear in the costate and in ell, which are of the size of the residuals.
    if moving and writer.order == Order.HESSIAN:
        writer.call("length", LENGTH, given)
    for j in curvature.stages:
        entries = writer.at(given["entries"], j * curvature.size)
        at_stage = {"entries": entries, "XZ": writer.at(given["XZ"], j * n * width)}
        writer.call(curvature.name, CURVATURE, given | at_stage)


def _find_cells(writer: Writer, found: dict[str, str]) -> tuple[str, str, str]:
    """Emit the first and the last cell of `%segment`, and their number."""
    next_ = writer.let("add i64 %segment, 1")
    first, last = (writer.load("i64", writer.at(found["first_cell"], k)) for k in ("%segment", next_))
    return first, last, writer.let(f"add i64 {writer.let(f'sub i64 {last}, {first}')}, 1")


def _call_rows(writer: Writer, name: str, more: str = "") -> None:
    """Emit the call of a loop over rows, and return unless it is done."""
    writer.line(f"%done = call i1 @{name}({TABLE}, i64 %segment, ptr %progress{more})")
    writer.line("br i1 %done, label %finished, label %pause")
    writer.label("pause")
    writer.line("ret i1 false")
    writer.label("finished")


def find_reset(writer: Writer, found: dict[str, str], segment: str, opens: str) -> tuple[str, dict[str, str]]:
    """Emit the index of the reset map at the start of a segment, -1 without one; return it with its pointers."""
    n, width = writer.sizes.n, writer.sizes.width
    # Without a transition the index is 0: the load stays inside the array, and its value is not used.
    safe = writer.let(f"select i1 {opens}, i64 {writer.let(f'sub i64 {segment}, 1')}, i64 0")
    of_transition = writer.load("i64", writer.at(found["resets"], safe))
    which = writer.let(f"select i1 {opens}, i64 {of_transition}, i64 -1")
    # The map of a transition is differentiated at the time of that transition: its unit vector is row `segment`.
    return which, {
        "time": writer.at(found["bounds"], segment),
        "moves": writer.at(found["units"], segment, width),
        "x_after": writer.at(found["reset_states"], safe, n),
        "Z_after": writer.at(found["reset_tangents"], safe, n * width),
    }


def choose_state(writer: Writer, which: str, given: dict[str, str], state: dict[str, str]) -> dict[str, str]:
    """Emit the choice of the state behind a reset map, if there is one, else the one before."""
    there = writer.let(f"icmp sge i64 {which}, 0")
    return {
        name: writer.let(f"select i1 {there}, ptr {given[f'{name}_after']}, ptr {state[name]}") for name in ("x", "Z")
    }


def write_forward(writer: Writer) -> str:
    """Write a segment forward: its reset map, its rows, and the functions at its end."""
    found = writer.pointers()
    first, last, _ = _find_cells(writer, found)
    state = state_pointers(writer, found, writer.let(f"add i64 {first}, %segment"))
    if writer.library.reset_maps:
        which, given = find_reset(writer, found, "%segment", writer.let("icmp sgt i64 %segment, 0"))
        for k in writer.cases(which, len(writer.library.reset_maps), "reset"):
            writer.call(f"reset_{k}", RESET, found | state | given)
        state = choose_state(writer, which, given, state)
    _call_rows(writer, "forward_rows", f", ptr {state['x']}, ptr {state['Z']}")
    after = writer.let(f"add i64 {writer.let(f'add i64 {last}, %segment')}, 1")
    given = found | state_pointers(writer, found, after)
    # Once per segment: what is not finite stays so to its end.
    writer.call("check_state", STATES, given)
    _call_transition_functions(writer, given, last, after)
    writer.line("ret i1 true")
    return writer.end_function(f"i1 @forward_any({WHOLE})", returns=False)


def _call_transition_functions(writer: Writer, found: dict[str, str], last: str, after: str) -> None:
    """Call the functions at the transition that ends a segment; behind the last one, the library has none."""
    next_ = writer.let("add i64 %segment, 1")
    given = found | {
        "time": writer.at(found["bounds"], next_),
        "moves": writer.at(found["units"], next_, writer.sizes.width),
        "origin": writer.at(found["nodes"], last),
        "signal": writer.at(found["signals"], last, 4 * writer.sizes.signals),
        "jump": writer.at(found["jumps"], after, writer.sizes.n) if writer.order else found["jumps"],
    }
    for kind in AT_TRANSITIONS:
        count = len(getattr(writer.library, kind.name))
        if kind.constraint and count:
            given |= constraint_pointers(writer, found, writer.let(f"add i64 %segment, {writer.rows[kind.name]}"))
        which = writer.load("i64", writer.at(found[kind.name], "%segment"))
        for k in writer.cases(which, count, kind.name):
            writer.call(f"{kind.name}_{k}", CONSTRAINT if kind.constraint else NODE, given)


def constraint_pointers(writer: Writer, found: dict[str, str], row: str) -> dict[str, str]:
    """Return pointers to the constraints from a row on."""
    return {
        "multiplier": writer.at(found["multipliers"], row),
        "constraint": writer.at(found["constraints"], row),
        "jacobian": writer.at(found["jacobian"], row, writer.sizes.width),
    }


def write_backward(writer: Writer) -> str:
    """Write a segment backward: its rows, then the reset map at its start."""
    found = writer.pointers()
    _call_rows(writer, "backward_rows")
    if writer.library.reset_maps:
        first, _, _ = _find_cells(writer, found)
        state = state_pointers(writer, found, writer.let(f"add i64 {first}, %segment"))
        which, given = find_reset(writer, found, "%segment", writer.let("icmp sgt i64 %segment, 0"))
        for k in writer.cases(which, len(writer.library.reset_maps), "reset"):
            # psi(tau+), which the first row of the segment has left, becomes psi(tau-) for the last row of the one
            # before.
            writer.call(f"reset_back_{k}", RESET_BACK, found | state | given)
    writer.line("ret i1 true")
    return writer.end_function(f"i1 @backward_any({WHOLE})", returns=False)
