"""Loops over the rows of a segment and over the segments, forward and backward, in hand-written LLVM IR."""

from __future__ import annotations

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
from switchfit.engine.native.writer import Writer, zero

TABLE = "ptr %table"
SEGMENT = f"{TABLE}, i64 %segment, i64 %first, i64 %last, double %begins, double %finishes, ptr %progress"
WHOLE = f"{TABLE}, i64 %segment, ptr %progress"


def row_pointers(writer: Writer, found: dict[str, str], cell: str) -> dict[str, str]:
    """Emit the times, signals and directions of the row of a segment in a cell, and whether it moves with theta."""
    N, S, width = writer.sizes.N, writer.sizes.signals, writer.sizes.width
    first, last = writer.let(f"icmp eq i64 {cell}, %first"), writer.let(f"icmp eq i64 {cell}, %last")
    here = writer.load("double", writer.at(found["nodes"], cell))
    after = writer.let(f"add i64 {cell}, 1")
    there = writer.load("double", writer.at(found["nodes"], after))
    start = writer.let(f"select i1 {first}, double %begins, double {here}")
    end = writer.let(f"select i1 {last}, double %finishes, double {there}")
    for k, value in enumerate((start, end, here)):
        writer.line(f"store double {value}, ptr {writer.at('%row', k)}")
    later, earlier = writer.let("icmp sgt i64 %segment, 0"), writer.let(f"icmp slt i64 %segment, {N}")
    opens, closes = writer.let(f"and i1 {first}, {later}"), writer.let(f"and i1 {last}, {earlier}")
    next_ = writer.let("add i64 %segment, 1")
    opening, closing = (
        writer.at(found["units"], writer.let(f"select i1 {flag}, i64 {index}, i64 0"), width)
        for flag, index in ((opens, "%segment"), (closes, next_))
    )
    return {
        "row": "%row",
        "signal": writer.at(found["signals"], cell, 4 * S),
        "opens": opening,
        "closes": closing,
        "first": first,
        "moves": writer.let(f"or i1 {opens}, {closes}"),
    }


def pointers_at_row(writer: Writer, found: dict[str, str], row: str) -> dict[str, str]:
    """Emit the addresses of what a row keeps at its stages: the states, their tangents, functions of them."""
    n, width = writer.sizes.n, writer.sizes.width
    return {
        "kept": writer.at(found["kept"], row, STAGES * most_kept(n)),
        "X": writer.at(found["stages"], row, STAGES * n),
        "XZ": writer.at(found["stage_tangents"], row, STAGES * n * width),
    }


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
    zero(writer, given["increments"], str(count))
    writer.line(f"store double {literal(1.0)}, ptr {given['newton']}")
    writer.line("br label %loop")
    writer.label("loop")
    writer.line("%k = phi i64 [0, %entry], [%more, %again]")
    writer.call(name, pointers, given)
    flag = writer.load("double", writer.at(given["newton"], 1))
    writer.line(f"%done = fcmp une double {flag}, 0.0")
    writer.line("br i1 %done, label %out, label %again")
    writer.label("again")
    writer.line("%more = add i64 %k, 1")
    writer.line(f"%last = icmp sge i64 %more, {NEWTON_ITERATIONS}")
    writer.line("br i1 %last, label %failed, label %loop")
    writer.label("failed")
    for pointer in ("%J", *(writer.at(given["increments"], k) for k in range(count))):
        writer.line(f"store double {literal(float('nan'))}, ptr {pointer}")
    writer.line("br label %out")
    writer.label("out")
    return writer.end_function(f"void @solve_{name}({', '.join(f'ptr %{pointer}' for pointer in (*pointers, 'J'))})")


def solve_stages(writer: Writer, mode: int, given: dict[str, str]) -> int:
    """Emit the call that computes the increments of a row, if the mode takes implicit steps; return its cost."""
    if not writer.library.implicit[mode]:
        return 0
    writer.line(f"call void @solve_newton_{mode}({', '.join(f'ptr {given[key]}' for key in (*NEWTON, 'J'))})")
    return USUAL_ITERATIONS * writer.module.work(f"newton_{mode}")


