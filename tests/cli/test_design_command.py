"""`switchfit design`, and [design] in problem files."""

import csv
import json
import tomllib

import numpy as np
import pytest

import switchfit as sf
from support.commands import catch_settings, run
from switchfit.io.problem_file.loading import load_problem

MODEL = """
import switchfit as sf
def heat(t, x, p, u):
    return p["b"] * u["power"] + u["sun"] - p["k"] * x
system = sf.HybridSystem({"heat": heat}, [0.0], state_names=("T",))
"""

PROBLEM = """
model = "model.py:system"
[parameters]
k = { value = 0.5, lower = 0.0 }
b = 2.0
[[experiments]]
mode_sequence = ["heat"]
inputs = { file = "plan.csv", columns = { power = "power", sun = "sun" } }
[[experiments.data]]
file = "plan.csv"
columns = ["T"]
sigma = 0.1
"""

DESIGN = """
[design]
criterion = "A"
samples = { T = 3 }
sensors = { T = 1.0 }
budget = 2.0
starts = 0
names = { k = 0.1, b = 0.5 }
free = { power = [0.0, 1.5] }
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "model.py").write_text(MODEL)
    (tmp_path / "problem.toml").write_text(PROBLEM + DESIGN)
    (tmp_path / "plain.toml").write_text(PROBLEM)
    rows = [f"{t},0,1.0,0.2" for t in np.linspace(0.0, 4.0, 9)]
    (tmp_path / "plan.csv").write_text("\n".join(["t,T,power,sun", *rows]) + "\n")
    return tmp_path


def test_a_design_is_printed_and_written(folder):
    out = folder / "out" / "deep"
    result = run("design", folder / "problem.toml", "--out", out, code=0)
    assert result.stdout.startswith("A-optimal design of run1 for k, b.\n")
    names = ["design.json", "design.png", "design.txt", "input.csv", "samples.csv"]
    assert sorted(path.name for path in out.iterdir()) == names
    assert (out / "design.txt").read_text() == result.stdout
    problem = load_problem(folder / "problem.toml").problem
    plan = sf.design(problem, **tomllib.loads(DESIGN)["design"])
    assert str(plan) == result.stdout.rstrip("\n")
    np.testing.assert_array_equal(sf.read_log(out / "input.csv")["power"], plan.inputs["power"])
    np.testing.assert_array_equal(sf.read_log(out / "input.csv").times, np.linspace(0.0, 4.0, 9))
    rows = list(csv.DictReader((out / "samples.csv").read_text().splitlines()))
    assert {row["sensor"] for row in rows} == {"T"}
    np.testing.assert_array_equal([float(row["t"]) for row in rows], plan.sample_times["T"])
    saved = json.loads((out / "design.json").read_text())["design"]
    assert saved["sample_times"]["T"] == plan.sample_times["T"].tolist()


def test_options_override_the_file(folder, monkeypatch):
    given = catch_settings(monkeypatch, "design")
    result = run("design", folder / "plain.toml", "--criterion", "E", "--samples", 5)
    assert (result.exit_code, result.stderr) == (2, "switchfit: enough\n")
    assert given == {"criterion": "E", "samples": 5}
    run("design", folder / "problem.toml", "--criterion", "D")
    assert (given["criterion"], given["samples"], given["budget"]) == ("D", {"T": 3}, 2.0)


def test_json_and_what_cannot_be_estimated(folder):
    (folder / "plan.csv").write_text((folder / "plan.csv").read_text().replace("1.0,0.2", "0.0,0.0"))
    result = run("design", folder / "plain.toml", "--json", code=1)
    assert "k, b cannot be estimated from such an experiment" in result.stderr
    shown = json.loads(result.stdout)
    assert (shown["theta_names"], shown["covariance"]) == (["k", "b"], [[None, None], [None, None]])


def test_a_mistake_in_the_file_is_said_with_its_key(folder):
    (folder / "problem.toml").write_text((PROBLEM + DESIGN).replace('criterion = "A"', 'criterion = "T"'))
    assert "design.criterion" in run("design", folder / "problem.toml", code=2).stderr
