"""Many fits: against the noise of the data, and from starts anywhere.

Figure 5: error of the estimates against the noise of 1 Hz positions, filtered as in the paper; and which of the
samples tell mu.

Estimates from starts anywhere within the bounds, which according to the paper would generally agree.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.estimation.local_fit import fit_locally
from switchfit.fit.evaluator import evaluate
from switchfit.paper import vehicle
from switchfit.paper.vehicle import BLUE, DARK, HORIZON, NAMES, PAGE, RED, SYMBOLS, TRUTH, Figure, Found, Row, Say, tidy
from switchfit.problem.measurements import Measurements
from switchfit.runtime.errors import NotIntegrableError
from switchfit.strategy.choice import estimate, was_interrupted

#: Standard deviations (m): variances of 0 to 0.25 m², more densely up to 0.25 m, the other reading of the paper's unit.
LEVELS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)

QUICK_LEVELS = (0.0, 0.1, 0.25, 0.5)
NOISE_RUNS, QUICK_NOISE_RUNS = 500, 50
PERCENTILES = (5, 25, 50, 75, 95)
TIMES = np.arange(HORIZON + 1)

#: Standard deviation of positions (m) of which a sample or another may tell mu, and the longest horizon (s) of these.
SIGMA, LONGEST = 0.1, 30.0

NOISE_LINES = """
* Fig. 5: error without noise | zero | bias of {bias} (tau_1 s, tau_2 s, mu)
| from interpolating 1 Hz positions and filtering them at {lowpass:g} Hz
* Fig. 5: mean normalised error at variance {variance:g} m² (%), from the truth
| degrades gracefully; mu is the most sensitive | tau_1, tau_2, mu: {last_size}
| {runs} runs a level, {last[converged]} converged
* Fig. 5: the same at standard deviation 0.25 m, the other reading of the paper's unit (%) | | {quarter_size}
* Fig. 5: rms normalised error from the noise-free estimate (%) | not printed | {from_noise_free} | from the truth {rms}
"""

SAMPLES_LINE = """
* V-A 3: standard error of mu, 1 Hz positions {label} | effectively only four measurements affect it | {mu:.4f}
| {samples} samples, {in_slip} of them in slip; sigma {sigma:g} m
"""

COUNT, QUICK_COUNT = 1000, 30
LOWER_MU, UPPER_MU = 0.05, 2.0

#: Estimates that agree to this part of the horizon, or to this difference of mu, count as one.
SAME = 1e-3

#: Number of estimates in the table, the most frequent ones.
SHOWN = 4

METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "exact": ("one fit, exact Hessian", {"strategy": "local", "hessian": "exact"}),
    "local": ("one fit, trust region", {"strategy": "local"}),
    "auto": ('strategy "auto"', {"strategy": "auto"}),
}


def compute_noise(quick: bool, say: Say) -> Found:
    """Run a Monte Carlo study at every level of noise, from the paper's start."""
    levels, runs = (QUICK_LEVELS, QUICK_NOISE_RUNS) if quick else (LEVELS, NOISE_RUNS)
    exact = vehicle.positions_at(vehicle.simulate_drive(step=1.0), TIMES)
    rows: list[Found] = []
    for level, sigma in enumerate(levels):
        say(f"sigma {sigma:g} m")
        rng, theta = np.random.default_rng(level), []
        for _ in range(runs if sigma else 1):
            noisy = exact + sigma * rng.standard_normal(exact.shape)
            fit = vehicle.complete(fit_locally(vehicle.stick_slip(vehicle.gps_reference(TIMES, noisy))))
            if fit.status.successful:
                theta.append(fit.theta)
        rows.append(_level(np.array(theta), np.array(rows[0]["median"] if rows else TRUTH)))
    return {"sigma": list(levels), "runs": runs, "levels": rows, "samples": _sample_sets()}


def _level(theta: FloatArray, noise_free: FloatArray) -> Found:
    """Return percentiles of the errors of estimates (R, 3) at one level of noise."""
    normalised = theta / TRUTH - 1
    return {
        "converged": len(theta),
        "median": np.median(theta, axis=0).tolist(),
        "percentiles": np.percentile(normalised, PERCENTILES, axis=0).T.tolist(),
        "mean_size": np.mean(np.abs(normalised), axis=0).tolist(),
        "rms": np.sqrt(np.mean(normalised**2, axis=0)).tolist(),
        "rms_from_noise_free": np.sqrt(np.mean(((theta - noise_free) / TRUTH) ** 2, axis=0)).tolist(),
    }


def _sample_sets() -> list[Found]:
    """Return the standard error of mu from 1 Hz positions over several horizons, and without positions in slip."""
    path = vehicle.simulate_drive(tf=LONGEST)
    begin, end = TRUTH[:2]
    sets = [(f"0 to {tf:g} s", tf, np.arange(tf + 1)) for tf in (end, 11.0, 12.0, 13.0, HORIZON, 20.0, LONGEST)]
    seconds = np.arange(HORIZON + 1)
    outside = seconds[(seconds <= begin) | (seconds > end)]
    sets.append((f"0 to {HORIZON:g} s without those in slip", HORIZON, outside))
    found: list[Found] = []
    for label, tf, times in sets:
        theta = TRUTH if tf > end else (TRUTH[0], TRUTH[2])
        data = Measurements(times, vehicle.positions_at(path, times), vehicle.position, sigma=SIGMA)
        hessian = evaluate(vehicle.stick_slip(data, theta, tf=tf)).hessian
        inside = int(np.sum((times > begin) & (times <= end)))
        errors = np.sqrt(np.diag(np.linalg.inv(hessian)))
        found.append({"label": label, "samples": len(times), "in_slip": inside, "mu": float(errors[-1])})
    return found


