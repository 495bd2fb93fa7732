"""Budgets, clocks, callbacks and Ctrl-C: when a search ends, and what is kept."""

import time

import numpy as np
import pytest

import switchfit as sf
from benchmarks.sharp.problems import dry, valve
from support.bad_guesses import measure, pose, say_no_once
from support.thermostats import FAR, TRUTH, thermostat
from switchfit.engine.corners.split_engine import SplitEngine
from switchfit.meshes.evaluator import Evaluator
from switchfit.runtime import work
from switchfit.strategy import choice, many_starts, search, stopping
from switchfit.strategy.many_starts import try_starts
from switchfit.strategy.short_fit import End


@pytest.fixture(scope="module")
def right():
    return sf.estimate(thermostat(tuple(TRUTH[:5])), strategy="local")


def count_calls(monkeypatch, owner, name, interrupted=None):
    """Return the number of calls of a method from now on, the only entry of a list; Ctrl-C comes during one of them."""
    count, call = [0], getattr(owner, name)

    def counted(self, *given, **settings):
        count[0] += 1
        if count[0] == interrupted:
            raise KeyboardInterrupt
        return call(self, *given, **settings)

    monkeypatch.setattr(owner, name, counted)
    return count


@pytest.mark.parametrize(
    ("build", "start", "budget", "strategy"),
    [(valve, 1, 5.0, search.BY_BEAM), pytest.param(dry, 4, 200.0, search.BY_MANY_STARTS, marks=pytest.mark.slow)],
)
def test_a_budget_of_time_is_kept_within_the_time_of_two_fits(monkeypatch, build, start, budget, strategy):
    """Of models with corners, on a clock of evaluations: each of J takes a second."""
    clock, case = count_calls(monkeypatch, SplitEngine, "_solve"), build()
    monkeypatch.setattr(choice.time, "perf_counter", lambda: clock[0])
    problem, theta = case.build_problem(), case.draw_starts(5)[start]
    sf.estimate(problem, strategy="local", start=theta)
    local, clock[0] = clock[0], 0
    found = sf.estimate(problem, strategy="thorough", start=theta, time_budget=local + budget)
    assert found.steps[-1].strategy == strategy
    assert budget < clock[0] - local < budget + 2.0 * local


def test_a_budget_of_time_ends_the_search(monkeypatch):
    found = sf.estimate(thermostat(FAR), time_budget=1e-6)
    assert [step.strategy for step in found.steps] == ["local"]
    with pytest.raises(ValueError, match="time_budget must be positive"):
        sf.estimate(thermostat(FAR), time_budget=0.0)
    with pytest.raises(ValueError, match="strategy must be 'local', 'auto' or 'thorough'; got 'magic'"):
        sf.estimate(thermostat(FAR), strategy="magic")
    for module in (search, stopping):
        monkeypatch.setattr(module, "is_doubted", lambda fit: True)
    found = [sf.estimate(thermostat(tuple(TRUTH[:5]), sigma=0.01), time_budget=budget) for budget in (None, 5.0)]
    assert [len(fit.steps) for fit in found] == [2, 3], "the beam finds nothing lower; seconds that are given are used"


def test_ctrl_c_in_a_short_fit_ends_the_search(monkeypatch):
    """The optimiser takes Ctrl-C for the end of its own work; the search must not go on with the next short fit."""
    problem = thermostat(FAR)
    alone = sf.estimate(problem, strategy="local")
    count = count_calls(monkeypatch, Evaluator, "__call__", alone.evaluations + 3)
    found = sf.estimate(problem)
    assert found.steps[-1].strategy == "interrupted"
    assert found.cost == pytest.approx(alone.cost)
    assert count[0] < alone.evaluations + 10  # nothing is fitted any more


def test_ctrl_c_keeps_what_the_starts_have_found(monkeypatch, right):
    problem = thermostat(FAR)
    first = try_starts(problem, right.theta, is_enough=say_no_once())
    count_calls(monkeypatch, Evaluator, "__call__", 3 + 2 * first.end.evaluations)
    found = try_starts(problem, right.theta)
    assert found.ended == "interrupted"
    assert 0 < len(found.costs) < 10
    assert found.end.cost == pytest.approx(right.cost, rel=1e-6)


@pytest.mark.parametrize("strategy", ["auto", "thorough"])
def test_a_callback_ends_a_search_within_one_evaluation(strategy):
    problem, _ = pose([measure()])
    seen = []

    def stop(record):
        seen.append(record)
        return len(seen) > alone.iterations

    alone = sf.estimate(problem, strategy="local")
    found = sf.estimate(problem, strategy=strategy, callback=stop)
    assert found.cost == alone.cost
    assert len(seen) == alone.iterations + 1
    assert search.was_interrupted(found)


def test_without_a_budget_searches_end_after_twenty_times_the_first_fit(monkeypatch):
    """On a clock of evaluations, which compilation does not move: each of J takes a second."""
    problem, _ = pose([measure()])
    clock = count_calls(monkeypatch, Evaluator, "__call__")
    monkeypatch.setattr(choice, "measure_work", lambda: clock[0])
    monkeypatch.setattr(search, "find_times", lambda problem, theta, is_enough: End(theta, np.inf, 0))
    for module, name in (
        (choice, "is_enough"),
        (search, "is_enough"),
        (many_starts, "_is_enough"),
        (search, "is_explained"),
    ):
        monkeypatch.setattr(module, name, lambda *given: False)
    found = sf.estimate(problem)
    local = found.steps[0].evaluations
    assert 20 * local < clock[0] - local < 22 * local
    assert found.steps[-1].ended == "time"


def test_work_is_counted_and_not_timed():
    """Two fits that are alike count the same, to the last bit, although one of them compiles and the other waits."""
    counts = []
    for wait in (0.0, 0.01):
        problem, _ = pose([measure()])
        before = work.measure_work()
        fit = sf.estimate(problem, strategy="thorough", callback=lambda record, wait=wait: time.sleep(wait) or False)
        counts.append((work.measure_work() - before, fit.cost, fit.evaluations))
    assert counts[0][1:] == counts[1][1:]
    assert counts[0][0] == pytest.approx(counts[1][0], rel=1e-12)
    assert counts[0][0] > 0.01
