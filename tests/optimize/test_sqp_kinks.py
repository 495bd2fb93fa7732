"""The SQP at kinks and jumps: which hold, which are left, and with which multipliers."""

from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from support.minimized import SEEDS, assert_feasible, evaluation
from support.optimizer import box, free, minimize, rows
from switchfit.optimize import Status
from switchfit.optimize.first_order import kkt_residual


def ordered(d, gap=0.0, lower=-np.inf, upper=np.inf):
    """theta_1 + gap <= theta_2 and so on, and bounds of all."""
    return rows(np.diff(np.eye(d), axis=0), np.full(d - 1, gap), np.full(d, lower), np.full(d, upper))


def with_kinks(function, breakpoints, weights):
    """Add sum of weights |theta_i − b| to a smooth function; derivatives at b from the side asked for."""

    def evaluate(theta, side):
        J, g, H = function(theta)
        g = np.array(g, float)
        for i, (points, w) in enumerate(zip(breakpoints, weights, strict=True)):
            if len(points):
                e = theta[i] - np.asarray(points)
                J = J + np.sum(w * np.abs(e))
                g[i] += np.sum(w * np.where(e == 0.0, side, np.sign(e)))
        return evaluation(float(J), g, H)

    return evaluate


@pytest.mark.parametrize("start", [-3.0, 0.3, 0.7, 0.70001, 40.0])
@pytest.mark.parametrize("curvature", [0.0, 1e-3, 1.0])
@pytest.mark.parametrize("hessian", ["exact", "none"])
def test_absolute_value_ends_exactly_on_its_kink(start, curvature, hessian):
    def function(theta):
        return 0.5 * curvature * theta[0] ** 2, curvature * theta, np.array([[curvature]])

    evaluate = with_kinks(function, [[0.7]], [1.0])
    result = minimize(evaluate, [start], constraints=free(1), breakpoints=[[0.7]], hessian=hessian)
    assert result.status is Status.CONVERGED_AT_KINK, result.status
    assert result.theta[0] == 0.7
    assert result.optimality == 0.0
    assert result.iterations <= 60
    ((_, left, right),) = result.kinks
    assert (left, right) == pytest.approx((-1.0 + 0.7 * curvature, 1.0 + 0.7 * curvature))


@pytest.mark.parametrize(("weight", "status"), [(1e-7, Status.SINGULAR), (1e-3, Status.CONVERGED_AT_KINK)])
def test_a_jump_that_cannot_be_seen_in_the_cost_holds_nothing(weight, status):
    """Along theta_1 = -theta_2 nothing is determined; a jump by integration error says that theta_1 is."""

    def function(theta):
        e = theta.sum() - 1.0
        return 10.0 + 50.0 * e**2, np.full(2, 100.0 * e), np.full((2, 2), 100.0)

    evaluate = with_kinks(function, [[0.7], []], [np.array([weight]), None])
    result = minimize(evaluate, [0.7, 0.3], constraints=free(2), breakpoints=[[0.7], []])
    assert result.status is status
    assert len(result.kinks) == (weight == 1e-3)


