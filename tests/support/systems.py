"""Test systems: nonlinear, time-dependent, with parameters in several modes and every kind of cost at once.

The weight of each kind of cost is a fixed parameter, that is an argument: one compiled program serves all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.discretization.arguments import Arguments, build_arguments
from switchfit.discretization.mesh import Mesh
from switchfit.discretization.model import Model
from switchfit.engine.jax.programs import derivatives
from switchfit.paper_adjoint import compute_paper_derivatives
from switchfit.problem.costs import RunningCost, TerminalCost
from switchfit.problem.experiment import Experiment, Parameter
from switchfit.problem.functions import use_float64
from switchfit.problem.inputs import Input
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.structure import Structure
from switchfit.problem.system import HybridSystem
from switchfit.runtime.cache import use_compilation_cache

KINDS = ("running", "reference", "samples", "terminal", "all")
CELLS = 176
"""Cells of every mesh, padded: one compiled program for coarse and fine ones."""


def mode_a(t, x, p):
    return jnp.array([x[1] * jnp.cos(t) + 0.2 * x[0] * x[1], -p["a"] * x[0] + 0.3 * x[1] ** 2 * jnp.sin(t)])


def driven_a(t, x, p, u):
    return mode_a(t, x, p) + u * jnp.array([x[1], 0.3 * p["b"]])


def driven_b(t, x, p, u):
    slope = [p["b"] * x[1] ** 2 - x[0] + 0.2 * jnp.cos(2 * t) * x[1], -x[0] * jnp.exp(-p["a"] * t)]
    return jnp.array(slope) + u**2 * jnp.array([p["a"], x[0]])


def stiff_b(t, x, p):
    """The second state follows the first one within a thousandth of the horizon."""
    return jnp.array([p["b"] * jnp.cos(t) - x[0] * x[1], -1000.0 * p["a"] * (x[1] - jnp.cos(p["b"] * x[0] + t))])


def reset(t, x, p):
    return jnp.array([1.1 * x[0] + p["a"] * t * x[1] ** 2, 0.2 * p["b"] ** 2 * jnp.sin(x[0]) - 0.7 * x[1]])


def initial_state(p):
    return jnp.array([p["a"], 1.0 - 0.2 * p["b"] ** 2])


def running(t, x, p):
    return p["w_running"] * (jnp.sin(x[0]) * x[1] ** 2 * p["a"] * jnp.cos(t) + jnp.exp(0.3 * x[0]) * p["b"] * x[1] * t)


def terminal(x, p):
    return p["w_terminal"] * (x[0] * x[1] ** 2 * p["b"] + p["a"] * x[0] ** 3)


def observed_continuously(t, x, p):
    return jnp.array([x[0] * x[1] + p["b"] * t])


def observed_at_samples(t, x, p):
    return jnp.array([p["a"] * x[1] ** 2 + t * x[0], x[0] + p["b"] * x[1]])


NODES = np.linspace(0.0, 2.0, 21)
KNOTS = NODES[[0, 5, 10, 15, 20]]
# Geometric towards the ends of the stiff mode, where x and the adjoints have layers.
LAYERED = np.concatenate([NODES, NODES[6] + 0.1 * 0.5 ** np.arange(1, 12), NODES[13] - 0.1 * 0.5 ** np.arange(1, 12)])
SAMPLE_TIMES = NODES[[0, 2, 5, 9, 10, 14, 17, 20]]
P0 = np.array([0.8, 1.2])

SYSTEMS = {
    "resets": (
        HybridSystem({"A": driven_a, "B": driven_b}, initial_state, {("A", "B"): reset}),
        ("A", "B", "A", "B"),
        NODES[[4, 8, 13]],
    ),
    "stiff": (
        HybridSystem({"A": mode_a, "S": stiff_b}, initial_state, {("S", "A"): reset}),
        ("A", "S", "A"),
        NODES[[6, 13]],
    ),
}
SYSTEMS["mixed"] = SYSTEMS["stiff"]
IMPLICIT = {"mixed": (False, True)}
"""Which modes take implicit steps, for problems in which some but not all do; ``solver="auto"`` chooses so."""


def problem_of(name: str) -> Problem:
    """One of `SYSTEMS`."""
    system, sequence, tau = SYSTEMS[name]
    values = np.stack([np.cos(3 * SAMPLE_TIMES), 1.0 + SAMPLE_TIMES], axis=1)
    values[3, 0] = np.nan
    data = [
        RunningCost(running),
        ReferenceSignal.from_samples(KNOTS, np.sin(2 * KNOTS), observe=observed_continuously, weights=[1.3]),
        Measurements(SAMPLE_TIMES, values, observe=observed_at_samples, sigma=[0.9, 1.2]),
        TerminalCost(terminal),
    ]
    inputs = Input(KNOTS, np.cos(KNOTS), kind="linear") if name == "resets" else None
    experiment = Experiment(data, sequence, tau, 0.0, 2.0, inputs=inputs)
    weights = {q: Parameter(1.0, fixed=True) for q in ("w_running", "w_terminal")}
    parameters = {"a": P0[0], "b": P0[1], **weights}
    return Problem(system, experiment, parameters, solver="stiff" if name == "stiff" else "explicit")


def padded_mesh(times: np.ndarray, cells: int = CELLS) -> Mesh:
    """A mesh of given nodes, padded to a given number of cells."""
    return Mesh(np.concatenate([times, np.full(cells + 1 - len(times), times[-1])]), len(times) - 1)


def weighted(structure: Structure, arguments: Arguments, kind: str) -> Arguments:
    """Arguments of `problem_of` that leave one kind of cost, or all."""
    on = {name: float(kind in (name, "all")) for name in KINDS}
    values = {"w_running": on["running"], "w_terminal": on["terminal"]}
    names = [name for name, _, read in structure.parameters if not read]
    with use_float64():
        return arguments._replace(
            fixed=tuple(jnp.asarray(values.get(name, q)) for name, q in zip(names, arguments.fixed, strict=True)),
            weights=tuple(W * on["reference"] for W in arguments.weights),
            samples=tuple(s._replace(weight=s.weight * on["samples"]) for s in arguments.samples),
        )


class Derivatives(NamedTuple):
    """Cost, gradient (D,) and Hessian (D, D)."""

    cost: float
    gradient: np.ndarray
    hessian: np.ndarray


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jax.jit` in float64, with the programs of other processes: several files of tests differentiate the same."""
    program = jax.jit(function)

    def call(arguments: Arguments, tau: Any, p: Any, side: int = 1) -> Any:
        with use_float64(), use_compilation_cache():
            return jax.tree.map(np.asarray, program(arguments, *map(jnp.asarray, (tau, p, side))))

    return call


