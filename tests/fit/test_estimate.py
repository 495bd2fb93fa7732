"""estimate(): truth recovered, constraints and kinks named, uncertainties in closed form, all ways to end."""

from dataclasses import replace
from itertools import product
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.optimize
import scipy.stats

import switchfit as sf
from support import models
from support.capacitors import CAPACITOR, GUESS, SIGMA, TIMES, TRUTH, capacitor, noise, refined_fit, run, voltage
from support.models import fit_problem
from switchfit.fit import solved_fit
from switchfit.fit.insignificance import drop_noise_of_times
from switchfit.fit.minimization import minimize_cost
from switchfit.meshes.evaluator import evaluator_of
from switchfit.meshes.follower import Follower
from switchfit.runtime.issue import Issue


def test_truth_from_noisy_samples():
    problem = capacitor(voltage(TIMES) + noise(0))
    found = fit_problem(problem, status=sf.Status.CONVERGED)
    assert np.all(np.abs(found.theta - TRUTH) < 4 * found.standard_errors)
    assert 0.5 < found.residual_variance < 2.0
    assert np.all(found.standard_errors < 0.1)
    # Nothing that is reported is stale: it is all at theta.
    at = sf.evaluate(problem, found.theta)
    assert found.cost == pytest.approx(at.cost, rel=1e-12)
    np.testing.assert_allclose(found.gradient, at.gradient, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.hessian, at.hessian, rtol=1e-9)
    fitted = found.comparisons[0][0].fitted[:, 0]
    np.testing.assert_allclose(fitted, voltage(TIMES, found.theta[0], found.theta[1:]), rtol=0, atol=1e-8)
    assert found.history[-1].theta.tolist() == found.theta.tolist()


def test_a_bound_that_is_reached_is_named():
    """The truth is 2: a rate of 1.6 at most is at its bound, has no error of its own and presses against it."""
    found = sf.estimate(capacitor(voltage(TIMES), k=sf.Parameter(GUESS[1:], upper=[1.6, 5.0])))
    assert found.parameters["k"][0] == 1.6
    (active,) = found.active
    assert (active.kind, active.unknown, active.value) == ("upper bound", "k[0]", 1.6)
    assert active.multiplier == pytest.approx(-found.gradient[1], rel=1e-9)
    assert found.verdict.reasons[-1] == Issue("at bounds", ("k[0]",))
    assert "k[0] at its upper bound 1.6" in found.message
    assert found.gradient[1] < -1.0
    assert found.optimality < 1e-7
    assert (found.standard_errors > 0.0).tolist() == [True, False, True]
    assert "at bounds" not in [reason.kind for reason in replace(found, lower=found.upper).verdict.reasons]


# Kinks


@pytest.mark.parametrize("guess", [0.15, 0.45, 0.7])
def test_a_transition_that_ends_at_a_sample_is_reported_as_a_kink(guess):
    """Later samples pull tau below 0.5 with the force 0.3, and a sample at 0.5 that is far too low pushes it up with
    the force 1, but only while tau is below 0.5."""
    data = sf.Measurements([0.5, 0.8, 1.0], [-1.0, 0.5, 0.6], sigma=1.0)
    found = sf.estimate(sf.Problem(models.LATE_RAMP, sf.Experiment(data, ("wait", "ramp"), (guess,), 0.0, 1.0)))
    assert found.status is sf.Status.CONVERGED_AT_KINK
    (kink,) = found.kinks
    assert (kink.unknown, kink.value, found.theta[0]) == ("tau_1", 0.5, 0.5)
    assert (kink.left, kink.right) == pytest.approx((-0.7, 0.3), rel=1e-9)
    assert "kink of the cost: tau_1 = 0.5, where the derivative jumps from -7.0e-01 to 3.0e-01" in found.message
    assert found.optimality < 1e-12
    # Of exp(-0.7 |x| - x^2) and exp(-0.3 x - x^2).
    assert found.standard_errors[0] == pytest.approx(0.6212692, rel=1e-6)
    assert found.covariance_from("gauss-newton") == pytest.approx(found.covariance)
    assert np.isfinite(found.confidence_intervals(hessian="sandwich")).all()
    assert replace(found, constraints=(("guard", 0.0, 1.0),)).covariance == found.held_covariance == 0.0


