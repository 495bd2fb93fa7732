"""Expression graphs of scalars and vectors, simplified while they are built, and templates made of them.

A node is an operation on earlier nodes. Equal operations share a node. Sums with zero and products with zero or one are
simplified at once, so that structural zeros of Jacobians and Hessians cost nothing. A node is a scalar, or a vector
with one entry for each unknown (the derivative of some scalar along theta); a scalar operand of a vector operation is
broadcast. A scalar is a double or a truth value; the two types do not mix.

A product with zero is zero only if the other factor is finite, which is not known yet when the product is left out. The
operations in such a factor that can be infinite or NaN for finite arguments (`MAY_FAIL`) are therefore *presumed*
finite. The program checks them at run time (`Graph.check`); if one is not finite, the caller falls back to JAX.

Operations of an expression graph, one row each: types of operands and result, value, LLVM code.

To add a function of the C library that JAX has under the same name, add one line here: `trace` finds it by its
primitive, `scalars` folds constants by its value, `llvm` writes its code, and `tests/test_operations.py` compares the
three.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
    gives_truth : bool
        Whether the result is a truth value, else it is a double; operands are truth values where there are primitives
        `of_truth`. `select` is treated separately.
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
    given: dict[str, Any] = {"primitives": (name,), "effort": 1 if "." in function else MANY} | more
    return Operation(name, value, code, operands, function=function, **given)


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
LONG = frozenset(name for name, operation in OPERATIONS.items() if operation.effort >= MANY)
FROM_LIBM = tuple(
    operation.function for operation in OPERATIONS.values() if operation.function and "." not in operation.function
)
"""Functions of the C library."""


Objects = NDArray[np.object_]

CHECKED = "check"
"""Name of the pointer to a double that is NaN once a value presumed finite was not."""


def _operator(op: str, swapped: bool = False) -> Callable[[Any, Any], Any]:
    """Return the method of a node that applies an operation to it and another operand, or the other way round."""

    def method(self: Any, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented  # NumPy then does it entry by entry
        return self.graph.apply(op, other, self) if swapped else self.graph.apply(op, self, other)

    return method


class Node:
    """One operation of a graph; arithmetic with nodes and numbers makes further ones.

    Attributes
    ----------
    index : its place in the graph, after those of its arguments
    op : one of `OPERATIONS`, "const", "load", "table" (numbers in memory), "lookup" (one of them), or the call of a
        routine: "factors", "solution" and "entry", see `switchfit.engine.native.llvm`
    args : its arguments; the number of a constant; (pointer, offset) of what is loaded; the bytes of a table; (table,
        index)
    vector, truth : whether it is a vector; whether it is a truth value, else it is a double or doubles
    """

    __slots__ = ("args", "graph", "index", "op", "truth", "vector")

    def __init__(self, graph: Graph, index: int, op: str, args: tuple[Any, ...], vector: bool) -> None:
        self.graph, self.index, self.op, self.args, self.vector = graph, index, op, args, vector
        self.truth = _is_truth(op, args)

    @property
    def number(self) -> Any:
        """Value of a constant; None for every other node."""
        return self.args[0] if self.op == "const" else None

    @property
    def values(self) -> NDArray[np.float64]:
        """Entries of a table."""
        return np.frombuffer(self.args[0])

    __add__, __radd__ = _operator("add"), _operator("add", swapped=True)
    __sub__, __rsub__ = _operator("sub"), _operator("sub", swapped=True)
    __mul__, __rmul__ = _operator("mul"), _operator("mul", swapped=True)
    __truediv__, __rtruediv__ = _operator("div"), _operator("div", swapped=True)
    __lt__, __gt__ = _operator("lt"), _operator("lt", swapped=True)
    __le__, __ge__ = _operator("le"), _operator("le", swapped=True)
    __and__, __or__ = _operator("and"), _operator("or")

    def __neg__(self) -> Node:
        return self.graph.apply("neg", self)

    def __invert__(self) -> Node:
        return self.graph.apply("not", self)

    def __bool__(self) -> bool:
        raise TypeError("a node is known only at run time: use apply('select', ...)")


def _is_truth(op: str, args: tuple[Any, ...]) -> bool:
    """Return whether an operation yields a truth value. LLVM checks that its arguments have the right types."""
    if op == "select":
        return args[1].truth
    operation = OPERATIONS.get(op)
    return op == "const" and isinstance(args[0], bool) if operation is None else operation.gives_truth


class Graph:
    """Nodes in the order in which they can be computed.

    Attributes
    ----------
    presumed : dict of index -> Node
        Nodes that must be finite, since products of zero with them were left out.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.presumed: dict[int, Node] = {}
        self._known: dict[tuple[Any, ...], Node] = {}
        self._finite: set[int] = set()
        self._uncertain: set[int] = set()

    def constant(self, number: Any) -> Node:
        """Return the node of a number or a truth value."""
        if isinstance(number, np.ndarray):
            number = number.item()
        number = bool(number) if isinstance(number, bool | np.bool_) else float(number)
        return self._node("const", (number,), False, key=("const", type(number), number, math.copysign(1.0, number)))

    def load(self, pointer: str, offset: int, vector: bool = False, certain: bool = True) -> Node:
        """Load pointer[offset]; unless it is `certain`, it may be infinite or NaN."""
        node = self._node("load", (pointer, offset), vector)
        if not certain:
            self._uncertain.add(node.index)
        return node

    def loads(self, pointer: str, count: int, offset: int = 0, vector: bool = False) -> Objects:
        """Load `count` consecutive entries: (count,)."""
        return as_objects([self.load(pointer, offset + k, vector) for k in range(count)])

    def lookup(self, table: NDArray[np.float64], index: Node) -> Node:
        """Return the entry of a constant table (K,) at an index that is an integer from 0 to K - 1.

        The caller guarantees the range: machine code reads the memory without a bounds check.
        """
        values = np.asarray(table, dtype=np.float64).tobytes()  # equal tables are shared
        return self.apply("lookup", self._node("table", (values,), False), index)

    def require(self, condition: Node) -> None:
        """Presume that a truth value is true: if it is not, the evaluation falls back to JAX."""
        self.presume(self.apply("div", 1.0, self.apply("select", condition, 1.0, 0.0)))

    def unit(self, position: int) -> Node:
        """Return the unit vector e_position, the vector of zeros for a position of none of the unknowns."""
        return self._node("unit", (position,), True)

    def apply(self, op: str, *given: Any) -> Node:
        """Return the node of an operation, which may be an existing or a simpler one."""
        args = tuple(a if isinstance(a, Node) else self.constant(a) for a in given)
        # Constants are folded as NumPy computes them, also to infinity and NaN.
        if args[0].op == "const" and all(a.op == "const" for a in args):
            with np.errstate(all="ignore"):
                return self.constant(OPERATIONS[op].value(*(a.args[0] for a in args)))
        simpler = self._simplify(op, args)
        if simpler is not None:
            return simpler
        # One order of the operands, so that a + b and b + a are one node.
        if op in COMMUTATIVE and args[0].index > args[1].index:
            args = args[::-1]
        return self._node(op, args, any(a.vector for a in args))

    def call(self, op: str, *args: Any, vector: bool = False) -> Node:
        """Return the node of a routine's call; its arguments are nodes, floats, and integers that say what it does."""
        return self._node(op, tuple(self.constant(a) if isinstance(a, float) else a for a in args), vector)

    def presume(self, node: Node) -> None:
        """Record all nodes that have to be finite for a node to be finite."""
        # A sum or product is finite if its operands are, overflow aside: only operations that may fail are recorded,
        # and the search goes on to the operands of all.
        pending = [node]
        while pending:
            each = pending.pop()
            if each.index in self._uncertain:
                self.presumed[each.index] = each
                continue
            if each.index in self._finite or each.op in ("const", "load", "unit") or each.truth:
                continue
            self._finite.add(each.index)
            if each.op == "lookup":  # at an index, which is finite
                if not np.isfinite(each.args[0].values).all():
                    self.presumed[each.index] = each
                continue
            # A quotient by a number other than zero cannot fail.
            if each.op in MAY_FAIL and not (each.op == "div" and each.args[1].number):
                if each.vector:  # a vector divided by a scalar
                    self.presume(self.apply("div", 1.0, each.args[1]))
                else:
                    self.presumed[each.index] = each
            pending += [a for a in each.args if isinstance(a, Node)]

    def find_failure(self, node: Node) -> Node:
        """Return 0 where a node is finite, else NaN: its product with zero, without simplification."""
        return self._node("mul", (self.constant(0.0), node), node.vector)

    def check(self) -> list[tuple[str, int, Node]]:
        """Return the store that makes `CHECKED` NaN if a presumption is wrong; an empty list without presumptions."""
        total = self.load(CHECKED, 0)
        for node in self.presumed.values():
            total = total + self.find_failure(node)
        return [(CHECKED, 0, total)] if self.presumed else []

    def _simplify(self, op: str, args: tuple[Node, ...]) -> Node | None:
        a, b = args[0], args[-1]
        if op in ("add", "sub"):
            if b.number == 0.0:
                return a
            if a.number == 0.0:
                return b if op == "add" else self.apply("neg", b)
            if b.op == "neg":
                return self.apply("sub" if op == "add" else "add", a, b.args[0])
            if a.op == "neg" and op == "add":
                return self.apply("sub", b, a.args[0])
        elif op == "mul":
            for this, other in ((a, b), (b, a)):
                # 0 * other: right unless `other` is infinite or NaN, which is checked at run time.
                if this.number == 0.0:
                    self.presume(other)
                    return this
                if this.number == 1.0:
                    return other
                if this.number == -1.0:
                    return self.apply("neg", other)
                if this.op == "neg":
                    return self.apply("neg", self.apply("mul", this.args[0], other))
        elif op == "div":
            if b.number == 1.0:
                return a
            if a.number == 0.0 and not b.vector:
                self.presume(self.apply("div", 1.0, b))
                return a
            # Division by a power of two is exact as a product.
            if b.number is not None and math.frexp(b.number)[0] in (0.5, -0.5):
                return self.apply("mul", a, 1.0 / b.number)
        elif op in ("neg", "not") and a.op == op:
            return a.args[0]
        elif op in ("and", "or"):
            for this, other in ((a, b), (b, a)):
                if this.number is not None:
                    return other if this.number == (op == "and") else this
        elif op == "select":
            if args[0].number is not None:
                return args[1] if args[0].number else args[2]
            if args[1] is args[2]:
                return args[1]
        elif op == "trunc" and a.op in INTEGERS:
            return a
        elif op == "lookup" and b.number is not None:
            return self.constant(a.values[int(b.number)])
        return None

    def _node(self, op: str, args: tuple[Any, ...], vector: bool, key: tuple[Any, ...] | None = None) -> Node:
        key = key or (op, vector, *((a.index if isinstance(a, Node) else a) for a in args))
        node = self._known.get(key)
        if node is None:
            node = Node(self, len(self.nodes), op, args, vector)
            self._known[key] = node
            self.nodes.append(node)
        return node


