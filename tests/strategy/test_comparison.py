"""Comparison of models: criteria in closed form, losses as densities, what is refused."""

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
import scipy.stats

import switchfit as sf
from support.regressions import SIGMA, design, pose, run, values
from switchfit.models import heater_problem
from switchfit.problem.losses import robust
from switchfit.strategy.likelihood import compute_log_norm

TIMES = np.linspace(0.3, 4.0, 12)


def fit(count, sigma=SIGMA, runs=None):
    noise = {sigma: sf.Parameter(0.5, lower=0.01)} if isinstance(sigma, str) else {}
    return sf.estimate(pose(runs or run(TIMES, values(TIMES, 0), sigma), count, **noise))


def squares(count, y):
    X = design(TIMES, count)
    return float(np.sum((y - X @ np.linalg.lstsq(X, y, rcond=None)[0]) ** 2))


def test_criteria_in_closed_form_with_sigma_known():
    table = sf.compare([fit(k) for k in (1, 2, 3)], names=("a", "ab", "abc"))
    n, k = len(TIMES), np.array([1, 2, 3])
    rss = np.array([squares(count, values(TIMES, 0)) for count in k])
    log_l = -0.5 * rss / SIGMA**2 - n * np.log(SIGMA) - 0.5 * n * np.log(2 * np.pi)
    np.testing.assert_allclose(table.log_likelihood, log_l, rtol=1e-8)
    assert (table.unknown_counts.tolist(), table.values) == ([1, 2, 3], n)
    np.testing.assert_allclose(table.aicc, 2 * k - 2 * log_l + 2 * k * (k + 1) / (n - k - 1), rtol=1e-8)
    np.testing.assert_allclose(table.bic, k * np.log(n) - 2 * log_l, rtol=1e-8)
    weight = np.exp(-0.5 * (table.aicc - table.aicc.min()))
    np.testing.assert_allclose(table.weights, weight / weight.sum(), rtol=1e-12)
    assert table.best == "ab"
    few = np.where(np.arange(n) < 3, values(TIMES, 0), np.nan)  # missing values are no different data
    assert np.isinf(sf.compare([fit(k, runs=run(TIMES, few)) for k in (1, 2)]).aicc[1])


def test_criteria_in_closed_form_with_sigma_unknown():
    """As a sigma that is a parameter has it."""
    table = sf.compare([fit(1, None), fit(2, None), fit(2, "noise"), fit(2)])
    n = len(TIMES)
    rss = np.array([squares(count, values(TIMES, 0)) for count in (1, 2)])
    log_l = -0.5 * n * (np.log(2 * np.pi * rss / n) + 1)
    np.testing.assert_allclose(table.log_likelihood[:3], [*log_l, log_l[1]], rtol=1e-8)
    assert table.unknown_counts.tolist() == [2, 3, 3, 2]
    assert table.log_likelihood[3] < table.log_likelihood[2]


@pytest.mark.parametrize("loss", ["linear", "huber", "soft_l1", "cauchy"])
def test_losses_are_densities(loss):
    norm = compute_log_norm(loss, 1.7)
    z = np.concatenate([-np.logspace(6, -6, 200_001), np.logspace(-6, 6, 200_001)])
    total = scipy.integrate.trapezoid(np.exp(-0.5 * robust(loss, 1.7, z**2) - norm), z)
    assert total == pytest.approx(1.0, abs=1e-3)


def test_the_likelihood_of_a_robust_loss():
    y = values(TIMES, 0)
    y[[3, 8]] += [5.0, -4.0]
    fits = [fit(2, runs=run(TIMES, y)), fit(2, runs=run(TIMES, y, loss="cauchy", loss_scale=1.5))]
    table = sf.compare(fits, names=("normal", "cauchy"))
    r = y - design(TIMES, 2) @ table.estimates[1].theta
    norm = np.log(SIGMA) + compute_log_norm("cauchy", 1.5)
    expected = -np.sum(0.5 * 1.5**2 * np.log1p((r / SIGMA) ** 2 / 1.5**2)) - len(y) * norm
    assert table.log_likelihood[1] == pytest.approx(expected, rel=1e-9)
    assert table.best == "cauchy"


def test_models_with_the_same_bic_are_as_good_as_each_other():
    """No evidence is printed where the difference in BIC would be printed as 0.0."""
    one, known, poor = fit(2), fit(3), fit(1)
    text = str(sf.compare([poor, one, known, one], names=("poor", "one", "all", "same")))
    assert text.startswith("one and same are as good as each other by BIC, 2.5 below all: positive evidence. 12 ")
    assert str(sf.compare([one, known])).startswith("model1 has the smallest BIC, 2.5 below model2: positive evidence.")


def test_different_data_are_refused_wherever_they_differ():
    y = values(TIMES, 0)
    changed = y + 1e-9 * (np.arange(12) == 4)
    twice = sf.Experiment([sf.Measurements(TIMES, y, sigma=SIGMA)] * 2, ("m",), (), 0.0, 4.0)
    for runs, said in (
        (run(TIMES, changed), r"model1 and model2 were fitted to different data, .*: values differ\."),
        ([run(TIMES, y), run(TIMES, values(TIMES, 1))], "1 and 2 experiments"),
        (run(TIMES[1:], y[1:]), r"times of shape \(12,\) and \(11,\)"),
        (run(TIMES - 0.01, y), r"times differ"),
        (twice, "1 and 2 Measurements"),
    ):
        with pytest.raises(ValueError, match=said):
            sf.compare([fit(2), fit(2, runs=runs)])


def test_what_cannot_be_compared():
    one = fit(1)
    area = sf.Experiment(sf.RunningCost(lambda t, x, p: (x[0] - 1.0) ** 2), ("m",), (), 0.0, 4.0)
    # 1 is the scale if none is given: the tail of Cauchy's loss falls as 1 / |z|, whose integral is infinite.
    heavy = run(TIMES, values(TIMES, 0), loss="cauchy", loss_scale=1.0)
    for estimates, error, said in (
        ([one, one.problem], TypeError, r"estimates must be a result of sf\.estimate or a list of them; got Problem"),
        ([one], ValueError, "compare needs two estimates or more; got 1"),
        ([one, fit(1, runs=area)], ValueError, "model2 has no likelihood: its cost has other terms than Measure"),
        ([one, fit(2, runs=heavy)], ValueError, r"model2 .*: loss='cauchy' is .* a loss_scale above 1; got 1\."),
    ):
        with pytest.raises(error, match=said):
            sf.compare(estimates)
    with pytest.raises(ValueError, match="names must have one entry for each of the 2 estimates"):
        sf.compare([one, one], names=("a",))


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
