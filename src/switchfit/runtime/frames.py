"""Results as DataFrames of pandas.

Results are data and do not know pandas. `describe_frame` lists the columns of a result, by a function that a module of
`switchfit.report` has registered for each kind of result, and `build_pandas` makes a DataFrame of them. pandas is
imported when it is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import singledispatch
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.runtime.extras import import_library
from switchfit.runtime.presentation import call_registered

if TYPE_CHECKING:
    import pandas


class Column(NamedTuple):
    """Name, values (one a row) and unit of a column, empty where there is none, or where rows differ in it."""

    name: str
    values: NDArray[Any]
    unit: str = ""


@dataclass(frozen=True)
class Frame:
    """The numbers of a result as a table: columns that identify a row, all others, and what is true of the whole."""

    index: tuple[Column, ...]
    columns: tuple[Column, ...]
    attributes: Mapping[str, str | float] = field(default_factory=dict)


@singledispatch
def describe_frame(result: object, **settings: object) -> Frame:
    """Return the numbers of a result with their names and units.

    Parameters
    ----------
    result : object
        Of a kind that a module of `switchfit.report` has registered.
    settings
        Keyword arguments of the registered function.
    """
    return call_registered(describe_frame, result, **settings)


class Tabular:
    """Results that can be converted to a DataFrame."""

    def to_pandas(self) -> pandas.DataFrame:
        """Return the numbers as a DataFrame; units are in ``.attrs["units"]``, by the names of the columns.

        The page "Data out" of the documentation lists the columns of each kind of result.

        Raises
        ------
        ImportError
            If pandas is not installed.

        See Also
        --------
        Estimate.to_pandas

        Examples
        --------
        >>> table = sf.simulate(heater_problem()).to_pandas()
        >>> list(table.columns), table.index.name, table.attrs["units"]
        (['mode', 'T'], 'time', {'time': 'h', 'T': 'K'})
        """
        return build_pandas(describe_frame(self))


def build_pandas(frame: Frame) -> pandas.DataFrame:
    """Return a frame as a DataFrame; a name that another column has already gets a number after it.

    Parameters
    ----------
    frame : Frame

    Raises
    ------
    MissingExtraError
        If pandas is not installed.
    """
    pandas = import_library("pandas", "a DataFrame", "pandas")
    found: dict[str, Any] = {}
    units = {}
    for column in (*frame.index, *frame.columns):
        number, name = 1, column.name
        # A state and a parameter may have one name, and so may outputs of two sensors.
        while name in found:
            number += 1
            name = f"{column.name} {number}"
        found[name] = np.asarray(column.values)
        if column.unit:
            units[name] = column.unit
    table = pandas.DataFrame(found).set_index(list(found)[: len(frame.index)])
    table.attrs = {**frame.attributes, "units": units}
    return table
