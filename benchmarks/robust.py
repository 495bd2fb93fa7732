"""How often 95 % intervals of fits with robust losses hold the truth, by H^-1 and by the sandwich covariance.

A line is fitted to noise of several kinds, by iterated weights and without switchfit. The losses have the scales of
sigma = 1, which is right for most of the noise but for the last kind. ``python -m benchmarks.robust [RUNS]`` prints
the table of ``docs/measured/robust.md``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import scipy.special

from switchfit.arrays import FloatArray
from switchfit.problem.losses import influence, robust

RUNS = 2000
LOSSES = (("huber", 1.5), ("soft_l1", 1.0), ("cauchy", 2.385))
Noise = Callable[[np.random.Generator, int], FloatArray]
NOISE: dict[str, Noise] = {
    "normal": lambda rng, n: rng.standard_normal(n),
    "every tenth five times as large": lambda rng, n: rng.standard_normal(n) * np.where(rng.random(n) < 0.1, 5.0, 1.0),
    "every fifth five times as large": lambda rng, n: rng.standard_normal(n) * np.where(rng.random(n) < 0.2, 5.0, 1.0),
    "Student's t, 3 degrees of freedom": lambda rng, n: rng.standard_t(3, n),
    "normal, twice sigma": lambda rng, n: 2.0 * rng.standard_normal(n),
}
SMALL = 1e-4
"""Step of the difference that is the second derivative of a loss."""
ITERATIONS = 60


def measure_coverage(loss: str, scale: float, noise: Noise, n: int, runs: int, seed: int = 0) -> tuple[float, float]:
    """Return the parts of the intervals of the slope that hold the truth, 0, by H^-1 and by the sandwich.

    Parameters
    ----------
    loss : str
    scale : float
    noise : callable
    n : int
        Number of samples.
    runs, seed : int
    """
    rng = np.random.default_rng(seed)
    X = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)
    quantiles = scipy.special.ndtri(0.975), scipy.special.stdtrit(n - 2, 0.975)
    held = np.zeros(2)
    for _ in range(runs):
        y = noise(rng, n)
        b = np.linalg.lstsq(X, y, rcond=None)[0]
        for _ in range(ITERATIONS):
            weighted = X * influence(loss, scale, (y - X @ b) ** 2)[:, None]
            b = np.linalg.solve(weighted.T @ X, weighted.T @ y)
        r = y - X @ b
        pull = influence(loss, scale, r**2) * r
        costs = [0.5 * robust(loss, scale, (r + step) ** 2) for step in (-SMALL, 0.0, SMALL)]
        bend = (costs[0] - 2 * costs[1] + costs[2]) / SMALL**2
        bread = np.linalg.inv((X * bend[:, None]).T @ X)
        sandwich = n / (n - 2) * bread @ (X * (pull**2)[:, None]).T @ X @ bread
        for k, covariance in enumerate((bread, sandwich)):
            held[k] += abs(b[1]) < quantiles[k] * np.sqrt(max(covariance[1, 1], 0.0))
    return float(held[0] / runs), float(held[1] / runs)


def main(runs: int = RUNS) -> None:
    """Print the table."""
    print("| noise | samples | " + " | ".join(f"{loss}, C = {scale:g}: H⁻¹, sandwich" for loss, scale in LOSSES) + " |")
    print("|---|---|" + "---|" * len(LOSSES))
    for name, noise in NOISE.items():
        for n in (40, 200):
            found = [measure_coverage(loss, scale, noise, n, runs) for loss, scale in LOSSES]
            print(
                f"| {name} | {n} | " + " | ".join(f"{100 * a:.1f} %, {100 * b:.1f} %" for a, b in found) + " |",
                flush=True,
            )
    print(f"\n{runs} logs a cell; one standard error is {100 * np.sqrt(0.05 * 0.95 / runs):.1f} %.")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