@pytest.mark.parametrize("seed", [0, 8])
def test_a_node_that_no_sample_is_taken_at_is_no_kink(seed):
    """Only the sum of the time and of the delay is determined, and samples are of the state at their times less the
    delay: at their times J jumps by integration error alone."""
    system = sf.HybridSystem({"on": lambda t, x, p: p["h"] - p["c"] * x, "off": lambda t, x, p: -p["c"] * x}, [0.0])
    times = np.linspace(1.03, 11.03, 41)
    t, tau = times - 0.4, 6.1
    rise = 2.0 * (1.0 - np.exp(-0.5 * np.minimum(t, tau))) * np.exp(-0.5 * np.maximum(t - tau, 0.0))
    values = 0.5 * np.exp(-0.5 * t) + rise + 0.05 * np.random.default_rng(seed).normal(size=41)
    data = sf.Measurements(times, values, sigma=0.05, delay="d")
    run = sf.Experiment(data, ("on", "off"), (5.0,), t0=0.0, tf=12.0, initial_state=[sf.Parameter(1.0)])
    bounds = {"c": sf.Parameter(0.4, lower=0.01), "d": sf.Parameter(0.2, lower=0.0, upper=0.9)}
    found = sf.estimate(sf.Problem(system, run, {"h": 0.8, **bounds}))
    assert "the data hardly determine" in str(found.verdict)
    assert not found.kinks


# Unknowns that the data does not determine


@pytest.mark.parametrize(("slope", "status"), [(1e-6, sf.Status.SINGULAR), (10.0, sf.Status.SADDLE)])
def test_a_time_is_not_determined_if_the_others_gain_nothing_as_it_moves(slope, status):
    """J may be flat in the time alone and still fall along a direction that contains it."""
    problem = capacitor(voltage(TIMES) + noise(5))
    found = minimize_cost(evaluator_of(problem), problem.initial_theta, "auto", 1e-7, 200)
    hessian = np.array([[-1e-6, 0.0, slope], [0.0, 1.0, 0.0], [slope, 0.0, 1.0]])
    dropped = drop_noise_of_times(problem, replace(found, status=sf.Status.SADDLE, hessian=hessian))
    assert dropped.status is status
    assert (status is sf.Status.SINGULAR) == (not dropped.hessian[0].any())


# Scales


def test_badly_scaled_unknowns_take_the_same_iterates():
    """Rates in units of 1e6 per second beside times in seconds, and rates of 1e6 in 1e-6 per second."""
    values = voltage(TIMES) + noise(6)
    histories = []
    for unit in (1.0, 1e6, 1e-6):
        in_unit = lambda mode, unit: lambda t, x, p: mode(t, x, {"k": p["k"] * unit})  # noqa: E731
        modes = {name: in_unit(mode, unit) for name, mode in CAPACITOR.modes.items()}
        found = sf.estimate(sf.Problem(sf.HybridSystem(modes, [0.0]), run(values), {"k": GUESS[1:] / unit}))
        assert found.success
        size = np.array([1.0, 1.0 / unit, 1.0 / unit])
        assert np.all(np.abs(found.theta / size - TRUTH) < 4 * found.standard_errors / size)
        histories.append([record.theta / size for record in found.history])
    length = min(map(len, histories))
    assert length > 3
    for history in histories[1:]:
        np.testing.assert_allclose(history[:length], histories[0][:length], rtol=1e-7)
        np.testing.assert_allclose(history[-1], histories[0][-1], rtol=1e-8)


# Ends


def test_trajectories_are_simulated_when_they_are_asked_for(monkeypatch):
    simulate = Mock(side_effect=solved_fit.compare)
    monkeypatch.setattr(solved_fit, "compare", simulate)
    fit = sf.estimate(capacitor(voltage(TIMES)))
    simulate.assert_not_called()
    assert fit.trajectories is fit.trajectories
    assert replace(fit, seconds=0.0).comparisons is fit.comparisons
    simulate.assert_called_once()
    with pytest.raises(AttributeError, match="no attribute 'trajectorys'"):
        fit.trajectorys  # noqa: B018


@pytest.mark.usefixtures("quick_certificates")
def test_a_budget_is_that_of_one_mesh():
    """The fit converges on the first mesh with its last iteration, and is resumed on a finer one all the same."""
    problem = refined_fit().problem
    first = evaluator_of(problem)
    on_first = minimize_cost(Follower(first), problem.initial_theta, "auto", 1e-7, 200).iterations
    found = fit_problem(problem, max_iterations=on_first, success=True)
    assert found.iterations == refined_fit().iterations > on_first
    np.testing.assert_array_equal(found.theta, refined_fit().theta)


