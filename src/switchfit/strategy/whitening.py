"""Residuals of another run without the correlation that the error of the fitted parameters makes.

With residuals and derivatives in units of sigma, e the noise of the new run, dp the error of the fitted parameters
(covariance C) and G the derivative of the new run's own unknowns, which were fitted to it, the residuals are

    r = M (e - X dp),      M = I - G G^+,      cov r = M + (M X) C (M X)'.

In a linear model ``z = (I + M X C X' M)^(-1/2) r`` has the covariance M: chi-square is ``z . z``, with as many degrees
of freedom as values less own unknowns ([1]_, section 3.9, prediction of several new observations). Tests of whiteness
are made of z, since the error of the parameters, which is common to all samples, correlates the residuals r.

References
----------
.. [1] G. A. F. Seber, A. J. Lee, Linear Regression Analysis, 2nd ed., Wiley 2003, chapters 3 and 5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.fit.result import inverse_on
from switchfit.fit.trajectory import Comparison
from switchfit.problem.data import FloatArray
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem
from switchfit.uncertainty.sensitivity import Sensitivity, collect_sample_derivatives

NEGLIGIBLE = 1e-10
"""Singular value of the derivative of the own unknowns, relative to the largest, of a direction that does nothing."""


class Whitened(NamedTuple):
    """Residuals whose correlation was removed, in the units of the data, and what follows from them.

    Attributes
    ----------
    residuals : list of lists of arrays, as the comparisons
    chi_square : float
    freedom : int
        Its degrees of freedom.
    covariance : (d, d)
        Of theta of the other run.
    """

    residuals: list[list[FloatArray]]
    chi_square: float
    freedom: int
    covariance: FloatArray


def whiten_residuals(
    estimate: Estimate,
    problem: Problem,
    sensitivities: Sequence[Sensitivity],
    comparisons: Sequence[Sequence[Comparison]],
    kept: Mapping[str, int],
    refit: Estimate | None,
    noise: float,
) -> Whitened:
    """Return the residuals with the correlation removed that the error of the parameters makes.

    Where the noise or the covariance of the fit is unknown, a loss is robust, or a delay is a parameter, the residuals
    as they are, and NaN for chi-square and covariance.

    Parameters
    ----------
    estimate : Estimate
        The fit.
    problem : Problem
        Of the other run.
    sensitivities : sequence of Sensitivity, one for each experiment
    comparisons : sequence of sequences of Comparison, one for each experiment
    kept : mapping of str to int
        Unknowns that come from the fit, and where they are in theta of the other run.
    refit : Estimate or None
        Estimation of the other unknowns.
    noise : float
        What residuals are divided by where sigma is unknown; 1 where it is known.
    """
    d = len(problem.theta_names)
    found = [[c.residuals.copy() for c in run] for run in comparisons]
    sigma = _collect_sigma(comparisons) * noise
    freedom = len(sigma)
    Z = np.zeros((d, 0))
    if refit is not None:
        where = _find_places(problem, refit)
        Z = np.zeros((d, refit.free_basis.shape[1]))
        Z[where] = refit.free_basis
        freedom += len(refit.priors) - Z.shape[1]
    C = _expand_covariance(estimate, kept, d)
    # Residuals over sigma are then no normal numbers, or their derivatives are not known. A sigma may be a parameter.
    robust = any(item.loss != "linear" for item in problem.measurements) or problem.estimates_delays
    if robust or problem.is_sigma_known is None or not (np.isfinite(C).all() and np.isfinite(noise)):
        return Whitened(found, np.nan, freedom, np.full((d, d), np.nan))
    samples = collect_sample_derivatives(problem, sensitivities)
    X, r = samples.derivative / sigma[:, None], -samples.residual / sigma
    if refit is not None and refit.priors:
        rows, error = _weigh_priors(problem, refit)
        X, r = np.vstack([X, rows]), np.append(r, -error)
    z, follow, alone = _remove_error(X, r, Z, C)
    for e, run in enumerate(comparisons):
        measured = [k for k, c in enumerate(run) if c.kind == "measurements"]
        for k, item in enumerate(measured):
            there = np.isfinite(run[item].residuals)
            here = (samples.experiment == e) & (samples.item == k)
            found[e][item][there] = (z[: len(sigma)] * sigma)[here]
    if refit is not None:
        # The exact Hessian, as of any fit: a transition time at which the vector field does not jump has no first
        # derivative, and would have no error.
        exact = inverse_on(refit.free_basis, refit.hessian) * noise**2
        if np.isfinite(exact).all():
            alone = np.zeros((d, d))
            alone[np.ix_(where, where)] = exact
    return Whitened(found, float(z @ z), freedom, follow @ follow.T + alone)


def _remove_error(
    X: FloatArray, r: FloatArray, Z: FloatArray, C: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return z (n,); a root of the covariance of theta that follows from C, (d, d); and that of the own unknowns alone.

    Parameters
    ----------
    X : (n, d)
        Derivatives of the residuals r (n,), in sigmas.
    Z : (d, k)
        Directions of the own unknowns that were fitted: G = X Z.
    C : (d, d)
        Covariance of the fitted parameters.
    """
    left, size, right = np.linalg.svd(X @ Z, full_matrices=False)
    does = size > NEGLIGIBLE * size.max(initial=0.0)
    Q, root = left[:, does], Z @ (right[does].T / size[does])  # Z G^+ = root Q', M = I - Q Q'
    values, vectors = np.linalg.eigh(C)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    U = X @ half
    # With M X C^(1/2) = W s V', cov r = M + W s^2 W': (I + W s^2 W')^(-1/2) is I + W (1 / sqrt(1 + s^2) - 1) W'.
    W, s, _ = np.linalg.svd(U - Q @ (Q.T @ U), full_matrices=False)
    r = r - Q @ (Q.T @ r)  # a fit that ended at a kink or a bound leaves a part
    z = r + W @ ((1 / np.sqrt(1 + s**2) - 1) * (W.T @ r))
    return z, half - root @ (Q.T @ U), root @ root.T  # own unknowns follow the error of the parameters


