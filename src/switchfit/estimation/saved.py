"""Save fits as JSON files that can be read without switchfit, and load them without losing a bit.

A file holds ``{"verdict": {...}, "format": "switchfit fit", "version": 7, "fit": {...}, "certificate": {...}}`` with
the fields of `Verdict`, `Fit` and `Certificate` under their own names. The verdict, with its line of text, and the
"transition_dates" that a fit to dates has beside them are meant for readers of the file; `load` computes them again
from the rest. ``"provenance"`` holds the fields of `Provenance`: what the fit was made from. Files without it are read
too.

- numbers are written with as many digits as it takes to read the same float64; JSON has no NaN and no infinities, so
  they are the strings ``"NaN"``, ``"Infinity"`` and ``"-Infinity"``;
- an array of float64 is a list, or a list of rows; any other, and an empty one, is
  ``{"dtype": ..., "shape": ..., "values": [...]}``;
- a status is its name; constraints, kinks and issues are objects with their fields.

When a file is read, pydantic checks it against the types of the dataclasses' fields. Then all sizes and names are
checked against one another (`_check_fit`), so that a loaded fit can be printed and plotted, and has intervals. Files of
versions 2 and 3, which hold sentences in place of data, and of versions 4 to 6 are upgraded to version 7 before that
(`_upgrade`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from functools import cache, partial
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, NamedTuple, NoReturn, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from switchfit.estimation.provenance import Provenance
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Comparison, Trajectory
from switchfit.problem.constraints import Constraint
from switchfit.problem.data import FloatArray
from switchfit.problem.dates import normalize_time_unit
from switchfit.runtime.errors import get_first_line
from switchfit.runtime.files import write_atomically
from switchfit.uncertainty.certificate import Certificate
from switchfit.uncertainty.identification import analyse_solution
from switchfit.uncertainty.verdict import Verdict, judge

FORMAT = "switchfit fit"
VERSION = 7
READABLE = (2, 3, 4, 5, 6, 7)

DATA = 4
"""The first version that holds data in place of sentences."""

NUMBERS = ("NaN", "Infinity", "-Infinity", "nan", "inf", "-inf")
"""Strings that stand for numbers; the latter three in files before version 4."""


DTYPES = re.compile("[<>|=]?[bifuU][0-9]+", re.ASCII)
"""Types of arrays of numbers or text, as NumPy names them in a file."""


def save_fit(fit: Fit, certificate: Certificate, path: Path, provenance: Provenance | None = None) -> None:
    """Write a fit to a file, whole or not at all.

    Parameters
    ----------
    fit : Fit
        Only the fields of `Fit` are written, also for a subclass.
    certificate : Certificate
    path : Path
        An existing file is replaced.
    provenance : Provenance, optional
        What the fit was made from.

    Raises
    ------
    OSError
        If the file cannot be written; an existing one is then left as it was.
    """
    content = write_fit(fit, certificate)
    if provenance is not None:
        content["provenance"] = to_json(provenance.place_beside(Path(path)), Provenance)
    write_document(content, Path(path))


def write_fit(fit: Fit, certificate: Certificate) -> dict[str, Any]:
    """Return the content of the file of a fit, without its provenance.

    Parameters
    ----------
    fit : Fit
    certificate : Certificate
    """
    verdict = judge(fit, certificate)
    return {
        "verdict": {"level": verdict.level, "text": str(verdict)} | to_json(verdict, Verdict),
        "format": FORMAT,
        "version": VERSION,
        **_list_dates(fit),
        "fit": to_json(fit, Fit),
        "certificate": to_json(certificate, Certificate),
    }


class SavedFit(NamedTuple):
    """What a file holds; no provenance in files that were written before it was kept."""

    fit: Fit
    certificate: Certificate
    provenance: Provenance | None


def load_fit(path: Path) -> tuple[Fit, Certificate]:
    """Return the fit and the certificate of a file, see `load_saved`.

    Parameters
    ----------
    path : Path
    """
    saved = load_saved(path)
    return saved.fit, saved.certificate


def load_saved(path: Path) -> SavedFit:
    """Read what `save_fit` wrote; every field is equal, and arrays have the same bits, dtype and shape.

    Parameters
    ----------
    path : Path

    Returns
    -------
    SavedFit

    Raises
    ------
    OSError
        If there is no such file (FileNotFoundError) or it cannot be read.
    ValueError
        If it is not valid JSON, not written by switchfit, of another version, or a field is missing, of a wrong type or
        of a size that does not match the others; the message names the file and the field.
    """
    content = read_document(Path(path), "a saved estimate", FORMAT, READABLE)
    version = content["version"]
    try:
        if version < VERSION:
            _upgrade(content, version)
        fit, certificate = parse_fit(content)
        if version < DATA:
            directions = analyse_solution(fit, None).directions
            certificate = replace(certificate, worst_unknowns=directions[0].names if directions else ())
        given = content.get("provenance")
        provenance = None if given is None else from_json(Provenance, given, "provenance")
        return SavedFit(fit, certificate, None if provenance is None else provenance.find_from(Path(path)))
    except (ValueError, OverflowError, RecursionError, MemoryError) as error:
        raise ValueError(f"{path} is damaged: {error}.") from error


def _list_dates(fit: Fit) -> dict[str, Any]:
    """Return the transition times that are dates by their names, for readers of the file; {} where none is."""
    if all(trajectory.origin is None for trajectory in fit.trajectories):
        return {}
    dates = {}
    for transition in fit.transitions:
        origin = fit.trajectories[transition.experiment].origin
        date = None if origin is None else origin.find_date(transition.time, transition.unit)
        if date is not None:
            dates[transition.name] = date.isoformat()
    return {"transition_dates": dates}


def parse_fit(content: Mapping[str, Any]) -> tuple[Fit, Certificate]:
    """Return a fit and its certificate from the content of a file of this version.

    Parameters
    ----------
    content : mapping

    Raises
    ------
    ValueError
        If a field is missing, of a wrong type or of a size that does not match the others.
    """
    fit = from_json(Fit, content.get("fit"), "fit")
    certificate = from_json(Certificate, content.get("certificate"), "certificate")
    _check_fit(fit)
    return fit, certificate


# --- files ------------------------------------------------------------------------------------------------------------


def write_document(content: dict[str, Any], path: Path) -> None:
    """Write JSON to a file, whole or not at all.

    Parameters
    ----------
    content : dict
    path : Path
    """
    write_atomically(_lay_out(content) + "\n", path)


def read_document(path: Path, what: str, form: str, readable: Sequence[int]) -> dict[str, Any]:
    """Return the JSON object in a file, with its "format" and its "version" checked.

    Parameters
    ----------
    path : Path
    what : str
        What the file should be, with its article, for messages.
    form : str
        The "format" that it must have.
    readable : sequence of int
        The versions that can be read.

    Raises
    ------
    OSError
        If it cannot be read.
    ValueError
        If it is not valid JSON, of another format or of another version.
    """
    try:
        text = path.read_bytes().decode()
        content = json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_refuse_repetition)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not {what}: it is not valid JSON ({error}).") from error
    if not isinstance(content, dict) or content.get("format") != form:
        raise ValueError(f'{path} is not {what}: it has no entry "format": "{form}" at its top.')
    version = content.get("version")
    if type(version) is not int or version not in readable:
        *others, last = readable
        read = f"the versions {', '.join(map(str, others))} and {last}" if others else f"version {last}"
        raise ValueError(
            f"{path} is {what} of version {version!r}; this switchfit reads {read}. Read it with the switchfit that "
            "wrote it."
        )
    return content


# --- to JSON ----------------------------------------------------------------------------------------------------------


def to_json(record: Any, kind: type) -> Any:
    """Return a dataclass by the fields of `kind` in terms of dict, list, str, int, finite float, bool and None.

    Parameters
    ----------
    record : object
    kind : type
        Of the record, or a dataclass with some of its fields.
    """
    from pydantic_core import to_json as encode  # imported here, since that takes longer than a small fit

    values = {f.name: getattr(record, f.name) for f in fields(kind)}
    named = {name: value.name if isinstance(value, Enum) else value for name, value in values.items()}
    return json.loads(encode(named, inf_nan_mode="strings", fallback=_encode_array))


def _encode_array(value: Any) -> Any:
    """Return an array as a list, or with its dtype and shape; TypeError for anything else."""
    if not isinstance(value, np.ndarray):
        raise TypeError(f"a {type(value).__name__} cannot be saved.")
    if value.dtype == np.float64 and value.size > 0:
        return value.tolist()
    return {"dtype": value.dtype.str, "shape": list(value.shape), "values": value.ravel().tolist()}


def _lay_out(value: Any, indent: str = "") -> str:
    """Return JSON with one entry of an object or one row of an array on a line."""
    deeper = indent + "  "
    if isinstance(value, dict) and value:
        entries = [f"{json.dumps(name)}: {_lay_out(entry, deeper)}" for name, entry in value.items()]
    elif isinstance(value, list) and any(isinstance(entry, (dict, list)) for entry in value):
        entries = [_lay_out(entry, deeper) for entry in value]
    else:
        return json.dumps(value, allow_nan=False, ensure_ascii=False)
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    return f"{opening}\n{deeper}" + f",\n{deeper}".join(entries) + f"\n{indent}{closing}"


# --- from JSON --------------------------------------------------------------------------------------------------------


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"it contains {name}")


def _refuse_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object; ValueError if it has a name twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it has the entry {next(name for name in names if names.count(name) > 1)!r} twice")
    return found


def from_json(kind: type, content: Any, where: str) -> Any:
    """Return a dataclass from JSON; ValueError with the path of a wrong entry.

    Parameters
    ----------
    kind : type
    content : object
    where : str
        What the path begins with.
    """
    import pydantic

    try:
        return _make_adapter(kind).validate_python(content)
    except pydantic.ValidationError as error:
        raise ValueError(_describe_error(error.errors(include_url=False)[0], content, where)) from error


@cache
def _make_adapter(kind: type) -> Any:
    """Return pydantic's validator of a dataclass."""
    import pydantic

    return pydantic.TypeAdapter(_convert_hint(kind))


