"""Figure 6: five trials with the paper's torques, with simulated logs, since the original ones were not published."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from switchfit.paper.vehicle import (
    COLUMN,
    DARK,
    LIGHT,
    RED,
    Figure,
    Found,
    Row,
    Say,
    fit_resticks,
    gps_reference,
    log_on_tyres,
    new_figure,
    tidy,
    wheel_speeds,
)

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
    (
        "GPS at 1 Hz (simulated)",
        {"color": RED, "ls": "", "marker": "o", "markersize": 2.5, "markeredgewidth": 0},
    ),
)


def compute(quick: bool, folder: Path, say: Say) -> Found:
    """Fit five logs, each with both restick models."""
    found: Found = {"trials": []}
    for number, (force, differential) in enumerate(TRIALS, start=1):
        say(f"trial {number}")
        clean, _ = log_on_tyres(SECONDS, wheel_speeds(differential, force))
        noise = GPS_SIGMA * np.random.default_rng(number).standard_normal(clean.shape)
        reference = gps_reference(SECONDS, clean + noise)
        dense = np.linspace(0.0, 15.0, 151)
        trial: Found = {
            "force": force,
            "differential": differential,
            "samples": (clean + noise).tolist(),
            "filtered": reference.signal(dense).round(4).tolist(),
            "fits": fit_resticks(reference, START, clean, stick_force=force),
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
    figure = new_figure(2 * COLUMN, 3.9)
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
    tidy(ax, f"X (m), each trial shifted by {SHIFT:g} m", "Y (m)")
    return figure


def rows(found: Found) -> list[Row]:
    """Return the lines of the table."""
    trials = found["trials"]
    lines = []
    for k, trial in enumerate(trials, start=1):
        ours = trial["fits"]["continuous"]
        theta = ours["theta"]
        lines.append(
            Row(
                f"Fig. 6, trial {k} (simulated log): tau_1, tau_2 (s), mu",
                "values are in the figure only",
                f"{theta['tau_1']:.2f}, {theta['tau_2']:.2f}, {theta['mu']:.3f}",
                f"{ours['iterations']} iterations, ‖DJ‖ = {ours['gradient_norm']:.0e}, smallest eigenvalue of D²J "
                f"{ours['smallest_eigenvalue']:.3g}",
            )
        )
    literal, reset = ([trial["fits"][kind] for trial in trials] for kind in ("continuous", "reset"))
    most = max(fit["iterations"] for fit in literal)
    largest = max(fit["gradient_norm"] for fit in literal)
    return [
        *lines,
        Row(
            "Fig. 6 (simulated logs): all trials converge to ‖DJ‖ < 1e-7 in fewer than 15 iterations",
            "yes",
            f"{'yes' if most < 15 and largest < 1e-7 else 'no'}: at most {most} iterations, ‖DJ‖ at most {largest:.0e}",
        ),
        Row(
            "Re-stick (simulated logs): cost J as printed, and with a reset map",
            "not done",
            "; ".join(f"{a['cost']:.2f}, {b['cost']:.3f}" for a, b in zip(literal, reset, strict=True)),
            f"the reset explains every log better: rms distance to the noise-free log "
            f"{np.mean([f['rms_position_error'] for f in literal]):.2f} m as printed, "
            f"{np.mean([f['rms_position_error'] for f in reset]):.2f} m with it, at as many unknowns"
            if all(b["cost"] < a["cost"] for a, b in zip(literal, reset, strict=True))
            else "the reset does not explain every log better",
        ),
    ]
