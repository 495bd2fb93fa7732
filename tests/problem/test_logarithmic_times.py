"""Transition times on a logarithmic scale: the optimiser works in log(tau - t0), all numbers given are those of tau.

And other unknowns on it whose best value is 0, where a logarithm has none.
"""

from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.derivatives import differentiate
from support.models import RAMP, first_state, fit_problem, refused
from support.valleys import eaten, leaky
from switchfit.fit.change_of_variables import convert_to_variables
from switchfit.meshes.evaluator import Evaluator
from switchfit.optimize.arrow import Arrow
from switchfit.problem.variables import Variables
from switchfit.strategy.random_starts import draw_starts

TENTHS = np.linspace(0.1, 2.0, 20)
TRUTH, RATES = (0.03, 4.0), (20.0, 0.3, 0.002)
BEST = np.array([0.0301556479, 4.15919815, 20.0582402, 0.291234028, 0.00197205875])
"""Where the fits of `relaxation` end, times since t0."""


def relaxation(guess, scale="log", t0=0.0, tf=None):
    """Three rates of decay, seen from a millisecond to a thousand seconds."""
    times = np.geomspace(1e-3, 1e3, 61)
    first, second = TRUTH
    spent = [np.minimum(times, first), np.clip(times - first, 0, second - first), np.clip(times - second, 0, None)]
    values = np.exp(-np.array(RATES) @ spent) + 0.01 * np.random.default_rng(1).normal(size=61)
    system = sf.HybridSystem({name: lambda t, x, p, k=k: -p["k"][k] * x for k, name in enumerate("abc")}, [1.0])
    data = sf.Measurements(t0 + times, values, sigma=0.01)
    given = [sf.Parameter(t0 + g, scale=scale) if np.isscalar(g) else g for g in guess]
    run = sf.Experiment(data, ("a", "b", "c"), given, t0, tf or t0 + 1000.0)
    return sf.Problem(system, run, {"k": sf.Parameter([10.0, 0.1, 0.01], scale="log")})


def ramp(seed, scale, sigma=0.05, times=TENTHS):
    """A ramp that stops at t0 + 1.2, with samples every tenth unless told."""
    values = 3 * np.minimum(times, 1.2) + sigma * np.random.default_rng(seed).normal(size=len(times))
    data = sf.Measurements(2.0 + times, values, sigma=sigma)
    run = sf.Experiment(data, ("up", "rest"), (sf.Parameter(3.0, scale=scale),), 2.0)
    return sf.Problem(RAMP, run, {"v": 2.0})


# The change of variables


def test_derivatives_of_the_change_of_variables_are_those_of_autodiff():
    """Gradient and Hessian in z of J(theta(z)), the term with d2 theta / dz2 = theta - t0 included."""
    theta, origin = np.array([5.0, 7.5, 0.3, 40.0]), np.array([4.0, 4.0, 0.0, 0.0])
    log = np.array([True, True, True, False])
    keep = np.array([True, True, False, False])
    variables = Variables.of(theta, np.array([theta - 100, theta + 100]), log, keep, origin)

    def cost(theta):
        return jnp.sin(theta[0] * theta[2]) + theta[1] ** 3 * theta[0] + jnp.exp(0.01 * theta[3] * theta[1])

    z = variables.inward(theta)
    _, gradient, hessian = differentiate(cost, theta)
    _, along, curvature = differentiate(lambda z: cost(variables.outward(z, jnp)), z)
    g, H = variables.derivatives_inward(theta, gradient, hessian)
    np.testing.assert_allclose(variables.outward(z), theta, rtol=1e-14)
    assert np.isinf(variables.outward(z + 1e3)[log]).all()  # a step too far, without a warning
    np.testing.assert_allclose(g, along, rtol=1e-12)
    np.testing.assert_allclose(H, curvature, rtol=1e-12)
    back = variables.derivatives_outward(theta, g, H)
    np.testing.assert_allclose(back[0], gradient, rtol=1e-12)
    np.testing.assert_allclose(back[1], hessian, rtol=1e-12, atol=1e-10)


# Fits


def test_an_arrow_shaped_hessian_is_changed_in_the_same_way():
    theta, origin, log = np.array([5.0, 6.0, 0.5]), np.array([4.0, 4.5, 0.0]), np.ones(3, bool)
    variables = Variables.of(theta, np.array([theta - 100, theta + 100]), log, ~log, origin)
    runs = [replace(ramp(0, "log").experiments[0], name=name) for name in "ab"]
    problem = sf.Problem(RAMP, runs, {"v": 2.0})
    here = Evaluator(problem)(problem.initial_theta, arrow=True)
    assert isinstance(here.hessian, Arrow)
    found = convert_to_variables(variables, theta, here, None)
    expected = variables.derivatives_inward(theta, here.gradient, here.hessian.dense())
    np.testing.assert_allclose(found.gradient, expected[0])
    np.testing.assert_allclose(found.hessian.dense(), expected[1], rtol=1e-12)
    assert not convert_to_variables(
        variables, np.full(3, 1e200), here, None
    ).hessian.finite  # too far, without a warning


