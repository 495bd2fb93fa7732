"""Profile likelihoods against closed forms, and what they say where there is no ordinary interval."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from models import curve, rest
from scipy.optimize import brentq

import switchfit as sf
from switchfit.fit.result import Fit
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


def exponential(t, x, p):
    return jnp.array([jnp.exp(-p["k"] * t)])


def square(t, x, p):
    return jnp.array([p["a"] ** 2])


def observed(h, values, parameters, sigma=SIGMA, times=TIMES):
    """A fit of h(t, p) alone: the state rests at 0."""
    return sf.estimate(curve(h, times, values, parameters, sigma=sigma, tf=4.0))


def ramp(values, tau=2.1, sigma=SIGMA, v=1.0):
    """x = v min(t, tau): its cost is quadratic in v, and in tau between samples."""
    data = sf.Measurements(TIMES, values, sigma=sigma, names=("x",))
    run = sf.Experiment(data, ("up", "rest"), (tau,), 0.0, 4.0)
    return sf.estimate(sf.Problem(RAMP, run, {"v": v}))


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


def test_the_interval_of_an_unknown_sigma_is_that_of_the_f_distribution():
    values = 1.0 - 0.5 * TIMES + noise(2)
    fit = observed(parabola, values, {"c": sf.Parameter([0.0, 0.0, 0.0])}, None)
    low, high = fit.profile("c[1]").interval(0.9)
    freedom = len(TIMES) - 3
    quantile = scipy.stats.f.ppf(0.9, 1, freedom)
    for edge in (low, high):
        rest = np.stack([np.ones(len(TIMES)), TIMES**2], axis=1)
        squares = np.linalg.lstsq(rest, values - edge * TIMES, rcond=None)[1][0]
        assert (squares - 2 * fit.cost) / (2 * fit.cost / freedom) == pytest.approx(quantile, rel=1e-6)


def test_of_a_transition_time_with_kinks_at_the_samples():
    values = np.minimum(TIMES, 2.05) + noise(3)
    fit = ramp(values)
    found = fit.profile("tau_1")
    np.testing.assert_allclose(found.costs, [ramp_cost(values, tau) for tau in found.values], rtol=1e-9)
    for level in (0.683, 0.95, 0.99):
        height = fit.cost + 0.5 * scipy.stats.chi2.ppf(level, 1)
        span = 6 * fit.standard_errors[0]

        def excess(tau, height=height):
            return ramp_cost(values, tau) - height

        tau = fit.theta[0]
        expected = [brentq(excess, *sorted((tau, tau + side * span))) for side in (-1, 1)]
        np.testing.assert_allclose(found.interval(level), expected, rtol=1e-6)
    inside = [t for t in TIMES if found.interval()[0] < t < found.interval()[1]]
    assert len(inside) > 1
    assert f"{len(inside)} sample times lie in the interval, where the slope of the profile may jump" in str(found)


def test_others_are_fitted_again_and_pushed_away_in_time():
    """tau_1 is moved beyond the estimate of tau_2; the other unknowns are those of a fit with tau_1 held."""
    rng = np.random.default_rng(0)
    true = np.minimum(TIMES, 2.0) + 0.5 * np.maximum(TIMES - 2.4, 0.0)
    values = true + 0.3 * rng.standard_normal(len(TIMES))
    system = sf.HybridSystem({"up": moving, "rest": rest, "half": lambda t, x, p: 0.5 * p["v"] + 0.0 * x}, [0.0])

    def problem(tau_1):
        data = sf.Measurements(TIMES, values, sigma=0.3)
        run = sf.Experiment(data, ("up", "rest", "half"), (tau_1, 2.6), 0.0, 4.0)
        return sf.Problem(system, run, {"v": 1.0})

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
    assert found.ends == ("limit", "crossed")
    n, mean = len(TIMES), values.mean()
    # (m - mean)^2 - mean^2 = 3.84 sigma^2 / n, with mean < 0
    high = mean + np.sqrt(mean**2 + scipy.stats.chi2.ppf(0.95, 1) * SIGMA**2 / n)
    np.testing.assert_allclose(found.interval(), [0.0, high], rtol=1e-6, atol=1e-12)
    assert "downward the limit 0 comes before the threshold: the interval is one-sided" in str(found)
    found.plot().draw_without_rendering()


def test_not_identifiable_upward():
    """A decay that is over before the first sample: any rate above some value fits as well."""
    times = TIMES[TIMES >= 1.0]
    values = 0.3 * noise(6, len(times))
    fit = observed(exponential, values, {"k": 3.0}, 0.3 * SIGMA, times)
    found = fit.profile("k")
    assert found.ends == ("crossed", "flat")
    low, high = found.interval()
    assert high == np.inf

    def cost(k):
        return 0.5 * np.sum((values - np.exp(-k * times)) ** 2) / (0.3 * SIGMA) ** 2

    expected = brentq(lambda k: cost(k) - fit.cost - 0.5 * scipy.stats.chi2.ppf(0.95, 1), 0.1, fit.theta[0])
    assert low == pytest.approx(expected, rel=1e-6)
    assert re.search(r"not identifiable upward: up to \S+ the cost does not rise enough", str(found))
    found.plot().draw_without_rendering()


def test_two_regions_of_one_profile():
    """y = a^2: -a fits as well as a."""
    values = 1.0 + 3 * noise(7)
    fit = observed(square, values, {"a": 0.9}, 3 * SIGMA)
    found = fit.profile("a")
    regions = found.regions()
    low, high = found.interval()
    half = np.sqrt(scipy.stats.chi2.ppf(0.95, 1) / len(TIMES)) * 3 * SIGMA
    expected = np.sqrt(values.mean() + np.array([-half, half]))
    np.testing.assert_allclose((low, high), expected, rtol=1e-6)
    assert len(regions) == 2
    np.testing.assert_allclose(regions[0], -expected[::-1], rtol=1e-6)
    assert "there is another minimum" in str(found)


def test_a_lower_minimum_is_told():
    def double_well(t, x, p):
        return jnp.array([p["a"] ** 2, 0.1 * p["a"]])

    values = np.tile([1.0, -0.1], (len(TIMES), 1))
    fit = observed(double_well, values, {"a": 0.9}, 0.6)
    assert fit.theta[0] > 0
    found = fit.profile("a")
    assert found.lower_cost[0] == pytest.approx(-1.0, abs=1e-2)
    assert "fit again with start=profile.lower_cost" in str(found)
    assert sf.estimate(fit.problem, start=found.lower_cost).cost == pytest.approx(0.0, abs=1e-12)


def test_at_a_kink_there_is_an_interval_too():
    """The estimate of tau_1 is a sample time, where no standard error applies."""
    values = np.minimum(TIMES, 2.0)
    values[TIMES > 2.0] += 0.35
    values[np.isclose(TIMES, 2.0)] -= 0.9
    data = sf.Measurements(TIMES, values, sigma=SIGMA)
    run = sf.Experiment(data, ("up", "rest"), (2.3,), 0.0, 4.0)
    problem = sf.Problem(RAMP, run, {"v": sf.Parameter(1.0, fixed=True)})
    fit = sf.estimate(problem)
    low, high = fit.profile("tau_1").interval()

    def cost(tau):
        return 0.5 * np.sum((values - np.minimum(TIMES, tau)) ** 2) / SIGMA**2

    height = cost(fit.theta[0]) + 0.5 * scipy.stats.chi2.ppf(0.95, 1)
    assert cost(low) == pytest.approx(height, rel=1e-6)
    assert cost(high) == pytest.approx(height, rel=1e-6)
    assert low < fit.theta[0] < high


# The machinery


def test_nothing_is_compiled_along_a_profile():
    fit = ramp(np.minimum(TIMES, 2.05) + noise(3))
    before = TRACES["count"]
    found = fit.profile("tau_1")
    found.interval(0.999)
    fit.profile("v").interval()
    assert TRACES["count"] == before
    assert len(found.values) > 15


def test_correlated_residuals_are_allowed_for_on_request_and_said():
    """The model is linear: corrected intervals are the estimate +- quantile x corrected standard error."""
    times = np.linspace(0.0, 4.0, 201)[1:]
    red = noise(5, 200)
    for i in range(1, 200):
        red[i] += 0.8 * red[i - 1]
    values = (1.0 + 2.0 * times - times**2 + red)[:, None]
    fit = observed(parabola, values, {"c": [1.0, 2.0, -1.0]}, sigma=None, times=times)
    found = fit.profile("c[1]")
    r = correct_correlation(fit.residuals.channels[0].correlation, 200, 3)
    assert found.widening == pytest.approx(np.sqrt((1 + r) / (1 - r)))
    half = fit.quantile(0.95) * fit.standard_errors[1]
    np.testing.assert_allclose(found.interval(), fit.theta[1] + half * np.array([-1, 1]), rtol=1e-5)
    wide = half * found.widening
    np.testing.assert_allclose(found.interval(corrected=True), fit.theta[1] + wide * np.array([-1, 1]), rtol=1e-5)
    assert found.regions(0.9, corrected=True)[0][1] - fit.theta[1] == pytest.approx(
        fit.quantile(0.9) * fit.corrected_standard_errors[1], rel=1e-5
    )
    said = " ".join(str(found).split())
    assert f"too narrow by a factor of about {found.widening:.2g}; profile.interval(corrected=True) allows" in said
    assert "95 % interval, residuals as if independent" in found.plot().axes[0].get_legend_handles_labels()[1]
    assert found.to_pandas().attrs["widening"] == found.widening
    white = observed(parabola, (1.0 + 2.0 * TIMES - TIMES**2 + noise(1))[:, None], {"c": [1.0, 2.0, -1.0]})
    assert white.profile("c[1]").widening == 1.0
    assert "independent" not in str(white.profile("c[1]"))
    with pytest.raises(TypeError, match="corrected must be True or False; got 1"):
        found.interval(corrected=1)


def test_it_can_be_stopped():
    fit = ramp(np.minimum(TIMES, 2.05) + noise(3))
    told = []

    def stop(done, total):
        told.append((done, total))
        return done >= 4

    found = fit.profile("tau_1", callback=stop)
    assert len(told) == 4
    assert all(done <= total for done, total in told)
    assert "stopped" in found.ends
    assert np.isnan(found.interval()).any()
    assert "it was stopped before it was done" in str(found)

    def interrupt(done, total):
        raise KeyboardInterrupt

    assert len(fit.profile("v", callback=interrupt).values) == 1


def test_what_cannot_be_profiled():
    fit = ramp(np.minimum(TIMES, 2.05) + noise(3))
    with pytest.raises(ValueError, match="there is no unknown 'mu'; the unknowns are tau_1, v"):
        fit.profile("mu")
    with pytest.raises(ValueError, match="level must lie between 0 and 1; got 1"):
        fit.profile("v", level=1)
    with pytest.raises(TypeError, match=r"profile needs the result of sf.estimate; got Problem"):
        sf.profile(fit.problem, "v")
    with pytest.raises(ValueError, match="a profile begins at a minimum, and this fit has not found one"):
        sf.estimate(fit.problem, max_iterations=0).profile("v")
    cost = sf.TerminalCost(lambda x, p: (x[0] - 1.0) ** 2)
    run = sf.Experiment(cost, ("up", "rest"), (1.9,), 0.0, 4.0)
    without = sf.estimate(sf.Problem(RAMP, run, {"v": sf.Parameter(1.0, fixed=True)}))
    with pytest.raises(ValueError, match="a profile needs a noise model: a cost of Measurements alone"):
        without.profile("tau_1")
    few = observed(parabola, np.array([1.0, 2.0, 2.5]), {"c": [0.0, 0.0, 0.0]}, None, TIMES[:3])
    with pytest.raises(ValueError, match="sigma is unknown and 3 values are too few"):
        few.profile("c[0]")


def test_figure_of_a_profile():
    fit = ramp(np.minimum(TIMES, 2.05) + noise(3))
    figure = fit.profile("tau_1").plot()
    (ax,) = figure.axes
    assert ax.get_title() == "Profile likelihood of tau_1"
    assert ax.get_xlabel() == "tau_1 (s)"
    assert ax.get_ylabel() == "2 (J - J min)"
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["95 % interval", "profile", "quadratic approximation", "sample times"]
    assert [text.get_text() for text in ax.texts] == ["68.3 %", "95 %"]
    figure.draw_without_rendering()
    unknown = ramp(np.minimum(TIMES, 2.05) + noise(3), sigma=None).profile("v").plot()
    assert unknown.axes[0].get_ylabel() == "2 (J - J min) / s²"


# Intervals across kinks


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("tau", [2.0, 2.05, 2.1])
def test_intervals_across_samples_are_those_of_the_profile(seed, tau):
    """v known: J is a parabola between samples, so the pieces are exact."""
    sigma = 0.3
    times = np.arange(1, 41) / 10
    values = np.minimum(times, tau) + sigma * np.random.default_rng(seed).standard_normal(40)
    data = sf.Measurements(times, values[:, None], sigma=sigma)
    run = sf.Experiment(data, ("up", "rest"), (tau,), 0.0, 4.0)
    fit = sf.estimate(sf.Problem(RAMP, run, {"v": sf.Parameter(1.0, fixed=True)}))
    for level in (0.68, 0.95):
        found = fit.confidence_intervals(level)[0]
        np.testing.assert_allclose(found, fit.profile("tau_1", level=level).interval(level), rtol=0, atol=1e-4)
    plain = Fit.confidence_intervals(fit)[0]
    assert fit.kinks or np.max(np.abs(fit.confidence_intervals()[0] - plain)) > 1e-4


@pytest.mark.parametrize("delay", [0.05, "lag"])
def test_the_kinks_of_samples_with_a_delay_are_where_the_state_was_measured(delay):
    """Intervals and profile are those of the same samples with earlier stamps."""
    times = np.arange(1, 41) / 10
    values = np.minimum(times, 2.0) + 0.3 * np.random.default_rng(1).standard_normal(40)
    parameters = {"v": sf.Parameter(1.0, fixed=True), "lag": sf.Parameter(0.05, fixed=True)}
    fits = []
    for late, given in ((0.0, 0.0), (0.05, delay)):
        data = sf.Measurements(times + late, values[:, None], sigma=0.3, delay=given)
        fits.append(sf.estimate(sf.Problem(RAMP, sf.Experiment(data, ("up", "rest"), (2.0,), 0.0, 4.0), parameters)))
    np.testing.assert_allclose(fits[1].confidence_intervals(), fits[0].confidence_intervals(), rtol=1e-7)
    np.testing.assert_allclose(fits[1].profile("tau_1").sample_times, times, rtol=1e-12)


@pytest.mark.parametrize("tau", [2.0, 2.01, 2.05])
def test_intervals_follow_the_profile_where_the_rate_is_estimated_too(tau):
    """The rate follows a curve: one parabola from sample to sample misses the ends by a tenth of the length."""
    benchmark = load_coverage()
    for seed in range(8):
        values = np.where(tau < benchmark.TIMES, 1 - np.exp(-8.0 * (benchmark.TIMES - tau)), 0.0)
        values = values + 0.05 * np.random.default_rng(seed).standard_normal(40)
        fit = sf.estimate(benchmark.build_problem(values[:, None], tau, rate_known=False), strategy="local")
        found, expected = fit.confidence_intervals()[0], fit.profile("tau_1").interval()
        np.testing.assert_allclose(found, expected, rtol=0, atol=0.05 * np.ptp(expected), err_msg=f"seed {seed}")


def test_the_likelihood_ratio_of_the_coverage_is_that_of_profiles():
    """What benchmarks/coverage.py computes apart, in closed form on a grid."""
    benchmark = load_coverage()
    for seed in range(4):
        values = np.where(benchmark.TIMES > 2.05, 1 - np.exp(-8.0 * (benchmark.TIMES - 2.05)), 0.0)
        values = values + 0.05 * np.random.default_rng(seed).standard_normal(40)
        fit = sf.estimate(benchmark.build_problem(values[:, None], 2.05, rate_known=False))
        trace = fit.profile("tau_1").trace
        there = trace.add(2.05, trace.centre)
        ratio = benchmark.compare_likelihoods(values[None], 2.05, rate_known=False)[0]
        assert ratio == pytest.approx(trace.compute_zeta(there) ** 2, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("rate_known", [True, False])
@pytest.mark.parametrize("tau", [2.0, 2.01, 2.05])
def test_intervals_cover_a_transition_on_beside_and_between_samples(tau, rate_known):
    """Three standard errors of 2000 logs are 1.5 %."""
    found = load_coverage().measure_coverage(tau, 2000, rate_known=rate_known)
    assert abs(found.piecewise - 0.95) < 0.015
    assert abs(found.many - 0.95) < 0.015
    assert abs(found.exact - 0.95) < 0.015
    if tau < 2.02:
        assert found.quadratic < 0.85


def load_coverage():
    path = Path(__file__).parent.parent / "benchmarks" / "coverage.py"
    spec = importlib.util.spec_from_file_location("coverage_benchmark", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["coverage_benchmark"] = module
    spec.loader.exec_module(module)
    return module