def write_forward_segment(writer: Writer, mode: int) -> str:
    """Write the loop over all rows of a segment in a mode, forward."""
    writer.line("%row = alloca [3 x double]")
    found = writer.pointers()
    before, left = writer.load_progress()
    flag = writer.load("i64", writer.at(found["modes"], writer.sizes.N + 1))
    judges, looks = (writer.let(f"icmp sgt i64 {flag}, {k}") for k in (0, 1))
    writer.line(f"%start = add i64 %first, {before}")
    writer.line("br label %loop")
    writer.label("loop")
    writer.line("%cell = phi i64 [%start, %entry], [%more, %next]")
    writer.line(f"%budget = phi i64 [{left}, %entry], [%left, %next]")
    place = row_pointers(writer, found, "%cell")
    row = writer.let("add i64 %cell, %segment")
    own = state_pointers(writer, found, row)
    x = writer.let(f"select i1 {place['first']}, ptr %x, ptr {own['x']}")
    Z = writer.let(f"select i1 {place['first']}, ptr %Z, ptr {own['Z']}")
    after = state_pointers(writer, found, writer.let(f"add i64 {row}, 1"))
    given = found | place | pointers_at_row(writer, found, row)
    given |= {"x": x, "Z": Z, "x_after": after["x"], "Z_after": after["Z"]}
    writer.line(f"br i1 {place['moves']}, label %is_end, label %is_inner")
    work = {}
    for kind in ("end", "inner"):
        writer.label(f"is_{kind}")
        work[kind] = solve_stages(writer, mode, given) + writer.call(f"forward_{kind}_{mode}", FORWARD, given)
        writer.line("br label %done_row")
    writer.label("done_row")
    writer.row_work = work["inner"]
    writer.line(f"%work = phi i64 [{work['end']}, %is_end], [{work['inner']}, %is_inner]")
    if writer.order >= Order.HESSIAN:
        writer.line(f"br i1 {judges}, label %judge, label %next")
        writer.label("judge")
        writer.call(f"error_{mode}", JUDGE, given)
        writer.line(f"br i1 {looks}, label %look, label %next")
        writer.label("look")
        writer.call(f"jump_{mode}", JUDGE, given)
    writer.line("br label %next")
    writer.label("next")
    writer.line("%left = sub i64 %budget, %work")
    writer.line("%more = add i64 %cell, 1")
    writer.line("%done = icmp sgt i64 %more, %last")
    writer.next_turn(writer.let("sub i64 %cell, %first"), "%done")
    return writer.end_function(f"i1 @forward_{mode}({SEGMENT}, ptr %x, ptr %Z)", returns=False)


def write_backward_segment(writer: Writer, mode: int, inner: Curvature, end: Curvature) -> str:
    """Write the loop over all rows of a segment in a mode, backward; rows at its `end` move with theta, others not."""
    n = writer.sizes.n
    writer.line("%row = alloca [3 x double]")
    found = writer.pointers()
    before, left = writer.load_progress()
    writer.line(f"%start = sub i64 %last, {before}")
    writer.line("br label %loop")
    writer.label("loop")
    writer.line("%cell = phi i64 [%start, %entry], [%less, %next]")
    writer.line(f"%budget = phi i64 [{left}, %entry], [%left, %next]")
    place = row_pointers(writer, found, "%cell")
    row = writer.let("add i64 %cell, %segment")
    after = writer.let(f"add i64 {row}, 1")
    given = found | place | pointers_at_row(writer, found, row)
    given |= {"jump": writer.at(found["jumps"], after, n), "late": writer.at(found["late"], row, n)}
    given["costate"] = writer.at(found["costates"], row, n)
    writer.line(f"br i1 {place['moves']}, label %is_end, label %is_inner")
    work = {}
    for kind, curvature in (("end", end), ("inner", inner)):
        writer.label(f"is_{kind}")
        work[kind] = writer.call(f"backward_{kind}_{mode}", BACKWARD, given)
        work[kind] += add_curvature(writer, curvature, given, moving=kind == "end")
        writer.line("br label %next")
    writer.label("next")
    writer.row_work += work["inner"]
    writer.line(f"%work = phi i64 [{work['end']}, %is_end], [{work['inner']}, %is_inner]")
    writer.line("%left = sub i64 %budget, %work")
    writer.line("%less = sub i64 %cell, 1")
    writer.line("%done = icmp slt i64 %less, %first")
    writer.next_turn(writer.let("sub i64 %last, %cell"), "%done")
    return writer.end_function(f"i1 @backward_{mode}({SEGMENT})", returns=False)


