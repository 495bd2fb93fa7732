"""The beam along a log whose order of modes is known: all that a problem may have, from a bad guess."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.bad_guesses import BAD, GUESS, LOSS, POWER, SEQUENCE, TAU, measure, pose
from support.models import decay, fit_problem, one_run, simulate_log
from support.thermostats import HEATER, TIMES, temperatures
from switchfit.meshes.evaluator import Evaluator
from switchfit.strategy import beam
from switchfit.strategy.joint_beams import Beams
from switchfit.strategy.known_order import explain_no_beam, find_times
from switchfit.strategy.proposal import Proposal, Quadratic
from switchfit.strategy.short_fit import fit_briefly

on = HEATER.modes["on"]


def see_twice(t, x, p):
    return jnp.stack([x[0], x[0] ** 2])


def open_window(t, x, p):
    return 0.7 * x


def heat(t, x, p, u):
    return u * p["power"] - p["k"] * x


def leak(t, x, p, u):
    return -p["k"] * x


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
FIRST = sf.HybridSystem({"on": on, "off": decay}, [sf.Parameter(1.5)], state_names=("T",))
RESET = sf.HybridSystem({"on": on, "off": decay}, [0.2], reset_maps={("off", "on"): open_window})
DRIVEN = sf.HybridSystem({"on": heat, "off": leak}, [0.2])
INPUT = sf.Input([0.0, 3.0, 6.0, 10.0], [1.0, 1.3, 0.8, 1.0], kind="hold")
THIRD = {"noise": sf.Parameter(0.1, lower=1e-3, upper=1.0)}
KNOWN_LOSS = GUESS | {"k": sf.Parameter(LOSS, fixed=True)}
LATE = {"late": sf.Parameter(0.05, lower=0.0, upper=0.2)}

CASES = {
    "nothing more": lambda: pose([measure()]),
    "a fixed time": lambda: pose([measure()], times=FIXED),
    "bounded times": lambda: pose([measure()], times=BOUNDED),
    "bounds nearer than samples": lambda: pose([measure()], times=NARROW),
    "a prior of a time": lambda: pose([measure()], times=PRIOR),
    "a fixed parameter": lambda: pose([measure()], parameters=KNOWN_LOSS, truth=(POWER,)),
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
    assert by_code
    for one, other in zip(by_code, by_rules, strict=True):
        assert one.cost == other.cost
        np.testing.assert_array_equal(one.transition_times[0], other.transition_times[0])
        np.testing.assert_array_equal(one.parameters, other.parameters)


def many_rooms(count):
    """Rooms with one loss coefficient, each with a power and times of its own."""
    random = np.random.default_rng(4)
    runs, truth = [], []
    for e in range(count):
        tau, power = np.sort(random.uniform(1.0, 9.0, 3)), random.uniform(0.8, 1.6)
        values = temperatures(TIMES, tau, power, LOSS) + random.normal(0.0, 0.02, len(TIMES))
        data, mapped = sf.Measurements(TIMES, values, sigma=0.02), {"power": f"power_{e}"}
        runs.append(sf.Experiment(data, SEQUENCE, BAD, 0.0, 10.0, parameter_map=mapped, name=f"room{e}"))
        truth.append((tau, power))
    powers = {f"power_{e}": sf.Parameter(2.5, lower=0.2, upper=5.0) for e in range(count)}
    problem = sf.Problem(HEATER, runs, {"k": sf.Parameter(2.0, lower=0.05, upper=3.0), **powers})
    theta = np.concatenate([*(tau for tau, _ in truth), [LOSS], [power for _, power in truth]])
    return problem, fit_briefly(problem, theta)


def test_runs_share_what_they_say():
    problem, right = many_rooms(4)
    assert find_times(problem, problem.initial_theta).cost <= right.cost * (1 + 1e-6)


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
        return [Proposal((SEQUENCE,), (np.array(BAD),), q, 0.0, said[e])]

    beams = Beams(problem, own)
    for _ in range(2):
        found, moved = beams.follow(q, follow)
    g = np.array([g[0] - Q[0, 1] / Q[1, 1] * g[1] for _, g, Q in said])
    Q = np.array([Q[0, 0] - Q[0, 1] ** 2 / Q[1, 1] for _, _, Q in said])
    lowest = ((Q - g).sum() + 1.2 * precision) / (Q.sum() + precision)
    np.testing.assert_allclose(moved, [lowest, *q[1:]], rtol=1e-12)
    assert [joined.sequences for joined in beams.join(found, moved)] == [(SEQUENCE,) * 3]
    np.testing.assert_allclose(told[3].center, [1.0 - g[1:].sum() / Q[1:].sum(), q[1]], rtol=1e-12)
    np.testing.assert_allclose(told[3].Q, [[Q[1:].sum(), 0.0], [0.0, 0.0]], rtol=1e-12)


def test_evidence_is_the_curvature_of_the_data_alone():
    """Of a run with priors: the Schur complement of the Gauss-Newton matrix without them, at the best."""
    problem, right = pose([measure()], parameters=PRIORS)
    proposal = beam.follow_order(problem, 0, right.theta[3:])[0]
    bare = sf.Problem(HEATER, problem.experiments[0], {"power": 1.0, "k": 1.0})
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
    given = {"data": MEASURED, "mode_sequence": SEQUENCE, "transition_times": BAD, "t0": 0.0, "tf": 10.0}
    run = sf.Experiment(**given | NO_BEAM[reason])
    assert reason in explain_no_beam(sf.Problem(HEATER, run, GUESS, engine="jax" if "jax" in reason else "auto"))


def test_a_beam_of_which_no_hypothesis_is_left_proposes_nothing():
    problem, _ = pose([measure()])
    assert beam.follow_order(problem, 0, np.array([1e300, 1e300])) == []


@pytest.mark.parametrize(
    ("limit", "seed", "held", "unit"),
    [
        pytest.param((), 0, (), 1.0, id="between samples"),
        pytest.param((), 2, (10.1,), 1.0, id="before a sample"),
        pytest.param((), 6, (4.0, 10.0), 1.0, id="after two samples"),
        pytest.param((), 6, (4.0, 10.0), 1e4, id="with a small unknown"),
        pytest.param((350.0,), 0, (3.7,), 1.0, id="at a speed, before a sample"),
        pytest.param((350.0,), 3, (7.4,), 1.0, id="at a speed, after a sample"),
    ],
)
def test_times_at_which_what_is_measured_jumps_are_found(limit, seed, held, unit):
    """Gear shifts, and the speed of the engine: a sample between a birth of the beam and a shift is off by 40 sigma. J
    jumps where a time passes a sample, and may be lowest beside one.
    """
    ratios = {"first": 3.0, "second": 2.0, "third": 1.3}

    def drive(ratio):
        rate = lambda x, p: p["a"] * ratio - unit * p["c"] * x[0] ** 2  # noqa: E731
        return lambda t, x, p: jnp.stack([rate(x, p), 10.0 * ratio * rate(x, p)])

    def shift(ratio):
        return lambda t, x, p: jnp.stack([x[0], 10.0 * ratio * x[0]])

    resets = {("first", "second"): shift(2.0), ("second", "third"): shift(1.3)}
    guards = dict.fromkeys(resets, lambda t, x, p: x[1] - p["limit"]) if limit else {}
    modes = {name: drive(ratio) for name, ratio in ratios.items()}
    system = sf.HybridSystem(modes, [1.0, 30.0], resets, guards=guards)
    log = sf.Measurements(np.linspace(0.1, 20.0, 200), np.zeros(200), lambda t, x, p: x[1:], sigma=3.0)
    guesses = dict(zip(("a", "c", "limit"), (0.5, 0.003 / unit, *(1.2 * each for each in limit)), strict=False))
    parameters = {name: sf.Parameter(value, lower=0.0) for name, value in guesses.items()}
    truth = (*((3.67996, 7.41272) if limit else (4.03, 10.07)), 1.0, 0.002 / unit, *limit)
    problem = one_run(system, log, tuple(ratios), (1.1 * truth[0], 1.1 * truth[1]), 20.0, parameters)
    fit = fit_problem(simulate_log(problem, truth, seed), level="good")
    assert [step.strategy for step in fit.steps] == ["local", "beam along the log"]
    np.testing.assert_allclose(fit.theta, truth, rtol=0.03)
    assert [kink.value for kink in fit.kinks] == pytest.approx(held, abs=1e-7)
    assert all(kink.left <= 0.0 <= kink.right for kink in fit.kinks)
    assert not fit.active
    for kink in fit.kinks:  # beyond the sample, J is that of a sample on the wrong side of the shift
        beyond = np.where(np.array(fit.theta_names) == kink.unknown, 2.0 * round(kink.value, 6) - fit.theta, fit.theta)
        assert sf.evaluate(fit.problem, beyond).cost > fit.cost + 100.0
    if not limit:
        # The middle part of a density that slopes a little between the samples.
        low, high = fit.confidence_intervals()[1]
        assert low <= fit.theta[1] <= high
        np.testing.assert_allclose([low, high], [10.0025, 10.0975], atol=4e-3)
    if not limit and len(held) < 2:  # a profile may end where another time is held
        np.testing.assert_allclose(fit.profile("tau_2").interval(), [10.0, 10.1], atol=1e-6)


def test_the_impacts_of_a_ball_whose_speed_is_measured_are_found():
    """A sample on the wrong side of an impact is off by 240 sigma: a beam takes the spread of speeds for noise."""
    bounce = lambda t, x, p: jnp.stack([x[0], -p["e"] * x[1]])  # noqa: E731
    fall = lambda t, x, p: jnp.stack([x[1], -p["g"] - p["drag"] * x[1]])  # noqa: E731
    pairs = [("up", "down"), ("down", "up")]
    guards = dict.fromkeys(pairs, lambda t, x, p: x[0])
    system = sf.HybridSystem({"up": fall, "down": fall}, [2.0, 0.0], dict.fromkeys(pairs, bounce), guards=guards)
    log = sf.Measurements(np.linspace(0.02, 2.0, 100), np.zeros(100), lambda t, x, p: x[1:], sigma=0.05)
    guesses, truth = {"g": 7.0, "drag": 0.15, "e": 0.6}, (0.64541959, 1.6293388, 9.81, 0.1, 0.8)
    parameters = {name: sf.Parameter(value, lower=0.0) for name, value in guesses.items()}
    problem = one_run(system, log, ("up", "down", "up"), (0.8, 1.4), 2.0, parameters)
    fit = fit_problem(simulate_log(problem, truth, seed=0), level="good")
    assert (np.abs(fit.theta - truth) < 4.0 * fit.standard_errors + 1e-3).all()
