"""The keys of problem files: each table is a model of `pydantic`, each key a field.

The description of a field is used in error messages. ``docs/problem-file.md`` shows the format by example.
"""

from __future__ import annotations

import datetime
import math
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field
from pydantic_core import PydanticCustomError

OPTIONS = {"strategy", "time_budget", "hessian", "tolerance", "max_iterations"}
"""Options of `estimate`."""

HessianKind = Literal["auto", "exact", "descent-first", "block-diagonal", "gauss-newton", "none"]


class Table(pydantic.BaseModel):
    """A table of a problem file, without other keys than its fields."""

    model_config = pydantic.ConfigDict(extra="forbid", strict=True, frozen=True)


def _entry_as_list(given: Any) -> Any:
    """Return a list; a single entry becomes a list of one."""
    return given if isinstance(given, list) else [given]


def is_date(given: Any) -> bool:
    """Return whether a value is a date: one of TOML's own, or text in ISO 8601.

    Parameters
    ----------
    given : object
    """
    if not isinstance(given, (str, datetime.date)):
        return False
    from switchfit.problem.dates import as_dates  # here, since NumPy takes half of the time until a mistake is named

    try:
        as_dates(given, "the time")
    except ValueError:
        return False
    return True


def _check_time(given: Any) -> Any:
    """Return a number or a date."""
    if isinstance(given, (int, float)) and not isinstance(given, bool):
        return float(given)
    if is_date(given):
        return given
    raise PydanticCustomError("time_type", f"Input should be a number or a date such as {_find_examples()}")


def _check_date(given: Any) -> Any:
    """Return a date."""
    if is_date(given):
        return given
    raise PydanticCustomError("date_type", f"Input should be a date such as {_find_examples()}")


def _find_examples() -> str:
    from switchfit.problem.instants import EXAMPLES

    return EXAMPLES


Time = Annotated[Any, pydantic.PlainValidator(_check_time)]
"""A number in the experiment's time unit, or a date."""

Date = Annotated[Any, pydantic.PlainValidator(_check_date)]


def _wrap_time(given: Any) -> Any:
    """Return ``{ value = 5.0 }`` for ``5.0``, and for a date: the guess of a transition time."""
    return {"value": given} if is_date(given) else _wrap_number(given)


def _wrap_number(given: Any) -> Any:
    """Return ``{ value = 0.8 }`` for ``0.8``, the guess of an unknown."""
    return {"value": given} if isinstance(given, (int, float, list)) and not isinstance(given, bool) else given


def _wrap_known(given: Any) -> Any:
    """Return ``{ value = 0.5, fixed = true }`` for ``0.5``: a state at t0 given as a number is known."""
    return {"value": given, "fixed": True} if isinstance(given, (int, float)) and not isinstance(given, bool) else given


def _wrap_end(given: Any) -> Any:
    """Return ``{ value = 6.0, fixed = true }`` for ``6.0``: a tf given as a number is known."""
    if is_date(given):
        return {"value": given, "fixed": True}
    if given is not None and not isinstance(given, dict) and _wrap_known(given) is given:
        raise PydanticCustomError("float_type", "Input should be a valid number or a date")
    return _wrap_known(given)


def _wrap_name(given: Any) -> Any:
    """Return ``{ name = "skid_steer" }`` for ``"skid_steer"``, a model without arguments."""
    return {"name": given} if isinstance(given, str) else given


def _list_table(given: Any) -> Any:
    """Return a list of tables; a single table becomes a list of one."""
    return [given] if isinstance(given, dict) else given


def _drop_first(given: Any) -> Any:
    """Return None for ``"first"``, the time of the first row."""
    return None if given == "first" else given


def _list_repair(given: Any) -> Any:
    """Return a list of one for a single repair."""
    return [given] if isinstance(given, str) else given


class PriorTable(Table):
    """A prior: normal with mean and sd, or log-normal with median and log_sd."""

    mean: Time = Field(default=None, description="mean of a normal prior")
    sd: float | None = Field(default=None, description="standard deviation of a normal prior")
    median: float | None = Field(default=None, description="median of a log-normal prior")
    log_sd: float | None = Field(
        default=None, description="standard deviation of the logarithm, for a log-normal prior"
    )


