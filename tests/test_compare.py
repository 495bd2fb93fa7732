"""Comparison of models: information criteria, likelihood ratios and cross-validation of linear regression by hand."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

import switchfit as sf
from switchfit.models import heater_problem
from switchfit.problem.losses import robust
from switchfit.strategy.cross_validation import begin_at
from switchfit.strategy.likelihood import compute_log_norm
from switchfit.strategy.nested import may_be_nested

SIGMA = 0.3
TIMES = np.linspace(0.3, 4.0, 12)
POWERS = sf.HybridSystem({"m": lambda t, x, p: p["a"] + p["b"] * t + p["c"] * t**2 + 0.0 * x}, [0.0])


def design(times, count):
    """x = a t + b t^2 / 2 + c t^3 / 3."""
    return np.stack([times ** (k + 1) / (k + 1) for k in range(count)], axis=1)


def values(seed):
    return design(TIMES, 2) @ [1.2, -0.4] + SIGMA * np.random.default_rng(seed).standard_normal(len(TIMES))


def problem(count, sigma=SIGMA, seeds=(0,), y=None, loss="linear", loss_scale=1.5):
    """A polynomial with so many coefficients; the others are 0."""
    settings = {} if loss == "linear" else {"loss": loss, "loss_scale": loss_scale}
    runs = [
        sf.Experiment(
            sf.Measurements(TIMES, values(seed) if y is None else y, sigma=sigma, **settings), ("m",), (), 0.0, 4.0
        )
        for seed in seeds
    ]
    parameters = {name: sf.Parameter(0.0, fixed=k >= count) for k, name in enumerate("abc")}
    if isinstance(sigma, str):
        parameters[sigma] = sf.Parameter(0.5, lower=0.01)
    return sf.Problem(POWERS, runs, parameters)


def fit(count, *args, **settings):
    return sf.estimate(problem(count, *args, **settings))


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
    pairs = {(pair.small, pair.large): pair for pair in table.nested}
    assert set(pairs) == {("a", "ab"), ("a", "abc"), ("ab", "abc")}
    pair = pairs["a", "abc"]
    assert pair.statistic == pytest.approx((rss[0] - rss[2]) / SIGMA**2, rel=1e-7)
    assert (pair.freedom, pair.regular) == (2, True)
    assert pair.probability == pytest.approx(scipy.stats.chi2.sf(pair.statistic, 2), rel=1e-9)


def test_criteria_in_closed_form_with_sigma_unknown():
    table = sf.compare([fit(k, None) for k in (1, 2)])
    n = len(TIMES)
    rss = np.array([squares(count, values(0)) for count in (1, 2)])
    log_l = -0.5 * n * (np.log(2 * np.pi * rss / n) + 1)
    np.testing.assert_allclose(table.log_likelihood, log_l, rtol=1e-8)
    assert table.unknown_counts.tolist() == [2, 3]
    assert table.names == ("model1", "model2")
    assert table.nested[0].statistic == pytest.approx(n * np.log(rss[0] / rss[1]), rel=1e-7)
    assert table.nested[0].freedom == 1


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
    table = sf.compare([fit(2, y=y), fit(2, y=y, loss="cauchy")], names=("normal", "cauchy"))
    r = y - design(TIMES, 2) @ table.estimates[1].theta
    by_hand = -np.sum(0.5 * 1.5**2 * np.log1p((r / SIGMA) ** 2 / 1.5**2)) - len(y) * (
        np.log(SIGMA) + compute_log_norm("cauchy", 1.5)
    )
    assert table.log_likelihood[1] == pytest.approx(by_hand, rel=1e-9)
    assert table.best == "cauchy"


def test_leaving_runs_out_in_closed_form():
    """Without own unknowns: -2 log L of each run with the regression of the two others."""
    seeds = (0, 1, 2)
    table = sf.compare([fit(k, seeds=seeds) for k in (1, 2)], cross_validate=True)
    assert table.folds == (("run1",), ("run2",), ("run3",))
    for m, count in enumerate((1, 2)):
        X = design(TIMES, count)
        for e in seeds:
            others = np.concatenate([values(seed) for seed in seeds if seed != e])
            p = np.linalg.lstsq(np.vstack([X, X]), others, rcond=None)[0]
            r, y = values(e) - X @ p, values(e)
            expected = r @ r / SIGMA**2 + len(y) * np.log(2 * np.pi * SIGMA**2)
            assert table.held_out[m, e] == pytest.approx(expected, rel=1e-6)
            percent = 100 * (1 - np.linalg.norm(r) / np.linalg.norm(y - y.mean()))
            assert table.held_out_percent[m, e] == pytest.approx(percent, rel=1e-5, abs=1e-5)
    assert "Cross-validation, 3 folds" in str(table)
    assert len(table.plot().axes) == 3


def test_leaving_runs_out_with_sigma_unknown_and_in_groups():
    seeds = (0, 1, 2)
    table = sf.compare([fit(k, None, seeds=seeds) for k in (1, 2)], cross_validate=2)
    assert table.folds == (("run1", "run3"), ("run2",))
    X = design(TIMES, 2)
    y = values(1)
    p = np.linalg.lstsq(X, y, rcond=None)[0]
    s2 = np.sum((y - X @ p) ** 2) / (len(y) - 2)
    r = np.concatenate([values(seed) - X @ p for seed in (0, 2)])
    expected = r @ r / s2 + len(r) * np.log(2 * np.pi * s2)
    assert table.held_out[1, 0] == pytest.approx(expected, rel=1e-6)


def test_the_transition_times_of_a_run_left_out_are_its_own():
    """They are estimated from it, and cost 2 each."""
    base = heater_problem()
    rng, times = np.random.default_rng(0), np.linspace(0.25, 6.0, 24)
    runs = []
    for tau in (2.1, 3.05):
        exact = 25 * (1 - np.exp(-0.4 * np.minimum(times, tau))) * np.exp(-0.4 * np.maximum(times - tau, 0))
        data = sf.Measurements(times, exact + 0.2 * rng.standard_normal(24), sigma=0.2)
        runs.append(sf.Experiment(data, ("on", "off"), (2.5,), 0.0, 6.0))
    both = sf.estimate(sf.Problem(base.system, runs, base.parameters))
    table = sf.compare([both, both], names=("one", "same"), cross_validate=True)
    alone = sf.estimate(sf.Problem(base.system, runs[0], base.parameters))
    found = alone.validate(runs[1])
    r = found.comparisons[0][0].residuals[:, 0]
    expected = r @ r / 0.04 + 24 * np.log(2 * np.pi * 0.04) + 2
    assert table.held_out[0, 1] == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(table.held_out[0], table.held_out[1], rtol=1e-12)


def test_a_mode_that_vanishes_is_on_the_boundary():
    base = heater_problem()
    log, run = base.experiments[0].data, base.experiments[0]
    never = sf.Problem(base.system, sf.Experiment(log, ("on",), (), 0.0, 6.0), base.parameters)
    table = sf.compare([sf.estimate(never), sf.estimate(base)], names=("on", "on, off"))
    assert [(pair.small, pair.large, pair.regular) for pair in table.nested] == [("on", "on, off", False)]
    assert "* too small: if the smaller model is right, a mode of the larger one vanishes." in str(table)
    assert run.mode_sequence == ("on", "off")


def test_models_with_the_same_bic_are_as_good_as_each_other():
    """No evidence is printed where the difference in BIC would be printed as 0.0."""
    one, known, poor = fit(2), fit(3), fit(1)
    assert str(sf.compare([one, one])).startswith("model1 and model2 are as good as each other by BIC. 12 values.")
    text = str(sf.compare([poor, one, known, one], names=("poor", "one", "all", "same")))
    assert text.startswith("one and same are as good as each other by BIC, 2.5 below all: positive evidence. 12 ")
    assert str(sf.compare([one, known])).startswith("model1 has the smallest BIC, 2.5 below model2: positive evidence.")


def test_a_probability_too_small_for_a_number_is_not_zero():
    y = 50.0 * values(0)
    text = str(sf.compare([fit(1, y=y), fit(2, y=y)], names=("a", "ab")))
    assert re.search(r"\ba +in ab +[0-9]+\.[0-9]+ +1 +< 1e-300\n?", text)


def test_pairs_are_those_that_are_given():
    fits = [fit(k) for k in (1, 2)]
    table = sf.compare(fits, names=("a", "ab"), nested=())
    assert table.nested == ()
    assert len(sf.compare(fits, names=("a", "ab"), nested=[("a", "ab")]).nested) == 1
    with pytest.raises(ValueError, match="nested: ab has 2 unknowns and a 1; the smaller model comes first"):
        sf.compare(fits, names=("a", "ab"), nested=[("ab", "a")])
    with pytest.raises(ValueError, match="each of nested must be two of the names a, ab"):
        sf.compare(fits, names=("a", "ab"), nested=[("a", "other")])


def test_different_data_are_refused_wherever_they_differ():
    one = fit(2)
    changed = values(0)
    changed[4] += 1e-9
    with pytest.raises(
        ValueError, match=r"model1 and model2 were fitted to different data, .*: values differ first at"
    ):
        sf.compare([one, fit(2, y=changed)])
    with pytest.raises(ValueError, match="1 and 2 experiments"):
        sf.compare([one, fit(2, seeds=(0, 1))])
    fewer = sf.Experiment(sf.Measurements(TIMES[1:], values(0)[1:], sigma=SIGMA), ("m",), (), 0.0, 4.0)
    with pytest.raises(ValueError, match=r"values of shape \(12, 1\) and \(11, 1\)"):
        sf.compare([one, sf.estimate(sf.Problem(POWERS, fewer, one.problem.parameters))])
    later = sf.Experiment(sf.Measurements(TIMES - 0.01, values(0), sigma=SIGMA), ("m",), (), 0.0, 4.0)
    with pytest.raises(ValueError, match=r"times differ first at index 0, 0.3 and 0.29"):
        sf.compare([one, sf.estimate(sf.Problem(POWERS, later, one.problem.parameters))])
    twice = sf.Experiment([one.problem.experiments[0].data[0]] * 2, ("m",), (), 0.0, 4.0)
    with pytest.raises(ValueError, match="1 and 2 Measurements"):
        sf.compare([one, sf.estimate(sf.Problem(POWERS, twice, one.problem.parameters))])


def test_equal_data_in_other_arrays_and_with_missing_values_are_the_same():
    y = values(0)
    y[2] = np.nan
    assert sf.compare([fit(1, y=y), fit(2, y=y.copy())]).values == len(TIMES) - 1


def test_what_cannot_be_compared():
    one = fit(1)
    with pytest.raises(TypeError, match=r"compare needs results of sf.estimate; got Problem"):
        sf.compare([one, one.problem])
    with pytest.raises(ValueError, match="compare needs two estimates or more; got 1"):
        sf.compare([one])
    with pytest.raises(ValueError, match="names must have one entry for each of the 2 estimates"):
        sf.compare([one, one], names=("a",))
    with pytest.raises(ValueError, match="cross_validate leaves runs out, and the problem has one"):
        sf.compare([one, one], cross_validate=True)
    two = fit(1, seeds=(0, 1))
    with pytest.raises(ValueError, match="cross_validate must"):
        sf.compare([two, two], cross_validate=1)
    named = sf.Problem(
        POWERS,
        [
            sf.Experiment(run.data, ("m",), (), 0.0, 4.0, name=name)
            for run, name in zip(two.problem.experiments, "xy", strict=True)
        ],
        two.problem.parameters,
    )
    with pytest.raises(ValueError, match="cross_validate needs experiments of the same names in all models"):
        sf.compare([two, sf.estimate(named)], cross_validate=True)
    area = sf.Experiment(sf.RunningCost(lambda t, x, p: (x[0] - 1.0) ** 2), ("m",), (), 0.0, 4.0)
    no_data = sf.estimate(sf.Problem(POWERS, area, one.problem.parameters))
    with pytest.raises(ValueError, match="model2 has no likelihood: its cost has other terms than Measurements"):
        sf.compare([one, no_data])


def test_few_values():
    table = sf.compare([fit(k, y=np.where(np.arange(12) < 3, values(0), np.nan)) for k in (1, 2)])
    assert np.isinf(table.aicc[1])
    np.testing.assert_allclose(table.weights, [1.0, 0.0])


def test_the_figure():
    figure = sf.compare([fit(k) for k in (1, 2)], names=("line", "parabola")).plot()
    figure.draw_without_rendering()
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["parabola", "line"]
    assert figure.axes[0].patches[0].get_width() == 0.0  # BIC of the best, at the top


def test_models_that_cannot_be_special_cases_are_not_taken_for_them():
    """Unknowns of the one are a part of the other's by name, but modes, noise or constants are others."""
    base, times = heater_problem(), (2.0,)
    log, power = base.experiments[0].data[0], base.parameters["power"]

    def build(modes, **known):
        k = known.get("k")
        parameters = {"k": sf.Parameter(0.4, fixed=True) if k is None else k, "power": known.get("power", power)}
        data = sf.Measurements(log.times, log.values, **{"sigma": 0.2} | known.get("noise", {}))
        run = sf.Experiment(data, modes, known.get("times", times), 0.0, 6.0)
        return sf.Problem(base.system, run, parameters)

    free = sf.Parameter(0.5, lower=0.01)
    large = build(("on", "off"), k=free)
    assert may_be_nested(build(("on", "off")), large)
    assert not may_be_nested(build(("off", "on")), large)
    assert may_be_nested(build(("off",), k=free, times=()), large)
    assert may_be_nested(build(("on", "off")), build(("on", "off", "on"), k=free, times=(2.0, 4.0)))
    assert not may_be_nested(build(("on", "off", "off"), times=(2.0, 4.0)), large)
    assert may_be_nested(build(("on", "on")), large)  # a mode that only the larger model has may be a more general one
    assert not may_be_nested(build(("on", "off"), power=sf.Parameter(9.0, fixed=True)), large)
    assert not may_be_nested(build(("on", "off"), noise={"sigma": 0.3}), large)
    assert not may_be_nested(build(("on", "off"), noise={"sigma": None}), large)
    assert not may_be_nested(build(("on", "off"), noise={"loss": "huber"}), large)
    late = (sf.Parameter(3.0, fixed=True),)
    assert may_be_nested(build(("on", "off"), k=free, times=late), large)
    earlier = build(("on", "off"), k=free, times=(sf.Parameter(2.0, fixed=True),))
    assert not may_be_nested(build(("on", "off"), k=free, times=late), earlier)
    fits = [sf.estimate(p, strategy="local") for p in (build(("off", "on")), large)]
    assert sf.compare(fits).nested == ()


