"""Loops over samples in hand-written LLVM IR: samples at nodes, and late samples, which lie between nodes."""

from __future__ import annotations

from switchfit.engine.native.kernels import (
    BACKWARD,
    END_OF_LATE,
    FORWARD,
    LATE_TIME,
    SAMPLE,
    Curvature,
)
from switchfit.engine.native.segments import (
    add_curvature,
    solve_stages,
    state_pointers,
)
from switchfit.engine.native.templates import Order
from switchfit.engine.native.writer import Writer

TABLE = "ptr %table"
SEGMENT = f"{TABLE}, i64 %segment, i64 %first, i64 %last, double %begins, double %finishes, ptr %progress"
WHOLE = f"{TABLE}, i64 %segment, ptr %progress"


def write_samples(writer: Writer, k: int) -> str:
    """Write the loop over the samples of the k-th Measurements, which are at the ends of rows."""
    n, N, q = writer.sizes.n, writer.sizes.N, writer.library.measurements[k].channels
    found, own = writer.pointers(), writer.samples_of(k)
    begins = [writer.load("i64", writer.at(found["first_cell"], i)) for i in range(1, N + 1)]
    before, left = writer.load_progress()
    writer.line("br label %loop")
    writer.label("loop")
    writer.line(f"%sample = phi i64 [{before}, %entry], [%more, %loop]")
    writer.line(f"%budget = phi i64 [{left}, %entry], [%left, %loop]")
    cell = writer.load("i64", writer.at(own["cell"], "%sample"))
    index = writer.let(f"add i64 {cell}, 1")
    for begin in begins:
        beyond = writer.let(f"icmp sge i64 {cell}, {begin}")
        index = writer.let(f"add i64 {index}, {writer.let(f'zext i1 {beyond} to i64')}")
    given = found | state_pointers(writer, found, index) | _sample_pointers(writer, own, q)
    given |= {"moves": found["units"], "time": writer.at(own["time"], "%sample")}
    given["jump"] = writer.at(found["jumps"], index, n) if writer.order else found["jumps"]
    _end_sample(writer, writer.call(f"sample_{k}", SAMPLE, given))
    return writer.end_function(f"i1 @samples_{k}({TABLE}, i64 %count, ptr %progress)", returns=False)


def _sample_pointers(writer: Writer, own: dict[str, str], q: int) -> dict[str, str]:
    return {"value": writer.at(own["value"], "%sample", q), "weight": writer.at(own["weight"], "%sample", q)}


def _end_sample(writer: Writer, work: int) -> None:
    writer.line(f"%left = sub i64 %budget, {work}")
    writer.line("%more = add i64 %sample, 1")
    writer.line("%done = icmp sge i64 %more, %count")
    writer.next_turn("%sample", "%done")


def _write_late_row(
    writer: Writer, k: int, found: dict[str, str], own: dict[str, str]
) -> tuple[str, dict[str, str], str, int]:
    """Write the forward step of a late sample's row; return the index of the row around it, pointers, mode, work."""
    n, S, width = writer.sizes.n, writer.sizes.signals, writer.sizes.width
    cell, segment = (writer.load("i64", writer.at(own[name], "%sample")) for name in ("cell", "segment"))
    row = writer.let(f"add i64 {cell}, {segment}")
    first = writer.let(f"icmp eq i64 {cell}, {writer.load('i64', writer.at(found['first_cell'], segment))}")
    opens = writer.let(f"and i1 {first}, {writer.let(f'icmp sgt i64 {segment}, 0')}")
    opening = writer.let(f"select i1 {opens}, i64 {segment}, i64 0")
    node = writer.load("double", writer.at(found["nodes"], cell))
    begins = writer.load("double", writer.at(found["bounds"], segment))
    start = writer.let(f"select i1 {opens}, double {begins}, double {node}")
    for place, value in ((0, start), (2, node)):
        writer.line(f"store double {value}, ptr {writer.at(found['late_row'], place)}")
    given = found | state_pointers(writer, found, row)
    if writer.library.reset_maps:
        transition = writer.let(f"sub i64 {opening}, 1")
        safe = writer.let(f"select i1 {opens}, i64 {transition}, i64 0")
        which = writer.load("i64", writer.at(found["resets"], safe))
        behind = writer.let(f"and i1 {opens}, {writer.let(f'icmp sge i64 {which}, 0')}")
        for name, after, size in (("x", "reset_states", n), ("Z", "reset_tangents", n * width)):
            jumped = writer.at(found[after], safe, size)
            given[name] = writer.let(f"select i1 {behind}, ptr {jumped}, ptr {given[name]}")
    given |= {
        "time": writer.at(own["time"], "%sample"),
        "row": found["late_row"],
        "closes": found["late_closes"],
        "opens": writer.at(found["units"], opening, width),
        "signal": writer.at(found["signals"], cell, 4 * S),
        "X": found["late_stages"],
        "XZ": found["late_stage_tangents"],
        "kept": found["late_kept"],
        "x_after": found["late_state"],
        "Z_after": found["late_tangent"],
        "psi": found["late_psi"],
        "jump": found["late_psi"],
        "costate": found["late_psi"],  # not used by rows of late samples
        "J": found["late_J"],
    }
    work = writer.call(f"late_time_{k}", LATE_TIME, given)
    mode = writer.load("i64", writer.at(found["modes"], segment))
    longest = 0
    for m, label in enumerate(writer.choose(mode, len(writer.library.modes), "forward")):
        writer.label(label)
        here = solve_stages(writer, m, given) + writer.call(f"forward_late_{m}", FORWARD, given)
        longest = max(longest, here)
        writer.line("br label %forward_end")
    writer.label("forward_end")
    return row, given, mode, work + longest


