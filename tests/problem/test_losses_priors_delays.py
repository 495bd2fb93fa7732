"""Costs and unknowns of real logs: noise as a parameter, robust losses, priors, delays, scales.

One oscillator that is damped from tau on; its derivatives are checked for each feature by Taylor remainders of three
orders and by four methods that agree.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.models import fit_problem, one_run
from switchfit.fit.comparison import compare
from switchfit.meshes.evaluator import evaluator_of
from switchfit.problem.functions import use_float64
from switchfit.problem.losses import LOSSES, influence, robust
from switchfit.report.numbers import format_rounded


def free(t, x, p):
    return jnp.array([x[1], -p["k"] * x[0] + 0.1 * x[0] * jnp.sin(t)])


def damped(t, x, p):
    return free(t, x, p) - p["damping"] * x


def position(t, x, p):
    return jnp.array([x[0] + 0.1 * t * x[1], x[1] * x[0]])


SYSTEM = sf.HybridSystem({"free": free, "damped": damped}, [1.0, 0.0], state_names=("x", "v"))
TIMES = np.linspace(0.15, 3.2, 24)
TRUTH = {"k": 2.1, "damping": 0.35}


@cache
def clean(delay=0.0):
    """Outputs without noise at `TIMES`, (24, 2)."""
    blank = sf.Measurements(TIMES, np.zeros((24, 2)), observe=position, delay=delay, sigma=1.0)
    problem = one_run(SYSTEM, blank, ("free", "damped"), (1.23,), 3.3, TRUTH)
    return compare(evaluator_of(problem), problem.initial_theta)[1][0][0].fitted


def problem(*, sigma=0.02, noise=0.02, outliers=0, seed=0, values=None, more=None, k=2.0, tau=1.1, start=None, **data):
    rng = np.random.default_rng(seed)
    values = (clean() if values is None else values) + noise * rng.normal(size=(24, 2))
    values[rng.permutation(24)[:outliers], 0] += 1.0
    values[4, 1] = np.nan
    data = sf.Measurements(TIMES, values, observe=position, sigma=sigma, **data)
    run = sf.Experiment(data, ("free", "damped"), (tau,), 0.0, 3.3, initial_state=start)
    return sf.Problem(SYSTEM, run, {"k": k, "damping": 0.3} | (more or {}))


NOISE = {"s": sf.Parameter(0.05, lower=1e-3)}
DELAY = {"d": sf.Parameter(0.043, lower=-0.05, upper=0.1)}
CASES = {
    "noise": lambda: problem(sigma="s", more=NOISE),
    "huber": lambda: problem(loss="huber", loss_scale=1.5, outliers=4),
    "soft_l1": lambda: problem(loss="soft_l1", outliers=4),
    "all at once": lambda: problem(
        delay="d", sigma=["s", "s2"], more=DELAY | NOISE | {"s2": NOISE["s"]}, loss="cauchy", loss_scale=2.0,
        k=sf.Parameter(2.0, lower=0.1, prior=sf.LogNormal(1.8, 0.02)), outliers=4,
        tau=sf.Parameter(1.1, prior=sf.Normal(1.3, 0.02)), start=[sf.Parameter(1.1, prior=sf.Normal(1.0, 0.01)), 0.0],
    ),
}  # fmt: skip


@pytest.fixture(scope="module", params=CASES)
def case(request):
    return CASES[request.param]()


@pytest.mark.slow
def test_taylor_remainders_have_orders_1_2_3_and_the_papers_equations_agree(case):
    check = sf.check_derivatives(case)
    np.testing.assert_allclose(check.observed_orders, [1.0, 2.0, 3.0], atol=0.1)
    assert max(check.gradient_gap, check.hessian_gap) < 1e-6


def test_gauss_newton_is_never_negative_and_reaches_the_same_minimum(case):
    assert evaluator_of(case).cost(case.initial_theta) == pytest.approx(sf.evaluate(case).cost, rel=1e-12)
    for theta in (case.initial_theta, case.initial_theta * 1.05):
        matrix = evaluator_of(case)(theta, matrix="gauss-newton").hessian
        scale = np.sqrt(np.diag(matrix))
        assert np.linalg.eigvalsh(matrix / np.outer(scale, scale)).min() > 0
    exact = fit_problem(case, success=True)
    again = sf.estimate(case, hessian="gauss-newton", start=exact.theta * (1 + 1e-4 * np.arange(len(exact.theta))))
    assert again.success
    np.testing.assert_allclose(again.theta, exact.theta, rtol=1e-6)


# Noise as a parameter


def test_estimated_sigma_is_the_root_mean_square_of_the_residuals():
    """... of the channel it belongs to; at the minimum J is 1/2 of each value and the sum of log sigma."""
    found = sf.estimate(problem(sigma=["s", "s2"], more=NOISE | {"s2": sf.Parameter(0.1, scale="log")}))
    residuals = found.comparisons[0][0].residuals
    expected = np.sqrt(np.nanmean(residuals**2, axis=0))
    np.testing.assert_allclose([found.parameters["s"], found.parameters["s2"]], expected, rtol=1e-7)
    assert found.cost == pytest.approx(47 / 2 + 24 * np.log(expected[0]) + 23 * np.log(expected[1]), rel=1e-9)
    np.testing.assert_array_equal(found.comparisons[0][0].sigma[0], [found.parameters["s"], found.parameters["s2"]])


def test_with_sigma_estimated_or_a_robust_loss_the_covariance_is_the_inverse_hessian():
    robust = sf.estimate(problem(outliers=5, loss="huber", loss_scale=1.5))
    np.testing.assert_allclose(robust.covariance, np.linalg.inv(robust.hessian), rtol=1e-9)
    assert np.isnan(robust.residual_variance)
    found = sf.estimate(problem(sigma="s", more=NOISE))
    rounding = 1e-15 * np.abs(found.covariance).max()  # sigma is independent of the others: zeros
    np.testing.assert_allclose(found.covariance, np.linalg.inv(found.hessian), rtol=1e-9, atol=rounding)
    error = found.standard_errors[found.theta_names.index("s")]
    assert error == pytest.approx(found.parameters["s"] / np.sqrt(2 * 47), rel=0.05)
    scaled = sf.estimate(problem(sigma=None))
    np.testing.assert_allclose(found.theta[:3], scaled.theta, rtol=1e-6)
    np.testing.assert_allclose(found.standard_errors[:3], scaled.standard_errors, rtol=0.05)


# Robust losses


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_are_those_of_scipy(loss):
    from scipy.optimize import least_squares

    r, scale = np.array([0.0, 0.3, 1.4, 1.6, 40.0]), 1.5
    ours = 0.5 * robust(loss, scale, r**2).sum()
    theirs = least_squares(lambda z: r + 0.0 * z, [1.0], loss=loss, f_scale=scale, max_nfev=1)
    assert ours == pytest.approx(theirs.cost, rel=1e-13)
    with use_float64():
        u = jnp.asarray(r**2)
        slope = jax.vmap(jax.grad(lambda u: robust(loss, scale, u, jnp)))(u)
    np.testing.assert_allclose(influence(loss, scale, r**2), slope, rtol=1e-12)


# Priors


def test_a_prior_is_one_more_measurement():
    """Of an unknown of which the data say nothing the posterior is the prior; others are not touched."""
    both = sf.estimate(problem(start=[1.0, 0.0], more={"free": sf.Parameter(3.0, prior=sf.Normal(4.0, 0.5))}))
    alone = sf.estimate(problem(start=[1.0, 0.0]))
    np.testing.assert_allclose(both.theta[:3], alone.theta, rtol=1e-9)
    assert (both.parameters["free"], both.standard_errors[3]) == pytest.approx((4.0, 0.5), rel=1e-9)
    assert both.freedom == alone.freedom
    assert both.residual_variance == pytest.approx(alone.residual_variance, rel=1e-9)
    assert "prior: normal(4, 0.5)" in str(both)


# Delays


def test_a_known_delay_shifts_the_samples():
    moved = sf.Measurements(TIMES, clean(), observe=position, sigma=0.02, delay=0.1)
    np.testing.assert_array_equal(moved.seen_times, TIMES - 0.1)
    late = problem(values=clean(0.1), delay=0.1, noise=0.0)
    assert sf.estimate(late).theta == pytest.approx([1.23, 2.1, 0.35], rel=1e-6)
    as_parameter = problem(values=clean(0.1), delay="d", noise=0.0, more={"d": sf.Parameter(0.1, fixed=True)})
    assert sf.evaluate(as_parameter).cost == pytest.approx(sf.evaluate(late).cost, rel=1e-6)


def test_an_unknown_delay_is_found():
    found = fit_problem(problem(values=clean(0.07), delay="d", noise=0.0, more=DELAY), success=True)
    np.testing.assert_allclose(found.theta, [1.23, 2.1, 0.35, 0.07], rtol=1e-6)
    comparison = found.comparisons[0][0]
    np.testing.assert_array_equal(comparison.times, TIMES)
    np.testing.assert_allclose(comparison.curve_times - found.trajectory.times, 0.07, rtol=1e-6)


@pytest.mark.slow
def test_the_check_of_derivatives_keeps_transitions_off_what_late_samples_see():
    this = CASES["all at once"]()
    theta = this.initial_theta
    theta[0] = TIMES[5] - 0.043
    check = sf.check_derivatives(this, theta)
    assert np.abs(check.theta[0] - this.late_times(theta, 0)).min() > 1e-4
    np.testing.assert_allclose(check.observed_orders, [1.0, 2.0, 3.0], atol=0.1)


# Scales


def test_a_logarithmic_scale_changes_the_path_and_the_intervals_alone():
    plain, log = sf.estimate(problem()), sf.estimate(problem(k=sf.Parameter(2.0, scale="log")))
    np.testing.assert_allclose(log.theta, plain.theta, rtol=1e-8)
    np.testing.assert_allclose(log.covariance, plain.covariance, rtol=1e-5)
    low, high = log.confidence_intervals()[1]
    assert low * high == pytest.approx(log.theta[1] ** 2, rel=1e-12)
    assert np.log(high / log.theta[1]) == pytest.approx(1.959964 * log.standard_errors[1] / log.theta[1], rel=1e-6)
    np.testing.assert_allclose(log.confidence_intervals()[0], plain.confidence_intervals()[0], rtol=1e-6)
    shown = ", ".join(format_rounded(end, (high - low) / 10)[0] for end in (low, high))
    assert f"95 % in [{shown}]" in str(log)
    bounded = sf.estimate(problem(k=sf.Parameter(2.0, lower=0.1, upper=2.05, scale="log")))
    assert (bounded.theta[1], bounded.standard_errors[1]) == (2.05, 0.0)
    assert bounded.active[0].multiplier == pytest.approx(-bounded.gradient[1], rel=1e-9)
