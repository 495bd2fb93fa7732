"""Sentences, tables and figures of a search for the mode sequence, of insertion rates, and of an online estimator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from switchfit.modes.rates import Insertion
from switchfit.modes.result import ModeEnding, ModeFit, ModeSearch, ModeStatus, ModeWarning
from switchfit.online.log import OnlineLog
from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.validation import join_names
from switchfit.report import formats, plot, style
from switchfit.report.formats import Table, Timed, format_estimate, format_table, format_time, label_time, wrap_text
from switchfit.report.sentences import ALLOWED, capitalise
from switchfit.report.style import FIT, LINE, LINE_COLOURS, MODE_COLOURS, REFERENCE, SHADE, SMALL, THIN, TRANSITION
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_count, format_text
from switchfit.uncertainty.residuals import correct_errors

CRITERIA = {"bic": "BIC", "mbic": "mBIC", "aicc": "AICc", "cost": "J + cost of switches"}
DISCOUNTED = "mBIC discounted"
"""Names of criteria; the last is that of one for residuals that are not noise."""

LISTED, LISTED_MINIMA = 6, 3
"""Alternatives in a report of a search; minima of each mode in a table of insertion rates, and in its figure."""

LONGEST_LINE = 60
"""Characters of a line of a sequence in a table."""

POINTS = 400
"""Times at which mode probabilities are drawn."""

DRAWN_RUNS = 4
"""Experiments in a figure."""

ROUNDING = 1e-6
"""Difference of a criterion that no data decide: two fits of the same curve differ by it."""

INVISIBLE = 0.02
"""Probability up to which a mode is left out of a figure: a line's width."""

LISTED_LAST = 12
"""Modes and alarms in a report of an online estimator, the last ones; and values of parameters, also in its figure."""

FAR = 10.0
"""Thresholds above which the axis of the statistic is logarithmic, beyond the threshold."""

ROOM = 0.08
"""Inches between axes, and above the legend of the first."""

QUANTILE = 1.96
"""Half the width of a 95 % band, in standard errors."""


def join_sequence(sequences: Sequence[Sequence[str]]) -> str:
    """Return mode sequences in one line.

    Parameters
    ----------
    sequences : sequence of sequences of str, one for each experiment
    """
    return " | ".join(" -> ".join(modes) for modes in sequences)


def name_criterion(name: str) -> str:
    """Return the name of a criterion as it is written."""
    return CRITERIA.get(name, name)


def _is_exchanged(ending: ModeEnding) -> bool:
    """Return whether the other sequence is the best one with its modes renamed, and as good but for rounding."""
    each = list(zip(ending.sequences, ending.other, strict=True))
    pairs = {pair for best, other in each for pair in zip(best, other, strict=False)}
    same_lengths = all(len(best) == len(other) for best, other in each)
    renamed = len({best for best, _ in pairs}) == len({other for _, other in pairs}) == len(pairs)
    return same_lengths and renamed and abs(ending.difference) < ROUNDING


def list_criteria(search: ModeSearch) -> dict[str, str]:
    """Return the criteria of a `ModeFit` that are shown, by the names of its attributes, with their titles.

    Parameters
    ----------
    search : ModeSearch
    """
    likely = ("bic", "mbic", "aicc") if search.sigma_known is not None else ()
    discounted = any(warning.kind == "discounted" for warning in search.warnings)
    own = {"criterion": DISCOUNTED if discounted else name_criterion(search.criterion)}
    return (own if discounted or search.criterion not in likely else {}) | {name: CRITERIA[name] for name in likely}