class ParameterTable(Table):
    """A guess with bounds, unit and prior; a bare number is a guess without bounds."""

    value: float | list[float] = Field(description="first guess, or the value itself where fixed")
    lower: float = Field(default=-math.inf, description="lower bound")
    upper: float = Field(default=math.inf, description="upper bound")
    unit: str = Field(default="", description="unit, for the report")
    fixed: bool = Field(default=False, description="true if it is known and not to be estimated")
    prior: PriorTable | None = Field(
        default=None, description="what is known of it: { mean, sd } or { median, log_sd }"
    )
    scale: Literal["linear", "log"] = Field(default="linear", description="'log': estimated as its logarithm")


class TransitionTable(Table):
    """First guess of a transition time, or of tf, with bounds."""

    value: Time = Field(description="first guess of the transition time, in the experiment's time_unit, or a date")
    lower: Time = Field(default=-math.inf, description="earliest time")
    upper: Time = Field(default=math.inf, description="latest time")
    unit: str = Field(default="", description="left out or the same as the experiment's time_unit")
    fixed: bool = Field(default=False, description="true if the time is known and not to be estimated")
    prior: PriorTable | None = Field(
        default=None, description="what is known of it: { mean, sd } or { median, log_sd }"
    )
    scale: Literal["linear", "log"] = Field(
        default="linear", description="'log': estimated as the logarithm of the time since t0"
    )


class StateTable(Table):
    """An entry of the initial state: a guess, or a known value."""

    value: float = Field(description="first guess of the state at t0, or the value itself where fixed")
    lower: float = Field(default=-math.inf, description="lower bound")
    upper: float = Field(default=math.inf, description="upper bound")
    unit: str = Field(default="", description="unit, for the report; left out, that of the state")
    fixed: bool = Field(default=False, description="true if it is known and not to be estimated")
    prior: PriorTable | None = Field(
        default=None, description="what is known of it: { mean, sd } or { median, log_sd }"
    )
    scale: Literal["linear", "log"] = Field(default="linear", description="'log': estimated as its logarithm")


class LogTable(Table):
    """Channels of a log over time."""

    file: str | None = Field(
        default=None,
        description="the log, relative to the problem file; a pattern such as 'logs/*.csv' or a folder stands for one "
        "run a log; left out, a log given to switchfit fit --problem",
    )
    time: str | None = Field(default=None, description="name of the column with the time; left out, it is found")
    topic: str | None = Field(default=None, description="topic of a ROS bag, or struct of a .mat file")
    origin: Annotated[list[float], Field(min_length=2, max_length=3)] | None = Field(
        default=None,
        description="[latitude, longitude] or [latitude, longitude, altitude] of the origin of east, north and up; "
        "left out, the first position",
    )
    range_error: float | None = Field(
        default=None, gt=0, description="standard deviation of the distance to a satellite in m; HDOP times it is sigma"
    )
    epoch: Literal["s", "ms", "us", "ns"] | None = Field(
        default=None, description="the numbers in the time column count from 1970 (UTC) in this unit: they are dates"
    )
    window: Annotated[list[Time], Field(min_length=2, max_length=2)] | None = Field(
        default=None, description="[from, to]: only rows with the time column, or the date, in between are used"
    )
    time_offset: Annotated[float | None, pydantic.BeforeValidator(_drop_first)] = Field(
        default=0.0, description="subtracted from the time column; 'first': the time of the first row"
    )
    time_scale: float | None = Field(
        default=None, gt=0, description="then multiplied: 1e-3 turns ms into s; left out, 1"
    )
    repair: Annotated[list[str], pydantic.BeforeValidator(_list_repair)] = Field(
        default_factory=list,
        description="what may be changed: 'sort', 'drop-duplicates', 'drop-missing-times', 'drop-broken-lines', "
        "'unwrap:CHANNEL'",
    )


