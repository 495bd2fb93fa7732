"""Equality constraints in the SQP: published and closed answers, SciPy, and what each term of the method is for."""

from collections import namedtuple
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from support.optimizer import box, free, minimize
from switchfit.optimize import Status, merit
from switchfit.optimize.composite_step import find_normal_step, solve_composite
from switchfit.optimize.equalities import Equalities
from switchfit.optimize.qp import Room
from switchfit.problem.functions import use_float64

Here = namedtuple("Here", "cost gradient hessian constraints jacobian")


@cache
def differentiate(cost, constraints):
    """Return `evaluate` of a cost and of a list of constraints written for JAX."""
    stack = lambda x: jnp.stack(constraints(x))  # noqa: E731

    @jax.jit
    def derive(x, multipliers):
        hessian = jax.hessian(lambda x: cost(x) + multipliers @ stack(x))(x)
        return cost(x), jax.grad(cost)(x), hessian, stack(x), jax.jacfwd(stack)(x)

    def evaluate(x, side, multipliers):
        with use_float64():
            found = derive(jnp.asarray(x), jnp.asarray(multipliers))
        return Here(float(found[0]), *map(np.asarray, found[1:]))

    return evaluate


def solve(cost, constraints, start, bounds=None, **settings):
    start = np.array(start, dtype=float)
    with use_float64():
        names = tuple(f"c{i}" for i in range(len(jax.eval_shape(constraints, start))))
    linear = free(len(start)) if bounds is None else bounds
    evaluate = differentiate(cost, constraints)
    return minimize(evaluate, start, constraints=linear, hessian="auto", equalities=names, **settings)


ON_UNIT_CIRCLE = lambda x: [x[0] ** 2 + x[1] ** 2 - 1]  # noqa: E731
ON_CIRCLE = lambda x: [x[0] ** 2 + x[1] ** 2 - 2]  # noqa: E731
"""Of radius sqrt(2): x + y is lowest at (-1, -1), with the multiplier 1/2."""


# --- known answers ----------------------------------------------------------------------------------------------------

# Hock and Schittkowski, Test Examples for Nonlinear Programming Codes, Springer 1981: number, cost, constraints, start,
# lowest cost.
PUBLISHED = {
    40: (
        lambda x: -x[0] * x[1] * x[2] * x[3],
        lambda x: [x[0] ** 3 + x[1] ** 2 - 1, x[0] ** 2 * x[3] - x[2], x[3] ** 2 - x[1]],
        [0.8, 0.8, 0.8, 0.8],
        -0.25,
    ),
    79: (
        lambda x: (x[0] - 1) ** 2 + (x[0] - x[1]) ** 2 + (x[1] - x[2]) ** 2 + (x[2] - x[3]) ** 4 + (x[3] - x[4]) ** 4,
        lambda x: [
            x[0] + x[1] ** 2 + x[2] ** 3 - 2 - 3 * np.sqrt(2),
            x[1] - x[2] ** 2 + x[3] + 2 - 2 * np.sqrt(2),
            x[0] * x[4] - 2,
        ],
        [2.0, 2.0, 2.0, 2.0, 2.0],
        0.0787768209,
    ),
}


@pytest.mark.parametrize("number", PUBLISHED)
def test_published_problems_are_solved_from_their_starts(number):
    cost, constraints, start, lowest = PUBLISHED[number]
    found = solve(cost, constraints, start)
    assert found.status.successful, found.status
    assert found.cost == pytest.approx(lowest, rel=1e-7, abs=1e-12)
    assert max(abs(value) for _, value, _ in found.equalities) < 1e-9
    assert found.violated == ()
    assert found.evaluations < 60


def test_a_published_problem_with_bounds_and_an_inequality():
    """Hock and Schittkowski's 71: the product of four is at least 25, as an equality with a slack."""
    bounds = box([1.0, 1.0, 1.0, 1.0, 0.0], [5.0, 5.0, 5.0, 5.0, np.inf])
    constraints = lambda x: [x[0] * x[1] * x[2] * x[3] - x[4] - 25, jnp.sum(x[:4] ** 2) - 40]  # noqa: E731
    cost = lambda x: x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2]  # noqa: E731
    found = solve(cost, constraints, [1.0, 5.0, 5.0, 1.0, 0.0], bounds, status=Status.CONVERGED)
    assert found.cost == pytest.approx(17.0140173, rel=1e-8)
    assert set(found.active) == {"low 0", "low 4"}
    assert found.free_basis.shape == (5, 1)


