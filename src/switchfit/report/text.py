"""The report of a fit, and what a problem is made of, as plain text at most 100 columns wide where names allow it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Fit, Step
from switchfit.fit.trajectory import Comparison
from switchfit.problem.data import FloatArray, Measurements, ReferenceSignal
from switchfit.problem.experiment import Experiment
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.problem import Problem
from switchfit.report import formats
from switchfit.report.formats import (
    Table,
    Timed,
    format_rounded,
    format_table,
    format_time,
    format_unit,
    get_unit,
    wrap_text,
)
from switchfit.report.frames import list_holds
from switchfit.report.sentences import ALLOWED, format_share, write_agreement
from switchfit.report.uncertainty import write_direction
from switchfit.runtime.presentation import format_count, format_text, join_first
from switchfit.uncertainty.certificate import WEAK
from switchfit.uncertainty.residuals import correct_errors, correct_intervals, explain_channel, list_channels
from switchfit.uncertainty.verdict import find_issues

ONE_SIDED = 1.2
"""Ratio of the two sides of an interval above which the report calls it asymmetric."""
LABEL = 18
"""Columns of the labels at the left."""


Row = tuple[str, str]
"""A label at the left, empty where it is that of the row before, and a text."""


SCREEN = {"experiments": 3, "channels": 6, "unknowns": 10, "fixed": 4, "directions": 1, "others": 3}
"""Largest number of entries of each section, about 40 lines for most fits; the others are counted."""

SMALL_CORRELATION = 0.1
"""Correlations below this in size are not listed."""


@format_text.register(Estimate)
def write_estimate(estimate: Estimate, *, full: bool = False) -> str:
    """Return the report: the verdict, the problem, the course of the fit, its quality, the unknowns, the warnings.

    Parameters
    ----------
    estimate : Estimate
        The failures of its certificate count in the verdict if it is known.
    full : bool
        All experiments, channels, unknowns, correlations, directions and warnings; otherwise as much as fits on one
        screen.

    Returns
    -------
    str
        Several lines without a newline at the end; the verdict first.
    """
    limits = dict.fromkeys(SCREEN, sys.maxsize) if full else SCREEN
    course = [*list_experiments(estimate, limits["experiments"]), *list_course(estimate)]
    channels = format_table(*tabulate_channels(estimate), most=limits["channels"], where=", of which more is explained")
    correlations = format_table(*tabulate_correlations(estimate), most=limits["others"])
    sections = {
        "Fit": _format_rows(course),
        "Quality of the fit": [*_format_rows(list_quality(estimate)), *([""] if channels else []), *channels],
        "Unknowns": _format_unknowns(estimate, limits["unknowns"]),
        "Held fixed": format_table(*tabulate_fixed(estimate), most=limits["fixed"]),
        f"Correlations above {SMALL_CORRELATION:g}": correlations,
        "Determined worst by the data": _describe_weak(estimate, limits["directions"]),
        "Warnings": _list_sentences(list_warnings(estimate), limits["others"], "warning"),
    }
    written = [[title, *lines] for title, lines in sections.items() if lines]
    shown = formats.join_sections(wrap_text(str(estimate.verdict)), *written)
    return shown if full else f"{shown}\n\nMore: estimate.report(full=True), switchfit fit --full."


# --- sections ---------------------------------------------------------------------------------------------------------


def list_experiments(fit: Fit, most: int) -> list[Row]:
    """Return each experiment's modes, its horizon, its data, and what its times are counted from.

    Parameters
    ----------
    fit : Fit
    most : int
        Number of experiments that are listed; the others are counted.
    """
    rows: list[Row] = []
    names = ["experiment"] if len(fit.trajectories) == 1 else fit.run_names
    origins = list(map(formats.describe_origin, fit.trajectories))
    for e, (name, trajectory) in enumerate(zip(names[:most], fit.trajectories, strict=False)):
        sequence = " -> ".join(mode for mode, _, _ in trajectory.mode_spans)
        span = formats.format_span(trajectory.times[0], trajectory.times[-1], trajectory)
        jumps = formats.list_jumps(trajectory.jump_times, trajectory)
        rows.append((name, ", ".join(filter(None, (sequence, span, jumps)))))
        data = [_format_data(comparison) for comparison in fit.comparisons[e]]
        rows += [("", text) for text in data or ["no data: a cost of the trajectory"]]
        if origins[e] and origins[e] not in origins[e - 1 : e]:
            rows.append(("times", origins[e]))
    if len(names) > most:
        rows.append(("", f"and {len(names) - most} more experiments"))
    return rows


def _format_data(comparison: Comparison) -> str:
    """Return the description of one of the data."""
    names = ", ".join(comparison.names)
    if comparison.kind != "measurements":
        return f"{names}: reference signal"
    missing = int(np.isnan(comparison.measured).sum())
    note = f", {missing} of {comparison.measured.size} values missing" if missing else ""
    if comparison.downweighted is not None:
        note += f", {format_count(int(comparison.downweighted.sum()), 'outlier')} weighed down by the loss"
    return f"{names}: {format_count(len(comparison.times), 'sample')}{note}"


def list_course(fit: Fit) -> list[Row]:
    """Return the kind of Hessian, the effort, the engine, the strategies with the lowest J each, and how the fit ended.

    Parameters
    ----------
    fit : Fit
    """
    rows = [("method", f"SQP, hessian = {fit.hessian_kind!r}")]
    iterations, evaluations = format_count(fit.iterations, "iteration"), format_count(fit.evaluations, "evaluation")
    effort = f"{iterations}, {evaluations}, {fit.seconds:.3g} s"
    if fit.steps:  # the iterations of short fits are not counted, and the last fit has few
        effort = f"{evaluations}, {fit.seconds:.3g} s in all, {iterations} in the last fit"
    rows += [("effort", effort), *([("", str(fit.engine))] if fit.engine is not None else [])]
    if fit.steps:
        rows.append(("tried", "; ".join(map(_format_step, fit.steps))))
    if fit.starts is not None and fit.starts[0]:
        ended = next((step.ended for step in reversed(fit.steps) if step.ended), "")
        rows.append(("starts", f"{write_agreement(*fit.starts)}{_ENDED.get(ended, '')}"))
    return [*rows, ("status", fit.message)]


_ENDED = {
    "settled": "; no further minimum is likely",
    "most": "; there may be further minima",
    "good": "; the lowest leaves nothing but noise",
    "time": "; ended by the limit of time",
    "interrupted": "; interrupted",
}
"""Why the many starts ended."""


def _format_step(step: Step) -> str:
    """Return a strategy and the lowest J after it: "failed" if the model could not be integrated, or constraints are
    not met; and what ended it before its end: an error, or the limit of time.
    """
    cost = f"J = {step.cost:.6g}" if np.isfinite(step.cost) else "failed"
    ended = "" if step.ended in _ENDED else step.ended
    if step.ended == "time":
        ended = "ended by the limit of time: with more seconds as time_budget it goes on"
    return f"{step.strategy}: {cost} ({step.seconds:.2g} s{', ' * bool(ended)}{ended})"


def list_quality(fit: Fit) -> list[Row]:
    """Return the cost, the optimality, the residual variance and the integration error.

    Parameters
    ----------
    fit : Fit
    """
    first = fit.initial_cost
    if np.isnan(first) and fit.history and not fit.steps:
        first = fit.history[0].cost
    guess = f"{first:.8g}" if np.isfinite(first) else "not integrable" if fit.steps else ""
    start = f"   (first guess: {guess})" if guess else ""
    rows = [("cost J", f"{fit.cost:.8g}{start}")]
    rows.append(("KKT residual", f"{fit.optimality:.1e}   (tolerance: {fit.tolerance:.1e})"))
    rows += [(name, f"{value:.1e}   (multiplier {multiplier:.6g})") for name, value, multiplier in fit.constraints]
    variance, unknowns = fit.residual_variance, format_count(fit.free_basis.shape[1], "free unknown")
    if np.isfinite(variance):
        priors = f" + {format_count(len(fit.priors), 'prior')}" if fit.priors else ""
        origin = f"2 J / ({fit.samples} values{priors} - {unknowns})"
        name, meaning = "residual variance", f", so sigma is about {np.sqrt(variance):.4g}"
        if fit.sigma_known:
            name, meaning = "reduced chi-square", "; near 1 where sigma is right"
        rows.append((name, f"{variance:.4g}   ({origin}{meaning})"))
    of = fit.integration_error_of
    rows.append(("integration error", f"{fit.integration_error:.1e}   (of {of}, relative, by halving all steps)"))
    return rows


def tabulate_channels(fit: Fit) -> Table:
    """Return the table of the channels, those that are explained worst first; one without variance is last.

    It has the root mean square of the residuals, in units and in sigmas.

    Parameters
    ----------
    fit : Fit
    """
    rows, shares = [], []
    for label, e, comparison, k in list_channels(fit.comparisons, fit.run_names):
        residual, sigma = comparison.residuals[:, k], comparison.sigma
        count = str(np.isfinite(residual).sum()) if comparison.kind == "measurements" else "signal"
        scaled = "" if sigma is None else f"{np.sqrt(np.nanmean((residual / sigma[:, k]) ** 2)):.3g}"
        share = explain_channel(comparison, k)
        explained = "" if np.isnan(share) else format_share(share)
        unit = get_unit(comparison, k, fit.trajectories[e])
        rows.append([label, count, f"{comparison.rmse[k]:.4g}", unit, scaled, explained])
        shares.append(share)
    titles = ["channel", "values", "rmse", "", "rmse/sigma", "explained"]
    return Table([rows[k] for k in np.argsort(shares, kind="stable")], "<>><>>", titles)


def _format_unknowns(fit: Fit, most: int) -> list[str]:
    """Return the table of the unknowns as lines; those that are left out are counted."""
    table, note = tabulate_unknowns(fit, shown := select_unknowns(fit, most))
    more = len(fit.theta) - len(shown)
    lines = format_table(*table) + ([f"  and {more} more unknowns"] if more else [])
    return [*lines, *wrap_text(note, "  ", "  ")] if note else lines


ROBUST = " They take the robust loss as that of the noise"
"""Behind the note on standard errors; how much it matters stands in benchmarks/robust.py."""


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
    kinks, dated, rows = [kink.unknown for kink in fit.kinks], formats.list_dated(fit), []
    for i in shown:
        name, run = fit.theta_names[i], dated[i]
        value, error, relative = format_rounded(fit.theta[i], np.nan if name in fit.idle else errors[i])
        plain = format_rounded(fit.theta[i], np.nan if name in fit.idle else naive[i])[1]
        counted = "" if run is None else f"t = {value}"
        if run is not None:
            value, relative = format_time(fit.theta[i], run, errors[i]), ""
        low, high = (format_end(end, wide[i], run) for end in wide[i])
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
    robust = any(c.downweighted is not None for run in fit.comparisons for c in run)
    has_sandwich = isinstance(fit, Estimate) and fit.has_sandwich
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
    width = ends[1] - ends[0]
    if not (np.isfinite(end) and np.isfinite(width) and width > 0):
        return ""
    if run is not None and run.origin is not None:
        return format_time(end, run, width / 4)
    return format_rounded(end, width / 10)[0]


def select_unknowns(fit: Fit, most: int) -> list[int]:
    """Return the indices of the unknowns that are listed; those at a bound, a kink or of a collapsed mode first.

    Parameters
    ----------
    fit : Fit
    most : int
    """
    marked = [i for i, name in enumerate(fit.theta_names) if _mark_unknown(fit, name)]
    return formats.select_unknowns(fit.is_time.tolist(), most, marked)


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
    above = np.argwhere(np.abs(correlation) > SMALL_CORRELATION)
    above = above[np.argsort(-np.abs(correlation[tuple(above.T)]), kind="stable")]
    names = fit.theta_names
    return Table([(f"{names[j]}, {names[i]}", f"{correlation[i, j]:+.3f}") for i, j in above], "<>")


def _describe_weak(estimate: Estimate, most: int) -> list[str]:
    """Return the combinations of unknowns that the data hardly determine, as lines."""
    found = estimate.identifiability
    weak = [d for d in found.directions if d.eigenvalue < WEAK] if estimate.status.successful else []
    return _list_sentences([write_direction(found, direction) for direction in weak], most, "direction")


def _list_sentences(sentences: Sequence[str], most: int, what: str) -> list[str]:
    """Return the first sentences as lines, and how many more there are of what they are about."""
    lines = [line for sentence in sentences[:most] for line in wrap_text(sentence, "  - ", "    ")]
    more = len(sentences) - len(sentences[:most])
    return lines + ([f"  and {format_count(more, what)} more"] if more else [])


_COVERED = {
    "a mode collapsed": {"idle times", "idle parameters"},
    "idle": {"idle times", "idle parameters"},
    "at bounds": {"lower bound", "upper bound"},
    "not determined": {"no errors: not positive definite"},
    "not converged": {"no errors: not positive definite"},
    "unexplained": {"sigma too small", "correlated residuals"},
    "model suspected": {"sigma too small", "correlated residuals"},
    "outliers suspected": {"sigma too small"},
    "sigma suspected": {"sigma too small"},
    "integration error": {"large integration error"},
}
"""Other kinds of warnings whose content is in a reason of the verdict, by the kind of that reason."""


def list_warnings(estimate: Estimate) -> list[str]:
    """Return the warnings that the verdict does not cover, as sentences.

    Parameters
    ----------
    estimate : Estimate
    """
    reasons = {reason.kind for reason in estimate.verdict.reasons}
    covered = reasons.union(*(_COVERED.get(kind, set()) for kind in reasons))
    return [str(issue) for issue in find_issues(estimate) if issue.kind not in covered]


# --- a problem before its fit -----------------------------------------------------------------------------------------


@format_text.register(Problem)
def write_problem(problem: Problem, *, full: bool = False) -> str:
    """Return experiments, data and unknowns of a problem.

    Parameters
    ----------
    problem : Problem
    full : bool
        All of them, not one screen.
    """
    unknowns, rows = problem.unknowns, []
    numbers = (unknowns.initial, unknowns.lower, unknowns.upper)
    columns = (unknowns.names, unknowns.units, *numbers, unknowns.priors.texts(), unknowns.log)
    dated = formats.list_dated(problem)
    for run, (name, unit, value, lower, upper, prior, log) in zip(dated, zip(*columns, strict=True), strict=True):
        first, least, most = (format_time(number, run) for number in (value, lower, upper))
        bounds = "" if np.isinf(lower) and np.isinf(upper) else f"in [{least}, {most}]"
        known, scale = f"prior: {prior}" if prior else "", "(log scale)" if log else ""
        rows.append((name, f"{first}{'' if run else unit_suffix(unit)}", bounds, known, scale))
    lines = format_table(rows, "<<<<<", most=sys.maxsize if full else SCREEN["unknowns"])
    experiments = write_experiments(problem.experiments, full=full)
    return "\n".join([experiments, "Unknowns, first guess and bounds", *lines])


def write_experiments(experiments: Sequence[Experiment], *, full: bool = False) -> str:
    """Return modes, horizon and data of experiments.

    Parameters
    ----------
    experiments : sequence of Experiment
    full : bool
        All of them, not one screen.
    """
    shown = experiments if full else experiments[: SCREEN["experiments"]]
    lines = []
    for k, experiment in enumerate(shown, start=1):
        lines.append(f"Experiment {k}{f' ({experiment.name})' if experiment.name else ''}")
        lines += [f"  {line}" for line in _describe_experiment(experiment)]
    if left := len(experiments) - len(shown):
        lines.append(f"and {left} more experiments: --full lists them")
    return "\n".join(lines)


def _describe_experiment(experiment: Experiment) -> list[str]:
    unit = formats.suffix_time(experiment)
    ends = experiment.ends_of_modes(experiment.initial_times)
    start, *times, end = (format_time(time, experiment) for time in ends)
    sequence = f"{' -> '.join(experiment.mode_sequence)} on [{start}, {end}]{unit}"
    if experiment.has_free_tf:
        sequence += " (tf is estimated)"
    if experiment.taken_from_data:
        sequence += f" ({' and '.join(experiment.taken_from_data)} from the data)"
    lines = [f"{sequence}, at {', '.join(times)}{unit}" if times else sequence]
    lines.append(formats.list_jumps(experiment.jump_times, experiment))
    lines += [f"times in {text}"] if (text := formats.describe_origin(experiment)) else []
    lines += [_describe_data(item, experiment) for item in experiment.data]
    return [line for line in lines if line]


def _describe_data(item: Any, experiment: Experiment) -> str:
    """Return the channels of data, their span and number, and what is known of the sensor."""
    if isinstance(item, ReferenceSignal):
        knots, names = item.signal.knots, _join_channel_names(item.names, item.units, item.signal.channels)
        span = formats.format_span(knots[0], knots[-1], experiment)
        return f"reference signal of {names}, {span}, {len(knots)} knots"
    if not isinstance(item, Measurements):
        return type(item).__name__
    unit = unit_suffix(experiment.time_unit)
    step = np.median(np.diff(item.times)) if len(item.times) > 1 else np.nan
    named = sorted({name for name in item.sigma_names if name})
    said = [
        f"{len(item.times)} samples of {_join_channel_names(item.names, item.units, item.values.shape[1])}",
        formats.format_span(item.times[0], item.times[-1], experiment),
        f"typically {step:.4g}{unit} apart",
        f"{item.values.size - item.count} values missing",
        f"late by {item.delay}{'' if isinstance(item.delay, str) else unit}" if item.delay else "",
        "noise unknown" if item.sigma is None else "",
        f"sigma: {', '.join(named)}" if named else "",
        f"loss {item.loss} ({item.loss_scale:g} sigma)" if item.loss != "linear" else "",
    ]
    return ", ".join(filter(None, said))


def _join_channel_names(names: Sequence[str] | None, units: Sequence[str] | None, channels: int) -> str:
    """Return names with their units, or the number of channels where they have no names."""
    if names is None:
        return f"{channels} channels"
    return ", ".join(map(formats.label_quantity, names, units or ("",) * channels))


def write_steps(evaluator: Evaluator, *, full: bool = False) -> str:
    """Return which steps the integrator takes in each experiment at the first guess, how many, and why.

    Parameters
    ----------
    evaluator : Evaluator
    full : bool
        For all of them, not one screen.
    """
    rows, names = [], evaluator.problem.run_names
    for name, structure, mesh in zip(names, evaluator.structures, evaluator.meshes, strict=True):
        implicit = " and ".join(map(repr, structure.list_implicit_modes()))
        kind = "implicit steps" if structure.has_one_method else f"steps, implicit ones in {implicit}, else explicit"
        kind = kind if implicit else "explicit steps"
        rows.append(("; ".join([f"{mesh.cells:,} {kind}", *map(str, mesh.stiffness)]), name if len(names) > 1 else ""))
    lines = format_table(rows, "<<", most=sys.maxsize if full else SCREEN["experiments"])
    return "\n".join(["Integration at the first guess", *lines])


# --- layout -----------------------------------------------------------------------------------------------------------


def _format_rows(rows: Sequence[Row]) -> list[str]:
    """Return labels at the left and texts, wrapped, beside them."""
    lines, indent = [], " " * (LABEL + 4)
    for label, text in rows:
        lines += [f"  {label}"] if len(label) > LABEL else []
        lines += wrap_text(text, indent if len(label) > LABEL else f"  {label:<{LABEL}}  ", indent)
    return lines
