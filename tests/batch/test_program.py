"""The optimiser inside a program: programmes, kinks, what is compiled when, and fits that crawl."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls

import switchfit as sf
from support.heated_rooms import LIMITS, ROOM, TIMES, TRUTH, measured_room, room
from support.models import climb, rest
from support.optimizer import minimize, solve_qp
from support.optimizer import rows as linear
from switchfit.batch import batch
from switchfit.batch.batch import Batch
from switchfit.batch.programs import minimize_fits
from switchfit.fit.minimization import minimize_cost
from switchfit.meshes.evaluator import evaluator_of
from switchfit.optimize.least_distance import nearest_feasible
from switchfit.optimize.traced_constraints import TracedBreakpoints, TracedConstraints
from switchfit.optimize.traced_qp import nonnegative_minimum
from switchfit.optimize.traced_sqp import minimize_traced
from switchfit.optimize.traced_state import TracedProblem
from switchfit.problem.functions import use_float64

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
