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
from switchfit.engine.native.adaptive import TIMES, Adaptive
from switchfit.engine.native.lines import Value, Variable
from switchfit.engine.native.llvm import BUDGET
from switchfit.engine.native.scalars import CHECKED
from switchfit.engine.native.segments import USUAL_ITERATIONS, constraint_pointers, solve_stages, state_pointers
from switchfit.engine.native.templates import Order
from switchfit.engine.native.workspace import ZEROED, list_place_lengths, memory, sums
from switchfit.engine.native.writer import Pointers, Writer

UNLIMITED = 2**63 - 1
"""A budget that no evaluation spends."""


def write_evaluation(writer: Writer) -> str:
    """Write `evaluate`, which runs all phases in order; the loops among them return whether they are finished.

    The phases are the segments forward, the samples of each Measurements, the terminal terms, and the segments
    backward.
    """
    N, K = writer.sizes.N, len(writer.library.measurements)
    of_samples = "".join(f", i64 %count_{k}" for k in range(K))
    table, progress, *counts = writer.begin(f"void @evaluate(ptr %table, ptr %progress{of_samples})")
    found = writer.pointers()
    # Phases: 0 start, 1 .. N + 1 segments forward, then K samples, the end, segments N .. 0 backward, the start
    # backward. A phase that runs out of budget stores its number and returns: the next call goes on there, and Python
    # can see Ctrl-C.
    backward = N + K + 3
    with writer.repeat():
        phase = writer.load("i64", progress)
        is_done = Variable(writer, "i1", True)
        with writer.when(phase.equals(0)):
            first = state_pointers(writer, found, 0)
            writer.call("start", found | {f"{name}_after": pointer for name, pointer in first.items()})
        with writer.when((phase > 0) & (phase <= N + 1)):
            is_done.value = writer.invoke("forward_any", table, phase - 1, progress, returns="i1")
        for k, count in enumerate(counts, start=N + 2):
            with writer.when(phase.equals(k)):
                is_done.value = writer.invoke(f"samples_{k - N - 2}", table, count, progress, returns="i1")
        with writer.when(phase.equals(backward - 1)):
            _call_end(writer, found)
        if writer.order > Order.COST:
            with writer.when((phase >= backward) & (phase <= backward + N)):
                is_done.value = writer.invoke("backward_any", table, backward + N - phase, progress, returns="i1")
            with writer.when(phase > backward + N):
                writer.call("start_back", found | {"jump": found["jumps"]})
        with writer.when(is_done.value.equals(False)):
            writer.line("ret void")
        last = phase >= (backward + N + 1 if writer.order > Order.COST else backward - 1)
        writer.store(last.choose(-1, phase + 1), progress)
        with writer.when(last):
            writer.line("ret void")
    return writer.end()


def _call_end(writer: Writer, found: Pointers) -> None:
    """Call the terminal cost and constraints."""
    N, library = writer.sizes.N, writer.library
    last = state_pointers(writer, found, writer.get("i64", found["first_cell"], N + 1) + (N + 1))
    # No row follows the end: what the terminal terms add to the costate goes to psi itself.
    given = found | last | {"jump": found["psi"]} | constraint_pointers(writer, found, writer.rows["end"])
    for name in ["end"] * bool(library.terminal) + ["end_constraint"] * bool(library.terminal_constraints):
        writer.call(name, given)


def write_costs(writer: Writer) -> str:
    """Write the loop over schedules that evaluates J of each; it returns how many it has done.

    `places` has for each the arrays of `list_place_lengths`, one after the other, and `bounds` and `first_cell` are as
    in `workspace.GIVEN`; J and the finiteness check of each come to `found`.
    """
    N, lengths = writer.sizes.N, list_place_lengths(writer.sizes.N)
    given = "ptr %done, i64 %count, ptr %places, ptr %bounds, ptr %first_cell, ptr %found"
    of_samples = "".join(f", i64 %count_{k}" for k in range(len(writer.library.measurements)))
    signature = f"void @all_costs(ptr %table, {given}{of_samples})"
    table, done, count, places, bounds, first_cell, results, *counts = writer.begin(signature)
    pointers, progress = writer.pointers(), writer.allocate("i64", 3)
    k, budget = Variable(writer, "i64", 0), Variable(writer, "i64", BUDGET)
    with writer.repeat() as leave:
        which = k.value
        place = writer.at(places, which, sum(lengths.values()))
        for name, length in lengths.items():
            writer.copy(pointers[name], place, length)
            place = writer.at(place, length)
        for name, source in (("bounds", bounds), ("first_cell", first_cell)):
            writer.copy(pointers[name], writer.at(source, which, N + 2), N + 2)
        parts = sums(writer.library, writer.sizes)
        # The sums are one block of memory, so that one call clears all of them.
        writer.zero(pointers[next(iter(parts))], sum(parts.values()))
        for name, extent in memory(writer.library, writer.sizes, writer.order).items():
            if name in ZEROED and extent.fixed:
                writer.zero(pointers[name], extent.fixed)
        writer.store(f"[i64 0, i64 0, i64 {UNLIMITED}]", progress, "[3 x i64]")
        writer.invoke("evaluate", table, progress, *counts)
        for entry, name in enumerate(("J", CHECKED)):
            writer.put(writer.load("double", pointers[name]), writer.at(results, which, 2), entry)
        # Work of this schedule, by what is left of a budget that no evaluation spends.
        budget.value = budget.value - (UNLIMITED - writer.get("i64", progress, 2))
        k.value = which + 1
        leave((k.value >= count) | (budget.value <= 0))
    writer.store(k.value, done)
    return writer.end()


