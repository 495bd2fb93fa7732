"""`python -m benchmarks sizes`: counts of a package whose sizes are known."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from benchmarks import sizes  # noqa: E402

SHORT = '''"""A module."""
from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True)
class RunTrajectory:
    states: list


class RunEvaluation(NamedTuple):
    cost: float


class PlainTrajectory:
    """No record: neither a dataclass nor a NamedTuple."""


def compute_hessian(x):
    """Return it.

    Two more lines of docstring.
    """
    return x
'''
LONG = "class Outer:\n    def find_gauss_newton(self):\n" + 9 * "        pass\n" + "\n\ndef hess(x):\n    return x\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "inner").mkdir()
    (tmp_path / "short.py").write_text(SHORT)
    (tmp_path / "inner" / "long.py").write_text(LONG)
    return tmp_path


def test_what_is_counted(folder):
    found = sizes.measure(str(folder))
    assert found["lines"] == len(SHORT.splitlines()) + len(LONG.splitlines())
    assert found["files"] == 2
    assert found["longest file"] == f"{len(SHORT.splitlines())} short.py"
    assert found["longest function"] == "10 inner/long.py: find_gauss_newton"
    assert found["longest class"] == "11 inner/long.py: Outer"
    assert found["records"] == ["RunEvaluation (short.py)", "RunTrajectory (short.py)"]
    assert found["ways to a Hessian"] == ["compute_hessian", "find_gauss_newton"]
