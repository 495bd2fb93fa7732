"""Choose the engine that evaluates an experiment: machine code if possible, else JAX, with the reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.jax.engine import JaxEngine
from switchfit.engine.jax.programs import derivatives
from switchfit.engine.native.engine import NativeEngine
from switchfit.engine.native.experiment import reason_for_jax
from switchfit.engine.native.foreign import can_be_foreign, foreign_derivatives
from switchfit.engine.native.hypotheses import NativeHypotheses, native_hypotheses
from switchfit.engine.native.templates import Order
from switchfit.engine.protocol import Engine, Evaluation, ExperimentEngine
from switchfit.engine.run import Run
from switchfit.engine.split import SplitEngine
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure


class _PathFallback(JaxEngine):
    """Stands beside machine code of a path through corners: it refuses the points that JAX would evaluate.

    JAX would compile a program for each path, for seconds, to find that a derivative is not finite.
    """

    def constrained(
        self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray
    ) -> Evaluation[FloatArray]:
        """Return an evaluation without numbers."""
        D, m = len(tau) + len(p), len(multipliers)
        derivatives = np.full((D + 1 + m, D), np.nan)
        return Evaluation(np.nan, derivatives[0], derivatives[1 : D + 1], np.full(m, np.nan), derivatives[D + 1 :])


def engine_of(run: Run, arguments: Arguments, mesh: Mesh) -> ExperimentEngine:
    """Return the engine of an experiment on a mesh, chosen by `Problem.engine`.

    Raises
    ------
    ValueError
        If ``engine="native"`` and the experiment cannot be compiled; the message gives the reason.
    """
    base = run.get_structure(mesh)

    def build(structure: Structure) -> ExperimentEngine:
        return _engine_on(run, structure, base, arguments, mesh)

    return build(base) if run.branches is None else SplitEngine(run, run.branches, base, arguments, mesh, build)


def _engine_on(run: Run, structure: Structure, base: Structure, arguments: Arguments, mesh: Mesh) -> ExperimentEngine:
    """Return the engine of a structure whose modes are smooth; the `base`, as users wrote it, tells why it is JAX."""
    asked = run.problem.engine
    reason = "engine='jax' is set" if asked == "jax" else reason_for_jax(structure, arguments, Order.HESSIAN)
    if reason is None:
        by_jax = JaxEngine if structure is base else _PathFallback
        return NativeEngine(structure, arguments, mesh, by_jax(structure, arguments, mesh))
    if structure is not base:
        reason = reason_for_jax(base, arguments, Order.HESSIAN) or reason
    if mesh.stiffness:
        stiff = "; ".join(map(str, mesh.stiffness))
        reason = f"{reason}; {stiff}"
    if asked == "native":
        raise ValueError(f"engine='native' requires machine code, but {reason}. Leave engine out to evaluate with JAX.")
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
    found = native_hypotheses(structure, arguments, mesh.times, jumps)
    if isinstance(found, str) and problem.engine == "native":
        raise ValueError(f"engine='native' requires machine code, but {found}. Leave engine out to evaluate with JAX.")
    return found


def summarize(engines: Sequence[ExperimentEngine], names: Sequence[str]) -> Engine:
    """Return one record for several experiments: "jax" if any is evaluated by JAX; the reason names these."""
    records = [each.engine for each in engines]
    by_jax = [(name, record) for name, record in zip(names, records, strict=True) if record.name == "jax"]
    if not by_jax or len(by_jax) == len(records):
        return replace(records[0], implicit_modes=_list_implicit_modes(records))
    which = ", ".join(name for name, _ in by_jax)
    reason = f"{by_jax[0][1].reason} (in {which}; the other experiments run in machine code)"
    return Engine("jax", reason, _list_implicit_modes(records))


def _list_implicit_modes(records: Sequence[Engine]) -> tuple[str, ...]:
    """Return the modes that take implicit steps in any of several experiments."""
    return tuple(dict.fromkeys(mode for record in records for mode in record.implicit_modes))


def runs_natively(structures: Sequence[Structure], arguments: Sequence[Arguments]) -> bool:
    """Return whether machine code can evaluate all experiments inside a JAX program."""
    given = zip(structures, arguments, strict=True)
    return all(can_be_foreign(s) and reason_for_jax(s, a, Order.HESSIAN) is None for s, a in given)


def derivatives_inside_program(
    structure: Structure,
    arguments: Arguments,
    tau: Any,
    p: Any,
    side: Any,
    *,
    natively: bool,
    places: Mapping[str, Any] | None = None,
) -> Any:
    """Return cost, gradient (D,) and Hessian (D, D) of one experiment inside a JAX program.

    `natively` selects machine code, on a CPU and if `runs_natively`; else JAX computes them. `side` is +1 or -1: the
    right or left derivative in a transition time that lies on a node. `places` are for machine code only: with the
    result of `places_in_library`, the structure may be a library, and one program serves all its sequences.
    """
    if natively:
        return foreign_derivatives(structure, arguments, tau, p, side, places)
    if places is not None:
        raise ValueError("JAX programs are written for one sequence: pass its structure, and no places.")
    return derivatives(arguments, tau, p, side, structure=structure, method="discrete-adjoint")
