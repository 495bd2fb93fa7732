"""Text and figure of a profile likelihood."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from switchfit.problem.validation.messages import unit_suffix
from switchfit.report import style, times
from switchfit.report.style import FIT_COLOUR, LINE, REFERENCE_COLOUR, SHADE_COLOUR, SMALL, THIN, TRANSITION_COLOUR
from switchfit.report.times import Timed, format_time
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_text
from switchfit.uncertainty.profiles import Profile

DRAWN_PROFILE_LEVELS = (0.683, 0.95, 0.99)
"""Levels whose thresholds the figure of a profile shows, up to the level of the profile."""

_ENDS = {
    "limit": "{side} the limit {limit} comes before the threshold: the interval is one-sided",
    "flat": "not identifiable {side}: up to {last} the cost does not rise enough",
    "failed": "{side} no fit succeeded beyond {last}",
    "stopped": "{side} it was stopped before it was done",
}
"""How a profile ended on one side, if not beyond the threshold."""

_NARROW = (
    "neighbouring residuals are correlated: the interval takes them as independent, and is too narrow by a factor of "
    "about {:.2g}; profile.interval(corrected=True) allows for it"
)

_JUMPS = "the profile jumps at {}: the other unknowns have several minima, and the one that was followed ends there"


@format_text.register(Profile)
def write_profile(profile: Profile) -> str:
    """Return the estimate, both intervals, and the notes.

    Parameters
    ----------
    profile : Profile
    """
    run, unit, percent = _find_run(profile), unit_suffix(profile.unit), f"{100 * profile.level:.3g} %"
    value, error = times.format_estimate(profile.value, profile.standard_error, run)
    low, high = profile.interval()
    # With sigma estimated as well, the ratio follows F; the threshold is its quantile.
    law = "chi-square with 1 degree of freedom"
    law = law if profile.fit.sigma_known else f"F with 1 and {profile.fit.freedom} degrees of freedom"
    quadratic = profile.fit.confidence_intervals(profile.level)[profile.fit.theta_names.index(profile.name)]
    both = ((low, high), quadratic)
    # Both intervals to the same places, by the width of the exact one, so that they can be compared.
    exact, other = (", ".join(format_time(end, run, (high - low) / 4) for end in ends) for ends in both)
    end_unit = unit if run is None else ""
    lines = [
        f"Profile of {profile.name}",
        f"  estimate              {value} {error}{unit if error or run is None else ''}".rstrip(),
        f"  {percent:<4} interval         [{exact}]{end_unit}   (likelihood ratio, {law})",
        f"  quadratic             {f'[{other}]{end_unit}' if np.isfinite(quadratic).all() else 'none'}",
        f"  points, fits          {len(profile.values)}, {profile.fits}",
    ]
    lines += [f"  times                 {times.describe_origin(run)}"] if run is not None else []
    return "\n".join([*lines, *(f"  - {note}" for note in _list_profile_notes(profile))])


def _find_run(profile: Profile) -> Timed | None:
    """Return the run of a profile of a time that is a date; None for any other."""
    return times.list_dated(profile.fit)[profile.fit.theta_names.index(profile.name)]


def _list_profile_notes(profile: Profile) -> Iterator[str]:
    """Yield what limits the interpretation of a profile, a sentence each."""
    run, (low, high) = _find_run(profile), profile.interval()
    show, unit = partial(format_time, run=run), "" if run is not None else unit_suffix(profile.unit)
    limits, outermost = profile.limits.values(), profile.values[[0, -1]]
    for side, end, limit, last in zip(("downward", "upward"), profile.ends, limits, outermost, strict=True):
        if end in _ENDS:
            yield _ENDS[end].format(side=side, limit=show(limit), last=show(last))
    if profile.widening > 1:
        yield _NARROW.format(profile.widening)
    for a, b in (region for region in profile.regions() if region != (low, high)):
        yield f"the data allow values from {show(a)} to {show(b)} as well: there is another minimum"
    # A profile may find a lower minimum than the fit: then its interval is about the wrong value.
    better = profile.lower_cost
    if better is not None:
        where = f"{profile.name} = {show(better[profile.fit.theta_names.index(profile.name)])}"
        found = f"a lower cost than the estimate's was found, J = {profile.costs.min():.8g} at {where}"
        yield f"{found}: fit again with start=profile.lower_cost"
    inside = profile.sample_times[(profile.sample_times > low) & (profile.sample_times < high)]
    if len(inside):
        count = f"{len(inside)} sample times lie" if len(inside) > 1 else f"the sample at {show(inside[0])}{unit} lies"
        yield f"{count} in the interval, where the slope of the profile may jump"
    if profile.jumps:
        yield _JUMPS.format(", ".join(map(show, sorted(set(profile.jumps)))))
    if not profile.converged.all():
        yield f"{int((~profile.converged).sum())} of the fits did not converge"


@draw_figure.register(Profile)
def plot_profile(profile: Profile, *, ax: Axes | None = None) -> Axes | Figure:
    """Draw the likelihood ratio against the value, with the thresholds, the interval, and the quadratic approximation.

    Parameters
    ----------
    profile : Profile
    ax : matplotlib.axes.Axes, optional
    """
    (drawn, ax), regions = style.open_axes(ax), profile.regions()
    # Half as high again as the threshold; points far above it, of a wide scan, would flatten the curve.
    top = 1.5 * profile.fit.quantile(profile.level) ** 2
    values, ratio = profile.values, profile.zeta**2
    # One more point on each side, so that the curve leaves the figure through its upper edge.
    near = np.flatnonzero(ratio <= top)
    first, last = max(near[0] - 1, 0), min(near[-1] + 1, len(values) - 1)
    edges = [edge for region in regions for edge in region if np.isfinite(edge)]
    low, high = min([values[near[0]], *edges]), max([values[near[-1]], *edges])
    margin = 0.08 * (high - low)
    label = f"{100 * profile.level:g} % interval{', residuals as if independent' if profile.widening > 1 else ''}"
    for a, b in np.clip(regions, low - margin, high + margin).tolist():
        ax.axvspan(a, b, color=SHADE_COLOUR, alpha=0.15, linewidth=0, label=label)
        label = ""
    # zeta is near to a straight line: straight between its points, squared, it is the profile between them.
    shown, fine = slice(first, last + 1), np.linspace(values[first], values[last], 500)
    curve = np.interp(fine, values[shown], profile.zeta[shown]) ** 2
    ax.plot(fine, curve, "-", color=FIT_COLOUR, linewidth=LINE, label="profile")
    ax.plot(values[shown], ratio[shown], "o", color=FIT_COLOUR, markersize=3.5)
    x = np.linspace(low - margin, high + margin, 400)
    if np.isfinite(profile.standard_error) and profile.standard_error > 0:
        parabola = ((x - profile.value) / profile.standard_error) ** 2
        ax.plot(x, parabola, "--", color=REFERENCE_COLOUR, linewidth=LINE, label="quadratic approximation")
    for level in (*(level for level in DRAWN_PROFILE_LEVELS if level < profile.level), profile.level):
        height = profile.fit.quantile(level) ** 2
        style.draw_level(ax, f"{100 * level:.3g} %", height, "right", colour=TRANSITION_COLOUR, line=":")
    ax.axvline(profile.value, color=FIT_COLOUR, linewidth=THIN)
    inside = profile.sample_times[(profile.sample_times >= x[0]) & (profile.sample_times <= x[-1])]
    if len(inside):
        ax.plot(
            inside,
            np.zeros(len(inside)),
            "|",
            color=TRANSITION_COLOUR,
            markersize=9,
            clip_on=False,
            label="sample times",
        )
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(0.0, top)
    style.label_unknown_axis(ax, profile.name, profile.unit, _find_run(profile))
    ax.set_ylabel("2 (J - J min)" if profile.fit.sigma_known else "2 (J - J min) / s²")
    ax.set_title(f"Profile likelihood of {profile.name}")
    ax.legend(fontsize=SMALL, loc="upper center", ncols=2, edgecolor="none")
    return style.turn_off_formulas(drawn)
