"""Random systems with everything that a problem may contain, against the reference in NumPy (`reference.py`).

Each system is drawn from a seed: its vector fields, observations, costs, guards and constraints are random
expressions that run with NumPy and with JAX. J, gradient, Hessian, constraints and their derivatives are compared block
by block, at the first guess and at a theta with a tie (a transition at a sample, or within rounding of one), coinciding
transitions or a mode that lasts no time.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations_with_replacement
from typing import Any

import jax
import numpy as np
import pytest

from support import reference
from support.random_problems import System
from switchfit.discretization.stiffness import Stiffness
from switchfit.engine.native.program_cache import drop_programs
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.refinement import refine_mesh

SYSTEMS = 200
METHODS = ("discrete-adjoint", "forward", "autodiff", "adjoint")

Tolerances = tuple[float, float, float]

CLOSE: Tolerances = (1e-10, 1e-8, 2e-7)
"""Largest error of J and c, of first and of second derivatives: of a block, relative to its largest entry plus 1 % of
the largest entry of all and of 1. What is left is integration error: of the meshes' tolerance in J, and larger by a
power of the step's length with each derivative in a transition time, which is the end of a step."""

PAPER: Tolerances = (1e-8, 1e-6, 1e-6)
"""The same for the paper's equations, whose derivatives are integrated by themselves, with larger error constants."""


# The comparison


