"""Monte Carlo: the same as single fits, whatever the order; intervals cover the truth."""

from dataclasses import replace

import numpy as np
import pytest

import switchfit as sf
from support.heated_rooms import LIMITS, ROOM, TIMES, TRUTH, growing, room
from support.models import decay, one_run, refused, rest
from switchfit.batch import layout as layout_module
from switchfit.batch import simulated_study
from switchfit.batch.batch import Batch
from switchfit.fit.minimization import minimize_cost
from switchfit.meshes.evaluator import Evaluator


def work_of(problem, truth, start, noise=None, seed=3):
    return simulated_study.build_study(problem, truth, start, noise, seed, LIMITS)[0]


@pytest.mark.parametrize(
    ("problem", "noise"),
    [
        (room(), None),
        (room(upper=0.8, guess=(1.7, 0.5)), 0.03),  # some estimates of k end on its bound
    ],
    ids=["ordinary", "bound"],
)
def test_monte_carlo_is_the_same_as_single_fits(problem, noise):
    """Those that are no ordinary minima are finished as a single fit is."""
    start = problem.initial_theta
    study = sf.monte_carlo(problem, 20, theta=TRUTH, start=start, noise=noise, seed=3)
    work = work_of(problem, TRUTH, start, noise=noise)
    evaluators = [Evaluator(work.problem_of(k), meshes=work.meshes) for k in range(20)]
    results = [minimize_cost(evaluator, start, "exact", 1e-7, 200) for evaluator in evaluators]
    assert study.success.all()
    np.testing.assert_allclose(study.theta, [result.theta for result in results], rtol=0, atol=1e-8)
    np.testing.assert_allclose(study.cost, [result.cost for result in results], rtol=1e-12)
    np.testing.assert_allclose(study.hessian, [result.hessian for result in results], rtol=1e-7)
    held = np.array([bool(result.active) for result in results])
    assert (4 <= held.sum() <= 16) == (noise == 0.03)
    np.testing.assert_array_equal(study.free, np.where(held, 1, 2))
    assert all("k at its upper bound" in study.message[k] for k in np.flatnonzero(held))
    np.testing.assert_allclose(study.standard_errors[held, 1], 0.0, atol=1e-15)
    assert np.ptp(study.theta[:, 0]) > 1e-3


