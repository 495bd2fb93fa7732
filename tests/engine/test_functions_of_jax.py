"""What JAX offers, as machine code: value, Jacobian and Hessian of many functions against JAX, or a reason why not."""

from __future__ import annotations

import re
import warnings
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from support.functions import FALLS_BACK, FUNCTIONS, LEFT_AT_SOME_POINTS, ZERO_TIMES_INFINITY
from switchfit.engine.native.llvm import compilation
from switchfit.engine.native.llvm import module as module_module
from switchfit.engine.native.scalars.graph import CHECKED, Graph
from switchfit.engine.native.tracing.trace import trace_scalars
from switchfit.engine.native.tracing.unsupported import Unsupported
from switchfit.problem.functions import use_float64

pytestmark = pytest.mark.promotes

OFTEN = (
    *("arithmetic: mod", "arithmetic: power of a negative", "elementary: guarded log", "rounding: round away"),
    *("decisions: where of booleans", "decisions: max of booleans", "decisions: xor", "decisions: count"),
    *("decisions: plus or minus one", "decisions: integer division", "decisions: select", "decisions: cond of several"),
    *("decisions: hysteresis", "arrays: einsum of a batch", "arrays: solve", "arrays: sum of nothing"),
    *("arrays: interp", "tables: interp of 500", "tables: map", "matrices: solve 3", "matrices: lu"),
    *("matrices: solve 6", "order: argsort 8", "places: at set by the state"),
    *("arrays: interp by hand", "arrays: cumprod", "places: optimization_barrier", "places: at add twice"),
    *("places: negative pad", "loops: scan of length 0", "loops: custom_jvp", "loops: while", "special: ndtr"),
)
"""What stands for all in the suite that runs by default."""

LONG = ("special: bessel_jn",)
"""Recurrences that lose digits, in JAX and in machine code."""


def derivatives_of(function):
    """Value, Jacobian and Hessian of w . f, written as the kernels write them."""

    def all_of(x, w):
        f = lambda x: jnp.ravel(jnp.asarray(function(x))).astype(jnp.float64)  # noqa: E731

        def weighted(x):
            value = f(x)
            return w[: value.size] @ value

        return [f(x), jax.jacfwd(f)(x), jax.jacfwd(jax.grad(weighted))(x)]

    return all_of


def machine_code_of(template, count):
    """A function of (x, w) that returns arrays as the template has them, and whether JAX has to do it again."""
    graph = Graph()
    outputs = template(graph, graph.loads("x", 3), graph.loads("w", count), checked=True)
    ends = np.cumsum([output.size for output in outputs])
    nodes = np.concatenate([output.reshape(-1) for output in outputs])
    module = module_module.Module(4)
    stores = [("y", k, node) for k, node in enumerate(nodes)] + graph.check()
    module.write_straight_line("f", stores)
    names = module.pointers["f"]
    program = compilation.compile_modules([module.take()])  # the code is gone with it

    def evaluate(x, w):
        y, wrong = np.full(ends[-1], 7e77), np.zeros(1)
        arrays = {"x": x, "w": w, "y": y, CHECKED: wrong}
        program.function("f", len(names))(*(arrays[name].ctypes.data for name in names))
        parts = np.split(y, ends[:-1])
        return [part.reshape(output.shape) for part, output in zip(parts, outputs, strict=True)], wrong[0] != 0.0

    return evaluate


def fold_constants(template, x, w):
    """The value that the graph computes by itself where the arguments are numbers."""
    value = template(Graph(), x, w)[0]
    return np.array([node.number for node in value.reshape(-1)], float).reshape(value.shape)


def points_of(name):
    """Three points inside, and two at which something happens: zeros of both signs, equal entries, integers, halves."""
    random = np.random.default_rng(zlib.crc32(name.encode()))
    inside = [random.uniform(0.3, 1.4, 3), random.uniform(0.3, 1.4, 3), random.uniform(-1.4, 1.4, 3)]
    return [*inside, np.array([0.0, 0.0, -0.0]), np.array([1.0, -0.5, 1.0])]


def assert_same_function(name):
    weights = np.random.default_rng(0).uniform(0.5, 1.5, 40)
    both = derivatives_of(FUNCTIONS[name])
    if name in FALLS_BACK:
        with use_float64(), pytest.raises(Unsupported, match=f"^the function {re.escape(FALLS_BACK[name])}") as caught:
            trace_scalars(both, (3,), (40,))
        assert "internal" not in str(caught.value)
        return
    with use_float64(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of JAX, about narrow types and the like
        template = trace_scalars(both, (3,), (40,))
        evaluate = machine_code_of(template, 40)
        folded = fold_constants(template, points_of(name)[0], weights)
        by_jax = jax.jit(both)
        pairs = [(x, evaluate(x, weights), by_jax(x, weights)) for x in points_of(name)]
    relative = 1e-10 if name in LONG else 1e-12
    if name in LEFT_AT_SOME_POINTS:
        assert {again for _, (_, again), _ in pairs} == {False, True}
        pairs = [(x, (found, again), expected) for x, (found, again), expected in pairs if not again]
    else:
        np.testing.assert_allclose(folded, pairs[0][2][0], rtol=relative, atol=1e-15, err_msg=f"folded, {name}")
    undefined = False
    for x, (found, again), expected in pairs:
        for what, own, other in zip(("value", "Jacobian", "Hessian"), found, map(np.asarray, expected), strict=True):
            assert own.shape == other.shape
            size = np.max(np.abs(other[np.isfinite(other)]), initial=0.0)
            lost = np.isnan(other) & ~np.isnan(own)
            if what != "value" and name in ZERO_TIMES_INFINITY:
                undefined |= bool(lost.any())
                assert again or not lost.any(), "machine code does not hand this point to JAX"
                own, other = own[~lost], other[~lost]
            message = f"{what} of {name} at {x.tolist()}"
            np.testing.assert_allclose(own, other, rtol=relative, atol=relative * size + 1e-15, err_msg=message)
    assert undefined == (name in ZERO_TIMES_INFINITY), "machine code and JAX agree: take it from the list"


@pytest.mark.parametrize("name", [pytest.param(f, marks=[pytest.mark.fuzz] * (f not in OFTEN)) for f in FUNCTIONS])
def test_functions_of_models(name):
    assert_same_function(name)


def test_the_lists_are_of_functions_that_exist():
    assert {*FALLS_BACK, *ZERO_TIMES_INFINITY, *OFTEN, *LONG, *LEFT_AT_SOME_POINTS} <= set(FUNCTIONS)
