"""The report of a fit as plain text, at most 100 columns wide where names allow it."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special

from switchfit.fit.result import Certificate, Fit, disagreement, free_curvature
from switchfit.fit.trajectory import Comparison, Trajectory
from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import unit_suffix
from switchfit.uncertainty.certificate import LARGE_INTEGRATION_ERROR, certify
from switchfit.uncertainty.identification import WEAK, Identifiability, after
from switchfit.uncertainty.residuals import diagnose

WIDTH = 100
LABEL = 18
"""Columns of the labels at the left."""
LISTED_CORRELATIONS = 10
LISTED_EXPERIMENTS = 10
SMALL_CORRELATION = 0.1
"""Correlations below this in size are not listed."""
BARELY_DETERMINED = 1e-6
"""Smallest eigenvalue of the scaled Hessian below which the report warns; correlations of 0.999999 give it."""
UNSEEN = 100.0
"""The same from which the Gauss-Newton matrix is singular rather than another: as for a transition at which the vector
field does not jump, such as a block that comes to rest."""
UNLIKELY = 1e-3
"""Probability of the residual variance below which the report warns, if it is 10 % off as well."""
DIFFERENT = 1.2
"""Factor between the standard errors of the two Hessians, of any combination of the unknowns, above which the report
warns: a 95 % interval that is too narrow by it covers 90 %, one too wide 98 %."""

METHODS = {
    "exact": "SQP with the exact Hessian",
    "descent-first": "steepest descent until the Hessian is positive definite, then SQP with it",
    "block-diagonal": "SQP with the block-diagonal Hessian",
    "gauss-newton": "SQP with the Gauss-Newton matrix",
    "none": "steepest descent",
}


def report(fit: Fit, certificate: Certificate | None = None, found: Identifiability | None = None) -> str:
    """What was fitted, how it ended, how well it fits, the unknowns with their errors, and what to be wary of.

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
        _failure(fit, certify(fit, None) if certificate is None else certificate),
        _section("Fit", [*_experiments(fit), *_course(fit)]),
        _section("Quality of the fit", [*_quality(fit), *_channels(fit)]),
        _section("Unknowns", _unknowns(fit)),
        _section("Held fixed", _fixed(fit)),
        _section(f"Correlations above {SMALL_CORRELATION:g}", _correlations(fit)),
        _section("Determined worst by the data", _weak(fit, after(fit, None) if found is None else found)),
        _section("Warnings", [line for warning in warnings_of(fit) for line in _wrapped(warning, "  - ", "    ")]),
    ]
    return "\n\n".join("\n".join(section) for section in sections if section)


def warnings_of(fit: Fit) -> list[str]:
    """What a reader should know before believing the numbers, a sentence or two each.

    Parameters
    ----------
    fit : Fit
    """
    sources = (_held, _idle, _at_kinks, _undetermined, _without_errors, _noise, _trends, _covariances, _integration)
    return [warning for source in sources for warning in source(fit)]


# --- transitions ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Transition:
    """One transition of one experiment.

    Attributes
    ----------
    experiment : int, from 0
    run : str
        The experiment's name; empty where there is only one.
    name : str
        As in `Fit.theta_names`.
    time : float
    unit : str
        That of the experiment's times.
    before, after : str
        The modes that it joins.
    index : int or None
        Its place in theta; None where it is fixed.
    """

    experiment: int
    run: str
    name: str
    time: float
    unit: str
    before: str
    after: str
    index: int | None


