"""Tables of what was estimated: unknowns with standard errors, what is held fixed, and correlations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.result import Fit
from switchfit.report import selection, times
from switchfit.report.numbers import format_rounded, format_unit
from switchfit.report.tables import Table, format_table, wrap_text
from switchfit.report.times import Timed, format_time
from switchfit.report.wording import ALLOWED
from switchfit.runtime.presentation import join_first
from switchfit.uncertainty.corrected_errors import correct_errors, correct_intervals
from switchfit.uncertainty.judged_fit import JudgedFit

ONE_SIDED = 1.2
"""Ratio of the two sides of an interval above which the report calls it asymmetric."""

SMALL_CORRELATION = 0.1
"""Correlations below this in size are not listed."""

ROBUST = " They take the robust loss as that of the noise"
"""Behind the note on standard errors; how much it matters stands in benchmarks/robust.py."""


def list_holds(fit: Fit, name: str) -> Iterator[str]:
    """Yield what holds an unknown: a bound, a kink, or that the cost does not depend on it.

    Parameters
    ----------
    fit : Fit
    name : str
    """
    if name in fit.idle:
        yield "idle"
    if name in (*fit.unread, *fit.absent):
        yield "not read"
    yield from (f"at {c.kind}" for c in fit.active if c.unknown == name and c.position is None)
    if name in [kink.unknown for kink in fit.kinks]:
        yield "at a kink"


def format_unknowns(fit: Fit, most: int) -> list[str]:
    """Return the table of the unknowns as lines; those that are left out are counted."""
    table, note = tabulate_unknowns(fit, shown := select_unknowns_of_fit(fit, most))
    more = len(fit.theta) - len(shown)
    lines = format_table(*table) + ([f"  and {more} more unknowns"] if more else [])
    return [*lines, *wrap_text(note, "  ", "  ")] if note else lines


def tabulate_unknowns(fit: Fit, shown: Sequence[int], *, ends: bool = False) -> tuple[Table, str]:
    """Return the table of the unknowns, and a note on the standard errors.

    Standard errors that are corrected for correlated residuals have the naive ones beside them.

    Parameters
    ----------
    fit : Fit
    shown : sequence of int
        Indices in theta of the unknowns in the table.
    ends : bool, optional
        Whether to add the ends of the 95 % intervals, corrected like the standard errors.
    """
    naive, errors, wide = fit.standard_errors, correct_errors(fit), correct_intervals(fit)
    known = bool(np.isfinite(errors).any())
    corrected = known and not np.array_equal(naive, errors, equal_nan=True)
    joins = {t.index: f"{t.before} -> {t.after}" for t in fit.transitions}
    kinks, dated, rows = [kink.unknown for kink in fit.kinks], times.list_dated(fit), []
    for i in shown:
        name, run = fit.theta_names[i], dated[i]
        value, error, relative = format_rounded(fit.theta[i], np.nan if name in fit.idle else errors[i])
        plain = format_rounded(fit.theta[i], np.nan if name in fit.idle else naive[i])[1]
        # The number beside the date: bounds and arguments are given in numbers.
        counted = "" if run is None else f"t = {value}"
        if run is not None:
            value, relative = format_time(fit.theta[i], run, errors[i]), ""
        low, high = (format_end(end, wide[i], run) for end in wide[i])
        # Shorter and longer side of the interval, about the estimate.
        sides = np.sort(np.abs(wide[i] - fit.theta[i]))
        # At a kink a profile may be narrower than the standard error says.
        usual = fit.quantile(0.95) * errors[i] if name in kinks and errors[i] > 0 else sides[0]
        apart = not errors[i] > 0 or max(sides[1], usual) > ONE_SIDED * min(sides[0], usual)
        sided = i in joins and sides[0] > 0 and apart
        within = f"95 % in [{low}, {high}]" if high and (sided or name in fit.log_scaled) and not ends else ""
        prior = f"prior: {fit.priors[name]}" if name in fit.priors else ""
        note = ", ".join(filter(None, (counted, joins.get(i), prior, within, _mark_unknown(fit, name))))
        shown_errors = (error, relative, plain if corrected else "") if known else ("", "", "")
        interval = (low, high) if ends and known else ("", "")
        guess = format_time(fit.initial_theta[i], run)
        rows.append([name, value, *shown_errors, *interval, format_unit(fit.theta_units[i]), guess, note])
    titles = ["", "value", "std. error", "", "naive", "95 % from", "to", "", "first guess", ""]
    table = Table(rows, "<><><>><><", titles)
    if not known or corrected:
        return table, f"{ALLOWED.removesuffix('.')}; naive: as if these were independent." if known else ""
    # A robust loss is not the log-likelihood of any noise that is known: standard errors take it for one.
    robust = any(c.downweighted is not None for run in fit.comparisons for c in run)
    has_sandwich = isinstance(fit, JudgedFit) and fit.has_sandwich
    other = ": covariance_from('sandwich') does not." if has_sandwich else "."
    matrix = "the Gauss-Newton matrix" if fit.hessian_kind == "sharp" else "the exact Hessian"
    return table, f"Standard errors from {matrix}.{ROBUST + other if robust else ''}"


def format_end(end: float, ends: FloatArray, run: Timed | None) -> str:
    """Return an end of an interval to the third digit of its width, as a date if it is one; "" if it is unknown.

    Parameters
    ----------
    end : float
    ends : (2,)
        Both of them.
    run : Timed or None
        What this is a time of; None for what is no time.
    """
    # The digit is chosen by the width, not by the end: both ends of an interval have the same places.
    width = ends[1] - ends[0]
    if not (np.isfinite(end) and np.isfinite(width) and width > 0):
        return ""
    if run is not None and run.origin is not None:
        return format_time(end, run, width / 4)
    return format_rounded(end, width / 10)[0]


def select_unknowns_of_fit(fit: Fit, most: int) -> list[int]:
    """Return the indices of the unknowns that are listed; those at a bound, a kink or of a collapsed mode first.

    Parameters
    ----------
    fit : Fit
    most : int
    """
    # What is held is what a reader has to see, however many unknowns there are.
    marked = [i for i, name in enumerate(fit.theta_names) if _mark_unknown(fit, name)]
    return selection.select_unknowns(fit.is_time.tolist(), most, marked)


def _mark_unknown(fit: Fit, name: str) -> str:
    """Return what holds an unknown, in capitals; "" if nothing does."""
    held = "mode does not occur" if name in fit.absent else next(list_holds(fit, name), "")
    return held.replace("idle", "mode collapsed").upper()


def tabulate_fixed(fit: Fit) -> Table:
    """Return transition times and parameters that were not estimated, without a header.

    Parameters
    ----------
    fit : Fit
    """
    fixed = [t for t in fit.transitions if t.index is None]
    rows = []
    for t in fixed:
        run = fit.trajectories[t.experiment]
        time, unit = format_time(t.time, run, digits=8), format_unit(t.unit) if run.origin is None else ""
        rows.append([t.name, time, unit, f"{t.before} -> {t.after}"])
    for name in fit.fixed:
        numbers = [f"{number:.8g}" for number in np.ravel(fit.parameters[name])]
        text = join_first(numbers) if len(numbers) == 1 else f"[{join_first(numbers)}]"
        rows.append([name, text, format_unit(fit.parameter_units[name]), ""])
    return Table(rows, "<<<<")


def tabulate_correlations(fit: Fit) -> Table:
    """Return the correlations of pairs of unknowns that are above `SMALL_CORRELATION` in size, the largest first.

    Parameters
    ----------
    fit : Fit
    """
    correlation = np.nan_to_num(np.tril(fit.correlation, -1))
    # The lower triangle, each pair once.
    above = np.argwhere(np.abs(correlation) > SMALL_CORRELATION)
    above = above[np.argsort(-np.abs(correlation[tuple(above.T)]), kind="stable")]
    names = fit.theta_names
    return Table([(f"{names[j]}, {names[i]}", f"{correlation[i, j]:+.3f}") for i, j in above], "<>")
