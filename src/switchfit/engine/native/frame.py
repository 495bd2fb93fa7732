"""Handler by which XLA calls machine code; it reads the arguments and results from XLA's call frame.

Only a few fields of the frame are read. Their offsets are fixed by XLA's C interface for foreign functions
(``xla/ffi/api/c_api.h``).
"""

from __future__ import annotations

from switchfit.engine.native.workspace import GIVEN, OF_SAMPLES, ZEROED, memory, sums
from switchfit.engine.native.writer import Writer, zero

MAJOR, MINOR = 0, 1
"""Version of the interface."""

EXTENSION, ARGUMENTS, RESULTS = 8, 72, 112
"""Byte offsets in the frame of the pointers to the first extension, to the arguments and to the results."""

DATA, DIMENSIONS = 24, 40
"""Byte offsets in a buffer of its data and its dimensions."""


def write_handler(writer: Writer) -> str:
    """Return the text of the handler, which fills the table of pointers and calls `evaluate`.

    Arguments are those of `workspace.GIVEN`, then those of the samples; results are all accumulators in one array, and
    the scratch space.
    """
    library, sizes = writer.library, writer.sizes
    measurements = len(library.measurements)
    names = [*GIVEN, *(f"{name} {k}" for k in range(measurements) for name in OF_SAMPLES)]
    writer.line(f"%table = alloca [{len(writer.names) + len(OF_SAMPLES) * measurements} x i64]")
    writer.line("%progress = alloca [3 x i64]")
    extension = writer.load("ptr", writer.into("%frame", EXTENSION))
    writer.line(f"br i1 {writer.let(f'icmp eq ptr {extension}, null')}, label %run, label %asked")
    writer.label("asked")
    kind = writer.load("i32", writer.into(extension, 8))
    writer.line(f"br i1 {writer.let(f'icmp eq i32 {kind}, 1')}, label %answer, label %run")
    writer.label("answer")  # XLA queries the version of the interface
    metadata = writer.load("ptr", writer.into(extension, 24))
    for offset, value in ((24, MAJOR), (28, MINOR), (32, 0)):
        writer.line(f"store i32 {value}, ptr {writer.into(metadata, offset)}")
    writer.line("ret ptr null")
    writer.label("run")
    arguments, results = (writer.load("ptr", writer.into("%frame", place)) for place in (ARGUMENTS, RESULTS))

    def buffer(buffers: str, k: int) -> tuple[str, str]:
        """Load data and dimensions of a buffer."""
        pointer = writer.load("ptr", writer.into(buffers, 8 * k))
        data, dimensions = (writer.load("ptr", writer.into(pointer, place)) for place in (DATA, DIMENSIONS))
        return data, dimensions

    (totals, _), (between, _) = buffer(results, 0), buffer(results, 1)
    found, lengths = {}, {}
    for k, name in enumerate(names):
        found[name], dimensions = buffer(arguments, k)
        lengths[name] = writer.load("i64", dimensions)
    last = writer.load("i64", writer.at(found["first_cell"], sizes.N + 1))
    rows = writer.let(f"add i64 {last}, {sizes.N + 1}")
    position = 0
    for name, length in sums(library, sizes).items():
        found[name] = writer.at(totals, position)
        position += length
    zero(writer, totals, str(position))
    place = "0"
    for name, extent in memory(library, sizes, writer.order).items():
        found[name] = writer.at(between, place)
        growing = writer.let(f"mul i64 {rows}, {extent.each_row}")
        count = writer.let(f"add i64 {growing}, {extent.fixed}")
        if name in ZEROED:
            zero(writer, found[name], count)
        place = writer.let(f"add i64 {place}, {count}")
    for k, name in enumerate([*writer.names, *names[len(GIVEN) :]]):
        writer.line(f"store ptr {found[name]}, ptr {writer.at('%table', k)}")
    counts = "".join(f", i64 {lengths[f'{OF_SAMPLES[0]} {k}']}" for k in range(measurements))
    writer.line("store [3 x i64] [i64 0, i64 0, i64 9223372036854775807], ptr %progress")  # unlimited budget
    writer.line(f"call void @evaluate(ptr %table, ptr %progress{counts})")
    writer.line("ret ptr null")
    text = "\n".join(writer.lines)
    return f"define ptr @xla_handler(ptr %frame) {{\nentry:\n{text}\n}}\n"
