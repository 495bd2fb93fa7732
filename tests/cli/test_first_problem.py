"""Problems to begin with: `switchfit init` and `switchfit examples`."""

import re
import shlex
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

import switchfit as sf
from support.commands import run
from support.places import EXAMPLES
from switchfit.cli import examples, first_problem
from switchfit.cli.examples import find_examples
from switchfit.cli.first_problem import choose_channels, write_first_problem
from switchfit.io.problem_file.loading import load_problem


def write_log(path, header="t,level,idle,count", rows=list):
    """A tank that fills to 2 until t = 6 and then drains to -1, each with a time constant of 1.5; noise of 0.01."""
    times = np.arange(0.0, 15.0, 0.1)
    filled = 2 - 2 * np.exp(-np.minimum(times, 6.0) / 1.5)
    values = -1 + (filled + 1) * np.exp(-np.maximum(times - 6.0, 0) / 1.5)
    values += 0.01 * np.random.default_rng(2).standard_normal(len(times))
    found = [f"{t:.3f},{v:.5f},7.0,{k}\n" for k, (t, v) in enumerate(zip(times.tolist(), values.tolist(), strict=True))]
    path.write_text(header + "\n" + "".join(rows(found)))
    return path


def test_without_a_log_an_example_is_written_that_can_be_fitted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run("init", "my room", code=0)
    written = {path.name for path in Path("my room").iterdir()} - {"__pycache__"}
    assert written == {"log.csv", "model.py", "problem.toml"}
    for command in re.findall(r"^  switchfit (.*)$", result.stdout, re.MULTILINE):
        run(*shlex.split(command), code=0)
    fit = sf.Estimate.load("my room/out/estimate.json")
    assert fit.verdict.level == "good"
    np.testing.assert_allclose(fit.theta, [5.3, 5.0, 0.2, 15.0], rtol=0.02)


def test_from_a_log(tmp_path):
    log = write_log(tmp_path / "tank.csv")
    folder = tmp_path / "tank"
    run("init", folder, "--from", log, code=0)
    assert (folder / "tank.csv").read_bytes() == log.read_bytes()
    (data,) = tomllib.loads((folder / "problem.toml").read_text())["experiments"][0]["data"]
    assert (data["file"], data["time"], data["columns"]) == ("tank.csv", "t", ["level"])  # idle: constant; count: rows
    loaded = load_problem(folder / "problem.toml")
    fit = sf.estimate(loaded.problem, **loaded.options)
    assert fit.verdict.level == "good"
    found = dict(zip(fit.theta_names, fit.theta, strict=True))
    truth = {"tau_1": 6.0, "time_constant": 1.5, "level_before": 2.0, "level_after": -1.0}
    assert {name: found[name] for name in truth} == pytest.approx(truth, abs=0.02)


def test_a_log_that_is_out_of_order_is_repaired_as_the_file_says(tmp_path):
    """Its times in milliseconds become seconds, and a name may have quotes and braces."""
    log = write_log(tmp_path / "log.csv", 't (ms),"a ""b"" {c} \\d",idle,count', lambda rows: [*rows[5:], *rows[:6]])
    write_first_problem(tmp_path / "new", log)
    text = (tmp_path / "new" / "problem.toml").read_text()
    assert 'repair = ["sort", "drop-duplicates"]' in text
    assert str(tmp_path) not in text
    problem = load_problem(tmp_path / "new" / "problem.toml").problem
    assert len(problem.experiments[0].data[0].times) == 150
    assert problem.experiments[0].tf == pytest.approx(14.9e-3)
    assert problem.system.state_names == ('a "b" {c} \\d', "count")


def test_a_log_in_another_multiple_of_a_state_s_unit_is_refused(tmp_path):
    write_first_problem(tmp_path / "new", write_log(tmp_path / "log.csv", "t,level (cm),idle,count"))
    write_log(tmp_path / "new" / "log.csv", "t,level (mm),idle,count")
    with pytest.raises(ValueError, match=r"column 'level' is in mm, but the model has the state 'level' in cm"):
        load_problem(tmp_path / "new" / "problem.toml")


