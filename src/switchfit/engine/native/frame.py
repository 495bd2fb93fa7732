"""Handler by which XLA calls machine code; it reads the arguments and results from XLA's call frame.

Only a few fields of the frame are read. Their offsets are fixed by XLA's C interface for foreign functions
(``xla/ffi/api/c_api.h``).
"""

from __future__ import annotations

from functools import reduce
from operator import mul

from switchfit.engine.native.lines import Operand, Value
from switchfit.engine.native.workspace import GIVEN, OF_SAMPLES, ZEROED, memory, sums
from switchfit.engine.native.writer import Writer

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
    (frame,) = writer.begin("ptr @xla_handler(ptr %frame)")
    table = writer.allocate("ptr", len(writer.names) + len(OF_SAMPLES) * measurements)
    progress = writer.allocate("i64", 3)
    extension = writer.load("ptr", writer.into(frame, EXTENSION))
    with writer.when(extension.differs("null")), writer.when(writer.load("i32", writer.into(extension, 8)).equals(1)):
        metadata = writer.load("ptr", writer.into(extension, 24))  # XLA queries the version of the interface
        for offset, value in ((24, MAJOR), (28, MINOR), (32, 0)):
            writer.store(value, writer.into(metadata, offset), "i32")
        writer.line("ret ptr null")
    arguments, results = (writer.load("ptr", writer.into(frame, place)) for place in (ARGUMENTS, RESULTS))

    def buffer(buffers: Value, k: int) -> tuple[Value, Value, Value]:
        """Load data, rank and dimensions of a buffer."""
        pointer = writer.get("ptr", buffers, k)
        data, dimensions = (writer.load("ptr", writer.into(pointer, place)) for place in (DATA, DIMENSIONS))
        return data, writer.load("i64", writer.into(pointer, RANK)), dimensions

    totals, rank, dimensions = buffer(results, 0)
    batched = rank.equals(2)
    leading = batched.to("i64")  # number of batch dimensions
    repeats = batched.choose(writer.load("i64", dimensions), 1)
    between = buffer(results, 1)[0]
    data, strides, lengths = {}, {}, {}
    for k, name in enumerate(names):
        data[name], _, dimensions = buffer(arguments, k)
        own = [writer.get("i64", dimensions, leading + axis) for axis in range(RANKS.get(name.split()[0], 1))]
        lengths[name] = own[0]
        strides[name] = (batched & (writer.load("i64", dimensions) > 1)).choose(reduce(mul, own), 0)
    with writer.loop(0, repeats) as which:
        found = {name: writer.at(data[name], which, strides[name]) for name in names}
        rows = writer.get("i64", found["first_cell"], sizes.N + 1) + (sizes.N + 1)
        parts = sums(library, sizes)
        own_totals, position = writer.at(totals, which, sum(parts.values())), 0
        for name, length in parts.items():
            found[name] = writer.at(own_totals, position)
            position += length
        writer.zero(own_totals, position)
        place: Operand = 0
        for name, extent in memory(library, sizes, writer.order).items():
            found[name], count = writer.at(between, place), rows * extent.each_row + extent.fixed
            if name in ZEROED:
                writer.zero(found[name], count)
            place = count + place
        for k, name in enumerate([*writer.names, *names[len(GIVEN) :]]):
            writer.put(found[name], table, k)
        writer.store("[i64 0, i64 0, i64 9223372036854775807]", progress, "[3 x i64]")  # unlimited budget
        writer.invoke("evaluate", table, progress, *(lengths[f"{OF_SAMPLES[0]} {k}"] for k in range(measurements)))
    return writer.end("ptr null")
