"""The picture of README and landing page: a measured toss of a cube, fitted. `python docs/idea_figures.py` writes idea.svg.

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

from switchfit.report.plot import plot_comparison, plot_modes, plot_transitions

HERE = Path(__file__).parent
EXAMPLE = HERE.parent / "examples" / "toss" / "release.py"
INKS = {"light": ("#222222", "#ffffff"), "dark": ("#d8d8d8", "#131416")}
"""Text and background of a light and of a dark page."""
SHOWN = {"x": "along the table: x (m)", "z": "height: z (m)"}
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
    """Draw height and path over time, with the modes shaded, and the numbers beside them."""
    trajectory, comparison = estimate.trajectories[0], estimate.comparisons[0][0]
    figure = Figure(figsize=(8.6, 3.6), layout="constrained", facecolor=paper)
    side = figure.add_gridspec(1, 2, width_ratios=[2.6, 1.0])
    upper, lower = side[0, 0].subgridspec(2, 1, hspace=0.08).subplots(sharex=True)
    errors = estimate.corrected_standard_errors[: len(NAMES)]
    for ax, channel in ((upper, "z"), (lower, "x")):
        plot_modes(trajectory, ax, labels=False)
        plot_transitions(estimate.transition_times[0], errors, ax)
        plot_comparison(comparison, trajectory, comparison.names.index(channel), ax)
        ax.set_ylabel(SHOWN[channel], color=ink)
        ax.tick_params(colors=ink)
        ax.spines[:].set_color(ink)
    upper.set_xlabel("")
    upper.tick_params(labelbottom=False)
    lower.set_xlabel("time (s)", color=ink)
    spans = {"in flight": (0.0, estimate.transition_times[0][4]), "slides": tuple(estimate.transition_times[0][4:6])}
    spans["sticks"] = (estimate.transition_times[0][5], trajectory.times[-1])
    for name, (begin, end) in spans.items():
        place = {"transform": upper.get_xaxis_transform(), "ha": "center", "va": "bottom", "color": ink}
        upper.text((begin + end) / 2, 1.03, name, **place)
    handles, labels = upper.get_legend_handles_labels()
    upper.legend(handles, labels, loc="upper right", frameon=False, fontsize=9, labelcolor=INKS["light"][0])
    text = figure.add_subplot(side[0, 1])
    text.set_axis_off()
    text.text(0.0, 0.97, "When did it switch?", weight="bold", color=ink, va="top", fontsize=11)
    lines = write_numbers(estimate)
    for k, line in enumerate(lines):
        text.text(0.0, 0.84 - 0.092 * k, line, color=ink, va="top", family="monospace", fontsize=9)
    text.text(
        0.0,
        0.84 - 0.092 * len(lines) - 0.03,
        f"{len(comparison.times)} measured positions\n{len(estimate.theta)} unknowns, one fit",
        color=ink,
        va="top",
        fontsize=9,
    )
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write an SVG that is the same each time."""
    with matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "switchfit"}):
        figure.savefig(path, metadata={"Date": None}, facecolor=figure.get_facecolor())


if __name__ == "__main__":
    save(draw_fit(fit(), *INKS["light"]), HERE / "idea.svg")
