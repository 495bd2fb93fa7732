"""Insertion of modes: proposals where the rate is lowest, and the search from an empty schedule."""

from __future__ import annotations

import jax.numpy as jnp
import models
import numpy as np
import pytest
from models import FISHING

import switchfit as sf
from switchfit.fit.evaluator import Evaluator
from switchfit.modes.criterion import Score
from switchfit.modes.fitter import Fitter
from switchfit.modes.hunt import Improver, Pool, insert_modes, list_pulses
from switchfit.modes.rates import compute_rates
from switchfit.modes.schedule import Schedule
from switchfit.strategy.library import build_library

EMPTY = Schedule(("idle",), np.zeros(0), 0.0, 12.0)
NONE = np.zeros(0)


def fishing():
    """The problem with an empty schedule."""
    return models.fishing((), max_transitions=10)


def search(given, schedules, parameters=NONE, switch_cost=0.0, **settings):
    """Return the best fit for each number of switches, and how many were fitted."""
    fitter = Fitter(given, build_library(given, **settings))
    improver = Improver(fitter, Pool(Score.of(given, switch_cost), "cost"), lambda what: None)
    insert_modes(improver, schedules, parameters)
    return improver.pool.by_switches, fitter.fits


def rate(given, schedule, **settings):
    """Return the insertion rate of a schedule."""
    fitter = Fitter(given, build_library(given, **settings))
    (found,) = compute_rates(fitter.get_evaluator([schedule]), schedule.times)
    return found


def pulses(given, schedules, parameters=NONE, library=None, **settings):
    return list_pulses(Fitter(given, build_library(given, library, **settings)), schedules, parameters)


def cost_of(given, schedule):
    """J of a schedule on a mesh of its own."""
    own = given.with_sequences([schedule.sequence], [schedule.times])
    return Evaluator(own, schedule.times).cost(schedule.times)


def test_a_problem_to_search_may_have_nothing_to_estimate():
    given = fishing()
    assert given.theta_names == ()
    assert sf.evaluate(given).cost == pytest.approx(6.062277, abs=1e-6)
    assert sf.simulate(given).states.shape[1] == 2
    calls = sf.estimate, sf.check_derivatives, lambda p: sf.multistart(p, 3), lambda p: sf.monte_carlo(p, 3)
    for call in (*calls, lambda p: sf.estimate_many([p])):
        with pytest.raises(ValueError, match=r"Nothing to estimate.*set max_transitions"):
            call(given)


def test_proposals_lower_j_as_the_rate_says():
    given = fishing()
    current = Schedule(("idle", "fishing", "idle"), np.array([2.6, 4.34]), 0.0, 12.0)
    before = cost_of(given, current)
    found = pulses(given, [current], max_switches=10)
    changes, compared = [change for change, _ in found], 0
    assert changes == sorted(changes)
    assert {schedule.sequence.count("fishing") for _, [schedule] in found} == {2}
    for change, [schedule] in found:
        sequence, times = schedule.sequence, schedule.times
        new = np.append(np.setdiff1d(times, current.times), 12.0)  # the last one ends with the horizon
        assert np.isclose(new[1] - new[0], [0.02 * 12.0, 0.1 * 12.0, 0.75 * 1.74]).any()
        assert change < 0
        if len(sequence) == 5:
            short = np.where(times == new[1], new[0] + 1e-3, times)
            fell = cost_of(given, current.replace(sequence, short)) - before
            assert fell == pytest.approx(change / (new[1] - new[0]) * 1e-3, rel=2e-2)
            compared += 1
    assert compared >= 3


def test_a_library_is_respected():
    given = fishing()
    current = Schedule(("idle", "fishing", "idle"), np.array([2.6, 4.34]), 0.0, 12.0)
    found = pulses(given, [current], max_switches=3)
    assert {each.sequence for _, [each] in found} == {("idle", "fishing", "idle", "fishing")}  # inside it takes four
    assert pulses(given, [EMPTY], library=("idle",), max_switches=10) == []
    for _, [each] in pulses(given, [current], max_switches=10, min_duration={"fishing": 2.0}):
        pairs = zip(each.durations, each.sequence, strict=True)
        assert all(lasted >= 2.0 for lasted, mode in pairs if mode == "fishing")
    last = pulses(given, [current], max_switches=10, last="idle")
    assert all(each.sequence[-1] == "idle" for _, [each] in last)


