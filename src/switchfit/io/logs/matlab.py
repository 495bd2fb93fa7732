"""MATLAB's .mat files: version 5 to 7.2 by SciPy, version 7.3 by h5py."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from switchfit.io.logs import explain_damage, import_library
from switchfit.io.logs.log import Log, Options
from switchfit.io.logs.tables import build_log, find_time_name
from switchfit.problem.validation import join_names, shorten
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors

HDF5 = b"\x89HDF\r\n\x1a\n"

OPAQUE = ("s0", "s1", "s2", "arr")
"""Fields of the array that SciPy returns for an object: its name, its type system, its class, its number."""


def read_mat(path: Path, options: Options) -> Log:
    """Read vectors of one length, one of which is the time, from a .mat file or from a struct in it.

    A matrix with a row or a column for each time becomes channels ``NAME_1``, ``NAME_2``, .... Fields may be grouped
    in structs, as Simulink's "structure with time" has them: ``signals.values``. A struct ``units`` beside the vectors
    has their units.

    Parameters
    ----------
    path : Path
    options : Options
        The topic is the struct; left out, the only one that has times.

    Raises
    ------
    InputError
        If the file cannot be read, or it is not clear which struct is meant.
    """
    contents, time, topic = _load(path), options.time, options.topic
    objects = " ".join(_explain_objects(contents))
    groups = {name: group for name, group in _list_groups(contents).items() if _find_times(group, time)}
    if topic is None and len(groups) != 1:
        what = f"several structs with times ({join_names(name or 'the file itself' for name in groups)})"
        if objects and not groups:
            raise InputError(f"{path}: {objects}")
        raise InputError(
            f"{path} has {what if groups else 'no vector of times'}; its variables are {join_names(contents)}. "
            f"{'Name one: topic = ...' if groups else 'Name the one with the times: time = ...'}"
        )
    chosen = next(iter(groups)) if topic is None else topic
    if chosen not in groups:
        raise InputError(
            f"{path} has no struct {shorten(chosen)} with times; those that have are {join_names(groups)}. "
            f"{objects}".strip()
        )
    group = groups[chosen]
    key = _find_times(group, time) or ""
    times = np.ravel(group[key])
    columns = {key: times}
    for name, value in _flatten(group).items():
        if name != key:
            columns |= _split_channels(name, value, len(times))
    source = f"{path} ({chosen})" if chosen else str(path)
    return build_log(source, columns, _read_units(group), options._replace(time=key))


def _load(path: Path) -> dict[str, Any]:
    with explain_read_errors(path), path.open("rb") as file:
        head = file.read(520)
    with explain_damage(path, "a .mat file"), warnings.catch_warnings():
        if HDF5 in (head[:8], head[512:520]):
            h5py = import_library("h5py", "matlab", f"{path}: a .mat file of version 7.3")
            with h5py.File(path, "r") as file:
                return {name: _read_hdf(h5py, item) for name, item in file.items() if not name.startswith("#")}
        from scipy.io import loadmat  # here, since importing it takes long
        from scipy.io.matlab import MatReadWarning

        warnings.simplefilter("ignore", MatReadWarning)  # of objects, which have no name of their own
        contents = loadmat(path, simplify_cells=True)
    return _mark_objects({name: value for name, value in contents.items() if not name.startswith("__")})


class _Object(NamedTuple):
    """An object of MATLAB, whose content no other program reads: its class."""

    kind: str


def _mark_objects(contents: Mapping[str, Any]) -> dict[str, Any]:
    """Return variables or fields with an `_Object` for each object, which SciPy gives as an array of four entries."""
    found = {}
    for name, value in contents.items():
        if isinstance(value, Mapping):
            value = _mark_objects(value)
        elif isinstance(value, np.ndarray) and value.dtype.names == OPAQUE:
            stored = np.ravel(value)[0]
            name = bytes(stored["s0"]).decode("utf-8", "replace") or name  # a variable's, which SciPy calls "None"
            value = _Object(bytes(stored["s2"]).decode("utf-8", "replace"))
        found[name] = value
    return found


_REMEDIES = {
    "timeseries": "s = struct('t', {0}.Time, 'y', {0}.Data)",
    "timetable": "s = timetable2table({0}); s.Time = seconds(s.Time - s.Time(1)); "
    "s = table2struct(s, 'ToScalar', true)",
    "table": "s = table2struct({0}, 'ToScalar', true)",
}
"""How to make a struct of objects of some classes in MATLAB."""


def _explain_objects(contents: Mapping[str, Any]) -> list[str]:
    """Return for each object what it is, and what to do in MATLAB."""
    found = []
    for name, group in _list_groups(contents).items():
        for key, value in group.items():
            if isinstance(value, _Object):
                whole = f"{name}.{key}" if name else key
                remedy = _REMEDIES.get(value.kind, "s = struct('t', TIMES, 'y', VALUES)").format(whole)
                found.append(
                    f"{whole} is a {value.kind}, an object that only MATLAB reads. In MATLAB, save its numbers: "
                    f"{remedy}; save('log.mat', '-struct', 's')"
                )
    return found


def _read_hdf(h5py: Any, item: Any) -> Any:
    """Return a group as a dict, text as a string, and an array in MATLAB's order of dimensions."""
    if "MATLAB_object_decode" in item.attrs:
        return _Object(bytes(item.attrs["MATLAB_class"]).decode())
    if isinstance(item, h5py.Group):
        return {name: _read_hdf(h5py, entry) for name, entry in item.items()}
    value = np.asarray(item[()]).T
    if item.attrs.get("MATLAB_class") == b"char":
        return "".join(map(chr, value.ravel().tolist()))
    return value


