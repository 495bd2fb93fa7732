"""Hops over samples, modes that are put in elsewhere, and the halving of rows beside transitions."""

import numpy as np
import pytest

import switchfit as sf
from support.bad_guesses import LOSS, POWER
from support.models import decay, fishing, one_run
from support.thermostats import FAR, HEATER, TIMES, temperatures, thermostat
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.halving import halve_rows
from switchfit.strategy.hops import hop_over_samples
from switchfit.strategy.reinsertion import can_reinsert, reinsert_modes
from switchfit.strategy.short_fit import End, fit_briefly


def test_modes_are_removed_and_put_in_elsewhere():
    """Of the fishing problem with a bang-bang control of four switches; only where the sequence stays the same."""
    best = sf.estimate(fishing((2.4, 4.2, 4.6, 5.0)), strategy="local").cost
    problem = fishing((8.0, 9.0, 10.0, 11.0))
    alone = sf.estimate(problem, strategy="local")
    assert alone.cost > 1.001 * best
    end = reinsert_modes(problem, alone.theta)
    assert end.cost == pytest.approx(best, rel=1e-6)
    assert sf.estimate(problem).cost <= end.cost * (1 + 1e-7)
    three = sf.HybridSystem(dict.fromkeys("ABC", decay), [1.0])
    cost = sf.RunningCost(lambda t, x, p: x[0] ** 2)
    assert not can_reinsert(sf.Problem(three, sf.Experiment(cost, tuple("ABC"), (1.0, 2.0), 0.0, 3.0), {"k": 1.0}))


def test_rows_beside_transitions_are_halved_too():
    """A transition in the second half of a cell leaves the row behind it as it is where cells are halved."""
    evaluator = Evaluator(thermostat(FAR))
    theta = np.array([0.4375, 1.9, 3.4, 6.7, 8.1, 1.0, 0.8])
    fine = halve_rows(evaluator, theta).meshes[0].times
    for tau in theta[:5]:
        coarse = evaluator.meshes[0].times
        behind = coarse[coarse > tau][0] - tau
        before = tau - coarse[coarse < tau][-1]
        assert fine[fine > tau][0] - tau <= 0.5 * behind * (1 + 1e-12)
        assert tau - fine[fine < tau][-1] <= 0.5 * before * (1 + 1e-12)


def pose_one_switch(values):
    """Return the problem of when the heater goes off, all else being known."""
    held = {"power": sf.Parameter(POWER, fixed=True), "k": sf.Parameter(LOSS, fixed=True)}
    return one_run(HEATER, sf.Measurements(TIMES, values), ("on", "off"), (9.0,), 10.0, held)


def test_hops_find_the_lowest_of_the_sample_intervals_near_by():
    """One transition, all else known, with much noise: the least cost by a fine grid."""
    grid = np.linspace(0.01, 9.99, 2000)
    clean = np.array([temperatures(TIMES, [tau], POWER, LOSS) for tau in [4.1, *grid]])
    values = clean[0] + np.random.default_rng(5).normal(0.0, 0.3, len(TIMES))
    costs = 0.5 * ((clean[1:] - values) ** 2).sum(1)
    problem = pose_one_switch(values)
    best = grid[int(np.argmin(costs))]
    for start in (best - 0.6, best + 0.6):
        theta = np.array([start])
        end = hop_over_samples(problem, End(theta, fit_briefly(problem, theta, 0).cost, 0))
        assert end.theta[0] == pytest.approx(best, abs=6e-3)
