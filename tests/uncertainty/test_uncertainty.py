"""Both covariances, identifiability in words, tests of the residuals, the certificate; and slowly, coverage."""

import re
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from scipy.integrate import quad

import switchfit as sf
from benchmarks import vehicle_coverage
from support.fits_by_hand import comparison_of, made, trajectory_of, warnings_of
from support.fits_by_hand import write_report as report
from support.models import STILL, VEHICLE_TRUTH, curve, drive, one_run, positions, simulate_log
from switchfit.engine.evaluation import Evaluation
from switchfit.fit.kink_variance import free_kinks, measure_kink_variance
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.models import heater_problem, lugre
from switchfit.optimize import Status
from switchfit.uncertainty.certificate import certify
from switchfit.uncertainty.covariance_comparison import disagreement
from switchfit.uncertainty.derivative_check import LARGEST_GAP, measure_derivative_gap
from switchfit.uncertainty.identification import Identifiability, analyse
from switchfit.uncertainty.residuals import correct_correlation, diagnose_channel

TIMES = np.linspace(0.25, 6.0, 24)


def observed(h, values, parameters, sigma, times=TIMES):
    return curve(h, times, values, parameters, sigma=sigma, tf=6.0)


def decay(t, x, p):
    return jnp.array([p["a"] * jnp.exp(-p["k"] * t)])


def noisy_decay(sigma, seed=0, **changes):
    values = np.exp(-0.5 * TIMES) + sigma * np.random.default_rng(seed).standard_normal(24)
    return observed(decay, values, {"a": 1.0, "k": 0.5}, sigma, **changes)


def one_line(result) -> str:
    """What is printed of a result, without its line breaks."""
    return " ".join(str(result).split())


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


# Identifiability


def test_a_trade_off_in_words_with_its_size_and_what_was_found():
    """y = (a + b) + 0.01 (a - b) t / 6: only the sum is well determined. Only the side that is allowed is tried."""

    def h(t, x, p):
        return jnp.array([p["a"] + p["b"] + 0.01 * (p["a"] - p["b"]) * t])

    problem = observed(h, 30.0 + 0.0 * TIMES, {"a": sf.Parameter(10.0, unit="m"), "b": 20.0}, 0.1)
    for found in (sf.identifiability(problem), sf.estimate(problem).identifiability):
        (direction,) = found.directions
        assert direction.summary in ("a and b trade off", "b and a trade off")
        assert np.sign(direction.change[0]) == -np.sign(direction.change[1])
        assert direction.rises == pytest.approx((found.rise, found.rise), rel=1e-6)  # the model is linear
        assert found.rise == pytest.approx(0.5 * scipy.stats.chi2.ppf(0.95, 1), rel=1e-9)
        moved = f"a {abs(direction.change[0]):.2g} m {'higher' if direction.change[0] > 0 else 'lower'}"
        assert moved in one_line(found)
        assert "or the opposite, raises J by 1.9; noise hides 1.9 (95 %)" in one_line(found)
    evaluate = evaluator_of(problem)
    theta = sf.estimate(problem).theta
    rise = evaluate(theta + direction.change).cost - evaluate(theta).cost
    assert direction.rises[0] == pytest.approx(rise, rel=1e-6)
    held = {"a": sf.Parameter(0.0, lower=0.0), "b": 1.0}
    (direction,) = sf.identifiability(observed(h, 1.0 + 0.0 * TIMES, held, 0.1)).directions
    assert np.isfinite(direction.rises).tolist() == [direction.change[0] >= 0, direction.change[0] < 0]


def test_a_singular_hessian_and_unknowns_without_effect():
    def h(t, x, p):
        return jnp.array([p["a"] * p["b"] * t + 0.0 * p["c"]])

    problem = observed(h, 2.0 * TIMES, {"a": 1.0, "b": 2.0, "c": 3.0}, 0.1)
    for found in (sf.identifiability(problem), sf.identifiability(sf.estimate(problem))):
        assert found.without == ("c",)
        assert found.undetermined == 2
        assert set(found.directions[0].names) == {"a", "b"}
        assert "the cost does not depend on c" in one_line(found)
        assert "do not determine 1 combination of the 3 unknowns" in one_line(found)


