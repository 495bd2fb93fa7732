"""What a saved estimate was made from, and `switchfit rerun`, which fits it again and compares."""

import hashlib
import json
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from test_cli import PROBLEM, ROOM
from test_many_logs import log_of, run
from test_report import made
from test_save import CERTIFICATE, SAVED

import switchfit as sf
from switchfit.estimation.saved import describe_python_problem, load_saved, save_fit
from switchfit.io import rerun
from switchfit.io.problem_file import load_problem
from switchfit.io.rerun import Prepared, compare_fits
from switchfit.models import heater_problem
from switchfit.optimize import Status

LOCAL = '\n[options]\nstrategy = "local"\n'


def save(folder, *arguments):
    """The saved estimate of a problem file, in the folder `out` beside it."""
    result = run("fit", folder / "problem.toml", "--out", folder / "out", "--no-figures", *arguments)
    assert result.exit_code in (0, 1), result.stderr
    return folder / "out" / "estimate.json"


def write_project(folder):
    folder.mkdir()
    (folder / "problem.toml").write_text(PROBLEM + LOCAL)
    (folder / "room.py").write_text(
        ROOM.replace("0.05", "LOSS").replace("import", "from losses import LOSS\nimport", 1)
    )
    (folder / "losses.py").write_text("LOSS = 0.05\n")
    (folder / "log.csv").write_text(log_of(3.2))
    return folder


@pytest.fixture(scope="module")
def saved_project(tmp_path_factory):
    """A project with a saved estimate: a problem file, its log, a model in two files."""
    project = write_project(tmp_path_factory.mktemp("rerun") / "project")
    save(project)
    return project


@pytest.fixture
def project(saved_project, tmp_path):
    """A copy to work in; its model is imported anew."""
    yield shutil.copytree(saved_project, tmp_path / "project", ignore=shutil.ignore_patterns("__pycache__"))
    sys.modules.pop("losses", None)


def change(path, edit):
    """A JSON file with its content edited in place."""
    content = json.loads(path.read_text(encoding="utf-8"))
    edit(content)
    path.write_text(json.dumps(content), encoding="utf-8")


def again(path, *arguments):
    sys.modules.pop("losses", None)
    return run("rerun", path, *arguments)


# --- what is saved ----------------------------------------------------------------------------------------------------


def test_the_file_holds_the_problem_hashes_and_versions(project):
    content = json.loads((project / "out" / "estimate.json").read_text())["provenance"]
    assert content["text"] == PROBLEM + LOCAL
    assert (content["problem_file"], content["folder"], content["log"]) == ("problem.toml", "..", "")
    digests = {digest["name"]: digest["sha256"] for digest in content["files"]}
    assert digests == {
        name: hashlib.sha256((project / name).read_bytes()).hexdigest() for name in ("room.py", "losses.py", "log.csv")
    }
    assert content["options"] == {"strategy": "local"}
    assert content["versions"]["switchfit"] == sf.__version__
    assert content["versions"]["numpy"] == np.__version__
    assert content["versions"]["Python"].count(".") == 2
    found = sf.Estimate.load(project / "out" / "estimate.json").provenance
    assert found.folder == str(project)
    values = sf.Estimate.load(project / "out" / "estimate.json").comparisons[0][0]
    raw = np.column_stack([values.times, values.measured]).astype("<f8").tobytes()
    assert [digest.sha256 for digest in found.data] == [hashlib.sha256(raw).hexdigest()]


def test_an_estimate_of_python_keeps_the_hash_of_its_data_and_versions(tmp_path):
    fit = sf.estimate(heater_problem(), strategy="local")
    fit.save(tmp_path / "fit.json")
    found = sf.Estimate.load(tmp_path / "fit.json").provenance
    assert (found.problem_file, found.text, found.files) == ("", "", ())
    assert [digest.name for digest in found.data] == ["thermometer"]
    assert found == describe_python_problem(fit)
    result = again(tmp_path / "fit.json")
    assert result.exit_code == 2
    assert "does not have its problem, which was built in Python: functions are not saved" in result.stderr


