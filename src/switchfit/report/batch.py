"""Tables and figures of many fits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial, singledispatch
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.batch.fits import Fits
from switchfit.batch.simulated import Bootstrap, MonteCarlo
from switchfit.batch.starts import Multistart
from switchfit.problem.parameter import unit_suffix
from switchfit.report import formats, style
from switchfit.report.formats import Table, format_estimate, format_table, format_time, label_quantity, list_dated
from switchfit.report.style import DATA, FIT, GROUP_COLOURS, LINE, SHADE, SMALL, THIN
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_count, format_text

LISTED_MINIMA = 10
LISTED_UNKNOWNS, LISTED_PLACES = 12, 6
"""Largest numbers of unknowns in a table, and in the line of a minimum; transition times are left out first."""
LISTED_FITS, LISTED_WORST = 24, 12
"""Fits up to which all are listed in their order; of more, the worst."""
LISTED_COLUMNS = 4
"""Unknowns in the line of a fit."""
TOO_FEW = "Fewer than two fits converged: no statistics."
OTHERS = "#bbbbbb"
"""Of a line that joins starts."""
LEVEL_COLOURS = {"good": "#1a7f4b", "doubtful": "#c07800", "bad": "#bb2a20"}
DRAWN_FITS, DRAWN_UNKNOWNS = 40, 6
"""Fits and unknowns in a figure: the worst fits, and of more unknowns first those that are no transition times."""

FARTHEST = 30.0
"""Length of one side of an interval, in the median of all, beyond which a figure cuts it off: a parameter on a
logarithmic scale that is not determined has an end of 1e166."""


@format_text.register(Fits)
def write_fits(fits: Fits) -> str:
    """Return the verdict, how the fits ended, the first that did not converge, and the table of the study.

    Parameters
    ----------
    fits : Fits
    """
    count, good = len(fits), int(fits.success.sum())
    each = f"({1e3 * fits.seconds / max(count, 1):.2f} ms each)"
    lines = [
        *formats.wrap_text(str(fits.verdict)),
        f"{format_count(count, 'fit')} in {fits.seconds:.1f} s {each}, {good} converged",
    ]
    endings = Counter(fits.status.tolist()).most_common()
    lines += format_table([(str(number), name) for name, number in endings], "><", indent="    ")
    if good < count:
        lines.append("not converged (all of them in .failures):")
        lines += [f"  run {run}: {message}" for run, message in fits.failures[:3]]
    if isinstance(fits, Bootstrap):
        what = f"{fits.resample} of {fits.block} samples" if fits.resample == "blocks" else fits.resample
        lines.append(f"resampled: {what}")
    minima = [f"{format_count(_count_minima(fits), 'minimum', 'minima')}:"] if isinstance(fits, Multistart) else []
    table, note = tabulate_study(fits)
    return "\n".join([*lines, "", *minima, *format_table(*table, indent=""), *([note] if note else [])])


def _count_minima(study: Multistart) -> int:
    return int(study.clusters.max(initial=-1)) + 1


@singledispatch
def tabulate_study(fits: Fits) -> tuple[Table, str]:
    """Return the table of many fits, and what it leaves out; the table is empty where too few converged.

    A row for each fit: level, cost, and the unknowns with their standard errors; of many, the worst first. Bootstraps
    and Monte Carlo studies have a row for each unknown, multistarts one for each minimum.

    Parameters
    ----------
    fits : Fits
    """
    listed, notes = range(len(fits)), []
    if len(fits) > LISTED_FITS:
        listed = fits.worst_first[:LISTED_WORST].tolist()
        notes.append(f"the worst {LISTED_WORST} of {len(fits)} fits; .to_pandas() has all of them")
    shown, errors, clocks = select_unknowns(fits, LISTED_COLUMNS), fits.standard_errors, list_dated(fits)
    titles, rows = ["run", "", "J", *(part for i in shown for part in (_label(fits, i), ""))], []
    for k in listed:
        cells = [part for i in shown for part in format_estimate(fits.theta[k, i], errors[k, i], clocks[i])]
        rows.append([str(fits.runs[k]), str(fits.levels[k]), f"{fits.cost[k]:.6g}", *cells])
    notes += filter(None, [_count_rest(fits, shown)])
    return Table(rows, "><>" + "><" * len(shown), titles), "\n".join(notes)


@tabulate_study.register
def tabulate_minima(study: Multistart) -> tuple[Table, str]:
    """Return a row for each of the ten lowest minima: J, how many starts ended there, and where it is."""
    rows, clocks = [], list_dated(study)
    shown = select_unknowns(study, LISTED_PLACES)
    for k in range(min(_count_minima(study), LISTED_MINIMA)):
        here = np.flatnonzero(study.clusters == k)
        places = []
        for i in shown:
            unit = "" if clocks[i] else unit_suffix(study.theta_units[i])
            places.append(f"{study.theta_names[i]} = {format_time(study.theta[here[0], i], clocks[i])}{unit}")
        more = len(study.theta_names) - len(shown)
        place = ", ".join(places) + (f" and {more} more" if more else "")
        rows.append((f"J = {study.cost[here].min():.9g}", format_count(len(here), "start"), place))
    return Table(rows, "<><"), ""


def select_unknowns(fits: Fits, most: int) -> list[int]:
    """Return the indices of the unknowns that are listed, at most so many."""
    is_time = [name.rsplit(".", 1)[-1].startswith("tau_") for name in fits.theta_names]
    return formats.select_unknowns(is_time, most)


def _count_rest(fits: Fits, shown: Sequence[int]) -> str:
    more = len(fits.theta_names) - len(shown)
    return f"and {format_count(more, 'more unknown')}" if more else ""


@tabulate_study.register
def tabulate_monte_carlo(study: MonteCarlo) -> tuple[Table, str]:
    """Return a row for each unknown: truth, mean error with its own error, spread, standard error, coverage."""
    count = int(study.success.sum())
    if count < 2:
        return Table([], ""), TOO_FEW
    spread, bias, coverage = study.standard_deviation, study.bias, study.coverage()
    reported = np.median(study.standard_errors[study.success], axis=0)
    rows, shown, clocks = [], select_unknowns(study, LISTED_UNKNOWNS), list_dated(study)
    for i in shown:
        truth = format_time(study.truth[i], clocks[i], spread[i])
        error = "-" if np.isnan(reported[i]) else f"{reported[i]:.3e}"
        covered = "-" if np.isnan(coverage[i]) else f"{100 * coverage[i]:.1f} %"
        sizes = f"{bias[i]:+.2e}", f"{spread[i] / np.sqrt(count):.1e}", f"{spread[i]:.3e}"
        rows.append((_label(study, i), truth, *sizes, error, covered))
    titles = ("", "truth", "bias", "+-", "spread", "standard error", "in 95 % interval")
    return Table(rows, "<" + ">" * 6, titles), _count_rest(study, shown)


@tabulate_study.register
def tabulate_bootstrap(study: Bootstrap) -> tuple[Table, str]:
    """Return a row for each unknown: estimate, bias, bootstrap standard error, 95 % interval (BCa)."""
    if int(study.success.sum()) < 2:
        return Table([], ""), TOO_FEW
    rows, shown, clocks = [], select_unknowns(study, LISTED_UNKNOWNS), list_dated(study)
    bias, error, intervals = study.bias, study.standard_deviation, study.intervals()
    for k in shown:
        ends = ", ".join(format_time(end, clocks[k], error[k]) for end in intervals[k])
        spread = f"{bias[k]:+.2e}", f"{error[k]:.3e}", f"[{ends}]"
        spread = spread if study.resampled[k] else ("-", "-", "of one run alone")
        rows.append((_label(study, k), format_time(study.estimate[k], clocks[k], error[k]), *spread))
    titles = ("", "estimate", "bias", "standard error", "95 % interval (BCa)")
    return Table(rows, "<" + ">" * 4, titles), _count_rest(study, shown)


def _label(fits: Fits, k: int) -> str:
    """Return name and unit of unknown k."""
    return label_quantity(fits.theta_names[k], fits.theta_units[k])


# --- figures ----------------------------------------------------------------------------------------------------------


@draw_figure.register(Fits)
def plot_fits(fits: Fits) -> Figure:
    """Draw a panel for each unknown: its histogram, or a row for each fit of a log.

    Parameters
    ----------
    fits : Fits
    """
    shown, width, height, most, title = list(range(len(fits.theta_names))), 3.4, 2.7, 3, ""
    if isinstance(fits, Bootstrap):
        draw: Any = draw_bootstrap
        shown, title = np.flatnonzero(fits.resampled).tolist(), f"Bootstrap: {fits.resample}"
    elif isinstance(fits, MonteCarlo):
        failed = int((~fits.success).sum())
        draw, title = draw_monte_carlo, f"{failed} runs that did not converge are left out" if failed else ""
    else:
        order = fits.worst_first[:DRAWN_FITS]
        draw, title = partial(draw_rows, order=order), formats.count_worst(order, fits, "fits")
        width, height, most = 2.9, 0.9 + 0.2 * max(len(order), 5), DRAWN_UNKNOWNS
        shown = select_unknowns(fits, DRAWN_UNKNOWNS)
    if isinstance(fits, MonteCarlo | Bootstrap) and fits.success.sum() < 2:
        shown, title = [], TOO_FEW
    columns = max(min(len(shown), most), 1)
    rows = max(-(-len(shown) // columns), 1)
    figure = style.make_figure(width * columns + 0.5, height * rows + 0.5)
    axes = [figure.add_subplot(rows, columns, number + 1) for number in range(len(shown))]
    for number, panel in enumerate(axes):
        draw(fits, shown[number], panel)
        if number % columns:
            panel.set_ylabel("")
            panel.tick_params(labelleft=False)
    figure.draw_legend(style.collect_handles(axes[:1]), most=3, loc="outside upper center", title=title)
    return style.turn_off_formulas(figure)


def draw_rows(fits: Fits, k: int, ax: Axes, *, order: NDArray[np.intp]) -> None:
    """Draw one unknown with its 95 % intervals, a row for each of the given fits, the first on top.

    Parameters
    ----------
    fits : Fits
    k : int, from 0
        Which unknown.
    ax : matplotlib.axes.Axes
    order : int array
        Places of the fits that are drawn.
    """
    rows, intervals, levels = np.arange(len(order)), fits.confidence_intervals()[order, k], fits.levels[order]
    for level, colour in LEVEL_COLOURS.items():
        here = levels == level
        if here.any():
            ax.hlines(rows[here], *intervals[here].T, color=colour, linewidth=LINE, alpha=0.6)
            ax.scatter(fits.theta[order[here], k], rows[here], s=18, color=colour, label=level, zorder=2)
    theta = fits.theta[order, k, None]
    size = np.abs(intervals - theta)
    known = size[(size > 0) & (size < np.inf)]
    if len(known) and known.max() > (most := FARTHEST * np.median(known)):
        near = np.where(size <= most, intervals, theta)
        margin = 0.05 * (np.nanmax(near) - np.nanmin(near))
        ax.set_xlim(np.nanmin(near) - margin, np.nanmax(near) + margin)
    ax.grid(axis="x", linewidth=THIN / 2, alpha=0.6)
    ax.set_yticks(rows, [str(run) for run in fits.runs[order]])
    ax.set_ylabel("run")
    ax.set_ylim(max(len(order), 1) - 0.5, -0.5)
    _label_axis(fits, k, ax)


def draw_bootstrap(study: Bootstrap, k: int, ax: Axes) -> None:
    """Draw the histogram of one unknown: estimates of the resampled data, the estimate, its 95 % interval.

    Parameters
    ----------
    study : Bootstrap
    k : int, from 0
        Which unknown.
    ax : matplotlib.axes.Axes
    """
    _draw_histogram(study, k, study.estimate[k], ax)
    ax.axvline(study.estimate[k], color=FIT, linewidth=LINE, label="estimate")
    for side, edge in enumerate(study.intervals()[k]):
        ax.axvline(edge, color=DATA, linestyle=":", linewidth=LINE, label="" if side else "95 % interval (BCa)")


def draw_monte_carlo(study: MonteCarlo, k: int, ax: Axes) -> None:
    """Draw the histogram of one unknown: estimates, truth, the normal density of the reported standard error.

    Parameters
    ----------
    study : MonteCarlo
    k : int, from 0
        Which unknown.
    ax : matplotlib.axes.Axes
    """
    _draw_histogram(study, k, study.truth[k], ax, density=True)
    error = float(np.median(study.standard_errors[study.success, k]))
    if np.isfinite(error) and error > 0:
        x = np.linspace(*ax.get_xlim(), 300)
        normal = np.exp(-0.5 * ((x - study.truth[k]) / error) ** 2) / (np.sqrt(2 * np.pi) * error)
        ax.plot(x, normal, color=DATA, linewidth=LINE, label="normal, reported error")
    ax.axvline(study.truth[k], color=FIT, linestyle="--", linewidth=LINE, label="truth")


def _draw_histogram(study: Fits, k: int, centre: float, ax: Axes, *, density: bool = False) -> None:
    """Draw the histogram of the estimates of unknown k: all but the farthest hundredth, with a margin."""
    values = study.theta[study.success, k]
    low, high = np.percentile(values, [0.5, 99.5])
    margin = 0.25 * max(float(high - low), 1e-12 * abs(centre), np.finfo(float).tiny)
    limits, label = (low - margin, high + margin), f"{len(values)} estimates"
    ax.hist(values, bins=40, range=limits, density=density, color=SHADE, alpha=0.7, label=label)
    ax.set_xlim(limits)
    ax.set_yticks([])
    ax.set_ylabel("density" if density else "fits")
    _label_axis(study, k, ax)


def _label_axis(fits: Fits, k: int, ax: Axes) -> None:
    """Label the horizontal axis with the name and unit of unknown k, with few ticks, at dates if it is a date."""
    clock = list_dated(fits)[k]
    style.label_unknown_axis(ax, fits.theta_names[k], fits.theta_units[k], clock)
    if clock is None:
        ax.locator_params(axis="x", nbins=4)


@draw_figure.register(Multistart)
def plot_starts(study: Multistart, *, ax: Axes | None = None) -> Axes | Figure:
    """Draw the final cost of each start above the best, ascending; those of one minimum share a colour.

    Parameters
    ----------
    study : Multistart
    ax : matplotlib.axes.Axes, optional
    """
    drawn, ax = style.open_axes(ax, (7.0, 3.6))
    order = np.argsort(np.where(np.isfinite(study.cost), study.cost, np.inf), kind="stable")
    costs, labels, rank = study.cost[order], study.clusters[order], np.arange(1, len(order) + 1)
    floor = max(1e-12 * abs(costs[0]), 1e-300)  # differences below are rounding
    height = np.where(np.isfinite(costs), np.maximum(costs - costs[0], floor), np.nan)
    ax.plot(rank, height, color=OTHERS, linewidth=THIN, zorder=1)
    for k in range(_count_minima(study)):
        here, colour = labels == k, GROUP_COLOURS[min(k, len(GROUP_COLOURS) - 1)]
        label = f"J = {costs[here][0]:.6g}: {format_count(int(here.sum()), 'start')}"
        label = label if k < len(GROUP_COLOURS) - 1 else ""
        ax.scatter(rank[here], height[here], s=22, color=colour, label=label, zorder=2)
    failed = labels < 0
    if failed.any():
        ax.scatter(rank[failed], height[failed], s=24, marker="x", color=DATA, label="not converged")
    ax.set_yscale("log")
    # All in one minimum: a few decades, not one tick.
    ax.set_ylim(floor / 3, max(3 * np.nanmax(height, initial=floor), 1e3 * floor))
    ax.locator_params(axis="x", integer=True)
    ax.set_xlim(0.5, len(order) + 0.5)
    ax.set_xlabel("starts, in the order of the cost at their end")
    ax.set_ylabel("cost above the best")
    ax.legend(frameon=False, fontsize=SMALL, loc="upper left")
    return style.turn_off_formulas(drawn)
