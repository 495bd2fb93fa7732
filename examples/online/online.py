"""Estimate while a simulated vehicle drives: when is it known that the wheels slip, and how often wrongly?

The skid-steered vehicle of the paper slips from 6 s to 10 s. A receiver gives its position ten times a second, with
an error of 5 cm; the friction mu is unknown, 0.8 guessed for 0.7. Run it:

    python examples/online/online.py [--drives 20] [--threshold 12] [--window 8] [--out DIR]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from switchfit.models import skid_steer

SLIPS, TRUE_MU, SIGMA = (6.0, 10.0), 0.7, 0.05  # s, 1, m
TIMES = np.arange(1, 151) / 10  # s
SYSTEM = skid_steer()
"""One system for all drives: its program is compiled once."""


def observe(t, x, p):
    """The position."""
    return jnp.stack([x[0], x[2]])


def make_problem(values=None, mu=0.8, sequence=("stick",), times=()):
    """Return the problem of a drive; all that it knows of the modes is that the vehicle sticks at first."""
    values = np.zeros((len(TIMES), 2)) if values is None else values
    data = sf.Measurements(TIMES, values, observe=observe, sigma=SIGMA, names=("X", "Y"), units=("m", "m"))
    run = sf.Experiment(data, sequence, times, t0=0.0, tf=TIMES[-1])
    return sf.Problem(SYSTEM, run, {"mu": sf.Parameter(mu, lower=0.05, upper=2.0, unit="1")})


def simulate(seed, *, slips=True):
    """Return the problem of a simulated drive, in which the vehicle slips for a while, or never does."""
    modes = (("stick", "slip", "stick"), SLIPS) if slips else (("stick",), ())
    path = sf.simulate(make_problem(None, TRUE_MU, *modes), times=TIMES).states[:, [0, 2]]
    return make_problem(path + SIGMA * np.random.default_rng(seed).standard_normal(path.shape))


def main():
    """Print how late and how often wrongly changes were declared, for all drives and for each as many without any."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--threshold", type=float, default=12.0)
    parser.add_argument("--window", type=float, help="seconds; all samples are kept without it")
    parser.add_argument("--out", type=Path, help="folder for the figure of the first drive")
    given = parser.parse_args()
    settings = {"threshold": given.threshold, "window": given.window}
    logs = [sf.replay(simulate(seed), **settings) for seed in range(given.drives)]
    quiet = [sf.replay(simulate(seed, slips=False), **settings) for seed in range(given.drives)]
    delays = np.array([log.delays(SLIPS) for log in logs])
    for mode, late in zip(("slip", "stick"), delays.T, strict=True):
        print(
            f"{mode:<6} known after {np.nanmedian(late):.1f} s (median), {np.nanmax(late):.1f} s (the latest);", end=""
        )
        print(f" {np.isfinite(late).sum()} of {len(late)} drives")
    others = sum(len(log.alarms) - 2 for log in logs)
    print(f"other alarms in these drives: {others}; retracted: {sum(len(log.retracted) for log in logs)}")
    print(f"alarms in {len(quiet)} drives without a change: {sum(len(log.alarms) for log in quiet)}")
    truth = np.array([*SLIPS, TRUE_MU])
    found = np.array([[*log.now.transition_times[-2:], log.now.parameters["mu"]] for log in logs])
    errors = [[*log.now.time_errors[-2:], log.now.standard_errors["mu"]] for log in logs]
    inside = np.mean(np.abs(found - truth) < 1.96 * np.array(errors), axis=0)
    print("inside the 95 % interval at the end: tau_1 {:.0%}, tau_2 {:.0%}, mu {:.0%}".format(*inside))
    seconds = np.concatenate([log.seconds for log in logs])
    print("an update took {:.1f} ms (median), {:.1f} ms (99 %)".format(*1e3 * np.percentile(seconds, [50, 99])))
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
        logs[0].plot().savefig(given.out / "online.png")


if __name__ == "__main__":
    main()
