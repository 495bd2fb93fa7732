"""Many starts: where they are drawn, and when they are enough."""

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from benchmarks.sharp.problems import dry
from support.bad_guesses import say_no_once, two_runs
from support.models import fit_problem, one_run, simulate_log
from support.thermostats import HEATER, TRUTH, thermostat
from switchfit.strategy import choice, search, stopping
from switchfit.strategy.many_starts import try_starts
from switchfit.strategy.random_starts import draw_starts


@pytest.fixture(scope="module")
def right():
    return sf.estimate(thermostat(tuple(TRUTH[:5])), strategy="local")


def test_many_starts_stop_when_nothing_new_is_found(right):
    problem = two_runs()
    found = try_starts(problem, problem.initial_theta)
    best = sf.estimate(problem, strategy="local").cost
    assert (found.ended, len(found.costs) < 127) == ("settled", True)
    assert found.count_agreeing(best, 1e-9) >= 2
    assert found.count_agreeing(0.5 * best, 1e-9) == 0  # another minimum
    assert found.end.cost == pytest.approx(best, rel=1e-6)
    few = try_starts(problem, problem.initial_theta, is_enough=say_no_once())
    assert (len(few.costs), few.ended) == (1, "good")


def test_many_starts_end_where_nothing_but_noise_is_left(monkeypatch):
    """A mass on a spring with dry friction, from a guess that leads to another minimum: the first start is right."""
    for module in (choice, search, stopping):
        monkeypatch.setattr(module, "explain_no_beam", lambda problem: "none is wanted")
    case = dry()
    found = sf.estimate(case.build_problem(), start=case.draw_starts(5)[4])
    assert found.steps[0].cost > 100 * found.cost
    assert (found.verdict.level, found.steps[-1].ended) == ("good", "good")
    assert found.starts[0] < 5
    assert "the lowest leaves nothing but noise" in " ".join(str(found).split())


def test_starts_of_unknowns_without_bounds_are_drawn_around_the_guess():
    run = sf.Experiment(sf.Measurements([1.0, 2.0], [0.5, 0.4]), ("on", "off"), (1.5,), 0.0, 2.0)
    parameters = {"power": sf.Parameter(2.0, lower=0.0), "k": -0.5}
    points = draw_starts(sf.Problem(HEATER, run, parameters), 64, seed=0)
    assert np.all((points >= [0.0, 0.2, -5.5]) & (points <= [2.0, 20.0, 4.5]))
    assert np.ptp(np.log(points[:, 1])) > 3


def test_starts_are_drawn_where_an_unknown_has_no_effect():
    """At the guess the level does not reach the weir: no derivative, and no hypothesis of the beam, leads there."""
    flows = {
        "on": lambda t, x, p: p["inflow"] - p["rate"] * jnp.maximum(x - p["height"], 0.0) - 0.02 * x,
        "off": lambda t, x, p: -p["rate"] * jnp.maximum(x - p["height"], 0.0) - 0.02 * x,
    }
    log, truth = sf.Measurements(np.arange(0.0, 60.0, 1.0), np.zeros(60), sigma=0.01), [31.0, 0.1, 0.25, 1.2]
    guesses = {"inflow": 0.076, "rate": 0.622, "height": 3.6}
    parameters = {name: sf.Parameter(value, lower=0.0) for name, value in guesses.items()}
    problem = one_run(sf.HybridSystem(flows, [0.2]), log, ("on", "off"), (31.7,), 59.0, parameters)
    fit = fit_problem(simulate_log(problem, truth, seed=1), time_budget=60.0, level="good")
    assert fit.steps[1].cost == fit.steps[0].cost, "the beam"
    np.testing.assert_allclose(fit.theta, truth, rtol=0.05)


def test_a_minimum_of_a_cost_without_data_that_re_insertion_misses_is_found_by_starts():
    """A quarter of all starts end at the lowest of its minima, where the first mode collapses."""
    fields = {"a": [[0.0, 1.0], [-1.0, -0.2]], "b": [[-0.3, 2.0], [-0.5, 0.1]], "c": [[0.2, -1.0], [1.5, -0.6]]}
    modes = {name: (lambda t, x, p, A=A: jnp.array(A) @ x) for name, A in fields.items()}
    system = sf.HybridSystem(modes, [1.0, 0.7])
    running = sf.RunningCost(lambda t, x, p: x[0] ** 2 + 0.5 * x[1] ** 2)
    costs = [running, sf.TerminalCost(lambda x, p: 2.0 * (x[0] - 0.3) ** 2)]
    found = sf.estimate(one_run(system, costs, ("b", "c", "b", "a"), (1.0, 2.0, 3.0), 4.0))
    # SciPy's SLSQP with DOP853: 3 of 12 random starts end here, at the times 0, 1.9467 and 2.5182.
    assert found.cost == pytest.approx(1.5073964931, rel=1e-8)
    assert [step.strategy for step in found.steps] == [
        "local",
        search.BY_REINSERTION,
        search.BY_FEW_STARTS,
        search.BY_MANY_STARTS,
    ]
