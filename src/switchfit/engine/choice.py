"""Choose the engine that evaluates an experiment: machine code if possible, else JAX, with the reason.

All engines offer the methods of `JaxEngine`, and their property `engine` says which one it is and why.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from jax import Array

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.corners.split_engine import SmoothEngine, SplitEngine
from switchfit.engine.evaluation import DenseEvaluation, Engine, build_undefined_evaluation
from switchfit.engine.jax.jax_engine import JaxEngine
from switchfit.engine.jax.programs import derivatives
from switchfit.engine.native.foreign import foreign_derivatives
from switchfit.engine.native.hypothesis_loops import hypotheses_program
from switchfit.engine.native.native_engine import NativeEngine
from switchfit.engine.native.native_hypotheses import NativeHypotheses
from switchfit.engine.native.program import reason_for_jax
from switchfit.engine.native.sizes import Sizes
from switchfit.engine.run import Run
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure

REQUIRED = "engine='native' requires machine code, but {}. Leave engine out to evaluate with JAX."

ExperimentEngine = NativeEngine | JaxEngine | SplitEngine
"""One experiment on one mesh, as functions of its transition times tau (N,) and its parameters p (M,)."""


class _PathFallback(JaxEngine):
    """Stands beside machine code of a path through corners: it refuses the points that JAX would evaluate.

    JAX would compile a program for each path, for seconds, to find that a derivative is not finite.
    """

    def constrained(self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray) -> DenseEvaluation:
        """Return an evaluation without numbers."""
        return build_undefined_evaluation(len(tau) + len(p), len(multipliers))


def engine_of(run: Run, arguments: Arguments, mesh: Mesh) -> ExperimentEngine:
    """Return the engine of an experiment on a mesh, chosen by `Problem.engine`.

    Raises
    ------
    ValueError
        If ``engine="native"`` and the experiment cannot be compiled; the message gives the reason.
    """
    base = run.get_structure(mesh)
    build = partial(_engine_on, run, base, arguments, mesh)
    return build(base) if run.branches is None else SplitEngine(run, run.branches, base, arguments, mesh, build)


def _engine_on(run: Run, base: Structure, arguments: Arguments, mesh: Mesh, structure: Structure) -> SmoothEngine:
    """Return the engine of a structure whose modes are smooth; the `base`, as users wrote it, tells why it is JAX."""
    asked = run.problem.engine
    reason = "engine='jax' is set" if asked == "jax" else reason_for_jax(structure, arguments)
    if reason is None:
        by_jax = JaxEngine if structure is base else _PathFallback
        return NativeEngine(structure, arguments, mesh, by_jax(structure, arguments, mesh))
    # The structure of a path has guards and branches that nobody has written: the reason is looked for in the user's.
    if structure is not base:
        reason = reason_for_jax(base, arguments) or reason
    # Whoever reads why a fit is slow wants to know of implicit steps too: they multiply the time of JAX.
    reason = "; ".join([reason, *map(str, mesh.stiffness)])
    if asked == "native":
        raise ValueError(REQUIRED.format(reason))
    return JaxEngine(structure, arguments, mesh, reason)


def hypotheses_of(
    problem: Problem, structure: Structure, arguments: Arguments, mesh: Mesh, jumps: Sequence[tuple[int, int]]
) -> NativeHypotheses | str:
    """Return what propagates hypotheses on the mode sequence of an experiment, or the reason why nothing does.

    Parameters
    ----------
    structure : Structure
        Its library has the modes and transitions of the hypotheses, its `transitions` are the births at most.
    jumps : sequence of (int, int)
        Node of each jump at a known time, and the place of its map in the library.

    Raises
    ------
    ValueError
        If ``engine="native"`` and the library cannot be compiled; the message gives the reason.
    """
    if problem.engine == "jax":
        return "engine='jax' is set"
    sizes = Sizes.of(structure, arguments)
    found = hypotheses_program(structure.library, sizes)
    if not isinstance(found, str):
        return NativeHypotheses(found, sizes, arguments, mesh.times, jumps)
    if problem.engine == "native":
        raise ValueError(REQUIRED.format(found))
    return found


def summarize(engines: Sequence[ExperimentEngine], names: Sequence[str]) -> Engine:
    """Return one record for several experiments: "jax" if any is evaluated by JAX; the reason names the first."""
    records = [each.engine for each in engines]
    implicit_modes = tuple(dict.fromkeys(mode for record in records for mode in record.implicit_modes))
    by_jax = [k for k, record in enumerate(records) if record.name == "jax"]
    # One experiment by JAX is what makes the problem slow: its reason stands for all.
    found = records[by_jax[0] if by_jax else 0]
    reason = f"{found.reason} (in {names[by_jax[0]]})" if 0 < len(by_jax) < len(records) else found.reason
    return replace(found, reason=reason, implicit_modes=implicit_modes)


def runs_natively(structures: Sequence[Structure], arguments: Sequence[Arguments]) -> bool:
    """Return whether machine code can evaluate all experiments inside a JAX program: none may have late samples."""
    # Late samples are rows of their own, which the call from XLA does not have.
    if any(sensor.delay is not None for structure in structures for sensor in structure.measurements):
        return False
    return all(reason_for_jax(s, a) is None for s, a in zip(structures, arguments, strict=True))


def derivatives_inside_program(
    structure: Structure, arguments: Arguments, tau: Array, p: Array, side: Array, places: Mapping[str, Any]
) -> tuple[Array, Array, Array]:
    """Return cost, gradient (D,) and Hessian (D, D) of one experiment inside a JAX program.

    `side` is +1 or -1: the right or left derivative in a transition time that lies on a node. With the `places` of
    `places_in_library`, machine code computes them, on a CPU and if `runs_natively`: the structure may be a library,
    and one program serves all its sequences. Without any, JAX does.
    """
    if places:
        J, g, H = foreign_derivatives(structure, arguments, tau, p, side, places)
    else:
        J, g, H = derivatives(arguments, tau, p, side, structure=structure, method="discrete-adjoint")
    return J, g, H
