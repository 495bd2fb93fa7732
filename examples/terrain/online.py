"""Sample by sample: when does the robot know that the ground has changed, how late, and how often is it wrong?

The nine logs of terrain.py, fed to an online estimator as if they were driven now. What it must know beforehand is the
noise: it is measured in the first second of each log, before any border. Times of the borders are those that terrain.py
finds afterwards in the whole logs. Run it:

    python examples/terrain/online.py [--threshold 50] [--out DIR]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from terrain import BEGIN, CHANNELS, GRAY, GREEN, LEVELS, SHORTEST, UNITS, read, robot

import switchfit as sf

BORDERS = {
    "green_table_00": (10.49,),
    "green_table_06": (4.52,),
    "green_table_12": (4.07, 8.97),
    "green_table_18": (2.32,),
    "green_table_24": (3.41,),
    "green_table_30": (2.31,),
    "table_gray_00": (),
    "table_gray_06": (13.41,),
    "table_gray_12": (7.98, 8.40),
}
"""Times (s) at which a wheel comes upon the other surface or leaves it, as the search finds them in each whole log."""

LAG = 0.15  # s
FIRST = 1.0  # s in which the noise is measured


def make_problem(name):
    """Return the problem of one log, with the noise of its first second, and its levels to be found."""
    times, values = read(name)
    early = values[times < BEGIN + FIRST]
    sigma = np.nanstd(early, axis=0, ddof=1)
    data = sf.Measurements(times, values, sigma=np.maximum(sigma, 0.02), names=CHANNELS, units=UNITS)
    run = sf.Experiment(data, ("neither",), t0=BEGIN, tf=times[-1], name=name)
    lags = {lag: sf.Parameter(LAG, fixed=True) for lag in ("lag_I", "lag_v")}
    return sf.Problem(robot(), run, LEVELS | lags)


def follow(name, threshold):
    """Return what the estimator says of one log."""
    return sf.replay(make_problem(name), threshold=threshold, min_duration=SHORTEST)


def count(log, borders):
    """Return how late each border was known (s), NaN where it was not, and how many alarms belong to none."""
    delays = log.delays(borders)
    return delays, len(log.alarms) - int(np.isfinite(delays).sum())


def main():
    """Print a line for each log."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threshold", type=float, default=50.0)
    parser.add_argument("--out", type=Path, help="folder for a figure of each log")
    given = parser.parse_args()
    print(f"{'log':<15}{'border (s)':>14}{'known after (s)':>18}{'other alarms':>14}{'retracted':>11}")
    for name in (*GREEN, *GRAY):
        log = follow(name, given.threshold)
        delays, others = count(log, BORDERS[name])
        borders = ", ".join(f"{t:.2f}" for t in BORDERS[name]) or "-"
        late = ", ".join("never" if np.isnan(d) else f"{d:.2f}" for d in delays) or "-"
        print(f"{name:<15}{borders:>14}{late:>18}{others:>14}{len(log.retracted):>11}")
        if given.out:
            given.out.mkdir(parents=True, exist_ok=True)
            log.plot().savefig(given.out / f"{name}.png")


if __name__ == "__main__":
    main()
