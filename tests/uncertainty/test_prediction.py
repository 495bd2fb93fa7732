"""Sensitivities and bands: closed forms, finite differences, Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

import switchfit as sf
from support import models
from support.models import heated_room
from switchfit.meshes.evaluator import evaluator_of
from switchfit.uncertainty.sample_derivatives import build_gauss_newton, collect_sample_derivatives
from switchfit.uncertainty.sensitivity import compute_sensitivity

SIGMA = 0.1
TIMES = np.linspace(0.25, 6.0, 24)


ROOM = heated_room(0.5)
JUMPING = heated_room(0.5, reset_maps={("on", "off"): lambda t, x, p: 2.0 * x + p["power"]})


def temperature(t, tau, power, k, *, jump=False):
    """The closed form; after a jump at tau x becomes 2 x + power."""
    x = models.temperature(t, tau, power, k, start=0.5)
    at_tau = models.temperature(tau, tau, power, k, start=0.5)
    return np.where(t <= tau, x, x * (2.0 * at_tau + power) / at_tau) if jump else x


def slopes(t, tau, power, k, *, jump=False):
    """Its derivatives in (tau, power, k) by central differences, with tau not among t."""
    columns = []
    for j in range(3):
        step = np.zeros(3)
        step[j] = 1e-6
        up, down = (temperature(t, *(np.array([tau, power, k]) + s * step), jump=jump) for s in (1, -1))
        columns.append((up - down) / 2e-6)
    return np.stack(columns, axis=1)


def room(values=0.0 * TIMES, *, system=ROOM, sigma=SIGMA):
    data = sf.Measurements(TIMES, values, sigma=sigma, names=("T",))
    return models.one_run(system, data, ("on", "off"), (2.1,), 6.0, {"power": 1.0, "k": 0.4}, rtol=1e-11, atol=1e-13)


def noisy(sigma=SIGMA):
    values = temperature(TIMES, 2.1, 1.0, 0.4) + SIGMA * np.random.default_rng(0).standard_normal(24)
    return sf.estimate(room(values, sigma=sigma))


@pytest.fixture(scope="module")
def fitted():
    return noisy()


def errors_of(times, theta, covariance, **settings):
    """Standard errors of the temperature by linear propagation."""
    X = slopes(times, *theta, **settings)
    return np.sqrt(np.einsum("ki,ij,kj->k", X, covariance, X))


# Sensitivities


@pytest.mark.parametrize("jump", [False, True], ids=["continuous", "reset map"])
def test_sensitivities_in_closed_form(jump):
    problem = room(system=JUMPING if jump else ROOM)
    theta = np.array([2.13, 1.1, 0.37])
    found = compute_sensitivity(problem, 0, theta, evaluator_of(problem).meshes[0]).nodes
    away = np.abs(found.times - theta[0]) > 1e-5
    assert away.sum() > 20
    np.testing.assert_allclose(found.states[:, 0][away], temperature(found.times, *theta, jump=jump)[away], rtol=1e-8)
    expected = slopes(found.times, *theta, jump=jump)
    np.testing.assert_allclose(found.states_d[away][:, 0], expected[away], atol=1e-7)


def test_at_a_transition_the_derivative_jumps_by_that_of_the_vector_field():
    problem = room()
    tau, power, k = theta = np.array([2.13, 1.1, 0.37])
    found = compute_sensitivity(problem, 0, theta, evaluator_of(problem).meshes[0]).nodes
    before, after = np.flatnonzero(found.times == tau)
    x = found.states[before, 0]
    assert found.states_d[before, 0, 0] == pytest.approx(0.0, abs=1e-14)
    assert found.states_d[after, 0, 0] == pytest.approx((power - k * x) - (-k * x), rel=1e-12)  # X of equation (8)
    np.testing.assert_allclose(found.states_d[before, 0, 1:], found.states_d[after, 0, 1:], rtol=1e-12)


@pytest.mark.parametrize(
    "loss", [*(pytest.param(loss, marks=pytest.mark.slow) for loss in ("linear", "huber", "cauchy")), "soft_l1"]
)
def test_gauss_newton_matrix_with_sigmas_to_estimate_robust_losses_and_priors_is_that_of_the_engine(loss):
    """Two channels that share a sigma in one run, a sigma that is another one's in the other run, one that is fixed."""
    values = temperature(TIMES, 2.1, 1.0, 0.4)[:, None] + np.array([0.2, -0.1]) * np.sin(7 * TIMES)[:, None]
    values[3, 1] = values[5, 0] = np.nan
    robust = {"loss": loss, "loss_scale": 1.2}
    both = sf.Measurements(TIMES, values, observe=lambda t, x, p: [x[0], x[0] ** 2], sigma=["s", "s"], **robust)
    mixed = sf.Measurements(TIMES, values[:, :1], sigma=["s"], **robust)
    held = sf.Measurements(TIMES, values, observe=lambda t, x, p: [x[0], x[0] * p["k"]], sigma=["held", 0.2], **robust)
    late = sf.Parameter(2.2, prior=sf.Normal(2.0, 0.1))
    runs = [
        sf.Experiment([both, held], ("on", "off"), (2.0,), 0.0, 6.0),
        sf.Experiment([mixed, held], ("on", "off"), (late,), 0.0, 6.0, parameter_map={"s": "other"}),
    ]
    parameters = {
        "power": 1.0,
        "k": sf.Parameter(0.4, scale="log", prior=sf.LogNormal(0.5, 0.3)),
        "s": sf.Parameter(0.15, lower=0.01),
        "other": sf.Parameter(0.3, scale="log"),
        "held": sf.Parameter(0.1, fixed=True),
    }
    problem = sf.Problem(ROOM, runs, parameters)
    theta = problem.initial_theta
    evaluator = evaluator_of(problem)
    found = [compute_sensitivity(problem, e, theta, mesh) for e, mesh in enumerate(evaluator.meshes)]
    built = build_gauss_newton(problem, theta, collect_sample_derivatives(problem, found))
    expected = evaluator(theta, matrix="gauss-newton").hessian
    np.testing.assert_allclose(built, expected, atol=1e-12 * np.abs(expected).max())


