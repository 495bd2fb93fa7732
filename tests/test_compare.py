"""Comparison of models: information criteria of linear regression by hand."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate

import switchfit as sf
from switchfit.models import heater_problem
from switchfit.problem.data import robust
from switchfit.strategy.comparison import compute_log_norm

SIGMA = 0.3
TIMES = np.linspace(0.3, 4.0, 12)
POWERS = sf.HybridSystem({"m": lambda t, x, p: p["a"] + p["b"] * t + p["c"] * t**2 + 0.0 * x}, [0.0])


def design(times, count):
    """x = a t + b t^2 / 2 + c t^3 / 3."""
    return np.stack([times ** (k + 1) / (k + 1) for k in range(count)], axis=1)


def values(seed):
    return design(TIMES, 2) @ [1.2, -0.4] + SIGMA * np.random.default_rng(seed).standard_normal(len(TIMES))


def run(y, sigma=SIGMA, times=TIMES, **settings):
    return sf.Experiment(sf.Measurements(times, y, sigma=sigma, **settings), ("m",), (), 0.0, 4.0)


def fit(count, sigma=SIGMA, runs=None, **settings):
    """A polynomial with so many coefficients; the others are 0."""
    parameters = {name: sf.Parameter(0.0, fixed=k >= count) for k, name in enumerate("abc")}
    if isinstance(sigma, str):
        parameters[sigma] = sf.Parameter(0.5, lower=0.01)
    return sf.estimate(sf.Problem(POWERS, runs or run(values(0), sigma, **settings), parameters))


def squares(count, y):
    X = design(TIMES, count)
    return float(np.sum((y - X @ np.linalg.lstsq(X, y, rcond=None)[0]) ** 2))


def test_criteria_in_closed_form_with_sigma_known():
    table = sf.compare([fit(k) for k in (1, 2, 3)], names=("a", "ab", "abc"))
    n, k = len(TIMES), np.array([1, 2, 3])
    rss = np.array([squares(count, values(0)) for count in k])
    log_l = -0.5 * rss / SIGMA**2 - n * np.log(SIGMA) - 0.5 * n * np.log(2 * np.pi)
    np.testing.assert_allclose(table.log_likelihood, log_l, rtol=1e-8)
    assert table.unknown_counts.tolist() == [1, 2, 3]
    assert table.values == n
    np.testing.assert_allclose(table.aic, 2 * k - 2 * log_l, rtol=1e-8)
    np.testing.assert_allclose(table.aicc, 2 * k - 2 * log_l + 2 * k * (k + 1) / (n - k - 1), rtol=1e-8)
    np.testing.assert_allclose(table.bic, k * np.log(n) - 2 * log_l, rtol=1e-8)
    weight = np.exp(-0.5 * (table.aicc - table.aicc.min()))
    np.testing.assert_allclose(table.weights, weight / weight.sum(), rtol=1e-12)
    assert table.best == "ab"
    assert table.delta_bic.min() == 0.0


def test_criteria_in_closed_form_with_sigma_unknown():
    table = sf.compare([fit(k, None) for k in (1, 2)])
    n = len(TIMES)
    rss = np.array([squares(count, values(0)) for count in (1, 2)])
    log_l = -0.5 * n * (np.log(2 * np.pi * rss / n) + 1)
    np.testing.assert_allclose(table.log_likelihood, log_l, rtol=1e-8)
    assert table.unknown_counts.tolist() == [2, 3]
    assert table.names == ("model1", "model2")


def test_a_sigma_that_is_a_parameter_is_the_same_as_one_left_out():
    table = sf.compare([fit(2, None), fit(2, "noise"), fit(2)], names=("left out", "parameter", "known"))
    assert table.log_likelihood[0] == pytest.approx(table.log_likelihood[1], rel=1e-9)
    assert table.unknown_counts.tolist() == [3, 3, 2]
    assert table.log_likelihood[2] < table.log_likelihood[0]


@pytest.mark.parametrize("loss", ["linear", "huber", "soft_l1", "cauchy"])
def test_losses_are_densities(loss):
    norm = compute_log_norm(loss, 1.7)
    z = np.concatenate([-np.logspace(6, -6, 200_001), np.logspace(-6, 6, 200_001)])
    total = scipy.integrate.trapezoid(np.exp(-0.5 * robust(loss, 1.7, z**2) - norm), z)
    assert total == pytest.approx(1.0, abs=1e-3)
    assert np.isinf(compute_log_norm("cauchy", 1.0))


def test_a_robust_loss_is_better_where_there_are_outliers():
    y = values(0)
    y[[3, 8]] += [5.0, -4.0]
    table = sf.compare(
        [fit(2, runs=run(y)), fit(2, runs=run(y, loss="cauchy", loss_scale=1.5))], names=("normal", "cauchy")
    )
    r = y - design(TIMES, 2) @ table.estimates[1].theta
    norm = np.log(SIGMA) + compute_log_norm("cauchy", 1.5)
    by_hand = -np.sum(0.5 * 1.5**2 * np.log1p((r / SIGMA) ** 2 / 1.5**2)) - len(y) * norm
    assert table.log_likelihood[1] == pytest.approx(by_hand, rel=1e-9)
    assert table.best == "cauchy"


def test_models_with_the_same_bic_are_as_good_as_each_other():
    """No evidence is printed where the difference in BIC would be printed as 0.0."""
    one, known, poor = fit(2), fit(3), fit(1)
    assert str(sf.compare([one, one])).startswith("model1 and model2 are as good as each other by BIC. 12 values.")
    text = str(sf.compare([poor, one, known, one], names=("poor", "one", "all", "same")))
    assert text.startswith("one and same are as good as each other by BIC, 2.5 below all: positive evidence. 12 ")
    assert str(sf.compare([one, known])).startswith("model1 has the smallest BIC, 2.5 below model2: positive evidence.")


def test_different_data_are_refused_wherever_they_differ():
    y = values(0)
    changed = y + 1e-9 * (np.arange(12) == 4)
    twice = sf.Experiment([sf.Measurements(TIMES, y, sigma=SIGMA)] * 2, ("m",), (), 0.0, 4.0)
    for runs, said in (
        (run(changed), r"model1 and model2 were fitted to different data, .*: values differ first at"),
        ([run(y), run(values(1))], "1 and 2 experiments"),
        (run(y[1:], times=TIMES[1:]), r"values of shape \(12, 1\) and \(11, 1\)"),
        (run(y, times=TIMES - 0.01), r"times differ first at index 0, 0.3 and 0.29"),
        (twice, "1 and 2 Measurements"),
    ):
        with pytest.raises(ValueError, match=said):
            sf.compare([fit(2), fit(2, runs=runs)])


def test_equal_data_in_other_arrays_and_with_missing_values_are_the_same():
    y = np.where(np.arange(12) == 2, np.nan, values(0))
    assert sf.compare([fit(1, runs=run(y)), fit(2, runs=run(y.copy()))]).values == len(TIMES) - 1


def test_what_cannot_be_compared():
    one = fit(1)
    area = sf.Experiment(sf.RunningCost(lambda t, x, p: (x[0] - 1.0) ** 2), ("m",), (), 0.0, 4.0)
    # 1 is the scale if none is given: the tail of Cauchy's loss falls as 1 / |z|, whose integral is infinite.
    heavy = run(values(0), loss="cauchy", loss_scale=1.0)
    for estimates, settings, error, said in (
        ([one, one.problem], {}, TypeError, "compare needs results of sf.estimate; got Problem"),
        ([one], {}, ValueError, "compare needs two estimates or more; got 1"),
        ([one, one], {"names": ("a",)}, ValueError, "names must have one entry for each of the 2 estimates"),
        ([one, fit(1, runs=area)], {}, ValueError, "model2 has no likelihood: its cost has other terms than Measure"),
        ([one, fit(2, runs=heavy)], {}, ValueError, r"model2 .*: loss='cauchy' is .* a loss_scale above 1; got 1\."),
    ):
        with pytest.raises(error, match=said):
            sf.compare(estimates, **settings)


def test_few_values():
    y = np.where(np.arange(12) < 3, values(0), np.nan)
    table = sf.compare([fit(k, runs=run(y)) for k in (1, 2)])
    assert np.isinf(table.aicc[1])
    np.testing.assert_allclose(table.weights, [1.0, 0.0])


def test_the_figure_has_the_best_at_the_top():
    figure = sf.compare([fit(k) for k in (1, 2)], names=("line", "parabola")).plot()
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["parabola", "line"]
    assert figure.axes[0].patches[0].get_width() == 0.0


def test_guards_are_equations_between_unknowns():
    """A limit that is an unknown alone gives the same model as a transition time that is free."""
    base = heater_problem()
    guards = {("on", "off"): lambda t, x, p: x[0] - p["limit"]}
    guarded = sf.HybridSystem(dict(base.system.modes), base.system.initial_state, guards=guards)
    limits = (sf.Parameter(15.0), sf.Parameter(15.7, fixed=True))
    problems = [sf.Problem(guarded, base.experiments, {**base.parameters, "limit": limit}) for limit in limits]
    table = sf.compare([sf.estimate(each) for each in (*problems, base)], names=("limit unknown", "known", "free"))
    assert table.unknown_counts.tolist() == [2, 1, 2]
    assert table.log_likelihood[0] == pytest.approx(table.log_likelihood[2], abs=1e-6)
