"""Figure 6: five trials with the paper's torques, with simulated logs, since the original ones were not published."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from switchfit.paper import vehicle
from switchfit.paper.vehicle import DARK, LIGHT, RED, Figure, Found, Row, Say

TITLE = "Trials (Fig. 6)"
START = (5.0, 10.0, 0.8)
SECONDS = np.arange(16.0)
#: Standard deviation of GPS positions (m).
GPS_SIGMA = 0.1
#: Drive force of each wheel in stick (N), as in the paper, and the treads' difference of speed (m/s), which varies
#: between the trials of the simulated vehicle.
TRIALS = ((12.0, 0.170), (12.0, 0.166), (12.0, 0.178), (15.0, 0.172), (15.0, 0.160))
#: Distance (m) between trials in the figure.
SHIFT = 20.0
LOOKS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("initial trajectory", {"color": LIGHT, "linewidth": 1.2}),
    ("interpolated and filtered", {"color": "#666666", "linewidth": 1.6, "linestyle": "--"}),
    ("optimal trajectory", {"color": DARK, "linewidth": 1.0}),
    ("GPS at 1 Hz (simulated)", {"color": RED, "ls": "", "marker": "o", "markersize": 2.5, "markeredgewidth": 0}),
)


def compute(quick: bool, folder: Path, say: Say) -> Found:
    """Fit five logs, each with both restick models."""
    found: Found = {"trials": []}
    for number, (force, differential) in enumerate(TRIALS, start=1):
        say(f"trial {number}")
        clean, _ = vehicle.log_on_tyres(SECONDS, vehicle.wheel_speeds(differential, force))
        samples = clean + GPS_SIGMA * np.random.default_rng(number).standard_normal(clean.shape)
        reference = vehicle.gps_reference(SECONDS, samples)
        trial: Found = {
            "force": force,
            "samples": samples.tolist(),
            "filtered": reference.signal(np.linspace(0.0, 15.0, 151)).round(4).tolist(),
            "fits": vehicle.fit_resticks(reference, START, clean, stick_force=force),
        }
        found["trials"].append(trial)
    return found


def draw(found: Found) -> dict[str, Figure]:
    """Draw figure 6: raw points, filtered curve, initial and optimal trajectory of each trial, shifted along X."""
    return {
        "fig6-trials": _paths(found, "continuous"),
        "fig6-trials-reset": _paths(found, "reset"),
    }


def _paths(found: Found, restick: str) -> Figure:
    figure = vehicle.new_figure(2 * vehicle.COLUMN, 3.9)
    ax = figure.subplots()
    for k, trial in enumerate(found["trials"]):
        shift, fit = np.array([SHIFT * k, 0.0]), trial["fits"][restick]
        for path, (label, look) in zip(
            (fit["initial"], trial["filtered"], fit["path"], trial["samples"]), LOOKS, strict=True
        ):
            ax.plot(*(np.array(path) + shift).T, label="" if k else label, **look)
        theta = fit["theta"]
        found_there = f"({theta['tau_1']:.2f}, {theta['tau_2']:.2f}) s\n$\\mu$ = {theta['mu']:.3f}"
        place: dict[str, Any] = {"xy": (shift[0] + 8.0, -2.5), "ha": "center", "va": "top"}
        ax.annotate(f"Trial {k + 1}\n$\\tau$ = {found_there}", fontsize=6.5, **place)
    ax.set_ylim(bottom=-15)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=7)
    model = "with reset at re-stick" if restick == "reset" else "as printed"
    ax.set_title(f"Simulated logs (Magic Formula vehicle), equation (18) {model}", fontsize=8, loc="left")
    vehicle.tidy(ax, f"X (m), each trial shifted by {SHIFT:g} m", "Y (m)")
    return figure


TRIAL_LINE = """
* Fig. 6, trial {number} (simulated log): tau_1, tau_2 (s), mu | values are in the figure only
| {theta[tau_1]:.2f}, {theta[tau_2]:.2f}, {theta[mu]:.3f}
| {iterations} iterations, ‖DJ‖ = {gradient_norm:.0e}, smallest eigenvalue of D²J {smallest_eigenvalue:.3g}
"""

LINES = """
* Fig. 6 (simulated logs): all trials converge to ‖DJ‖ < 1e-7 in fewer than 15 iterations | yes
| {answer}: at most {most} iterations, ‖DJ‖ at most {largest:.0e}
* Re-stick (simulated logs): cost J as printed, and with a reset map | not done | {costs} | {remark}
"""

BETTER = (
    "the reset explains every log better: rms distance to the noise-free log {:.2f} m as printed, {:.2f} m with it, at "
    "as many unknowns"
)


def rows(found: Found) -> list[Row]:
    """Return the lines of the table."""
    literal, reset = ([trial["fits"][kind] for trial in found["trials"]] for kind in ("continuous", "reset"))
    lines = [row for k, fit in enumerate(literal, start=1) for row in vehicle.fill_rows(TRIAL_LINE, number=k, **fit)]
    most, largest = (max(fit[name] for fit in literal) for name in ("iterations", "gradient_norm"))
    costs = [(a["cost"], b["cost"]) for a, b in zip(literal, reset, strict=True)]
    distances = (np.mean([fit["rms_position_error"] for fit in fits]) for fits in (literal, reset))
    better = all(b < a for a, b in costs)
    return lines + vehicle.fill_rows(
        LINES,
        answer="yes" if most < 15 and largest < 1e-7 else "no",
        most=most,
        largest=largest,
        costs="; ".join(f"{a:.2f}, {b:.3f}" for a, b in costs),
        remark=BETTER.format(*distances) if better else "the reset does not explain every log better",
    )
