"""`switchfit validate` and `switchfit compare`: from saved estimates, with nothing but the files beside them."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from test_cli import PROBLEM, ROOM
from test_many_logs import run

import switchfit as sf
from switchfit.io.problem_file import load_problem
from switchfit.models import heater_problem

LOCAL = '\n[options]\nstrategy = "local"\n'


def write_log(path, switch, heating=0.5, seed=0):
    """A room that is heated until it is switched off, with noise of 0.1."""
    times = np.arange(0.25, 6.0, 0.25)
    heated = heating / 0.05 * (1 - np.exp(-0.05 * np.minimum(times, switch)))
    values = heated * np.exp(-0.05 * np.maximum(times - switch, 0)) + 0.1 * np.random.default_rng(seed).normal(
        size=len(times)
    )
    np.savetxt(path, np.stack([times, values], axis=1), delimiter=",", header="t,T", comments="", fmt="%.17g")


@pytest.fixture(scope="module")
def saved_project(tmp_path_factory):
    """Two models fitted to one log, both saved; another log; one that the parameters do not hold for."""
    folder = tmp_path_factory.mktemp("comparison") / "project"
    folder.mkdir()
    (folder / "room.py").write_text(ROOM)
    write_log(folder / "log.csv", 3.2, seed=1)
    write_log(folder / "other.csv", 2.4, seed=2)
    write_log(folder / "weaker.csv", 3.0, heating=0.3, seed=3)
    (folder / "problem.toml").write_text(PROBLEM + LOCAL)
    never = PROBLEM.replace('["on", "off"]', '["on"]').replace("transition_times = [2.0]\n", "")
    (folder / "never.toml").write_text(never + LOCAL)
    for name in ("problem", "never"):
        result = run("fit", folder / f"{name}.toml", "--out", folder / "out" / name, "--no-figures")
        assert result.exit_code in (0, 1), result.stderr
    return folder


@pytest.fixture
def project(saved_project, tmp_path, monkeypatch):
    """A copy to work in, as the current folder."""
    copied = shutil.copytree(saved_project, tmp_path / "project", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.chdir(copied)
    return copied


FIT = Path("out/problem/estimate.json")
NEVER = Path("out/never/estimate.json")


# --- validate ---------------------------------------------------------------------------------------------------------


def test_validate_says_what_validate_of_the_estimate_says(project):
    """From the saved estimate alone: the log that was fitted is not even there."""
    (project / "log.csv").unlink()
    result = run("validate", FIT, "other.csv", "--out", "val")
    assert result.exit_code == 0, result.stderr
    other = load_problem("problem.toml", "other.csv").problem
    expected = sf.Estimate.load(FIT).validate(other)
    assert result.stdout == f"{expected}\n"
    assert result.stdout.startswith("Good: the fitted parameters predict ")
    assert (project / "val" / "validation.txt").read_text() == result.stdout
    assert (project / "val" / "validation.png").read_bytes().startswith(b"\x89PNG")
    assert result.stderr == "written to val\n"


def test_validate_as_json(project):
    result = run("validate", FIT, "other.csv", "--json")
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    rows = {row["name"]: row for row in found["unknowns"]}
    assert (found["verdict"], rows["heating"]["from"], rows["tau_1"]["from"]) == ("good", "fit", "run")
    assert rows["heating"]["value"] == sf.Estimate.load(FIT).parameters["heating"]
    assert abs(rows["tau_1"]["value"] - 2.4) < 4 * rows["tau_1"]["standard_error"]
    assert found["channels"][0]["name"] == "T"
    expected = sf.Estimate.load(FIT).validate(load_problem("problem.toml", "other.csv").problem)
    assert found["channels"][0]["fit_percent"] == found["fit_percent"] == expected.percent
    assert found["chi_square"] == expected.chi_square
    assert (found["changes"], found["out"]) == ([], None)


def test_validate_with_a_problem_file_for_a_run_that_differs(project):
    """Another first guess, and a file of its own."""
    text = PROBLEM.replace("log.csv", "other.csv").replace("[2.0]", "[2.5]").replace("heating = 0.4", "heating = 7.0")
    Path("other.toml").write_text(text + LOCAL)
    result = run("validate", FIT, "other.toml", "--figures", "svg", "--out", "val")
    assert result.exit_code == 0, result.stderr
    heating = sf.Estimate.load(FIT).parameters["heating"]
    row = next(line for line in result.stdout.splitlines() if line.startswith("  heating"))
    assert row.split()[1] == f"{heating:.3f}"
    assert sorted(path.name for path in Path("val").iterdir()) == ["validation.svg", "validation.txt"]


def test_a_run_for_which_the_parameters_do_not_hold_is_exit_code_1(project):
    result = run("validate", FIT, "weaker.csv")
    assert result.exit_code == 1
    assert result.stdout.startswith("Bad: the fitted parameters do not predict this run")
    assert result.stderr.startswith("switchfit: the parameters do not hold for this run")
    quiet = run("validate", FIT, "weaker.csv", "--quiet")
    assert (quiet.exit_code, quiet.stdout, quiet.stderr) == (1, "", "")


def test_a_model_that_has_changed_since_the_fit_is_named(project):
    Path("room.py").write_text(ROOM + "\n# a comment\n")
    result = run("validate", FIT, "other.csv")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("Changed since\n  room.py has changed: ")
    assert "log.csv" not in result.stdout, "that the other log is another file is no change"


def test_a_model_that_no_longer_suits_the_saved_problem_is_named(project):
    """As where a model is written over the one that was fitted, and both fits are then to be compared."""
    Path("room.py").write_text(ROOM.replace('"on"', '"heating"'))
    for result in (run("validate", FIT, "other.csv"), run("compare", FIT, FIT)):
        assert (result.exit_code, result.stdout) == (2, "")
        assert "estimate.json cannot be built again, since room.py in " in result.stderr
        assert "mode_sequence names the unknown mode 'on'" in result.stderr
        assert "Fit again; or put the files as they were into a folder" in result.stderr
    Path("before").mkdir()
    Path("before", "room.py").write_text(ROOM)
    shutil.copy("log.csv", "before")
    result = run("compare", FIT, NEVER, "--folder", "before")
    assert result.exit_code == 0, result.stderr


def test_validate_finds_the_model_elsewhere(project, tmp_path):
    (tmp_path / "mail").mkdir()
    moved = shutil.copy(FIT, tmp_path / "mail")
    result = run("validate", moved, "other.csv")
    assert result.exit_code == 2
    assert "was made from room.py, which is not in " in result.stderr
    result = run("validate", moved, "other.csv", "--folder", project)
    assert result.exit_code == 0, result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere.json", "other.csv"), "There is no saved estimate nowhere.json; check the name and the folder."),
        (("out", "other.csv"), "out is a folder; name the estimate.json in it."),
        (("problem.toml", "other.csv"), "problem.toml is not a saved estimate"),
        ((FIT, "nowhere.csv"), "nowhere.csv; check the name and the folder."),
        ((FIT, "nowhere.toml"), "There is no problem file nowhere.toml"),
        ((FIT,), "Missing argument 'LOG|PROBLEM.toml'"),
    ],
)
def test_what_validate_cannot_read(project, arguments, message):
    result = run("validate", *arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert message in result.stderr


def test_a_fit_of_python_needs_a_problem_file_for_the_other_run(project):
    sf.estimate(heater_problem(), strategy="local").save("heater.json")
    result = run("validate", "heater.json", "other.csv")
    assert result.exit_code == 2
    assert "heater.json does not have its problem, which was built in Python" in result.stderr
    assert "estimate.validate(...)" in result.stderr


# --- compare ----------------------------------------------------------------------------------------------------------


def load_all(*names):
    return [
        sf.Estimate.load(f"out/{name}/estimate.json", problem=load_problem(f"{name}.toml").problem) for name in names
    ]


def test_compare_prints_the_table_of_compare(project):
    result = run("compare", FIT, NEVER, "--out", "cmp")
    assert result.exit_code == 0, result.stderr
    expected = sf.compare(load_all("problem", "never"), names=("problem", "never"))
    assert result.stdout == f"{expected}\n"
    assert result.stdout.startswith("problem has the smallest BIC")
    assert (project / "cmp" / "comparison.txt").read_text() == result.stdout
    assert (project / "cmp" / "comparison.png").read_bytes().startswith(b"\x89PNG")


def test_compare_as_json_has_the_best_model_first(project):
    result = run("compare", NEVER, FIT, "--json")
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    expected = sf.compare(load_all("never", "problem"))
    assert [row["name"] for row in found["models"]] == ["problem", "never"]
    assert [row["bic"] for row in found["models"]] == expected.bic[::-1].tolist()
    assert (found["best"], found["values"]) == ("problem", 23)


def test_a_fit_that_did_not_converge_is_exit_code_1(project):
    run("fit", "problem.toml", "--out", "stopped", "--no-figures", "--max-iterations", 1)
    result = run("compare", NEVER, "stopped/estimate.json")
    assert result.exit_code == 1
    assert "Not converged: stopped." in result.stdout
    assert result.stderr == (
        "switchfit: not converged: stopped; fit these again, their likelihoods may be too small.\n"
    )


def test_data_that_have_changed_since_the_fit_cannot_be_compared(project):
    shutil.copy("other.csv", "log.csv")
    result = run("compare", FIT, NEVER)
    assert (result.exit_code, result.stdout) == (2, "")
    assert f"{FIT} was fitted to other values than the files in {project} have now: fit them again." in result.stderr


def test_one_estimate_is_not_enough_and_python_compares_what_python_built(project):
    result = run("compare", FIT)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "name two saved estimates or more" in result.stderr
    sf.estimate(heater_problem(), strategy="local").save("heater.json")
    result = run("compare", FIT, "heater.json")
    assert result.exit_code == 2
    assert "heater.json does not have its problem" in result.stderr
    assert "sf.compare([...])" in result.stderr


@pytest.fixture(autouse=True)
def _import_models_anew():
    yield
    sys.modules.pop("room", None)
