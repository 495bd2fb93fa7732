"""What slides along a corner: set points that move, inputs, belts; and where it leaves."""

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.sharp_modes import TIGHT, check_derivatives, problem_of, still


def relay(t, x, p):
    above = x[0] < 0.8 + 0.3 * jnp.sin(2 * t)
    return jnp.stack([-p["a"] * x[0] + p["b"] * jnp.where(above, 1.0, 0.0)])


def test_a_relay_keeps_the_state_on_a_set_point_that_moves():
    """It slides, but decays while the set point falls too fast."""
    problem = problem_of(relay, [0.0], {"a": 0.5, "b": 1.2}, 5.0, **TIGHT)
    times = np.array([1.2, 1.25, 1.3, 1.4, 2.4, 2.6, 3.0, 3.5, 4.3])
    found = sf.simulate(problem, times=times).states[:, 0]
    decay = found[2] * np.exp(-0.5 * (times - 1.3))
    decays = (times > 1.26) & (times < 2.5)
    expected = np.where(decays, decay, 0.8 + 0.3 * np.sin(2 * times))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    evaluator = check_derivatives(problem)
    assert evaluator.engines[0]._split.path.sides == (((-1,), (0,), (1,), (0,), (1,)),)


def test_what_slides_along_an_input_moves_with_it():
    """A servo with a limited speed reaches a position, follows it, and falls behind where that is faster or jumps."""

    def servo(t, x, p, u):
        return p["v"] * jnp.sign(u - x)

    position = sf.Input([0.0, 1.0, 3.0], [0.5, 1.0, -5.0], kind="linear")
    problem = problem_of(servo, [0.0], {"v": 2.0}, 3.0, inputs=position, **TIGHT)
    times = np.linspace(0.1, 3.0, 30)
    expected = np.select([times < 1 / 3, times < 1.0], [2.0 * times, 0.5 + 0.5 * times], 3.0 - 2.0 * times)
    np.testing.assert_allclose(sf.simulate(problem, times=times).states[:, 0], expected, rtol=0, atol=1e-9)
    assert check_derivatives(problem).engines[0]._split.path.sides == (((1,), (0,), (-1,)),)
    problem = problem_of(servo, [0.0], {"v": 2.0}, 3.0, inputs=sf.Input([0.0, 1.0], [0.5, 9.0], kind="hold"))
    found = sf.simulate(problem, times=times).states[:, 0]
    np.testing.assert_allclose(found, np.minimum(2.0 * times, 0.5) + 2.0 * np.maximum(times - 1.0, 0.0), atol=1e-9)


def test_what_slides_goes_on_where_the_input_bends():
    """A block on a belt of measured speed: that it sticks to the belt is true to the errors of the solver."""

    def block(t, x, p, u):
        return jnp.stack([x[1], -p["k"] * x[0] - 0.2887 * x[1] - p["mu"] * jnp.sign(x[1] - u)])

    times = np.linspace(0.0, 10.0, 101)
    speed = sf.Input(times, 0.4 + 0.25 * np.sin(0.9 * times) + 0.1 * np.sin(2.7 * times), kind="linear")
    data = sf.Measurements(np.linspace(0.1, 10.0, 100), np.zeros(100), lambda t, x, p: x[:1], sigma=1.0)
    parameters = {"k": 2.7161, "mu": 3.0794}
    evaluator = check_derivatives(problem_of(block, [0.0, 0.0], parameters, 10.0, data, inputs=speed))
    assert evaluator.engines[0]._split.path.sides == (((-1,), (0,), (-1,), (0,), (-1,)),)


def test_what_slides_leaves_at_a_tangent():
    """The solver takes long steps while it slides, and leaves from a state that is a little on the wrong side."""
    problem = problem_of(lambda t, x, p: p["v"] * jnp.sign(jnp.sin(2 * t) - x), [0.0], {"v": 1.5}, 2.3)
    times, left = np.linspace(0.7, 2.3, 30), 0.5 * np.arccos(-0.75)
    expected = np.where(times < left, np.sin(2 * times), np.sin(2 * left) - 1.5 * (times - left))
    np.testing.assert_allclose(sf.simulate(problem, times=times).states[:, 0], expected, rtol=0, atol=1e-7)
    assert np.isfinite(sf.evaluate(problem).gradient).all()


def test_three_bodies_may_rest():
    problem = problem_of(still, [1.0, 1.0, 1.0], {"c": 1.0}, 3.0, **TIGHT)
    expected = [[0.0, 0.0, 1.0 - 0.95], [0.0, 0.0, 0.0]]
    np.testing.assert_allclose(sf.simulate(problem, times=[1.9, 3.0]).states, expected, atol=1e-9)
    check_derivatives(problem)


def test_a_body_that_comes_to_rest_at_the_limit_of_friction_stays_there():
    """On its side nothing moves it any more, up to 1e-7 of what leads back from the other side."""
    problem = problem_of(lambda t, x, p: p["pull"] - jnp.sign(x), [5e-8], {"pull": 1.0 - 1e-7}, 1.0)
    assert sf.simulate(problem, times=[0.25, 1.0]).states[:, 0] == pytest.approx([2.5e-8, 0.0], abs=1e-8)


def test_two_tanks_that_are_level_stay_so():
    """The slope of sign(z) sqrt(abs(z)) is infinite at z = 0, which attracts from both sides: z slides along it."""

    def even_out(t, x, p):
        z = x[0] - x[1]
        flow = p["c"] * jnp.sign(z) * jnp.sqrt(jnp.abs(z))
        return jnp.stack([-flow, flow])

    problem = problem_of(even_out, [1.0, 0.4], {"c": 0.4}, 4.0)
    times = np.linspace(0.0, 4.0, 41)
    states = sf.simulate(problem, times=times).states
    # z' = -2 c sqrt(z), from z = 0.6 until it is zero.
    z = np.maximum(np.sqrt(0.6) - 0.4 * times, 0.0) ** 2
    np.testing.assert_allclose(states, np.stack([0.7 + z / 2, 0.7 - z / 2], axis=1), atol=1e-7)
