"""Problem files: a model, its data, guesses and bounds, in TOML.

The `pydantic` models below define the format. Their fields are the keys; the description of a field is used in error
messages. ``docs/problem-file.md`` shows the format by example.
"""

from __future__ import annotations

import datetime
import difflib
import functools
import inspect
import os
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
import pydantic
from numpy.typing import NDArray
from pydantic import Field
from pydantic_core import PydanticCustomError

from switchfit.estimation.provenance import Provenance
from switchfit.io.logs.files import find_logs, name_logs
from switchfit.io.logs.log import Log
from switchfit.io.logs.reader import align_starts, read_source
from switchfit.io.logs.units import SECONDS, normalize_time_unit
from switchfit.io.python_file import call, describe_error, find_object, find_user_place, load_object
from switchfit.io.sources import describe_sources
from switchfit.models import BUILT_IN
from switchfit.problem.data import FloatArray, Input, Measurements, ReferenceSignal
from switchfit.problem.dates import EXAMPLES, Dates, as_dates, make_origin
from switchfit.problem.experiment import Experiment, Parameter
from switchfit.problem.jump import Jump
from switchfit.problem.priors import LogNormal, Normal, Prior
from switchfit.problem.problem import Problem
from switchfit.problem.system import HybridSystem
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import is_device
from switchfit.runtime.issue import Issue

OPTIONS = {"strategy", "time_budget", "hessian", "tolerance", "max_iterations"}
"""Options of `estimate`."""

HessianKind = Literal["auto", "exact", "descent-first", "block-diagonal", "gauss-newton", "none"]


@dataclass(frozen=True)
class ProblemFile:
    """Contents of a problem file.

    Attributes
    ----------
    path : Path
    problem : Problem
    options : dict
        Keyword arguments for `switchfit.estimate` that the file sets.
    provenance : Provenance
        The text of the file, and hashes of the files that it names: for `Estimate.save`.
    issues : tuple of Issue
        What is odd about the logs; of kind "log: refused" for those of many that could not be used.
    """

    path: Path
    problem: Problem
    options: dict[str, Any]
    provenance: Provenance
    issues: tuple[Issue, ...] = ()


class Runs(NamedTuple):
    """The experiments of a problem file, and what is odd about their logs.

    Attributes
    ----------
    experiments : tuple of Experiment
    issues : tuple of Issue
        As of a `ProblemFile`.
    """

    experiments: tuple[Experiment, ...]
    issues: tuple[Issue, ...]


def load_problem(path: str | Path, log: str | Path | None = None, *, text: str | None = None) -> ProblemFile:
    """Read a problem file, the data files it names, and the Python file of its model.

    Parameters
    ----------
    path : str or Path
        A TOML file. Paths in it are relative to its folder.
    log : str or Path, optional
        Instead of the file that the data of the only experiment name; inputs and further data from other files stay.
    text : str, optional
        Instead of what the problem file contains, which then need not be there.

    Returns
    -------
    ProblemFile

    Raises
    ------
    InputError
        For any error in the file or in the files that it names; the message has the file, the key, the value that was
        given, and what to do.
    """
    path = Path(path)
    text = _read(path) if text is None else text
    contents = _validate(path, _parse(path, text))
    if log is not None:
        contents = _replace_log(path, contents, os.path.abspath(log))
    options = contents.options.model_dump(include=OPTIONS, exclude_none=True)
    build = _build_from_tables if contents.problem is None else _load_from_python
    problem, issues = build(path, contents)
    provenance = describe_sources(path, text, log, contents.model_dump(exclude_none=True), options)
    return ProblemFile(path, problem, options, provenance, issues)


def read_experiments(path: str | Path) -> Runs:
    """Read a problem file and the data files it names, but do not run the Python file that it names.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Runs
        With data and horizon, but without observation functions; empty if the whole problem is built in Python.

    Raises
    ------
    InputError
        As in `load_problem`.
    """
    path = Path(path)
    contents = _validate(path, _parse(path, _read(path)))
    if contents.problem is not None:
        find_object(contents.problem, path.parent, f"{path}: problem")
        return Runs((), ())
    if contents.model is not None and contents.model.name not in BUILT_IN:
        _check_model_name(f"{path}: model", contents.model)
        find_object(contents.model.name, path.parent, f"{path}: model")
    for name, table in contents.parameters.items():
        _build_at(f"{path}: parameters.{name}", _build_parameter, table)
    return _build_experiments(path, contents, None)


# --- the format -------------------------------------------------------------------------------------------------------


