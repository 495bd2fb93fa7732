"""Loops that call the straight-line functions of `switchfit.engine.native.kernels`, in hand-written LLVM IR.

Rows are numbered by ``cell + segment``: each transition cuts one cell in two. The mode of a segment, and the reset map
and other functions of a transition, are read at run time. Segments that a sequence does not need are idle: they begin
and end at tf.

Python handles Ctrl-C only between two calls. Loops therefore return when a budget is spent, and resume at the next
call. Their state between two calls is `progress`, three integers: the phase of the evaluation (-1 at its end), the
number of finished iterations of the loop in this phase, and the rest of the budget (`llvm.BUDGET`).
"""

from __future__ import annotations

from switchfit.discretization.tableaus import STIFF
from switchfit.engine.native.adaptive import (
    ADAPTIVE_NEWTON,
    IMPLICIT_STEP,
    IMPLICIT_TIMES,
    SLOPE,
    STAGE_TIMES,
    STEP,
    Adaptive,
    step_functions,
)
from switchfit.engine.native.kernels import CONSTRAINT, NODE, START, START_BACK
from switchfit.engine.native.llvm import BUDGET, literal
from switchfit.engine.native.scalars import CHECKED
from switchfit.engine.native.segments import USUAL_ITERATIONS, constraint_pointers, state_pointers
from switchfit.engine.native.templates import Order
from switchfit.engine.native.workspace import ZEROED, list_place_lengths, memory, sums
from switchfit.engine.native.writer import Writer, copy, zero

UNLIMITED = 2**63 - 1
"""A budget that no evaluation spends."""

TABLE = "ptr %table"
WHOLE = f"{TABLE}, i64 %segment, ptr %progress"


def write_evaluation(writer: Writer) -> str:
    """Write `evaluate`, which runs all phases in order; the loops among them return whether they are finished.

    The phases are the segments forward, the samples of each Measurements, the terminal terms, and the segments
    backward.
    """
    N, K = writer.sizes.N, len(writer.library.measurements)
    found = writer.pointers()
    # Phases: 0 .. N segments forward, N + 1 .. N + K samples, N + 1 + K the end, then segments N .. 0 backward and the
    # start. A phase that runs out of budget stores its number and returns: the next call goes on there, and Python can
    # see Ctrl-C.
    before = writer.load("i64", "%progress")
    counts = [f"%count_{k}" for k in range(K)]
    writer.line("br label %phase")
    writer.label("phase")
    writer.line(f"%now = phi i64 [{before}, %entry], [%following, %done]")
    writer.line(f"%is_forward = icmp sle i64 %now, {N}")
    writer.line("br i1 %is_forward, label %forward, label %later")
    writer.label("forward")
    writer.line("%is_start = icmp eq i64 %now, 0")
    writer.line("br i1 %is_start, label %start, label %segment")
    writer.label("start")
    writer.call("start", START, found | state_pointers(writer, found, "0"))
    writer.line("br label %segment")
    writer.label("segment")
    writer.line(f"%passed = call i1 @forward_any({TABLE}, i64 %now, ptr %progress)")
    writer.line("br i1 %passed, label %done, label %pause")
    writer.label("later")
    cases = [f"i64 {N + 1 + k}, label %samples_{k}" for k in range(K)] + [f"i64 {N + 1 + K}, label %at_end"]
    writer.line(f"switch i64 %now, label %backward [{' '.join(cases)}]")
    for k, count in enumerate(counts):
        writer.label(f"samples_{k}")
        writer.line(f"%counted_{k} = call i1 @samples_{k}({TABLE}, i64 {count}, ptr %progress)")
        writer.line(f"br i1 %counted_{k}, label %done, label %pause")
    writer.label("at_end")
    index = writer.let(f"add i64 {writer.load('i64', writer.at(found['first_cell'], N + 1))}, {N + 1}")
    # No row follows the end: what the terminal terms add to the costate goes to psi itself.
    last = found | state_pointers(writer, found, index) | {"jump": found["psi"]}
    last |= {"time": writer.at(found["bounds"], N + 1), "moves": found["units"]}
    last |= {"origin": found["nodes"], "signal": found["signals"]}  # no terminal constraint takes an input
    if writer.library.terminal:
        writer.call("end", NODE, last)
    if writer.library.terminal_constraints:
        writer.call("end_constraint", CONSTRAINT, last | constraint_pointers(writer, found, str(writer.rows["end"])))
    writer.line("br label %done")
    writer.label("backward")
    if writer.order > Order.COST:
        writer.line(f"%segment_back = sub i64 {2 * N + K + 2}, %now")
        writer.line("%is_back = icmp sge i64 %segment_back, 0")
        writer.line("br i1 %is_back, label %back, label %start_back")
        writer.label("back")
        writer.line(f"%returned = call i1 @backward_any({TABLE}, i64 %segment_back, ptr %progress)")
        writer.line("br i1 %returned, label %done, label %pause")
        writer.label("start_back")
        writer.call("start_back", START_BACK, found | {"jump": found["jumps"]})
    writer.line("store i64 -1, ptr %progress")
    writer.line("ret void")
    writer.label("done")
    writer.line("%following = add i64 %now, 1")
    writer.line("br label %phase")
    writer.label("pause")
    writer.line("store i64 %now, ptr %progress")
    given = "".join(f", i64 {count}" for count in counts)
    return writer.end_function(f"void @evaluate({TABLE}, ptr %progress{given})")