def test_twenty_unknowns_over_eight_decades():
    """A quadratic cost: the planted pair is found and named whatever the units of the unknowns are."""
    d = 20
    rng = np.random.default_rng(1)
    size = 10.0 ** rng.uniform(-4, 4, d)
    H = np.eye(d)
    H[4, 11] = H[11, 4] = 0.9999
    H = H / np.outer(size, size)
    theta = 3.0 * size
    names = tuple(f"p{k}" for k in range(d))

    def cost(at):
        return 0.5 * float((at - theta) @ H @ (at - theta))

    about = Identifiability(names, ("",) * d, np.zeros(d, bool), 0.02, "1 % of J", "solution", np.nan)
    found = analyse(about, H, np.eye(d), theta, cost)
    np.testing.assert_allclose(found.eigenvalues[[0, -1]], [1e-4, 1.9999], rtol=1e-6)
    (direction,) = found.directions
    assert set(direction.summary.removesuffix(" trade off").split(" and ")) == {"p4", "p11"}
    assert np.flatnonzero(np.abs(direction.weights) > 1e-6).tolist() == [4, 11]
    # No unknown moves by more than its own size, so that J rises by less than asked for.
    assert np.max(np.abs(direction.change / theta)) <= 1.0 + 1e-12
    assert direction.rises[0] == pytest.approx(cost(theta + direction.change), rel=1e-9)


def test_where_the_valley_bends_the_change_is_shortened():
    H = np.array([[1.0, 0.99], [0.99, 1.0]])

    about = Identifiability(("a", "b"), ("", ""), np.zeros(2, bool), 1.0, "1 % of J", "solution", 100.0)
    found = analyse(about, H, np.eye(2), np.zeros(2), lambda at: 0.5 * at @ H @ at + 10.0 * (at[0] - at[1]) ** 4)
    (direction,) = found.directions
    assert max(direction.rises) <= 2.0
    quadratic = 0.5 * direction.change @ H @ direction.change
    assert quadratic < 0.5
    assert f"raises J by {max(direction.rises):.2g} ({max(direction.rises):.2g} %); 1 % of J is 1" in one_line(found)
    rounded = replace(found, directions=(replace(direction, rises=(-3e-13, -4e-13)),))
    assert "raises J by 0 (0 %)" in one_line(rounded)


def test_before_a_fit_without_sigma_and_without_measurements():
    samples = sf.Measurements(TIMES, 0.0 * TIMES, observe=decay)
    signal = sf.ReferenceSignal.from_samples(TIMES, np.exp(-0.4 * TIMES), observe=decay)
    for data, t0, said in (
        (samples, 0.0, "a change of all that is measured by 1 % of how it varies does"),
        (signal, 0.25, "1 % of J is"),
    ):
        run = sf.Experiment(data, ("still",), (), t0, 6.0)
        assert said in one_line(sf.identifiability(sf.Problem(STILL, run, {"a": 1.0, "k": 0.5})))


# Residuals


def diagnostics_of(residual, sigma=0.1):
    trajectory = trajectory_of()
    comparison = comparison_of(trajectory, samples=len(residual), names=("X", "h"), sigma=sigma)
    comparison.measured[:] = comparison.fitted + np.asarray(residual)[:, None]
    return comparison


def test_residuals_against_scipy_and_the_textbook():
    rng = np.random.default_rng(0)
    residual = 0.1 * rng.standard_normal(200)
    found = diagnose_channel(diagnostics_of(residual), 0)
    z = residual / 0.1
    r = [np.sum(z[k:] * z[:-k]) / np.sum(z**2) for k in range(1, 11)]
    np.testing.assert_allclose(found.autocorrelation, r, rtol=1e-9)
    Q = 200 * 202 * sum(value**2 / (200 - k) for k, value in enumerate(r, start=1))
    assert found.whiteness == pytest.approx(scipy.stats.chi2.sf(Q, 10), rel=1e-9)
    assert found.rms == pytest.approx(np.sqrt(np.mean(z**2)), rel=1e-12)
    assert found.white


