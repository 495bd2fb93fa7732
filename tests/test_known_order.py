"""The beam along a log whose order of modes is known: all that a problem may have, from a bad guess."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from models import decay as off
from models import heated_room
from test_strategy import temperatures

import switchfit as sf
from switchfit.fit.evaluator import Evaluator
from switchfit.strategy import beam, choice, starts
from switchfit.strategy.beam import Proposal, Quadratic
from switchfit.strategy.hops import choose_hops, hop_over_samples, is_lower
from switchfit.strategy.known_order import Beams, _list_settled, explain_no_beam, find_times
from switchfit.strategy.starts import End, fit_briefly

TIMES = np.linspace(0.25, 10.0, 40)
SEQUENCE, TAU, FAR = ("on", "off", "on", "off"), (1.83, 5.32, 7.1), (0.5, 1.0, 9.5)
POWER, LOSS = 1.0, 0.8
GUESS = {"power": sf.Parameter(2.2, lower=0.2, upper=5.0), "k": sf.Parameter(0.4, lower=0.05, upper=3.0)}


ROOM = heated_room()
on = ROOM.modes["on"]


def see_twice(t, x, p):
    return jnp.stack([x[0], x[0] ** 2])


def open_window(t, x, p):
    return 0.7 * x


def heat(t, x, p, u):
    return u * p["power"] - p["k"] * x


def leak(t, x, p, u):
    return -p["k"] * x


def measure(sigma=0.02, seed=1, times=TIMES, observe=None, channels=1, **more):
    """Return measurements without values, and the noise that they get."""
    noise = np.random.default_rng(seed).normal(0.0, 0.02, (len(times), channels))
    return sf.Measurements(times, np.zeros((len(times), channels)), observe=observe, sigma=sigma, **more), noise


def is_fixed(tau):
    return isinstance(tau, sf.Parameter) and tau.fixed


def pose(logs, system=ROOM, parameters=GUESS, times=FAR, truth=(POWER, LOSS), **more):
    """Return a problem with a bad guess whose data are simulated at the truth, and the fit that begins there."""

    def build(data, tau):
        given = {"mode_sequence": SEQUENCE, "t0": 0.0, "tf": 10.0} | more
        run = sf.Experiment(list(data), transition_times=tau, **given)
        return sf.Problem(system, run, parameters)

    near = [tau for tau, given in zip(TAU, times, strict=True) if not is_fixed(given)]
    problem = build([log for log, _ in logs], times)
    theta = np.concatenate([near, truth])
    seen = Evaluator(problem, theta).simulate(theta)[0].seen
    filled = [
        replace(log, values=values[: len(noise)] + noise) for (log, noise), values in zip(logs, seen, strict=True)
    ]
    problem = build(filled, times)
    return problem, fit_briefly(problem, theta)


def measure_oddly(places, value, **more):
    """Return measurements with some values that are wrong by a value, or missing where it is NaN."""
    log, noise = measure(**more)
    noise[places] += value
    return log, noise


MEASURED = sf.Measurements(TIMES, np.sin(TIMES))
FIXED = (sf.Parameter(TAU[0], fixed=True), 2.5, 9.5)
BOUNDED = (0.5, sf.Parameter(6.0, lower=5.0, upper=6.5), sf.Parameter(9.0, lower=7.05, upper=9.5))
NARROW = (0.5, sf.Parameter(5.3, lower=5.25, upper=5.4), 9.5)
PRIOR = (0.5, sf.Parameter(6.0, prior=sf.Normal(5.3, 0.1)), 9.5)
LOGARITHMIC = {"power": sf.Parameter(5.0, scale="log"), "k": sf.Parameter(0.2, scale="log")}
PRIORS = {
    "power": sf.Parameter(2.2, lower=0.1, prior=sf.LogNormal(1.0, 0.3)),
    "k": sf.Parameter(0.4, prior=sf.Normal(0.8, 0.2)),
}
FIRST = sf.HybridSystem({"on": on, "off": off}, [sf.Parameter(1.5)], state_names=("T",))
RESET = sf.HybridSystem({"on": on, "off": off}, [0.2], reset_maps={("off", "on"): open_window})
DRIVEN = sf.HybridSystem({"on": heat, "off": leak}, [0.2])
INPUT = sf.Input([0.0, 3.0, 6.0, 10.0], [1.0, 1.3, 0.8, 1.0], kind="hold")
THIRD = {"noise": sf.Parameter(0.1, lower=1e-3, upper=1.0)}
LATE = {"late": sf.Parameter(0.05, lower=0.0, upper=0.2)}

CASES = {
    "nothing more": lambda: pose([measure()]),
    "a fixed time": lambda: pose([measure()], times=FIXED),
    "bounded times": lambda: pose([measure()], times=BOUNDED),
    "bounds nearer than samples": lambda: pose([measure()], times=NARROW),
    "a prior of a time": lambda: pose([measure()], times=PRIOR),
    "a fixed parameter": lambda: pose(
        [measure()], parameters=GUESS | {"k": sf.Parameter(LOSS, fixed=True)}, truth=(POWER,)
    ),
    "priors": lambda: pose([measure()], parameters=PRIORS),
    "logarithmic scales": lambda: pose([measure()], parameters=LOGARITHMIC),
    "sigma unknown": lambda: pose([measure(sigma=None)]),
    "sigma estimated": lambda: pose([measure(sigma="noise")], parameters=GUESS | THIRD, truth=(POWER, LOSS, 0.02)),
    "outliers": lambda: pose([measure_oddly([6, 19, 31], 1.5, loss="soft_l1")]),
    "missing values": lambda: pose([measure_oddly([3, 4, 5, 17, 30], np.nan)]),
    "several sensors": lambda: pose(
        [measure(times=TIMES[::3]), measure(seed=2, times=TIMES[1::2], observe=see_twice, channels=2)]
    ),
    "an unknown initial state": lambda: pose([measure()], system=FIRST, truth=(POWER, LOSS, 0.2)),
    "reset maps": lambda: pose([measure()], system=RESET),
    "jumps": lambda: pose([measure()], jumps=sf.Jump(4.1, lambda t, x, p: x + 0.5), times=(0.5, 5.0, 9.5)),
    "inputs": lambda: pose([measure()], system=DRIVEN, inputs=INPUT),
    "implicit steps": lambda: pose([measure()]),
    "a delay": lambda: pose([measure(delay=0.2)]),
    "an unknown delay": lambda: pose([measure(delay="late")], parameters=GUESS | LATE, truth=(POWER, LOSS, 0.1)),
}


@pytest.mark.parametrize("name", CASES)
def test_the_best_is_found_from_a_bad_guess(name):
    """As by a fit from the truth; a local fit from the guess ends higher."""
    problem, right = CASES[name]()
    if name == "implicit steps":
        problem = replace(problem, solver="stiff")
    assert explain_no_beam(problem) == ""
    end = find_times(problem, problem.initial_theta)
    assert end.cost <= right.cost + 1e-6 * abs(right.cost)
    assert np.all((end.theta >= problem.unknowns.lower) & (end.theta <= problem.unknowns.upper))


@pytest.mark.parametrize("name", ["nothing more", "bounded times", "sigma unknown"])
def test_machine_code_keeps_the_hypotheses_that_the_rules_say(name, monkeypatch):
    problem = replace(CASES[name]()[0], min_duration={"on": 0.5, "off": 0.4})
    by_code = beam.follow_order(problem, 0, problem.initial_theta[3:])
    monkeypatch.setattr(beam.Pass, "order", None)
    by_rules = beam.follow_order(problem, 0, problem.initial_theta[3:])
    assert len(by_code) > 0
    for one, other in zip(by_code, by_rules, strict=True):
        assert one.cost == other.cost
        np.testing.assert_array_equal(one.transition_times[0], other.transition_times[0])
        np.testing.assert_array_equal(one.parameters, other.parameters)


def many_rooms(count, guess_k=2.0):
    """Rooms with one loss coefficient, each with a power and times of its own."""
    random = np.random.default_rng(4)
    runs, truth = [], []
    for e in range(count):
        tau, power = np.sort(random.uniform(1.0, 9.0, 3)), random.uniform(0.8, 1.6)
        values = temperatures(TIMES, tau, power, LOSS) + random.normal(0.0, 0.02, len(TIMES))
        data, mapped = sf.Measurements(TIMES, values, sigma=0.02), {"power": f"power_{e}"}
        runs.append(sf.Experiment(data, SEQUENCE, FAR, 0.0, 10.0, parameter_map=mapped, name=f"room{e}"))
        truth.append((tau, power))
    powers = {f"power_{e}": sf.Parameter(2.5, lower=0.2, upper=5.0) for e in range(count)}
    problem = sf.Problem(ROOM, runs, {"k": sf.Parameter(guess_k, lower=0.05, upper=3.0), **powers})
    theta = np.concatenate([*(tau for tau, _ in truth), [LOSS], [power for _, power in truth]])
    return problem, fit_briefly(problem, theta)


def test_runs_share_what_they_say():
    problem, right = many_rooms(4)
    end = find_times(problem, problem.initial_theta)
    assert end.cost <= right.cost * (1 + 1e-6)


def test_only_runs_that_a_fit_has_moved_are_followed_again():
    """Those whose times or whose parameters are no longer where their beams have proposed them."""
    problem, right = many_rooms(4)
    beams = Beams(problem, [beam.prepare(problem, e).own for e in range(4)])
    found, _ = beams.follow(right.theta[beams.first :], lambda e, q, said: beam.follow_order(problem, e, q, said))
    assert _list_settled(problem, beams, found, right) == {0, 1, 2, 3}
    late, strong = right.theta.copy(), right.theta.copy()
    late[problem.unknowns.times[1][2]] += beam.prepare(problem, 1).grid
    strong[problem.theta_names.index("power_2")] *= 1.2
    assert _list_settled(problem, beams, found, right._replace(theta=late)) == {0, 2, 3}
    assert _list_settled(problem, beams, found, right._replace(theta=strong)) == {0, 1, 3}
    followed = []
    again, q = beams.follow(late[beams.first :], lambda e, *given: followed.append(e) or found[e], {0, 2, 3})
    assert followed == [1]
    assert [len(proposals) > 0 for proposals in again] == [False, True, False, False]
    np.testing.assert_array_equal(q[[1, 3, 4]], late[beams.first :][[1, 3, 4]])  # their own powers stay


@pytest.mark.parametrize("precision", [0.0, 2.0])
def test_shared_parameters_are_at_the_minimum_of_what_all_runs_and_priors_say(precision):
    """With a quadratic cost of each run; a run is told the sum of the others, whose own parameters follow."""
    problem, _ = many_rooms(3)  # parameters: k, shared, then a power of each run
    prior = sf.Normal(1.2, precision**-0.5) if precision else None
    problem = replace(problem, parameters={**problem.parameters, "k": sf.Parameter(2.0, 0.05, 3.0, prior=prior)})
    random, own = np.random.default_rng(0), [np.array([0, 1 + e]) for e in range(3)]
    roots = random.normal(size=(3, 2, 2))
    said = [Quadratic(np.array([1.0, 1.5]), random.normal(size=2), root @ root.T + np.eye(2)) for root in roots]
    told, q = [], np.array([1.1, 1.4, 1.6, 1.7])

    def follow(e, q, evidence):
        told.append(evidence)
        return [Proposal((SEQUENCE,), (np.array(FAR),), q, 0.0, said[e])]

    beams = Beams(problem, own)
    for _ in range(2):
        found, moved = beams.follow(q, follow)
    g = np.array([g[0] - Q[0, 1] / Q[1, 1] * g[1] for _, g, Q in said])
    Q = np.array([Q[0, 0] - Q[0, 1] ** 2 / Q[1, 1] for _, _, Q in said])
    lowest = ((Q - g).sum() + 1.2 * precision) / (Q.sum() + precision)
    np.testing.assert_allclose(moved, [lowest, *q[1:]], rtol=1e-12)
    [joined] = beams.join(found, moved)
    assert joined.sequences == (SEQUENCE,) * 3
    np.testing.assert_allclose(told[3].center, [1.0 - g[1:].sum() / Q[1:].sum(), q[1]], rtol=1e-12)
    np.testing.assert_allclose(told[3].Q, [[Q[1:].sum(), 0.0], [0.0, 0.0]], rtol=1e-12)


def test_evidence_is_the_curvature_of_the_data_alone():
    """Of a run with priors: the Schur complement of the Gauss-Newton matrix without them, at the best."""
    problem, right = pose([measure()], parameters=PRIORS)
    proposal = beam.follow_order(problem, 0, right.theta[3:])[0]
    bare = sf.Problem(ROOM, problem.experiments[0], {"power": 1.0, "k": 1.0})
    theta = np.append(proposal.transition_times[0], proposal.parameters)
    H = Evaluator(bare, theta)(theta, matrix="gauss-newton").hessian
    # A time is known to half a grid interval at least.
    H[:3, :3] += 12 / beam.prepare(problem, 0).grid ** 2 * np.eye(3)
    expected = H[3:, 3:] - H[3:, :3] @ np.linalg.solve(H[:3, :3], H[:3, 3:])
    np.testing.assert_allclose(proposal.evidence.Q, expected, rtol=1e-2)


NO_BEAM = {
    "the experiment has a free tf: give tf a number": {"tf": sf.Parameter(11.0, lower=10.0, upper=12.0)},
    "there are no data to follow": {"data": sf.RunningCost(lambda t, x, p: x[0] ** 2)},
    "has terminal constraints: leave": {"data": [MEASURED, sf.TerminalConstraint(lambda x, p: x[0])]},
    "a beam needs machine code, but engine='jax' is set. Use method='insertion'": {},
}


@pytest.mark.parametrize("reason", NO_BEAM)
def test_where_no_beam_applies_it_says_why(reason):
    given = {"data": MEASURED, "mode_sequence": SEQUENCE, "transition_times": FAR, "t0": 0.0, "tf": 10.0}
    run = sf.Experiment(**given | NO_BEAM[reason])
    assert reason in explain_no_beam(sf.Problem(ROOM, run, GUESS, engine="jax" if "jax" in reason else "auto"))


def pose_one_switch(values):
    """Return the problem of when the heater goes off, all else being known."""
    held = {"power": sf.Parameter(POWER, fixed=True), "k": sf.Parameter(LOSS, fixed=True)}
    run = sf.Experiment(sf.Measurements(TIMES, values), ("on", "off"), (9.0,), 0.0, 10.0)
    return sf.Problem(ROOM, run, held)


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


@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_only_hops_that_lower_the_cost_are_fitted(noise):
    """From the minima of many intervals; the model about the middle of an interval says too often that J falls."""
    clean = temperatures(TIMES, [4.1], POWER, LOSS)
    tried = lower = 0
    for seed in range(4):
        values = clean + np.random.default_rng(seed).normal(0.0, noise, len(TIMES))
        problem = pose_one_switch(values)
        for start in np.arange(2.0, 7.0, 0.5):
            end = fit_briefly(problem, np.array([start]))
            evaluator = Evaluator(problem, end.theta)
            for hop in choose_hops(evaluator, end.theta, end.cost):
                tried += 1
                lower += is_lower(fit_briefly(problem, hop, evaluator=evaluator).cost, end.cost)
    assert lower == tried
    assert (tried > 0) == (noise == 1.0)


def test_an_error_inside_a_search_is_a_step(monkeypatch):
    """What was fitted is kept, the other strategies are tried, and the report has the message."""

    def fail(*given, **settings):
        raise RuntimeError("a search went wrong")

    problem, _ = CASES["nothing more"]()
    alone = sf.estimate(problem, strategy="local")
    monkeypatch.setattr(choice, "find_times", fail)
    monkeypatch.setattr(choice, "try_starts", fail)
    found = sf.estimate(problem)
    assert found.cost == alone.cost
    assert [step.ended for step in found.steps[1:]] == ["RuntimeError: a search went wrong"] * 2
    assert "a search went wrong" in " ".join(str(found).split())


@pytest.mark.parametrize("strategy", ["auto", "thorough"])
def test_a_callback_ends_a_search_within_one_evaluation(strategy):
    problem, _ = CASES["nothing more"]()
    seen = []

    def stop(record):
        seen.append(record)
        return len(seen) > alone.iterations

    alone = sf.estimate(problem, strategy="local")
    found = sf.estimate(problem, strategy=strategy, callback=stop)
    assert found.cost == alone.cost
    assert len(seen) == alone.iterations + 1
    assert choice.was_interrupted(found)


def test_without_a_budget_searches_end_after_twenty_times_the_first_fit(monkeypatch):
    """On a clock of evaluations: each of J takes a second."""
    clock, evaluate = [0.0], Evaluator.__call__

    def timed(self, *given, **settings):
        clock[0] += 1.0
        return evaluate(self, *given, **settings)

    problem, _ = CASES["nothing more"]()
    monkeypatch.setattr(choice.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(Evaluator, "__call__", timed)
    monkeypatch.setattr(choice, "find_times", lambda problem, theta, is_enough: End(theta, np.inf, 0))
    monkeypatch.setattr(choice, "is_enough", lambda *given: False)
    monkeypatch.setattr(starts, "_is_enough", lambda *given: False)
    monkeypatch.setattr(choice, "is_explained", lambda *given: False)
    found = sf.estimate(problem)
    local = found.steps[0].seconds
    assert 20 * local < clock[0] - local < 22 * local
    assert found.steps[-1].ended == "time"
    assert "with more seconds as time_budget it goes on" in " ".join(str(found).split())


def test_a_beam_of_which_no_hypothesis_is_left_proposes_nothing():
    problem, _ = pose([measure()])
    assert beam.follow_order(problem, 0, np.array([1e300, 1e300])) == []
