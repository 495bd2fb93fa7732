"""The table of operations: value, code and JAX's primitive agree, at random points and where something happens."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from switchfit.engine.native.llvm import compilation
from switchfit.engine.native.llvm import module as module_module
from switchfit.engine.native.scalars.graph import Graph
from switchfit.engine.native.scalars.operations import MAY_FAIL, OPERATIONS
from switchfit.problem.functions import use_float64

SIZES = [0.0, 0.5, 1.0, 2.5, 2e3, 1e-300, 1e300, np.inf]
SPECIAL = [*SIZES, *(-size for size in SIZES), 5e-324, np.nan]
SIGN_OF_ZERO_LEFT_OPEN = ("max", "min")
"""Of 0.0 and -0.0 NumPy takes the first."""


def points_of(operation):
    """Arrays of operands: (count, K)."""
    if operation.name == "select":
        return np.array([[c, a, b] for c in (0.0, 1.0) for a, b in product(SPECIAL, repeat=2)]).T
    if operation.of_truth:
        return np.array(list(product([0.0, 1.0], repeat=operation.operands))).T
    random = np.random.default_rng(0)
    drawn = [scale * random.normal(size=(operation.operands, 40)) for scale in (0.5, 1.0, 30.0)]
    return np.concatenate([np.array(list(product(SPECIAL, repeat=operation.operands))).T, *drawn], axis=1)


def is_truth(operation, k):
    """Whether the k-th operand is a truth value."""
    return operation.of_truth or (operation.name == "select" and k == 0)


def applied(graph, operation, operands):
    """The node of an operation, as a double."""
    node = graph.apply(operation.name, *operands)
    return graph.apply("select", node, 1.0, 0.0) if node.truth else node


def by_machine_code(operation, points):
    graph = Graph()
    operands = [graph.load("x", k) for k in range(operation.operands)]
    operands = [graph.apply("ne", x, 0.0) if is_truth(operation, k) else x for k, x in enumerate(operands)]
    module = module_module.Module(1)
    module.write_straight_line("f", [("y", 0, applied(graph, operation, operands))])
    assert graph.nodes[-1].op in (operation.name, "select"), "simplified away"
    program = compilation.compile_modules([module.take()])
    function, y = program.function("f", 2), np.zeros(1)
    found = []
    for x in np.ascontiguousarray(points.T):
        function(x.ctypes.data, y.ctypes.data)
        found.append(y[0])
    return np.array(found)


def by_folding(operation, points):
    graph = Graph()
    operands = [
        [graph.constant(bool(x) if is_truth(operation, k) else x) for k, x in enumerate(point)] for point in points.T
    ]
    return np.array([applied(graph, operation, given).number for given in operands])


def by_numpy(operation, points):
    with np.errstate(all="ignore"):
        given = [row.astype(bool) if is_truth(operation, k) else row for k, row in enumerate(points)]
        return np.asarray(operation.value(*given), float)


def assert_same(found, expected, points, name, relative=1e-14):
    np.testing.assert_allclose(found, expected, rtol=relative, atol=0.0, err_msg=name)
    zero = (expected == 0.0) & ~((points == 0.0).all(0) & (name in SIGN_OF_ZERO_LEFT_OPEN))
    np.testing.assert_array_equal(np.signbit(found[zero]), np.signbit(expected[zero]), err_msg=f"sign of zero, {name}")


@pytest.mark.parametrize("name", OPERATIONS)
def test_value_code_and_what_the_table_says_agree(name):
    """Whether it commutes, gives whole numbers, and may give what is not finite for finite operands."""
    operation = OPERATIONS[name]
    points = points_of(operation)
    expected = by_numpy(operation, points)
    assert_same(by_folding(operation, points), expected, points, name)
    assert_same(by_machine_code(operation, points), expected, points, name)
    if operation.operands == 2:
        assert operation.commutes == np.array_equal(expected, by_numpy(operation, points[::-1]), equal_nan=True)
    finite = expected[np.isfinite(expected)]
    whole = np.array_equal(finite, np.round(finite))
    assert operation.gives_integer == (whole and not (operation.of_truth or operation.gives_truth))
    tame = np.isfinite(points).all(0) & (np.abs(points) < 1e100).all(0)  # sums and products overflow
    if not operation.of_truth:
        assert (name in MAY_FAIL) == (not np.isfinite(expected[tame]).all())


@pytest.mark.parametrize("name", [name for name, operation in OPERATIONS.items() if operation.primitives])
def test_the_value_is_that_of_the_primitive_of_jax(name):
    operation = OPERATIONS[name]
    points = points_of(operation)
    points = points[:, ((points == 0.0) | ~(np.abs(points) < 1e-307)).all(0)]  # XLA takes subnormals for zeros
    for primitive in operation.primitives:
        if primitive == "add_any":
            continue  # what sums of derivatives are
        with use_float64():
            expected = np.asarray(getattr(jax.lax, primitive)(*map(jnp.asarray, points)), float)
        assert_same(by_numpy(operation, points), expected, points, name, 1e-12)
