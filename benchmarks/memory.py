"""Memory and time of (J, g, H) on a long log, in its own process: ``python -m benchmarks.memory SAMPLES METHOD``."""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from switchfit.discretization.mesh import Mesh
from switchfit.meshes.evaluator import Evaluator

HORIZON = 100.0


def mode(sign: float) -> Any:
    """Five coupled states, five parameters."""

    def f(t: Any, x: Any, p: Any) -> Any:
        k = p["k"]
        return jnp.stack(
            [
                x[1],
                -x[0] * (1 + k[0]) - k[1] * x[1] + 0.1 * sign * jnp.sin(t),
                x[3] - k[2] * x[4],
                -x[2] - 0.1 * x[3] + k[3] * x[0] * sign,
                -k[4] * x[4] + 0.1 * jnp.tanh(x[0]),
            ]
        )

    return f


def evaluator(samples: int) -> Evaluator:
    """All five states measured `samples` times; five unknown transitions. One step from sample to sample."""
    system = sf.HybridSystem({"a": mode(1.0), "b": mode(-1.0)}, [1.0, 0.0, 0.5, 0.0, 0.2])
    times = np.linspace(HORIZON / samples, HORIZON, samples)
    values = np.random.default_rng(0).standard_normal((samples, 5))
    guess = HORIZON * (np.arange(5) + 1) / 6 + 3e-4
    run = sf.Experiment(sf.Measurements(times, values, sigma=1.0), tuple("ababab"), tuple(guess), 0.0, HORIZON)
    problem = sf.Problem(system, run, {"k": sf.Parameter([0.1, 0.2, 0.1, 0.05, 0.3])})
    return Evaluator(problem, meshes=[Mesh.from_times(np.append(0.0, times))])


def main() -> None:
    """Print seconds of an evaluation, seconds of the first, and the largest memory of the process (MB)."""
    samples, method = int(sys.argv[1]), sys.argv[2]
    before = _megabytes()
    evaluate = evaluator(samples)
    theta = evaluate.problem.initial_theta
    began = time.perf_counter()
    evaluate(theta, method=method)  # type: ignore[arg-type]
    first = time.perf_counter() - began
    taken = []
    for _ in range(5):
        began = time.perf_counter()
        evaluate(theta, method=method)  # type: ignore[arg-type]
        taken.append(time.perf_counter() - began)
    print(json.dumps({"seconds": float(np.median(taken)), "first": first, "before": before, "largest": _megabytes()}))


def _megabytes() -> float:
    """Largest resident memory of this process so far. What Linux's getrusage says may be the parent's."""
    status = Path("/proc/self/status")
    if status.exists():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2  # macOS counts in bytes


if __name__ == "__main__":
    main()