def write_costs(writer: Writer) -> str:
    """Write the loop over schedules that evaluates J of each; it returns how many it has done.

    `places` has for each the arrays of `list_place_lengths`, one after the other, and `bounds` and `first_cell` are as
    in `workspace.GIVEN`; J and the finiteness check of each come to `found`.
    """
    N, K = writer.sizes.N, len(writer.library.measurements)
    lengths = list_place_lengths(N)
    pointers = writer.pointers()
    size = sum(lengths.values())
    writer.line("%own = alloca [3 x i64]")
    writer.line("br label %loop")
    writer.label("loop")
    writer.line("%k = phi i64 [0, %entry], [%more, %loop]")
    writer.line(f"%budget = phi i64 [{BUDGET}, %entry], [%left, %loop]")
    place = writer.at("%places", "%k", size)
    for name, length in lengths.items():
        copy(writer, pointers[name], place, length)
        place = writer.at(place, length)
    for name in ("bounds", "first_cell"):
        copy(writer, pointers[name], writer.at(f"%{name}", "%k", N + 2), N + 2)
    parts = sums(writer.library, writer.sizes)
    # The sums are one block of memory, so that one call clears all of them.
    zero(writer, pointers[next(iter(parts))], str(sum(parts.values())))
    for name, extent in memory(writer.library, writer.sizes, writer.order).items():
        if name in ZEROED and extent.fixed:
            zero(writer, pointers[name], str(extent.fixed))
    writer.line(f"store [3 x i64] [i64 0, i64 0, i64 {UNLIMITED}], ptr %own")
    counts = "".join(f", i64 %count_{k}" for k in range(K))
    writer.line(f"call void @evaluate({TABLE}, ptr %own{counts})")
    for k, name in enumerate(("J", CHECKED)):
        value = writer.load("double", pointers[name])
        writer.line(f"store double {value}, ptr {writer.at(writer.at('%found', '%k', 2), k)}")
    # Work of this schedule, by what is left of a budget that no evaluation spends.
    left = writer.load("i64", writer.at("%own", 2))
    writer.line(f"%left = sub i64 %budget, {writer.let(f'sub i64 {UNLIMITED}, {left}')}")
    writer.line("%more = add i64 %k, 1")
    writer.line("%inside = icmp slt i64 %more, %count")
    writer.line("%affords = icmp sgt i64 %left, 0")
    writer.line("%goes_on = and i1 %inside, %affords")
    writer.line("br i1 %goes_on, label %loop, label %out")
    writer.label("out")
    writer.line("store i64 %more, ptr %done")
    given = "ptr %done, i64 %count, ptr %places, ptr %bounds, ptr %first_cell, ptr %found"
    of_samples = "".join(f", i64 %count_{k}" for k in range(K))
    return writer.end_function(f"void @all_costs({TABLE}, {given}{of_samples})")


