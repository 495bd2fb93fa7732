"""Results as DataFrames and CSV, read back by their own readers; many fits saved, printed, drawn."""

import csv
import io
import json
import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pandas as pd
import polars as pl
import pytest
import xarray as xr

import switchfit as sf
from support.commands import log_of, run
from support.equal_fits import CERTIFICATE, assert_same
from support.fits_by_hand import made, several, trajectory_of
from support.log_folders import fill_folder
from support.models import RAMP, heated_room, one_run, temperature
from switchfit.batch import fits as fits_module
from switchfit.batch.archives import compute_seal
from switchfit.cli.tables import write_runs, write_unknowns
from switchfit.fit.result import Fit
from switchfit.models import heater_problem
from switchfit.problem.constraints import ActiveConstraint
from switchfit.runtime.extras import MissingExtraError
from switchfit.uncertainty.corrected_errors import correct_intervals


@pytest.fixture
def folder(tmp_path):
    """Two logs of rooms, their model and a problem."""
    return fill_folder(tmp_path)


pytestmark = pytest.mark.usefixtures("fits_one_by_one")


def as_estimate(fit):
    return sf.Estimate(**{f.name: getattr(fit, f.name) for f in fields(Fit)}, saved_certificate=CERTIFICATE)


@pytest.fixture(scope="module")
def studies(heater):
    """One of each kind of fits."""
    problem = heater_problem()
    return {
        "Fits": sf.estimate_many([problem, problem]),
        "MonteCarlo": sf.monte_carlo(problem, 6, theta=[2.5, 0.4]),
        "Bootstrap": sf.bootstrap(heater, 6),
        "Multistart": sf.multistart(problem, 4),
    }


# --- single fits ------------------------------------------------------------------------------------------------------


def test_the_table_of_the_unknowns(heater):
    """One that is held has no error."""
    table = heater.to_pandas()
    assert list(table.index) == ["tau_1", "k"]
    assert table["value"].tolist() == heater.theta.tolist()
    rest = {"unit": ["h", "1/h"], "guess": [2.0, 0.5], "transition": ["on -> off", ""]}
    assert {name: table[name].tolist() for name in rest} == rest
    assert (table.attrs["verdict"], table.attrs["cost"]) == ("good", heater.cost)
    active = (ActiveConstraint("lower bound", 0.05, "mu", multiplier=3.0),)
    table = as_estimate(made(active=active, free_basis=np.eye(3)[:, :2], idle=("tau_2",))).to_pandas()
    assert table["held"].tolist() == ["", "idle", "at lower bound"]
    assert np.isnan(table.loc["mu", ["std_error", "low", "high"]].astype(float)).all()


@pytest.mark.parametrize("what", ["unknowns", "trajectories", "residuals", "history"])
def test_tables_of_a_fit_come_back_from_their_files(heater, what, tmp_path):
    table = heater.to_pandas(what)
    again = pd.read_csv(io.StringIO(table.to_csv()), index_col=list(range(table.index.nlevels)))
    assert list(again.columns) == list(table.columns)
    for name in table.select_dtypes("number"):
        np.testing.assert_allclose(again[name], table[name], rtol=1e-15, err_msg=name)
    table.to_parquet(tmp_path / "table.parquet")
    stored = pd.read_parquet(tmp_path / "table.parquet")
    pd.testing.assert_frame_equal(stored, table)
    assert stored.attrs == table.attrs


def test_a_table_or_a_library_that_is_not_there(heater, monkeypatch):
    with pytest.raises(ValueError, match="what must be one of unknowns, trajectories, residuals, history; got"):
        heater.to_pandas("theta")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match=r"needs pandas, which cannot .*: pip install pandas"):
        heater.to_pandas()


def test_states_that_are_called_like_other_columns():
    path = replace(trajectory_of(), state_names=("mode", "time"))
    table = path.to_pandas()
    assert list(table.columns) == ["mode", "mode 2", "time 2"]
    np.testing.assert_array_equal(table["mode 2"], path.states[:, 0])
    several_alike = replace(trajectory_of(), state_names=("x", "x"))
    assert list(several_alike.to_pandas().columns) == ["mode", "x", "x 2"]


