"""Text and figures of what comes with a fit: profiles, predictions, residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from switchfit.report.text import rounded

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from switchfit.profile import Profile

LINE, QUADRATIC, THRESHOLD, SHADE = "#b2182b", "#777777", "#333333", "#4a7fb5"
LEVELS = (0.683, 0.95, 0.99)
"""Whose thresholds a profile's figure shows, up to the one it was followed to."""


def profile_text(profile: Profile) -> str:
    """The estimate, both intervals, how each side ended, and what to be wary of.

    Parameters
    ----------
    profile : Profile
    """
    unit = "" if profile.unit in ("", "1") else f" {profile.unit}"
    value, error, _ = rounded(profile.value, profile.standard_error)
    percent = f"{100 * profile.level:.3g} %"
    low, high = profile.interval()
    digits = max(profile.standard_error, 0.0) if np.isfinite(profile.standard_error) else 0.0
    digits = digits or abs(high - low) if np.isfinite(high - low) else digits or abs(profile.value)
    by = (
        "likelihood ratio, chi-square with 1 degree of freedom"
        if profile.fit.sigma_known
        else f"likelihood ratio, F with 1 and {profile.fit.freedom} degrees of freedom"
    )
    quadratic = profile.fit.confidence_intervals(profile.level)[profile.fit.theta_names.index(profile.name)]
    shown = (
        f"[{_number(quadratic[0], digits)}, {_number(quadratic[1], digits)}]{unit}"
        if np.isfinite(quadratic).all()
        else "none"
    )
    lines = [
        f"Profile of {profile.name}",
        f"  estimate              {value} {error}{unit}".rstrip(),
        f"  {percent:<4} interval         [{_number(low, digits)}, {_number(high, digits)}]{unit}   ({by})",
        f"  quadratic             {shown}",
        f"  points, fits          {len(profile.values)}, {profile.trace.fits}",
    ]
    return "\n".join([*lines, *(f"  - {note}" for note in profile_notes(profile))])


def _number(value: float, error: float) -> str:
    """A number to the second digit of an error."""
    if not np.isfinite(value):
        return {np.inf: "inf", -np.inf: "-inf"}.get(value, "?")
    return rounded(value, error)[0] if error > 0 else f"{value:.6g}"


def profile_notes(profile: Profile) -> list[str]:
    """What is not as in the textbook, a sentence each.

    Parameters
    ----------
    profile : Profile
    """
    notes = []
    for side, end, limit in zip(("downward", "upward"), profile.ends, profile.trace.limits.values(), strict=True):
        if end == "limit":
            notes.append(f"{side} the limit {limit:.6g} comes before the threshold: the interval is one-sided")
        elif end == "flat":
            far = profile.values[0] if side == "downward" else profile.values[-1]
            notes.append(f"not identifiable {side}: up to {far:.3g} the cost does not rise enough")
        elif end == "failed":
            far = profile.values[0] if side == "downward" else profile.values[-1]
            notes.append(f"{side} no fit succeeded beyond {far:.6g}")
        elif end == "stopped":
            notes.append(f"{side} it was stopped before it was done")
    low, high = profile.interval()
    others = [r for r in profile.regions() if r != (low, high)]
    notes += [f"the data allow values from {a:.6g} to {b:.6g} as well: there is another minimum" for a, b in others]
    better = profile.lower_cost
    if better is not None:
        notes.append(
            f"a lower cost than the estimate's was found, J = {profile.costs.min():.8g} at {profile.name} = "
            f"{better[profile.fit.theta_names.index(profile.name)]:.6g}: fit again with start=profile.lower_cost"
        )
    inside = profile.sample_times[(profile.sample_times > low) & (profile.sample_times < high)]
    if len(inside):
        count = f"{len(inside)} sample times lie" if len(inside) > 1 else f"the sample at {inside[0]:.6g} s lies"
        notes.append(f"{count} in the interval, where the slope of the profile may jump")
    if not profile.converged.all():
        notes.append(f"{int((~profile.converged).sum())} of the fits did not converge")
    return notes


def plot_profile(profile: Profile) -> Figure:
    """A figure of one profile.

    Parameters
    ----------
    profile : Profile
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    draw_profile(profile, figure.subplots())
    return figure


def draw_profile(profile: Profile, ax: Axes) -> Axes:
    """The likelihood ratio against the value, with the thresholds, the interval, and the quadratic approximation.

    Parameters
    ----------
    profile : Profile
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
    """
    regions = profile.regions()
    top = 1.5 * profile.fit.quantile(profile.level) ** 2
    values, ratio = profile.values, profile.zeta**2
    near = np.flatnonzero(ratio <= top)
    first, last = max(near[0] - 1, 0), min(near[-1] + 1, len(values) - 1)
    edges = [edge for region in regions for edge in region if np.isfinite(edge)]
    low, high = min([values[near[0]], *edges]), max([values[near[-1]], *edges])
    margin = 0.08 * (high - low)
    for k, (a, b) in enumerate(regions):
        bounds = max(a, low - margin), min(b, high + margin)
        ax.axvspan(
            *bounds, color=SHADE, alpha=0.15, linewidth=0, label="" if k else f"{100 * profile.level:g} % interval"
        )
    ax.plot(values[first : last + 1], ratio[first : last + 1], "o-", color=LINE, markersize=3.5, label="profile")
    x = np.linspace(low - margin, high + margin, 400)
    if np.isfinite(profile.standard_error) and profile.standard_error > 0:
        parabola = ((x - profile.value) / profile.standard_error) ** 2
        ax.plot(x, parabola, "--", color=QUADRATIC, linewidth=1.4, label="quadratic approximation")
    for level in sorted({*(level for level in LEVELS if level < profile.level), profile.level}):
        height = profile.fit.quantile(level) ** 2
        ax.axhline(height, color=THRESHOLD, linewidth=0.8, linestyle=":")
        ax.annotate(
            f"{100 * level:.3g} %",
            (0.995, height),
            xycoords=("axes fraction", "data"),
            ha="right",
            va="bottom",
            fontsize=8,
        )
    ax.axvline(profile.value, color=LINE, linewidth=0.8)
    inside = profile.sample_times[(profile.sample_times >= x[0]) & (profile.sample_times <= x[-1])]
    if len(inside):
        ax.plot(inside, np.zeros(len(inside)), "|", color=THRESHOLD, markersize=9, clip_on=False, label="sample times")
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(0.0, top)
    unit = f" ({profile.unit})" if profile.unit not in ("", "1") else ""
    ax.set_xlabel(f"{profile.name}{unit}")
    ax.set_ylabel("2 (J - J min)" if profile.fit.sigma_known else "2 (J - J min) / s²")
    ax.set_title(f"Profile likelihood of {profile.name}")
    ax.ticklabel_format(axis="x", useOffset=False)
    ax.legend(frameon=False, fontsize=8, loc="upper center", ncols=2)
    return ax
