"""Warnings about the numbers of a fit, as data; the report writes the sentences."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from switchfit.fit.result import Fit
from switchfit.fit.scaled_hessian import moves_by_itself
from switchfit.fit.termination import MOST_NAMED_UNKNOWNS
from switchfit.meshes.integration_error import LARGE_INTEGRATION_ERROR
from switchfit.problem.reads import name_whole_parameters
from switchfit.runtime.issue import Issue
from switchfit.uncertainty.chi_square import UNLIKELY_AS_NOISE, compare_with_sigma
from switchfit.uncertainty.covariance_comparison import disagreement
from switchfit.uncertainty.doubts import BARELY_DETERMINED
from switchfit.uncertainty.identification import analyse_solution
from switchfit.uncertainty.residuals import diagnose

SINGULAR_FACTOR = 100.0
"""Factor between the standard errors of the two Hessians above which the Gauss-Newton matrix counts as singular, as for
a transition at which the vector field does not jump, such as a block that comes to rest."""

DIFFERENT_FACTOR = 1.2
"""Factor between the standard errors of the two Hessians, for any combination of the unknowns, above which a warning is
given: a 95 % interval that is too narrow by this factor covers 90 %, one that is too wide 98 %."""


def list_without_effect(fit: Fit) -> tuple[str, ...]:
    """Return the free parameters and initial states on which J does not depend, to second order.

    Those that no function reads which acts, and any other whose row of the Hessian is exactly 0, such as an entry of an
    array that no function reads. Those that a bound, a kink, a guard or a collapsed mode holds are not among them.
    """
    flat = np.all(fit.hessian == 0.0, axis=1) & ~fit.is_time
    flat |= np.isin(fit.theta_names, (*fit.unread, *fit.absent))
    flat &= moves_by_itself(fit.free_basis)
    return tuple(np.array(fit.theta_names, dtype=object)[flat].tolist())


def _find_residual_issues(fit: Fit) -> Iterator[Issue]:
    """Find residuals of a fit that are not white noise of the size of sigma.

    Parameters
    ----------
    fit : Fit
    """
    variance = fit.residual_variance
    if fit.sigma_known and np.isfinite(variance):
        probability, is_size = compare_with_sigma(2 * fit.cost, fit.freedom)
        if probability < UNLIKELY_AS_NOISE or not is_size:
            figures = {"chi-square": variance, "factor": max(variance, 1 / max(variance, 1e-300)) ** 0.5}
            yield Issue("sigma too small" if variance > 1 else "sigma too large", figures=figures)
    if fit.sigma_known is not None:
        yield from diagnose(fit).issues


def find_issues(fit: Fit) -> Iterator[Issue]:
    """Yield the warnings about a fit, in the order of the report.

    Parameters
    ----------
    fit : Fit
    """
    yield from find_short_modes(fit)
    yield from find_active_bounds(fit)
    yield from find_times_at_jumps(fit)
    is_time = dict(zip(fit.theta_names, fit.is_time.tolist(), strict=True))
    for kind, wanted in (("idle times", True), ("idle parameters", False)):
        if names := tuple(name for name in fit.idle if is_time[name] is wanted):
            yield Issue(kind, names)
    yield from find_kinks(fit)
    yield from find_without_effect(fit)
    smallest, names = find_weakest(fit)
    if abs(smallest) < BARELY_DETERMINED:
        yield Issue("not determined", names, {"eigenvalue": smallest})
    yield from _find_missing_errors(fit, smallest)
    if fit.status.successful:
        yield from _find_residual_issues(fit)
        yield from _compare_covariances(fit)
    if not fit.integration_error <= LARGE_INTEGRATION_ERROR:
        yield Issue("large integration error", (fit.integration_error_of,), {"error": fit.integration_error})


def find_short_modes(fit: Fit) -> Iterator[Issue]:
    """Find modes that have collapsed, or are at their minimum duration."""
    for constraint in fit.active:
        if constraint.position is not None:
            kind = "a mode collapsed" if constraint.kind == "collapsed" else "a mode is short"
            yield Issue(kind, (constraint.mode, constraint.run), {"position": float(constraint.position)})


def find_active_bounds(fit: Fit) -> Iterator[Issue]:
    """Find unknowns that bounds hold which the user gave; equal bounds are a value that is known."""
    known = {*fit.idle, *np.array(fit.theta_names)[fit.lower == fit.upper].tolist()}
    for constraint in fit.active:
        if constraint.kind in ("lower bound", "upper bound") and constraint.unknown not in known:
            yield Issue(constraint.kind, (constraint.unknown,), {"value": constraint.value})


def find_times_at_jumps(fit: Fit) -> Iterator[Issue]:
    """Find transition times that are held by jumps at known times."""
    held = [each for each in fit.active if each.kind == "known jump" and each.unknown not in fit.idle]
    if held:
        places = tuple(each.value for each in held)
        yield Issue("at known jumps", tuple(each.unknown for each in held), {"at": places})


def find_kinks(fit: Fit) -> Iterator[Issue]:
    """Find unknowns at which the derivative jumps through zero."""
    if fit.kinks:
        yield Issue("at kinks", tuple(kink.unknown for kink in fit.kinks))


def find_without_effect(fit: Fit) -> Iterator[Issue]:
    """Find unknowns on which the cost does not depend: no function reads them, only modes that do not occur do, or it
    is unknown why.

    Parameters
    ----------
    fit : Fit
    """
    without = list_without_effect(fit)
    for kind, group in (("not read", fit.unread), ("acts elsewhere", fit.absent)):
        if names := name_whole_parameters([name for name in without if name in group]):
            yield Issue(kind, names)
    if others := tuple(name for name in without if name not in (*fit.unread, *fit.absent)):
        yield Issue("without effect", others)


def find_weakest(fit: Fit) -> tuple[float, tuple[str, ...]]:
    """Return the smallest eigenvalue of the scaled Hessian of the free unknowns with an effect, infinite if there are
    none, and the unknowns with the largest components in its direction.
    """
    found = analyse_solution(fit, None)
    if flat := tuple(name for name in found.without if name not in list_without_effect(fit)):  # transition times
        return 0.0, flat[:MOST_NAMED_UNKNOWNS]
    return (
        (float(found.eigenvalues[0]), found.directions[0].names[:MOST_NAMED_UNKNOWNS])
        if found.directions
        else (np.inf, ())
    )


def _find_missing_errors(fit: Fit, smallest: float) -> Iterator[Issue]:
    """Find the reason why a fit has no standard errors; `smallest`: of the eigenvalues of its scaled Hessian."""
    # Unknowns without effect have no error either, and have said why.
    missing = ~np.isfinite(fit.standard_errors) & ~np.isin(fit.theta_names, list_without_effect(fit))
    if not missing.any() or not np.isfinite(fit.hessian).all():
        return
    if fit.sigma_known is None:
        if any(fit.comparisons):  # a cost of the trajectory alone never has standard errors
            yield Issue("no errors: no noise model")
    elif fit.sigma_known or fit.freedom > 0:  # with too few samples the verdict says so
        names = () if missing.all() else tuple(np.array(fit.theta_names, dtype=object)[missing].tolist())
        yield Issue("no errors: not positive definite", names, {"eigenvalue": smallest})


def _compare_covariances(fit: Fit) -> Iterator[Issue]:
    """Test whether the exact Hessian and the Gauss-Newton matrix give different standard errors."""
    found = disagreement(fit)
    if found is not None and found.factor > DIFFERENT_FACTOR:
        kind = "known to second order" if found.factor > SINGULAR_FACTOR else "covariances differ"
        figures = {"factor": found.factor, "exact": found.exact, "Gauss-Newton": found.gauss_newton}
        yield Issue(kind, (found.name,), figures)
