"""The report of a fit as plain text, at most 100 columns wide where names allow it."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.fit.result import Fit, disagreement
from switchfit.fit.trajectory import Comparison
from switchfit.optimize import Status
from switchfit.problem.parameter import unit_suffix
from switchfit.report.numbers import format_rounded, format_unit, get_unit
from switchfit.report.tables import format_table
from switchfit.report.uncertainty import write_direction
from switchfit.runtime.presentation import format_text
from switchfit.uncertainty.certificate import Certificate, certify
from switchfit.uncertainty.identification import WEAK, Identifiability, analyse_solution
from switchfit.uncertainty.issues import DIFFERENT, find_issues

WIDTH = 100
LABEL = 18
"""Columns of the labels at the left."""
LISTED_CORRELATIONS = 10
LISTED_EXPERIMENTS = 10
SMALL_CORRELATION = 0.1
"""Correlations below this in size are not listed."""
METHODS = {
    "auto": "SQP with the exact Hessian in a trust region",
    "exact": "SQP with the exact Hessian and a line search",
    "descent-first": "steepest descent until the Hessian is positive definite, then SQP with it",
    "block-diagonal": "SQP with the block-diagonal Hessian",
    "gauss-newton": "SQP with the Gauss-Newton matrix",
    "none": "steepest descent",
}


def report(fit: Fit, certificate: Certificate | None = None, found: Identifiability | None = None) -> str:
    """Return what was fitted, how it ended, how well it fits, the unknowns with their errors, and what to be wary of.

    Parameters
    ----------
    fit : Fit
    certificate : Certificate, optional
        Left out, what can be checked without the model is checked.
    found : Identifiability, optional
        Left out, what the Hessian alone tells.

    Returns
    -------
    str
        Several lines without a newline at the end.
    """
    sections = [
        _format_failure(fit, certify(fit, None) if certificate is None else certificate),
        _format_section("Fit", [*_format_experiments(fit), *_format_course(fit)]),
        _format_section("Quality of the fit", [*_format_quality(fit), *_format_channels(fit)]),
        _format_section("Unknowns", _format_unknowns(fit)),
        _format_section("Held fixed", _format_fixed(fit)),
        _format_section(f"Correlations above {SMALL_CORRELATION:g}", _format_correlations(fit)),
        _format_section(
            "Determined worst by the data", _describe_weak(fit, analyse_solution(fit, None) if found is None else found)
        ),
        _format_section("Warnings", [line for issue in find_issues(fit) for line in _wrap(str(issue), "  - ", "    ")]),
    ]
    return "\n\n".join("\n".join(section) for section in sections if section)


@format_text.register(Fit)
def write_fit(fit: Fit) -> str:
    """Return the report of a fit, with what can be checked without its model."""
    return report(fit)


@format_text.register(Estimate)
def write_estimate(estimate: Estimate) -> str:
    """Return the report of an estimate, with its certificate if that is known already, and J evaluated where it is
    weak.
    """
    return report(estimate, estimate.known_certificate, estimate.identifiability)


# --- sections ---------------------------------------------------------------------------------------------------------


def _format_failure(fit: Fit, certificate: Certificate) -> list[str]:
    """Return lines in capitals, unless a minimum was found, it is the only one nearby, and nothing that was checked
    failed.
    """
    if not fit.status.is_strict_minimum:
        return [f"*** {_FAILURES.get(fit.status, 'NOT CONVERGED: the numbers below are not a minimum')}. ***"]
    if certificate.passed:
        return []
    return _wrap(f"*** CERTIFICATE FAILED: {'; '.join(map(str, certificate.failures))}. ***", "", "    ")


_FAILURES = {
    Status.NONFINITE_START: "NOT STARTED: the numbers below are the first guess",
    Status.INTERRUPTED: "NOT CONVERGED: interrupted; the numbers below are the best so far",
    Status.SADDLE: "NOT A MINIMUM: the numbers below are a saddle point of the cost",
    Status.INFEASIBLE: "CONSTRAINTS NOT MET: the numbers below break a guard or a terminal constraint",
    Status.SINGULAR: "NOT UNIQUE: other numbers than those below fit the data as well",
    Status.COLLAPSED: (
        "A MODE HAS COLLAPSED: it lasts no time at the solution, and what acts in it alone is not determined"
    ),
}


def _format_experiments(fit: Fit) -> Iterator[str]:
    """Return each experiment's modes, its horizon and its data."""
    single = len(fit.trajectories) == 1
    names = ["experiment"] if single else fit.run_names
    for name, trajectory, run in list(zip(names, fit.trajectories, fit.comparisons, strict=True))[:LISTED_EXPERIMENTS]:
        sequence = " -> ".join(mode for mode, _, _ in trajectory.mode_spans)
        horizon = f"{trajectory.times[0]:.6g} to {trajectory.times[-1]:.6g}{unit_suffix(trajectory.time_unit)}"
        yield from _format_row(name, f"{sequence}, {horizon}")
        for comparison in run:
            yield from _format_row("", _format_data(comparison))
        if not run:
            yield from _format_row("", "no data: a cost of the trajectory")
    if len(names) > LISTED_EXPERIMENTS:
        yield from _format_row("", f"and {len(names) - LISTED_EXPERIMENTS} more experiments")


