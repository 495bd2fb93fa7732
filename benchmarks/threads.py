"""Fits beside busy processes, with and without OMP_NUM_THREADS=1; `main` is one process of them."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import switchfit as sf
from benchmarks import models, problems
from benchmarks.cold import process
from benchmarks.modes.truths import three_modes
from benchmarks.report import Report

COMMAND = [sys.executable, "-m", "benchmarks.threads"]
VARIABLE = "OMP_NUM_THREADS"
SETTINGS = {"unset": "", "1": "1"}
"""Values of it; OpenBLAS reads the empty one as none."""

FIT, SEARCH, JOINT = (
    "fit of fishing, 8 unknowns",
    "mode search, 3 modes",
    "fit of the tosses with its report, 51 unknowns",
)
WANTED = 1.1
"""Processor time of a search beside busy processes, as a multiple of that with one thread."""


def run(report: Report, quick: bool, cores: set[int] | None) -> None:
    """Time warm fits in processes of their own, the conditions in turns."""
    rounds, repetitions = (1, 3) if quick else (5, 7)
    taken: dict[str, dict[str, list[tuple[float, float]]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        process([*COMMAND, "0"], Path(folder), cores)  # fills the cache
        for _ in range(rounds):
            for load in ("idle", "busy"):
                for setting, value in SETTINGS.items():
                    with _busy(load == "busy", cores):
                        _, output = process([*COMMAND, str(repetitions)], Path(folder), cores, {VARIABLE: value})
                    for name, times in json.loads(output).items():
                        taken.setdefault(name, {}).setdefault(f"{load}, {setting}", []).append(times)
    report.section(
        "Beside busy processes",
        f"Warm fits in processes of their own with {VARIABLE} unset or 1, medians of wall clock / processor time, all "
        "threads, in milliseconds. *Busy*: endless loops on all cores but one. In brackets: ratios to *idle, 1*.",
    )
    rows = []
    for name, conditions in taken.items():
        found = {condition: np.median(times, axis=0) for condition, times in conditions.items()}
        ratios = {condition: times / found["idle, 1"] for condition, times in found.items()}
        cells = [
            " / ".join(f"{1e3 * t:.3g} ({r:.2f})" for t, r in zip(found[c], ratios[c], strict=True)) for c in found
        ]
        rows.append((name, *cells))
        if name == SEARCH:
            ratio = float(found["busy, unset"][1] / found["busy, 1"][1])
            report.target(f"search beside busy processes, {VARIABLE} unset / 1, processor", WANTED, ratio, "x")
    report.table(("", *taken[SEARCH]), rows)
    report.data["threads"] = taken


@contextmanager
def _busy(wanted: bool, cores: set[int] | None) -> Iterator[None]:
    """Keep all cores but one busy until the end of the block; at least one."""
    count = max(len(cores or ()) - 1, 1) if wanted else 0
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def cases() -> dict[str, Callable[[], Any]]:
    """What is timed."""
    fishing = problems.case("fishing").problem(np.array(models.FISHING_START))
    truth, tosses = three_modes(0), problems.tosses()
    return {
        FIT: lambda: sf.estimate(fishing, strategy="local"),
        SEARCH: lambda: sf.find_modes(truth.problem, criterion="mbic", **truth.settings),
        JOINT: lambda: str(sf.estimate(tosses, strategy="local")),
    }


def main() -> None:
    """Print the median seconds of each case, of the clock and of the processor."""
    found = {}
    for name, call in cases().items():
        call()
        times = []
        for _ in range(int(sys.argv[1])):
            began, busy = time.perf_counter(), time.process_time()
            call()
            times.append((time.perf_counter() - began, time.process_time() - busy))
        if times:
            found[name] = np.median(times, axis=0).tolist()
    print(json.dumps(found))


if __name__ == "__main__":
    main()
