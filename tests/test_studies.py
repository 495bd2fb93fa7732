"""Thousands of fits of several problems: none may fail that would not fail again from where it ended."""

import numpy as np
import pytest
from studies import MEASURED, MULTISTART, thermostat

import switchfit as sf
from switchfit.batch import simulated as module
from switchfit.batch.program import Limits


def drawn(problem, truth, seed, run=0):
    """The problem with the data of one run of a Monte Carlo study."""
    clean = module.simulate_clean(problem, truth)
    return module.SimulatedStudy(problem, [], truth[None], Limits(1e-7, 200), seed, truth, None, clean).problem_of(run)


def cured(study, problem_of):
    """What a restart cures among the fits that failed, and the messages of all that did."""
    found = []
    for k in np.flatnonzero(~study.success):
        again = sf.estimate(problem_of(int(study.runs[k])), start=study.theta[k])
        if again.success:
            found.append((int(k), study.status[k], study.message[k], again.status.name))
    return found


def start_anywhere(name, count, seed=0):
    study = sf.multistart(MULTISTART[name](), count, seed=seed)
    assert cured(study, lambda run: MULTISTART[name]()) == []
    return study


def fit_again(name, count, seed=0, *, from_guess):
    problem, truth = MEASURED[name]()
    start = problem.initial_theta if from_guess else truth
    study = sf.monte_carlo(problem, count, theta=truth, start=start, seed=seed)
    assert cured(study, lambda run: drawn(problem, truth, seed, run)) == []
    return study


def no_failure(study):
    assert study.failures == [], study.failures[:3]


# Short forms


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(MULTISTART))
def test_starts(name):
    no_failure(start_anywhere(name, 40, seed=1))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["thermostat", "ramps"])
def test_refits(name):
    study = fit_again(name, 150, seed=1, from_guess=True)
    no_failure(study)
    # A fit that meets a kink is handed over before it crawls there by the thousand evaluations.
    assert study.evaluations.max() < 200


# In full


@pytest.mark.fuzz
@pytest.mark.parametrize(("name", "count"), [("fishing", 400), ("linear", 200), ("vehicle", 200)])
def test_a_thousand_starts(name, count):
    no_failure(start_anywhere(name, count, seed=7))


@pytest.mark.fuzz
@pytest.mark.parametrize("seed", [0, 1])
def test_starts_of_a_fit_whose_modes_collapse(seed):
    problem, truth = thermostat()
    noisy = drawn(problem, truth, seed)
    study = sf.multistart(noisy, 100, seed=seed)
    assert cured(study, lambda run: noisy) == []
    no_failure(study)
    assert np.sum(study.status == "COLLAPSED") > 10


@pytest.mark.fuzz
@pytest.mark.parametrize("from_guess", [False, True])
@pytest.mark.parametrize("name", MEASURED)
def test_ten_thousand_refits(name, from_guess):
    study = fit_again(name, 1000, seed=7, from_guess=from_guess)
    no_failure(study)
    assert study.evaluations.max() < 300
