"""Loops over samples in hand-written LLVM IR: samples at nodes, and late samples, which lie between nodes."""

from __future__ import annotations

from collections.abc import Sequence

from switchfit.engine.native.kernels import Curvature
from switchfit.engine.native.lines import Value
from switchfit.engine.native.segments import (
    add_curvature,
    choose_state,
    find_reset,
    solve_stages,
    start_row,
    state_pointers,
)
from switchfit.engine.native.templates import Order
from switchfit.engine.native.writer import Pointers, Writer


def write_samples(writer: Writer, k: int) -> str:
    """Write the loop over the samples of the k-th Measurements, which are at the ends of rows."""
    _, count, _ = writer.begin(f"i1 @samples_{k}(ptr %table, i64 %count, ptr %progress)")
    found, own = writer.pointers(), writer.samples_of(k)
    # The state at the end of a cell is that of the last row inside it: cell + (segments begun in it or before) + 1.
    begins = [writer.get("i64", found["first_cell"], i) for i in range(1, writer.sizes.N + 1)]
    with writer.turns(count) as sample:
        cell = writer.get("i64", own["cell"], sample)
        index = sum(((cell >= begin).to("i64") for begin in begins), cell + 1)
        given = found | state_pointers(writer, found, index) | _sample_pointers(writer, k, own, sample)
        # Samples at nodes have known times: `moves` is the row of zeros.
        given |= {"moves": found["units"], "jump": writer.at(found["jumps"], index, writer.sizes.n)}
        writer.call(f"sample_{k}", given)
    return writer.end()


def _sample_pointers(writer: Writer, k: int, own: Pointers, sample: Value) -> Pointers:
    lengths = {"time": 1} | dict.fromkeys(("value", "weight"), writer.library.measurements[k].channels)
    return {name: writer.at(own[name], sample, length) for name, length in lengths.items()}


def _write_late_row(writer: Writer, k: int, found: Pointers, own: Pointers, sample: Value) -> tuple[Pointers, Value]:
    """Write the forward step of a late sample's row; return pointers and the mode of the row."""
    cell, segment = (writer.get("i64", own[name], sample) for name in ("cell", "segment"))
    row, place = cell + segment, start_row(writer, found, segment, cell)
    for entry, name in ((0, "start"), (2, "origin")):
        writer.put(place[name], found["late_row"], entry)
    state = state_pointers(writer, found, row)
    if writer.library.reset_maps:
        state = choose_state(*find_reset(writer, found, segment, place["begins"]), state)
    given = found | place | state | _sample_pointers(writer, k, own, sample)
    given |= {
        "row": found["late_row"],
        "closes": found["late_closes"],
        "X": found["late_stages"],
        "XZ": found["late_stage_tangents"],
        "kept": found["late_kept"],
        "x_after": found["late_state"],
        "Z_after": found["late_tangent"],
        "psi": found["late_psi"],
        "jump": found["late_psi"],
        "late": writer.at(found["late"], row, writer.sizes.n),
        "J": found["late_J"],
    }
    writer.call(f"late_time_{k}", given)
    mode = writer.get("i64", found["modes"], segment)
    for m in writer.cases(mode, len(writer.library.modes)):
        if writer.library.implicit[m]:
            solve_stages(writer, f"newton_{m}", given)
        writer.call(f"forward_late_{m}", given)
    return given, mode


def write_late_samples(writer: Writer, k: int, curvatures: Sequence[dict[str, Curvature]]) -> str:
    """Write the loop over the late samples of the k-th Measurements; each ends a row of its own.

    `curvatures` have for each mode what adds the second derivatives of such a row to H.
    """
    _, count, _ = writer.begin(f"i1 @samples_{k}(ptr %table, i64 %count, ptr %progress)")
    found, own = writer.pointers(), writer.samples_of(k)
    with writer.turns(count) as sample:
        given, mode = _write_late_row(writer, k, found, own, sample)
        # A late sample is forward and backward at once, as nothing follows it: psi = D_x l at its end, and what is left
        # at its start waits in `late` for the backward step of the row around it.
        at_end = {"x": found["late_state"], "Z": found["late_tangent"], "J": found["J"]}
        at_end |= {"time": writer.at(found["late_row"], 1), "moves": found["late_closes"]}
        writer.zero(found["late_psi"], writer.sizes.n)
        writer.call(f"sample_{k}", given | at_end)
        if writer.order > Order.COST:
            for m in writer.cases(mode, len(writer.library.modes)):
                writer.call(f"backward_late_{m}", given)
                add_curvature(writer, curvatures[m]["late"], given, moving=True)
            writer.call("end_of_late", given)
    return writer.end()


def write_late_states(writer: Writer, k: int) -> str:
    """Write a loop that stores the times at which late samples saw the state, and these states."""
    signature = f"void @late_states_{k}(ptr %table, i64 %count, ptr %times, ptr %states)"
    _, count, times, states = writer.begin(signature)
    n, found, own = writer.sizes.n, writer.pointers(), writer.samples_of(k)
    with writer.loop(0, count) as sample:
        _write_late_row(writer, k, found, own, sample)
        writer.copy(writer.at(times, sample), writer.at(found["late_row"], 1), 1)
        writer.copy(writer.at(states, sample, n), found["late_state"], n)
    return writer.end()
