"""How often 95 % intervals of a transition time hold the truth, with the truth on, beside and between samples.

A state rests at 0 and rises to 1 with the time constant 1/8 s from tau on; it is sampled every 0.1 s, so that most of
what is known about tau comes from the one or two samples after it. ``python benchmarks/coverage.py [RUNS]`` prints the
table of ``docs/measured/coverage.md``.

The last column is computed apart, without switchfit: the region where twice the rise of the profile stays below the
quantile of chi², from the solution in closed form on a grid of tau and k. It is what the likelihood ratio can do.
"""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

import numpy as np

import switchfit as sf
from switchfit.fit.result import Fit

TIMES = np.arange(1, 41) / 10
RATE, SIGMA, RUNS = 8.0, 0.05, 1000
CHI2 = 3.841458820694124
"""95 % quantile of chi² with one degree of freedom."""
PLACES = {2.0: "on a sample", 2.01: "0.01 s beside it", 2.05: "between two samples"}


class Coverage(NamedTuple):
    """Parts of the intervals that hold the truth, of single fits and of `estimate_many`, of the fits that end at a
    kink, and of the regions of the likelihood ratio that hold the truth.
    """

    quadratic: float
    piecewise: float
    many: float
    at_kink: float
    exact: float


def rest(t: Any, x: Any, p: Any) -> Any:
    """x' = 0."""
    return 0.0 * x


def charge(t: Any, x: Any, p: Any) -> Any:
    """x' = k (1 - x)."""
    return p["k"] * (1.0 - x)


def build_problem(values: Any, tau: float, *, rate_known: bool, sigma: float = SIGMA) -> sf.Problem:
    """Return the problem with tau as the first guess."""
    system = sf.HybridSystem(modes={"rest": rest, "charge": charge}, initial_state=[0.0])
    run = sf.Experiment(sf.Measurements(TIMES, values, sigma=sigma), ("rest", "charge"), (tau,), 0.0, 4.0)
    k = sf.Parameter(RATE, fixed=True) if rate_known else sf.Parameter(RATE, lower=0.5, upper=40.0)
    return sf.Problem(system, run, {"k": k})


def measure_coverage(tau: float, runs: int, *, rate_known: bool, seed: int = 5) -> Coverage:
    """Fit `runs` logs with noise and count the intervals that hold tau."""
    rng = np.random.default_rng(seed)
    clean = np.where(tau < TIMES, 1 - np.exp(-RATE * (TIMES - tau)), 0.0)
    logs = [(clean + SIGMA * rng.standard_normal(len(TIMES)))[:, None] for _ in range(runs)]
    problems = [build_problem(values, tau, rate_known=rate_known) for values in logs]
    counts = np.zeros(4)
    exact = float(np.mean(compare_likelihoods(np.array(logs)[:, :, 0], tau, rate_known=rate_known) <= CHI2))
    together = sf.estimate_many(problems).confidence_intervals()[:, 0]
    for problem, (least, most) in zip(problems, together, strict=True):
        fit = sf.estimate(problem, strategy="local")
        (low, high), (lower, upper) = Fit.confidence_intervals(fit)[0], fit.confidence_intervals()[0]
        counts += low <= tau <= high, lower <= tau <= upper, least <= tau <= most, bool(fit.kinks)
    return Coverage(*(counts / runs), exact)


def compare_likelihoods(logs: np.ndarray, tau: float, *, rate_known: bool) -> np.ndarray:
    """Return twice the rise of the profile at the true tau above its lowest minimum, for each log: (R,).

    Parameters
    ----------
    logs : (R, K)
    tau : float
    rate_known : bool
    """
    taus = np.unique(np.append(np.linspace(tau - 0.25, tau + 0.25, 501), tau))
    rates = np.array([RATE]) if rate_known else np.geomspace(2.0, 40.0, 400)
    after = np.maximum(TIMES - taus[:, None], 0.0)
    profiles = np.full((len(taus), len(logs)), np.inf)
    for k in rates:
        outputs = 1 - np.exp(-k * after)
        costs = 0.5 * np.sum(outputs**2, axis=1)[:, None] - outputs @ logs.T
        np.minimum(profiles, costs, out=profiles)
    here = int(np.searchsorted(taus, tau))
    return 2 * (profiles[here] - profiles.min(axis=0)) / SIGMA**2


def main(runs: int = RUNS) -> None:
    """Print the table."""
    kinds = "theta ± quantile x standard error | piecewise | of `estimate_many`"
    print(f"| true transition time | rate | {kinds} | fits at a kink | likelihood ratio, computed apart |")
    print("|---|---|---|---|---|---|---|")
    for tau, place in PLACES.items():
        for known in (True, False):
            found = measure_coverage(tau, runs, rate_known=known)
            rate = "known" if known else "estimated"
            print(f"| {place} | {rate} | {' | '.join(f'{100 * part:.1f} %' for part in found)} |")
    print(f"\n{runs} logs a line.")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
