"""What a user writes passes mypy, and runs: `tests/typing_user.py`."""

import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import typing_user
from matplotlib.figure import Figure

import switchfit as sf

matplotlib.use("agg")

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_mypy_finds_nothing():
    command = [sys.executable, "-m", "mypy", "--warn-unused-ignores", "tests/typing_user.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_mypy_finds_what_is_wrong(tmp_path):
    """That is, types are there: were all of them Any, nothing would be found."""
    path = tmp_path / "wrong.py"
    path.write_text(
        "import switchfit as sf\n"
        "sf.Experiment([], 5, [])\n"
        "sf.HybridSystem({}, [0.0], state_names=3)\n"
        "figure: int = sf.Estimate.load('x').plot()\n"
        "sf.Input([0.0], [0.0], kind='step')\n"
    )
    command = [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    found = [line.split(":")[1] for line in done.stdout.splitlines() if ": error:" in line]
    assert found == ["2", "3", "4", "5"], done.stdout


@pytest.mark.slow
def test_it_runs(tmp_path):
    found = typing_user.use(typing_user.make_problem(), tmp_path)
    assert all(type(number) is float for number in found)


@pytest.mark.usefixtures("quick_certificates")
def test_figures_and_parameters_are_what_annotations_say(tmp_path):
    estimate = sf.estimate(typing_user.make_problem())
    assert isinstance(estimate.plot(), Figure)
    assert isinstance(estimate.plot_residuals(), Figure)
    assert type(estimate.parameters["power"]) is float
    np.testing.assert_array_equal(estimate.parameters["unused"], [1.0, 2.0])
    estimate.save(tmp_path / "out.json")
    loaded = sf.Estimate.load(tmp_path / "out.json")
    assert loaded.parameters["power"] == estimate.parameters["power"]
    assert type(loaded.parameters["power"]) is float
    np.testing.assert_array_equal(loaded.parameters["unused"], [1.0, 2.0])


def test_lists_are_kept_as_tuples():
    """What is read from the objects does not depend on what was given, and cannot be changed behind their backs."""
    problem = typing_user.make_problem()
    run = problem.experiments[0]
    assert run.mode_sequence == ("on", "off")
    assert isinstance(run.transition_times, tuple)
    assert problem.system.state_names == ("T",)
    assert run.data[0].names == ("T",)


def test_a_run_of_one_mode_needs_no_transition_times():
    log = sf.Measurements([0.0, 1.0], [1.0, 2.0])
    assert sf.Experiment(log, ["on"]).transition_times == ()
