"""Expression graphs of scalars and vectors, simplified while they are built.

A node is an operation on earlier nodes. Equal operations share a node. Sums with zero and products with zero or one are
simplified at once, so that structural zeros of Jacobians and Hessians cost nothing. A node is a scalar, or a vector
with one entry for each unknown (the derivative of some scalar along theta); a scalar operand of a vector operation is
broadcast. A scalar is a double or a truth value; the two types do not mix.

A product with zero is zero only if the other factor is finite, which is not known yet when the product is left out. The
operations in such a factor that can be infinite or NaN for finite arguments (`MAY_FAIL`) are therefore *presumed*
finite. The program checks them at run time (`Graph.check`); if one is not finite, the caller falls back to JAX.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from switchfit.engine.native.scalars.operations import BY_VALUE, COMMUTATIVE, INTEGERS, MAY_FAIL, OPERATIONS

Objects = NDArray[np.object_]
"""An array of nodes, or of nodes and numbers."""

Scalar: TypeAlias = "Node | float"
"""A node, or a number or a truth value that is known while a graph is built."""

CHECKED = "check"
"""Name of the pointer to a double that is NaN once a value presumed finite was not."""


def _operator(op: str, swapped: bool = False) -> Callable[[Any, Any], Any]:
    """Return the method of a node that applies an operation to it and another operand, or the other way round."""

    def method(self: Node, other: Scalar | Objects) -> Node:
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
    def number(self) -> float | None:
        """Value of a constant, a double or a truth value; None for every other node."""
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

    def constant(self, number: float | np.bool_ | NDArray[Any]) -> Node:
        """Return the node of a number or a truth value."""
        if isinstance(number, np.ndarray):
            number = number.item()
        # 1, 1.0 and True are the same key of a dictionary, and so are 0.0 and -0.0: type and sign tell them apart.
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

    def apply(self, op: str, *given: Scalar) -> Node:
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

    def call(self, op: str, *args: object, vector: bool = False) -> Node:
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
        # Arguments by their index: a node is its place in the graph. Equal keys are equal values, so that common
        # subexpressions of f, its Jacobians and its second derivatives are computed once.
        key = key or (op, vector, *((a.index if isinstance(a, Node) else a) for a in args))
        node = self._known.get(key)
        if node is None:
            node = Node(self, len(self.nodes), op, args, vector)
            self._known[key] = node
            self.nodes.append(node)
        return node


class Namespace:
    """NumPy functions, by name, for arrays of nodes: the ``xp`` of functions that run with NumPy too.

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