def _list_groups(contents: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return the file itself, called "", and all structs in it by their names."""
    groups: dict[str, Mapping[str, Any]] = {"": contents}
    for name, value in contents.items():
        if isinstance(value, Mapping):
            inside = _list_groups(value)
            groups |= {f"{name}.{inner}" if inner else name: group for inner, group in inside.items()}
    return groups


def _find_times(group: Mapping[str, Any], time: str | None) -> str | None:
    """Return the name of the vector of times in a struct, None if there is none."""
    vectors = [name for name, value in group.items() if _is_vector(value)]
    if time is not None:
        return time if time in vectors else None
    return find_time_name(vectors)


def _is_vector(value: Any) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.dtype.kind in "biuf"
        and value.size > 1
        and value.size == max(value.shape)
    )


def _flatten(group: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arrays of a struct and of structs in it that have no times of their own, by names with dots."""
    found: dict[str, Any] = {}
    for name, value in group.items():
        if isinstance(value, Mapping) and name != "units" and not _find_times(value, None):
            found |= {f"{name}.{inner}": entry for inner, entry in _flatten(value).items()}
        elif isinstance(value, list) and all(isinstance(entry, Mapping) for entry in value):  # an array of structs
            for k, entry in enumerate(value, start=1):
                found |= {f"{name}_{k}.{inner}": inside for inner, inside in _flatten(entry).items()}
        elif isinstance(value, np.ndarray):
            found[name] = value
    return found


def _split_channels(name: str, value: Any, samples: int) -> dict[str, Any]:
    """Return an array with a sample for each time as vectors; nothing for other arrays."""
    value = np.squeeze(value)
    if value.dtype.kind not in "biuf" or samples not in value.shape or value.ndim > 2:
        return {}
    if value.ndim == 1:
        return {name: value}
    rows = value if value.shape[0] == samples else value.T
    return {f"{name}_{k + 1}": rows[:, k] for k in range(rows.shape[1])}


def _read_units(group: Mapping[str, Any]) -> dict[str, str]:
    units = group.get("units", {})
    return {name: unit for name, unit in units.items() if isinstance(unit, str)} if isinstance(units, Mapping) else {}