@pytest.mark.parametrize(("guess", "t0"), [((0.03, 4.0), 0.0), ((10.0, 300.0), 0.0), ((10.0, 300.0), 7.0)])
def test_times_are_found_from_guesses_decades_away(guess, t0):
    fit = fit_problem(relaxation(guess, t0=t0), strategy="local", success=True)
    np.testing.assert_allclose(fit.theta - [t0, t0, 0, 0, 0], BEST, rtol=1e-6)
    assert fit.log_scaled == ("tau_1", "tau_2", "k[0]", "k[1]", "k[2]")


def test_all_that_is_returned_is_that_of_the_times_themselves():
    """The same minimum: Hessian, covariance, history."""
    linear, log = (sf.estimate(ramp(1, scale), strategy="local") for scale in ("linear", "log"))
    np.testing.assert_allclose(log.theta, linear.theta, rtol=1e-10)
    np.testing.assert_allclose(log.hessian, linear.hessian, rtol=1e-7)
    np.testing.assert_allclose(log.standard_errors, linear.standard_errors, rtol=1e-7)
    np.testing.assert_allclose([log.history[0].theta, log.initial_theta], [[3.0, 2.0]] * 2)


def test_a_fit_that_ends_at_a_sample_ends_there_to_the_bit():
    """Rounding of the logarithm would put it beside the sample, where the one-sided derivatives are others."""
    hours = TENTHS
    scales = (1e3 * (1 + 1e-4 * k) for k in range(100))
    times = next(scale * hours for scale in scales if np.exp(np.log(scale * hours[11])) != scale * hours[11])
    values = 3 * np.minimum(hours, 1.2) + 0.05 * np.random.default_rng(4).normal(size=20)
    data = sf.Measurements(times, values, sigma=0.05)

    def fit_on(scale):
        run = sf.Experiment(data, ("up", "rest"), (sf.Parameter(times[9], scale=scale),), 0.0)
        return sf.estimate(sf.Problem(RAMP, run, {"v": sf.Parameter(0.002, scale="log")}), strategy="local")

    linear, log = fit_on("linear"), fit_on("log")
    assert log.status is sf.Status.CONVERGED_AT_KINK
    assert log.theta[0] == linear.theta[0] == times[11]
    sides, expected = ((kink.left, kink.right) for fit in (log, linear) for kink in fit.kinks)
    assert sides == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(log.confidence_intervals(), linear.confidence_intervals(), rtol=1e-6)


PUSHED = sf.HybridSystem(
    {
        "push": lambda t, x, p: jnp.array([x[1], 1.0 + 0 * x[0]]),
        "slide back": lambda t, x, p: jnp.array([x[1] - 1.0, 0 * x[0]]),
        "roll": lambda t, x, p: jnp.array([x[1], 0 * x[0]]),
    },
    [0.0, 0.0],
)
HOURS = np.linspace(0.1, 4.0, 40)
LEAP = np.where(HOURS < 1.6, 0.5 * HOURS**2, 1.28 + 1.6 * (HOURS - 1.6) + 0.1)
"""Push for 1.6, then leap ahead and roll: what would have to slide forward slides back."""


def constrained(guesses, fixed, scale):
    """A mode that the data do not have: it lasts no time."""
    data = sf.Measurements(3.0 + HOURS, LEAP, observe=first_state, sigma=0.1)
    taus = [sf.Parameter(3.0 + g, scale=scale, fixed=f) for g, f in zip(guesses, fixed, strict=True)]
    return sf.Problem(PUSHED, sf.Experiment(data, ("push", "slide back", "roll"), taus, 3.0, 7.0))


@pytest.mark.parametrize(
    ("guesses", "fixed"),
    [([1.5, 1.7], [False, False]), ([1.0, 1.4], [False, True]), ([1.6, 2.5], [True, False])],
    ids=["between two", "before a fixed time", "after a fixed time"],
)
def test_active_constraints_and_multipliers_are_those_of_the_linear_scale(guesses, fixed):
    linear, log = (sf.estimate(constrained(guesses, fixed, scale), strategy="local") for scale in ("linear", "log"))
    assert log.status.successful
    np.testing.assert_allclose(log.theta, linear.theta, rtol=1e-7)
    assert [(c.kind, c.mode, c.position) for c in log.active] == [(c.kind, c.mode, c.position) for c in linear.active]
    assert log.active[0].multiplier > 0.01
    assert log.active[0].multiplier == pytest.approx(linear.active[0].multiplier, rel=1e-5)


