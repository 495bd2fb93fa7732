"""Many starts of one problem: both minima, bounds, ends that raise, starts that cannot be integrated."""

from dataclasses import replace

import numpy as np
import pytest

import switchfit as sf
from benchmarks.starts.bounces import FALL, ball_on_guards
from support.heated_rooms import ROOM, TIMES, growing, measured_room, room
from support.models import one_run
from switchfit.batch import batch, starts
from switchfit.batch.layout import CHUNK
from switchfit.fit.local_fit import fit_locally
from switchfit.fit.minimization import minimize_cost
from switchfit.models import heater_problem
from switchfit.strategy.random_starts import draw_starts

# Multistart


def two_minima():
    """One pulse, given twice in the data: a schedule with one gap fits the first or the second."""
    system = sf.HybridSystem({"rest": lambda t, x, p: 1.0 - x, "pulse": lambda t, x, p: -2.0 * x}, [0.9])

    def build(values, times):
        data = sf.Measurements(np.linspace(0.1, 9.9, 60), values, sigma=0.05)
        return one_run(system, data, ("rest", "pulse", "rest"), times, 10.0, min_duration=0.2)

    guesses = ((2.0, 3.0), (7.0, 7.8))
    curves = [sf.simulate(build(np.zeros(60), guess), times="samples").states[:, 0] for guess in guesses]
    return build(np.minimum(*curves), (4.0, 6.0))


def test_multistart_finds_both_minima_and_estimates_the_lower_one():
    problem = two_minima()
    study = sf.multistart(problem, 24, seed=1)
    assert len(study) == 24
    np.testing.assert_array_equal(study.start[0], problem.initial_theta)
    knots = np.hstack([np.zeros((24, 1)), study.start, np.full((24, 1), 10.0)])
    assert np.all(np.diff(knots) >= 0.2 - 1e-12)
    assert len(np.unique(study.start[:, 0])) == 24
    for k, end in enumerate(([2.0, 3.0], [7.0, 7.8])):
        found = study.clusters == k
        np.testing.assert_allclose(study.theta[found].mean(0), end, atol=0.1)
        assert np.ptp(study.cost[found]) < 1e-6 * study.cost[found][0]
    assert study.best.status.successful
    assert study.best.verdict.level == "bad"  # of two pulses one is explained
    np.testing.assert_allclose(study.best.theta, study.theta[study.clusters == 0].mean(0), atol=1e-4)
    assert study.best.cost == pytest.approx(np.nanmin(study.cost), rel=1e-6)


def test_fixed_times_and_bounds_keep_their_place_among_the_starts():
    data = sf.Measurements(TIMES, np.zeros(24), sigma=0.01)
    times = (1.0, sf.Parameter(2.0, fixed=True), sf.Parameter(3.0, lower=2.5, upper=3.5), 4.0)
    run = sf.Experiment(data, ("on", "off", "on", "off", "on"), times, 0.0, 6.0)
    problem = sf.Problem(ROOM, run, {"k": sf.Parameter(0.8, lower=0.1, upper=2.0)}, min_duration=0.1)
    first, third, fourth, k = draw_starts(problem, 20, 0).T
    assert np.all((first >= 0.1 - 1e-12) & (first <= 1.9 + 1e-12))
    assert np.all((third >= 2.5) & (third <= 3.5) & (fourth - third >= 0.1 - 1e-12) & (fourth <= 5.9 + 1e-12))
    assert k.min() < 0.4
    assert k.max() > 1.6


# Chunks


def test_a_multistart_that_was_stopped_is_doubtful():
    part = sf.multistart(heater_problem(), 2 * CHUNK, callback=lambda done, total: True)
    assert (part.best.verdict.level, part.verdict.level) == ("good", "doubtful")
    assert [reason.kind for reason in part.verdict.reasons] == ["stopped"]
    assert f"noise; stopped, {CHUNK} of {2 * CHUNK} fits were not done: call it again" in str(part.verdict)
    assert "stopped, " in str(replace(part, best=None).verdict)


