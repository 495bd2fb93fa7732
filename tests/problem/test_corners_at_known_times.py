"""Corners that an input or the time meets: steps end there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.sharp_modes import HEIGHTS, KNOTS, problem_of
from switchfit.discretization.mesh import Mesh
from switchfit.engine.run import runs_of
from switchfit.meshes.evaluator import evaluator_of
from switchfit.meshes.halving import halve_cells

ONE = np.array([1.5, -4.4, 3.3, -0.1, 2.7, 2.0, 2.0, 0.4, -3.9, 4.0, 1.0, -2.0, 0.3])
TWO = np.stack([ONE, ONE[::-1]], axis=1)
TIMED = {
    "clip": (ONE, lambda t, u, limit: jnp.clip(u, -2.0, 2.0)),
    "where": (ONE, lambda t, u, limit: jnp.where(u > 2.0, 2.0, jnp.where(u < -2.0, -2.0, u))),
    "nested": (ONE, lambda t, u, limit: jnp.clip(jnp.abs(jnp.clip(u, -2.0, 2.0) - 0.5), 0.2, 1.0)),
    "fixed limit": (ONE, lambda t, u, limit: jnp.clip(u, -limit, limit)),
    "jump": (ONE, lambda t, u, limit: jnp.where(u > 1.7, 5.0, 0.0)),
    "jump that is touched": (ONE, lambda t, u, limit: jnp.where(u >= 2.0, 5.0, 0.0) + jnp.where(u >= 4.0, 9.0, 0.0)),
    "floor": (ONE, lambda t, u, limit: jnp.floor(u)),
    "round": (ONE, lambda t, u, limit: jnp.round(u)),
    "table": (ONE, lambda t, u, limit: jnp.interp(u, KNOTS, HEIGHTS)),
    "cases": (ONE, lambda t, u, limit: jax.lax.cond(u > 1.0, lambda: -1.0, lambda: jnp.maximum(u, 0.0))),
    "relu": (ONE, lambda t, u, limit: jax.nn.relu(u - 1.0)),
    "vector": (TWO, lambda t, u, limit: jnp.clip(u, -2.0, 2.0).sum()),
    "two names": ({"left": TWO[:, 0], "right": TWO[:, 1]}, lambda t, u, limit: jnp.maximum(u["left"], u["right"])),
    "time": (ONE, lambda t, u, limit: jnp.where(jnp.mod(t, 0.37) < 0.1, u, 0.0)),
}


def timed_problem(what, kind):
    values, force = TIMED[what]
    inputs = sf.Input(np.linspace(0.0, 6.0, 13), values, kind=kind)
    parameters = {"a": 1.0, "limit": sf.Parameter(1.5, fixed=True)}
    return problem_of(
        lambda t, x, p, u: p["a"] * force(t, u, p["limit"]) - 0.3 * x, [0.3], parameters, 6.0, inputs=inputs
    )


@pytest.mark.parametrize("kind", ["linear", "cubic"])
@pytest.mark.parametrize("what", TIMED)
def test_steps_end_where_an_input_or_the_time_meets_a_corner(what, kind):
    evaluator = evaluator_of(timed_problem(what, kind))
    J = evaluator.cost(np.ones(1))
    assert halve_cells(evaluator).cost(np.ones(1)) == pytest.approx(J, rel=3e-9)
    assert evaluator.meshes[0].cells < 250


def test_the_cost_of_an_input_that_saturates_is_exact():
    """x' = a clip(u, -2, 2) where u rises from 0 to 6 and falls again: the integral in closed form."""
    times, inputs = np.array([0.5, 1.0, 1.4, 2.0]), sf.Input([0.0, 1.0, 2.0], [0.0, 6.0, 0.0], kind="linear")
    data = sf.Measurements(times, np.zeros(4))
    problem = problem_of(
        lambda t, x, p, u: p["a"] * jnp.clip(u, -2.0, 2.0), [0.0], {"a": 1.0}, 2.0, data, inputs=inputs
    )
    states = np.array([1 / 3 + 2 * (1 / 2 - 1 / 3), 1 / 3 + 4 / 3, 1 / 3 + 2 * (1.4 - 1 / 3), 10 / 3])
    assert sf.evaluate(problem).cost == pytest.approx(0.5 * states @ states, rel=1e-13)


def test_the_cost_of_a_running_cost_that_jumps_at_a_known_time_is_exact():
    cost = sf.RunningCost(lambda t, x, p: jnp.where(t < 1.234, x[0] ** 2, 0.0))
    problem = problem_of(lambda t, x, p: -p["a"] * x, [1.0], {"a": 1.0}, 3.0, cost)
    assert sf.evaluate(problem).cost == pytest.approx(0.5 * (1.0 - np.exp(-2.468)), rel=1e-8)


@pytest.mark.parametrize(
    "force",
    [
        lambda u: jax.lax.fori_loop(0, 3, lambda i, v: jnp.clip(v, -2.0, 2.0), u),
        lambda u: jnp.clip(jax.lax.reduce(jnp.stack([u, u**2]), 0.0, lambda a, b: a + jnp.maximum(b, 0.0), (0,)), 0, 9),
        lambda u: jnp.clip(
            jax.pure_callback(lambda t: t, jax.ShapeDtypeStruct((), float), jax.lax.stop_gradient(u)), 0, 9
        ),
    ],
)
def test_what_is_not_followed_is_no_corner_at_a_known_time(force):
    inputs = sf.Input(np.linspace(0.0, 6.0, 13), ONE, kind="linear")
    (run,) = runs_of(problem_of(lambda t, x, p, u: p["a"] * force(u) - x, [0.3], {"a": 1.0}, 6.0, inputs=inputs))
    assert np.isfinite(run.corner_times).all()


@pytest.mark.parametrize("limit", [2.0, None])
def test_an_input_that_meets_no_corner_or_one_of_an_unknown_changes_no_mesh(limit):
    """One that stays at its limit does not cross it; nor is a corner that moves with an unknown at a known time."""
    values = [0.0, 2.0, 2.0, 1.0] if limit else [0.0, 3.0, -1.0, 1.0]
    inputs = sf.Input([0.0, 1.0, 2.0, 4.0], values, kind="linear")

    def mode(t, x, p, u):
        return jnp.clip(u, -9.0 if limit else -p["a"], limit or p["a"]) - x

    (run,) = runs_of(problem_of(mode, [0.0], {"a": 1.5}, inputs=inputs))
    assert not run.corner_times.size
    np.testing.assert_array_equal(run.coarse.times, Mesh.of(run.experiment).times)
