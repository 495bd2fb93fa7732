"""The report of a search for the mode sequence: the best one, and a table by number of switches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.modes.ending_report import CRITERION_TITLES, name_criterion
from switchfit.modes.result import ModeFit, ModeSearch
from switchfit.report import numbers, tables
from switchfit.report import times as times_module
from switchfit.report.tables import Table, format_table, wrap_text
from switchfit.report.times import Timed, format_estimate, format_time, label_time
from switchfit.report.wording import ALLOWED
from switchfit.runtime.presentation import format_count, format_text
from switchfit.uncertainty.corrected_errors import correct_errors

DISCOUNTED = "mBIC discounted"
"""Names of criteria; the last is that of one for residuals that are not noise."""

LISTED = 6
"""Alternatives in a report of a search."""

LONGEST_LINE = 60
"""Characters of a line of a sequence in a table."""


def list_criteria(search: ModeSearch) -> dict[str, str]:
    """Return the criteria of a `ModeFit` that are shown, by the names of its attributes, with their titles.

    Parameters
    ----------
    search : ModeSearch
    """
    likely = ("bic", "mbic", "aicc") if search.sigma_known is not None else ()
    discounted = any(warning.kind == "discounted" for warning in search.warnings)
    own = {"criterion": DISCOUNTED if discounted else name_criterion(search.criterion)}
    return (own if discounted or search.criterion not in likely else {}) | {
        name: CRITERION_TITLES[name] for name in likely
    }


@format_text.register(ModeSearch)
def write_search(search: ModeSearch) -> str:
    """Return the status, the best sequence with its times and parameters, and a table by number of switches.

    Parameters
    ----------
    search : ModeSearch
    """
    fit, head = search.best, wrap_text(search.message)
    if not search.chosen:
        return "\n".join(head)
    head += [line for warning in search.warnings for line in wrap_text(str(warning), "- ", "  ")]
    # Said only where it makes a difference.
    corrected = fit is not None and not np.array_equal(correct_errors(fit), fit.standard_errors, equal_nan=True)
    best = _list_segments(search), _list_parameters(search), [ALLOWED] if corrected else []
    alternatives = _list_alternatives(search) if len(search.chosen) > 1 else []
    effort = f"{format_count(search.fits, 'fit')}, {search.evaluations} evaluations, {search.seconds:.1f} s"
    return tables.join_sections(head, *best, _tabulate_numbers(search), alternatives, [effort])


def tabulate_segments(
    modes: Sequence[str], times: FloatArray, errors: FloatArray, ends: Sequence[str], run: Timed
) -> Table:
    """Return a row for each segment: mode, from, the standard error of that, and to."""
    known = [format_estimate(time, error, run) for time, error in zip(times.tolist(), errors.tolist(), strict=True)]
    shown = [ends[0], *(time for time, _ in known), ends[1]]
    spread_unit = "" if run.origin is None else f" {run.time_unit}"
    spreads = ["", *(spread and f"{spread}{spread_unit}" for _, spread in known)]
    titles = ["mode", label_time(run, "from"), "", label_time(run, "to")]
    return Table(list(zip(modes, shown[:-1], spreads, shown[1:], strict=True)), "<>>>", titles)


def _list_segments(search: ModeSearch) -> list[str]:
    """Return a line for each segment of the best: mode, from, to, and the standard error of where it begins."""
    best, fit, lines = search.chosen[0], search.best, []
    # An index of -1, of a time that was not estimated, finds the NaN behind the last.
    errors = np.append([] if fit is None else correct_errors(fit), np.nan)  # the last: not estimated
    for e, (sequence, times) in enumerate(zip(best.sequences, search.transition_times, strict=True)):
        places = np.full(len(times), -1) if fit is None else fit.transition_places[e][: len(times)]
        # A search without a fit, as one that was interrupted, has no trajectory to take the dates from.
        run = times_module.Clock(None if fit is None else fit.trajectories[e].origin, search.time_units[e])
        ends = [format_time(time, run, 0.0) for time in (search.starts[e], search.ends[e])]
        lines += [f"{search.run_names[e]}:"] if len(best.sequences) > 1 else []
        lines += format_table(*tabulate_segments(sequence, times, errors[places], ends, run))
    return lines


def _list_parameters(search: ModeSearch) -> list[str]:
    """Return a line for each estimated parameter and initial state of the best."""
    best, fit, rows = search.chosen[0], search.best, []
    for name, value, acts in zip(search.parameter_names, best.parameters, best.acting, strict=True):
        if not acts:
            rows.append([name, f"{value:.6g}", "a guess: acts in none of the modes"])
        elif fit is not None and name in fit.theta_names:
            k = fit.theta_names.index(name)
            number, error, relative = numbers.format_rounded(fit.theta[k], correct_errors(fit)[k])
            rows.append([name, number, f"{error} {relative}".strip()])
    return format_table(rows, "<><")


def _tabulate_numbers(search: ModeSearch) -> list[str]:
    """Return a row for each number of switches: J, the criteria, and the best sequence."""
    criteria, rows = list_criteria(search), []
    for fit in search.fitted:
        cells = ["*" if fit.sequences == search.chosen[0].sequences else "", f"{fit.switches}", f"{fit.cost:.8g}"]
        for name, title in criteria.items():
            # A criterion of the user's own may have any size; those of likelihoods are compared to a tenth.
            digits = ".8g" if name == "criterion" and title != DISCOUNTED else ".1f"
            cells.append(f"{getattr(fit, name):{digits}}".replace("nan", ""))
        rows.append((fit, cells))
    titles = ["", "switches", "J", *criteria.values()]
    return _format_sequences(search, rows, "<" + ">" * (len(titles) - 1), titles, "sequence")


def _list_alternatives(search: ModeSearch) -> list[str]:
    """Return a line for each alternative: its weight, its criterion less the lowest, and its sequence."""
    criteria = list_criteria(search)
    # The criterion by which the alternatives were weighed: weights are exp(-difference / 2).
    name = "criterion" if "criterion" in criteria else "aicc" if search.criterion == "aicc" else "mbic"
    lowest = getattr(search.chosen[0], name)
    chosen = search.chosen[:LISTED]
    rows = [(fit, [f"{fit.weight:.3f}", f"{getattr(fit, name) - lowest:.2f}"]) for fit in chosen]
    more = [f"  and {len(search.chosen) - LISTED} more in .chosen"] if len(search.chosen) > LISTED else []
    titles = ["weight", f"{criteria[name]} above the best"]
    return [*_format_sequences(search, rows, ">>", titles, "alternatives"), *more]


def _format_sequences(
    search: ModeSearch, fits: Sequence[tuple[ModeFit, list[str]]], alignment: str, titles: list[str], what: str
) -> list[str]:
    """Return the table of fits with their cells, and their sequences in the last column, in several lines if long.

    Of several runs, those are listed whose sequence differs from the best's.
    """
    single, rows = len(search.run_names) == 1, []
    for fit, cells in fits:
        lines: list[str] = []
        for name, modes, known in zip(search.run_names, fit.sequences, search.chosen[0].sequences, strict=True):
            if single or modes != known:
                text = " -> ".join(modes) if single else f"{name}: {' -> '.join(modes)}"
                lines += wrap_text(text, width=LONGEST_LINE)
        rows += [[*(c if k == 0 else "" for c in cells), line] for k, line in enumerate(lines or ["the same"])]
    return format_table(rows, f"{alignment}<", [*titles, what if single else f"{what}, where not as above"])
