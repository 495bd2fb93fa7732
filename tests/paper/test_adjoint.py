"""The paper's adjoint equations against the derivatives of the discretised cost, block by block, and these themselves.

Both converge to the derivatives of the cost, so the gap between them closes at the order of the integrator (5).
On the diagonal of the tau block it is one less: the local error of the row that ends at tau_i goes with the sixth power
of its length, and tau_i differentiates it twice. A mistake in a formula leaves a gap that does not close at all.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from support.derivatives import differentiate
from support.systems import KINDS, NODES, P0, Parameter, case, closed_form, closed_form_case, padded_mesh
from switchfit.discretization.arguments import build_arguments

# A sample inside a stiff mode starts a layer of the adjoints, which this mesh does not resolve.
SMOOTH_KINDS = ("running", "reference", "terminal")
VARIATIONS = [("resets", kind) for kind in reversed(KINDS)]
VARIATIONS += [(name, kind) for name in ("stiff", "mixed") for kind in SMOOTH_KINDS]

BLOCKS = ("D_tau J", "D_p J", "tau-tau, i = j", "tau-tau, i > j", "tau-p", "p-p")


def blocks(N: int, gradient: np.ndarray, hessian: np.ndarray) -> dict[str, float]:
    """Largest entry of each block of a gradient and a Hessian."""
    of_tau = np.diag(hessian)[:N], hessian[:N, :N][np.tril_indices(N, -1)]
    parts = gradient[:N], gradient[N:], *of_tau, hessian[:N, N:], hessian[N:, N:]
    return {name: float(np.abs(part).max()) for name, part in zip(BLOCKS, parts, strict=True)}


ORDER = {"tau-tau, i = j": 4.0}
ROUNDING = {"stiff": 1e-10, "mixed": 1e-10}
"""Relative gaps that need not close any further; the Jacobian of the stiff mode amplifies rounding."""


TAYLOR = {"resets": ([0.413, 0.791, 1.336], 0.01), "mixed": ([0.6187, 1.2812], 2e-4)}
"""Transition times that are no nodes, and a step."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", TAYLOR)
def test_taylor_remainders_have_orders_1_2_3(name: str, kind: str) -> None:
    this, (tau, size) = case(name), TAYLOR[name]
    arguments, direction = this.arguments(kind), np.array([*[1.0, -0.7, 0.8][: this.N], 0.9, -1.1])
    at = this.discrete(arguments, np.array(tau), P0)

    def remainders(step: float) -> list[float]:
        d = step * direction
        change = this.discrete(arguments, tau + d[: this.N], P0 + d[this.N :]).cost - at.cost
        return [change, change - at.gradient @ d, change - at.gradient @ d - 0.5 * d @ at.hessian @ d]

    coarse, fine = np.abs(remainders(size / 2)), np.abs(remainders(size / 4))
    np.testing.assert_allclose(np.log2(coarse / fine), [1.0, 2.0, 3.0], atol=0.2)


@cache
def gaps(name: str, kind: str) -> list[dict[str, float]]:
    """Gap of each block, relative to the largest entry, on meshes that are halved again and again."""
    this = case(name)
    found = []
    for halvings in (1, 2) if name in ROUNDING else (2, 3):
        given = this.arguments(kind, halvings=halvings), this.tau, P0
        paper, discrete = this.paper(*given), this.discrete(*given)
        assert paper.cost == pytest.approx(discrete.cost, rel=1e-12)
        gradient, hessian = np.abs(discrete.gradient).max(), np.abs(discrete.hessian).max()
        away = (paper.gradient - discrete.gradient) / gradient, (paper.hessian - discrete.hessian) / hessian
        found.append(blocks(this.N, *away))
    return found


SLOW = {v for v in VARIATIONS if v[0] != "resets"} | {("resets", "all")}
"""What other variations test as well: with resets, with all costs apart; implicit steps are the same equations."""


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize(
    ("name", "kind"), [pytest.param(*v, marks=pytest.mark.slow) if v in SLOW else v for v in VARIATIONS]
)
def test_gap_closes_at_the_order_of_the_integrator(name: str, kind: str, block: str) -> None:
    coarse, fine = (gap[block] for gap in gaps(name, kind))
    at_least = ORDER.get(block, 5.0) - 0.8
    assert fine < ROUNDING.get(name, 0.0) or np.log2(coarse / fine) > at_least, f"{block}: {coarse:.1e} to {fine:.1e}"


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("nodes", [[4, 9, 14], [4, 4, 13]], ids=["at a sample", "coinciding"])
def test_derivatives_converge_from_both_sides(nodes: list[int], side: int) -> None:
    this = case("resets")
    given = this.arguments(halvings=3), NODES[nodes], P0, side
    paper, discrete = this.paper(*given), this.discrete(*given)
    np.testing.assert_allclose(paper.gradient, discrete.gradient, atol=1e-7)
    np.testing.assert_allclose(paper.hessian, discrete.hessian, atol=1e-6)


CLOSED = {
    "with a reset map": (1, False, lambda z: closed_form(z[0], z[1]), [0.9, 0.7], (1e-8, 1e-6)),
    "without parameters": (1, True, lambda z: closed_form(z[0], 0.7), [0.9], (1e-8, 1e-6)),
    "without transitions": (0, False, lambda z: z[0] ** 2 * 4 / 3, [0.7], (1e-12, 1e-12)),
}


@pytest.mark.parametrize(("name", "method"), [*((name, "paper") for name in CLOSED), ("with a reset map", "discrete")])
def test_closed_forms(name: str, method: str) -> None:
    transitions, fixed, cost, theta, (first, second) = CLOSED[name]
    tau, p = np.split(np.array(theta), [transitions])
    this = closed_form_case(transitions=transitions, q=Parameter(0.7, fixed=fixed))
    mesh = padded_mesh(np.linspace(0.0, 2.0, 41), 40)
    found = getattr(this, method)(build_arguments(this.problem, 0, mesh), tau, p)
    J, gradient, hessian = differentiate(cost, theta)
    assert found.cost == pytest.approx(J, rel=1e-8)
    np.testing.assert_allclose(found.gradient, gradient, rtol=first)
    np.testing.assert_allclose(found.hessian, hessian, rtol=second)
