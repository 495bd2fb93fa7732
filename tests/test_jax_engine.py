"""What the JAX engine knows of nodes: constraints and costs, whatever their kind, against JAX's own derivatives."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import constrained
from systems import compiled

import switchfit as sf
from switchfit.discretization import nodes
from switchfit.discretization.arguments import build_arguments
from switchfit.discretization.mesh import Mesh
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import compute_path_constraints, compute_path_cost, propagate
from switchfit.engine.jax import programs
from switchfit.engine.jax.gauss_newton import differentiate_residuals
from switchfit.engine.jax.programs import differentiate_constrained
from switchfit.fit.evaluator import evaluator_of

TAU, P0 = np.array([0.93, 2.07]), np.array([0.7, 0.4])


def program_inputs(problem: sf.Problem):
    """The structure, and the arguments on a mesh of 12 cells."""
    times = np.unique(np.concatenate([np.linspace(0.0, 3.0, 11), [0.5, 1.4, 2.6]]).round(12))
    return problem.structures[0], build_arguments(problem, 0, Mesh.from_times(times))


def assert_close(found, expected, relative: float) -> None:
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=relative * np.abs(b).max())


@pytest.mark.slow  # short forms: in test_guards.py, and of JAX in test_random_systems.py
@pytest.mark.parametrize(
    ("implicit", "relative"), [((False, False), 1e-12), ((True, True), 1e-9), ((False, True), 1e-9)]
)
def test_the_lagrangian_has_exact_derivatives(implicit: tuple[bool, ...], relative: float) -> None:
    structure, arguments = program_inputs(constrained(TAU))
    structure = replace(structure, implicit=implicit)
    multipliers = np.array([0.3, -1.1, 0.7, 0.4])

    def constraints_of(model, path, theta):
        p = theta[2:]
        at_transitions = [model.guard(i)(theta[i], path.at_transition(i)[1], p) for i in range(2)]
        return jnp.concatenate([jnp.stack(at_transitions), model.terminal_constraint(path.after[-1], p)])

    def lagrangian(arguments, tau, p, side):
        def value(theta):
            model = Model(structure, arguments)
            path = propagate(model, theta[:2], theta[2:], side)
            J, c = compute_path_cost(model, path, theta[2:]), constraints_of(model, path, theta)
            return J + multipliers @ c, (J, c)

        theta = jnp.concatenate([tau, p])
        _, (J, c) = value(theta)
        slope, hessian = jax.jacfwd(value, has_aux=True), jax.jacfwd(jax.jacfwd(value, has_aux=True), has_aux=True)
        return J, slope(theta)[0], hessian(theta)[0], c, jax.jacfwd(lambda theta: value(theta)[1][1])(theta)

    expected = compiled(lagrangian)(arguments, TAU, P0)

    def differentiate(arguments, tau, p, side):
        return differentiate_constrained(arguments, tau, p, side, multipliers, structure=structure)

    found = compiled(differentiate)(arguments, TAU, P0)
    assert np.abs(expected[2]).min() > 1e-3, "an entry is not tested"
    assert_close(found, expected, relative)


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


@pytest.mark.slow  # in closed form, and in both engines, in test_protocol.py
def test_costs_at_transitions(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kind of node at transitions that is a cost: here the guards, taken for one."""
    structure, arguments = program_inputs(constrained(TAU))
    without = compiled(
        lambda a, tau, p, side: compute_path_cost(m := Model(structure, a), propagate(m, tau, p, side), p)
    )
    J_without = float(without(arguments, TAU, P0))
    monkeypatch.setattr(nodes, "AT_TRANSITIONS", (nodes.TransitionKind("guards", constraint=False),))

    def by_jax(arguments, tau, p, side):
        def cost(theta):
            model = Model(structure, arguments)
            path = propagate(model, theta[:2], theta[2:], side)
            own = sum(model.guard(i)(theta[i], path.at_transition(i)[1], theta[2:]) for i in range(2))
            return compute_path_cost(model, path, theta[2:]), own

        theta = jnp.concatenate([tau, p])
        J, own = cost(theta)
        gradient = jax.jacfwd(lambda theta: cost(theta)[0])
        return J, gradient(theta), jax.jacfwd(gradient)(theta), own

    def by_programs(arguments, tau, p, side):
        model = Model(structure, arguments)
        J, g, adjoint = trace("discrete-adjoint", "exact")(arguments, tau, p, side)
        forward = trace("forward", "exact")(arguments, tau, p, side)[2]
        return J, g, adjoint, forward, compute_path_constraints(model, propagate(model, tau, p, side), p)

    J, g, H, own = compiled(by_jax)(arguments, TAU, P0)
    assert float(J) == pytest.approx(J_without + float(own), rel=1e-13)
    found_J, found_g, adjoint, forward, c = compiled(by_programs)(arguments, TAU, P0)
    assert_close((found_J, found_g, adjoint, forward), (J, g, H, H), 1e-12)
    assert c.shape == (2,)  # those at the end alone

    def gauss_newton(arguments, tau, p, side):
        return differentiate_residuals(Model(structure, arguments), jnp.concatenate([tau, p]), side)[2]

    with_costs = compiled(gauss_newton)(arguments, TAU, P0)
    monkeypatch.setattr(nodes, "AT_TRANSITIONS", ())
    added = with_costs - compiled(lambda *given: gauss_newton(*given))(arguments, TAU, P0)

    def expected_added(arguments, tau, p, side):
        """Their second derivatives along (tau_i, x(tau_i-), p), without that of the trajectory."""
        model = Model(structure, arguments)
        theta, total = jnp.concatenate([tau, p]), 0.0
        for i in range(2):

            def x_of(theta, i=i):
                return propagate(model, theta[:2], theta[2:], side).at_transition(i)[1]

            x, x_d = x_of(theta), jax.jacfwd(x_of)(theta)

            def along(e, i=i, x=x, x_d=x_d):
                q = theta + e
                return model.guard(i)(q[i], x + x_d @ e, q[2:])

            total = total + jax.jacfwd(jax.jacfwd(along))(jnp.zeros(theta.size))
        return total

    expected = compiled(expected_added)(arguments, TAU, P0)
    np.testing.assert_allclose(added, expected, rtol=0.0, atol=1e-11 * np.abs(expected).max())


def trace(method: str, matrix: str):
    """A function that returns J, g and H of `constrained`, and is traced anew by each program."""
    structure, _ = program_inputs(constrained(TAU))
    return lambda *at: programs.derivatives.__wrapped__(*at, structure=structure, method=method, matrix=matrix)


def test_all_matrices_come_with_the_same_cost_and_gradient() -> None:
    _, arguments = program_inputs(constrained(TAU))
    kinds = ("forward", "exact"), ("forward", "none"), ("discrete-adjoint", "none"), ("forward", "gauss-newton")
    expected, *others = (compiled(trace(*kind))(arguments, TAU, P0) for kind in (("discrete-adjoint", "exact"), *kinds))
    for found, (_, matrix) in zip(others, kinds, strict=True):
        assert_close(found[:2], expected[:2], 1e-12)
        assert bool(np.isnan(found[2]).all()) is (matrix == "none")
    assert_close(others[0][2:], expected[2:], 1e-12)
