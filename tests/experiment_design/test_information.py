"""The information of an experiment, against closed forms."""

from dataclasses import replace
from itertools import combinations

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.designs import TIMES, lag, line, line_information, planned
from support.models import STILL, curve, first_state
from switchfit.models import heater_problem

# Information


def test_information_of_a_line_does_not_depend_on_values_but_on_missing_ones():
    problem = line()
    (data,) = problem.experiments[0].data
    values = np.random.default_rng(0).normal(size=(9, 1))
    values[2] = np.nan
    plan = sf.design(replace(problem, experiments=replace(problem.experiments[0], data=replace(data, values=values))))
    np.testing.assert_allclose(plan.covariance, np.linalg.inv(line_information(np.delete(TIMES, 2))), rtol=1e-12)
    np.testing.assert_allclose(plan.standard_errors**2, np.diag(plan.covariance))
    assert plan.criterion_after == pytest.approx(np.log(np.linalg.det(plan.covariance)), abs=1e-12)
    assert plan.criterion_before == plan.criterion_after


def test_priors_and_other_runs_are_information():
    problem = line()
    first = replace(problem.experiments[0], name="first")
    second = replace(first, name="second", data=planned(TIMES[:3], observe=first.data[0].observe, sigma=0.2))
    parameters = {"a": sf.Parameter(1.0, prior=sf.Normal(1.0, 0.05)), "b": 2.0}
    plan = sf.design(sf.Problem(STILL, [first, second], parameters), samples=2)
    assert plan.run == "second"
    (times,) = plan.sample_times.values()
    F = line_information(TIMES) + line_information(times, 0.2) + np.diag([0.05**-2.0, 0.0])
    others = F - line_information(times, 0.2)
    choices = combinations(TIMES[:3], 2)
    best = max(choices, key=lambda pair: np.linalg.det(others + line_information(np.array(pair), 0.2)))
    np.testing.assert_array_equal(times, best)  # 0 and 0.5; without all else it would be 0 and 1
    np.testing.assert_allclose(plan.covariance, np.linalg.inv(F), rtol=1e-10)
    assert len(plan.problem.experiments[0].data[0].times) == 9


def test_a_sigma_that_is_a_parameter_and_a_robust_loss():
    """The loss counts as normal noise."""
    plan = sf.design(line(sigma="noise", parameters={"noise": sf.Parameter(0.1, lower=0.01)}))
    np.testing.assert_allclose(plan.covariance[:2, :2], np.linalg.inv(line_information(TIMES)), rtol=1e-10)
    assert plan.standard_errors[2] == pytest.approx(0.1 / np.sqrt(2 * 9), rel=1e-10)
    np.testing.assert_allclose(sf.design(line(loss="huber")).covariance, plan.covariance[:2, :2], rtol=1e-9)


def test_guarded_times_are_no_unknowns_of_their_own():
    """The covariance is that of the parameters, and of guarded times as functions of them."""
    fall = {"air": lambda t, x, p: jnp.stack([x[1], -p["g"] + 0.0 * x[0]])}
    bounce = {("air", "air"): lambda t, x, p: jnp.stack([x[0], -p["e"] * x[1]])}
    system = sf.HybridSystem(fall, [1.0, 0.0], bounce, guards={("air", "air"): lambda t, x, p: x[0]})
    data = planned(np.linspace(0.1, 1.5, 15), observe=first_state, sigma=0.01)
    problem = sf.Problem(system, sf.Experiment(data, ("air", "air"), (0.5,), 0.0, 1.5), {"g": 9.8, "e": 0.8})
    plan = sf.design(problem)
    exact = sf.evaluate_on_guards(plan.problem, plan.theta)
    np.testing.assert_allclose(plan.covariance[1:, 1:], np.linalg.inv(exact.hessian), rtol=1e-6)
    of_time = exact.times_slope @ np.linalg.inv(exact.hessian) @ exact.times_slope.T
    assert plan.standard_errors[0] ** 2 == pytest.approx(of_time.item(), rel=1e-6)
    assert plan.theta[0] == pytest.approx(np.sqrt(2 / 9.8), rel=1e-6)
    assert sf.design(problem, samples=3, names=["g", "e"]).undetermined == ()


def test_what_cannot_be_determined_is_named():
    still = lag(np.zeros(4))
    plan = sf.design(still)
    assert plan.undetermined == ("k", "b")
    assert np.isinf(plan.criterion_after)
    assert "cannot determine k, b" in " ".join(str(plan).split())
    moved = sf.design(still, free={"u": (-1.0, 1.0)})
    assert moved.undetermined == ()
    assert np.isinf(moved.criterion_before)
    assert np.isfinite(moved.criterion_after)
    of_product, guess = (lambda t, x, p: jnp.stack([p["a"] * p["b"] * t])), {"a": 1.0, "b": 2.0}
    assert sf.design(curve(of_product, TIMES, TIMES, guess, tf=4.0, sigma=1.0)).undetermined == ("a", "b")


def test_a_transition_at_a_sample_counts_half_from_each_side():
    near = [sf.design(heater_problem(), [2.0 + step, 0.5]) for step in (-1e-7, 0.0, 1e-7)]
    before, at, after = (np.linalg.inv(plan.covariance) for plan in near)
    assert abs(before[0, 0] - after[0, 0]) > 0.2 * at[0, 0]
    np.testing.assert_allclose(at, 0.5 * (before + after), rtol=1e-5)


def test_standard_errors_beyond_the_next_transition_are_doubtful():
    assert sf.design(heater_problem(), samples=4).doubtful == ()
    problem = heater_problem()
    late = planned([4.0, 5.0], sigma=3.0, names=("thermometer",))
    plan = sf.design(replace(problem, experiments=replace(problem.experiments[0], data=late)), names="k")
    assert plan.standard_errors[0] > 2.0
    assert plan.doubtful == ("tau_1", "k")
    assert "The standard error of tau_1, k is larger than the distance to a bound" in " ".join(str(plan).split())
