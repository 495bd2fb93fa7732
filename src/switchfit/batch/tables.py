"""The report of many fits as text: how they ended, and the table of the study."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import singledispatch

import numpy as np

from switchfit.batch.bootstrap_study import Bootstrap
from switchfit.batch.fits import Fits
from switchfit.batch.monte_carlo_study import MonteCarlo
from switchfit.batch.starts import Multistart
from switchfit.problem.validation.messages import unit_suffix
from switchfit.report import selection, tables
from switchfit.report.numbers import label_quantity
from switchfit.report.tables import Table, format_table
from switchfit.report.times import Clock, Timed, format_estimate, format_time
from switchfit.runtime.presentation import format_count, format_text

LISTED_COST_MINIMA = 10

LISTED_UNKNOWNS, LISTED_PLACES = 12, 6
"""Largest numbers of unknowns in a table, and in the line of a minimum; transition times are left out first."""

LISTED_FITS, LISTED_WORST = 24, 12
"""Fits up to which all are listed in their order; of more, the worst."""

LISTED_COLUMNS = 4
"""Unknowns in the line of a fit."""

TOO_FEW = "Fewer than two fits converged: no statistics."


def list_dated_unknowns(fits: Fits) -> list[Timed | None]:
    """Return the clock of each unknown that is a time with dates; None for every other unknown."""
    origins = zip(fits.date_origins, fits.theta_units, strict=True)
    return [None if origin is None else Clock(origin, unit) for origin, unit in origins]


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
        *tables.wrap_text(str(fits.verdict)),
        f"{format_count(count, 'fit')} in {fits.seconds:.1f} s {each}, {good} converged",
    ]
    # By how often each status occurs.
    endings = Counter(fits.status.tolist()).most_common()
    lines += format_table([(str(number), name) for name, number in endings], "><", indent="    ")
    if good < count:
        lines.append("not converged (all of them in .failures):")
        lines += [f"  run {run}: {message}" for run, message in fits.failures[:3]]
    if isinstance(fits, Bootstrap):
        what = f"{fits.resample} of {fits.block} samples" if fits.resample == "blocks" else fits.resample
        lines.append(f"resampled: {what}")
    minima = [f"{format_count(count_minima(fits), 'minimum', 'minima')}:"] if isinstance(fits, Multistart) else []
    table, note = tabulate_study(fits)
    return "\n".join([*lines, "", *minima, *format_table(*table, indent=""), *([note] if note else [])])


def count_minima(study: Multistart) -> int:
    """Return the number of different minima that the starts ended at."""
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
    # Few fits are listed as they were given, so that one finds one's own; of many, those that need a look.
    if len(fits) > LISTED_FITS:
        listed = fits.worst_first[:LISTED_WORST].tolist()
        notes.append(f"the worst {LISTED_WORST} of {len(fits)} fits; .to_pandas() has all of them")
    shown, errors, clocks = (
        select_unknowns_of_fits(fits, LISTED_COLUMNS),
        fits.standard_errors,
        list_dated_unknowns(fits),
    )
    titles, rows = ["run", "", "J", *(part for i in shown for part in (_label(fits, i), ""))], []
    for k in listed:
        cells = [part for i in shown for part in format_estimate(fits.theta[k, i], errors[k, i], clocks[i])]
        rows.append([str(fits.runs[k]), str(fits.levels[k]), f"{fits.cost[k]:.6g}", *cells])
    notes += filter(None, [_count_rest(fits, shown)])
    return Table(rows, "><>" + "><" * len(shown), titles), "\n".join(notes)


@tabulate_study.register
def tabulate_minima(study: Multistart) -> tuple[Table, str]:
    """Return a row for each of the ten lowest minima: J, how many starts ended there, and where it is."""
    rows, clocks = [], list_dated_unknowns(study)
    shown = select_unknowns_of_fits(study, LISTED_PLACES)
    for k in range(min(count_minima(study), LISTED_COST_MINIMA)):
        # Clusters are numbered by their cost, the lowest first; its first start stands for where it is.
        here = np.flatnonzero(study.clusters == k)
        places = []
        for i in shown:
            unit = "" if clocks[i] else unit_suffix(study.theta_units[i])
            places.append(f"{study.theta_names[i]} = {format_time(study.theta[here[0], i], clocks[i])}{unit}")
        more = len(study.theta_names) - len(shown)
        place = ", ".join(places) + (f" and {more} more" if more else "")
        rows.append((f"J = {study.cost[here].min():.9g}", format_count(len(here), "start"), place))
    return Table(rows, "<><"), ""


def select_unknowns_of_fits(fits: Fits, most: int) -> list[int]:
    """Return the indices of the unknowns that are listed, at most so many."""
    # Names of several runs have the run before the point: `run_2.tau_1`.
    is_time = [name.rsplit(".", 1)[-1].startswith("tau_") for name in fits.theta_names]
    return selection.select_unknowns(is_time, most)


def _count_rest(fits: Fits, shown: Sequence[int]) -> str:
    more = len(fits.theta_names) - len(shown)
    return f"and {format_count(more, 'more unknown')}" if more else ""


@tabulate_study.register
def tabulate_monte_carlo(study: MonteCarlo) -> tuple[Table, str]:
    """Return a row for each unknown: truth, mean error with its own error, spread, standard error, coverage."""
    count = int(study.success.sum())
    if count < 2:
        return Table([], ""), TOO_FEW
    # What an estimator is judged by: its bias against the error of that bias, its spread against the reported error.
    spread, bias, coverage = study.standard_deviation, study.bias, study.coverage()
    # The middle of the standard errors that the fits report, to be compared with the spread of their estimates.
    reported = np.median(study.standard_errors[study.success], axis=0)
    rows, shown, clocks = [], select_unknowns_of_fits(study, LISTED_UNKNOWNS), list_dated_unknowns(study)
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
    rows, shown, clocks = [], select_unknowns_of_fits(study, LISTED_UNKNOWNS), list_dated_unknowns(study)
    bias, error, intervals = study.bias, study.standard_deviation, study.intervals()
    for k in shown:
        ends = ", ".join(format_time(end, clocks[k], error[k]) for end in intervals[k])
        spread = f"{bias[k]:+.2e}", f"{error[k]:.3e}", f"[{ends}]"
        # An unknown of one run alone does not vary if whole runs are drawn: its spread would be 0, which is wrong.
        spread = spread if study.resampled[k] else ("-", "-", "of one run alone")
        rows.append((_label(study, k), format_time(study.estimate[k], clocks[k], error[k]), *spread))
    titles = ("", "estimate", "bias", "standard error", "95 % interval (BCa)")
    return Table(rows, "<" + ">" * 4, titles), _count_rest(study, shown)


def _label(fits: Fits, k: int) -> str:
    """Return name and unit of unknown k."""
    return label_quantity(fits.theta_names[k], fits.theta_units[k])