# Uncertainty


def test_intervals_are_made_on_the_logarithmic_scale():
    """Between samples J is smooth, and nothing but the standard error makes the interval."""
    problem = ramp(1, "log", sigma=0.06, times=np.array([0.3, 0.6, 2.0, 2.2, 2.4, 2.6]))
    fit = sf.estimate(problem, strategy="local")
    assert 2.7 < fit.theta[0] < 3.9
    away, error = fit.theta[0] - 2.0, fit.standard_errors[0]
    expected = 2.0 + away * np.exp(np.array([-1, 1]) * fit.quantile(0.5) * error / away)
    low, high = fit.confidence_intervals(0.5)[0]
    np.testing.assert_allclose([low, high], expected, rtol=1e-9)
    assert high - fit.theta[0] > 1.01 * (fit.theta[0] - low)
    fits = sf.estimate_many([problem, problem])
    np.testing.assert_allclose(fits.confidence_intervals(0.5)[1, 0], expected, rtol=1e-6)


# Starts and many fits


def test_starts_are_drawn_evenly_over_the_decades():
    drawn = draw_starts(relaxation((0.03, 4.0), t0=7.0), 256, 0)[1:, :2] - 7.0
    assert (np.diff(drawn, axis=1) > 0).all()
    assert drawn.min() > 0.003 * 0.999
    assert drawn.max() < 1000.0
    counts, _ = np.histogram(np.log10(drawn), bins=np.log10(0.003 * (1000 / 0.003) ** np.linspace(0, 1, 6)))
    np.testing.assert_allclose(counts / counts.sum(), 0.2, atol=0.03)


def test_many_starts_and_many_logs_and_strategies_end_where_single_fits_do():
    found = sf.multistart(relaxation((0.02, 3.0)), 2, seed=1)
    np.testing.assert_allclose(found.best.theta, BEST, rtol=1e-6)
    fits = sf.estimate_many([relaxation((0.02, 3.0)), relaxation((0.03, 4.0))])
    np.testing.assert_allclose(fits.theta, [BEST, BEST], rtol=1e-5)
    # The guess is that of modes that are over before the first is: the local fit ends at a saddle.
    problem = relaxation((200.0, 600.0))
    assert sf.estimate(problem, strategy="local").verdict.level != "good"
    np.testing.assert_allclose(sf.estimate(problem).theta, BEST, rtol=1e-5)


# What is given


test_what_does_not_go_together_is_said = refused(
    (lambda: relaxation((sf.Parameter(0.03), 4.0)), r"must be on one scale.*got \['linear', 'log'\].*all of them"),
    (lambda: replace(ramp(0, "log"), min_duration=0.1), "min_duration must be 0 where transition times are on a l"),
    error=ValueError,
)


def test_a_fixed_time_may_have_any_scale():
    problem = relaxation((0.03, sf.Parameter(4.0, fixed=True)))
    assert problem.unknowns.log_times.tolist() == [True, False, False, False]


def test_an_unknown_whose_best_value_is_0_ends_at_its_bound():
    log, linear = (sf.estimate(leaky(61, scale)) for scale in ("log", "linear"))
    np.testing.assert_allclose(log.theta, linear.theta, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(log.confidence_intervals()[0], log.profile("tau_1").interval(), rtol=1e-3)
    assert "at bounds" in {reason.kind for reason in log.verdict.reasons}


def test_an_unknown_that_is_not_told_from_0_is_doubtful_and_no_fit_starts_there():
    problem = leaky(7, "log")
    fit = sf.estimate(problem)
    assert fit.verdict.reasons[0].kind == "vanishing"
    assert "leak tends to 0: use a linear scale with lower=0" in " ".join(str(fit.verdict).split())
    assert fit.confidence_intervals()[-1].tolist() == [0.0, np.inf]
    with pytest.raises(ValueError, match="start must be above 0 for leak, whose scale is 'log'; got"):
        sf.estimate(problem, start=[4.3, 1.0, 0.5, 0.0], strategy="local")


@pytest.mark.parametrize(("problem", "name"), [(partial(leaky, 0), "leak"), (partial(eaten, 1), "tau_1")])
def test_profiles_do_not_depend_on_the_scale(problem, name):
    """Neither where the unknown goes to 0 itself nor where others creep along a valley without an end."""
    found = [sf.estimate(problem(scale), strategy="local").profile(name) for scale in ("log", "linear")]
    assert found[0].ends == found[1].ends
    np.testing.assert_allclose(found[0].interval(), found[1].interval(), rtol=1e-4, atol=1e-9)
