"""From a poor guess to the right answer: each strategy by itself, and how `estimate` chooses among them."""

from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from models import decay, fishing, heated_room

import switchfit as sf
from benchmarks.sharp.problems import dry, valve
from switchfit.engine.choice import SplitEngine
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Step
from switchfit.optimize import Status
from switchfit.strategy import choice
from switchfit.strategy.choice import Search, is_enough
from switchfit.strategy.hops import can_reinsert, reinsert_modes
from switchfit.strategy.starts import End, draw_starts, try_starts

HEATER = heated_room()
TRUTH = np.array([1.83, 3.4, 5.32, 6.7, 8.1, 1.0, 0.8])
TIMES = np.linspace(0.25, 10.0, 40)


def temperatures(times, switches, power, k):
    """Closed form of x' = P(t) - k x with the power on, off, on, ..., from 0.2."""
    edges = np.concatenate([[0.0], switches, [np.inf]])
    found, x = np.zeros(len(times)), 0.2
    for i, (begin, end) in enumerate(pairwise(edges.tolist())):
        level = power / k if i % 2 == 0 else 0.0
        inside = (times >= begin) & (times < end)
        found[inside] = level + (x - level) * np.exp(-k * (times[inside] - begin))
        x = level + (x - level) * np.exp(-k * (end - begin))
    return found


def thermostat(guess=None, sigma=0.02, modes=("on", "off") * 3):
    values = temperatures(TIMES, TRUTH[:5], *TRUTH[5:]) + np.random.default_rng(1).normal(0.0, 0.02, len(TIMES))
    run = sf.Experiment(sf.Measurements(TIMES, values, sigma=sigma), modes, guess, 0.0, 10.0)
    parameters = {"power": sf.Parameter(1.2, lower=0.2, upper=5.0), "k": sf.Parameter(0.6, lower=0.05, upper=3.0)}
    return sf.Problem(HEATER, run, parameters)


FAR = (0.5, 1.0, 1.5, 2.0, 9.0)


@pytest.fixture(scope="module")
def right():
    return sf.estimate(thermostat(tuple(TRUTH[:5])), strategy="local")


@pytest.fixture(scope="module")
def far_fit():
    """A fit from a far guess, by default."""
    return sf.estimate(thermostat(FAR))


def test_by_default_the_right_answer_is_found(right, far_fit):
    assert far_fit.verdict.level == "good"
    assert far_fit.cost == pytest.approx(right.cost, rel=1e-6)
    np.testing.assert_allclose(far_fit.theta, right.theta, rtol=1e-5)
    np.testing.assert_array_equal(far_fit.initial_theta[:5], FAR)


def test_what_each_step_brought_is_told(far_fit):
    assert far_fit.steps[0].strategy == "local"
    costs = [step.cost for step in far_fit.steps]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] == far_fit.cost < 0.02 * costs[0]
    assert sum(step.evaluations for step in far_fit.steps) == far_fit.evaluations
    text = " ".join(str(far_fit).split())
    assert f"tried local: J = {costs[0]:.6g}" in text
    assert f"{choice.BEAM}: J = {far_fit.cost:.6g}" in text
    assert far_fit.initial_cost == pytest.approx(sf.evaluate(thermostat(FAR)).cost, rel=1e-6)
    assert far_fit.seconds >= sum(step.seconds for step in far_fit.steps) > 0


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
        (None, (LOCAL, LOWER), True),
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
    times = np.linspace(3.0, 300.0, 100)
    flame = sf.HybridSystem({"burn": burn, "quench": quench}, [0.01])

    def pose(values, tau, a, q):
        run = sf.Experiment(sf.Measurements(times, values, sigma=0.01), ("burn", "quench"), (tau,), 0.0, 300.0)
        return sf.Problem(flame, run, {"a": a, "q": q})

    truth = sf.simulate(pose(np.zeros((100, 1)), 160.0, 1.0, 0.05), times=times).states
    values = truth + 0.01 * np.random.default_rng(7).normal(size=truth.shape)
    near = pose(values, 166.6, 1.147, 0.044)
    wrong = sf.estimate(near, strategy="local")
    assert abs(wrong.transition_times[0][0] - 165.8) < 0.1
    assert wrong.verdict.level == "doubtful"
    assert choice.is_explained(near, wrong.cost)
    assert not choice.is_confirmed(near, wrong)
    found = sf.estimate(near)
    assert abs(found.transition_times[0][0] - 160.6) < 0.1
    assert found.verdict.level == "good"