def transitions_of(fit: Fit) -> list[Transition]:
    """All transitions in order, each with its place in theta.

    Parameters
    ----------
    fit : Fit

    Notes
    -----
    In theta the free ones stand first, in this order, as ``tau_i`` or ``run.tau_i``.
    """
    found: list[Transition] = []
    place = 0
    for e, (trajectory, times) in enumerate(zip(fit.trajectories, fit.transition_times, strict=True)):
        places: list[int | None] = []
        run = "" if len(fit.trajectories) == 1 else f"run{e + 1}"
        for i, time in enumerate(times):
            name = f".{fit.theta_names[place]}" if place < len(fit.theta) else ""
            free = name.endswith(f".tau_{i + 1}") and bool(fit.theta[place] == time)
            if free:
                run = name.rpartition(".tau_")[0][1:]
            places.append(place if free else None)
            place += free
        modes = [mode for mode, _, _ in trajectory.mode_spans]
        prefix = f"{run}." if run else ""
        found += [
            Transition(
                e, run, f"{prefix}tau_{i + 1}", float(times[i]), trajectory.time_unit, modes[i], modes[i + 1], where
            )
            for i, where in enumerate(places)
        ]
    return found


def run_names(fit: Fit) -> list[str]:
    """The name of each experiment: as in the names of its transition times, or run1, run2, ...

    Parameters
    ----------
    fit : Fit
    """
    named = {transition.experiment: transition.run for transition in transitions_of(fit)}
    return [named.get(e) or f"run{e + 1}" for e in range(len(fit.trajectories))]


def unit_of(channel: str, trajectory: Trajectory) -> str:
    """The unit of a channel that is called like a state; "" for any other, and for a pure number."""
    units = dict(zip(trajectory.state_names, trajectory.state_units, strict=True))
    return _shown_unit(units.get(channel, ""))


def time_label(unit: str) -> str:
    """The label of an axis of times in a unit, such as "time (min)"."""
    return f"time ({unit})" if _shown_unit(unit) else "time"


def standard_errors_of(fit: Fit) -> FloatArray:
    """Standard errors (d,); NaN where they cannot be had, 0 for an unknown that is held.

    Parameters
    ----------
    fit : Fit
    """
    return fit.standard_errors if np.isfinite(fit.hessian).all() else np.full(len(fit.theta), np.nan)


# --- sections ---------------------------------------------------------------------------------------------------------


def _failure(fit: Fit, certificate: Certificate) -> list[str]:
    """Lines in capitals, unless a minimum was found, it is the only one nearby, and nothing that was checked failed."""
    if fit.status.successful:
        return _wrapped(f"*** CERTIFICATE FAILED: {'; '.join(certificate.failures)}. ***", "", "    ") * bool(
            certificate.failures
        )
    return [f"*** {_FAILURES.get(fit.status.name, 'NOT CONVERGED: the numbers below are not a minimum')}. ***"]


_FAILURES = {
    "NONFINITE_START": "NOT STARTED: the numbers below are the first guess",
    "INTERRUPTED": "NOT CONVERGED: interrupted; the numbers below are the best so far",
    "SADDLE": "NOT A MINIMUM: the numbers below are a saddle point of the cost",
    "INFEASIBLE": "CONSTRAINTS NOT MET: the numbers below break a guard or a terminal constraint",
    "SINGULAR": "NOT UNIQUE: other numbers than those below fit the data as well",
    "COLLAPSED": "A MODE HAS COLLAPSED: it lasts no time at the solution, and what acts in it alone is not determined",
}


def _experiments(fit: Fit) -> Iterator[str]:
    """For each experiment its modes, its horizon and its data."""
    single = len(fit.trajectories) == 1
    names = ["experiment"] if single else run_names(fit)
    for name, trajectory, run in list(zip(names, fit.trajectories, fit.comparisons, strict=True))[:LISTED_EXPERIMENTS]:
        sequence = " -> ".join(mode for mode, _, _ in trajectory.mode_spans)
        horizon = f"{trajectory.times[0]:.6g} to {trajectory.times[-1]:.6g}{unit_suffix(trajectory.time_unit)}"
        yield from _row(name, f"{sequence}, {horizon}")
        for comparison in run:
            yield from _row("", _data(comparison))
        if not run:
            yield from _row("", "no data: a cost of the trajectory")
    if len(names) > LISTED_EXPERIMENTS:
        yield from _row("", f"and {len(names) - LISTED_EXPERIMENTS} more experiments")


