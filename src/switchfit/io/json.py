"""Fits as JSON files that can be read without switchfit, and back again without losing a bit.

A file holds ``{"format": "switchfit fit", "version": 3, "fit": {...}, "certificate": {...}}`` with the fields of
`Fit` and `Certificate` under their own names:

- numbers are written with as many digits as it takes to read the same float64; JSON has no NaN and no infinities, so
  they are the strings ``"nan"``, ``"inf"`` and ``"-inf"``;
- an array of float64 is a list, or a list of rows; any other, and an empty one, is
  ``{"dtype": ..., "shape": ..., "values": [...]}``;
- a status is its name.

What is read is checked against the types that the fields of the dataclasses declare, and then all sizes against one
another (`_check_fit`): what was loaded can be printed and plotted, and has intervals.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import UnionType
from typing import Any, NoReturn, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.result import Certificate, Fit
from switchfit.fit.trajectory import Comparison, Trajectory
from switchfit.problem.data import FloatArray
from switchfit.runtime.files import write_atomically

FORMAT = "switchfit fit"
VERSION = 3

DTYPE = re.compile(r"[<>|=]?[bifuU]\d+")
"""What a dtype of numbers or text is called; NumPy has more names, some of them obsolete."""
READABLE = (2, 3)

LATER_FIELDS: dict[type, tuple[str, ...]] = {
    Trajectory: ("time_unit",),
    Fit: ("engine", "idle", "integration_error_of"),
    Certificate: ("integration_error_of",),
}
"""Fields that files of version 2 lack: they take their defaults."""


def save_fit(fit: Fit, certificate: Certificate, path: Path) -> None:
    """Write a fit to a file, whole or not at all.

    Parameters
    ----------
    fit : Fit
        Of a subclass only what belongs to `Fit` is written.
    certificate : Certificate
    path : Path
        An existing file is replaced.

    Raises
    ------
    OSError
        If the file cannot be written; an existing one is then left as it was.
    """
    content = {
        "format": FORMAT,
        "version": VERSION,
        "fit": _encoded(fit, Fit),
        "certificate": _encoded(certificate, Certificate),
    }
    write_atomically(_dumped(content) + "\n", Path(path))


def load_fit(path: Path) -> tuple[Fit, Certificate]:
    """Read what `save_fit` wrote; every field is equal, and arrays have the same bits, dtype and shape.

    Parameters
    ----------
    path : Path

    Returns
    -------
    fit : Fit
    certificate : Certificate

    Raises
    ------
    OSError
        If there is no such file (FileNotFoundError) or it cannot be read.
    ValueError
        If it is no JSON, not written by switchfit, of another version, or a field is missing, of a wrong type or of a
        size that does not fit the others; the message names the file and the field.
    """
    try:
        text = Path(path).read_bytes().decode()
        content = json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_without_repetition)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not a saved estimate: it is no valid JSON ({error}).") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f'{path} is not a saved estimate: it has no entry "format": "{FORMAT}" at its top.')
    if content.get("version") not in READABLE:
        raise ValueError(
            f"{path} is a saved estimate of version {content.get('version')!r}; this switchfit reads the "
            f"versions {' and '.join(map(str, READABLE))}. Read it with the switchfit that wrote it."
        )
    try:
        fit = _decoded(Fit, content.get("fit"), "fit")
        certificate = _decoded(Certificate, content.get("certificate"), "certificate")
        _check_fit(fit)
        return fit, certificate
    except (ValueError, OverflowError, RecursionError, MemoryError) as error:
        raise ValueError(f"{path} is damaged: {error}.") from error


# --- to JSON ----------------------------------------------------------------------------------------------------------


def _encoded(value: Any, kind: type | None = None) -> Any:
    """`value` in terms of dict, list, str, int, finite float, bool and None; a dataclass by the fields of `kind`."""
    if is_dataclass(value):
        return {f.name: _encoded(getattr(value, f.name)) for f in fields(kind or type(value))}
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, np.ndarray):
        if value.dtype == np.float64 and value.size > 0:
            return _encoded(value.tolist())
        return {"dtype": value.dtype.str, "shape": list(value.shape), "values": _encoded(value.ravel().tolist())}
    if isinstance(value, Mapping):
        return {str(name): _encoded(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_encoded(entry) for entry in value]
    if isinstance(value, np.generic):
        return _encoded(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value


def _dumped(value: Any, indent: str = "") -> str:
    """JSON with one entry of an object or one row of an array on a line."""
    deeper = indent + "  "
    if isinstance(value, dict) and value:
        entries = [f"{json.dumps(name)}: {_dumped(entry, deeper)}" for name, entry in value.items()]
    elif isinstance(value, list) and any(isinstance(entry, (dict, list)) for entry in value):
        entries = [_dumped(entry, deeper) for entry in value]
    else:
        return json.dumps(value, allow_nan=False, ensure_ascii=False)
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    return f"{opening}\n{deeper}" + f",\n{deeper}".join(entries) + f"\n{indent}{closing}"


# --- from JSON --------------------------------------------------------------------------------------------------------


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"it contains {name}")


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, none of whose names stands there twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it has the entry {next(name for name in names if names.count(name) > 1)!r} twice")
    return found


def _decoded(hint: Any, value: Any, where: str) -> Any:
    """`value` as what the type hint of the field `where` says; ValueError otherwise."""
    origin, inner = get_origin(hint), get_args(hint)
    if is_dataclass(hint) and isinstance(hint, type):
        return _dataclass(hint, value, where)
    if origin is UnionType:
        optional = [kind for kind in inner if kind is not type(None)]
        return None if value is None else _decoded(optional[0], value, where)
    if origin is np.ndarray:
        array, declared = _array(value, where), np.dtype(get_args(inner[1])[0])
        same_size = declared.kind == "U" or array.dtype.itemsize == declared.itemsize
        if array.dtype.kind != declared.kind or not same_size:
            raise ValueError(f"{where} must be an array of {declared.type.__name__}; got one of {array.dtype}")
        return array
    if origin is tuple:
        return _tuple(inner, value, where)
    if origin is Mapping:
        entries = _checked(value, dict, where).items()
        return {_checked(name, str, where): _decoded(inner[1], entry, f"{where}[{name!r}]") for name, entry in entries}
    if isinstance(hint, type) and issubclass(hint, Enum):
        names = hint.__members__
        if not isinstance(value, str) or value not in names:
            raise ValueError(f"{where} must be one of {', '.join(names)}; got {_shown(value)}")
        return names[value]
    return _number(value, where) if hint is float else _checked(value, hint, where)


def _dataclass(kind: type, value: Any, where: str) -> Any:
    """An instance of a dataclass from a dict with its fields and no others."""
    hints = get_type_hints(kind)
    names = [f.name for f in fields(kind)]
    given = _checked(value, dict, where)
    for name in names:
        if name not in given and name not in LATER_FIELDS.get(kind, ()):
            raise ValueError(f"{where}.{name} is missing")
    if unknown := [name for name in given if name not in names]:
        raise ValueError(f"{where} has the unknown entry {unknown[0]!r}")
    return kind(**{name: _decoded(hints[name], given[name], f"{where}.{name}") for name in names if name in given})


def _tuple(kinds: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    """A tuple of the given types, or of any number of the first one where the second is an ellipsis."""
    entries = _checked(value, list, where)
    if kinds[1:] == (Ellipsis,):
        kinds = kinds[:1] * len(entries)
    if len(entries) != len(kinds):
        raise ValueError(f"{where} must have {len(kinds)} entries; got {len(entries)}")
    parts = zip(kinds, entries, strict=True)
    return tuple(_decoded(kind, entry, f"{where}[{k}]") for k, (kind, entry) in enumerate(parts))


def _array(value: Any, where: str) -> NDArray[Any]:
    """An array from a list of numbers, or from its dtype, shape and values."""
    if not isinstance(value, dict):
        return _assembled(_numbers(value, where), np.dtype(np.float64), where)
    if set(value) != {"dtype", "shape", "values"}:
        raise ValueError(f"{where} must be an array; got {_shown(value)}")
    name = _checked(value["dtype"], str, where)
    if not DTYPE.fullmatch(name):
        raise ValueError(f"{where} has the dtype {name!r}, which is none of numbers or text")
    try:
        dtype = np.dtype(name)
    except TypeError as error:
        raise ValueError(f"{where} has the unknown dtype {name!r}") from error
    values = _checked(value["values"], list, where)
    if dtype.kind == "f":
        values = _numbers(values, where)
    else:
        kind = {"U": str, "b": bool}.get(dtype.kind, int)
        values = [_checked(entry, kind, where) for entry in values]
    flat = _assembled(values, dtype, where)
    shape = _tuple((int, ...), value["shape"], f"{where} shape")
    if flat.size != np.prod(shape) or min(shape, default=0) < 0:
        raise ValueError(f"{where} has the shape {shape} but {flat.size} values")
    return flat.reshape(shape)


def _assembled(values: Any, dtype: np.dtype[Any], where: str) -> NDArray[Any]:
    try:
        return np.array(values, dtype=dtype)
    except (TypeError, ValueError, OverflowError, MemoryError) as error:
        raise ValueError(f"{where} is no array of {dtype}: {error}") from error


def _numbers(value: Any, where: str) -> Any:
    """Nested lists of floats."""
    if isinstance(value, list):
        return [_numbers(entry, where) for entry in value]
    return _number(value, where)


def _number(value: Any, where: str) -> float:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number and (not isinstance(value, str) or value not in ("nan", "inf", "-inf")):
        raise ValueError(f'{where} must be a number, or one of "nan", "inf", "-inf"; got {_shown(value)}')
    return float(value)


def _checked(value: Any, kind: type, where: str) -> Any:
    """`value`, which has to be exactly of a JSON type."""
    if type(value) is not kind:
        words = {dict: "an object", list: "a list", str: "a string", int: "an integer", bool: "true or false"}
        raise ValueError(f"{where} must be {words.get(kind, kind)}; got {_shown(value)}")
    if isinstance(value, str):
        value.encode()  # half of a surrogate pair can be written as JSON, but is no text
    return value


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


# --- sizes ------------------------------------------------------------------------------------------------------------


def _check_fit(fit: Fit) -> None:
    """ValueError if sizes, names or times do not fit one another."""
    d, experiments = len(fit.theta_names), len(fit.trajectories)
    unknowns = f"since fit.theta_names has {d} entries"
    _check_size("fit.theta_units", fit.theta_units, (d,), unknowns)
    for name in ("initial_theta", "theta", "lower", "upper", "gradient"):
        _check_size(f"fit.{name}", getattr(fit, name), (d,), unknowns)
    for name in ("hessian", "saved_gauss_newton"):
        if getattr(fit, name) is not None:
            _check_size(f"fit.{name}", getattr(fit, name), (d, d), unknowns)
    for k, record in enumerate(fit.history):
        _check_size(f"fit.history[{k}].theta", record.theta, (d,), unknowns)
    _check_basis(fit.free_basis, d)
    _check_names("fit.kinks", (name for name, _, _ in fit.kinks), fit.theta_names)
    _check_names("fit.priors", fit.priors, fit.theta_names)
    _check_names("fit.log_scaled", fit.log_scaled, fit.theta_names)
    if experiments == 0:
        raise ValueError("fit.trajectories must have one entry or more; got none")
    runs = f"since fit.trajectories has {experiments} entries"
    _check_size("fit.transition_times", fit.transition_times, (experiments,), runs)
    _check_size("fit.comparisons", fit.comparisons, (experiments,), runs)
    for e, (trajectory, times) in enumerate(zip(fit.trajectories, fit.transition_times, strict=True)):
        _check_trajectory(trajectory, times, e)
        for k, comparison in enumerate(fit.comparisons[e]):
            _check_comparison(comparison, f"fit.comparisons[{e}][{k}]")


def _check_trajectory(trajectory: Trajectory, transition_times: FloatArray, e: int) -> None:
    where = f"fit.trajectories[{e}]"
    _check_times(f"{where}.times", trajectory.times)
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
        raise ValueError(f'{where}.kind must be "measurements" or "reference"; got {_shown(comparison.kind)}')
    _check_times(f"{where}.times", comparison.times)
    _check_times(f"{where}.curve_times", comparison.curve_times)
    q, K, L = len(comparison.names), len(comparison.times), len(comparison.curve_times)
    sizes = f"since its times has {K} entries and its names {q}"
    for name in ("measured", "fitted", "sigma", "downweighted"):
        if getattr(comparison, name) is not None:
            _check_size(f"{where}.{name}", getattr(comparison, name), (K, q), sizes)
    _check_size(f"{where}.curve", comparison.curve, (L, q), f"since its curve_times has {L} entries and its names {q}")


def _check_size(where: str, value: Any, shape: tuple[int, ...], reason: str) -> None:
    found = value.shape if isinstance(value, np.ndarray) else (len(value),)
    if found != shape:
        raise ValueError(f"{where} must have the shape {shape}, {reason}; got {found}")


def _check_times(where: str, times: FloatArray) -> None:
    """Times up to 1e100 in size, beyond which no axis can be drawn."""
    if times.ndim != 1 or not (np.abs(times) < 1e100).all() or np.any(np.diff(times) < 0):
        raise ValueError(f"{where} must be a list of finite numbers (below 1e100) that do not decrease")


def _check_basis(basis: FloatArray, d: int) -> None:
    """Columns of length 1 at right angles to one another."""
    if basis.ndim != 2 or basis.shape[0] != d or basis.shape[1] > d:
        raise ValueError(f"fit.free_basis must have {d} rows and at most as many columns; got the shape {basis.shape}")
    if not (np.abs(basis) <= 2).all() or not np.allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-6):
        raise ValueError("fit.free_basis must have orthonormal columns")


def _check_names(where: str, given: Iterable[str], known: tuple[str, ...]) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"{where} has the name {name!r}, which is none of fit.theta_names")
