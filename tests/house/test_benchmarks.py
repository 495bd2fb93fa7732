"""All sides of the benchmarks compute the same thing. Nothing here looks at the clock."""

import math
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

pytest.importorskip("casadi")

import switchfit as sf
from benchmarks import casadi_forms, derivatives, models, problems, side_by_side, vehicle
from benchmarks.online import drives
from benchmarks.peers import casadi_collocation, casadi_horizon, casadi_shooting, scipy_differences
from benchmarks.sharp import problems as sharp_problems
from benchmarks.sharp.case import is_right
from benchmarks.sharp.corners import find_sides
from switchfit.problem.functions import use_float64

ROWS = 22


@pytest.mark.slow
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


def test_entrywise_models_are_those_of_switchfit():
    random = np.random.default_rng(0)
    for name, model in models.MODELS.items():
        case = problems.case(name)
        problem = case.problem()
        assert len(problem.theta_names) == len(model.theta), name
        np.testing.assert_array_equal(problem.initial_theta, model.theta)
        x, p = random.standard_normal(len(model.x0)), [float(value) for value in model.p]
        with use_float64():
            for mode in model.modes:
                theirs = model.field(mode, x.tolist(), p, math)
                np.testing.assert_allclose(case.system.modes[mode](0.0, x, case.pack(np.array(p))), theirs, rtol=1e-12)
            assert float(case.cost.ell(0.0, x, {})) == pytest.approx(model.density(x.tolist()), rel=1e-12)


def test_peers_agree_with_switchfit_on_a_small_model():
    """Two switches and a parameter, short: every library has the same J, gradient and Hessian."""
    model = replace(models.VEHICLE, times=(0.7, 1.3), horizon=(0.0, 2.0))
    case = replace(problems.case("vehicle"), model=model)
    ours = sf.evaluate(case.problem(rtol=1e-10, atol=1e-12))
    casadi, scipy = casadi_shooting.build(model, 64, unrolled=False), scipy_differences.build(model, 1e-10)
    rivals = {"CasADi MX": casadi, "SciPy": scipy}
    if find_spec("heyoka"):
        from benchmarks.peers import heyoka_variational

        rivals["heyoka"] = heyoka_variational.build(model, 1e-10)
    for name, functions in rivals.items():
        J, g, H = functions.hessian(model.theta)
        allowed = (1e-8, 1e-3, 1e-2) if name == "SciPy" else (1e-8, 1e-8, 1e-7)
        for mine, theirs, rtol in zip((ours.cost, ours.gradient, ours.hessian), (J, g, H), allowed, strict=True):
            assert side_by_side.error_of(theirs, mine) < rtol, name
        assert functions.cost(model.theta) == pytest.approx(J, rel=1e-12)
        gradient = functions.gradient(model.theta)[1]
        assert side_by_side.error_of(gradient, g) < (1e-3 if name == "SciPy" else 1e-10), name


def test_collocation_finds_the_known_optimum_of_fishing():
    none = np.zeros(0)
    found = casadi_collocation.Collocation(models.FISHING, 8, (none, none))(np.array(models.FISHING_START))
    assert found.success
    assert found.cost == pytest.approx(models.FISHING.optimum, rel=1e-9)
    np.testing.assert_allclose(found.theta, models.FISHING_BEST, atol=1e-6)


@pytest.mark.parametrize("name", sorted(sharp_problems.PROBLEMS))
def test_twins_of_sharp_problems_are_the_models_that_switchfit_gets(name):
    """The entries of both are equal on all sides of all corners, and the truth fits its data as noise does."""
    case = sharp_problems.PROBLEMS[name]()
    random = np.random.default_rng(0)
    scale = np.maximum(np.abs(case.x0), 1.0)
    for _ in range(20):
        x = np.array(case.x0) + 0.5 * random.standard_normal(len(case.x0)) * scale
        p = {key: value * random.uniform(0.7, 1.3) for key, value in case.parameters.items()}
        sides = find_sides(case.corners(x, tuple(p.values())))
        for mode, field in case.modes.items():
            theirs = case.twin(mode, 0.3, x, tuple(p.values()), sides)
            with use_float64():
                np.testing.assert_allclose(field(0.3, np.asarray(x), p), theirs, rtol=1e-12, atol=1e-12)
    assert 0.7 < 2 * case.judge(case.truth) / case.values.size < 1.3
    assert not is_right(case.judge(case.draw_starts(1)[0]), case.judge(case.truth))


def test_a_step_of_the_peers_is_that_of_switchfit():
    filterpy_bank = pytest.importorskip("benchmarks.peers.filterpy_bank", exc_type=ImportError)
    model = replace(models.VEHICLE, p=(0.7,))
    z = np.array([1.0, 8.0, 2.0, 1.0, 0.3, 0.5, 0.7])
    program = casadi_horizon.Program(model, 0.1, (0, 2), (0.05, 0.05), (0.05, 2.0), 1.0)
    steps = filterpy_bank.build_steps(model, 0.1)
    for share, mode in enumerate(("stick", "slip")):
        run = sf.Experiment(sf.RunningCost(lambda t, x, p: 0.0), (mode,), (), 0.0, 0.1, initial_state=z[:6])
        after = sf.simulate(sf.Problem(drives.SYSTEM, run, {"mu": 0.7}), times=[0.1]).states[0]
        theirs, tangent = (each.full() for each in program.tangent(z, share))
        np.testing.assert_allclose(theirs.ravel()[:6], after, atol=1e-4)  # of two Runge-Kutta steps, in slip
        bank, jacobian = steps[mode](z)
        np.testing.assert_allclose(bank, theirs.ravel(), rtol=1e-12)
        np.testing.assert_allclose(jacobian, tangent, atol=1e-12)
