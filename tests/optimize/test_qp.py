"""The quadratic programme against its KKT conditions, and the algebra around it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.optimizer import draw_matrix, solve_qp
from switchfit.optimize import positive_definite
from switchfit.optimize.curvature import null_space
from switchfit.optimize.dense import Dense
from switchfit.optimize.first_order import kkt_residual
from switchfit.optimize.positive_definite import CholeskyFactor, shift_to_positive
from switchfit.optimize.qp import Room, solve_programme
from switchfit.optimize.symmetric_matrix import diagonal_scaling

SEEDS = st.integers(0, 2**32 - 1)


def convexify(hessian, normals):
    return Dense(hessian).convexify(normals)[0].array


def assert_kkt(g, B, C, c, solution, rtol=1e-9):
    """Stationarity, feasibility, signs and complementarity, in units of the unconstrained step."""
    d, lam = solution
    unit = np.sqrt(np.diag(B))
    terms = np.max((np.abs(g) + np.abs(B) @ np.abs(d) + np.abs(C).T @ lam) / unit)
    assert np.all(np.abs(g + B @ d - C.T @ lam) <= rtol * terms * unit)
    length = np.sqrt(g @ np.linalg.solve(B, g))
    finite = np.isfinite(c)
    size = np.abs(C[finite]) @ (np.abs(d) + length / unit) + np.abs(c[finite])
    gap = C[finite] @ d - c[finite]
    assert np.all(gap >= -rtol * size)
    assert np.all(lam >= 0.0)
    assert np.all(lam[~finite] == 0.0)
    active = lam[finite] > 0.0
    assert np.all(np.abs(gap[active]) <= rtol * size[active])


@settings(max_examples=150, deadline=None)
@given(SEEDS, st.integers(1, 12), st.integers(0, 20), st.floats(0, 10))
def test_kkt_conditions_hold(seed, d, k, log_condition):
    rng = np.random.default_rng(seed)
    B, scale = draw_matrix(rng, np.logspace(0.0, -log_condition, d))
    g = scale * rng.normal(size=d) * 10.0 ** rng.uniform(-8, 8)
    C = rng.normal(size=(k, d)) * scale * 10.0 ** rng.uniform(-4, 4, (k, 1))
    if k > 2 and k % 2:  # one row again, a sum of two, and one without any entry
        C = np.vstack([C[:-1], 3.0 * C[:1], C[:1] + C[1:2], np.zeros((1, d))])
        k += 2
    interior = np.abs(C @ np.linalg.solve(B, g)) * rng.uniform(0, 1, k)
    c = -np.where(rng.uniform(size=k) < 0.3, 0.0, interior)
    assert_kkt(g, B, C, c, solve_qp(g, B, C, c))


def test_where_daqp_fails_the_step_is_none_and_the_residual_the_whole_gradient(monkeypatch):
    monkeypatch.setattr("daqp.solve", lambda *args, **kwargs: (None, None, -4, {}))
    g, B, C, c = np.array([1.0, 2.0]), np.diag([1.0, 4.0]), np.eye(2), np.array([-0.5, -0.1])
    assert not solve_qp(g, B, C, c)[0].any()
    assert kkt_residual(g, g, np.eye(2))[0] == pytest.approx(np.sqrt(5.0))


def test_bounded_step_has_the_multipliers_of_the_closed_form():
    g, B = np.array([-3.0, 5.0]), np.array([[2.0, 0.0], [0.0, 1e-8]])
    C, c = np.vstack([np.eye(2), -np.eye(2)]), np.array([-np.inf, -7.0, -1.0, -np.inf])
    step, multipliers = solve_qp(g, B, C, c)
    np.testing.assert_allclose(step, [1.0, -7.0], rtol=1e-15)
    np.testing.assert_allclose(multipliers, [0.0, 5.0 - 7e-8, 1.0, 0.0], rtol=1e-14)


@pytest.mark.parametrize("matrix", [np.diag([1.0, -1.0]), np.array([[1.0, 2.0], [2.0, 1.0]])])
def test_a_matrix_that_is_not_positive_definite_is_refused(matrix):
    with pytest.raises(ValueError, match="not positive definite; convexify it first"):
        CholeskyFactor.of(matrix)


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(1, 8), st.integers(0, 3))
def test_convexified_matrix_is_positive_definite_and_exact_where_possible(seed, d, k):
    rng = np.random.default_rng(seed)
    H = rng.normal(size=(d, d))
    H = H + H.T
    N = rng.normal(size=(min(k, d), d))
    Z = null_space(N)
    H = H + Z @ Z.T * (np.abs(np.linalg.eigvalsh(H)).max() + 1.0)  # positive definite on the face only
    B = convexify(H, N)
    assert np.linalg.eigvalsh(B)[0] > 0.0
    np.testing.assert_allclose(Z.T @ B @ Z, Z.T @ H @ Z, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("lowest", [-1.0, -1e-11, 0.0, 1e-11, 5e-11, 1e-10])
def test_a_shift_never_lowers_an_eigenvalue_and_the_result_can_be_factorized(lowest):
    shifted, was_positive = shift_to_positive(np.diag([1.0, lowest]))
    assert not was_positive
    assert np.linalg.eigvalsh(shifted)[0] >= max(lowest, 1e-10)
    positive_definite.CholeskyFactor.of(shifted)


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(1, 6))
def test_convexifying_commutes_with_rescaling_the_unknowns(seed, d):
    rng = np.random.default_rng(seed)
    H = rng.normal(size=(d, d))
    H = H + H.T
    S = np.diag(10.0 ** rng.uniform(-6, 6, d))
    B, scaled = convexify(H, np.zeros((0, d))), convexify(S @ H @ S, np.zeros((0, d)))
    unit, size = np.sqrt(np.outer(np.diag(B), np.diag(B))), np.outer(np.diag(S), np.diag(S))
    np.testing.assert_allclose(scaled / size / unit, B / unit, atol=1e-6)


def test_scaling_survives_zero_diagonals():
    assert np.all(diagonal_scaling(Dense(np.zeros((2, 2)))) == 1.0)
    H = np.array([[0.0, 1e6], [1e6, 0.0]])
    D = diagonal_scaling(Dense(H))
    assert np.abs(H / np.outer(D, D)).max() <= 1.0 + 1e-6
    assert np.linalg.eigvalsh(convexify(H, np.zeros((0, 2))))[0] > 1e5


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(1, 6), st.integers(0, 6), st.booleans())
def test_kkt_residual_is_the_distance_to_the_cone(seed, d, k, kink):
    rng = np.random.default_rng(seed)
    N = rng.normal(size=(k, d)) * 10.0 ** rng.uniform(-3, 3, (k, 1))
    low = rng.normal(size=d)
    high = low.copy()
    if kink:
        high[0] += rng.uniform(0.1, 2.0)
    residual, lam = kkt_residual(low, high, N)
    assert np.all(lam >= 0.0)
    value = N.T @ lam
    assert np.linalg.norm(np.clip(value, low, high) - value) == pytest.approx(residual, abs=1e-12)
    # Projection: the residual is orthogonal to what carries a multiplier and leaves the cone from every other row.
    r = np.clip(value, low, high) - value
    unit = N / np.linalg.norm(N, axis=1)[:, None] if k else N
    assert np.all(unit @ r <= 1e-10)
    assert np.all(np.abs((unit @ r)[lam > 1e-8]) <= 1e-10)


@pytest.mark.parametrize("d", [1, 2, 3, 7])
@pytest.mark.parametrize("log_condition", [0.0, 6.0, 11.0])
def test_bounds_and_rows_of_ill_conditioned_programmes(d, log_condition):
    """Of random programmes in a box with a row: the conditions hold, and bounds that press hold exactly."""
    rng = np.random.default_rng(d)
    pressed = 0
    for _ in range(200):
        B, scale = draw_matrix(rng, np.logspace(0.0, -log_condition, d))
        g = scale * rng.standard_normal(d)
        newton = -np.linalg.solve(B, g)
        rows = rng.standard_normal((1, d)) * scale
        wide = np.abs(newton) * 10.0 ** rng.uniform(-3, 1, d)
        low, high = wide * rng.uniform(0.0, 1.0, (2, d))
        offsets = -np.concatenate([np.abs(rows @ newton) * rng.uniform(), low, high])
        normals = np.vstack([rows, np.eye(d), -np.eye(d)])
        if np.all(normals @ newton >= offsets):
            continue
        room = Room(normals[: 1 + d], offsets[: 1 + d], np.append(np.inf, high))
        step, pull = solve_programme(g, B, CholeskyFactor.of(B), room)
        multipliers = np.concatenate([pull[:1], np.maximum(pull[1:], 0.0), np.maximum(-pull[1:], 0.0)])
        assert_kkt(g, B, normals, offsets, (step, multipliers))
        at = multipliers[1:] > 0.0
        np.testing.assert_array_equal((normals[1:] @ step)[at], offsets[1:][at])
        pressed += at.any()
    assert pressed > 50


def test_a_face_that_is_nearly_flat_leaves_a_definite_matrix():
    """Along a collapsed mode J is all but flat; what ties the flat direction to the blocked one is then huge."""
    along, across = np.array([1.0, 1.0, 0.0]) / np.sqrt(2), np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    normals = np.array([[-1.0, 1.0, 0.0]])
    for flat in np.logspace(-12, -2, 200):
        hessian = flat * np.outer(along, along) + np.outer(across, across) + np.diag([0.0, 0.0, 1.0])
        hessian += 0.8 * (np.outer(along, across) + np.outer(across, along))
        B = convexify(hessian, normals)
        unit = np.sqrt(np.diag(B))
        assert np.linalg.eigvalsh(B / np.outer(unit, unit))[0] > 0.0
        assert_kkt(np.ones(3), B, normals, np.zeros(1), solve_qp(np.ones(3), B, normals, np.zeros(1)))