def test_what_is_no_noise_is_enough_once_a_search_agrees():
    problem = thermostat(FAR)
    wrong = sf.estimate(problem, strategy="local")
    assert not is_enough(problem, wrong)
    assert not is_enough(problem, wrong, (LOCAL, LOWER))
    assert is_enough(problem, wrong, (LOCAL, SAME))
    assert not is_enough(problem, replace(wrong, status=Status.MAX_ITERATIONS), (LOCAL, SAME))


def test_a_good_fit_tries_nothing_else(right):
    again = sf.estimate(thermostat(tuple(TRUTH[:5])))
    assert again.steps == ()
    assert again.cost == right.cost


def test_a_fit_that_has_not_converged_on_coarse_meshes_is_replaced(monkeypatch, right):
    """It may have gone down into their error: its J would be lower than that of any honest end."""
    stopped = replace(right, status=Status.MAX_ITERATIONS, integration_error=1e-3, cost=0.9 * right.cost)
    first = iter([stopped])
    real = choice.fit_locally
    monkeypatch.setattr(choice, "fit_locally", lambda *given, **settings: next(first, None) or real(*given, **settings))
    found = sf.estimate(thermostat(FAR))
    assert [(step.strategy, np.isfinite(step.cost)) for step in found.steps] == [("local", False), (choice.BEAM, True)]
    assert found.cost == pytest.approx(right.cost, rel=1e-9)


def test_transition_times_need_not_be_given(right):
    problem = thermostat(None)
    np.testing.assert_allclose(problem.experiments[0].initial_times, np.arange(1, 6) * 10 / 6)
    assert problem.experiments[0].is_guess_proposed
    assert not thermostat(FAR).experiments[0].is_guess_proposed
    found = sf.estimate(problem)
    assert found.cost == pytest.approx(right.cost, rel=1e-6)
    # Without a known noise it is not the residuals of the nearest minimum that decide.
    unknown = sf.estimate(thermostat(None, sigma=None))
    assert [step.strategy for step in unknown.steps][:2] == ["local, from evenly spaced times", choice.BEAM]
    np.testing.assert_allclose(unknown.theta, right.theta, rtol=1e-4)


def two_runs(guess=(3.0, 3.0), k=0.5):
    times = np.linspace(0.25, 6.0, 24)
    truth, random = ((2.2, 1.0), (4.1, 1.3)), np.random.default_rng(2)
    runs = []
    for e, (tau, power) in enumerate(truth):
        values = temperatures(times, [tau], power, 0.5) + random.normal(0.0, 0.02, len(times))
        data = sf.Measurements(times, values, sigma=0.02)
        mapped = {"power": f"power_{e}"}
        runs.append(sf.Experiment(data, ("on", "off"), (guess[e],), 0.0, 6.0, parameter_map=mapped, name=f"room{e}"))
    powers = {f"power_{e}": sf.Parameter(1.0, lower=0.01, upper=50.0) for e in range(2)}
    return sf.Problem(HEATER, runs, {"k": sf.Parameter(k, lower=0.01, upper=5.0), **powers})


def test_a_run_that_begins_badly_does_not_lead_the_others_astray():
    problem = two_runs()
    best = sf.estimate(problem, strategy="local")
    start = problem.initial_theta.copy()
    start[problem.theta_names.index("room1.tau_1")] = 0.05
    start[problem.theta_names.index("power_1")] = 40.0
    alone = sf.estimate(problem, strategy="local", start=start)
    assert alone.verdict.level == "bad"
    found = sf.estimate(problem, start=start)
    assert found.cost == pytest.approx(best.cost, rel=1e-6)
    assert [step.strategy for step in found.steps] == ["local", choice.BEAM]


