"""Bootstrap: against scipy where the estimate is a mean, and what it is for where the noise is not what it seems."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import switchfit as sf
from support.models import RAMP, STILL, curve, refused
from switchfit.batch.layout import CHUNK
from switchfit.batch.programs import Limits
from switchfit.batch.resampled_data import StudyOfRuns

TIMES = np.linspace(0.1, 4.0, 40)


def level(t, x, p):
    return jnp.array([p["m"]])


def mean_of(values, sigma=None):
    return sf.estimate(curve(level, TIMES[: len(values)], values, {"m": 0.0}, sigma=sigma, tf=4.0))


def skewed(seed=0, count=40):
    return 2.0 + np.random.default_rng(seed).exponential(size=count)


def test_the_bootstrap_of_a_mean_is_that_of_scipy():
    """Estimates are the mean plus sqrt(n / (n - 1)) times that of resampled, centred values."""
    values = skewed()
    fit = mean_of(values)
    study = sf.bootstrap(fit, 4000)
    assert study.success.all()
    inflation = np.sqrt(40 / 39)
    assert study.estimate[0] == pytest.approx(values.mean(), rel=1e-9)
    assert study.standard_deviation[0] == pytest.approx(values.std(ddof=1) / np.sqrt(40), rel=0.04)
    assert abs(study.bias[0]) < 4 * study.standard_deviation[0] / np.sqrt(4000)
    other = scipy.stats.bootstrap((values,), np.mean, n_resamples=20_000, rng=np.random.default_rng(1))
    expected = values.mean() + inflation * (np.array(other.confidence_interval) - values.mean())
    np.testing.assert_allclose(study.intervals()[0], expected, atol=0.02)
    shift = scipy.stats.norm.ppf(np.mean(study.theta[:, 0] < study.estimate[0]))
    z = shift + scipy.stats.norm.ppf([0.05, 0.95])
    parts = scipy.stats.norm.cdf(shift + z / (1 - study.acceleration[0] * z))
    np.testing.assert_allclose(study.intervals(0.9)[0], np.quantile(study.theta[:, 0], parts), rtol=1e-9)
    # scipy's acceleration, by leaving each value out and taking the mean of the rest
    without = (values.sum() - values) / 39
    influence = without.mean() - without
    expected = np.sum(influence**3) / (6 * np.sum(influence**2) ** 1.5)
    assert study.acceleration[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_wild_follows_noise_that_grows():
    """Noise ten times larger at the end: the classical error of the slope is too small, the wild one is right."""
    rng = np.random.default_rng(3)
    size = np.linspace(0.1, 2.0, 40) ** 2
    values = 1.0 + 0.5 * TIMES + size * rng.standard_normal(40)
    line = lambda t, x, p: jnp.array([p["m"] + p["s"] * t])  # noqa: E731
    fit = sf.estimate(curve(line, TIMES, values, {"m": 0.0, "s": 0.0}, tf=4.0))
    design = np.stack([np.ones(40), TIMES], axis=1)
    residual = values - design @ fit.theta
    inverse = np.linalg.inv(design.T @ design)
    sandwich = inverse @ (design.T * residual**2 * 40 / 38) @ design @ inverse
    study = sf.bootstrap(fit, 3000, resample="wild")
    np.testing.assert_allclose(study.standard_deviation, np.sqrt(np.diag(sandwich)), rtol=0.06)


@pytest.mark.slow
def test_blocks_follow_noise_that_is_correlated():
    """The mean of first-order autoregressive noise: its error is sqrt((1 + r) / (1 - r)) times the classical one."""
    rng = np.random.default_rng(5)
    n, r = 1500, 0.7
    noise = np.zeros(n)
    for k in range(1, n):
        noise[k] = r * noise[k - 1] + rng.standard_normal()
    times = np.linspace(0.001, 4.0, n)
    fit = sf.estimate(curve(level, times, 1.0 + noise, {"m": 0.0}, tf=4.0))
    blocks = sf.bootstrap(fit, 1000, resample="blocks")
    single = sf.bootstrap(fit, 1000)
    assert 10 < blocks.block < 60
    expected = np.sqrt((1 + r) / (1 - r))
    assert blocks.standard_deviation[0] / single.standard_deviation[0] == pytest.approx(expected, rel=0.2)
    assert single.standard_deviation[0] == pytest.approx(fit.standard_errors[0], rel=0.1)
    assert sf.bootstrap(fit, 5, resample="blocks", block=7).block == 7


def ramps(slopes, sigma=0.05, seed=0):
    """Runs whose slopes differ from one to the next by more than the noise explains."""
    rng = np.random.default_rng(seed)
    runs = []
    for slope in slopes:
        values = slope * np.minimum(TIMES, 2.05) + sigma * rng.standard_normal(40)
        runs.append(sf.Experiment(sf.Measurements(TIMES, values, sigma=sigma), ("up", "rest"), (2.0,), 0.0, 4.0))
    return sf.Problem(RAMP, runs, {"v": 1.0})


def test_a_run_weighs_as_often_as_it_was_drawn():
    problem = ramps([0.9, 1.0, 1.2], seed=1)  # with others J has two minima close to each other
    fit = sf.estimate(problem, strategy="local")
    study = sf.bootstrap(fit, 6, resample="runs", seed=2)
    work = StudyOfRuns(problem, list(fit.evaluator.meshes), fit.theta[None], Limits(1e-7, 200), 2)
    assert len({tuple(each) for each in work.weigh(range(6))}) > 1
    for k in range(6):
        weights = np.round(work.weigh([k])[0]).astype(int)
        assert weights.sum() == 3
        drawn = np.repeat(np.arange(3), weights)
        again = sf.estimate(replace(problem, experiments=[problem.experiments[e] for e in drawn]), strategy="local")
        assert study.theta[k][-1] == pytest.approx(again.theta[-1], rel=1e-6)
    assert study.resampled.tolist() == [False] * 3 + [True]
    assert np.isnan(study.intervals()).all(axis=1).tolist() == [True] * 3 + [False]
    np.testing.assert_allclose(study.standard_deviation, [np.nan] * 3 + [study.theta[:, 3].std(ddof=1)], rtol=1e-12)
    assert [ax.get_xlabel() for ax in study.plot().axes if ax.get_visible()] == ["v"]


def test_missing_values_stay_missing_and_channels_stay_together():
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((40, 1)) * np.array([1.0, -2.0])
    values = np.array([1.0, 3.0]) + noise
    values[[3, 9], 1] = np.nan

    two = lambda t, x, p: jnp.array([p["m"], p["n"]])  # noqa: E731
    fit = sf.estimate(curve(two, TIMES, values, {"m": 0.0, "n": 0.0}, tf=4.0))
    study = sf.bootstrap(fit, 300)
    assert study.samples.tolist() == [78] * 300
    assert np.corrcoef(study.theta.T)[0, 1] < -0.9


def test_seeds_and_folders(tmp_path):
    fit, runs = mean_of(skewed(), sigma=1.0), sf.estimate(ramps([0.9, 1.0, 1.2]))
    one, other = (sf.bootstrap(fit, CHUNK + 8, seed=seed) for seed in (0, 1))
    same = sf.bootstrap(fit, CHUNK + 8, folder=tmp_path)
    np.testing.assert_array_equal(one.theta, same.theta)
    assert not np.array_equal(one.theta, other.theta)
    for another, resample in ((fit, "wild"), (runs, "runs")):
        with pytest.raises(ValueError, match="holds the results of another run"):
            sf.bootstrap(another, CHUNK + 8, folder=tmp_path, resample=resample)


def made(**settings):
    return lambda: sf.bootstrap(mean_of(skewed()), **settings)


def with_reference():
    signal = sf.ReferenceSignal.from_samples(TIMES, skewed(), observe=level)
    return sf.estimate(sf.Problem(STILL, sf.Experiment(signal, ("still",), (), 0.1, 4.0), {"m": 0.0}))


test_what_is_refused = refused(
    (made(resample="pairs"), "resample must be one of residuals, wild, blocks, runs; got 'pairs'"),
    (made(block=3), "block is the length of blocks: give it with resample='blocks'"),
    (made(resample="blocks", block=41), "block must lie between 1 and the 40 samples there are; got 41"),
    (made(resample="runs"), "resample='runs' needs two experiments or more"),
    (lambda: sf.bootstrap(mean_of(skewed()).problem), r"bootstrap needs the result of sf.estimate; got Problem"),
    (lambda: sf.bootstrap(sf.estimate(mean_of(skewed()).problem, max_iterations=0)), "a bootstrap begins at a minimum"),
    (lambda: sf.bootstrap(with_reference()), "resamples Measurements; this problem has a ReferenceSignal"),
    (lambda: made(runs=10)().intervals(0), "level must lie between 0 and 1; got 0"),
)


NO_LEAST_SQUARES = {
    "prior": ({"m": sf.Parameter(1.0, prior=sf.Normal(1.0, 1.0))}, {"sigma": 1.0}),
    "sigma": ({"m": 1.0, "s": sf.Parameter(1.0, lower=0.1)}, {"sigma": "s"}),
    "delay": ({"m": 1.0, "d": sf.Parameter(0.01, lower=0.0, upper=0.05)}, {"sigma": 1.0, "delay": "d"}),
    "loss": ({"m": 1.0}, {"sigma": 1.0, "loss": "huber"}),
}


@pytest.mark.parametrize("what", NO_LEAST_SQUARES)
def test_only_least_squares_are_resampled(what):
    """Draws of the residuals of anything else have another spread than the estimates: sf.monte_carlo is advised."""
    parameters, settings = NO_LEAST_SQUARES[what]
    fit = sf.estimate(curve(level, TIMES, skewed(), parameters, tf=4.0, **settings))
    with pytest.raises(ValueError, match=rf"least squares alone.* {what}.*sf\.monte_carlo"):
        sf.bootstrap(fit, 5)
