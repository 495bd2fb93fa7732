"""How the horizon matters, which the paper leaves for further analysis.

Accuracy, conditioning and the region of starts from which the optimum is reached, for horizons of different lengths.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from switchfit.batch.monte_carlo import monte_carlo
from switchfit.batch.multistart import multistart
from switchfit.data import FloatArray, Measurements, ReferenceSignal
from switchfit.evaluate import evaluate
from switchfit.paper.part import BLUE, DARK, PAGE, RED, SYMBOLS, Found, Row, Say, new_figure, tidy
from switchfit.paper.vehicle import HORIZON, NAMES, TRUTH, complete, driven, position, states_at, stick_slip

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Horizon"
#: Ends with the beginning at 0, and beginnings with the end at 15 (s). Slip lasts from 6 to 10 s.
ENDS = (10.5, 11.0, 12.0, 13.0, 15.0, 18.0, 22.0, 26.0, 30.0)
BEGINNINGS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 5.5)
QUICK_ENDS, QUICK_BEGINNINGS = (10.5, 15.0, 26.0), (0.0, 5.0)
RUNS, QUICK_RUNS = 400, 32
STARTS, QUICK_STARTS = 512, 32
#: Noise of the positions (m), ten a second.
SIGMA, RATE = 0.1, 10
#: An estimate belongs to the optimum if it is this near to the truth, in units of it.
NEAR = 1e-4


def compute(quick: bool, folder: Path, say: Say) -> Found:
    """Both families of horizons."""
    families = {
        "end": [(0.0, end) for end in (QUICK_ENDS if quick else ENDS)],
        "beginning": [(begin, HORIZON) for begin in (QUICK_BEGINNINGS if quick else BEGINNINGS)],
    }
    found: Found = {"runs": QUICK_RUNS if quick else RUNS, "starts": QUICK_STARTS if quick else STARTS}
    for family, horizons in families.items():
        found[family] = []
        for t0, tf in horizons:
            say(f"{t0:g} to {tf:g} s")
            found[family].append(_horizon(t0, tf, found["runs"], found["starts"], folder))
    return found


def _horizon(t0: float, tf: float, runs: int, starts: int, folder: Path) -> Found:
    """Accuracy and conditioning with noisy positions; convergence of the noise-free fit of Fig. 4 from many starts."""
    path = driven(tf=max(tf, HORIZON))
    begin = states_at(path, np.array([t0]))[0]
    times = np.arange(round(RATE * t0), round(RATE * tf) + 1) / RATE
    clean = states_at(path, times)[:, [0, 2]]
    noisy = stick_slip(Measurements(times, clean, position, sigma=SIGMA), TRUTH, t0=t0, tf=tf, initial_state=begin)
    hessian = evaluate(noisy).hessian
    name = f"{t0:g}-{tf:g}"
    study = complete(monte_carlo(noisy, runs, theta=TRUTH, seed=round(10 * (t0 + tf)), folder=folder / f"noise-{name}"))
    scale = np.array(TRUTH)
    here = (path.times >= t0) & (path.times <= tf)
    reference = ReferenceSignal.from_samples(path.times[here], path.states[here])
    exact = stick_slip(reference, TRUTH, t0=t0, tf=tf, initial_state=begin)
    search = complete(multistart(exact, _starts(t0, tf, starts), folder=folder / f"starts-{name}"))
    arrived = search.success & np.all(np.abs(search.theta / scale - 1) < NEAR, axis=1)
    return {
        "t0": t0,
        "tf": tf,
        "standard_errors": np.sqrt(np.diag(np.linalg.inv(hessian))).tolist(),
        "rms_errors": np.sqrt(np.mean(study.errors**2, axis=0)).tolist(),
        "converged": int(study.success.sum()),
        "condition": float(np.linalg.cond(hessian * np.outer(scale, scale))),
        "arrived": float(np.mean(arrived)),
        "region": float(np.mean(arrived) * (tf - t0) ** 2 / 2),
    }


def _starts(t0: float, tf: float, count: int) -> FloatArray:
    """Ordered transition times all over the horizon and mu from 0.2 to 2, as a Sobol sequence would spread them."""
    from scipy.stats import qmc  # here, since it takes long to import

    cube = qmc.Sobol(3, seed=0).random(count)
    times = np.sort(t0 + (tf - t0) * (0.005 + 0.99 * cube[:, :2]), axis=1)
    times[:, 1] = np.maximum(times[:, 1], times[:, 0] + 1e-3)
    return np.column_stack([times, 0.2 + 1.8 * cube[:, 2]])


def draw(found: Found) -> dict[str, Figure]:
    """Accuracy, conditioning and region of convergence against the end and against the beginning of the horizon."""
    figure = new_figure(PAGE, 5.4)
    axes = figure.subplots(3, 2, sharex="col", sharey="row", height_ratios=(1.5, 1, 1))
    colours, markers = (RED, BLUE, DARK), ("o", "s", "^")
    for column, (family, key, label) in enumerate(
        (("end", "tf", "end of the horizon (s), from 0 s"), ("beginning", "t0", "beginning (s), to 15 s"))
    ):
        accuracy, conditioning, region = axes[:, column]
        levels = found[family]
        x = [level[key] for level in levels]
        for k, name in enumerate(NAMES):
            predicted = [100 * level["standard_errors"][k] / TRUTH[k] for level in levels]
            seen = [100 * level["rms_errors"][k] / TRUTH[k] for level in levels]
            accuracy.semilogy(
                x, predicted, "-", color=colours[k], linewidth=1.1, label=f"{SYMBOLS[name]}, standard error"
            )
            accuracy.semilogy(
                x, seen, markers[k], color=colours[k], markersize=3.5, label=f"{SYMBOLS[name]}, Monte Carlo"
            )
        conditioning.semilogy(
            x, [level["condition"] for level in levels], "-o", color=DARK, markersize=3, linewidth=1.1
        )
        region.plot(x, [100 * level["arrived"] for level in levels], "-o", color=DARK, markersize=3, linewidth=1.1)
        region.set_ylim(0, 102)
        for ax in (accuracy, conditioning, region):
            ax.axvline(15.0 if family == "end" else 0.0, color="#999999", linestyle=":", linewidth=0.9)
        tidy(accuracy, "", "error (%)" if column == 0 else "", letter=f"({'ab'[column]})")
        tidy(conditioning, "", "condition number" if column == 0 else "")
        tidy(region, label, "starts that reach\nthe optimum (%)" if column == 0 else "")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=7)
    return {"horizon": figure}


def rows(found: Found) -> list[Row]:
    """Lines of the table."""
    shortest, longest = found["end"][0], found["end"][-1]
    paper = next(level for level in found["end"] if level["tf"] == HORIZON)
    late = found["beginning"][-1]

    def line(level: Any) -> str:
        errors = ", ".join(f"{100 * e / t:.2f}" for e, t in zip(level["rms_errors"], TRUTH, strict=True))
        return (
            f"errors {errors} %; condition number {level['condition']:.3g}; {100 * level['arrived']:.0f} % of starts "
            f"reach the optimum"
        )

    remark = f"{RATE} Hz positions, sigma {SIGMA:g} m; {found['runs']} runs, {found['starts']} starts"
    return [
        Row(f"Horizon 0 to {level['tf']:g} s", "left for further analysis", line(level), remark)
        for level in (shortest, paper, longest)
    ] + [
        Row(
            f"Horizon {late['t0']:g} to {HORIZON:g} s",
            "left for further analysis",
            line(late),
            "state at its beginning known",
        )
    ]
