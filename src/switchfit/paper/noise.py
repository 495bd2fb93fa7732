"""Figure 5: error of the estimates against the noise of 1 Hz positions, filtered as in the paper."""

from __future__ import annotations

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.local_fit import fit_locally
from switchfit.paper import figure_style, fit_summary, table_rows, vehicle
from switchfit.paper.figure_style import BLUE, DARK, PAGE, RED, SYMBOLS, tidy
from switchfit.paper.informative_samples import POSITION_SIGMA, SAMPLES_LINE, compare_sample_sets
from switchfit.paper.table_rows import Found, Say, TableRow
from switchfit.paper.vehicle import HORIZON, NAMES, TRUTH
from switchfit.runtime.presentation import Figure

#: Standard deviations (m): variances of 0 to 0.25 m², more densely up to 0.25 m, the other reading of the paper's unit.
NOISE_LEVELS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)

QUICK_NOISE_LEVELS = (0.0, 0.1, 0.25, 0.5)
NOISE_RUNS, QUICK_NOISE_RUNS = 500, 50
PERCENTILES = (5, 25, 50, 75, 95)
NOISY_SAMPLE_TIMES = np.arange(HORIZON + 1)

NOISE_LINES = """
* Fig. 5: error without noise | zero | bias of {bias} (tau_1 s, tau_2 s, mu)
| from interpolating 1 Hz positions and filtering them at {lowpass:g} Hz
* Fig. 5: mean normalised error at variance {variance:g} m² (%), from the truth
| degrades gracefully; mu is the most sensitive | tau_1, tau_2, mu: {last_size}
| {runs} runs a level, {last[converged]} converged
* Fig. 5: the same at standard deviation 0.25 m, the other reading of the paper's unit (%) | | {quarter_size}
* Fig. 5: rms normalised error from the noise-free estimate (%) | not printed | {from_noise_free} | from the truth {rms}
"""


def compute_noise(quick: bool, say: Say) -> Found:
    """Run a Monte Carlo study at every level of noise, from the paper's start."""
    levels, runs = (QUICK_NOISE_LEVELS, QUICK_NOISE_RUNS) if quick else (NOISE_LEVELS, NOISE_RUNS)
    exact = vehicle.positions_at(vehicle.simulate_drive(step=1.0), NOISY_SAMPLE_TIMES)
    rows: list[Found] = []
    for level, sigma in enumerate(levels):
        say(f"sigma {sigma:g} m")
        # A generator for each level: fewer runs (--quick) draw the first of the same noise.
        rng, theta = np.random.default_rng(level), []
        for _ in range(runs if sigma else 1):
            noisy = exact + sigma * rng.standard_normal(exact.shape)
            fit = fit_summary.complete(
                fit_locally(vehicle.stick_slip(vehicle.gps_reference(NOISY_SAMPLE_TIMES, noisy)))
            )
            if fit.status.successful:
                theta.append(fit.theta)
        # The estimate without noise, of the first level, has a bias of its own: errors are given from both.
        rows.append(_level(np.array(theta), np.array(rows[0]["median"] if rows else TRUTH)))
    return {"sigma": list(levels), "runs": runs, "levels": rows, "samples": compare_sample_sets()}


def _level(theta: FloatArray, noise_free: FloatArray) -> Found:
    """Return percentiles of the errors of estimates (R, 3) at one level of noise."""
    # Mean and rms of the relative errors, as the paper has them, and the spread about the noise-free estimate.
    normalised = theta / TRUTH - 1
    return {
        "converged": len(theta),
        "median": np.median(theta, axis=0).tolist(),
        "percentiles": np.percentile(normalised, PERCENTILES, axis=0).T.tolist(),
        "mean_size": np.mean(np.abs(normalised), axis=0).tolist(),
        "rms": np.sqrt(np.mean(normalised**2, axis=0)).tolist(),
        "rms_from_noise_free": np.sqrt(np.mean(((theta - noise_free) / TRUTH) ** 2, axis=0)).tolist(),
    }


def draw_noise(found: Found) -> dict[str, Figure]:
    """Draw figure 5, with the standard deviation on a second axis."""
    figure = figure_style.new_figure(PAGE, 3.0)
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


def list_noise(found: Found) -> list[TableRow]:
    """Return the lines of the table."""
    sigma, levels = found["sigma"], found["levels"]
    quarter, last = levels[sigma.index(0.25)], levels[-1]
    rows = table_rows.fill_rows(
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
    return rows + [
        row for line in found["samples"] for row in table_rows.fill_rows(SAMPLES_LINE, sigma=POSITION_SIGMA, **line)
    ]


def _list(values: FloatArray, form: str) -> str:
    return ", ".join(format(value, form) for value in values)
