"""Problem files: a model, its data, guesses and bounds, in TOML.

The `pydantic` models below define the format. Their fields are the keys; the description of a field is used in error
messages. ``docs/problem-file.md`` shows the format by example.
"""

from __future__ import annotations

import difflib
import functools
import inspect
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import pydantic
from pydantic import Field
from pydantic_core import PydanticCustomError

from switchfit.io.csv import read_columns
from switchfit.io.python_file import call, describe_error, find_object, find_user_place, load_object
from switchfit.models import BUILT_IN
from switchfit.problem.data import FloatArray, Input, Measurements, ReferenceSignal
from switchfit.problem.experiment import Experiment, Parameter
from switchfit.problem.priors import LogNormal, Normal, Prior
from switchfit.problem.problem import Problem
from switchfit.problem.system import HybridSystem
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import is_device

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
    """

    path: Path
    problem: Problem
    options: dict[str, Any]


def load_problem(path: str | Path) -> ProblemFile:
    """Read a problem file, the data files it names, and the Python file of its model.

    Parameters
    ----------
    path : str or Path
        A TOML file. Paths in it are relative to its folder.

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
    contents = _validate(path, _parse(path))
    options = contents.options.model_dump(include=OPTIONS, exclude_none=True)
    build = _build_from_tables if contents.problem is None else _load_from_python
    return ProblemFile(path, build(path, contents), options)


def read_experiments(path: str | Path) -> tuple[Experiment, ...]:
    """Read a problem file and the data files it names, but do not run the Python file that it names.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    tuple of Experiment
        With data and horizon, but without observation functions; empty if the whole problem is built in Python.

    Raises
    ------
    InputError
        As in `load_problem`.
    """
    path = Path(path)
    contents = _validate(path, _parse(path))
    if contents.problem is not None:
        find_object(contents.problem, path.parent, f"{path}: problem")
        return ()
    if contents.model is not None and contents.model.name not in BUILT_IN:
        _check_model_name(f"{path}: model", contents.model)
        find_object(contents.model.name, path.parent, f"{path}: model")
    for name, table in contents.parameters.items():
        _build_at(f"{path}: parameters.{name}", _build_parameter, table)
    return _build_experiments(path, contents, None)


# --- the format -------------------------------------------------------------------------------------------------------


