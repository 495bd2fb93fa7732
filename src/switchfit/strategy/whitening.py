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

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.comparison import Comparison
from switchfit.fit.result import invert
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem
from switchfit.uncertainty.judged_fit import JudgedFit
from switchfit.uncertainty.sample_derivatives import collect_sample_derivatives
from switchfit.uncertainty.sensitivity import Sensitivity

NEGLIGIBLE_SINGULAR_VALUE = 1e-10
"""Singular value of the derivative of the own unknowns, relative to the largest, of a direction that does nothing."""


def whiten_residuals(
    estimate: JudgedFit,
    problem: Problem,
    sensitivities: Sequence[Sensitivity],
    comparisons: Sequence[Sequence[Comparison]],
    kept: Mapping[str, int],
    refit: JudgedFit | None,
    noise: float,
) -> tuple[list[list[FloatArray]], float, int, FloatArray]:
    """Return residuals without the correlation that the error of the parameters makes, and what follows from them.

    They are in the units of the data, as the comparisons; then come chi-square, its degrees of freedom, and the
    covariance of theta of the other run, (d, d). Where the noise or the covariance of the fit is unknown, a loss is
    robust, or a delay is a parameter, the residuals as they are, and NaN for chi-square and covariance.

    Parameters
    ----------
    estimate : JudgedFit
        The fit.
    problem : Problem
        Of the other run.
    sensitivities : sequence of Sensitivity, one for each experiment
    comparisons : sequence of sequences of Comparison, one for each experiment
    kept : mapping of str to int
        Unknowns that come from the fit, and where they are in theta of the other run.
    refit : JudgedFit or None
        Estimation of the other unknowns.
    noise : float
        What residuals are divided by where sigma is unknown; 1 where it is known.
    """
    d = len(problem.theta_names)
    found = [[c.residuals.copy() for c in run] for run in comparisons]
    freedom = sum(item.count for item in problem.measurements)
    Z = np.zeros((d, 0))
    if refit is not None:
        where = np.flatnonzero(np.isin(problem.theta_names, refit.theta_names))
        Z = np.zeros((d, refit.free_basis.shape[1]))
        Z[where] = refit.free_basis
        # Each prior of an own unknown is one more residual, each free direction one fewer.
        freedom += len(refit.priors) - Z.shape[1]
    here = [i for name, i in kept.items() if name in estimate.theta_names]
    there = [estimate.theta_names.index(problem.theta_names[i]) for i in here]
    C = np.zeros((d, d))
    # Fixed parameters, and what is free here but was not in the fit, have no error: their rows stay 0.
    C[np.ix_(here, here)] = estimate.covariance[np.ix_(there, there)]
    # Residuals over sigma are then no normal numbers, or their derivatives are not known. A sigma may be a parameter.
    robust = any(item.loss != "linear" for item in problem.measurements) or problem.estimates_delays
    if robust or problem.is_sigma_known is None or not (np.isfinite(C).all() and np.isfinite(noise)):
        return found, np.nan, freedom, np.full((d, d), np.nan)
    samples = collect_sample_derivatives(problem, sensitivities)
    sigma = noise * samples.weight**-0.5
    # `residual` is model minus data; r of the formulas above is data minus model, so that X is the model's derivative.
    X, r = samples.derivative / sigma[:, None], -samples.residual / sigma
    if refit is not None and refit.priors:
        rows, error = _weigh_priors(problem, refit)
        X, r = np.vstack([X, rows]), np.append(r, -error)
    z, follow, alone = _remove_error(X, r, Z, C)
    for e, run in enumerate(comparisons):
        measured = [k for k, c in enumerate(run) if c.kind == "measurements"]
        for k, item in enumerate(measured):
            own = (samples.experiment == e) & (samples.item == k)
            # Back in the units of the data, in the places of values that are there: samples come in the order of the
            # comparisons.
            found[e][item][np.isfinite(run[item].residuals)] = (z[: len(sigma)] * sigma)[own]
    if refit is not None:
        # The exact Hessian, as of any fit: a transition time at which the vector field does not jump has no first
        # derivative, and would have no error.
        exact = invert(refit, refit.hessian, noise**2) * noise**2
        if np.isfinite(exact).all():
            alone = np.zeros((d, d))
            alone[np.ix_(where, where)] = exact
    return found, float(z @ z), freedom, follow @ follow.T + alone


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
    # A direction that moves no residual has been fitted by nothing: it takes no degree of freedom out of r.
    does = size > NEGLIGIBLE_SINGULAR_VALUE * size.max(initial=0.0)
    Q, root = left[:, does], Z @ (right[does].T / size[does])  # Z G^+ = root Q', M = I - Q Q'
    # A root of C: half half' = C. Where a direction is held C is singular, and rounding may make an eigenvalue
    # negative.
    values, vectors = np.linalg.eigh(C)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    U = X @ half
    # With M X C^(1/2) = W s V', cov r = M + W s^2 W': (I + W s^2 W')^(-1/2) is I + W (1 / sqrt(1 + s^2) - 1) W'.
    W, s, _ = np.linalg.svd(U - Q @ (Q.T @ U), full_matrices=False)
    r = r - Q @ (Q.T @ r)  # a fit that ended at a kink or a bound leaves a part
    z = r + W @ ((1 / np.sqrt(1 + s**2) - 1) * (W.T @ r))
    return z, half - root @ (Q.T @ U), root @ root.T  # own unknowns follow the error of the parameters


def _weigh_priors(problem: Problem, refit: JudgedFit) -> tuple[FloatArray, FloatArray]:
    """Return the priors of own unknowns as further residuals: their derivatives (m, d), and their values (m,)."""
    where = np.flatnonzero(np.isin(problem.theta_names, refit.theta_names))
    priors = PriorTerms(*(values[where] for values in problem.unknowns.priors))
    _, g, h = priors.evaluate(refit.theta, gauss_newton=True)  # of r = g / sqrt(h), whose derivative is sqrt(h)
    # Unknowns without a prior have h = 0.
    has, root = h > 0, np.sqrt(h[h > 0])
    rows = np.zeros((len(root), len(problem.theta_names)))
    rows[np.arange(len(root)), where[has]] = root
    return rows, g[has] / root