# Bands


@pytest.mark.parametrize("known", [True, False], ids=["sigma known", "sigma unknown"])
def test_bands_in_closed_form(known):
    """Inside the data, and after them, where the last mode goes on."""
    fit = noisy(SIGMA if known else None)
    times = np.array([0.0, 0.33, 1.0, 2.5, 3.333, 6.0, 6.5, 9.0, 20.0])
    found = fit.predict(times)
    errors = errors_of(times, fit.theta, fit.covariance)
    np.testing.assert_allclose(found.states[:, 0], temperature(times, *fit.theta), rtol=1e-8)
    np.testing.assert_allclose(found.state_errors[:, 0], errors, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(found.output_errors[:, 0], errors, rtol=1e-5, atol=1e-9)
    noise = SIGMA if known else np.sqrt(fit.residual_variance)
    np.testing.assert_allclose(found.noise, noise, rtol=1e-12)
    half = fit.quantile(0.9) * np.sqrt(errors**2 + noise**2)
    band = found.prediction_band(0.9)[:, 0]
    np.testing.assert_allclose(band, found.outputs + np.stack([-half, half], axis=1), rtol=1e-6)
    inner = found.output_band(0.9)[:, 0]
    np.testing.assert_allclose(inner[:, 1] - inner[:, 0], 2 * fit.quantile(0.9) * errors, rtol=1e-5, atol=1e-9)
    np.testing.assert_array_equal(found.state_band(0.9)[:, 0], inner)


def fit_correlated(seed, correlation=0.6, count=600):
    """The room at 100 samples an hour; the noise is autoregressive, of first order."""
    times = np.arange(1, count + 1) * 6.0 / count
    shocks = SIGMA * np.sqrt(1 - correlation**2) * np.random.default_rng(seed).standard_normal(count + 100)
    noise = scipy.signal.lfilter([1.0], [1.0, -correlation], shocks)[100:]
    data = sf.Measurements(times, temperature(times, 2.1, 1.0, 0.4) + noise, sigma=SIGMA)
    run = sf.Experiment(data, ("on", "off"), (2.2,), 0.0, 6.0)
    return sf.estimate(sf.Problem(ROOM, run, {"power": 1.0, "k": 0.4}), strategy="local")


def test_bands_allow_for_correlated_residuals_as_the_table_does(fitted):
    fit = fit_correlated(0)
    factor = fit.corrected_standard_errors / fit.standard_errors
    assert factor == pytest.approx(2.0, rel=0.2)  # sqrt((1 + r) / (1 - r))
    np.testing.assert_allclose(fit.corrected_covariance, factor[0] ** 2 * fit.covariance, rtol=1e-12)
    times = np.array([1.0, 4.0])
    found = fit.predict(times)
    errors = factor[0] * errors_of(times, fit.theta, fit.covariance)
    np.testing.assert_allclose(found.output_errors[:, 0], errors, rtol=1e-5)
    np.testing.assert_allclose(found.state_errors, found.output_errors)
    assert found.corrected
    again = fit.validate(fit.problem).predictions[0]
    np.testing.assert_allclose(np.interp(times, again.times, again.output_errors[:, 0]), errors, rtol=0.01)
    assert (found.corrected, fitted.predict(times).corrected) == (True, False)


def test_the_noise_of_a_sample_is_that_of_the_nearest():
    sigma = np.where(TIMES < 3.0, 0.1, 0.4)[:, None]
    np.testing.assert_array_equal(noisy(sigma).predict([0.0, 2.7, 2.9, 6.0]).noise[:, 0], [0.1, 0.1, 0.4, 0.4])


def test_what_cannot_be_predicted(fitted):
    few = sf.Experiment(sf.Measurements(TIMES[[1, 20]], np.array([0.7, 0.8])), ("on", "off"), (2.1,), 0.0, 6.0)
    without = sf.estimate(sf.Problem(ROOM, few, {"power": 1.0, "k": sf.Parameter(0.4, fixed=True)}))
    free_end = sf.Parameter(7.0, 6.5, 8.0, prior=sf.Normal(7.0, 0.1))
    line = sf.HybridSystem({"on": lambda t, x, p: p["power"] + 0.0 * x}, [0.0])
    timed = sf.Experiment(sf.Measurements(TIMES, TIMES, sigma=SIGMA), ("on",), (), 0.0, free_end)
    ends = sf.estimate(sf.Problem(line, timed, {"power": 1.1}))
    for fit, settings, error, said in (
        (fitted, {"times": [1.0, -0.5]}, ValueError, r"times must not lie before t0 = 0.0 s, .*; got -0.5"),
        (fitted, {"times": [np.nan]}, ValueError, "times must be finite numbers of shape"),
        (fitted, {"experiment": 1}, ValueError, r"experiment must lie in 0..0; got 1"),
        (fitted.problem, {}, TypeError, r"must be what sf.estimate returns: .*; got Problem"),
        (without, {}, ValueError, "There are no bands without a covariance"),
        (ends, {"times": [9.0]}, ValueError, r"times must not lie after tf where tf is estimated.*; got 9"),
    ):
        with pytest.raises(error, match=said):
            sf.predict(fit, **settings)


# Beyond tf


def test_a_time_near_the_largest_float_is_reached_by_implicit_steps(fitted):
    found = fitted.predict([1.0, 1.7e308])
    assert abs(found.outputs[1, 0]) < 1e-8
    assert found.output_errors[1, 0] < 1e-8


def test_after_tf_a_held_input_keeps_its_last_value_and_any_other_must_be_known():
    def fit(kind):
        inputs = sf.Input(np.arange(7.0), np.ones(7), kind=kind)
        system = sf.HybridSystem({"on": lambda t, x, p, u: -p["k"] * x + u}, [0.0])
        data = sf.Measurements(TIMES, 2.5 * (1 - np.exp(-0.4 * TIMES)), sigma=SIGMA)
        return sf.estimate(models.one_run(system, data, ("on",), (), 6.0, {"k": 0.3}, inputs=inputs))

    assert fit("hold").predict([9.0]).outputs[0, 0] == pytest.approx(2.5 * (1 - np.exp(-3.6)), rel=1e-6)
    with pytest.raises(ValueError, match="Input must be known"):
        fit("linear").predict([9.0])


def test_bands_in_the_figure_with_each_transition_twice(fitted):
    found, (panel, residuals) = fitted.predict(), fitted.plot().axes
    assert np.sum(found.times == fitted.theta[0]) == 2
    assert len(panel.collections) == len(residuals.collections) == 2
    top = max(path.vertices[:, 1].max() for path in panel.collections[1].get_paths())
    assert top == pytest.approx(found.output_band().max(), rel=1e-9)
    for without in (fitted.plot(bands=False), replace(fitted, problem=None).plot()):
        assert not without.axes[0].collections


@pytest.mark.parametrize("delay", [0.25, "late"])
def test_bands_and_sigma_of_a_late_sensor_are_at_its_stamps(delay):
    sigma, late = np.where(TIMES < 3.1, 0.1, 0.2)[:, None], {"late": sf.Parameter(0.2, lower=0.0, upper=0.25)}
    data = sf.Measurements(TIMES, temperature(TIMES - 0.25, 2.1, 1.0, 0.4), sigma=sigma, names=("T",), delay=delay)
    run = sf.Experiment(data, ("on", "off"), (2.1,), 0.0, 6.0)
    fit = sf.estimate(sf.Problem(ROOM, run, {"power": 1.0, "k": 0.4} | (late if delay == "late" else {})))
    assert fit.predict([2.9]).noise.tolist() == [[0.2]]  # the sample nearest to 3.15
    for figure in (fit.plot(), fit.predict().plot()):
        curve = next(line for line in figure.axes[0].lines if line.get_label() in {"fitted", "predicted"})
        for band in figure.axes[0].collections:
            begin = band.get_datalim(figure.axes[0].transData).x0
            assert begin == pytest.approx(0.25, rel=1e-3) == curve.get_xdata()[0]
