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


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(MULTISTART))
def test_starts(name):
    study = sf.multistart(MULTISTART[name](), 40, seed=1)
    assert cured(study, lambda run: MULTISTART[name]()) == []
    assert study.failures == []


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(MEASURED))
def test_refits(name):
    problem, truth = MEASURED[name]()
    study = sf.monte_carlo(problem, 150, theta=truth, start=problem.initial_theta, seed=1)
    assert cured(study, lambda run: drawn(problem, truth, 1, run)) == []
    assert study.failures == []
    # A fit that meets a kink is handed over before it crawls there by the thousand evaluations.
    assert study.evaluations.max() < 200


@pytest.mark.fuzz
@pytest.mark.parametrize("seed", [0, 1])
def test_starts_of_a_fit_whose_modes_collapse(seed):
    problem, truth = thermostat()
    noisy = drawn(problem, truth, seed)
    study = sf.multistart(noisy, 100, seed=seed)
    assert cured(study, lambda run: noisy) == []
    assert study.failures == []
    assert np.sum(study.status == "COLLAPSED") > 10
