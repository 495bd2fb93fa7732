"""Comparisons with a parameter are found in the traces of functions, with file and line; nothing else is."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from switchfit.problem.inspection import find_comparisons


def make_problem(mode, **given):
    times = np.linspace(0.1, 1.0, 5)
    log = sf.Measurements(times, times, sigma=1.0, observe=given.pop("observe", None))
    run = sf.Experiment(log, ("m",), (), 0.0, 1.0, parameter_map=given.pop("parameter_map", None))
    return sf.Problem(sf.HybridSystem({"m": mode}, [0.3]), run, {"a": 1.0, "b": 2.0} | given)


FOUND = {
    "where": lambda t, x, p: jnp.where(t < p["a"], x, -x) * p["b"],
    "computed": lambda t, x, p: jnp.where(t < 2.0 * p["a"] + 1.0, x, -x) * p["b"],
    "modulo": lambda t, x, p: jnp.where(t % p["a"] < 0.5, x, -x) * p["b"],
    "branch": lambda t, x, p: jax.lax.cond(t < p["a"], lambda y: y * p["b"], lambda y: y, x),
    "in a branch": lambda t, x, p: jax.lax.cond(t < 0.5, lambda y: y * (t > p["a"]), lambda y: y, x) * p["b"],
    "in a loop": lambda t, x, p: jax.lax.fori_loop(0, 3, lambda k, y: y * jnp.where(t < p["a"], p["b"], 1.0), x),
    "loop": lambda t, x, p: p["b"] * jax.lax.while_loop(lambda y: y < p["a"], lambda y: y + 1.0, t) * x,
    "jitted": lambda t, x, p: jax.jit(lambda a: jnp.where(t < a, x, -x))(p["a"]) * p["b"],
    "heaviside": lambda t, x, p: jnp.heaviside(t - p["a"], 0.5) * p["b"] * x,
    "search": lambda t, x, p: jnp.searchsorted(jnp.stack([0.0 * t, p["a"]]), t) * p["b"] * x,
}


@pytest.mark.promotes
@pytest.mark.parametrize("name", FOUND)
def test_a_comparison_is_found_with_its_line(name):
    mode = FOUND[name]
    first = mode.__code__.co_firstlineno
    problem = make_problem(mode)
    lines = [f"mode 'm' compares with a at test_comparisons.py:{line}" for line in (first, first + 1)]
    assert find_comparisons(problem).get(0) in lines
    assert find_comparisons(problem).get(1) is None


@pytest.mark.promotes
@pytest.mark.parametrize(
    ("mode", "words"),
    [
        (lambda t, x, p: jnp.floor(p["a"] * t) * x * p["b"], "rounds what depends on a"),
        (lambda t, x, p: jnp.round(p["a"] * t) * x * p["b"], "rounds what depends on a"),
        (lambda t, x, p: (p["a"] * t).astype(int) * x * p["b"], "rounds what depends on a"),
        (lambda t, x, p: jnp.sign(t - p["a"]) * p["b"], "takes the sign of what depends on a"),
    ],
)
def test_rounding_and_signs_are_found(mode, words):
    assert f"mode 'm' {words} at test_comparisons.py:" in find_comparisons(make_problem(mode)).get(0)


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
    problem = make_problem(NOT_FOUND[name])
    assert find_comparisons(problem).get(0) is None
    assert find_comparisons(problem).get(1) is None


def test_other_functions_and_the_names_of_a_map():
    def mode(t, x, p):
        return -p["b"] * x

    def observe(t, x, p):
        return jnp.where(t < p["own"], x, 2.0 * x)

    problem = make_problem(mode, observe=observe, parameter_map={"own": "a"})
    line = observe.__code__.co_firstlineno + 1
    assert find_comparisons(problem).get(0) == f"observe 1 compares with own at test_comparisons.py:{line}"


def test_a_mode_that_does_not_occur_is_not_named():
    modes = {"m": lambda t, x, p: -p["a"] * x, "n": lambda t, x, p: jnp.where(t < p["a"], x, -x)}
    times = np.linspace(0.1, 1.0, 5)
    run = sf.Experiment(sf.Measurements(times, times, sigma=1.0), ("m",), (), 0.0, 1.0)
    problem = sf.Problem(sf.HybridSystem(modes, [0.3]), run, {"a": 1.0}, max_transitions=1)
    assert find_comparisons(problem).get(0) is None
