"""Validation on another run, in closed form of linear regression."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.signal
import scipy.stats

import switchfit as sf
from support.models import approach
from support.regressions import SIGMA, design, pose, run, values
from switchfit.cli.summaries import summarize_validation
from switchfit.models import heater_problem
from switchfit.report.numbers import format_rounded
from switchfit.strategy.input_correlation import correlate

TRAIN, TEST = np.array([0.5, 1.0, 1.7, 2.2, 3.0, 3.9]), np.linspace(0.2, 4.5, 31)


def fit_line(sigma=SIGMA, seed=0):
    return sf.estimate(pose(run(TRAIN, values(TRAIN, seed), sigma)))


def by_hand(seed=0):
    """Estimates of the parameters, their covariance over sigma^2, and the residual variance."""
    X, y = design(TRAIN), values(TRAIN, seed)
    p, (squares,), *_ = np.linalg.lstsq(X, y, rcond=None)
    return p, np.linalg.inv(X.T @ X), squares / (len(y) - 2)


@pytest.mark.parametrize("sigma", [SIGMA, None, "s"], ids=["sigma known", "sigma unknown", "sigma a parameter"])
def test_the_test_of_the_residuals_in_closed_form(sigma):
    """Chi-square where sigma is known, Fisher's F where it is that of the residuals of the fit."""
    named, known, y = {"s": sf.Parameter(0.5, scale="log")} if sigma == "s" else {}, sigma == SIGMA, values(TEST, 1)
    fit = sf.estimate(pose(run(TRAIN, values(TRAIN, 5), sigma), **named))
    found = fit.validate(run(TEST, y, sigma))
    p, C, variance = by_hand(seed=5)
    variance = SIGMA**2 if known else variance
    r, X, n = y - design(TEST) @ p, design(TEST), len(TEST)
    expected = r @ np.linalg.solve(variance * (np.eye(n) + X @ C @ X.T), r)
    assert found.chi_square == pytest.approx(expected, rel=1e-6)
    assert (found.freedom, found.kept) == (n, ("a", "b", *named))
    probability = scipy.stats.chi2.sf(expected, n) if known else scipy.stats.f.sf(expected / n, n, len(TRAIN) - 2)
    assert found.probability == pytest.approx(probability, rel=1e-5)
    assert r @ r / variance > 1.2 * expected, "otherwise the error of the parameters would not matter in this test"
    variance *= (len(TRAIN) - 2) / len(TRAIN) if named else 1.0  # the likelihood's
    np.testing.assert_allclose(found.covariance[:2, :2], variance * C, rtol=1e-6)
    mean = y.mean()
    assert found.percent == pytest.approx(100 * (1 - np.linalg.norm(r) / np.linalg.norm(y - mean)), rel=1e-6)
    assert found.explained == pytest.approx(1 - r @ r / np.sum((y - mean) ** 2), rel=1e-6)
    (prediction,) = found.predictions
    X = design(prediction.times)
    bands = np.sqrt(np.einsum("ki,ij,kj->k", X, variance * C, X))
    np.testing.assert_allclose(prediction.output_errors[:, 0], bands, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize(
    ("sigma", "spread", "freedom"),
    [
        (("s", "w"), None, 2 * 6 - 2),  # of as many values
        (("s", SIGMA), None, 4 * 6 - 2),
        (("s", "s"), 0.5, 2 * 6 + 0.5 / 0.5**2 - 2),  # the prior counts as 2 more values
        (("s", SIGMA), 1e-4, np.inf),
    ],
    ids=["two sigmas", "one known", "prior", "prior that says it"],
)
def test_the_noise_is_known_as_well_as_the_sigmas_are(sigma, spread, freedom):
    """The variance of chi-square is that of Satterthwaite's F."""
    both = {"observe": lambda t, x, p: jnp.stack([x[0], x[0]]), "names": ("x", "y")}
    named = {name: sf.Parameter(0.4, scale="log") for name in {*sigma} - {SIGMA}}
    fitted, other = (
        run(times, np.stack([values(times, seed) for seed in seeds], axis=1), sigma, **both)
        for times, seeds in ((TRAIN, (0, 1)), (TEST, (2, 3)))
    )
    fit = sf.estimate(pose(fitted, **named))
    if spread is not None:
        prior = sf.LogNormal(fit.parameters["s"], spread)
        fit = sf.estimate(pose(fitted, s=sf.Parameter(0.4, scale="log", prior=prior)))
    found = fit.validate(other)
    assert min(found.noise_freedom, 1e6) == pytest.approx(min(freedom, 1e6), rel=0.01)
    assert f"F with 62 and {found.noise_freedom:.4g}" in str(found)


def test_a_sigma_that_is_estimated_from_the_other_run_tests_nothing():
    other = pose(run(TEST, values(TEST, 1), "s"), s=sf.Parameter(0.5, scale="log"))
    assert np.isnan(fit_line().validate(other).chi_square)
    assert fit_line().validate(other, refit=()).noise_freedom == np.inf


def test_the_table_allows_for_correlated_residuals():
    """Of the fit: its parameters' errors are as wide as in its own table."""
    times = np.linspace(0.0, 5.0, 201)[1:]
    red = scipy.signal.lfilter([1.0], [1.0, -0.8], SIGMA * np.random.default_rng(4).standard_normal(200))
    fit = sf.estimate(pose(run(times, design(times) @ [1.2, -0.4] + red, None)))
    found = fit.validate(run(TEST, values(TEST, 1), None))
    np.testing.assert_allclose(found.corrected_standard_errors, fit.corrected_standard_errors, rtol=1e-6)
    assert np.all(found.corrected_standard_errors > 1.5 * found.standard_errors)
    assert format_rounded(found.theta[0], found.corrected_standard_errors[0])[1] in str(found)
    written = [entry["standard_error"] for entry in summarize_validation(found)["unknowns"]]
    np.testing.assert_array_equal(written, found.corrected_standard_errors)


@pytest.mark.parametrize("prior", [None, sf.Normal(0.5, 0.1)], ids=["no prior", "prior"])
def test_own_unknowns_are_estimated_and_cost_a_degree_of_freedom(prior):
    """The initial state of the other run: chi-square is that of generalized least squares, which does not use M.

    A prior counts as a measurement.
    """
    fit, y, n = fit_line(), values(TEST, 2, shift=0.8), len(TEST)
    found = fit.validate(run(TEST, y, initial_state=[sf.Parameter(0.0, prior=prior)]))
    p, C, _ = by_hand()
    r, X, G = y - design(TEST) @ p, design(TEST), np.ones((n, 1))
    if prior is None:
        Z, z, H = X / SIGMA, r / SIGMA, G / SIGMA
    else:
        Z, z, H = np.vstack([X / SIGMA, np.zeros(2)]), np.append(r / SIGMA, 5.0), np.vstack([G / SIGMA, [10.0]])
    W = np.linalg.inv(np.eye(len(z)) + Z @ (SIGMA**2 * C) @ Z.T)
    expected = z @ (W - W @ H @ np.linalg.inv(H.T @ W @ H) @ H.T @ W) @ z
    assert found.chi_square == pytest.approx(expected, rel=1e-6)
    assert found.freedom == len(z) - 1
    assert found.theta_names == ("a", "b", "x(t0)")
    np.testing.assert_allclose(found.theta[:2], p, rtol=1e-6)
    if prior is None:
        assert found.theta[2] == pytest.approx(r.mean(), rel=1e-6)
        u = X.mean(axis=0)  # x(t0) = mean (y - X p), so that it follows dp by -u
        assert found.covariance[2, 2] == pytest.approx(SIGMA**2 * (1 / n + u @ C @ u), rel=1e-6)
        np.testing.assert_allclose(found.covariance[2, :2], -(SIGMA**2) * u @ C, rtol=1e-6)


def test_residuals_are_tested_without_the_error_of_the_parameters_that_they_share():
    fit = fit_line(seed=5)
    times = np.linspace(0.1, 5.0, 200)
    found = fit.validate(run(times, values(times, 7)))
    raw = found.comparisons[0][0].residuals[:, 0]
    assert raw[1:] @ raw[:-1] / (raw @ raw) > 0.3
    assert abs(found.residuals.channels[0].correlation) < 0.2
    assert found.verdict.level == "good"


def test_the_transition_time_of_another_day_is_estimated_and_the_parameters_stay(heater):
    times = np.linspace(0.25, 5.0, 20)
    y = approach(times, [1.4], (0.4, 0.4), (25.0, 0.0), start=0.0) + 0.2 * np.random.default_rng(4).normal(size=20)
    found = heater.validate(sf.Measurements(times, y))
    assert found.theta_names == ("tau_1", "k")
    assert found.theta[1] == heater.theta[1]
    assert abs(found.theta[0] - 1.4) < 4 * found.standard_errors[0]
    assert found.standard_errors[0] > found.refit.standard_errors[0]  # it contains the error of k
    np.testing.assert_array_equal(found.comparisons[0][0].sigma, 0.2)
    same = heater.validate(sf.Experiment(sf.Measurements(times, y, sigma=0.2), ("on", "off"), (2.0,), 0.0, 5.0))
    assert same.chi_square == pytest.approx(found.chi_square, rel=1e-6)
    (line,) = (line for line in str(found).splitlines() if line.startswith("  tau_1"))
    assert line.endswith("estimated from this run")
    held = heater.validate(sf.Measurements(times, y), refit=())
    assert held.theta[0] == heater.theta[0]
    assert (held.refit, held.freedom, held.verdict.level) == (None, 20, "bad")


def test_a_problem_brings_parameters_of_its_own():
    """Another scale and offset of the sensor, which the fit has not; they are refitted as a whole."""
    fit, y = fit_line(), values(TEST, 3, shift=0.5)
    other = pose(run(TEST, y, observe=lambda t, x, p: p["gain"][0] * x + p["gain"][1]), gain=[1.0, 0.0])
    found = fit.validate(other)
    np.testing.assert_allclose(found.theta[:2], fit.theta, rtol=1e-12)
    predicted = np.stack([design(TEST) @ by_hand()[0], np.ones(len(TEST))], axis=1)
    np.testing.assert_allclose(found.theta[2:], np.linalg.lstsq(predicted, y, rcond=None)[0], rtol=1e-5)
    assert found.freedom == len(TEST) - 2
    np.testing.assert_array_equal(fit.validate(other, refit=()).theta[2:], [1.0, 0.0])
    np.testing.assert_array_equal(fit.validate(other, refit=("gain[0]", "gain[1]")).theta, found.theta)
    with pytest.raises(ValueError, match="the entries of 'gain' are estimated all together, or none of them"):
        fit.validate(other, refit=("gain[0]",))


def test_a_log_is_read_by_the_names_of_the_channels():
    fit, y = fit_line(), values(TEST, 1)
    log = sf.Log(TEST, {"x": y, "other": 0.0 * y}, {}, "s", "log")
    assert fit.validate(log).chi_square == pytest.approx(fit.validate(run(TEST, y)).chi_square, rel=1e-6)
    with pytest.raises(ValueError, match="the log has no column x; it has y"):
        fit.validate(sf.Log(TEST, {"y": y}, {}, "s", "log"))
    with pytest.raises(ValueError, match="the channels of the fit have no names"):
        sf.estimate(pose(run(TRAIN, values(TRAIN, 0), names=None))).validate(log)


def driven(missing):
    """A fit and another run of a system with an input, which the model may miss in part."""
    system = sf.HybridSystem({"m": lambda t, x, p, u: p["a"] * u - x}, [0.0])
    times, knots, rng = np.linspace(0.1, 20.0, 200), np.arange(0.0, 20.0, 0.5), np.random.default_rng(0)

    def build(y, u, a):
        data = sf.Measurements(times, y, sigma=0.05)
        return sf.Problem(system, sf.Experiment(data, ("m",), (), 0.0, 20.0, inputs=sf.Input(knots, u)), {"a": a})

    problems = []
    for seed in (1, 2):
        u = np.random.default_rng(seed).standard_normal(len(knots))
        y = sf.simulate(build(np.zeros(200), u, 1.0), times=times).states[:, 0] + 0.05 * rng.standard_normal(200)
        y += missing * u[np.clip((times / 0.5).astype(int), 0, len(u) - 1)]
        problems.append(build(y, u, 0.8))
    return sf.estimate(problems[0]), problems[1]


def test_residuals_that_depend_on_the_input_are_found():
    fit, other = driven(0.0)
    found = fit.validate(other)
    assert found.verdict.level == "good"
    assert [(test.channel, test.input) for test in found.inputs] == [("x1", "u")]
    assert found.inputs[0].probability > 1e-3
    fit, other = driven(0.06)
    found = fit.validate(other)
    assert found.inputs[0].probability < 1e-6
    assert any(reason.kind == "input not explained" for reason in found.verdict.reasons)
    assert "Correlation with inputs" in str(found)
    with pytest.raises(ValueError, match=r"inputs, or other data than .*: give validate an sf\.Experiment"):
        fit.validate(other.experiments[0].data[0])


def test_the_test_of_inputs_is_that_of_a_regression():
    rng = np.random.default_rng(0)
    z, u, lags = rng.standard_normal(60), rng.standard_normal(60), 4
    Phi = np.stack([u[lags - k : 60 - k] for k in range(lags + 1)], axis=1)
    Phi -= Phi.mean(axis=0)
    inner = z[lags:]
    explained = inner @ Phi @ np.linalg.lstsq(Phi, inner, rcond=None)[0] / (inner @ inner)
    assert correlate(z, u, lags) == pytest.approx(scipy.stats.chi2.sf(56 * explained, lags + 1), rel=1e-9)
    assert np.isnan(correlate(z, np.ones(60), lags))
    assert np.isnan(correlate(z[:10], u[:10], lags))
    shares = [correlate(*rng.standard_normal((2, 100)), 5) < 0.1 for _ in range(1000)]
    assert 0.07 < np.mean(shares) < 0.13


def test_without_a_noise_level_there_is_no_chi_square():
    fit = fit_line()
    found = fit.validate(pose(run(TEST, values(TEST, 1), None)))
    assert np.isnan(found.chi_square)
    assert found.predictions == ()
    found.plot().draw_without_rendering()
    r = values(TEST, 1) - design(TEST) @ by_hand()[0]
    assert found.explained == pytest.approx(1 - r @ r / len(r) / values(TEST, 1).var(), rel=1e-6)
    assert "chi²" not in str(found)


def test_what_cannot_be_validated():
    one, y = fit_line(), values(TEST, 1)
    data = sf.Measurements(TEST, y)
    two = sf.Measurements(TEST, np.zeros((len(TEST), 2)), observe=lambda t, x, p: jnp.stack([x[0], x[0]]))
    both = sf.estimate(pose([run(TRAIN, values(TRAIN, s)) for s in (0, 1)]))
    each = sf.estimate(pose(run(TRAIN, values(TRAIN, 0), np.full((len(TRAIN), 1), SIGMA))))
    own = run(TEST, y, initial_state=[sf.Parameter(0.0)])
    for call, error, said in (
        (lambda: one.validate(3), TypeError, r"validate needs another run: an sf.Experiment.*got 3"),
        (lambda: one.validate(own, refit=("b",)), ValueError, r"refit names 'b', which is no unknown of the other run"),
        (lambda: one.validate(two), ValueError, "of the fit have 1 channels, those of the other run 2"),
        (lambda: one.validate([data] * 2), ValueError, "the fit has 1 Measurements; got 2 for the other run"),
        (lambda: both.validate(data), ValueError, "the fit has several experiments, inputs, or other data"),
        (lambda: each.validate(data), ValueError, "sigma differs from sample to sample in the fit"),
    ):
        with pytest.raises(error, match=said):
            call()


def test_a_transition_at_which_the_vector_field_does_not_jump_has_the_error_of_the_exact_hessian():
    """A block that slides until its speed is zero: to first order, the data do not depend on when it rests."""
    system = sf.HybridSystem({"slide": lambda t, x, p: p["v"] - t + 0.0 * x, "rest": lambda t, x, p: 0.0 * x}, [0.0])
    times = np.linspace(0.03, 2.0, 40)
    exact, runs = np.minimum(times, 1.0) - np.minimum(times, 1.0) ** 2 / 2, []
    for seed in (1, 2):
        data = sf.Measurements(times, exact + 0.003 * np.random.default_rng(seed).standard_normal(40), sigma=0.003)
        runs.append(sf.Experiment(data, ("slide", "rest"), (0.95,), 0.0, 2.0))
    found = sf.estimate(sf.Problem(system, runs[0], {"v": 1.1})).validate(runs[1])
    assert found.theta_names == ("tau_1", "v")
    assert found.standard_errors[0] >= found.refit.standard_errors[0] * (1 - 1e-9)
    assert found.refit.standard_errors[0] > 0.005


def test_a_run_with_as_many_own_unknowns_as_values_tests_nothing(heater):
    one = sf.Measurements([4.0], [8.3], sigma=0.2)
    found = heater.validate(sf.Experiment(one, ("on", "off"), (2.0,), 0.0, 6.0))
    assert (found.freedom, found.explained) == (0, pytest.approx(1.0, abs=1e-6))
    assert found.verdict.level == "doubtful"
    assert "so that nothing is left to test" in str(found.verdict)
    assert {reason.kind for reason in found.verdict.reasons} == {"nothing left to test", "predicts"}
    kept = heater.validate(sf.Experiment(one, ("on", "off"), (2.46,), 0.0, 6.0), refit=())
    assert (kept.freedom, kept.verdict.level) == (1, "good")


def test_another_log_with_dates():
    """Its dates are counted from the origin of the fit; where t0 is a date, that of another day is not known."""
    base = heater_problem()
    log = base.experiments[0].data[0]

    def build(day, **given):
        days = np.datetime64(f"2024-03-{day:02}T00:00", "ns")
        return sf.Measurements(days + np.round(log.times * 3.6e12).astype("timedelta64[ns]"), log.values, **given)

    def fit(**ends):
        run = sf.Experiment(build(1, sigma=0.2), ("on", "off"), ("2024-03-01T02:00",), time_unit="h", **ends)
        return sf.estimate(sf.Problem(base.system, run, base.parameters))

    dated = fit(t0="2024-03-01T00:00", tf="2024-03-01T06:00")
    numbers = dated.validate(sf.Measurements(log.times, log.values))
    assert dated.validate(build(1)).chi_square == pytest.approx(numbers.chi_square, rel=1e-9)
    with pytest.raises(ValueError, match=r"begins at 2024-03-05T00:15:00, after .* 2024-03-01 06:00.*: give validate"):
        dated.validate(build(5))
    with pytest.raises(ValueError, match="the other log has dates, and the times of the fit are numbers: give valid"):
        sf.estimate(base).validate(build(1))
    found = fit()
    other = found.validate(build(5))
    assert other.problem.experiments[0].t0 == pytest.approx(96.0, abs=1e-9)
    assert other.theta[0] - 96.0 == pytest.approx(found.theta[0], abs=1e-3)
