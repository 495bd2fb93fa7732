"""Tables of pandas, polars and xarray, and logs, wherever arrays are taken: numbers, names and units arrive."""

import subprocess
import sys

import numpy as np
import pandas as pd
import polars as pl
import pytest
import xarray as xr

import switchfit as sf

TIMES = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
X, Y = np.sin(TIMES), np.cos(TIMES)
UNITS = {"x": "m", "y": "rad"}


def pandas_table():
    table = pd.DataFrame({"x": X, "y": Y}, index=pd.Index(TIMES, name="t"), dtype="Float64")
    table["x"].attrs["units"] = "ignored: pandas hands out a new column every time"
    table.attrs["units"] = UNITS
    return table.index, table


def polars_table():
    table = pl.DataFrame({"t": TIMES, "x": X, "y": Y})
    return table["t"], table[["x", "y"]]


def xarray_dataset():
    data = xr.Dataset({"x": ("t", X), "y": ("t", Y)}, coords={"t": TIMES})
    for name, unit in UNITS.items():
        data[name].attrs["units"] = unit
    return data["t"], data


def xarray_array():
    data = xr.DataArray(
        np.stack([X, Y], axis=1), coords={"t": TIMES, "channel": ["x", "y"]}, dims=("t", "channel"), name="pose"
    )
    data.attrs["units"] = UNITS
    return data["t"], data


def log(tmp_path):
    path = tmp_path / "a.csv"
    rows = [f"{t!r},{x!r},{y!r}\n" for t, x, y in zip(TIMES.tolist(), X.tolist(), Y.tolist(), strict=True)]
    path.write_text("t,x [m],y [rad]\n" + "".join(rows))
    found = sf.read_log(path)
    return found.times, found[["x", "y"]]


TABLES = [pandas_table, polars_table, xarray_dataset, xarray_array, log]


@pytest.mark.parametrize("make", TABLES, ids=lambda make: make.__name__)
def test_numbers_names_and_units_arrive(make, tmp_path):
    times, values = make(tmp_path) if make is log else make()
    units, array = (None if make is polars_table else ("m", "rad")), np.stack([X, Y], axis=1)
    data = sf.Measurements(times, values, sigma=0.1)
    np.testing.assert_array_equal(data.times, TIMES)
    np.testing.assert_array_equal(data.values, array)
    assert (data.names, data.units) == (("x", "y"), units)
    renamed = sf.Measurements(times, values, names=("a", "b"), units=("km", "deg"), sigma=0.5 + np.abs(array))
    assert (renamed.names, renamed.units, renamed.sigma.shape) == (("a", "b"), ("km", "deg"), (5, 2))
    reference = sf.ReferenceSignal.from_samples(times, values)
    np.testing.assert_allclose(reference.signal(TIMES), array, atol=1e-14)
    assert (reference.names, reference.units) == (("x", "y"), units)
    inputs = sf.Input(times, values, kind="linear")
    assert inputs.units == units
    assert inputs.names in (("x", "y"), ())  # an array of xarray is an array
    np.testing.assert_array_equal(inputs.signal(0.0, 2.0)(TIMES)[:, 1], Y)


def test_names_and_units_that_are_not_given_for_each():
    """Units follow their names; what is no name is none."""
    table = pd.DataFrame({"b": X, "a": Y})
    table.attrs["units"] = {"a": "m", "b": "rad"}
    inputs = sf.Input(TIMES, table)
    assert dict(zip(inputs.names, inputs.units, strict=True)) == {"a": "m", "b": "rad"}
    twice = pd.DataFrame(np.stack([X, Y], axis=1), columns=["x", "x"])
    for values in (pd.DataFrame({0: X, 1: Y}), pd.Series(X), pl.Series(X), twice):
        assert sf.Measurements(TIMES, values).names is None
    with pytest.raises(ValueError, match=r"units must have one entry for each of the 1 channels; got \('m', 's'\)"):
        sf.Measurements(TIMES, X, units=("m", "s"))
    with pytest.raises(TypeError, match="each of units must be a string; got 3"):
        sf.Input(TIMES, X, units=[3])


@pytest.mark.parametrize(
    "column",
    [pd.Series(X, name="x"), pl.Series("x", X), xr.DataArray(X, dims="t", name="x", attrs={"units": "m"})],
    ids=["pandas", "polars", "xarray"],
)
def test_single_columns(column):
    data = sf.Measurements(TIMES, column)
    np.testing.assert_array_equal(data.values[:, 0], X)
    assert (data.names, data.units) == (("x",), ("m",) if isinstance(column, xr.DataArray) else None)
    assert sf.Input(TIMES, column).shape == ()


@pytest.mark.parametrize(
    "values",
    [
        pd.DataFrame({"x": pd.array([1, None, 3, 4, 5], dtype="Int64")}),
        pl.DataFrame({"x": [1, None, 3, 4, 5]}),
        pl.Series("x", [1.0, None, 3, 4, 5]),
        xr.DataArray([1, np.nan, 3, 4, 5], name="x"),
    ],
)
def test_missing_values(values):
    data = sf.Measurements(TIMES, values)
    np.testing.assert_array_equal(data.values[:, 0], [1, np.nan, 3, 4, 5])
    with pytest.raises(ValueError, match=r"Input 'x' values must be finite|Input values must be finite"):
        sf.Input(TIMES, values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (pl.DataFrame({"x": ["a"] * 5}), "Measurements values must be an array of numbers"),
        (pl.DataFrame({"x": [True] * 5}), "Measurements values must be an array of numbers"),
        (xr.DataArray(X.astype(np.float32)), "Measurements values must be in double precision"),
        (pd.Series(pd.to_datetime(["2024-05-01"] * 5)), "dates and time differences are not supported"),
    ],
)
def test_what_is_no_number(values, message):
    with pytest.raises((TypeError, ValueError), match=message):
        sf.Measurements(TIMES, values)


def test_a_log_as_a_table(tmp_path):
    """The same measurements from both; of the libraries none is imported for it."""
    times, channels = log(tmp_path)
    table = channels.to_pandas()
    assert (table.index.name, list(table.columns), table.attrs["units"]) == ("t", ["x", "y"], UNITS)
    one, other = sf.Measurements(times, channels), sf.Measurements(table.index, table)
    np.testing.assert_array_equal(one.values, other.values)
    assert (one.names, one.units) == (other.names, other.units)
    code = (
        "import sys, switchfit as sf; log = sf.read_log('a.csv'); sf.Measurements(log.times, log[['x']]);"
        "print([name for name in ('pandas', 'polars', 'xarray', 'pyarrow', 'h5py', 'rosbags') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
