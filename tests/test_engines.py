"""Fits in machine code with tables and mass matrices; and the page of the documentation that says what has it."""

from __future__ import annotations

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from functions import FALLS_BACK

import switchfit as sf
from switchfit.engine.native import entries, matrices, sorting, trace

PAGE = Path(__file__).resolve().parent.parent / "docs" / "engines.md"

SPEED = np.array([-3.0, -1.0, -0.2, 0.0, 0.2, 1.0, 3.0])
FRICTION = np.array([-1.4, -0.9, -1.1, 0.0, 1.1, 0.9, 1.4])


def driven(t, x, p):
    """A mass on a belt, with friction from a table."""
    return jnp.array([x[1], p["force"] - p["scale"] * jnp.interp(x[1], SPEED, FRICTION)])


def released(t, x, p):
    return jnp.array([x[1], -p["k"] * x[0] - p["scale"] * jnp.interp(x[1], SPEED, FRICTION)])


def arm(torque):
    """Two links, with a mass matrix that depends on their angles; the lever of the torque changes at the transition."""

    def mode(t, x, p):
        q, v = x[:2], x[2:]
        c, s = p["m"] * jnp.cos(q[0] - q[1]), p["m"] * jnp.sin(q[0] - q[1])
        mass = jnp.array([[2.0, c], [c, 1.0 + p["m"]]])
        forces = jnp.array([torque * p["torque"] - s * v[1] ** 2, s * v[0] ** 2]) - 0.3 * v - p["k"] * jnp.sin(q)
        return jnp.concatenate([v, jnp.linalg.solve(mass, forces)])

    return mode


SYSTEMS = {
    "friction from a table": (
        sf.HybridSystem({"driven": driven, "released": released}, [0.0, 0.1]),
        ("driven", "released"),
        {"force": 2.0, "scale": 0.8, "k": 1.5},
    ),
    "mass matrix": (
        sf.HybridSystem({"up": arm(1.0), "down": arm(-0.5)}, [0.1, -0.2, 0.0, 0.0]),
        ("up", "down"),
        {"m": 0.6, "torque": 1.5, "k": 1.2},
    ),
}


def problem_of(name):
    """Two modes, a transition at 0.9, and noise; the guess is somewhere else."""
    system, modes, truth = SYSTEMS[name]
    times = np.linspace(0.05, 2.0, 40)

    def at(tau, parameters, values):
        log = sf.Measurements(times, values, observe=lambda t, x, p: x, sigma=0.01)
        return sf.Problem(system, sf.Experiment(log, modes, (tau,), 0.0, 2.0), parameters)

    states = len(system.initial_state)
    path = sf.simulate(at(0.9, truth, np.zeros((40, states))))
    exact = np.stack([np.interp(times, path.times, column) for column in path.states.T], axis=1)
    values = exact + np.random.default_rng(0).normal(0.0, 0.01, (40, states))
    return at(0.97, {key: 1.1 * value for key, value in truth.items()}, values)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "mass matrix")) for name in SYSTEMS]
)
def test_a_fit_in_machine_code_is_the_fit_by_jax(name):
    found = sf.estimate(problem_of(name))
    assert found.success
    assert found.engine.name == "native"
    by_jax = found.evaluator_at_solution()(found.theta, method="discrete-adjoint")  # on the mesh of the fit
    assert by_jax.cost == pytest.approx(found.cost, rel=1e-9)
    errors = np.sqrt(np.diag(np.linalg.inv(by_jax.hessian)))
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), errors, rtol=1e-6)
    step = np.linalg.solve(by_jax.hessian, by_jax.gradient)
    assert np.abs(step / errors).max() < 1e-5, "JAX would go on"


# The page


def rows_of(section):
    """Rows of the table of a section: lists of cells."""
    text = PAGE.read_text().split(f"## {section}\n")[1].split("\n## ")[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"][2:]


def names_in(cell):
    return re.findall(r"`([^`]*)`", cell)


def test_the_page_names_what_jax_has_to_do():
    left = {name for _, examples in rows_of("JAX") for name in names_in(examples)}
    reasons = [reason for reason in FALLS_BACK.values() if "(limit" not in reason]
    called = {found[1] for reason in reasons if (found := re.match(r"calls ([\w.]+\w)", reason))}
    assert len(called) > 20
    assert not called - left


def test_the_page_claims_machine_code_only_for_what_has_it():
    written = {name for _, examples, _ in rows_of("Machine code") for name in names_in(examples)}
    fallen = {name for name in written for why in FALLS_BACK.values() if f"calls {name}" in why and "(limit" not in why}
    assert len(written) > 30
    assert not fallen


@pytest.mark.parametrize(
    ("row", "limits"),
    [
        ("branches, loops", (trace.MOST_NODES,)),
        ("tables of numbers", (entries.MOST_ROWS_OF_TABLE,)),
        ("tables of parameters", (entries.MOST_CHOICES,)),
        ("indices that depend", (entries.MOST_CHOICES,)),
        ("linear systems", (matrices.MOST_ROWS_TO_PIVOT,)),
        ("Cholesky", (matrices.MOST_ROWS, matrices.MOST_KNOWN_ROWS)),
        ("sorting", (sorting.MOST_SORTED,)),
    ],
)
def test_the_limits_on_the_page_are_those_of_the_code(row, limits):
    (cell,) = (limit for what, _, limit in rows_of("Machine code") if what.startswith(row))
    assert tuple(map(int, re.findall(r"\d+", cell))) == limits