class _Table(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", strict=True, frozen=True)


def _is_date(given: Any) -> bool:
    """Return whether a value is a date: one of TOML's own, or text in ISO 8601."""
    if not isinstance(given, (str, datetime.date)):
        return False
    try:
        as_dates(given, "the time")
    except ValueError:
        return False
    return True


def _check_time(given: Any) -> Any:
    """Return a number or a date."""
    if isinstance(given, (int, float)) and not isinstance(given, bool):
        return float(given)
    if _is_date(given):
        return given
    raise PydanticCustomError("time_type", f"Input should be a number or a date such as {EXAMPLES}")


def _check_date(given: Any) -> Any:
    """Return a date."""
    if _is_date(given):
        return given
    raise PydanticCustomError("date_type", f"Input should be a date such as {EXAMPLES}")


Time = Annotated[Any, pydantic.PlainValidator(_check_time)]
"""A number in the experiment's time unit, or a date."""

Date = Annotated[Any, pydantic.PlainValidator(_check_date)]


def _time_as_table(given: Any) -> Any:
    """Return ``{ value = 5.0 }`` for ``5.0``, and for a date: the guess of a transition time."""
    return {"value": given} if _is_date(given) else _number_as_table(given)


def _number_as_table(given: Any) -> Any:
    """Return ``{ value = 0.8 }`` for ``0.8``, the guess of an unknown."""
    return {"value": given} if isinstance(given, (int, float, list)) and not isinstance(given, bool) else given


def _known_as_table(given: Any) -> Any:
    """Return ``{ value = 0.5, fixed = true }`` for ``0.5``: a state at t0 given as a number is known."""
    return {"value": given, "fixed": True} if isinstance(given, (int, float)) and not isinstance(given, bool) else given


def _end_as_table(given: Any) -> Any:
    """Return ``{ value = 6.0, fixed = true }`` for ``6.0``: a tf given as a number is known."""
    if _is_date(given):
        return {"value": given, "fixed": True}
    if given is not None and not isinstance(given, dict) and _known_as_table(given) is given:
        raise PydanticCustomError("float_type", "Input should be a valid number or a date")
    return _known_as_table(given)


def _name_as_table(given: Any) -> Any:
    """Return ``{ name = "skid_steer" }`` for ``"skid_steer"``, a model without arguments."""
    return {"name": given} if isinstance(given, str) else given


def _table_as_list(given: Any) -> Any:
    """Return a list of tables; a single table becomes a list of one."""
    return [given] if isinstance(given, dict) else given


def _entry_as_list(given: Any) -> Any:
    """Return a list; a single entry becomes a list of one."""
    return given if isinstance(given, list) else [given]


def _first_as_none(given: Any) -> Any:
    """Return None for ``"first"``, the time of the first row."""
    return None if given == "first" else given


def _repair_as_list(given: Any) -> Any:
    """Return a list of one for a single repair."""
    return [given] if isinstance(given, str) else given


class PriorTable(_Table):
    """A prior: normal with mean and sd, or log-normal with median and log_sd."""

    mean: Time = Field(default=None, description="mean of a normal prior")
    sd: float | None = Field(default=None, description="standard deviation of a normal prior")
    median: float | None = Field(default=None, description="median of a log-normal prior")
    log_sd: float | None = Field(
        default=None, description="standard deviation of the logarithm, for a log-normal prior"
    )


class ParameterTable(_Table):
    """A guess with bounds, unit and prior; a bare number is a guess without bounds."""

    value: float | list[float] = Field(description="first guess, or the value itself where fixed")
    lower: float = Field(default=-np.inf, description="lower bound")
    upper: float = Field(default=np.inf, description="upper bound")
    unit: str = Field(default="", description="unit, for the report")
    fixed: bool = Field(default=False, description="true if it is known and not to be estimated")
    prior: PriorTable | None = Field(
        default=None, description="what is known of it: { mean, sd } or { median, log_sd }"
    )
    scale: Literal["linear", "log"] = Field(default="linear", description="'log': estimated as its logarithm")


class TransitionTable(_Table):
    """First guess of a transition time, or of tf, with bounds."""

    value: Time = Field(description="first guess of the transition time, in the experiment's time_unit, or a date")
    lower: Time = Field(default=-np.inf, description="earliest time")
    upper: Time = Field(default=np.inf, description="latest time")
    unit: str = Field(default="", description="left out or the same as the experiment's time_unit")
    fixed: bool = Field(default=False, description="true if the time is known and not to be estimated")
    prior: PriorTable | None = Field(
        default=None, description="what is known of it: { mean, sd } or { median, log_sd }"
    )
    scale: Literal["linear", "log"] = Field(
        default="linear", description="'log': estimated as the logarithm of the time since t0"
    )


class StateTable(_Table):
    """An entry of the initial state: a guess, or a known value."""

    value: float = Field(description="first guess of the state at t0, or the value itself where fixed")
    lower: float = Field(default=-np.inf, description="lower bound")
    upper: float = Field(default=np.inf, description="upper bound")
    unit: str = Field(default="", description="unit, for the report; left out, that of the state")
    fixed: bool = Field(default=False, description="true if it is known and not to be estimated")
    prior: PriorTable | None = Field(
        default=None, description="what is known of it: { mean, sd } or { median, log_sd }"
    )
    scale: Literal["linear", "log"] = Field(default="linear", description="'log': estimated as its logarithm")


class LogTable(_Table):
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
    time_offset: Annotated[float | None, pydantic.BeforeValidator(_first_as_none)] = Field(
        default=0.0, description="subtracted from the time column; 'first': the time of the first row"
    )
    time_scale: float | None = Field(
        default=None, gt=0, description="then multiplied: 1e-3 turns ms into s; left out, 1"
    )
    repair: Annotated[list[str], pydantic.BeforeValidator(_repair_as_list)] = Field(
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


class ModelTable(_Table):
    """The model: built in, or in a Python file."""

    name: str = Field(description="a built-in model, or 'file.py:object' with a HybridSystem or a function making one")
    arguments: dict[str, Any] = Field(default_factory=dict, description="arguments of the function")


class JumpTable(_Table):
    """A change of the state at known times."""

    time: Annotated[list[Time], pydantic.BeforeValidator(_entry_as_list)] = Field(
        description="when, in the experiment's time_unit or as a date: one time, or several"
    )
    map: Annotated[ModelTable, pydantic.BeforeValidator(_name_as_table)] = Field(
        description="'file.py:function' with map(t, x, p), which returns the state just after; or a table with the "
        "name and arguments of a function that returns such a map"
    )


class ExperimentTable(_Table):
    """One run."""

    mode_sequence: list[str] = Field(min_length=1, description="names of the modes in the order of their activity")
    transition_times: list[Annotated[TransitionTable, pydantic.BeforeValidator(_time_as_table)]] | None = Field(
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
    data: Annotated[list[DataTable], pydantic.BeforeValidator(_table_as_list)] = Field(
        min_length=1, description="data to which the model is fitted; the costs of several tables are added"
    )
    t0: Time = Field(default=None, description="start of the horizon, a number or a date; left out, the first sample")
    tf: Annotated[TransitionTable | None, pydantic.BeforeValidator(_end_as_table)] = Field(
        default=None,
        description="end of the horizon; left out, the last sample. A number or a date, or a table with value, lower "
        "and upper if it is to be estimated",
    )
    initial_state: list[Annotated[StateTable, pydantic.BeforeValidator(_known_as_table)]] | None = Field(
        default=None,
        description="state at t0, instead of the model's: a number, or a table if it is to be estimated",
    )
    parameter_map: dict[str, str] = Field(
        default_factory=dict,
        description="the model's name of a parameter = the name under [parameters] that this run uses for it",
    )
    inputs: InputTable | None = Field(default=None, description="a known input")
    jumps: Annotated[list[JumpTable], pydantic.BeforeValidator(_table_as_list)] = Field(
        default_factory=list, description="changes of the state at known times, such as doses"
    )
    name: str | None = Field(default=None, description="used in the report if there are several experiments")


class OptionsTable(_Table):
    """Options of the fit; options that are left out have the library's defaults."""

    min_duration: float | None = Field(
        default=None, ge=0, description="shortest time a mode may last, in the time_unit of the experiments"
    )
    solver: Literal["auto", "explicit", "stiff"] | None = Field(
        default=None, description="steps of the integrator; 'stiff' takes implicit ones, 'auto' where they are needed"
    )
    rtol: float | None = Field(default=None, gt=0, description="relative tolerance of the integrator")
    atol: float | None = Field(default=None, gt=0, description="absolute tolerance of the integrator")
    strategy: Literal["local", "auto", "thorough"] | None = Field(
        default=None, description="one fit, more if its verdict is not good, or all strategies"
    )
    time_budget: float | None = Field(default=None, gt=0, description="seconds after which no further strategy begins")
    hessian: HessianKind | None = Field(default=None, description="quadratic term of the optimizer")
    tolerance: float | None = Field(default=None, gt=0, description="optimality at which to stop")
    max_iterations: int | None = Field(default=None, ge=0, description="most iterations")


class Contents(_Table):
    """The whole file: a model with parameters and experiments, or a problem built in Python."""

    model: Annotated[ModelTable, pydantic.BeforeValidator(_name_as_table)] | None = Field(
        default=None, description="a built-in model, or 'file.py:object', or a table with name and arguments"
    )
    problem: str | None = Field(
        default=None,
        description="'file.py:object' with an sf.Problem or a function making one, instead of all the rest",
    )
    parameters: dict[str, Annotated[ParameterTable, pydantic.BeforeValidator(_number_as_table)]] = Field(
        default_factory=dict, description="the model's parameters"
    )
    experiments: Annotated[list[ExperimentTable], pydantic.BeforeValidator(_table_as_list)] = Field(
        default_factory=list, description="the runs"
    )
    options: OptionsTable = Field(default_factory=OptionsTable, description="how to solve")


# --- from text to checked tables --------------------------------------------------------------------------------------


def _read(path: Path) -> str:
    if is_device(path):
        raise InputError(f"{path} is a device; name a problem file.")
    try:
        return path.read_bytes().decode()
    except FileNotFoundError:
        raise InputError(f"There is no problem file {path}; check the name and the folder.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not valid TOML: {error}.") from error


def _parse(path: Path, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{path} is not valid TOML: brackets are nested too deep.") from error
    except ValueError as error:  # invalid TOML, or a number with thousands of digits
        raise InputError(f"{path} is not valid TOML: {error}.") from error


def _validate(path: Path, given: dict[str, Any]) -> Contents:
    try:
        contents = Contents.model_validate(given)
    except pydantic.ValidationError as error:
        raise InputError(f"{path}: {_describe_error(error)}") from error
    if contents.problem is not None:
        others = [key for key in ("model", "parameters", "experiments") if key in given]
        if others:
            raise InputError(f"{path}: 'problem' replaces everything but options; leave out {' and '.join(others)}.")
    elif contents.model is None:
        raise InputError(f"{path}: the key 'model' is missing; name one of {', '.join(BUILT_IN)} or 'file.py:object'.")
    elif not contents.experiments:
        raise InputError(f"{path}: [[experiments]] is missing; give at least one.")
    return contents


def _describe_error(error: pydantic.ValidationError) -> str:
    """Return the first error as a sentence."""
    errors = sorted(error.errors(include_url=False), key=lambda e: e["type"] != "extra_forbidden")
    first = errors[0]
    table, steps = _follow_location(first["loc"])
    key = _join_steps(steps)
    if first["type"] == "extra_forbidden":
        known = list(table.model_fields) if table else []
        close = difflib.get_close_matches(str(steps[-1]), known, n=1)
        remedy = f"did you mean {close[0]!r}?" if close else f"known here are {', '.join(known)}."
        sentence = f"unknown key {key}; {remedy}"
    elif first["type"] == "missing":
        sentence = f"the key {key} is missing: {_get_description(table, steps)}."
    else:
        sentence = f"{key} {_rephrase(first)}; got {_shorten(first['input'])} ({_get_description(table, steps)})."
    different = {_join_steps(_follow_location(e["loc"])[1]) for e in errors} - {key}
    return sentence + (f" Also wrong: {', '.join(sorted(different))}." if different else "")


def _follow_location(location: Sequence[str | int]) -> tuple[type[_Table] | None, list[str | int]]:
    """Return the table that holds the key at a location, and the location without pydantic's names for unions."""
    table: type[_Table] | None = Contents
    holder = table
    steps: list[str | int] = []
    for step in location:
        if table is not None and isinstance(step, str) and (step in table.model_fields or step == location[-1]):
            holder = table
            steps.append(step)
            annotation = table.model_fields[step].annotation if step in table.model_fields else None
            table = _find_table(annotation)
            if table is ParameterTable:  # a dict of tables: the next step is a name the user chose
                table = _ParameterNames
        elif table is _ParameterNames:
            steps.append(step)
            holder = table = ParameterTable
        elif isinstance(step, int):
            steps.append(step)
    return holder, steps


class _ParameterNames(_Table):
    """Placeholder for [parameters], whose keys are chosen by the user."""


def _find_table(annotation: Any) -> type[_Table] | None:
    if inspect.isclass(annotation) and issubclass(annotation, _Table):
        return annotation
    return next((found for part in get_args(annotation) if (found := _find_table(part)) is not None), None)


def _join_steps(steps: Sequence[str | int]) -> str:
    """Return ``'experiments[1].data[2].file'``, counted from 1."""
    text = ""
    for step in steps:
        text += f"[{step + 1}]" if isinstance(step, int) else f".{step}" if text else step
    return repr(text)


def _get_description(table: type[_Table] | None, steps: Sequence[str | int]) -> str:
    names = [step for step in steps if isinstance(step, str)]
    known = table.model_fields.get(names[-1]) if table and names else None
    return (known.description if known else None) or "a parameter is a number, a list of numbers or a table"


def _rephrase(error: Any) -> str:
    """Return pydantic's message as the end of a sentence: 'Input should be a valid number' -> 'must be a number'."""
    if error["type"] in ("too_short", "too_long"):
        bound, size = next((k, v) for k, v in error["ctx"].items() if k in ("min_length", "max_length"))
        return f"must have at {'least' if bound == 'min_length' else 'most'} {size} entries"
    message = error["msg"][:1].lower() + error["msg"][1:]
    for old, new in (("input should be", "must be"), ("a valid ", "a "), ("dictionary", "table"), (" or instance", "")):
        message = message.replace(old, new)
    return re.sub(r" of \w+Table$", "", message)


def _shorten(given: Any) -> str:
    text = repr(given)
    return text if len(text) <= 60 else f"{text[:57]}..."


# --- from tables to a problem -----------------------------------------------------------------------------------------


def _load_from_python(path: Path, contents: Contents) -> tuple[Problem, tuple[Issue, ...]]:
    given = contents.options.model_dump(include={"min_duration", "solver", "rtol", "atol"}, exclude_none=True)
    if given:
        raise InputError(f"{path}: with 'problem', {', '.join(given)} is set where the sf.Problem is built, not here.")
    reference = contents.problem or ""
    found = load_object(reference, path.parent, f"{path}: problem")
    if callable(found):
        found = call(found, f"{path}: problem {reference!r}")
    if not isinstance(found, Problem):
        raise InputError(
            f"{path}: problem {reference!r} must be an sf.Problem or a function that returns one; "
            f"got {type(found).__name__}."
        )
    return found, ()


def _build_from_tables(path: Path, contents: Contents) -> tuple[Problem, tuple[Issue, ...]]:
    system = _build_system(path, contents.model or ModelTable(name=""))
    runs = _build_experiments(path, contents, system)
    parameters = {
        name: _build_at(f"{path}: parameters.{name}", _build_parameter, table)
        for name, table in contents.parameters.items()
    }
    options = contents.options.model_dump(include={"min_duration", "solver", "rtol", "atol"}, exclude_none=True)
    return _build_at(f"{path}", Problem, system, runs.experiments, parameters, **options), runs.issues


def _build_experiments(path: Path, contents: Contents, system: HybridSystem | None) -> Runs:
    """Return the experiments, one for each log that a pattern stands for; without a system they observe nothing."""
    experiments: list[Experiment] = []
    issues: dict[str, Issue] = {}
    for k, given in enumerate(contents.experiments, start=1):
        where = f"{path}: experiments[{k}]"
        known = frozenset(contents.parameters) | frozenset(given.parameter_map)
        tables = _build_at(where, _expand_patterns, path.parent, given)
        refused: list[ValueError] = []
        for table in tables:
            try:
                logs = _open_logs(path.parent, table, where, known)
                issues |= {str(issue): issue for log in logs for issue in log.issues}
                arguments = (path.parent, table, logs, system, where, known)
                experiments.append(_build_at(where, _build_experiment, *arguments))
            except ValueError as error:
                refused.append(error)
        if len(refused) == len(tables):
            raise refused[0]
        issues |= {str(error): Issue("log: refused", (str(error),)) for error in refused}
    return Runs(tuple(experiments), tuple(issues.values()))


def _expand_patterns(folder: Path, table: ExperimentTable) -> list[ExperimentTable]:
    """Return an experiment for each log that patterns and folders in it stand for; logs of one name go together."""
    given = {item.file for item in _list_log_tables(table) if item.file is not None}
    found = {pattern: find_logs(folder, pattern) for pattern in sorted(given)}
    named = {pattern: dict(zip(name_logs(logs), logs, strict=True)) for pattern, logs in found.items() if logs}
    if not named:
        return [table]
    names = set.union(*(set(logs) for logs in named.values()))
    for pattern, logs in named.items():
        if missing := sorted(names - set(logs)):
            raise ValueError(f"{folder / pattern} has no log {missing[0]!r}, which another pattern of the run has.")
    prefix = "" if table.name is None else f"{table.name} "
    return [
        _replace_files(table, {pattern: logs[name] for pattern, logs in named.items()}, f"{prefix}{name}")
        for name in sorted(names)
    ]


def _list_log_tables(table: ExperimentTable) -> list[LogTable]:
    return [*table.data, *([] if table.inputs is None else [table.inputs])]


def _replace_files(table: ExperimentTable, files: Mapping[str | None, str], name: str | None) -> ExperimentTable:
    """Return an experiment with other files in place of some."""

    def replace(item: Any) -> Any:
        return item.model_copy(update={"file": files.get(item.file, item.file)})

    inputs = None if table.inputs is None else replace(table.inputs)
    return table.model_copy(update={"data": [replace(item) for item in table.data], "inputs": inputs, "name": name})


def _replace_log(path: Path, contents: Contents, log: str) -> Contents:
    """Return the contents with a log in place of the files that are left out; if none is, of the data's first file."""
    if len(contents.experiments) != 1:
        raise InputError(f"{path} must have one [[experiments]] to be fitted to logs; got {len(contents.experiments)}.")
    (table,) = contents.experiments
    left_out = any(item.file is None for item in _list_log_tables(table))
    files = {None if left_out else table.data[0].file: log}
    return contents.model_copy(update={"experiments": [_replace_files(table, files, table.name)]})


def _build_at(where: str, build: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Build something; add the place in the problem file to its error messages."""
    try:
        return build(*arguments, **named)
    except (InputError, KeyboardInterrupt):
        raise
    except BaseException as error:
        if find_user_place(error) is not None:
            raise InputError(f"{where}: {describe_error(error)}.") from error
        if isinstance(error, (ValueError, TypeError)):
            raise InputError(f"{where}: {error}") from error
        raise


def _build_system(path: Path, table: ModelTable) -> HybridSystem:
    what = f"{path}: model"
    if table.name in BUILT_IN:
        found = BUILT_IN[table.name]
    else:
        _check_model_name(what, table)
        found = load_object(table.name, path.parent, what)
    if callable(found):
        found = call(found, f"{what} {table.name!r}", **_check_arguments(found, table, what))
    elif table.arguments:
        raise InputError(f"{what} {table.name!r} is not a function; leave out its arguments.")
    if not isinstance(found, HybridSystem):
        raise InputError(
            f"{what} {table.name!r} must be an sf.HybridSystem or a function that returns one; "
            f"got {type(found).__name__}."
        )
    return found


def _check_model_name(what: str, table: ModelTable) -> None:
    if ".py" not in table.name:
        raise InputError(
            f"{what} {table.name!r} is not known; the built-in models are {', '.join(BUILT_IN)}. Give a model of your "
            "own as 'file.py:object'."
        )


def _check_arguments(factory: Callable[..., Any], table: ModelTable, what: str) -> dict[str, Any]:
    """Return the arguments of a table; raise if the factory does not take them."""
    try:
        inspect.signature(factory).bind(**table.arguments)
    except TypeError as error:
        takes = ", ".join(inspect.signature(factory).parameters) or "no arguments"
        raise InputError(f"{what} {table.name!r}: {error}; it takes {takes}.") from error
    return table.arguments


def _build_parameter(table: ParameterTable | TransitionTable | StateTable, **more: Any) -> Parameter:
    """Return the unknown that a table describes."""
    given = table.model_dump(exclude={"prior"})
    return Parameter(**given, prior=None if table.prior is None else _build_prior(table.prior), **more)


def _build_prior(table: PriorTable) -> Prior:
    given = table.model_dump(exclude_none=True)
    if set(given) == {"mean", "sd"}:
        return Normal(**given)
    if set(given) == {"median", "log_sd"}:
        return LogNormal(**given)
    raise ValueError(f"prior needs mean and sd (normal), or median and log_sd (log-normal); got {given}.")


def _build_experiment(
    folder: Path,
    table: ExperimentTable,
    logs: Sequence[Log],
    system: HybridSystem | None,
    where: str,
    parameters: frozenset[str],
) -> Experiment:
    places = [f"{where}.data[{k}]" for k in range(1, len(table.data) + 1)]
    data = [
        _build_at(place, _build_data, folder, item, log, system, place, parameters, table)
        for place, item, log in zip(places, table.data, logs, strict=False)  # that of the inputs comes after them
    ]
    times = table.transition_times
    return Experiment(
        data=data,
        mode_sequence=tuple(table.mode_sequence),
        transition_times=None if times is None else tuple(map(_build_parameter, times)),
        t0=table.t0,
        tf=None if table.tf is None else _build_parameter(table.tf),  # type: ignore[arg-type]
        inputs=None
        if table.inputs is None
        else _build_at(f"{where}.inputs", _build_input, table.inputs, logs[-1], table),
        initial_state=_build_initial_state(table),
        parameter_map=table.parameter_map,
        name=table.name,
        time_unit=table.time_unit,
        jumps=[
            _build_at(f"{where}.jumps[{k}]", _build_jump, folder, item, system, f"{where}.jumps[{k}].map")
            for k, item in enumerate(table.jumps, start=1)
        ],
        origin=_find_origin(table, logs),
        time_zone=table.time_zone,
    )


def _build_jump(folder: Path, table: JumpTable, system: HybridSystem | None, where: str) -> Jump:
    """Return a jump; without a system, one whose map was not loaded."""
    if ".py" not in table.map.name:
        raise ValueError(f"map must name a function of a Python file, 'file.py:function'; got {table.map.name!r}.")
    if system is None:
        find_object(table.map.name, folder, where)
        return Jump(table.time, lambda t, x, p: x)
    found = load_object(table.map.name, folder, where)
    if table.map.arguments and callable(found):
        found = call(found, f"{where} {table.map.name!r}", **_check_arguments(found, table.map, where))
    return Jump(table.time, found)


def _find_origin(table: ExperimentTable, logs: Sequence[Log]) -> Any:
    """Return the date at which times are 0: as stated, else t0, else the beginning of the earliest log with dates."""
    if table.origin is not None or _is_date(table.t0):
        return table.origin
    dated = [log for item, log in zip(_list_log_tables(table), logs, strict=True) if _keep_dates(item, log, table)]
    zones = {log.time_zone for log in dated}
    if not dated or ("" in zones and len(zones) > 1 and table.time_zone is None):
        return None  # the experiment says which dates have zones and which have none
    zone = table.time_zone or (zones.pop() if len(zones) == 1 else "UTC")
    starts = [
        as_dates(log.start if log.time_zone else log.start.replace(tzinfo=None), "origin") for log in dated if log.start
    ]
    return make_origin(min(int((start.localize(zone, "origin") if zone else start).instants) for start in starts), zone)


def _keep_dates(item: LogTable, log: Log, run: ExperimentTable) -> bool:
    """Return whether the times of a log are handed over as dates.

    Those that are written as dates are, unless time_offset or time_scale makes numbers of them; the stamps of a
    recorder, and numbers since 1970, only if the file says that they are dates, or gives a date to compare them with.
    """
    if not log.offset:
        return False
    stated = item.epoch is not None or run.origin is not None or run.time_zone is not None or _has_dates(run)
    if item.time_offset == 0.0 and item.time_scale is None:
        return log.has_dates or stated
    if stated:
        raise ValueError(
            f"{log.source} has dates, which are converted to time_unit by themselves: leave out time_offset and "
            "time_scale."
        )
    return False


def _has_dates(run: ExperimentTable) -> bool:
    """Return whether a time of an experiment is given as a date."""
    tables = [*(run.transition_times or ()), *([] if run.tf is None else [run.tf])]
    times = [run.t0, *(time for table in tables for time in (table.value, table.lower, table.upper))]
    times += [time for jump in run.jumps for time in jump.time]
    return any(map(_is_date, times))


def _build_initial_state(table: ExperimentTable) -> list[Parameter] | list[float] | None:
    """Return the state at t0 for an Experiment: numbers if all of it is known."""
    if table.initial_state is None:
        return None
    if all(entry.fixed for entry in table.initial_state):
        return [entry.value for entry in table.initial_state]
    return [_build_parameter(entry) for entry in table.initial_state]


def _build_data(
    folder: Path,
    table: DataTable,
    log: Log,
    system: HybridSystem | None,
    where: str,
    parameters: frozenset[str],
    run: ExperimentTable,
) -> Measurements | ReferenceSignal:
    observe = _build_observe(folder, table, system, where)
    names = tuple(table.observe) if isinstance(table.observe, list) else tuple(table.columns)
    if table.kind == "reference":
        if table.sigma is not None:
            raise ValueError("sigma belongs to kind = 'measurements'; a reference has weights.")
        for key, default in (("loss", "linear"), ("delay", 0.0)):
            if getattr(table, key) != default:
                raise ValueError(f"{key} belongs to kind = 'measurements', not to a reference.")
        times, values, units = _cut_log(log, table, table.columns, run, "ReferenceSignal")
        return ReferenceSignal.from_samples(
            times, values, observe=observe, lowpass_hz=table.lowpass_hz, weights=table.weights, names=names, units=units
        )
    for key in ("lowpass_hz", "weights"):
        if getattr(table, key) is not None:
            raise ValueError(f"{key} belongs to kind = 'reference'; measurements have sigma.")
    sigma_columns = _find_sigma_columns(table, parameters)
    times, values, units = _cut_log(log, table, [*table.columns, *sigma_columns], run, "Measurements")
    q = len(table.columns)
    sigma = values[:, q:] if sigma_columns else table.sigma
    return Measurements(
        times,
        values[:, :q],
        observe=observe,
        sigma=sigma,
        names=names,
        loss=table.loss,
        loss_scale=table.loss_scale,
        delay=table.delay,
        units=units[:q],
    )


def _find_sigma_columns(table: DataTable, parameters: frozenset[str]) -> list[str]:
    """Return the columns that hold sigma; an empty list if it is numbers, or names of parameters."""
    given = table.sigma if isinstance(table.sigma, list) else []
    named = [entry for entry in given if isinstance(entry, str)]
    if not named or all(name in parameters for name in named):
        return []
    if len(named) < len(given) or any(name in parameters for name in named):
        raise ValueError(
            f"sigma must name columns of the file alone, or parameters and numbers; got {table.sigma}, and the "
            f"parameters are {', '.join(sorted(parameters)) or 'none'}."
        )
    return named


def _build_input(table: InputTable, log: Log, run: ExperimentTable) -> Input:
    if isinstance(table.columns, dict):
        times, values, units = _cut_log(log, table, list(table.columns.values()), run, "Input")
        named = dict(zip(table.columns, values.T, strict=True))
        ordered = tuple(unit for _, unit in sorted(zip(table.columns, units, strict=True)))
        return Input(times, named, kind=table.kind, units=ordered)
    times, values, units = _cut_log(log, table, table.columns, run, "Input")
    return Input(times, values[:, 0] if len(table.columns) == 1 else values, kind=table.kind, units=units)


def _cut_log(
    log: Log, table: LogTable, columns: Sequence[str], run: ExperimentTable, what: str
) -> tuple[FloatArray | Dates, FloatArray, tuple[str, ...]]:
    """Return times (K,), which may be dates, and the values of some columns (K, q) in the rows inside the window, and
    their units.

    `what` is made from them, for messages.
    """
    times, inside = log.times, np.ones(len(log), dtype=bool)
    if table.window is not None:
        (first, last), axis = _place_window(log, table, run)
        inside = (axis >= first) & (axis <= last)
        if not inside.any():
            shown = log.dates if any(map(_is_date, table.window)) else None
            least, most = (axis.min(), axis.max()) if shown is None else (repr(shown[0]), repr(shown[-1]))
            raise InputError(
                f"{log.source}: no time in column {log.time_name!r} lies in the window [{table.window[0]}, "
                f"{table.window[1]}]; they reach from {least} to {most}."
            )
    times = times[inside]
    _check_order(log, times, log.rows[inside], what)
    offset = times[0] if table.time_offset is None else table.time_offset
    values = np.stack([log[name][inside] for name in columns], axis=1)
    units = tuple(log.units[log.find_channel(name)] for name in columns)
    if log.dates is not None and _keep_dates(table, log, run):
        return log.dates[inside], values, units
    return (times - offset) * _find_time_scale(log, table, run.time_unit), values, units


def _place_window(log: Log, table: LogTable, run: ExperimentTable) -> tuple[list[float], FloatArray]:
    """Return the ends of the window, and the times of a log (K,), both as numbers with one origin and one unit."""
    ends = table.window or []
    dated = list(map(_is_date, ends))
    if not any(dated):
        return list(ends), log.times + log.offset if table.epoch is not None else log.times
    if not all(dated) or log.dates is None:
        other = "numbers" if log.dates is None else "dates, of which the window has one"
        raise ValueError(f"window = [{ends[0]}, {ends[1]}] has dates, and {log.source} has {other}. Give both alike.")
    zone = run.time_zone or log.time_zone
    origin = make_origin(int(log.dates.instants[0]), log.time_zone) if not zone else None
    if origin is None:
        origin = make_origin(int(log.dates.localize(zone, log.source).instants[0]), zone)
    limits = [float(origin.to_numbers(as_dates(end, "window"), "s", "window")) for end in ends]
    return limits, origin.to_numbers(log.dates, "s", log.source)


def _open_logs(folder: Path, table: ExperimentTable, where: str, parameters: frozenset[str]) -> list[Log]:
    """Return the logs of data and inputs, in this order; the times of those with dates begin together."""
    logs = [
        _build_at(f"{where}.data[{k}]", _open_data, folder, item, parameters)
        for k, item in enumerate(table.data, start=1)
    ]
    if table.inputs is not None:
        logs.append(_build_at(f"{where}.inputs", _open_input, folder, table.inputs))
    return align_starts(logs)


def _open_data(folder: Path, table: DataTable, parameters: frozenset[str]) -> Log:
    return _open_log(folder, table, [*table.columns, *_find_sigma_columns(table, parameters)])


def _open_input(folder: Path, table: InputTable) -> Log:
    return _open_log(folder, table, list(table.columns.values() if isinstance(table.columns, dict) else table.columns))


def _open_log(folder: Path, table: LogTable, columns: Sequence[str]) -> Log:
    if table.file is None:
        raise ValueError("the key 'file' is missing: name the log, or give logs: switchfit fit LOG ... --problem FILE.")
    log = read_source(
        folder / table.file,
        columns=list(dict.fromkeys(columns)),
        time=table.time,
        topic=table.topic,
        origin=table.origin,
        range_error=table.range_error,
        repair=table.repair,
        keep_epoch=True,
    )
    return log if table.epoch is None else _count_from_1970(log, table.epoch)


def _count_from_1970(log: Log, unit: str) -> Log:
    """Return a log whose times are numbers since 1970 as one with dates."""
    if log.offset:
        raise ValueError(f"{log.source} has dates already: leave out epoch = {unit!r}.")
    if log.time_unit not in ("", unit):
        raise ValueError(f"{log.source}: the times are in {log.time_unit}, but epoch is {unit!r}.")
    first = float(log.times[0])
    if not first > 0:
        raise ValueError(f"{log.source}: epoch = {unit!r} needs numbers that count from 1970; the first is {first:g}.")
    return replace(log, times=log.times - first, offset=first, time_unit=unit, time_zone="UTC")


def _check_order(log: Log, times: FloatArray, rows: NDArray[np.intp], what: str) -> None:
    """Raise for times that do not increase, with the line; a reference may have a time twice."""
    steps = np.diff(times)
    wrong = (steps < 0) if what == "ReferenceSignal" else (steps <= 0)
    if wrong.any():
        k = int(wrong.argmax()) + 1
        repair = "sort" if steps[k - 1] < 0 else "drop-duplicates"
        raise ValueError(
            f"{what} times must increase strictly; in {log.source}, {log.place} {rows[k]}, {times[k]} follows "
            f"{times[k - 1]}. repair = [{repair!r}] mends that, if the log is otherwise right."
        )


def _find_time_scale(log: Log, table: LogTable, time_unit: str) -> float:
    """Return what times are multiplied by; raise if the log states another unit than the experiment."""
    unit = normalize_time_unit(time_unit)
    if table.time_scale is not None or log.time_unit in ("", unit) or unit not in SECONDS:
        return 1.0 if table.time_scale is None else table.time_scale
    scale = SECONDS[log.time_unit] / SECONDS[unit]
    raise InputError(
        f"{log.source}: the times are in {log.time_unit}, but time_unit of the experiment is {time_unit!r}. Set "
        f"time_scale = {scale:.12g} to convert them, or time_unit = {log.time_unit!r}; time_scale = 1 leaves them as "
        "they are."
    )


def _build_observe(
    folder: Path, table: DataTable, system: HybridSystem | None, where: str
) -> Callable[..., Any] | None:
    """Return the observation h(t, x, p); None for the whole state, or without a system."""
    if table.observe is None:
        return None
    if isinstance(table.observe, str):
        if system is None:
            find_object(table.observe, folder, f"{where}.observe")
            return None
        observe = load_object(table.observe, folder, f"{where}.observe")
        if not callable(observe):
            raise ValueError(f"observe {table.observe!r} must be a function h(t, x, p); got {type(observe).__name__}.")
        return observe
    if len(table.observe) != len(table.columns):
        raise ValueError(
            f"observe must name one state for each of the {len(table.columns)} columns; got {table.observe}."
        )
    if system is None:
        return None
    if system.state_names is None:
        raise ValueError("observe names states, but the model has no state_names; add them to it.")
    unknown = [name for name in table.observe if name not in system.state_names]
    if unknown:
        raise ValueError(
            f"observe names the unknown state {unknown[0]!r}; the states are {', '.join(system.state_names)}."
        )
    return select_states(tuple(system.state_names.index(name) for name in table.observe))


@functools.cache
def select_states(indices: tuple[int, ...]) -> Callable[..., Any]:
    """Return the observation ``h(t, x, p) = x[indices]``, cached by indices so that it compiles once.

    Parameters
    ----------
    indices : tuple of int
        Positions in the state.
    """
    picked = np.array(indices)

    def observe(t: Any, x: Any, p: Any) -> Any:
        return x[picked]

    return observe
