"""The two sides of the benchmark against CasADi compute the same thing. Nothing here looks at the clock."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("casadi")
sys.path.insert(0, str(Path(__file__).parent.parent))

from benchmarks import casadi_forms, derivatives, vehicle
from benchmarks.fit import CostBySciPy

ROWS = 22


@pytest.mark.parametrize("reference", [False, True])
def test_casadi_and_switchfit_agree(reference):
    problem = vehicle.with_reference(ROWS - 2) if reference else vehicle.without_reference()
    evaluator = vehicle.evaluator_with(problem, ROWS - 2)
    theta = problem.initial_theta
    rows = vehicle.table_of_rows(evaluator, theta)
    assert len(rows) == ROWS
    ours = evaluator(theta, method="discrete-adjoint")
    for name, form in casadi_forms.FORMS.items():
        program = casadi_forms.Timed(form(rows, reference))
        assert derivatives.gap(ours, *program(theta)) < 1e-10, name


def test_compiled_program_and_cost_are_those_of_the_evaluator():
    problem = vehicle.without_reference()
    evaluator = vehicle.evaluator_with(problem, ROWS - 2)
    theta = problem.initial_theta
    ours = evaluator(theta, method="discrete-adjoint")
    J, g, H = derivatives.compiled_program(evaluator, theta)()
    assert derivatives.gap(ours, float(J), np.asarray(g), np.asarray(H)) < 1e-12
    assert derivatives.compiled_cost(evaluator)(theta) == pytest.approx(ours.cost, rel=1e-13)


def test_cost_by_scipy_is_that_of_switchfit():
    problem = vehicle.with_reference()
    theta = problem.initial_theta
    ours = vehicle.evaluator_with(problem, None)(theta).cost
    assert CostBySciPy(problem)(theta) == pytest.approx(ours, rel=1e-6)
