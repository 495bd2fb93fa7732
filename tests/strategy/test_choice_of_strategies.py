"""From a poor guess to the right answer: how `estimate` chooses among the strategies."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.bad_guesses import measure, pose, two_runs
from support.models import fit_problem, one_run, simulate_log
from support.thermostats import FAR, TRUTH, thermostat
from switchfit.fit.search_record import Step
from switchfit.optimize import Status
from switchfit.strategy import choice, search, stopping
from switchfit.strategy.stopping import is_enough


@pytest.fixture(scope="module")
def right():
    return sf.estimate(thermostat(tuple(TRUTH[:5])), strategy="local")


def test_by_default_the_right_answer_is_found_and_what_each_step_brought_is_told(right):
    far_fit = fit_problem(thermostat(FAR), level="good")
    assert far_fit.cost == pytest.approx(right.cost, rel=1e-6)
    np.testing.assert_allclose(far_fit.theta, right.theta, rtol=1e-5)
    np.testing.assert_array_equal(far_fit.initial_theta[:5], FAR)
    costs = [step.cost for step in far_fit.steps]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] == far_fit.cost < 0.02 * costs[0]
    assert sum(step.evaluations for step in far_fit.steps) == far_fit.evaluations
    text = " ".join(str(far_fit).split())
    assert f"tried local: J = {costs[0]:.6g}" in text
    assert f"{search.BY_BEAM}: J = {far_fit.cost:.6g}" in text


LOCAL, LOWER, SAME = Step("local", 40.0, 9, 0.1), Step("a search", 30.0, 9, 0.1), Step("a search", 40.0, 9, 0.1)


@pytest.mark.parametrize(
    ("sigma", "steps", "enough"),
    [
        (0.02, (), True),  # noise of a known size
        (0.01, (), False),  # sigma, the model or the minimum is wrong
        (0.01, (LOCAL, SAME), True),  # not the minimum
        (0.004, (LOCAL, LOWER), True),  # white, but larger than sigma
        (None, (), False),  # a minimum near by may leave as little
        (None, (LOCAL, SAME), True),
    ],
)
def test_a_search_that_looked_once_is_enough(sigma, steps, enough):
    problem = thermostat(tuple(TRUTH[:5]), sigma=sigma)
    assert is_enough(problem, sf.estimate(problem, strategy="local"), steps) == enough


def burn(t, x, p):
    return p["a"] * x**2 * (1.0 - x)


def quench(t, x, p):
    return burn(t, x, p) - p["q"] * x


def test_an_end_that_chi_square_allows_and_residuals_refute_is_not_the_end():
    # A flame is quenched at 160. Every sample interval may have a minimum: an early one is 165.8, J 61.1 for 50.
    flame = sf.HybridSystem({"burn": burn, "quench": quench}, [0.01])

    log = sf.Measurements(np.linspace(3.0, 300.0, 100), np.zeros(100), sigma=0.01)
    near = one_run(flame, log, ("burn", "quench"), (166.6,), 300.0, {"a": 1.147, "q": 0.044})
    near = simulate_log(near, [160.0, 1.0, 0.05], seed=7)
    wrong = sf.estimate(near, strategy="local")
    assert abs(wrong.transition_times[0][0] - 165.8) < 0.1
    assert stopping.is_explained(near, wrong.cost)
    assert not stopping.is_confirmed(near, wrong)
    found = fit_problem(near, level="good")
    assert abs(found.transition_times[0][0] - 160.6) < 0.1


def test_a_fit_that_has_not_converged_on_coarse_meshes_is_replaced(monkeypatch, right):
    """It may have gone down into their error: its J would be lower than that of any honest end."""
    stopped = replace(right, status=Status.MAX_ITERATIONS, integration_error=1e-3, cost=0.9 * right.cost)
    first = iter([stopped])
    real = choice.fit_on_meshes
    monkeypatch.setattr(
        choice, "fit_on_meshes", lambda *given, **settings: next(first, None) or real(*given, **settings)
    )
    found = sf.estimate(thermostat(FAR))
    assert [(step.strategy, np.isfinite(step.cost)) for step in found.steps] == [
        ("local", False),
        (search.BY_BEAM, True),
    ]
    assert found.cost == pytest.approx(right.cost, rel=1e-9)


def test_transition_times_need_not_be_given(right):
    problem = thermostat(None)
    np.testing.assert_allclose(problem.experiments[0].initial_times, np.arange(1, 6) * 10 / 6)
    assert sf.estimate(problem).cost == pytest.approx(right.cost, rel=1e-6)
    # Without a known noise it is not the residuals of the nearest minimum that decide.
    unknown = sf.estimate(thermostat(None, sigma=None))
    assert [step.strategy for step in unknown.steps][:2] == ["local, from evenly spaced times", search.BY_BEAM]
    np.testing.assert_allclose(unknown.theta, right.theta, rtol=1e-4)


def test_a_run_that_begins_badly_does_not_lead_the_others_astray():
    problem = two_runs()
    best = sf.estimate(problem, strategy="local")
    start = problem.initial_theta.copy()
    start[problem.theta_names.index("room1.tau_1")] = 0.05
    start[problem.theta_names.index("power_1")] = 40.0
    found = sf.estimate(problem, start=start)
    assert found.cost == pytest.approx(best.cost, rel=1e-6)
    assert [step.strategy for step in found.steps] == ["local", search.BY_BEAM]


def test_a_guess_that_cannot_be_integrated_is_a_bad_start():
    def grow(t, x, p):
        return p["a"] * x**2

    system = sf.HybridSystem({"grow": grow, "rest": lambda t, x, p: -x}, [1.0])
    times = np.linspace(0.1, 3.0, 30)
    before = times < 1.0
    values = np.where(before, 1 / (1 - 0.5 * np.minimum(times, 1.0)), 2.0 * np.exp(-(times - 1.0)))
    data = sf.Measurements(times, values + np.random.default_rng(0).normal(0, 0.01, 30), sigma=0.01)
    problem = one_run(system, data, ("grow", "rest"), (2.0,), 3.0, {"a": sf.Parameter(2.0, lower=0.0, upper=4.0)})
    with pytest.raises(ValueError, match=r"cannot be integrated|grows without bound"):
        sf.estimate(problem, strategy="local")
    found = fit_problem(problem, level="good")
    np.testing.assert_allclose(found.theta, [1.0, 0.5], atol=0.02)


def test_an_error_inside_a_search_is_a_step(monkeypatch):
    """What was fitted is kept, the other strategies are tried, and the report has the message."""

    def fail(*given, **settings):
        raise RuntimeError("a search went wrong")

    problem, _ = pose([measure()])
    alone = sf.estimate(problem, strategy="local")
    monkeypatch.setattr(search, "find_times", fail)
    monkeypatch.setattr(search, "try_starts", fail)
    found = sf.estimate(problem)
    assert found.cost == alone.cost
    assert [step.ended for step in found.steps[1:]] == ["RuntimeError: a search went wrong"] * 2


def test_a_guess_at_which_a_cost_has_no_slope_later_on_is_a_bad_start():
    """That of what flows out of a tank which runs dry: not so where it does not."""

    def flow(x, p):
        return p["k"] * jnp.sqrt(jnp.maximum(x[0], 0.0))

    modes = {"fill": lambda t, x, p: jnp.stack([p["q"] - flow(x, p)]), "drain": lambda t, x, p: -flow(x, p) + 0.0 * x}
    log = sf.Measurements(np.linspace(0.2, 8.0, 40), np.zeros(40), sigma=0.01)
    data = [log, sf.RunningCost(lambda t, x, p: 1e-3 * flow(x, p))]
    parameters = {"q": sf.Parameter(0.4, 0.01, 5.0), "k": sf.Parameter(0.9, 0.01, 5.0)}
    problem = one_run(sf.HybridSystem(modes, [0.2]), data, ("fill", "drain"), (3.0,), 8.0, parameters)
    problem = simulate_log(problem, [6.0, 0.5, 0.4], seed=1)
    alone = fit_problem(problem, strategy="local", status=Status.NONFINITE_START)
    assert alone.reason.kind == "undefined"
    assert 3.0 < alone.reason.figures["t"] < 8.0
    np.testing.assert_allclose(sf.estimate(problem).theta, [6.0, 0.5, 0.4], rtol=0.05)
