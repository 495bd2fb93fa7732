"""A simulated drive with all that GPS does, written to a bag, read back and fitted: it ends at the truth.

It is that of docs/gps-ros.md: the heading is not measured, the antenna is not where the robot's centre is, positions
come late against the commands, and some fixes jump by metres.
"""

import pytest

from support.pages import blocks_of, copy_examples
from support.places import ROOT


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """A folder that has the examples, as a clone has, to work in."""
    copy_examples(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


TRUTH = {"tau_1": 8.0, "tau_2": 14.0, "rate": 0.25, "ahead": 0.4, "delay": 0.2, "heading(t0)": 0.5}


def test_the_drive_of_the_documentation_ends_at_its_truth(clone):
    names = {}
    for kind, block in blocks_of(ROOT / "docs" / "gps-ros.md"):
        if kind == "python":
            exec(block, names)
    fit = names["estimate"]
    found = dict(zip(fit.theta_names, zip(fit.theta, fit.corrected_standard_errors, strict=True), strict=True))
    for name, true in TRUTH.items():
        value, error = found[name]
        assert abs(value - true) < 3.5 * error, name
    assert found["tau_1"][1] < 0.1
