"""Cold processes: the command line, the shipped examples, the import, and the same answer from other libraries."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from statistics import median

from benchmarks.answer import DERIVATIVES, FITS
from benchmarks.report import Report

ROOT = Path(__file__).parent.parent
FIT = [sys.executable, "-c", "from switchfit.cli import main; main()", "fit", "examples/toss/problem.toml"]
IMPORT = [sys.executable, "-c", "from switchfit import *"]
NOTHING = [sys.executable, "-c", "pass"]
HELP = [sys.executable, "-c", "from switchfit.cli import main; main()", "--help"]
EMPTY, FILLED = "switchfit fit toss, empty cache", "switchfit fit toss, filled cache"
ALL, SHORT = "from switchfit import *", "switchfit --help"
EXAMPLES = ("toss", "two_turns", "vehicle", "dates", "terrain", "husky")
WAIT = 3.0
"""Seconds in which a cold fit of an example should be there, with and without --out."""
SAME_ANSWER = 1e-6
TARGETS = {EMPTY: 4.0, FILLED: 2.0, ALL: 1.2, SHORT: 0.3}


def run(report: Report, quick: bool, cores: set[int] | None) -> None:
    """Wall-clock medians of whole processes, on all cores."""
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder) / "0"
        few, many = (1, 2) if quick else (5, 11)
        taken = {
            EMPTY: [seconds_of(FIT, first.with_name(str(k)), cores) for k in range(few)],
            FILLED: [seconds_of(FIT, first, cores) for _ in range(many)],
            ALL: [seconds_of(IMPORT, first, cores) for _ in range(many)],
            SHORT: [seconds_of(HELP, first, cores) for _ in range(many)],
            "python, nothing": [seconds_of(NOTHING, first, cores) for _ in range(many)],
        }
    report.section("Cold processes", "Wall clock of whole processes, on all cores; the interpreter's start included.")
    report.table(
        ("", "median", "minimum", "processes"),
        [(name, f"{median(s):.2f} s", f"{min(s):.2f} s", len(s)) for name, s in taken.items()],
    )
    report.data["cold"] = taken
    for name, wanted in TARGETS.items():
        report.target(name, wanted, median(taken[name]), "s")
    examples(report, quick, cores)
    answers(report, quick, cores)


def examples(report: Report, quick: bool, cores: set[int] | None) -> None:
    """Whole fits of the shipped examples with an empty cache, with and without the folder that --out writes."""
    report.section(
        "Cold fits of the examples",
        "`switchfit fit examples/NAME/problem.toml` in a new process with an empty cache, on all cores; medians. *With "
        "--out*: `report.html`, `report.txt`, `estimate.json` and `fit.png` too. Byte code and matplotlib's list of "
        "fonts are there already. Processor time, of all threads, depends less on what else runs on the machine.",
    )
    repeated = 1 if quick else 5
    taken: dict[str, dict[str, list[tuple[float, float]]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        variables = {"MPLCONFIGDIR": str(Path(folder) / "matplotlib")}
        for k in range(-1, repeated):  # one round is not counted: it compiles byte code and lists fonts
            for name in EXAMPLES[:1] if k < 0 else EXAMPLES:
                for out in ("without --out", "with --out"):
                    place = Path(folder) / f"{name}{k}{out}"
                    command = [*FIT[:-1], f"examples/{name}/problem.toml"]
                    command += ["--out", str(place / "out")] if out == "with --out" else []
                    before = resource.getrusage(resource.RUSAGE_CHILDREN)
                    seconds, _ = process(command, place / "cache", cores, variables, codes=(0, 1))
                    after = resource.getrusage(resource.RUSAGE_CHILDREN)
                    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
                    if k >= 0:
                        taken.setdefault(name, {}).setdefault(out, []).append((seconds, busy))
    rows = []
    for name, both in taken.items():
        cells = [f"{median(column):.2f} s" for own in both.values() for column in zip(*own, strict=True)]
        rows.append((name, *cells, repeated))
        for out, own in both.items():
            report.target(f"{name}, empty cache, {out}", WAIT, median(seconds for seconds, _ in own), "s")
    report.table(("", "without --out", "processor", "with --out", "processor", "processes"), rows)
    report.data["cold: examples"] = taken


def answers(report: Report, quick: bool, cores: set[int] | None) -> None:
    """From the start of a process to the same answer, library by library; raises if the answers differ."""
    report.section(
        "Cold processes, side by side",
        "From the start of the interpreter to its end, on all cores, at settings that give J to 1e-8. *Empty cache*: "
        "the library's own cache of compiled programs, a new folder each time; *filled* by the same process before. "
        "diffrax compiles each time as JAX does unless it is told otherwise; *JAX's cache*: JAX's persistent cache "
        "turned on and filled, and EQX_ON_ERROR=nan, since programs that can raise are not kept in it.",
    )
    jax_cache = {
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        "EQX_ON_ERROR": "nan",
    }
    asked = {"derivatives": "(J, gradient, Hessian) of the vehicle", "fit": "whole fit of the fishing problem"}
    libraries = {"derivatives": DERIVATIVES, "fit": FITS}
    for what, title in asked.items():
        taken: dict[str, list[float]] = {}
        found: dict[str, float] = {}
        missing = []
        with tempfile.TemporaryDirectory() as folder:
            for library in libraries[what]:
                if library != "switchfit" and find_spec(library) is None:
                    missing.append(library)
                    continue
                command = [sys.executable, "-m", "benchmarks.answer", what, library]
                caches = {library: ("{k}", {})}
                if library in ("switchfit", "heyoka"):
                    own = library + "{k}"
                    caches = {
                        f"{library}, empty cache": (own, {}),
                        f"{library}, filled cache": (own.format(k=0), {}),
                    }
                if library == "diffrax":
                    on = jax_cache | {"JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "jax")}
                    process(command, Path(folder) / "none", cores, on)
                    caches["diffrax, JAX's cache"] = ("none", on)
                for name, (cache, variables) in caches.items():
                    taken[name] = []
                    for k in range(1 if quick else 5):
                        path = Path(folder) / cache.format(k=k)
                        seconds, output = process(command, path, cores, variables)
                        taken[name].append(seconds)
                        found[name] = float(output.split()[-1])
        J = next(iter(found.values()))
        for name, other in found.items():
            if not abs(other - J) <= SAME_ANSWER * abs(J):
                raise ArithmeticError(f"{title}: J is {J!r} by switchfit and {other!r} by {name}")
        rows = [
            (name, f"{median(s):.2f} s", f"{min(s):.2f} s", f"{abs(found[name] - J) / abs(J):.0e}", len(s))
            for name, s in taken.items()
        ]
        report.note(f"**{title}**")
        header = ("", "median", "minimum", "J from switchfit's by", "processes")
        report.table(header, rows + [(library, "not installed", "", "", "") for library in missing])
        report.data[f"cold: {title}"] = taken


def seconds_of(command: list[str], cache: Path, cores: set[int] | None) -> float:
    """Wall clock of one process with a compilation cache of its own, on `cores`."""
    return process(command, cache, cores)[0]


def process(
    command: list[str],
    cache: Path,
    cores: set[int] | None,
    variables: dict[str, str] | None = None,
    codes: tuple[int, ...] = (0,),
) -> tuple[float, str]:
    """Wall clock and output of one process with a compilation cache of its own, on `cores`; raises for other codes."""
    own = ("JAX_COMPILATION_CACHE_DIR", "PYTHONDONTWRITEBYTECODE")
    environment = {key: value for key, value in os.environ.items() if key not in own}
    environment |= {"SWITCHFIT_CACHE": str(cache), "XDG_CACHE_HOME": str(cache)} | (variables or {})
    with _on(cores):
        began = time.perf_counter()
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - began
    if done.returncode not in codes:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return seconds, done.stdout


@contextmanager
def _on(cores: set[int] | None) -> Iterator[None]:
    """Let this thread, and the processes it starts, use `cores`."""
    if cores is None:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