def test_multipliers_hessian_and_free_directions_in_closed_form():
    found = solve(lambda x: x[0] + x[1], ON_CIRCLE, [-2.0, 0.5], status=Status.CONVERGED)
    np.testing.assert_allclose(found.theta, [-1.0, -1.0], atol=1e-9)
    assert found.equalities == (("c0", pytest.approx(0.0, abs=1e-9), pytest.approx(0.5, abs=1e-9)),)
    np.testing.assert_allclose(found.hessian, np.eye(2), atol=1e-8)
    np.testing.assert_allclose(np.abs(found.free_basis[:, 0]), np.sqrt([0.5, 0.5]), atol=1e-9)
    assert found.free_basis[0, 0] * found.free_basis[1, 0] < 0


# --- each part of the method ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.05, 0.1, 0.4])
def test_second_order_correction_keeps_full_steps(angle):
    """Maratos' problem ([Nocedal & Wright], example 15.4): near the solution a full step makes both J and c worse."""
    found = solve(lambda x: 2 * (x[0] ** 2 + x[1] ** 2 - 1) - x[0], ON_UNIT_CIRCLE, [np.cos(angle), np.sin(angle)])
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.theta, [1.0, 0.0], atol=1e-8)
    assert found.equalities[0][2] == pytest.approx(-1.5)
    assert all(record.step == 1.0 for record in found.history[1:])


def test_convergence_is_quadratic():
    """The Hessian is that of the Lagrangian: without the constraints' part the steps shrink by a factor."""
    found = solve(*PUBLISHED[40][:3])
    ends = np.array([np.linalg.norm(record.theta - found.theta) for record in found.history])
    small = np.flatnonzero((ends < 1e-2) & (ends > 1e-7))
    assert small.size >= 1
    assert np.all(ends[small + 1] < 10 * ends[small] ** 2 + 1e-12)


def test_the_penalty_is_raised_where_its_first_value_is_too_small():
    """At the start the cost is lowest: the multipliers are 0 there, and so is the first penalty."""
    found = solve(lambda x: 0.5 * jnp.sum(x**2), lambda x: [jnp.exp(x[0]) - 3.0], [0.0, 0.0], status=Status.CONVERGED)
    np.testing.assert_allclose(found.theta, [np.log(3.0), 0.0], atol=1e-10)


def test_linearisations_that_bounds_contradict_are_met_as_far_as_they_can_be():
    """From 0.1 the linearised x² = 4 leads to 20, far outside the bounds."""
    found = solve(lambda x: x[1], lambda x: [x[0] ** 2 - 4, x[1] - x[0]], [0.1, 0.0], box([0, 0], [3, 3]))
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.theta, [2.0, 2.0], atol=1e-9)


def test_constraints_that_say_the_same_twice_are_met():
    found = solve(lambda x: x[0] + x[1], lambda x: [*ON_CIRCLE(x), 3 * ON_CIRCLE(x)[0]], [-2.0, 0.5])
    assert found.status.successful
    np.testing.assert_allclose(found.theta, [-1.0, -1.0], atol=1e-8)


@pytest.mark.parametrize(
    ("constraints", "violated", "evaluations"),
    [
        (lambda x: [x[1] - 1.0, x[0] ** 2 + 1.0], {"c1": 1.0}, 40),  # 53 where a trust region has to vanish
        (lambda x: [x[0] - 1.0, x[0] - 2.0], {"c0": 0.5, "c1": -0.5}, 10),
    ],
)
def test_constraints_that_cannot_be_met_are_named(constraints, violated, evaluations):
    found = solve(lambda x: (x[0] - 3.0) ** 2 + x[1] ** 2, constraints, [2.0, 0.0], status=Status.INFEASIBLE)
    assert not found.status.successful
    assert {name: value for name, value in found.violated if abs(value) > 1e-3} == pytest.approx(violated, abs=1e-3)
    assert found.evaluations < evaluations


def test_constraints_are_not_stuck_where_a_step_reduces_their_violation(monkeypatch):
    """However long it has stayed the same: here, from the first iteration on."""
    monkeypatch.setattr(merit, "STAGNANT", 0)
    found = solve(lambda x: x[0] + x[1], ON_CIRCLE, [3.0, -2.0], status=Status.CONVERGED)
    np.testing.assert_allclose(found.theta, [-1.0, -1.0], atol=1e-7)


def test_a_saddle_on_a_surface_is_left():
    """On the unit circle x² - y² is highest at (1, 0), where a start is stationary, and lowest at (0, 1)."""
    found = solve(lambda x: x[0] ** 2 - x[1] ** 2, ON_UNIT_CIRCLE, [1.0, 0.0], status=Status.CONVERGED)
    np.testing.assert_allclose(np.abs(found.theta), [0.0, 1.0], atol=1e-7)
    assert found.cost == pytest.approx(-1.0)


