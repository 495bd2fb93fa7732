"""Operations of an expression graph, one row each: types of operands and result, value, LLVM code.

To add a function of the C library that JAX has under the same name, add one line here: `trace` finds it by its
primitive, `scalars` folds constants by its value, `llvm` writes its code, and `tests/test_operations.py` compares the
three.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

MANY = 20
"""Cost of a function of the C library, in additions."""


class Operation(NamedTuple):
    """One operation.

    Attributes
    ----------
    name : str
    value : callable
        Function of NumPy that evaluates it for numbers or arrays; `scalars.Namespace` finds the operation by it.
    code : str
        LLVM's instruction, with {0}, {1}, {2} for the operands and {type} for the type of the result: a double, a
        vector of doubles or a truth value.
    operands : int
        Number of operands.
    takes_truth, gives_truth : bool
        Whether operands, or the result, are truth values; else they are doubles. `select` is treated separately.
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
    takes_truth: bool = False
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
    return Operation(name, value, takes_truth=True, gives_truth=True, of_truth=of_truth, **given)


def _call(name: str, value: Callable[..., Any], function: str, operands: int = 1, **more: Any) -> Operation:
    given = ", ".join(f"double {{{k}}}" for k in range(operands))
    code = f"call double @{function}({given})"
    return Operation(name, value, code, operands, function=function, **({"primitives": (name,)} | more))


def _intrinsic(name: str, value: Callable[..., Any], intrinsic: str, **more: Any) -> Operation:
    return _call(name, value, f"llvm.{intrinsic}.f64", **more)


def _from_libm(name: str, value: Callable[..., Any], function: str | None = None, **more: Any) -> Operation:
    return _call(name, value, function or name, effort=MANY, **more)


def _round_half_away(a: Any) -> Any:
    size = np.abs(a)
    return np.copysign(np.floor(size) + (size - np.floor(size) >= 0.5), a)


OPERATIONS = {
    operation.name: operation
    for operation in (
        _arithmetic("add", np.add, "fadd contract", primitives=("add", "add_any"), commutes=True, known_alike=True),
        _arithmetic("sub", np.subtract, "fsub contract", known_alike=True),
        _arithmetic("mul", np.multiply, "fmul contract", commutes=True, known_alike=True),
        _arithmetic("div", np.divide, "fdiv", effort=4, may_fail=True),
        Operation("neg", np.negative, "fneg {type} {0}", 1, primitives=("neg",)),
        _comparison("lt", np.less, "olt"),
        _comparison("le", np.less_equal, "ole"),
        _comparison("eq", np.equal, "oeq", commutes=True),
        _comparison("ne", np.not_equal, "une", commutes=True),
        _logic("and", np.bitwise_and, ("and", "min"), known_alike=True),
        _logic("or", np.bitwise_or, ("or", "max"), known_alike=True),
        _logic("xor", np.bitwise_xor, ("xor", "ne")),
        _logic("not", np.invert, ("not",), operands=1, code="xor i1 {0}, true", commutes=False),
        Operation("select", np.where, "select i1 {0}, {type} {1}, {type} {2}", 3),
        _intrinsic("max", np.maximum, "maximum", operands=2, commutes=True),
        _intrinsic("min", np.minimum, "minimum", operands=2, commutes=True),
        _intrinsic("abs", np.abs, "fabs"),
        _intrinsic("sqrt", np.sqrt, "sqrt", effort=4, may_fail=True),
        _intrinsic("floor", np.floor, "floor", gives_integer=True),
        _intrinsic("ceil", np.ceil, "ceil", gives_integer=True),
        _intrinsic("trunc", np.trunc, "trunc", primitives=(), gives_integer=True),
        _intrinsic("rint", np.rint, "rint", primitives=(), gives_integer=True),
        _intrinsic("round", _round_half_away, "round", primitives=(), gives_integer=True),
        _from_libm("exp", np.exp, may_fail=True),
        _from_libm("exp2", np.exp2, may_fail=True),
        _from_libm("expm1", np.expm1, may_fail=True),
        _from_libm("log", np.log, may_fail=True),
        _from_libm("log1p", np.log1p, may_fail=True),
        _from_libm("pow", np.float_power, operands=2, may_fail=True),  # np.power(-inf, 0.5) is NaN
        _from_libm("rem", np.fmod, "fmod", operands=2, may_fail=True),
        _from_libm("cbrt", np.cbrt),
        _from_libm("sin", np.sin),
        _from_libm("cos", np.cos),
        _from_libm("tan", np.tan),
        _from_libm("asin", np.arcsin, may_fail=True),
        _from_libm("acos", np.arccos, may_fail=True),
        _from_libm("atan", np.arctan),
        _from_libm("atan2", np.arctan2, operands=2),
        _from_libm("sinh", np.sinh, may_fail=True),
        _from_libm("cosh", np.cosh, may_fail=True),
        _from_libm("tanh", np.tanh),
        _from_libm("asinh", np.arcsinh),
        _from_libm("acosh", np.arccosh, may_fail=True),
        _from_libm("atanh", np.arctanh, may_fail=True),
        _from_libm("erf", np.vectorize(math.erf, otypes=[float])),
        _from_libm("erfc", np.vectorize(math.erfc, otypes=[float])),
    )
}

BY_VALUE = {operation.value: operation for operation in OPERATIONS.values()}
"""Operations by their NumPy functions."""

COMMUTATIVE = frozenset(name for name, operation in OPERATIONS.items() if operation.commutes)
INTEGERS = frozenset(name for name, operation in OPERATIONS.items() if operation.gives_integer)
MAY_FAIL = frozenset(name for name, operation in OPERATIONS.items() if operation.may_fail)
LONG = frozenset(name for name, operation in OPERATIONS.items() if operation.effort >= MANY)
FROM_LIBM = tuple(
    operation.function for operation in OPERATIONS.values() if operation.function and "." not in operation.function
)
"""Functions of the C library."""
