"""What an online estimator says after each sample: mode, state, parameters, errors, alarm and status."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.online.information import drop_artificial, invert
from switchfit.runtime.presentation import format_line


class OnlineStatus(Enum):
    """How an online estimator stands; the value is a sentence with a remedy.

    See Also
    --------
    OnlineEstimator

    Examples
    --------
    >>> sf.OnlineEstimator(heater_problem()).update(0.1).status.name
    'WAITING'
    """

    WAITING = "fewer values have been measured than there are unknowns: give it more samples"
    TRACKING = "the model follows the samples"
    ALARM = "the mode has changed: see `alarm`"
    RETRACTED = "later samples have refuted the last change of mode: see `retracted`"
    OVERRUN = "the budget of an update was spent, and a part of its work was left out: raise budget=, or lower width="
    LOST = "the samples are not what the model predicts: check sigma, the modes and the successions"
    STOPPED = (
        "the model can no longer be simulated, in no mode: see whether y, u and the model are finite, then begin anew "
        "with `reset`"
    )


class Alarm(NamedTuple):
    """A change of mode.

    Attributes
    ----------
    time : float
        Of the sample at which it was declared.
    mode : str
        The mode that has begun.
    transition_time : float
    standard_error : float
        Of the transition time.
    statistic : float
        Twice by how much the cost is lower with the change than without it.

    See Also
    --------
    OnlineEstimator, Now

    Examples
    --------
    >>> sf.replay(heater_problem(), threshold=20.0).alarms[0].mode
    'off'
    """

    time: float
    mode: str
    transition_time: float
    standard_error: float
    statistic: float


@dataclass(frozen=True, eq=False)
class Best:
    """The linearised cost of the best hypothesis, and its state, in D unknowns.

    Attributes
    ----------
    theta : (U,), parameters and initial states in the order of the problem's theta
    state : (n,)
    times : slice, of the transition times that are not past
    parameters : dict of str to slice, of the free parameters
    of_engine, artificial : ((E, E), (n, E)), (E,)
        Second derivatives and tangent in the engine's E unknowns, and what the diagonal has that is no knowledge.
    into : (E, D)
        How these unknowns follow from the D.
    """

    theta: FloatArray
    state: FloatArray
    times: slice
    parameters: dict[str, slice]
    of_engine: tuple[FloatArray, FloatArray]
    artificial: FloatArray
    into: FloatArray

    @cached_property
    def matrix(self) -> FloatArray:
        """Second derivatives of the cost, (D, D)."""
        return self.into.T @ drop_artificial(self.of_engine[0], self.artificial) @ self.into

    @property
    def tangent(self) -> FloatArray:
        """Derivatives of the state, (n, D)."""
        return self.of_engine[1] @ self.into


@dataclass(frozen=True, eq=False)
class Now:
    """What is known after a sample. It does not change afterwards: any thread may read it.

    Attributes
    ----------
    time : float
    mode : str
    since : float
        When the mode began.
    mode_sequence : tuple of str
    transition_times : (N,) array
    parameters : dict of str to array
    alarm : Alarm or None
        A change of mode that this sample has shown.
    retracted : Alarm or None
        A change that it has refuted.
    statistic, threshold : float
        Twice by how much the best hypothesis with a further change has a lower cost than the best without it, and the
        value above which that is an alarm.
    status : OnlineStatus
    seconds : float
        What the update took.
    best : Best
        The linearised cost of the best hypothesis, from which the errors follow.
    past_errors : tuple of float
        Standard errors of the transitions that have left the window.
    walked : (D,) or 0
        Variances by which parameters that drift have moved away from the constants of the window.
    modes : tuple of str
        Those of the system.
    hypotheses : ((B,), (B,))
        The mode that each hypothesis is in, and its cost with the price of its changes.

    See Also
    --------
    OnlineEstimator

    Examples
    --------
    >>> now = sf.OnlineEstimator(heater_problem()).update(0.1, [0.5])
    >>> now.state.shape, now.covariance.shape
    ((1,), (1, 1))
    """

    time: float
    mode: str
    since: float
    mode_sequence: tuple[str, ...]
    transition_times: FloatArray
    parameters: dict[str, FloatArray]
    alarm: Alarm | None
    retracted: Alarm | None
    statistic: float
    threshold: float
    status: OnlineStatus
    seconds: float
    best: Best
    past_errors: tuple[float, ...]
    walked: FloatArray | float
    modes: tuple[str, ...]
    hypotheses: tuple[NDArray[np.int64], FloatArray]

    def __repr__(self) -> str:
        return format_line(self, f"t = {self.time:.6g}", f"{self.mode} since {self.since:.6g}", self.status.name)

    @cached_property
    def mode_probability(self) -> dict[str, float]:
        """Share of the hypotheses that are in each mode, weighted by their likelihood and the price of a change."""
        mode, value = self.hypotheses
        # Less the lowest, or all would underflow in a long log.
        share = np.exp(value.min() - value)
        shares = np.bincount(mode, share / share.sum(), len(self.modes))
        return dict(zip(self.modes, shares.tolist(), strict=True))

    @property
    def state(self) -> FloatArray:
        """x at `time`: (n,)."""
        return self.best.state

    @cached_property
    def _unknowns(self) -> FloatArray:
        return invert(self.best.matrix)

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of the state: (n, n); infinite on its diagonal where the samples say nothing."""
        Z, P = self.best.tangent, self._unknowns
        # An unknown that does not move the state may have an infinite variance: 0 times infinity is no number.
        used = (Z != 0).any(0)
        return np.asarray(Z[:, used] @ P[np.ix_(used, used)] @ Z[:, used].T)

    @property
    def standard_errors(self) -> dict[str, FloatArray]:
        """Standard errors of the parameters, by name."""
        errors = np.sqrt(np.diag(self._unknowns) + self.walked)
        return {name: errors[of].reshape(self.parameters[name].shape) for name, of in self.best.parameters.items()}

    @property
    def time_errors(self) -> FloatArray:
        """Standard errors of the transition times: (N,)."""
        return np.array([*self.past_errors, *np.sqrt(np.diag(self._unknowns))[self.best.times]])