def _format_data(comparison: Comparison) -> str:
    """Return one of the data in words."""
    names = ", ".join(comparison.names)
    if comparison.kind != "measurements":
        return f"{names}: reference signal"
    missing = int(np.isnan(comparison.measured).sum())
    note = f", {missing} of {comparison.measured.size} values missing" if missing else ""
    if comparison.downweighted is not None:
        note += f", {_count(int(comparison.downweighted.sum()), 'outlier')} weighed down by the loss"
    return f"{names}: {_count(len(comparison.times), 'sample')}{note}"


def _format_course(fit: Fit) -> Iterator[str]:
    """Return method, effort, and how it ended."""
    yield from _format_row("method", METHODS.get(fit.hessian_kind, fit.hessian_kind))
    effort = f"{_count(fit.iterations, 'iteration')}, {_count(fit.evaluations, 'evaluation')}, {fit.seconds:.3g} s"
    yield from _format_row("effort", effort)
    if fit.engine is not None:
        yield from _format_row("", str(fit.engine))
    yield from _format_row("status", fit.message)


def _format_quality(fit: Fit) -> Iterator[str]:
    """Return cost, optimality, residual variance, integration error."""
    start = f"   (first guess: {fit.history[0].cost:.8g})" if fit.history else ""
    yield from _format_row("cost J", f"{fit.cost:.8g}{start}")
    yield from _format_row("KKT residual", f"{fit.optimality:.1e}   (tolerance: {fit.tolerance:.1e})")
    for name, value, multiplier in fit.constraints:
        yield from _format_row(name, f"{value:.1e}   (multiplier {multiplier:.6g})")
    variance, unknowns = fit.residual_variance, _count(fit.free_basis.shape[1], "free unknown")
    if np.isfinite(variance):
        priors = f" + {_count(len(fit.priors), 'prior')}" if fit.priors else ""
        origin = f"2 J / ({fit.samples} values{priors} - {unknowns})"
        if fit.sigma_known:
            yield from _format_row("reduced chi-square", f"{variance:.4g}   ({origin}; near 1 where sigma is right)")
        else:
            noise = f"so sigma is about {np.sqrt(variance):.4g}"
            yield from _format_row("residual variance", f"{variance:.4g}   ({origin}, {noise})")
    of = fit.integration_error_of
    yield from _format_row(
        "integration error", f"{fit.integration_error:.1e}   (of {of}, relative, by halving all steps)"
    )


def _format_channels(fit: Fit) -> list[str]:
    """Return a table of the channels: root mean square of the residuals, in units and in sigmas."""
    single = len(fit.trajectories) == 1
    rows = []
    for name, trajectory, run in zip(fit.run_names, fit.trajectories, fit.comparisons, strict=True):
        for comparison in run:
            for k, channel in enumerate(comparison.names):
                count, rmse, scaled = _format_residuals(comparison, k)
                label = channel if single else f"{name} {channel}"
                rows.append([label, count, rmse, get_unit(channel, trajectory), scaled])
    if not rows:
        return []
    most = 4 * LISTED_EXPERIMENTS
    in_sigmas = "rmse/sigma" if any(row[-1] for row in rows) else ""
    table = format_table([["channel", "values", "rmse", "", in_sigmas], *rows[:most]], "<>><>")
    return ["", *table] + ([f"  and {len(rows) - most} more channels"] if len(rows) > most else [])


def _format_residuals(comparison: Comparison, k: int) -> tuple[str, str, str]:
    """Return the number of values, rmse and rmse / sigma of one channel; blank if it has no samples."""
    residual = comparison.measured[:, k] - comparison.fitted[:, k]
    there = np.isfinite(residual)
    count = str(there.sum()) if comparison.kind == "measurements" else "signal"
    if not there.any():
        return count, "", ""
    rmse = np.sqrt(np.mean(residual[there] ** 2))
    scaled = "" if comparison.sigma is None else residual[there] / comparison.sigma[there, k]
    return count, f"{rmse:.4g}", "" if isinstance(scaled, str) else f"{np.sqrt(np.mean(scaled**2)):.3g}"