def test_modes_are_removed_and_put_in_elsewhere():
    """Of the fishing problem with a bang-bang control of four switches."""
    best = sf.estimate(fishing((2.4, 4.2, 4.6, 5.0)), strategy="local").cost
    problem = fishing((8.0, 9.0, 10.0, 11.0))
    alone = sf.estimate(problem, strategy="local")
    assert alone.cost > 1.001 * best
    end = reinsert_modes(problem, alone.theta)
    assert end.cost < alone.cost
    assert sf.estimate(problem).cost <= end.cost * (1 + 1e-7)
    assert end.cost == pytest.approx(best, rel=1e-6)


def test_a_mode_is_only_moved_where_the_sequence_stays_the_same():
    assert can_reinsert(thermostat(FAR))
    three = sf.HybridSystem(dict.fromkeys("ABC", decay), [1.0])
    cost = sf.RunningCost(lambda t, x, p: x[0] ** 2)
    assert not can_reinsert(sf.Problem(three, sf.Experiment(cost, tuple("ABC"), (1.0, 2.0), 0.0, 3.0), {"k": 1.0}))


def say_no_once():
    """Return a function of a cost that is false once, and then true."""
    answers = iter((False, True))
    return lambda cost: next(answers)


def test_many_starts_stop_when_nothing_new_is_found(right):
    problem = two_runs()
    found = try_starts(problem, problem.initial_theta)
    best = sf.estimate(problem, strategy="local").cost
    assert len(found.costs) < 127
    assert found.ended == "settled"
    assert found.count_agreeing(best, 1e-9) >= 2
    assert found.count_agreeing(0.5 * best, 1e-9) == 0  # another minimum
    assert found.end.cost == pytest.approx(best, rel=1e-6)
    few = try_starts(problem, problem.initial_theta, is_enough=say_no_once())
    assert (len(few.costs), few.ended) == (1, "good")


def test_many_starts_end_where_nothing_but_noise_is_left(monkeypatch):
    """A mass on a spring with dry friction, from a guess that leads to another minimum: the first start is right."""
    monkeypatch.setattr(choice, "explain_no_beam", lambda problem: "none is wanted")
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
    assert np.ptp(points[:, 2]) > 7


def test_a_guess_that_cannot_be_integrated_is_a_bad_start():
    def grow(t, x, p):
        return p["a"] * x**2

    system = sf.HybridSystem({"grow": grow, "rest": lambda t, x, p: -x}, [1.0])
    times = np.linspace(0.1, 3.0, 30)
    before = times < 1.0
    values = np.where(before, 1 / (1 - 0.5 * np.minimum(times, 1.0)), 2.0 * np.exp(-(times - 1.0)))
    data = sf.Measurements(times, values + np.random.default_rng(0).normal(0, 0.01, 30), sigma=0.01)
    run = sf.Experiment(data, ("grow", "rest"), (2.0,), 0.0, 3.0)
    problem = sf.Problem(system, run, {"a": sf.Parameter(2.0, lower=0.0, upper=4.0)})
    with pytest.raises(ValueError, match=r"cannot be integrated|grows without bound"):
        sf.estimate(problem, strategy="local")
    found = sf.estimate(problem)
    assert found.verdict.level == "good"
    np.testing.assert_allclose(found.theta, [1.0, 0.5], atol=0.02)


