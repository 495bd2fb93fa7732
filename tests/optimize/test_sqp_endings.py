"""How the SQP ends: saddles, flat directions, undefined regions, wrong gradients, rounding."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.minimized import SEEDS, quadratic, rosenbrock, smooth
from support.optimizer import box, draw_matrix, free, minimize, rows
from switchfit.optimize import Status


def double_well(theta):
    x, y = theta
    return x**4 / 4 - x**2 / 2 + y**2, np.array([x**3 - x, 2 * y]), np.diag([3 * x**2 - 1, 2.0])


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
