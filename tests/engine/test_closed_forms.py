"""Each engine and method gives J, its gradient and its Hessian as closed forms have them, whatever is measured.

The problems are in `support/closed_forms.py`. Hard moments (`test_hard_moments.py`) and the blocks of the paper's
equations (`test_adjoint.py`) have closed forms of their own.
"""

from dataclasses import replace

import numpy as np
import pytest

import switchfit as sf
from support.closed_forms import CLOSED_FORMS
from support.sharp_modes import crossings_of, expect, value_of
from switchfit.meshes.evaluator import Evaluator

WAYS = [
    pytest.param(name, *way, id=f"{name}-{'-'.join(way)}", marks=[pytest.mark.slow] * (way in given.slow))
    for name, given in CLOSED_FORMS.items()
    for way in (*given.quick, *given.slow)
]
"""A problem, an engine, a method."""


def assert_near(found, expected, error, relative_to, spare=0.0):
    """Compare arrays as `ClosedForm.relative_to` says; `spare` is the rounding of entries that are 0."""
    if relative_to == "entries":
        is_zero = expected == 0.0
        np.testing.assert_allclose(found[is_zero], 0.0, atol=spare)
        np.testing.assert_allclose(found[~is_zero], expected[~is_zero], rtol=error)
    else:
        scale = np.abs(expected).max() if relative_to == "largest" else 1.0
        np.testing.assert_allclose(found, expected, rtol=0, atol=error * scale)


@pytest.mark.parametrize(("name", "engine", "method"), WAYS)
def test_cost_gradient_and_hessian_are_those_of_the_closed_form(name, engine, method):
    given = CLOSED_FORMS[name]
    problem = replace(given.build(), engine=engine)
    J, g, H = given.differentiate(problem)
    evaluator, theta = Evaluator(problem), problem.initial_theta
    found = evaluator(theta, method=method)
    assert found.cost == pytest.approx(float(J), rel=given.errors[0])
    assert evaluator.cost(theta) == pytest.approx(found.cost, rel=1e-12)
    assert_near(found.gradient, g, given.errors[1], given.relative_to)
    assert_near(found.hessian, H, given.errors[2], given.relative_to, spare=1e-12)
    assert evaluator.engine.name == engine


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_a_wrong_formula_would_not_pass(name):
    """Every entry is large enough to be seen, but those that are exactly 0."""
    _, g, H = CLOSED_FORMS[name].differentiate(CLOSED_FORMS[name].build())
    entries = np.abs(np.concatenate([g, np.ravel(H)]))
    assert entries[entries > 0.0].min() > 1e-2


CORNERS = [
    pytest.param(name, engine, marks=[pytest.mark.slow] * (engine == "jax"))
    for name, given in CLOSED_FORMS.items()
    for engine in ("native", "jax")
    if given.solution
]


@pytest.mark.parametrize(("name", "engine"), CORNERS)
def test_gauss_newton_matrix_and_states_at_corners_are_those_of_the_closed_form(name, engine):
    """On both sides of crossings."""
    solution, problem = CLOSED_FORMS[name].solution, replace(CLOSED_FORMS[name].build(), engine=engine)
    evaluator, theta = Evaluator(problem), problem.initial_theta
    *_, gauss_newton = expect(solution, problem)
    np.testing.assert_allclose(evaluator(theta, matrix="gauss-newton").hessian, gauss_newton, rtol=1e-8, atol=1e-8)
    times = np.linspace(0.0, problem.experiments[0].tf, 200)[1:]
    states = sf.simulate(problem, times=times).states[:, 0]
    np.testing.assert_allclose(states, value_of(solution, times, theta), rtol=0, atol=1e-9)
    path = sf.simulate(problem)
    assert (np.diff(path.times) >= 0.0).all()
    for time in crossings_of(evaluator):
        assert np.abs(path.times - time).min() < 1e-12
