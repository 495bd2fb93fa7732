"""Figure 6: five trials with the paper's torques, with simulated logs, since the original ones were not published."""

from __future__ import annotations

from typing import Any

import numpy as np

from switchfit.paper import figure_style, fit_summary, table_rows, tyre_logs, vehicle
from switchfit.paper.figure_style import DARK, LIGHT, RED, tidy
from switchfit.paper.table_rows import Found, Say, TableRow
from switchfit.paper.tyre_logs import TYRE_LOG_START
from switchfit.paper.vehicle import SAMPLE_TIMES
from switchfit.runtime.presentation import Figure

#: Standard deviation of GPS positions (m).
GPS_SIGMA = 0.1

#: Drive force of each wheel in stick (N), as in the paper, and the treads' difference of speed (m/s), which varies
#: between the trials of the simulated vehicle.
TRIALS = ((12.0, 0.170), (12.0, 0.166), (12.0, 0.178), (15.0, 0.172), (15.0, 0.160))

#: Distance (m) between trials in the figure.
SHIFT_OF_TRIALS = 20.0

TRIAL_LOOKS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("initial trajectory", {"color": LIGHT, "linewidth": 1.2}),
    ("interpolated and filtered", {"color": "#666666", "linewidth": 1.6, "linestyle": "--"}),
    ("optimal trajectory", {"color": DARK, "linewidth": 1.0}),
    ("GPS at 1 Hz (simulated)", {"color": RED, "ls": "", "marker": "o", "markersize": 2.5, "markeredgewidth": 0}),
)

TRIAL_LINE = """
* Fig. 6, trial {number} (simulated log): tau_1, tau_2 (s), mu | values are in the figure only
| {theta[tau_1]:.2f}, {theta[tau_2]:.2f}, {theta[mu]:.3f}
| {iterations} iterations, ‖DJ‖ = {gradient_norm:.0e}, smallest eigenvalue of D²J {smallest_eigenvalue:.3g}
"""

TRIALS_LINE = """
* Fig. 6 (simulated logs): all trials converge to ‖DJ‖ < 1e-7 in fewer than 15 iterations | yes
| {answer}: at most {most} iterations, ‖DJ‖ at most {largest:.0e}
"""


def compute_trials(quick: bool, say: Say) -> Found:
    """Fit five logs."""
    found: Found = {"trials": []}
    for number, (force, differential) in enumerate(TRIALS, start=1):
        say(f"trial {number}")
        clean, _ = tyre_logs.log_on_tyres(SAMPLE_TIMES, tyre_logs.wheel_speeds(differential, force))
        # The number of the trial is the seed: each has noise of its own, and the same one in every run.
        samples = clean + GPS_SIGMA * np.random.default_rng(number).standard_normal(clean.shape)
        reference = vehicle.gps_reference(SAMPLE_TIMES, samples)
        trial: Found = {
            "force": force,
            "samples": samples.tolist(),
            "filtered": reference.signal(np.linspace(0.0, 15.0, 151)).round(4).tolist(),
            "fit": fit_summary.fit_log(reference, TYRE_LOG_START, clean, stick_force=force),
        }
        found["trials"].append(trial)
    return found


def draw_trials(found: Found) -> dict[str, Figure]:
    """Draw figure 6: raw points, filtered curve, initial and optimal trajectory of each trial, shifted along X."""
    figure = figure_style.new_figure(2 * figure_style.COLUMN, 3.9)
    ax = figure.subplots()
    for k, trial in enumerate(found["trials"]):
        shift, fit = np.array([SHIFT_OF_TRIALS * k, 0.0]), trial["fit"]
        paths = fit["initial"], trial["filtered"], fit["path"], trial["samples"]
        for path, (label, look) in zip(paths, TRIAL_LOOKS, strict=True):
            ax.plot(*(np.array(path) + shift).T, label="" if k else label, **look)
        text = "Trial {}\n$\\tau$ = ({tau_1:.2f}, {tau_2:.2f}) s\n$\\mu$ = {mu:.3f}".format(k + 1, **fit["theta"])
        ax.annotate(text, (shift[0] + 8.0, -2.5), ha="center", va="top", fontsize=6.5)
    ax.set_ylim(bottom=-15)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=7)
    ax.set_title("Simulated logs (Magic Formula vehicle), equation (18) as printed", fontsize=8, loc="left")
    tidy(ax, f"X (m), each trial shifted by {SHIFT_OF_TRIALS:g} m", "Y (m)")
    return {"fig6-trials": figure}


def list_trials(found: Found) -> list[TableRow]:
    """Return the lines of the table."""
    fits = [trial["fit"] for trial in found["trials"]]
    lines = [row for k, fit in enumerate(fits, start=1) for row in table_rows.fill_rows(TRIAL_LINE, number=k, **fit)]
    most, largest = (max(fit[name] for fit in fits) for name in ("iterations", "gradient_norm"))
    answer = "yes" if most < 15 and largest < 1e-7 else "no"
    return lines + table_rows.fill_rows(TRIALS_LINE, answer=answer, most=most, largest=largest)
