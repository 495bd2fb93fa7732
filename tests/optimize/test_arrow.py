"""The algebra of arrow-shaped Hessians, against that of full matrices."""

from types import SimpleNamespace

import numpy as np
import pytest

from support.optimizer import box, minimize, rows, solve_qp
from switchfit.optimize.arrow import Arrow, ArrowFactor, ArrowLayout
from switchfit.optimize.curvature import null_space
from switchfit.optimize.dense import Dense
from switchfit.optimize.qp import Room
from switchfit.optimize.symmetric_matrix import diagonal_scaling

PLACES = [np.array([0, 1, 2, 9, 10]), np.array([3, 4, 9, 10]), np.array([5, 6, 7, 10, 9]), np.array([8, 9])]
LAYOUT = ArrowLayout.of(11, PLACES)
"""Four runs with 3, 2, 3 and 1 unknowns of their own; two are shared."""


def arrow_of(full):
    """The arrow that holds a full matrix of its shape."""
    extended = np.pad(full, (0, 1))
    own, shared = LAYOUT.own, LAYOUT.shared
    padding = (own == 11)[:, :, None] * np.eye(own.shape[1])
    blocks, borders = extended[own[:, :, None], own[:, None, :]] + padding, extended[own[:, :, None], shared]
    return Arrow(LAYOUT, blocks, borders, full[np.ix_(shared, shared)])


def random_matrix(rng, lowest=None):
    """Of the arrow's shape; shifted to a given smallest eigenvalue if one is named."""
    full = rng.normal(size=(11, 11)) * rng.choice([0.1, 1.0, 10.0], size=(11, 1))
    full = full + full.T
    run = np.full(11, -1)
    for e, own in enumerate(LAYOUT.own):
        run[own[own < 11]] = e
    full[(run[:, None] != run) & (run[:, None] >= 0) & (run >= 0)] = 0.0
    return full if lowest is None else full + (lowest - np.linalg.eigvalsh(full)[0]) * np.eye(11)