SURFACE = lambda x, y: (x - y**2, [1.0, -2 * y], np.diag([0.0, -2.0]))  # noqa: E731


def kinked(weight, level, start, surface=SURFACE):
    """Minimize w |x - 1| + (y - level)²/2 on a surface, which is x = y² unless said."""

    def evaluate(z, side, multipliers):
        x, y = z
        gradient = np.array([weight * (np.sign(x - 1.0) or side), y - level])
        c, normal, bend = surface(x, y)
        hessian = np.diag([0.0, 1.0]) + multipliers[0] * bend
        cost = weight * abs(x - 1) + 0.5 * (y - level) ** 2
        return Here(cost, gradient, hessian, np.array([c]), np.array([normal]))

    settings = {"constraints": free(2), "breakpoints": ([1.0], ()), "hessian": "auto", "equalities": ("surface",)}
    return minimize(evaluate, start, **settings)


@pytest.mark.parametrize("start", [(0.3, 0.9), (1.0, 1.0), (2.5, 1.2), (1.0, 0.6)])
def test_a_kink_on_a_surface_holds_the_solution_or_is_passed(start):
    """At the kink, y = 1, the pull is (y - level)/2y: -1/2 is less than the weight 1, and -1 more than 0.2."""
    found = kinked(1.0, 2.0, start)
    assert found.status is Status.CONVERGED_AT_KINK
    assert found.theta.tolist() == [1.0, pytest.approx(1.0, abs=1e-8)]
    assert found.equalities[0][2] == pytest.approx(-0.5, abs=1e-7)
    found = kinked(0.2, 3.0, start)
    assert found.status is Status.CONVERGED
    assert found.theta[1] == pytest.approx(3.0 / 1.4, abs=1e-8)  # y - 3 + 2 y 0.2 = 0


@pytest.mark.parametrize("place", [0.7, 1.3])
@pytest.mark.parametrize("weight", [5.0, -1e-9])
def test_a_kink_is_left_where_constraints_cannot_be_met_on_it(place, weight):
    """With x given: the kink at which the start is holds x, or keeps it to one side."""
    found = kinked(weight, 0.0, [1.0, 0.5], lambda x, y: (x - place, [1.0, 0.0], np.zeros((2, 2))))
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.theta, [place, 0.0], atol=1e-10)
    assert found.equalities[0][2] == pytest.approx(weight * np.sign(1 - place))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_units_of_constraints_and_unknowns_do_not_matter(unit):
    """The same iterations, whatever a constraint and an unknown are measured in."""
    cost, constraints, start, _ = PUBLISHED[79]
    start, scale = np.array(start), np.array([unit, 1.0, 1.0, 1.0, 1.0])
    plain = solve(cost, constraints, start, reach=0.1 * start)
    scaled = lambda x: [100 * unit * c for c in constraints(x / scale)]  # noqa: E731
    settings = {"reach": 0.1 * start * scale, "tolerance": 1e-7 if unit >= 1 else 1e-1}
    found = solve(lambda x: cost(x / scale), scaled, start * scale, **settings)
    assert found.status.successful
    np.testing.assert_allclose(found.theta / scale, plain.theta, rtol=1e-6)
    assert abs(found.iterations - plain.iterations) <= 2


def test_known_multipliers_save_the_second_evaluation_of_the_start():
    cost, constraints, start, _ = PUBLISHED[79]
    found = solve(cost, constraints, start)
    known = np.array([multiplier for _, _, multiplier in found.equalities])
    again = solve(cost, constraints, found.theta + 1e-3)
    resumed = solve(cost, constraints, found.theta + 1e-3, multipliers=known)
    assert (again.history[0].evaluations, resumed.history[0].evaluations) == (2, 1)
    np.testing.assert_allclose(resumed.theta, found.theta, atol=1e-8)
    np.testing.assert_allclose([value[2] for value in resumed.equalities], known, atol=1e-7)
    np.testing.assert_allclose(resumed.hessian, found.hessian, atol=1e-6)
    assert solve(cost, constraints, found.theta, multipliers=known).evaluations == 1
    wrong = solve(cost, constraints, found.theta + 1e-3, multipliers=known + 5.0)
    np.testing.assert_allclose(wrong.theta, found.theta, atol=1e-8)
    np.testing.assert_allclose(wrong.hessian, found.hessian, atol=1e-6)


