"""Many fits: the same as single ones, whatever the data, the order, the chunks, and the machine."""

import os
import signal
import time
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls

import switchfit as sf
from benchmarks.starts.bounces import FALL, ball_on_guards
from support.heated_rooms import ROOM, TIMES, TRUTH, room
from support.models import climb, decay, one_run, refused, rest, slow_guess, temperature
from support.optimizer import minimize, solve_qp
from support.optimizer import rows as linear
from switchfit.batch import batch, simulated_study, starts
from switchfit.batch import layout as layout_module
from switchfit.batch.batch import Batch
from switchfit.batch.chunks import run_chunks
from switchfit.batch.layout import CHUNK
from switchfit.batch.programs import Limits, minimize_fits
from switchfit.fit.local_fit import fit_locally
from switchfit.fit.minimization import minimize_cost
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.models import heater_problem
from switchfit.optimize.least_distance import nearest_feasible
from switchfit.optimize.traced_constraints import TracedBreakpoints, TracedConstraints
from switchfit.optimize.traced_qp import nonnegative_minimum
from switchfit.optimize.traced_sqp import minimize_traced
from switchfit.optimize.traced_state import TracedProblem
from switchfit.problem.functions import use_float64
from switchfit.strategy.random_starts import draw_starts

OTHER = sf.HybridSystem({"on": lambda t, x, p: 2.0 - 2.0 * p["k"] * x, "off": decay}, [0.2])


# The optimiser inside a program