def test_lockstep_is_the_same_as_one_after_the_other(monkeypatch):
    """As with a GPU: in calls of 16 fits, not of 4096, and only what JAX evaluates."""
    monkeypatch.setattr(layout_module, "CHUNK_IN_LOCKSTEP", 16)
    work = work_of(room(engine="jax"), TRUTH, np.array([1.7, 1.0]))
    values = np.stack([work.draw_run(k)[0, 0] for k in range(12)])
    varying, starts = work.stack_values({(0, 0): values}), work.starts.repeat(12, axis=0)
    one = Batch(work.problem, work.meshes, varying, LIMITS).fit(starts)
    monkeypatch.setattr(layout_module, "has_gpu", lambda: True)
    assert (layout_module.choose_chunk_size(work.problem), layout_module.choose_chunk_size(room())) == (16, 128)
    other = Batch(work.problem, work.meshes, varying, LIMITS).fit(starts)
    natively = Batch(replace(work.problem, engine="auto"), work.meshes, varying, LIMITS).fit(starts)
    np.testing.assert_allclose(one.theta, other.theta, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(one.iterations, other.iterations)
    np.testing.assert_allclose(one.theta, natively.theta, rtol=0, atol=1e-10)


def test_fits_that_do_not_converge_are_listed():
    study = sf.monte_carlo(room(), 5, theta=TRUTH, start=[1.7, 1.0], max_iterations=1)
    assert [run for run, _ in study.failures] == list(range(5))
    assert "Stopped after 1 iteration " in study.failures[0][1]
    assert study.verdict.level == "bad"
    assert study.plot().legends[0].get_title().get_text() == "Fewer than two fits converged: no statistics."


def test_the_intervals_cover_the_truth():
    study = sf.monte_carlo(room(), 400, theta=TRUTH)
    assert np.all(np.abs(study.coverage() - 0.95) < 0.03)
    assert np.all(np.abs(study.bias) < 4 * study.standard_deviation / 20)
    np.testing.assert_allclose(study.standard_errors.mean(0), study.standard_deviation, rtol=0.1)


def test_the_truth_is_the_estimate_if_none_is_given():
    problem = work_of(room(), TRUTH, TRUTH).problem_of(0)
    study = sf.monte_carlo(problem, 2)
    np.testing.assert_allclose(study.truth, sf.estimate(problem).theta, rtol=0, atol=1e-12)


def refused_study(*settings, data=None, **more):
    return lambda: sf.monte_carlo(room(data), *settings, **{"theta": TRUTH, **more})


test_what_is_refused = refused(
    (refused_study(0), "runs must be 1 or more; got 0"),
    (refused_study(noise=-1.0), "noise must be zero or positive"),
    (refused_study(noise=[1.0, 2.0]), "does not fit data of shape"),
    (refused_study(noise=lambda rng, clean, item: clean[:3]), "noise must give finite values of shape"),
    (refused_study(theta=[2.0]), "theta must have shape"),
    (refused_study(data=sf.Measurements(TIMES, np.zeros(24))), "noise must be given"),
    (refused_study(data=sf.RunningCost(lambda t, x, p: x[0] ** 2)), "simulates Measurements: every run needs some"),
    (refused_study(data=sf.ReferenceSignal.from_samples(np.arange(7.0), np.zeros(7))), "and none a ReferenceSignal"),
    (refused_study(client="scheduler:8786"), TypeError, r"client must be a dask\.distributed\.Client; got str"),
    (lambda: sf.multistart(room(), [1.0, 2.0]), r"array of shape \(S, 2\)"),
    (lambda: sf.multistart(room(), [[1.0, 2.0], [1.0, 6.0]]), "start 1 violates: k at its upper bound 5"),
    (lambda: sf.multistart(room(), 0), "starts must be 1 or more"),
    (
        lambda: sf.estimate_many([room(), sf.Problem(ROOM, room().experiments, {"k": sf.Parameter(1.0, fixed=True)})]),
        "problem 1 differs from the first one",
    ),
    (lambda: sf.estimate_many([]), "one problem or more"),
    (lambda: sf.multistart(growing((2.0, 2.0)), [[2.0, 2.0], [2.5, 3.0]]), "cannot be integrated"),
    error=ValueError,
)


def test_a_run_whose_noise_raises_an_error_is_listed():
    def noise(rng, clean, item):
        values = clean + 0.01 * rng.standard_normal(clean.shape)
        lucky = rng.random()
        if lucky < 0.2:
            raise ArithmeticError("no noise today")
        return values if lucky < 0.8 else np.full_like(values, np.nan)

    study = sf.monte_carlo(room(), 40, theta=TRUTH, noise=noise, seed=0)
    failed = study.status == "ERROR"
    assert 4 <= failed.sum() <= 36
    np.testing.assert_array_equal([~study.success, np.isnan(study.cost)], [failed, failed])
    said = " ".join(message for _, message in study.failures)
    assert "ArithmeticError: no noise today" in said
    assert "noise must give finite values of shape (24, 1); got shape (24, 1), not all finite" in said


def test_the_truth_of_a_study_lies_on_its_guard_however_coarse_the_mesh_of_the_guess():
    """x' = -k x meets x = 0.01 at ln(100) / k; the guess of k is slow, and its mesh too coarse for the truth."""
    guards = {("decay", "rest"): lambda t, x, p: x[0] - 0.01}
    system = sf.HybridSystem({"decay": decay, "rest": rest}, [1.0], guards=guards)
    data = sf.Measurements(np.arange(0.1, 6.0, 0.1), np.zeros((59, 1)), sigma=0.01)
    problem = one_run(system, data, ("decay", "rest"), (4.0,), 6.0, {"k": sf.Parameter(1.0, lower=0.1)})
    study = sf.monte_carlo(problem, 1, theta=[0.5, 9.0])
    assert study.truth[0] == pytest.approx(np.log(100) / 9, abs=1e-7)
