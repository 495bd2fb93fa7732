"""The command line: what it writes, what it prints where, and its exit codes."""

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

import switchfit as sf
from support.commands import PROBLEM, ROOM, catch_settings, log_of, run
from switchfit import cli
from switchfit.cli import fit
from switchfit.io.problem_file.loading import load_problem


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A problem with an exact answer: heating 0.5 until t = 3.2."""
    folder = tmp_path_factory.mktemp("room")
    (folder / "problem.toml").write_text(PROBLEM)
    (folder / "room.py").write_text(ROOM)
    (folder / "log.csv").write_text(log_of(3.2))
    return folder


def read_json(result):
    """The one JSON value on stdout, without NaN and infinity, which are no JSON."""

    def refuse(constant):
        raise ValueError(constant)

    return json.loads(result.stdout, parse_constant=refuse)


def test_fit_converged(folder, tmp_path):
    out = tmp_path / "a" / "b"
    result = run("fit", folder / "problem.toml", "--out", out, code=0)
    assert sorted(path.name for path in out.iterdir()) == ["estimate.json", "fit.png", "report.html", "report.txt"]
    assert (out / "report.txt").read_text().strip() == result.stdout.strip()
    assert result.stderr == f"written to {out}\n"
    estimate = sf.Estimate.load(out / "estimate.json")
    np.testing.assert_allclose(estimate.theta, [3.2, 0.5], rtol=1e-5)
    found = read_json(run("fit", folder / "problem.toml", "--json", "--out", out, "--no-figures"))
    assert (found["verdict"], found["converged"], found["out"]) == ("good", True, str(out))
    assert found["engine"] == {"name": "native", "reason": None, "implicit_modes": []}
    tau, heating = found["unknowns"]
    assert (tau["name"], tau["unit"], heating["name"]) == ("tau_1", "s", "heating")
    assert tau["value"] == pytest.approx(3.2, rel=1e-5)
    assert tau["low"] < 3.2 < tau["high"]
    assert 0 < tau["standard_error"] < tau["high"] - tau["low"]
    assert [mode["mode"] for mode in found["runs"][0]["modes"]] == ["on", "off"]


def test_fit_not_converged_writes_what_was_found(folder, tmp_path):
    result = run("fit", folder / "problem.toml", "--out", tmp_path, "--max-iterations", 1, "--no-figures", "--json")
    assert (result.exit_code, read_json(result)["converged"]) == (1, False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["estimate.json", "report.txt"]
    assert "not converged. Stopped after 1 iteration " in result.stderr


def test_options_win_over_the_file(folder, tmp_path, monkeypatch):
    (folder / "options.toml").write_text(PROBLEM + '\n[options]\nhessian = "none"\ntolerance = 1e-3\n')
    got = catch_settings(monkeypatch, "estimate")
    result = run("fit", folder / "options.toml", "--hessian", "gauss-newton", "--max-iterations", 7)
    assert (result.exit_code, result.stderr) == (2, "switchfit: enough\n")
    assert got == {"hessian": "gauss-newton", "tolerance": 1e-3, "max_iterations": 7}


def test_interrupt_ends_the_fit_and_writes(folder, tmp_path, interrupted_fits):
    before = signal.getsignal(signal.SIGINT)
    result = run("fit", folder / "problem.toml", "--out", tmp_path, "--no-figures", code=1)
    assert "Interrupted after 1 iteration " in result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["estimate.json", "report.txt"]
    assert signal.getsignal(signal.SIGINT) is before


def test_second_interrupt_stops_at_once(folder, monkeypatch):
    def estimate(problem, callback, **options):
        signal.raise_signal(signal.SIGINT)
        assert callback(None)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(sf, "estimate", estimate)
    assert "interrupted before there was anything to write" in run("fit", folder / "problem.toml", code=130).stderr


def test_check_fails_where_derivatives_are_wrong(folder, monkeypatch):
    gaps = dict.fromkeys(("gradient_gap", "hessian_gap"), float("nan"))
    failures = (sf.Issue("derivatives of another cost"),)
    wrong = SimpleNamespace(passed=False, observed_orders=(1.0, 1.0, 1.0), failures=failures, **gaps)
    monkeypatch.setattr(sf, "check_derivatives", lambda problem, paper: wrong)
    assert run("check", folder / "problem.toml").exit_code == 1


def test_simulate(folder, tmp_path):
    result = run("simulate", folder / "problem.toml", "--out", tmp_path / "new" / "x.csv", code=0)
    assert result.stdout == ""
    header, *rows = csv.reader((tmp_path / "new" / "x.csv").read_text().splitlines())
    assert header == ["experiment", "t", "mode", "T"]
    runs, times, modes, states = (np.array(column) for column in zip(*rows, strict=True))
    times, states, on = times.astype(float), states.astype(float), modes == "on"
    assert ({*modes}, {*runs}) == ({"on", "off"}, {"run1"})
    assert times[on].max() == times[~on].min() == 2.0
    np.testing.assert_allclose(states[on], 8 * (1 - np.exp(-0.05 * times[on])), atol=1e-8)
    assert "'--out'" in run("simulate", folder / "problem.toml", code=2).stderr


def test_version_and_help():
    assert run("--version").stdout == f"switchfit {sf.__version__}\n"
    for name in ([], ["init"], ["fit"], ["check"], ["simulate"], ["validate"], ["compare"], ["examples"], ["paper"]):
        assert "Usage" in run(*name, "--help").stdout
    for wrong in (["--hessian", "newton"], ["--max-iterations", -1]):
        assert run("fit", "problem.toml", *wrong).exit_code == 2


# --- what is wrong is said on stderr, exit code 2, no traceback -------------------------------------------------------


@pytest.mark.parametrize(
    ("where", "wild"),
    [
        ("file", "KeyboardInterrupt"),
        ("factory", "__import__('click').exceptions.Exit(0)"),
        ("mode", "SystemExit(0)"),
        ("mode", "KeyboardInterrupt"),
        ("observation", "StopIteration"),
    ],
)
def test_whatever_a_model_file_raises_is_said_with_its_place(where, wild, tmp_path):
    (tmp_path / "log.csv").write_text("t,T\n0,1\n1,2\n6,3\n")
    bad = {
        "file": f"{ROOM}\nraise {wild}\n",
        "factory": f"{ROOM}\ndef make():\n    raise {wild}\n",
        "mode": ROOM.replace('return p["heating"]', f'raise {wild}\n    return p["heating"]'),
        "observation": f"{ROOM}\ndef observe(t, x, p):\n    raise {wild}\n",
    }[where]
    (tmp_path / "bad.py").write_text(bad)
    problem = PROBLEM.replace("room.py:room", "bad.py:make" if where == "factory" else "bad.py:room")
    if where == "observation":
        problem = problem.replace('columns = ["T"]', 'columns = ["T"]\nobserve = "bad.py:observe"')
    (tmp_path / "bad.toml").write_text(problem)
    line = [text.strip() for text in bad.splitlines()].index(f"raise {wild}") + 1
    for command in ("check", "fit"):
        result = run(command, tmp_path / "bad.toml", code=2)
        assert f"{tmp_path / 'bad.py'}, line {line}" in result.stderr
        assert "Traceback" not in result.stderr
    assert "Traceback" in run("check", tmp_path / "bad.toml", "--debug").stderr


def test_ctrl_c_is_an_interrupt_wherever_it_comes(tmp_path):
    """A signal that arrives while a model file runs is no error of that file."""
    (tmp_path / "log.csv").write_text("t,T\n0,1\n1,2\n6,3\n")
    (tmp_path / "slow.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\n" + ROOM)
    (tmp_path / "slow.toml").write_text(PROBLEM.replace("room.py", "slow.py"))
    result = run("fit", tmp_path / "slow.toml")
    said = "switchfit: interrupted before there was anything to write.\n"
    assert (result.exit_code, result.stderr) == (130, said)


def test_ctrl_c_that_is_ignored_stays_so(folder, monkeypatch):
    """As in a background job of a shell script; and an error of our own is not hidden."""
    monkeypatch.setattr(sf, "check_derivatives", lambda problem, paper: signal.raise_signal(signal.SIGINT) or 1 / 0)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        result = run("check", folder / "problem.toml")
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.exit_code == 3
    assert "ZeroDivisionError: division by zero" in result.stderr


def test_check_without_running_the_model(folder, tmp_path):
    shutil.copy(folder / "log.csv", tmp_path)
    (tmp_path / "room.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    path = tmp_path / "problem.toml"
    path.write_text(PROBLEM)
    result = run("check", path, "--no-run", code=0)
    for said in ("on -> off on [0, 6] s, at 2 s", "12 samples of T (K), 0.25 to 5.75", "No Python file was run"):
        assert said in result.stdout
    for old, new, message in (
        ("transition_times = [2.0]", "transition_times = [7.0]", "experiments[1]: transition_times must increase"),
        ("room.py:room", "roof", "model 'roof' is not known"),
        ("heating = 0.4", "heating = { value = 0.4, lower = 1.0 }", "parameters.heating: Parameter value 0.4 lies"),
    ):
        path.write_text(PROBLEM.replace(old, new))
        assert message in run("check", path, "--no-run").stderr
    path.write_text('problem = "room.py:make"\n')
    assert run("check", path, "--no-run").exit_code == 0
    assert not (tmp_path / "ran").exists()


def test_a_folder_that_cannot_be_made_is_said(folder, tmp_path):
    (tmp_path / "report.txt").write_text("before")
    result = run("fit", folder / "problem.toml", "--out", tmp_path / "report.txt", code=2)
    assert f"{tmp_path / 'report.txt'} cannot be read or written: File exists" in result.stderr


@pytest.mark.parametrize("stream", ["stdout", pytest.param("stderr", marks=pytest.mark.slow)])
def test_a_reader_that_is_gone_ends_nothing(stream, folder, tmp_path, quick_processes):
    """As `switchfit ... | head`: no traceback, all files, and the exit code as without the pipe."""
    program = "from switchfit.cli import main; main()"
    command = [sys.executable, "-c", program, "fit", folder / "problem.toml", "--out", tmp_path, "--no-figures"]
    other = "stderr" if stream == "stdout" else "stdout"
    with subprocess.Popen(command, **{stream: subprocess.PIPE, other: subprocess.PIPE}, text=True) as process:
        getattr(process, stream).close()  # before anything is written
        said = getattr(process, other).read()
        assert process.wait(timeout=120) == 0
    assert "Broken pipe" not in said
    assert "Traceback" not in said
    assert {path.name for path in tmp_path.iterdir()} == {"report.txt", "estimate.json"}


# --- for scripts, and for those who watch -----------------------------------------------------------------------------


def test_check_as_json(folder):
    found = read_json(run("check", folder / "problem.toml", "--json"))
    assert found["derivatives"]["passed"] is True
    np.testing.assert_allclose(found["derivatives"]["orders"], [1, 2, 3], atol=0.2)
    assert found["derivatives"]["gradient_gap"] is None  # the paper's equations are for --full
    assert found["identifiability"]["undetermined"] == 0
    assert [(entry["name"], entry["upper"]) for entry in found["unknowns"]] == [("tau_1", None), ("heating", None)]
    full = read_json(run("check", folder / "problem.toml", "--json", "--full"))
    assert full["derivatives"]["gradient_gap"] < 1e-4
    assert read_json(run("check", folder / "problem.toml", "--json", "--no-run"))["issues"] == []


@pytest.mark.parametrize("command", [["fit", "--max-iterations", 1], ["check"]])
def test_quiet_prints_nothing(folder, command):
    result = run(*command, folder / "problem.toml", "--quiet")
    assert (result.exit_code, result.output) == (len(command) > 1, "")
    said = f"switchfit: There is no problem file {folder / 'none.toml'}; check the name and the folder.\n"
    result = run(*command, folder / "none.toml", "--quiet")
    assert (result.exit_code, result.stdout, result.stderr) == (2, "", said)
    assert "contradict each other" in run(*command, folder / "problem.toml", "--quiet", "--verbose", code=2).stderr


def test_verbose_says_what_is_done(folder):
    result = run("fit", folder / "problem.toml", "--verbose", "--strategy", "thorough")
    for said in ("iteration 1: J = ", "strategy: beam along the log (lowest J so far: ", "Evaluated in machine code."):
        assert said in result.stderr
    assert run("fit", folder / "problem.toml").stderr == ""  # the log of the library is quiet again


def test_check_is_one_screen_of_many_runs(tmp_path, folder):
    """And needs no JAX program: the paper's equations take longer than a fit to compile."""
    for name in ("room.py", "log.csv"):
        shutil.copy(folder / name, tmp_path)
    head, run_table = PROBLEM.split("[[experiments]]")
    parts = [f'[[experiments]]\nname = "r{k}"\n{run_table.strip()}' for k in range(12)]
    (tmp_path / "problem.toml").write_text("\n\n".join([head, *parts]))
    short, full = (run("check", tmp_path / "problem.toml", *options).stdout for options in ((), ("--full",)))
    assert len(short.splitlines()) < 50
    assert "and 9 more experiments: --full lists them" in short
    for said in ("Experiment 12 (r11)", "Paper's equations"):
        assert said in full
        assert said not in short