def _weigh_priors(problem: Problem, refit: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return the priors of own unknowns as further residuals: their derivatives (m, d), and their values (m,)."""
    where = np.array(_find_places(problem, refit))
    priors = PriorTerms(*(values[where] for values in problem.unknowns.priors))
    _, g, h = priors.evaluate(refit.theta, gauss_newton=True)  # of r = g / sqrt(h), whose derivative is sqrt(h)
    has, root = h > 0, np.sqrt(h[h > 0])
    rows = np.zeros((len(root), len(problem.theta_names)))
    rows[np.arange(len(root)), where[has]] = root
    return rows, g[has] / root


def _find_places(problem: Problem, refit: Estimate) -> list[int]:
    """Return where the unknowns that were estimated are in theta."""
    return [problem.theta_names.index(name) for name in refit.theta_names]


def _expand_covariance(estimate: Estimate, kept: Mapping[str, int], d: int) -> FloatArray:
    """Return the covariance of the parameters of a fit at their places in another theta: (d, d)."""
    shared = {name: i for name, i in kept.items() if name in estimate.theta_names}
    here, there = list(shared.values()), [estimate.theta_names.index(name) for name in shared]
    C = np.zeros((d, d))
    C[np.ix_(here, here)] = estimate.covariance[np.ix_(there, there)]
    return C


def _collect_sigma(comparisons: Sequence[Sequence[Comparison]]) -> FloatArray:
    """Return the sigma of all samples that are not missing, in the order of their derivatives; 1 where unknown."""
    measured = [c for run in comparisons for c in run if c.kind == "measurements"]
    sizes = [np.ones(c.measured.shape) if c.sigma is None else c.sigma for c in measured]
    there = [size[np.isfinite(c.measured)] for size, c in zip(sizes, measured, strict=True)]
    return np.concatenate([np.zeros(0), *there])
