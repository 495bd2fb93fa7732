"""Many logs: patterns and folders in problem files, and `switchfit fit LOG ... --problem FILE`."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

import switchfit as sf
from support.commands import PROBLEM, ROOM, log_of, run
from support.log_folders import fill_folder
from switchfit.io.logs.files import find_logs, name_files
from switchfit.io.problem_file.loading import load_problem
from switchfit.runtime.errors import InputError


@pytest.fixture
def folder(tmp_path):
    """Two logs of rooms, their model and a problem."""
    return fill_folder(tmp_path)


def spoil(folder):
    (folder / "logs" / "sunday.csv").write_text("t;T\n0;1\n1;cold\n")


# --- files ------------------------------------------------------------------------------------------------------------


def test_patterns_and_folders(tmp_path):
    for name in ("b.csv", "a.csv", "a.csv.gz", "notes.md", ".hidden.csv", "c[1].csv", "bag/metadata.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    (tmp_path / "empty").mkdir()
    assert find_logs(tmp_path, "*.csv") == ["a.csv", "b.csv", "c[1].csv"]
    assert find_logs(tmp_path, ".") == [f"./{name}" for name in ("a.csv", "a.csv.gz", "b.csv", "bag", "c[1].csv")]
    for one in ("a.csv", "missing.csv", "bag", "c[1].csv", "", "x" * 5000, "a\0b"):
        assert find_logs(tmp_path, one) is None
    with pytest.raises(InputError, match=r"No file matches .*x\*\.csv; check the pattern and the folder"):
        find_logs(tmp_path, "x*.csv")
    with pytest.raises(InputError, match=r"empty has no logs: no file in it ends in \.csv, \.dat"):
        find_logs(tmp_path, "empty")


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["logs/a.csv", "logs/b.csv.gz"], ["a", "b"]),
        (["logs/1/drive.csv", "logs/2/drive.csv"], ["1", "2"]),
        (["1/a.csv", "1/a.mat", "2/a.csv"], ["1/a.csv", "1/a.mat", "2/a.csv"]),
        (["one/fit.json", "one/other.json", "two/fit.json"], ["one/fit", "one/other", "two/fit"]),
        (["x/a/1/fit.json", "x/b/1/fit.json", "x/b/2/fit.json"], ["a/1", "b/1", "b/2"]),
        (["estimate.json", "out/estimate.json"], [Path.cwd().name, "out"]),
        (["a.json", "a.json"], ["a.json", "a.json"]),
    ],
)
def test_names(paths, names):
    assert name_files(paths) == names


# --- in problem files -------------------------------------------------------------------------------------------------


@pytest.fixture
def pattern(folder):
    (folder / "problem.toml").write_text(PROBLEM.replace("log.csv", "logs/*.csv"))
    return folder / "problem.toml"


def test_a_pattern_is_a_run_for_each_log(pattern):
    loaded = load_problem(pattern)
    assert [run.name for run in loaded.problem.experiments] == ["monday", "tuesday"]
    assert loaded.problem.theta_names == ("monday.tau_1", "tuesday.tau_1", "heating")
    np.testing.assert_allclose(sf.estimate(loaded.problem).theta, [3.2, 2.1, 0.5], rtol=1e-5)
    assert loaded.issues == ()


def test_a_bad_log_is_left_out_of_a_problem(folder, pattern):
    spoil(folder)
    result = run("check", pattern, "--no-run", code=2)
    assert result.stderr.startswith("switchfit: Left out: ")
    assert "sunday.csv, line 3, column 'T': 'cold' is not a number; leave the cell empty" in result.stderr
    assert "monday" in result.stdout
    for name in ("monday", "tuesday"):
        (folder / "logs" / f"{name}.csv").unlink()
    with pytest.raises(InputError, match=r"sunday\.csv, line 3"):  # not one of the logs can be used
        load_problem(pattern)


def test_logs_of_one_name_go_together(folder):
    text = PROBLEM.replace("log.csv", "logs/*.csv").replace("[[experiments]]", '[[experiments]]\nname = "room"')
    other = '\n[[experiments.data]]\nfile = "more/*.csv"\ncolumns = ["T"]\nsigma = 0.2\n'
    (folder / "problem.toml").write_text(text + other)
    (folder / "more").mkdir()
    (folder / "more" / "tuesday.csv").write_text(log_of(1.0))
    with pytest.raises(InputError, match=r"experiments\[1\]: .*more.\*\.csv has no log 'monday', which another patte"):
        load_problem(folder / "problem.toml")
    (folder / "more" / "monday.csv").write_text(log_of(2.0))
    runs = load_problem(folder / "problem.toml").problem.experiments
    assert [run.name for run in runs] == ["room monday", "room tuesday"]
    for run_of, switches in zip(runs, ((3.2, 2.0), (2.1, 1.0)), strict=True):
        for data, switch in zip(run_of.data, switches, strict=True):
            assert data.times[np.argmax(data.values)] == pytest.approx(switch, abs=0.3)


# --- one by one -------------------------------------------------------------------------------------------------------


def read(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_logs_one_by_one(folder):
    logs, problem, out, table = (folder / name for name in ("logs", "problem.toml", "out", "new/table.csv"))
    result = run("fit", logs, "--problem", problem, "--table", table, "--out", out, "--no-figures", code=0)
    rows = read(table)
    assert [row["log"] for row in rows] == [str(logs / "monday.csv"), str(logs / "tuesday.csv")]
    found = [[float(row[name]) for name in ("tau_1 (s)", "heating")] for row in rows]
    np.testing.assert_allclose(found, [[3.2, 0.5], [2.1, 0.5]], rtol=1e-5)
    assert {row["status"] for row in rows} == {"CONVERGED"}
    assert all(float(row["tau_1 (s) std. error"]) > 0 for row in rows)
    assert re.search(r"tau_1 \(s\) = 3\.20 ± 0\.\d{2}, heating = 0\.500 ± 0\.0\d{2}\b", result.stdout)
    assert "2 logs: 2 fitted, 0 not, 0 refused" in result.stderr
    np.testing.assert_allclose(sf.Estimate.load(out / "tuesday" / "estimate.json").theta, [2.1, 0.5], rtol=1e-5)
    assert (out / "monday" / "report.txt").exists()


def test_a_bad_log_does_not_end_the_run(folder):
    """Nor does one of a room that is heated again and again, by a model that heats once: its row says why it is bad."""
    spoil(folder)
    waves = "".join(f"{t:g};{5 * np.sin(3 * t):.6g}\n" for t in np.arange(0.25, 6.0, 0.5))
    (folder / "logs" / "friday.csv").write_text("t;T\n" + waves)
    (folder / "logs" / "short.csv").write_text("t;U\n0;1\n")
    table, problem = folder / "table.csv", ("--problem", folder / "problem.toml")
    result = run("fit", folder / "logs", *problem, "--table", table, code=2)
    rows = {row["log"].rpartition("/")[2]: row for row in read(table)}
    assert [row["verdict"] for row in rows.values()] == ["bad", "good", "refused", "refused", "good"]
    assert "short.csv has no column 'T'; its columns are t, U." in rows["short.csv"]["message"]
    assert "sunday.csv, line 3, column 'T': 'cold' is not a number" in rows["sunday.csv"]["message"]
    assert rows["sunday.csv"]["tau_1 (s)"] == ""
    assert "of the variance" in rows["friday.csv"]["message"]
    assert rows["friday.csv"]["message"] in result.stdout
    assert "5 logs: 2 fitted, 1 not, 2 refused" in result.stderr
    logs = [folder / "logs" / name for name in ("monday.csv", "sunday.csv")]
    monday, sunday = json.loads(run("fit", *logs, "--json", *problem).stdout)["logs"]
    assert (monday["log"], monday["verdict"]) == (str(logs[0]), "good")
    assert (sunday["verdict"], sunday["message"]) == ("refused", rows["sunday.csv"]["message"])
    assert run("fit", folder / "logs" / "friday.csv", *problem).exit_code == 1


def test_a_fit_that_raises_is_one_bad_log(folder, monkeypatch):
    real = sf.estimate

    def estimate(problem, **options):
        monkeypatch.setattr(sf, "estimate", real)
        raise LookupError("no luck")

    monkeypatch.setattr(sf, "estimate", estimate)
    result = run("fit", folder / "logs", "--problem", folder / "problem.toml", code=2)
    assert "monday.csv: refused. LookupError: no luck" in result.stdout
    assert "2 logs: 1 fitted, 0 not, 1 refused" in result.stderr


def test_ctrl_c_ends_the_run_and_leaves_the_table(folder, interrupted_fits):
    table = folder / "table.csv"
    result = run("fit", folder / "logs", "--problem", folder / "problem.toml", "--table", table, code=1)
    assert [row["status"] for row in read(table)] == ["INTERRUPTED"]
    assert "1 were not begun" in result.stderr


@pytest.mark.parametrize(
    ("data", "inputs", "expected"),
    [
        ('file = "log.csv"\n', 'file = "log.csv"\n', ("monday", "monday")),
        ("", 'file = "logs/tuesday.csv"\n', ("monday", "tuesday")),
        ('file = "log.csv"\n', 'file = "logs/tuesday.csv"\n', ("monday", "tuesday")),
    ],
)
def test_where_the_log_goes(folder, data, inputs, expected):
    """In place of what is left out; otherwise in place of the data's file, wherever it is named."""
    text = PROBLEM.replace("t0 = 0.0\ntf = 6.0\n", "").replace('file = "log.csv"\n', data)
    (folder / "problem.toml").write_text(f'{text}\n[experiments.inputs]\n{inputs}columns = ["T"]\n')
    (folder / "room.py").write_text(ROOM.replace("(t, x, p)", "(t, x, p, u)"))
    (run_of,) = load_problem(folder / "problem.toml", folder / "logs" / "monday.csv").problem.experiments
    peaks = (run_of.data[0].values.max(), run_of.inputs.values.max())
    assert peaks == tuple(max(sf.read_log(folder / "logs" / f"{name}.csv")["T"]) for name in expected)


def test_what_is_missing_or_too_much(folder):
    problem, monday = folder / "problem.toml", folder / "logs" / "monday.csv"
    for arguments, message in (
        ((problem, problem), "name one problem file; to fit several logs by one, name it with --problem PROBLEM.toml"),
        ((problem, "--table", folder / "a.csv"), "name one problem file"),
        ((folder / "logs" / "x*.csv", "--problem", problem), "No file matches"),
    ):
        assert message in run("fit", *arguments, code=2).stderr
    problem.write_text(PROBLEM.replace('file = "log.csv"\n', ""))
    with pytest.raises(InputError, match=r"experiments\[1\]\.data\[1\]: the key 'file' is missing: name the log"):
        load_problem(problem)
    problem.write_text(PROBLEM + PROBLEM[PROBLEM.index("[[experiments]]") :])
    with pytest.raises(InputError, match=r"must have one \[\[experiments\]\], .*; got 2\. Write a problem file"):
        load_problem(problem, monday)