class Case:
    """A problem, and two ways to evaluate and differentiate its cost, each compiled once.

    Each returns `Derivatives`: `paper` by the paper's adjoint equations; `discrete` of the discretised cost, with a
    gradient backward and a Hessian forward over it.
    """

    def __init__(self, problem: Problem, implicit: tuple[bool, ...] | None = None) -> None:
        self.problem = problem
        structure = problem.structures[0]
        self.structure = structure if implicit is None else replace(structure, implicit=implicit)
        self.tau = problem.experiments[0].initial_times
        self.N = len(self.tau)
        self.paper = compiled(self._compute_by_the_paper)
        self.discrete = compiled(self._differentiate)

    def arguments(self, kind: str = "all", *, halvings: int = 0) -> Arguments:
        """Arguments of one of `SYSTEMS`, on the mesh of `NODES` with each cell halved some times."""
        times = np.unique(LAYERED) if any(self.structure.implicit) else NODES
        for _ in range(halvings):
            times = np.sort(np.concatenate([times, 0.5 * (times[1:] + times[:-1])]))
        return weighted(self.structure, build_arguments(self.problem, 0, padded_mesh(times)), kind)

    def _compute_by_the_paper(self, arguments: Arguments, *at: Any) -> Derivatives:
        return Derivatives(*compute_paper_derivatives(Model(self.structure, arguments), *at))

    def _differentiate(self, *at: Any) -> Derivatives:
        return Derivatives(*derivatives(*at, structure=self.structure, method="discrete-adjoint"))


@cache
def case(name: str) -> Case:
    """The case of one of `SYSTEMS`, shared by all tests of a run."""
    return Case(problem_of(name), IMPLICIT.get(name))


# A system whose cost has a closed form


def closed_form_case(*, transitions: int, q: Parameter) -> Case:
    """x' = q from 0; then, at tau, x becomes ``q x^2 + tau`` and x' = -x, to T = 2; ell = x^2 / 2."""
    modes = {"A": lambda t, x, p: p["q"] * jnp.ones(1), "B": lambda t, x, p: -x}
    system = HybridSystem(modes, [0.0], {("A", "B"): lambda t, x, p: p["q"] * x**2 + t})
    sequence, tau = (("A", "B"), [0.9]) if transitions else (("A",), [])
    cost = RunningCost(lambda t, x, p: 0.5 * x[0] ** 2)
    return Case(Problem(system, Experiment(cost, sequence, tau, 0.0, 2.0), {"q": q}))


def closed_form(tau, q):
    """The cost of `closed_form_case` with one transition."""
    opened = q * (q * tau) ** 2 + tau
    return q**2 * tau**3 / 6 + opened**2 * (1 - jnp.exp(-2 * (2.0 - tau))) / 4
