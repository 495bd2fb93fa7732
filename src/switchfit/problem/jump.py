"""Jumps of the state at known times: doses, impulses, refills."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from switchfit.problem.data import FloatArray
from switchfit.problem.dates import Dates, as_dates, is_dated
from switchfit.problem.validation import as_array, as_callable, set_fields, shorten


@dataclass(frozen=True, eq=False)
class Jump:
    """A change of the state at known times, such as a dose or an impulse: ``x(t+) = map(t, x(t-), p)``.

    The mode stays the same, and no transition is needed. The map reads the parameters, so that the amount of a dose
    may be estimated.

    Parameters
    ----------
    time : float, date, or a sequence of these
        When, in the experiment's time unit or as dates, which the experiment converts to it: one time, or several in
        ascending order, at each of which the map acts. A time lies in ``[t0, tf)``.
    map : callable ``map(t, x, p) -> (n,)``, twice differentiable
        The state just after, given the state x just before.

    Raises
    ------
    ValueError
        For times that are not finite or do not increase, and text that is no date.
    TypeError
        If the times are neither numbers nor dates, or the map is not a function of (t, x, p).

    Notes
    -----
    A sample at the time of a jump is of the state before it, as at a transition. Jumps at the same time act in the
    order in which the experiment lists them. A transition stays on its side of a jump: the guess says between which
    jumps it lies, and these are its bounds.

    See Also
    --------
    Experiment : takes them as `jumps`.
    HybridSystem : has the reset maps of transitions, whose times are estimated.

    Examples
    --------
    Three doses of 100 mg, eight hours apart, into a body of unknown volume:

    >>> import switchfit as sf
    >>> system = sf.HybridSystem({"eliminate": lambda t, x, p: -p["k"] * x}, [0.0])
    >>> doses = sf.Jump([0.0, 8.0, 16.0], lambda t, x, p: x + 100.0 / p["V"])
    >>> log = sf.Measurements([1.0, 7.0, 12.0, 24.0], [9.1, 4.9, 9.8, 7.4], sigma=0.3)
    >>> run = sf.Experiment(log, ["eliminate"], [], t0=0.0, time_unit="h", jumps=[doses])
    >>> fit = sf.estimate(sf.Problem(system, run, {"k": 0.2, "V": sf.Parameter(8.0, lower=1.0)}))
    >>> {name: round(value, 2) for name, value in zip(fit.theta_names, fit.theta.tolist())}
    {'k': 0.1, 'V': 9.92}
    """

    time: Any
    map: Callable[..., object]

    def __post_init__(self) -> None:
        as_callable(self.map, "Jump map", "a function map(t, x, p)", arguments=3)
        if is_dated(self.time):
            dates = as_dates(self.time, "Jump time")
            _check_order(dates.instants.reshape(-1).tolist(), self.time)
            set_fields(self, time=dates)
            return
        times = as_array(self.time, "Jump time", form="a number or a sequence of numbers")
        if times.ndim > 1 or not np.isfinite(times).all():
            raise ValueError(f"Jump time must be a finite number or several; got {shorten(self.time)}.")
        listed = times.reshape(-1).tolist()
        _check_order(listed, self.time)
        set_fields(self, time=listed[0] if times.ndim == 0 else tuple(listed))

    @property
    def times(self) -> FloatArray:
        """All its times: (K,). ValueError for dates, which become numbers in an experiment."""
        if isinstance(self.time, Dates):
            raise ValueError(f"the times of this Jump are dates ({self.time!r}): an Experiment makes numbers of them.")
        return np.atleast_1d(np.asarray(self.time, dtype=np.float64))


def _check_order(times: Sequence[float], given: Any) -> None:
    """Raise ValueError unless times increase strictly."""
    if not times:
        raise ValueError(f"Jump time must be a finite number or several; got {shorten(given)}.")
    if any(later <= earlier for earlier, later in pairwise(times)):
        raise ValueError(f"The times of a Jump must increase strictly; got {shorten(given)}.")