def write_loop(writer: Writer, name: str, order: tuple[str, ...]) -> str:
    """Write the calls of a straight-line function at `count` points, from one to the next its pointers advance by
    given numbers of bytes.
    """
    with writer.loop("0", "%count") as k:
        steps = {key: writer.let(f"mul i64 {k}, %{key}_step") for key in order}
        given = {key: writer.let(f"getelementptr i8, ptr %{key}, i64 {step}") for key, step in steps.items()}
        writer.call(name, order, given)
    pointers = "".join(f", ptr %{key}, i64 %{key}_step" for key in order)
    return writer.end_function(f"void @each_{name}(i64 %count{pointers})")


def write_slope_in_cell(writer: Writer, mode: int) -> str:
    """Write the slope of one mode at any time, with the signals of the cell that holds it."""
    writer.line("%moment = alloca [2 x double]")
    found = writer.pointers()
    signal = _store_moment(writer, found, "%time", "%moment", "entry")
    given = found | {"moment": "%moment", "signal": signal, "y": "%y", "K": "%K"}
    writer.call(f"slope_{mode}", SLOPE, given)
    signature = f"void @slope_at_{mode}({TABLE}, i64 %cells, ptr %state, double %time, ptr %y, ptr %K)"
    return writer.end_function(signature)


def _store_moment(writer: Writer, found: dict[str, str], time: str, moment: str, block: str, name: str = "") -> str:
    """Store a time, and the first node of the cell that holds it, clipped to [low, high]; return the signals there.

    `block` is the label of the current block; that of the last one is ``found{name}``, if there are signals.
    """
    S, at = writer.sizes.signals, Adaptive()
    writer.line(f"store double {time}, ptr {moment}")
    if not S:
        return found["signals"]
    low, high = (writer.load("double", writer.at("%state", k)) for k in (at.low, at.high))
    # At the ends of a stretch an input may jump: the time is kept inside [low, high], so that the cell is one of the
    # stretch.
    above = writer.let(f"fcmp olt double {time}, {low}")
    later = writer.let(f"select i1 {above}, double {low}, double {time}")
    below = writer.let(f"fcmp ogt double {later}, {high}")
    inside = writer.let(f"select i1 {below}, double {high}, double {later}")
    left, right = f"%left{name}", f"%right{name}"
    writer.line(f"br label %search{name}")
    writer.label(f"search{name}")  # nodes[left] <= time; time < nodes[right], or right is the last node
    writer.line(f"{left} = phi i64 [0, %{block}], [{left}_next, %halve{name}]")
    writer.line(f"{right} = phi i64 [%cells, %{block}], [{right}_next, %halve{name}]")
    width = writer.let(f"sub i64 {right}, {left}")
    many = writer.let(f"icmp sgt i64 {width}, 1")
    writer.line(f"br i1 {many}, label %halve{name}, label %found{name}")
    writer.label(f"halve{name}")
    middle = writer.let(f"lshr i64 {writer.let(f'add i64 {left}, {right}')}, 1")
    node = writer.load("double", writer.at(found["nodes"], middle))
    before = writer.let(f"fcmp ole double {node}, {inside}")
    writer.line(f"{left}_next = select i1 {before}, i64 {middle}, i64 {left}")
    writer.line(f"{right}_next = select i1 {before}, i64 {right}, i64 {middle}")
    writer.line(f"br label %search{name}")
    writer.label(f"found{name}")
    origin = writer.load("double", writer.at(found["nodes"], left))
    writer.line(f"store double {origin}, ptr {writer.at(moment, 1)}")
    return writer.at(found["signals"], left, 4 * S)