@pytest.mark.parametrize("seed", range(5))
def test_operations_are_those_of_the_full_matrix(seed):
    rng = np.random.default_rng(seed)
    full, other = random_matrix(rng), random_matrix(rng)
    arrow = arrow_of(full)
    vector, scaling, free = rng.normal(size=11), rng.uniform(0.1, 9.0, 11), rng.random(11) > 0.3
    labels, sides = rng.integers(0, 2, 11).astype(float), rng.integers(-1, 2, 11).astype(float)
    np.testing.assert_array_equal(arrow.dense(), full)
    np.testing.assert_allclose(arrow.dot(vector), full @ vector, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(arrow.diagonal(), np.diag(full))
    np.testing.assert_array_equal(arrow.absolute().dense(), abs(full))
    np.testing.assert_array_equal(arrow.absolute().largest_in_rows(), abs(full).max(1))
    np.testing.assert_allclose(arrow.scale(scaling).dense(), full / np.outer(scaling, scaling), rtol=1e-12)
    np.testing.assert_array_equal(arrow.held(free).dense(), np.where(np.outer(free, free), full, np.diag(1.0 - free)))
    np.testing.assert_array_equal(arrow.mask(labels).dense(), full * (labels[:, None] == labels))
    pair = sides[:, None] + sides
    mixed = np.where(pair > 0, full, np.where(pair < 0, other, 0.5 * (full + other)))
    np.testing.assert_allclose(arrow.mix_sides(arrow_of(other), sides).dense(), mixed, rtol=1e-14)
    floor = rng.uniform(0.0, 1.0, 11)
    np.testing.assert_allclose(diagonal_scaling(arrow, floor), diagonal_scaling(Dense(full), floor), rtol=1e-12)
    assert arrow.finite
    assert not arrow_of(np.where(full == full[0, 0], np.nan, full)).finite


ORDERED = np.zeros((4, 11))
ORDERED[[0, 1], [1, 2]], ORDERED[[0, 1], [0, 1]] = 1.0, -1.0  # theta_0 <= theta_1 <= theta_2
ORDERED[2, 4], ORDERED[2, 3] = 1.0, -1.0
ORDERED[3, 6], ORDERED[3, 5] = 1.0, -1.0


@pytest.mark.parametrize("seed", range(40))
def test_quadratic_programmes(seed):
    """The solution of the full programme, from none of the constraints active to nearly all."""
    rng = np.random.default_rng(seed)
    full, gradient = random_matrix(rng, lowest=10.0 ** rng.uniform(-4, 1)), rng.normal(size=11)
    wide = 10.0 ** rng.uniform(-3, 2)
    lower, upper = -wide * rng.random(11), wide * rng.random(11)
    slack = wide * rng.random(4) * (rng.random(4) > 0.3)
    normals, offsets = np.vstack([ORDERED, np.eye(11), -np.eye(11)]), np.concatenate([-slack, lower, -upper])
    expected, _ = solve_qp(gradient, full, normals, offsets)
    room = Room(normals[:15], offsets[:15], np.append(np.full(4, np.inf), upper))
    step, pull = arrow_of(full).solve(gradient, ArrowFactor.of(arrow_of(full)), room)
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(step, expected, atol=1e-8 * size)
    np.testing.assert_allclose(full @ step + gradient, room.normals.T @ pull, atol=1e-8)
    assert np.all(pull[room.normals @ step > room.lower + 1e-8 * size] <= 0.0)
    assert np.all(pull[room.normals @ step < room.upper - 1e-8 * size] >= 0.0)
    assert np.all(normals @ step - offsets >= -1e-11 * size)


NONE, NO_FLOOR = np.zeros((0, 11)), np.zeros(11)


def test_an_indefinite_block_leaves_the_shared_unknowns_their_curvature():
    """In place of -1e-4 its eigenvalue is made 1e-2, not 1e-4: the shared unknown gets a curvature of 49, not 5000."""
    full = np.eye(11)
    full[0, 0], full[0, 9], full[9, 0] = -1e-4, 0.5, 0.5
    convex = arrow_of(full).convexify(NONE, NO_FLOOR)[0].dense()
    assert convex[0, 0] > 5e-3
    assert convex[9, 9] < 100.0
    assert np.linalg.eigvalsh(convex)[0] > 0.0


@pytest.mark.parametrize("seed", range(20))
def test_curvature_on_the_face_of_active_constraints_is_kept(seed):
    """H is indefinite only across the active constraints: Newton's step along them must not be spoiled."""
    rng = np.random.default_rng(seed)
    normals = np.zeros((4, 11))
    normals[0], normals[1, 3], normals[2, 5], normals[3, 9] = ORDERED[0], 1.0, -1.0, 1.0
    chosen = normals[rng.random(4) > 0.3] if seed else normals
    Z = null_space(chosen)
    full = random_matrix(rng, lowest=0.2)
    for n in chosen:
        full -= rng.uniform(0.1, 30.0) * np.outer(n, n)  # of the arrow's shape, and nothing on the face
    convex = arrow_of(full).convexify(chosen, NO_FLOOR)[0].dense()
    assert np.linalg.eigvalsh(convex)[0] > 0.0
    np.testing.assert_allclose(Z.T @ convex @ Z, Z.T @ full @ Z, rtol=1e-9, atol=1e-9)
    assert Z.shape[1] == 11 - len(chosen)


def test_curvature_beside_bounds_needs_no_full_matrix(monkeypatch):
    bounds = np.eye(11)[[3, 9]]
    arrow, none = arrow_of(random_matrix(np.random.default_rng(1), lowest=0.2)), np.zeros(11, dtype=bool)
    expected = Dense(arrow.dense()).curvature(bounds, none, NO_FLOOR)
    monkeypatch.delattr(Arrow, "dense")
    found = arrow.curvature(bounds, none, NO_FLOOR)
    np.testing.assert_allclose(found.basis @ found.basis.T, expected.basis @ expected.basis.T, atol=1e-12)
    assert found.spectrum.smallest > 0.0 < expected.spectrum.smallest


BOX = box(np.full(11, -9.0), np.full(11, 9.0))


def minimize_both(function, start, **settings):
    """The results with full matrices and with arrows of a function that returns J, g and H in full."""

    def build(arrow):
        def evaluate(theta, side):
            J, g, H = function(theta, side)
            return SimpleNamespace(cost=J, gradient=g, hessian=arrow_of(H) if arrow else H)

        return evaluate

    return (minimize(build(arrow), start, **{"constraints": BOX} | settings) for arrow in (False, True))


def rugged(theta, side):
    """A sum over runs, not convex away from its minimum, with unknowns of each run's own and two shared ones."""
    J, g, H = 0.0, np.zeros(11), np.zeros((11, 11))
    for e, places in enumerate(PLACES):
        z = theta[places]
        a = np.cos(np.arange(len(places)) + e)
        s = a @ z
        J += np.cosh(0.1 * s) + 0.5 * z @ z - np.cos(2.0 * z).sum()
        g[places] += 0.1 * np.sinh(0.1 * s) * a + z + 2.0 * np.sin(2.0 * z)
        H[np.ix_(places, places)] += 0.01 * np.cosh(0.1 * s) * np.outer(a, a) + np.diag(1.0 + 4.0 * np.cos(2.0 * z))
    return J, g, H


@pytest.mark.parametrize("seed", range(6))
def test_the_optimiser_ends_where_it_does_with_full_matrices(seed):
    """From where it is convex at the same point by the same steps; from elsewhere at a regular minimum too."""
    rng = np.random.default_rng(seed)
    lower = np.where(rng.random(11) < 0.3, 0.05, -9.0)
    constraints = rows(ORDERED, np.zeros(4), lower, np.full(11, 9.0))
    for size in (0.3, 3.0):
        start = np.maximum(np.sort(size * rng.random(11)), lower)
        full, arrow = minimize_both(rugged, start, constraints=constraints)
        assert arrow.status.is_strict_minimum, arrow.status
        assert arrow.optimality < 1e-7
        if size < 1.0:
            np.testing.assert_allclose(arrow.theta, full.theta, atol=1e-9)
            assert arrow.active == full.active
            assert arrow.iterations == full.iterations
            assert full.smallest_eigenvalue > 1e-10
            assert arrow.smallest_eigenvalue in (np.inf, pytest.approx(full.smallest_eigenvalue, rel=1e-5))
        np.testing.assert_allclose(arrow.hessian, rugged(arrow.theta, 1)[2], rtol=1e-12)


@pytest.mark.parametrize("seed", range(12))
def test_coordinates_are_released_from_kinks(seed):
    """From a start on five kinks, some of which hold and some of which give way because others move."""
    rng = np.random.default_rng(seed)
    places, marks = rng.choice(11, 5, replace=False), rng.uniform(-0.3, 0.3, 5)
    weights = 10.0 ** rng.uniform(-2, 0.5, 5)
    full_matrix, pull = random_matrix(rng, lowest=0.2), rng.normal(size=11)

    def kinked(theta, side):
        H = full_matrix
        away = theta[places] - marks
        sign = np.where(away == 0.0, side, np.sign(away))
        gradient = H @ theta + pull
        gradient[places] += weights * sign
        return 0.5 * theta @ H @ theta + pull @ theta + weights @ np.abs(away), gradient, H

    start = np.zeros(11)
    start[places] = marks
    full, arrow = minimize_both(kinked, start, breakpoints=[np.sort(marks[places == i]) for i in range(11)])
    assert arrow.status.is_strict_minimum
    assert arrow.status is full.status
    assert arrow.iterations == full.iterations
    assert arrow.evaluations == full.evaluations
    np.testing.assert_allclose(arrow.theta, full.theta, rtol=1e-7, atol=1e-8)