def test_an_estimate_of_python_can_say_which_problem_file_it_is_of(project):
    loaded = load_problem(project / "problem.toml")
    sf.estimate(loaded.problem, **loaded.options).save(project / "fit.json", provenance=loaded.provenance)
    result = again(project / "fit.json")
    assert (result.exit_code, result.stdout.split(":")[0]) == (0, "The same answer, to the last bit")
    with pytest.raises(TypeError, match="provenance must be the provenance of a problem file; got str"):
        sf.estimate(loaded.problem).save(project / "fit.json", provenance="problem.toml")


def test_a_loaded_estimate_keeps_its_provenance_when_it_is_saved_elsewhere(project, tmp_path):
    loaded = sf.Estimate.load(project / "out" / "estimate.json")
    loaded.save(tmp_path / "fit.json")
    content = json.loads((tmp_path / "fit.json").read_text())["provenance"]
    assert content["folder"] == "project"
    assert sf.Estimate.load(tmp_path / "fit.json").provenance == loaded.provenance
    assert again(tmp_path / "fit.json").exit_code == 0
    earlier = sf.Estimate.load(SAVED)
    assert earlier.provenance is None
    earlier.save(tmp_path / "earlier.json")
    assert "provenance" not in json.loads((tmp_path / "earlier.json").read_text())


# --- the same answer --------------------------------------------------------------------------------------------------


def test_the_same_answer_also_after_the_folder_has_moved(project, tmp_path):
    result = again(project / "out" / "estimate.json")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("The same answer, to the last bit: J is ")
    project.rename(tmp_path / "moved")
    result = again(tmp_path / "moved" / "out" / "estimate.json")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("The same answer, to the last bit: J is ")
    (tmp_path / "moved" / "log.csv").write_text(log_of(3.5))
    assert again(tmp_path / "moved" / "out" / "estimate.json").exit_code == 1, "read where it was before"


def test_the_problem_is_the_one_that_was_saved(project):
    (project / "problem.toml").write_text("not even TOML")
    result = again(project / "out" / "estimate.json")
    assert result.exit_code == 0, result.stderr
    assert "Changed since\n  problem.toml has changed; what it was is fitted, and not what it is\n" in result.stdout
    (project / "problem.toml").unlink()
    result = again(project / "out" / "estimate.json")
    assert (result.exit_code, "Changed" in result.stdout) == (0, False)


def test_a_log_that_was_given_on_the_command_line(project):
    (project / "logs").mkdir()
    for name, switch in (("monday", 3.0), ("tuesday", 2.1)):
        (project / "logs" / f"{name}.csv").write_text(log_of(switch))
    logs, out = project / "logs", project / "out"
    result = run("fit", logs, "--problem", project / "problem.toml", "--out", out, "--no-figures", "--hessian", "exact")
    assert result.exit_code == 0, result.stderr
    content = json.loads((out / "tuesday" / "estimate.json").read_text())["provenance"]
    assert (content["log"], content["folder"]) == ("logs/tuesday.csv", "../..")
    assert "log.csv" not in [digest["name"] for digest in content["files"]]
    assert content["options"] == {"strategy": "local", "hessian": "exact"}
    result = again(out / "tuesday" / "estimate.json")
    assert result.exit_code == 0, result.stderr
    assert "to the last bit" in result.stdout


def test_a_problem_that_is_built_in_a_python_file(project):
    (project / "problem.toml").write_text('problem = "built.py:build"\n')
    text = "from pathlib import Path\nfrom switchfit.io.problem_file import load_problem\n"
    text += "def build():\n    return load_problem(Path(__file__).parent / 'inner.toml').problem\n"
    (project / "built.py").write_text(text)
    (project / "inner.toml").write_text(PROBLEM)
    path = save(project)
    assert "to the last bit" in again(path).stdout
    (project / "log.csv").write_text(log_of(3.1))
    result = again(path)  # which no hash of a file shows
    assert result.exit_code == 1
    assert "Changed since" not in result.stdout
    assert "The values that were fitted are not those of the saved fit." in result.stdout


# --- another answer ---------------------------------------------------------------------------------------------------


