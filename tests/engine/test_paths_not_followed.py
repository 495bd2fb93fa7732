"""Paths through corners that cannot be followed: what is refused, and with which sentence."""

import inspect
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.sharp import problems as sharp
from support.sharp_modes import problem_of, spring
from switchfit.engine.corners.branches import MOST_CROSSINGS
from switchfit.engine.corners.split_engine import SplitEngine
from switchfit.engine.jax import jax_engine
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.refinement import refine_mesh
from switchfit.runtime.errors import NotIntegrableError


def test_where_crossings_are_too_many_rows_are_not_split():
    """As they were without corners: J is accurate, since the mesh resolves them."""

    def drag(t, x, p):
        return jnp.stack([x[1], -p["k"] * x[0] - p["c"] * jnp.abs(x[1]) * x[1]])

    few, many = (problem_of(drag, [1.0, 0.0], {"k": 16.0, "c": 0.01}, tf) for tf in (3.0, 45.0))
    assert isinstance(Evaluator(few).engines[0], SplitEngine)
    whole = Evaluator(many)
    assert not isinstance(whole.engines[0], SplitEngine)
    theta = many.initial_theta
    assert whole(theta).cost == pytest.approx(whole.divide(4)(theta).cost, rel=1e-7)


def trickle(t, x, p):
    # Nearly empty tanks, whose levels are held inside the margins of their corners.
    return 1e-5 - p["c"] * jnp.sqrt(jnp.maximum(x, 0.0)) * jnp.array([1.0, 0.9, 0.8])


def heat(t, x, p):
    # Without a dead band, and with a sensor that lags: it settles at its setpoint by switching ever faster.
    return jnp.stack([p["h"] * jnp.where(x[1] < 20.0, 1.0, 0.0) - 0.12 * (x[0] - 5.0), (x[0] - x[1]) / 4.0])


@pytest.mark.parametrize(
    ("mode", "start", "parameters", "theta", "tf", "message"),
    [
        (spring, [1.0, 0.0], {"k": 1.0, "c": 0.001}, [100.0, 0.001], 20.0, f"than {MOST_CROSSINGS} times up to"),
        (heat, [25.0, 22.0], {"h": 0.0}, [2.5], 100.0, "than .* give them a dead band"),
        (trickle, [1.0, 1.0, 1.0], {"c": 0.1}, [1.0], 3.0, "slides along more than 2 .* at a time .* at t = 2.5"),
    ],
    ids=["too many", "ever faster", "three at a time"],
)
def test_what_cannot_be_followed_at_a_trial_is_refused_with_its_corner(mode, start, parameters, theta, tf, message):
    problem, (lines, first) = problem_of(mode, start, parameters, tf), inspect.getsourcelines(mode)
    evaluator = Evaluator(problem)
    assert np.isfinite(evaluator.cost(problem.initial_theta))
    with pytest.raises(NotIntegrableError, match=message) as refused:
        refine_mesh(problem, 0, np.array(theta))
    assert "mode 'm'" in str(refused.value)
    assert f"({Path(inspect.getsourcefile(mode)).name}:{first + len(lines) - 1})" in str(refused.value)


def rooted(t, x, p):
    return jnp.stack([x[1], -p["k"] * x[0] - jnp.sqrt(p["c"]) * jnp.sign(x[1])])


@pytest.mark.parametrize(
    ("problem", "theta"),
    [
        (problem_of(trickle, [1.0, 1.0, 1.0], {"c": 0.9}, 2.2), [1.3]),
        (problem_of(rooted, [1.0, 0.0], {"k": 4.0, "c": 0.01}), [4.0, 0.0]),
    ],
    ids=["rest", "infinite derivative"],
)
def test_points_at_which_it_cannot_be_followed_have_no_cost(problem, theta, monkeypatch):
    """JAX is not asked for a program of each path, to find that a derivative is infinite."""
    monkeypatch.setattr(jax_engine, "derivatives", None)
    evaluator = Evaluator(problem)
    for _ in range(2):
        assert np.isfinite(evaluator.cost(problem.initial_theta))
        assert np.isnan([evaluator(np.array(theta)).cost, evaluator.cost(np.array(theta))]).all()


def test_where_a_corner_is_just_touched_there_are_no_derivatives():
    engine = Evaluator(problem_of(spring, [1.0, 0.0], {"k": 4.0, "c": 0.3})).engines[0]
    split, found = engine._solve(np.zeros(0), np.array([4.0, 0.3]), 1.0)
    flat = replace(found, jacobian=np.zeros_like(found.jacobian))  # no guard changes with the time of its crossing
    assert np.isnan(engine._eliminate(split, flat)[0][split.guarded]).all()


def test_a_branch_that_is_not_defined_where_it_begins_is_refused():
    """SciPy looks for a first step without end."""
    problem = problem_of(lambda t, x, p: p["c"] * jnp.log(-jnp.abs(x) - 1.0), [1.0], {"c": 0.1})
    with pytest.raises(
        NotIntegrableError, match=r"mode 'm' returned \[nan\] at t = 0 .*\(log at test_paths_not_followed.py"
    ):
        refine_mesh(problem, 0, problem.initial_theta)


def test_a_solver_that_is_stuck_makes_no_corner_steep_beyond_which_the_field_is_defined():
    """A sensor whose time constant is all but zero; the relay of all later fits would be without its corner."""
    problem = sharp.relay().build_problem()
    evaluator = Evaluator(problem)
    before = evaluator.cost(problem.initial_theta)
    with pytest.raises(NotIntegrableError, match="mode 'day' cannot be integrated"):
        refine_mesh(problem, 0, np.array([5.5, 5.1, 0.16, 1e-15]))
    assert not evaluator.engines[0].has_steep_corners
    assert Evaluator(problem).cost(problem.initial_theta) == pytest.approx(before, rel=1e-9)
