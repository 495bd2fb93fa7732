"""Where many fits ended: arrays with one entry a fit.

`Ends` are those of finished fits, a part of `Fits`; a `Chunk` is the same while its fits are done, which may be done
again and replaced one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.batch.failures import describe_failure
from switchfit.fit.kink_variance import free_kinks
from switchfit.fit.result import Fit
from switchfit.fit.scaled_hessian import inverse_on
from switchfit.optimize import Result, Status
from switchfit.optimize.traced_state import Outcome


@dataclass(frozen=True, eq=False)
class Ends:
    """Where R fits ended, one entry a fit.

    Attributes
    ----------
    theta, cost, gradient, hessian : (R, d), (R,), (R, d), (R, d, d)
    optimality : (R,)
    iterations, evaluations : (R,) int
    status : (R,) str
        Name of the `Status`.
    message : (R,) str
        Empty where the status is CONVERGED without an active constraint; the error of a fit that ended with one.
    free : (R,) int
        Directions that constraints and kinks leave free.
    kinks : (R, d, 2)
        Derivatives of J to the left and right of an unknown that ended at a kink; 0 for others.
    covariance : (R, d, d)
        ``Z (Z' H Z)^-1 Z'`` on the free directions Z, later with those at kinks, not yet scaled; NaN where it is not
        positive definite.
    """

    theta: FloatArray
    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray
    optimality: FloatArray
    iterations: NDArray[np.int64]
    evaluations: NDArray[np.int64]
    status: NDArray[np.str_]
    message: NDArray[np.str_]
    free: NDArray[np.int64]
    kinks: FloatArray
    covariance: FloatArray

    @property
    def at_kink(self) -> NDArray[np.bool_]:
        """Which unknowns ended at a kink: (R, d)."""
        return self.kinks[:, :, 0] < self.kinks[:, :, 1]


class Chunk(Ends):
    """Ends to be written to: a fit that is done again replaces what was found before. Text is in arrays of objects."""

    @classmethod
    def of(cls, outcome: Outcome) -> Chunk:
        """Return the outcomes of R fits as if all of them had converged, without covariances."""
        # Copies: arrays that come from JAX cannot be written to.
        found = {name: np.array(getattr(outcome, name)) for name in Outcome._fields[:7]}
        R, d = outcome.theta.shape
        # Arrays of objects, since text in a fixed-width array would be cut off at the length of the first message.
        texts: list[NDArray[Any]] = [np.full(R, text, dtype=object) for text in (Status.CONVERGED.name, "")]
        unknown, kinks = np.full((R, d, d), np.nan), np.zeros((R, d, 2))
        return cls(**found, status=texts[0], message=texts[1], free=np.full(R, d), kinks=kinks, covariance=unknown)

    def replace_fit(self, k: int, found: Result | Fit, kinks: Sequence[tuple[int, float, float]], message: str) -> None:
        """Replace the k-th fit by another one, with its kinks; iterations and evaluations of both are added."""
        for name in ("theta", "cost", "gradient", "hessian", "optimality"):
            getattr(self, name)[k] = getattr(found, name)
        # The work of the first try was done too.
        self.iterations[k] += found.iterations
        self.evaluations[k] += found.evaluations
        self.status[k], self.message[k] = found.status.name, message
        self.free[k] = found.free_basis.shape[1]
        self.covariance[k] = inverse_on(found.free_basis, found.hessian)
        # The first try may have ended at other kinks.
        self.kinks[k] = 0.0
        for place, left, right in kinks:
            self.kinks[k, place] = left, right

    def free_kinks(self, k: int, scale: float) -> None:
        """Let the unknowns at kinks of the k-th fit have variances; `scale`: that of its covariance."""
        kinks = [(place, *self.kinks[k, place].tolist()) for place in np.flatnonzero(self.at_kink[k]).tolist()]
        self.covariance[k] = free_kinks(self.covariance[k], self.hessian[k], kinks, scale)

    def set_error(self, k: int, error: BaseException) -> None:
        """Say that the k-th fit ended with an error."""
        self.status[k], self.message[k] = Status.ERROR.name, describe_failure(error)

    def clear_fit(self, k: int, error: BaseException) -> None:
        """Leave nothing of the k-th fit but the error with which it failed before it began."""
        for array in vars(self).values():
            # Numbers of a fit that never began must not enter a mean or a median.
            array[k] = np.nan if array.dtype.kind == "f" else 0
        self.set_error(k, error)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays by their names, text as such."""
        return {name: a.astype(str) if a.dtype == object else a for name, a in vars(self).items()}
