"""Verdicts on many fits: each as that on a single fit as far as J tells, and rules for all of them together."""

from dataclasses import replace

import numpy as np
import pytest

import switchfit as sf
from support.heated_rooms import ROOM, TIMES, TRUTH
from support.heated_rooms import room as heat
from support.models import temperature
from switchfit.batch.doubts import _count_collapsed
from switchfit.batch.layout import CHUNK
from switchfit.uncertainty.quality import measure_quality

pytestmark = pytest.mark.usefixtures("fits_one_by_one")

TEMPERATURES = temperature(TIMES, 2.1, 1.0, 0.8)


def room(values=TEMPERATURES, *, sigma=0.01, seed=0, noise=0.01, **settings):
    values = values + noise * np.random.default_rng(seed).standard_normal(24)
    return heat(sf.Measurements(TIMES, values, sigma=sigma), **settings)


def wave(size):
    return TEMPERATURES + size * np.sin(4 * TIMES)


def test_the_share_of_a_reference_is_that_of_a_single_fit_and_a_cost_without_data_has_none():
    signal = sf.ReferenceSignal.from_samples(np.r_[0.0, TIMES], np.r_[0.2, wave(0.1)][:, None])
    problem = sf.Problem(ROOM, sf.Experiment(signal, ("on", "off"), (1.7,), 0.0, 6.0), {"k": 1.0})
    single, many = sf.estimate(problem, strategy="local"), sf.estimate_many([problem, problem])
    assert many.explained[0] == pytest.approx(measure_quality(single).explained, abs=1e-3)
    assert many.verdict.level == single.verdict.level == "doubtful"
    assert "little of the variance is explained in 2 of 2 fits" in str(many.verdict)
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: (x[0] - 0.8) ** 2), ("on", "off"), (1.0,), 0.0, 6.0)
    many = sf.estimate_many([sf.Problem(ROOM, run, {"k": sf.Parameter(0.8, fixed=True)})])
    assert np.isnan(many.explained).all()
    assert str(many.verdict) == "Good: 1 good of 1 fit."


def kinds(result):
    return [reason.kind for reason in result.verdict.reasons]


# --- fits of logs -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "level"),
    [
        ({}, "good"),
        ({"values": wave(0.03)}, "doubtful"),  # what is left is no noise
        ({"values": wave(1.0)}, "bad"),
        ({"noise": 0.5, "sigma": 0.5}, "good"),
        ({"prior": sf.Normal(0.9, 0.05)}, "good"),
        ({"values": wave(1.0), "sigma": None}, "bad"),
        ({"upper": 0.5, "guess": (1.7, 0.4)}, "doubtful"),
        ({"upper": 0.785, "guess": (1.7, 0.6)}, "doubtful"),  # at its bound, and the data do not mind
    ],
)
def test_level_and_share_that_is_explained_are_those_of_a_single_fit(settings, level):
    problem = room(**settings)
    single, many = sf.estimate(problem, strategy="local"), sf.estimate_many([problem])
    assert single.verdict.level == many.verdict.level == many.levels[0] == level
    assert many.explained[0] == pytest.approx(measure_quality(single).explained, abs=1e-9)


def test_one_bad_fit_among_many_is_named_and_all_are_bad_where_half_of_them_are():
    problems = [room(wave(1.0)) if seed < 3 else room(seed=seed) for seed in range(6)]
    assert sf.estimate_many(problems).verdict.level == "bad"
    many = sf.estimate_many(problems[2:])
    assert many.levels.tolist() == ["bad", "good", "good", "good"]
    said = str(many.verdict)
    assert said.startswith("Doubtful: 3 good and 1 bad of 4 fits; the model is far from the data in ")
    assert "(fit 0 explains" in said
    assert said.endswith("fit problem 0 by itself with sf.estimate.")
    good = sf.estimate_many(problems[3:])
    assert str(good).startswith(str(good.verdict))
    assert str(good).startswith("Good: 3 good of 3 fits, explaining 99.")


def test_chi_square_is_shared_among_the_fits():
    """One fit in a thousand has so large a chi-square by chance, and 10,000 fits have ten."""
    many = sf.estimate_many([room(seed=seed) for seed in range(CHUNK)])
    few = sf.estimate_many([room()])
    large = 0.5 * 54.0  # of 22 degrees of freedom: probability 2e-4
    assert replace(few, cost=np.array([large]), explained=np.array([0.9])).verdict.level == "doubtful"
    explained = np.repeat(0.9, CHUNK)
    assert replace(many, cost=np.r_[large, np.repeat(11.0, CHUNK - 1)], explained=explained).verdict.level == "good"