def _format_unknowns(fit: Fit) -> list[str]:
    """Return the table of the unknowns."""
    errors = fit.standard_errors
    known = bool(np.isfinite(errors).any())
    joins = {t.index: f"{t.before} -> {t.after}" for t in fit.transitions}
    rows = [["", "value", "std. error", "", "", "first guess", ""]]
    for i, name in enumerate(fit.theta_names):
        value, error, relative = format_rounded(fit.theta[i], np.nan if name in fit.idle else errors[i])
        prior = f"prior: {fit.priors[name]}" if name in fit.priors else ""
        notes = [joins.get(i, ""), prior, _format_log_scale(fit, i), _mark_unknown(fit, name)]
        note = ", ".join(note for note in notes if note)
        rows.append(
            [name, value, error, relative, format_unit(fit.theta_units[i]), f"{fit.initial_theta[i]:.6g}", note]
        )
    if not known:
        rows = [row[:2] + row[4:] for row in rows]
        return format_table(rows, "<><><")
    return [*format_table(rows, "<><><><"), "", f"  Standard errors from the exact Hessian{_compare_covariances(fit)}."]


def _compare_covariances(fit: Fit) -> str:
    """Return how the other covariance compares."""
    found = disagreement(fit)
    if found is None:
        return ""
    return f"; Gauss-Newton's are within {100 * (found.factor - 1):.2g} % of them" if found.factor < DIFFERENT else ""


def _format_log_scale(fit: Fit, i: int) -> str:
    """Return the interval of an unknown on a logarithmic scale, which its standard error does not say."""
    if fit.theta_names[i] not in fit.log_scaled:
        return ""
    low, high = fit.confidence_intervals()[i]
    return f"95 % in [{low:.4g}, {high:.4g}]" if low < high else ""


def _mark_unknown(fit: Fit, name: str) -> str:
    """Return what holds an unknown, in capitals."""
    if name in fit.idle:
        return "MODE COLLAPSED"
    bounds = [constraint.kind for constraint in fit.active if constraint.unknown == name]
    if bounds:
        return f"AT {bounds[0].upper()}"
    return "AT A KINK" if name in [kink.unknown for kink in fit.kinks] else ""


def _format_fixed(fit: Fit) -> list[str]:
    """Return transition times and parameters that were not estimated."""
    fixed = [t for t in fit.transitions if t.index is None]
    rows = [[t.name, f"{t.time:.8g}", format_unit(t.unit), f"{t.before} -> {t.after}"] for t in fixed]
    for name in fit.fixed:
        text = np.array2string(fit.parameters[name], precision=8, threshold=6, edgeitems=2, separator=", ")
        rows.append([name, " ".join(text.split()), format_unit(fit.parameter_units[name]), ""])
    return format_table(rows, "<<<<")


def _format_correlations(fit: Fit) -> list[str]:
    """Return the largest correlations."""
    if not np.isfinite(fit.standard_errors).any():
        return []
    correlation = np.nan_to_num(np.tril(fit.correlation, -1))
    above = np.argwhere(np.abs(correlation) > SMALL_CORRELATION)
    above = above[np.argsort(-np.abs(correlation[tuple(above.T)]), kind="stable")]
    names = fit.theta_names
    rows = [[f"{names[j]}, {names[i]}", f"{correlation[i, j]:+.3f}"] for i, j in above[:LISTED_CORRELATIONS]]
    more = len(above) - len(rows)
    return format_table(rows, "<>") + ([f"  and {more} more"] if more > 0 else [])


def _describe_weak(fit: Fit, found: Identifiability) -> list[str]:
    """Return the combinations of unknowns that the data hardly see, if there are any."""
    weak = [d for d in found.directions if d.eigenvalue < WEAK] if fit.status.successful else []
    return [line for direction in weak for line in _wrap(write_direction(found, direction), "  - ", "    ")]


# --- layout -----------------------------------------------------------------------------------------------------------


def _format_section(title: str, lines: Sequence[str]) -> list[str]:
    return [title, *lines] if lines else []


def _format_row(label: str, text: str) -> list[str]:
    """Return a label at the left and text, wrapped, beside it."""
    if len(label) > LABEL:
        return [f"  {label}", *_wrap(text, " " * (LABEL + 4), " " * (LABEL + 4))]
    return _wrap(text, f"  {label:<{LABEL}}  ", " " * (LABEL + 4))


def _wrap(text: str, first: str, others: str) -> list[str]:
    return textwrap.wrap(
        text, WIDTH, initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
