"""Adaptive steps in machine code: `discretization.step_size` as straight-line functions between slopes of a mode."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from switchfit.discretization.implicit_rows import estimate_error
from switchfit.discretization.rows import combine, end_of_row, stage_state
from switchfit.discretization.step_size import STIFF_EXPONENT, Progress, Tolerances, judge_error, judge_step
from switchfit.discretization.tableaus import ADAPTIVE, STIFF
from switchfit.engine.native.elimination import eliminate
from switchfit.engine.native.kernels import Kernels, Store
from switchfit.engine.native.llvm import Module
from switchfit.engine.native.scalars import CHECKED, Graph, Namespace, Node, Objects, Template
from switchfit.engine.native.templates import ELL, ELL_X, F_X, F, Sizes

STAGES = len(ADAPTIVE.tableau.b)
STAGE_TIMES = [*ADAPTIVE.tableau.c.tolist(), 1.0]
"""Times of the slopes of a step, as fractions of it; the last one is at its end."""

IMPLICIT_TIMES = [0.0, *STIFF.c.tolist()]
"""Times of the start and of the stages of an implicit step, as fractions of it."""


class Adaptive(NamedTuple):
    """Offsets in the state of the adaptive solver, in doubles.

    t, step, refused, stuck : of `Progress`; truth values are 0 or 1
    end : of the solve
    rtol, atol : of `Tolerances`
    low, high : the times between which a signal may be looked up
    """

    t: int = 0
    step: int = 1
    refused: int = 2
    stuck: int = 3
    end: int = 4
    rtol: int = 5
    atol: int = 6
    low: int = 7
    high: int = 8

    @property
    def size(self) -> int:
        """Number of doubles."""
        return len(self)


def write_slope(kernels: Kernels, mode: int, stage: Template) -> None:
    """Write f and ell of a mode at one time: the derivative of y = (x, running cost so far)."""
    graph = Graph()
    (p, constants), zero = kernels.inputs(graph), graph.constant(0.0)
    t, origin = graph.loads("moment", 2)
    signal, zeros = graph.loads("signal", 4 * kernels.sizes.signals), np.full(kernels.sizes.n, zero, dtype=object)
    given = (t, graph.loads("y", kernels.sizes.n), p, zeros, zero, origin, signal, *constants)
    f, ell = stage(graph, *given, only=(F, ELL), checked=True)
    stores = [("K", k, node) for k, node in enumerate([*f, ell.item()])]
    kernels.module.write_straight_line(f"slope_{mode}", stores + graph.check())


def step_functions() -> list[str]:
    """Return the names of the functions of `write_step` in the order of their calls; a slope precedes each call."""
    return [*(f"adaptive_{j}" for j in range(1, STAGES)), "adaptive_after", "adaptive_judge"]


def write_step(module: Module, sizes: Sizes) -> None:
    """Write the functions between the slopes K of a step: the states for the next slope, and the error control."""
    size, at = sizes.n + 1, Adaptive()

    # y is (x, running cost): the mesh has to resolve both. A slope of the mode is evaluated between two of these
    # functions.
    def begin(slopes: int) -> tuple[Graph, Objects, Objects, list[Objects]]:
        graph = Graph()
        K = [graph.loads("K", size, k * size) for k in range(slopes)]
        return graph, graph.loads("state", at.size), graph.loads("y", size), K

    def write(name: str, values: Objects) -> None:
        module.write_straight_line(name, [("argument", k, node) for k, node in enumerate(values)])

    *of_stages, of_end, of_control = step_functions()
    for j, name in enumerate(of_stages, start=1):
        _, state, y, K = begin(j)
        write(name, stage_state(ADAPTIVE.tableau.a[j], state[at.step], y, K))
    _, state, y, K = begin(STAGES)
    write(of_end, end_of_row(ADAPTIVE.tableau, state[at.step], y, K))

    graph, state, y, K = begin(STAGES + 1)
    at_step, end, tolerances = _read_state(graph, state)
    after = graph.loads("argument", size)
    now, y_now = judge_step(at_step, end, tolerances, y, after, K, Namespace(graph))
    module.write_straight_line(of_control, _store_state(graph, now, y_now))


def write_implicit_step(kernels: Kernels, mode: int, stage: Template) -> None:
    """Write an iteration of Newton's method for an implicit step in a mode, and the error control behind it."""
    n, at = kernels.sizes.n, Adaptive()

    def begin() -> tuple[Graph, Objects, Objects, list[tuple[Node, Any]]]:
        graph = Graph()
        p, constants = kernels.inputs(graph)
        zero = graph.constant(0.0)
        zeros = np.full(n, zero, dtype=object)

        def point(j: int) -> tuple[Node, Any]:
            t, origin = graph.loads("moments", 2, 2 * j)
            signal = graph.loads(f"signal_{j}", 4 * kernels.sizes.signals)
            return t, lambda t, x: (t, x, p, zeros, zero, origin, signal, *constants)

        points = [point(j) for j in range(len(IMPLICIT_TIMES))]
        return graph, graph.loads("state", at.size), graph.loads("y", n + 1), points

    graph, state, y, (_, *points) = begin()

    def field(j: int, X: Objects) -> list[Objects]:
        t, at_stage = points[j]
        return stage(graph, *at_stage(t, X), only=(F, F_X))

    stores = kernels.correct(graph, state[at.step], y[:n], field)
    kernels.module.write_straight_line(f"newton_adaptive_{mode}", stores)

    graph, state, y, ((start, at_start), *points) = begin()
    h, k = state[at.step], kernels.load_increments(graph)
    f, f_x, ell, ell_x = stage(graph, *at_start(start, y[:n]), only=(F, F_X, ELL, ELL_X), checked=True)
    states = [y[:n] + combine(row, k) for row in STIFF.a]
    # The running cost needs no iterations: its increments are h ell at the stages that the states have.
    for j, ((t, at_stage), X) in enumerate(zip(points, states, strict=True)):
        (density,) = stage(graph, *at_stage(t, X), only=(ELL,), checked=True)
        k[j] = np.append(k[j], h * density.item())
    # d (x, cost) / dt = (f, ell) does not depend on the cost: its column is zero.
    jacobian = np.block([[f_x, np.zeros((n, 1))], [ell_x[None], 0.0]])
    error = estimate_error(h, k, np.append(f, ell), jacobian, eliminate)
    at_step, end, tolerances = _read_state(graph, state)
    now, y_now = judge_error(
        at_step, end, tolerances, y, y + combine(STIFF.b, k), error, STIFF_EXPONENT, Namespace(graph)
    )
    # The stages of a step that is rejected may be anywhere.
    checks = [
        (pointer, offset, graph.apply("select", now.refused, graph.load(CHECKED, 0), node))
        for pointer, offset, node in graph.check()
    ]
    stores = _store_state(graph, now, y_now)
    kernels.module.write_straight_line(f"adaptive_implicit_{mode}", stores + checks)


def _read_state(graph: Graph, state: Objects) -> tuple[Progress, Node, Tolerances]:
    """Return the progress, the end time and the tolerances from the state of the solver."""
    at = Adaptive()
    flags = (graph.apply("ne", state[k], 0.0) for k in (at.refused, at.stuck))
    return Progress(state[at.t], state[at.step], *flags), state[at.end], Tolerances(state[at.rtol], state[at.atol])


def _store_state(graph: Graph, now: Progress, y: Objects) -> list[Store]:
    """Return stores of the progress and of y."""
    at = Adaptive()
    stores = [("state", at.t, now.t), ("state", at.step, now.step)]
    for place, flag in ((at.refused, now.refused), (at.stuck, now.stuck)):
        stores.append(("state", place, graph.apply("select", flag, 1.0, 0.0)))
    return stores + [("y", k, node) for k, node in enumerate(y)]
