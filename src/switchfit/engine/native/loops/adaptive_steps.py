"""Adaptive steps in machine code: a step in one mode with its error control, and the loop that repeats it."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Sequence

import numpy as np

from switchfit.discretization import row_errors, step_size, tableaus
from switchfit.discretization.rows import combine
from switchfit.discretization.tableaus import ADAPTIVE, STIFF
from switchfit.engine.native.elimination import eliminate
from switchfit.engine.native.kernels import Kernels
from switchfit.engine.native.llvm.lines import Value, Variable
from switchfit.engine.native.loops.writer import Pointers, Writer
from switchfit.engine.native.scalars.graph import CHECKED, Graph, Namespace, Objects
from switchfit.engine.native.scalars.template import Template
from switchfit.engine.native.templates import ELL, ELL_X, F_X, F

STAGE_FRACTIONS = {False: [*ADAPTIVE.c.tolist(), 1.0], True: [0.0, *STIFF.c.tolist()]}
"""Times at which an explicit (False) or implicit step evaluates the mode, as fractions of it."""

Adaptive = namedtuple("Adaptive", "t step refused stuck end rtol atol low high")

AT = Adaptive(*range(9))
"""Offsets in the state of the adaptive solver, in doubles: t, step, refused and stuck are those of `Progress`, truth
values being 0 or 1; the end of the solve; rtol and atol of `Tolerances`; low and high, the times between which a signal
may be looked up.
"""


def write_slope(kernels: Kernels, mode: int, stage: Template) -> None:
    """Write f and ell of a mode at one time: the derivative of y = (x, running cost so far)."""
    graph = Graph()
    f, ell = _evaluate(kernels, graph, stage)(graph.loads("y", kernels.sizes.n), (F, ELL))
    stores = [("K", k, node) for k, node in enumerate([*f, ell.item()])]
    kernels.module.write_straight_line(f"slope_{mode}", stores + graph.check())


def _evaluate(
    kernels: Kernels, graph: Graph, stage: Template, number: str = "", checked: bool = True
) -> Callable[[Objects, Sequence[int]], list[Objects]]:
    """Return some outputs of a mode as a function of the state, at the time of a ``moment`` with this number."""
    t, origin = graph.loads(f"moment{number}", 2)
    at = kernels.take_inputs(graph, origin, f"signal{number}")
    return lambda x, only: stage(graph, *at(t, x), only=only, checked=checked)


@np.errstate(divide="ignore")  # the error of a mode at rest is the number zero
def write_step(kernels: Kernels, mode: int, stage: Template) -> None:
    """Write a step in a mode, with the error control behind it; an implicit one follows the iterations of Newton."""
    n, is_implicit = kernels.sizes.n, kernels.library.implicit[mode]
    graph, count = Graph(), len(STAGE_FRACTIONS[is_implicit])
    state, y = graph.loads("state", len(AT)), graph.loads("y", n + 1)
    # y is (x, running cost): the mesh has to resolve both.
    points = [_evaluate(kernels, graph, stage, str(j)) for j in range(count)]
    flags = (graph.apply("ne", state[k], 0.0) for k in (AT.refused, AT.stuck))
    progress = step_size.Progress(state[AT.t], state[AT.step], *flags)
    given = progress, state[AT.end], step_size.Tolerances(state[AT.rtol], state[AT.atol]), y
    h, xp = progress.step, Namespace(graph)
    if is_implicit:
        k, (at_start, *at_stages) = kernels.load_increments(graph), points
        f, f_x, ell, ell_x = at_start(y[:n], (F, F_X, ELL, ELL_X))
        # The running cost needs no iterations: its increments are h ell at the stages that the states have.
        densities = [each(y[:n] + combine(row, k), (ELL,))[0] for each, row in zip(at_stages, STIFF.a, strict=True)]
        k = [np.append(each, h * density.item()) for each, density in zip(k, densities, strict=True)]
        # d (x, cost) / dt = (f, ell) does not depend on the cost: its column is zero.
        jacobian = np.block([[f_x, np.zeros((n, 1))], [ell_x[None], 0.0]])
        error = row_errors.estimate_error(h, k, np.append(f, ell), jacobian, eliminate)
        now, y_now = step_size.judge_error(*given, y + combine(STIFF.b, k), error, step_size.STIFF_EXPONENT, xp)
    else:
        K: list[Objects] = []
        for row, evaluate in zip((*ADAPTIVE.a, ADAPTIVE.b), points, strict=True):
            after = y + h * combine(row, K)
            K.append(np.concatenate([np.ravel(value) for value in evaluate(after[:n], (F, ELL))]))
        now, y_now = step_size.judge_error(
            *given, after, h * combine(tableaus.ADAPTIVE_ERROR, K), step_size.EXPONENT, xp
        )
    stores = [("state", AT.t, now.t), ("state", AT.step, now.step), *(("y", k, node) for k, node in enumerate(y_now))]
    for place, flag in ((AT.refused, now.refused), (AT.stuck, now.stuck)):
        stores.append(("state", place, graph.apply("select", flag, 1.0, 0.0)))
    # The stages of a step that is rejected may be anywhere.
    for pointer, offset, node in graph.check():
        stores.append((pointer, offset, graph.apply("select", now.refused, graph.load(CHECKED, 0), node)))
    kernels.module.write_straight_line(f"step_{mode}", stores)
    if is_implicit:
        graph = Graph()
        stages = [_evaluate(kernels, graph, stage, str(j), checked=False) for j in range(1, count)]
        field = lambda j, X: stages[j](X, (F, F_X))  # noqa: E731
        found = kernels.correct(graph, graph.load("state", AT.step), graph.loads("y", n), field)
        kernels.module.write_straight_line(f"newton_step_{mode}", found)


def _store_moment(writer: Writer, found: Pointers, cells: Value, time: Value, moment: Value) -> Value:
    """Store a time, and the first node of the cell that holds it, clipped to [low, high]; return the signals there."""
    S = writer.sizes.signals
    writer.store(time, moment)
    if not S:
        return found["signals"]
    low, high = (writer.get("double", found["state"], k) for k in (AT.low, AT.high))
    # At the ends of a stretch an input may jump: the time is kept inside [low, high], so that the cell is one of the
    # stretch.
    later = (time < low).choose(low, time)
    inside = (later > high).choose(high, later)
    left, right = Variable(writer, "i64", 0), Variable(writer, "i64", cells)
    with writer.repeat() as leave:  # nodes[left] <= time; time < nodes[right], or right is the last node
        one, other = left.value, right.value
        leave(other - one <= 1)
        middle = (one + other) >> 1
        is_before = writer.get("double", found["nodes"], middle) <= inside
        left.value, right.value = is_before.choose(middle, one), is_before.choose(other, middle)
    writer.put(writer.get("double", found["nodes"], left.value), moment, 1)
    return writer.at(found["signals"], left.value, 4 * S)


def write_adaptive_solve(writer: Writer, mode: int) -> str:
    """Write the loop over adaptive steps in one mode; it stores the times of accepted steps.

    It ends at the end time, after `most` accepted steps, or when the solver is stuck.
    """
    n = writer.sizes.n
    given = "i64 %cells, ptr %state, ptr %y, ptr %rows, i64 %most, ptr %count"
    _, cells, state, y, rows, most, count = writer.begin(f"void @adaptive_{mode}_steps(ptr %table, {given})")
    found = writer.pointers() | {"state": state, "y": y}
    lengths = {"increments": len(STIFF.b) * n, "newton": 2}
    found |= {name: writer.allocate("double", length) for name, length in lengths.items()}
    found["J"] = found["newton"]  # NaN if the iterations do not converge, as the increments are
    writer.store(0, count, "i64")
    with writer.repeat() as leave:
        t, end, stuck, step = (writer.get("double", state, k) for k in (AT.t, AT.end, AT.stuck, AT.step))
        # Go on while t < end, not stuck, and with room for accepted times.
        leave(((t < end) & stuck.equals(0.0) & (writer.load("i64", count) < most)).equals(False))
        for j, c in enumerate(STAGE_FRACTIONS[writer.library.implicit[mode]]):
            found[f"moment{j}"] = writer.allocate("double", 2)
            found[f"signal{j}"] = _store_moment(writer, found, cells, t + step * c, found[f"moment{j}"])
        writer.take_step(mode, "step", found, "newton_step")
        with writer.when(writer.get("double", state, AT.refused).equals(0.0)):
            accepted = writer.load("i64", count)
            row = writer.at(rows, accepted, 2 + n)
            writer.store(writer.get("double", state, AT.t), row)
            writer.copy(writer.at(row, 1), y, 1 + n)
            writer.store(accepted + 1, count)
    return writer.end()