_ENDINGS = {
    "FOUND": "Found: {best}.",
    "undiscounted": "Ambiguous: {best}; or {other}, which {criterion} prefers if the residuals are taken for noise, "
    "which they are not. Improve the model, or give successions or a min_duration.",
    "other criterion": "Ambiguous: {criterion} prefers {best}, {other_criterion} prefers {other}. Longer data, "
    "successions or a min_duration may decide.",
    "exchanged": "Ambiguous: {best}, and {other}, which is the same with other values of the parameters: the functions "
    "of these modes can take each other's place. Say which is which by first, last or bounds of the parameters.",
    "traceless": "Ambiguous: {best}, or {other}: which of them leaves no trace in what is measured. Measure another "
    "state, or give first, last or successions.",
    "close": "Ambiguous: {best}, and {other}, whose {compared} is only {difference:.2g} higher. Longer data, "
    "successions or a min_duration may decide.",
    "AT_LIMIT": "At the limit: {best} has {most}, as many as were allowed. Raise max_switches, or give successions or "
    "a min_duration.",
    "NOT_EXPLAINED": "Not explained: no sequence explains the data. The best is {best}, but {why}. A mode may be "
    "missing from the library, or an effect from the model; check sigma, or give starts for the parameters.",
    "sigma": "Not explained, unless sigma is {ratio:.2g} times as large as given: the residuals of {best} are white "
    "noise of that size. If sigma is right, a mode may be missing from the library, or an effect from the model.",
    "nothing fitted": "Not converged: no sequence could be fitted. Give better guesses of the parameters, or starts.",
    "NOT_CONVERGED": "Not converged: the fit of {best} ended otherwise. {fit}",
    "UNIDENTIFIED": "Found: {best}. But {parameters} in no mode of the library, and cannot be estimated. Fix it, leave "
    "it out, or add the mode that it belongs to.",
    "INTERRUPTED": "Interrupted: the best so far is {best}. Search on with the same folder, or with better guesses.",
    "NO_SUCCESSION": "No succession: first, last, successions and min_duration admit no sequence with at most {most}. "
    "Raise max_switches, or add successions.",
}
"""By the name of the status, or of a case of it."""
_UNLIKELY = {
    "chi-square": "chi-square would be so large with a probability of {:.1e} if the model were right",
    "correlated residuals": "the residuals are correlated (a probability of {:.1e} if they were white)",
}
"""Why the data are not explained."""


def _name_case(ending: ModeEnding) -> str:
    """Return the key of the sentence."""
    if ending.reason == "sigma":
        return "sigma"
    if ending.status is ModeStatus.NOT_CONVERGED and not ending.sequences:
        return "nothing fitted"
    if ending.status is not ModeStatus.AMBIGUOUS:
        return ending.status.name
    if ending.prefers_other:
        return "undiscounted" if ending.prefers_other == "as it stands" else "other criterion"
    if ending.traceless:
        return "traceless"
    return "exchanged" if _is_exchanged(ending) else "close"


@format_text.register(ModeEnding)
def write_ending(ending: ModeEnding) -> str:
    """Return how a search ended as a sentence, with the remedy.

    Parameters
    ----------
    ending : ModeEnding
    """
    fields = vars(ending) | {
        "best": join_sequence(ending.sequences),
        "other": join_sequence(ending.other),
        "criterion": name_criterion(ending.criterion),
        "other_criterion": name_criterion(ending.prefers_other),
        "compared": name_criterion("mbic" if ending.criterion == "bic" else ending.criterion),
        "most": format_count(ending.limit, "switch", "switches"),
        "why": _UNLIKELY.get(ending.reason, _UNLIKELY["correlated residuals"]).format(ending.probability),
        "parameters": _name_acting(ending.held),
    }
    return _ENDINGS[_name_case(ending)].format(**fields)


def _name_acting(names: Sequence[str]) -> str:
    """Return names and the verb, such as "k acts"."""
    return f"{join_names(names)} {'acts' if len(names) == 1 else 'act'}"


_WARNINGS = {
    "cut off": "{where} is as short as its min_duration allows, and the log may begin or end in the middle of it: give "
    "this mode a smaller min_duration.",
    "short segment": "{where} has {count}: it may make up for an error of the model. Give a min_duration, and see "
    "whether the data need it.",
    "correlated residuals": "the residuals of {names} are correlated: modes may make up for an error of the model, and "
    "standard errors are too small.",
    "discounted": "{number} by the discounted mBIC: the residuals are not noise, and the values count as the {samples} "
    "independent ones that they are worth{larger}.",
    "outliers": "{count} are outliers: they were weighed by a robust loss. Give loss='huber' to the measurements.",
    "no trace": "{where} leaves no trace in what is measured: it may have been so or not.",
    "not estimated": "{acting} in modes that do not occur: {guesses}, without a standard error.",
    "criteria differ": "{preferring} prefers {number}.",
}


