"""Meshes that follow theta: a block that slides to rest comes to rest elsewhere as soon as the unknowns change."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from benchmarks.sharp.problems import spring
from switchfit.discretization import row_errors, rows, steps
from switchfit.discretization.tableaus import EXPLICIT, EXPLICIT_BEND, EXPLICIT_ERROR, STIFF, STIFF_BEND
from switchfit.engine.native.kernels import JUMP_WEIGHT
from switchfit.engine.native.sizes import Order
from switchfit.meshes import follower
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.meshes.follower import Follower
from switchfit.meshes.refinement import refine_mesh, refine_mesh_of_run
from switchfit.problem.functions import use_float64

G, SLOW = 9.81, 1e-2
TIMES = np.arange(1, 101) * 0.02
TRUTH = {"tau": 0.6, "mu": 0.3, "a": 6.0}


def block(values, guess, runs=1, slow=SLOW, **settings):
    """A block, pushed for a while, then sliding to rest; its position is measured. Runs share friction and push."""

    def friction(v, p):
        return p["mu"] * G * v / jnp.sqrt(v**2 + slow**2)

    modes = {
        "push": lambda t, x, p: jnp.stack([x[1], p["a"] - friction(x[1], p)]),
        "slide": lambda t, x, p: jnp.stack([x[1], -friction(x[1], p)]),
    }
    data = sf.Measurements(TIMES, values, observe=lambda t, x, p: x[:1], sigma=1e-3)
    run = sf.Experiment(data, ("push", "slide"), (guess["tau"],), t0=0.0, tf=2.0)
    parameters = {"mu": guess["mu"], "a": guess["a"]}
    return sf.Problem(sf.HybridSystem(modes, [0.0, slow]), [run] * runs, parameters, **settings)


@pytest.fixture(scope="module")
def measured():
    clean = block(np.zeros((len(TIMES), 1)), TRUTH)
    noise = 1e-3 * np.random.default_rng(0).standard_normal((len(TIMES), 1))
    evaluator = Evaluator(clean).divide(4)
    return evaluator.simulate(clean.initial_theta)[0].seen[0][: len(TIMES)] + noise


@pytest.fixture
def made(monkeypatch):
    """The runs for which a mesh is made anew."""
    runs = []

    def refine(run, *at, **more):
        runs.append(run.e)
        return refine_mesh_of_run(run, *at, **more)

    monkeypatch.setattr(follower, "refine_mesh_of_run", refine)
    return runs


def test_the_errors_of_rows_are_those_of_the_embedded_method():
    """``h sum_j e_j K_j`` of every row, with stages computed anew in NumPy."""
    problem = block(np.zeros((len(TIMES), 1)), TRUTH)
    evaluator, theta = evaluator_of(problem), problem.initial_theta
    path = evaluator.simulate(theta)[0]
    tau, (mu, a) = theta[0], theta[1:]
    largest = np.zeros(2)
    for start, end, x in zip(path.start, path.end, path.before, strict=True):
        h, slopes, states = end - start, [], []
        for weights in EXPLICIT.a:
            X = x + h * sum((w * K for w, K in zip(weights, slopes, strict=False)), np.zeros(2))
            states.append(X)
            slopes.append(np.array([X[1], (end <= tau) * a - mu * G * X[1] / np.sqrt(X[1] ** 2 + SLOW**2)]))
        errors = np.abs(h * EXPLICIT_ERROR @ np.stack(slopes))
        bends = [-mu * G * SLOW**2 / (X[1] ** 2 + SLOW**2) ** 1.5 for X in (states[0], states[-1])]
        f_x = [np.array([[0.0, 1.0], [0.0, bend]]) for bend in bends]
        jumps = JUMP_WEIGHT * row_errors.measure_jump(*judge(h, slopes, states, f_x, EXPLICIT_BEND), np)
        largest = np.maximum(largest, np.maximum(errors, jumps))
    found = evaluator.judge_rows()(theta).row_errors[0]
    # They are made of differences of states, which are of size 1 and have rounding errors.
    errors = evaluator.engines[0].at(Order.HESSIAN)._named["errors"]
    np.testing.assert_allclose(errors, largest, rtol=1e-9, atol=1e-15)
    assert found == pytest.approx((largest / np.abs(path.after).max(axis=0)).max())


def judge(h, slopes, states, f_x, weights):
    """What is read of a row of a field whose slope in t is 0."""
    k = h * np.stack(slopes)
    smooth = 0.5 * h * (f_x[0] + f_x[1]) @ (states[-1] - states[0])
    return k[0], k[len(k) // 2], k[-1], weights @ k, smooth


def measure(f, f_x, tableau, weights, h):
    """The jump of a row of x' = f(t, x) from 1 at 0, whose slope in t is 0 beside jumps."""
    with use_float64():
        found = steps.compute_stages(tableau, lambda t, x: jnp.stack([f(t, x[0])]), 0.0, h, jnp.ones(1))
        found = rows.Stages(*([np.asarray(value) for value in part] for part in found))
    slopes = [np.array([[f_x(found.times[j], found.states[j][0])]]) for j in (0, -1)]
    return float(row_errors.measure_jump(*judge(h, found.slopes, found.states, slopes, weights), np)[0])