@pytest.mark.parametrize("seed", range(20))
def test_the_dual_programme_against_scipy(seed):
    """min ½ ‖N' lam − g‖² over lam >= 0, dependent rows among them."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((rng.integers(1, 9), rng.integers(1, 6)))
    if seed % 3 == 0:
        rows = np.vstack([rows, rows[:2] + rows[-1]])
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    g = rng.standard_normal(rows.shape[1])
    allowed = rng.random(len(rows)) < 0.8
    with use_float64():
        lam = np.asarray(jax.jit(nonnegative_minimum)(rows @ rows.T, -rows @ g, allowed))
    assert np.all(lam >= 0)
    assert np.all(lam[~allowed] == 0)
    distance = nnls(rows[allowed].T, g)[1] if allowed.any() else np.linalg.norm(g)
    assert np.linalg.norm(g - rows.T @ lam) == pytest.approx(distance, abs=1e-9)


KNOTS = np.arange(0.0, 10.05, 0.5)


def kinked(theta, side, H, centre, weights, xp):
    """½ (theta − c)ᵀ H (theta − c) and weights |theta_i − b| for each knot b."""
    e = theta - centre
    gaps = theta[:, None] - KNOTS[None]
    slopes = xp.where(gaps == 0.0, side, xp.sign(gaps))
    return 0.5 * e @ H @ e + xp.sum(weights * xp.abs(gaps)), H @ e + xp.sum(weights * slopes, axis=1), H


@jax.jit
def fitted_with_kinks(start, H, centre, weights):
    """The traced optimiser on `kinked`, its first two coordinates in order."""
    evaluate = partial(kinked, H=H, centre=centre, weights=weights, xp=jnp)
    constraints = TracedConstraints(jnp.array([[-1.0, 1.0, 0.0]]), jnp.zeros(1), jnp.zeros(3), jnp.full(3, 10.0))
    breakpoints = TracedBreakpoints(np.arange(3), jnp.asarray(np.tile(KNOTS, (3, 1))))
    return minimize_traced(TracedProblem(evaluate, constraints, breakpoints, 1e-9, 200), start)


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_kinks_hold_and_let_go_inside_the_program_too(share):
    """`share` of the kinks are concave: then minima are many, and each must be one from which no step descends."""
    settled, held = 0, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        R = rng.standard_normal((3, 3))
        H, centre = R @ R.T + 0.2 * np.eye(3), np.sort(rng.uniform(1.0, 9.0, 3))
        weights = 10.0 ** rng.uniform(-2, 0.5, (3, 1)) * rng.random((3, KNOTS.size))
        weights *= np.where(rng.random(weights.shape) < share, -1.0, 1.0)
        start = np.sort(np.round(rng.uniform(0.0, 10.0, 3) * 2) / 2 if seed % 2 else rng.uniform(0.0, 10.0, 3))
        with use_float64():
            found = jax.tree.map(np.asarray, fitted_with_kinks(*map(jnp.asarray, (start, H, centre, weights))))
        if not found.settled:
            continue
        settled += 1
        held += found.held.any()
        assert np.isin(found.theta[found.held], KNOTS).all()
        assert np.all((found.left <= 0.0) & (found.gradient >= 0.0) | ~found.held)
        assert found.optimality <= 1e-9

        def at(theta, side, given=(H, centre, weights)):
            cost, gradient, hessian = kinked(theta, side, *given, np)
            return SimpleNamespace(cost=cost, gradient=gradient, hessian=hessian)

        assert found.cost == pytest.approx(at(found.theta, 1).cost, rel=1e-14)
        for v in rng.standard_normal((50, 3)):
            assert at(found.theta + 1e-6 * v, 1).cost >= found.cost - 1e-14 * abs(found.cost)
        if share == 0.0:
            order = linear([[-1.0, 1.0, 0.0]], [0.0], np.zeros(3), np.full(3, 10.0))
            expected = minimize(at, start, constraints=order, breakpoints=[KNOTS] * 3, tolerance=1e-9)
            np.testing.assert_allclose(found.theta, expected.theta, rtol=0, atol=1e-8)
            assert [i for i, _, _ in expected.kinks] == np.flatnonzero(found.held).tolist()
    assert settled >= 45
    assert held >= 20


@pytest.mark.parametrize(
    ("curvature", "centre", "jumps", "held"),
    [(-0.3, 1.9, (0.0, 1.0), True), (1.0, 3.0, (1.0, 1e-8), False), (1.0, 3.0, (1.0, 1e-2), True)],
)
def test_in_the_program_too_a_jump_that_can_be_seen_in_the_cost_holds_an_unknown(curvature, centre, jumps, held):
    """Whatever the curvature along it is."""
    weights = np.zeros((3, KNOTS.size))
    weights[0, [0, 4]] = jumps
    with use_float64():
        given = [1.4, 3.2, 4.0], np.diag([curvature, 1.0, 1.0]), [centre, 3.3, 4.1], weights
        found = jax.tree.map(np.asarray, fitted_with_kinks(*map(jnp.asarray, given)))
    assert found.settled
    np.testing.assert_allclose(found.theta, [2.0, 3.3, 4.1], rtol=1e-12 if held else 1e-7)
    np.testing.assert_array_equal(found.held, [held, False, False])


# The same as single fits


LIMITS = Limits(1e-7, 200)


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


# Many logs


def fit_as_single_ones(problems, rtol):
    """Return the fits of many problems, which must be those of each by itself."""
    fits = sf.estimate_many(problems)
    assert fits.message.tolist() == [""] * len(problems)
    for theta, errors, problem in zip(fits.theta, fits.standard_errors, problems, strict=True):
        single = sf.estimate(problem)
        np.testing.assert_allclose(theta, single.theta, rtol=rtol)
        np.testing.assert_allclose(errors, single.standard_errors, rtol=max(10 * rtol, 1e-6))
    return fits


def test_many_logs_are_the_same_as_single_estimates():
    """Logs of two lengths, one with a missing sample, and two whose horizon is the span of their own data."""
    problems = [room(sf.Measurements(TIMES, measured_room(seed), sigma=0.01)) for seed in range(3)]
    item = problems[1].experiments[0].data[0]
    short = sf.Measurements(item.times[3:16], item.values[3:16], sigma=0.01)
    holes = item.values.copy()
    holes[5] = np.nan
    problems += [room(short), room(replace(item, values=holes))]
    for first in (0.25, 100.0):
        run = sf.Experiment(replace(item, times=item.times - 0.25 + first), ("on", "off"), (first + 1.5,))
        problems.append(replace(problems[0], experiments=run))
    fits = fit_as_single_ones(problems, 1e-8)
    assert fits.samples.tolist() == [24, 24, 24, 13, 23, 24, 24]
    np.testing.assert_allclose(fits.theta[6] - fits.theta[5], [99.75, 0.0], atol=1e-6)


def test_a_log_that_needs_a_finer_mesh_is_done_again_by_itself():
    """The guess is slow and the truth fast: the mesh of the guess is too coarse for one of the logs."""
    problems = [slow_guess(k, 1) for k in (1.0, 12.0, 1.1)]
    fits = fit_as_single_ones(problems, 1e-5)
    on_its_mesh = minimize_cost(evaluator_of(problems[1]), problems[1].initial_theta, "exact", 1e-7, 200)
    assert abs(on_its_mesh.theta[0] - fits.theta[1, 0]) > 1e-5


# Chunks


def test_a_multistart_that_was_stopped_is_doubtful():
    part = sf.multistart(heater_problem(), 2 * CHUNK, callback=lambda done, total: True)
    assert (part.best.verdict.level, part.verdict.level) == ("good", "doubtful")
    assert [reason.kind for reason in part.verdict.reasons] == ["stopped"]
    assert f"noise; stopped, {CHUNK} of {2 * CHUNK} fits were not done: call it again" in str(part.verdict)
    assert "stopped, " in str(replace(part, best=None).verdict)


def test_a_run_that_was_stopped_goes_on_where_it_was(tmp_path):
    settings, seen = {"theta": TRUTH, "seed": 5}, []
    kept = settings | {"folder": tmp_path / "study"}
    partial = sf.monte_carlo(room(), 4 * CHUNK, **kept, callback=lambda done, total: seen.append(done) or True)
    assert len(partial) < 4 * CHUNK
    assert "stopped, " in str(partial)
    assert partial.verdict.reasons[-1].kind == "stopped"
    done = len(list(kept["folder"].iterdir())) * CHUNK
    whole = sf.monte_carlo(room(), 4 * CHUNK, **kept, callback=lambda done, total: seen.append(done))
    assert (*seen[:2], seen[-1]) == (CHUNK, done, 4 * CHUNK)
    np.testing.assert_array_equal(whole.theta, sf.monte_carlo(room(), 4 * CHUNK, **settings).theta)
    np.testing.assert_array_equal(whole.runs, np.arange(4 * CHUNK))


def test_a_folder_of_another_run_is_refused(tmp_path):
    sf.multistart(room(), 2, folder=tmp_path)
    for problem, seed in ((room(), 1), (replace(room(), system=OTHER), 0)):
        with pytest.raises(ValueError, match="holds the results of another run"):
            sf.multistart(problem, 2, folder=tmp_path, seed=seed)


def test_ctrl_c_returns_what_is_done(tmp_path):
    def work(runs):
        if runs.start == 4:
            time.sleep(0.2)  # the others are done by then
            raise KeyboardInterrupt
        return {"value": np.arange(runs.start, runs.stop)}

    work.size, work.fingerprint = 2, lambda: "interrupted"
    runs, arrays = run_chunks(work, 6, folder=tmp_path / "x")
    assert set(runs) <= {0, 1, 2, 3}
    np.testing.assert_array_equal(arrays["value"], runs)


def test_nothing_is_compiled_for_other_limits():
    """Which are obeyed all the same."""
    settings = {"theta": TRUTH, "start": [1.7, 1.0], "seed": 3}
    whole = sf.monte_carlo(room(), 4, **settings)
    count = minimize_fits._cache_size()
    assert not sf.monte_carlo(room(), 4, **settings, max_iterations=1).success.any()
    rough = sf.monte_carlo(room(), 4, **settings, tolerance=1e5)  # the first gradients are larger still
    assert minimize_fits._cache_size() == count
    assert rough.success.all()
    assert rough.iterations.sum() < whole.iterations.sum()


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


@pytest.mark.slow
def test_another_sequence_of_the_same_length_compiles_nothing():
    """What comes when is read at run time."""
    counts = []
    for sequence in (("on", "off", "on"), ("off", "on", "off")):
        run = sf.Experiment(sf.Measurements(TIMES, np.zeros(24), sigma=0.01), sequence, [2.05, 4.1], 0.0, 6.0)
        problem = sf.Problem(ROOM, run, {"k": sf.Parameter(0.8, lower=0.1, upper=5.0)}, max_transitions=3)
        assert sf.monte_carlo(problem, 8, theta=problem.initial_theta).success.any()
        counts.append(minimize_fits._cache_size())
    assert counts[0] == counts[1]


def test_starts_that_differ_in_the_transition_time_alone_end_in_one_minimum():
    noisy = 0.4 + 0.05 * np.random.default_rng(2).standard_normal(24) + 0.3 * (np.abs(TIMES - 2.5) < 1.5)
    study = sf.multistart(room(sf.Measurements(TIMES, noisy, sigma=0.05)), [[tau, 1.0] for tau in (2.9, 3.0, 3.1)])
    assert study.success.all()
    assert np.ptp(study.theta[:, 1]) > 0  # to rounding
    assert study.clusters.tolist() == [0, 0, 0]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_in_the_middle(tmp_path, quick_processes):
    """Two worker processes, one of which is killed after the first chunk: nothing is missing, nothing differs."""
    distributed = pytest.importorskip("distributed")
    alone = sf.monte_carlo(room(), 6 * CHUNK, theta=TRUTH, seed=7)
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, local_directory=str(tmp_path)
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        workers = client.run(os.getpid)
        assert len(set(workers.values())) == 2
        killed = []

        def progress(done, total):
            if not killed:
                killed.append(next(iter(workers.values())))
                os.kill(killed[0], signal.SIGKILL)

        study = sf.monte_carlo(room(), 6 * CHUNK, theta=TRUTH, seed=7, client=client, callback=progress)
    assert killed
    assert len(study) == 6 * CHUNK
    assert study.success.all()
    np.testing.assert_allclose(study.theta, alone.theta, rtol=0, atol=1e-12)


# What one fit raises does not end the others


def look_up(k):
    if np.any(k > 4.0):
        raise ArithmeticError("the table ends below this k")
    return np.zeros(np.shape(k), np.int32)


def table(k):
    """k itself, by way of a function that JAX cannot see into and that raises an error above 4."""
    shape = jax.ShapeDtypeStruct(k.shape, jnp.int32)
    looked_up = jax.pure_callback(look_up, shape, jax.lax.stop_gradient(k), vmap_method="expand_dims")
    return k + looked_up.astype(k.dtype)


FAILING = sf.HybridSystem({"on": lambda t, x, p: p["h"] - table(p["k"]) * x}, [0.2])


def failing_room(seed, guess):
    """A room that is heated all the time, on coarse meshes: those of most guesses are then padded to the same length,
    and share programs.
    """
    values = temperature(TIMES, 9.0, 1.0, TRUTH[1]) + 0.01 * np.random.default_rng(seed).standard_normal(24)
    run = sf.Experiment(sf.Measurements(TIMES, values, sigma=0.01), ("on",), (), 0.0, 6.0)
    parameters = {"h": guess[0], "k": sf.Parameter(guess[1], lower=0.1, upper=9.0)}
    return sf.Problem(FAILING, run, parameters, rtol=1e-5, atol=1e-7)


def measured_room(seed):
    return temperature(TIMES, TRUTH[0], 1.0, TRUTH[1]) + 0.01 * np.random.default_rng(seed).standard_normal(24)


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


def test_a_log_that_raises_an_error_is_listed(monkeypatch, tmp_path):
    monkeypatch.setattr("logging.root.disabled", True)  # what JAX logs about callbacks is not of interest
    problems = [failing_room(seed, guess) for seed, guess in enumerate([(0.9, 1.0), (0.9, 5.0), (1.2, 0.9)])]
    fits = sf.estimate_many(problems, folder=tmp_path)
    assert fits.status.tolist() == ["CONVERGED", "ERROR", "CONVERGED"]
    assert "the table ends below this k" in fits.failures[0][1]
    np.testing.assert_array_equal(fits.start[1], [0.9, 5.0])


def test_an_error_of_the_program_itself_is_said(monkeypatch):
    """It must not pass silently for a model that cannot be evaluated: all fits would take many times as long."""

    def fail(*given, layout):
        raise TypeError("unhashable layout")

    monkeypatch.setattr(batch, "minimize_fits", fail)
    settings = {"theta": TRUTH, "seed": 1}
    with pytest.warns(RuntimeWarning, match=r"failed \(TypeError: unhashable layout\); they are done one by one"):
        study = sf.monte_carlo(room(), 3, **settings)
    monkeypatch.undo()
    np.testing.assert_allclose(study.theta, sf.monte_carlo(room(), 3, **settings).theta, rtol=1e-6)


@pytest.mark.parametrize("name", ["loss", "leak"])
def test_models_with_the_same_machine_code_share_an_operation(name):
    """The second differs from the first in the name of a parameter alone; XLA takes the name of an operation once."""
    system = sf.HybridSystem({"on": lambda t, x, p: 1.5 - p[name] * x, "off": lambda t, x, p: -1.0 * x}, [0.2])
    problem = sf.Problem(system, room().experiments, {name: sf.Parameter(1.0, lower=0.1, upper=5.0)})
    assert sf.monte_carlo(problem, 3, theta=TRUTH).success.all()  # a warning would be an error


# Budgets, and fits that crawl


@pytest.mark.slow
def test_a_fit_that_crawls_towards_a_kink_is_handed_over():
    """Ramps between samples that are few and noisy: most fits end where a transition meets a sample."""
    system = sf.HybridSystem({"rest": rest, "up": climb, "down": lambda t, x, p: 0.0 * x - 1.0}, [0.0])
    data = sf.Measurements(np.linspace(0.5, 6.0, 12), np.zeros(12), sigma=0.4)
    run = sf.Experiment(data, ("rest", "up", "rest", "down"), (1.3, 2.6, 4.3), 0.0, 6.0)
    problem = sf.Problem(system, run, {"v": sf.Parameter(1.0, lower=0.1, upper=4.0)})
    study = sf.monte_carlo(problem, 150, theta=[1.1, 2.8, 4.6, 1.2], start=problem.initial_theta, seed=1)
    assert study.success.all()
    assert np.sum(study.status == "CONVERGED_AT_KINK") > 40
    assert study.evaluations.max() < 200


def test_a_fit_that_is_finished_has_half_the_budget_left(finished):
    """Whatever the program of all fits takes, `minimize` is never left with nothing."""
    study = sf.monte_carlo(room(), 4, theta=TRUTH, start=[1.7, 1.0], max_iterations=6)
    assert finished
    assert min(budget for _, budget in finished) >= 3
    assert study.iterations.max() <= 6


def test_an_end_that_is_out_of_order_by_rounding_is_finished():
    """What the program of all fits leaves behind may violate a constraint by the error of its quadratic programme."""
    problem = room(sf.Measurements(TIMES, measured_room(0), sigma=0.01))
    starts = np.array([[-2.2e-11, 0.9], [6.0 + 1e-9, 0.8], [2.0, 0.8]])
    meshes = evaluator_of(problem).meshes
    found = Batch(problem, meshes, {}, LIMITS).fit(starts)
    assert "ERROR" not in found.status.tolist()
    assert np.all((found.theta[:, 0] >= 0.0) & (found.theta[:, 0] <= 6.0))


def test_what_the_program_does_not_settle_is_fitted_from_its_start(monkeypatch, finished):
    """The program leaves the second fit elsewhere: where it did is not where `minimize` begins."""
    problem = room(sf.Measurements(TIMES, measured_room(0), sigma=0.01))
    meshes, starts = evaluator_of(problem).meshes, np.array([[1.7, 1.0], [2.0, 0.9]])
    expected = Batch(problem, meshes, {}, LIMITS).fit(starts)

    def leave_one(*given, layout):
        outcome = minimize_fits(*given, layout=layout)
        theta, settled = np.array(outcome.theta), np.array(outcome.settled)
        theta[1], settled[1] = [0.0, 5.0], False
        return outcome._replace(theta=theta, settled=settled)

    monkeypatch.setattr(batch, "minimize_fits", leave_one)
    found = Batch(problem, meshes, {}, LIMITS).fit(starts)
    assert finished == [((2.0, 0.9), 200 - expected.iterations[1])], "together they have what was allowed"
    np.testing.assert_allclose(found.theta, expected.theta, rtol=0, atol=1e-8)
    assert found.status.tolist() == ["CONVERGED", "CONVERGED"]
    assert found.iterations[1] > expected.iterations[1]


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_feasible_point_is_that_of_the_quadratic_programme(seed):
    rng = np.random.default_rng(seed)
    d = int(rng.integers(1, 8))
    A = np.diff(np.vstack([np.zeros(d), np.eye(d), np.zeros(d)]), axis=0)
    lower, upper = (np.where(rng.random(d) < 0.3, value, inf) for value, inf in ((1.0, -np.inf), (9.0, np.inf)))
    constraints = linear(A, np.append(np.zeros(d), -10.0), lower, upper)
    theta = rng.uniform(-2.0, 12.0, d)
    if seed % 2:
        theta = np.sort(np.clip(theta, 1.0, 9.0)) - 1e-11 * rng.standard_normal(d)
    found = nearest_feasible(constraints, theta)
    inside = np.full(d, 5.0)
    expected = inside + solve_qp(inside - theta, np.eye(d), constraints.normals, -constraints.slack(inside))[0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)  # a step of 10, whose programme keeps 1e-12 of it
    assert constraints.slack(found).min() >= -1e-14


def test_the_truth_of_a_study_lies_on_its_guard_however_coarse_the_mesh_of_the_guess():
    """x' = -k x meets x = 0.01 at ln(100) / k; the guess of k is slow, and its mesh too coarse for the truth."""
    guards = {("decay", "rest"): lambda t, x, p: x[0] - 0.01}
    system = sf.HybridSystem({"decay": decay, "rest": rest}, [1.0], guards=guards)
    data = sf.Measurements(np.arange(0.1, 6.0, 0.1), np.zeros((59, 1)), sigma=0.01)
    problem = one_run(system, data, ("decay", "rest"), (4.0,), 6.0, {"k": sf.Parameter(1.0, lower=0.1)})
    study = sf.monte_carlo(problem, 1, theta=[0.5, 9.0])
    assert study.truth[0] == pytest.approx(np.log(100) / 9, abs=1e-7)


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


# --- starts that cannot be integrated ---------------------------------------------------------------------------------


def growing(guess):
    """x' = a x², not finite where a < 0, grows without bound within the horizon unless it is stopped in time."""
    modes = {"grow": lambda t, x, p: jnp.sqrt(p["a"]) ** 2 * x**2, "rest": lambda t, x, p: -x}
    times = np.linspace(0.1, 3.0, 30)
    values = np.where(times < 1.0, 1 / (1 - 0.5 * np.minimum(times, 1.0)), 2.0 * np.exp(1.0 - times))
    data = sf.Measurements(times, values + np.random.default_rng(0).normal(0, 0.01, 30), sigma=0.01)
    run = sf.Experiment(data, ("grow", "rest"), guess[:1], 0.0, 3.0)
    return sf.Problem(sf.HybridSystem(modes, [1.0]), run, {"a": sf.Parameter(guess[1], lower=-1.0, upper=4.0)})


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
