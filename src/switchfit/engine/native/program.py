"""Write, compile and cache machine code for a library of modes.

A program runs through the segments forward, then through samples and terminal costs, then through the segments
backward. The mode of each segment is read at run time, so that all sequences of a library share a program.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from itertools import chain

from switchfit.engine.native.adaptive import write_slope, write_step
from switchfit.engine.native.driver import (
    write_adaptive_solve,
    write_costs,
    write_evaluation,
    write_loop,
)
from switchfit.engine.native.frame import write_handler
from switchfit.engine.native.kernels import Curvature, Kernels
from switchfit.engine.native.llvm import Module, Program, compile_modules
from switchfit.engine.native.sample_loops import write_late_samples, write_late_states, write_samples
from switchfit.engine.native.segments import (
    estimate_row,
    write_backward,
    write_backward_rows,
    write_forward,
    write_forward_rows,
    write_newton,
)
from switchfit.engine.native.templates import Order, Sizes
from switchfit.engine.native.trace import Unsupported
from switchfit.engine.native.writer import Writer
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure

_one_at_a_time = threading.Lock()

log = logging.getLogger("switchfit")

PREFIX = {Order.COST: "plain_", Order.GRADIENT: "first_", Order.HESSIAN: "", Order.GAUSS_NEWTON: "gauss_newton_"}
"""Prefix of the names of functions, by the order of their derivatives."""


def program_of(library: Structure, sizes: Sizes, order: Order) -> Program | str:
    """Return machine code for a library with derivatives of an order, or the reason why it cannot be compiled.

    Functions that cannot be written as straight-line code have no machine code. A fit needs simulations and second
    derivatives: both are compiled into one program. Any other failure is a defect of this package: the caller falls
    back to JAX as well, and the reason begins with "internal: ".
    """
    both = (Order.COST, Order.HESSIAN)
    return compile_library(library, sizes, both if order in both else (order,), _write, "Evaluated by JAX")


Write = Callable[[Structure, Sizes, Order, Module, list[int]], Iterator[str]]
"""Writes functions of a library with derivatives of an order, in parts, and the work of a row of each mode."""


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
    row_work = [0] * len(library.modes)
    modules = [Module(sizes.width, PREFIX[order]) for order in orders]
    try:
        if sizes.D == 0:
            raise Unsupported("an experiment has no unknowns")
        with use_float64():
            parts = (write(library, sizes, order, each, row_work) for order, each in zip(orders, modules, strict=True))
            program = compile_modules(chain.from_iterable(parts))
    except Unsupported as error:
        reason = str(error)
        log.info("%s: %s.", otherwise, reason)
    except Exception as error:
        reason = f"internal: {type(error).__name__}: {error}"
        log.info("%s: %s.", otherwise, reason, exc_info=True)
    else:
        program.row_work = row_work
        program.pointers = {f"{each.prefix}{name}": given for each in modules for name, given in each.pointers.items()}
        return program
    return reason


def drop_programs() -> None:
    """Drop cached programs that are not in use."""
    with _one_at_a_time:
        _program_of.cache_clear()


def _write(library: Structure, sizes: Sizes, order: Order, module: Module, row_work: list[int]) -> Iterator[str]:
    """Write all functions of a library with derivatives of an order, a part for each mode and one for the rest.

    At order HESSIAN, the work of a row of each mode is stored in `row_work`.
    """
    kernels = Kernels(library, sizes, order, module)
    writer = Writer(library, sizes, order, kernels, module)
    late = [k for k, sensor in enumerate(library.measurements) if sensor.delay is not None]
    curvatures = []
    for mode in range(len(library.modes)):
        curvatures.append(_write_mode(kernels, writer, mode, bool(late)))
        if order == Order.HESSIAN:
            row_work[mode] = estimate_row(writer, mode, curvatures[mode]["inner"])
        yield module.take()
    kernels.nodes()
    for k in range(len(library.measurements)):
        if k in late:
            kernels.late_time(k)
            module.add(write_late_samples(writer, k, curvatures))
            module.add(write_late_states(writer, k))
        else:
            module.add(write_samples(writer, k))
    if library.terminal_constraints:
        kernels.end_constraint()
    for name in ["start", *(f"reset_{k}" for k in range(len(library.reset_maps)))] if order == Order.COST else ():
        module.add(write_loop(writer, name))
    kernels.state()
    loops: list[Callable[[Writer], str]] = [write_forward_rows, write_forward, write_evaluation]
    if order == Order.COST:
        loops.append(write_costs)
    else:
        loops += [partial(write_backward_rows, curvatures=curvatures), write_backward]
    if order != Order.GRADIENT:
        kernels.outputs()
        module.add(write_loop(writer, "outputs"))
    if order == Order.HESSIAN:
        loops.append(write_handler)
    for write in loops:
        module.add(write(writer))
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
        module.add(write_newton(writer, f"newton_{mode}"))
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
    if order >= Order.HESSIAN:
        kernels.judge_row(mode, stage, tableau)
    if order == Order.COST:
        write_slope(kernels, mode, stage)
        module.add(write_loop(writer, f"slope_{mode}"))
        write_step(kernels, mode, stage)
        if library.implicit[mode]:
            module.add(write_newton(writer, f"newton_step_{mode}"))
        module.add(write_adaptive_solve(writer, mode))
    return curvatures
