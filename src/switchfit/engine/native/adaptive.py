"""Adaptive steps in machine code: `discretization.rows` as straight-line functions between slopes of a mode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from switchfit.discretization.rows import (
    ADAPTIVE,
    ADAPTIVE_ERROR,
    EXPONENT,
    STIFF,
    STIFF_EXPONENT,
    Progress,
    Tolerances,
    combine,
    estimate_error,
    judge_error,
)
from switchfit.engine.native.elimination import eliminate
from switchfit.engine.native.kernels import Kernels
from switchfit.engine.native.scalars import CHECKED, Graph, Namespace, Objects, Template
from switchfit.engine.native.templates import ELL, ELL_X, F_X, F

TIMES = {False: [*ADAPTIVE.c.tolist(), 1.0], True: [0.0, *STIFF.c.tolist()]}
"""Times at which an explicit (False) or implicit step evaluates the mode, as fractions of it."""


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


def write_slope(kernels: Kernels, mode: int, stage: Template) -> None:
    """Write f and ell of a mode at one time: the derivative of y = (x, running cost so far)."""
    graph = Graph()
    f, ell = _evaluate(kernels, graph, stage)(graph.loads("y", kernels.sizes.n), (F, ELL))
    stores = [("K", k, node) for k, node in enumerate([*f, ell.item()])]
    kernels.module.write_straight_line(f"slope_{mode}", stores + graph.check())


def _evaluate(
    kernels: Kernels, graph: Graph, stage: Template, number: str = "", checked: bool = True
) -> Callable[[Objects, Sequence[int]], list[Objects]]:
    """Return some outputs of a mode as a function of the state, at the time of a `moment` with this number."""
    t, origin = graph.loads(f"moment{number}", 2)
    at = kernels.take_inputs(graph, origin, f"signal{number}")
    return lambda x, only: stage(graph, *at(t, x), only=only, checked=checked)


@np.errstate(divide="ignore")  # the error of a mode at rest is the number zero
def write_step(kernels: Kernels, mode: int, stage: Template) -> None:
    """Write a step in a mode, with the error control behind it; an implicit one follows the iterations of Newton."""
    n, at, is_implicit = kernels.sizes.n, Adaptive(), kernels.library.implicit[mode]
    graph, count = Graph(), len(TIMES[is_implicit])
    state, y = graph.loads("state", len(at)), graph.loads("y", n + 1)
    # y is (x, running cost): the mesh has to resolve both.
    points = [_evaluate(kernels, graph, stage, str(j)) for j in range(count)]
    progress = Progress(
        state[at.t], state[at.step], *(graph.apply("ne", state[k], 0.0) for k in (at.refused, at.stuck))
    )
    given = progress, state[at.end], Tolerances(state[at.rtol], state[at.atol]), y
    h, xp = progress.step, Namespace(graph)
    if is_implicit:
        k, (at_start, *at_stages) = kernels.load_increments(graph), points
        f, f_x, ell, ell_x = at_start(y[:n], (F, F_X, ELL, ELL_X))
        # The running cost needs no iterations: its increments are h ell at the stages that the states have.
        densities = [each(y[:n] + combine(row, k), (ELL,))[0] for each, row in zip(at_stages, STIFF.a, strict=True)]
        k = [np.append(each, h * density.item()) for each, density in zip(k, densities, strict=True)]
        # d (x, cost) / dt = (f, ell) does not depend on the cost: its column is zero.
        jacobian = np.block([[f_x, np.zeros((n, 1))], [ell_x[None], 0.0]])
        error = estimate_error(h, k, np.append(f, ell), jacobian, eliminate)
        now, y_now = judge_error(*given, y + combine(STIFF.b, k), error, STIFF_EXPONENT, xp)
    else:
        K: list[Objects] = []
        for row, evaluate in zip((*ADAPTIVE.a, ADAPTIVE.b), points, strict=True):
            after = y + h * combine(row, K)
            K.append(np.concatenate([np.ravel(value) for value in evaluate(after[:n], (F, ELL))]))
        now, y_now = judge_error(*given, after, h * combine(ADAPTIVE_ERROR, K), EXPONENT, xp)
    stores = [("state", at.t, now.t), ("state", at.step, now.step), *(("y", k, node) for k, node in enumerate(y_now))]
    for place, flag in ((at.refused, now.refused), (at.stuck, now.stuck)):
        stores.append(("state", place, graph.apply("select", flag, 1.0, 0.0)))
    # The stages of a step that is rejected may be anywhere.
    for pointer, offset, node in graph.check():
        stores.append((pointer, offset, graph.apply("select", now.refused, graph.load(CHECKED, 0), node)))
    kernels.module.write_straight_line(f"step_{mode}", stores)
    if is_implicit:
        graph = Graph()
        stages = [_evaluate(kernels, graph, stage, str(j), checked=False) for j in range(1, count)]
        field = lambda j, X: stages[j](X, (F, F_X))  # noqa: E731
        found = kernels.correct(graph, graph.load("state", at.step), graph.loads("y", n), field)
        kernels.module.write_straight_line(f"newton_step_{mode}", found)