def test_a_sigma_that_is_known_is_a_special_case_of_one_that_is_a_parameter():
    table = sf.compare([fit(2), fit(2, "noise")], names=("known", "parameter"))
    assert [(pair.small, pair.large, pair.freedom) for pair in table.nested] == [("known", "parameter", 1)]
    assert table.nested[0].statistic == pytest.approx(2 * (table.log_likelihood[1] - table.log_likelihood[0]))


def test_guards_are_equations_between_unknowns():
    """A limit that is an unknown alone gives the same model as a transition time that is free."""
    base = heater_problem()
    guarded = sf.HybridSystem(
        dict(base.system.modes), base.system.initial_state, guards={("on", "off"): lambda t, x, p: x[0] - p["limit"]}
    )
    limit = {"limit": sf.Parameter(15.0)}
    fits = [
        sf.estimate(sf.Problem(guarded, base.experiments, {**base.parameters, **limit})),
        sf.estimate(
            sf.Problem(guarded, base.experiments, {**base.parameters, "limit": sf.Parameter(15.7, fixed=True)})
        ),
        sf.estimate(base),
    ]
    table = sf.compare(fits, names=("limit unknown", "limit known", "free"))
    assert table.unknown_counts.tolist() == [2, 1, 2]
    assert table.log_likelihood[0] == pytest.approx(table.log_likelihood[2], abs=1e-6)
    pairs = {(pair.small, pair.large): pair.freedom for pair in table.nested}
    assert pairs == {("limit known", "limit unknown"): 1, ("limit known", "free"): 1}


