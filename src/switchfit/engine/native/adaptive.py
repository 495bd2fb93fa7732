"""Adaptive steps in machine code: `discretization.step_size` as straight-line functions between slopes of a mode."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from switchfit.discretization.rows import end_of_row, stage_state
from switchfit.discretization.step_size import Progress, Tolerances, judge_step
from switchfit.discretization.tableaus import ADAPTIVE
from switchfit.engine.native.llvm import Module
from switchfit.engine.native.scalars import CHECKED, Graph, Namespace, Objects, Template
from switchfit.engine.native.templates import ELL, F, Sizes

STAGES = len(ADAPTIVE.tableau.b)
STAGE_TIMES = [*ADAPTIVE.tableau.c.tolist(), 1.0]
"""Times of the slopes of a step, as fractions of it; the last one is at its end."""

SLOPE = ("c", "p", "moment", "signal", "y", "K", CHECKED)
STEP = ("state", "y", "argument", "K")


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


def write_slope(
    module: Module, name: str, stage: Template, inputs: tuple[Graph, Objects, list[Objects]], sizes: Sizes
) -> None:
    """Write f and ell at one time: the derivative of y = (x, running cost so far); `inputs` are a graph, p and c."""
    graph, p, constants = inputs
    t, origin = graph.loads("moment", 2)
    signal = graph.loads("signal", 4 * sizes.signals)
    zeros = np.full(sizes.n, graph.constant(0.0), dtype=object)
    given = (t, graph.loads("y", sizes.n), p, zeros, graph.constant(0.0), origin, signal, *constants)
    f, ell = stage(graph, *given, only=(F, ELL), checked=True)
    stores = [("K", k, node) for k, node in enumerate([*f, ell.item()])]
    module.write_straight_line(name, SLOPE, stores + graph.check())


def step_functions() -> list[str]:
    """Return the names of the functions of `write_step` in the order of their calls; a slope precedes each call."""
    return [*(f"adaptive_{j}" for j in range(1, STAGES)), "adaptive_after", "adaptive_judge"]


def write_step(module: Module, sizes: Sizes) -> None:
    """Write the functions between the slopes K of a step: the states for the next slope, and the error control."""
    size, at = sizes.n + 1, Adaptive()

    def begin(slopes: int) -> tuple[Graph, Objects, Objects, list[Objects]]:
        graph = Graph()
        K = [graph.loads("K", size, k * size) for k in range(slopes)]
        return graph, graph.loads("state", at.size), graph.loads("y", size), K

    def write(name: str, values: Objects) -> None:
        module.write_straight_line(name, STEP, [("argument", k, node) for k, node in enumerate(values)])

    *of_stages, of_end, of_control = step_functions()
    for j, name in enumerate(of_stages, start=1):
        _, state, y, K = begin(j)
        write(name, stage_state(ADAPTIVE.tableau.a[j], state[at.step], y, K))
    _, state, y, K = begin(STAGES)
    write(of_end, end_of_row(ADAPTIVE.tableau, state[at.step], y, K))

    graph, state, y, K = begin(STAGES + 1)
    given = Progress(
        state[at.t],
        state[at.step],
        graph.apply("ne", state[at.refused], 0.0),
        graph.apply("ne", state[at.stuck], 0.0),
    )
    tolerances = Tolerances(state[at.rtol], state[at.atol])
    after = graph.loads("argument", size)
    now, y_now = judge_step(given, state[at.end], tolerances, y, after, K, Namespace(graph))
    stores = [("state", at.t, now.t), ("state", at.step, now.step)]
    for place, flag in ((at.refused, now.refused), (at.stuck, now.stuck)):
        stores.append(("state", place, graph.apply("select", flag, 1.0, 0.0)))
    module.write_straight_line(of_control, STEP, stores + [("y", k, node) for k, node in enumerate(y_now)])