def assert_no_descent(evaluate, result, constraints, breakpoints):
    """First-order optimality by directions: none of many feasible ones decreases J before the next breakpoint."""
    rng = np.random.default_rng(1)
    J = evaluate(result.theta, 1).cost
    slack = constraints.slack(result.theta)
    gaps = [np.abs(np.asarray(p) - x) for p, x in zip(breakpoints, result.theta, strict=True)]
    gap = min(np.min(g[g > 0.0], initial=np.inf) for g in gaps)
    for v in rng.normal(size=(300, result.theta.size)):
        for t in (1e-4, 1e-6):
            t = min(t, 0.5 * gap / np.max(np.abs(v)))
            if np.all(slack + t * (constraints.normals @ v) >= 0.0):
                assert evaluate(result.theta + t * v, 1).cost >= J - 1e-7 * t - 1e-15


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(1, 5))
@example(8678464, 4)  # a pair on a convex and a concave kink descends on the less steep side of the concave one
@example(4137468320, 5)
@example(3692735272, 3)
def test_many_small_kinks_under_constraints(seed, d):
    rng = np.random.default_rng(seed)
    R = rng.normal(size=(d, d))
    H = R @ R.T + 0.2 * np.eye(d)
    centre = np.sort(rng.uniform(0.2, 0.8, d)) * 10
    breakpoints = [np.arange(0.0, 10.01, 0.1)] * d
    weights = [rng.uniform(-1, 1.0, 101) * 10.0 ** rng.uniform(-4, -1) for _ in range(d)]
    evaluate = with_kinks(lambda t: (0.5 * (t - centre) @ H @ (t - centre), H @ (t - centre), H), breakpoints, weights)
    constraints = ordered(d, 0.0, 0.0, 10.0)
    start = np.sort(np.round(rng.uniform(0, 10, d), 1))
    result = minimize(evaluate, start, constraints=constraints, breakpoints=breakpoints)
    assert result.status.is_strict_minimum, result.status
    assert result.iterations <= 60
    assert_feasible(result, constraints)
    assert_no_descent(evaluate, result, constraints, breakpoints)
    for i, left, right in result.kinks:
        assert result.theta[i] in breakpoints[i]
        assert left <= right


def corner(left, right):
    """J = sum of right max(theta, 0) + left min(theta, 0), with all unknowns on their breakpoints at the origin."""

    def evaluate(theta, side):
        chosen = np.where(theta > 0.0, right, np.where(theta < 0.0, left, right if side > 0 else left))
        return evaluation(float(chosen @ theta), chosen, None)

    d = len(left)
    settings = {"constraints": ordered(d), "hessian": "none", "max_iterations": 0}
    return minimize(evaluate, np.zeros(d), breakpoints=[[0.0]] * d, **settings)


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(2, 4))
def test_optimality_at_a_corner_is_the_steepest_descent_over_all_orthants(seed, d):
    rng = np.random.default_rng(seed)
    left, right = rng.integers(-3, 4, (2, d)).astype(float)
    order = np.diff(np.eye(d), axis=0)
    steepest = 0.0
    for signs in product((-1.0, 1.0), repeat=d):
        gradient = np.where(np.array(signs) > 0.0, right, left)
        steepest = max(steepest, kkt_residual(gradient, gradient, np.vstack([order, np.diag(signs)]))[0])
    result = corner(left, right)
    assert result.optimality == pytest.approx(steepest, abs=1e-12)
    assert result.status.is_strict_minimum == (steepest <= 1e-12)


@pytest.mark.parametrize("rounding", [0.0, 1e-16, -1e-16])
@pytest.mark.parametrize("side", [1, -1])
def test_the_multiplier_at_a_concave_kink_is_that_of_the_side_that_is_allowed(side, rounding):
    """J falls with 5 to the side that a row blocks and rises with 3 to the other one; y decides by rounding."""
    slopes = {-side: np.array([5.0 * side, 0.0]), side: np.array([3.0 * side, rounding])}

    def evaluate(theta, to):
        chosen = slopes[to if theta[0] == 0.0 else int(np.sign(theta[0]))]
        return evaluation(float(slopes[side][0] * theta[0]), chosen, np.eye(2))

    settings = {"constraints": rows([[side, 0.0]], [0.0]), "max_iterations": 0}
    result = minimize(evaluate, np.zeros(2), breakpoints=[[0.0], []], **settings)
    np.testing.assert_allclose(result.multipliers, [3.0, 0.0, 0.0, 0.0, 0.0], atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(8, 12))
