"""The data, the course and the quality of a fit, as rows of its report: a label at the left, a text beside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.fit.comparison import Comparison
from switchfit.fit.result import Fit
from switchfit.fit.search_record import Step
from switchfit.report import times
from switchfit.report.numbers import get_unit
from switchfit.report.shares import format_share
from switchfit.report.tables import Table, wrap_text
from switchfit.report.templates import write_agreement
from switchfit.runtime.presentation import format_count
from switchfit.uncertainty.explained_variance import explain_channel
from switchfit.uncertainty.residuals import list_channels

LABEL = 18
"""Columns of the labels at the left."""

LabelledRow = tuple[str, str]
"""A label at the left, empty where it is that of the row before, and a text."""

_ENDED = {
    "settled": "; no further minimum is likely",
    "most": "; there may be further minima",
    "good": "; the lowest leaves nothing but noise",
    "time": "; ended by the limit of time",
    "interrupted": "; interrupted",
}
"""Why the many starts ended."""


# --- sections ---------------------------------------------------------------------------------------------------------


def list_experiments(fit: Fit, most: int) -> list[LabelledRow]:
    """Return each experiment's modes, its horizon, its data, and what its times are counted from.

    Parameters
    ----------
    fit : Fit
    most : int
        Number of experiments that are listed; the others are counted.
    """
    rows: list[LabelledRow] = []
    names = ["experiment"] if len(fit.trajectories) == 1 else fit.run_names
    origins = list(map(times.describe_origin, fit.trajectories))
    for e, (name, trajectory) in enumerate(zip(names[:most], fit.trajectories, strict=False)):
        sequence = " -> ".join(mode for mode, _, _ in trajectory.mode_spans)
        span = times.format_span(trajectory.times[0], trajectory.times[-1], trajectory)
        jumps = times.list_jumps(trajectory.jump_times, trajectory)
        rows.append((name, ", ".join(filter(None, (sequence, span, jumps)))))
        data = [_format_data(comparison) for comparison in fit.comparisons[e]]
        rows += [("", text) for text in data or ["no data: a cost of the trajectory"]]
        # Said once for runs that follow one another with the same origin. For the first one the slice is empty.
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


def list_course(fit: Fit) -> list[LabelledRow]:
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


def _format_step(step: Step) -> str:
    """Return a strategy and the lowest J after it: "failed" if the model could not be integrated, or constraints are
    not met; and what ended it before its end: an error, or the limit of time.
    """
    cost = f"J = {step.cost:.6g}" if np.isfinite(step.cost) else "failed"
    ended = "" if step.ended in _ENDED else step.ended
    if step.ended == "time":
        ended = "ended by the limit of time: with more seconds as time_budget it goes on"
    return f"{step.strategy}: {cost} ({step.seconds:.2g} s{', ' * bool(ended)}{ended})"


def list_quality(fit: Fit) -> list[LabelledRow]:
    """Return the cost, the optimality, the residual variance and the integration error.

    Parameters
    ----------
    fit : Fit
    """
    first = fit.initial_cost
    # A fit without strategies has its first guess in the history.
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
        # 2 J / (N - d) is sigma squared where sigma was not given, else chi-square by its degrees of freedom.
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
    # NaN, of a channel that does not vary, is sorted to the end; equal ones keep their order.
    return Table([rows[k] for k in np.argsort(shares, kind="stable")], "<>><>>", titles)


# --- layout -----------------------------------------------------------------------------------------------------------


def format_rows(rows: Sequence[LabelledRow]) -> list[str]:
    """Return labels at the left and texts, wrapped, beside them."""
    lines, indent = [], " " * (LABEL + 4)
    for label, text in rows:
        lines += [f"  {label}"] if len(label) > LABEL else []
        lines += wrap_text(text, indent if len(label) > LABEL else f"  {label:<{LABEL}}  ", indent)
    return lines