def list_blocks(kinds: np.ndarray, order: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and place of each block of a derivative of an order, (d,) or (d, d)."""
    names = [*dict.fromkeys(kinds)]
    if order == 1:
        yield from ((name, kinds == name) for name in names)
        return
    diagonal = np.eye(len(kinds), dtype=bool)
    for a, b in combinations_with_replacement(names, 2):
        on = np.outer(kinds == a, kinds == b)
        if a == b == "tau":
            yield "tau-tau diagonal", on & diagonal
            on &= ~diagonal
        yield f"{a}-{b}", on


def check(kinds: np.ndarray, what: str, order: int, found: Any, expected: Any, tolerance: float) -> list[str]:
    """What is wrong with a derivative of an order, (..., d) or (..., d, d), as sentences."""
    expected = np.asarray(expected)
    off, size = np.abs(found - expected), np.abs(expected)
    if order == 0:
        errors = {"": np.max(off / np.maximum(size, 1.0), initial=0.0)}
    else:
        least = 0.01 * max(np.max(size, initial=0.0), 1.0)
        errors = {
            name: np.max(off[..., on], initial=0.0) / (np.max(size[..., on], initial=0.0) + least)
            for name, on in list_blocks(kinds, order)
        }
    return [f"{what} {name} is off by {error:.1e}" for name, error in errors.items() if not error <= tolerance]


def compare(kinds: np.ndarray, where: str, found: Any, expected: Any, tolerances: Tolerances = CLOSE) -> list[str]:
    """What is wrong with J, gradient and Hessian."""
    value, gradient, hessian = tolerances
    wrong = check(kinds, f"{where}: J", 0, found.cost, expected.cost, value)
    wrong += check(kinds, f"{where}: gradient", 1, found.gradient, expected.gradient, gradient)
    wrong += check(kinds, f"{where}: Hessian", 2, found.hessian, expected.hessian, hessian)
    return wrong


def differences(
    system: System, methods: tuple[str, ...], engine: str = "auto", implicit: tuple[str, ...] = ()
) -> list[str]:
    """Everything in which switchfit differs from the reference, as sentences; `implicit` modes take implicit steps."""
    problem, kinds = replace(system.problem, engine=engine, **({"solver": "auto"} if implicit else {})), system.kinds
    stiffness = [Stiffness(name, 0, 0, 0.0) for name in implicit]
    special, other = system.special_theta()
    thetas = {"guess": problem.initial_theta, special: problem.check_theta(other)}
    runs = range(len(problem.experiments))
    meshes = [refine_mesh(problem, e, *thetas.values(), stiffness=stiffness) for e in runs]
    evaluator = Evaluator(problem, meshes=meshes)
    used = {mode for run in problem.experiments for mode in run.mode_sequence}
    assert not implicit or set(evaluator.engine.implicit_modes) == used & set(implicit)
    wrong: list[str] = []
    for name, theta in thetas.items():
        for side in (1, -1) if name == "tie" else (1,):
            expected, where = system.reference.derivatives(theta, side), f"{name}, side {side}"
            for method in ("auto", *methods):
                tolerances = PAPER if method == "adjoint" else CLOSE
                wrong += compare(kinds, f"{where}, {method}", evaluator(theta, side, method), expected, tolerances)
            if len(problem.experiments) > 1:
                arrow = evaluator(theta, side, arrow=True)
                wrong += compare(kinds, f"{where}, arrow", replace(arrow, hessian=arrow.hessian.dense()), expected)
            if problem.constraint_names:
                wrong += compare_constrained(kinds, f"{where}, constrained", evaluator, theta, side, expected)
    return wrong


def compare_constrained(
    kinds: np.ndarray, where: str, evaluator: Evaluator, theta: np.ndarray, side: int, expected: reference.Derivatives
) -> list[str]:
    """The same with constraints, and the Hessian of their Lagrangian."""
    multipliers = np.random.default_rng(1).normal(size=len(expected.constraints))
    found = evaluator.constrained(theta, side, multipliers)
    hessian = expected.hessian + np.einsum("k,kij->ij", multipliers, expected.curvatures)
    return [
        *compare(kinds, where, found, replace(expected, hessian=hessian)),
        *check(kinds, f"{where}: constraints", 0, found.constraints, expected.constraints, CLOSE[0]),
        *check(kinds, f"{where}: Jacobian", 1, found.jacobian, expected.jacobian, CLOSE[1]),
    ]


# The tests


PLAIN: dict[str, Any] = {
    "runs": 1,
    "late": False,
    "guards": False,
    "constraints": False,
    "array": False,
    "solver": "explicit",
    "transitions": 2,
    "states": 2,
    "modes": 2,
}
"""A small system, to which the short tests add one thing after the other."""

SHORT = {
    "resets, a sigma that is a parameter": {"resets": True, "noise": "parameter", "samples": 2},
    "inputs, a reference signal": {"input": "cubic", "tracking": True, "transitions": 3},
    "robust losses, priors": {"robust": True, "priors": True, "noise": "mixed", "samples": 1},
    "two runs with a map": {"runs": 2, "running": True, "states": 1, "initial": "unknown"},
    "ten states": {"states": 10, "modes": 1, "transitions": 1, "samples": 1},
    "implicit steps": {"solver": "stiff", "resets": True, "input": "linear", "running": True, "initial": "unknown"},
}


@pytest.mark.parametrize(
    ("seed", "name"), [pytest.param(*v, marks=[pytest.mark.slow] * (v[1] == "ten states")) for v in enumerate(SHORT)]
)
def test_derivatives_of_random_systems_in_machine_code(seed, name):
    assert not differences(System(1000 + seed, **{**PLAIN, **SHORT[name]}), ())


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("seed", "given"),
    [
        (1, {"guards": True, "constraints": True, "priors": True, "transitions": 1, "states": 1}),
        (3, {"guards": True, "constraints": True, "late": True, "samples": 1, "solver": "stiff", "states": 3}),
    ],
)
def test_derivatives_of_random_systems_in_each_engine(seed, given, engine):
    """Guards and terminal constraints, with priors or a delay that is estimated."""
    system = System(2000 + seed, **{**PLAIN, **given})
    assert system.problem.constraint_names
    assert not differences(system, (), engine)


@pytest.fixture
def used_once():
    """Drop the programs of a system after its test: no other test needs them, and those of hundreds take 10 GB."""
    yield
    drop_programs()
    jax.clear_caches()


@pytest.mark.parametrize("seed", [pytest.param(v, marks=[pytest.mark.slow] * (v > 1)) for v in range(SYSTEMS)])
@pytest.mark.usefixtures("used_once")
def test_derivatives_of_random_systems_with_both_kinds_of_steps(seed):
    """Every other mode takes implicit steps."""
    system = System(3000 + seed, modes=3, transitions=3, solver="explicit")
    names = list(system.problem.system.modes)
    assert not differences(system, (), "native", implicit=tuple(names[seed % 2 :: 2]))


@pytest.mark.fuzz
@pytest.mark.usefixtures("used_once")
@pytest.mark.parametrize("seed", range(SYSTEMS))
def test_derivatives_of_random_systems_by_each_method(seed):
    """In machine code, and by one of the others, which JAX takes 20 s to compile; in each tenth JAX does it all."""
    assert not differences(System(seed), (METHODS[seed % len(METHODS)],), "jax" if seed % 10 == 0 else "auto")
