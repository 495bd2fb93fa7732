"""What the JAX engine knows of nodes: constraints and costs, whatever their kind, against JAX's own derivatives."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from models import constrained
from systems import compiled

import switchfit as sf
from switchfit.discretization.mesh import Mesh, build_arguments
from switchfit.engine.jax import derivatives
from switchfit.fit.evaluator import evaluator_of

TAU, P0 = np.array([0.93, 2.07]), np.array([0.7, 0.4])


def program_inputs(problem: sf.Problem):
    """The structure, and the arguments on a mesh of 12 cells."""
    times = np.unique(np.concatenate([np.linspace(0.0, 3.0, 11), [0.5, 1.4, 2.6]]).round(12))
    return problem.structures[0], build_arguments(problem, 0, Mesh.from_times(times))


def assert_close(found, expected, relative: float) -> None:
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=relative * np.abs(b).max())


@pytest.mark.parametrize("guarded", [False, True])
def test_a_loop_of_unknown_length_is_differentiated_forward(guarded):
    """JAX has no reverse derivatives of it. Half of the state is reached by halving it until it is below one."""

    def halve(x):
        return jax.lax.while_loop(lambda y: y[0] > 1.0, lambda y: 0.5 * y, x)

    def build(scale):
        system = sf.HybridSystem(
            {"a": lambda t, x, p: -p["k"] * scale(x), "b": lambda t, x, p: -x},
            [1.9],
            guards={("a", "b"): lambda t, x, p: x[0] - 1.3} if guarded else {},
        )
        data = sf.Measurements(np.linspace(0.1, 1.0, 10), np.exp(-np.linspace(0.1, 1.0, 10)), sigma=0.1)
        return sf.Problem(system, sf.Experiment(data, ("a", "b"), (0.4,), 0.0, 1.0), {"k": 0.9})

    looping, plain = evaluator_of(build(halve)), evaluator_of(build(lambda x: 0.5 * x))
    theta = looping.problem.initial_theta
    assert "while_loop" in looping.engine.reason
    for matrix in ("exact", "none", "gauss-newton"):
        found, expected = (each(theta, matrix=matrix) for each in (looping, plain))
        np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-7)
        np.testing.assert_allclose(found.hessian, expected.hessian, rtol=1e-6)
    if guarded:
        found, expected = (each.constrained(theta, 1, np.array([0.7])) for each in (looping, plain))
        np.testing.assert_allclose(found.hessian, expected.hessian, rtol=1e-6)
    with pytest.raises(ValueError, match=r"write jax\.lax\.scan"):
        looping.engines[0].costates(*looping.problem.vectors(theta, 0), np.zeros(int(guarded)))


def trace(method: str, matrix: str):
    """A function that returns J, g and H of `constrained`, and is traced anew by each program."""
    structure, _ = program_inputs(constrained(TAU))
    return lambda *at: derivatives.__wrapped__(*at, structure=structure, method=method, matrix=matrix)


def test_all_matrices_come_with_the_same_cost_and_gradient() -> None:
    _, arguments = program_inputs(constrained(TAU))
    kinds = ("forward", "exact"), ("forward", "none"), ("discrete-adjoint", "none"), ("forward", "gauss-newton")
    expected, *others = (compiled(trace(*kind))(arguments, TAU, P0) for kind in (("discrete-adjoint", "exact"), *kinds))
    for found, (_, matrix) in zip(others, kinds, strict=True):
        assert_close(found[:2], expected[:2], 1e-12)
        assert bool(np.isnan(found[2]).all()) is (matrix == "none")
    assert_close(others[0][2:], expected[2:], 1e-12)
