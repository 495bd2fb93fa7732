"""A problem sees what its functions read when it is built, and equal functions share compiled programs."""

from __future__ import annotations

import copy
import functools
import math
import pickle
import re
import types

import cloudpickle
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.places import ROOT
from switchfit.models import heater_problem
from switchfit.problem import contents, functions
from switchfit.problem.functions import Call, trace_function, use_float64

SAMPLES = sf.Measurements([0.5, 1.0], [math.exp(-0.5), math.exp(-1.0)], sigma=0.1)


def problem_of(f, observe=None, **settings):
    data = SAMPLES if observe is None else sf.Measurements(SAMPLES.times, SAMPLES.values, observe=observe, sigma=0.1)
    system = sf.HybridSystem({"fall": f}, [1.0], **settings)
    return sf.Problem(system, sf.Experiment(data, ("fall",), (), 0.0, 1.0), {"a": 0.8})


# What a function reads has changed: a way to read g, and a way to change it

GLOBAL = {"g": 1.0}


def list_ways():
    """Return for each way a vector field that reads g = 1, and a function that makes it 2."""
    GLOBAL["g"] = 1.0
    box, array, module, number = [1.0], np.array([1.0]), types.ModuleType("constants"), 1.0
    module.g = 1.0

    class Body:
        g = 1.0

        def f(self, t, x, p):
            return -self.g * p["a"] * x

    def closure(t, x, p):
        return -number * p["a"] * x

    def change_number():
        nonlocal number
        number = 2.0

    def default(t, x, p, g=1.0):
        return -g * p["a"] * x

    def attribute(t, x, p):
        return -attribute.g * p["a"] * x

    attribute.g = 1.0

    def partial(gains, t, x, p):
        return -gains[0] * p["a"] * x

    def helper(x):
        return box[0] * x

    def nested(t, x, p):
        def inner(y):
            return sum(box[0] * y for _ in range(1))

        return -inner(p["a"] * x)

    @functools.wraps(jnp.clip)
    def wrapped(t, x, p):
        return -box[0] * p["a"] * x

    def put(holder, key=0):
        return lambda: holder.__setitem__(key, 2.0)

    def set_g(holder):
        return lambda: setattr(holder, "g", 2.0)

    body, jitted = Body(), jax.jit(helper)
    return {
        "global dict": (lambda t, x, p: -GLOBAL["g"] * p["a"] * x, put(GLOBAL, "g")),
        "global lookup": (lambda t, x, p: -globals()["GLOBAL"]["g"] * p["a"] * x, put(GLOBAL, "g")),
        "closure": (closure, change_number),
        "array in place": (lambda t, x, p: -array * p["a"] * x, put(array)),
        "default": (default, lambda: setattr(default, "__defaults__", (2.0,))),
        "attribute of a function": (attribute, set_g(attribute)),
        "bound method": (body.f, set_g(body)),
        "attribute of a class": (lambda t, x, p: -Body.g * p["a"] * x, set_g(Body)),
        "module": (lambda t, x, p: -module.g * p["a"] * x, set_g(module)),
        "partial": (functools.partial(partial, box), put(box)),
        "helper": (lambda t, x, p: -helper(p["a"] * x), put(box)),
        "jitted helper": (lambda t, x, p: -jitted(p["a"] * x), put(box)),
        "inner function": (nested, put(box)),
        "name of a library": (wrapped, put(box)),
    }


WAYS = tuple(list_ways())


def rate_of(problem):
    """The vector field of a problem at x = 1, as its engines evaluate it."""
    with use_float64():
        return float(problem.structures[0].modes[0](0.0, np.ones(1), {"a": 0.8})[0])


@pytest.mark.parametrize("way", WAYS)
def test_a_problem_keeps_its_functions_as_they_were_when_it_was_built(way):
    f, change = list_ways()[way]
    assert rate_of(problem_of(f)) == -0.8
    old = problem_of(f)
    change()
    assert rate_of(old) == -0.8
    assert rate_of(problem_of(f)) == -1.6


