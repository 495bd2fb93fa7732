"""The largest log-likelihood of a model, with all constants, so that models of the noise may differ."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np

from switchfit.fit.comparison import Comparison
from switchfit.problem.losses import robust
from switchfit.problem.problem import Problem
from switchfit.runtime import special


def compute_log_likelihood(problem: Problem, comparisons: Sequence[Sequence[Comparison]]) -> float:
    """Return the log-likelihood of all samples, constants included, without priors.

    If sigma is left out, it is the largest over sigma, at ``sigma^2 = 2 J / n``.

    Parameters
    ----------
    problem : Problem
    comparisons : sequence of sequences of Comparison, one for each experiment
    """
    total, squares, count = 0.0, 0.0, 0
    known = problem.is_sigma_known
    for item, comparison in zip(problem.measurements, chain(*comparisons), strict=True):
        there = np.isfinite(comparison.residuals)
        r = comparison.residuals[there]
        sigma = np.ones(len(r)) if comparison.sigma is None else comparison.sigma[there]
        u = (r / sigma) ** 2
        # J leaves the constants out; models with other sigmas are compared with them.
        total -= float(np.log(sigma).sum())
        squares += float(u.sum())
        count += len(r)
        if known:
            total -= 0.5 * float(np.sum(robust(item.loss, item.loss_scale, u)))
            total -= len(r) * compute_log_norm(item.loss, item.loss_scale)
    if known:
        return total
    return total - 0.5 * count * (np.log(2 * np.pi * squares / count) + 1)


def compute_log_norm(loss: str, scale: float) -> float:
    """Return the logarithm of the integral of ``exp(-rho / 2)`` over residuals in sigmas, by which a loss is a density.

    Infinite for a Cauchy loss with a scale up to 1, which is no density.

    Parameters
    ----------
    loss : str
    scale : float
    """
    if loss == "linear":
        return 0.5 * float(np.log(2 * np.pi))
    if loss == "cauchy":  # the integral of (1 + z^2 / C^2)^(-C^2 / 2), Student's
        if scale <= 1:
            return np.inf
        a = 0.5 * scale**2
        return float(np.log(scale) + 0.5 * np.log(np.pi) + special.gammaln(a - 0.5) - special.gammaln(a))
    from scipy.integrate import quad  # here, since importing it takes longer than most comparisons

    def density(z: float) -> float:
        return float(np.exp(-0.5 * robust(loss, scale, np.float64(z * z))))

    parts = [quad(density, a, b, epsabs=0.0, epsrel=1e-10)[0] for a, b in ((0.0, scale), (scale, np.inf))]
    return float(np.log(2 * sum(parts)))
