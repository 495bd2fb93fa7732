"""The certificate: derivatives that are wrong are called so, and others are not."""

import re
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from benchmarks import vehicle_coverage
from support.fits_by_hand import made
from support.fits_by_hand import write_report as report
from support.models import one_run
from switchfit.engine.evaluation import Evaluation
from switchfit.meshes.evaluator import Evaluator
from switchfit.models import heater_problem, lugre
from switchfit.optimize import Status
from switchfit.uncertainty.certificate import certify
from switchfit.uncertainty.derivative_check import LARGEST_GAP, measure_derivative_gap

# The certificate


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


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"optimality": 1e-3}, "the KKT residual 1.0e-03 is above the tolerance 1.0e-07"),
        ({"hessian": np.diag([1.0, -1.0, 1.0])}, "the Hessian has a negative eigenvalue on the free directions"),
        ({"integration_error": 2e-3}, "the integration error of J is 2.0e-03, relative"),
    ],
)
def test_a_certificate_that_fails_is_the_first_line_of_the_report(changes, words):
    fit = made(**changes)
    certificate = certify(fit, None)
    assert not certificate.passed
    assert any(words in str(failure) for failure in certificate.failures)
    assert words[:30] in " ".join(report(fit).split("\n\n")[0].split())
    assert "FAILED" in str(certificate).splitlines()[-1]
    assert words[:30] not in report(replace(fit, status=Status.MAX_ITERATIONS)).split("\n\n")[0]


@pytest.mark.parametrize(
    ("method", "wrong", "said"),
    [
        ("adjoint", {"gradient": 1e-3}, "the paper's equations differ from the derivatives of J by 1.0e-03"),
        ("adjoint", {"hessian": np.nan}, "the paper's equations differ from the derivatives of J by inf"),
        ("auto", {"gradient": 1e-2}, "FAILED: the derivatives do not belong to the cost."),
        ("auto", {"hessian": 1e-2}, "FAILED: the derivatives do not belong to the cost."),
    ],
)
def test_wrong_derivatives_fail(monkeypatch, method, wrong, said):
    """Those of the paper by a gap that does not close, and overflow is none that is unchecked; the others by Taylor."""
    shift_derivatives(monkeypatch, method, **wrong)
    check = sf.check_derivatives(heater_problem(), paper=method == "adjoint")
    assert len(check.failures) == 1
    assert said in str(check)


@pytest.mark.slow
def test_a_gap_of_unstable_adjoints_is_no_failure():
    """Omega decays twice as fast as the state: at the longest steps that are stable for that, it is not."""
    problem = vehicle_coverage.draw_log(vehicle_coverage.CASES["lugre, force"]())
    check = sf.check_derivatives(problem)
    assert measure_derivative_gap(Evaluator(problem), check.theta)[1] > 1e3
    assert max(check.gradient_gap, check.hessian_gap) < LARGEST_GAP
    assert check.passed, check


def test_unstable_explicit_steps_are_not_called_wrong_derivatives():
    """LuGre friction with the published stiffness, which takes 20,000 explicit steps at the limit of stability."""
    case = vehicle_coverage.CASES["lugre, spring"]()
    system = lugre(k=2.0, sigma_0=1e5, sigma_1=np.sqrt(1e5), v_s=0.001)
    problem = sf.Problem(system, case.problem.experiments, case.problem.parameters, solver="explicit")
    check = sf.check_derivatives(problem, case.theta, paper=False)
    assert [issue.kind for issue in check.failures] == ["cost not continuous"]
    assert "J jumps at this theta or near it" in str(check)
    assert "solver='stiff'" in str(check)


def test_a_comparison_of_an_input_with_an_unknown_is_named_where_derivatives_fail():
    """A dead band: how the time at which the input leaves it moves is left out."""

    def flow(t, x, p, u):
        return p["k"] * jnp.sign(u) * jnp.maximum(jnp.abs(u) - p["w"], 0.0) - 0.3 * x

    knots = [0.0, 0.6, 1.2, 0.3, -0.5, -1.1, -0.4, 0.5, 1.3, 0.9, 0.2, -0.6, -0.2]
    command, times = sf.Input(np.arange(13.0), knots, kind="linear"), np.arange(0.25, 12.0, 0.25)
    data = sf.Measurements(times, 0.7 * np.sin(times), sigma=0.03)
    problem = one_run(sf.HybridSystem({"m": flow}, [0.0]), data, ("m",), (), 12.0, {"w": 0.3, "k": 0.7}, inputs=command)
    check = sf.check_derivatives(problem, paper=False)
    assert [issue.kind for issue in check.failures] == ["hidden switch"]
    assert re.search(r"mode 'm' bends with w at test_certificate.py:\d+, and derivatives leave out", str(check))
    assert "hidden switch" in [issue.kind for issue in sf.estimate(problem, strategy="local").certificate.failures]


def test_a_cost_that_is_not_finite_nearby_says_nothing_about_derivatives():
    """x' = p x² ends at t = 1 / p."""
    system = sf.HybridSystem({"m": lambda t, x, p: p["p"] * x**2}, [1.0])
    run = sf.Experiment(sf.TerminalCost(lambda x, p: x[0] ** 2), ("m",), (), 0.0, 1.0)
    check = sf.check_derivatives(sf.Problem(system, run, {"p": 0.999}), paper=False)
    assert [issue.kind for issue in check.failures] == ["cost not finite"]
    assert "not finite at this theta or near it" in str(check)
