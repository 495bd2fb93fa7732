"""Warnings about the numbers of a fit, as data; the report writes the sentences."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from switchfit.fit.result import Fit, disagreement, free_curvature, list_without_effect
from switchfit.problem.readers import name_whole_parameters
from switchfit.runtime import special
from switchfit.runtime.issue import Issue
from switchfit.uncertainty.answers import BARELY_DETERMINED, CLEARLY_OFF, UNLIKELY
from switchfit.uncertainty.certificate import LARGE_INTEGRATION_ERROR
from switchfit.uncertainty.residuals import diagnose

UNSEEN = 100.0
"""Factor between the standard errors of the two Hessians above which the Gauss-Newton matrix counts as singular, as for
a transition at which the vector field does not jump, such as a block that comes to rest."""
DIFFERENT = 1.2
"""Factor between the standard errors of the two Hessians, for any combination of the unknowns, above which a warning is
given: a 95 % interval that is too narrow by this factor covers 90 %, one that is too wide 98 %."""


def find_issues(fit: Fit) -> list[Issue]:
    """Return the warnings about a fit, in the order of the report.

    Parameters
    ----------
    fit : Fit
    """
    sources = (
        _find_active,
        _find_idle,
        _find_kinks,
        find_without_effect,
        _find_undetermined,
        _find_missing_errors,
        _check_noise,
        _check_residuals,
        _compare_covariances,
        _check_integration,
    )
    return [issue for source in sources for issue in source(fit)]


def _find_active(fit: Fit) -> Iterator[Issue]:
    """Find the constraints that hold with equality."""
    for constraint in fit.active:
        if constraint.position is not None:
            figures = {"position": float(constraint.position), "value": constraint.value}
            kind = "mode collapsed" if constraint.kind == "collapsed" else constraint.kind
            yield Issue(kind, (constraint.mode, constraint.run), figures)
        elif constraint.unknown not in fit.idle:
            yield Issue(constraint.kind, (constraint.unknown,), {"value": constraint.value})


def _find_idle(fit: Fit) -> Iterator[Issue]:
    """Find unknowns on which the cost does not depend, because a mode has collapsed."""
    times = {name for name, is_time in zip(fit.theta_names, fit.is_time.tolist(), strict=True) if is_time}
    for kind, names in (
        ("idle times", tuple(name for name in fit.idle if name in times)),
        ("idle parameters", tuple(name for name in fit.idle if name not in times)),
    ):
        if names:
            yield Issue(kind, names)


def _find_kinks(fit: Fit) -> Iterator[Issue]:
    """Find unknowns at which the derivative jumps through zero."""
    if fit.kinks:
        figures = {"left": tuple(k.left for k in fit.kinks), "right": tuple(k.right for k in fit.kinks)}
        yield Issue("at a kink", tuple(kink.unknown for kink in fit.kinks), figures)


def find_without_effect(fit: Fit) -> Iterator[Issue]:
    """Find unknowns on which the cost does not depend: no function reads them, only modes that do not occur do, or it
    is unknown why.

    Parameters
    ----------
    fit : Fit
    """
    without = list_without_effect(fit)
    unread = [name for name in without if name in fit.unread]
    absent = [name for name in without if name in fit.absent]
    others = [name for name in without if name not in unread and name not in absent]
    for kind, names in (
        ("not read", name_whole_parameters(unread)),
        ("acts elsewhere", name_whole_parameters(absent)),
        ("without effect", tuple(others)),
    ):
        if names:
            yield Issue(kind, names)


def _find_undetermined(fit: Fit) -> Iterator[Issue]:
    """Find a direction along which the cost hardly changes, of the unknowns on which it depends."""
    curvature = free_curvature(fit, list_without_effect(fit))
    if len(curvature.scaled) and abs(smallest := float(curvature.scaled[0])) < BARELY_DETERMINED:
        yield Issue("hardly determined", curvature.weakest, {"eigenvalue": smallest})


def _find_missing_errors(fit: Fit) -> Iterator[Issue]:
    """Find the reason why a fit has no standard errors."""
    without = list_without_effect(fit)
    missing = ~np.isfinite(fit.standard_errors) & ~np.isin(fit.theta_names, without)
    if not missing.any():
        return
    k = fit.free_basis.shape[1]
    if not np.isfinite(fit.hessian).all():
        yield Issue("no errors: not finite")
    elif fit.sigma_known is None:
        if not any(fit.comparisons):  # a cost of the trajectory alone never has standard errors
            return
        yield Issue("no errors: no noise model")
    elif fit.sigma_known is False and fit.samples <= k:
        yield Issue("no errors: too few samples", figures={"samples": float(fit.samples), "unknowns": float(k)})
    else:
        smallest = float(np.min(free_curvature(fit, without).scaled, initial=np.inf))
        names = () if missing.all() else tuple(np.array(fit.theta_names, dtype=object)[missing].tolist())
        yield Issue("no errors: not positive definite", names, {"eigenvalue": smallest})


def _check_noise(fit: Fit) -> Iterator[Issue]:
    """Test whether a known sigma contradicts the residuals: 2 J should be chi-square distributed."""
    variance = fit.residual_variance
    if not (fit.status.successful and fit.sigma_known and np.isfinite(variance)):
        return
    freedom = fit.freedom
    below, above = special.chdtr(freedom, 2 * fit.cost), special.chdtrc(freedom, 2 * fit.cost)
    if 2 * min(below, above) > UNLIKELY or abs(variance - 1) < CLEARLY_OFF:
        return
    yield Issue("sigma too small" if variance > 1 else "sigma too large", figures={"chi-square": variance})


def _check_residuals(fit: Fit) -> Iterator[Issue]:
    """Find residuals that are not white, normal noise."""
    if fit.status.successful and fit.sigma_known is not None:
        yield from diagnose(fit).issues


def _compare_covariances(fit: Fit) -> Iterator[Issue]:
    """Test whether the exact Hessian and the Gauss-Newton matrix give different standard errors."""
    found = disagreement(fit) if fit.status.successful else None
    if found is not None and found.factor > DIFFERENT:
        kind = "known to second order" if found.factor > UNSEEN else "covariances differ"
        figures = {"factor": found.factor, "exact": found.exact, "Gauss-Newton": found.gauss_newton}
        yield Issue(kind, (found.name,), figures)


def _check_integration(fit: Fit) -> Iterator[Issue]:
    """Test whether the integration is accurate enough."""
    if not fit.integration_error <= LARGE_INTEGRATION_ERROR:
        yield Issue("large integration error", (fit.integration_error_of,), {"error": fit.integration_error})