def _convert_hint(hint: Any) -> Any:
    """Convert the type hint of a field to one with which pydantic reads JSON: arrays, names of statuses, lists for
    tuples.
    """
    from pydantic import AfterValidator, BeforeValidator, ConfigDict, PlainValidator, Strict, create_model

    origin, inner = get_origin(hint), get_args(hint)
    if isinstance(hint, type) and is_dataclass(hint):
        hints = get_type_hints(hint)
        entries: dict[str, Any] = {f.name: (_convert_hint(hints[f.name]), ...) for f in fields(hint)}
        model = create_model(hint.__name__, __config__=ConfigDict(extra="forbid", strict=True), **entries)
        return Annotated[model, _as_dataclass(hint)]
    if origin is np.ndarray:
        return Annotated[Any, PlainValidator(partial(_read_array, np.dtype(get_args(inner[1])[0])))]
    if isinstance(hint, type) and issubclass(hint, Enum):
        return Annotated[Any, PlainValidator(partial(_read_member, hint))]
    if hint is str:
        return Annotated[str, AfterValidator(_check_text)]
    if hint is float:
        return Annotated[Any, PlainValidator(_read_number)]
    if origin is tuple:
        entries_ = tuple(entry if entry is Ellipsis else _convert_hint(entry) for entry in inner)
        return Annotated[tuple[entries_], Strict(), BeforeValidator(_list_as_tuple)]  # type: ignore[valid-type]
    if origin in (UnionType, Union):
        return Union[tuple(_convert_hint(entry) for entry in inner)]  # noqa: UP007  # of a list that is known at run time
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return dict[_convert_hint(str), _convert_hint(inner[1])]  # type: ignore[misc]
    return hint


