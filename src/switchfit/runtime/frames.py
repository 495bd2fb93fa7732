"""Results as DataFrames of pandas, Datasets of xarray and draws of ArviZ.

Results are data and know none of these libraries. `describe_frame` lists the numbers of a result with their dimensions
and units, by a function that a module of `switchfit.report` has registered for each kind of result, and `build_pandas`
and `build_xarray` make the same list into either. The libraries are imported when they are needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import singledispatch
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from switchfit.runtime.errors import import_library
from switchfit.runtime.presentation import call_registered

if TYPE_CHECKING:
    import pandas
    import xarray


class Variable(NamedTuple):
    """Numbers or text with a name.

    Attributes
    ----------
    name : str
    values : array_like
        One axis for each of the dimensions.
    dimensions : tuple of str
    unit : str
        Empty where there is none, or where entries differ in it.
    column : str
        Name of a column of a DataFrame, with {} where the label of the last dimension belongs; empty for none.
    """

    name: str
    values: Any
    dimensions: tuple[str, ...]
    unit: str = ""
    column: str = "{}"


class Labels(NamedTuple):
    """Names and units of the entries of a dimension; no units where there are none."""

    names: tuple[str, ...]
    units: tuple[str, ...] = ()


@dataclass(frozen=True)
class Frame:
    """The numbers of a result as a table whose rows lie along one dimension.

    Attributes
    ----------
    rows : str
        The dimension of the rows.
    index : tuple of Variable
        What identifies a row.
    variables : tuple of Variable
        With dimensions (rows,), (rows, labels), or others, which are not in a DataFrame.
    labels : mapping of str to Labels
        Of the other dimensions.
    attributes : mapping of str to str or float
    """

    rows: str
    index: tuple[Variable, ...]
    variables: tuple[Variable, ...]
    labels: Mapping[str, Labels] = field(default_factory=dict)
    attributes: Mapping[str, str | float] = field(default_factory=dict)


@singledispatch
def describe_frame(result: Any, **settings: Any) -> Frame:
    """Return the numbers of a result with their names, dimensions and units.

    Parameters
    ----------
    result : object
        Of a kind that a module of `switchfit.report` has registered.
    settings
        Keyword arguments of the registered function.
    """
    frame: Frame = call_registered(describe_frame, result, **settings)
    return frame


class Tabular:
    """Results that can be converted to objects of pandas and xarray."""

    def to_pandas(self) -> pandas.DataFrame:
        """Return the numbers as a DataFrame; units are in ``.attrs["units"]``, by the names of the columns.

        The page "Data out" of the documentation lists the columns of each kind of result.

        Raises
        ------
        ImportError
            If pandas is not installed.

        See Also
        --------
        Estimate.to_pandas, Trajectory.to_xarray

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem

        >>> table = sf.simulate(heater_problem()).to_pandas()
        >>> list(table.columns), table.index.name, table.attrs["units"]
        (['mode', 'T'], 'time', {'time': 'h', 'T': 'K'})
        """
        return build_pandas(describe_frame(self))

    def to_xarray(self) -> xarray.Dataset:
        """Return the numbers as a Dataset; each variable has its unit in ``.attrs["units"]``.

        Raises
        ------
        ImportError
            If xarray is not installed.

        See Also
        --------
        Estimate.to_xarray, Trajectory.to_pandas

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem

        >>> found = sf.simulate(heater_problem()).to_xarray()
        >>> found["T"].dims, found["T"].attrs
        (('time',), {'units': 'K'})
        """
        return build_xarray(describe_frame(self))


def build_pandas(frame: Frame) -> pandas.DataFrame:
    """Return a frame as a DataFrame.

    Parameters
    ----------
    frame : Frame

    Raises
    ------
    MissingExtraError
        If pandas is not installed.
    """
    pandas = import_library("pandas", "a DataFrame", "pandas")
    units = {variable.name: variable.unit for variable in frame.index if variable.unit}
    index = {variable.name: np.asarray(variable.values) for variable in frame.index}
    columns: dict[str, Any] = {}
    for name, values, unit in _list_columns(frame, set(index)):
        columns[name] = np.asarray(values)
        if unit:
            units[name] = unit
    table = pandas.DataFrame({**index, **columns}).set_index(list(index))
    table.attrs = {**frame.attributes, "units": units}
    return table


def _list_columns(frame: Frame, taken: set[str]) -> Iterator[tuple[str, Any, str]]:
    """Yield name, values and unit of each column; a name that is taken gets that of its variable after it."""
    for variable in frame.variables:
        if variable.dimensions == (frame.rows,):
            yield _choose_name(variable.name, variable.name, taken), variable.values, variable.unit
        elif variable.column and len(variable.dimensions) == 2:
            labels = frame.labels[variable.dimensions[1]]
            units = labels.units or ("",) * len(labels.names)
            for k, (label, unit) in enumerate(zip(labels.names, units, strict=True)):
                name = _choose_name(variable.column.format(label), variable.name, taken)
                yield name, np.asarray(variable.values)[:, k], unit


def _choose_name(name: str, variable: str, taken: set[str]) -> str:
    """Return a name that no other column has, and enter it."""
    if name in taken:
        name = f"{name} ({variable})"
    number, unique = 1, name
    while unique in taken:
        number += 1
        unique = f"{name} {number}"
    taken.add(unique)
    return unique


def build_xarray(frame: Frame) -> xarray.Dataset:
    """Return a frame as a Dataset; the labels of a dimension have their units beside them, as "unit" or "NAME_unit".

    Parameters
    ----------
    frame : Frame

    Raises
    ------
    MissingExtraError
        If xarray is not installed.
    """
    xarray = import_library("xarray", "a Dataset", "xarray")
    coordinates = {
        variable.name: (frame.rows, np.asarray(variable.values), _make_attributes(variable.unit))
        for variable in frame.index
    }
    for dimension, labels in frame.labels.items():
        coordinates[dimension] = (dimension, np.array(labels.names, dtype=str), {})
        if any(labels.units):
            coordinates[f"{dimension}_unit"] = (dimension, np.array(labels.units, dtype=str), {})
    taken = set(coordinates)
    variables = {}
    for variable in frame.variables:
        name = _choose_name(variable.name, "value", taken)
        variables[name] = (variable.dimensions, np.asarray(variable.values), _make_attributes(variable.unit))
    return xarray.Dataset(variables, coordinates, dict(frame.attributes))


def _make_attributes(unit: str) -> dict[str, str]:
    return {"units": unit} if unit else {}


def build_arviz(draws: Iterable[Variable], attributes: Mapping[str, str]) -> Any:
    """Return draws as ArviZ takes them, as InferenceData.

    Parameters
    ----------
    draws : iterable of Variable
        With dimensions ("chain", "draw").
    attributes : mapping of str to str
        What the draws are.

    Raises
    ------
    MissingExtraError
        If ArviZ or xarray is not installed.
    """
    xarray, arviz = (
        import_library("xarray", "draws for ArviZ", "xarray"),
        import_library("arviz", "draws for ArviZ", "arviz"),
    )
    posterior = {each.name: (each.dimensions, each.values, _make_attributes(each.unit)) for each in draws}
    chains, size = next((np.shape(values) for _, values, _ in posterior.values()), (0, 0))
    places = {"chain": np.arange(chains), "draw": np.arange(size)}
    return arviz.InferenceData(posterior=xarray.Dataset(posterior, places, dict(attributes)))