@format_text.register(ModeWarning)
def write_warning(warning: ModeWarning) -> str:
    """Return what may be wrong with a sequence as a sentence.

    Parameters
    ----------
    warning : ModeWarning
    """
    run = f" of {warning.run}" if warning.run else ""
    span = f"{warning.begin:.6g} to {warning.end:.6g}{unit_suffix(warning.unit)}"
    sigma = f", and sigma as {np.sqrt(warning.dispersion):.2g} times larger" if warning.dispersion > 1 else ""
    fields = vars(warning) | {
        "where": f"{warning.mode}{run} from {span}",
        "count": format_count(warning.samples, "sample"),
        "names": ", ".join(warning.channels),
        "number": format_count(warning.switches, "switch", "switches"),
        "larger": sigma,
        "acting": _name_acting(warning.parameters),
        "guesses": "it keeps its guess" if len(warning.parameters) == 1 else "they keep their guesses",
        "preferring": name_criterion(warning.criterion),
    }
    return _WARNINGS.get(warning.kind, _WARNINGS["criteria differ"]).format(**fields)


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
    corrected = fit is not None and not np.array_equal(correct_errors(fit), fit.standard_errors, equal_nan=True)
    best = list_segments(search), list_parameters(search), [ALLOWED] if corrected else []
    alternatives = list_alternatives(search) if len(search.chosen) > 1 else []
    effort = f"{format_count(search.fits, 'fit')}, {search.evaluations} evaluations, {search.seconds:.1f} s"
    return formats.join_sections(head, *best, tabulate_numbers(search), alternatives, [effort])


def _tabulate_segments(
    modes: Sequence[str], times: FloatArray, errors: FloatArray, ends: Sequence[str], run: Timed
) -> Table:
    """Return a row for each segment: mode, from, the standard error of that, and to."""
    known = [format_estimate(time, error, run) for time, error in zip(times.tolist(), errors.tolist(), strict=True)]
    shown = [ends[0], *(time for time, _ in known), ends[1]]
    spread_unit = "" if run.origin is None else f" {run.time_unit}"
    spreads = ["", *(spread and f"{spread}{spread_unit}" for _, spread in known)]
    titles = ["mode", label_time(run, "from"), "", label_time(run, "to")]
    return Table(list(zip(modes, shown[:-1], spreads, shown[1:], strict=True)), "<>>>", titles)


def list_segments(search: ModeSearch) -> list[str]:
    """Return a line for each segment of the best: mode, from, to, and the standard error of where it begins."""
    best, fit, lines = search.chosen[0], search.best, []
    errors = np.append([] if fit is None else correct_errors(fit), np.nan)  # the last: not estimated
    for e, (sequence, times) in enumerate(zip(best.sequences, search.transition_times, strict=True)):
        places = np.full(len(times), -1) if fit is None else fit.transition_places[e][: len(times)]
        run = formats.Clock(None if fit is None else fit.trajectories[e].origin, search.time_units[e])
        ends = [format_time(time, run, 0.0) for time in (search.starts[e], search.ends[e])]
        lines += [f"{search.run_names[e]}:"] if len(best.sequences) > 1 else []
        lines += format_table(*_tabulate_segments(sequence, times, errors[places], ends, run))
    return lines


def list_parameters(search: ModeSearch) -> list[str]:
    """Return a line for each estimated parameter and initial state of the best."""
    best, fit, rows = search.chosen[0], search.best, []
    for name, value, acts in zip(search.parameter_names, best.parameters, best.acting, strict=True):
        if not acts:
            rows.append([name, f"{value:.6g}", "a guess: acts in none of the modes"])
        elif fit is not None and name in fit.theta_names:
            k = fit.theta_names.index(name)
            number, error, relative = formats.format_rounded(fit.theta[k], correct_errors(fit)[k])
            rows.append([name, number, f"{error} {relative}".strip()])
    return format_table(rows, "<><")


def tabulate_numbers(search: ModeSearch) -> list[str]:
    """Return a row for each number of switches: J, the criteria, and the best sequence."""
    criteria, rows = list_criteria(search), []
    for fit in search.fitted:
        cells = ["*" if fit.sequences == search.chosen[0].sequences else "", f"{fit.switches}", f"{fit.cost:.8g}"]
        for name, title in criteria.items():
            digits = ".8g" if name == "criterion" and title != DISCOUNTED else ".1f"
            cells.append(f"{getattr(fit, name):{digits}}".replace("nan", ""))
        rows.append((fit, cells))
    titles = ["", "switches", "J", *criteria.values()]
    return _format_sequences(search, rows, "<" + ">" * (len(titles) - 1), titles, "sequence")