def test_data_that_have_changed(project):
    size = (project / "log.csv").stat().st_size
    (project / "log.csv").write_text(log_of(3.5) + "\n")
    result = again(project / "out" / "estimate.json")
    assert result.exit_code == 1
    assert f"  log.csv has changed: {size:,} bytes with SHA-256 " in result.stdout
    assert "Another answer: tau_1 differs by " in result.stdout
    row = next(line for line in result.stdout.splitlines() if line.startswith("  tau_1"))
    saved = load_saved(project / "out" / "estimate.json").fit
    apart = 0.3 / saved.standard_errors[0]
    assert row.split()[-3:] == [f"{apart:+.2g}", "std.", "errors"]
    assert "The values that were fitted are not those of the saved fit." in result.stdout


@pytest.mark.parametrize(("file", "old", "new"), [("room.py", "- LOSS", "- 1.2 * LOSS"), ("losses.py", "0.05", "0.06")])
def test_a_model_that_has_changed(project, file, old, new):
    """Also in a file that only the model's file imports."""
    (project / file).write_text((project / file).read_text().replace(old, new))
    result = again(project / "out" / "estimate.json")
    assert result.exit_code == 1
    assert f"Changed since\n  {file} has changed: " in result.stdout
    assert "Another answer: " in result.stdout
    assert "values that were fitted" not in result.stdout


def test_a_pattern_that_stands_for_other_logs_now(project):
    (project / "logs").mkdir()
    for name, switch in (("monday", 3.2), ("tuesday", 2.1)):
        (project / "logs" / f"{name}.csv").write_text(log_of(switch))
    (project / "problem.toml").write_text((PROBLEM + LOCAL).replace("log.csv", "logs/*.csv"))
    path = save(project)
    (project / "logs" / "monday.csv").rename(project / "logs" / "friday.csv")
    result = again(path)
    assert result.exit_code == 1
    assert "  logs/monday.csv is no longer there\n  logs/friday.csv is new\n" in result.stdout
    said = "Another problem: its unknowns are now without monday.tau_1 and with friday.tau_1."
    assert said in result.stdout


def test_other_versions_are_named(project):
    path = project / "out" / "estimate.json"

    def edit(content):
        content["provenance"]["versions"] |= {"jax": "0.1.2", "gone": "3"}
        content["provenance"]["platform"] = "an abacus"

    change(path, edit)
    result = again(path)
    assert result.exit_code == 0
    import jax

    assert (
        f"Changed since\n  jax was 0.1.2, and is {jax.__version__}\n  it was run on an abacus, and now on "
        in result.stdout
    )
    assert "gone" not in result.stdout


def test_differences_are_counted_in_standard_errors():
    fit = made()
    provenance = describe_python_problem(fit)
    prepared = Prepared(fit, provenance, None, ())

    def compare(**changes):
        return compare_fits(prepared, replace(fit, **changes))

    errors = fit.standard_errors
    assert compare() == rerun.Answers(True, "The same answer, to the last bit: J is 28.")
    near = compare(theta=fit.theta + np.array([0.009, 0.0, 0.0]) * errors)
    assert near.same
    assert near.text.startswith(
        "The same answer: tau_1 differs by 0.009 standard errors, and no unknown by more; J was 28,"
    )
    far = compare(theta=fit.theta - np.array([0.0, 0.009, 0.02]) * errors)
    assert not far.same
    assert far.text.startswith("Another answer: mu differs by 0.02 standard errors; J was 28, and is 28.\n")
    assert far.text.splitlines()[-1].split()[-3:] == ["-0.02", "std.", "errors"]
    costly = compare(cost=28.1)
    assert (costly.same, costly.text) == (False, "Another cost at the same answer: J was 28, and is 28.1.")
    assert compare(cost=28.0 + 1e-9).same
    stopped = compare(status=Status.MAX_ITERATIONS)
    assert not stopped.same
    assert "the saved fit converged, this one did not converge" in stopped.text
    swapped = compare(theta_names=("tau_2", "tau_1", "mu"))
    assert (swapped.same, swapped.text) == (False, "Another problem: its unknowns are now in another order.")


