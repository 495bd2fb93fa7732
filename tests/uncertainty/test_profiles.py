"""Profile likelihoods against closed forms, and what they say where there is no ordinary interval."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from scipy.optimize import brentq

import switchfit as sf
from benchmarks import coverage
from support.models import curve, one_run, rest
from switchfit.uncertainty.residuals import correct_correlation

SIGMA = 0.2
TIMES = np.linspace(0.0, 4.0, 21)[1:]
TRACES = {"count": 0}


def noise(seed, count=20):
    return SIGMA * np.random.default_rng(seed).standard_normal(count)


def moving(t, x, p):
    TRACES["count"] += 1
    return p["v"] + 0.0 * x


RAMP = sf.HybridSystem({"up": moving, "rest": rest}, [0.0], state_names=("x",), state_units=("m",))


def parabola(t, x, p):
    return jnp.array([p["c"][0] + p["c"][1] * t + p["c"][2] * t**2])


def observed(h, values, parameters, sigma=SIGMA, times=TIMES):
    """A fit of h(t, p) alone: the state rests at 0."""
    return sf.estimate(curve(h, times, values, parameters, sigma=sigma, tf=4.0))


def ramp(values, tau=2.1, *, times=TIMES, sigma=SIGMA, v=1.0, **settings):
    """x = v min(t, tau): its cost is quadratic in v, and in tau between samples."""
    data = sf.Measurements(times, values, sigma=sigma, names=("x",), **settings)
    lag = sf.Parameter(0.05, fixed=True)
    return sf.estimate(sf.Problem(RAMP, sf.Experiment(data, ("up", "rest"), (tau,), 0.0, 4.0), {"v": v, "lag": lag}))


ONE = sf.Parameter(1.0, fixed=True)
"""The rate, where it is known."""


@pytest.fixture(scope="module")
def noisy_ramp():
    return ramp(np.minimum(TIMES, 2.05) + noise(3))


def ramp_cost(values, tau, sigma=SIGMA):
    """The smallest cost over v at a given tau."""
    a = np.minimum(TIMES, tau)
    return 0.5 * (values @ values - (a @ values) ** 2 / (a @ a)) / sigma**2


# Closed forms


@pytest.mark.parametrize("known", [True, False], ids=["sigma known", "sigma unknown"])
def test_of_a_linear_model_it_is_the_quadratic_interval(known):
    values = 1.0 - 0.5 * TIMES + 0.1 * TIMES**2 + noise(1)
    fit = observed(parabola, values, {"c": [0.0, 0.0, 0.0]}, SIGMA if known else None)
    for name in fit.theta_names:
        found = fit.profile(name)
        k = fit.theta_names.index(name)
        np.testing.assert_allclose(found.zeta, (found.values - fit.theta[k]) / fit.standard_errors[k], atol=2e-4)
        for level in (0.5, 0.95, 0.999):
            np.testing.assert_allclose(found.interval(level), fit.confidence_intervals(level)[k], rtol=1e-6)
    assert found.ends == ("crossed", "crossed")


def test_of_a_transition_time_with_kinks_at_the_samples(noisy_ramp):
    fit, values = noisy_ramp, np.minimum(TIMES, 2.05) + noise(3)
    found = fit.profile("tau_1")
    np.testing.assert_allclose(found.costs, [ramp_cost(values, tau) for tau in found.values], rtol=1e-9)
    tau, span = fit.theta[0], 6 * fit.standard_errors[0]
    for level in (0.683, 0.95, 0.99):
        height = fit.cost + 0.5 * scipy.stats.chi2.ppf(level, 1)

        def excess(tau, height=height):
            return ramp_cost(values, tau) - height

        expected = [brentq(excess, *sorted((tau, tau + side * span))) for side in (-1, 1)]
        np.testing.assert_allclose(found.interval(level), expected, rtol=1e-6)
    assert found.lower_cost is None
    low, high = found.interval()
    inside = np.sum((low < TIMES) & (high > TIMES))
    assert f"{inside} sample times lie in the interval, where the slope of the profile may jump" in str(found)


def test_others_are_fitted_again_and_pushed_away_in_time():
    """tau_1 is moved beyond the estimate of tau_2; the other unknowns are those of a fit with tau_1 held."""
    rng = np.random.default_rng(0)
    true = np.minimum(TIMES, 2.0) + 0.5 * np.maximum(TIMES - 2.4, 0.0)
    values = true + 0.3 * rng.standard_normal(len(TIMES))
    system = sf.HybridSystem({"up": moving, "rest": rest, "half": lambda t, x, p: 0.5 * p["v"] + 0.0 * x}, [0.0])

    def problem(tau_1):
        data = sf.Measurements(TIMES, values, sigma=0.3)
        return one_run(system, data, ("up", "rest", "half"), (tau_1, 2.6), 4.0, {"v": 1.0})

    fit = sf.estimate(problem(1.9))
    found = fit.profile("tau_1")
    assert found.thetas[:, 0].max() > fit.theta[1]
    assert np.all(np.diff(found.thetas[:, :2], axis=1) >= -1e-12)
    compared = [k for k, value in enumerate(found.values) if 0.5 < value < 2.6]
    for k in compared[:: len(compared) // 4]:
        held = problem(sf.Parameter(found.values[k], fixed=True))
        again = sf.estimate(held, start=found.thetas[k][1:])
        assert again.cost == pytest.approx(found.costs[k], rel=1e-7)
        assert sf.estimate(held).cost >= found.costs[k] * (1 - 1e-7)


# What is no ordinary interval


def test_one_sided_at_a_bound():
    values = -0.05 + noise(4)
    fit = observed(lambda t, x, p: p["m"] * jnp.ones(1), values, {"m": sf.Parameter(0.1, lower=0.0)})
    assert fit.theta[0] == 0.0
    assert np.isnan(fit.confidence_intervals()).all()
    found = fit.profile("m")
    n, mean = len(TIMES), values.mean()
    # (m - mean)^2 - mean^2 = 3.84 sigma^2 / n, with mean < 0
    high = mean + np.sqrt(mean**2 + scipy.stats.chi2.ppf(0.95, 1) * SIGMA**2 / n)
    np.testing.assert_allclose(found.interval(), [0.0, high], rtol=1e-6, atol=1e-12)
    assert "downward the limit 0 comes before the threshold: the interval is one-sided" in str(found)


def test_not_identifiable_upward():
    """A decay that is over before the first sample: any rate above some value fits as well."""
    times = TIMES[TIMES >= 1.0]
    values = 0.3 * noise(6, len(times))
    fit = observed(lambda t, x, p: jnp.array([jnp.exp(-p["k"] * t)]), values, {"k": 3.0}, 0.3 * SIGMA, times)
    found = fit.profile("k")
    assert found.ends == ("crossed", "flat")
    low, high = found.interval()
    assert high == np.inf

    def cost(k):
        return 0.5 * np.sum((values - np.exp(-k * times)) ** 2) / (0.3 * SIGMA) ** 2

    expected = brentq(lambda k: cost(k) - fit.cost - 0.5 * scipy.stats.chi2.ppf(0.95, 1), 0.1, fit.theta[0])
    assert low == pytest.approx(expected, rel=1e-6)
    assert re.search(r"not identifiable upward: up to \S+ the cost does not rise enough", str(found))


def test_two_regions_of_one_profile():
    """y = a^2: -a fits as well as a."""
    values = 1.0 + 3 * noise(7)
    found = observed(lambda t, x, p: jnp.array([p["a"] ** 2]), values, {"a": 0.9}, 3 * SIGMA).profile("a")
    half = np.sqrt(scipy.stats.chi2.ppf(0.95, 1) / len(TIMES)) * 3 * SIGMA
    expected = np.sqrt(values.mean() + np.array([-half, half]))
    np.testing.assert_allclose(found.interval(), expected, rtol=1e-6)
    np.testing.assert_allclose(found.regions()[0], -expected[::-1], rtol=1e-6)
    assert "there is another minimum" in str(found)


def test_a_lower_minimum_is_told():
    values = np.tile([1.0, -0.1], (len(TIMES), 1))
    fit = observed(lambda t, x, p: jnp.array([p["a"] ** 2, 0.1 * p["a"]]), values, {"a": 0.9}, 0.6)
    assert fit.theta[0] > 0
    found = fit.profile("a")
    assert found.lower_cost[0] == pytest.approx(-1.0, abs=1e-2)
    assert "fit again with start=profile.lower_cost" in str(found)
    assert sf.estimate(fit.problem, start=found.lower_cost).cost == pytest.approx(0.0, abs=1e-12)


# The machinery


def test_nothing_is_compiled_along_a_profile(noisy_ramp):
    before = TRACES["count"]
    found = noisy_ramp.profile("tau_1")
    found.interval(0.999)
    assert TRACES["count"] == before


def test_correlated_residuals_are_allowed_for_on_request_and_said():
    """The model is linear: corrected intervals are the estimate +- quantile x corrected standard error."""
    times = np.linspace(0.0, 4.0, 201)[1:]
    red = scipy.signal.lfilter([1.0], [1.0, -0.8], noise(5, 200))
    values = (1.0 + 2.0 * times - times**2 + red)[:, None]
    fit = observed(parabola, values, {"c": [1.0, 2.0, -1.0]}, sigma=None, times=times)
    found = fit.profile("c[1]")
    r = correct_correlation(fit.residuals.channels[0].correlation, 200, 3)
    assert found.widening == pytest.approx(np.sqrt((1 + r) / (1 - r)))
    half = fit.quantile(0.95) * fit.standard_errors[1] * np.array([-1, 1])
    np.testing.assert_allclose(found.interval(), fit.theta[1] + half, rtol=1e-5)
    np.testing.assert_allclose(found.interval(corrected=True), fit.theta[1] + half * found.widening, rtol=1e-5)
    np.testing.assert_allclose(found.regions(corrected=True)[0], found.interval(corrected=True), rtol=1e-5)
    said = " ".join(str(found).split())
    assert f"too narrow by a factor of about {found.widening:.2g}; profile.interval(corrected=True) allows" in said


def test_it_can_be_stopped(noisy_ramp):
    told = []
    found = noisy_ramp.profile("tau_1", callback=lambda done, total: told.append(done <= total) or done >= 4)
    assert told == [True] * 4
    assert "stopped" in found.ends
    assert np.isnan(found.interval()).any()
    assert "it was stopped before it was done" in str(found)

    def interrupt(done, total):
        raise KeyboardInterrupt

    assert len(noisy_ramp.profile("v", callback=interrupt).values) == 1


def test_what_cannot_be_profiled(noisy_ramp):
    cost = sf.TerminalCost(lambda x, p: (x[0] - 1.0) ** 2)
    without = sf.Problem(RAMP, sf.Experiment(cost, ("up", "rest"), (1.9,), 0.0, 4.0), {"v": ONE})
    few = observed(parabola, np.array([1.0, 2.0, 2.5]), {"c": [0.0, 0.0, 0.0]}, None, TIMES[:3])
    begun = sf.estimate(noisy_ramp.problem, max_iterations=0)
    for fit, name, settings, error, said in (
        (noisy_ramp, "mu", {}, ValueError, "there is no unknown 'mu'; the unknowns are tau_1, v"),
        (noisy_ramp, "v", {"level": 1}, ValueError, "level must lie between 0 and 1; got 1"),
        (noisy_ramp.problem, "v", {}, TypeError, r"must be what sf.estimate returns: .*; got Problem"),
        (begun, "v", {}, ValueError, "a profile begins at a minimum, and this fit has not found one"),
        (sf.estimate(without), "tau_1", {}, ValueError, "a profile needs a noise model: a cost of Measurements alone"),
        (few, "c[0]", {}, ValueError, "sigma is unknown and 3 values are too few"),
    ):
        with pytest.raises(error, match=said):
            sf.profile(fit, name, **settings)
    with pytest.raises(TypeError, match="corrected must be True or False; got 1"):
        noisy_ramp.profile("v").interval(corrected=1)


# Intervals across kinks


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("tau", [2.0, 2.05, 2.1])
def test_intervals_across_samples_are_those_of_the_profile(seed, tau):
    """v known: J is a parabola between samples, so the pieces are exact."""
    times = np.arange(1, 41) / 10
    values = np.minimum(times, tau) + 0.3 * np.random.default_rng(seed).standard_normal(40)
    fit = ramp(values, tau, times=times, sigma=0.3, v=ONE)
    for level in (0.68, 0.95):
        found = fit.confidence_intervals(level)[0]
        np.testing.assert_allclose(found, fit.profile("tau_1", level=level).interval(level), rtol=0, atol=1e-4)


@pytest.mark.parametrize("delay", [0.05, "lag"])
def test_the_kinks_of_samples_with_a_delay_are_where_the_state_was_measured(delay):
    """Intervals and profile are those of the same samples with earlier stamps."""
    times = np.arange(1, 41) / 10
    values = np.minimum(times, 2.0) + 0.3 * np.random.default_rng(1).standard_normal(40)
    delays = (0.0, 0.0), (0.05, delay)
    fits = [ramp(values, 2.0, times=times + late, sigma=0.3, v=ONE, delay=given) for late, given in delays]
    np.testing.assert_allclose(fits[1].confidence_intervals(), fits[0].confidence_intervals(), rtol=1e-7)
    np.testing.assert_allclose(fits[1].profile("tau_1").sample_times, times, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("rate_known", [True, False])
@pytest.mark.parametrize("tau", [2.0, 2.01, 2.05])
def test_intervals_cover_a_transition_on_beside_and_between_samples(tau, rate_known):
    """Three standard errors of 2000 logs are 1.5 %."""
    found = coverage.measure_coverage(tau, 2000, rate_known=rate_known)
    np.testing.assert_allclose([found.piecewise, found.many, found.exact], 0.95, rtol=0, atol=0.015)
    assert (found.quadratic < 0.9) == (tau == 2.01)
