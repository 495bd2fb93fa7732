"""Saved estimates: what they were made from, built again from that, for `switchfit validate` and `compare`."""

import hashlib
import json
import re
import shutil
import sys
from pathlib import Path

import pytest

import switchfit as sf
from support.commands import PROBLEM, ROOM, log_of, run
from switchfit.cli.saved_estimates import list_changed_models, load_with_problem
from switchfit.io.problem_file.loading import load_problem
from switchfit.io.provenance import Provenance
from switchfit.models import heater_problem
from switchfit.runtime.errors import InputError

MODEL = ROOM.replace("0.05", "LOSS").replace("import", "from losses import LOSS\nimport", 1)
LOCAL = '\n[options]\nstrategy = "local"\n'


@pytest.fixture(scope="module")
def saved_project(tmp_path_factory):
    """Two models fitted to one log, both saved; another log; one that the parameters do not hold for."""
    folder = tmp_path_factory.mktemp("comparison") / "project"
    folder.mkdir()
    (folder / "room.py").write_text(MODEL)
    (folder / "losses.py").write_text("LOSS = 0.05\n")
    (folder / "log.csv").write_text(log_of(3.2, noise=0.1, seed=1, step=0.25))
    (folder / "other.csv").write_text(log_of(2.4, noise=0.1, seed=2, step=0.25))
    (folder / "weaker.csv").write_text(log_of(3.0, heating=0.3, noise=0.1, seed=3, step=0.25))
    (folder / "problem.toml").write_text(PROBLEM + LOCAL)
    never = PROBLEM.replace('["on", "off"]', '["on"]').replace("transition_times = [2.0]\n", "")
    (folder / "never.toml").write_text(never + LOCAL)
    for name in ("problem", "never"):
        result = run("fit", folder / f"{name}.toml", "--out", folder / "out" / name, "--no-figures", "--full", code=0)
    assert result.stdout.startswith("Doubtful: ")
    sf.estimate(heater_problem(), strategy="local").save(folder / "heater.json")
    return folder


