"""Searches for the mode sequence are saved, loaded, printed and drawn; what is no search is refused."""

from __future__ import annotations

import json

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.mode_libraries import rise
from support.turning_modes import FREE, SYSTEM, make_problem, make_run
from switchfit.models import heater_problem

SEEN: list[sf.SearchProgress] = []
"""What the search of `found` has told on its way."""


@pytest.fixture(scope="module")
def found():
    return sf.find_modes(make_problem(), max_switches=3, callback=SEEN.append)


def test_a_hidden_switch_is_refused():
    late = {"late": lambda t, x, p: jnp.where(t < p["rate"], jnp.ones(2), jnp.zeros(2))}
    problem = make_problem(system=sf.HybridSystem({"rise": rise} | late, [0.2, 1.0]), given=("late",))
    with pytest.raises(ValueError, match=r"mode .late. compares with rate at test_searches_kept.py"):
        sf.find_modes(problem, "late", max_switches=0)


@pytest.fixture
def saved(found, tmp_path):
    found.save(tmp_path / "modes.json")
    return tmp_path / "modes.json"


def test_a_search_is_saved_and_loaded(found, saved):
    loaded = sf.ModeSearch.load(saved)
    assert str(loaded) == str(found)
    assert (loaded.ending, loaded.warnings) == (found.ending, found.warnings)
    t = np.linspace(0.0, 8.0, 33)
    np.testing.assert_array_equal(loaded.mode_probability(t), found.mode_probability(t))
    with pytest.raises(ValueError, match="was loaded without its model"):
        loaded.by_switches[0]
    whole = sf.ModeSearch.load(saved, problem=make_problem())
    assert abs(whole.by_switches[1].cost - found.by_switches[1].cost) < 1e-9
    assert whole.best.predict([1.0]).outputs.shape == (1, 2)


def test_files_of_other_kinds_are_refused(saved):
    other = sf.Problem(SYSTEM, make_run(name="other"), FREE)
    for problem, message in ((heater_problem(), "it is another problem's"), (other, "holds the runs")):
        with pytest.raises(ValueError, match=message):
            sf.ModeSearch.load(saved, problem=problem)
    content = json.loads(saved.read_text())
    for changes, message in (
        ({"format": "switchfit fit"}, "is not a saved search"),
        ({"version": 1}, "of version 1; this switchfit reads version 5"),
        ({"search": content["search"] | {"fits": "many"}}, "is damaged"),
    ):
        saved.write_text(json.dumps(content | changes))
        with pytest.raises(ValueError, match=message):
            sf.ModeSearch.load(saved)


def test_the_report_and_the_figure_have_the_sequence_and_the_criteria(found):
    assert str(found).startswith("Found: rise -> turn -> fall.")
    [line] = [line for line in str(found).splitlines() if line.lstrip().startswith("*")]
    assert line.split()[1] == "2"
    numbers, _, probabilities = found.plot().axes
    assert [line.get_label() for line in numbers.lines[:3]] == ["BIC", "mBIC", "AICc"]
    assert [text.get_text() for text in probabilities.get_legend().get_texts()] == ["rise", "fall", "turn"]
