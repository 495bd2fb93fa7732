"""Loops over the samples of each Measurements; late ones end a row of their own."""

from __future__ import annotations

from collections.abc import Sequence

from switchfit.engine.native.kernels import CurvatureFunction
from switchfit.engine.native.llvm.lines import Value
from switchfit.engine.native.loops.segments import (
    OF_STAGES,
    add_curvature,
    choose_state,
    count_rows,
    find_reset,
    start_row,
)
from switchfit.engine.native.loops.writer import Pointers, Writer
from switchfit.engine.native.sizes import Order


def write_samples(writer: Writer, k: int) -> str:
    """Write the loop over the samples of the k-th Measurements, which are at the ends of rows."""
    _, count = writer.begin(f"void @samples_{k}(ptr %table, i64 %count)")
    found = writer.pointers()
    # The state at the end of a cell is that of the last row inside it: cell + (segments begun in it or before) + 1.
    begins = [writer.get("i64", found["first_cell"], i) for i in range(1, writer.sizes.N + 1)]
    with writer.loop(0, count) as sample:
        cell = writer.get("i64", found[f"cell {k}"], sample)
        index = sum(((cell >= begin).to("i64") for begin in begins), cell + 1)
        given = found | writer.at_row(found, index, "x", "Z", "jump") | writer.at_sample(found, k, sample)
        # Samples at nodes have known times: `moves` is the row of zeros.
        writer.call(f"sample_{k}", given | {"moves": found["units"]})
    return writer.end()


def _write_late_row(writer: Writer, k: int, found: Pointers, sample: Value) -> tuple[Pointers, Value]:
    """Write the forward step of a late sample's row, which is behind all others in memory; return pointers and its
    mode.
    """
    cell, segment = (writer.get("i64", found[f"{name} {k}"], sample) for name in ("cell", "segment"))
    row, place, last = cell + segment, start_row(writer, found, segment, cell), count_rows(writer, found)
    times = writer.allocate("double", 3)
    for entry, name in ((0, "start"), (2, "origin")):
        writer.put(place[name], times, entry)
    state = writer.at_row(found, row, "x", "Z")
    if writer.library.reset_maps:
        state = choose_state(*find_reset(writer, found, segment, place["begins"]), state)
    psi = writer.allocate("double", writer.sizes.n)
    given = found | place | state | writer.at_sample(found, k, sample) | writer.at_row(found, last, *OF_STAGES)
    given |= writer.at_row(found, last + 1, "x", "Z", suffix="_after") | writer.at_row(found, row, "late")
    given |= {"row": times, "closes": writer.allocate("double", writer.sizes.width), "psi": psi, "jump": psi}
    given["J"] = writer.allocate("double")
    writer.call(f"late_time_{k}", given)
    mode = writer.get("i64", found["modes"], segment)
    for m in writer.cases(mode, len(writer.library.modes)):
        writer.take_step(m, "forward_late", given)
    return given, mode


def write_late_samples(writer: Writer, k: int, curvatures: Sequence[dict[str, CurvatureFunction]]) -> str:
    """Write the loop over the late samples of the k-th Measurements; each ends a row of its own.

    `curvatures` have for each mode what adds the second derivatives of such a row to H.
    """
    _, count = writer.begin(f"void @samples_{k}(ptr %table, i64 %count)")
    found = writer.pointers()
    with writer.loop(0, count) as sample:
        given, mode = _write_late_row(writer, k, found, sample)
        seen = writer.at(found[f"seen {k}"], sample, 1 + writer.sizes.n)
        time = writer.at(given["row"], 1)
        writer.copy(seen, time, 1)
        writer.copy(writer.at(seen, 1), given["x_after"], writer.sizes.n)
        # A late sample is forward and backward at once, as nothing follows it: psi = D_x l at its end, and what is left
        # at its start is added to `late`, where it waits for the backward step of the row around it.
        at_end = {"x": given["x_after"], "Z": given["Z_after"], "J": found["J"], "time": time, "moves": given["closes"]}
        writer.zero(given["psi"], writer.sizes.n)
        writer.call(f"sample_{k}", given | at_end)
        if writer.order > Order.COST:
            for m in writer.cases(mode, len(writer.library.modes)):
                writer.call(f"backward_late_{m}", given)
                add_curvature(writer, curvatures[m]["late"], given, moving=True)
    return writer.end()
