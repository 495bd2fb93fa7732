"""A function without a finite value or derivative is named, with file and line, t and x, and at once."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.models import fit_problem
from switchfit.fit.nonfinite_functions import explain_nonfinite
from switchfit.meshes.evaluator import evaluator_of
from switchfit.problem.finiteness import find_undefined
from switchfit.runtime.errors import NotIntegrableError

TIMES = np.linspace(0.1, 4.0, 30)


def make_problem(modes, values, parameters, x0=(1.0,), times=TIMES, observe=None, **more):
    log = sf.Measurements(times, values, sigma=1e-2, observe=observe)
    given = {"m": modes} if callable(modes) else modes
    guess = np.linspace(times[0], times[-1], len(given) + 1)[1:-1]
    run = sf.Experiment(log, tuple(given), tuple(guess), 0.0, float(times[-1]), **more)
    return sf.Problem(sf.HybridSystem(given, list(x0)), run, parameters)


def drain(t, x, p):
    return jnp.stack([p["q"] - p["k"] * jnp.sqrt(jnp.maximum(x[0], 0.0))])


def pour(t, x, p):
    return jnp.stack([p["q"] - p["k"] * jnp.sqrt(x[0])])


SQRT = f"sqrt at test_finiteness.py:{pour.__code__.co_firstlineno + 1}"


@pytest.mark.parametrize("strategy", ["local", "auto"])
def test_a_tank_that_is_empty_at_the_start_is_told_at_once(strategy):
    problem = make_problem(pour, 1.0 - np.exp(-TIMES), {"q": 1.0, "k": 0.8}, x0=(0.0,))
    sf.estimate(problem, strategy="local")  # compiles
    began = time.perf_counter()
    found = fit_problem(problem, strategy=strategy, status=sf.Status.NONFINITE_START)
    assert time.perf_counter() - began < 1.0
    assert found.steps == ()
    assert found.reason.subjects == ("mode 'm'", *SQRT.split(" at "), "")
    assert f"mode 'm' has no finite derivatives at t = 0, x = [0.0]: the derivative of {SQRT}" in str(found.verdict)
    assert "jnp.sqrt(jnp.maximum(x, 1e-9)), or make what happens there a mode of its own." in str(found.verdict)
    assert "Mode 'm' has no finite derivatives at t = 0" in found.message


@pytest.mark.parametrize("k", [0.8, 0.3])
def test_a_tank_that_runs_empty_is_fitted(k):
    """From a guess that runs empty, at t = 2 / k, where the root has an infinite slope, and from one that does not."""
    noise = 1e-2 * np.random.default_rng(0).normal(size=len(TIMES))
    values = np.maximum(1.0 - 0.4 * TIMES, 0.0) ** 2 + noise
    found = fit_problem(make_problem(drain, values, {"q": 0.0, "k": k}), level="good")
    assert found.parameters["k"] == pytest.approx(0.8, abs=0.01)
    assert found.engine.name == "native"


def test_a_fit_is_not_thrown_away_where_finer_meshes_cannot_be_made():
    """x**2 = 1 - 2 k t: J falls up to the k with which x reaches 0 at the end, and has no more digits there."""
    values = np.sqrt(np.maximum(1.0 - 0.4 * TIMES, 0.0))
    found = fit_problem(make_problem(lambda t, x, p: -p["k"] / x, values, {"k": 0.05}), strategy="local", level="bad")
    assert found.parameters["k"] == pytest.approx(0.125, abs=1e-5)


def test_a_line_search_that_failed_beside_what_is_undefined_says_so():
    def mode(t, x, p):
        return -p["r"] * x * jnp.log(x) - p["h"]

    problem = make_problem(mode, np.maximum(0.3 - 0.1 * TIMES, 0.0), {"r": 0.2, "h": 0.01}, x0=(0.3,))
    found = fit_problem(problem, strategy="local", status=sf.Status.LINE_SEARCH_FAILED)
    assert f"log at test_finiteness.py:{mode.__code__.co_firstlineno + 1} is not finite" in found.message
    assert "mode 'm' has no finite value at t = 4, x = [" in str(found.verdict)


def test_a_guess_that_cannot_be_integrated_names_the_operation():
    def mode(t, x, p):
        return -p["k"] * x ** p["n"]

    line = mode.__code__.co_firstlineno + 1
    with pytest.raises(NotIntegrableError, match=rf"\[nan\] at t = 1\.33.* \(pow at test_finiteness.py:{line}\)"):
        sf.estimate(make_problem(mode, np.zeros(len(TIMES)), {"k": 1.5, "n": 0.5}), strategy="local")
    # A state that grows without bound accuses no operation
    with pytest.raises(NotIntegrableError, match=r"^((?!test_finiteness).)*$"):
        sf.estimate(make_problem(lambda t, x, p: p["k"] * x * x, np.zeros(len(TIMES)), {"k": 1.0}), strategy="local")


def explain(problem):
    return explain_nonfinite(evaluator_of(problem), problem.initial_theta)


def test_an_observation_is_named_at_its_samples_alone():
    def mode(t, x, p):
        return jnp.stack([p["u"], p["u"] * x[0]])

    def observe(t, x, p):
        return jnp.linalg.norm(x)[None]

    def build(times):
        return make_problem(mode, times[:, None], {"u": 1.0}, x0=(0.0, 0.0), times=times, observe=observe)

    assert explain(build(TIMES)) is None
    issue = explain(build(np.append(0.0, TIMES)))
    line = observe.__code__.co_firstlineno + 1
    assert issue.subjects == ("observe 1", "jnp.linalg.norm", f"test_finiteness.py:{line}", "")
    assert (issue.figures["t"], issue.figures["x"], issue.figures["valued"]) == (0.0, (0.0, 0.0), 1.0)
    assert "eep it from 0, as jnp.sqrt(jnp.sum(x**2) + 1e-12)" in str(issue)


def test_modes_with_inputs_and_the_second_of_two_modes():
    def fill(t, x, p, u):
        return p["k"] * u["flow"] * jnp.ones(1)

    def empty(t, x, p, u):
        return -p["k"] * jnp.sqrt(u["flow"] - 1.0) * x

    def drip(t, x, p, u):
        return -p["k"] * (jnp.maximum(u["flow"] - 1.0, 0.0) * x) ** 0.5

    flow = sf.Input([0.0, 4.0], {"flow": [2.0, 0.0]}, kind="linear")
    with pytest.raises(NotIntegrableError, match=r"mode 'empty' returned .* \(sqrt at test_finiteness.py"):
        sf.evaluate(make_problem({"fill": fill, "empty": empty}, TIMES, {"k": 1.0}, inputs=flow))
    issue = explain(make_problem({"fill": fill, "drip": drip}, TIMES, {"k": 1.0}, inputs=flow))
    assert issue.subjects[:2] == ("mode 'drip'", "pow")
    assert issue.figures["t"] >= 2.0


def test_other_functions_and_runs_are_named():
    modes = {"m": lambda t, x, p: -p["k"] * x}
    log = sf.Measurements(TIMES, TIMES, sigma=1.0)
    runs = [
        sf.Experiment(log, ("m",), (), 0.0, 4.0, parameter_map={"x0": name}, name=run)
        for name, run in (("a", "first"), ("b", "second"))
    ]
    system = sf.HybridSystem(modes, lambda p: jnp.sqrt(p["x0"])[None])
    issue = explain(sf.Problem(system, runs, {"k": 1.0, "a": 1.0, "b": 0.0}))
    assert "initial_state 1 of second has no finite derivatives: the derivative of sqrt" in str(issue).lower()
    run = sf.Experiment(sf.TerminalCost(lambda x, p: jnp.sqrt(-x[0])), ("m",), (), 0.0, 1.0)
    issue = explain(sf.Problem(sf.HybridSystem(modes, [1.0]), run, {"k": 1.0}))
    assert issue.subjects[:2] == ("TerminalCost 1", "sqrt")
    assert issue.figures["valued"] == 0.0
    assert "t" not in issue.figures


def find(mode, states):
    problem = make_problem(mode, np.ones(30), {"a": 1.5}, x0=(0.3,))
    states = np.array(states, dtype=float)
    found = find_undefined(problem.structures[0].modes[0], [np.zeros(len(states)), states], {"a": 1.5})
    assert found is None or found.line == f"test_finiteness.py:{mode.__code__.co_firstlineno}"
    return None if found is None else (found.point, found.operation, found.order, found.valued)


@pytest.mark.promotes
@pytest.mark.parametrize(
    ("mode", "states", "expected"),
    [
        (lambda t, x, p: -jnp.log(x) * p["a"], [[1.0], [-1.0]], (1, "log", 0, False)),
        (lambda t, x, p: -p["a"] / x, [[1.0], [2.0], [0.0]], (2, "div", 0, False)),
        (lambda t, x, p: -p["a"] * x**1.5, [[1.0], [0.0]], (1, "pow", 2, True)),
        (lambda t, x, p: jnp.where(x > 0, jnp.sqrt(x), 0.0) * p["a"], [[1.0], [-1.0]], (1, "sqrt", 0, True)),
        (lambda t, x, p: jax.lax.fori_loop(0, 3, lambda k, y: jnp.sqrt(y), x) * p["a"], [[0.0]], (0, "scan", 1, True)),
        (lambda t, x, p: jax.jit(lambda y: jnp.sqrt(y))(x) * p["a"], [[0.0]], (0, "sqrt", 1, True)),
        # Of branches the one that is taken counts
        (
            lambda t, x, p: jax.lax.cond(x[0] > 0, lambda y: jnp.sqrt(y), lambda y: 0.0 * y, x) * p["a"] + 1 / (x + 1),
            [[-1.0]],
            (0, "div", 0, False),
        ),
        # Finite throughout
        (lambda t, x, p: jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0) * p["a"], [[1.0], [-1.0]], None),
        (lambda t, x, p: jnp.sqrt(jnp.zeros(1)) + jnp.sqrt(t) + p["a"] * x, [[0.0]], None),
        # No operation is undefined: it overflows
        (lambda t, x, p: p["a"] * x * x, [[1e200]], None),
    ],
)
def test_the_first_operation_that_is_not_finite_is_found(mode, states, expected):
    assert find(mode, states) == expected
