"""Problems whose answers are known, recomputed independently to 12 digits or more."""

import numpy as np
import pytest

import switchfit as sf
from support.models import fit_problem, linear, tracked_drive

TIGHT = {"rtol": 1e-12, "atol": 1e-14}


def test_one_switch():
    problem = linear((0.5,), **TIGHT)
    start = sf.evaluate(problem)
    assert start.cost == pytest.approx(7.033595807668208, rel=1e-11)
    assert start.gradient[0] == pytest.approx(15.980536237752, rel=1e-10)
    found = sf.estimate(problem)
    assert found.transition_times[0][0] == pytest.approx(0.26486609904078, abs=1e-9)
    assert found.cost == pytest.approx(5.254542944923224, abs=1e-11)
    assert found.hessian[0, 0] == pytest.approx(60.47193065, abs=1e-6)


def test_five_switches_from_equal_spacing():
    problem = linear(**TIGHT)
    assert sf.evaluate(problem).cost == pytest.approx(4.912678, abs=5e-7)
    found = sf.estimate(problem)
    assert found.cost == pytest.approx(4.504794324332318, abs=1e-11)
    expected = [0.10021709786456, 0.29739223936426, 0.43294465994443, 0.64175816832317, 0.76662528600859]
    np.testing.assert_allclose(found.transition_times[0], expected, rtol=0, atol=1e-9)


def test_exact_orders_of_the_skid_steered_vehicle():
    """The simulated problem of the paper, equation (18): 10 iterations at most, the last ones quadratic."""
    found = sf.estimate(tracked_drive())
    assert found.hessian_kind == "auto"
    assert found.iterations <= 10
    np.testing.assert_allclose(found.theta, [6.0, 10.0, 0.7], rtol=0, atol=1e-6)
    optimality = np.array([record.optimality for record in found.history])
    assert optimality[-1] < 1e-7
    assert np.log(optimality[-2]) / np.log(optimality[-3]) > 1.5 or optimality[-2] < 1e-9


@pytest.mark.parametrize("hessian", ["block-diagonal", "gauss-newton"])
def test_other_second_derivatives_reach_the_same_optimum(hessian):
    found = fit_problem(tracked_drive(), hessian=hessian, max_iterations=5000, success=True)
    np.testing.assert_allclose(found.theta, [6.0, 10.0, 0.7], rtol=0, atol=1e-6)
    assert (found.iterations > 200) == (hessian == "block-diagonal")  # the exact Hessian takes ten at most


def test_the_scheme_of_the_paper_descends_until_the_hessian_is_positive_definite():
    """Section II-A; the Hessian at the start has a negative eigenvalue, so that the first steps are along −DJ."""
    problem = tracked_drive()
    found = sf.estimate(problem, hessian="descent-first")
    np.testing.assert_allclose(found.theta, [6.0, 10.0, 0.7], rtol=0, atol=1e-6)
    positive = [np.linalg.eigvalsh(sf.evaluate(problem, record.theta).hessian)[0] > 0 for record in found.history]
    first = positive.index(True)
    assert 5 < first >= found.iterations - 10
    assert all(positive[first:])
    step, downhill = found.history[1].theta - found.history[0].theta, -sf.evaluate(problem).gradient
    np.testing.assert_allclose(step / np.linalg.norm(step), downhill / np.linalg.norm(downhill), atol=1e-12)
