"""The command ``python -m benchmarks online``."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

import switchfit as sf
from benchmarks import machine
from benchmarks.online import exact, long, side_by_side
from benchmarks.online.drives import SENSORS, Drive, build_problem, simulate
from benchmarks.report import RESULTS, format_table
from switchfit.online.calibration import NEVER
from switchfit.online.estimator import THRESHOLD

QUIET, QUIET_LENGTH, LEVELS = 200, 20.0, (8.0, 10.0, 12.0)
"""Drives without a change, s, and thresholds at which alarms in them are counted."""


def find_maxima(report: Callable[[str], None]) -> dict[str, np.ndarray]:
    """Return the largest statistic of drives without a change: switchfit's, and that of the exact likelihood ratio."""
    online = sf.OnlineEstimator(build_problem("positions"), threshold=NEVER)
    found: dict[str, list[float]] = {"switchfit": [], "exact": []}
    for seed in range(QUIET):
        drive = simulate(np.zeros(0), QUIET_LENGTH, np.random.default_rng(seed))
        online.reset()
        found["switchfit"].append(max(online.update(t, y).statistic for t, y in drive.read("positions")))
        found["exact"].append(float(exact.find_ratios(drive).max()))
    report(f"{QUIET} drives without a change")
    return {name: np.array(values) for name, values in found.items()}


def compare_with_wanted(
    told: list[side_by_side.Told],
    rows: list[tuple[str, ...]],
    drives: list[Drive],
    maxima: dict[str, np.ndarray],
    seconds: np.ndarray,
) -> list[str]:
    """Return the table of what was wanted before the estimator was written, what is reached, and what could be."""
    row = dict(zip(side_by_side.HEADER, rows[0], strict=True))
    right = sum(not one.wrong for one in told)
    p50, p99 = np.percentile(1e3 * seconds, [50, 99])
    delays = [side_by_side.find_delay(exact.find_ratios(drive) > THRESHOLD, drive, 0) for drive in drives]
    largest, shares = (
        [form(own) for own in maxima.values()]
        for form in (
            lambda own: ", ".join(f"{value:.1f}" for value in np.percentile(own, [50, 90, 95, 100])),
            lambda own: ", ".join(f"{np.mean(own > level):.1%} at {level:g}" for level in LEVELS),
        )
    )
    return format_table(
        ("", "wanted", "reached", "exact likelihood ratio"),
        [
            ("drives with the right sequence", "20 of 20", f"{right} of {len(told)}", ""),
            (
                "slip known after: median, largest (s)",
                "0.70, 0.80",
                row["slip known after"],
                f"{np.median(delays):.2f}, {max(delays):.2f}",
            ),
            ("stick known after: median, largest (s)", "0.50, 0.60", row["stick known after"], ""),
            ("drives with an alarm before it slips", "0", row["early"], ""),
            ("an update, p50 and p99 (ms)", "1, 5", f"{p50:.2f}, {p99:.2f}", ""),
            (
                f"largest statistic in {QUIET} drives of {QUIET_LENGTH:g} s without a change: 50, 90, 95, 100 %",
                "6.8, 9.4, 11.1, 11.9",
                *largest,
            ),
            ("drives of those with an alarm", "25% at 8, 7.5% at 10, 0 at 12", *shares),
        ],
    )


def main(arguments: list[str]) -> None:
    """Run all drives, print the tables and write them to benchmarks/results."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks online", description=__doc__)
    parser.add_argument("--drives", type=int, default=20, help="short ones, for each sensor")
    parser.add_argument("--seconds", type=float, default=10_000.0, help="length of the long drive")
    parser.add_argument("--changes", type=int, default=56, help="in it")
    parser.add_argument("--thresholds", type=float, nargs="+", default=[12.0, 25.0], help="for it")
    options = parser.parse_args(arguments)
    cores = machine.use_one_core()
    described, began = machine.describe(cores), time.perf_counter()

    def report(what: str) -> None:
        print(f"{time.perf_counter() - began:5.0f} s  {what}", flush=True)

    lines, seconds = long.study(options.seconds, options.changes, options.thresholds, report)
    drives, others = (side_by_side.simulate_drives(seeds) for seeds in (range(options.drives), side_by_side.TUNING))
    compared, told = {}, []
    for sensor in SENSORS:
        compared[sensor], of_ours = side_by_side.compare(sensor, drives, others, report)
        told = told or of_ours
    maxima = find_maxima(report)
    wanted = compare_with_wanted(told, compared["positions"], drives, maxima, next(iter(seconds.values())))
    tables = []
    for sensor, rows in compared.items():
        tables += [f"Measured: {sensor}.", "", *format_table(side_by_side.HEADER, rows), ""]
    packages = ", ".join(f"{name} {described['packages'][name]}" for name in ("switchfit", "filterpy", "casadi"))
    text = "\n".join(
        [
            f"{options.drives} drives of {side_by_side.LENGTH:g} s, ten samples a second, slip from about 6 s to "
            f"10 s. {side_by_side.MEANING}",
            "",
            *tables,
            "What was wanted of an estimator from positions, before it was written; and what the exact likelihood "
            "ratio of one change, on a fine grid of its time and mu, says of the same samples:",
            "",
            *wanted,
            "",
            *lines,
            "",
            f"One core of {described['cpu']}; {packages}; load at the start {described['load'][0]}; "
            f"{time.perf_counter() - began:.0f} s in all.",
        ]
    )
    print(text)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "online.md").write_text(text + "\n", encoding="utf-8")
