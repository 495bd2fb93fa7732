"""Many fits at once: Monte Carlo on the paper's vehicle, in a process of its own that uses all cores.

``python -m benchmarks.many RUNS`` prints what was measured as JSON; the part `many` runs it and makes the table. With
``jax`` behind RUNS everything is evaluated by JAX: on a GPU, where there is one.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks import vehicle
from benchmarks.cold import _on
from benchmarks.report import Report
from switchfit.models import skid_steer

TRUTH = np.array([*vehicle.TRUTH, vehicle.MU_TRUTH])
START = np.array([*vehicle.START, vehicle.MU_START])
AT_ONE_HERTZ, AT_TEN_HERTZ = "positions at 1 Hz", "all states at 10 Hz"
CASES = {
    "the truth": (AT_ONE_HERTZ, TRUTH),
    "the paper's start": (AT_ONE_HERTZ, START),
    "the truth, all states at 10 Hz": (AT_TEN_HERTZ, TRUTH),
    "the paper's start, all states at 10 Hz": (AT_TEN_HERTZ, START),
}
SINGLE = 40
TARGET = 2e-3
"""Seconds a refit that were aimed at, on two cores."""


def positions(t: Any, x: Any, p: Any) -> Any:
    """What a GPS receiver sees."""
    return x[jnp.array([0, 2])]


def problem(seen: str, engine: str = "auto") -> sf.Problem:
    """The vehicle for 15 s, noise of 0.1 in every channel."""
    if seen == AT_ONE_HERTZ:
        data = sf.Measurements(
            np.arange(0.0, 15.5, 1.0), np.zeros((16, 2)), observe=positions, sigma=0.1, names=("X", "Y")
        )
    else:
        data = sf.Measurements(np.arange(151) / 10, np.zeros((151, 6)), sigma=0.1)
    run = sf.Experiment(data, vehicle.SEQUENCE, vehicle.START, *vehicle.HORIZON)
    mu = sf.Parameter(vehicle.MU_START, lower=0.05, upper=2.0)
    return sf.Problem(skid_steer(), run, {"mu": mu}, engine=engine)


def measure(runs: int, engine: str = "auto") -> dict[str, Any]:
    """Seconds a fit: `runs` refits at once, and some of them by `estimate`, one after the other."""
    from switchfit.batch.programs import Limits
    from switchfit.batch.simulated_study import build_study
    from switchfit.fit.minimization import minimize_cost
    from switchfit.meshes.evaluator import Evaluator

    found: dict[str, Any] = {}
    for name, (seen, start) in CASES.items():
        here = problem(seen, engine)
        began = time.perf_counter()
        sf.monte_carlo(here, 64, theta=TRUTH, start=start)
        first = time.perf_counter() - began
        began = time.perf_counter()
        study = sf.monte_carlo(here, runs, theta=TRUTH, start=start)
        seconds = time.perf_counter() - began
        work, _ = build_study(here, TRUTH, start, None, 0, Limits(1e-7, 200))
        few = min(SINGLE, runs)
        singles = [
            minimize_cost(Evaluator(work.problem_of(k), meshes=work.meshes), start, "exact", 1e-7, 200)
            for k in range(few)
        ]
        gap = max(float(np.max(np.abs(single.theta - study.theta[k]))) for k, single in enumerate(singles))
        problems = [work.problem_of(k) for k in range(few)]
        sf.estimate(problems[0], start=start)
        taken = []
        for single in problems:
            began = time.perf_counter()
            sf.estimate(single, start=start)
            taken.append(time.perf_counter() - began)
        found[name] = {
            "runs": runs,
            "seconds": seconds,
            "first 64, with compilation": first,
            "converged": int(study.success.sum()),
            "at a kink": int(np.sum(study.status == "CONVERGED_AT_KINK")),
            "iterations": float(np.median(study.iterations)),
            "cells": work.meshes[0].cells,
            "seconds of a single estimate": float(np.median(taken)),
            "largest difference to single fits": gap,
            "coverage": study.coverage().tolist(),
        }
    return found


def run(report: Report, quick: bool, cores: set[int] | None) -> None:
    """The study in a process on all cores."""
    runs = 500 if quick else 10_000
    with _on(cores):
        command = [sys.executable, "-m", "benchmarks.many", str(runs)]
        root = Path(__file__).parent.parent
        done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    found = json.loads(done.stdout.splitlines()[-1])
    report.section(
        "Many fits at once",
        f"`sf.monte_carlo` on {len(cores) if cores else 'all'} cores: the vehicle, positions at 1 Hz or all six states "
        f"at 10 Hz, noise 0.1, {runs} runs. *Single*: the same fits by `estimate()`, one after the other, each on its "
        "own mesh, median. "
        f"*Difference*: the largest in any unknown to single fits of the first {SINGLE} runs on the same mesh.",
    )
    report.table(
        (
            "every fit begins at",
            "all",
            "a fit",
            "single",
            "ratio",
            "first 64, cold",
            "converged",
            "at a kink",
            "iterations",
            "cells",
            "difference",
        ),
        [
            (
                name,
                f"{row['seconds']:.1f} s",
                f"{1e3 * row['seconds'] / runs:.2f} ms",
                f"{1e3 * row['seconds of a single estimate']:.1f} ms",
                f"{row['seconds of a single estimate'] * runs / row['seconds']:.1f}",
                f"{row['first 64, with compilation']:.1f} s",
                f"{row['converged']} of {runs}",
                row["at a kink"],
                f"{row['iterations']:.0f}",
                row["cells"],
                f"{row['largest difference to single fits']:.0e}",
            )
            for name, row in found.items()
        ],
    )
    report.data["many"] = found
    for name, row in found.items():
        report.target(f"a refit of the vehicle from {name}", 1e3 * TARGET, 1e3 * row["seconds"] / runs, "ms")


if __name__ == "__main__":
    print(json.dumps(measure(int(sys.argv[1]), *sys.argv[2:])))