@pytest.fixture
def project(saved_project, tmp_path, monkeypatch):
    """A copy to work in, as the current folder."""
    copied = shutil.copytree(saved_project, tmp_path / "project", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.chdir(copied)
    yield copied
    for name in ("losses", "leaks"):
        sys.modules.pop(name, None)


FIT = Path("out/problem/estimate.json")
NEVER = Path("out/never/estimate.json")


def succeed(*arguments):
    """What a command prints."""
    return run(*arguments, code=0).stdout


def refuse(*arguments):
    """What a command says that ends with code 2 and prints nothing."""
    result = run(*arguments, code=2)
    assert result.stdout == ""
    return result.stderr


# --- validate ---------------------------------------------------------------------------------------------------------


def test_validate_says_what_validate_of_the_estimate_says(project):
    """From the saved estimate alone: the log that was fitted is not even there."""
    (project / "log.csv").unlink()
    result = run("validate", FIT, "other.csv", "--out", "val")
    expected = sf.Estimate.load(FIT).validate(load_problem("problem.toml", "other.csv").problem)
    assert (result.exit_code, result.stdout, result.stderr) == (0, f"{expected}\n", "written to val\n")
    assert result.stdout.startswith("Good: the fitted parameters predict ")
    assert (project / "val" / "validation.txt").read_text() == result.stdout
    assert (project / "val" / "validation.png").read_bytes().startswith(b"\x89PNG")
    found = json.loads(succeed("validate", FIT, "other.csv", "--json"))
    rows = {row["name"]: row for row in found["unknowns"]}
    assert (found["verdict"], rows["heating"]["from"], rows["tau_1"]["from"]) == ("good", "fit", "run")
    assert rows["heating"]["value"] == sf.Estimate.load(FIT).parameters["heating"]
    assert abs(rows["tau_1"]["value"] - 2.4) < 4 * rows["tau_1"]["standard_error"]
    assert found["channels"][0]["fit_percent"] == found["fit_percent"] == expected.percent
    assert (found["chi_square"], found["changes"], found["out"]) == (expected.chi_square, [], None)


def test_validate_with_a_problem_file_for_a_run_that_differs(project):
    """Another first guess, and a file of its own."""
    text = PROBLEM.replace("log.csv", "other.csv").replace("[2.0]", "[2.5]").replace("heating = 0.4", "heating = 7.0")
    Path("other.toml").write_text(text + LOCAL)
    printed = succeed("validate", FIT, "other.toml", "--figures", "svg", "--out", "val")
    row = next(line for line in printed.splitlines() if line.startswith("  heating"))
    assert row.split()[1] == f"{sf.Estimate.load(FIT).parameters['heating']:.3f}"
    assert sorted(path.name for path in Path("val").iterdir()) == ["validation.svg", "validation.txt"]


def test_a_run_for_which_the_parameters_do_not_hold_is_exit_code_1(project):
    result = run("validate", FIT, "weaker.csv", code=1)
    assert result.stdout.startswith("Bad: the fitted parameters do not predict this run")
    assert result.stderr.startswith("switchfit: the parameters do not hold for this run")
    quiet = run("validate", FIT, "weaker.csv", "--quiet")
    assert (quiet.exit_code, quiet.stdout, quiet.stderr) == (1, "", "")


def test_a_model_that_no_longer_suits_the_saved_problem_is_named(project):
    """As where a model is written over the one that was fitted, and both fits are then to be compared."""
    Path("room.py").write_text(MODEL.replace('"on"', '"heating"'))
    for said in (refuse("validate", FIT, "other.csv"), refuse("compare", FIT, FIT)):
        assert "estimate.json cannot be built again, since room.py in " in said
        assert "mode_sequence names the unknown mode 'on'" in said
        assert "Put the files as they were into a folder, and name it with --folder; or fit again." in said
    Path("before").mkdir()
    Path("before", "room.py").write_text(MODEL)
    for name in ("log.csv", "losses.py"):
        shutil.copy(name, "before")
    succeed("compare", FIT, NEVER, "--folder", "before")


# --- compare ----------------------------------------------------------------------------------------------------------


def test_compare_says_what_compare_of_the_estimates_says(project):
    result = run("compare", FIT, NEVER, "--out", "cmp")
    names = ("problem", "never")
    problems = [load_problem(f"{name}.toml").problem for name in names]
    fits = [sf.Estimate.load(path, problem=each) for path, each in zip((FIT, NEVER), problems, strict=True)]
    expected = sf.compare(fits, names=names)
    assert (result.exit_code, result.stdout) == (0, f"{expected}\n")
    assert (project / "cmp" / "comparison.txt").read_text() == result.stdout
    found = json.loads(succeed("compare", NEVER, FIT, "--json"))  # the best model comes first
    assert [(row["name"], row["bic"]) for row in found["models"]] == list(zip(names, expected.bic, strict=True))
    assert (found["best"], found["values"]) == ("problem", 23)


def test_a_fit_that_did_not_converge_is_exit_code_1(project):
    run("fit", "problem.toml", "--out", "stopped", "--no-figures", "--max-iterations", 1)
    result = run("compare", NEVER, "stopped/estimate.json")
    assert (result.exit_code, "Not converged: stopped." in result.stdout) == (1, True)
    assert "not converged: stopped; fit these again, their likelihoods may be too small." in result.stderr


# --- what cannot be read ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("validate", "nowhere.json", "other.csv"), "file 'nowhere.json' does not exist."),
        (("validate", "problem.toml", "other.csv"), "problem.toml is not a saved estimate"),
        (("validate", FIT, "nowhere.csv"), "nowhere.csv; check the name and the folder."),
        (("validate", "heater.json", "other.csv"), "in the script that fitted it: estimate.validate(...), sf.compare"),
    ],
)
def test_what_cannot_be_read(project, arguments, said):
    assert said in refuse(*arguments)


def refuse_to_build(path, folder=None):
    """The message of a problem that cannot be built again."""
    with pytest.raises(InputError) as error:
        build_again(path, folder)
    return str(error.value)


def build_again(path, folder=None):
    """The saved estimate with its problem, whose cost must be what it was."""
    sys.modules.pop("losses", None)
    estimate, changes = load_with_problem(path, folder)
    assert sf.evaluate(estimate.problem, estimate.theta).cost == pytest.approx(estimate.cost, rel=1e-9)
    return changes


# --- what is saved ----------------------------------------------------------------------------------------------------


def test_the_file_holds_the_problem_hashes_and_versions(project):
    content = json.loads(FIT.read_text())["provenance"]
    assert content["text"] == PROBLEM + LOCAL
    assert (content["problem_file"], content["folder"], content["log"]) == ("problem.toml", "../..", "")
    names = ("room.py", "losses.py", "log.csv")
    expected = {name: hashlib.sha256((project / name).read_bytes()).hexdigest() for name in names}
    assert {digest["name"]: digest["sha256"] for digest in content["files"]} == expected
    assert content["options"] == {"strategy": "local"}
    assert content["versions"]["switchfit"] == sf.__version__
    assert content["versions"]["Python"].count(".") == 2


