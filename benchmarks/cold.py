"""Cold processes: the command line with an empty and with a filled compilation cache, and the import."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

from benchmarks.report import Report

ROOT = Path(__file__).parent.parent
FIT = [sys.executable, "-c", "from switchfit.cli import main; main()", "fit", "examples/toss/problem.toml"]
IMPORT = [sys.executable, "-c", "import switchfit"]
NOTHING = [sys.executable, "-c", "pass"]
EMPTY_TARGET, FILLED_TARGET, IMPORT_TARGET = 6.0, 2.5, 1.2


def run(report: Report, quick: bool, cores: set[int] | None) -> None:
    """Wall-clock medians of whole processes, on all cores."""
    with tempfile.TemporaryDirectory() as folder:
        caches = (str(Path(folder) / f"empty{k}") for k in range(100))
        filled = str(Path(folder) / "filled")
        seconds_of(FIT, filled, cores)
        few, many = (1, 2) if quick else (5, 11)
        commands: dict[str, tuple[int, Callable[[], float]]] = {
            "switchfit fit toss, empty cache": (few, lambda: seconds_of(FIT, next(caches), cores)),
            "switchfit fit toss, filled cache": (many, lambda: seconds_of(FIT, filled, cores)),
            "import switchfit": (many, lambda: seconds_of(IMPORT, filled, cores)),
            "python, nothing": (many, lambda: seconds_of(NOTHING, filled, cores)),
        }
        taken = {name: [call() for _ in range(count)] for name, (count, call) in commands.items()}
    report.section("Cold processes", "Wall clock of whole processes, on all cores; the interpreter's start included.")
    report.table(
        ("", "median", "minimum", "processes"),
        [(name, f"{median(s):.2f} s", f"{min(s):.2f} s", len(s)) for name, s in taken.items()],
    )
    report.data["cold"] = taken
    names = list(taken)
    for name, wanted in zip(names, (EMPTY_TARGET, FILLED_TARGET, IMPORT_TARGET), strict=False):
        report.target(name, wanted, median(taken[name]), "s")


def seconds_of(command: list[str], cache: str, cores: set[int] | None) -> float:
    """Wall clock of one process with a compilation cache of its own."""
    environment = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"SWITCHFIT_CACHE": cache, "XDG_CACHE_HOME": cache}

    def use_all_cores() -> None:
        if cores is not None:
            os.sched_setaffinity(0, cores)

    began = time.perf_counter()
    done = subprocess.run(
        command, cwd=ROOT, env=environment, preexec_fn=use_all_cores, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return time.perf_counter() - began
