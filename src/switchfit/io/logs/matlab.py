"""MATLAB's .mat files: version 5 to 7.2 by SciPy, version 7.3 by h5py."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from switchfit.io.logs.columns import build_log, find_time_name
from switchfit.io.logs.log import Log
from switchfit.io.logs.options import Options
from switchfit.io.logs.refusals import explain_damage
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.runtime.errors import InputError
from switchfit.runtime.extras import import_library
from switchfit.runtime.files import explain_read_errors

MatValue: TypeAlias = Any
"""What a variable or a field of a struct holds, as SciPy or h5py read it: an array, text, or more structs."""

HDF5 = b"\x89HDF\r\n\x1a\n"

OBJECTS = (
    "Objects, such as a timeseries, only MATLAB reads. Save their numbers there: "
    "s = struct('t', ts.Time, 'y', ts.Data); save('log.mat', '-struct', 's')"
)
"""What to do with a file that has no times, or not where they were looked for."""


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
    arrays = dict(_flatten(contents))
    groups = _find_times(arrays, time)
    if topic is None and len(groups) != 1:
        what = f"several structs with times ({join_names(name or 'the file itself' for name in groups)})"
        raise InputError(
            f"{path} has {what if groups else 'no vector of times'}; its variables are {join_names(contents)}. "
            f"{'Name one: topic = ...' if groups else f'Name the one with the times: time = ... {OBJECTS}'}"
        )
    chosen = next(iter(groups)) if topic is None else topic
    if chosen not in groups:
        raise InputError(
            f"{path} has no struct {shorten(chosen)} with times; those that have are {join_names(groups)}. {OBJECTS}"
        )
    key, inside = groups[chosen], f"{chosen}." if chosen else ""
    own = {name.removeprefix(inside): value for name, value in arrays.items() if name.startswith(inside)}
    units = {name.removeprefix("units."): value for name, value in own.items() if isinstance(value, str)}
    times = np.ravel(own.pop(key))
    columns = {key: times}
    for name, value in own.items():
        columns |= _split_channels(name, value, len(times))
    source = f"{path} ({chosen})" if chosen else str(path)
    return build_log(source, columns, units, options._replace(time=key))


def _load(path: Path) -> dict[str, MatValue]:
    with explain_read_errors(path), path.open("rb") as file:
        head = file.read(520)
    with explain_damage(path, "a .mat file"), warnings.catch_warnings():
        # Version 7.3 is HDF5 behind a block of 512 bytes, which other writers leave out.
        if HDF5 in (head[:8], head[512:520]):
            h5py = import_library("h5py", f"{path}: a .mat file of version 7.3", "'switchfit[matlab]'")
            with h5py.File(path, "r") as file:
                return {name: _read_hdf(h5py, item) for name, item in file.items() if not name.startswith("#")}
        from scipy.io import loadmat  # here, since importing it takes long
        from scipy.io.matlab import MatReadWarning

        warnings.simplefilter("ignore", MatReadWarning)  # of objects, which have no name of their own
        contents = loadmat(path, simplify_cells=True)
    return {name: value for name, value in contents.items() if not name.startswith("__")}


def _read_hdf(h5py: ModuleType, item: MatValue) -> MatValue:
    """Return a group as a dict, text as a string, and an array in MATLAB's order of dimensions."""
    # A timeseries or a table: MATLAB stores numbers that only its own classes can look up.
    if "MATLAB_object_decode" in item.attrs:
        return None  # numbers that stand for an object
    if isinstance(item, h5py.Group):
        return {name: _read_hdf(h5py, entry) for name, entry in item.items()}
    # MATLAB stores by columns, HDF5 by rows.
    value = np.asarray(item[()]).T
    if item.attrs.get("MATLAB_class") == b"char":
        return "".join(map(chr, value.ravel().tolist()))
    return value


def _flatten(group: Mapping[str, MatValue], prefix: str = "") -> Iterator[tuple[str, NDArray[Any] | str]]:
    """Yield the arrays and texts in structs, and in arrays of structs, by names with dots."""
    for name, value in group.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name}.")
        # Simulink's signals are an array of structs: signals_1.values, signals_2.values, ...
        elif isinstance(value, list) and all(isinstance(entry, Mapping) for entry in value):
            yield from _flatten({f"{name}_{k}": entry for k, entry in enumerate(value, start=1)}, prefix)
        elif isinstance(value, (np.ndarray, str)):
            yield f"{prefix}{name}", value


def _find_times(arrays: Mapping[str, NDArray[Any] | str], time: str | None) -> dict[str, str]:
    """Return the name of the vector of times in each struct that has one; the file itself is called ""."""
    vectors: dict[str, list[str]] = {}
    for name, value in arrays.items():
        struct, _, own = name.rpartition(".")
        if _is_vector(value) and time in (None, own):
            vectors.setdefault(struct, []).append(own)
    # A struct counts if a vector in it is called like a time, or as the user says.
    found = {struct: find_time_name(names) if time is None else time for struct, names in vectors.items()}
    return {struct: name for struct, name in found.items() if name is not None}


def _is_vector(value: NDArray[Any] | str) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and 1 < value.size == max(value.shape)


def _split_channels(name: str, value: NDArray[Any] | str, samples: int) -> dict[str, NDArray[Any]]:
    """Return an array with a sample for each time as vectors; nothing for other arrays, and for text."""
    array = np.squeeze(np.asarray(value))
    if array.dtype.kind not in "biuf" or samples not in array.shape or array.ndim > 2:
        return {}
    if array.ndim == 1:
        return {name: array}
    # A square matrix is ambiguous: a row for each time is taken, as MATLAB's solvers return it.
    rows = array if array.shape[0] == samples else array.T
    return {f"{name}_{k + 1}": rows[:, k] for k in range(rows.shape[1])}
