"""Cold processes: the command line with an empty and with a filled compilation cache, and the import."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

from benchmarks.report import Report

ROOT = Path(__file__).parent.parent
FIT = [sys.executable, "-c", "from switchfit.cli import main; main()", "fit", "examples/toss/problem.toml"]
IMPORT = [sys.executable, "-c", "import switchfit"]
NOTHING = [sys.executable, "-c", "pass"]
EMPTY, FILLED = "switchfit fit toss, empty cache", "switchfit fit toss, filled cache"
TARGETS = {EMPTY: 6.0, FILLED: 2.5, "import switchfit": 1.2}


def run(report: Report, quick: bool, cores: set[int] | None) -> None:
    """Wall-clock medians of whole processes, on all cores."""
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder) / "0"
        few, many = (1, 2) if quick else (5, 11)
        taken = {
            EMPTY: [seconds_of(FIT, first.with_name(str(k)), cores) for k in range(few)],
            FILLED: [seconds_of(FIT, first, cores) for _ in range(many)],
            "import switchfit": [seconds_of(IMPORT, first, cores) for _ in range(many)],
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


def seconds_of(command: list[str], cache: Path, cores: set[int] | None) -> float:
    """Wall clock of one process with a compilation cache of its own, on `cores`."""
    environment = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"SWITCHFIT_CACHE": str(cache), "XDG_CACHE_HOME": str(cache)}
    with _on(cores):
        began = time.perf_counter()
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - began
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return seconds


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