def test_a_trajectory_goes_back_in_as_data_with_its_names_and_units():
    path = sf.simulate(heater_problem(), times=[1.0, 2.0, 3.0])
    table = path.to_pandas()
    data = sf.Measurements(table.index, table[["T"]], sigma=0.1)
    assert (data.names, data.units) == (("T",), ("K",))
    np.testing.assert_array_equal(data.values, path.states)


def test_predictions_and_profiles_as_tables(heater):
    prediction, profile = heater.predict([1.0, 4.0]), heater.profile("k")
    table = prediction.to_pandas()
    np.testing.assert_array_equal(table[["T low", "T high"]], prediction.state_band()[:, 0])
    bands = table[["thermometer output low", "thermometer output high"]]
    np.testing.assert_array_equal(bands, prediction.output_band()[:, 0])
    assert table.attrs["units"]["T std. error"] == "K"
    table = profile.to_pandas()
    assert (table.index.name, list(table.columns)) == ("k", ["cost", "zeta", "converged", "tau_1"])
    assert (table.attrs["low"], table.attrs["high"]) == profile.interval()
    assert table.attrs["units"]["k"] == "1/h"


# --- many fits --------------------------------------------------------------------------------------------------------

KINDS = ["Fits", "MonteCarlo", "Bootstrap", "Multistart"]


@pytest.mark.parametrize("kind", KINDS)
def test_many_fits_have_a_row_each_and_come_back_to_the_bit(studies, kind, tmp_path):
    fits, path = studies[kind], tmp_path / "fits.npz"
    table = fits.to_pandas()
    np.testing.assert_array_equal(table[["tau_1", "k"]], fits.theta)
    np.testing.assert_array_equal(table["k std. error"], fits.standard_errors[:, 1])
    np.testing.assert_array_equal(table[["k low", "k high"]], fits.confidence_intervals()[:, 1])
    assert table["level"].tolist() == fits.levels.tolist()
    assert table.attrs["units"]["k std. error"] == "1/h"
    assert ("cluster" in table) == (kind == "Multistart")
    fits.save(str(path))
    again = sf.Fits.load(path)
    assert type(again) is type(fits)
    for f in fields(fits):
        if f.name != "best":
            assert_same(getattr(fits, f.name), getattr(again, f.name))
    if kind == "Multistart":
        for f in fields(Fit):
            assert_same(getattr(fits.best.complete(), f.name), getattr(again.best, f.name))
        replace(fits, best=None).save(path)
        assert sf.Multistart.load(path).best is None
    assert str(again) == str(fits)
    assert again.plot().axes


def test_trajectories_and_residuals_of_all_runs_are_in_one_table_and_the_history_in_another(heater):
    fit = as_estimate(several(3))
    table = fit.to_pandas("trajectories")
    assert table.index.names == ["run", "time"]
    second = table.loc["run2"]
    np.testing.assert_array_equal(second[["X", "dX"]], fit.trajectories[1].states)
    assert second["mode"].tolist() == fit.trajectories[1].modes.tolist()
    table = fit.to_pandas("residuals")
    assert table.index.names == ["run", "channel", "time"]
    np.testing.assert_allclose(table["residual"], table["measured"] - table["fitted"], atol=1e-15)
    np.testing.assert_allclose(table["standardized"], table["residual"] / 0.1)
    table = heater.to_pandas("history")
    assert table["cost"].tolist() == [record.cost for record in heater.history]
    np.testing.assert_array_equal(table[["tau_1", "k"]], [record.theta for record in heater.history])


