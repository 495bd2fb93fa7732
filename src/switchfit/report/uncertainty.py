"""Text and figures of what comes with a fit: profiles, predictions, residuals."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from switchfit.problem.parameter import unit_suffix
from switchfit.report import formats, style
from switchfit.report.formats import Table, Timed, format_table, format_time, wrap_text
from switchfit.report.sentences import capitalise, describe_unread, join_words
from switchfit.report.style import FIT, LINE, REFERENCE, SHADE, SMALL, THIN, TRANSITION
from switchfit.runtime import special
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_count, format_text
from switchfit.uncertainty.certificate import Certificate, DerivativeCheck, Direction, Identifiability
from switchfit.uncertainty.profiles import Profile
from switchfit.uncertainty.residuals import ChannelResiduals, ResidualDiagnostics

LEVELS = (0.683, 0.95, 0.99)
"""Levels whose thresholds the figure of a profile shows, up to the level of the profile."""
ROUNDING = 1e-12
"""Rise of J, relative to J, that is rounding."""
LARGEST_FIGURE = 10
"""Largest number of channels in one figure."""


# --- certificate ------------------------------------------------------------------------------------------------------


@format_text.register(Certificate)
def write_certificate(certificate: Certificate) -> str:
    """Return every check with its number, and the verdict.

    Parameters
    ----------
    certificate : Certificate
    """
    return "\n".join(format_table(*tabulate_certificate(certificate), indent=""))


def tabulate_certificate(certificate: Certificate) -> Table:
    """Return every check with its number, and the verdict, without a header.

    Parameters
    ----------
    certificate : Certificate
    """
    held = "; ".join(map(str, [*certificate.active, *certificate.kinks]))
    failures = "; ".join(map(str, certificate.failures))
    error = f"{certificate.integration_error:.1e} ({certificate.integration_error_of})"
    orders = ", ".join("rounding" if np.isnan(order) else f"{order:.2f}" for order in certificate.taylor_orders)
    rows = [
        ("KKT residual", f"{certificate.optimality:.2e}"),
        ("smallest Hessian eigenvalue, free directions", f"{certificate.smallest_eigenvalue:.4g}"),
        ("  with unknowns scaled to unit curvature", f"{certificate.smallest_scaled_eigenvalue:.4g}"),
        ("  condition number of that", f"{certificate.condition_number:.3g}"),
        ("  worst-determined direction", certificate.worst_direction),
        ("largest integration error, relative", error),
        ("paper's gradient against discretised, relative", _format_gap(certificate.gradient_gap)),
        ("paper's Hessian against discretised, relative", _format_gap(certificate.hessian_gap)),
        (
            "Taylor orders of J, with gradient, with Hessian",
            orders if np.isfinite(certificate.taylor_orders).any() else "not checked",
        ),
        ("active constraints", held or "none"),
        ("verdict", f"FAILED: {failures}" if failures else "passed"),
    ]
    return Table(rows, "<<")


def _format_gap(gap: float) -> str:
    return "not checked" if np.isnan(gap) else f"{gap:.1e}"


# --- derivatives ------------------------------------------------------------------------------------------------------


@format_text.register(DerivativeCheck)
def write_derivative_check(check: DerivativeCheck) -> str:
    """Return the Taylor table, the gaps between the methods, and the verdict.

    Parameters
    ----------
    check : DerivativeCheck
    """
    rows, titles = [], ["h", "J", "order", "+ gradient", "order", "+ Hessian", "order"]
    for k, (h, remainders) in enumerate(zip(check.steps, check.remainders, strict=True)):
        orders = [""] * 3 if k == 0 else ["-" if np.isnan(order) else f"{order:.2f}" for order in check.orders[k - 1]]
        cells = [text for r, order in zip(remainders, orders, strict=True) for text in (f"{r:.2e}", order)]
        rows.append([f"{h:.1e}", *cells])
    lines = [
        "Taylor remainders of J along a random direction",
        "",
        *format_table(rows, ">" * 7, titles),
        "",
        "Paper's equations (6)-(17) against the derivatives of the discretised cost, relative:",
        f"  gradient {_format_gap(check.gradient_gap)}",
        f"  Hessian  {_format_gap(check.hessian_gap)}",
        write_orders(check),
    ]
    return "\n".join(lines)


def write_orders(check: DerivativeCheck) -> str:
    """Return the observed orders of the Taylor remainders and the verdict, in a line.

    Parameters
    ----------
    check : DerivativeCheck
    """
    verdict = f"FAILED: {'; '.join(map(str, check.failures))}" if check.failures else "passed"
    if any(issue.kind == "cost not finite" for issue in check.failures):
        return f"No orders were observed: {verdict}."
    observed = check.observed_orders
    orders = ", ".join("rounding only" if np.isnan(order) else f"{order:.2f}" for order in observed)
    return f"Observed orders {orders} (1, 2, 3 expected): {verdict}."


# --- identifiability --------------------------------------------------------------------------------------------------

_PLACES = {"solution": "At the solution", "first guess": "At the first guess"}
_RISES = {
    "noise": "noise hides {} (95 %)",
    "1 % of J": "1 % of J is {}",
    "1 % of variation": "a change of all that is measured by 1 % of how it varies does {}",
}


@format_text.register(Identifiability)
def write_identifiability(found: Identifiability) -> str:
    """Return how many unknowns the data determine, and the combinations that they determine badly.

    Parameters
    ----------
    found : Identifiability
    """
    count, many = len(found.theta_names) - len(found.held), found.undetermined - len(found.without)
    others = ", ".join(name for name in found.without if name not in (*found.unread, *found.absent))
    where = _PLACES[found.where]
    every = f"the data determine all {count} unknowns; condition number of the scaled Hessian"
    not_all = f"the data do not determine {format_count(many, 'combination')} of the {count} unknowns."
    collapsed = f"{', '.join(found.idle)}, because a mode has collapsed: leave it out of mode_sequence."
    cases = {
        f"{where} the cost does not depend on {others}, to second order.": others,
        f"{capitalise(describe_unread(found.unread, found.absent))}.": found.unread or found.absent,
        f"{where} the cost does not depend on {collapsed}": found.idle,
        f"{where} constraints, kinks and collapsed modes hold all unknowns.": not count,
        f"{where} {every} {found.condition_number:.3g}.": count and not found.undetermined,
        f"{where} {not_all}": count and many > 0,
    }
    lines = [line for sentence, applies in cases.items() if applies for line in wrap_text(sentence, others="")]
    for direction in found.directions if count else ():
        lines += wrap_text(write_direction(found, direction), "  - ", "    ")
    return "\n".join(lines)


def write_direction(found: Identifiability, direction: Direction) -> str:
    """Return which unknowns trade off along a direction, the change that was tried, and the rise of J.

    Parameters
    ----------
    found : Identifiability
    direction : Direction
        One of ``found.directions``.
    """
    # If only the opposite change was possible, describe that one.
    side = -1.0 if np.isnan(direction.rises[0]) and np.isfinite(direction.rises[1]) else 1.0
    places = [found.theta_names.index(name) for name in direction.names]
    moves = join_words([_format_move(found, i, side * float(direction.change[i])) for i in places])
    rise = _RISES[found.meaning].format(f"{found.rise:.2g}") if found.rise > 0 else ""
    seen = f", or the opposite, should raise J little; {rise}."
    seen = _format_rises(direction, rise, found.cost) if found.tried else seen
    return f"{direction.summary} (scaled eigenvalue {direction.eigenvalue:.2g}): {moves}{seen}"


def _format_move(found: Identifiability, i: int, change: float) -> str:
    """Return a change in words: later or earlier for a transition time, higher or lower for other unknowns."""
    up, down = ("later", "earlier") if found.is_time[i] else ("higher", "lower")
    size = f"{abs(change):.2g}{unit_suffix(found.theta_units[i])}"
    return f"{found.theta_names[i]} {size} {up if change > 0 else down}"


def _format_rises(direction: Direction, rise: str, cost: float) -> str:
    """Return the rise of J on both sides of a change, as the end of a sentence."""
    finite = [r for r in direction.rises if np.isfinite(r)]
    if not finite:
        return ": J could not be evaluated there."
    worst = 0.0 if abs(max(finite)) <= ROUNDING * abs(cost) else max(finite)
    related = np.isfinite(cost) and abs(worst) < 10 * abs(cost)  # a ratio to a J near 0 means nothing
    relative = f" ({100 * worst / abs(cost):.2g} %)" if related else ""
    both = ", or the opposite," if len(finite) == 2 else ""
    return f"{both} raises J by {worst:.2g}{relative}" + (f"; {rise}." if rise else ".")


# --- residuals --------------------------------------------------------------------------------------------------------


@format_text.register(ResidualDiagnostics)
def write_diagnostics(diagnostics: ResidualDiagnostics) -> str:
    """Return a line for each channel, and the tests that fail.

    Parameters
    ----------
    diagnostics : ResidualDiagnostics
    """
    if not diagnostics.channels:
        return "No residuals: the cost has no Measurements."
    lines = ["Standardised residuals", *format_table(*tabulate_diagnostics(diagnostics))]
    return "\n".join([*lines, *(f"  - {issue}" for issue in diagnostics.issues)])


def tabulate_diagnostics(diagnostics: ResidualDiagnostics) -> Table:
    """Return a row for each channel.

    Parameters
    ----------
    diagnostics : ResidualDiagnostics
    """
    rows, titles = [], ["", "values", "rms", "mean", "lag 1", "worth", "P(white)", "beyond 4"]
    for label, channel in zip(diagnostics.labels, diagnostics.channels, strict=True):
        size = [f"{len(channel.values)}", f"{channel.rms:.3g}", f"{channel.mean:+.2f}"]
        correlation = [f"{channel.correlation:+.2f}", f"{channel.effective:.0f}"]
        tests = [format_probability(channel.whiteness), f"{channel.outliers}"]
        rows.append([label, *size, *correlation, *tests])
    return Table(rows, "<" + ">" * 7, titles)


def format_probability(value: float) -> str:
    """Return a probability as text; a dash if it is not known."""
    return "-" if np.isnan(value) else f"{value:.3f}" if value >= 5e-4 else f"{value:.0e}"


# --- profiles ---------------------------------------------------------------------------------------------------------


@format_text.register(Profile)
def write_profile(profile: Profile) -> str:
    """Return the estimate, both intervals, and the notes.

    Parameters
    ----------
    profile : Profile
    """
    run, unit, percent = _find_run(profile), unit_suffix(profile.unit), f"{100 * profile.level:.3g} %"
    value, error = formats.format_estimate(profile.value, profile.standard_error, run)
    low, high = profile.interval()
    law = "chi-square with 1 degree of freedom"
    law = law if profile.fit.sigma_known else f"F with 1 and {profile.fit.freedom} degrees of freedom"
    quadratic = profile.fit.confidence_intervals(profile.level)[profile.fit.theta_names.index(profile.name)]
    both = ((low, high), quadratic)
    exact, other = (", ".join(format_time(end, run, (high - low) / 4) for end in ends) for ends in both)
    end_unit = unit if run is None else ""
    lines = [
        f"Profile of {profile.name}",
        f"  estimate              {value} {error}{unit if error or run is None else ''}".rstrip(),
        f"  {percent:<4} interval         [{exact}]{end_unit}   (likelihood ratio, {law})",
        f"  quadratic             {f'[{other}]{end_unit}' if np.isfinite(quadratic).all() else 'none'}",
        f"  points, fits          {len(profile.values)}, {profile.fits}",
    ]
    lines += [f"  times                 {formats.describe_origin(run)}"] if run is not None else []
    return "\n".join([*lines, *(f"  - {note}" for note in list_profile_notes(profile))])


def _find_run(profile: Profile) -> Timed | None:
    """Return the run of a profile of a time that is a date; None for any other."""
    return formats.list_dated(profile.fit)[profile.fit.theta_names.index(profile.name)]


_ENDS = {
    "limit": "{side} the limit {limit} comes before the threshold: the interval is one-sided",
    "flat": "not identifiable {side}: up to {last} the cost does not rise enough",
    "failed": "{side} no fit succeeded beyond {last}",
    "stopped": "{side} it was stopped before it was done",
}
"""How a profile ended on one side, if not beyond the threshold."""


def list_profile_notes(profile: Profile) -> Iterator[str]:
    """Yield what limits the interpretation of a profile, a sentence each.

    Parameters
    ----------
    profile : Profile
    """
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


_NARROW = (
    "neighbouring residuals are correlated: the interval takes them as independent, and is too narrow by a factor of "
    "about {:.2g}; profile.interval(corrected=True) allows for it"
)
_JUMPS = "the profile jumps at {}: the other unknowns have several minima, and the one that was followed ends there"


@draw_figure.register(Profile)
def plot_profile(profile: Profile, *, ax: Axes | None = None) -> Axes | Figure:
    """Draw the likelihood ratio against the value, with the thresholds, the interval, and the quadratic approximation.

    Parameters
    ----------
    profile : Profile
    ax : matplotlib.axes.Axes, optional
    """
    (drawn, ax), regions = style.open_axes(ax), profile.regions()
    top = 1.5 * profile.fit.quantile(profile.level) ** 2
    values, ratio = profile.values, profile.zeta**2
    near = np.flatnonzero(ratio <= top)
    first, last = max(near[0] - 1, 0), min(near[-1] + 1, len(values) - 1)
    edges = [edge for region in regions for edge in region if np.isfinite(edge)]
    low, high = min([values[near[0]], *edges]), max([values[near[-1]], *edges])
    margin = 0.08 * (high - low)
    label = f"{100 * profile.level:g} % interval{', residuals as if independent' if profile.widening > 1 else ''}"
    for a, b in np.clip(regions, low - margin, high + margin).tolist():
        ax.axvspan(a, b, color=SHADE, alpha=0.15, linewidth=0, label=label)
        label = ""
    # zeta is near to a straight line: straight between its points, squared, it is the profile between them.
    shown, fine = slice(first, last + 1), np.linspace(values[first], values[last], 500)
    curve = np.interp(fine, values[shown], profile.zeta[shown]) ** 2
    ax.plot(fine, curve, "-", color=FIT, linewidth=LINE, label="profile")
    ax.plot(values[shown], ratio[shown], "o", color=FIT, markersize=3.5)
    x = np.linspace(low - margin, high + margin, 400)
    if np.isfinite(profile.standard_error) and profile.standard_error > 0:
        parabola = ((x - profile.value) / profile.standard_error) ** 2
        ax.plot(x, parabola, "--", color=REFERENCE, linewidth=LINE, label="quadratic approximation")
    for level in (*(level for level in LEVELS if level < profile.level), profile.level):
        height = profile.fit.quantile(level) ** 2
        style.draw_level(ax, f"{100 * level:.3g} %", height, "right", colour=TRANSITION, line=":")
    ax.axvline(profile.value, color=FIT, linewidth=THIN)
    inside = profile.sample_times[(profile.sample_times >= x[0]) & (profile.sample_times <= x[-1])]
    if len(inside):
        ax.plot(inside, np.zeros(len(inside)), "|", color=TRANSITION, markersize=9, clip_on=False, label="sample times")
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(0.0, top)
    style.label_unknown_axis(ax, profile.name, profile.unit, _find_run(profile))
    ax.set_ylabel("2 (J - J min)" if profile.fit.sigma_known else "2 (J - J min) / s²")
    ax.set_title(f"Profile likelihood of {profile.name}")
    ax.legend(fontsize=SMALL, loc="upper center", ncols=2, edgecolor="none")
    return style.turn_off_formulas(drawn)


@draw_figure.register(ResidualDiagnostics)
def plot_diagnostics(diagnostics: ResidualDiagnostics, most: int = LARGEST_FIGURE) -> Figure:
    """Draw a row for each channel: residuals in time, their autocorrelation, their quantiles against normal ones.

    Parameters
    ----------
    diagnostics : ResidualDiagnostics
    most : int, optional
        Of more channels, those are shown whose residuals widen the standard errors most, the worst first.
    """
    shown = list(zip(diagnostics.labels, diagnostics.channels, strict=True))
    if len(shown) > most:
        shown = sorted(shown, key=lambda pair: pair[1].widening, reverse=True)[:most]
    figure = style.make_figure(10.5, 0.5 + 2.5 * max(len(shown), 1))
    if not shown:
        figure.suptitle("No residuals: the cost has no Measurements")
        return figure
    figure.suptitle(formats.count_worst(shown, diagnostics.channels, "channels"), fontsize="medium")
    axes = figure.subplots(len(shown), 3, squeeze=False, width_ratios=[2.0, 1.2, 1.0])
    for row, (label, channel) in zip(axes, shown, strict=True):
        for ax, draw in zip(row, (draw_in_time, draw_autocorrelation, draw_quantiles), strict=True):
            draw(channel, ax)
        row[0].set_ylabel(f"{formats.wrap_quantity(label)}\nresidual / {'sigma' if channel.sigma_known else 'rms'}")
    for ax, title in zip(axes[0], ("Residuals in time", "Autocorrelation", "Quantiles"), strict=True):
        ax.set_title(title)
    for ax, label in zip(axes[-1, 1:], ("lag (samples)", "normal quantile"), strict=True):
        ax.set_xlabel(label)
    return style.turn_off_formulas(figure)


def draw_in_time(channel: ChannelResiduals, ax: Axes) -> None:
    """Draw standardised residuals over time with lines at two standard deviations.

    Parameters
    ----------
    channel : ChannelResiduals
    ax : matplotlib.axes.Axes
    """
    ax.axhline(0.0, color=FIT, linewidth=THIN)
    for side in (-2.0, 2.0):
        ax.axhline(side, color=TRANSITION, linewidth=THIN, linestyle=":")
    size = 3.5 if len(channel.values) <= 300 else 1.5
    ax.plot(channel.times, channel.values, "o", color=TRANSITION, markersize=size, markeredgewidth=0, alpha=0.8)
    style.label_axis(ax, channel)


def draw_autocorrelation(channel: ChannelResiduals, ax: Axes) -> None:
    """Draw the autocorrelation against lag, with the limits within which that of white noise lies in 95 %.

    Parameters
    ----------
    channel : ChannelResiduals
    ax : matplotlib.axes.Axes
    """
    limit = 1.96 / np.sqrt(max(len(channel.values), 1))
    ax.axhspan(-limit, limit, color=SHADE, alpha=0.15, linewidth=0)
    ax.axhline(0.0, color=TRANSITION, linewidth=THIN)
    lags = np.arange(1, len(channel.autocorrelation) + 1)
    ax.vlines(lags, 0.0, channel.autocorrelation, color=FIT, linewidth=LINE)
    ax.plot(lags, channel.autocorrelation, "o", color=FIT, markersize=4)
    reach = max(1.3 * float(np.max(np.abs(channel.autocorrelation), initial=0.0)), 2 * limit)
    ax.set_ylim(-min(reach, 1.05), min(reach, 1.05))


def draw_quantiles(channel: ChannelResiduals, ax: Axes) -> None:
    """Draw sorted standardised residuals against the quantiles of the normal distribution: a straight line if normal.

    Parameters
    ----------
    channel : ChannelResiduals
    ax : matplotlib.axes.Axes
    """
    n = len(channel.values)
    expected = special.ndtri((np.arange(1, n + 1) - 0.5) / n)
    ax.plot(expected[[0, -1]], expected[[0, -1]], "-", color=FIT, linewidth=THIN)
    ax.plot(expected, np.sort(channel.values), "o", color=TRANSITION, markersize=3, markeredgewidth=0)
