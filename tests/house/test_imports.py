"""`import switchfit`: public names are imported when they are used, and everything works as if they had been before."""

import ast
import importlib
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

import switchfit as sf

PACKAGE = Path(sf.__file__).parent
HEAVY = {"jax", "numpy", "scipy", "matplotlib", "llvmlite", "switchfit.report"}


def run_python(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


# --- what is fast -----------------------------------------------------------------------------------------------------


def run_command(arguments, **variables):
    """What a command of the command line prints, and the heavy modules that it imports."""
    code = f"""
import sys
sys.stderr = sys.stdout
sys.argv = ["switchfit", *{arguments!r}]
from switchfit.cli import main
try:
    main()
finally:
    print("\\nheavy:", *sorted({HEAVY!r} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | variables)
    printed, _, heavy = done.stdout.rpartition("heavy:")
    return printed, set(heavy.split())


MISTAKES = {
    "key": ("fit", "unit =", "unitt =", "unknown key 'parameters.k.unitt'; did you mean 'unit'?"),
    "TOML": ("fit", "[parameters]", "[parameters", "is not valid TOML"),
    "model": ("fit", "model.py", "modell.py", "there is no file"),
    "log": ("fit", "log.csv", "logg.csv", "There is no file"),
    "column": ("fit", '["T"]', '["TT"]', "has no column 'TT'; its columns are t, T"),
    "check": ("check --no-run", '["T"]', '["TT"]', "has no column 'TT'; its columns are t, T"),
    "modes": ("modes", '["T"]', '["TT"]', "has no column 'TT'; its columns are t, T"),
}
"""A command, what is written in a problem file, what in its place, and what is said about that."""

PROBLEM = """
model = "model.py:system"
[parameters]
k = { value = 0.3, unit = "1/s" }
[[experiments]]
mode_sequence = ["on"]
t0 = 2024-05-01T00:00:00
[experiments.data]
file = "log.csv"
columns = ["T"]
"""


@pytest.mark.parametrize(("command", "right", "wrong", "message"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_in_a_problem_file_is_named_before_jax_is_imported(tmp_path, command, right, wrong, message):
    (tmp_path / "problem.toml").write_text(PROBLEM.replace(right, wrong))
    (tmp_path / "model.py").write_text("")
    (tmp_path / "log.csv").write_text("t,T\n1,0.1\n2,0.2\n3,0.3\n")
    printed, heavy = run_command([*command.split(), str(tmp_path / "problem.toml")])
    assert message in printed
    assert heavy <= ({"numpy"} if "column" in message else set())


COMPLETION = {"_SWITCHFIT_COMPLETE": "complete_bash", "COMP_WORDS": "switchfit fit --he", "COMP_CWORD": "2"}


@pytest.mark.parametrize(
    ("arguments", "variables", "message"),
    [
        (["--help"], {}, "Usage: switchfit"),
        (["--version"], {}, "switchfit "),
        (["fit", "--help"], {}, "Usage: switchfit fit"),
        (["examples"], {}, "heaters"),
        ([], COMPLETION, "--help"),
        (["fit", "--strategi", "auto"], {}, "No such option: --strategi"),
        (["fit", "nothing.toml"], {}, "There is no problem file nothing.toml"),
        (["compare", "nothing.json", "other.json"], {}, "file 'nothing.json' does not exist"),
    ],
)
def test_what_needs_no_numbers_imports_no_numerical_library(arguments, variables, message):
    printed, heavy = run_command(arguments, **variables)
    assert message in printed
    assert heavy == set()


# --- the names --------------------------------------------------------------------------------------------------------


def test_type_checkers_read_the_names_of_the_table():
    """`__init__.pyi` is what mypy and editors read; the table of `__init__.py` is what runs."""
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text())
    found = {a.asname: node.module for node in stub.body if isinstance(node, ast.ImportFrom) for a in node.names}
    assert found == {name: f"switchfit.{module}" for name, module in sf._MODULES.items()}


def test_names_are_those_of_their_modules_and_stay_the_same_objects():
    for name, module in sf._MODULES.items():
        assert getattr(sf, name) is getattr(importlib.import_module(f"switchfit.{module}"), name)
        assert vars(sf)[name] is getattr(sf, name), "looked up anew each time"
    with pytest.raises(AttributeError, match="module 'switchfit' has no attribute 'fit_all'"):
        sf.fit_all  # noqa: B018


def test_public_things_survive_pickling_into_a_process_that_has_imported_nothing():
    blob = pickle.dumps([sf.Parameter(1.0, unit="kg"), sf.Problem, sf.estimate])
    code = f"import pickle; p, kind, verb = pickle.loads({blob!r}); print(p.unit, kind.__name__, verb.__name__)"
    assert run_python(code) == "kg Problem estimate\n"


@pytest.mark.slow
def test_the_first_use_of_a_result_imports_what_it_needs(quick_processes):
    """The functions that write, draw and validate it: each in a process in which they are not yet imported."""
    uses = {
        "print(str(fit).splitlines()[0][:5])": "Good:",
        "print(len(fit.plot().axes))": "2",
        "print(type(fit.to_pandas()).__name__)": "DataFrame",
        "print(fit.validate(fit.problem).verdict.level)": "good",
    }
    begin = "from switchfit.models import heater_problem; from switchfit.estimation.estimating import estimate"
    for use, expected in uses.items():
        assert run_python(f"{begin}\nfit = estimate(heater_problem())\n{use}").strip() == expected
