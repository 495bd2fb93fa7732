"""`Parameter`, an unknown of any kind: of the model, a transition time, or an entry of an initial state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from switchfit.arrays import Converted, FloatArray
from switchfit.problem.dates import Dates, list_dates, read_date
from switchfit.problem.priors import LogNormal, Normal, Prior, PriorTerms
from switchfit.problem.validation.arrays import as_array
from switchfit.problem.validation.messages import shorten
from switchfit.problem.validation.names import as_choice, as_name
from switchfit.problem.validation.objects import as_flag, set_fields

BOUNDS = ("lower", "upper")


@dataclass(frozen=True, eq=False)
class Parameter:
    """One unknown, scalar or array: its initial guess and what is known about it.

    Parameters
    ----------
    value : float or array_like
        Initial guess, or the value itself where `fixed`. Of a transition time or a free tf it may be a date, as in
        ``sf.Parameter("2020-03-23", lower="2020-03-16")``; its bounds, and the mean of a normal prior, are dates too.
    lower, upper : float or array_like, optional
        Bounds; broadcast to the shape of `value`.
    unit : str, optional
        For the report. That of a transition time is its experiment's `time_unit`.
    fixed : bool, optional
        A fixed parameter is not estimated.
    prior : Normal or LogNormal, optional
        What is known beforehand: it adds to the cost. Numbers of the prior are broadcast to the shape of `value`; that
        of a fixed parameter counts for nothing.
    scale : {"linear", "log"}, optional
        "log": the optimiser works in log p, and confidence intervals are made there, so that they are positive. All
        that is given and returned, bounds, priors, theta and covariance too, is p itself. Of a transition time or a
        free tf it is the logarithm of the time since t0.

    Raises
    ------
    ValueError
        If a value is not finite, bounds cross, the guess lies outside them, a prior does not fit, or the scale or the
        prior is logarithmic and p not confined to positive numbers.
    TypeError
        If a value or a bound is neither a number nor a date, `unit` not a string, or `fixed` neither True nor False.

    See Also
    --------
    Problem : takes it under `parameters`.
    Normal, LogNormal

    Examples
    --------
    >>> mu = sf.Parameter(0.8, lower=0.05, upper=2.0, unit="1")
    >>> rates = sf.Parameter([1e-3, 2.0], scale="log")
    >>> known = sf.Parameter(9.81, fixed=True)
    >>> mu.shape, rates.shape
    ((), (2,))
    """

    value: Converted  # an array of any shape, or `Dates` until an experiment has counted it; the bounds likewise
    lower: Converted = -np.inf
    upper: Converted = np.inf
    unit: str = ""
    fixed: bool = False
    prior: Prior | None = None
    scale: Literal["linear", "log"] = "linear"

    def __post_init__(self) -> None:
        scale = as_choice(self.scale, "Parameter scale", ("linear", "log"))
        unit = as_name(self.unit, "Parameter unit", empty=True)
        set_fields(self, unit=unit, fixed=as_flag(self.fixed, "Parameter fixed"), scale=scale)
        given = {name: read_date(getattr(self, name), f"Parameter {name}") for name in ("value", *BOUNDS)}
        if any(isinstance(each, Dates) for each in (*given.values(), getattr(self.prior, "mean", None))):
            # Dates have no numbers before an experiment has an origin; then `replace` comes here again, with numbers.
            set_fields(self, **given)  # an experiment makes numbers of them, and checks these
            return
        set_fields(self, **self._read_numbers(scale))
        self._check_prior()

    def _read_numbers(self, scale: str) -> dict[str, FloatArray]:
        """Return the value and the bounds, checked against one another."""
        value = as_array(self.value, "Parameter value", finite=True)
        lower, upper = (self._bound(name, value.shape) for name in BOUNDS)
        if value.size == 0:
            raise ValueError("Parameter value must have one entry or more; got none.")
        if not ((lower <= value).all() and (value <= upper).all()):
            bounds = f"[{shorten(self.lower)}, {shorten(self.upper)}]"
            if (lower > upper).any():
                raise ValueError(f"Parameter lower must not be above upper; got {bounds}.")
            raise ValueError(f"Parameter value {shorten(self.value)} lies outside its bounds {bounds}.")
        if scale == "log":
            # The logarithm has its own bound, 0; a bound that was given stays, to be checked.
            lower = np.where(np.isneginf(lower), 0.0, lower)
            if not (np.all(value > 0) and np.all(lower >= 0)):
                given = f"{shorten(self.value)} and the lower bound {shorten(self.lower)}"
                raise ValueError(f"Parameter with scale='log' must be positive; got {given}.")
        return {"value": value, "lower": lower, "upper": upper}

    def _bound(self, name: str, shape: tuple[int, ...]) -> FloatArray:
        """Return a bound with one entry for each of the value."""
        given = getattr(self, name)
        if type(given) is float and shape == ():  # of most transition times
            return np.array(given)
        bound = as_array(given, f"Parameter {name}")
        try:
            return np.broadcast_to(bound, shape).copy()
        except ValueError:
            raise ValueError(f"Parameter {name} must fit the value, of shape {shape}; got {shorten(bound)}.") from None

    def _check_prior(self) -> None:
        if self.prior is None:
            return
        if not isinstance(self.prior, (Normal, LogNormal)):
            raise TypeError(f"Parameter prior must be an sf.Normal or an sf.LogNormal; got {shorten(self.prior)}.")
        try:
            PriorTerms.of(self.prior, self.shape)
        except ValueError as error:
            raise ValueError(f"Parameter prior must fit the value, of shape {self.shape}; got {self.prior}.") from error
        if isinstance(self.prior, LogNormal) and not (self.positive or self.fixed):
            raise ValueError(
                "Parameter with a LogNormal prior needs a lower bound above 0, or scale='log'; got the lower bound "
                f"{shorten(self.lower)}."
            )

    @property
    def positive(self) -> bool:
        """Whether it can take positive values alone."""
        return self.scale == "log" or bool(np.all(self.lower > 0))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the parameter, () for a scalar."""
        return tuple(self.value.shape)


def require_time_unit(parameter: Parameter, what: str, time_unit: str) -> None:
    """Raise ValueError for a time with another unit than its experiment's."""
    if parameter.unit not in ("", time_unit):
        raise ValueError(
            f"{what} has the unit {parameter.unit!r}, but time_unit of its experiment is {time_unit!r}, and times are "
            "not converted. Give both in the same unit."
        )


def as_parameter(
    value: object, what: str, form: str = "a number, an array or an sf.Parameter", *, fixed: bool = False
) -> Parameter:
    """Return `value` itself if it is a `Parameter`, otherwise a free or fixed one without bounds.

    Errors call it `what`, and `form` what it has to be.
    """
    try:
        parameter = value if isinstance(value, Parameter) else Parameter(value, fixed=fixed)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{what} must be {form}: {error}") from error
    for _, date in list_dates(parameter if parameter is value else parameter.value):
        raise ValueError(f"{what} must be a number; got the date {date!r}. Only transition times and tf may be dates.")
    return parameter