def write_late_samples(writer: Writer, k: int, curvatures: list[Curvature]) -> str:
    """Write the loop over the late samples of the k-th Measurements; each ends a row of its own.

    `curvatures` add the second derivatives of such a row to H, one for each mode.
    """
    n, q = writer.sizes.n, writer.library.measurements[k].channels
    found, own = writer.pointers(), writer.samples_of(k)
    before, left = writer.load_progress()
    writer.line("br label %loop")
    writer.label("loop")
    writer.line(f"%sample = phi i64 [{before}, %entry], [%more, %next]")
    writer.line(f"%budget = phi i64 [{left}, %entry], [%left, %next]")
    row, given, mode, work = _write_late_row(writer, k, found, own)
    at_end = {"x": found["late_state"], "Z": found["late_tangent"], "J": found["J"]} | _sample_pointers(writer, own, q)
    at_end |= {"time": writer.at(found["late_row"], 1), "moves": found["late_closes"]}
    for entry in range(n):
        writer.line(f"store double 0.0, ptr {writer.at(found['late_psi'], entry)}")
    work += writer.call(f"sample_{k}", SAMPLE, given | at_end)
    if writer.order > Order.COST:
        longest = 0
        for m, label in enumerate(writer.choose(mode, len(writer.library.modes), "backward")):
            writer.label(label)
            here = writer.call(f"backward_late_{m}", BACKWARD, given)
            if writer.order == Order.HESSIAN:
                here += add_curvature(writer, curvatures[m], given, moving=True)
            longest = max(longest, here)
            writer.line("br label %backward_end")
        writer.label("backward_end")
        work += longest
        work += writer.call("end_of_late", END_OF_LATE, given | {"late": writer.at(found["late"], row, n)})
    writer.line("br label %next")
    writer.label("next")
    _end_sample(writer, work)
    return writer.end_function(f"i1 @samples_{k}({TABLE}, i64 %count, ptr %progress)", returns=False)


def write_late_states(writer: Writer, k: int) -> str:
    """Write a loop that stores the times at which late samples saw the state, and these states."""
    n = writer.sizes.n
    found, own = writer.pointers(), writer.samples_of(k)
    writer.line("br label %loop")
    writer.label("loop")
    writer.line("%sample = phi i64 [0, %entry], [%more, %forward_end]")
    _write_late_row(writer, k, found, own)
    moment = writer.load("double", writer.at(found["late_row"], 1))
    writer.line(f"store double {moment}, ptr {writer.at('%times', '%sample')}")
    for entry in range(n):
        value = writer.load("double", writer.at(found["late_state"], entry))
        place = writer.let(f"getelementptr inbounds double, ptr {writer.at('%states', '%sample', n)}, i64 {entry}")
        writer.line(f"store double {value}, ptr {place}")
    writer.line("%more = add i64 %sample, 1")
    writer.line("%done = icmp sge i64 %more, %count")
    writer.line("br i1 %done, label %out, label %loop")
    writer.label("out")
    return writer.end_function(f"void @late_states_{k}({TABLE}, i64 %count, ptr %times, ptr %states)")