class DataTable(LogTable):
    """Data to which the model is fitted."""

    columns: list[str] = Field(min_length=1, description="names of the columns with the values")
    kind: Literal["measurements", "reference"] = Field(
        default="measurements", description="discrete noisy samples, or a continuous reference signal"
    )
    observe: str | list[str] | None = Field(
        default=None,
        description="the state that each column measures, by name, or 'file.py:function' with h(t, x, p); left out, "
        "the columns are the whole state",
    )
    sigma: float | str | list[float | str] | None = Field(
        default=None,
        description="standard deviation of the noise: a number, one per column, the names of columns that hold it, or "
        "of parameters that it is; left out, it is unknown (measurements only)",
    )
    loss: Literal["linear", "soft_l1", "huber", "cauchy"] = Field(
        default="linear", description="loss of the residuals, for outliers (measurements only)"
    )
    loss_scale: float = Field(default=1.0, gt=0, description="residual, in sigmas, above which it counts as an outlier")
    delay: float | str = Field(
        default=0.0,
        description="delay of the sensor, in the experiment's time_unit, or the name of the parameter that it is "
        "(measurements only)",
    )
    lowpass_hz: float | None = Field(
        default=None,
        gt=0,
        description="cut-off of a low-pass filter, in cycles per time_unit of the experiment: Hz if that is s "
        "(reference only)",
    )
    weights: list[float] | None = Field(default=None, description="weight of each column (reference only)")


class InputTable(LogTable):
    """A known input u(t); the modes are then functions f(t, x, p, u)."""

    columns: Annotated[
        Annotated[list[str], Field(min_length=1), pydantic.Tag("list")]
        | Annotated[dict[str, str], Field(min_length=1), pydantic.Tag("table")],
        pydantic.Discriminator(lambda given: "table" if isinstance(given, dict) else "list"),
    ] = Field(
        description="names of the columns with the values, or { name in the model = column }, with which u is a dict"
    )
    kind: Literal["hold", "linear", "cubic"] = Field(default="hold", description="interpolation between samples")


class ModelTable(Table):
    """The model: built in, or in a Python file."""

    name: str = Field(description="a built-in model, or 'file.py:object' with a HybridSystem or a function making one")
    arguments: dict[str, Any] = Field(default_factory=dict, description="arguments of the function")


class JumpTable(Table):
    """A change of the state at known times."""

    time: Annotated[list[Time], pydantic.BeforeValidator(_entry_as_list)] = Field(
        description="when, in the experiment's time_unit or as a date: one time, or several"
    )
    map: Annotated[ModelTable, pydantic.BeforeValidator(_wrap_name)] = Field(
        description="'file.py:function' with map(t, x, p), which returns the state just after; or a table with the "
        "name and arguments of a function that returns such a map"
    )


class ExperimentTable(Table):
    """One run."""

    mode_sequence: list[str] | None = Field(
        default=None,
        min_length=1,
        description="names of the modes in the order of their activity; left out, switchfit modes finds it, for which "
        "there must be [library]",
    )
    transition_times: list[Annotated[TransitionTable, pydantic.BeforeValidator(_wrap_time)]] | None = Field(
        default=None,
        description="first guess of each transition time, in time_unit or as a date, one fewer than modes; if left "
        "out, all of the log is searched",
    )
    time_unit: str = Field(
        default="s",
        min_length=1,
        description="unit of all times of the run; dates are converted to it, numbers are not",
    )
    origin: Date = Field(
        default=None, description="date at which times are 0; left out, t0 if it is a date, else the first date"
    )
    time_zone: str | None = Field(
        default=None,
        description="zone of the dates that state none, and in which dates are shown, such as 'Europe/Berlin'",
    )
    data: Annotated[list[DataTable], pydantic.BeforeValidator(_list_table)] = Field(
        min_length=1, description="data to which the model is fitted; the costs of several tables are added"
    )
    t0: Time = Field(default=None, description="start of the horizon, a number or a date; left out, the first sample")
    tf: Annotated[TransitionTable | None, pydantic.BeforeValidator(_wrap_end)] = Field(
        default=None,
        description="end of the horizon; left out, the last sample. A number or a date, or a table with value, lower "
        "and upper if it is to be estimated",
    )
    initial_state: list[Annotated[StateTable, pydantic.BeforeValidator(_wrap_known)]] | None = Field(
        default=None,
        description="state at t0, instead of the model's: a number, or a table if it is to be estimated",
    )
    parameter_map: dict[str, str] = Field(
        default_factory=dict,
        description="the model's name of a parameter = the name under [parameters] that this run uses for it",
    )
    inputs: InputTable | None = Field(default=None, description="a known input")
    jumps: Annotated[list[JumpTable], pydantic.BeforeValidator(_list_table)] = Field(
        default_factory=list, description="changes of the state at known times, such as doses"
    )
    name: str | None = Field(default=None, description="used in the report if there are several experiments")