def test_as_many_constraints_as_unknowns_need_one_evaluation_at_the_start():
    """No direction is left in which curvature counts; the Hessian at the end is that of the Lagrangian all the same."""
    found = solve(lambda x: x[0] * x[1], lambda x: [x[0] ** 2 + x[1] ** 2 - 5.0, x[0] - 2.0], [1.5, 1.5])
    assert found.status is Status.CONVERGED
    assert found.history[0].evaluations == 1
    np.testing.assert_allclose(found.theta, [2.0, 1.0], atol=1e-9)
    (_, _, first), (_, _, second) = found.equalities
    assert (first, second) == pytest.approx((-1.0, 3.0))
    np.testing.assert_allclose(found.hessian, [[2 * first, 1.0], [1.0, 2 * first]], atol=1e-7)


def test_constraints_that_are_not_finite_at_the_start():
    found = solve(lambda x: x[0] ** 2 + 0 * x[1], lambda x: [jnp.log(x[1])], [1.0, -1.0], status=Status.NONFINITE_START)
    assert found.equalities == ()


def test_points_where_constraints_are_not_finite_are_avoided():
    """From 5 a full step of log(x) = 0 leads below 0."""
    found = solve(lambda x: (x[1] - 1) ** 2 + 0 * x[0], lambda x: [jnp.log(x[0])], [5.0, 0.0], status=Status.CONVERGED)
    np.testing.assert_allclose(found.theta, [1.0, 1.0], atol=1e-8)


# --- the composite step -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_composite_steps_satisfy_the_conditions_of_their_programmes(seed):
    """Stationarity, feasibility and signs, also where trust region or bounds leave the constraints unmet."""
    rng = np.random.default_rng(seed)
    d, k = 6, 2
    A, c, g = rng.normal(size=(k, d)), rng.normal(size=k) * 10 ** rng.uniform(-2, 1), rng.normal(size=d)
    root = rng.normal(size=(d, d))
    H = 0.5 * (root + root.T) if seed % 2 else root @ root.T
    N = np.vstack([np.eye(d), -np.eye(d)])
    offsets = -rng.uniform(0.0, 1.0, size=2 * d) * (rng.random(2 * d) > 0.2)
    reach, radius = 10 ** rng.uniform(-1, 1, size=d), 10 ** rng.uniform(-1, 1)
    room = Room(np.eye(d), offsets[:d], -offsets[d:])
    step, _, _ = solve_composite(g, H, Equalities(c, A), room, reach, radius)
    assert np.all(np.abs(step) <= radius * reach * (1 + 1e-9))
    assert np.all(N @ step >= offsets - 1e-9)
    normal = find_normal_step(Equalities(c, A), room, reach, 0.95 * radius)
    low, high = np.maximum(offsets[:d], -0.95 * radius * reach), np.minimum(-offsets[d:], 0.95 * radius * reach)
    best = scipy.optimize.lsq_linear(A, -c, (low - 1e-300, high + 1e-300), method="bvls")
    assert np.linalg.norm(c + A @ normal) == pytest.approx(np.sqrt(2 * best.cost), rel=1e-6, abs=1e-9)
    np.testing.assert_allclose(A @ step, A @ normal, atol=1e-8 * (1 + np.abs(c).max()))
    # Inside the null space the model, made convex, is not lower at the normal step.
    convex = np.all(np.linalg.eigvalsh(H) >= 0)
    model = lambda s: g @ s + 0.5 * s @ H @ s  # noqa: E731
    assert not convex or model(step) <= model(normal) + 1e-9


@pytest.mark.parametrize("seed", range(24, 28))
def test_a_normal_step_stays_where_the_inequalities_allow(seed):
    """Across fewer constraints than unknowns ‖c + A v‖² is flat: a hair in its metric is a long way in the unknowns."""
    rng = np.random.default_rng(seed)
    for _ in range(20):
        jacobian = rng.normal(size=(2, 4)) * 10.0 ** rng.uniform(-4, 1, (2, 1))
        slack = 10.0 ** rng.uniform(-12, 0, 3)
        slack[rng.integers(3)] = 0.0
        reach = 10.0 ** rng.uniform(-2, 1, 4)
        lower, upper = -(10.0 ** rng.uniform(-6, 1, 4)), 10.0 ** rng.uniform(-6, 1, 4)
        order = np.diff(np.eye(4), axis=0)
        room = Room(np.vstack([order, np.eye(4)]), np.append(-slack, lower), np.append(np.full(3, np.inf), upper))
        step = find_normal_step(Equalities(rng.normal(size=2), jacobian), room, reach, 1.0)
        products, size = room.normals @ step, np.max(np.abs(step))
        assert max(np.max(room.lower - products), np.max(products - room.upper)) <= 1e-5 * size
