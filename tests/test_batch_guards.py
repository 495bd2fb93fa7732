"""Many fits with guards and terminal constraints: far starts end where near ones do, and bad starts end nothing."""

from __future__ import annotations

import numpy as np
import pytest

import switchfit as sf
from benchmarks.starts.bounces import FALL, ball_on_guards
from switchfit.batch import study as again

COLLAPSE = [10, 13]
"""Starts from which the guards pull transitions together, so that a direct fit loses modes."""


@pytest.fixture(scope="module")
def case():
    """A ball with eight bounces; their times are known to 30 ms, and restitution, height and speed roughly."""
    return ball_on_guards(16)


def test_all_starts_near_the_truth_find_the_restitution(case):
    found = sf.multistart(case.problem, case.starts)
    assert found.success.all()
    assert found.clusters.tolist() == [0] * 16
    assert found.verdict.level == "good"
    assert "the lowest J was found from 15 of 15 other starts" in str(found.verdict)
    assert found.best.parameters["e"] == pytest.approx(FALL[0], abs=4 * found.best.standard_errors[8])


def test_without_the_second_attempt_they_do_not(case, monkeypatch):
    """What the test above is about: a direct fit from some of the starts loses modes."""
    monkeypatch.setattr(again, "_is_doubted", lambda *given: False)
    found = sf.multistart(case.problem, case.starts[COLLAPSE])
    assert (found.collapsed > 0).all()


def test_a_study_from_a_far_start_finds_the_truth(case):
    best = sf.estimate(case.problem, strategy="local", start=case.starts[0])
    study = sf.monte_carlo(case.problem, 6, theta=best.theta, start=case.starts[COLLAPSE[0]])
    assert study.verdict.level == "good"
    np.testing.assert_allclose(study.theta[:, 8], best.theta[8], atol=0.002)


# --- starts that cannot be integrated ---------------------------------------------------------------------------------


def grow(t, x, p):
    return p["a"] * x**2


def growing(guess):
    """A state that grows without bound within the horizon unless it is stopped in time."""
    system = sf.HybridSystem({"grow": grow, "rest": lambda t, x, p: -x}, [1.0])
    times = np.linspace(0.1, 3.0, 30)
    values = np.where(times < 1.0, 1 / (1 - 0.5 * np.minimum(times, 1.0)), 2.0 * np.exp(-(times - 1.0)))
    data = sf.Measurements(times, values + np.random.default_rng(0).normal(0, 0.01, 30), sigma=0.01)
    run = sf.Experiment(data, ("grow", "rest"), guess[:1], 0.0, 3.0)
    return sf.Problem(system, run, {"a": sf.Parameter(guess[1], lower=0.0, upper=4.0)})


@pytest.mark.parametrize("guess", [pytest.param((2.0, 2.0), marks=pytest.mark.slow), (0.9, 0.6)])
def test_a_start_that_cannot_be_integrated_is_a_bad_start(guess):
    """Whether or not it is the problem's own guess."""
    found = sf.multistart(growing(guess), [[2.0, 2.0], [0.9, 0.6], [1.1, 0.4]])
    assert found.success.tolist() == [False, True, True]
    np.testing.assert_allclose(found.best.theta, [1.0, 0.5], atol=0.02)
    assert found.verdict.level == "good"


def test_no_start_that_can_be_integrated_is_an_error():
    with pytest.raises(ValueError, match=r"cannot be integrated|grows without bound"):
        sf.multistart(growing((2.0, 2.0)), [[2.0, 2.0], [2.5, 3.0]])
