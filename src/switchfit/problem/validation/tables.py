"""Tables of other libraries (pandas, polars, xarray, our own logs): their columns, names and units.

None of these libraries is imported: an object is known by the package of its class.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

LIBRARIES = frozenset({"pandas", "polars", "xarray", "switchfit"})


def is_of_library(value: object, *names: str) -> bool:
    """Return whether the class of an object, or one that it is derived from, is of one of the packages."""
    return any(kind.__module__.partition(".")[0] in names for kind in type(value).__mro__)


def list_columns(value: object) -> list[tuple[object, object]] | None:
    """Return (name, column) of each column of a table; None for anything else.

    Tables are DataFrames of pandas and polars, Datasets of xarray and logs.
    """
    if not is_of_library(value, *LIBRARIES):
        return None
    table: Any = value  # of a library that is not imported here
    if hasattr(table, "data_vars"):
        return list(table.data_vars.items())
    if not hasattr(table, "columns"):
        return None
    if hasattr(table, "iloc"):  # in pandas, names may be anything, and stand there twice
        return [(name, table.iloc[:, k]) for k, name in enumerate(table.columns)]
    return [(name, table[name]) for name in table.columns]


def find_labels(value: object) -> tuple[tuple[str, ...] | None, tuple[str, ...] | None]:
    """Return the names and the units of the columns of a table, or of the one column that it is.

    Names are None unless all are strings and differ; an array of xarray with labels along its second dimension has
    these. Units are in ``attrs["units"]`` of the table or the column, a string or a mapping from names to units; they
    are None where no unit is given.
    """
    channels = list_columns(value)
    if channels is None and is_of_library(value, *LIBRARIES):
        channels = [(getattr(value, "name", None), value)]
        if getattr(value, "ndim", 1) == 2:
            array: Any = value  # of xarray
            channels = [(label.item(), array) for label in array.coords.get(array.dims[1], ())]
    channels = channels or []
    names = [name for name, _ in channels]
    proper = all(isinstance(name, str) and name.strip() for name in names) and len(set(names)) == len(names)
    units = tuple(_find_unit(column, name) or _find_unit(value, name) for name, column in channels)
    return tuple(map(str, names)) if names and proper else None, units if any(units) else None


def _find_unit(value: object, name: object) -> str:
    attributes = getattr(value, "attrs", None)
    units = attributes.get("units", "") if isinstance(attributes, Mapping) else ""
    unit = units.get(name, "") if isinstance(units, Mapping) else units
    return unit if isinstance(unit, str) else ""