def list_alternatives(search: ModeSearch) -> list[str]:
    """Return a line for each alternative: its weight, its criterion less the lowest, and its sequence."""
    criteria = list_criteria(search)
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


@draw_figure.register(ModeSearch)
def plot_search(search: ModeSearch) -> Figure:
    """Draw the criteria by number of switches, the best fit with its modes shaded, and the mode probabilities.

    Parameters
    ----------
    search : ModeSearch
    """
    runs = range(min(len(search.run_names), DRAWN_RUNS) if search.best is not None else 0)
    figure = style.make_figure(8.0, 2.8 + 4.2 * max(len(runs), 1 if search.chosen else 0))
    axes = figure.subplots(1 + 2 * len(runs), 1, squeeze=False, height_ratios=[1.0, *([1.2, 0.6] * len(runs))])[:, 0]
    plot_numbers(search, axes[0])
    colours = style.assign_colours(search.modes, MODE_COLOURS)
    for e, above, below in zip(runs, axes[1::2], axes[2::2], strict=True):
        best: Any = search.best
        plot.plot_comparison(*plot.list_outputs(best, e)[0], above)
        plot.plot_modes(best.trajectories[e], above, colours=colours)
        above.set_title(search.run_names[e] if len(search.run_names) > 1 else "", loc="left", fontsize=SMALL)
        t = np.linspace(search.starts[e], search.ends[e], POINTS)
        stack_probabilities(t, search.modes, search.mode_probability(t, experiment=e), below)
        style.label_axis(below, best.trajectories[e])
    return style.turn_off_formulas(figure)


def plot_numbers(search: ModeSearch, ax: Axes) -> None:
    """Draw the criteria over the number of switches, each less its lowest.

    Parameters
    ----------
    search : ModeSearch
    ax : matplotlib.axes.Axes
    """
    numbers = [fit.switches for fit in search.fitted]
    colours = style.assign_colours([*CRITERIA, "criterion"], LINE_COLOURS)
    for name, label in list_criteria(search).items():
        values = np.array([getattr(fit, name) for fit in search.fitted])
        if np.isfinite(values).any():
            above = values - np.nanmin(np.where(np.isfinite(values), values, np.nan))
            ax.plot(numbers, above, "o-", color=colours[name], linewidth=LINE, markersize=4, label=label)
    if search.chosen:
        ax.axvline(search.chosen[0].switches, color=FIT, linewidth=THIN, zorder=0)
    ax.set_yscale("symlog", linthresh=10.0)
    ax.set_ylim(bottom=-1.0)
    ax.set_xlabel("number of switches")
    ax.set_ylabel("above the lowest")
    ax.locator_params(axis="x", integer=True)
    if ax.lines:
        ax.legend(fontsize=SMALL)


def stack_probabilities(t: FloatArray, modes: Sequence[str], probability: FloatArray, ax: Axes) -> None:
    """Draw probabilities over time, one upon the other, with a legend; modes without any are left out.

    Parameters
    ----------
    t : (K,)
    modes : sequence of str
    probability : (K, modes)
    ax : matplotlib.axes.Axes
    """
    colours = style.assign_colours(modes, LINE_COLOURS)
    drawn = [mode for mode, own in zip(modes, probability.max(axis=0), strict=True) if own > INVISIBLE]
    rows = [probability[:, modes.index(mode)] for mode in drawn]
    ax.stackplot(t, rows, labels=drawn, colors=[colours[mode] for mode in drawn], step="post", linewidth=0)
    ax.set_ylim(0.0, 1.0)
    ax.set_xlim(t[0], t[-1])
    ax.set_ylabel("probability")
    ax.axhline(0.5, color=REFERENCE, linewidth=THIN)
    style.draw_legend_above(ax)


# --- insertion rates --------------------------------------------------------------------------------------------------


@format_text.register(Insertion)
def write_insertion(found: Insertion) -> str:
    """Return which pulse lowers J fastest, and the lowest minima of all modes.

    Parameters
    ----------
    found : Insertion
    """
    run, pulses = found.trajectory, found.minima(LISTED_MINIMA)
    text, rows = "No short pulse of any mode lowers J.", []
    if pulses:
        at = format_time(pulses[0].time, run) + formats.suffix_time(run)
        speed = f"{-pulses[0].rate:.4g} per {run.time_unit} of its length"
        text = f"A short pulse of {pulses[0].mode} at {at} lowers J fastest: by {speed}."
    for pulse in pulses:
        interrupted = found.modes[int(found.active[np.flatnonzero(found.times == pulse.time)[-1]])]
        rows.append((pulse.mode, format_time(pulse.time, run), f"{pulse.rate:.4g}", interrupted))
    table = format_table(rows, "<>><", ["mode", label_time(run, "time"), "dJ / d length", "in"])
    return formats.join_sections(wrap_text(text), table)


