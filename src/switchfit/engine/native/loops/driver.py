"""The driver of an evaluation: the segments forward, samples and terminal terms, then the segments backward."""

from __future__ import annotations

from switchfit.engine.native.layout import ZEROED
from switchfit.engine.native.loops.segments import constraint_pointers, count_rows
from switchfit.engine.native.loops.writer import Writer
from switchfit.engine.native.sizes import Order


def write_evaluation(writer: Writer) -> str:
    """Write `evaluate`: the segments forward, the samples of each Measurements, the terminal terms, and the segments
    backward.
    """
    N = writer.sizes.N
    of_samples = "".join(f", i64 %count_{k}" for k in range(len(writer.library.measurements)))
    table, *counts = writer.begin(f"void @evaluate(ptr %table{of_samples})")
    found, layout = writer.pointers(), writer.layout
    rows = count_rows(writer, found)
    # Nothing is left of the evaluation before: first all sums, then the parts that rows only add to.
    # The sums are one block of memory, so that one call clears all of them.
    writer.zero(found[next(iter(layout.sums))], sum(layout.sums.values()))
    for name in ZEROED:
        fixed, each_row = layout.memory[name]
        writer.zero(found[name], rows * each_row + fixed)
    # x(t0) and its tangents become state 0, as if a reset map at t0 had made them.
    writer.call("start", found | writer.at_row(found, 0, "x", "Z", suffix="_after"))
    # Forward through all segments: states, tangents Z, running costs, and the functions at transitions.
    with writer.loop(0, N + 1) as segment:
        writer.invoke("forward", table, segment)
    # Samples need states and tangents alone. What they add to the costate waits in `jump` at the end of their row.
    for k, count in enumerate(counts):
        writer.invoke(f"samples_{k}", table, count)
    # No row follows the end: what the terminal terms add to the costate goes to psi itself.
    library, given = writer.library, found | writer.at_row(found, rows, "x", "Z") | {"jump": found["psi"]}
    given |= constraint_pointers(writer, found, layout.constraint_rows["end"])
    for name in ["end"] * bool(library.terminal) + ["end_constraint"] * bool(library.terminal_constraints):
        writer.call(name, given)
    if writer.order > Order.COST:
        # Behind the modes: -2 where J, the constraints and their derivatives are all that is asked for.
        with writer.when(writer.get("i64", found["modes"], N + 1) > -2):
            # psi at the start of a segment is psi(tau-) of the one before: the last segment comes first.
            with writer.loop(0, N + 1) as turn:
                writer.invoke("backward", table, N - turn)
            writer.call("start_back", found)
    return writer.end()
