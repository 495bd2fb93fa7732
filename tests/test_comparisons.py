"""Comparisons with a parameter are found in the traces of functions, with file and line; nothing else is."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from switchfit.problem.inspection import find_comparisons


def make_problem(mode, observe=None, parameter_map=None, **others):
    times = np.linspace(0.1, 1.0, 5)
    log = sf.Measurements(times, times, sigma=1.0, observe=observe)
    run = sf.Experiment(log, ("m",), (), 0.0, 1.0, parameter_map=parameter_map)
    return sf.Problem(sf.HybridSystem({"m": mode, **others}, [0.3]), run, {"a": 1.0, "b": 2.0}, max_transitions=1)


FOUND = {
    "where": lambda t, x, p: jnp.where(t < 2.0 * p["a"] + 1.0, x, -x) * p["b"],
    "modulo": lambda t, x, p: jnp.where(t % p["a"] < 0.5, x, -x) * p["b"],
    "branch": lambda t, x, p: jax.lax.cond(t < p["a"], lambda y: y * p["b"], lambda y: y, x),
    "in a branch": lambda t, x, p: jax.lax.cond(t < 0.5, lambda y: y * (t > p["a"]), lambda y: y, x) * p["b"],
    "in a loop": lambda t, x, p: jax.lax.fori_loop(0, 3, lambda k, y: y * jnp.where(t < p["a"], p["b"], 1.0), x),
    "loop": lambda t, x, p: p["b"] * jax.lax.while_loop(lambda y: y < p["a"], lambda y: y + 1.0, t) * x,
    "jitted": lambda t, x, p: jax.jit(lambda a: jnp.where(t < a, x, -x))(p["a"]) * p["b"],
    "heaviside": lambda t, x, p: jnp.heaviside(t - p["a"], 0.5) * p["b"] * x,
    "floor": lambda t, x, p: jnp.floor(p["a"] * t) * x * p["b"],
    "round": lambda t, x, p: jnp.round(p["a"] * t) * x * p["b"],
    "integers": lambda t, x, p: (p["a"] * t).astype(int) * x * p["b"],
    "sign": lambda t, x, p: jnp.sign(t - p["a"]) * p["b"],
    "search": lambda t, x, p: jnp.searchsorted(jnp.stack([0.0 * t, p["a"]]), t) * p["b"] * x,
}


SAID = {"floor": "rounds what depends on", "round": "rounds what depends on", "integers": "rounds what depends on"}
SAID["sign"] = "takes the sign of what depends on"


@pytest.mark.promotes
@pytest.mark.parametrize("name", FOUND)
def test_a_comparison_is_found_with_its_line(name):
    first = FOUND[name].__code__.co_firstlineno
    found = find_comparisons(make_problem(FOUND[name]))
    said = SAID.get(name, "compares with")
    assert found.get(0) in [f"mode 'm' {said} a at test_comparisons.py:{line}" for line in (first, first + 1)]
    assert found.get(1) is None


NOT_FOUND = {
    "corner of the state": lambda t, x, p: jnp.where(x > p["a"], p["b"], -p["b"]) * jnp.sign(x - p["a"]),
    "state alone": lambda t, x, p: jnp.sign(x) * p["a"] + p["b"] * (t < 0.5),
    "continuous": lambda t, x, p: jnp.maximum(t - p["a"], 0.0) * jnp.clip(x, 0.0, p["a"]) * p["b"],
    "interpolation": lambda t, x, p: jnp.interp(t, jnp.stack([0.0 * t, p["a"]]), jnp.array([0.0, 1.0])) * x * p["b"],
    "rule of its own": lambda t, x, p: jax.nn.softplus(p["a"]) * x + jax.nn.relu(p["b"] - x),
    "is it a number": lambda t, x, p: jnp.where(jnp.isnan(p["a"]), 0.0, p["a"]) * x * p["b"],
    "overwritten": lambda t, x, p: jnp.where(t < jax.jit(lambda a, b: b)(p["a"], t), x, p["a"]) * p["b"],
}


@pytest.mark.promotes
@pytest.mark.parametrize("name", NOT_FOUND)
def test_nothing_is_accused_that_does_not_jump_with_the_parameter(name):
    """A mode that does not occur is not named either."""
    found = find_comparisons(make_problem(NOT_FOUND[name], n=FOUND["where"]))
    assert (found.get(0), found.get(1)) == (None, None)


def test_other_functions_and_the_names_of_a_map():
    observe = lambda t, x, p: jnp.where(t < p["own"], x, 2.0 * x)  # noqa: E731
    problem = make_problem(lambda t, x, p: -p["b"] * x, observe=observe, parameter_map={"own": "a"})
    line = observe.__code__.co_firstlineno
    assert find_comparisons(problem).get(0) == f"observe 1 compares with own at test_comparisons.py:{line}"
