"""Intervals of many fits where samples are far apart: those of single fits, at kinks and across samples."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

import switchfit as sf
from benchmarks.coverage import RATE, SIGMA, TIMES, build_problem
from support.valleys import eaten, leaky
from switchfit.batch import simulated_study
from switchfit.batch.programs import Limits
from switchfit.batch.study import Study
from switchfit.meshes.evaluator import Evaluator
from switchfit.uncertainty.profile_pieces import find_ends
from switchfit.uncertainty.walk_tracing import trace_walks
from switchfit.uncertainty.walks import Derivatives, Walks


def measured(tau, seed, times=TIMES):
    clean = np.where(tau < times, 1 - np.exp(-RATE * (times - tau)), 0.0)
    return (clean + SIGMA * np.random.default_rng(seed).standard_normal(len(times)))[:, None]


def charged(tau, seed, rate_known=False):
    """A log whose rate is unknown too."""
    return build_problem(measured(tau, seed), tau, rate_known=rate_known)


def check_same(problems, level):
    """Each interval of the batch is that of a single fit, measured by its length; returns the batch."""
    many = sf.estimate_many(problems)
    found = many.confidence_intervals(level)
    for k, problem in enumerate(problems):
        single = sf.estimate(problem, strategy="local", start=many.theta[k])
        expected = single.confidence_intervals(level)
        np.testing.assert_allclose(many.theta[k], single.theta, rtol=1e-5)
        np.testing.assert_allclose(many.standard_errors[k], single.standard_errors, rtol=1e-3)
        length = np.nan_to_num(expected[:, 1] - expected[:, 0], nan=1.0)[:, None]
        np.testing.assert_allclose(found[k] / length, expected / length, atol=1e-4, rtol=0, err_msg=f"fit {k}")
    return many


@pytest.mark.parametrize("tau", [2.0, 2.01, 2.05])
@pytest.mark.parametrize("rate_known", [pytest.param(True, marks=pytest.mark.slow), False])
@pytest.mark.parametrize("level", [pytest.param(0.68, marks=pytest.mark.slow), 0.95])
def test_intervals_are_those_of_single_fits(tau, rate_known, level):
    problems = [charged(tau, seed, rate_known) for seed in range(16)]
    many = check_same(problems, level)
    assert many.at_kink.any() or tau != 2.0


@pytest.mark.parametrize(
    ("build", "scale", "seed"),
    [(leaky, "log", 7), (leaky, "log", 8), (leaky, "linear", 2), (eaten, "linear", 34), (eaten, "linear", 39)],
)
def test_pieces_follow_other_unknowns_to_bounds_from_bounds_and_along_valleys(build, scale, seed):
    """Held where they meet a bound, they were not eliminated again: widths were 0, or ends stuck at samples."""
    fit = sf.estimate(build(seed, scale), strategy="local")
    profile = np.array(fit.profile("tau_1").interval())
    np.testing.assert_allclose(fit.confidence_intervals()[0], profile, atol=0.01 * np.ptp(profile), rtol=0)


def test_a_way_ends_where_the_others_are_not_determined():
    """Beyond x = 1 J does not depend on y. The other way, to the left, is not affected."""
    count, stops = 2, np.array([[-1.0, -9.0, np.nan, np.nan], [1.0, 9.0, np.nan, np.nan]])
    each = np.ones((count, 2))
    walks = Walks(
        0 * each, np.zeros(2, int), np.array([-1, 1]), np.array([[False, True]] * 2), stops, np.array([-9.0, 9.0]),
        -9 * each, 9 * each, np.full(2, 5.0),
    )  # fmt: skip

    def evaluate(which, thetas):
        x, y = thetas.T
        inside = np.where(x < 1.0, 1.0, 0.0)
        H = np.array([[[1.0, 0.0], [0.0, k]] for k in inside])
        return Derivatives(0.5 * x**2 + 0.5 * inside * y**2, np.column_stack([x, inside * y]), H)

    left, right = trace_walks(walks, np.zeros(2), evaluate, 4)
    assert np.isfinite(left[:, 0]).sum() == 2
    assert np.isfinite(right[:, 0]).sum() == 1
    assert find_ends(left, np.array(2.0), -1) == pytest.approx(-2.0, abs=1e-6)
    assert left[1, 1] == -9.0


def test_a_way_ends_where_transition_times_lose_their_order():
    """Another time y follows x to the left, y = 1 - x: a model cannot be evaluated where x is behind y."""
    walks = Walks(
        np.array([[0.0, 1.0]]), np.zeros(1, int), np.ones(1, int), np.array([[False, True]]),
        np.array([[0.3, 0.8, 9.0, np.nan]]), np.array([9.0]), np.full((1, 2), -9.0), np.full((1, 2), 9.0),
        np.full(1, 5.0),
    )  # fmt: skip

    def evaluate(which, thetas):
        x, y = thetas.T
        assert (x <= y).all()
        off = y - 1.0 + x
        H = np.tile([[2.0, 1.0], [1.0, 1.0]], (len(x), 1, 1))
        return Derivatives(0.5 * x**2 + 0.5 * off**2, np.column_stack([x + off, off]), H)

    (pieces,) = trace_walks(walks, np.zeros(1), evaluate, 4, [np.array([0, 1])])
    assert pieces[np.isfinite(pieces[:, 0]), 0] == pytest.approx([0.0, 0.3])


def with_other_data(seed, **changes):
    problem = charged(2.0, seed)
    run = problem.experiments[0]
    return replace(problem, experiments=replace(run, data=[replace(run.data[0], **changes)]))


unknown_sigma = partial(with_other_data, sigma=None)
delayed = partial(with_other_data, times=TIMES + 0.03, delay=0.03)
"""The kinks are where the state was measured, not where the samples are stamped."""


def several_runs(seed, taus=(2.0, 1.51), shift=0.0):
    """Runs that share the rate, each with sample times of its own."""
    runs = []
    for e, tau in enumerate(taus):
        times = TIMES + shift * seed
        data = sf.Measurements(times, measured(tau, seed + 10 * e, times), sigma=SIGMA)
        runs.append(sf.Experiment(data, ("rest", "charge"), (tau,), 0.0, 4.2))
    return sf.Problem(charged(2.0, seed).system, runs, {"k": sf.Parameter(RATE, lower=0.5, upper=40.0)})


@pytest.mark.parametrize(
    "build", [unknown_sigma, delayed, several_runs, partial(several_runs, taus=(2.03,), shift=0.01)]
)
def test_intervals_of_other_logs_are_those_of_single_fits_too(build):
    many = check_same([build(seed) for seed in range(8)], 0.95)
    assert (~np.isnan(many.pieces[:, :, 0, 0, 0])).sum() > 4
    assert many.pieces.shape[1] == (2 if build is several_runs else 1)


def test_an_interval_grows_with_its_level_beyond_the_pieces_too():
    many, levels = sf.estimate_many([charged(2.0, seed) for seed in range(12)]), (0.5, 0.9, 0.95, 0.99, 0.999, 0.9999)
    lengths = [np.ptp(many.confidence_intervals(level)[:, 0], axis=1) for level in levels]
    assert np.isfinite(lengths).all()
    assert (np.diff(lengths, axis=0) > 0).all()
    for side, limit in enumerate((0.0, 4.0)):  # the last piece goes on to the end of the horizon
        stops = many.pieces[:, 0, side, :, 1]
        assert (np.where(limit, np.nanmax(stops, axis=1), np.nanmin(stops, axis=1)) == limit).all()


def test_an_unknown_that_a_bound_holds_has_no_interval():
    many = sf.estimate_many([replace(charged(2.05, 0), parameters={"k": sf.Parameter(4.0, lower=0.5, upper=5.0)})])
    assert many.at_bounds.tolist() == [1]
    assert np.isnan(many.confidence_intervals()[0, 1]).all()
    assert np.isfinite(many.confidence_intervals()[0, 0]).all()


@pytest.mark.slow
def test_a_kink_has_an_interval_with_jax_too():
    """Where an evaluation would have to be compiled first, the others keep one parabola."""
    problems = [replace(charged(2.0, s, True), engine="jax") for s in range(12)]
    many = sf.estimate_many(problems)
    at_kink = many.at_kink[:, 0]
    assert set(at_kink) == {True, False}
    assert np.isnan(many.pieces[~at_kink]).all()
    native = sf.estimate_many([replace(problem, engine="auto") for problem in problems])
    np.testing.assert_allclose(many.confidence_intervals()[at_kink], native.confidence_intervals()[at_kink], rtol=1e-6)


def test_what_is_found_for_a_run_does_not_depend_on_the_others_of_its_call():
    problem, truth = charged(2.0, 3, True), np.array([2.0])
    work, _ = simulated_study.build_study(problem, truth, truth, None, 0, Limits(1e-7, 200))
    whole, *parts = (work(runs) for runs in (range(128), range(50), range(50, 128)))
    assert np.isfinite(whole["pieces"][:, 0, 0, 0, 0]).any()
    for name, array in whole.items():
        np.testing.assert_array_equal(array, np.concatenate([part[name] for part in parts]), err_msg=name)


def test_a_fit_that_was_done_again_is_evaluated_on_its_own_meshes(monkeypatch):
    """The model of the first one raises an error there: it has the interval of one parabola."""
    problem = charged(2.0, 3, True)
    plain = sf.monte_carlo(problem, 8, theta=[2.0], seed=1)

    def raise_error(theta, side):
        raise ZeroDivisionError("undefined here")

    def redo(study, chunk, runs, batch):
        for k, run in enumerate(runs):
            batch.own[k] = cache(partial(Evaluator, study.problem_of(run), chunk.theta[k].copy()))
        batch.own[first] = lambda: raise_error

    first = int(np.flatnonzero(np.isfinite(plain.pieces[:, 0, 0, 1, 0]))[0])
    monkeypatch.setattr(Study, "_redo_unresolved", redo)
    own = sf.monte_carlo(problem, 8, theta=[2.0], seed=1)
    others = np.arange(8) != first
    assert not np.isfinite(own.pieces[first, 0, :, 1:]).any()
    np.testing.assert_allclose(own.confidence_intervals()[others], plain.confidence_intervals()[others], rtol=1e-5)
