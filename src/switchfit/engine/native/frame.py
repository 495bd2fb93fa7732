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

DATA, RANK, DIMENSIONS = 24, 32, 40
"""Byte offsets in a buffer of its data, its rank and its dimensions."""

RANKS = {"signals": 3, "units": 2, "value": 2, "weight": 2}
"""Ranks of the arguments of one experiment that are not 1."""


def write_handler(writer: Writer) -> str:
    """Return the text of the handler, which fills the table of pointers and calls `evaluate` for each entry of a batch.

    Arguments are those of `workspace.GIVEN`, then those of the samples; results are all accumulators in one array, and
    the scratch space. In a batch, each has one more dimension in front, of length 1 if all entries share it. All
    entries use the scratch space of the first one after another, so that it stays in the CPU caches.
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

    def buffer(buffers: str, k: int) -> tuple[str, str, str]:
        """Load data, rank and dimensions of a buffer."""
        pointer = writer.load("ptr", writer.into(buffers, 8 * k))
        data, dimensions = (writer.load("ptr", writer.into(pointer, place)) for place in (DATA, DIMENSIONS))
        return data, writer.load("i64", writer.into(pointer, RANK)), dimensions

    totals, rank, dimensions = buffer(results, 0)
    batched = writer.let(f"icmp eq i64 {rank}, 2")
    leading = writer.let(f"zext i1 {batched} to i64")  # number of batch dimensions
    first = writer.load("i64", dimensions)
    repeats = writer.let(f"select i1 {batched}, i64 {first}, i64 1")
    between = buffer(results, 1)[0]
    data, strides, lengths = {}, {}, {}
    for k, name in enumerate(names):
        data[name], _, dimensions = buffer(arguments, k)
        size, own = "1", []
        for axis in range(RANKS.get(name.split()[0], 1)):
            place = writer.let(f"add i64 {leading}, {axis}")
            own.append(writer.load("i64", writer.at(dimensions, place)))
            size = writer.let(f"mul i64 {size}, {own[-1]}")
        lengths[name] = own[0]
        differs = writer.let(f"icmp sgt i64 {writer.load('i64', dimensions)}, 1")
        both = writer.let(f"and i1 {batched}, {differs}")
        strides[name] = writer.let(f"select i1 {both}, i64 {size}, i64 0")
    with writer.loop("0", repeats) as which:
        found = {name: writer.at(data[name], writer.let(f"mul i64 {which}, {strides[name]}")) for name in names}
        last = writer.load("i64", writer.at(found["first_cell"], sizes.N + 1))
        rows = writer.let(f"add i64 {last}, {sizes.N + 1}")
        parts = sums(library, sizes)
        own_totals, position = writer.at(totals, which, sum(parts.values())), 0
        for name, length in parts.items():
            found[name] = writer.at(own_totals, position)
            position += length
        zero(writer, own_totals, str(position))
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
    return writer.end_function("ptr @xla_handler(ptr %frame)", returns=False)