def _data(comparison: Comparison) -> str:
    """One of the data in words."""
    names = ", ".join(comparison.names)
    if comparison.kind != "measurements":
        return f"{names}: reference signal"
    missing = int(np.isnan(comparison.measured).sum())
    note = f", {missing} of {comparison.measured.size} values missing" if missing else ""
    if comparison.downweighted is not None:
        note += f", {_count(int(comparison.downweighted.sum()), 'outlier')} weighed down by the loss"
    return f"{names}: {_count(len(comparison.times), 'sample')}{note}"


def _course(fit: Fit) -> Iterator[str]:
    """Method, effort, and how it ended."""
    yield from _row("method", METHODS.get(fit.hessian_kind, fit.hessian_kind))
    effort = f"{_count(fit.iterations, 'iteration')}, {_count(fit.evaluations, 'evaluation')}, {fit.seconds:.3g} s"
    yield from _row("effort", effort)
    if fit.engine is not None:
        yield from _row("", str(fit.engine))
    yield from _row("status", fit.message)


def _quality(fit: Fit) -> Iterator[str]:
    """Cost, optimality, residual variance, integration error."""
    start = f"   (first guess: {fit.history[0].cost:.8g})" if fit.history else ""
    yield from _row("cost J", f"{fit.cost:.8g}{start}")
    yield from _row("KKT residual", f"{fit.optimality:.1e}   (tolerance: {fit.tolerance:.1e})")
    for name, value, multiplier in fit.constraints:
        yield from _row(name, f"{value:.1e}   (multiplier {multiplier:.6g})")
    variance, unknowns = fit.residual_variance, _count(fit.free_basis.shape[1], "free unknown")
    if np.isfinite(variance):
        priors = f" + {_count(len(fit.priors), 'prior')}" if fit.priors else ""
        origin = f"2 J / ({fit.samples} values{priors} - {unknowns})"
        if fit.sigma_known:
            yield from _row("reduced chi-square", f"{variance:.4g}   ({origin}; near 1 where sigma is right)")
        else:
            noise = f"so sigma is about {np.sqrt(variance):.4g}"
            yield from _row("residual variance", f"{variance:.4g}   ({origin}, {noise})")
    of = fit.integration_error_of
    yield from _row("integration error", f"{fit.integration_error:.1e}   (of {of}, relative, by halving all steps)")


def _channels(fit: Fit) -> list[str]:
    """A table of the channels: root mean square of the residuals, in units and in sigmas."""
    single = len(fit.trajectories) == 1
    rows = []
    for name, trajectory, run in zip(run_names(fit), fit.trajectories, fit.comparisons, strict=True):
        for comparison in run:
            for k, channel in enumerate(comparison.names):
                count, rmse, scaled = _residuals(comparison, k)
                label = channel if single else f"{name} {channel}"
                rows.append([label, count, rmse, unit_of(channel, trajectory), scaled])
    if not rows:
        return []
    most = 4 * LISTED_EXPERIMENTS
    in_sigmas = "rmse/sigma" if any(row[-1] for row in rows) else ""
    table = _table([["channel", "values", "rmse", "", in_sigmas], *rows[:most]], "<>><>")
    return ["", *table] + ([f"  and {len(rows) - most} more channels"] if len(rows) > most else [])


def _residuals(comparison: Comparison, k: int) -> tuple[str, str, str]:
    """Number of values, rmse and rmse / sigma of one channel; blank where there are none."""
    residual = comparison.measured[:, k] - comparison.fitted[:, k]
    there = np.isfinite(residual)
    count = str(there.sum()) if comparison.kind == "measurements" else "signal"
    if not there.any():
        return count, "", ""
    rmse = np.sqrt(np.mean(residual[there] ** 2))
    scaled = "" if comparison.sigma is None else residual[there] / comparison.sigma[there, k]
    return count, f"{rmse:.4g}", "" if isinstance(scaled, str) else f"{np.sqrt(np.mean(scaled**2)):.3g}"


