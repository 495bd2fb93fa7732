"""Hard moments: transitions at samples, at each other and at the ends of the horizon."""

from dataclasses import replace

import numpy as np
import pytest

import switchfit as sf
from support import models
from switchfit.meshes.evaluator import Evaluator, evaluator_of

TIMES = np.linspace(0.5, 4.0, 8)
A, B, C = 0.7, 0.2, 1.1


def decay(rate):
    return lambda t, x, p: -rate * x


SYSTEM = sf.HybridSystem({"a": decay(A), "b": decay(B), "c": decay(C)}, [1.0])
VALUES = np.cos(TIMES)


@pytest.fixture(scope="module")
def this():
    data = sf.Measurements(TIMES, VALUES, sigma=1.0)
    return sf.Problem(SYSTEM, sf.Experiment(data, ("a", "b", "c"), (1.1, 2.9), 0.0, 4.0), rtol=1e-12, atol=1e-14)


def expected(tau, side):
    """J, gradient and Hessian: x at the samples is exp(-s), and some samples feel a time move to one side."""
    t1, t2 = tau
    s = np.minimum(TIMES, t1) * A + np.clip(TIMES - t1, 0, max(t2 - t1, 0)) * B + np.clip(TIMES - t2, 0, None) * C
    last = TIMES[-1]  # tf: nothing moves beyond it
    after = [t < TIMES if side > 0 and t < last else t <= TIMES for t in tau]
    slopes = np.array([(A - B) * after[0], (B - C) * after[1]])
    x = np.exp(-s)
    r, x_d = x - VALUES, -x * slopes
    hessian = x_d @ x_d.T + np.einsum("k,ik,jk->ij", r * x, slopes, slopes)
    return 0.5 * r @ r, x_d @ r, hessian


EPS = np.finfo(float).eps
MOMENTS = {
    "at a sample": (1.5, 2.9),
    "a rounding below a sample": (1.5 * (1 - EPS), 2.9),
    "a rounding above a sample": (1.5 * (1 + EPS), 2.9),
    "a few roundings above a sample": (1.5 * (1 + 8 * EPS), 2.9),
    "equal": (2.2, 2.2),
    "equal, at a sample": (2.0, 2.0),
    "at t0": (0.0, 2.9),
    "at tf, which is a sample": (1.1, 4.0),
    "both at t0": (0.0, 0.0),
    "both at tf": (4.0, 4.0),
    "at both ends": (0.0, 4.0),
}


@pytest.mark.parametrize(
    "method",
    ["discrete-adjoint", "adjoint", *(pytest.param(name, marks=pytest.mark.slow) for name in ("forward", "autodiff"))],
)
@pytest.mark.parametrize("where", MOMENTS)
def test_derivatives_at_hard_moments_are_those_of_the_closed_form(this, where, method):
    """One-sided where they jump: for increasing times, as `evaluate` says."""
    tau = MOMENTS[where]
    found = evaluator_of(this)(np.array(tau), method=method)
    cost, gradient, hessian = expected(tau, 1)
    assert found.cost == pytest.approx(cost, rel=1e-7)
    np.testing.assert_allclose(found.gradient, gradient, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.hessian, hessian, rtol=0, atol=1e-4)
    if where == "at a sample":
        assert abs(found.gradient[0] - expected(tau, -1)[1][0]) > 0.01


@pytest.mark.parametrize("side", [1, -1])
def test_both_one_sided_derivatives_are_those_of_the_closed_form(this, side):
    """Within rounding of a sample and of other nodes, and at the ends, where there is one whatever the side."""
    evaluator = Evaluator(replace(this, rtol=1e-13, atol=1e-15))
    nodes = [node for node in evaluator.breakpoints()[0][1::3] if node < 2.8]
    ulps = (-(2**30), -1000, -3, -1, 0, 1, 3, 1000, 2**30)
    places = [(node + many * np.spacing(node), 2.9) for node in (1.5, *nodes) for many in ulps]
    for tau in (*places, (0.0, 2.9), (1.1, 4.0)):
        found = evaluator(np.array(tau), side)
        J, gradient, _ = expected(tau, side)
        assert found.cost == pytest.approx(J, rel=1e-11)
        np.testing.assert_allclose(found.gradient, gradient, rtol=1e-9, atol=1e-11)
    for node in nodes:
        costs = [evaluator(np.array([np.nextafter(node, to), 2.9]), side).cost for to in (0.0, node, 4.0)]
        np.testing.assert_allclose(costs, costs[0], rtol=1e-14)


@pytest.mark.parametrize("where", MOMENTS)
def test_a_fit_may_begin_at_a_hard_moment(this, where):
    found = sf.estimate(this, start=MOMENTS[where])
    assert found.status.is_strict_minimum or found.status is sf.Status.SINGULAR
    assert found.cost <= expected(MOMENTS[where], 1)[0]


def test_a_time_between_equal_modes_is_not_determined():
    """What J has of a second derivative in it is the error of its integration."""
    data = sf.Measurements([0.25, 0.75], [0.8, 0.5], sigma=0.1)
    run = sf.Experiment(data, ("m", "m"), (0.5,), 0.0, 1.0)
    found = sf.estimate(sf.Problem(sf.HybridSystem({"m": models.decay}, [1.0]), run, {"k": 1.0}))
    assert found.status is sf.Status.SINGULAR
    assert not found.hessian[0].any()
    assert found.hessian[1, 1] > 0.0
