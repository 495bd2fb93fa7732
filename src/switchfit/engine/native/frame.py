"""How XLA calls machine code: a handler that finds arguments and results in a frame of pointers.

Only a few fields of that frame are read. Where they stand is fixed by XLA's C interface for foreign functions
(``xla/ffi/api/c_api.h``).
"""

from __future__ import annotations

from switchfit.engine.native.driver import POINTERS, Driver
from switchfit.engine.native.kernels import STAGES, Sizes
from switchfit.engine.native.scalars import CHECKED

MAJOR, MINOR = 0, 1
"""Version of the interface."""

EXTENSION, ARGUMENTS, RESULTS = 8, 72, 112
"""Bytes into the frame: pointers to the first extension, to the arguments and to the results."""

DATA, DIMENSIONS = 24, 40
"""Bytes into a buffer: its data and its dimensions."""

GIVEN = ("nodes", "signals", "c", "tau", "first_cell", "units")
"""Arguments of the operation, before the samples."""


def workspace(sizes: Sizes, cells: int, samples: bool) -> dict[str, int]:
    """Lengths of the results of the operation; the first is what it is for."""
    n, N, D, width, rows = sizes.n, sizes.N, sizes.D, sizes.width, cells + sizes.N
    return {
        "psi": n + 2 + width + D * width,
        "states": (rows + 1 + N) * n,
        "tangents": (rows + 1) * n * width,
        "stages": rows * STAGES * n,
        "stage_tangents": rows * STAGES * n * width,
        "jumps": (rows + 1) * n if samples else n,
        "reset_tangents": N * n * width + 1,
        "entries": STAGES * (1 + n + sizes.M) ** 2,
        "length": width,
    }


def handler(driver: Driver) -> str:
    """The handler: it fills the table of pointers, and calls the driver."""
    sizes, measurements = driver.sizes, len(driver.structure.measurements)
    n, N, D, width = sizes.n, sizes.N, sizes.D, sizes.width
    driver.line(f"%table = alloca [{len(POINTERS) + 4 * measurements} x i64]")
    driver.line("%progress = alloca [3 x i64]")
    extension = driver.let(f"load ptr, ptr {driver.into('%frame', EXTENSION)}")
    driver.line(f"br i1 {driver.let(f'icmp eq ptr {extension}, null')}, label %run, label %asked")
    driver.lines.append("asked:")
    kind = driver.let(f"load i32, ptr {driver.into(extension, 8)}")
    driver.line(f"br i1 {driver.let(f'icmp eq i32 {kind}, 1')}, label %answer, label %run")
    driver.lines.append("answer:")  # which version of the interface this is
    metadata = driver.let(f"load ptr, ptr {driver.into(extension, 24)}")
    for offset, value in ((24, MAJOR), (28, MINOR), (32, 0)):
        driver.line(f"store i32 {value}, ptr {driver.into(metadata, offset)}")
    driver.line("ret ptr null")
    driver.lines.append("run:")
    given, made = (driver.let(f"load ptr, ptr {driver.into('%frame', place)}") for place in (ARGUMENTS, RESULTS))

    def data(buffers: str, k: int) -> tuple[str, str]:
        """Data and dimensions of a buffer."""
        buffer = driver.let(f"load ptr, ptr {driver.into(buffers, 8 * k)}")
        places = (driver.into(buffer, place) for place in (DATA, DIMENSIONS))
        pointer, dimensions = (driver.let(f"load ptr, ptr {place}") for place in places)
        return pointer, dimensions

    found, shapes = {}, {}
    for k, name in enumerate(GIVEN):
        found[name], shapes[name] = data(given, k)
    for k, name in enumerate(workspace(sizes, 0, False)):
        found[name], shapes[name] = data(made, k)
    nodes = driver.let(f"load i64, ptr {shapes['nodes']}")
    cells = driver.let(f"sub i64 {nodes}, 1")
    behind = driver.let(f"add i64 {cells}, {N + 1}")
    found |= {
        "p": driver.at(found["tau"], N),
        "J": driver.at(found["psi"], n),
        "g": driver.at(found["psi"], n + 1),
        "H": driver.at(found["psi"], n + 1 + width),
        CHECKED: driver.at(found["psi"], n + 1 + width + D * width),
        "reset_states": driver.at(found["states"], behind, n),
    }
    for k, name in enumerate(POINTERS):
        driver.line(f"store ptr {found.get(name, 'null')}, ptr {driver.at('%table', k)}")
    counts = ""
    for k in range(measurements):
        for m in range(4):
            pointer, dimensions = data(given, len(GIVEN) + 4 * k + m)
            driver.line(f"store ptr {pointer}, ptr {driver.at('%table', len(POINTERS) + 4 * k + m)}")
        counts += f", i64 {driver.let(f'load i64, ptr {dimensions}')}"
    jumps = driver.let(f"load i64, ptr {shapes['jumps']}")
    for name, length in (("psi", str(n + 2 + width + D * width)), ("jumps", jumps)):
        size = driver.let(f"mul i64 {length}, 8")
        driver.line(f"call void @llvm.memset.p0.i64(ptr {found[name]}, i8 0, i64 {size}, i1 false)")
    first = driver.let(f"load double, ptr {found['nodes']}")
    last = driver.let(f"load double, ptr {driver.at(found['nodes'], cells)}")
    driver.line("store [3 x i64] [i64 0, i64 0, i64 9223372036854775807], ptr %progress")  # all at once
    driver.line(f"call void @evaluate(ptr %table, ptr %progress, i64 {cells}, double {first}, double {last}{counts})")
    driver.line("ret ptr null")
    text = "\n".join(driver.lines)
    return (
        "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)\n"
        f"define ptr @xla_handler(ptr %frame) {{\nentry:\n{text}\n}}\n"
    )