def test_an_estimate_of_python_keeps_versions(project):
    assert sf.Estimate.load("heater.json").provenance == Provenance(problem_file="", text="", files=())
    said = "does not have its problem, which was built in Python: functions are not saved"
    assert said in refuse_to_build("heater.json")


def test_an_estimate_of_python_can_say_which_problem_file_it_is_of(project, tmp_path):
    """And keeps it when it is saved elsewhere."""
    loaded = load_problem(project / "problem.toml")
    sf.estimate(loaded.problem, **loaded.options).save(project / "fit.json", provenance=loaded.provenance)
    first = sf.Estimate.load(project / "fit.json")
    first.save(tmp_path / "fit.json")
    assert json.loads((tmp_path / "fit.json").read_text())["provenance"]["folder"] == "project"
    build_again(tmp_path / "fit.json")
    with pytest.raises(TypeError, match="provenance must be the provenance of a problem file; got str"):
        first.save(project / "fit.json", provenance="problem.toml")


def test_the_folder_has_moved(project, tmp_path, monkeypatch):
    build_again(FIT)
    monkeypatch.chdir(tmp_path)
    project.rename("moved")
    Path("moved", "problem.toml").unlink()  # the text that was saved is enough
    build_again("moved" / FIT)
    Path("moved", "log.csv").write_text(log_of(3.5))  # read where it is now, not where it was
    said = f"was fitted to other values than the files in {tmp_path / 'moved'} have now: fit them again."
    assert said in refuse_to_build("moved" / FIT)


def test_a_log_that_was_given_on_the_command_line(project):
    (project / "logs").mkdir()
    for name, switch in (("monday", 3.0), ("tuesday", 2.1)):
        (project / "logs" / f"{name}.csv").write_text(log_of(switch))
    result = run("fit", "logs", "--problem", "problem.toml", "--out", "many", "--no-figures", "--hessian", "exact")
    assert result.exit_code == 0, result.stderr
    saved = Path("many", "tuesday", "estimate.json")
    content = json.loads(saved.read_text())["provenance"]
    assert (content["log"], content["folder"]) == ("logs/tuesday.csv", "../..")
    assert content["options"] == {"strategy": "local", "hessian": "exact"}
    build_again(saved)


def test_changes_of_the_model_are_listed(project):
    """Also those of a file that only the model's file imports; not those of data, whose values are compared."""
    given = sf.Estimate.load(FIT).provenance
    with (project / "log.csv").open("a") as log:
        log.write("\n")
    assert build_again(FIT) == []
    (project / "losses.py").write_text("LOSS = 0.06\n")
    assert list_changed_models(given, load_problem(project / "problem.toml")) == ["losses.py has changed"]
    (project / "losses.py").rename(project / "leaks.py")
    (project / "room.py").write_text((project / "room.py").read_text().replace("from losses", "from leaks"))
    changes = list_changed_models(given, load_problem(project / "problem.toml"))
    assert changes[1:] == ["losses.py is no longer there", "leaks.py is new"]
    (project / "leaks.py").rename(project / "losses.py")
    (project / "losses.py").write_text("LOSS = 0.05\n")
    Path("room.py").write_text(MODEL + "\n# a comment\n")
    assert succeed("validate", FIT, "other.csv").startswith("Changed since\n  room.py has changed\n\n")


# --- what cannot be built again -------------------------------------------------------------------------------------


def test_files_that_are_not_there(project, tmp_path):
    path = tmp_path / "sent" / "problem" / "estimate.json"
    path.parent.mkdir(parents=True)
    FIT.rename(path)
    said = f"{path} cannot be built again, since room.py, losses.py, log.csv in {tmp_path} is missing or has changed: "
    assert said in refuse_to_build(path)
    build_again(path, project)
    (project / "log.csv").unlink()
    assert f"{path} cannot be built again, since log.csv in {project} is missing" in refuse_to_build(path, project)


def test_provenance_that_is_damaged(project):
    content = json.loads(FIT.read_text())
    content["provenance"]["files"][0].update(size="big")
    FIT.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=re.escape(f"{FIT} is damaged: provenance is not what was written")):
        sf.Estimate.load(FIT)