class _Table(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", strict=True, frozen=True)


def _number_as_table(given: Any) -> Any:
    """Return ``{ value = 0.8 }`` for ``0.8``, the guess of an unknown."""
    return {"value": given} if isinstance(given, (int, float, list)) and not isinstance(given, bool) else given


def _known_as_table(given: Any) -> Any:
    """Return ``{ value = 0.5, fixed = true }`` for ``0.5``: a state at t0 given as a number is known."""
    return {"value": given, "fixed": True} if isinstance(given, (int, float)) and not isinstance(given, bool) else given


def _end_as_table(given: Any) -> Any:
    """Return ``{ value = 6.0, fixed = true }`` for ``6.0``: a tf given as a number is known."""
    if given is not None and not isinstance(given, dict) and _known_as_table(given) is given:
        raise PydanticCustomError("float_type", "Input should be a valid number")
    return _known_as_table(given)


def _name_as_table(given: Any) -> Any:
    """Return ``{ name = "skid_steer" }`` for ``"skid_steer"``, a model without arguments."""
    return {"name": given} if isinstance(given, str) else given


def _table_as_list(given: Any) -> Any:
    """Return a list of tables; a single table becomes a list of one."""
    return [given] if isinstance(given, dict) else given


class PriorTable(_Table):
    """A prior: normal with mean and sd, or log-normal with median and log_sd."""

    mean: float | None = Field(default=None, description="mean of a normal prior")
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

    value: float = Field(description="first guess of the transition time, in the experiment's time_unit")
    lower: float = Field(default=-np.inf, description="earliest time")
    upper: float = Field(default=np.inf, description="latest time")
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
    """Columns of a CSV file over time."""

    file: str = Field(description="CSV file, relative to the problem file")
    time: str = Field(description="name of the column with the time")
    window: Annotated[list[float], Field(min_length=2, max_length=2)] | None = Field(
        default=None, description="[from, to]: only rows with the time column in between are used"
    )
    time_offset: float = Field(default=0.0, description="subtracted from the time column")
    time_scale: float = Field(default=1.0, gt=0, description="then multiplied: 1e-3 turns ms into s")


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


class ExperimentTable(_Table):
    """One run."""

    mode_sequence: list[str] = Field(min_length=1, description="names of the modes in the order of their activity")
    transition_times: list[Annotated[TransitionTable, pydantic.BeforeValidator(_number_as_table)]] | None = Field(
        default=None,
        description="first guess of each transition time, in time_unit, one fewer than modes; if left out, all of the "
        "log is searched",
    )
    time_unit: str = Field(
        default="s", min_length=1, description="unit of all times of the run, for the report; nothing is converted"
    )
    data: Annotated[list[DataTable], pydantic.BeforeValidator(_table_as_list)] = Field(
        min_length=1, description="data to which the model is fitted; the costs of several tables are added"
    )
    t0: float | None = Field(default=None, description="start of the horizon; left out, the first sample")
    tf: Annotated[TransitionTable | None, pydantic.BeforeValidator(_end_as_table)] = Field(
        default=None,
        description="end of the horizon; left out, the last sample. A number, or a table with value, lower and upper "
        "if it is to be estimated",
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
    name: str | None = Field(default=None, description="used in the report if there are several experiments")


class ModelTable(_Table):
    """The model: built in, or in a Python file."""

    name: str = Field(description="a built-in model, or 'file.py:object' with a HybridSystem or a function making one")
    arguments: dict[str, Any] = Field(default_factory=dict, description="arguments of the function")


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


def _parse(path: Path) -> dict[str, Any]:
    if is_device(path):
        raise InputError(f"{path} is a device; name a problem file.")
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except FileNotFoundError:
        raise InputError(f"There is no problem file {path}; check the name and the folder.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    except RecursionError as error:
        raise InputError(f"{path} is not valid TOML: brackets are nested too deep.") from error
    except ValueError as error:  # invalid TOML, invalid UTF-8, or a number with thousands of digits
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


def _load_from_python(path: Path, contents: Contents) -> Problem:
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
    return found


def _build_from_tables(path: Path, contents: Contents) -> Problem:
    system = _build_system(path, contents.model or ModelTable(name=""))
    experiments = _build_experiments(path, contents, system)
    parameters = {
        name: _build_at(f"{path}: parameters.{name}", _build_parameter, table)
        for name, table in contents.parameters.items()
    }
    options = contents.options.model_dump(include={"min_duration", "solver", "rtol", "atol"}, exclude_none=True)
    return _build_at(f"{path}", Problem, system, experiments, parameters, **options)


def _build_experiments(path: Path, contents: Contents, system: HybridSystem | None) -> tuple[Experiment, ...]:
    """Return the experiments; without a system their observations are left out."""
    experiments = []
    for k, table in enumerate(contents.experiments, start=1):
        where = f"{path}: experiments[{k}]"
        known = frozenset(contents.parameters) | frozenset(table.parameter_map)
        experiments.append(_build_at(where, _build_experiment, path.parent, table, system, where, known))
    return tuple(experiments)


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
    folder: Path, table: ExperimentTable, system: HybridSystem | None, where: str, parameters: frozenset[str]
) -> Experiment:
    places = [f"{where}.data[{k}]" for k in range(1, len(table.data) + 1)]
    data = [
        _build_at(place, _build_data, folder, item, system, place, parameters)
        for place, item in zip(places, table.data, strict=True)
    ]
    times = table.transition_times
    return Experiment(
        data=data,
        mode_sequence=tuple(table.mode_sequence),
        transition_times=None if times is None else tuple(map(_build_parameter, times)),  # type: ignore[arg-type]
        t0=table.t0,  # type: ignore[arg-type]  # None: from the data
        tf=None if table.tf is None else _build_parameter(table.tf),  # type: ignore[arg-type]
        inputs=None if table.inputs is None else _build_at(f"{where}.inputs", _build_input, folder, table.inputs),
        initial_state=_build_initial_state(table),
        parameter_map=table.parameter_map,
        name=table.name,
        time_unit=table.time_unit,
    )


def _build_initial_state(table: ExperimentTable) -> list[Parameter] | list[float] | None:
    """Return the state at t0 for an Experiment: numbers if all of it is known."""
    if table.initial_state is None:
        return None
    if all(entry.fixed for entry in table.initial_state):
        return [entry.value for entry in table.initial_state]
    return [_build_parameter(entry) for entry in table.initial_state]


def _build_data(
    folder: Path, table: DataTable, system: HybridSystem | None, where: str, parameters: frozenset[str]
) -> Measurements | ReferenceSignal:
    observe = _build_observe(folder, table, system, where)
    names = tuple(table.observe) if isinstance(table.observe, list) else tuple(table.columns)
    if table.kind == "reference":
        if table.sigma is not None:
            raise ValueError("sigma belongs to kind = 'measurements'; a reference has weights.")
        for key, default in (("loss", "linear"), ("delay", 0.0)):
            if getattr(table, key) != default:
                raise ValueError(f"{key} belongs to kind = 'measurements', not to a reference.")
        times, values = _read_log(folder, table, table.columns)
        return ReferenceSignal.from_samples(
            times, values, observe=observe, lowpass_hz=table.lowpass_hz, weights=table.weights, names=names
        )
    for key in ("lowpass_hz", "weights"):
        if getattr(table, key) is not None:
            raise ValueError(f"{key} belongs to kind = 'reference'; measurements have sigma.")
    sigma_columns = _find_sigma_columns(table, parameters)
    times, values = _read_log(folder, table, [*table.columns, *sigma_columns])
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


def _build_input(folder: Path, table: InputTable) -> Input:
    if isinstance(table.columns, dict):
        times, values = _read_log(folder, table, list(table.columns.values()))
        return Input(times, dict(zip(table.columns, values.T, strict=True)), kind=table.kind)
    times, values = _read_log(folder, table, table.columns)
    return Input(times, values[:, 0] if len(table.columns) == 1 else values, kind=table.kind)


def _read_log(folder: Path, table: LogTable, columns: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Return times (K,) and the values of some columns (K, q) in the rows inside the window."""
    path = folder / table.file
    rows = read_columns(path, [table.time, *columns])
    missing = np.isnan(rows[:, 0])
    if missing.any():
        raise InputError(f"{path}, column {table.time!r}: the time of sample {missing.argmax() + 1} is missing.")
    if table.window is not None:
        first, last = table.window
        inside = (rows[:, 0] >= first) & (rows[:, 0] <= last)
        if not inside.any():
            raise InputError(
                f"{path}: no time in column {table.time!r} lies in the window [{first}, {last}]; they reach from "
                f"{rows[:, 0].min()} to {rows[:, 0].max()}."
            )
        rows = rows[inside]
    return (rows[:, 0] - table.time_offset) * table.time_scale, rows[:, 1:]


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