def _as_dataclass(kind: type) -> Any:
    """Return a pydantic validator that converts a model with the fields of a dataclass to that dataclass."""
    from pydantic import AfterValidator

    names = [f.name for f in fields(kind)]
    return AfterValidator(lambda model: kind(**{name: getattr(model, name) for name in names}))


def _list_as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _read_member(kind: type[Enum], value: Any) -> Enum:
    if not isinstance(value, str) or value not in kind.__members__:
        raise ValueError(f"must be one of {', '.join(kind.__members__)}; got {_shorten(value)}")
    return kind[value]


def _read_array(declared: np.dtype[Any], value: Any) -> NDArray[Any]:
    """Return an array of the declared type from a list of numbers, or from its dtype, shape and values."""
    if isinstance(value, dict):
        array = _read_described_array(value)
    elif declared.kind == "f":
        array = _build_array(_read_numbers(value), np.dtype(np.float64))
    else:
        raise ValueError(f"must be an array of {declared.type.__name__}; got {_shorten(value)}")
    same_size = declared.kind == "U" or array.dtype.itemsize == declared.itemsize
    if array.dtype.kind != declared.kind or not same_size:
        raise ValueError(f"must be an array of {declared.type.__name__}; got one of {array.dtype}")
    return array


def _read_described_array(value: dict[str, Any]) -> NDArray[Any]:
    """Return an array from its dtype, shape and values."""
    if set(value) != {"dtype", "shape", "values"}:
        raise ValueError(f"must be an array; got {_shorten(value)}")
    name = _require_type(value["dtype"], str)
    if not DTYPES.fullmatch(name):  # NumPy accepts more names, some of them with a warning
        raise ValueError(f"has the dtype {name!r}, which is not a dtype of numbers or text")
    try:
        dtype = np.dtype(name)
    except TypeError as error:
        raise ValueError(f"has the unknown dtype {name!r}") from error
    values = _require_type(value["values"], list)
    if dtype.kind == "f":
        values = _read_numbers(values)
    else:
        kind = {"U": str, "b": bool}.get(dtype.kind, int)
        values = [_require_type(entry, kind) for entry in values]
    flat = _build_array(values, dtype)
    shape = tuple(_require_type(entry, int) for entry in _require_type(value["shape"], list))
    if flat.size != np.prod(shape) or min(shape, default=0) < 0:
        raise ValueError(f"has the shape {shape} but {flat.size} values")
    return flat.reshape(shape)


