"""Tables of other libraries (pandas, polars, xarray, our own logs): their columns, names and units.

None of these libraries is imported: an object is known by the package of its class.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

LIBRARIES = frozenset({"pandas", "polars", "xarray", "switchfit"})


def is_of_library(value: Any, *names: str) -> bool:
    """Return whether the class of an object, or one that it is derived from, is of one of the packages."""
    return any(kind.__module__.partition(".")[0] in names for kind in type(value).__mro__)


def list_columns(value: Any) -> list[tuple[Any, Any]] | None:
    """Return (name, column) of each column of a table; None for anything else.

    Tables are DataFrames of pandas and polars, Datasets of xarray and logs.
    """
    if not is_of_library(value, *LIBRARIES):
        return None
    if hasattr(value, "data_vars"):
        return list(value.data_vars.items())
    if not hasattr(value, "columns"):
        return None
    if hasattr(value, "iloc"):  # in pandas, names may be anything, and stand there twice
        return [(name, value.iloc[:, k]) for k, name in enumerate(value.columns)]
    return [(name, value[name]) for name in value.columns]


def find_names(value: Any) -> tuple[str, ...] | None:
    """Return the names of the columns of a table, or of the one column that it is, if all are strings and differ.

    An array of xarray with labels along its second dimension has these for names.
    """
    columns = list_columns(value)
    if columns is not None:
        names: tuple[Any, ...] = tuple(name for name, _ in columns)
    elif not is_of_library(value, *LIBRARIES):
        return None
    elif getattr(value, "ndim", 1) == 2:
        names = tuple(_list_labels(value))
    else:
        names = (getattr(value, "name", None),)
    proper = all(isinstance(name, str) and name.strip() for name in names) and len(set(names)) == len(names)
    return tuple(map(str, names)) if names and proper else None


def find_units(value: Any) -> tuple[str, ...] | None:
    """Return the unit of each column from ``attrs["units"]`` of the table or the column; None where no unit is given.

    ``attrs["units"]`` is a string, or a mapping from names to units.
    """
    if not is_of_library(value, *LIBRARIES):
        return None
    columns = list_columns(value)
    if columns is None:
        names = [getattr(value, "name", None)] if getattr(value, "ndim", 1) == 1 else _list_labels(value)
        columns = [(name, value) for name in names]
    units = tuple(_find_unit(column, name) or _find_unit(value, name) for name, column in columns)
    return units if any(units) else None


def _find_unit(value: Any, name: Any) -> str:
    attributes = getattr(value, "attrs", None)
    units = attributes.get("units", "") if isinstance(attributes, Mapping) else ""
    unit = units.get(name, "") if isinstance(units, Mapping) else units
    return unit if isinstance(unit, str) else ""


def _list_labels(value: Any) -> list[Any]:
    """Return the labels along the second dimension of an array of xarray; none if it has no labels."""
    dimensions: tuple[Any, ...] = getattr(value, "dims", ())
    coordinates = getattr(value, "coords", {})
    labels = coordinates[dimensions[1]] if len(dimensions) == 2 and dimensions[1] in coordinates else ()
    return [label.item() for label in labels] if isinstance(labels, Iterable) else []
