"""Figure 5: error of the estimates against the noise of 1 Hz positions, filtered as in the paper or fitted directly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from switchfit.batch.simulated import MonteCarlo, monte_carlo
from switchfit.fit.result import inverse_on
from switchfit.paper import vehicle
from switchfit.paper.vehicle import BLUE, DARK, PAGE, RED, SYMBOLS, Figure, Found, Row, Say, tidy
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem

TITLE = "Measurement noise (Fig. 5)"
#: Standard deviations (m): variances of 0 to 0.25 m², more densely up to 0.25 m, the other reading of the paper's unit.
LEVELS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)
QUICK_LEVELS = (0.0, 0.1, 0.25, 0.5)
RUNS, QUICK_RUNS = 500, 50
PERCENTILES = (5, 25, 50, 75, 95)
#: Two-sided 95 % point of the normal distribution.
NORMAL = 1.959963984540054
TIMES = np.arange(vehicle.HORIZON + 1)
FILTERED, DIRECT = "interpolated and filtered", "samples fitted directly"


def build_problem(method: str, sigma: float) -> Problem:
    """Return the problem of one of the methods to fit the same samples; a reference signal has no sigma."""
    path = vehicle.simulate_drive(step=1.0)
    if method == FILTERED:
        return vehicle.stick_slip(vehicle.gps_reference(TIMES, vehicle.positions_at(path, TIMES)))
    return vehicle.fit_positions(path, TIMES, vehicle.START, sigma or 1.0, vehicle.HORIZON)


def compute(quick: bool, folder: Path, say: Say) -> Found:
    """Run a Monte Carlo study at every level of noise, with both methods, from the paper's start."""
    levels, runs = (QUICK_LEVELS, QUICK_RUNS) if quick else (LEVELS, RUNS)
    found: Found = {"sigma": list(levels), "runs": runs, "ways": {}}
    for method in (FILTERED, DIRECT):
        rows: list[Found] = []
        for level, sigma in enumerate(levels):
            say(f"{method}: sigma {sigma:g} m")
            study = monte_carlo(
                build_problem(method, sigma),
                1 if sigma == 0 else runs,
                theta=vehicle.TRUTH,
                start=vehicle.START,
                noise=sigma,
                seed=level,
                folder=folder / f"{method.split()[0]}-{sigma:g}",
            )
            noise_free = np.array(rows[0]["median"] if rows else vehicle.TRUTH)
            rows.append(_level(vehicle.complete(study), sigma, noise_free))
        found["ways"][method] = rows
    return found


def _level(study: MonteCarlo, sigma: float, noise_free: FloatArray) -> Found:
    """Return percentiles of the estimates, errors and coverage at one level of noise."""
    theta = study.theta[study.success]
    normalised = study.errors / vehicle.TRUTH
    return {
        "converged": len(theta),
        "median": np.median(theta, axis=0).tolist(),
        "percentiles": np.percentile(normalised, PERCENTILES, axis=0).T.tolist(),
        "mean_size": np.mean(np.abs(normalised), axis=0).tolist(),
        "rms": np.sqrt(np.mean(normalised**2, axis=0)).tolist(),
        "rms_from_noise_free": np.sqrt(np.mean(((theta - noise_free) / vehicle.TRUTH) ** 2, axis=0)).tolist(),
        "coverage": _coverage(study, sigma).tolist() if sigma > 0 else [None] * 3,
    }


def _coverage(study: MonteCarlo, sigma: float) -> FloatArray:
    """Return the part of the 95 % intervals that contain the truth: (3,).

    A reference signal has no noise model. A plausible one treats the integral as a sum over samples one second apart:
    J / sigma² times 1/s is then a negative log-likelihood, and the covariance is sigma² (1 s) H⁻¹.
    """
    if study.sigma_known is not None:
        return study.coverage()
    inside = []
    for theta, hessian in zip(study.theta[study.success], study.hessian[study.success], strict=True):
        errors = sigma * np.sqrt(np.diag(inverse_on(np.eye(3), hessian)))
        inside.append(np.abs(theta - vehicle.TRUTH) <= NORMAL * errors)
    return np.mean(inside, axis=0)


