"""Both covariances and the sandwich, at kinks and jumps too; and slowly, coverage."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
import scipy.stats
from scipy.integrate import quad

import switchfit as sf
from support.fits_by_hand import made, warnings_of
from support.models import STILL, VEHICLE_TRUTH, drive, one_run, positions, simulate_log
from support.noisy_decays import TIMES, decay, observed, one_line
from switchfit.fit.kink_variance import free_kinks, measure_kink_variance
from switchfit.uncertainty.covariance_comparison import disagreement


def noisy_decay(sigma, seed=0, **changes):
    values = np.exp(-0.5 * TIMES) + sigma * np.random.default_rng(seed).standard_normal(24)
    return observed(decay, values, {"a": 1.0, "k": 0.5}, sigma, **changes)


# Covariances


def test_the_gauss_newton_covariance_in_closed_form():
    fit = sf.estimate(noisy_decay(0.1))
    a, k = fit.theta
    design = np.stack([np.exp(-k * TIMES), -a * TIMES * np.exp(-k * TIMES)], axis=1) / 0.1
    np.testing.assert_allclose(fit.gauss_newton, design.T @ design, rtol=1e-9)
    covariance = np.linalg.inv(design.T @ design)
    np.testing.assert_allclose(fit.covariance_from("gauss-newton"), covariance, rtol=1e-8)
    half = scipy.stats.norm.ppf(0.95) * np.sqrt(np.diag(covariance))
    interval = fit.confidence_intervals(0.9, hessian="gauss-newton")
    np.testing.assert_allclose(interval, np.stack([fit.theta - half, fit.theta + half], axis=1), rtol=1e-8)


@pytest.mark.parametrize("part", [4.0, 0.25, 1e-8])
def test_the_factor_between_the_covariances_goes_either_way(part):
    hessian = np.diag([100.0, 400.0, 900.0])
    fit = made(hessian=hessian, saved_gauss_newton=np.diag([1.0, part, 1.0]) @ hessian)
    found = disagreement(fit)
    assert found.factor == pytest.approx(max(part, 1 / part) ** 0.5, rel=1e-9)
    assert (found.name, found.exact) == ("tau_2", pytest.approx(0.05, rel=1e-12))
    assert found.gauss_newton == pytest.approx(0.05 / np.sqrt(part), rel=1e-12)
    unseen = "To first order the fitted values hardly depend on tau_2: its standard errors"
    assert (unseen in warnings_of(fit)[0]) == (part < 1e-4)


def test_what_no_sample_shows_to_first_order_is_not_hidden_by_rounding():
    hessian, unseen = np.array([[100.0, 60.0, 0.0], [60.0, 400.0, 0.0], [0.0, 0.0, 900.0]]), np.diag([1.0, 1e-11, 1.0])
    assert disagreement(made(hessian=hessian, saved_gauss_newton=unseen @ hessian @ unseen)).factor > 1e10


def measure_moment(left, right, curvature):
    """The second moment of exp(-g |x| - s x^2 / 2), g being the slope to each side."""

    def integrate(power, g):
        return quad(lambda x: x**power * np.exp(-g * x - curvature * x**2 / 2), 0.0, np.inf, epsabs=0.0)[0]

    return sum(integrate(2, g) for g in (left, right)) / sum(integrate(0, g) for g in (left, right))


def test_the_variance_at_a_kink_is_the_second_moment_of_its_density():
    """The last are a steep one, one without curvature, jumps of J, and a J that falls again at once."""
    slopes = [[1.0, 2.0], [0.0, 5.0], [30.0, 0.1], [0.0, 0.0], [99.0, 0.5], [2.0, 7.0], [np.inf, np.inf], [1e-9, 150.0]]
    curvatures = np.array([3.0, 0.4, 2.0, 4.0, 1e-2, 0.0, 1.0, -4.0])
    expected = [measure_moment(*g, s) for g, s in zip(slopes[:-2], curvatures[:-2], strict=True)]
    np.testing.assert_allclose(measure_kink_variance(np.array(slopes), curvatures), [*expected, 0.0, 0.0], rtol=1e-5)


@pytest.mark.parametrize(("scale", "left", "right"), [(1.0, 0.5, 3.0), (0.3, 0.5, 3.0), (1.0, 0.0, 0.0)])
def test_what_follows_unknowns_at_kinks_is_as_uncertain(scale, left, right):
    """The inverse is that of H with 1 / v in place of the curvatures along kinks; without slopes it is that of H."""
    root = np.random.default_rng(0).standard_normal((8, 5))
    H, inverse, held, free = root.T @ root, np.zeros((5, 5)), [3, 1], np.ix_([0, 2, 4], [0, 2, 4])
    inverse[free] = np.linalg.inv(H[free])
    curvatures, stiffer = np.diag(np.linalg.inv(np.linalg.inv(H)[np.ix_(held, held)])), H.copy()
    for place, s in zip(held, curvatures, strict=True):
        stiffer[place, place] += scale / measure_moment(left / scale, place * right / scale, s / scale) - s
    found = free_kinks(inverse, H, [(place, -left, place * right) for place in held], scale)
    np.testing.assert_allclose(found, np.linalg.inv(stiffer), rtol=1e-9)


@pytest.mark.parametrize("level", [0.6, 0.95])
def test_the_interval_of_a_time_at_which_what_is_measured_jumps_is_that_of_its_density(level):
    """J jumps at each sample; all other unknowns are known, so that its density can be summed."""
    modes = dict.fromkeys(("before", "after"), lambda t, x, p: -0.05 * x)
    system = sf.HybridSystem(modes, [10.0], {("before", "after"): lambda t, x, p: x + 1.5})
    t, grid = np.arange(0.5, 40.0), np.linspace(0.0, 40.0, 400_001)
    log = sf.Measurements(t, np.zeros(40), sigma=1.0)
    problem = simulate_log(one_run(system, log, tuple(modes), (16.0,), 40.0), [16.2], seed=0)
    y, costs = problem.measurements[0].values[:, 0], np.zeros_like(grid)
    for time, value in zip(t, y, strict=True):
        seen = 10.0 * np.exp(-0.05 * time) + np.where(grid < time, 1.5 * np.exp(-0.05 * (time - grid)), 0.0)
        costs += 0.5 * (value - seen) ** 2
    density = np.exp(costs.min() - costs)
    expected = np.interp([0.5 - 0.5 * level, 0.5 + 0.5 * level], np.cumsum(density) / density.sum(), grid)
    found = sf.estimate(problem).confidence_intervals(level)[0]
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_no_covariance_of_another_kind():
    fit = sf.estimate(noisy_decay(0.1))
    with pytest.raises(ValueError, match="hessian must be 'exact', 'gauss-newton' or 'sandwich'; got 'fisher'"):
        fit.covariance_from("fisher")
    with pytest.raises(ValueError, match="The Gauss-Newton matrix of this fit is not known"):
        replace(fit, problem=None).covariance_from("gauss-newton")


# Coverage


def vehicle(rate=10.0, sigma=0.1):
    """The paper's simulated vehicle, guessed right: positions at a rate (Hz) on [0, 15] s."""
    return drive(positions(np.arange(1, round(15 * rate)) / rate, sigma), VEHICLE_TRUTH)


