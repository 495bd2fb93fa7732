"""What a saved estimate was made from, and its problem, built again from that."""

import hashlib
import json
import re
import shutil
import sys

import numpy as np
import pytest
from test_cli import PROBLEM, ROOM
from test_many_logs import log_of, run

import switchfit as sf
from switchfit.estimation.saved import describe_python_problem
from switchfit.io.problem_file import load_problem
from switchfit.io.saved_problem import list_changed_models, load_with_problem
from switchfit.models import heater_problem
from switchfit.runtime.errors import InputError

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
    project = write_project(tmp_path_factory.mktemp("saved") / "project")
    save(project)
    return project


@pytest.fixture
def project(saved_project, tmp_path):
    """A copy to work in; its model is imported anew."""
    yield shutil.copytree(saved_project, tmp_path / "project", ignore=shutil.ignore_patterns("__pycache__"))
    sys.modules.pop("losses", None)


def refuse(path, folder=None):
    """The message of a problem that cannot be built again."""
    with pytest.raises(InputError) as error:
        build_again(path, folder)
    return str(error.value)


def build_again(path, folder=None):
    """The saved estimate with its problem, whose cost must be what it was."""
    sys.modules.pop("losses", None)
    estimate, loaded = load_with_problem(path, folder)
    assert sf.evaluate(loaded.problem, estimate.theta).cost == pytest.approx(estimate.cost, rel=1e-9)
    return loaded


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
    assert content["versions"]["Python"].count(".") == 2
    found = sf.Estimate.load(project / "out" / "estimate.json")
    values = found.comparisons[0][0]
    raw = np.column_stack([values.times, values.measured]).astype("<f8").tobytes()
    assert [digest.sha256 for digest in found.provenance.data] == [hashlib.sha256(raw).hexdigest()]


def test_an_estimate_of_python_keeps_the_hash_of_its_data_and_versions(tmp_path):
    fit = sf.estimate(heater_problem(), strategy="local")
    fit.save(tmp_path / "fit.json")
    found = sf.Estimate.load(tmp_path / "fit.json").provenance
    assert (found.problem_file, found.text, found.files) == ("", "", ())
    assert [digest.name for digest in found.data] == ["thermometer"]
    assert found == describe_python_problem(fit)
    said = refuse(tmp_path / "fit.json")
    assert "does not have its problem, which was built in Python: functions are not saved" in said


def test_an_estimate_of_python_can_say_which_problem_file_it_is_of(project, tmp_path):
    """And keeps it when it is saved elsewhere."""
    loaded = load_problem(project / "problem.toml")
    sf.estimate(loaded.problem, **loaded.options).save(project / "fit.json", provenance=loaded.provenance)
    first = sf.Estimate.load(project / "fit.json")
    first.save(tmp_path / "fit.json")
    assert json.loads((tmp_path / "fit.json").read_text())["provenance"]["folder"] == "project"
    assert sf.Estimate.load(tmp_path / "fit.json").provenance == first.provenance
    build_again(tmp_path / "fit.json")
    with pytest.raises(TypeError, match="provenance must be the provenance of a problem file; got str"):
        first.save(project / "fit.json", provenance="problem.toml")


# --- the problem again ------------------------------------------------------------------------------------------------


def test_the_folder_has_moved(project, tmp_path):
    build_again(project / "out" / "estimate.json")
    project.rename(tmp_path / "moved")
    (tmp_path / "moved" / "problem.toml").unlink()  # the text that was saved is enough
    build_again(tmp_path / "moved" / "out" / "estimate.json")
    for other in (log_of(3.5), log_of(3.2).replace("0.25;", "0.3;")):  # other values, another time
        (tmp_path / "moved" / "log.csv").write_text(other)
        said = refuse(tmp_path / "moved" / "out" / "estimate.json")  # read where it is now, not where it was
        assert f"was fitted to other values than the files in {tmp_path / 'moved'} have now: fit them again." in said


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
    build_again(out / "tuesday" / "estimate.json")


def test_changes_of_the_model_are_listed(project):
    """Also those of a file that only the model's file imports; not those of data, whose values are compared."""
    path = project / "out" / "estimate.json"
    given = sf.Estimate.load(path).provenance
    (project / "log.csv").write_text(log_of(3.2) + "\n")
    assert list_changed_models(given, build_again(path)) == []
    size = (project / "losses.py").stat().st_size
    (project / "losses.py").write_text("LOSS = 0.06  # more\n")
    loaded = load_problem(project / "problem.toml")
    (change,) = list_changed_models(given, loaded)
    assert change.startswith(f"losses.py has changed: {size} bytes with SHA-256 ")
    assert change.endswith(f"..., now {size + 8} bytes")
    (project / "losses.py").rename(project / "leaks.py")
    (project / "room.py").write_text((project / "room.py").read_text().replace("from losses", "from leaks"))
    changes = list_changed_models(given, load_problem(project / "problem.toml"))
    assert changes[1:] == ["losses.py is no longer there", "leaks.py is new"]
    sys.modules.pop("leaks", None)


# --- what cannot be built again -------------------------------------------------------------------------------------


def test_files_that_are_not_there(project, tmp_path):
    path = tmp_path / "sent" / "estimate.json"
    path.parent.mkdir()
    (project / "out" / "estimate.json").rename(path)
    assert (
        f"{path} was made from room.py, which is not in {tmp_path}: put it there, or name the folder that it is in with"
    ) in refuse(path)
    build_again(path, project)
    (project / "log.csv").unlink()
    assert f"{path} was made from log.csv, which is not in {project}" in refuse(path, project)


DAMAGES = [
    (lambda p: p.pop("text"), "provenance is not what was written"),
    (lambda p: p["files"][0].update(size="big"), "provenance is not what was written"),
    (lambda p: p.update(versions=[]), "provenance is not what was written"),
    (lambda p: p.update(folder="a\0b"), "provenance.folder has a null character"),
]


@pytest.mark.parametrize(("edit", "message"), DAMAGES)
def test_provenance_that_is_damaged(project, edit, message):
    path = project / "out" / "estimate.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    edit(content["provenance"])
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ValueError, match=re.escape(f"{path} is damaged: {message}")):
        sf.Estimate.load(path)