def test_an_unknown_without_a_standard_error_is_compared_by_its_size():
    fit = made(sigma_known=None)
    prepared = Prepared(fit, describe_python_problem(fit), None, ())
    assert compare_fits(prepared, replace(fit, theta=fit.theta * (1 + 1e-8))).same
    other = compare_fits(prepared, replace(fit, theta=fit.theta * np.array([1.0, 1.0, 1.001])))
    assert not other.same
    assert other.text.startswith("Another answer: mu was 0.8, and is 0.8008; J was 28")
    assert other.text.splitlines()[-1].split() == ["mu", "0.8", "0.8008", "+0.0008"]
    failed = replace(fit, cost=np.nan, initial_cost=np.nan)
    assert compare_fits(Prepared(failed, prepared.provenance, None, ()), failed).same


def test_of_many_unknowns_those_that_differ_most_are_listed(monkeypatch):
    monkeypatch.setattr(rerun, "MOST_LISTED", 1)
    fit = made()
    answers = compare_fits(
        Prepared(fit, describe_python_problem(fit), None, ()), replace(fit, theta=fit.theta + np.array([0.1, 0.0, 0.1]))
    )
    assert [line.split()[0] for line in answers.text.splitlines()[3:]] == ["mu", "and"]
    assert answers.text.endswith("and 2 more unknowns with smaller differences")


# --- what cannot be run again -----------------------------------------------------------------------------------------


def test_files_that_are_not_there(project, tmp_path):
    path = tmp_path / "sent" / "estimate.json"
    path.parent.mkdir()
    (project / "out" / "estimate.json").rename(path)
    result = again(path)
    assert result.exit_code == 2
    said = (
        f"{path} was made from room.py, which is not in {tmp_path}: put it there, or name the folder that it is in with"
    )
    assert said in result.stderr
    assert again(path, "--folder", project).exit_code == 0
    (project / "log.csv").unlink()
    result = again(path, "--folder", project)
    assert f"{path} was made from log.csv, which is not in {project}" in result.stderr


def test_a_file_that_is_wrong_now(project):
    (project / "log.csv").write_text("t;T\n0;1\n1;cold\n")
    result = again(project / "out" / "estimate.json")
    assert result.exit_code == 2
    assert "log.csv, line 3, column 'T': 'cold' is not a number" in result.stderr


def test_files_that_are_no_saved_estimates(project, tmp_path):
    save_fit(made(), CERTIFICATE, tmp_path / "bare.json")
    for path, said in (
        (tmp_path / "none.json", "There is no saved estimate"),
        (project, "is a folder; name the estimate.json in it"),
        (project / "log.csv", "log.csv is not a saved estimate: it is not valid JSON"),
        (SAVED, "does not say what it was made from: fit its problem file again"),
    ):
        result = again(path)
        assert result.exit_code == 2
        assert said in result.stderr


DAMAGES = [
    (lambda p: p.pop("text"), "provenance.text is missing"),
    (lambda p: p.update(colour="red"), "provenance.colour is unknown"),
    (lambda p: p.update(text=3), "provenance.text is not what was written; got 3"),
    (lambda p: p.update(files={"a": 1}), "provenance.files is not what was written"),
    (lambda p: p["files"][0].update(size="big"), "provenance.files[0].size is not what was written"),
    (lambda p: p.update(versions=[]), "provenance.versions is not what was written"),
    (lambda p: p.update(folder="a\0b"), "provenance.folder has a null character"),
    (lambda p: p["options"].update(hessian="best"), "provenance.options: 'hessian' must be 'auto'"),
    (lambda p: p["options"].update(max_iterations=2.5), "provenance.options: 'max_iterations' must be a"),
]


@pytest.mark.parametrize(("edit", "message"), DAMAGES, ids=[message[:40] for _, message in DAMAGES])
def test_provenance_that_is_damaged(project, edit, message):
    path = project / "out" / "estimate.json"
    change(path, lambda content: edit(content["provenance"]))
    result = again(path)
    assert result.exit_code == 2
    assert f"{path} is damaged: " in result.stderr
    assert message in result.stderr
