"""What JAX promises nobody is used in one module alone, and does what that module says of it."""

import ast
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import switchfit as sf
from switchfit.problem.functions import use_float64
from switchfit.runtime import jax_internals

PACKAGE = Path(sf.__file__).parent

PRIVATE = re.compile(r"jax\._src|jax\.interpreters|jax\.extend|jax\.core|jaxlib|jax\.experimental\.compilation_cache")
"""Modules of JAX without a promise that what is in them stays."""


def find_private_names(source: str) -> set[str]:
    """Modules of JAX that a source imports, or reaches by attributes of `jax`, and that are private."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Attribute):
            names.add(ast.unparse(node))
    return {name for name in names if PRIVATE.match(name)}


def test_one_module_alone_uses_what_is_private_in_jax():
    assert find_private_names("from jax.interpreters import partial_eval") == {"jax.interpreters.partial_eval"}
    assert find_private_names("jax.core.Tracer; jax.numpy.sin(jax.lax.cos)") == {"jax.core.Tracer", "jax.core"}
    found = {path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if find_private_names(path.read_text())}
    assert found == {Path("runtime/jax_internals.py")}


def test_versions_in_the_header_are_the_bounds_of_the_package():
    versions = re.search(r"JAX (\d+\.\d+) and (\d+\.\d+),", jax_internals.__doc__ or "")
    assert versions is not None
    first, last = versions.groups()
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    after = f"0.{int(last.split('.')[1]) + 1}"
    assert f'"jax>={first},<{after}"' in text
    assert f'"jax[cuda12]>={first},<{after}"' in text
    # What runs the tests is inside them.
    own = tuple(map(int, jax.__version__.split(".")[:2]))
    assert tuple(map(int, first.split("."))) <= own <= tuple(map(int, last.split(".")))


def trace(function, *given):
    with use_float64():
        return jax.make_jaxpr(function)(*given)


def test_what_no_result_needs_is_dropped_from_a_jaxpr():
    def total(x, y, z):
        jnp.cos(z)
        return jnp.sin(x) + jnp.sum(y)

    closed = trace(total, 1.0, np.ones(3), 2.0)
    jaxpr, is_left = jax_internals.drop_unused(closed.jaxpr, [True, False, False])
    assert is_left == [True, True, False]
    assert "cos" not in {equation.primitive.name for equation in jaxpr.eqns}
    with use_float64():
        (value,) = jax_internals.evaluate_jaxpr(jax_internals.forget_names(jaxpr), closed.consts, 1.0, np.ones(3))
    assert float(value) == np.sin(1.0) + 3.0
    assert len(jax_internals.drop_unused(closed.jaxpr, True)[0].invars) == 3


def test_an_operation_knows_the_line_of_the_user_and_passes_it_on():
    def square(x):
        return x * x

    (equation,) = trace(square, 2.0).jaxpr.eqns
    path, line = jax_internals.find_user_line(equation)
    assert (Path(path), line) == (Path(__file__), square.__code__.co_firstlineno + 1)
    assert square.__code__ in jax_internals.list_calls(equation)
    assert jax_internals.is_user_file(__file__)
    assert not jax_internals.is_user_file(jnp.__file__)

    def elsewhere(x):
        with jax_internals.keep_user_line(equation):
            return x + 1.0

    (other,) = trace(elsewhere, 2.0).jaxpr.eqns
    assert jax_internals.find_user_line(other) == (path, line)


def test_a_jaxpr_names_its_function_and_the_types_of_its_variables():
    def total(x):
        return jnp.sum(x)

    closed = trace(total, np.ones((2, 3)))
    file, name = jax_internals.find_traced_function(closed)
    assert (Path(file), name) == (Path(__file__), "total")
    assert jax_internals.find_traced_function(object()) == (None, "")
    kind = jax_internals.array_type(closed.jaxpr.invars[0])
    assert (kind.shape, kind.dtype) == ((2, 3), np.float64)


def test_a_tracer_is_told_from_an_array():
    seen = []
    jax.make_jaxpr(lambda x: seen.append(jax_internals.is_tracer(x)) or x)(1.0)
    assert seen == [True]
    assert not jax_internals.is_tracer(jnp.ones(2))


def test_arrays_in_a_jaxpr_are_copied():
    number, array = np.array(3.0), np.ones((2, 1))
    closed = trace(lambda x: x * number + jnp.sum(jnp.asarray(array)), 2.0)
    jax_internals.copy_literals(closed.jaxpr)
    consts = jax_internals.copy_constants(closed.consts)
    number[...] = array[...] = 4.0
    with use_float64():
        (value,) = jax_internals.evaluate_jaxpr(closed.jaxpr, consts, 2.0)
    assert float(value) == 8.0


def test_an_operation_is_evaluated_by_its_own_rule_for_derivatives():
    clip = jax.custom_jvp(lambda x: x)
    clip.defjvp(lambda x, x_d: (x[0], 3.0 * x_d[0]))
    closed = trace(clip, 2.0)
    (equation,) = (each for each in closed.jaxpr.eqns if each.primitive.name == "custom_jvp_call")
    with use_float64():
        slope = jax.grad(lambda x: jax_internals.evaluate_equation(equation, [x])[0])(2.0)
    assert float(slope) == 3.0
