"""Tables and figures of many fits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from switchfit.batch.fits import Fits
from switchfit.batch.resampling import Bootstrap
from switchfit.batch.simulated import MonteCarlo
from switchfit.batch.starts import Multistart
from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import unit_suffix
from switchfit.report.numbers import format_count, format_rounded
from switchfit.report.tables import format_table, wrap_text
from switchfit.runtime.presentation import draw_figure, format_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ESTIMATE, TRUTH, NORMAL = "#4a7fb5", "#b2182b", "#222222"
CLUSTER_COLOURS = ("#b2182b", "#4a7fb5", "#e0a030", "#5c9e5c", "#8a5fa3", "#777777")
LEVEL_COLOURS = {"good": "#1a7f4b", "doubtful": "#c07800", "bad": "#bb2a20"}
COLUMNS = 3
LISTED_MINIMA = 10
LISTED_UNKNOWNS, LISTED_PLACES = 12, 6
"""Largest numbers of unknowns in a table, and in the line of a minimum; transition times are left out first."""
LISTED_FITS, LISTED_WORST = 24, 12
"""Fits up to which all are listed in their order; of more, the worst."""
LISTED_COLUMNS = 4
"""Unknowns in the line of a fit."""
DRAWN_FITS, DRAWN_UNKNOWNS = 40, 6
"""Fits and unknowns in a figure: the worst fits, and of more unknowns first those that are no transition times."""
TOO_FEW = "Fewer than two fits converged: no statistics."
BOOTSTRAP_TITLES = {
    "residuals": "Bootstrap of residuals",
    "wild": "Bootstrap of residuals with random signs",
    "blocks": "Bootstrap of blocks of residuals",
    "runs": "Bootstrap of runs",
}


def summarise(fits: Fits) -> list[str]:
    """Return the verdict, how many fits were done, how they ended, and the first that did not converge.

    Parameters
    ----------
    fits : Fits
    """
    count, good = len(fits), int(fits.success.sum())
    each = 1e3 * fits.seconds / max(count, 1)
    lines = wrap_text(str(fits.verdict))
    lines.append(f"{format_count(count, 'fit')} in {fits.seconds:.1f} s ({each:.2f} ms each), {good} converged")
    if count < fits.requested:
        lines.append(f"STOPPED: {fits.requested - count} of {fits.requested} fits were not done")
    endings = Counter(fits.status.tolist()).most_common()
    lines += format_table([(str(number), name) for name, number in endings], "><", indent="    ")
    if good:
        spent = fits.iterations[fits.success]
        lines.append(f"iterations: median {np.median(spent):.0f}, most {spent.max()}")
    if good < count:
        lines.append("not converged (all of them in .failures):")
        lines += [f"  run {run}: {message}" for run, message in fits.failures[:3]]
    return lines


@format_text.register(Fits)
def write_fits(fits: Fits) -> str:
    """Return the verdict, how the fits ended, and a line for each of them; of many, for the worst.

    Parameters
    ----------
    fits : Fits
    """
    return "\n".join([*summarise(fits), "", *tabulate_fits(fits)])


def tabulate_fits(fits: Fits) -> list[str]:
    """Return a line for each fit: level, cost, and the unknowns with their standard errors; of many, the worst first.

    Parameters
    ----------
    fits : Fits
    """
    most = len(fits) if len(fits) <= LISTED_FITS else LISTED_WORST
    listed = range(most) if most == len(fits) else fits.worst_first[:most].tolist()
    shown = _select_unknowns(fits, LISTED_COLUMNS)
    header = ["run", "", "J", *(part for i in shown for part in (_label(fits, i), ""))]
    errors = fits.standard_errors
    rows = [header]
    for k in listed:
        cells = [part for i in shown for part in format_rounded(fits.theta[k, i], errors[k, i])[:2]]
        rows.append([str(fits.runs[k]), str(fits.levels[k]), f"{fits.cost[k]:.6g}", *cells])
    lines = format_table(rows, ">" + "<>" + "><" * len(shown), indent="")
    if most < len(fits):
        lines.append(f"the worst {most} of {len(fits)} fits; .to_pandas() has all of them")
    return lines + _count_rest(fits, shown)


@format_text.register(MonteCarlo)
def write_monte_carlo(study: MonteCarlo) -> str:
    """Return the verdict, how the fits ended, and a line for each unknown.

    Parameters
    ----------
    study : MonteCarlo
    """
    return "\n".join([*summarise(study), "", *tabulate_monte_carlo(study)])


@format_text.register(Bootstrap)
def write_bootstrap(study: Bootstrap) -> str:
    """Return the verdict, how the fits ended, what was resampled, and a line for each unknown.

    Parameters
    ----------
    study : Bootstrap
    """
    what = f"{study.resample} of {study.block} samples" if study.resample == "blocks" else study.resample
    return "\n".join([*summarise(study), f"resampled: {what}", "", *tabulate_bootstrap(study)])


@format_text.register(Multistart)
def write_multistart(study: Multistart) -> str:
    """Return the verdict, how the fits ended, and a line for each of the ten lowest minima.

    Parameters
    ----------
    study : Multistart
    """
    minima = int(study.clusters.max(initial=-1)) + 1
    rows = []
    for k in range(min(minima, LISTED_MINIMA)):
        here = np.flatnonzero(study.clusters == k)
        shown, at = _select_unknowns(study, LISTED_PLACES), study.theta[here[0]]
        named = [f"{study.theta_names[i]} = {at[i]:.6g}{unit_suffix(study.theta_units[i])}" for i in shown]
        more = len(at) - len(shown)
        place = ", ".join(named) + (f" and {more} more" if more else "")
        rows.append((f"J = {study.cost[here].min():.9g}", format_count(len(here), "start"), place))
    return "\n".join(
        [*summarise(study), "", f"{format_count(minima, 'minimum', 'minima')}:", *format_table(rows, "<><")]
    )


def _select_unknowns(fits: Fits, most: int) -> list[int]:
    """Return the indices of the unknowns that are listed; of more than `most`, transition times are left out first."""
    names = fits.theta_names
    if len(names) <= most:
        return list(range(len(names)))
    is_time = [name.rsplit(".", 1)[-1].startswith("tau_") for name in names]
    return sorted(sorted(range(len(names)), key=lambda i: is_time[i])[: most - 1])


def _count_rest(fits: Fits, shown: Sequence[int]) -> list[str]:
    more = len(fits.theta_names) - len(shown)
    return [f"and {format_count(more, 'more unknown')}"] if more else []


def tabulate_monte_carlo(study: MonteCarlo) -> list[str]:
    """Return a line for each unknown: truth, mean error with its own error, spread, standard error, coverage."""
    count = int(study.success.sum())
    if count < 2:
        return [TOO_FEW]
    spread, bias, coverage = study.standard_deviation, study.bias, study.coverage()
    with np.errstate(invalid="ignore"):
        reported = np.median(study.standard_errors[study.success], axis=0)
    header = ("", "truth", "bias", "+-", "spread", "standard error", "in 95 % interval")
    shown = _select_unknowns(study, LISTED_UNKNOWNS)
    rows: list[Sequence[str]] = [
        (
            _label(study, i),
            f"{study.truth[i]:.6g}",
            f"{bias[i]:+.2e}",
            f"{spread[i] / np.sqrt(count):.1e}",
            f"{spread[i]:.3e}",
            "-" if np.isnan(reported[i]) else f"{reported[i]:.3e}",
            "-" if np.isnan(coverage[i]) else f"{100 * coverage[i]:.1f} %",
        )
        for i in shown
    ]
    return format_table([header, *rows], "<" + ">" * 6, indent="") + _count_rest(study, shown)


def tabulate_bootstrap(study: Bootstrap) -> list[str]:
    """Return a line for each unknown: estimate, bias, bootstrap standard error, 95 % interval (BCa)."""
    if int(study.success.sum()) < 2:
        return [TOO_FEW]
    rows: list[Sequence[str]] = [("", "estimate", "bias", "standard error", "95 % interval (BCa)")]
    shown = _select_unknowns(study, LISTED_UNKNOWNS)
    bias, error, intervals = study.bias, study.standard_deviation, study.intervals()
    for k in shown:
        label, value = _label(study, k), f"{study.estimate[k]:.6g}"
        if not study.resampled[k]:
            rows.append((label, value, "-", "-", "of one run alone"))
            continue
        low, high = intervals[k]
        rows.append((label, value, f"{bias[k]:+.2e}", f"{error[k]:.3e}", f"[{low:.6g}, {high:.6g}]"))
    return format_table(rows, "<" + ">" * 4, indent="") + _count_rest(study, shown)


def _label(fits: Fits, k: int) -> str:
    """Return name and unit of unknown k."""
    unit = fits.theta_units[k]
    return fits.theta_names[k] + (f" ({unit})" if unit and unit != "1" else "")


@draw_figure.register(Fits)
def plot_fits(fits: Fits) -> Figure:
    """Draw unknowns with their 95 % intervals, a row for each fit, the worst on top.

    Parameters
    ----------
    fits : Fits
    """
    from matplotlib.figure import Figure

    shown, order = _select_unknowns(fits, DRAWN_UNKNOWNS), fits.worst_first[:DRAWN_FITS]
    count, columns = len(order), max(len(shown), 1)
    size = (1.2 + 2.6 * columns, 1.4 + 0.2 * max(count, 5))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, columns, sharey=True, squeeze=False)[0]
    places, intervals, levels = np.arange(count), fits.confidence_intervals(), fits.levels[order]
    for ax, i in zip(axes, shown, strict=False):
        for level, colour in LEVEL_COLOURS.items():
            here = levels == level
            if not here.any():
                continue
            value, (low, high) = fits.theta[order[here], i], intervals[order[here], i].T
            ax.hlines(places[here], low, high, color=colour, linewidth=1.6, alpha=0.6)
            ax.scatter(value, places[here], s=18, color=colour, label=level, zorder=2)
        ax.set_xlabel(_label(fits, i))
        ax.ticklabel_format(axis="x", useOffset=False)
        ax.locator_params(axis="x", nbins=4)
        ax.grid(axis="x", linewidth=0.4, alpha=0.6)
    axes[0].set_yticks(places, [str(run) for run in fits.runs[order]])
    axes[0].set_ylabel("run")
    axes[0].set_ylim(max(count, 1) - 0.5, -0.5)
    handles, labels = axes[0].get_legend_handles_labels()
    if handles:
        title = None if count == len(fits) else f"the worst {count} of {len(fits)} fits"
        figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False, title=title)
    return figure


@draw_figure.register(Bootstrap)
def plot_bootstrap(study: Bootstrap) -> Figure:
    """Draw a histogram for each unknown: estimates of the resampled data, the estimate, its 95 % interval."""
    from matplotlib.figure import Figure

    if int(study.success.sum()) < 2:
        return _draw_nothing()
    shown = np.flatnonzero(study.resampled)
    columns = max(min(len(shown), COLUMNS), 1)
    rows = max(-(-len(shown) // columns), 1)
    figure = Figure(figsize=(3.4 * columns, 2.7 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    theta, intervals = study.theta[study.success], study.intervals()
    for ax, k in zip(axes, shown, strict=False):
        limits = _choose_limits(theta[:, k], study.estimate[k])
        ax.hist(theta[:, k], bins=40, range=limits, color=ESTIMATE, alpha=0.7, label=f"{len(theta)} estimates")
        ax.axvline(study.estimate[k], color=TRUTH, linewidth=1.4, label="estimate")
        for side, edge in enumerate(intervals[k]):
            ax.axvline(edge, color=NORMAL, linestyle=":", linewidth=1.2, label="" if side else "95 % interval (BCa)")
        _draw_histogram_axis(study, int(k), limits, ax)
    for ax in axes[len(shown) :]:
        ax.set_visible(False)
    axes[0].set_ylabel("fits")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=3, frameon=False, title=BOOTSTRAP_TITLES[study.resample]
    )
    return figure


def _draw_nothing() -> Figure:
    """Return a figure that says that too few fits converged."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 1.5), layout="constrained")
    figure.suptitle(TOO_FEW)
    return figure


