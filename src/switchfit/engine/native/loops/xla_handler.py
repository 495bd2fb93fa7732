"""The handler by which XLA calls machine code: it reads the arguments and results from XLA's call frame.

Only a few fields of the frame are read. Their offsets are fixed by XLA's C interface for foreign functions
(``xla/ffi/api/c_api.h``); `tests/engine/test_machine_code.py` compares them with the header of the JAX that is
installed.
"""

from __future__ import annotations

from switchfit.engine.native.llvm.lines import Operand, Value
from switchfit.engine.native.loops.segments import count_rows
from switchfit.engine.native.loops.writer import Writer

FFI_MAJOR, FFI_MINOR = 0, 1
"""Version of the interface."""

FRAME_EXTENSION, FRAME_ARGUMENTS, FRAME_RESULTS = 8, 72, 112
"""Byte offsets in the frame of the pointers to the first extension, to the arguments and to the results."""

BUFFER_DATA, BUFFER_DIMENSIONS = 24, 40
"""Byte offsets in a buffer of its data and its dimensions."""


def write_handler(writer: Writer) -> str:
    """Return the text of the handler, which fills the table of pointers and calls `evaluate`.

    Results are all accumulators in one array, and the scratch space.
    """
    names = writer.layout.arguments
    (frame,) = writer.begin("ptr @xla_handler(ptr %frame)")
    table = writer.allocate("ptr", len(writer.names))
    extension = writer.load("ptr", writer.into(frame, FRAME_EXTENSION))
    with writer.when(extension.differs("null")), writer.when(writer.load("i32", writer.into(extension, 8)).equals(1)):
        metadata = writer.load("ptr", writer.into(extension, 24))  # XLA queries the version of the interface
        for offset, value in ((24, FFI_MAJOR), (28, FFI_MINOR), (32, 0)):
            writer.store(value, writer.into(metadata, offset), "i32")
        writer.line("ret ptr null")
    arguments, results = (writer.load("ptr", writer.into(frame, place)) for place in (FRAME_ARGUMENTS, FRAME_RESULTS))

    def of_buffer(buffers: Value, k: int, offset: int) -> Value:
        """Load the address of the data or of the dimensions of a buffer."""
        return writer.load("ptr", writer.into(writer.get("ptr", buffers, k), offset))

    found = {name: of_buffer(arguments, k, BUFFER_DATA) for k, name in enumerate(names)}
    totals, between = (of_buffer(results, k, BUFFER_DATA) for k in (0, 1))
    # All sums are one result, in the order of the layout: the first is `totals`, the second the scratch space.
    position = 0
    for name, length in writer.layout.sums.items():
        found[name] = writer.at(totals, position)
        position += length
    rows = count_rows(writer, found)
    place: Operand = 0
    for name, (fixed, each_row) in writer.layout.memory.items():
        found[name] = writer.at(between, place)
        place = rows * each_row + fixed + place
    for k, name in enumerate(writer.names):
        writer.put(found[name], table, k)
    # The number of samples of each Measurements is the length of its array of cells.
    of_cells = (k for k, name in enumerate(names) if name.startswith("cell "))
    writer.invoke(
        "evaluate", table, *(writer.get("i64", of_buffer(arguments, k, BUFFER_DIMENSIONS), 0) for k in of_cells)
    )
    return writer.end("ptr null")