def _unknowns(fit: Fit) -> list[str]:
    """The table of the unknowns."""
    errors = standard_errors_of(fit)
    known = bool(np.isfinite(errors).any())
    joins = {t.index: f"{t.before} -> {t.after}" for t in transitions_of(fit)}
    rows = [["", "value", "std. error", "", "", "first guess", ""]]
    for i, name in enumerate(fit.theta_names):
        value, error, relative = rounded(fit.theta[i], np.nan if name in fit.idle else errors[i])
        prior = f"prior: {fit.priors[name]}" if name in fit.priors else ""
        notes = [joins.get(i, ""), prior, _on_log_scale(fit, i), _mark(fit, i)]
        note = ", ".join(note for note in notes if note)
        rows.append(
            [name, value, error, relative, _shown_unit(fit.theta_units[i]), f"{fit.initial_theta[i]:.6g}", note]
        )
    if not known:
        rows = [row[:2] + row[4:] for row in rows]
        return _table(rows, "<><><")
    return [*_table(rows, "<><><><"), "", f"  Standard errors from the exact Hessian{_beside(fit)}."]


def _beside(fit: Fit) -> str:
    """How the other covariance compares."""
    found = disagreement(fit)
    if found is None:
        return ""
    return f"; Gauss-Newton's are within {100 * (found.factor - 1):.2g} % of them" if found.factor < DIFFERENT else ""


def _on_log_scale(fit: Fit, i: int) -> str:
    """The interval of an unknown on a logarithmic scale, which its standard error does not say."""
    if fit.theta_names[i] not in fit.log_scaled:
        return ""
    low, high = fit.confidence_intervals()[i]
    return f"95 % in [{low:.4g}, {high:.4g}]" if low < high else ""


def _mark(fit: Fit, i: int) -> str:
    """What holds an unknown, in capitals."""
    name = fit.theta_names[i]
    if name in fit.idle:
        return "MODE COLLAPSED"
    if any(text.startswith(f"{name} at its lower bound") for text in fit.active):
        return "AT LOWER BOUND"
    if any(text.startswith(f"{name} at its upper bound") for text in fit.active):
        return "AT UPPER BOUND"
    return "AT A KINK" if name in [kink[0] for kink in fit.kinks] else ""


def rounded(value: float, error: float) -> tuple[str, str, str]:
    """Value, "± error" and "(relative error)" as text, the value to the two significant digits of its error.

    Parameters
    ----------
    value, error : float
        An error that is NaN is left away; one of 0 says that the value is held.
    """
    if not np.isfinite(error) or error <= 0.0 or not np.isfinite(value):
        return f"{value:.8g}", "held" if error == 0.0 else "", ""
    last = 1 - _exponent(error)  # decimal place of the second digit of the error
    if value != 0.0:
        last = max(last, 1 - _exponent(value))
    relative = f"({100 * error / abs(value):.2g} %)" if abs(value) > error / 10 else ""
    if 1e-4 <= max(abs(value), error) < 1e7:
        return f"{value:.{max(last, 0)}f}", f"± {error:.{max(last, 0)}f}", relative
    digits = max(last + _exponent(value), 1) if value != 0.0 else 1
    return f"{value:.{digits}e}", f"± {error:.1e}", relative


def _exponent(number: float) -> int:
    return int(np.floor(np.log10(abs(number))))


def _fixed(fit: Fit) -> list[str]:
    """Transition times and parameters that were not estimated."""
    fixed = [t for t in transitions_of(fit) if t.index is None]
    rows = [[t.name, f"{t.time:.8g}", _shown_unit(t.unit), f"{t.before} -> {t.after}"] for t in fixed]
    free = {name.partition("[")[0] for name in fit.theta_names}
    for name, value in fit.parameters.items():
        if name not in free:
            text = np.array2string(np.asarray(value), precision=8, threshold=6, edgeitems=2, separator=", ")
            rows.append([name, " ".join(text.split()), "", ""])
    return _table(rows, "<<<<")