def test_times_out_of_order_by_rounding_are_put_in_order():
    """By a part of 1e-15 of the horizon, the time itself being 0: an end that one fit found is a start for the next."""
    problem = capacitor(voltage(TIMES))
    for tau, put in ((-3.8e-14, 0.0), (2.0 + 4e-16, 2.0), (1.6e-30, 1.6e-30)):
        assert problem.check_theta([tau, 2.0, 1.0])[0] == put
        sf.estimate(problem, start=[tau, 2.0, 1.0])
    with pytest.raises(ValueError, match="must not decrease inside"):
        problem.check_theta([-1e-9, 2.0, 1.0])
    data, held = sf.Measurements(TIMES, voltage(TIMES), sigma=SIGMA), sf.Parameter(1.0, fixed=True)
    twice = sf.Experiment(data, ("charge", "discharge") * 2, (0.5, held, 1.5), 0.0, 2.0)
    theta = sf.Problem(CAPACITOR, twice, {"k": GUESS[1:]}).check_theta([1.0 + 4e-16, 1.0 - 4e-16, 2.0, 1.0])
    np.testing.assert_array_equal(theta, [1.0, 1.0, 2.0, 1.0])


# Modes that collapse


def with_a_mode_too_many(sequence, times):
    system = replace(CAPACITOR, modes={**CAPACITOR.modes, "drain": lambda t, x, p: 0.0 * x - p["leak"]})
    data = sf.Measurements(TIMES, voltage(TIMES) + noise(1), sigma=SIGMA)
    parameters = {"k": GUESS[1:], "leak": sf.Parameter(1.0, lower=0.1, upper=5.0)}
    return sf.Problem(system, sf.Experiment(data, sequence, times, 0.0, 2.0), parameters)


def test_a_mode_that_collapses_between_two_of_the_same_is_reported_as_such():
    # From other guesses the fit ends at a lower cost, where the mode has a duration.
    problem = with_a_mode_too_many(("charge", "discharge", "drain", "discharge"), (0.6, 1.4, 1.5))
    found = fit_problem(problem, hessian="exact", status=sf.Status.COLLAPSED)
    plain = sf.estimate(capacitor(voltage(TIMES) + noise(1), tau=0.6))
    assert found.idle == ("tau_2", "tau_3", "leak")
    assert found.theta[1] == found.theta[2]
    (active,) = found.active
    assert str(active) == "mode 3 ('drain') has collapsed to nothing"
    # All else is what it is without that mode, and so are the standard errors.
    known = [found.theta_names.index(name) for name in plain.theta_names]
    np.testing.assert_allclose(found.theta[known], plain.theta, rtol=1e-6)
    np.testing.assert_allclose(found.standard_errors[known], plain.standard_errors, rtol=1e-4)
    assert "; mode 'drain' collapsed: strategy='thorough', or leave the mode out" in str(found.verdict)
    text = " ".join(found.report(full=True).split())
    for unsaid in ("not identified", "Fix one of", "add data", "hardly determine", "NOT UNIQUE"):
        assert unsaid not in text


def test_a_parameter_that_acts_only_in_a_mode_that_collapsed_at_the_start_is_named():
    found = fit_problem(with_a_mode_too_many(("drain", "charge", "discharge"), (0.2, 0.6)), status=sf.Status.COLLAPSED)
    assert found.theta[0] == 0.0
    assert found.idle == ("leak",)
    assert "mode 1 ('drain') has collapsed to nothing" in map(str, found.active)


GUESSES = ((2.0, 3.5, 3.6), (1.0, 2.0, 4.0), (2.0, 4.0, 5.0), (3.0, 3.2, 5.0))
MET_EXACTLY = [*product(GUESSES, (0.8, 1.0), ("local",)), (GUESSES[1], 0.8, "auto")]