def test_a_cauchy_loss_that_is_no_density_has_no_likelihood():
    """1 is the scale if none is given: its tail falls as 1 / |z|, whose integral is infinite."""
    fits = [fit(2), fit(2, loss="cauchy", loss_scale=1.0)]
    with pytest.raises(
        ValueError, match=r"model2 has no likelihood: loss='cauchy' is .* a loss_scale above 1; got 1\."
    ):
        sf.compare(fits)


def test_one_unknown_at_its_bound_halves_the_probability():
    """c = 0 is a bound of the larger model: in every other log c is estimated to be there."""
    base = problem(2)
    bounded = {**base.parameters, "c": sf.Parameter(0.1, lower=0.0)}
    for seed, inside in ((2, False), (4, True)):
        y = values(seed)
        small = sf.estimate(problem(2, y=y))
        large = sf.estimate(sf.Problem(POWERS, problem(2, y=y).experiments, bounded))
        (pair,) = sf.compare([small, large]).nested
        assert (large.parameters["c"] > 1e-6) == inside
        if inside:
            assert pair.probability == pytest.approx(scipy.stats.chi2.sf(pair.statistic, 1) / 2, rel=1e-9)
        else:
            assert (pair.statistic, pair.probability) == (0.0, 1.0)


def test_the_same_fit_twice_is_not_a_worse_one_by_rounding():
    base = heater_problem()
    useless = {**base.parameters, "unused": sf.Parameter(1.0, prior=sf.Normal(1.0, 0.1))}
    fits = [sf.estimate(base), sf.estimate(sf.Problem(base.system, base.experiments, useless), strategy="local")]
    (pair,) = sf.compare(fits).nested
    assert (pair.statistic, pair.probability) == (0.0, 1.0)
    assert "fit it again" not in str(sf.compare(fits))


def test_the_first_guess_of_a_run_left_out_is_the_estimate_of_all_runs():
    """Of its own parameters and initial state too, not of its transition times alone."""
    base = heater_problem()
    log = base.experiments[0].data[0]
    data = sf.Measurements(log.times, log.values, sigma=0.2)
    settings = {"initial_state": [sf.Parameter(0.5)], "parameter_map": {"k": "k_own"}}
    run = sf.Experiment(data, ("on", "off"), (2.0,), 0.0, 6.0, **settings)
    first = sf.Problem(base.system, run, {"k_own": sf.Parameter(0.5, lower=0.01), "power": base.parameters["power"]})
    theta = np.array([2.5, 0.39, 0.1])
    np.testing.assert_array_equal(begin_at(first, theta).initial_theta, theta)
