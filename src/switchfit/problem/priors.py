"""Priors: knowledge about an unknown before the fit, as a term of the cost.

A prior counts as one more measurement, of the unknown itself: J with its priors is the negative logarithm of the
posterior density, up to a constant, and its minimum the maximum a posteriori (MAP) estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import numpy as np

from switchfit.arrays import Converted, Traced
from switchfit.problem.dates import Dates, read_date
from switchfit.problem.validation.arrays import as_array, require_deviation
from switchfit.problem.validation.messages import shorten
from switchfit.problem.validation.objects import set_fields


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal prior: adds ``1/2 ((p - mean) / sd)**2`` to J.

    Parameters
    ----------
    mean : float or array_like
        Mean, in the unit of the unknown; a date for a transition time whose guess is one.
    sd : float or array_like
        Standard deviation, positive, in the same unit.

    Raises
    ------
    ValueError
        If a number is not finite, or sd not positive.
    TypeError
        If one is not a number.

    See Also
    --------
    LogNormal, Parameter

    Examples
    --------
    >>> mu = sf.Parameter(0.8, prior=sf.Normal(mean=0.7, sd=0.1))
    >>> mu.prior.sd
    array(0.1)
    """

    mean: Converted  # an array, or `Dates` until an experiment has counted it
    sd: Converted

    def __post_init__(self) -> None:
        set_fields(self, mean=read_date(self.mean, "Normal mean"))
        _check(self, "sd" if isinstance(self.mean, Dates) else "mean", "sd")


@dataclass(frozen=True, eq=False)
class LogNormal:
    """Log-normal prior of a positive unknown: adds ``1/2 ((log p - log median) / log_sd)**2`` to J.

    Parameters
    ----------
    median : float or array_like
        Median, positive, in the unit of the unknown.
    log_sd : float or array_like
        Standard deviation of log p, positive: 0.1 is about 10 %.

    Raises
    ------
    ValueError
        If a number is not finite, or not positive.
    TypeError
        If one is not a number.

    Notes
    -----
    This is a normal prior of log p, with a density over log p: the maximum a posteriori is that of log p.

    See Also
    --------
    Normal, Parameter

    Examples
    --------
    >>> mu = sf.Parameter(0.8, lower=0.01, prior=sf.LogNormal(median=0.7, log_sd=0.1))
    >>> mu.prior.log_sd
    array(0.1)
    """

    median: Converted
    log_sd: Converted

    def __post_init__(self) -> None:
        _check(self, "median", "log_sd")
        if not np.all(self.median > 0):
            raise ValueError(f"LogNormal median must be positive; got {shorten(self.median)}.")


Prior = Normal | LogNormal


def _check(prior: Normal | LogNormal, center: str, spread: str) -> None:
    kind = type(prior).__name__
    for name in (center, spread):
        set_fields(prior, **{name: as_array(getattr(prior, name), f"{kind} {name}", finite=name == center)})
    require_deviation(getattr(prior, spread), f"{kind} {spread}")


class PriorTerms(NamedTuple):
    """The priors of a whole theta: three (d,) arrays.

    Attributes
    ----------
    center : mean, or logarithm of the median
    precision : 1 / sd**2, 0 without a prior
    log : bool, whether the prior is one of log p
    """

    center: Traced  # NumPy; of JAX where many problems are evaluated as one batch
    precision: Traced
    log: Traced

    @classmethod
    def of(cls, prior: Prior | None, shape: tuple[int, ...]) -> PriorTerms:
        """Return the terms of one unknown of the given shape, flattened."""
        size = math.prod(shape)
        if prior is None:
            return cls(np.zeros(size), np.zeros(size), np.zeros(size, bool))
        log = isinstance(prior, LogNormal)
        center, sd = (np.log(prior.median), prior.log_sd) if isinstance(prior, LogNormal) else (prior.mean, prior.sd)
        return cls(
            np.broadcast_to(center, shape).ravel().astype(np.float64),
            np.broadcast_to(sd**-2.0, shape).ravel().astype(np.float64),
            np.full(size, log),
        )

    @classmethod
    def join(cls, parts: list[PriorTerms]) -> PriorTerms:
        """Concatenate the terms of several unknowns."""
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    @property
    def any(self) -> bool:
        """Whether any unknown has a prior."""
        return bool(np.any(self.precision > 0))

    def evaluate(
        self, theta: Traced, xp: ModuleType = np, *, gauss_newton: bool = False
    ) -> tuple[Traced, Traced, Traced]:
        """Return the cost (), gradient (d,) and diagonal of the Hessian (d,), or of the Gauss-Newton matrix, at theta
        (d,); for several thetas (B, d), of each.

        With ``e = (v - center) / sd``, v being p or log p, the cost is ``1/2 sum e**2``.
        """
        # 1 where the prior is not logarithmic, since `where` differentiates both cases, and log of a negative theta is
        # NaN.
        p = xp.where(self.log, theta, 1.0)
        e = xp.where(self.log, xp.log(p), theta) - self.center
        v_p = xp.where(self.log, 1.0 / p, 1.0)
        # The Gauss-Newton matrix leaves out e d^2 v, which vanishes for a normal prior.
        v_pp = 0.0 if gauss_newton else xp.where(self.log, -1.0 / p**2, 0.0)
        w = self.precision
        return 0.5 * xp.sum(w * e * e, -1), w * e * v_p, w * (v_p**2 + e * v_pp)

    def texts(self) -> list[str]:
        """Return each prior in words; empty for an unknown without a prior."""
        found = [""] * len(self.precision)
        for i in np.flatnonzero(self.precision > 0).tolist():
            center, sd = self.center[i], self.precision[i] ** -0.5
            text = f"log-normal({np.exp(center):.6g}, {sd:.4g})" if self.log[i] else f"normal({center:.6g}, {sd:.4g})"
            found[i] = text
        return found
