"""A ball that bounces eight times: how springy is it, when the times of its bounces are only roughly known?

The ground is a guard: a bounce is where the height is 0. The heights in ball.csv are made up: `simulate` (seed 7)
writes 50 of them a second, with noise of 5 mm. The guesses of the bounces are up to 30 ms off, as if read from a video.

``python examples/ball/ball.py`` fits, from many guesses too, and bootstraps; with a folder as its argument it writes
the figure there. ``python examples/ball/ball.py --simulate`` makes ball.csv.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOG = Path(__file__).parent / "ball.csv"
GRAVITY, SIGMA, END, SEED = 9.81, 0.005, 3.45, 7
TRUTH = {"e": 0.8, "z0": 1.0, "vz0": 0.5}
"""Restitution, height (m) and speed upwards (m/s) at the start."""
BOUNCES, OFF = 8, 0.03
"""Bounces in the log, and by how much the guesses of their times are off at most (s)."""


def bounce_times(e: float, z0: float, vz0: float) -> np.ndarray:
    """Return the times of the bounces in closed form: (8,)."""
    speed = np.sqrt(vz0**2 + 2 * GRAVITY * z0)
    flights = 2 * speed / GRAVITY * e ** np.arange(1, BOUNCES)
    return np.cumsum([(vz0 + speed) / GRAVITY, *flights])


def heights(times: np.ndarray, e: float, z0: float, vz0: float) -> np.ndarray:
    """Return the heights without noise, in closed form."""
    impacts = bounce_times(e, z0, vz0)
    speeds = np.sqrt(vz0**2 + 2 * GRAVITY * z0) * e ** np.arange(1, BOUNCES + 1)
    bounce = np.searchsorted(impacts, times) - 1
    since = times - np.where(bounce < 0, 0.0, impacts[bounce])
    rising = np.where(bounce < 0, vz0, speeds[bounce])
    return np.where(bounce < 0, z0, 0.0) + rising * since - 0.5 * GRAVITY * since**2


def simulate() -> np.ndarray:
    """Return the log: times (s) and noisy heights (m), (172, 2)."""
    times = 0.02 * np.arange(1, 173)
    noise = np.random.default_rng(SEED).normal(0.0, SIGMA, len(times))
    return np.column_stack([times, heights(times, **TRUTH) + noise]).round(5)


def read() -> np.ndarray:
    """Return the log in ball.csv: times (s) and heights (m), (172, 2)."""
    return np.loadtxt(LOG, delimiter=",", skiprows=1)


ball = sf.HybridSystem(
    modes={"air": lambda t, x, p: jnp.stack([x[1], -GRAVITY + 0.0 * x[0]])},
    initial_state=lambda p: jnp.stack([p["z0"], p["vz0"]]),
    reset_maps={("air", "air"): lambda t, x, p: jnp.stack([x[0], -p["e"] * x[1]])},
    guards={("air", "air"): lambda t, x, p: x[0]},
    state_names=("z", "vz"),
    state_units=("m", "m/s"),
)


def make_guesses(count: int, seed: int = SEED) -> np.ndarray:
    """Return guesses of all unknowns: times up to 30 ms off, e up to 0.2, z0 and vz0 up to 0.3: (count, 11)."""
    random = np.random.default_rng(seed)
    truth = np.concatenate([bounce_times(**TRUTH), list(TRUTH.values())])
    return truth + random.uniform(-1.0, 1.0, (count, BOUNCES + 3)) * np.repeat([OFF, 0.2, 0.3], [BOUNCES, 1, 2])


def make_problem(guess: np.ndarray | None = None) -> sf.Problem:
    """Return the problem with a guess of all unknowns, (11,); the first of `make_guesses` if left out."""
    guess = make_guesses(1)[0] if guess is None else guess
    times, z = read().T
    log = sf.Measurements(times, z, observe=lambda t, x, p: x[0], sigma=SIGMA, names=("height",))
    run = sf.Experiment(log, ("air",) * (BOUNCES + 1), tuple(guess[:BOUNCES]), t0=0.0, tf=END)
    e, z0, vz0 = guess[BOUNCES:]
    parameters = {
        "e": sf.Parameter(e, lower=0.1, upper=1.0),
        "z0": sf.Parameter(z0, lower=0.1, upper=3.0, unit="m"),
        "vz0": sf.Parameter(vz0, lower=-3.0, upper=3.0, unit="m/s"),
    }
    return sf.Problem(ball, run, parameters)


def plot(estimate: sf.Estimate, study: Any) -> Figure:
    """Draw the log with the fit and the guesses of the bounces, and below how far off guesses and estimates are."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(3, 2))
    times, z = read().T
    fine = np.linspace(0.0, END, 2000)
    fitted = {name: float(value) for name, value in estimate.parameters.items()}
    above.plot(times, z, ".", color="#222222", markersize=3, label="measured, 50 a second")
    above.plot(fine, heights(fine, **fitted), color="#b2182b", linewidth=1, label="fitted")
    guesses = estimate.problem.initial_theta[:BOUNCES]
    above.plot(guesses, np.zeros(BOUNCES), "|", color="#4a7fb5", markersize=14, label="guesses of the bounces")
    above.set_xlabel("t (s)")
    above.set_ylabel("height (m)")
    above.legend(frameon=False, fontsize=8, ncols=3, loc="upper right")
    truth, number = bounce_times(**TRUTH), np.arange(1, BOUNCES + 1)
    found = 1e3 * (estimate.theta[:BOUNCES] - truth)
    below.axhline(0.0, color="#bbbbbb", linewidth=0.8)
    bars = {"capsize": 2, "markersize": 3, "linewidth": 1}
    reported, resampled = (1.96e3 * errors[:BOUNCES] for errors in (estimate.standard_errors, study.standard_deviation))
    below.errorbar(number - 0.08, found, reported, fmt="o", color="#b2182b", label="95 %, Hessian", **bars)
    below.errorbar(number + 0.08, found, resampled, fmt="s", color="#222222", label="95 %, bootstrap", **bars)
    below.set_xlabel("bounce (the guesses are up to 30 ms off)")
    below.set_ylabel("estimate less truth (ms)")
    below.legend(frameon=False, fontsize=8, loc="lower left", ncols=2)
    return figure


def main(folder: Path | None = None) -> None:
    """Fit from one guess and from many, bootstrap, and draw."""
    problem = make_problem()
    estimate = sf.estimate(problem)
    print(estimate, end="\n\n")
    print(sf.multistart(problem, make_guesses(32)), end="\n\n")
    study = sf.bootstrap(estimate, 200)
    print(study)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        plot(estimate, study).savefig(folder / "ball.svg")


if __name__ == "__main__":
    if sys.argv[1:] == ["--simulate"]:
        np.savetxt(LOG, simulate(), delimiter=",", header="t (s),z (m)", comments="", fmt="%.5f")
    else:
        main(*map(Path, sys.argv[1:2]))
