"""Write, compile and cache machine code for a library of modes.

A program runs through the segments forward, then through samples and terminal costs, then through the segments
backward. The mode of each segment is read at run time, so that all sequences of a library share a program.

Handler by which XLA calls machine code; it reads the arguments and results from XLA's call frame.

Only a few fields of the frame are read. Their offsets are fixed by XLA's C interface for foreign functions
(``xla/ffi/api/c_api.h``).

Loops that call the straight-line functions of `switchfit.engine.native.kernels`, in hand-written LLVM IR.

Rows are numbered by ``cell + segment``: each transition cuts one cell in two. The mode of a segment, and the reset map
and other functions of a transition, are read at run time. Segments that a sequence does not need are idle: they begin
and end at tf.
"""

from __future__ import annotations

import logging
import threading
from collections import namedtuple
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import chain

import numpy as np

from switchfit.discretization import rows
from switchfit.discretization.rows import ADAPTIVE, STIFF, combine
from switchfit.engine.native import segments
from switchfit.engine.native.elimination import eliminate
from switchfit.engine.native.kernels import Curvature, Kernels
from switchfit.engine.native.llvm import Module, Operand, Program, Value, Variable, compile_modules
from switchfit.engine.native.scalars import CHECKED, Graph, Namespace, Objects, Template
from switchfit.engine.native.segments import Pointers, Writer
from switchfit.engine.native.templates import ELL, ELL_X, F_X, F, Order, Sizes
from switchfit.engine.native.trace import Unsupported
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure

MAJOR, MINOR = 0, 1
"""Version of the interface."""

EXTENSION, ARGUMENTS, RESULTS = 8, 72, 112
"""Byte offsets in the frame of the pointers to the first extension, to the arguments and to the results."""

DATA, DIMENSIONS = 24, 40
"""Byte offsets in a buffer of its data and its dimensions."""


def write_handler(writer: Writer) -> str:
    """Return the text of the handler, which fills the table of pointers and calls `evaluate`.

    Results are all accumulators in one array, and the scratch space.
    """
    names = writer.layout.arguments
    (frame,) = writer.begin("ptr @xla_handler(ptr %frame)")
    table = writer.allocate("ptr", len(writer.names))
    extension = writer.load("ptr", writer.into(frame, EXTENSION))
    with writer.when(extension.differs("null")), writer.when(writer.load("i32", writer.into(extension, 8)).equals(1)):
        metadata = writer.load("ptr", writer.into(extension, 24))  # XLA queries the version of the interface
        for offset, value in ((24, MAJOR), (28, MINOR), (32, 0)):
            writer.store(value, writer.into(metadata, offset), "i32")
        writer.line("ret ptr null")
    arguments, results = (writer.load("ptr", writer.into(frame, place)) for place in (ARGUMENTS, RESULTS))

    def of_buffer(buffers: Value, k: int, offset: int) -> Value:
        """Load the address of the data or of the dimensions of a buffer."""
        return writer.load("ptr", writer.into(writer.get("ptr", buffers, k), offset))

    found = {name: of_buffer(arguments, k, DATA) for k, name in enumerate(names)}
    totals, between = (of_buffer(results, k, DATA) for k in (0, 1))
    position = 0
    for name, length in writer.layout.sums.items():
        found[name] = writer.at(totals, position)
        position += length
    rows = segments.count_rows(writer, found)
    place: Operand = 0
    for name, (fixed, each_row) in writer.layout.memory.items():
        found[name] = writer.at(between, place)
        place = rows * each_row + fixed + place
    for k, name in enumerate(writer.names):
        writer.put(found[name], table, k)
    of_cells = (k for k, name in enumerate(names) if name.startswith("cell "))
    writer.invoke("evaluate", table, *(writer.get("i64", of_buffer(arguments, k, DIMENSIONS), 0) for k in of_cells))
    return writer.end("ptr null")


