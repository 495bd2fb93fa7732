"""Derivatives of the discretised cost: forward over backward and forward over forward must agree to rounding."""

from __future__ import annotations

import numpy as np
import pytest
from derivatives import differentiate
from systems import (
    KINDS,
    NODES,
    P0,
    Derivatives,
    Parameter,
    case,
    closed_form,
    closed_form_case,
    padded_mesh,
)

from switchfit.discretization.mesh import build_arguments

INSIDE = {"plain": [0.613, 1.287], "resets": [0.413, 0.791, 1.336]}
INSIDE |= {name: [0.6187, 1.2812] for name in ("stiff", "mixed")}
"""Transition times that are not nodes."""


def assert_same(found: Derivatives, expected: Derivatives, relative: float) -> None:
    """Equal gradients and Hessians, relative to their largest entries."""
    assert found.cost == pytest.approx(expected.cost, rel=relative)
    for a, b in ((found.gradient, expected.gradient), (found.hessian, expected.hessian)):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=relative * np.abs(b).max())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "name", ["mixed", *(pytest.param(name, marks=pytest.mark.slow) for name in ("resets", "stiff"))]
)
def test_adjoint_and_forward_agree(name: str, kind: str) -> None:
    this = case(name)
    at = this.arguments(kind), INSIDE[name], P0
    expected = this.forward(*at)
    assert np.abs(expected.hessian).min() > 1e-6, "an entry is not tested"
    assert_same(this.discrete(*at), expected, 1e-9 if any(this.structure.implicit) else 2e-12)


def test_derivatives_in_closed_form() -> None:
    this = closed_form_case(transitions=1, q=Parameter(0.7))
    found = this.discrete(build_arguments(this.problem, 0, padded_mesh(np.linspace(0.0, 2.0, 41), 40)), [0.9], [0.7])
    _, gradient, hessian = differentiate(lambda z: closed_form(z[0], z[1]), [0.9, 0.7])
    np.testing.assert_allclose(found.gradient, gradient, rtol=1e-8)
    np.testing.assert_allclose(found.hessian, hessian, rtol=1e-6)


@pytest.mark.parametrize("side", [-1, 1])
def test_side_is_the_limit_from_that_side(side: int) -> None:
    this = case("resets")
    tau = NODES[[5, 9, 14]]
    at = this.discrete(this.arguments(halvings=2), tau, P0, side)
    beside = this.discrete(this.arguments(halvings=2), tau + side * 1e-9, P0, side)
    other = this.discrete(this.arguments(halvings=2), tau, P0, -side)
    np.testing.assert_allclose(at.gradient, beside.gradient, atol=1e-6)
    np.testing.assert_allclose(at.hessian, beside.hessian, atol=1e-4)
    assert np.abs(at.gradient - other.gradient).max() > 0.1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "name", ["resets", "mixed", *(pytest.param(name, marks=pytest.mark.slow) for name in ("plain", "stiff"))]
)
def test_taylor_remainders_have_orders_1_2_3(name: str, kind: str) -> None:
    this = case(name)
    arguments = this.arguments(kind)
    tau = np.array(INSIDE[name])
    direction = np.array([*[1.0, -0.7, 0.8][: this.N], 0.9, -1.1])
    direction *= (0.0002 if any(this.structure.implicit) else 0.01) / np.abs(direction).max()
    at = this.discrete(arguments, tau, P0)

    def remainders(step: float) -> list[float]:
        d = step * direction
        change = this.cost(arguments, tau + d[: this.N], P0 + d[this.N :]) - at.cost
        return [change, change - at.gradient @ d, change - at.gradient @ d - 0.5 * d @ at.hessian @ d]

    coarse, fine = np.abs(remainders(0.5)), np.abs(remainders(0.25))
    np.testing.assert_allclose(np.log2(coarse / fine), [1.0, 2.0, 3.0], atol=0.2)


def test_equal_neighbouring_modes_give_zero_rows() -> None:
    """... up to the integrator's error, since where tau_1 stands moves a step of the integrator."""
    this = case("plain")
    found = this.discrete(this.arguments(equal=1.0, halvings=3), INSIDE["plain"], P0)
    assert np.abs(found.hessian[1:, 1:]).max() > 1.0
    np.testing.assert_allclose(found.gradient[0], 0.0, atol=1e-7)
    np.testing.assert_allclose(found.hessian[0], 0.0, atol=1e-4)


@pytest.mark.parametrize("split", [0.0, 0.35, 0.6, 1.287])
def test_splitting_a_mode_changes_nothing(split: float) -> None:
    """Modes A, A, C with the first transition anywhere, at t0 too, where nothing is left of the first A."""
    this = case("plain")
    arguments = this.arguments(equal=1.0, halvings=3)
    expected = this.discrete(arguments, [0.0, 1.287], P0)
    found = this.discrete(arguments, [split, 1.287], P0)
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    np.testing.assert_allclose(found.gradient[1:], expected.gradient[1:], atol=1e-6)
    np.testing.assert_allclose(found.hessian[1:, 1:], expected.hessian[1:, 1:], atol=1e-5)