def draw_noise(found: Found) -> dict[str, Figure]:
    """Draw figure 5, with the standard deviation on a second axis."""
    figure = vehicle.new_figure(PAGE, 3.0)
    variance = np.array(found["sigma"]) ** 2
    for k, (ax, name) in enumerate(zip(figure.subplots(1, 3), NAMES, strict=True)):
        bands = 100 * np.array([level["percentiles"][k] for level in found["levels"]]).T
        for low, high, label in ((0, 4, "5 to 95 %"), (1, 3, "25 to 75 %")):
            ax.fill_between(variance, bands[low], bands[high], color=BLUE, alpha=0.3, linewidth=0, label=label)
        ax.plot(variance, bands[2], "-o", color=DARK, markersize=3, linewidth=1, label="median")
        ax.axhline(0.0, color=RED, linewidth=0.8)
        tidy(ax, "noise variance (m²)", f"normalised error of {SYMBOLS[name]} (%)", letter=f"({'abc'[k]})")
        above = ax.secondary_xaxis("top", functions=(lambda v: np.sqrt(np.maximum(v, 0.0)), np.square))
        above.set_ticks([0.1, 0.2, 0.3, 0.4, 0.5])
        above.tick_params(labelsize=7)
        above.set_xlabel("standard deviation (m)", fontsize=8)
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=7)
    return {"fig5-noise": figure}


def list_noise(found: Found) -> list[Row]:
    """Return the lines of the table."""
    sigma, levels = found["sigma"], found["levels"]
    quarter, last = levels[sigma.index(0.25)], levels[-1]
    rows = vehicle.fill_rows(
        NOISE_LINES,
        runs=found["runs"],
        variance=sigma[-1] ** 2,
        lowpass=vehicle.LOWPASS_HZ,
        last=last,
        bias=_list(np.subtract(levels[0]["median"], TRUTH), "+.4f"),
        last_size=_list(np.multiply(100, last["mean_size"]), ".2f"),
        quarter_size=_list(np.multiply(100, quarter["mean_size"]), ".2f"),
        from_noise_free=_list(np.multiply(100, last["rms_from_noise_free"]), ".2f"),
        rms=_list(np.multiply(100, last["rms"]), ".2f"),
    )
    return rows + [row for line in found["samples"] for row in vehicle.fill_rows(SAMPLES_LINE, sigma=SIGMA, **line)]


def _list(values: Any, form: str) -> str:
    return ", ".join(format(value, form) for value in values)


def compute_starts(quick: bool, say: Say) -> Found:
    """Fit from starts all over the bounds, with three methods."""
    problem = vehicle.build_simulated_problem()
    starts = draw_starts(QUICK_COUNT if quick else COUNT)
    found: Found = {"starts": len(starts), "ways": {}}
    for method, (label, settings) in METHODS.items():
        ends: list[Found] = []
        for k, start in enumerate(starts):
            if k % 100 == 0:
                say(f"{label}: start {k} of {len(starts)}")
            theta, cost = None, None
            with suppress(NotIntegrableError):
                fit = estimate(problem, start=start, **settings)
                if was_interrupted(fit):
                    raise KeyboardInterrupt
                theta, cost = (fit.theta.tolist(), fit.cost) if fit.status.successful else (None, None)
            same = (end for end in ends if _agree(end["theta"], theta))
            if (end := next(same, None)) is None:
                ends.append(end := {"theta": theta, "cost": cost, "count": 0})
            end["count"] += 1
        found["ways"][method] = sorted(ends, key=lambda end: -end["count"])
    return found


def draw_starts(count: int) -> FloatArray:
    """Return ordered transition times anywhere in the horizon, and mu anywhere within its bounds: (count, 3)."""
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0.0, HORIZON, (count, 2)), axis=1)
    return np.column_stack([times, rng.uniform(LOWER_MU, UPPER_MU, count)])


def _agree(one: list[float] | None, other: list[float] | None) -> bool:
    if one is None or other is None:
        return one is other
    return bool(np.all(np.abs(np.subtract(one, other)) < SAME * np.array([HORIZON, HORIZON, 1.0])))


def list_starts(found: Found) -> list[Row]:
    """Return a line for each method."""
    return [
        Row(
            f"V-B: {found['starts']} starts all over the bounds, {METHODS[method][0]}",
            "would generally lead to the same estimate",
            "; ".join(_name(end) for end in ends[:SHOWN]),
            _rest(ends[SHOWN:]),
        )
        for method, ends in found["ways"].items()
    ]


def _name(end: Found) -> str:
    if end["theta"] is None:
        return f"{end['count']} not converged"
    tau_1, tau_2, mu = end["theta"]
    return f"{end['count']} at ({tau_1:.2f}, {tau_2:.2f}, {mu:.3f}), J = {end['cost']:.3g}"


def _rest(ends: list[Found]) -> str:
    text = "tau uniform in 0 to 15 s, mu in its bounds; (tau_1, tau_2, mu)"
    return text + (f"; {sum(end['count'] for end in ends)} elsewhere" if ends else "")