def write_evaluation(writer: Writer) -> str:
    """Write `evaluate`: the segments forward, the samples of each Measurements, the terminal terms, and the segments
    backward.
    """
    N = writer.sizes.N
    of_samples = "".join(f", i64 %count_{k}" for k in range(len(writer.library.measurements)))
    table, *counts = writer.begin(f"void @evaluate(ptr %table{of_samples})")
    found, layout = writer.pointers(), writer.layout
    rows = segments.count_rows(writer, found)
    # The sums are one block of memory, so that one call clears all of them.
    writer.zero(found[next(iter(layout.sums))], sum(layout.sums.values()))
    for name in segments.ZEROED:
        fixed, each_row = layout.memory[name]
        writer.zero(found[name], rows * each_row + fixed)
    writer.call("start", found | writer.at_row(found, 0, "x", "Z", suffix="_after"))
    with writer.loop(0, N + 1) as segment:
        writer.invoke("forward", table, segment)
    for k, count in enumerate(counts):
        writer.invoke(f"samples_{k}", table, count)
    # No row follows the end: what the terminal terms add to the costate goes to psi itself.
    library, given = writer.library, found | writer.at_row(found, rows, "x", "Z") | {"jump": found["psi"]}
    given |= segments.constraint_pointers(writer, found, layout.constraint_rows["end"])
    for name in ["end"] * bool(library.terminal) + ["end_constraint"] * bool(library.terminal_constraints):
        writer.call(name, given)
    if writer.order > Order.COST:
        with writer.loop(0, N + 1) as turn:
            writer.invoke("backward", table, N - turn)
        writer.call("start_back", found)
    return writer.end()


TIMES = {False: [*ADAPTIVE.c.tolist(), 1.0], True: [0.0, *STIFF.c.tolist()]}
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
    """Return some outputs of a mode as a function of the state, at the time of a `moment` with this number."""
    t, origin = graph.loads(f"moment{number}", 2)
    at = kernels.take_inputs(graph, origin, f"signal{number}")
    return lambda x, only: stage(graph, *at(t, x), only=only, checked=checked)


@np.errstate(divide="ignore")  # the error of a mode at rest is the number zero
def write_step(kernels: Kernels, mode: int, stage: Template) -> None:
    """Write a step in a mode, with the error control behind it; an implicit one follows the iterations of Newton."""
    n, is_implicit = kernels.sizes.n, kernels.library.implicit[mode]
    graph, count = Graph(), len(TIMES[is_implicit])
    state, y = graph.loads("state", len(AT)), graph.loads("y", n + 1)
    # y is (x, running cost): the mesh has to resolve both.
    points = [_evaluate(kernels, graph, stage, str(j)) for j in range(count)]
    flags = (graph.apply("ne", state[k], 0.0) for k in (AT.refused, AT.stuck))
    progress = rows.Progress(state[AT.t], state[AT.step], *flags)
    given = progress, state[AT.end], rows.Tolerances(state[AT.rtol], state[AT.atol]), y
    h, xp = progress.step, Namespace(graph)
    if is_implicit:
        k, (at_start, *at_stages) = kernels.load_increments(graph), points
        f, f_x, ell, ell_x = at_start(y[:n], (F, F_X, ELL, ELL_X))
        # The running cost needs no iterations: its increments are h ell at the stages that the states have.
        densities = [each(y[:n] + combine(row, k), (ELL,))[0] for each, row in zip(at_stages, STIFF.a, strict=True)]
        k = [np.append(each, h * density.item()) for each, density in zip(k, densities, strict=True)]
        # d (x, cost) / dt = (f, ell) does not depend on the cost: its column is zero.
        jacobian = np.block([[f_x, np.zeros((n, 1))], [ell_x[None], 0.0]])
        error = rows.estimate_error(h, k, np.append(f, ell), jacobian, eliminate)
        now, y_now = rows.judge_error(*given, y + combine(STIFF.b, k), error, rows.STIFF_EXPONENT, xp)
    else:
        K: list[Objects] = []
        for row, evaluate in zip((*ADAPTIVE.a, ADAPTIVE.b), points, strict=True):
            after = y + h * combine(row, K)
            K.append(np.concatenate([np.ravel(value) for value in evaluate(after[:n], (F, ELL))]))
        now, y_now = rows.judge_error(*given, after, h * combine(rows.ADAPTIVE_ERROR, K), rows.EXPONENT, xp)
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