def test_descent_of_a_long_collapsed_chain_with_concave_kinks_is_seen(seed, d):
    rng = np.random.default_rng(seed)
    middle = np.sort(rng.integers(-3, 4, d)).astype(float)
    jump = rng.integers(-2, 1, d).astype(float)
    jump[int(rng.integers(d))] = 30.0
    left, right = middle - 0.5 * jump - middle.mean(), middle + 0.5 * jump - middle.mean()
    ends = np.tri(d)
    # Feasible directions are sums of these: the last ones to the right, the first ones to the left.
    descends = min((ends.T @ right).min(), (-ends @ left).min()) < -1e-12
    assert (corner(left, right).optimality > 1e-12) == descends


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_collapsed_group_leaves_its_concave_kinks_together(unit):
    # Alone, x would go right and y left, and x <= y blocks both; together they descend to the right.
    def evaluate(theta, side):
        x, y = theta / unit
        a = np.where(theta == 0.0, side, np.sign(theta))
        J = -1.95 * x + 1.45 * y - 0.05 * (abs(x) + abs(y)) + 0.5 * (x**2 + y**2)
        g = np.array([-1.95 + x, 1.45 + y]) - 0.05 * a
        return evaluation(J, g / unit, np.eye(2) / unit**2)

    settings = {"constraints": ordered(2), "tolerance": 1e-9 / unit}
    result = minimize(evaluate, np.zeros(2), breakpoints=[[0.0], [0.0]], **settings, status=Status.CONVERGED)
    np.testing.assert_allclose(result.theta / unit, 0.3, rtol=1e-12)


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(2, 6), st.sampled_from(["exact", "block-diagonal", "none"]))
def test_nonconvex_costs_with_kinks_of_all_sizes(seed, d, hessian):
    rng = np.random.default_rng(seed)
    S = rng.normal(size=(d, d))
    S = S + S.T
    c = rng.normal(size=d)
    breakpoints = [np.unique(np.round(rng.uniform(-1, 1, rng.integers(0, 40)), 2)) for _ in range(d)]
    weights = [rng.uniform(-0.5, 1, p.size) * 10.0 ** rng.uniform(-5, 0.3) for p in breakpoints]

    def function(t):
        return np.sum(t**4) + 0.5 * t @ S @ t + c @ t, 4 * t**3 + S @ t + c, np.diag(12 * t**2) + S

    evaluate = with_kinks(function, breakpoints, weights)
    constraints = ordered(d, 0.01 * (seed % 2), -1.0, 1.0)
    start = np.sort(rng.uniform(-0.9, 0.8, d)) + 0.011 * np.arange(d)
    settings = {"hessian": hessian, "blocks": np.arange(d) // 2, "max_iterations": 5000, "tolerance": 1e-6}
    result = minimize(evaluate, start, constraints=constraints, breakpoints=breakpoints, **settings)
    assert result.status.is_strict_minimum, result.status
    assert_feasible(result, constraints)
    if hessian == "exact":
        assert result.iterations < 50
        costs = [record.cost for record in result.history]
        assert np.all(np.diff(costs) <= 1e-13 * np.abs(costs[0]) + 1e-13)
        assert not result.free_basis.size or result.smallest_eigenvalue > 0.0


def test_breakpoints_on_an_upper_and_on_a_lower_bound_get_the_inner_side_of_each():
    def evaluate(theta, side):
        x, y = theta
        is_left, is_right = x < 1.0 or (x == 1.0 and side < 0), y > 0.0 or (y == 0.0 and side > 0)
        g = np.array([-1.0 if is_left else 5.0, 1.0 if is_right else -7.0])
        return evaluation(float(y - x), g, np.zeros((2, 2)))

    square = box([0.0, 0.0], [1.0, 1.0])
    result = minimize(evaluate, [1.0, 0.0], constraints=square, breakpoints=[[1.0], [0.0]])
    assert result.status.is_strict_minimum
    np.testing.assert_array_equal(result.gradient, [-1.0, 1.0])
    assert result.evaluations == 2
