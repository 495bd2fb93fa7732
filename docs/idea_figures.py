"""The picture of README and landing page: a measured toss, fitted. `python docs/idea_figures.py` writes idea.svg.

The landing page has it in the colours of a light and of a dark page, drawn when the documentation is built; README's is
kept, since a README is shown where nothing is built.
"""

from __future__ import annotations

import runpy
from pathlib import Path

import matplotlib

import switchfit as sf

matplotlib.use("agg")

from matplotlib.figure import Figure

from switchfit.report.panels import plot_comparison, plot_modes, plot_transitions
from switchfit.uncertainty.corrected_errors import find_transition_intervals

HERE = Path(__file__).parent
EXAMPLE = HERE.parent / "examples" / "toss" / "release.py"
INKS = {"light": ("#222222", "#ffffff"), "dark": ("#d8d8d8", "#131416")}
"""Text and background of a light and of a dark page."""
SHOWN = {"x": "path: x (m)", "z": "height: z (m)"}
NAMES = ("impact 1", "impact 2", "impact 3", "impact 4", "lies flat", "rests")


def draw(folder: Path) -> None:
    """Write idea-light.svg and idea-dark.svg."""
    folder.mkdir(exist_ok=True)
    estimate = fit()
    for name in INKS:
        save(draw_fit(estimate, *INKS[name]), folder / f"idea-{name}.svg")


def fit() -> sf.Estimate:
    """Return the fit of the toss: six transition times, 21 other unknowns."""
    return sf.estimate(runpy.run_path(str(EXAMPLE))["make_problem"]())


def write_numbers(estimate: sf.Estimate) -> list[str]:
    """Return a line for each transition time and for the friction, with standard errors as the report has them."""
    errors = dict(zip(estimate.theta_names, estimate.corrected_standard_errors, strict=True))
    rows = [
        (name, time, errors[f"tau_{k}"], " s")
        for k, (name, time) in enumerate(zip(NAMES, estimate.transition_times[0], strict=True), start=1)
    ]
    rows.append(("friction μ", float(estimate.parameters["mu"]), errors["mu"], ""))
    return [f"{name:<10} {value:.4f} ± {error:.4f}{unit}" for name, value, error, unit in rows]


def draw_fit(estimate: sf.Estimate, ink: str, paper: str) -> Figure:
    """Draw height and path over time, with the modes shaded, and the numbers below: readable on a phone too."""
    trajectory, comparison = estimate.trajectories[0], estimate.comparisons[0][0]
    times, intervals = estimate.transition_times[0], find_transition_intervals(estimate, 0)
    figure = Figure(figsize=(6.4, 4.6), layout="constrained", facecolor=paper)
    upper, lower, below = figure.subplots(3, 1, height_ratios=(1.0, 1.0, 0.72))
    for ax, channel in ((upper, "z"), (lower, "x")):
        plot_modes(trajectory, ax, labels=False)
        plot_transitions(times, intervals, ax)
        plot_comparison(comparison, comparison.names.index(channel), ax)
        ax.set_ylabel(SHOWN[channel], color=ink)
        ax.tick_params(colors=ink)
        ax.spines[:].set_color(ink)
    upper.set_xlabel("")
    upper.tick_params(labelbottom=False)
    lower.set_xlabel("time (s)", color=ink)
    for name, begin, end in (("in flight", 0.0, times[4]), ("slides", *times[4:6])):
        place = {"transform": upper.get_xaxis_transform(), "ha": "center", "va": "bottom", "color": ink}
        upper.text((begin + end) / 2, 1.03, name, **place)
    upper.text(1.0, 1.03, "sticks", transform=upper.transAxes, ha="right", va="bottom", color=ink)
    handles, labels = upper.get_legend_handles_labels()
    upper.legend(
        handles,
        labels,
        loc="upper center",
        bbox_to_anchor=(0.67, 1.0),
        frameon=False,
        labelcolor=INKS["light"][0],
        ncols=2,
    )
    below.set_axis_off()
    for k, line in enumerate(write_numbers(estimate)):
        column, row = divmod(k, 4)
        below.text(0.53 * column, 0.95 - 0.25 * row, line, color=ink, va="top", family="monospace", fontsize=9.5)
    known = f"{len(comparison.times)} positions, {len(estimate.theta)} unknowns, one fit"
    below.text(0.53, 0.2, known, color=ink, va="top", fontsize=9.5, weight="bold")
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write an SVG that is the same each time."""
    with matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "switchfit"}):
        figure.savefig(path, metadata={"Date": None}, facecolor=figure.get_facecolor())


if __name__ == "__main__":
    save(draw_fit(fit(), *INKS["light"]), HERE / "idea.svg")
