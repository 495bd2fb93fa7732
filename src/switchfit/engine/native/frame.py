"""How XLA calls machine code: a handler that finds arguments and results in a frame of pointers.

Only a few fields of that frame are read. Where they stand is fixed by XLA's C interface for foreign functions
(``xla/ffi/api/c_api.h``).
"""

from __future__ import annotations

from switchfit.engine.native.driver import Driver
from switchfit.engine.native.workspace import GIVEN, OF_SAMPLES, ZEROED, memory, sums

MAJOR, MINOR = 0, 1
"""Version of the interface."""

EXTENSION, ARGUMENTS, RESULTS = 8, 72, 112
"""Bytes into the frame: pointers to the first extension, to the arguments and to the results."""

DATA, DIMENSIONS = 24, 40
"""Bytes into a buffer: its data and its dimensions."""


def handler(driver: Driver) -> str:
    """The handler: it fills the table of pointers, and calls the driver.

    Its arguments are those of `workspace.GIVEN`, then those of the samples; its results are all sums in one, and the
    memory.
    """
    library, sizes = driver.library, driver.sizes
    measurements = len(library.measurements)
    driver.line(f"%table = alloca [{len(driver.names) + len(OF_SAMPLES) * measurements} x i64]")
    driver.line("%progress = alloca [3 x i64]")
    extension = driver.load("ptr", driver.into("%frame", EXTENSION))
    driver.line(f"br i1 {driver.let(f'icmp eq ptr {extension}, null')}, label %run, label %asked")
    driver.label("asked")
    kind = driver.load("i32", driver.into(extension, 8))
    driver.line(f"br i1 {driver.let(f'icmp eq i32 {kind}, 1')}, label %answer, label %run")
    driver.label("answer")  # which version of the interface this is
    metadata = driver.load("ptr", driver.into(extension, 24))
    for offset, value in ((24, MAJOR), (28, MINOR), (32, 0)):
        driver.line(f"store i32 {value}, ptr {driver.into(metadata, offset)}")
    driver.line("ret ptr null")
    driver.label("run")
    given, made = (driver.load("ptr", driver.into("%frame", place)) for place in (ARGUMENTS, RESULTS))

    def data(buffers: str, k: int) -> tuple[str, str]:
        """Data and dimensions of a buffer."""
        buffer = driver.load("ptr", driver.into(buffers, 8 * k))
        pointer, dimensions = (driver.load("ptr", driver.into(buffer, place)) for place in (DATA, DIMENSIONS))
        return pointer, dimensions

    found = {name: data(given, k)[0] for k, name in enumerate(GIVEN)}
    last = driver.load("i64", driver.at(found["first_cell"], sizes.N + 1))
    rows = driver.let(f"add i64 {last}, {sizes.N + 1}")

    totals, first = data(made, 0)[0], 0
    for name, size in sums(library, sizes).items():
        found[name] = driver.at(totals, first)
        first += size
    zero(driver, totals, str(first))
    between, position = data(made, 1)[0], "0"
    for name, length in memory(library, sizes, driver.order).items():
        found[name] = driver.at(between, position)
        growing = driver.let(f"mul i64 {rows}, {length.each_row}")
        count = driver.let(f"add i64 {growing}, {length.fixed}")
        if name in ZEROED:
            zero(driver, found[name], count)
        position = driver.let(f"add i64 {position}, {count}")
    for k, name in enumerate(driver.names):
        driver.line(f"store ptr {found[name]}, ptr {driver.at('%table', k)}")
    counts = ""
    for k in range(measurements):
        shapes = []
        for m in range(len(OF_SAMPLES)):
            pointer, dimensions = data(given, len(GIVEN) + len(OF_SAMPLES) * k + m)
            at = driver.at("%table", len(driver.names) + len(OF_SAMPLES) * k + m)
            driver.line(f"store ptr {pointer}, ptr {at}")
            shapes.append(dimensions)
        counts += f", i64 {driver.load('i64', shapes[0])}"
    driver.line("store [3 x i64] [i64 0, i64 0, i64 9223372036854775807], ptr %progress")  # all at once
    driver.line(f"call void @evaluate(ptr %table, ptr %progress{counts})")
    driver.line("ret ptr null")
    text = "\n".join(driver.lines)
    return (
        "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)\n"
        f"define ptr @xla_handler(ptr %frame) {{\nentry:\n{text}\n}}\n"
    )


def zero(driver: Driver, pointer: str, count: str) -> None:
    """Write zeros to `count` doubles."""
    size = driver.let(f"mul i64 {count}, 8")
    driver.line(f"call void @llvm.memset.p0.i64(ptr {pointer}, i8 0, i64 {size}, i1 false)")