def add_curvature(writer: Writer, curvature: Curvature, given: dict[str, str], moving: bool) -> int:
    """Emit the calls that add the second derivatives of a row to H; return their cost.

    For a row that moves, the derivative of its length is added too.
    """
    n, width, work = writer.sizes.n, writer.sizes.width, 0
    if writer.order < Order.HESSIAN:
        return work
    if moving and writer.order == Order.HESSIAN:
        work += writer.call("length", LENGTH, given)
    for j in curvature.stages:
        entries = writer.at(given["entries"], j * curvature.size)
        at_stage = {"entries": entries, "XZ": writer.at(given["XZ"], j * n * width)}
        work += writer.call(curvature.name, CURVATURE, given | at_stage)
    return work


def segment_pointers(writer: Writer, found: dict[str, str]) -> dict[str, str]:
    """Emit where a segment begins and ends (cells, times, indices of states), and the arguments of its rows."""
    next_ = writer.let("add i64 %segment, 1")
    first, last = (writer.load("i64", writer.at(found["first_cell"], k)) for k in ("%segment", next_))
    begins, finishes = (writer.load("double", writer.at(found["bounds"], k)) for k in ("%segment", next_))
    before = writer.let(f"add i64 {first}, %segment")
    after = writer.let(f"add i64 {writer.let(f'add i64 {last}, %segment')}, 1")
    given = f"{TABLE}, i64 %segment, i64 {first}, i64 {last}, double {begins}, double {finishes}, ptr %progress"
    return {"next": next_, "last": last, "before": before, "after": after, "given": given}


def _switch_to_reset(writer: Writer, found: dict[str, str], name: str) -> tuple[str, dict[str, str], list[str]]:
    """Emit a switch to the reset map at the start of a segment; return its index, its pointers and the blocks."""
    n, width = writer.sizes.n, writer.sizes.width
    transition = writer.let("sub i64 %segment, 1")
    opens = writer.let("icmp sgt i64 %segment, 0")
    safe = writer.let(f"select i1 {opens}, i64 {transition}, i64 0")
    of_transition = writer.load("i64", writer.at(found["resets"], safe))
    which = writer.let(f"select i1 {opens}, i64 {of_transition}, i64 -1")
    given = {
        "time": writer.at(found["bounds"], "%segment"),
        "moves": writer.at(found["units"], "%segment", width),
        "x_after": writer.at(found["reset_states"], safe, n),
        "Z_after": writer.at(found["reset_tangents"], safe, n * width),
    }
    return which, given, writer.choose(which, len(writer.library.reset_maps), name)


