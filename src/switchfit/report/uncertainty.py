"""Text and figures of what comes with a fit: profiles, predictions, residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.special

from switchfit.report.plot import LARGEST_FIGURE
from switchfit.report.text import rounded, time_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from switchfit.uncertainty.profiles import Profile
    from switchfit.uncertainty.residuals import ChannelResiduals, ResidualDiagnostics

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
    unit = "" if profile.unit in ("", "1") else f" {profile.unit}"
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
        count = f"{len(inside)} sample times lie" if len(inside) > 1 else f"the sample at {inside[0]:.6g}{unit} lies"
        notes.append(f"{count} in the interval, where the slope of the profile may jump")
    if profile.trace.jumps:
        places = ", ".join(f"{value:.6g}" for value in sorted(set(profile.trace.jumps)))
        notes.append(f"the profile jumps at {places}: the others have several minima, and the one followed ends there")
    if profile.trace.coarse:
        notes.append("towards its ends the steps of the integration are too long: give the Problem a smaller rtol")
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
    from scipy.interpolate import PchipInterpolator  # here, since importing it takes longer than a profile

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
    # zeta is near to a straight line: a curve through its points, squared, is the profile between them.
    shown = slice(first, last + 1)
    fine = np.linspace(values[first], values[last], 500)
    between = PchipInterpolator(values[shown], profile.zeta[shown])(fine) if last > first else profile.zeta[shown]
    ax.plot(fine[: len(between)], between**2, "-", color=LINE, linewidth=1.5, label="profile")
    ax.plot(values[shown], ratio[shown], "o", color=LINE, markersize=3.5)
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


def plot_diagnostics(diagnostics: ResidualDiagnostics) -> Figure:
    """A row a channel: residuals in time, their autocorrelation, and their quantiles against those of a normal one.

    Parameters
    ----------
    diagnostics : ResidualDiagnostics
        Of more than ten channels the first ten are shown.
    """
    from matplotlib.figure import Figure

    shown = list(zip(diagnostics.labels, diagnostics.channels, strict=True))[:LARGEST_FIGURE]
    figure = Figure(figsize=(10.5, 0.5 + 2.5 * max(len(shown), 1)), layout="constrained")
    if not shown:
        figure.suptitle("No residuals: the cost has no Measurements")
        return figure
    axes = figure.subplots(len(shown), 3, squeeze=False, width_ratios=[2.0, 1.2, 1.0])
    for row, (label, channel) in zip(axes, shown, strict=True):
        draw_in_time(channel, row[0])
        draw_autocorrelation(channel, row[1])
        draw_quantiles(channel, row[2])
        row[0].set_ylabel(f"{label}\nresidual / sigma" if channel.sigma_known else f"{label}\nresidual / rms")
    for ax, title in zip(axes[0], ("Residuals in time", "Autocorrelation", "Quantiles"), strict=True):
        ax.set_title(title)
    for k, ax in enumerate(axes[:, 0]):  # below all rows, or wherever the next row has times in another unit
        unit = shown[k][1].time_unit
        if k + 1 == len(shown) or shown[k + 1][1].time_unit != unit:
            ax.set_xlabel(time_label(unit))
    for ax, label in zip(axes[-1, 1:], ("lag (samples)", "normal quantile"), strict=True):
        ax.set_xlabel(label)
    return figure


def draw_in_time(channel: ChannelResiduals, ax: Axes) -> Axes:
    """Standardised residuals over time with lines at two standard deviations.

    Parameters
    ----------
    channel : ChannelResiduals
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
    """
    ax.axhline(0.0, color=LINE, linewidth=0.9)
    for side in (-2.0, 2.0):
        ax.axhline(side, color=THRESHOLD, linewidth=0.8, linestyle=":")
    size = 3.5 if len(channel.values) <= 300 else 1.5
    ax.plot(channel.times, channel.values, "o", color=THRESHOLD, markersize=size, markeredgewidth=0, alpha=0.8)
    return ax


def draw_autocorrelation(channel: ChannelResiduals, ax: Axes) -> Axes:
    """Autocorrelation against lag, with the limits within which that of white noise lies in 95 %.

    Parameters
    ----------
    channel : ChannelResiduals
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
    """
    limit = 1.96 / np.sqrt(max(len(channel.values), 1))
    ax.axhspan(-limit, limit, color=SHADE, alpha=0.15, linewidth=0)
    ax.axhline(0.0, color=THRESHOLD, linewidth=0.8)
    lags = np.arange(1, channel.lags + 1)
    ax.vlines(lags, 0.0, channel.autocorrelation, color=LINE, linewidth=1.5)
    ax.plot(lags, channel.autocorrelation, "o", color=LINE, markersize=4)
    reach = max(1.3 * float(np.max(np.abs(channel.autocorrelation), initial=0.0)), 2 * limit)
    ax.set_ylim(-min(reach, 1.05), min(reach, 1.05))
    return ax


def draw_quantiles(channel: ChannelResiduals, ax: Axes) -> Axes:
    """Sorted standardised residuals against the quantiles of the normal distribution: a straight line if normal.

    Parameters
    ----------
    channel : ChannelResiduals
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
    """
    n = len(channel.values)
    expected = scipy.special.ndtri((np.arange(1, n + 1) - 0.5) / n)
    ax.plot(expected[[0, -1]], expected[[0, -1]], "-", color=LINE, linewidth=1.0)
    ax.plot(expected, np.sort(channel.values), "o", color=THRESHOLD, markersize=3, markeredgewidth=0)
    return ax
