"""Effect of the end of the horizon, which the paper leaves for further analysis.

The effect on accuracy, on conditioning, and on the region of starts from which the optimum is reached. A horizon that
ends during slip has no second transition: only tau_1 and mu are estimated. The start of the horizon does not matter as
long as the state there is known: nothing in stick depends on the unknowns.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from switchfit.batch.simulated import monte_carlo
from switchfit.batch.starts import multistart
from switchfit.fit.evaluator import evaluate
from switchfit.paper import vehicle
from switchfit.paper.vehicle import BLUE, DARK, HORIZON, NAMES, RED, SYMBOLS, TRUTH, Figure, Found, Row, Say, stick_slip
from switchfit.problem.data import FloatArray, ReferenceSignal

TITLE = "Horizon"
#: Ends of the horizon (s); slip lasts from 6 to 10 s.
ENDS = (7.0, 8.0, 9.0, 10.0, 10.5, 11.0, 12.0, 13.0, 15.0, 18.0, 22.0, 26.0, 30.0)
QUICK_ENDS = (8.0, 10.5, 15.0, 26.0)
RUNS, QUICK_RUNS = 400, 32
STARTS, QUICK_STARTS = 512, 32
#: Noise of the positions (m), ten per second.
SIGMA, RATE = 0.1, 10
#: Largest relative distance to the truth at which an estimate counts as the optimum.
NEAR = 1e-4


def compute(quick: bool, folder: Path, say: Say) -> Found:
    """Fit the same problem on horizons of different lengths."""
    runs, starts = (QUICK_RUNS, QUICK_STARTS) if quick else (RUNS, STARTS)
    found: Found = {"runs": runs, "starts": starts, "horizons": []}
    for tf in QUICK_ENDS if quick else ENDS:
        say(f"0 to {tf:g} s")
        found["horizons"].append(_horizon(tf, runs, starts, folder))
    found["samples"] = _sample_sets()
    return found


def _sample_sets() -> list[Found]:
    """Return the standard error of mu from 1 Hz positions over several horizons, and without positions in slip."""
    path = vehicle.simulate_drive(tf=ENDS[-1])
    begin, end = TRUTH[:2]
    sets = [(f"0 to {tf:g} s", tf, np.arange(tf + 1)) for tf in (end, 11.0, 12.0, 13.0, HORIZON, 20.0, 30.0)]
    seconds = np.arange(HORIZON + 1)
    outside = seconds[(seconds <= begin) | (seconds > end)]
    sets.append((f"0 to {HORIZON:g} s without those in slip", HORIZON, outside))
    found: list[Found] = []
    for label, tf, times in sets:
        theta = TRUTH if tf > end else (TRUTH[0], TRUTH[2])
        hessian = evaluate(vehicle.fit_positions(path, times, theta, SIGMA, tf)).hessian
        inside = int(np.sum((times > begin) & (times <= end)))
        errors = np.sqrt(np.diag(np.linalg.inv(hessian)))
        found.append({"label": label, "samples": len(times), "in_slip": inside, "mu": float(errors[-1])})
    return found


def _horizon(tf: float, runs: int, starts: int, folder: Path) -> Found:
    """Return accuracy and conditioning with noisy positions; convergence of the noise-free fit of Fig. 4 from many
    starts.
    """
    path = vehicle.simulate_drive(tf=max(tf, HORIZON))
    times = np.arange(round(RATE * tf) + 1) / RATE
    names = NAMES if tf > TRUTH[1] else (NAMES[0], NAMES[2])
    truth = tuple(TRUTH[NAMES.index(name)] for name in names)
    noisy = vehicle.fit_positions(path, times, truth, SIGMA, tf)
    hessian, seed = evaluate(noisy).hessian, round(10 * tf)
    study = vehicle.complete(monte_carlo(noisy, runs, theta=truth, seed=seed, folder=folder / f"noise-{tf:g}"))
    here = slice(0, np.searchsorted(path.times, tf - 1e-9) + 1)  # without the second of two nodes at tf
    exact = stick_slip(ReferenceSignal.from_samples(path.times[here], path.states[here]), truth, tf=tf)
    search = vehicle.complete(multistart(exact, _starts(len(names), tf, starts), folder=folder / f"starts-{tf:g}"))
    arrived = search.success & np.all(np.abs(search.theta / truth - 1) < NEAR, axis=1)
    return {
        "tf": tf,
        "names": list(names),
        "standard_errors": (np.sqrt(np.diag(np.linalg.inv(hessian))) / truth).tolist(),
        "rms_errors": (np.sqrt(np.mean(study.errors**2, axis=0)) / truth).tolist(),
        "condition": float(np.linalg.cond(hessian * np.outer(truth, truth))),
        "arrived": float(np.mean(arrived)),
    }


def _starts(d: int, tf: float, count: int) -> FloatArray:
    """Return ordered transition times all over the horizon and mu from 0.2 to 2, from a Sobol sequence."""
    from scipy.stats import qmc  # imported here, since that takes long

    cube = qmc.Sobol(d, seed=0).random(count)
    times = np.sort(tf * (0.005 + 0.99 * cube[:, :-1]), axis=1)
    times[:, 1:] = np.maximum(times[:, 1:], times[:, :-1] + 1e-3)
    return np.column_stack([times, 0.2 + 1.8 * cube[:, -1]])


def draw(found: Found) -> dict[str, Figure]:
    """Draw accuracy, conditioning and region of convergence against the end of the horizon."""
    figure = vehicle.new_figure(vehicle.COLUMN, 5.6)
    accuracy, conditioning, region = figure.subplots(3, 1, sharex=True, height_ratios=(1.6, 1, 1))
    levels = found["horizons"]
    for name, colour, marker in zip(NAMES, (RED, BLUE, DARK), ("o", "s", "^"), strict=True):
        here = [(level, level["names"].index(name)) for level in levels if name in level["names"]]
        x = [level["tf"] for level, _ in here]
        predicted, seen = ([100 * level[key][k] for level, k in here] for key in ("standard_errors", "rms_errors"))
        accuracy.semilogy(x, predicted, "-", color=colour, linewidth=1.1, label=f"{SYMBOLS[name]}, standard error")
        accuracy.semilogy(x, seen, marker, color=colour, markersize=3.5, label=f"{SYMBOLS[name]}, Monte Carlo")
    line: dict[str, Any] = {"color": DARK, "marker": "o", "markersize": 3, "linewidth": 1.1}
    x = [level["tf"] for level in levels]
    conditioning.semilogy(x, [level["condition"] for level in levels], **line)
    region.plot(x, [100 * level["arrived"] for level in levels], **line)
    region.set_ylim(0, 102)
    for ax in (accuracy, conditioning, region):
        ax.axvspan(*TRUTH[:2], color="#f9dfbf", linewidth=0)
        ax.axvline(HORIZON, color="#999999", linestyle=":", linewidth=0.9)
    accuracy.annotate("slip", (8.0, 1.0), xycoords=("data", "axes fraction"), ha="center", va="bottom", fontsize=7)
    accuracy.annotate("paper", (HORIZON, 1.0), xycoords=("data", "axes fraction"), ha="center", va="bottom", fontsize=7)
    vehicle.tidy(accuracy, "", "error (%)")
    vehicle.tidy(conditioning, "", "condition number")
    vehicle.tidy(region, "end of the horizon (s)", "starts that reach\nthe optimum (%)")
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=6)
    return {"horizon": figure}


LINE = """
* Horizon 0 to {tf:g} s | left for further analysis
| {errors}; condition number {condition:.0f}; {share:.0f} % of starts reach the optimum
| {rate} Hz positions, sigma {sigma:g} m; {runs} runs, {starts} starts
"""

SAMPLES_LINE = """
* V-A 3: standard error of mu, 1 Hz positions {label} | effectively only four measurements affect it | {mu:.4f}
| {samples} samples, {in_slip} of them in slip; sigma {sigma:g} m
"""


def rows(found: Found) -> list[Row]:
    """Return the lines of the table."""
    lines, settings = [], {"rate": RATE, "sigma": SIGMA, "runs": found["runs"], "starts": found["starts"]}
    for level in found["horizons"]:
        errors = [f"{name} {100 * e:.2g} %" for name, e in zip(level["names"], level["rms_errors"], strict=True)]
        own = {"errors": ", ".join(errors), "share": 100 * level["arrived"]}
        lines += vehicle.fill_rows(LINE, **settings, **own, **level)
    for line in found["samples"]:
        lines += vehicle.fill_rows(SAMPLES_LINE, sigma=SIGMA, **line)
    return lines