@draw_figure.register(Insertion)
def plot_insertion(found: Insertion, *, ax: Axes | None = None) -> Axes | Figure:
    """Draw the rate of each mode over time, its lowest minima as dots, with the active modes shaded.

    Parameters
    ----------
    found : Insertion
    ax : matplotlib.axes.Axes, optional
    """
    (drawn, ax), run = style.open_axes(ax, (7.2, 3.8)), found.trajectory
    order = [*plot.choose_mode_colours([run]), *found.modes]
    colours, shades = (style.assign_colours(order, palette) for palette in (LINE_COLOURS, MODE_COLOURS))  # of one hue
    ax.axhline(0.0, color=REFERENCE, linewidth=THIN, zorder=2)
    for k, mode in enumerate(found.modes):
        rate = np.where(found.active == k, np.nan, found.rate[:, k])  # zero by definition
        if np.isfinite(rate).any():
            ax.plot(found.times, rate, "-", color=colours[mode], linewidth=LINE, label=f"pulse of {mode}", zorder=3)
            minima = [pulse for pulse in found.minima(LISTED_MINIMA) if pulse.mode == mode]
            times, rates = [pulse.time for pulse in minima], [pulse.rate for pulse in minima]
            ax.plot(times, rates, "o", markersize=4.5, color=colours[mode], zorder=4)
    plot.plot_modes(run, ax, colours=shades)
    ax.set_ylabel(formats.label_quantity("dJ / d length of a pulse", f"1/{run.time_unit}"))
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="best", frameon=False, fontsize=SMALL)
    return style.turn_off_formulas(drawn)


# --- what an online estimator said -----------------------------------------------------------------------------------


@format_text.register(OnlineLog)
def write_log(log: OnlineLog) -> str:
    """Return the present mode, the modes with their times, parameters, alarms, and how long updates took.

    Parameters
    ----------
    log : OnlineLog
    """
    unit = formats.suffix_time(log)
    now, end = log.now, format_time(log.now.time, log)
    error = now.time_errors[-1] if len(now.time_errors) else np.nan
    since = format_estimate(now.since, float(error), log)[0]
    changes = format_count(len(now.transition_times), "change")
    first = f"{now.mode} since {since}{unit}, after {changes} of mode up to {end}{unit}."
    head = wrap_text(f"{first} {capitalise(now.status.value)}.")
    counts, took = Counter(status.name for status in log.status), log.latency()
    counted = ", ".join(f"{number} {name}" for name, number in counts.items())
    p50, p90, p99, most = (f"{1e3 * took[name]:.3g}" for name in ("p50", "p90", "p99", "max"))
    effort = wrap_text(f"{format_count(len(log.times), 'update')}: {counted}")
    effort.append(f"an update took {p50} ms (median), {p90} (90 %), {p99} (99 %), {most} (the longest)")
    return formats.join_sections(head, _list_modes(log), _list_parameters(log), _list_alarms(log), effort)


def _list_modes(log: OnlineLog) -> list[str]:
    """Return a line for each of the last modes: from, the standard error of that, and to."""
    now = log.now
    ends = format_time(float(log.since[0]), log), "now"
    table = _tabulate_segments(now.mode_sequence, now.transition_times, now.time_errors, ends, log)
    return format_table(*table._replace(rows=table.rows[-LISTED_LAST:]))


def _list_values(log: OnlineLog) -> list[tuple[str, str, FloatArray, FloatArray]]:
    """Return name, unit, value (K,) and standard error (K,) of each entry of the free parameters."""
    found = []
    for name, errors in log.standard_errors.items():
        unit = log.units[name]
        for k, index in enumerate(np.ndindex(errors.shape[1:])):
            label = f"{name}[{k}]" if errors[0].size > 1 else name
            found.append((label, unit, log.parameters[name][:, *index], errors[:, *index]))
    return found


