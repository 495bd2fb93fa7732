"""How the cost of the Hessian grows: with nodes, states, transitions and parameters, by method; and its memory."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks.report import Report
from benchmarks.timing import ms, take_turns
from switchfit.discretization.mesh import Mesh
from switchfit.meshes.evaluator import Evaluator

NODES = (500, 1000, 2000, 4000, 8000)
HORIZON = 10.0
METHODS = ("forward", "discrete-adjoint")
"""Second order in JAX, whose crossover is looked for."""

SHOWN = {
    "auto": "auto (machine code)",
    "discrete-adjoint": "discrete-adjoint (JAX)",
    "forward": "forward (JAX)",
    "adjoint": "the paper's equations (JAX)",
}
"""All methods, and what the tables call them."""

GROWING = {
    "states": ((2, 2, 2), (4, 2, 2), (8, 2, 2), (16, 2, 2), (32, 2, 2)),
    "transitions": ((4, 1, 2), (4, 5, 2), (4, 10, 2), (4, 20, 2)),
    "parameters": ((4, 2, 1), (4, 2, 5), (4, 2, 10), (4, 2, 20)),
}
"""(states, transitions, parameters) of each study."""

MIX = {1: (1, 0), 2: (1, 1), 3: (2, 1), 4: (2, 2), 5: (3, 2), 6: (3, 3), 7: (4, 3), 8: (4, 4)}
"""Unknowns d: (transitions, parameters)."""


def run(report: Report, quick: bool) -> None:
    """All studies."""
    with_nodes(report, quick)
    with_unknowns(report, quick)
    for what, cases in GROWING.items():
        growing(report, what, cases[:2] if quick else cases)
    memory(report, quick)


def growing(report: Report, what: str, cases: tuple[tuple[int, int, int], ...]) -> None:
    """One of states, transitions and parameters grows: 200 cells, all methods."""
    rows = []
    for states, transitions, parameters in cases:
        problem = oscillators(transitions, parameters, states)
        calls = {method: _call(problem, 200, method) for method in SHOWN}
        timings = take_turns(calls, 15, block=3)
        of = {method: timing.minimum for method, timing in timings.items()}
        times = [ms(of[method]) for method in SHOWN]
        ratios = [f"{of[method] / of['auto']:.1f}" for method in SHOWN if method != "auto"]
        rows.append((states, transitions, parameters, *times, *ratios))
        report.data[f"{what} {(states, transitions, parameters)}"] = {m: vars(t) for m, t in timings.items()}
    report.section(f"Hessian against {what}: 200 cells (minima)")
    ratios = [f"{name.partition(' (')[0]} / auto" for method, name in SHOWN.items() if method != "auto"]
    report.table(("states", "transitions", "parameters", *SHOWN.values(), *ratios), rows)


def memory(report: Report, quick: bool) -> None:
    """Long logs, each in a process of its own."""
    rows = []
    sizes = (10_000,) if quick else (10_000, 30_000, 100_000)
    for method in ("auto",) if quick else SHOWN:
        for size in sizes:
            command = [sys.executable, "-m", "benchmarks.memory", str(size), method]
            root = Path(__file__).parent.parent
            done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
            found = json.loads(done.stdout)
            report.data[f"memory {method} {size}"] = found
            of_all = f"{found['largest']:.0f} MB", f"{found['before']:.0f} MB"
            rows.append((SHOWN[method], size, f"{found['seconds']:.3f} s", f"{found['first']:.1f} s", *of_all))
            if method == "auto" and size == sizes[-1] and not quick:
                report.target(f"(J, g, H) on {size} samples", 1.0, found["seconds"], "s")
                report.target(f"memory of (J, g, H) on {size} samples", 1000.0, found["largest"], "MB")
    report.section("(J, g, H) of long logs: 5 states, 5 transitions, 5 parameters, a step a sample")
    header = ("method", "samples", "an evaluation", "the first", "largest memory of the process", "of it before")
    report.table(header, rows)


def oscillators(transitions: int, parameters: int, states: int = 4) -> sf.Problem:
    """A chain of nonlinear oscillators whose two modes take turns, `parameters` stiffnesses and dampings in them."""

    def mode(sign: float) -> Any:
        def f(t: Any, x: Any, p: Any) -> Any:
            q, v = x[: states // 2], x[states // 2 :]
            k = p["k"] if parameters else jnp.zeros(0)
            force = -jnp.sin(q) - 0.1 * v + 0.2 * sign * jnp.cos(t)
            for i in range(parameters):
                force = force + sign**i * k[i] * (q * v if i % 2 else jnp.tanh(jnp.roll(q, i) - q)) / (1 + i)
            return jnp.concatenate([v, force])

        return f

    system = sf.HybridSystem({"a": mode(1.0), "b": mode(-1.0)}, 0.5 * np.ones(states))
    times = HORIZON * (np.arange(transitions) + 1.0) / (transitions + 1) + 1e-3
    sequence = tuple("ab"[i % 2] for i in range(transitions + 1))
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: 0.5 * (x @ x)), sequence, tuple(times), 0.0, HORIZON)
    free = {"k": sf.Parameter(np.linspace(0.1, 0.3, parameters))} if parameters else {}
    return sf.Problem(system, run, free)


def _call(problem: sf.Problem, cells: int, method: Any) -> partial[Any]:
    evaluator = Evaluator(problem, meshes=[Mesh.from_times(np.linspace(0.0, HORIZON, cells + 1))])
    return partial(evaluator, problem.initial_theta, method=method)


def with_nodes(report: Report, quick: bool) -> None:
    """20 unknown transitions, 10 parameters, meshes of more and more nodes."""
    problem = oscillators(20, 10)
    sizes = NODES[:3:2] if quick else NODES
    calls = {str(size): _call(problem, size - 1, "auto") for size in sizes}
    timings = take_turns(calls, 5 if quick else 30, block=3)
    least = np.array([timings[str(size)].minimum for size in sizes])
    exponent, _ = np.polyfit(np.log(sizes), np.log(least), 1)
    report.section("Hessian against nodes: 20 transitions, 10 parameters, 4 states")
    report.table(
        ("nodes", "median", "minimum", "a node"),
        [
            (size, ms(timings[str(size)].median), ms(t), f"{t / size * 1e6:.2f} us")
            for size, t in zip(sizes, least, strict=True)
        ],
    )
    last = float(np.log(least[-1] / least[-2]) / np.log(sizes[-1] / sizes[-2]))
    report.note(f"Fitted exponent of the minimum: {exponent:.2f} (1 is linear); between the last two sizes {last:.2f}.")
    report.data["nodes"] = {"exponent": float(exponent), **{name: vars(t) for name, t in timings.items()}}
    report.target("exponent of the Hessian's cost in nodes", 1.1, float(exponent), "")


def with_unknowns(report: Report, quick: bool) -> None:
    """JAX forward over forward against forward over backward, 200 cells, for d = 1 to 8 unknowns."""
    rows = []
    forward_wins = []
    for d, (transitions, parameters) in MIX.items():
        if quick and d > 2:
            break
        problem = oscillators(transitions, parameters)
        calls = {method: _call(problem, 200, method) for method in METHODS}
        timings = take_turns(calls, 20 if quick else 100)
        forward, adjoint = (timings[method].minimum for method in METHODS)
        forward_wins.append(forward < adjoint)
        rows.append((d, transitions, parameters, ms(forward), ms(adjoint), f"{forward / adjoint:.2f}"))
        report.data[f"unknowns {d}"] = {method: vars(t) for method, t in timings.items()}
    justified = len(forward_wins) if all(forward_wins) else forward_wins.index(False)
    report.section("Forward against discrete-adjoint, 200 cells, 4 states (minima)")
    report.table(("unknowns", "transitions", "parameters", "forward", "discrete-adjoint", "forward / adjoint"), rows)
    report.note(f"Forward wins up to {justified} unknowns.")
    report.data["forward up to"] = justified
