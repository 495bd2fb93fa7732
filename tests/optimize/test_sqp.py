"""The SQP on functions with known minimisers: rates, constraints, what is idle, and its callback."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.minimized import SEEDS, assert_feasible, evaluation, quadratic, rosenbrock, smooth
from support.optimizer import box, draw_matrix, free, minimize, rows
from switchfit.optimize import Status

# --- smooth problems --------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(1, 10))
def test_convex_quadratics_over_twelve_decades_take_one_newton_step(seed, d):
    rng = np.random.default_rng(seed)
    H, scale = draw_matrix(rng, np.logspace(0, 3, d), 6)
    centre = rng.normal(size=d) / scale
    result = minimize(quadratic(H, centre), centre + rng.normal(size=d) / scale, constraints=free(d), tolerance=1e-6)
    assert result.status is Status.CONVERGED
    assert result.iterations <= 4
    np.testing.assert_allclose((result.theta - centre) * scale, 0.0, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(2, 6))
def test_constrained_quadratics_satisfy_kkt(seed, d):
    rng = np.random.default_rng(seed)
    R = rng.normal(size=(d, d))
    H = R @ R.T + 0.1 * np.eye(d)
    start = rng.normal(size=d)
    A = rng.normal(size=(2 * d, d))
    constraints = rows(A, A @ start - rng.uniform(0, 1, 2 * d), start - 1.0, start + rng.uniform(0, 1, d))
    result = minimize(quadratic(H, rng.normal(size=d) * 3), start, constraints=constraints, tolerance=1e-9)
    assert result.status.is_strict_minimum, result.status
    assert_feasible(result, constraints)
    lam = result.multipliers
    assert np.all(lam >= 0.0)
    np.testing.assert_allclose(constraints.normals.T @ lam, result.gradient, atol=1e-8)
    assert np.all(np.abs(constraints.slack(result.theta)[lam > 1e-7]) <= 1e-12)


def test_rate_is_quadratic_on_a_face_although_the_full_hessian_is_indefinite():
    # Minimise exp(x) − x − 5 y² + x y over y <= 1: the Hessian has a negative eigenvalue for every y, not on the face.
    def function(theta):
        x, y = theta
        J = np.exp(x) - x - 5 * y**2 + x * y
        return J, np.array([np.exp(x) - 1 + y, -10 * y + x]), np.array([[np.exp(x), 1.0], [1.0, -10.0]])

    constraints = box([-3.0, 0.2], [3.0, 0.9])
    result = minimize(smooth(function), [0.5, 0.5], constraints=constraints, tolerance=1e-13)
    assert result.status.is_strict_minimum
    errors = np.array([abs(record.theta[0] - np.log(0.1)) for record in result.history])
    local = errors[(errors < 0.3) & (errors > 1e-15)]
    assert local.size >= 3
    assert np.all(local[1:] <= 1.0 * local[:-1] ** 2 + 1e-14)
    assert result.active == ("up 1",)
    assert result.multipliers[3] == pytest.approx(9.0 - np.log(0.1), rel=1e-12)
    np.testing.assert_allclose(np.abs(result.free_basis[:, 0]), [1.0, 0.0], atol=1e-15)
    assert result.smallest_eigenvalue == pytest.approx(1.0, rel=1e-9)


# --- constraints ------------------------------------------------------------------------------------------------------


def test_degenerate_coincident_constraints():
    # The solution is at the origin, where five constraints meet in two dimensions, one of them twice.
    A = [[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [2.0, 1.0]]
    constraints = rows(A, np.zeros(5), np.zeros(2), np.full(2, 5.0))
    evaluate = quadratic(np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([-1.0, -2.0]))
    result = minimize(evaluate, [1.0, 3.0], constraints=constraints, tolerance=1e-12, status=Status.CONVERGED)
    np.testing.assert_array_equal(result.theta, 0.0)
    assert result.free_basis.shape == (2, 0)
    np.testing.assert_allclose(constraints.normals.T @ result.multipliers, result.gradient, atol=1e-12)


# --- unknowns on which the cost does not depend -----------------------------------------------------------------------


def test_what_is_idle_is_held_and_its_curvature_not_asked_for():
    """J is flat along (1, 1) where both are equal; what it has there is the error of its evaluation, a ripple."""
    ripple = 1e-9

    def function(theta):
        a, b, c = theta
        cost = (b - a) + (c - 1.0) ** 2 + ripple * np.cos(40 * (a + b))
        s, k = -40 * ripple * np.sin(40 * (a + b)), -1600 * ripple * np.cos(40 * (a + b))
        return cost, [s - 1.0, s + 1.0, 2 * (c - 1.0)], [[k, k, 0.0], [k, k, 0.0], [0.0, 0.0, 2.0]]

    def idle(theta, everything):
        return np.array([theta[0] == theta[1], False, False])

    settings = {"constraints": rows([[-1.0, 1.0, 0.0]], [0.0]), "size": np.ones(3)}
    result = minimize(smooth(function), [0.3, 0.62, 3.0], idle=idle, **settings, status=Status.COLLAPSED)
    assert not result.status.is_strict_minimum
    assert result.idle == (0, 1)
    assert result.optimality < 1e-12
    np.testing.assert_allclose(np.abs(result.free_basis), [[0.0], [0.0], [1.0]], atol=1e-12)
    assert result.smallest_eigenvalue == pytest.approx(1.0)
    assert result.iterations < 10


@pytest.mark.parametrize("hessian", ["auto", "exact"])
def test_a_cost_without_any_curvature(hessian):
    """A constant has neither a gradient nor a Hessian; a plane has no Hessian, and its lowest corner is found."""
    nothing = [[0.0, 0.0], [0.0, 0.0]]
    flat = minimize(smooth(lambda theta: (1.0, [0.0, 0.0], nothing)), [1.0, 2.0], constraints=free(2), hessian=hessian)
    assert flat.status is Status.SINGULAR
    plane = smooth(lambda theta: (theta[0] - 1e-3 * theta[1], [1.0, -1e-3], nothing))
    corner = minimize(plane, [1.0, 2.0], constraints=box([-1.0, -5.0], [4.0, 7.0]), hessian=hessian)
    np.testing.assert_array_equal(corner.theta, [-1.0, 7.0])
    assert corner.status.successful


def test_a_step_back_to_the_point_itself_is_no_progress():
    """Past the iterations after which a failed step may be followed by another one, at the limit of precision."""

    def noisy(theta):
        J, g, H = rosenbrock(theta)
        error = np.random.default_rng(np.frombuffer(theta.tobytes(), np.uint8)).normal(size=2)
        return 1e4 + J, np.asarray(g) + 1e-9 * error, H

    result = minimize(smooth(noisy), [-1.2, 1.0], constraints=free(2), hessian="auto", tolerance=1e-12)
    assert result.status is Status.CONVERGED_PRECISION, result.status
    assert 15 < result.iterations < 60


def test_in_a_narrow_curved_valley_a_step_that_failed_is_followed_by_one_back_to_its_floor():
    """(1 - x)² + 1e4 (y - x²)²: 84 iterations where the trust region shrinks instead."""

    def valley(theta):
        x, y = theta
        J, g, H = rosenbrock(theta)
        more = 9900.0 * (y - x**2)
        steep = np.array([[-4.0 * more + 79200.0 * x**2, -39600.0 * x], [-39600.0 * x, 19800.0]])
        return J + more * (y - x**2), g + np.array([-4.0 * x * more, 2.0 * more]), H + steep

    result = minimize(smooth(valley), [-1.2, 1.0], constraints=free(2), hessian="auto", status=Status.CONVERGED)
    np.testing.assert_allclose(result.theta, 1.0, atol=1e-6)
    assert result.iterations < 40


def test_iterations_the_callback_and_ctrl_c_end_it():
    """With the lowest point so far, also where Ctrl-C comes during an evaluation."""
    calls = []

    def interrupting(theta, side):
        calls.append(theta)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return evaluation(*rosenbrock(theta))

    settings = {"constraints": free(2)}
    few = minimize(smooth(rosenbrock), [-1.2, 1.0], max_iterations=3, **settings)
    interrupted = minimize(interrupting, [-1.2, 1.0], **settings)
    stopped = minimize(smooth(rosenbrock), [-1.2, 1.0], callback=lambda record: record.iteration == 2, **settings)
    assert (few.status, few.iterations) == (Status.MAX_ITERATIONS, 3)
    assert (interrupted.status, stopped.status) == (Status.INTERRUPTED,) * 2
    assert stopped.iterations == 2
    for result in (few, interrupted, stopped):
        assert [record.iteration for record in result.history] == list(range(result.iterations + 1))
        assert result.cost == min(record.cost for record in result.history) < rosenbrock([-1.2, 1.0])[0]
        np.testing.assert_array_equal(result.history[-1].theta, result.theta)


@settings(max_examples=100, deadline=None)
@given(SEEDS, st.integers(1, 5), st.integers(0, 4), st.floats(-18, 0))
def test_far_from_all_constraints_means_that_none_is_active(seed, d, m, log_distance):
    rng = np.random.default_rng(seed)
    A, theta, scale = rng.normal(size=(m, d)), rng.normal(size=d), np.abs(rng.normal(size=d)) * 10.0
    distance = 10.0**log_distance
    constraints = rows(A, A @ theta - distance, theta - distance, theta + 1.0) if m else free(d)
    slack, size = constraints.slack(theta), np.maximum(scale, np.abs(theta))
    if constraints.are_far(slack, float(size.max())):
        assert constraints.active(slack, size).size == 0
    elif m == 0:
        raise AssertionError("nothing is near")