@pytest.mark.parametrize("shape", [(), (3, 1)])
def test_constants_are_copied_when_a_problem_is_built(shape):
    """Nothing has been compiled for this number when the array that held it changes."""
    g = np.full(shape, 1.37)
    built = problem_of(lambda t, x, p: -np.ravel(g)[0] * jnp.sum(jnp.asarray(g)) * p["a"] * x)
    expected = sf.evaluate(problem_of(lambda t, x, p: -1.37 * (1.37 * g.size) * p["a"] * x)).cost
    g[...] = 5.0
    found = [sf.evaluate(built, method=method).cost for method in ("forward", "auto")]
    assert found == pytest.approx([expected] * 2, rel=1e-12)


def test_a_rule_for_derivatives_that_has_changed_is_another_function():
    slope = [1.0]

    def problem():
        @jax.custom_jvp
        def identity(x):
            return x

        identity.defjvp(lambda primals, tangents: (identity(*primals), slope[0] * tangents[0]))
        return problem_of(lambda t, x, p: -identity(p["a"]) * x)

    right = sf.evaluate(problem()).gradient
    slope[0] = 2.0
    np.testing.assert_allclose(sf.evaluate(problem()).gradient, 2 * right, rtol=1e-12)


# The opposite: equal functions are one


def test_functions_made_anew_share_their_programs():
    def made(number):
        rows = np.array([0])
        return problem_of(lambda t, x, p: -number * p["a"] * x, observe=lambda t, x, p: x[rows])

    one, other, different = made(1.0), made(1.0), made(np.nextafter(1.0, 2.0))
    assert one.structures == other.structures != different.structures
    assert hash(one.structures) == hash(other.structures)
    system = sf.HybridSystem({"fall": lambda t, x, p: -p["a"] * x}, [1.0])
    assert sf.Problem(system, [each.experiments[0] for each in (one, other)], {"a": 1.0}).alike == ((0, 1),)


CHANGES = (
    lambda x, p: x - p["a"],
    lambda x, p: x - p["b"],
    lambda x, p: x + p["a"],
    lambda x, p: x - p["a"] * 1.0000000000000002,
    lambda x, p: jnp.sin(x) - p["a"],
    lambda x, p: x[::-1] - p["a"],
    lambda x, p: jnp.roll(x, 1) - p["a"],
    lambda x, p: jax.lax.fori_loop(0, 2, lambda k, x: x - p["a"], x),
    lambda x, p: jax.lax.fori_loop(0, 3, lambda k, x: x - p["a"], x),
    lambda x, p: jnp.where(x > 0.0, x, p["a"]),
    lambda x, p: jnp.where(x >= 0.0, x, p["a"]),
    lambda x, p: jax.nn.silu(x) - p["a"],
    lambda x, p: jnp.linalg.solve(jnp.eye(2) + x[:, None], x) - p["a"],
    lambda x, p: jnp.linalg.solve(jnp.eye(2) + x[None, :], x) - p["a"],
)


def test_other_functions_are_other():
    def trace(function):
        return trace_function(Call(function, ((2,), None), (2,), "f", "f(x, p)"), {"a": (), "b": ()})

    traced = [trace(change) for change in CHANGES]
    assert len(set(traced)) == len({one.digest for one in traced}) == len(CHANGES)
    for change, own in zip(CHANGES, traced, strict=True):
        assert trace(lambda x, p, change=change: change(x, p)) == own


@pytest.mark.parametrize(
    "read", [lambda p: p.pop("a"), lambda p: p.setdefault("a", 2.0), lambda p: p.popitem()[1], lambda p: p.copy()["a"]]
)
def test_a_function_may_read_its_parameters_by_any_method_of_a_dict(read):
    found = sf.evaluate(problem_of(lambda t, x, p: -read(p) * x))
    expected = sf.evaluate(problem_of(lambda t, x, p: -p["a"] * x))
    np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-13)