def test_a_large_log_is_referred_to(tmp_path, monkeypatch):
    log = write_log(tmp_path / "log.csv")
    monkeypatch.setattr(first_problem, "LARGEST_COPY", 100)
    written = write_first_problem(tmp_path / "new", log)
    assert [path.name for path in written] == ["problem.toml", "model.py"]
    assert 'file = "../log.csv"' in (tmp_path / "new" / "problem.toml").read_text()
    assert load_problem(tmp_path / "new" / "problem.toml").problem


def test_positions_are_east_and_north(tmp_path):
    points = "".join(
        f'<trkpt lat="{48 + 1e-5 * max(k - 20, 0)}" lon="{11 + 1e-5 * min(k, 20)}">'
        f"<time>2024-05-01T10:00:{k:02d}Z</time></trkpt>"
        for k in range(50)
    )
    (tmp_path / "track.gpx").write_text(f'<gpx version="1.1" creator="t"><trk><trkseg>{points}</trkseg></trk></gpx>')
    channels, _ = choose_channels(sf.read_log(tmp_path / "track.gpx"))
    assert channels == ["east", "north"]
    write_first_problem(tmp_path / "new", tmp_path / "track.gpx")
    assert load_problem(tmp_path / "new" / "problem.toml").problem


# --- nothing is overwritten -------------------------------------------------------------------------------------------


def test_nothing_is_overwritten(tmp_path):
    room = tmp_path / "room"
    room.mkdir()
    assert run("init", room).exit_code == 0  # into an empty folder
    written = {path: path.read_text() for path in room.iterdir()}
    for command in (("init", room), ("examples", "toss", room), ("init", room / "log.csv")):
        assert "exists already, and nothing is overwritten" in run(*command, code=2).stderr
    assert {path: path.read_text() for path in room.iterdir()} == written


@pytest.mark.parametrize(
    ("rows", "message"),
    [(["1.0"] * 20, "has no channel with 8 samples or more that changes"), ("12", "has no channel"), (None, "log.csv")],
    ids=["constant", "short", "missing"],
)
def test_logs_that_cannot_be_used(rows, message, tmp_path):
    if rows:
        (tmp_path / "log.csv").write_text("t,a\n" + "".join(f"{k},{value}\n" for k, value in enumerate(rows)))
    assert message in run("init", tmp_path / "new", "--from", tmp_path / "log.csv", code=2).stderr
    assert not (tmp_path / "new").exists()


# --- examples ---------------------------------------------------------------------------------------------------------


def test_examples_are_listed_with_what_they_are_about():
    listed = [line.split(maxsplit=1) for line in run("examples").stdout.splitlines()]
    assert {name for name, _ in listed} == {path.stem for path in EXAMPLES.iterdir() if not path.name.startswith("_")}
    assert all(len(about) > 10 for _, about in listed)


def test_an_example_is_copied_and_can_be_fitted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "switchfit fit toss/problem.toml" in run("examples", "toss").stdout
    names = {path.name for path in EXAMPLES.joinpath("toss").iterdir()} - {"__pycache__"}
    assert {path.name for path in Path("toss").iterdir()} == names
    assert "python mine/own_model.py" in run("examples", "own_model", "mine").stdout
    assert Path("mine", "own_model.py").is_file()
    assert "switchfit modes covid/search.toml" in run("examples", "covid").output
    assert "there is no example 'moon'; there are ball, covid" in run("examples", "moon", code=2).stderr


def test_installed_examples_come_first(tmp_path, monkeypatch):
    """In a wheel they are inside the package; in a clone, beside it."""
    assert find_examples() == EXAMPLES
    package = tmp_path / "switchfit"
    shutil.copytree(EXAMPLES / "toss", package / "examples" / "toss")
    monkeypatch.setattr(examples, "PACKAGE", package)
    assert find_examples() == package / "examples"