def _list_parameters(log: OnlineLog) -> list[str]:
    rows = []
    for name, unit, value, error in _list_values(log):
        shown, spread = format_estimate(float(value[-1]), float(error[-1]), None)
        rows.append([name, shown, spread or "not known yet", unit_suffix(unit).strip()])
    return format_table(rows, "<>><", most=LISTED_LAST, where=" in .parameters")


def _list_alarms(log: OnlineLog) -> list[str]:
    """Return a line for each of the last alarms: when it came, what it said then, and whether it was retracted."""
    rows = []
    for alarm in log.alarms[-LISTED_LAST:]:
        began, spread = format_estimate(alarm.transition_time, alarm.standard_error, log)
        began = began if spread else format_time(alarm.transition_time, log)
        refuted = "retracted" if alarm in log.retracted else ""
        rows.append([format_time(alarm.time, log), alarm.mode, began, spread, f"{alarm.statistic:.1f}", refuted])
    titles = [label_time(log, "alarm at"), "mode", label_time(log, "since"), "", "statistic", "and then"]
    more = [f"  {len(log.alarms) - LISTED_LAST} earlier ones in .alarms"] if len(log.alarms) > LISTED_LAST else []
    return [*format_table(rows, "><>>><", titles), *more] or ["  no alarm"]


@draw_figure.register(OnlineLog)
def plot_log(log: OnlineLog) -> Figure:
    """Draw the probability of each mode, the statistic, and the parameters with their 95 % bands over time.

    Parameters
    ----------
    log : OnlineLog
    """
    values = _list_values(log)[:LISTED_LAST]
    figure = style.make_figure(8.0, 4.2 + 1.5 * len(values))
    figure.get_layout_engine().set(h_pad=ROOM)  # type: ignore[union-attr,call-arg]
    axes = figure.subplots(2 + len(values), 1, sharex=True, squeeze=False)[:, 0]
    stack_probabilities(log.times, log.modes, log.probability, axes[0])
    now = log.now
    reach = QUANTILE * now.time_errors
    ends = np.stack([now.transition_times - reach, now.transition_times + reach], axis=1)
    plot.plot_transitions(now.transition_times, ends, axes[0])
    plot_statistic(log, axes[1])
    for ax, (name, unit, value, error) in zip(axes[2:], values, strict=True):
        _plot_value(log.times, value, error, ax)
        ax.set_ylabel(formats.wrap_quantity(name, unit))
    for ax in axes:
        style.label_axis(ax, log)
        ax.label_outer()
    return style.turn_off_formulas(figure)


def plot_statistic(log: OnlineLog, ax: Axes) -> None:
    """Draw the statistic with its threshold, and a dot for each alarm, an empty one if it was retracted.

    Parameters
    ----------
    log : OnlineLog
    ax : matplotlib.axes.Axes
    """
    ax.plot(log.times, np.maximum(log.statistic, 0.0), "-", color=SHADE, linewidth=THIN)
    for alarm in log.alarms:
        face = "none" if alarm in log.retracted else FIT
        ax.plot(alarm.time, alarm.statistic, "o", markersize=4, color=FIT, markerfacecolor=face)
    style.draw_level(ax, "threshold", log.threshold, "left")
    if np.max(log.statistic) > FAR * log.threshold:
        ax.set_yscale("symlog", linthresh=log.threshold, linscale=2.0)
    ax.set_ylim(0.0, max(1.5 * log.threshold, ax.get_ylim()[1]))
    ax.set_ylabel("statistic")


def _plot_value(times: FloatArray, value: FloatArray, error: FloatArray, ax: Axes) -> None:
    """Draw a parameter with its 95 % band, which is cut off where it is much wider than at the end."""
    band = np.stack([value - QUANTILE * error, value + QUANTILE * error], axis=1)
    ax.plot(times, value, "-", color=FIT, linewidth=LINE, zorder=3)
    reach = 3.0 * QUANTILE * np.nan_to_num(error[-1], posinf=0.0)
    ax.set_ylim(*ax.get_ylim() + reach * np.array([-1.0, 1.0]))
    ax.set_autoscaley_on(False)
    plot.plot_band(times, plot.replace_infinities(band), ax, alpha=0.2, label="95 %")
    ax.axhline(value[-1], color=TRANSITION, linestyle=":", linewidth=THIN, zorder=1)
    ax.tick_params(labelsize=SMALL)