def test_a_function_that_reads_plain_things_is_not_called_again(monkeypatch):
    calls = []
    real = functions._trace
    monkeypatch.setattr(functions, "_trace", lambda *given, **form: calls.append(1) or real(*given, **form))
    constants = {"g": 1.25, "table": np.arange(3.0), "pair": (1, "a")}

    def rate(a):
        return constants["g"] * a * constants["table"][1] * math.pi

    for end in (1.0, 2.0):
        data = sf.Measurements([0.5, end], [0.6, 0.4], sigma=0.1)
        system = sf.HybridSystem({"fall": lambda t, x, p: -rate(p["k"]) * x}, [1.0])
        sf.Problem(system, sf.Experiment(data, ("fall",), (), 0.0, end), {"k": end})
    assert len(calls) == 1


def test_values_of_different_types_are_different():
    values = [0.0, -0.0, 1, True, 1.0, "1", np.float64(1.0), np.ones(1), [1.0], (1.0,), {"a": 1.0}, np.ones(1, int)]
    read = [contents.read_contents(lambda value=value: value) for value in values]
    assert None not in read
    assert len(set(read)) == len(values)


# A problem that travels


def test_a_problem_that_is_pickled_is_the_same_or_is_refused_if_its_functions_have_changed():
    g = np.array([1.0])
    problem = problem_of(lambda t, x, p: -g * p["a"] * x)
    expected = sf.evaluate(problem).cost
    travelled = cloudpickle.loads(cloudpickle.dumps(problem))
    assert travelled.structures == problem.structures
    assert "evaluator" not in travelled.__dict__, "it travels without its programs"
    assert sf.evaluate(travelled).cost == expected
    g[0] = 2.0
    blob = cloudpickle.dumps(problem)
    with pytest.raises(ValueError, match=r"mode 'fall' does something else .* Build the problem anew"):
        cloudpickle.loads(blob)


@pytest.mark.parametrize(
    "send", [lambda value: pickle.loads(pickle.dumps(value)), copy.deepcopy], ids=["pickle", "copy"]
)
def test_problems_and_results_travel_by_the_standard_library(send):
    """Where modes are functions of a module; programs stay behind, and meshes do not."""
    problem, times = heater_problem(), [1.0, 5.0, 8.0]
    fit = sf.estimate(problem)
    results = [
        fit.predict(times),
        fit.profile("k"),
        sf.compare([fit, fit]),
        fit.validate(problem),
        sf.multistart(problem, 3),
    ]
    sent, *others = send([fit, *results])
    assert list(map(str, others)) == list(map(str, results))
    assert (str(sent), repr(sent.problem)) == (str(fit), repr(fit.problem))
    assert sent.problem is not fit.problem
    for name in ("theta", "standard_errors", "hessian"):
        np.testing.assert_array_equal(getattr(sent, name), getattr(fit, name))
    for name in ("outputs", "output_errors"):
        np.testing.assert_array_equal(getattr(sent.predict(times), name), getattr(fit.predict(times), name))
    assert others[1].interval(0.99) == pytest.approx(results[1].interval(0.99), rel=1e-6)
    assert sf.evaluate(send(problem)).cost == sf.evaluate(problem).cost


def test_a_lambda_cannot_be_pickled_by_the_standard_library():
    with pytest.raises((pickle.PicklingError, AttributeError), match="lambda"):
        pickle.dumps(problem_of(lambda t, x, p: -p["a"] * x))


def test_the_page_on_models_runs_and_prints_what_it_says(capsys):
    page = (ROOT / "docs" / "models.md").read_text()
    block, *_ = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(compile(block, "models.md", "exec"), {})
    said = re.findall(r"\)  # ([0-9.]+)$", block, re.MULTILINE)
    assert len(said) == 3
    assert capsys.readouterr().out.split() == said
