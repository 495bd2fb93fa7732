"""`check_derivatives`: what makes it fail, and that it does not fail for another reason."""

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from benchmarks import vehicle_coverage
from switchfit.engine.protocol import Evaluation
from switchfit.fit.evaluator import Evaluator
from switchfit.models import heater_problem, lugre
from switchfit.uncertainty import certificate


def shift_derivatives(monkeypatch, method, *, gradient=0.0, hessian=0.0):
    """Make the derivatives of one method wrong by a share of each entry."""
    right = Evaluator.__call__

    def evaluate(self, theta, side=1, method_="auto", matrix="exact", **settings):
        asked = settings.get("method", method_)
        found = right(self, theta, side, asked, matrix)
        if asked != method:
            return found
        return Evaluation(found.cost, found.gradient * (1 + gradient), found.hessian * (1 + hessian))

    monkeypatch.setattr(Evaluator, "__call__", evaluate)


@pytest.mark.parametrize("wrong", [{"gradient": 1e-3}, {"hessian": 1e-3}])
def test_a_gap_that_does_not_close_fails(monkeypatch, wrong):
    shift_derivatives(monkeypatch, "adjoint", **wrong)
    check = sf.check_derivatives(heater_problem())
    assert not check.passed
    assert "the paper's equations differ from the derivatives of J by 1.0e-03" in str(check)
    assert "do not belong to the cost" not in str(check)


@pytest.mark.parametrize("wrong", [{"gradient": 1e-2}, {"hessian": 1e-2}])
def test_derivatives_of_another_cost_fail(monkeypatch, wrong):
    shift_derivatives(monkeypatch, "auto", **wrong)
    check = sf.check_derivatives(heater_problem(), paper=False)
    assert not check.passed
    assert "FAILED: the derivatives do not belong to the cost." in str(check)


@pytest.mark.slow
def test_a_gap_of_unstable_adjoints_is_no_failure():
    """Omega decays twice as fast as the state: at the longest steps that are stable for that, it is not."""
    problem = vehicle_coverage.draw_log(vehicle_coverage.CASES["lugre, force"]())
    check = sf.check_derivatives(problem)
    assert certificate.measure_derivative_gap(Evaluator(problem), check.theta)[1] > 1e3
    assert max(check.gradient_gap, check.hessian_gap) < certificate.LARGEST_GAP
    assert check.passed, check


def test_adjoints_that_overflow_are_a_gap_not_unchecked(monkeypatch):
    shift_derivatives(monkeypatch, "adjoint", hessian=np.nan)
    check = sf.check_derivatives(heater_problem())
    assert check.hessian_gap == np.inf
    assert not check.passed


def test_a_cost_that_is_not_finite_fails():
    """A model that is defined at theta itself, and not a step beside it."""

    def decay(t, x, p):
        return -x / jnp.where(p["k"] == 1.0, 1.0, jnp.nan)

    run = sf.Experiment(sf.Measurements([0.5, 1.0], [[0.6], [0.4]]), ("decay",), (), 0.0, 1.0)
    problem = sf.Problem(sf.HybridSystem({"decay": decay}, [1.0]), run, {"k": 1.0})
    assert np.isfinite(sf.evaluate(problem).cost)
    check = sf.check_derivatives(problem, paper=False)
    assert not check.passed
    assert [issue.kind for issue in check.failures] == ["cost not finite"]
    assert "do not belong to the cost" not in str(check)


def test_explicit_steps_that_blow_up_are_not_called_wrong_derivatives():
    """LuGre friction with the published stiffness, which takes 20,000 explicit steps at the limit of stability."""
    case = vehicle_coverage.CASES["lugre, spring"]()
    system = lugre(k=2.0, sigma_0=1e5, sigma_1=np.sqrt(1e5), v_s=0.001)
    problem = sf.Problem(system, case.problem.experiments, case.problem.parameters, solver="explicit")
    check = sf.check_derivatives(problem, case.theta, paper=False)
    assert not check.passed
    assert "not finite at this theta or near it" in str(check)
    assert "solver='stiff'" in str(check)
    assert "rounding only" not in str(check)
