"""Jumps of the state at known times: doses, impulses, refills."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from switchfit.arrays import Converted, Traced
from switchfit.problem.dates import read_dates
from switchfit.problem.validation.arrays import as_array
from switchfit.problem.validation.messages import shorten
from switchfit.problem.validation.objects import as_callable, set_fields


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

    >>> system = sf.HybridSystem({"eliminate": lambda t, x, p: -p["k"] * x}, [0.0])
    >>> doses = sf.Jump([0.0, 8.0, 16.0], lambda t, x, p: x + 100.0 / p["V"])
    >>> log = sf.Measurements([1.0, 7.0, 12.0, 24.0], [9.1, 4.9, 9.8, 7.4], sigma=0.3)
    >>> run = sf.Experiment(log, ["eliminate"], [], t0=0.0, time_unit="h", jumps=[doses])
    >>> fit = sf.estimate(sf.Problem(system, run, {"k": 0.2, "V": sf.Parameter(8.0, lower=1.0)}))
    >>> {name: round(value, 2) for name, value in zip(fit.theta_names, fit.theta.tolist())}
    {'k': 0.1, 'V': 9.92}
    """

    time: Converted  # a float or a tuple of them, or `Dates` until an experiment has counted them
    map: Callable[..., Traced]

    def __post_init__(self) -> None:
        as_callable(self.map, "Jump map", "a function map(t, x, p)", arguments=3)
        dates = read_dates(self.time, "Jump time")
        form = "a number or a sequence of numbers"
        times = as_array(self.time, "Jump time", form=form, finite=True) if dates is None else dates.instants
        if times.ndim > 1 or not times.size or np.any(np.diff(np.atleast_1d(times)) <= 0):
            raise ValueError(f"Jump time must be {form} that increase strictly; got {shorten(self.time)}.")
        listed = times.tolist()
        set_fields(self, time=dates if dates is not None else tuple(listed) if isinstance(listed, list) else listed)