def test_correlated_residuals_are_worth_fewer():
    shocks = 0.08 * np.random.default_rng(2).standard_normal(2000)
    residual = scipy.signal.lfilter([1.0], [1.0, -0.6], shocks)
    found = diagnose_channel(diagnostics_of(residual), 0)
    assert not found.white
    assert found.correlation == pytest.approx(0.6, abs=0.05)
    assert found.effective == pytest.approx(2000 * 0.4 / 1.6, rel=0.15)
    (warning,) = warnings_of(made(comparisons=((diagnostics_of(residual),),), cost=2000.0, sigma_known=False))
    assert f"too small by a factor of up to {found.narrowing:.2g}." in warning


@pytest.mark.parametrize(("r", "d"), [(0.5, 1), (0.8, 1), (0.8, 3), (0.6, 5)])
def test_the_correlation_of_noise_follows_from_that_of_residuals(r, d):
    """Of polynomials fitted to noise of a first-order process: without its bias to a fifth of it."""
    n, runs = 200, 3000
    shocks = np.random.default_rng(d).standard_normal((runs, n + 100))
    noise = scipy.signal.lfilter([1.0], [1.0, -r], shocks, axis=1)[:, 100:]
    basis = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, n), d - 1))[0]
    z = noise - (noise @ basis) @ basis.T
    first = np.sum(z[:, 1:] * z[:, :-1], axis=1) / np.sum(z**2, axis=1)
    bias = r - first.mean()
    assert bias == pytest.approx((3 * r + d * (1 + r)) / n, rel=0.15)
    assert abs(np.mean([correct_correlation(one, n, d) for one in first]) - r) < 0.2 * bias


def test_the_correction_of_the_correlation_keeps_within_limits():
    assert correct_correlation(0.5, 40, 8) == pytest.approx((40 - 9) / (40 + 9)), "worth one value more than unknowns"
    assert correct_correlation(0.95, 40, 8) == 0.95, "never less than that of the residuals"
    assert correct_correlation(-0.1, 40, 8) == -0.1
    assert correct_correlation(1.0, 40, 8) == 0.999
    assert correct_correlation(0.5, 10**6, 3) == pytest.approx(0.5, abs=1e-5)


def test_a_cost_without_measurements_has_no_residuals():
    cost = sf.TerminalCost(lambda x, p: (p["a"] - 1.0) ** 2)
    none = sf.estimate(sf.Problem(STILL, sf.Experiment(cost, ("still",), (), 0.0, 1.0), {"a": 2.0}))
    assert str(none.residuals) == "No residuals: the cost has no Measurements."


def test_a_channel_met_exactly_and_a_short_one():
    exact = diagnose_channel(diagnostics_of(np.zeros(30), sigma=None), 0)
    assert (exact.white, exact.outliers) == (True, 0)
    short = diagnose_channel(diagnostics_of(np.ones(4)), 0)
    assert np.isnan(short.whiteness)


# The certificate


def shift_derivatives(monkeypatch, method, *, gradient=0.0, hessian=0.0):
    """Make the derivatives of one method wrong by a share of each entry."""
    right = Evaluator.__call__

    def evaluate(self, theta, side=1, method_="auto", matrix="exact", **settings):
        asked = settings.get("method", method_)
        found = right(self, theta, side, asked, matrix)
        if asked != method:
            return found
        return Evaluation(found.cost, found.gradient * (1 + gradient), found.hessian * (1 + hessian))

    monkeypatch.setattr(Evaluator, "__call__", evaluate)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"optimality": 1e-3}, "the KKT residual 1.0e-03 is above the tolerance 1.0e-07"),
        ({"hessian": np.diag([1.0, -1.0, 1.0])}, "the Hessian has a negative eigenvalue on the free directions"),
        ({"integration_error": 2e-3}, "the integration error of J is 2.0e-03, relative"),
    ],
)
def test_a_certificate_that_fails_is_the_first_line_of_the_report(changes, words):
    fit = made(**changes)
    certificate = certify(fit, None)
    assert not certificate.passed
    assert any(words in str(failure) for failure in certificate.failures)
    assert words[:30] in " ".join(report(fit).split("\n\n")[0].split())
    assert "FAILED" in str(certificate).splitlines()[-1]
    assert words[:30] not in report(replace(fit, status=Status.MAX_ITERATIONS)).split("\n\n")[0]


