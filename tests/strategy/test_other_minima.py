"""Minima beside a fit that looks good: those that are lower are found, those as low are named."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.models import first_state, fit_problem, one_run, simulate_log
from switchfit.optimize import Status
from switchfit.strategy import other_minima, search


@pytest.mark.parametrize("friction", [0.0, 0.03])
def test_a_minimum_on_the_other_side_of_where_the_modes_agree_is_found(friction):
    """The fields of a mass on two springs differ by nothing where it passes 0, at 6.8 s: a switch as long before it
    as the right one is behind leaves noise of the right size, too, and is 16 standard errors off."""

    def spring(kind):
        dry = (lambda v: friction * jnp.sign(v)) if friction else (lambda v: 0.0)
        return lambda t, x, p: jnp.stack([x[1], -p[kind] * x[0] - p["damping"] * x[1] - dry(x[1])])

    springs = sf.HybridSystem({kind: spring(kind) for kind in ("soft", "hard")}, [1.0, 0.0])
    log = sf.Measurements(np.arange(0.0, 16.0, 0.1), np.zeros(160), sigma=0.03, observe=lambda t, x, p: x[0])
    guess = {"hard": 9.01, "soft": 4.02, "damping": 0.105}
    problem = one_run(springs, log, ("hard", "soft"), (6.66,), 16.0, guess)
    problem = simulate_log(problem, [7.0, 9.0, 4.0, 0.1], seed=10)
    near = fit_problem(problem, strategy="local", level="good")
    fit = sf.estimate(problem)
    assert [step.strategy for step in fit.steps] == ["local", search.BY_OTHER_MINIMUM]
    assert fit.cost < near.cost - 1.0
    assert abs(fit.theta[0] - 7.0) < 3 * fit.standard_errors[0]
    again = sf.estimate(problem, start=fit.theta)
    assert not again.steps, "of two minima that are known the lower one is left as it is"


def pushed(sigma: float, seed: int) -> sf.Problem:
    """Return the log of a mass on a spring that is driven by 2 sin(2 t) until 5 s: 4.4 s, as far before its zero, looks
    nearly the same."""

    def mass(t, x, p, force=0.0):
        return jnp.stack([x[1], force - p["k"] * x[0] - 0.3 * x[1]])

    def driven(t, x, p):
        return mass(t, x, p, p["a"] * jnp.sin(2.0 * t))

    log = sf.Measurements(np.arange(0.1, 10.0, 0.1), np.zeros(99), sigma=sigma, observe=first_state)
    system = sf.HybridSystem({"driven": driven, "free": mass}, [0.0, 0.0])
    problem = one_run(system, log, ("driven", "free"), (4.42,), 10.0, {"k": 1.0, "a": 2.0})
    return simulate_log(problem, [5.0, 1.0, 2.0], seed)


@pytest.mark.parametrize(("seed", "sigma"), [(10, 0.04), (5, 0.06)])
def test_a_minimum_is_found_although_the_exact_hessian_far_away_has_none(monkeypatch, seed, sigma):
    """The first model of the interval in which J falls again lies above the fit, or has no minimum."""
    problem = pushed(sigma, seed)
    near = fit_problem(problem, strategy="local", level="good")
    assert near.theta[0] < 4.5
    assert sf.estimate(problem).theta[0] == pytest.approx(5.0, abs=0.02)
    assert not sf.estimate(problem, time_budget=1e-9).steps, "no time is left to look elsewhere"
    (run,) = problem.experiments
    unknown = replace(problem, experiments=replace(run, data=replace(run.data[0], sigma=None)))
    starts, _ = other_minima.find_other_minima(sf.estimate(unknown, strategy="local"))
    assert starts[0][0] == pytest.approx(5.0, abs=0.1)
    monkeypatch.setattr(other_minima, "find_far_minima", lambda *given: 1 / 0)
    assert sf.estimate(problem).theta[0] == near.theta[0], "the fit is not lost"


def test_minima_that_the_data_do_not_tell_apart_are_named():
    fit = fit_problem(pushed(0.1, seed=4), level="doubtful")
    [(name, value, rise)] = fit.rivals
    regions = sf.profile(fit, "tau_1").regions()
    assert (name, len(regions)) == ("tau_1", 2)
    assert regions[0][0] < value < regions[0][1] < fit.confidence_intervals()[0, 0]
    other = sf.estimate(fit.problem, start=[value, 1.0, 2.0], strategy="local")
    assert rise == pytest.approx(other.cost - fit.cost, abs=1e-3)
    assert f"tau_1 may be {value:.6g} as well, where J is {rise:.2g} higher" in str(fit.verdict)


def test_a_minimum_beside_a_fit_with_estimated_sigmas_is_found():
    """A wheel brakes on a road that becomes wet at 0.9 s; 0.02 s earlier, with more noise, is a minimum, too: the guess
    lies beside it."""

    def roll(road):
        def wheel(t, x, p):
            slip = (x[0] - 0.3 * x[1]) / x[0]
            force = 2.0 * 9.81 * p[road] * slip * p["s"] / (slip**2 + p["s"] ** 2)
            return jnp.stack([-force - 0.01 * x[0], 90.0 * force - 500.0])

        return wheel

    wheel = sf.HybridSystem({road: roll(road) for road in ("dry", "wet")}, lambda p: jnp.stack([p["v"], p["v"] / 0.3]))
    log = sf.Measurements(np.arange(0.02, 1.6, 0.02), np.zeros((79, 2)), sigma=[0.1, 0.5])
    slips = {name: sf.Parameter(value, scale="log") for name, value in {"dry": 0.88, "wet": 0.51, "s": 0.097}.items()}
    problem = one_run(wheel, log, ("dry", "wet"), (0.87,), 1.58, slips | {"v": 25.0})
    truth = [0.9, 0.9, 0.5, 0.1, 25.0]
    (run,) = simulate_log(problem, truth, seed=18).experiments
    sigmas = {name: sf.Parameter(value, scale="log") for name, value in {"sigma_v": 0.09, "sigma_w": 0.57}.items()}
    run = replace(run, data=replace(run.data[0], sigma=list(sigmas)))
    problem = replace(problem, experiments=run, parameters=problem.parameters | sigmas)
    near, right = (
        sf.estimate(problem, strategy="local"),
        sf.estimate(problem, start=[*truth, 0.1, 0.5], strategy="local"),
    )
    assert (near.theta[0], right.theta[0]) == pytest.approx((0.88, 0.9), abs=0.005)
    assert near.cost > right.cost + 5.0
    fit = fit_problem(problem, level="good")
    assert fit.cost < right.cost + 0.01


def test_a_minimum_behind_a_kink_where_a_pendulum_turns_once_more_is_found():
    """It is driven until 5.3 s, and rests by dry friction. Its J has two minima, 5 standard errors of mu apart."""

    def swing(t, x, p, drive=0.0):
        return jnp.stack([x[1], drive - 9.81 * jnp.sin(x[0]) - p["mu"] * jnp.sign(x[1]) - p["c"] * x[1]])

    def driven(t, x, p):
        return swing(t, x, p, p["torque"] * jnp.cos(2.5 * t))

    log = sf.Measurements(np.arange(0.1, 14.0, 0.1), np.zeros(139), sigma=0.01, observe=first_state)
    system = sf.HybridSystem({"driven": driven, "free": swing}, [0.3, 0.0])
    guess = {"mu": 0.37, "c": 0.125, "torque": 1.56}
    truth = np.array([5.3, 0.4, 0.15, 2.0])
    problem = simulate_log(one_run(system, log, ("driven", "free"), (5.28,), 14.0, guess), truth, 22)
    near, fit = fit_problem(problem, strategy="local", level="good"), sf.estimate(problem)
    assert fit.cost < near.cost - 1.0
    assert fit.cost == pytest.approx(sf.estimate(problem, start=truth, strategy="local").cost, rel=1e-6)


@pytest.mark.parametrize(("seed", "status"), [(0, Status.CONVERGED_AT_KINK), (1, Status.CONVERGED)])
def test_a_narrow_minimum_far_away_is_found_from_a_kink_too(seed, status):
    """A lag is driven in steps and leaks faster from 5.2 s on. It is at rest from 5.6 to 7.2 s: a switch there or a
    little later leaves noise of the right size."""
    steps = [0.0, 0.7, 1.9, 3.3, 4.1, 5.6, 7.2, 8.8, 9.5]
    command = sf.Input(steps, [0.0, 1.0, 2.0, 1.0, -1.0, 0.0, 2.0, 3.0, 1.0])
    leaks = {name: (lambda t, x, p, u, k=name: p["gain"] * u - p[k] * x) for name in ("slow", "fast")}
    log = sf.Measurements(np.linspace(0.1, 10.0, 67), np.zeros(67), sigma=0.03)
    guess = {"gain": 0.6, "slow": 1.0, "fast": 1.0}
    problem = one_run(sf.HybridSystem(leaks, [0.0]), log, ("slow", "fast"), (7.5,), 10.0, guess, inputs=command)
    problem = simulate_log(problem, [5.2, 1.2, 0.5, 1.5], seed)
    near = sf.estimate(problem, strategy="local")
    assert (near.status, near.verdict.level) == (status, "good")
    assert near.theta[0] > 7.2
    assert sf.estimate(problem).theta[0] == pytest.approx(5.2, abs=0.15)


def hide_leak() -> sf.Problem:
    """Return a problem whose noise is so large that chi-square of 400 samples does not tell where the leak was."""
    modes = {
        "usual": lambda t, x, p: p["in"] - p["k"] * x,
        "leak": lambda t, x, p: p["in"] - p["out"] - p["k"] * x,
    }
    log = sf.Measurements(np.linspace(0.25, 100.0, 400), np.zeros(400), sigma=1.0)
    guess = {"in": 0.8, "k": 0.14, "out": 0.3}
    return one_run(sf.HybridSystem(modes, [10.0]), log, ("usual", "leak", "usual"), (20.0, 50.0), 100.0, guess)


def hide_step() -> sf.Problem:
    """Return a problem in which 1.5 is added to a measured state: J jumps where the time passes a sample."""
    modes = dict.fromkeys(("before", "after"), lambda t, x, p: -p["k"] * x)
    system = sf.HybridSystem(modes, [10.0], {("before", "after"): lambda t, x, p: x + 1.5})
    log = sf.Measurements(np.arange(0.5, 40.0), np.zeros(40), sigma=0.5)
    return one_run(system, log, tuple(modes), (20.0,), 40.0, {"k": 0.04})


LEAK, STEP = (30.0, 34.0, 1.0, 0.1, 0.5), (16.2, 0.05)


@pytest.mark.parametrize(
    ("make", "truth", "seed"), [(hide_leak, LEAK, 0), (hide_leak, LEAK, 42), (hide_step, STEP, 58)]
)
def test_a_lower_minimum_that_chi_square_hides_is_found(make, truth, seed):
    problem = simulate_log(make(), truth, seed)
    near, fit = fit_problem(problem, strategy="local", level="good"), sf.estimate(problem)
    assert fit.cost < near.cost - 2.0
    assert fit.cost < sf.estimate(problem, start=truth).cost + 0.01
