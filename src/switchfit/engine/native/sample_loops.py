"""Loops over samples in hand-written LLVM IR: samples at nodes, and late samples, which lie between nodes."""

from __future__ import annotations

from collections.abc import Sequence

from switchfit.engine.native.kernels import BACKWARD, END_OF_LATE, FORWARD, LATE_TIME, SAMPLE, Curvature
from switchfit.engine.native.segments import (
    add_curvature,
    choose_state,
    find_reset,
    solve_stages,
    start_row,
    state_pointers,
)
from switchfit.engine.native.templates import Order
from switchfit.engine.native.writer import TABLE, Writer, copy


def write_samples(writer: Writer, k: int) -> str:
    """Write the loop over the samples of the k-th Measurements, which are at the ends of rows."""
    n, N = writer.sizes.n, writer.sizes.N
    found, own = writer.pointers(), writer.samples_of(k)
    # The state at the end of a cell is that of the last row inside it: cell + (segments begun in it or before) + 1.
    begins = [writer.load("i64", writer.at(found["first_cell"], i)) for i in range(1, N + 1)]
    with writer.turns("%count") as sample:
        cell = writer.load("i64", writer.at(own["cell"], sample))
        index = writer.let(f"add i64 {cell}, 1")
        for begin in begins:
            beyond = writer.let(f"icmp sge i64 {cell}, {begin}")
            index = writer.let(f"add i64 {index}, {writer.let(f'zext i1 {beyond} to i64')}")
        given = found | state_pointers(writer, found, index) | _sample_pointers(writer, k, own, sample)
        # Samples at nodes have known times: `moves` is the row of zeros.
        given |= {"moves": found["units"], "time": writer.at(own["time"], sample)}
        given["jump"] = writer.at(found["jumps"], index, n) if writer.order else found["jumps"]
        writer.call(f"sample_{k}", SAMPLE, given)
    return writer.end_function(f"i1 @samples_{k}({TABLE}, i64 %count, ptr %progress)", returns=False)


def _sample_pointers(writer: Writer, k: int, own: dict[str, str], sample: str) -> dict[str, str]:
    q = writer.library.measurements[k].channels
    return {name: writer.at(own[name], sample, q) for name in ("value", "weight")}


def _write_late_row(
    writer: Writer, k: int, found: dict[str, str], own: dict[str, str], sample: str
) -> tuple[str, dict[str, str], str]:
    """Write the forward step of a late sample's row; return the index of the row around it, pointers, its mode."""
    cell, segment = (writer.load("i64", writer.at(own[name], sample)) for name in ("cell", "segment"))
    row, place = writer.let(f"add i64 {cell}, {segment}"), start_row(writer, found, segment, cell)
    for entry, name in ((0, "start"), (2, "origin")):
        writer.line(f"store double {place[name]}, ptr {writer.at(found['late_row'], entry)}")
    given = found | state_pointers(writer, found, row)
    if writer.library.reset_maps:
        given |= choose_state(writer, *find_reset(writer, found, segment, place["opens"]), given)
    given |= {
        "time": writer.at(own["time"], sample),
        "row": found["late_row"],
        "closes": found["late_closes"],
        "opens": place["opening"],
        "signal": place["signal"],
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
    writer.call(f"late_time_{k}", LATE_TIME, given)
    mode = writer.load("i64", writer.at(found["modes"], segment))
    for m in writer.cases(mode, len(writer.library.modes), "forward"):
        solve_stages(writer, m, given)
        writer.call(f"forward_late_{m}", FORWARD, given)
    return row, given, mode


def write_late_samples(writer: Writer, k: int, curvatures: Sequence[dict[str, Curvature]]) -> str:
    """Write the loop over the late samples of the k-th Measurements; each ends a row of its own.

    `curvatures` have for each mode what adds the second derivatives of such a row to H.
    """
    n, found, own = writer.sizes.n, writer.pointers(), writer.samples_of(k)
    with writer.turns("%count") as sample:
        row, given, mode = _write_late_row(writer, k, found, own, sample)
        # A late sample is forward and backward at once, as nothing follows it: psi = D_x l at its end, and what is left
        # at its start waits in `late` for the backward step of the row around it.
        at_end = {"x": found["late_state"], "Z": found["late_tangent"], "J": found["J"]}
        at_end |= {"time": writer.at(found["late_row"], 1), "moves": found["late_closes"]}
        for entry in range(n):
            writer.line(f"store double 0.0, ptr {writer.at(found['late_psi'], entry)}")
        writer.call(f"sample_{k}", SAMPLE, given | at_end | _sample_pointers(writer, k, own, sample))
        if writer.order > Order.COST:
            for m in writer.cases(mode, len(writer.library.modes), "backward"):
                writer.call(f"backward_late_{m}", BACKWARD, given)
                add_curvature(writer, curvatures[m]["late"], given, moving=True)
            writer.call("end_of_late", END_OF_LATE, given | {"late": writer.at(found["late"], row, n)})
    return writer.end_function(f"i1 @samples_{k}({TABLE}, i64 %count, ptr %progress)", returns=False)


def write_late_states(writer: Writer, k: int) -> str:
    """Write a loop that stores the times at which late samples saw the state, and these states."""
    n, found, own = writer.sizes.n, writer.pointers(), writer.samples_of(k)
    with writer.loop("0", "%count") as sample:
        _write_late_row(writer, k, found, own, sample)
        copy(writer, writer.at("%times", sample), writer.at(found["late_row"], 1), 1)
        copy(writer, writer.at("%states", sample, n), found["late_state"], n)
    return writer.end_function(f"void @late_states_{k}({TABLE}, i64 %count, ptr %times, ptr %states)")
