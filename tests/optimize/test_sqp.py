"""The SQP on functions with known minimisers: rates, constraints, kinks, saddles, and every status."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from support.optimizer import box, draw_matrix, free, minimize, rows
from switchfit.optimize import Status
from switchfit.optimize.first_order import kkt_residual

SEEDS = st.integers(0, 2**32 - 1)


def evaluation(cost, gradient, hessian):
    return SimpleNamespace(cost=cost, gradient=gradient, hessian=hessian)


def ordered(d, gap=0.0, lower=-np.inf, upper=np.inf):
    """theta_1 + gap <= theta_2 and so on, and bounds of all."""
    return rows(np.diff(np.eye(d), axis=0), np.full(d - 1, gap), np.full(d, lower), np.full(d, upper))


def smooth(function):
    """An evaluate callable from theta -> (cost, gradient, hessian)."""

    def evaluate(theta, side):
        return evaluation(*function(theta))

    return evaluate


def quadratic(H, centre, offset=0.0):
    """½ (theta − centre)ᵀ H (theta − centre) + offset."""

    def function(theta):
        e = theta - centre
        return 0.5 * e @ H @ e + offset, H @ e, H

    return smooth(function)


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


def rosenbrock(theta):
    x, y = theta
    J = 100.0 * (y - x**2) ** 2 + (1.0 - x) ** 2
    g = np.array([-400.0 * x * (y - x**2) - 2.0 * (1.0 - x), 200.0 * (y - x**2)])
    return J, g, np.array([[1200.0 * x**2 - 400.0 * y + 2.0, -400.0 * x], [-400.0 * x, 200.0]])


def double_well(theta):
    x, y = theta
    return x**4 / 4 - x**2 / 2 + y**2, np.array([x**3 - x, 2 * y]), np.diag([3 * x**2 - 1, 2.0])


def assert_feasible(result, constraints):
    for record in result.history:
        size = 1.0 + np.abs(constraints.A) @ np.abs(record.theta) + np.abs(constraints.b)
        assert np.all(constraints.A @ record.theta - constraints.b >= -1e-14 * size)
        assert np.all(record.theta >= constraints.lower)
        assert np.all(record.theta <= constraints.upper)


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


# --- kinks ------------------------------------------------------------------------------------------------------------


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


# --- statuses ---------------------------------------------------------------------------------------------------------


BOX = box([0.0, -1.0], [5.0, 1.0])
SMALL = quadratic(1e-9 * np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([1.0, 2.0]), 1e-7)


@pytest.mark.parametrize(
    ("evaluate", "start", "constraints", "expected"),
    [
        (smooth(double_well), [0.0, 0.0], BOX, [1.0, 0.0]),  # a saddle, left to the side that is allowed
        (SMALL, [1.5, 1.5], free(2), [1.0, 2.0]),  # a small cost is not stopped early
        (quadratic(np.array([[2.0, 1.0], [1.0, 2.0]]), np.zeros(2)), [1.0, 3.0],
         box([1.0, -np.inf], [1.0, np.inf]), [1.0, -0.5]),  # an unknown that is fixed
    ],
)  # fmt: skip
def test_where_it_converges(evaluate, start, constraints, expected):
    result = minimize(evaluate, start, constraints=constraints, status=Status.CONVERGED)
    np.testing.assert_allclose(result.theta, expected, rtol=1e-8, atol=1e-12)


def test_a_saddle_that_cannot_be_left_is_reported():
    # The Hessian claims negative curvature that J does not have.
    def function(theta):
        return 1.0 + theta @ theta, 2 * theta, np.diag([-2.0, 2.0])

    result = minimize(smooth(function), [0.0, 0.0], constraints=free(2), status=Status.SADDLE)
    assert not result.status.is_strict_minimum
    assert result.smallest_eigenvalue == pytest.approx(-1.0)


def test_flat_direction_is_singular_and_named():
    def function(theta):
        e = 1e3 * theta[0] + 1e-3 * theta[1] - 1.0
        a = np.array([1e3, 1e-3, 0.0])
        z = np.array([0.0, 0.0, theta[2]])
        return 1.0 + e**2 + theta[2] ** 2, 2 * e * a + 2 * z, 2 * np.outer(a, a) + 2 * np.diag([0.0, 0.0, 1.0])

    result = minimize(smooth(function), [1e-3, 1e3, 1.0], constraints=free(3), status=Status.SINGULAR)
    assert abs(result.smallest_eigenvalue) < 1e-12
    np.testing.assert_allclose(np.abs(result.curvature.spectrum.lowest), [0.0, 1.0, 0.0], atol=1e-5)


def test_infinite_and_undefined_regions_are_backed_away_from():
    def function(theta):
        x = theta[0]
        if x >= 1.0:
            return (np.inf if x < 2.0 else np.nan), np.array([np.nan]), np.full((1, 1), np.nan)
        return -np.log(1 - x) - 3 * x, np.array([1 / (1 - x) - 3]), np.array([[1 / (1 - x) ** 2]])

    result = minimize(smooth(function), [-5.0], constraints=free(1), status=Status.CONVERGED)
    assert result.theta[0] == pytest.approx(2 / 3, rel=1e-8)
    minimize(smooth(function), [1.5], constraints=free(1), status=Status.NONFINITE_START)


@pytest.mark.parametrize("factor", [[-2.0, -2.0], [2.0, -2.0]])
def test_a_gradient_that_is_wrong_is_seen(factor):
    evaluate = smooth(lambda t: (t @ t, np.array(factor) * t, 2 * np.eye(2)))
    result = minimize(evaluate, [1.0, 1.0], constraints=free(2), status=Status.LINE_SEARCH_FAILED)
    assert not result.status.is_strict_minimum
    np.testing.assert_array_equal(result.theta, [1.0, 1.0])
    assert result.reason.kind == "wrong slope"


def unnamed_kink(theta):
    x, y = theta
    cost = 5 * abs(x - 0.3) + (x - 1) ** 2 + (y - x) ** 2
    return cost, [5 * np.sign(x - 0.3) + 2 * (x - 1) - 2 * (y - x), 2 * (y - x)], [[4.0, -2.0], [-2.0, 2.0]]


def jump(theta):
    x, y = theta
    cost = 2.0 * (x > 0.3) + (x - 1) ** 2 + (y - x) ** 2
    return cost, [2 * (x - 1) - 2 * (y - x), 2 * (y - x)], [[4.0, -2.0], [-2.0, 2.0]]


def stairs(theta):
    """Against the slope: over any length differences contradict the slope, which is right between jumps."""
    return 4.0 * np.floor(100 * theta[0]) / 100 + (theta[0] - 1) ** 2, 2 * (theta - 1), [[2.0]]


def far_above_a_jump(theta):
    """J is up to 1e12 at the start: a part of it is more than all that J is at the jump."""
    grown = np.exp(theta[0])
    return grown + 100.0 * (theta[0] < 2.0), [grown], [[grown]]


@pytest.mark.parametrize("hessian", ["auto", "exact"])
@pytest.mark.parametrize(
    ("function", "start", "kind", "place"),
    [
        (unnamed_kink, [0.0, 0.0], "kink", 0.3),
        (jump, [0.0, 0.0], "jump", 0.3),
        (stairs, [0.305], "jump", 0.31),
        (far_above_a_jump, [3.0], "jump", 2.0),
        (far_above_a_jump, [np.log(1e12)], "jump", 2.0),
    ],
)
def test_where_the_line_search_fails_is_seen_and_the_derivatives_are_not_blamed(function, start, kind, place, hessian):
    result = minimize(smooth(function), start, constraints=free(len(start)), hessian=hessian)
    assert result.status is Status.LINE_SEARCH_FAILED
    assert result.reason.kind == kind
    assert np.array(result.reason.places) == pytest.approx(np.array([[0, place]]), rel=1e-6, abs=1e-6)
    if function is jump:
        assert result.reason.figures == pytest.approx({"before": 0.49, "after": 2.49})


def test_rounding_is_that_of_the_terms_of_a_cost_that_are_large():
    """Terms of 1e10 cancel: their rounding is all that J has near its minimum, a million times that of J."""
    rng = np.random.default_rng(1)

    def function(theta):
        x, y = theta
        cost = 1e10 - (1e10 - np.exp(x) - np.exp(-x)) + (y - x) ** 2
        slope = np.exp(x) - np.exp(-x) + 1e-6 * rng.normal()
        return cost, [slope - 2 * (y - x), 2 * (y - x)], [[np.exp(x) + np.exp(-x) + 2, -2.0], [-2.0, 2.0]]

    result = minimize(smooth(function), [20.0, 19.0], constraints=free(2), tolerance=1e-12)
    assert result.status is Status.CONVERGED_PRECISION, result.status
    assert np.abs(result.theta).max() < 1e-4


def test_a_decrease_below_the_rounding_of_the_cost_is_told_as_such():
    def function(theta):  # the Hessian promises a step a million times too long, and J is a large constant
        return 1e12 + 1e-3 * (theta[0] - 1) ** 2, 2e-3 * (theta - 1), np.array([[2e-9]])

    result = minimize(smooth(function), [0.0], constraints=free(1), status=Status.LINE_SEARCH_FAILED)
    assert result.reason.kind == "rounding"
    assert result.reason.figures == pytest.approx({"noise": 4096 * 2.0**-52 * 1e12})


def test_a_line_search_that_failed_begins_anew():
    """One evaluation gives a cost that is too low: nothing nearby is lower, until that point is evaluated again."""
    calls = []

    def function(theta):
        J, g, H = rosenbrock(theta)
        calls.append(theta)
        return J - (1.0 if len(calls) == 8 else 0.0), g, H

    result = minimize(smooth(function), [-1.2, 1.0], constraints=free(2), status=Status.CONVERGED)
    np.testing.assert_allclose(result.theta, 1.0, atol=1e-6)


# --- rounding is measured by the size of the unknowns -----------------------------------------------------------------


def test_a_time_within_rounding_of_the_start_is_at_the_start():
    """tau_1 = 1.6e-30 instead of 0, at a breakpoint there, with a kink: no step along it can be told from none."""
    constraints = rows([[1.0, 0.0], [-1.0, 1.0], [0.0, -1.0]], [0.0, 0.0, -10.0])

    def function(theta):
        a, b = theta
        return 3.0 * a + (b - 4.0) ** 2, [3.0, 2 * (b - 4.0)], [[0.0, 0.0], [0.0, 2.0]]

    nodes = np.linspace(0.0, 10.0, 11)
    settings = {"constraints": constraints, "size": [10.0, 10.0]}
    result = minimize(smooth(function), [1.6e-30, 2.5], breakpoints=[nodes, nodes], **settings, status=Status.CONVERGED)
    assert result.theta[0] == 0.0
    assert result.theta[1] == pytest.approx(4.0)
    assert result.active == ("row 0",)
    # A violation of that size is rounding as well, although tau_1 itself is no larger.
    again = minimize(smooth(function), [-3.8e-14, 2.5], **settings)
    assert again.theta[0] == 0.0


@pytest.mark.parametrize("seed", range(10))
def test_coincident_times_are_equal_bit_for_bit(seed):
    """All of a group that the cost draws to one place end at the same number, whatever rounding did on the way."""
    rng = np.random.default_rng(seed)
    d = 5
    A = np.diff(np.vstack([np.zeros(d), np.eye(d), np.zeros(d)]), axis=0)
    b = np.append(np.zeros(d), -10.0)
    wanted = 5.0 + rng.normal(size=d)[::-1].cumsum()
    start = np.sort(rng.uniform(0.5, 9.5, d))
    result = minimize(quadratic(np.eye(d), wanted), start, constraints=rows(A, b), size=np.full(d, 10.0))
    assert result.status.is_strict_minimum
    gaps = A @ result.theta - b
    assert np.all((gaps == 0.0) | (gaps > 1e-9))
    assert len(result.active) == np.sum(gaps == 0.0)


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


# --- contracts --------------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(1, 6))
def test_a_regular_minimum_has_the_curvature_that_its_status_says(seed, d):
    """At an interior point with a definite programme no eigenvalue is looked at: they are positive all the same."""
    rng = np.random.default_rng(seed)
    H, _ = draw_matrix(rng, 10.0 ** rng.uniform(-13, 1, d))
    result = minimize(quadratic(H, rng.normal(size=d)), rng.normal(size=d), constraints=free(d))
    if result.status is Status.CONVERGED:
        assert result.smallest_eigenvalue > 1e-10
    if result.status is Status.SINGULAR:
        assert result.smallest_eigenvalue <= 1e-10


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
