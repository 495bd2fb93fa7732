"""An hour of driving, sample by sample: ``python -m benchmarks online``

The simulated vehicle drives for an hour and begins or ends to slip twenty times; positions and headings come ten times
a second, with an error of 5 cm and 0.05 rad. Which changes are found, how late, how well, and what an update takes; and
what comes of as many quiet drives, in which it never slips.
"""

from __future__ import annotations

import argparse
import resource

import numpy as np

import switchfit as sf
from benchmarks import machine
from benchmarks.report import RESULTS, format_table
from switchfit.models import skid_steer

PERIOD, SIGMA, MU, WINDOW = 0.1, 0.05, 0.7, 15.0
FOUND = ("threshold", "changes found", "other alarms", "delay: median, largest", "errors", "alarms in a quiet drive")
TAKEN = ("threshold", "p50", "p90", "p99", "p99.9", "longest", "p50 in the first and last sixth", "memory")
LIMITS = (0.0, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 3.0, 5.0, 10.0, np.inf)
"""Of the histogram, in ms."""
APART = 8.0
"""Shortest time between two changes, s."""

Drive = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Times of the changes (N,), times (K,), values (K, 3)."""


def simulate_drive(length: float, changes: int, seed: int) -> Drive:
    """Return a drive with changes at random times."""
    rng = np.random.default_rng(seed)
    room = np.sort(rng.uniform(0.0, length - 20.0 - APART * changes, changes))
    taus = 10.0 + room + APART * np.arange(changes)
    modes = tuple(("stick", "slip")[k % 2] for k in range(changes + 1))
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: 0.0), modes, tuple(taus), 0.0, length)
    times = PERIOD * np.arange(1, int(length / PERIOD))
    truth = sf.Problem(skid_steer(), run, {"mu": MU}, max_transitions=2 * changes + 4)
    states = sf.simulate(truth, times=times).states
    return taus, times, states[:, :3] + SIGMA * rng.standard_normal((len(times), 3))


def build_problem() -> sf.Problem:
    """Return what the estimator is told: the model, the sensor, and a guess of mu."""
    gps = sf.Measurements([], np.empty((0, 3)), lambda t, x, p: x[:3], SIGMA)
    run = sf.Experiment(gps, ("stick",), (), 0.0, 1.0)
    return sf.Problem(skid_steer(), run, {"mu": sf.Parameter(0.8, lower=0.05, upper=2.0)})


def follow(drive: Drive, threshold: float) -> tuple[list[sf.Alarm], int, sf.Now, np.ndarray, list[float]]:
    """Return alarms, how many were retracted, the last word, what each update took, and the memory at five times."""
    _, times, values = drive
    online = sf.OnlineEstimator(build_problem(), window=WINDOW, threshold=threshold)
    alarms, retracted, seconds, memory = [], 0, np.zeros(len(times)), []
    for k, (t, y) in enumerate(zip(times, values, strict=True)):
        now = online.update(t, y)
        seconds[k] = now.seconds
        alarms += [now.alarm] if now.alarm is not None else []
        retracted += now.retracted is not None
        if (k + 1) % (len(times) // 5) == 0:
            memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return alarms, retracted, now, seconds, memory


def main(arguments: list[str]) -> None:
    """Parse the command line, run the drives, print the tables and write them to benchmarks/results."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks online", description=__doc__.partition("\n")[0])
    parser.add_argument("--hours", type=float, default=1.0, help="length of the drive")
    parser.add_argument("--changes", type=int, default=20)
    parser.add_argument("--thresholds", type=float, nargs="+", default=[12.0, 25.0])
    options = parser.parse_args(arguments)
    length = 3600.0 * options.hours
    cores = machine.use_one_core()
    drives = {changes: simulate_drive(length, changes, seed=4) for changes in (options.changes, 0)}
    rows, latencies = [], []
    for threshold in options.thresholds:
        taus = drives[options.changes][0]
        alarms, retracted, now, seconds, memory = follow(drives[options.changes], threshold)
        quiet, taken_back, *_ = follow(drives[0], threshold)
        right = len(now.transition_times) == len(taus)
        delays = [min((a.time - tau for a in alarms if a.time >= tau), default=np.nan) for tau in taus]
        away = (now.transition_times - taus) / now.time_errors if right else np.array([np.nan])
        rows.append(
            (
                f"{threshold:g}",
                f"{len(taus)}: {'all, and no other' if right else len(now.transition_times)}",
                f"{len(alarms) - len(taus)}, {retracted} retracted",
                f"{np.median(delays):.2f} s, {max(delays):.2f} s",
                f"{np.sqrt((away**2).mean()):.2f}",
                f"{len(quiet)}, {taken_back} retracted",
            )
        )
        percentiles = np.percentile(1e3 * seconds, [50, 90, 99, 99.9, 100])
        latencies.append(
            (
                f"{threshold:g}",
                *(f"{value:.2f}" for value in percentiles),
                ", ".join(f"{1e3 * np.median(part):.2f}" for part in np.array_split(seconds, 6)[::5]),
                ", ".join(f"{value:.0f}" for value in memory),
            )
        )
    counts, limits = np.histogram(1e3 * seconds, LIMITS)
    described = machine.describe(cores)
    errors = "Errors: root mean square of what the transition times are off, in their own standard errors."
    lines = [
        f"{len(seconds)} updates, a window of {WINDOW:g} s, 40 hypotheses. {errors}",
        "",
        *format_table(FOUND, rows),
        "",
        "What an update takes, in ms, and the memory of the process, in MB, after each fifth of the drive:",
        "",
        *format_table(TAKEN, latencies),
        "",
        *format_table(
            ("ms", "updates, last threshold"),
            [(f"{a:g} to {b:g}", n) for a, b, n in zip(limits[:-1], limits[1:], counts.tolist(), strict=True) if n],
        ),
        "",
        f"One core of {described['cpu']}; load at the start {described['load'][0]}.",
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "online.md").write_text(text, encoding="utf-8")
