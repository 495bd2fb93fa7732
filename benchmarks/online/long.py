"""One long drive, and one as long in which the vehicle never slips: what is found, and what an update takes."""

from __future__ import annotations

import resource
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import switchfit as sf
from benchmarks.online.drives import Drive, build_problem, simulate
from benchmarks.report import format_table

SENSOR, WINDOW = "positions and headings", 15.0
APART = 8.0
"""Shortest time between two changes, s."""
FOUND = ("threshold", "changes found", "other alarms", "delay: median, largest", "errors", "alarms in a quiet drive")
TAKEN = ("threshold", "p50", "p90", "p99", "p99.9", "longest", "p50 in the first and last sixth", "memory")
LIMITS = (0.0, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 3.0, 5.0, 10.0, np.inf)
"""Of the histogram, in ms."""


class Followed(NamedTuple):
    """What was said of a drive, the seconds of each update, and the memory of the process in MB after each fifth."""

    alarms: list[sf.Alarm]
    retracted: int
    now: sf.Now
    seconds: np.ndarray
    memory: list[float]


def simulate_long(length: float, changes: int, seed: int = 4) -> Drive:
    """Return a drive with changes at random times."""
    rng = np.random.default_rng(seed)
    room = np.sort(rng.uniform(0.0, length - 20.0 - APART * changes, changes))
    return simulate(10.0 + room + APART * np.arange(changes), length, rng)


def follow(drive: Drive, threshold: float, report: Callable[[str], None]) -> Followed:
    """Return what is said of a drive."""
    online = sf.OnlineEstimator(build_problem(SENSOR), window=WINDOW, threshold=threshold)
    alarms, retracted, seconds, memory = [], 0, np.zeros(len(drive.times)), []
    for k, (t, y) in enumerate(drive.read(SENSOR)):
        now = online.update(t, y)
        seconds[k] = now.seconds
        alarms += [now.alarm] if now.alarm is not None else []
        retracted += now.retracted is not None
        if (k + 1) % (len(drive.times) // 5) == 0:
            memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
            report(f"threshold {threshold:g}, {len(drive.taus)} changes: {k + 1} updates")
    return Followed(alarms, retracted, now, seconds, memory)


def study(
    length: float, changes: int, thresholds: list[float], report: Callable[[str], None]
) -> tuple[list[str], dict[float, np.ndarray]]:
    """Return the lines of the tables, and the seconds of each update by threshold."""
    drive, quiet = simulate_long(length, changes), simulate_long(length, 0)
    rows, latencies, seconds = [], [], {}
    for threshold in thresholds:
        one, other = follow(drive, threshold, report), follow(quiet, threshold, report)
        taus, now = drive.taus, one.now
        right = len(now.transition_times) == len(taus)
        delays = [min((a.time - tau for a in one.alarms if a.time >= tau), default=np.nan) for tau in taus]
        away = (now.transition_times - taus) / now.time_errors if right else np.array([np.nan])
        rows.append(
            (
                f"{threshold:g}",
                f"{len(taus)}: {'all, and no other' if right else len(now.transition_times)}",
                f"{len(one.alarms) - len(taus)}, {one.retracted} retracted",
                f"{np.median(delays):.2f} s, {max(delays):.2f} s",
                f"{np.sqrt((away**2).mean()):.2f}",
                f"{len(other.alarms)}, {other.retracted} retracted",
            )
        )
        seconds[threshold] = one.seconds
        percentiles = np.percentile(1e3 * one.seconds, [50, 90, 99, 99.9, 100])
        latencies.append(
            (
                f"{threshold:g}",
                *(f"{value:.2f}" for value in percentiles),
                ", ".join(f"{1e3 * np.median(part):.2f}" for part in np.array_split(one.seconds, 6)[::5]),
                ", ".join(f"{value:.0f}" for value in one.memory),
            )
        )
    counts, limits = np.histogram(1e3 * one.seconds, LIMITS)
    lines = [
        f"{len(drive.times)} updates, a window of {WINDOW:g} s, 40 hypotheses. Errors: root mean square of what the "
        "transition times are off, in their own standard errors.",
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
    ]
    return lines, seconds