@pytest.mark.parametrize(("tableau", "weights"), [(EXPLICIT, EXPLICIT_BEND), (STIFF, STIFF_BEND)])
def test_a_jump_inside_a_row_is_seen_however_short_the_row_is(tableau, weights):
    for jump in (0.2, 0.4, 0.6, 0.9):
        for h in (1.0, 1e-6):
            field = lambda t, x, at=jump * h: jnp.where(t > at, 1.0, -1.0)  # noqa: E731
            assert 0.8 * h < measure(field, lambda t, x: 0.0, tableau, weights, h) < 7.0 * h
    for h in (0.1, 1.0, 2.0):  # the derivative explains a decay, also where the row is too long for it
        assert measure(lambda t, x: -4.0 * x, lambda t, x: -4.0, tableau, weights, h) == 0.0
        assert measure(lambda t, x: -(x**2), lambda t, x: -2.0 * x, tableau, weights, h) == 0.0


@pytest.fixture
def far(measured):
    """Guesses at which the block comes to rest elsewhere."""
    return block(measured, {"tau": 0.8, "mu": 0.4, "a": 7.0})


def test_a_point_that_the_mesh_does_not_suit_gets_one_of_its_own(far):
    """The mesh of the guess has J wrong by far at another theta."""
    there = np.array([0.6, 0.3, 6.0])
    follower = Follower(evaluator_of(far))
    right = Evaluator(far, there).divide(4).cost(there)
    assert abs(evaluator_of(far).cost(there) - right) > 1e-3 * right
    found = follower(there)
    assert found.cost == pytest.approx(right, rel=1e-6)
    assert follower.evaluator is evaluator_of(far)  # the point is a trial so far
    follower.accept(there, found.cost)
    np.testing.assert_array_equal(follower.evaluator.meshes[0].times, refine_mesh(far, 0, there).times)
    assert follower(there).cost == found.cost


def test_the_block_is_found_from_far_guesses(far):
    starts = [0.8, 0.4, 7.0], [0.45, 0.22, 7.5], [0.75, 0.25, 4.5]
    costs = [sf.estimate(far, strategy="local", start=start).cost for start in starts]
    np.testing.assert_allclose(costs, costs[0], atol=1e-5)
    assert costs[0] < 70.0  # half of chi-square for 100 samples


def test_the_hessian_gives_way_where_a_thin_layer_is_only_passed():
    """A mass on a spring reverses within 1e-6 m/s of friction: with the Hessian, steps are a thousandth as long."""
    case = spring()
    problem, starts = case.build_problem(), case.draw_starts(99)
    for start in starts[[7, 19, 44, 89, 98]]:
        fit = sf.estimate(problem, strategy="local", start=start)
        assert fit.verdict.level == "good"
        assert fit.hessian_kind == "sharp"
        assert fit.iterations < 20
        assert (np.abs(fit.theta - case.truth) < 4.0 * fit.standard_errors).all()