def _build_array(values: Any, dtype: np.dtype[Any]) -> NDArray[Any]:
    try:
        return np.array(values, dtype=dtype)
    except (TypeError, ValueError, OverflowError, MemoryError) as error:
        raise ValueError(f"is not an array of {dtype}: {error}") from error


def _read_numbers(value: Any) -> Any:
    """Return nested lists of floats."""
    if isinstance(value, list):
        return [_read_numbers(entry) for entry in value]
    return _read_number(value)


def _read_number(value: Any) -> float:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number and (not isinstance(value, str) or value not in NUMBERS):
        raise ValueError(f'must be a number, or one of "NaN", "Infinity", "-Infinity"; got {_shorten(value)}')
    return float(value)


def _require_type(value: Any, kind: type) -> Any:
    """Return `value`; ValueError unless its type is exactly `kind`."""
    if type(value) is not kind:
        words = {list: "a list", str: "a string", int: "an integer", bool: "true or false"}
        raise ValueError(f"must be {words[kind]}; got {_shorten(value)}")
    return _check_text(value) if isinstance(value, str) else value


def _check_text(value: str) -> str:
    """Return `value`; ValueError for half of a surrogate pair, which JSON can hold, but UTF-8 cannot."""
    value.encode()
    return value


def _shorten(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


WORDS = {
    "model_type": "an object",
    "dict_type": "an object",
    "tuple_type": "a list",
    "string_type": "a string",
    "int_type": "an integer",
    "bool_type": "true or false",
}
"""JSON's names for the types in pydantic's errors."""


def _describe_error(error: Mapping[str, Any], content: Any, top: str) -> str:
    """Return one of pydantic's errors as a sentence: where, what is wrong, what was given."""
    kind, given = error["type"], error["input"]
    where = _describe_place(error["loc"], content, top)
    if kind == "missing":
        return f"{where} is missing"
    if kind == "extra_forbidden":
        return f"{_describe_place(error['loc'][:-1], content, top)} has the unknown entry {error['loc'][-1]!r}"
    if kind == "value_error":
        return f"{where} {error['ctx']['error']}"
    if kind == "too_long" and isinstance(given, tuple):
        return f"{where} must have {error['ctx']['max_length']} entries; got {len(given)}"
    if kind in WORDS:
        return f"{where} must be {WORDS[kind]}; got {_shorten(given)}"
    return f"{where} must be {error['msg'].removeprefix('Input should be ')}; got {_shorten(given)}"


def _describe_place(loc: Iterable[Any], content: Any, top: str) -> str:
    """Return the path of an entry, as in ``fit.history[1].cost``, without what pydantic adds to it."""
    where, value = top, content
    for step in loc:
        if isinstance(value, list) and isinstance(step, int):
            where, value = f"{where}[{step}]", value[step] if step < len(value) else None
        elif isinstance(value, dict) and isinstance(step, str):
            where, value = f"{where}.{step}", value.get(step)
    return where


# --- files of earlier versions ----------------------------------------------------------------------------------------


def _upgrade(content: dict[str, Any], version: int) -> None:
    """Upgrade the content of a file of an earlier version to version 7, in place."""
    try:
        if version < DATA:
            _upgrade_fit(content["fit"])
            _upgrade_certificate(content["certificate"], content["fit"])
        if content["fit"]["engine"] is not None:
            content["fit"]["engine"].setdefault("implicit_modes", [])
        content["fit"].setdefault("starts", None)
        content["fit"].setdefault("saved_profiles", [])
        content["fit"].setdefault("unread", [])
        content["fit"].setdefault("absent", [])
        content["fit"].setdefault("steps", [])
        content["fit"].setdefault("initial_cost", _read_first_cost(content["fit"]["history"]))
        for comparison in (comparison for run in content["fit"]["comparisons"] for comparison in run):
            comparison.setdefault("weights", None)
            comparison.setdefault("units", [])
        for trajectory in content["fit"]["trajectories"]:
            trajectory.setdefault("origin", None)
    except (LookupError, TypeError, AttributeError) as error:
        raise ValueError(
            f"it does not match the format of version {content['version']} ({get_first_line(error)})"
        ) from error


def _read_first_cost(history: list[dict[str, Any]]) -> Any:
    """Return J at the first guess: before there were strategies, every history began there."""
    return history[0]["cost"] if history else "NaN"


def _upgrade_fit(fit: dict[str, Any]) -> None:
    names, theta = fit["theta_names"], fit["theta"]
    for trajectory in fit["trajectories"]:
        trajectory.setdefault("time_unit", "s")
    fit.update({"engine": None, "idle": [], "integration_error_of": "J"} | fit)  # files of version 2 lack them
    fit["run_names"], fit["transition_places"] = _find_transitions(fit)
    units = {name.partition("[")[0]: unit for name, unit in zip(names, fit["theta_units"], strict=False)}
    fit["parameter_units"] = {name: units.get(name, "") for name in fit["parameters"]}
    fit["fixed"] = [name for name in fit["parameters"] if name not in units]
    fit["kinks"] = [
        {"unknown": name, "value": theta[names.index(name)] if name in names else "NaN", "left": left, "right": right}
        for name, left, right in fit["kinks"]
    ]
    known = _list_possible_constraints(fit)
    for k, text in enumerate(fit["active"]):
        if text not in known:
            raise ValueError(f"fit.active[{k}] is not a constraint of this fit; got {_shorten(text)}")
    fit["active"] = [known[text] for text in fit["active"]]
    fit["reason"] = {"kind": "message", "subjects": [fit.pop("message")], "figures": {}}
    fit |= {"earlier_iterations": 0, "smallest_eigenvalue": "NaN", "flat_direction": [], "violated": []}


def _upgrade_certificate(certificate: dict[str, Any], fit: dict[str, Any]) -> None:
    certificate.setdefault("integration_error_of", "J")
    del certificate["worst_direction"]
    failures = [{"kind": "message", "subjects": [text], "figures": {}} for text in certificate["failures"]]
    certificate |= {"worst_unknowns": [], "active": fit["active"], "kinks": fit["kinks"], "failures": failures}


def _find_transitions(fit: dict[str, Any]) -> tuple[list[str], list[Any]]:
    """Return the names of the runs and the indices of transition times in theta, from the names of the unknowns.

    Free transition times come first in theta, in order, with names ``tau_i`` or ``run.tau_i``.
    """
    names, theta, all_times = fit["theta_names"], fit["theta"], fit["transition_times"]
    runs, all_places, place = [], [], 0
    for e, given in enumerate(all_times):
        run = f"run{e + 1}"
        times = given["values"] if isinstance(given, dict) else given
        places = []
        for i, time in enumerate(times):
            name = f".{names[place]}" if place < len(names) else ""
            free = name.endswith(f".tau_{i + 1}") and theta[place] == time
            run = name.removesuffix(f".tau_{i + 1}")[1:] or run if free else run
            places.append(place if free else -1)
            place += free
        runs.append(run)
        all_places.append({"dtype": "<i8", "shape": [len(places)], "values": places})
    return runs, all_places


def _list_possible_constraints(fit: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return every linear constraint that may be active, by its sentence in version 3."""
    found = {}
    for name, low, high in zip(fit["theta_names"], fit["lower"], fit["upper"], strict=False):
        for side, value in (("lower", low), ("upper", high)):
            bound = Constraint(f"{side} bound", float(value), unknown=name)  # type: ignore[arg-type]  # one of the kinds
            found[f"{name} at its {side} bound {float(value):g}"] = bound
    single = len(fit["trajectories"]) == 1
    for run, trajectory in zip(fit["run_names"], fit["trajectories"], strict=False):
        modes, starts = trajectory["modes"]["values"], trajectory["segments"]["values"][:-1]
        for i, mode in enumerate(modes[start] for start in starts):
            where = f"mode {i + 1} ({mode!r})" + ("" if single else f" of {run}")
            place = {"mode": mode, "position": i, "run": "" if single else run}
            found[f"{where} has collapsed to nothing"] = Constraint("collapsed", 0.0, **place)
            found[f"{where} is at its minimum duration"] = Constraint("minimum duration", np.nan, **place)
    return {text: to_json(constraint, Constraint) | {"multiplier": "NaN"} for text, constraint in found.items()}


# --- sizes ------------------------------------------------------------------------------------------------------------


def _check_fit(fit: Fit) -> None:
    """Raise ValueError if sizes, names or times do not match one another."""
    d, experiments = len(fit.theta_names), len(fit.trajectories)
    unknowns = f"since fit.theta_names has {d} entries"
    _check_size("fit.theta_units", fit.theta_units, (d,), unknowns)
    for name in ("initial_theta", "theta", "lower", "upper", "gradient"):
        _check_size(f"fit.{name}", getattr(fit, name), (d,), unknowns)
    for name in ("hessian", "saved_gauss_newton"):
        if getattr(fit, name) is not None:
            _check_size(f"fit.{name}", getattr(fit, name), (d, d), unknowns)
    for k, profile in enumerate(fit.saved_profiles):
        _check_names(f"fit.saved_profiles[{k}].unknown", (profile.unknown,), fit.theta_names)
        for name in ("below", "above"):
            pieces = getattr(profile, name)
            _check_size(f"fit.saved_profiles[{k}].{name}", pieces, (len(pieces), 5), "rows of five numbers")
            if not len(pieces) or not np.isfinite(pieces).all():
                raise ValueError(f"fit.saved_profiles[{k}].{name} must hold one row or more of finite numbers")
    for k, record in enumerate(fit.history):
        _check_size(f"fit.history[{k}].theta", record.theta, (d,), unknowns)
    _check_basis(fit.free_basis, d)
    _check_names("fit.kinks", (kink.unknown for kink in fit.kinks), fit.theta_names)
    _check_names("fit.active", (c.unknown for c in fit.active if c.position is None), fit.theta_names)
    for name in ("idle", "unread", "absent"):
        _check_names(f"fit.{name}", getattr(fit, name), fit.theta_names)
    _check_names("fit.priors", fit.priors, fit.theta_names)
    _check_names("fit.log_scaled", fit.log_scaled, fit.theta_names)
    for name in fit.parameters:
        if name not in fit.parameter_units:
            raise ValueError(f"fit.parameter_units lacks the parameter {name!r}")
    for name in fit.fixed:
        if name not in fit.parameters:
            raise ValueError(f"fit.fixed has the name {name!r}, which is not in fit.parameters")
    if experiments == 0:
        raise ValueError("fit.trajectories must have one entry or more; got none")
    runs = f"since fit.trajectories has {experiments} entries"
    _check_size("fit.run_names", fit.run_names, (experiments,), runs)
    _check_size("fit.transition_places", fit.transition_places, (experiments,), runs)
    _check_size("fit.transition_times", fit.transition_times, (experiments,), runs)
    _check_size("fit.comparisons", fit.comparisons, (experiments,), runs)
    for e, (trajectory, times) in enumerate(zip(fit.trajectories, fit.transition_times, strict=True)):
        _check_trajectory(trajectory, times, e)
        places = fit.transition_places[e]
        _check_size(f"fit.transition_places[{e}]", places, times.shape, f"as fit.transition_times[{e}]")
        if np.any((places < -1) | (places >= d)):
            raise ValueError(f"fit.transition_places[{e}] must lie between -1 and {d - 1}; got {places.tolist()}")
        for k, comparison in enumerate(fit.comparisons[e]):
            _check_comparison(comparison, f"fit.comparisons[{e}][{k}]")


def _check_trajectory(trajectory: Trajectory, transition_times: FloatArray, e: int) -> None:
    where = f"fit.trajectories[{e}]"
    _check_times(f"{where}.times", trajectory.times)
    if trajectory.origin is not None:
        normalize_time_unit(trajectory.time_unit)
    n, K = len(trajectory.state_names), len(trajectory.times)
    _check_size(f"{where}.state_units", trajectory.state_units, (n,), f"since its state_names has {n} entries")
    nodes = f"since its times has {K} entries"
    _check_size(f"{where}.states", trajectory.states, (K, n), f"{nodes} and its state_names {n}")
    _check_size(f"{where}.modes", trajectory.modes, (K,), nodes)
    _check_size(f"fit.transition_times[{e}]", transition_times, (transition_times.size,), "a list of numbers")
    N = len(transition_times)
    _check_size(f"{where}.segments", trajectory.segments, (N + 2,), f"since fit.transition_times[{e}] has {N} entries")
    ends = trajectory.segments
    if ends[0] != 0 or ends[-1] != K or np.any(np.diff(ends) <= 0):
        raise ValueError(f"{where}.segments must increase from 0 to {K}, the number of times; got {ends.tolist()}")


def _check_comparison(comparison: Comparison, where: str) -> None:
    if comparison.kind not in ("measurements", "reference"):
        raise ValueError(f'{where}.kind must be "measurements" or "reference"; got {_shorten(comparison.kind)}')
    _check_times(f"{where}.times", comparison.times)
    _check_times(f"{where}.curve_times", comparison.curve_times)
    q, K, L = len(comparison.names), len(comparison.times), len(comparison.curve_times)
    sizes = f"since its times has {K} entries and its names {q}"
    for name in ("measured", "fitted", "sigma", "downweighted"):
        if getattr(comparison, name) is not None:
            _check_size(f"{where}.{name}", getattr(comparison, name), (K, q), sizes)
    if comparison.units:
        _check_size(f"{where}.units", comparison.units, (q,), f"since its names has {q} entries")
    if comparison.weights is not None:
        _check_size(f"{where}.weights", comparison.weights, (q,), f"since its names has {q} entries")
    _check_size(f"{where}.curve", comparison.curve, (L, q), f"since its curve_times has {L} entries and its names {q}")


def _check_size(where: str, value: Any, shape: tuple[int, ...], reason: str) -> None:
    found = value.shape if isinstance(value, np.ndarray) else (len(value),)
    if found != shape:
        raise ValueError(f"{where} must have the shape {shape}, {reason}; got {found}")


def _check_times(where: str, times: FloatArray) -> None:
    """Raise ValueError for times above 1e100 in size, for which no axis can be drawn."""
    if times.ndim != 1 or not (np.abs(times) < 1e100).all() or np.any(np.diff(times) < 0):
        raise ValueError(f"{where} must be a list of finite numbers (below 1e100) that do not decrease")


def _check_basis(basis: FloatArray, d: int) -> None:
    """Raise ValueError unless all columns have length 1 and are at right angles to one another."""
    if basis.ndim != 2 or basis.shape[0] != d or basis.shape[1] > d:
        raise ValueError(f"fit.free_basis must have {d} rows and at most as many columns; got the shape {basis.shape}")
    if not (np.abs(basis) <= 2).all() or not np.allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-6):
        raise ValueError("fit.free_basis must have orthonormal columns")


def _check_names(where: str, given: Iterable[str], known: tuple[str, ...]) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"{where} has the name {name!r}, which is not in fit.theta_names")