@pytest.mark.slow
def test_intervals_cover_the_truth_of_the_papers_vehicle():
    """2,400 runs: the fraction of 95 % intervals that cover has a standard deviation of 0.45 %."""
    study = sf.monte_carlo(vehicle(), 2400, theta=VEHICLE_TRUTH, seed=1)
    assert study.success.sum() >= 2395
    coverage = study.coverage(0.95)
    assert np.all((coverage > 0.93) & (coverage < 0.97)), coverage


def location(values, loss="huber", sigma=1.0, m=0.1):
    """A fit of a constant m to values."""
    times = np.arange(1.0, len(values) + 1)
    settings = {"loss": loss, "loss_scale": 1.5 if loss != "linear" else 1.0}
    data = sf.Measurements(times, values, observe=lambda t, x, p: p["m"] + 0 * x, sigma=sigma, **settings)
    return sf.estimate(one_run(STILL, data, ("still",), (), times[-1], {"m": m}), strategy="local")


def test_the_sandwich_of_a_location_in_closed_form():
    """Huber's psi(r) = r clipped at C: C = n / (n - 1) sum psi^2 / (sum psi')^2, whatever sigma the costs have."""
    sigma = 0.5
    values = np.random.default_rng(0).standard_t(2, 50) * sigma
    fit = location(values, sigma=sigma)
    r = (values - fit.parameters["m"]) / sigma
    psi, slope = np.clip(r, -1.5, 1.5), np.abs(r) < 1.5
    assert abs(psi.sum()) < 1e-6
    assert 30 < slope.sum() < 50
    expected = 50 / 49 * np.sum(psi**2) / np.sum(slope) ** 2 * sigma**2
    assert fit.covariance_from("sandwich") == pytest.approx(np.array([[expected]]), rel=1e-9)
    half = scipy.stats.t.ppf(0.95, 49) * np.sqrt(expected)
    ends = fit.theta[0] + half * np.array([-1.0, 1.0])
    np.testing.assert_allclose(fit.confidence_intervals(0.9, hessian="sandwich"), [ends], rtol=1e-9)
    constant = location(np.zeros(30), loss="linear")  # no variance, of which a share could be explained
    assert str(constant).startswith("Good: converged; one fit; the data do not vary")


def test_the_sandwich_of_a_line_is_that_of_white():
    """Without a robust loss: (X'X)^-1 X' diag(r^2) X (X'X)^-1 n / (n - d), sigma known, wrong or unknown."""
    rng = np.random.default_rng(1)
    values = 1.0 + 0.5 * TIMES + 0.3 * TIMES * rng.standard_normal(24)
    X = np.stack([np.ones(24), TIMES], axis=1)
    bread = np.linalg.inv(X.T @ X)
    r = values - X @ (bread @ X.T @ values)
    expected = 24 / 22 * bread @ (X.T * r**2) @ X @ bread
    for sigma in (None, 0.1, 3.0):
        fit = sf.estimate(observed(lambda t, x, p: p["a"] + p["b"] * t + 0 * x, values, {"a": 0.5, "b": 0.1}, sigma))
        np.testing.assert_allclose(fit.covariance_from("sandwich"), expected, rtol=1e-6)


@pytest.mark.usefixtures("quick_certificates")
def test_no_sandwich_without_the_gradients_of_the_samples(tmp_path):
    fit = location(np.random.default_rng(0).standard_normal(30))
    fit.save(tmp_path / "fit.json")
    with_prior = location(np.zeros(30), m=sf.Parameter(0.1, prior=sf.Normal(0.0, 1.0)))
    assert "They take the robust loss as that of the noise." in one_line(with_prior)
    for without in (sf.Estimate.load(tmp_path / "fit.json"), with_prior, location(np.array([0.3]))):
        with pytest.raises(ValueError, match="needs the gradient of each sample: the problem, with a cost of Meas"):
            without.covariance_from("sandwich")