def write_adaptive_solve(writer: Writer, mode: int) -> str:
    """Write the loop over adaptive steps in one mode; it stores the times of accepted steps.

    It ends at the end time, after `most` accepted steps, when the solver is stuck, or when the budget is spent.
    Rejected steps count for the budget too.
    """
    size, at, is_implicit = writer.sizes.n + 1, Adaptive(), writer.library.implicit[mode]
    functions = step_functions()
    if is_implicit:
        found = writer.pointers()
        for name, length in (("moments", 2 * len(IMPLICIT_TIMES)), ("increments", len(STIFF.b) * size), ("newton", 2)):
            writer.line(f"%{name} = alloca [{length} x double]")
        work = USUAL_ITERATIONS * writer.module.work(f"newton_adaptive_{mode}")
        work += writer.module.work(f"adaptive_implicit_{mode}")
    else:
        writer.line(f"%argument = alloca [{size} x double]")
        writer.line(f"%K = alloca [{len(STAGE_TIMES) * size} x double]")
        work = len(STAGE_TIMES) * writer.module.work(f"slope_{mode}") + sum(map(writer.module.work, functions))
    writer.line("br label %loop")
    writer.label("loop")
    writer.line("%done = phi i64 [0, %entry], [%more, %next]")
    writer.line("%tried = phi i64 [0, %entry], [%tries, %next]")
    t, end, stuck = (writer.load("double", writer.at("%state", k)) for k in (at.t, at.end, at.stuck))
    # Go on while t < end, not stuck, room for accepted times, and tries within the budget.
    flags = [writer.let(f"fcmp olt double {t}, {end}"), writer.let(f"fcmp oeq double {stuck}, 0.0")]
    flags.append(writer.let("icmp slt i64 %done, %most"))
    flags.append(writer.let(f"icmp slt i64 %tried, {max(1, BUDGET // work)}"))
    goes_on = flags[0]
    for flag in flags[1:]:
        goes_on = writer.let(f"and i1 {goes_on}, {flag}")
    writer.line(f"br i1 {goes_on}, label %try, label %out")
    writer.label("try")
    step = writer.load("double", writer.at("%state", at.step))
    # Slopes at t + c h, one after the other; between two of them a function makes the next state.
    times = [
        writer.let(f"fadd double {t}, {writer.let(f'fmul double {step}, {literal(c)}')}")
        for c in (IMPLICIT_TIMES if is_implicit else STAGE_TIMES)
    ]
    if is_implicit:
        _call_implicit_step(writer, found, mode, times)
    else:
        for j, (time, function) in enumerate(zip(times, functions, strict=True)):
            at_state = f"double {time}, ptr {'%argument' if j else '%y'}, ptr {writer.at('%K', j * size)}"
            writer.line(f"call void @slope_at_{mode}({TABLE}, i64 %cells, ptr %state, {at_state})")
            writer.call(function, STEP, {name: f"%{name}" for name in STEP})
    refused = writer.load("double", writer.at("%state", at.refused))
    accepted = writer.let(f"fcmp oeq double {refused}, 0.0")
    writer.line(f"br i1 {accepted}, label %keep, label %next")
    writer.label("keep")
    reached = writer.load("double", writer.at("%state", at.t))
    row = writer.at("%rows", "%done", 1 + size)
    writer.line(f"store double {reached}, ptr {row}")
    copy(writer, writer.at(row, 1), "%y", size)
    writer.line("br label %next")
    writer.label("next")
    writer.line(f"%more = add i64 %done, {writer.let(f'zext i1 {accepted} to i64')}")
    writer.line("%tries = add i64 %tried, 1")
    writer.line("br label %loop")
    writer.label("out")
    writer.line("store i64 %done, ptr %count")
    return writer.end_function(
        f"void @adaptive_{mode}_steps({TABLE}, i64 %cells, ptr %state, ptr %y, ptr %rows, i64 %most, ptr %count)"
    )


def _call_implicit_step(writer: Writer, found: dict[str, str], mode: int, times: list[str]) -> None:
    """Emit an implicit step: its times and the signals there, Newton's iterations, the error control."""
    given, block = found | {name: f"%{name}" for name in ("moments", "state", "y", "increments", "newton")}, "try"
    for j, time in enumerate(times):
        given[f"signal_{j}"] = _store_moment(writer, found, time, writer.at("%moments", 2 * j), block, f"_{j}")
        block = f"found_{j}"
    arguments = ", ".join(f"ptr {given[name]}" for name in (*ADAPTIVE_NEWTON, "newton"))
    writer.line(f"call void @solve_newton_adaptive_{mode}({arguments})")
    writer.call(f"adaptive_implicit_{mode}", IMPLICIT_STEP, given)