@pytest.mark.parametrize(
    ("build", "start", "budget", "strategy"), [(valve, 1, 5.0, choice.BEAM), (dry, 4, 200.0, choice.STARTS)]
)
def test_a_budget_of_time_is_kept_within_the_time_of_two_fits(monkeypatch, build, start, budget, strategy):
    """Models with corners, on a clock of evaluations: each of J takes a second."""
    clock, solve = [0.0], SplitEngine._solve

    def timed(self, *given):
        clock[0] += 1.0
        return solve(self, *given)

    monkeypatch.setattr(SplitEngine, "_solve", timed)
    monkeypatch.setattr(choice.time, "perf_counter", lambda: clock[0])
    case = build()
    problem, theta = case.build_problem(), case.draw_starts(5)[start]
    alone = sf.estimate(problem, strategy="local", start=theta)
    local, clock[0] = clock[0], 0.0
    found = sf.estimate(problem, strategy="thorough", start=theta, time_budget=local + budget)
    assert found.steps[-1].strategy == strategy
    assert budget < clock[0] - local < budget + 2.0 * local
    assert found.cost <= alone.cost


def test_a_budget_of_time_ends_the_search():
    found = sf.estimate(thermostat(FAR), time_budget=1e-6)
    assert [step.strategy for step in found.steps] == ["local"]
    with pytest.raises(ValueError, match="time_budget must be positive"):
        sf.estimate(thermostat(FAR), time_budget=0.0)
    with pytest.raises(ValueError, match="strategy must be 'local', 'auto' or 'thorough'; got 'magic'"):
        sf.estimate(thermostat(FAR), strategy="magic")


def interrupt_after(monkeypatch, calls):
    """Let Ctrl-C come during the evaluation with this number, of those from now on."""
    count, evaluate = [0], Evaluator.__call__

    def counted(self, *given, **settings):
        count[0] += 1
        if count[0] == calls:
            raise KeyboardInterrupt
        return evaluate(self, *given, **settings)

    monkeypatch.setattr(Evaluator, "__call__", counted)
    return count


def test_ctrl_c_in_a_short_fit_ends_the_search(monkeypatch):
    """The optimiser takes Ctrl-C for the end of its own work; the search must not go on with the next short fit."""
    problem = thermostat(FAR)
    alone = sf.estimate(problem, strategy="local")
    count = interrupt_after(monkeypatch, alone.evaluations + 3)
    found = sf.estimate(problem)
    assert found.steps[-1].strategy == "interrupted"
    assert found.cost == pytest.approx(alone.cost)
    assert count[0] < alone.evaluations + 10  # nothing is fitted any more


def test_ctrl_c_keeps_what_the_starts_have_found(monkeypatch, right):
    problem = thermostat(FAR)
    first = try_starts(problem, right.theta, is_enough=say_no_once())
    interrupt_after(monkeypatch, 3 + 2 * first.end.evaluations)
    found = try_starts(problem, right.theta)
    assert found.ended == "interrupted"
    assert 0 < len(found.costs) < 10
    assert found.end.cost == pytest.approx(right.cost, rel=1e-6)


def test_rows_beside_transitions_are_halved_too():
    """A transition in the second half of a cell leaves the row behind it as it is where cells are halved."""
    evaluator = Evaluator(thermostat(FAR))
    theta = np.array([0.4375, 1.9, 3.4, 6.7, 8.1, 1.0, 0.8])
    fine = evaluator.halve_rows(theta).meshes[0].times
    for tau in theta[:5]:
        coarse = evaluator.meshes[0].times
        behind = coarse[coarse > tau][0] - tau
        before = tau - coarse[coarse < tau][-1]
        assert fine[fine > tau][0] - tau <= 0.5 * behind * (1 + 1e-12)
        assert tau - fine[fine < tau][-1] <= 0.5 * before * (1 + 1e-12)


def test_runs_are_set_aside_by_name():
    problem = two_runs()
    rest = problem.without_runs("room1")
    assert rest.theta_names == ("tau_1", "k", "power_0")
    with pytest.raises(ValueError, match="there is no experiment 'room7'; there are room0, room1"):
        problem.without_runs("room7")
    with pytest.raises(ValueError, match="none is left"):
        problem.without_runs("room0", "room1")