def write_loop(writer: Writer, name: str) -> str:
    """Write the calls of a straight-line function at `count` points, from one to the next its pointers advance by
    given numbers of bytes.
    """
    keys = writer.module.pointers[name]
    pointers = "".join(f", ptr %{key}, i64 %{key}_step" for key in keys)
    count, *given = writer.begin(f"void @each_{name}(i64 %count{pointers})")
    with writer.loop(0, count) as k:
        each = zip(keys, given[::2], given[1::2], strict=True)
        writer.call(name, {key: writer.into(pointer, k * step) for key, pointer, step in each})
    return writer.end()


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
    n, is_implicit = writer.sizes.n, writer.library.implicit[mode]
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
        for j, c in enumerate(TIMES[is_implicit]):
            found[f"moment{j}"] = writer.allocate("double", 2)
            found[f"signal{j}"] = _store_moment(writer, found, cells, t + step * c, found[f"moment{j}"])
        if is_implicit:
            segments.solve_stages(writer, f"newton_step_{mode}", found)
        writer.call(f"step_{mode}", found)
        with writer.when(writer.get("double", state, AT.refused).equals(0.0)):
            accepted = writer.load("i64", count)
            row = writer.at(rows, accepted, 2 + n)
            writer.store(writer.get("double", state, AT.t), row)
            writer.copy(writer.at(row, 1), y, 1 + n)
            writer.store(accepted + 1, count)
    return writer.end()


_one_at_a_time = threading.Lock()

log = logging.getLogger("switchfit")

PREFIX = {Order.COST: "plain_", Order.GRADIENT: "first_", Order.HESSIAN: "", Order.GAUSS_NEWTON: "gauss_newton_"}
"""Prefix of the names of functions, by the order of their derivatives."""


def second_order(library: Structure) -> Order:
    """Return the order of the derivatives that fits of a library take their steps by."""
    return Order.GAUSS_NEWTON if library.has_rough_hessian else Order.HESSIAN


def program_of(library: Structure, sizes: Sizes, order: Order) -> Program | str:
    """Return machine code for a library with derivatives of an order, or the reason why it cannot be compiled.

    Functions that cannot be written as straight-line code have no machine code. A fit needs simulations and second
    derivatives: both are compiled into one program. Any other failure is a defect of this package: the caller falls
    back to JAX as well, and the reason begins with "internal: ".
    """
    both = (Order.COST, second_order(library))
    return compile_library(library, sizes, both if order in both else (order,), _write, "Evaluated by JAX")


Write = Callable[[Structure, Sizes, Order, Module], Iterator[str]]
"""Writes functions of a library with derivatives of an order, in parts."""


def compile_library(
    library: Structure, sizes: Sizes, orders: tuple[Order, ...], write: Write, otherwise: str
) -> Program | str:
    """Return the machine code that a function writes, or the reason why there is none, as `program_of` does.

    The log has the reason too, behind what is so `otherwise`.
    """
    with _one_at_a_time:
        return _program_of(library, sizes, orders, write, otherwise)


@lru_cache(maxsize=64)
def _program_of(
    library: Structure, sizes: Sizes, orders: tuple[Order, ...], write: Write, otherwise: str
) -> Program | str:
    modules = [Module(sizes.width, PREFIX[order]) for order in orders]
    try:
        if sizes.D == 0:
            raise Unsupported("an experiment has no unknowns")
        with use_float64():
            parts = (write(library, sizes, order, each) for order, each in zip(orders, modules, strict=True))
            program = compile_modules(chain.from_iterable(parts))
    except Unsupported as error:
        reason = str(error)
        log.info("%s: %s.", otherwise, reason)
    except Exception as error:
        reason = f"internal: {type(error).__name__}: {error}"
        log.info("%s: %s.", otherwise, reason, exc_info=True)
    else:
        program.row_work = modules[-1].row_work
        program.pointers = {f"{each.prefix}{name}": given for each in modules for name, given in each.pointers.items()}
        return program
    return reason


