"""Operations of an expression graph, one row each: types of operands and result, value, LLVM code.

To add a function of the C library that JAX has under the same name, add one line here: `tracing` finds it by its
primitive, `graph` folds constants by its value, `llvm` writes its code, and `tests/engine/test_operations.py` compares
the three.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from switchfit.arrays import FloatArray

LIBM_EFFORT = 20
"""Cost of a function of the C library, in additions."""


class Operation(NamedTuple):
    """One operation.

    Attributes
    ----------
    name : str
    value : callable
        Function of NumPy that evaluates it for numbers or arrays; `Namespace` finds the operation by it.
    code : str
        LLVM's instruction, with {0}, {1}, {2} for the operands and {type} for the type of the result: a double, a
        vector of doubles or a truth value.
    operands : int
        Number of operands.
    gives_truth : bool
        Whether the result is a truth value, else it is a double; operands are truth values where there are primitives
        `of_truth`. ``select`` is treated separately.
    function : str or None
        Function that its code calls: an intrinsic ("llvm.") or a function of the C library.
    primitives, of_truth : tuple of str
        JAX primitives that it implements, for doubles and for truth values.
    effort : int
        Its cost, in additions.
    may_fail : bool
        Whether it is infinite or NaN for some finite operands; overflow of sums and products does not count.
    commutes : bool
    gives_integer : bool
        Whether its result is an integer, as a double.
    known_alike : bool
        Whether NumPy and JAX agree for arrays of any type: known arrays are then evaluated without XLA.
    """

    name: str
    value: Callable[..., Any]
    code: str
    operands: int
    gives_truth: bool = False
    function: str | None = None
    primitives: tuple[str, ...] = ()
    of_truth: tuple[str, ...] = ()
    effort: int = 1
    may_fail: bool = False
    commutes: bool = False
    gives_integer: bool = False
    known_alike: bool = False


def _arithmetic(name: str, value: Callable[..., Any], instruction: str, **more: Any) -> Operation:
    return Operation(name, value, f"{instruction} {{type}} {{0}}, {{1}}", 2, **({"primitives": (name,)} | more))


def _comparison(name: str, value: Callable[..., Any], condition: str, **more: Any) -> Operation:
    code = f"fcmp {condition} double {{0}}, {{1}}"
    return Operation(name, value, code, 2, gives_truth=True, primitives=(name,), known_alike=True, **more)


def _logic(name: str, value: Callable[..., Any], of_truth: tuple[str, ...], **more: Any) -> Operation:
    given: dict[str, Any] = {"operands": 2, "code": f"{name} i1 {{0}}, {{1}}", "commutes": True} | more
    return Operation(name, value, gives_truth=True, of_truth=of_truth, **given)


def _call(name: str, value: Callable[..., Any], function: str = "", operands: int = 1, **more: Any) -> Operation:
    """Return an operation that calls an intrinsic, "llvm.*", or a function of the C library, by default of its name."""
    function = function or name
    code = f"call double @{function}({', '.join(f'double {{{k}}}' for k in range(operands))})"
    given: dict[str, Any] = {"primitives": (name,), "effort": 1 if "." in function else LIBM_EFFORT} | more
    return Operation(name, value, code, operands, function=function, **given)


def _round_half_away(a: FloatArray) -> FloatArray:
    size = np.abs(a)
    return np.copysign(np.floor(size) + (size - np.floor(size) >= 0.5), a)


OPERATIONS = {
    operation.name: operation
    for operation in (
        # `contract` lets LLVM fuse a product and a sum, which rounds once, not twice; it may not reorder sums.
        _arithmetic("add", np.add, "fadd contract", primitives=("add", "add_any"), commutes=True, known_alike=True),
        _arithmetic("sub", np.subtract, "fsub contract", known_alike=True),
        _arithmetic("mul", np.multiply, "fmul contract", commutes=True, known_alike=True),
        _arithmetic("div", np.divide, "fdiv", effort=4, may_fail=True),
        Operation("neg", np.negative, "fneg {type} {0}", 1, primitives=("neg",)),
        # Ordered comparisons are false for NaN; `une`, unordered, is true for it, as in Python.
        _comparison("lt", np.less, "olt"),
        _comparison("le", np.less_equal, "ole"),
        _comparison("gt", np.greater, "ogt"),
        _comparison("ge", np.greater_equal, "oge"),
        _comparison("eq", np.equal, "oeq", commutes=True),
        _comparison("ne", np.not_equal, "une", commutes=True),
        _logic("and", np.bitwise_and, ("and", "min"), known_alike=True),
        _logic("or", np.bitwise_or, ("or", "max"), known_alike=True),
        _logic("xor", np.bitwise_xor, ("xor", "ne")),
        _logic("not", np.invert, ("not",), operands=1, code="xor i1 {0}, true", commutes=False),
        Operation("select", np.where, "select i1 {0}, {type} {1}, {type} {2}", 3),
        _call("max", np.maximum, "llvm.maximum.f64", operands=2, commutes=True),
        _call("min", np.minimum, "llvm.minimum.f64", operands=2, commutes=True),
        _call("abs", np.abs, "llvm.fabs.f64"),
        _call("sqrt", np.sqrt, "llvm.sqrt.f64", effort=4, may_fail=True),
        _call("floor", np.floor, "llvm.floor.f64", gives_integer=True),
        _call("ceil", np.ceil, "llvm.ceil.f64", gives_integer=True),
        _call("trunc", np.trunc, "llvm.trunc.f64", primitives=(), gives_integer=True),
        _call("rint", np.rint, "llvm.rint.f64", primitives=(), gives_integer=True),
        _call("round", _round_half_away, "llvm.round.f64", primitives=(), gives_integer=True),
        _call("exp", np.exp, may_fail=True),
        _call("exp2", np.exp2, may_fail=True),
        _call("expm1", np.expm1, may_fail=True),
        _call("log", np.log, may_fail=True),
        _call("log1p", np.log1p, may_fail=True),
        _call("pow", np.float_power, operands=2, may_fail=True),  # np.power(-inf, 0.5) is NaN
        _call("rem", np.fmod, "fmod", operands=2, may_fail=True),
        _call("cbrt", np.cbrt),
        _call("sin", np.sin),
        _call("cos", np.cos),
        _call("tan", np.tan),
        _call("asin", np.arcsin, may_fail=True),
        _call("acos", np.arccos, may_fail=True),
        _call("atan", np.arctan),
        _call("atan2", np.arctan2, operands=2),
        _call("sinh", np.sinh, may_fail=True),
        _call("cosh", np.cosh, may_fail=True),
        _call("tanh", np.tanh),
        _call("asinh", np.arcsinh),
        _call("acosh", np.arccosh, may_fail=True),
        _call("atanh", np.arctanh, may_fail=True),
        _call("erf", np.vectorize(math.erf, otypes=[float])),
        _call("erfc", np.vectorize(math.erfc, otypes=[float])),
    )
}


BY_VALUE = {operation.value: operation for operation in OPERATIONS.values()}
"""Operations by their NumPy functions."""


COMMUTATIVE = frozenset(name for name, operation in OPERATIONS.items() if operation.commutes)


INTEGERS = frozenset(name for name, operation in OPERATIONS.items() if operation.gives_integer)


MAY_FAIL = frozenset(name for name, operation in OPERATIONS.items() if operation.may_fail)


LONG = frozenset(name for name, operation in OPERATIONS.items() if operation.effort >= LIBM_EFFORT)


FROM_LIBM = tuple(
    operation.function for operation in OPERATIONS.values() if operation.function and "." not in operation.function
)
"""Functions of the C library."""
