"""runs.csv and unknowns.csv: every number of a fit of many runs, where one screen of the report has no room for it."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from models import decay
from typer.testing import CliRunner

import switchfit as sf
from switchfit import cli
from switchfit.io.result_tables import write_runs, write_unknowns
from switchfit.runtime.presentation import format_text
from switchfit.uncertainty.residuals import correct_intervals

pytestmark = pytest.mark.usefixtures("fits_one_by_one")

TIMES = np.linspace(0.25, 6.0, 24)


def heating(t, x, p):
    return p["power"] - p["k"] * x


ROOM = sf.HybridSystem({"on": heating, "off": decay}, [0.2], state_names=("T",), state_units=("K",))


def temperatures(tau, power, k=0.5):
    rising = power / k + (0.2 - power / k) * np.exp(-k * np.minimum(TIMES, tau))
    return rising * np.exp(-k * np.maximum(TIMES - tau, 0.0))


@pytest.fixture(scope="module")
def estimate():
    """Five rooms: the time of the third is known, the fourth is far from the model, the fifth at its bound."""
    rng, runs, own = np.random.default_rng(0), [], {}
    for e in range(5):
        tau, power = 2.0 + 0.4 * e, 1.0 + 0.1 * e
        values = temperatures(tau, power) + 0.02 * rng.standard_normal(24)
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


def test_unknowns_are_all_there_to_the_last_digit(estimate):
    rows = read(write_unknowns(estimate))
    assert [row["unknown"] for row in rows] == list(estimate.theta_names)
    assert [row["unit"] for row in rows] == list(estimate.theta_units)
    assert [float(row["value"]) for row in rows] == estimate.theta.tolist()
    assert [float(row["guess"]) for row in rows] == estimate.initial_theta.tolist()
    free = [k for k, row in enumerate(rows) if not row["held"]]
    errors = [float(rows[k]["std_error"]) for k in free]
    np.testing.assert_array_equal(errors, estimate.corrected_standard_errors[free])
    assert [float(rows[k]["naive_std_error"]) for k in free] == estimate.standard_errors[free].tolist()
    ends = [[float(rows[k][end]) for end in ("low", "high")] for k in free]
    np.testing.assert_array_equal(ends, correct_intervals(estimate)[free])
    held = {row["unknown"]: row["held"] for row in rows if row["held"]}
    assert held["power_4"] == "at upper bound"
    assert rows[0]["transition"] == "on -> off"


def test_runs_have_their_own_unknowns_under_the_names_of_the_model(estimate):
    rows = read(write_runs(estimate))
    assert [row["run"] for row in rows] == [f"room{e}" for e in range(5)]
    place = estimate.theta_names.index
    for e, row in enumerate(rows):
        assert float(row["power (K/h)"]) == estimate.theta[place(f"power_{e}")]
        assert float(row["power (K/h) std. error"]) == estimate.corrected_standard_errors[place(f"power_{e}")]
        if e != 2:
            assert float(row["tau_1 (h)"]) == estimate.theta[place(f"room{e}.tau_1")]
        assert (row["modes"], row["time unit"], row["values"]) == ("on -> off", "h", "24")
        residuals = estimate.comparisons[e][0].residuals
        assert float(row["chi2"]) == pytest.approx(np.sum((residuals / 0.02) ** 2))
        measured = estimate.comparisons[e][0].measured
        assert float(row["explained"]) == pytest.approx(
            1 - np.sum(residuals**2) / np.sum((measured - measured.mean()) ** 2)
        )
    assert rows[2]["tau_1 (h)"] == ""
    assert "k" not in rows[0]  # which all share
    assert sum(float(row["chi2"]) for row in rows) == pytest.approx(2 * estimate.cost)
    flags = [row["flags"] for row in rows]
    assert "residuals of room3 T correlated; chi2 of room3 T too large" in flags[3]
    assert "power (K/h) at upper bound" in flags[4]
    assert all("room3" not in flags[e] for e in (0, 1, 2, 4))


def test_the_report_names_the_files_where_it_leaves_rows_out(estimate):
    files = {"runs": "out/runs.csv", "unknowns": "out/unknowns.csv"}
    text = format_text(estimate, files=files)
    assert "and 2 more experiments, all in out/runs.csv" in text
    assert "more unknowns, all in" not in text  # ten of them are listed
    assert "all in" not in format_text(estimate, full=True, files=files)
    assert "all in" not in estimate.report()


PROBLEM = """
model = "rooms.py:room"
parameters = { k = 0.5, power = { value = 1.1, lower = 0.1 } }

[[experiments]]
mode_sequence = ["on", "off"]
transition_times = [3.0]
t0 = 0.0
tf = 6.0
data = { file = "log_*.csv", time = "t", columns = ["T"], sigma = 0.02 }

[options]
strategy = "local"
"""


def test_the_command_writes_them_where_they_are_many(tmp_path):
    """Twelve logs of one experiment."""
    rng = np.random.default_rng(0)
    for e in range(12):
        values = temperatures(2.0 + 0.1 * e, 1.0) + 0.02 * rng.standard_normal(24)
        table = np.column_stack([TIMES, values])
        np.savetxt(tmp_path / f"log_{e}.csv", table, delimiter=",", header="t,T", comments="")
    (tmp_path / "rooms.py").write_text(
        "import switchfit as sf\n"
        "room = sf.HybridSystem({'on': lambda t, x, p: p['power'] - p['k'] * x,\n"
        "                        'off': lambda t, x, p: -p['k'] * x}, [0.2], state_names=('T',))\n"
    )
    (tmp_path / "problem.toml").write_text(PROBLEM)
    out = tmp_path / "out"
    done = CliRunner().invoke(cli.app, ["fit", str(tmp_path / "problem.toml"), "--out", str(out), "--no-figures"])
    assert done.exit_code == 0, done.output
    assert sorted(path.name for path in out.iterdir()) == ["estimate.json", "report.txt", "runs.csv", "unknowns.csv"]
    said = " ".join(done.stdout.split())
    assert f"and 9 more experiments, all in {out / 'runs.csv'}" in said
    assert f"more unknowns, all in {out / 'unknowns.csv'}" in said
    assert [len(read((out / name).read_text())) for name in ("runs.csv", "unknowns.csv")] == [12, 14]


def test_tables_of_many_fits_leave_transition_times_out_first(estimate):
    assert "more unknowns" not in str(sf.bootstrap(estimate, 3))  # ten
    problem = estimate.problem
    again = [replace(run, transition_times=(3.0,), name=f"{run.name}b") for run in problem.experiments]
    larger = sf.estimate(sf.Problem(ROOM, [*problem.experiments, *again], problem.parameters), strategy="local")
    text = str(sf.bootstrap(larger, 3))
    assert "and 4 more unknowns" in text
    assert "power_4 (K/h)" in text
    assert "and 10 more" in str(sf.multistart(larger.problem, larger.theta[None]))