def _choose_limits(values: FloatArray, centre: float) -> tuple[float, float]:
    """Return the limits of a histogram of estimates: all but the farthest hundredth, with a margin."""
    middle = np.percentile(values, [0.5, 99.5])
    reach = max(float(np.ptp(middle)), 1e-12 * abs(centre), np.finfo(float).tiny)
    return float(middle[0] - 0.25 * reach), float(middle[1] + 0.25 * reach)


def _draw_histogram_axis(study: Fits, k: int, limits: tuple[float, float], ax: Axes) -> None:
    """Label the axis with the name and unit of unknown k, with few ticks."""
    ax.set_xlabel(_label(study, k))
    ax.set_xlim(limits)
    ax.set_yticks([])
    ax.ticklabel_format(axis="x", useOffset=False)
    ax.locator_params(axis="x", nbins=4)


@draw_figure.register(MonteCarlo)
def plot_monte_carlo(study: MonteCarlo) -> Figure:
    """Draw a histogram for each unknown: estimates, truth, the normal density of the reported standard error."""
    from matplotlib.figure import Figure

    if int(study.success.sum()) < 2:
        return _draw_nothing()
    d = len(study.theta_names)
    columns = min(d, COLUMNS)
    rows = -(-d // columns)
    figure = Figure(figsize=(3.4 * columns, 2.7 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    theta = study.theta[study.success]
    with np.errstate(invalid="ignore"):
        errors = np.median(study.standard_errors[study.success], axis=0)
    for k, ax in enumerate(axes):
        if k >= d:
            ax.set_visible(False)
            continue
        values = theta[:, k]
        limits = _choose_limits(values, study.truth[k])
        ax.hist(
            values, bins=40, range=limits, density=True, color=ESTIMATE, alpha=0.7, label=f"{len(values)} estimates"
        )
        if np.isfinite(errors[k]) and errors[k] > 0:
            x = np.linspace(*limits, 300)
            normal = np.exp(-0.5 * ((x - study.truth[k]) / errors[k]) ** 2) / (np.sqrt(2 * np.pi) * errors[k])
            ax.plot(x, normal, color=NORMAL, linewidth=1.2, label="normal, reported error")
        ax.axvline(study.truth[k], color=TRUTH, linestyle="--", linewidth=1.4, label="truth")
        _draw_histogram_axis(study, k, limits, ax)
    axes[0].set_ylabel("density")
    handles, labels = axes[0].get_legend_handles_labels()
    failed = int((~study.success).sum())
    title = f"{failed} runs that did not converge are left out" if failed else None
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False, title=title)
    return figure


@draw_figure.register(Multistart)
def plot_waterfall(study: Multistart) -> Figure:
    """Draw the final cost of every start, ascending, above the best; starts that ended together share a colour."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    ax = figure.subplots()
    order = np.argsort(np.where(np.isfinite(study.cost), study.cost, np.inf), kind="stable")
    best = study.cost[order[0]]
    rank = np.arange(1, len(order) + 1)
    height = study.cost[order] - best
    floor = max(1e-12 * abs(best), 1e-300)  # differences below are rounding
    ax.plot(rank, np.maximum(height, floor), color="#bbbbbb", linewidth=0.8, zorder=1)
    labels = study.clusters[order]
    for k in range(int(labels.max(initial=-1)) + 1):
        here = labels == k
        label = f"J = {study.cost[order][here][0]:.6g}: {here.sum()} starts" if k < len(CLUSTER_COLOURS) - 1 else None
        colour = CLUSTER_COLOURS[min(k, len(CLUSTER_COLOURS) - 1)]
        ax.scatter(rank[here], np.maximum(height[here], floor), s=22, color=colour, label=label, zorder=2)
    failed = labels < 0
    if failed.any():
        ended = np.maximum(height[failed], floor)
        ax.scatter(rank[failed], ended, s=24, marker="x", color="#222222", label="not converged")
    ax.set_yscale("log")
    ax.set_xlabel("starts, in the order of the cost at their end")
    ax.set_ylabel("cost above the best")
    ax.legend(frameon=False, fontsize=8)
    return figure