def test_a_fit_that_goes_on_is_no_search(monkeypatch):
    """It ends where it would have ended: that nothing is lower elsewhere, only a search can say."""
    nothing = lambda theta: End(theta, np.inf, 1)  # noqa: E731
    strategies = [(choice.MORE, nothing), ("elsewhere", nothing), ("not needed", nothing)]
    monkeypatch.setattr(Search, "_list_strategies", lambda self: strategies)
    fit = sf.estimate(thermostat(tuple(TRUTH[:5]), sigma=None))
    assert [step.strategy for step in fit.steps] == ["local", choice.MORE, "elsewhere"]


def test_a_minimum_on_the_other_side_of_where_the_modes_agree_is_found():
    """The fields of a mass on two springs differ by nothing where it passes 0, at 6.8 s: a switch as long before it
    as the right one is behind leaves noise of the right size, too, and is 16 standard errors off."""
    times = np.arange(0.0, 16.0, 0.1)
    springs = {
        "soft": lambda t, x, p: jnp.stack([x[1], -p["soft"] * x[0] - p["damping"] * x[1]]),
        "hard": lambda t, x, p: jnp.stack([x[1], -p["hard"] * x[0] - p["damping"] * x[1]]),
    }

    def build(values, switch, guesses):
        log = sf.Measurements(times, values, sigma=0.03, observe=lambda t, x, p: x[0])
        run = sf.Experiment(log, ("hard", "soft"), (switch,), 0.0, 16.0)
        names = ("hard", "soft", "damping")
        return sf.Problem(sf.HybridSystem(springs, [1.0, 0.0]), run, dict(zip(names, guesses, strict=True)))

    truth = np.array([7.0, 9.0, 4.0, 0.1])
    exact = sf.simulate(build(np.zeros(160), truth[0], truth[1:]))
    values = np.interp(times, exact.times, exact.states[:, 0]) + 0.03 * np.random.default_rng(10).normal(size=160)
    problem = build(values, 6.66, (9.01, 4.02, 0.105))
    near = sf.estimate(problem, strategy="local")
    fit = sf.estimate(problem)
    assert abs(near.theta[0] - truth[0]) > 10 * near.standard_errors[0]
    assert near.verdict.level == "good"
    assert [step.strategy for step in fit.steps] == ["local", choice.OTHER]
    assert fit.cost < near.cost - 1.0
    assert abs(fit.theta[0] - truth[0]) < 3 * fit.standard_errors[0]
    again = sf.estimate(problem, start=fit.theta)
    assert not again.steps, "of two minima that are known the lower one is left as it is"


def test_starts_are_drawn_where_an_unknown_has_no_effect():
    """At the guess the level does not reach the weir: no derivative, and no hypothesis of the beam, leads there."""
    times = np.arange(0.0, 60.0, 1.0)
    flows = {
        "on": lambda t, x, p: p["inflow"] - p["rate"] * jnp.maximum(x - p["height"], 0.0) - 0.02 * x,
        "off": lambda t, x, p: -p["rate"] * jnp.maximum(x - p["height"], 0.0) - 0.02 * x,
    }

    def build(values, switch, guesses):
        run = sf.Experiment(sf.Measurements(times, values, sigma=0.01), ("on", "off"), (switch,))
        names = ("inflow", "rate", "height")
        parameters = {n: sf.Parameter(v, lower=0.0) for n, v in zip(names, guesses, strict=True)}
        return sf.Problem(sf.HybridSystem(flows, [0.2]), run, parameters)

    truth = (0.1, 0.25, 1.2)
    exact = sf.simulate(build(np.zeros(60), 31.0, truth))
    values = np.interp(times, exact.times, exact.states[:, 0]) + 0.01 * np.random.default_rng(1).normal(size=60)
    fit = sf.estimate(build(values, 31.7, (0.076, 0.622, 3.6)), time_budget=60.0)
    assert fit.steps[1].cost == fit.steps[0].cost, "the beam"
    assert fit.verdict.level == "good"
    np.testing.assert_allclose(fit.theta, (31.0, *truth), rtol=0.05)
