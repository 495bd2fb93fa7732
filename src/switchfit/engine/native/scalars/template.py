"""Templates: traced functions of scalars, which are copied into graphs or evaluated by NumPy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import Traced
from switchfit.engine.native.scalars.graph import Graph, Node, Objects, Scalar, as_objects, list_needed
from switchfit.engine.native.scalars.operations import LONG, OPERATIONS


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
        *inputs: Scalar | NDArray[Any],
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
        # Nodes of the template in their order, each applied anew in the other graph: with known inputs it simplifies
        # further, and what both have in common is one node there.
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
        known: dict[int, Any] = {node.index: node.number for node in nodes if node.op == "const"}
        known |= {node.index: node.values for node in nodes if node.op == "table"}
        values = {name: operation.value for name, operation in OPERATIONS.items()}
        values["lookup"] = lambda table, index: table[np.asarray(index, int)]
        return loads, known, [(n.index, values[n.op], [a.index for a in n.args]) for n in nodes if n.op in values]

    def evaluate(self, *inputs: Traced) -> list[NDArray[np.float64]]:
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