def write_loop(writer: Writer, name: str) -> str:
    """Write the calls of a straight-line function at `count` points, from one to the next its pointers advance by
    given numbers of bytes.
    """
    keys = writer.module.pointers[name]
    pointers = "".join(f", ptr %{key}, i64 %{key}_step" for key in keys)
    count, *given = writer.begin(f"void @each_{name}(i64 %count{pointers})")
    with writer.loop(0, count) as k:
        each = zip(keys, given[::2], given[1::2], strict=True)
        writer.call(name, {key: writer.into(pointer, k * step) for key, pointer, step in each})
    return writer.end()


def _store_moment(writer: Writer, found: Pointers, cells: Value, time: Value, moment: Value) -> Value:
    """Store a time, and the first node of the cell that holds it, clipped to [low, high]; return the signals there."""
    S, at = writer.sizes.signals, Adaptive()
    writer.store(time, moment)
    if not S:
        return found["signals"]
    low, high = (writer.get("double", found["state"], k) for k in (at.low, at.high))
    # At the ends of a stretch an input may jump: the time is kept inside [low, high], so that the cell is one of the
    # stretch.
    later = (time < low).choose(low, time)
    inside = (later > high).choose(high, later)
    left, right = Variable(writer, "i64", 0), Variable(writer, "i64", cells)
    with writer.repeat() as leave:  # nodes[left] <= time; time < nodes[right], or right is the last node
        one, other = left.value, right.value
        leave(other - one <= 1)
        middle = (one + other) >> 1
        is_before = writer.get("double", found["nodes"], middle) <= inside
        left.value, right.value = is_before.choose(middle, one), is_before.choose(other, middle)
    writer.put(writer.get("double", found["nodes"], left.value), moment, 1)
    return writer.at(found["signals"], left.value, 4 * S)


def write_adaptive_solve(writer: Writer, mode: int) -> str:
    """Write the loop over adaptive steps in one mode; it stores the times of accepted steps.

    It ends at the end time, after `most` accepted steps, when the solver is stuck, or when the budget is spent.
    Rejected steps count for the budget too.
    """
    n, at, module, is_implicit = writer.sizes.n, Adaptive(), writer.module, writer.library.implicit[mode]
    given = "i64 %cells, ptr %state, ptr %y, ptr %rows, i64 %most, ptr %count"
    _, cells, state, y, rows, most, count = writer.begin(f"void @adaptive_{mode}_steps(ptr %table, {given})")
    effort = module.work(f"step_{mode}")
    effort += USUAL_ITERATIONS * module.work(f"newton_step_{mode}") if is_implicit else 0
    found, tried = writer.pointers() | {"state": state, "y": y}, Variable(writer, "i64", 0)
    lengths = {"increments": len(STIFF.b) * n, "newton": 2}
    found |= {name: writer.allocate("double", length) for name, length in lengths.items()}
    found["J"] = found["newton"]  # NaN if the iterations do not converge, as the increments are
    writer.store(0, count, "i64")
    with writer.repeat() as leave:
        t, end, stuck, step = (writer.get("double", state, k) for k in (at.t, at.end, at.stuck, at.step))
        # Go on while t < end, not stuck, room for accepted times, and tries within the budget.
        goes_on = (t < end) & stuck.equals(0.0) & (writer.load("i64", count) < most)
        leave((goes_on & (tried.value < max(1, BUDGET // effort))).equals(False))
        tried.value = tried.value + 1
        for j, c in enumerate(TIMES[is_implicit]):
            found[f"moment{j}"] = writer.allocate("double", 2)
            found[f"signal{j}"] = _store_moment(writer, found, cells, t + step * c, found[f"moment{j}"])
        if is_implicit:
            solve_stages(writer, f"newton_step_{mode}", found)
        writer.call(f"step_{mode}", found)
        with writer.when(writer.get("double", state, at.refused).equals(0.0)):
            accepted = writer.load("i64", count)
            row = writer.at(rows, accepted, 2 + n)
            writer.store(writer.get("double", state, at.t), row)
            writer.copy(writer.at(row, 1), y, 1 + n)
            writer.store(accepted + 1, count)
    return writer.end()