class Namespace:
    """NumPy functions, by name, for arrays of nodes: the `xp` of functions that run with NumPy too.

    Comparisons of nodes yield truth values, except ``==``, which tests whether two nodes are the same object.
    """

    def __init__(self, graph: Graph) -> None:
        self._graph = graph

    def __getattr__(self, name: str) -> Callable[..., Any]:
        operation = BY_VALUE.get(getattr(np, name))
        if operation is None:
            raise AttributeError(f"no operation for numpy.{name}: add it to engine/native/scalars.py")
        return np.frompyfunc(partial(self._graph.apply, operation.name), operation.operands, 1)


def as_objects(values: Sequence[Any]) -> Objects:
    """Return an object array (len,) of nodes and numbers."""
    array = np.empty(len(values), dtype=object)
    for k, value in enumerate(values):
        array[k] = value
    return array


def list_needed(outputs: Sequence[Node]) -> list[Node]:
    """Return all nodes that some outputs depend on, in order."""
    if not outputs:
        return []
    nodes, wanted = outputs[0].graph.nodes, {node.index for node in outputs}
    # Arguments have lower indices: one pass backward finds all.
    for node in reversed(nodes):
        if node.index in wanted:
            wanted.update([a.index for a in node.args if isinstance(a, Node)])
    return [nodes[k] for k in sorted(wanted)]