def drop_programs() -> None:
    """Drop cached programs that are not in use, and what is known of their memory."""
    with _one_at_a_time:
        _program_of.cache_clear()
        segments.layout_of.cache_clear()


def _write(library: Structure, sizes: Sizes, order: Order, module: Module) -> Iterator[str]:
    """Write all functions of a library with derivatives of an order, a part for each mode and one for the rest."""
    kernels = Kernels(library, sizes, order, module)
    writer = Writer(library, sizes, order, module)
    late = [k for k, sensor in enumerate(library.measurements) if sensor.delay is not None]
    curvatures = []
    for mode in range(len(library.modes)):
        curvatures.append(_write_mode(kernels, writer, mode, bool(late)))
        if order > Order.COST:
            module.row_work.append(segments.estimate_row(writer, mode, curvatures[mode]["inner"]))
        yield module.take()
    kernels.nodes()
    for k in range(len(library.measurements)):
        if k in late:
            kernels.late_time(k)
            module.add(segments.write_late_samples(writer, k, curvatures))
        else:
            module.add(segments.write_samples(writer, k))
    for name in ["start", *(f"reset_{k}" for k in range(len(library.reset_maps)))] if order == Order.COST else ():
        module.add(write_loop(writer, name))
    kernels.state()
    if order != Order.GRADIENT:
        kernels.outputs()
        module.add(write_loop(writer, "outputs"))
    module.add(segments.write_forward(writer))
    module.add(write_evaluation(writer))
    if order > Order.COST:
        module.add(segments.write_backward(writer, curvatures))
    if order == Order.HESSIAN:
        module.add(write_handler(writer))
    yield module.take()


def _write_mode(kernels: Kernels, writer: Writer, mode: int, late: bool) -> dict[str, Curvature]:
    """Write the rows of a mode; return what adds the second derivatives of each kind of rows to H."""
    module, order, library = kernels.module, kernels.order, kernels.library
    running = bool(library.running or library.references) and not library.is_rest(mode)
    stage = kernels.templates.stage(mode, running=running)
    kinds = [("inner", stage, False, running, False), ("end", stage, True, running, False)]
    if late:
        # A late sample's row is beside the trajectory: it adds no running cost, which the row around it has.
        kinds.append(("late", kernels.templates.stage(mode, running=False) if running else stage, True, False, True))
    if library.implicit[mode]:
        kernels.newton(f"newton_{mode}", stage)
        module.add(segments.write_newton(writer, f"newton_{mode}"))
    tableau, curvatures = kernels.tableau(mode), {}
    for kind, template, moving, costs, is_late in kinds:
        name = f"{kind}_{mode}"
        factors = kernels.forward_row(f"forward_{name}", template, moving, costs, tableau)
        if order > Order.COST:
            chosen = kernels.backward_row(f"backward_{name}", template, moving, costs, tableau, factors, is_late)
            curvatures[kind] = kernels.share_curvature(f"curvature_{name}", chosen, tableau)
    # The same for all modes: written once.
    if order == Order.HESSIAN and mode == 0:
        kernels.length()
    if order > Order.COST and late and mode == 0:
        kernels.end_of_late()
    if order > Order.COST:
        kernels.judge_row(mode, stage, tableau)
    else:
        write_slope(kernels, mode, stage)
        module.add(write_loop(writer, f"slope_{mode}"))
        write_step(kernels, mode, stage)
        if library.implicit[mode]:
            module.add(segments.write_newton(writer, f"newton_step_{mode}"))
        module.add(write_adaptive_solve(writer, mode))
    return curvatures