@pytest.mark.parametrize(("guess", "rate", "strategy"), MET_EXACTLY)
def test_a_mode_that_collapses_where_the_data_are_met_exactly_is_reported_as_such(guess, rate, strategy):
    """J is zero but for the integration error, whose minimum is where the mode lasts about 1e-12 of the horizon."""
    times = np.linspace(0.1, 6.0, 40)
    charged, left = 1.0 - np.exp(-rate * np.minimum(times, 3.0)), np.exp(-rate * np.maximum(times - 3.0, 0.0))
    system = sf.HybridSystem({"on": models.charge, "off": models.decay}, [0.0])
    run = sf.Experiment(sf.Measurements(times, charged * left, sigma=0.01), ("on", "off", "on", "off"), guess, 0.0, 6.0)
    found = sf.estimate(sf.Problem(system, run, {"k": sf.Parameter(1.2, lower=0.01)}), strategy=strategy)
    assert found.status is sf.Status.COLLAPSED
    assert found.idle in (("tau_1", "tau_2"), ("tau_2", "tau_3"))
    collapsed = [found.theta_names.index(name) for name in found.idle]
    assert found.theta[collapsed[0]] == found.theta[collapsed[1]]
    (switch,) = set(range(3)) - set(collapsed)
    np.testing.assert_allclose(found.theta[[switch, 3]], [3.0, rate], rtol=1e-8)
    assert "NOT UNIQUE" not in str(found)


@pytest.mark.parametrize(("hessian", "iterations"), [("block-diagonal", 500), ("gauss-newton", 200), ("none", 3)])
def test_the_hessian_reported_is_exact_whatever_the_fit_worked_with(hessian, iterations):
    """With noise the exact Hessian differs from Gauss-Newton's matrix, and steepest descent has none at all."""
    problem = capacitor(voltage(TIMES) + 10 * noise(7))
    found = sf.estimate(problem, hessian=hessian, max_iterations=iterations)
    exact = sf.evaluate(problem, found.theta).hessian
    np.testing.assert_allclose(found.hessian, exact, rtol=1e-6, atol=1e-8 * np.abs(exact).max())
    gauss_newton = evaluator_of(problem)(found.theta, matrix="gauss-newton").hessian
    assert np.abs(gauss_newton - exact).max() > 1e-3 * np.abs(exact).max()
    if hessian != "none":
        np.testing.assert_allclose(found.theta, sf.estimate(problem).theta, rtol=1e-6)


# Uncertainties


STRAIGHT = sf.HybridSystem({"m": lambda t, x, p: p["c"][0] + 2.0 * p["c"][1] * t + 0.0 * x}, [0.0])
"""x = c0 t + c1 t^2: linear in its parameters."""


@pytest.mark.parametrize("known", [True, False], ids=["sigma known", "sigma unknown"])
def test_covariance_of_a_linear_model_in_closed_form(known):
    """Least squares with the matrix [t, t^2]: estimate, covariance and intervals as in any textbook."""
    values = 0.7 * TIMES - 1.3 * TIMES**2 + 5 * noise(8)
    values[[3, 20]] = np.nan
    there = np.isfinite(values)
    design = np.stack([TIMES, TIMES**2], axis=1)[there]
    best, (squares,), *_ = np.linalg.lstsq(design, values[there], rcond=None)
    freedom = there.sum() - 2
    variance = (5 * SIGMA) ** 2 if known else squares / freedom
    covariance = variance * np.linalg.inv(design.T @ design)
    data = sf.Measurements(TIMES, values, sigma=5 * SIGMA if known else None)
    found = sf.estimate(sf.Problem(STRAIGHT, sf.Experiment(data, ("m",), (), 0.0, 2.0), {"c": [0.0, 0.0]}))
    assert found.samples == 38
    np.testing.assert_allclose(found.theta, best, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-8)
    errors = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.standard_errors, errors, rtol=1e-8)
    np.testing.assert_allclose(found.correlation, covariance / np.outer(errors, errors), rtol=1e-8)
    assert found.residual_variance == pytest.approx(squares / freedom / ((5 * SIGMA) ** 2 if known else 1.0), rel=1e-8)
    for level in (0.5, 0.95, 0.99):
        tail = 0.5 + level / 2
        quantile = scipy.stats.norm.ppf(tail) if known else scipy.stats.t.ppf(tail, freedom)
        expected = best[:, None] + np.array([-1.0, 1.0]) * quantile * errors[:, None]
        np.testing.assert_allclose(found.confidence_intervals(level), expected, rtol=1e-8)
    np.testing.assert_array_equal(found.confidence_intervals(), found.confidence_intervals(0.95))