@pytest.mark.parametrize(
    ("method", "wrong", "said"),
    [
        ("adjoint", {"gradient": 1e-3}, "the paper's equations differ from the derivatives of J by 1.0e-03"),
        ("adjoint", {"hessian": np.nan}, "the paper's equations differ from the derivatives of J by inf"),
        ("auto", {"gradient": 1e-2}, "FAILED: the derivatives do not belong to the cost."),
        ("auto", {"hessian": 1e-2}, "FAILED: the derivatives do not belong to the cost."),
    ],
)
def test_wrong_derivatives_fail(monkeypatch, method, wrong, said):
    """Those of the paper by a gap that does not close, and overflow is none that is unchecked; the others by Taylor."""
    shift_derivatives(monkeypatch, method, **wrong)
    check = sf.check_derivatives(heater_problem(), paper=method == "adjoint")
    assert len(check.failures) == 1
    assert said in str(check)


@pytest.mark.slow
def test_a_gap_of_unstable_adjoints_is_no_failure():
    """Omega decays twice as fast as the state: at the longest steps that are stable for that, it is not."""
    problem = vehicle_coverage.draw_log(vehicle_coverage.CASES["lugre, force"]())
    check = sf.check_derivatives(problem)
    assert measure_derivative_gap(Evaluator(problem), check.theta)[1] > 1e3
    assert max(check.gradient_gap, check.hessian_gap) < LARGEST_GAP
    assert check.passed, check


def test_unstable_explicit_steps_are_not_called_wrong_derivatives():
    """LuGre friction with the published stiffness, which takes 20,000 explicit steps at the limit of stability."""
    case = vehicle_coverage.CASES["lugre, spring"]()
    system = lugre(k=2.0, sigma_0=1e5, sigma_1=np.sqrt(1e5), v_s=0.001)
    problem = sf.Problem(system, case.problem.experiments, case.problem.parameters, solver="explicit")
    check = sf.check_derivatives(problem, case.theta, paper=False)
    assert [issue.kind for issue in check.failures] == ["cost not continuous"]
    assert "J jumps at this theta or near it" in str(check)
    assert "solver='stiff'" in str(check)


def test_a_comparison_of_an_input_with_an_unknown_is_named_where_derivatives_fail():
    """A dead band: how the time at which the input leaves it moves is left out."""

    def flow(t, x, p, u):
        return p["k"] * jnp.sign(u) * jnp.maximum(jnp.abs(u) - p["w"], 0.0) - 0.3 * x

    knots = [0.0, 0.6, 1.2, 0.3, -0.5, -1.1, -0.4, 0.5, 1.3, 0.9, 0.2, -0.6, -0.2]
    command, times = sf.Input(np.arange(13.0), knots, kind="linear"), np.arange(0.25, 12.0, 0.25)
    data = sf.Measurements(times, 0.7 * np.sin(times), sigma=0.03)
    problem = one_run(sf.HybridSystem({"m": flow}, [0.0]), data, ("m",), (), 12.0, {"w": 0.3, "k": 0.7}, inputs=command)
    check = sf.check_derivatives(problem, paper=False)
    assert [issue.kind for issue in check.failures] == ["hidden switch"]
    assert re.search(r"mode 'm' bends with w at test_uncertainty.py:\d+, and derivatives leave out", str(check))
    assert "hidden switch" in [issue.kind for issue in sf.estimate(problem, strategy="local").certificate.failures]


def test_a_cost_that_is_not_finite_nearby_says_nothing_about_derivatives():
    """x' = p x² ends at t = 1 / p."""
    system = sf.HybridSystem({"m": lambda t, x, p: p["p"] * x**2}, [1.0])
    run = sf.Experiment(sf.TerminalCost(lambda x, p: x[0] ** 2), ("m",), (), 0.0, 1.0)
    check = sf.check_derivatives(sf.Problem(system, run, {"p": 0.999}), paper=False)
    assert [issue.kind for issue in check.failures] == ["cost not finite"]
    assert "not finite at this theta or near it" in str(check)


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


# --- the sandwich covariance ------------------------------------------------------------------------------------------


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
