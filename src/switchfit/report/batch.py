"""Tables of many fits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import singledispatch
from typing import NamedTuple

import numpy as np

from switchfit.batch.fits import Fits
from switchfit.batch.resampling import Bootstrap
from switchfit.batch.simulated import MonteCarlo
from switchfit.batch.starts import Multistart
from switchfit.problem.dates import Origin
from switchfit.problem.parameter import unit_suffix
from switchfit.report.dates import format_estimate, format_unknown
from switchfit.report.style import label_quantity
from switchfit.report.tables import Table, format_table, wrap_text
from switchfit.runtime.presentation import format_count, format_text

LISTED_MINIMA = 10
LISTED_UNKNOWNS, LISTED_PLACES = 12, 6
"""Largest numbers of unknowns in a table, and in the line of a minimum; transition times are left out first."""
LISTED_FITS, LISTED_WORST = 24, 12
"""Fits up to which all are listed in their order; of more, the worst."""
LISTED_COLUMNS = 4
"""Unknowns in the line of a fit."""
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
    """Return the verdict, how the fits ended, and the table of the study with what it leaves out.

    Parameters
    ----------
    fits : Fits
    """
    lines = summarise(fits)
    if isinstance(fits, Bootstrap):
        what = f"{fits.resample} of {fits.block} samples" if fits.resample == "blocks" else fits.resample
        lines.append(f"resampled: {what}")
    lines.append("")
    if isinstance(fits, Multistart):
        lines.append(f"{format_count(_count_minima(fits), 'minimum', 'minima')}:")
    table, note = tabulate_study(fits)
    lines += format_table(*table, indent="") if table.rows else []
    return "\n".join([*lines, note] if note else lines)


def _count_minima(study: Multistart) -> int:
    return int(study.clusters.max(initial=-1)) + 1


@singledispatch
def tabulate_study(study: Fits) -> tuple[Table, str]:
    """Return the table of many fits, and what it leaves out; the table is empty where too few converged.

    A row for each fit: level, cost, and the unknowns with their standard errors; of many, the worst first. Bootstraps
    and Monte Carlo studies have a row for each unknown, multistarts one for each minimum.

    Parameters
    ----------
    study : Fits
    """
    fits = study
    most = len(fits) if len(fits) <= LISTED_FITS else LISTED_WORST
    listed = range(most) if most == len(fits) else fits.worst_first[:most].tolist()
    shown = select_unknowns(fits, LISTED_COLUMNS)
    header = ["run", "", "J", *(part for i in shown for part in (_label(fits, i), ""))]
    errors = fits.standard_errors
    rows = [header]
    for k in listed:
        cells = [part for i in shown for part in format_estimate(fits.theta[k, i], errors[k, i], find_clock(fits, i))]
        rows.append([str(fits.runs[k]), str(fits.levels[k]), f"{fits.cost[k]:.6g}", *cells])
    notes = [f"the worst {most} of {len(fits)} fits; .to_pandas() has all of them"] if most < len(fits) else []
    notes += [text] if (text := _count_rest(fits, shown)) else []
    return Table(rows, ">" + "<>" + "><" * len(shown)), "\n".join(notes)


@tabulate_study.register
def tabulate_minima(study: Multistart) -> tuple[Table, str]:
    """Return a row for each of the ten lowest minima: J, how many starts ended there, and where it is."""
    rows = []
    shown = select_unknowns(study, LISTED_PLACES)
    for k in range(min(_count_minima(study), LISTED_MINIMA)):
        here = np.flatnonzero(study.clusters == k)
        at = study.theta[here[0]]
        named = [
            f"{study.theta_names[i]} = {format_unknown(at[i], find_clock(study, i))}"
            f"{'' if find_clock(study, i) else unit_suffix(study.theta_units[i])}"
            for i in shown
        ]
        more = len(at) - len(shown)
        place = ", ".join(named) + (f" and {more} more" if more else "")
        rows.append((f"J = {study.cost[here].min():.9g}", format_count(len(here), "start"), place))
    return Table(rows, "<><"), ""


def select_unknowns(fits: Fits, most: int) -> list[int]:
    """Return the indices of the unknowns that are listed; of more than `most`, transition times are left out first."""
    names = fits.theta_names
    if len(names) <= most:
        return list(range(len(names)))
    is_time = [name.rsplit(".", 1)[-1].startswith("tau_") for name in names]
    return sorted(sorted(range(len(names)), key=lambda i: is_time[i])[: most - 1])


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
    with np.errstate(invalid="ignore"):
        reported = np.median(study.standard_errors[study.success], axis=0)
    header = ("", "truth", "bias", "+-", "spread", "standard error", "in 95 % interval")
    shown = select_unknowns(study, LISTED_UNKNOWNS)
    rows: list[Sequence[str]] = [
        (
            _label(study, i),
            format_unknown(study.truth[i], find_clock(study, i), spread[i]),
            f"{bias[i]:+.2e}",
            f"{spread[i] / np.sqrt(count):.1e}",
            f"{spread[i]:.3e}",
            "-" if np.isnan(reported[i]) else f"{reported[i]:.3e}",
            "-" if np.isnan(coverage[i]) else f"{100 * coverage[i]:.1f} %",
        )
        for i in shown
    ]
    return Table([header, *rows], "<" + ">" * 6), _count_rest(study, shown)


@tabulate_study.register
def tabulate_bootstrap(study: Bootstrap) -> tuple[Table, str]:
    """Return a row for each unknown: estimate, bias, bootstrap standard error, 95 % interval (BCa)."""
    if int(study.success.sum()) < 2:
        return Table([], ""), TOO_FEW
    rows: list[Sequence[str]] = [("", "estimate", "bias", "standard error", "95 % interval (BCa)")]
    shown = select_unknowns(study, LISTED_UNKNOWNS)
    bias, error, intervals = study.bias, study.standard_deviation, study.intervals()
    for k in shown:
        clock = find_clock(study, k)
        label, value = _label(study, k), format_unknown(study.estimate[k], clock, error[k])
        if not study.resampled[k]:
            rows.append((label, value, "-", "-", "of one run alone"))
            continue
        low, high = intervals[k]
        ends = [format_unknown(end, clock, error[k]) for end in (low, high)]
        rows.append((label, value, f"{bias[k]:+.2e}", f"{error[k]:.3e}", f"[{ends[0]}, {ends[1]}]"))
    return Table(rows, "<" + ">" * 4), _count_rest(study, shown)


class Clock(NamedTuple):
    """What the numbers of one unknown are as dates, for `switchfit.report.dates`."""

    origin: Origin
    time_unit: str


def find_clock(fits: Fits, k: int) -> Clock | None:
    """Return what the numbers of unknown k are as dates; None if they are no dates."""
    origin = fits.date_origins[k]
    return None if origin is None else Clock(origin, fits.theta_units[k])


def _label(fits: Fits, k: int) -> str:
    """Return name and unit of unknown k."""
    return label_quantity(fits.theta_names[k], fits.theta_units[k])