def _correlations(fit: Fit) -> list[str]:
    """The largest correlations."""
    if not np.isfinite(standard_errors_of(fit)).any():
        return []
    correlation = np.nan_to_num(np.tril(fit.correlation, -1))
    above = np.argwhere(np.abs(correlation) > SMALL_CORRELATION)
    above = above[np.argsort(-np.abs(correlation[tuple(above.T)]), kind="stable")]
    names = fit.theta_names
    rows = [[f"{names[j]}, {names[i]}", f"{correlation[i, j]:+.3f}"] for i, j in above[:LISTED_CORRELATIONS]]
    more = len(above) - len(rows)
    return _table(rows, "<>") + ([f"  and {more} more"] if more > 0 else [])


def _weak(fit: Fit, found: Identifiability) -> list[str]:
    """The combinations of unknowns that the data hardly see, if there are any."""
    weak = [d for d in found.directions if d.eigenvalue < WEAK] if fit.success else []
    return [line for direction in weak for line in _wrapped(direction.sentence, "  - ", "    ")]


# --- warnings ---------------------------------------------------------------------------------------------------------


def _held(fit: Fit) -> Iterator[str]:
    """Constraints that hold with equality."""
    for text in fit.active:
        sentence = text[:1].upper() + text[1:] if text.startswith("mode ") else text
        if "collapsed" in text:
            yield (
                f"{sentence}: the data want no such mode there. Leave it out of mode_sequence, start from another "
                "guess, or give min_duration."
            )
        elif "minimum duration" in text:
            yield f"{sentence}: the data would have it shorter. Lower min_duration, or leave the mode out."
        elif " bound " in text and text.partition(" at its ")[0] not in fit.idle:
            yield (
                f"{sentence.replace(' at its', ' is at its')}: it has no standard error, and those of the others take "
                "it as known. Move the bound if it is not a physical one."
            )
        elif " bound " not in text:
            yield f"Active constraint: {text}."


def _idle(fit: Fit) -> Iterator[str]:
    """Unknowns of which a collapsed mode leaves nothing to know."""
    times = [name for name in fit.idle if name.rpartition(".")[2].startswith("tau_")]
    others = [name for name in fit.idle if name not in times]
    if times:
        yield (
            f"Where the collapsed mode would stand does not matter, since the same mode is active before and after it: "
            f"{', '.join(times)} may lie anywhere in between, and the numbers above say no more than that."
        )
    if others:
        yield (
            f"{', '.join(others)}: acts only in modes that have collapsed. The data say nothing about it, and its "
            "value above is where the fit left it, not an estimate."
        )


def _at_kinks(fit: Fit) -> Iterator[str]:
    """Unknowns at which the derivative jumps through zero."""
    for name, left, right in fit.kinks:
        yield (
            f"{name} is at a kink of the cost, where its derivative jumps from {left:.1e} to {right:.1e}; a transition "
            "time that meets a sample is one. It has no standard error, and those of the others take it as known."
        )


def _undetermined(fit: Fit) -> Iterator[str]:
    """A direction along which the cost hardly changes."""
    curvature = free_curvature(fit)
    if len(curvature.scaled) and abs(smallest := curvature.scaled[0]) < BARELY_DETERMINED:
        *others, last = curvature.weakest
        what = f"{', '.join(others)} and {last} apart from one another" if others else last
        yield (
            f"The data hardly determine {what} (smallest eigenvalue {smallest:.1e} of the Hessian scaled to unit "
            "curvature). Fix one of the unknowns, or add data that tell them apart."
        )


def _without_errors(fit: Fit) -> Iterator[str]:
    """Why there are no standard errors."""
    if np.isfinite(standard_errors_of(fit)).all():
        return
    k = fit.free_basis.shape[1]
    if not np.isfinite(fit.hessian).all():
        reason = "the cost or its derivatives are not finite"
    elif fit.sigma_known is None:
        reason = (
            "the cost has no noise model. They need a cost that is made of Measurements alone, with sigma or without"
        )
    elif fit.sigma_known is False and fit.samples <= k:
        reason = f"sigma is unknown and {fit.samples} values are too few to estimate it beside {k} unknowns"
    else:
        smallest = float(np.min(free_curvature(fit).scaled, initial=np.inf))
        reason = f"the Hessian is not positive definite (smallest eigenvalue {smallest:.1e}, scaled to unit curvature)"
    yield f"No standard errors: {reason}."