def test_collapsed_modes_are_counted():
    """A log of a room that was never heated."""
    cold = 0.2 * np.exp(-0.8 * TIMES)
    many = sf.estimate_many([room(cold, guess=(1.0, 1.0), upper=1.1, seed=seed) for seed in range(3)])
    assert (many.collapsed == 1).any()
    assert (many.verdict.level, "some a mode collapsed" in kinds(many)) == ("doubtful", True)


@pytest.mark.parametrize(("failed", "level"), [(2, "good"), (3, "doubtful"), (99, "doubtful"), (100, "bad")])
def test_a_hundredth_of_a_study_may_fail_and_an_integration_error_counts(study, failed, level):
    status = study.status.astype(object)
    status[:failed] = "MAX_ITERATIONS"
    assert replace(study, status=status.astype(str), integration_error=9e-4).verdict.level == level
    assert replace(study, integration_error=1.1e-3).verdict.level == "bad"


def test_a_short_mode_is_one_of_its_horizon_wherever_the_clock_begins():
    """Of 6 s that begin at 1e9 s, 1 s is a sixth."""
    cost = sf.RunningCost(lambda t, x, p: x[0])
    run = sf.Experiment(cost, ("on", "off"), (1e9 + 1.0,), 1e9, 1e9 + 6.0)
    ends = 1e9 + np.array([[0.0, 1.0, 6.0], [0.0, 0.0, 6.0], [0.0, 6.0, 6.0]])
    assert _count_collapsed(sf.Problem(ROOM, run, {"k": 1.0}), run, ends).tolist() == [0, 1, 1]


# --- studies ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def study():
    found = sf.monte_carlo(room(), 200, theta=TRUTH)
    assert str(found).startswith("Good: 200 of 200 fits converged, in one minimum.\n")
    return found


def test_a_study_with_more_noise_than_sigma_says_so():
    found = sf.monte_carlo(room(), 200, theta=TRUTH, noise=0.03)
    assert found.verdict.level == "doubtful"
    assert {"some no noise", "intervals too short"} <= set(kinds(found))
    share = found.verdict.reasons[-1].figures["share"]
    assert share == pytest.approx(found.coverage().min())


def test_an_end_in_another_minimum_is_found(study):
    theta = study.theta.copy()
    theta[17] += 30 * study.standard_deviation
    away = replace(study, theta=theta)
    assert away.verdict.level == "doubtful"
    assert "1 of 200 fits ended in another minimum, fit 17 farthest off" in str(away.verdict)


def test_a_bootstrap_of_a_bad_fit_is_bad():
    found = sf.bootstrap(sf.estimate(room(wave(1.0)), strategy="local"), 20)
    assert found.verdict.level == "bad"
    assert str(found).startswith("Bad: the fit that was resampled is bad")
    fine = sf.bootstrap(sf.estimate(room(wave(0.03)), strategy="local"), 20)
    assert fine.origin.level == "doubtful"  # sigma is too small, which is what a bootstrap is for
    assert fine.verdict.level == "good"


def test_a_bootstrap_of_runs_is_judged_by_what_runs_share():
    problem = sf.Problem(ROOM, [room(seed=seed).experiments[0] for seed in range(5)], {"k": 1.0})
    found = sf.bootstrap(sf.estimate(problem), 40, resample="runs")
    assert found.verdict.level == "good"
    theta = found.theta.copy()
    theta[3, 0] += 1.0  # the time of a run that was not drawn
    assert replace(found, theta=theta).verdict.level == "good"


# --- starts -----------------------------------------------------------------------------------------------------------


def test_many_starts_have_the_verdict_of_the_best_and_say_how_many_found_it():
    found = sf.multistart(room(), 16)
    assert found.verdict.level == found.best.verdict.level == "good"
    looked = found.verdict.answers[1]
    assert looked.figures["agreeing"] == np.sum(found.clusters == 0) - 1
    assert replace(found, best=None).verdict.level == "bad"  # no start could be fitted


# --- folders ----------------------------------------------------------------------------------------------------------


def test_a_folder_gives_the_same_verdict_and_intervals_unless_it_is_of_another_format(tmp_path, monkeypatch):
    problems = [room(wave(1.0)), room(), room()]
    first = sf.estimate_many(problems, folder=tmp_path)
    monkeypatch.setattr("switchfit.batch.study.Batch", None)  # nothing is fitted
    again = sf.estimate_many(problems, folder=tmp_path)
    assert again.verdict == first.verdict
    np.testing.assert_array_equal(again.levels, first.levels)
    np.testing.assert_array_equal(again.confidence_intervals(), first.confidence_intervals())
    monkeypatch.setattr("switchfit.batch.logs.CHUNK_FORMAT", "fits 1")
    with pytest.raises(ValueError, match="holds the results of another run"):
        sf.estimate_many(problems, folder=tmp_path)
