"""The adaptive solver: SciPy's RK45 with its step size control, as straight lines around the slope of a mode."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.integrate import RK45

from switchfit.discretization.rows import combine
from switchfit.engine.native.llvm import Module
from switchfit.engine.native.scalars import CHECKED, Graph, Objects, Template, as_objects
from switchfit.engine.native.templates import ELL, F, Sizes

SLOPE = ("c", "p", "moment", "signal", "y", "K", CHECKED)
ADAPTIVE = ("state", "y", "argument", "K")


class Adaptive(NamedTuple):
    """Places in the state of the adaptive solver.

    t, h : where it is, and how long a step it will try; `step` is what it tries, which may be cut by the `end`
    rtol, atol : tolerances
    refused, stuck : 1 if the last step was refused; if the next would not change t
    low, high : between which moments the field may be asked
    """

    t: int = 0
    h: int = 1
    end: int = 2
    rtol: int = 3
    atol: int = 4
    refused: int = 5
    stuck: int = 6
    low: int = 7
    high: int = 8
    step: int = 9

    @property
    def size(self) -> int:
        """Number of places."""
        return len(self)


def write_slope(
    module: Module, name: str, stage: Template, inputs: tuple[Graph, Objects, list[Objects]], sizes: Sizes
) -> None:
    """Write f and ell at one moment: the derivative of y = (x, running cost so far); `inputs` are a graph, p and c."""
    graph, p, constants = inputs
    t, origin = graph.loads("moment", 2)
    signal = graph.loads("signal", 4 * sizes.signals)
    none = np.full(sizes.n, graph.constant(0.0), dtype=object)
    given = (t, graph.loads("y", sizes.n), p, none, graph.constant(0.0), origin, signal, *constants)
    f, ell = stage(graph, *given, only=(F, ELL), checked=True)
    stores = [("K", k, node) for k, node in enumerate([*f, ell.item()])]
    module.straight(name, SLOPE, stores + graph.check(), seen=True)


def write_control(module: Module, sizes: Sizes) -> None:
    """Write what the solver does between its slopes. Of its state, which lies in memory, `Adaptive` says the places."""
    size = sizes.n + 1
    A, B, E = RK45.A, RK45.B, RK45.E
    at = Adaptive()

    def begun() -> tuple[Graph, Objects, Objects]:
        graph = Graph()
        return graph, graph.loads("state", at.size), graph.loads("y", size)

    graph, state, _ = begun()
    t, h, end = state[at.t], state[at.h], state[at.end]
    step = graph.apply("select", graph.apply("le", end, t + h), end - t, h)
    module.straight("adaptive_begin", ADAPTIVE, [("state", at.step, step)])
    for j in range(1, len(A)):
        graph, state, y = begun()
        K = [graph.loads("K", size, k * size) for k in range(j)]
        argument = y + state[at.step] * combine(A[j].tolist(), K)
        module.straight(f"adaptive_{j}", ADAPTIVE, [("argument", k, node) for k, node in enumerate(argument)])
    graph, state, y = begun()
    K = [graph.loads("K", size, k * size) for k in range(len(B))]
    after = y + state[at.step] * combine(B.tolist(), K)
    module.straight("adaptive_after", ADAPTIVE, [("argument", k, node) for k, node in enumerate(after)])

    graph, state, y = begun()
    after = graph.loads("argument", size)
    K = [graph.loads("K", size, k * size) for k in range(len(E))]
    t, step, end = state[at.t], state[at.step], state[at.end]
    error = step * combine(E.tolist(), K)
    both = ((graph.apply("abs", old), graph.apply("abs", new)) for old, new in zip(y, after, strict=True))
    larger = as_objects([graph.apply("max", old, new) for old, new in both])
    relative = error / (state[at.atol] + state[at.rtol] * larger)
    norm = graph.apply("sqrt", (relative * relative).sum() / size)
    accepted = graph.apply("lt", norm, 1.0)
    factor = 0.9 * graph.apply("pow", norm, -0.2)
    factor = graph.apply("min", graph.apply("max", factor, 0.2), 10.0)
    factor = graph.apply("select", graph.apply("eq", norm, 0.0), 10.0, factor)
    again = graph.apply("and", accepted, graph.apply("ne", state[at.refused], 0.0))
    factor = graph.apply("select", again, graph.apply("min", factor, 1.0), factor)
    factor = graph.apply("select", graph.apply("ne", norm, norm), 0.2, factor)
    reached = graph.apply("select", graph.apply("eq", step, end - t), end, t + step)
    shortest = graph.apply("min", step, step * factor)
    # Written so that a step which is not a number is stuck as well: it would be tried for ever.
    goes_on = graph.apply("lt", 10 * np.finfo(float).eps * graph.apply("abs", t), shortest)
    stuck = graph.apply("not", goes_on)
    number = {name: graph.apply("select", flag, 1.0, 0.0) for name, flag in (("yes", accepted), ("stuck", stuck))}
    stores = [
        ("state", at.t, graph.apply("select", accepted, reached, t)),
        ("state", at.h, step * factor),
        ("state", at.refused, 1.0 - number["yes"]),
        ("state", at.stuck, number["stuck"]),
    ]
    stores += [
        ("y", k, graph.apply("select", accepted, new, old)) for k, (new, old) in enumerate(zip(after, y, strict=True))
    ]
    module.straight("adaptive_judge", ADAPTIVE, stores)