class Template:
    """A traced function of scalars that can be copied into graphs; inputs and outputs are lists of arrays.

    Parameters
    ----------
    outputs : list of arrays of nodes and numbers; the inputs are loads from pointers "0", "1", ...
    presumed : nodes that have to be finite
    """

    def __init__(self, outputs: Sequence[Objects], presumed: Sequence[Node] = ()) -> None:
        self.presumed = list(presumed)
        self.shapes = [np.shape(a) for a in outputs]
        self._flat = [list(np.asarray(a, dtype=object).reshape(-1)) for a in outputs]
        self._needed: dict[tuple[int, ...], list[Node]] = {}

    def __call__(
        self,
        graph: Graph,
        *inputs: Any,
        only: Sequence[int] | None = None,
        also: Sequence[Node] = (),
        checked: bool = False,
        known: Mapping[int, Node] | None = None,
    ) -> list[Objects]:
        """Copy the function into a graph; return its outputs, or `only` some, for the given inputs.

        With `checked`, the graph also presumes finite what the template does. The values of nodes on which these
        outputs depend, as of `list_long`, are returned `also`, in one more array; with `known`, by the index of the
        node, they are not computed again.
        """
        chosen = tuple(range(len(self._flat)) if only is None else only)
        given = [np.asarray(a, dtype=object).reshape(-1) for a in inputs]
        made: dict[int, Node] = dict(known or {})  # the copies by the index of the node here
        for node in self._list_needed(chosen, checked):
            if node.index in made:
                continue
            if node.op == "load":
                value = given[int(node.args[0])][node.args[1]]
                made[node.index] = value if isinstance(value, Node) else graph.constant(value)
            elif node.op == "const":
                made[node.index] = graph.constant(node.args[0])
            elif node.op == "lookup":
                made[node.index] = graph.lookup(node.args[0].values, made[node.args[1].index])
            elif node.op != "table":
                made[node.index] = graph.apply(node.op, *(made[a.index] for a in node.args))
        # What the template left out as a product with zero is presumed in the graph that uses it, with these inputs.
        for node in self.presumed if checked else ():
            graph.presume(made[node.index])
        results = []
        for k in chosen:
            values = [made[v.index] if isinstance(v, Node) else graph.constant(v) for v in self._flat[k]]
            results.append(as_objects(values).reshape(self.shapes[k]))
        return [*results, as_objects([made[node.index] for node in also])] if also else results

    @cached_property
    def _steps(self) -> tuple[list[tuple[int, int, int]], dict[int, Any], list[tuple[int, Any, list[int]]]]:
        """What `evaluate` does, by the indices of nodes: entries of inputs, numbers, operations on them in order."""
        nodes = self._list_needed(tuple(range(len(self._flat))))
        loads = [(node.index, int(node.args[0]), node.args[1]) for node in nodes if node.op == "load"]
        known = {node.index: node.number for node in nodes if node.op == "const"}
        known |= {node.index: node.values for node in nodes if node.op == "table"}
        values = {name: operation.value for name, operation in OPERATIONS.items()}
        values["lookup"] = lambda table, index: table[np.asarray(index, int)]
        return loads, known, [(n.index, values[n.op], [a.index for a in n.args]) for n in nodes if n.op in values]

    def evaluate(self, *inputs: Any) -> list[NDArray[np.float64]]:
        """Evaluate the function with NumPy; the entries of its inputs are numbers, or arrays (L,) of equal length.

        The outputs have an axis of length L in front if an input has.
        """
        loads, numbers, operations = self._steps
        known = numbers | {index: inputs[k][offset] for index, k, offset in loads}
        with np.errstate(all="ignore"):
            # The nodes in order, each an operation of NumPy on whole columns.
            for index, value, args in operations:
                known[index] = value(*[known[a] for a in args])
        results = []
        for values, shape in zip(self._flat, self.shapes, strict=True):
            entries = [known[v.index] if isinstance(v, Node) else v for v in values]
            rows = np.stack(np.broadcast_arrays(*entries), axis=-1) if entries else np.zeros(0)
            results.append(rows.reshape((*rows.shape[:-1], *shape)))
        return results

    @property
    def has_equal_outputs(self) -> bool:
        """Whether all outputs are the same operations of the same inputs."""
        keys = [[v.index if isinstance(v, Node) else (v,) for v in values] for values in self._flat]
        return all(each == keys[0] for each in keys)

    def list_long(self, only: Sequence[int]) -> list[Node]:
        """Return the operations that take long, functions of the C library, on which some outputs depend."""
        return [node for node in self._list_needed(tuple(only)) if node.op in LONG]

    def _list_needed(self, chosen: tuple[int, ...], checked: bool = False) -> list[Node]:
        """Return all nodes on which the chosen outputs depend and, if `checked`, the presumed ones."""
        key = (*chosen, -1) if checked else chosen
        if key not in self._needed:
            wanted = [v for k in chosen for v in self._flat[k] if isinstance(v, Node)]
            self._needed[key] = list_needed([*wanted, *(self.presumed if checked else [])])
        return self._needed[key]