# --- completion -------------------------------------------------------------------------------------------------------


def test_commands_options_and_examples_are_completed(monkeypatch, capsys):
    """Files are completed by the shell itself, where nothing is offered."""
    monkeypatch.setenv("_SWITCHFIT_COMPLETE", "complete_bash")
    for words, offered in {
        ("fit", ""): [], ("examples", "to"): ["toss", "tosses"], ("fit", "--ver"): ["--verbose"], ("si",): ["simulate"],
    }.items():  # fmt: skip
        monkeypatch.setenv("COMP_WORDS", " ".join(("switchfit", *words)))
        monkeypatch.setenv("COMP_CWORD", str(len(words)))
        with pytest.raises(SystemExit):
            cli.main()
        assert capsys.readouterr().out.split() == offered


# --- progress, and all of it ------------------------------------------------------------------------------------------


def test_a_fit_waits_for_the_modules_that_draw(folder, monkeypatch):
    """Two threads that import modules of one package in different orders find some half made."""
    done = []

    def import_figures():
        time.sleep(0.3)
        done.append(True)

    monkeypatch.setattr(fit, "_import_figures", import_figures)
    fit.estimate_problem(load_problem(folder / "problem.toml"), prepare_figures=True)
    assert done


def test_ctrl_c_during_a_strategy_keeps_the_best(folder, tmp_path, monkeypatch):
    """Nobody asks the callback there: the first Ctrl-C must be heard all the same."""

    def search(*given):
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("not heard")

    monkeypatch.setattr("switchfit.strategy.search.find_times", search)
    real = sf.estimate
    monkeypatch.setattr(sf, "estimate", lambda problem, **options: real(problem, **options, strategy="thorough"))
    run("fit", folder / "problem.toml", "--out", tmp_path, "--no-figures", code=0)
    assert sf.Estimate.load(tmp_path / "estimate.json").steps[-1].strategy == "interrupted"
