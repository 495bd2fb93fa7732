"""Minima beside a fit that looks good: those that are lower are found, those as low are named."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.models import first_state, fit_problem, one_run, simulate_log
from support.two_minima import TWO_MINIMA
from switchfit.meshes.evaluator import evaluator_of
from switchfit.strategy import other_minima

THOROUGH = ("estimated sigmas",)
"""Problems of which a thorough search takes seconds."""

WAYS = [
    *((name, "auto") for name in TWO_MINIMA),
    *(pytest.param(name, "thorough", marks=pytest.mark.slow) for name in THOROUGH),
]


@pytest.mark.parametrize(("name", "strategy"), WAYS)
def test_of_two_minima_the_lower_one_is_found(name, strategy):
    given, problem = TWO_MINIMA[name], TWO_MINIMA[name].build()
    near = fit_problem(problem, strategy="local", level=given.level, status=given.status)
    assert given.wrong[0] < near.theta[0] < given.wrong[1]
    fit = fit_problem(problem, strategy=strategy, level=given.found_level)
    assert given.right[0] < fit.theta[0] < given.right[1]
    assert fit.cost < near.cost - given.gain
    if given.as_from_truth:
        right = sf.estimate(problem, start=given.truth, strategy="local" if given.as_from_truth == "same" else "auto")
        assert fit.cost < right.cost + 0.01
        assert given.as_from_truth != "same" or fit.cost == pytest.approx(right.cost, rel=1e-6)
    if strategy == "auto" and given.steps is not None:
        assert tuple(step.strategy for step in fit.steps) == given.steps
        assert abs(fit.theta[0] - given.truth[0]) < 3 * fit.standard_errors[0]
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
    starts, _ = other_minima.find_other_minima(sf.estimate(unknown, strategy="local"), evaluator_of(unknown))
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
