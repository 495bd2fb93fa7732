"""`switchfit modes`, [library] in problem files, and the problem file of the best."""

import inspect
import json
import signal
import tomllib

import numpy as np
import pytest

import switchfit as sf
from support.commands import catch_settings, run
from support.mode_search_folder import (
    MODEL,
    PROBLEM,
    fill,
    simulate,
    write_log,
)
from switchfit.cli.fitted_problem import write_fitted_problem
from switchfit.io.problem_file.loading import load_problem


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log of rise -> fall -> rise."""
    return fill(tmp_path_factory.mktemp("modes"))


@pytest.fixture(scope="module")
def found(folder):
    """The command that found it, and its output folder."""
    out = folder / "out" / "deep"
    return run("modes", folder / "problem.toml", "--max-switches", 4, "--out", out, "--json", "--verbose"), out


def test_the_sequence_is_written(found, folder):
    result, out = found
    assert result.exit_code == 0, result.stderr
    assert result.stderr.endswith(f"written to {out}\n")
    assert sorted(path.name for path in out.iterdir()) == ["best.toml", "modes.json", "modes.png", "modes.txt"]
    search = sf.ModeSearch.load(out / "modes.json")
    assert search.mode_sequence == ("rise", "fall", "rise")
    np.testing.assert_allclose(search.transition_times[0], [2.5, 5.5], atol=0.05)
    assert (out / "modes.txt").read_text() == f"{search}\n"
    assert "- c acts in modes that do not occur: it keeps its guess, without a standard error." in str(search)
    shown = json.loads(result.stdout)
    assert (shown["status"], shown["success"], shown["criterion"], shown["out"]) == ("FOUND", True, "bic", str(out))
    assert [row["switches"] for row in shown["by_switches"]] == [0, 1, 2, 3, 4]
    assert sum(row["weight"] for row in shown["alternatives"]) == pytest.approx(1.0)
    best = {row["name"]: row["value"] for row in shown["best"]["unknowns"]}
    np.testing.assert_allclose([best["a"], best["b"]], [0.7, 0.4], rtol=0.05)


def test_the_best_is_a_problem_file_that_is_fitted_to_the_same_answer(found, folder, tmp_path):
    """From a folder of its own, with paths to where the data are; nothing is left to do for the fit."""
    _, out = found
    run("fit", out / "best.toml", "--out", tmp_path, "--no-figures", code=0)
    fit, best = sf.Estimate.load(tmp_path / "estimate.json"), sf.ModeSearch.load(out / "modes.json").best
    assert fit.theta_names == best.theta_names
    np.testing.assert_allclose(fit.theta, best.theta, rtol=1e-8)
    np.testing.assert_allclose(fit.standard_errors, best.standard_errors, rtol=1e-6)
    assert fit.iterations <= 1
    written = tomllib.loads((out / "best.toml").read_text())
    assert written["parameters"]["c"] == {"value": 0.1, "fixed": True}, "it acts in none of the modes"
    assert written["parameters"]["a"]["unit"] == "1/s"
    assert written["experiments"][0]["data"][0]["file"] == "../../log.csv"
    assert written["options"] == {"min_duration": 0.2}, "of the library, which a fit does not read"
    again = run("modes", out / "best.toml", "--max-switches", 2, "--json")
    assert json.loads(again.stdout)["by_switches"][-1]["sequences"] == [["rise", "fall", "rise"]]


def test_options_override_the_library_of_the_file(folder, monkeypatch):
    defaults = {name: p.default for name, p in inspect.signature(sf.find_modes).parameters.items()}
    given = catch_settings(monkeypatch, "find_modes")
    assert run("modes", folder / "problem.toml", code=2).stderr == "switchfit: enough\n"
    file = {"first": ["rise"], "min_duration": 0.2, "successions": {"rise": ["fall", "drift"], "fall": ["rise"]}}
    assert given == {name: (defaults | file)[name] for name in given}
    run("modes", folder / "problem.toml", "--criterion", "mbic", "--max-switches", 3, "--method", "beam")
    assert [given[name] for name in ("criterion", "max_switches", "method")] == ["mbic", 3, "beam"]


def test_ctrl_c_keeps_the_best(folder, tmp_path, monkeypatch):
    real = sf.find_modes

    def find_modes(problem, callback, **settings):
        def press(progress):
            if progress.fits == 3:
                signal.raise_signal(signal.SIGINT)
            return callback(progress)

        return real(problem, callback=press, **settings)

    monkeypatch.setattr(sf, "find_modes", find_modes)
    result = run("modes", folder / "problem.toml", "--out", tmp_path, code=1)
    assert result.stdout.startswith("Interrupted: the best so far is rise")
    assert result.stderr.startswith("stopping after this fit; Ctrl-C again to stop at once\n")
    assert (tmp_path / "modes.txt").read_text() == result.stdout
    assert (tmp_path / "best.toml").exists()


def write_problem(folder, old, new=""):
    assert old in PROBLEM
    (folder / "changed.toml").write_text(PROBLEM.replace(old, new))
    return folder / "changed.toml"


LIBRARY = PROBLEM[PROBLEM.index("[library]") :]


@pytest.mark.parametrize("command", [("fit",), ("check", "--no-run")])
def test_other_commands_say_what_to_do_without_a_sequence(folder, command):
    finds = f"want to know, switchfit modes {folder}/problem.toml --out DIR finds it"
    for path, remedy in (
        (write_problem(folder, LIBRARY), "add [library] to the file: switchfit modes"),
        (folder / "problem.toml", finds),
    ):
        result = run(*command, path, code=2)
        assert result.stderr.startswith(f"switchfit: {path}: experiments[1]: the key 'mode_sequence' is missing: name")
        assert remedy in result.stderr


def test_a_sequence_in_the_file_is_the_first_guess_and_what_fit_takes(folder):
    path = write_problem(folder, "t0 = 0.0", 't0 = 0.0\nmode_sequence = ["rise", "fall"]\ntransition_times = [2.0]')
    for searched in (False, True):
        loaded = load_problem(path, searched=searched)
        assert loaded.problem.experiments[0].mode_sequence == ("rise", "fall")
    assert loaded.library["successions"] == {"rise": ["fall", "drift"], "fall": ["rise"]}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('first = "rise"', 'first = "up"', "changed.toml: library: first names the unknown mode 'up'; the modes are"),
        ('first = "rise"', "first = 3", "'library.first[1]' must be a string; got 3 (mode or modes with which a seque"),
        ("min_duration = 0.2", "min_duration = -1", "'library.min_duration' must be greater than or equal to 0; got"),
        ('first = "rise"', 'first = "fall"\nlast = "drift"', "No succession: first, last, successions and min_du"),
        ("min_duration = 0.2", "modes = []", "'library.modes' must have at least 1 item after validation, not 0; go"),
        ("tf = 8.0", "tf = 8.0\ntransition_times = [2.0]", "transition_times belong to a mode_sequence, which is miss"),
    ],
)
def test_what_is_wrong_with_a_library_is_said(folder, old, new, message):
    assert message in run("modes", write_problem(folder, old, new), "--max-switches", 1, code=2).stderr


def test_a_problem_built_in_python_has_no_file_of_the_best(folder, tmp_path):
    (folder / "python.toml").write_text('problem = "model.py:build"\n\n[library]\nmodes = ["rise"]\n')
    result = run("modes", folder / "python.toml", "--max-switches", 0, "--out", tmp_path)
    assert result.exit_code in (0, 1)
    assert "no best.toml: " in result.stderr
    assert "'model.py:build' builds in Python: write the sequence there." in result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["modes.json", "modes.png", "modes.txt"]


RICH = """
model = { name = "models/model.py:driven" }
[parameters]
a = { value = 0.7, lower = 0.01, prior = { median = 0.7, log_sd = 0.5 }, scale = "log" }
"b" = 0.4
[[experiments]]
name = "run \\"A\\""
mode_sequence = ["pushed", "fall"]
transition_times = ["2024-05-01T10:00:02Z"]
initial_state = [{ value = 0.4, lower = 0.0 }]
inputs = { file = "inputs/*.csv", time = "t", epoch = "s", columns = ["u"], kind = "linear" }
jumps = [{ time = "2024-05-01T10:00:05Z", map = "models/model.py:drop" }]
[[experiments.data]]
file = "logs/*.csv"
time = "t"
epoch = "s"
columns = ["T"]
observe = "models/model.py:twice"
sigma = 0.04
loss = "huber"
[options]
strategy = "local"
min_duration = { fall = 0.5 }
"""


def test_paths_dates_patterns_and_models_are_kept(tmp_path):
    """Two logs by a pattern, dates, an input, a jump, a state that is estimated, a prior."""
    home, out = tmp_path / "home", tmp_path / "elsewhere" / "out"
    for path in (home / "logs", home / "inputs", home / "models", out):
        path.mkdir(parents=True)
    (home / "models" / "model.py").write_text(MODEL)
    start = 1714557600.0  # 2024-05-01 10:00 UTC
    for k in range(2):
        times = start + np.linspace(0.0, 8.0, 40)
        write_log(home / "logs" / f"{k}.csv", 2 * simulate(times - start, (2.5,), sigma=0.01, seed=k), times=times)
        write_log(home / "inputs" / f"{k}.csv", np.full(40, 3.0), times=times, names=("u",))
    (home / "problem.toml").write_text(RICH)
    given = load_problem(home / "problem.toml")
    estimate = sf.estimate(given.problem, strategy="local")
    text = write_fitted_problem(given, estimate, out)
    (out / "best.toml").write_text(text)
    again = load_problem(out / "best.toml")
    problem = again.problem
    assert problem.theta_names == given.problem.theta_names
    np.testing.assert_allclose(problem.initial_theta, estimate.theta, rtol=1e-12)
    assert problem.min_duration == given.problem.min_duration == {"fall": 0.5}
    assert again.options == {"strategy": "local"}
    for before, after in zip(given.problem.experiments, problem.experiments, strict=True):
        assert (before.name, before.origin, before.t0, before.end) == (after.name, after.origin, after.t0, after.end)
        np.testing.assert_array_equal(before.data[0].times, after.data[0].times)
        np.testing.assert_array_equal(before.inputs.values, after.inputs.values)
        assert before.jump_times == pytest.approx(after.jump_times)
    np.testing.assert_allclose(sf.evaluate(problem).cost, estimate.cost, rtol=1e-10)
    first, second = tomllib.loads(text)["experiments"]
    assert first["origin"] == given.problem.experiments[0].origin.date, "from which its numbers count"
    assert second["data"][0]["file"] == "../../home/logs/1.csv"