def draw(found: Found) -> dict[str, Figure]:
    """Draw figure 5, with the standard deviation on a second axis, and the coverage below."""
    figure = vehicle.new_figure(PAGE, 4.6)
    axes = figure.subplots(2, 3, sharex=True, height_ratios=(1.6, 1.0))
    variance = np.array(found["sigma"]) ** 2
    line: dict[str, Any] = {"markersize": 3, "linewidth": 1}
    looks = {
        FILTERED: {**line, "color": DARK, "linestyle": "--", "marker": "s"},
        DIRECT: {**line, "color": BLUE, "linestyle": "-", "marker": "o"},
    }
    for k, name in enumerate(vehicle.NAMES):
        errors, coverage = axes[:, k]
        for method, levels in found["ways"].items():
            look = looks[method]
            bands = 100 * np.array([level["percentiles"][k] for level in levels]).T
            if method == DIRECT:
                shade: dict[str, Any] = {"color": look["color"], "alpha": 0.3, "linewidth": 0}
                errors.fill_between(variance, bands[0], bands[4], label=f"5 to 95 %, {method}", **shade)
            else:
                errors.plot(variance, bands[0], ":", color=look["color"], linewidth=1.2, label=f"5 and 95 %, {method}")
                errors.plot(variance, bands[4], ":", color=look["color"], linewidth=1.2)
            errors.plot(variance, bands[2], **look, label=f"median, {method}")
            inside = [100 * level["coverage"][k] for level in levels[1:]]
            coverage.plot(variance[1:], inside, **look)
        errors.axhline(0.0, color=RED, linewidth=0.8)
        coverage.axhline(95.0, color=RED, linewidth=0.8)
        coverage.set_ylim(60, 101)
        tidy(errors, "", f"normalised error of {SYMBOLS[name]} (%)", letter=f"({'abc'[k]})")
        tidy(coverage, "noise variance (m²)", f"coverage, {SYMBOLS[name]} (%)")
        above = errors.secondary_xaxis("top", functions=(lambda v: np.sqrt(np.maximum(v, 0.0)), np.square))
        above.set_ticks([0.1, 0.2, 0.3, 0.4, 0.5])
        above.tick_params(labelsize=7)
        above.set_xlabel("standard deviation (m)", fontsize=8)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=7)
    return {"fig5-noise": figure}


LINES = """
* Fig. 5: error without noise | zero | bias of {bias} (tau_1 s, tau_2 s, mu)
| from interpolating 1 Hz positions and filtering them at {lowpass:g} Hz; the samples fitted directly give {direct_bias}
* Fig. 5: mean normalised error at variance {variance:g} m² (%), from the truth
| degrades gracefully; mu is the most sensitive | tau_1, tau_2, mu: {last_size}
| {runs} runs a level, {last[converged]} converged
* Fig. 5: the same at standard deviation 0.25 m, the other reading of the paper's unit (%) | | {quarter_size}
| samples fitted directly: {direct_quarter_size}
* at variance {variance:g} m² with the samples fitted directly (%) | not done | {direct_last_size}
| {direct_last[converged]} of {runs} converged; rms error of the filtered fit is {ratio} times as large
* Fig. 5: rms normalised error from the noise-free estimate (%) | not printed | {from_noise_free} | from the truth {rms}
* coverage of 95 % intervals, filtered (%) | not done | {coverage}
| tau_1, tau_2, mu at sigma = {levels} m; covariance sigma² (1 s) H⁻¹
* coverage of 95 % intervals, direct (%) | not done | {direct_coverage} | tau_1, tau_2, mu at the same levels
"""


def rows(found: Found) -> list[Row]:
    """Return the lines of the table."""
    sigma, values = found["sigma"], {"runs": found["runs"], "variance": found["sigma"][-1] ** 2}
    shown = [1, len(sigma) // 2, -1]  # the first level with noise, the middle one and the last
    for prefix, method, digits in (("", FILTERED, "+.4f"), ("direct_", DIRECT, ".0e")):
        levels = found["ways"][method]
        quarter, last = levels[sigma.index(0.25)], levels[-1]
        values |= {
            f"{prefix}bias": _list(np.subtract(levels[0]["median"], vehicle.TRUTH), digits),
            f"{prefix}last": last,
            f"{prefix}last_size": _list(np.multiply(100, last["mean_size"]), ".2f"),
            f"{prefix}quarter_size": _list(np.multiply(100, quarter["mean_size"]), ".2f"),
            f"{prefix}coverage": "; ".join(_list(np.multiply(100, levels[k]["coverage"]), ".0f") for k in shown),
        }
    filtered, direct = values["last"], values["direct_last"]
    return vehicle.fill_rows(
        LINES,
        lowpass=vehicle.LOWPASS_HZ,
        ratio=_list(np.divide(filtered["rms"], direct["rms"]), ".2f"),
        from_noise_free=_list(np.multiply(100, filtered["rms_from_noise_free"]), ".2f"),
        rms=_list(np.multiply(100, filtered["rms"]), ".2f"),
        levels=_list([sigma[k] for k in shown], "g"),
        **values,
    )


def _list(values: Any, form: str) -> str:
    return ", ".join(format(value, form) for value in values)