def rewrite(path, change_header=None, *, seal=True, **changes):
    """The file with some arrays changed, and sealed again; `change_header` is a function of its JSON."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files} | changes
    if change_header is not None:
        content = json.loads(arrays["header"].tobytes())
        change_header(content)
        arrays["header"] = np.frombuffer(json.dumps(content).encode(), dtype=np.uint8)
    arrays = {name: array for name, array in arrays.items() if array is not None}
    old = arrays.pop("seal")
    np.savez(path, **arrays, seal=np.array(compute_seal(arrays)) if seal else old)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"covariance": None}, ".*missing 1 required positional argument: 'covariance'"),
        ({"change_header": lambda c: c["fits"].update(seconds="long")}, "fits is not what was written"),
        ({"cost": np.zeros(2), "seal": False}, "its content is not what was written"),
    ],
)
def test_fits_that_are_damaged(studies, change, message, tmp_path):
    path = tmp_path / "fits.npz"
    studies["Fits"].save(path)
    rewrite(path, **change)
    with pytest.raises(ValueError, match=f"fits.npz is damaged: {message}"):
        sf.Fits.load(path)


def test_files_that_hold_no_fits(studies, heater, tmp_path, monkeypatch):
    path = tmp_path / "fits.npz"
    studies["MonteCarlo"].save(path)
    whole = path.read_bytes()
    with pytest.raises(ValueError, match=r"holds the kind of fits 'MonteCarlo', not Bootstrap: sf\.Fits\.load reads"):
        sf.Bootstrap.load(path)
    monkeypatch.setattr(fits_module, "FITS_VERSION", 4)
    with pytest.raises(ValueError, match="is a file of saved fits of version 3; this switchfit reads version 4"):
        sf.Fits.load(path)
    heater.save(tmp_path / "fit.json")
    np.savez(tmp_path / "pickle.npz", header=np.array([{}], dtype=object))
    others = [(tmp_path / name).read_bytes() for name in ("fit.json", "pickle.npz")]
    for content in (b"", whole[: len(whole) // 2], np.lib.format.magic(1, 0), *others):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"fits\.npz does not hold saved fits"):
            sf.Fits.load(path)


# --- simulation at given times ----------------------------------------------------------------------------------------


def test_fits_print_as_a_table_and_the_worst_come_first(studies):
    lines = str(studies["Fits"]).splitlines()
    assert lines[lines.index("") + 1].split() == ["run", "J", "tau_1", "(h)", "k", "(1/h)"]
    assert [row.split()[:3] for row in lines[lines.index("") + 2 :]] == [[run, "good", "6.03062"] for run in "01"]
    study = studies["MonteCarlo"]
    cost, explained, status = study.cost.copy(), study.explained.copy(), study.status.astype("U20")
    cost[4], explained[4], status[2] = 1e4, 0.3, "MAX_ITERATIONS"
    assert replace(study, cost=cost, explained=explained, status=status).worst_first[:2].tolist() == [2, 4]


def test_a_simulation_at_given_times_is_that_of_the_nodes(heater):
    problem = heater_problem()
    times = np.array([0.0, 1.0, 2.0, 2.5, 4.1, 6.0])
    path = sf.simulate(problem, [2.5, 0.4], times=times)
    rising = np.minimum(times, 2.5)
    exact = 25.0 * (1.0 - np.exp(-0.4 * rising)) * np.exp(-0.4 * (times - rising))
    np.testing.assert_allclose(path.states[:, 0], exact, rtol=1e-8, atol=1e-8)
    assert path.modes.tolist() == ["on", "on", "on", "on", "off", "off"]  # at the transition that before it
    assert path.mode_spans == [("on", 0.0, 2.5), ("off", 4.1, 6.0)]
    late = sf.simulate(problem, [2.5, 0.4], times=[5.0])
    assert late.segments.tolist() == [0, 0, 1]
    assert late.mode_spans == [("off", 5.0, 5.0)]
    path = sf.simulate(heater.problem, heater.theta, times=heater.comparisons[0][0].times)
    np.testing.assert_array_equal(path.times, heater.comparisons[0][0].times)
    np.testing.assert_allclose(path.states, heater.comparisons[0][0].fitted, rtol=1e-8)


def test_a_simulation_up_to_a_free_tf_and_times_outside():
    end, constant = sf.Parameter(1.7, lower=1.0, upper=5.0), {"v": sf.Parameter(2.0, fixed=True)}
    problem = one_run(RAMP, sf.TerminalCost(lambda x, p: (x[0] - 3.0) ** 2), ("up",), (), end, constant)
    path = sf.simulate(problem, times=[0.0, 1.0, 1.7])
    np.testing.assert_allclose(path.states[:, 0], [0.0, 2.0, 3.4], rtol=1e-9)
    inside = r"times must increase strictly inside \[t0, tf\] = "
    for given, times, message in (
        (problem, [2.0], inside + r"\[0.0, 1.7\] s; got 2.0"),
        (heater_problem(), [-1.0], inside + r"\[0.0, 6.0\] h; got -1.0"),
        (heater_problem(), [1.0, 1.0], inside + r"\[0.0, 6.0\] h; got 1.0"),
        (heater_problem(), [], r"times must be finite numbers of shape \(K,\); got shape \(0,\)"),
        (problem, "samples", "times='samples' needs Measurements, and experiment 0 has none"),
    ):
        with pytest.raises(ValueError, match=message):
            sf.simulate(given, times=times)


# --- command line -----------------------------------------------------------------------------------------------------


def test_simulate_writes_the_times_that_are_asked_for(folder):
    (folder / "problem.toml").write_text((folder / "problem.toml").read_text().replace("log.csv", "logs/monday.csv"))
    out = folder / "path.csv"
    for given, times in (("0.5", np.arange(0.0, 6.25, 0.5)), ("4", [0.0, 4.0])):
        result = run("simulate", folder / "problem.toml", "--out", out, "--times", given, code=0)
        np.testing.assert_allclose(pd.read_csv(out)["t"], times)
    for wrong in ("often", "0", "-1", "nan", "1e-9"):
        result = run("simulate", folder / "problem.toml", "--out", out, f"--times={wrong}", code=2)
        assert "--times must be " in result.stderr


def test_the_table_of_logs_is_complete_and_may_be_parquet(folder, monkeypatch):
    (folder / "logs" / "sunday.csv").write_text("t;T\n0;1\n1;cold\n")

    def fit(name):
        return run("fit", folder / "logs", "--problem", folder / "problem.toml", "--table", folder / name, code=2)

    fit("table.csv")
    fit("table.parquet")
    written, parquet = pd.read_csv(folder / "table.csv"), pd.read_parquet(folder / "table.parquet")
    assert list(parquet.columns) == list(written.columns)
    assert parquet["verdict"].tolist() == ["good", "refused", "good"]
    for name in ("chi2", "t0", "tf", "seconds", "tau_1 (s)", "tau_1 (s) std. error", "heating"):
        for table in (parquet, written):
            assert np.isfinite(table[name]).tolist() == [True, False, True], name
    assert written["degrees of freedom"].dropna().tolist() == [10, 10]
    np.testing.assert_allclose(written["chi2"].dropna(), 2 * written["cost"].dropna(), rtol=1e-12)
    assert "cold" in parquet["message"][1]
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    assert "pip install 'switchfit[parquet]', or give the table a name that ends in .csv" in fit("new.parquet").stderr


# --- runs.csv and unknowns.csv ---------------------------------------------------------------------------------------

TIMES = np.linspace(0.25, 6.0, 24)


ROOM = heated_room()


@pytest.fixture(scope="module")
def estimate():
    """Five rooms: the time of the third is known, the fourth is far from the model, the fifth at its bound."""
    rng, runs, own = np.random.default_rng(0), [], {}
    for e in range(5):
        tau, power = 2.0 + 0.4 * e, 1.0 + 0.1 * e
        values = temperature(TIMES, tau, power, 0.5) + 0.02 * rng.standard_normal(24)
        values += 0.2 * np.sin(3 * TIMES) * (e == 3)
        guess = sf.Parameter(tau, fixed=True) if e == 2 else 3.0
        data = sf.Measurements(TIMES, values, sigma=0.02)
        given = {"parameter_map": {"power": f"power_{e}"}, "name": f"room{e}", "time_unit": "h"}
        runs.append(sf.Experiment(data, ("on", "off"), (guess,), 0.0, 6.0, **given))
        own[f"power_{e}"] = sf.Parameter(1.0, lower=0.1, upper=1.2 if e == 4 else 5.0, unit="K/h")
    return sf.estimate(sf.Problem(ROOM, runs, {"k": 0.5, **own}), strategy="local")


def read(text):
    header, *rows = csv.reader(io.StringIO(text))
    assert all(len(row) == len(header) for row in rows)
    return [dict(zip(header, row, strict=True)) for row in rows]


def test_the_file_of_unknowns_is_the_table_to_the_last_digit(estimate):
    """The interval is that of the report; what is held has neither error nor interval."""
    rows, table = read(write_unknowns(estimate)), estimate.to_pandas().reset_index()
    assert list(rows[0]) == list(table.columns)
    for name in table:
        cells = ["" if pd.isna(cell) else str(cell) for cell in table[name].tolist()]
        assert [row[name] for row in rows] == cells
    free = table["held"] == ""
    np.testing.assert_array_equal(table.loc[free, ["low", "high"]], correct_intervals(estimate)[free])
    np.testing.assert_array_equal(table.loc[free, "std_error"], estimate.corrected_standard_errors[free])
    np.testing.assert_array_equal(table.loc[free, "naive_std_error"], estimate.standard_errors[free])
    assert dict(zip(table["unknown"], table["held"], strict=True))["power_4"] == "at upper bound"


def test_runs_have_how_well_they_fit(estimate):
    rows = read(write_runs(estimate))
    assert [row["run"] for row in rows] == [f"room{e}" for e in range(5)]
    for row, (comparison,) in zip(rows, estimate.comparisons, strict=True):
        residuals, measured = comparison.residuals, comparison.measured
        assert float(row["chi2"]) == pytest.approx(np.sum((residuals / 0.02) ** 2))
        total = np.sum((measured - measured.mean()) ** 2)
        assert float(row["explained"]) == pytest.approx(1 - np.sum(residuals**2) / total)
    assert sum(float(row["chi2"]) for row in rows) == pytest.approx(2 * estimate.cost)


def test_the_command_writes_them_where_they_are_many(folder):
    """Twelve logs of one experiment."""
    for e in range(10):
        (folder / "logs" / f"log_{e}.csv").write_text(log_of(2.0 + 0.1 * e))
    text = (folder / "problem.toml").read_text().replace("log.csv", "logs/*.csv")
    (folder / "problem.toml").write_text(f'{text}\n[options]\nstrategy = "local"\n')
    out = folder / "out"
    done = run("fit", folder / "problem.toml", "--out", out, "--no-figures", code=0)
    assert sorted(path.name for path in out.iterdir()) == ["estimate.json", "report.txt", "runs.csv", "unknowns.csv"]
    said = " ".join(done.stdout.split())
    assert "and 9 more experiments" in said
    assert "more unknowns" in said
    assert [len(read((out / name).read_text())) for name in ("runs.csv", "unknowns.csv")] == [12, 13]


# --- tables where arrays are taken: numbers, names and units arrive ---------------------------------------------------

CLOCK = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
X, Y = np.sin(CLOCK), np.cos(CLOCK)
UNITS = {"x": "m", "y": "rad"}


def pandas_table():
    table = pd.DataFrame({"x": X, "y": Y}, index=pd.Index(CLOCK, name="t"), dtype="Float64")
    table["x"].attrs["units"] = "ignored: pandas hands out a new column every time"
    table.attrs["units"] = UNITS
    return table.index, table


def polars_table():
    table = pl.DataFrame({"t": CLOCK, "x": X, "y": Y})
    return table["t"], table[["x", "y"]]


def xarray_dataset():
    data = xr.Dataset({"x": ("t", X), "y": ("t", Y)}, coords={"t": CLOCK})
    for name, unit in UNITS.items():
        data[name].attrs["units"] = unit
    return data["t"], data


def xarray_array():
    coordinates = {"t": CLOCK, "channel": ["x", "y"]}
    data = xr.DataArray(np.stack([X, Y], axis=1), coords=coordinates, dims=tuple(coordinates), name="pose")
    data.attrs["units"] = UNITS
    return data["t"], data


def log(tmp_path):
    path = tmp_path / "a.csv"
    rows = [f"{t!r},{x!r},{y!r}\n" for t, x, y in zip(CLOCK.tolist(), X.tolist(), Y.tolist(), strict=True)]
    path.write_text("t,x [m],y [rad]\n" + "".join(rows))
    found = sf.read_log(path)
    return found.times, found[["x", "y"]]


TABLES = [pandas_table, polars_table, xarray_dataset, xarray_array, log]


@pytest.mark.parametrize("make", TABLES, ids=lambda make: make.__name__)
def test_numbers_names_and_units_arrive(make, tmp_path):
    times, values = make(tmp_path) if make is log else make()
    units, array = (None if make is polars_table else ("m", "rad")), np.stack([X, Y], axis=1)
    data = sf.Measurements(times, values, sigma=0.1)
    np.testing.assert_array_equal(data.times, CLOCK)
    np.testing.assert_array_equal(data.values, array)
    assert (data.names, data.units) == (("x", "y"), units)
    renamed = sf.Measurements(times, values, names=("a", "b"), units=("km", "deg"), sigma=0.5 + np.abs(array))
    assert (renamed.names, renamed.units, renamed.sigma.shape) == (("a", "b"), ("km", "deg"), (5, 2))
    reference = sf.ReferenceSignal.from_samples(times, values)
    np.testing.assert_allclose(reference.signal(CLOCK), array, atol=1e-14)
    assert (reference.names, reference.units) == (("x", "y"), units)
    inputs = sf.Input(times, values, kind="linear")
    assert inputs.units == units
    assert inputs.names in (("x", "y"), ())  # an array of xarray is an array
    np.testing.assert_array_equal(inputs.signal(0.0, 2.0)(CLOCK)[:, 1], Y)


def test_names_and_units_that_are_not_given_for_each():
    """Units follow their names; what is no name is none."""
    table = pd.DataFrame({"b": X, "a": Y})
    table.attrs["units"] = {"a": "m", "b": "rad"}
    inputs = sf.Input(CLOCK, table)
    assert dict(zip(inputs.names, inputs.units, strict=True)) == {"a": "m", "b": "rad"}
    twice = pd.DataFrame(np.stack([X, Y], axis=1), columns=["x", "x"])
    for values in (pd.DataFrame({0: X, 1: Y}), pd.Series(X), pl.Series(X), twice):
        assert sf.Measurements(CLOCK, values).names is None
    with pytest.raises(ValueError, match=r"units must have one entry for each of the 1 channels; got \('m', 's'\)"):
        sf.Measurements(CLOCK, X, units=("m", "s"))
    with pytest.raises(TypeError, match="each of units must be a string; got 3"):
        sf.Input(CLOCK, X, units=[3])


@pytest.mark.parametrize(
    "column",
    [pd.Series(X, name="x"), pl.Series("x", X), xr.DataArray(X, dims="t", name="x", attrs={"units": "m"})],
    ids=["pandas", "polars", "xarray"],
)
def test_single_columns(column):
    data = sf.Measurements(CLOCK, column)
    np.testing.assert_array_equal(data.values[:, 0], X)
    assert (data.names, data.units) == (("x",), ("m",) if isinstance(column, xr.DataArray) else None)
    assert sf.Input(CLOCK, column).shape == ()


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
    data = sf.Measurements(CLOCK, values)
    np.testing.assert_array_equal(data.values[:, 0], [1, np.nan, 3, 4, 5])
    with pytest.raises(ValueError, match=r"Input 'x' values must be finite|Input values must be finite"):
        sf.Input(CLOCK, values)


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