def test_rates_beside_jumps_and_collapsed_modes():
    jump = sf.Jump([5.9], lambda t, x, p: x + jnp.array([0.3, 0.0]))
    cost = sf.RunningCost(lambda t, x, p: (x[0] - 1.0) ** 2 + (x[1] - 1.0) ** 2)
    run = sf.Experiment(cost, ("idle", "fishing"), (6.0,), 0.0, 12.0, jumps=jump)
    given = sf.Problem(FISHING, run, min_duration=0.5)
    close = Schedule(("idle", "fishing", "idle", "fishing"), np.array([3.0, 3.6, 4.2]), 0.0, 12.0)
    assert rate(given, close).trajectory.jump_times.tolist() == [5.9]
    gone = Schedule(("idle", "fishing", "idle"), np.array([3.0, 3.0]), 0.0, 12.0)
    found, expected = rate(fishing(), gone).best(), rate(fishing(), EMPTY).best()
    assert found[0] == expected[0]
    assert found[1] == pytest.approx(expected[1], abs=0.5)


TABLE = {0: 6.062277, 1: 3.136445, 2: 1.382755, 4: 1.349674, 6: 1.346318, 8: 1.345295218, 10: 1.344846158}
"""J of the fishing problem by the number of switches."""


def test_fishing_from_the_empty_schedule():
    found, fits = search(fishing(), [EMPTY], max_switches=10)
    for switches, cost in TABLE.items():
        assert found[switches].cost == pytest.approx(cost, abs=1e-6)
    assert fits < 200


def test_a_cost_of_switches_ends_the_search():
    """From 2 to 4 switches J falls by 0.033, from 4 to 6 by 0.0034."""
    costs = {}
    for switch_cost in (0.0, 0.01, 0.1):
        found, _ = search(fishing(), [EMPTY], switch_cost=switch_cost, max_switches=10)
        costs[switch_cost] = min(found, key=lambda n: found[n].cost + switch_cost * n), max(found)
    assert costs[0.0] == (10, 10)
    assert costs[0.01][0] == 4
    assert costs[0.1][0] == 2
    assert costs[0.1][1] < 10


def test_two_unstable_modes_from_one():
    """Five switches between them are a standard example; the search finds a schedule that is at least as good."""
    given = models.linear((), max_transitions=5)
    found, _ = search(given, [Schedule(("A1",), NONE, 0.0, 1.0)], max_switches=5)
    expected = sf.estimate(models.linear()).cost
    assert min(each.cost for each in found.values()) <= expected * (1 + 1e-6)


def test_two_experiments_with_shared_parameters():
    """A pulse is inserted in the run that lacks it."""
    modes = {"rest": lambda t, x, p: 0.0 * x, "rise": lambda t, x, p: p["v"] + 0.0 * x}
    system = sf.HybridSystem(modes, [0.0])
    times = np.linspace(0.0, 4.0, 21)

    def run(begin, end, sequence, switches):
        log = sf.Measurements(times, 0.9 * np.clip(times - begin, 0.0, end - begin), sigma=0.05)
        return sf.Experiment(log, sequence, switches, 0.0, 4.0)

    first = run(1.0, 2.0, ("rest", "rise", "rest"), (1.0, 2.0))
    second = run(1.5, 3.0, ("rest",), ())
    given = sf.Problem(system, [first, second], {"v": 0.9})
    pair = [Schedule(("rest", "rise", "rest"), np.array([1.0, 2.0]), 0.0, 4.0), Schedule(("rest",), NONE, 0.0, 4.0)]
    _, best = pulses(given, pair, np.array([0.9]), max_switches=4)[0]
    assert [schedule.sequence for schedule in best] == [("rest", "rise", "rest")] * 2
    np.testing.assert_array_equal(best[0].times, [1.0, 2.0])
    ends, _ = search(given, pair, np.array([0.9]), max_switches=4)
    assert ends[4].cost == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(ends[4].schedules[1].times, [1.5, 3.0], atol=1e-3)


def test_a_pulse_with_a_reset_map_is_not_proposed():
    modes = {"a": lambda t, x, p: -x, "b": lambda t, x, p: jnp.ones_like(x), "c": lambda t, x, p: -3.0 * x}
    system = sf.HybridSystem(modes, [2.0], {("b", "a"): lambda t, x, p: 0.1 * x})
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: (x[0] - 1.0) ** 2), ("a",), (), 0.0, 4.0)
    given = sf.Problem(system, run, max_transitions=4)
    found = pulses(given, [Schedule(("a",), NONE, 0.0, 4.0)], max_switches=4)
    assert found
    assert all("b" not in each.sequence for _, [each] in found)