def write_forward(writer: Writer) -> str:
    """Write a segment of any mode forward: its reset map, its rows, and the functions at its end."""
    found = writer.pointers()
    place = segment_pointers(writer, found)
    state = state_pointers(writer, found, place["before"])
    if writer.library.reset_maps:
        which, given, labels = _switch_to_reset(writer, found, "reset")
        for k, label in enumerate(labels):
            writer.label(label)
            writer.call(f"reset_{k}", RESET, found | state | given)
            writer.line("br label %reset_end")
        writer.label("reset_end")
        there = writer.let(f"icmp sge i64 {which}, 0")
        for name, after in (("x", "x_after"), ("Z", "Z_after")):
            state[name] = writer.let(f"select i1 {there}, ptr {given[after]}, ptr {state[name]}")
    mode = writer.load("i64", writer.at(found["modes"], "%segment"))
    labels = writer.choose(mode, len(writer.library.modes), "mode")
    for k, label in enumerate(labels):
        writer.label(label)
        writer.line(f"%done_{k} = call i1 @forward_{k}({place['given']}, ptr {state['x']}, ptr {state['Z']})")
        writer.line(f"br i1 %done_{k}, label %mode_end, label %pause")
    writer.label("pause")
    writer.line("ret i1 false")
    writer.label("mode_end")
    state = state_pointers(writer, found, place["after"])
    writer.call("check_state", STATES, found | state)
    if writer.sizes.N:
        _call_transition_functions(writer, found, place, state)
    writer.line("ret i1 true")
    return writer.end_function(f"i1 @forward_any({WHOLE})", returns=False)


def _call_transition_functions(
    writer: Writer, found: dict[str, str], place: dict[str, str], state: dict[str, str]
) -> None:
    """Call the functions at the transition that ends a segment."""
    n, width = writer.sizes.n, writer.sizes.width
    kinds = [kind for kind in AT_TRANSITIONS if getattr(writer.library, kind.name)]
    if not kinds:
        return
    closes = writer.let(f"icmp slt i64 %segment, {writer.sizes.N}")
    writer.line(f"br i1 {closes}, label %transition, label %no_transition")
    writer.label("transition")
    given = found | state
    given |= {
        "time": writer.at(found["bounds"], place["next"]),
        "moves": writer.at(found["units"], place["next"], width),
        "origin": writer.at(found["nodes"], place["last"]),
        "signal": writer.at(found["signals"], place["last"], 4 * writer.sizes.signals),
        "jump": writer.at(found["jumps"], place["after"], n) if writer.order else found["jumps"],
    }
    for kind in kinds:
        which = writer.load("i64", writer.at(found[kind.name], "%segment"))
        if kind.constraint:
            given |= constraint_pointers(writer, found, writer.let(f"add i64 %segment, {writer.rows[kind.name]}"))
        for k, label in enumerate(writer.choose(which, len(getattr(writer.library, kind.name)), kind.name)):
            writer.label(label)
            writer.call(f"{kind.name}_{k}", CONSTRAINT if kind.constraint else NODE, given)
            writer.line(f"br label %{kind.name}_end")
        writer.label(f"{kind.name}_end")
    writer.line("br label %no_transition")
    writer.label("no_transition")


def constraint_pointers(writer: Writer, found: dict[str, str], row: str) -> dict[str, str]:
    """Return pointers to the constraints from a row on."""
    return {
        "multiplier": writer.at(found["multipliers"], row),
        "constraint": writer.at(found["constraints"], row),
        "jacobian": writer.at(found["jacobian"], row, writer.sizes.width),
    }


def write_backward(writer: Writer) -> str:
    """Write a segment of any mode backward: its rows, then the reset map at its start."""
    found = writer.pointers()
    place = segment_pointers(writer, found)
    mode = writer.load("i64", writer.at(found["modes"], "%segment"))
    for k, label in enumerate(writer.choose(mode, len(writer.library.modes), "mode")):
        writer.label(label)
        writer.line(f"%done_{k} = call i1 @backward_{k}({place['given']})")
        writer.line(f"br i1 %done_{k}, label %mode_end, label %pause")
    writer.label("pause")
    writer.line("ret i1 false")
    writer.label("mode_end")
    if writer.library.reset_maps:
        state = state_pointers(writer, found, place["before"])
        _, given, labels = _switch_to_reset(writer, found, "reset")
        for k, label in enumerate(labels):
            writer.label(label)
            writer.call(f"reset_back_{k}", RESET_BACK, found | state | given)
            writer.line("br label %reset_end")
        writer.label("reset_end")
    writer.line("ret i1 true")
    return writer.end_function(f"i1 @backward_any({WHOLE})", returns=False)