Duration = Annotated[float, Field(ge=0)]

MinDuration = Annotated[
    Annotated[Duration, pydantic.Tag("number")] | Annotated[dict[str, Duration], pydantic.Tag("table")],
    pydantic.Discriminator(lambda given: "table" if isinstance(given, dict) else "number"),
]
"""One for all modes, or one for each; 0 for those that are left out."""

ModeNames = Annotated[list[str], pydantic.BeforeValidator(_list_repair)]
"""Names of modes; a single name becomes a list of one."""


class LibraryTable(Table):
    """The mode sequences among which ``switchfit modes`` searches."""

    modes: Annotated[list[str], Field(min_length=1)] | None = Field(
        default=None, description="names of the modes that may occur; left out, all of the model"
    )
    first: ModeNames | None = Field(
        default=None, description="mode or modes with which a sequence may begin; left out, any"
    )
    last: ModeNames | None = Field(
        default=None, description="mode or modes with which a sequence may end; left out, any"
    )
    min_duration: MinDuration | None = Field(
        default=None,
        description="shortest time a mode may last, or a table with a time for each mode; left out, that of [options]",
    )
    successions: dict[str, ModeNames] | None = Field(
        default=None,
        description="mode = the modes that may follow it; a mode that is left out is the last; left out, any may "
        "follow any",
    )


class OptionsTable(Table):
    """Options of the fit; options that are left out have the library's defaults."""

    min_duration: MinDuration | None = Field(
        default=None,
        description="shortest time a mode may last, in the time_unit of the experiments, or a table with a time for "
        "each mode",
    )
    solver: Literal["auto", "explicit", "stiff"] | None = Field(
        default=None, description="steps of the integrator; 'stiff' takes implicit ones, 'auto' where they are needed"
    )
    rtol: float | None = Field(default=None, gt=0, description="relative tolerance of the integrator")
    atol: float | None = Field(default=None, gt=0, description="absolute tolerance of the integrator")
    strategy: Literal["local", "auto", "thorough"] | None = Field(
        default=None, description="one fit, more if its verdict is not good, or all strategies"
    )
    time_budget: float | None = Field(default=None, gt=0, description="seconds after which strategies end")
    hessian: HessianKind | None = Field(default=None, description="quadratic term of the optimizer")
    tolerance: float | None = Field(default=None, gt=0, description="optimality at which to stop")
    max_iterations: int | None = Field(default=None, ge=0, description="most iterations")


class Contents(Table):
    """The whole file: a model with parameters and experiments, or a problem built in Python."""

    model: Annotated[ModelTable, pydantic.BeforeValidator(_wrap_name)] | None = Field(
        default=None, description="a built-in model, or 'file.py:object', or a table with name and arguments"
    )
    problem: str | None = Field(
        default=None,
        description="'file.py:object' with an sf.Problem or a function making one, instead of all the rest",
    )
    parameters: dict[str, Annotated[ParameterTable, pydantic.BeforeValidator(_wrap_number)]] = Field(
        default_factory=dict, description="the model's parameters"
    )
    experiments: Annotated[list[ExperimentTable], pydantic.BeforeValidator(_list_table)] = Field(
        default_factory=list, description="the runs"
    )
    library: LibraryTable | None = Field(
        default=None, description="the mode sequences among which switchfit modes searches; empty, all"
    )
    options: OptionsTable = Field(default_factory=OptionsTable, description="how to solve")