def test_a_hessian_that_misjudges_a_step_stays_if_halved_cells_have_it_too(measured):
    """As in a curved valley, or where a transition passes samples."""
    problem = block(measured, TRUTH)
    follower, theta = Follower(evaluator_of(problem)), problem.initial_theta
    found = follower(theta)
    step = -found.gradient * (found.gradient @ found.gradient) / (found.gradient @ found.hessian @ found.gradient)
    straight = replace(found, cost=found.cost + float(found.gradient @ step))
    assert not follower._is_hessian_wrong(theta, found, theta + step, straight)


def test_a_trial_that_cannot_be_integrated_is_refused():
    """x' = r x² grows without bound: for a large r before the end."""
    system = sf.HybridSystem({"grow": lambda t, x, p: p["r"] * x**2}, [1.0])
    data = sf.Measurements(np.linspace(0.1, 1.0, 10), np.ones((10, 1)), sigma=0.1)
    problem = sf.Problem(system, sf.Experiment(data, ("grow",), (), t0=0.0, tf=1.0), {"r": 0.1})
    assert not np.isfinite(Follower(evaluator_of(problem))(np.array([1.5])).cost)


def test_only_the_runs_that_need_it_get_another_mesh(measured, made):
    problem = block(measured, TRUTH, runs=2)
    follower = Follower(evaluator_of(problem))
    theta = problem.initial_theta.copy()
    follower(theta)
    assert not made
    theta[1] = 0.45  # the second run's transition
    follower(theta)
    assert made == [1]


def test_meshes_of_smooth_models_stay(made):
    """A fit of a smooth model from a fair guess makes no mesh anew."""
    decay = sf.HybridSystem({"fast": lambda t, x, p: -p["a"] * x, "slow": lambda t, x, p: -p["b"] * x}, [1.0])
    times = np.linspace(0.1, 4.0, 40)
    values = np.where(times < 1.55, np.exp(-times), np.exp(-1.55 - 0.3 * (times - 1.55)))[:, None]
    run = sf.Experiment(sf.Measurements(times, values, sigma=0.01), ("fast", "slow"), (1.2,), t0=0.0, tf=4.0)
    fit = sf.estimate(sf.Problem(decay, run, {"a": 0.8, "b": 0.5}), strategy="local")
    np.testing.assert_allclose(fit.theta, [1.55, 1.0, 0.3], rtol=1e-6)
    assert not made


def test_a_loose_tolerance_does_not_make_meshes_for_ever(measured, made):
    problem = block(measured, TRUTH, rtol=1e-2, atol=1e-3)
    follower = Follower(evaluator_of(problem))
    for mu in (0.3, 0.31, 0.32, 0.33):
        theta = np.array([0.6, mu, 6.0])
        follower.accept(theta, follower(theta).cost)
    assert len(made) <= 3  # of four points; two, and one where the layer lies inside a row


def test_intervals_of_times_are_not_too_narrow_where_a_layer_moves():
    """On one mesh J rises with the first step of tau, since the layer leaves its short cells: a profile ends there."""
    ahead, after = 6.0 - 0.3 * G, 0.3 * G
    speed = 0.6 * ahead
    sliding = np.minimum(TIMES - 0.6, speed / after)
    exact = np.where(TIMES < 0.6, 0.5 * ahead * TIMES**2, 0.18 * ahead + speed * sliding - 0.5 * after * sliding**2)
    values = (exact + 1e-3 * np.random.default_rng(0).standard_normal(len(TIMES)))[:, None]
    fit = sf.estimate(block(values, TRUTH, slow=1e-6), strategy="local")
    low, high = fit.confidence_intervals(0.95)[0]
    np.testing.assert_allclose(high - low, 2 * 1.96 * fit.standard_errors[0], rtol=0.02)
    assert low < 0.6 < high
