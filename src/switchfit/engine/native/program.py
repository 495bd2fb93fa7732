"""The program of a library of modes: which functions its machine code has.

A program runs through the segments forward, then through samples and terminal costs, then through the segments
backward. The mode of each segment is read at run time, so that all sequences of a library share a program.
"""

from __future__ import annotations

from collections.abc import Iterator

from switchfit.discretization.arguments import Arguments
from switchfit.engine.native.kernels import CurvatureFunction, Kernels
from switchfit.engine.native.llvm.compilation import Program
from switchfit.engine.native.llvm.module import Module
from switchfit.engine.native.loops.adaptive_steps import write_adaptive_solve, write_slope, write_step
from switchfit.engine.native.loops.driver import write_evaluation
from switchfit.engine.native.loops.sample_loops import write_late_samples, write_samples
from switchfit.engine.native.loops.segments import write_backward, write_forward, write_newton
from switchfit.engine.native.loops.writer import Writer, write_loop
from switchfit.engine.native.loops.xla_handler import write_handler
from switchfit.engine.native.program_cache import compile_library
from switchfit.engine.native.sizes import Order, Sizes
from switchfit.problem.structure import Structure

USUAL_ITERATIONS = 5
"""Iterations that count for the work of a row."""


def reason_for_jax(structure: Structure, arguments: Arguments) -> str | None:
    """Return why an experiment cannot be compiled with second derivatives; None if it can."""
    program = program_of(structure.library, Sizes.of(structure, arguments), second_order(structure))
    return program if isinstance(program, str) else None


def _estimate_row(writer: Writer, mode: int, curvature: CurvatureFunction) -> int:
    """Return the work of a row of a mode in an evaluation with second derivatives, in additions."""
    names = [f"forward_inner_{mode}", f"backward_inner_{mode}", *(curvature.name for _ in curvature.stages)]
    newton = USUAL_ITERATIONS * writer.module.work[f"newton_{mode}"] if writer.library.implicit[mode] else 0
    return newton + sum(writer.module.work[name] for name in names)


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
    return compile_library(library, sizes, both if order in both else (order,), _write)


def _write(library: Structure, sizes: Sizes, order: Order, module: Module) -> Iterator[str]:
    """Write all functions of a library with derivatives of an order, a part for each mode and one for the rest."""
    kernels = Kernels(library, sizes, order, module)
    writer = Writer(library, sizes, order, module)
    late = [k for k, sensor in enumerate(library.measurements) if sensor.delay is not None]
    curvatures = []
    # A part for each mode: these are the longest. A mode whose text is the same in another library is loaded from the
    # cache.
    for mode in range(len(library.modes)):
        curvatures.append(_write_mode(kernels, writer, mode, bool(late)))
        if order > Order.COST:
            module.row_work.append(_estimate_row(writer, mode, curvatures[mode]["inner"]))
        yield module.take()
    # Before the loops that call them: a call needs the pointers of its function.
    kernels.nodes()
    for k in range(len(library.measurements)):
        if k in late:
            kernels.late_time(k)
            module.add(write_late_samples(writer, k, curvatures))
        else:
            module.add(write_samples(writer, k))
    # Single calls from Python, for the adaptive solver, which has no derivatives.
    for name in ["start", *(f"reset_{k}" for k in range(len(library.reset_maps)))] if order == Order.COST else ():
        module.add(write_loop(writer, name))
    kernels.state()
    if order != Order.GRADIENT:
        kernels.outputs()
        module.add(write_loop(writer, "outputs"))
    module.add(write_forward(writer))
    module.add(write_evaluation(writer))
    if order > Order.COST:
        module.add(write_backward(writer, curvatures))
    # Fits inside a program of JAX take steps by the exact Hessian alone.
    if order == Order.HESSIAN:
        module.add(write_handler(writer))
    yield module.take()


def _write_mode(kernels: Kernels, writer: Writer, mode: int, late: bool) -> dict[str, CurvatureFunction]:
    """Write the rows of a mode; return what adds the second derivatives of each kind of rows to H."""
    module, order, library = kernels.module, kernels.order, kernels.library
    running = bool(library.running or library.references) and not library.is_rest(mode)
    stage = kernels.templates.stage(mode, running=running)
    # A row beside a transition has ends that move with theta, and more code; all others share `inner`.
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
            curvatures[kind] = kernels.curvature(f"curvature_{name}", chosen, tableau)
    # The same for all modes: written once.
    if order == Order.HESSIAN and mode == 0:
        kernels.length()
    if order > Order.COST:
        kernels.judge_row(mode, stage, tableau)
    else:
        write_slope(kernels, mode, stage)
        module.add(write_loop(writer, f"slope_{mode}"))
        write_step(kernels, mode, stage)
        if library.implicit[mode]:
            module.add(write_newton(writer, f"newton_step_{mode}"))
        module.add(write_adaptive_solve(writer, mode))
    return curvatures
