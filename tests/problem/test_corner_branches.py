"""Corners inside a mode are found, each once, and a branch is the mode on the sides of its corners."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.sharp_modes import HEIGHTS, KNOTS, problem_of, still
from switchfit.engine.corners.branch_functions import trace_for_numpy
from switchfit.engine.native.sizes import Order, Sizes
from switchfit.engine.native.templates import Templates
from switchfit.problem.corners.branches import find_corners
from switchfit.problem.functions import use_float64


def corners_of(mode, inputs=None, n=2):
    problem = problem_of(mode, np.ones(n), {"w": 0.7}, tf=1.0, count=1, inputs=inputs)
    return find_corners(problem.structures[0].modes[0])


def stacked(first):
    """A mode of two states whose first slope is a function of the state and p."""
    return lambda t, x, p: jnp.stack([first(x, p), -x[0]])


MODES = {
    "sign": (lambda x, p: -p["w"] * jnp.sign(x[0]), 1),
    "abs": (lambda x, p: p["w"] * jnp.abs(x[0] - x[1]), 1),
    "maximum": (lambda x, p: jnp.maximum(x[0] * p["w"], x[1] ** 2), 1),
    "minimum": (lambda x, p: jnp.minimum(0.3, x[0] * x[1]), 1),
    "the same twice": (lambda x, p: jnp.where(x[0] < 0, x[1], 2.0) + jnp.maximum(x[0], 0.0), 1),
    "the same the other way round": (lambda x, p: jnp.where(x[0] > 0, x[1], 2.0) + jnp.minimum(0.0, x[0]), 1),
    "two states both ways": (lambda x, p: jnp.where(x[0] > x[1], x[0], 1.0) * jnp.where(x[1] >= x[0], 2.0, 1.0), 1),
    "nested": (lambda x, p: jnp.where(x[0] > 0, jnp.where(x[1] <= p["w"], x[1] ** 2, 2.0), 3.0), 2),
    "both of two": (lambda x, p: jnp.where((x[0] > 0) & (x[1] > 0), x[0] * x[1], 0.0), 2),
    "select": (lambda x, p: jnp.select([x[0] > 1, x[0] > 0], [x[0], x[1]], 0.0), 2),
    "dead zone": (lambda x, p: jnp.sign(x[0]) * jnp.maximum(jnp.abs(x[0]) - p["w"], 0.0), 2),
    "clip": (lambda x, p: jnp.clip(x[0], -p["w"], p["w"]), 2),
    "clamp": (lambda x, p: jax.lax.clamp(-p["w"], x[0], p["w"]), 2),
    "relu": (lambda x, p: jax.nn.relu(x[0] - x[1]), 1),
    "cond": (lambda x, p: jax.lax.cond(x[0] > p["w"], lambda x: x[1], lambda x: x[0] * x[1], x), 1),
    "corners of cases": (
        lambda x, p: jax.lax.cond(x[0] > 0.3, lambda: jnp.abs(x[1]), lambda: jnp.maximum(x[1] - 0.2, p["w"] * x[0])),
        3,
    ),
    "inside jit": (lambda x, p: jax.jit(lambda y: jnp.where(y > 0, y, y**2))(x[0]), 1),
    "interp": (lambda x, p: jnp.interp(x[0], KNOTS, HEIGHTS), 4),
    "interp with an unknown height": (lambda x, p: jnp.interp(x[0], KNOTS, HEIGHTS * p["w"]), 4),
    "one condition for a vector": (lambda x, p: jnp.where(x[0] > p["w"], x, x**2)[1], 1),
    "entries of a vector": (lambda x, p: jnp.sum(jnp.abs(x) * jnp.array([1.0, 2.0])), 2),
}
"""Slopes of (x, p), and how many corners they have."""


def sides_at(corners, given):
    """The sides at a point; where an operation is inside another, its g depends on the side of the other."""
    sides = (1,) * corners.count
    for _ in range(corners.count + 1):
        sides = tuple(np.where(np.asarray(corners.surfaces(sides).evaluate(given)) > 0, 1, -1).tolist())
    return sides


@pytest.mark.parametrize("name", MODES)
def test_each_corner_is_found_once_and_a_branch_is_the_mode_on_its_sides(name):
    """With its derivatives; and it has no corner that could be crossed, wherever the state is."""
    slope, count = MODES[name]
    corners = corners_of(stacked(slope))
    assert corners.count == count
    assert all(line.startswith("test_corner_branches.py:") for line in corners.lines)
    mode, seen = corners.function, set()
    rng = np.random.default_rng(3)
    w = [np.array(0.7)] * len(mode.parameters)
    with use_float64():
        for _ in range(12):
            x = 1.5 * rng.standard_normal(2)
            sides = sides_at(corners, [0.3, x, *w])
            branch = corners.branch(sides)
            if sides not in seen:
                assert find_corners(branch).count == 0
                seen.add(sides)
            np.testing.assert_array_equal(branch.evaluate([0.3, x, *w]), mode.evaluate([0.3, x, *w]))
            found, expected = (jax.jacfwd(lambda x, f=f: f.evaluate([0.3, x, *w]))(x) for f in (branch, mode))
            np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-14)
    assert len(seen) > 1


def test_what_does_not_change_with_the_state_has_no_corner():
    assert corners_of(stacked(lambda x, p: -p["w"] * x[0] * jnp.sin(x[1]))).count == 0
    assert corners_of(lambda t, x, p: jnp.where(t > p["w"], 1.0, -1.0) * jnp.maximum(p["w"], 0.0) * x).count == 0
    inputs = sf.Input(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    assert corners_of(lambda t, x, p, u: jnp.abs(u - p["w"]) * jnp.where(u > t, 1.0, x[0]) * x, inputs).count == 0


def test_a_branch_leaves_out_what_has_no_slope_on_the_other_side():
    """sqrt(x) has no slope at 0, and a selection would multiply it by 0."""
    root = lambda x, p: jnp.where(x[0] < 0, 2.0 * x[0], jnp.sqrt(x[0]))  # noqa: E731
    for slope in (root, lambda x, p: jnp.where(x[0] >= 0, jnp.sqrt(x[0]), 2.0 * x[0])):
        corners = corners_of(stacked(slope))
        with use_float64():
            at = jnp.array([0.0, 1.0])
            below = sides_at(corners, [0.0, at - 1.0])
            found = jax.grad(lambda x, below=below, corners=corners: corners.branch(below).evaluate([0.0, x])[0])(at)
        np.testing.assert_array_equal(found, [2.0, 0.0])


@pytest.mark.parametrize("seed", range(5))
def test_sliding_stays_on_its_corners_and_is_a_convex_combination(seed):
    """g moves with time; one corner, and both."""
    rng = np.random.default_rng(seed)
    A, b = rng.standard_normal((2, 3, 3)), rng.standard_normal((2, 3))
    normals, jumps = rng.standard_normal((2, 3)), rng.standard_normal((2, 3))

    def mode(t, x, p):
        g = normals @ x - jnp.array([0.2, -0.1]) * t**2
        f = jnp.where(g[0] > 0, A[0] @ x + b[0], A[1] @ x + b[1])
        return f + jnp.sign(g[1]) * (jumps[0] + p["w"] * x * jumps[1])

    corners = corners_of(mode, n=3)
    assert corners.count == 2
    given = [0.4, rng.standard_normal(3), np.array(0.7)]
    with use_float64():
        fields = {s: np.asarray(corners.branch(s).evaluate(given)) for s in [(1, 1), (1, -1), (-1, 1), (-1, -1)]}
        for sides, kept in {(0, 1): [0], (0, -1): [0], (1, 0): [1], (0, 0): [0, 1]}.items():
            f = np.asarray(corners.branch(sides).evaluate(given))
            rates = normals @ f - np.array([0.4, -0.2]) * 0.4
            np.testing.assert_allclose(rates[kept], 0.0, atol=1e-12 * np.abs(f).max())
            np.testing.assert_allclose(corners.rates(sides).evaluate(given), rates, rtol=1e-12, atol=1e-12)
            ends = dict(zip(corners.list_ends(sides), np.asarray(corners.ends(sides).evaluate(given)), strict=True))
            base = tuple(side or -1 for side in sides)
            expected = fields[base].copy()
            for k in kept:
                expected += ends[k, -1] * (fields[(*base[:k], 1, *base[k + 1 :])] - fields[base])
                assert ends[k, 1] == pytest.approx(1.0 - ends[k, -1], rel=1e-12)
            np.testing.assert_allclose(f, expected, rtol=1e-12, atol=1e-12)


def test_branches_share_what_they_have_in_common():
    """A corner is one function on all sides of another one, and a library that has grown traces its new modes alone."""
    problem = problem_of(still, [1.0, 1.0, 1.0], {"c": 1.0})
    corners, structure = find_corners(problem.structures[0].modes[0]), problem.structures[0]
    assert corners.end((1, 1, 1), 0) == corners.end((1, -1, 1), 0) != corners.end((-1, 1, 1), 0)
    modes = [corners.branch(sides) for sides in ((1, 1, 1), (1, -1, 1), (-1, 1, 1))]
    stages = []
    for count in (2, 3):
        grown = {"modes": tuple(modes[:count]), "mode_names": ("m",) * count, "implicit": (False,) * count}
        sizes = Sizes(structure.n, count, count, structure.M, 0, 0, ((3,),))
        templates = Templates(replace(structure, **grown, transitions=count).library, sizes, Order.HESSIAN)
        with use_float64():
            stages.append([templates.stage(mode) for mode in range(count)])
    assert stages[0][0] is stages[1][0] is not stages[1][1]
    assert stages[0][1] is stages[1][1]


def test_a_branch_that_only_jax_evaluates_takes_an_input_too():
    def pushed(t, x, p, u):
        size = jnp.linalg.eigvalsh(jnp.diag(jnp.stack([x[0] ** 2, 1.0])))[1]
        return jnp.stack([x[1], u[0] - p["mu"] * jnp.sign(x[1]) * size])

    problem = problem_of(pushed, [1.5, 1.0], {"mu": 0.3}, 1.0, inputs=sf.Input([0.0, 1.0], [[0.5], [2.0]]))
    branch = find_corners(problem.structures[0].modes[0]).branch((1,))
    function, states = trace_for_numpy(branch), np.array([[1.5, 1.0], [2.0, 0.7]])
    inputs = np.array([[0.5, 0.0], [2.0, 0.0]])  # with their rates
    found = function(np.array([0.1, 0.2]), [states, inputs], [np.array(0.3)])
    np.testing.assert_allclose(found, [[1.0, 0.5 - 0.3 * 2.25], [0.7, 2.0 - 0.3 * 4.0]])


@pytest.mark.parametrize(
    "clip",
    [
        lambda z: jnp.clip(z, 0.0, 1.0),
        lambda z: jnp.minimum(jnp.maximum(z, 0.0), 1.0),
        lambda z: jax.nn.relu(z) - jax.nn.relu(z - 1.0),
    ],
    ids=["clip", "minimum", "relu"],
)
@pytest.mark.parametrize("vector", [False, True])
def test_two_forces_saturate_one_after_the_other(clip, vector):
    """Below their lower limits their upper ones compare the same two numbers, and are two corners all the same."""

    def mode(t, x, p):
        force = clip(x[2] - jnp.arange(2.0)) if vector else [clip(x[2]), clip(x[2] - 1.0)]
        return p["w"] * jnp.array([force[0], force[1], 1.0])

    problem = problem_of(mode, [0.0, 0.0, -0.5], {"w": 1.0}, tf=3.5)
    np.testing.assert_allclose(sf.simulate(problem, times=[3.5]).states[0], [2.5, 1.5, 3.0], rtol=1e-8)
    assert find_corners(problem.structures[0].modes[0]).count in (3, 4)  # an upper limit may be another lower one


def test_jumps_of_rounding_and_of_the_integer_below_are_two_corners():
    assert corners_of(stacked(lambda x, p: jnp.floor(x[0]) + jnp.ceil(x[0]) + jnp.round(x[0]))).count == 2
