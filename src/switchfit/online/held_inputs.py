"""Inputs of an online estimator: those of the experiment until others are given, which hold from then on."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.online.feed import Feed, shift_cubic
from switchfit.problem.experiment import Experiment
from switchfit.problem.signals import PiecewisePolynomial
from switchfit.problem.validation.arrays import as_array
from switchfit.problem.validation.messages import shorten


class HeldInputs:
    """The inputs of a run, as they come.

    Attributes
    ----------
    held : (q,) array or None
        Inputs that hold from the last update on; None before any were given: those of the experiment then.
    """

    def __init__(self, run: Experiment) -> None:
        self._own = run.inputs
        self._signal = None if run.inputs is None else run.inputs.signal(run.t0, run.end)
        self.held: FloatArray | None = None

    def hold(self, u: ArrayLike | Mapping[str, float] | None) -> FloatArray | None:
        """Return the inputs up to this update, after which those that come with it hold."""
        before, own = self.held, self._own
        if u is None:
            return before
        if self._signal is None or own is None:
            raise ValueError("u was given, but the experiment has no inputs.")
        if isinstance(u, Mapping):
            if set(u) != set(own.names):
                raise ValueError(f"u must have the inputs {', '.join(own.names)}; got {', '.join(map(str, u))}.")
            u = [u[name] for name in own.names]
        given = as_array(u, "u").reshape(-1).copy()
        if given.shape != (self._signal.channels,) or not np.isfinite(given).all():
            raise ValueError(f"u must be {self._signal.channels} finite values; got {shorten(given.tolist())}.")
        # These hold from now on; up to now the ones before hold, which are returned.
        self.held = given
        return given if before is None else before

    def list_times(self, begin: float, end: float, count: int, held: FloatArray | None) -> list[float]:
        """Return `end`, and times before it: evenly spaced ones, and the knots of inputs that are not held."""
        step = (end - begin) / count
        found = [*(begin + k * step for k in range(1, count)), end]
        if held is None and self._signal is not None:
            knots = self._signal.knots
            inside = knots[knots.searchsorted(begin, "right") : knots.searchsorted(end, "left")]
            found = np.unique(np.concatenate([found, inside])).tolist()
        return found

    def write(self, feed: Feed, cell: int, held: FloatArray | None) -> None:
        """Write the inputs in a cell: those that are held, or the problem's."""
        whole: PiecewisePolynomial | None = self._signal
        if whole is None:
            return
        into, (begin, end) = feed.signals[cell], feed.nodes[cell : cell + 2].tolist()
        if held is not None:
            into[0], into[1:] = held, 0.0
            return
        if end > whole.knots[-1] and whole.coefficients[-1, 1:].any():
            raise ValueError(f"the inputs of the problem end at {whole.knots[-1]:.9g}: give u from then on.")
        # By the middle of the cell: its ends may be knots, which belong to two pieces.
        k = int(whole.interval(np.array([0.5 * (begin + end)]))[0])
        into[:] = shift_cubic(whole.coefficients[k], begin - whole.knots[k])
