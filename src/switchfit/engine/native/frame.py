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

DATA, RANK, DIMENSIONS = 24, 32, 40
"""Bytes into a buffer: its data, the number of its dimensions, and these."""

RANKS = {"signals": 3, "units": 2, "value": 2, "weight": 2}
"""Numbers of dimensions of what one experiment is given, where they are not 1."""


def write_handler(driver: Driver) -> str:
    """Return the handler's text: it fills the table of pointers and calls the driver, once per entry of a batch.

    Its arguments are those of `workspace.GIVEN`, then those of the samples; its results are all sums in one, and the
    memory. In a batch all of them have one dimension more, of length 1 where they are the same for all; the memory of
    the first serves all, one after the other, and stays in the caches.
    """
    library, sizes = driver.library, driver.sizes
    measurements = len(library.measurements)
    names = [*GIVEN, *(f"{name} {k}" for k in range(measurements) for name in OF_SAMPLES)]
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
    arguments, results = (driver.load("ptr", driver.into("%frame", place)) for place in (ARGUMENTS, RESULTS))

    def buffer(buffers: str, k: int) -> tuple[str, str, str]:
        """Load data, rank and dimensions of a buffer."""
        pointer = driver.load("ptr", driver.into(buffers, 8 * k))
        data, dimensions = (driver.load("ptr", driver.into(pointer, place)) for place in (DATA, DIMENSIONS))
        return data, driver.load("i64", driver.into(pointer, RANK)), dimensions

    totals, rank, dimensions = buffer(results, 0)
    batched = driver.let(f"icmp eq i64 {rank}, 2")
    leading = driver.let(f"zext i1 {batched} to i64")  # dimensions before those of one experiment
    first = driver.load("i64", dimensions)
    repeats = driver.let(f"select i1 {batched}, i64 {first}, i64 1")
    between = buffer(results, 1)[0]
    data, strides, lengths = {}, {}, {}
    for k, name in enumerate(names):
        data[name], _, dimensions = buffer(arguments, k)
        size, own = "1", []
        for axis in range(RANKS.get(name.split()[0], 1)):
            place = driver.let(f"add i64 {leading}, {axis}")
            own.append(driver.load("i64", driver.at(dimensions, place)))
            size = driver.let(f"mul i64 {size}, {own[-1]}")
        lengths[name] = own[0]
        differs = driver.let(f"icmp sgt i64 {driver.load('i64', dimensions)}, 1")
        both = driver.let(f"and i1 {batched}, {differs}")
        strides[name] = driver.let(f"select i1 {both}, i64 {size}, i64 0")
    driver.line("br label %loop")
    driver.label("loop")
    driver.line("%which = phi i64 [0, %run], [%following, %loop]")
    found = {name: driver.at(data[name], driver.let(f"mul i64 %which, {strides[name]}")) for name in names}
    last = driver.load("i64", driver.at(found["first_cell"], sizes.N + 1))
    rows = driver.let(f"add i64 {last}, {sizes.N + 1}")
    parts = sums(library, sizes)
    own_totals, position = driver.at(totals, "%which", sum(parts.values())), 0
    for name, length in parts.items():
        found[name] = driver.at(own_totals, position)
        position += length
    zero(driver, own_totals, str(position))
    place = "0"
    for name, extent in memory(library, sizes, driver.order).items():
        found[name] = driver.at(between, place)
        growing = driver.let(f"mul i64 {rows}, {extent.each_row}")
        count = driver.let(f"add i64 {growing}, {extent.fixed}")
        if name in ZEROED:
            zero(driver, found[name], count)
        place = driver.let(f"add i64 {place}, {count}")
    for k, name in enumerate([*driver.names, *names[len(GIVEN) :]]):
        driver.line(f"store ptr {found[name]}, ptr {driver.at('%table', k)}")
    counts = "".join(f", i64 {lengths[f'{OF_SAMPLES[0]} {k}']}" for k in range(measurements))
    driver.line("store [3 x i64] [i64 0, i64 0, i64 9223372036854775807], ptr %progress")  # all at once
    driver.line(f"call void @evaluate(ptr %table, ptr %progress{counts})")
    driver.line("%following = add i64 %which, 1")
    driver.line(f"%more = icmp slt i64 %following, {repeats}")
    driver.line("br i1 %more, label %loop, label %out")
    driver.label("out")
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