def _noise(fit: Fit) -> Iterator[str]:
    """Where sigma is known and the residuals contradict it: 2 J should be chi-square distributed."""
    variance = fit.residual_variance
    if not (fit.success and fit.sigma_known and np.isfinite(variance)):
        return
    freedom = fit.freedom
    below, above = scipy.special.chdtr(freedom, 2 * fit.cost), scipy.special.chdtrc(freedom, 2 * fit.cost)
    if 2 * min(below, above) > UNLIKELY or abs(variance - 1) < 0.1:
        return
    if variance > 1:
        yield (
            f"The reduced chi-square is {variance:.3g} where 1 is expected: sigma is too small, or the model misses "
            f"something (look at the residuals). Standard errors are too small, by a factor of {np.sqrt(variance):.2g} "
            "if it is sigma."
        )
    else:
        yield (
            f"The reduced chi-square is {variance:.3g} where 1 is expected: sigma is too large, or the samples were "
            f"smoothed before. Standard errors are too large, by a factor of {1 / np.sqrt(variance):.2g} if it is "
            "sigma."
        )


def _trends(fit: Fit) -> Iterator[str]:
    """Residuals that are no white, normal noise."""
    if fit.success and fit.sigma_known is not None:
        yield from diagnose(fit, run_names(fit)).sentences()


def _covariances(fit: Fit) -> Iterator[str]:
    """Where the exact Hessian and the Gauss-Newton matrix tell different standard errors."""
    found = disagreement(fit) if fit.success else None
    if found is None or not found.factor > DIFFERENT:
        return
    both = f"{found.exact:.2g} and {found.gauss_newton:.2g}"
    if found.factor > UNSEEN:
        yield (
            f"To first order the fitted values hardly depend on {found.name}: its standard errors from the exact "
            f"Hessian and from the Gauss-Newton matrix are {both}. What is known of it is known to second order: trust "
            "its profile likelihood more than either."
        )
    else:
        yield (
            "Standard errors from the exact Hessian and from the Gauss-Newton matrix differ by up to a factor "
            f"{found.factor:.3g} (of {found.name}: {both}): within its noise the model is not linear in its unknowns. "
            "Trust profile likelihoods more than either."
        )


def _integration(fit: Fit) -> Iterator[str]:
    """A trajectory that is not accurate enough."""
    if not fit.integration_error <= LARGE_INTEGRATION_ERROR:
        yield (
            f"The integration error of {fit.integration_error_of} is {fit.integration_error:.1e}, relative: the "
            "numbers have fewer digits than it seems. Give the Problem a smaller rtol, or solver='stiff' if a mode is "
            "stiff."
        )


# --- layout -----------------------------------------------------------------------------------------------------------


def _section(title: str, lines: Sequence[str]) -> list[str]:
    return [title, *lines] if lines else []


def _row(label: str, text: str) -> list[str]:
    """A label at the left and text, wrapped, beside it."""
    if len(label) > LABEL:
        return [f"  {label}", *_wrapped(text, " " * (LABEL + 4), " " * (LABEL + 4))]
    return _wrapped(text, f"  {label:<{LABEL}}  ", " " * (LABEL + 4))


def _wrapped(text: str, first: str, others: str) -> list[str]:
    return textwrap.wrap(
        text, WIDTH, initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )


def _table(rows: Sequence[Sequence[str]], alignment: str) -> list[str]:
    """Rows with their columns aligned to the left (<) or right (>); columns that are empty throughout are left out."""
    columns = [k for k in range(len(alignment)) if any(row[k] for row in rows)]
    widths = {k: max(len(row[k]) for row in rows) for k in columns}
    return [("  " + "  ".join(f"{row[k]:{alignment[k]}{widths[k]}}" for k in columns)).rstrip() for row in rows]


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _shown_unit(unit: str) -> str:
    return "" if unit == "1" else unit