@pytest.fixture
def finished(monkeypatch):
    """Starts and budgets of the fits that `minimize` finishes."""
    begun = []

    def listen(evaluator, theta, *settings, **more):
        begun.append((tuple(theta), settings[-1]))
        return minimize_cost(evaluator, theta, *settings, **more)

    monkeypatch.setattr(batch, "minimize_cost", listen)
    return begun


def test_fits_are_settled_inside_the_program_at_kinks_too(finished):
    """What goes wrong inside it is finished by `minimize`, and would be seen by the time it takes alone."""
    study = sf.monte_carlo(room(), 64, theta=[2.0, 0.8], seed=2)  # the truth is on a sample
    assert study.success.all()
    assert study.at_kink.sum() > 5
    assert (study.free == 2 - study.at_kink.sum(axis=1)).all()
    assert not finished


def test_starts_that_differ_in_the_transition_time_alone_end_in_one_minimum():
    noisy = 0.4 + 0.05 * np.random.default_rng(2).standard_normal(24) + 0.3 * (np.abs(TIMES - 2.5) < 1.5)
    study = sf.multistart(room(sf.Measurements(TIMES, noisy, sigma=0.05)), [[tau, 1.0] for tau in (2.9, 3.0, 3.1)])
    assert study.success.all()
    assert np.ptp(study.theta[:, 1]) > 0  # to rounding
    assert study.clusters.tolist() == [0, 0, 0]


def test_the_lowest_end_may_raise_an_error_when_it_is_fitted_again(monkeypatch):
    problem, calls = room(sf.Measurements(TIMES, measured_room(0), sigma=0.01)), []

    def estimate(problem, **settings):
        calls.append(settings["start"])
        return 1 / 0 if len(calls) in (1, 3, 4) else fit_locally(problem, **settings)

    monkeypatch.setattr(starts, "fit_locally", estimate)
    study, none = (sf.multistart(problem, [[2.0, 0.9], [1.5, 0.7]]) for _ in range(2))
    assert sorted(study.status.tolist()) == ["CONVERGED", "ERROR"]
    assert study.best.success
    assert none.best is None
    assert none.status.tolist() == ["ERROR"] * 2
    assert "ZeroDivisionError: division by zero" in none.failures[1][1]


# Guards: far starts end where near ones do


def test_starts_near_and_far_find_the_restitution_of_a_ball():
    """A ball with eight bounces; their times are known to 30 ms, and restitution, height and speed roughly. From start
    10 the guards pull transitions together, so that a direct fit loses modes.
    """
    case = ball_on_guards(16)
    found = sf.multistart(case.problem, case.starts)
    assert found.success.all()
    assert found.clusters.tolist() == [0] * 16
    assert found.verdict.level == "good"
    assert "the lowest J was found from 15 of 15 other starts" in str(found.verdict)
    assert found.best.parameters["e"] == pytest.approx(FALL[0], abs=4 * found.best.standard_errors[8])
    study = sf.monte_carlo(case.problem, 6, theta=found.best.theta, start=case.starts[10])
    assert study.verdict.level == "good"
    np.testing.assert_allclose(study.theta[:, 8], found.best.theta[8], atol=0.002)


@pytest.mark.parametrize("guess", [pytest.param((2.0, 2.0), marks=pytest.mark.slow), (0.9, 0.6)])
def test_a_start_that_cannot_be_integrated_is_a_bad_start(guess):
    """Whether or not it is the problem's own guess."""
    found = sf.multistart(growing(guess), [[2.0, 2.0], [0.9, 0.6], [1.1, 0.4], [0.9, -0.5]])
    assert found.success.tolist() == [False, True, True, False]
    assert found.clusters[[0, 3]].tolist() == [-1, -1]
    assert [run for run, _ in found.failures] == [0, 3]
    assert "not finite" in found.failures[1][1]
    np.testing.assert_allclose(found.best.theta, [1.0, 0.5], atol=0.02)
    assert found.verdict.level == "good"
