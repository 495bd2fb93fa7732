"""solver="auto": explicit steps, and implicit ones in the modes where explicit ones are hopeless."""

import pickle
from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import switchfit as sf
from support.stiff_modes import SQUARE, robertson, van_der_pol
from support.stiff_modes import one_mode as stiff_mode
from switchfit.engine.adaptive.stiffness import Look, Watch
from switchfit.engine.run import runs_of
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.meshes.implicit_modes import ImplicitModes
from switchfit.meshes.refinement import refine_if_unstable, refine_mesh
from switchfit.report.problem import write_steps


def relax(t, x, p):
    """A fast linear mode that follows cos t."""
    return -p["rate"] * (x - jnp.cos(t))


def oscillate(t, x, p):
    return jnp.array([x[1], -(p["omega"] ** 2) * x[0]])


one_mode = partial(stiff_mode, solver="auto")
"""The step method of its mode is chosen, unless a solver is given."""


def relaxing(rate=1e5, **settings):
    return one_mode(relax, [0.0], {"rate": rate}, 10.0, **settings)


# What is taken for stiff


VAN_DER_POL = van_der_pol, [2.0, 0.0], {"mu": 1000.0}, 300.0
ROBERTSON = robertson, [1.0, 0.0, 0.0], {"a": 0.04, "b": 1e4, "c": 3e7}, 40.0


@pytest.mark.parametrize("given", [VAN_DER_POL, ROBERTSON], ids=["van der Pol", "Robertson"])
def test_the_mesh_is_that_of_the_stiff_solver(given):
    problem, stiff = one_mode(*given), one_mode(*given, solver="stiff")
    mesh, expected = (refine_mesh(p, 0, p.initial_theta) for p in (problem, stiff))
    np.testing.assert_array_equal(mesh.nodes, expected.nodes)
    assert evaluator_of(problem).cost(problem.initial_theta) == evaluator_of(stiff).cost(stiff.initial_theta)


def test_robertsons_problem_agrees_with_scipy():
    """Explicit steps at the limit of stability are wrong by 2e-5 on their own mesh."""
    problem = one_mode(*ROBERTSON)

    def slope(t, y):
        return [*np.asarray(robertson(t, y[:3], ROBERTSON[2])), y[0] ** 2]

    y = scipy.integrate.solve_ivp(slope, (0.0, 40.0), [1.0, 0, 0, 0], method="Radau", rtol=1e-9, atol=1e-12).y[:, -1]
    cost = evaluator_of(problem).cost(problem.initial_theta)
    assert cost == pytest.approx(y[3], rel=1e-7)
    explicit = replace(problem, solver="explicit")
    assert abs(evaluator_of(explicit).cost(problem.initial_theta) / y[3] - 1) > 1e-6


def test_the_explicit_solve_is_given_up_once_it_is_clear_that_stability_limits_it(monkeypatch):
    watches, watch = [], ImplicitModes.watch
    monkeypatch.setattr(ImplicitModes, "watch", lambda choice, k: watches.append(watch(choice, k)) or watches[-1])
    problem = relaxing(1e4)
    refine_mesh(problem, 0, problem.initial_theta)
    assert watches[0].modes["m"].count <= 20 * 256


# What is not


@pytest.mark.parametrize(
    ("given", "rtol", "cells"),
    [
        ((oscillate, [1.0, 0.0], {"omega": 300.0}, 10.0), 1e-8, 30_000),
        ((oscillate, [1.0, 0.0], {"omega": 300.0}, 100.0), 1e-3, 3000),
        ((lambda t, x, p: p["rate"] * (x - jnp.cos(100.0 * t)), [0.0], {"rate": 1.0}, 10.0), 1e-8, 1000),
        *(((relax, [0.0], {"rate": rate}, 10.0), 1e-8, 0) for rate in (1.0, 1000.0)),
    ],
    ids=["fast oscillation", "with a loose tolerance", "a mode that grows", *["few steps"] * 2],
)
def test_what_is_not_stiff_keeps_its_explicit_steps_to_the_bit(given, rtol, cells):
    """Many steps for accuracy, or few steps, by which little could be gained."""
    problem, explicit = (one_mode(*given, rtol=rtol, solver=solver) for solver in ("auto", "explicit"))
    mesh, expected = (refine_mesh(p, 0, p.initial_theta) for p in (problem, explicit))
    np.testing.assert_array_equal(mesh.nodes, expected.nodes)
    assert mesh.cells > cells
    assert mesh.stiffness == ()


def test_what_neither_can_integrate_is_refused():
    """An oscillation that needs millions of steps of either kind."""
    with pytest.raises(ValueError, match=r"mode 'm' cannot be integrated.*more than 200000 steps.*use a better guess"):
        sf.evaluate(one_mode(oscillate, [1.0, 0.0], {"omega": 1e5}, 10.0))


def test_the_look_at_eigenvalues_survives_a_model_that_is_undefined_beside_the_trajectory():
    watch = Watch()
    watch.enter("m")
    there = np.array([1.0, 0.0])
    watch.look(Look(1e-3, lambda t, y: np.where(y[:, :1] > 1.0, [np.nan, 0.0], [-1e6, 0.0]), 0.0, there, 1e-2))
    assert watch.modes["m"].rates == [0.0]


def test_eigenvalues_are_those_of_the_vector_field():
    """Complex ones by their size, growing ones not at all, whatever the size of the states."""
    A = np.array([[-3.0, 400.0, 0.0], [-400.0, -3.0, 0.0], [0.0, 0.0, 5000.0]])
    for size in (1e-6, 1.0, 1e6):
        watch = Watch()
        watch.enter("m")
        y = size * np.array([1.0, -2.0, 0.5, 0.0])
        watch.look(Look(0.01, lambda t, y: np.pad(y[:, :3] @ A.T, [(0, 0), (0, 1)]), 0.0, y, 1e-2 * size))
        (rate,) = watch.modes["m"].rates
        assert rate == pytest.approx(np.hypot(3.0, 400.0), rel=1e-5)
        assert watch.modes["m"].limited == [0.01 * rate]


# By time


def test_the_predicted_time_decides_on_the_engine_that_evaluates():
    """Three to five times fewer implicit steps: their rows have four times the work in machine code, ten in JAX."""
    problem = one_mode(van_der_pol, [2.0, 0.0], {"mu": 50.0}, 150.0)
    native, by_jax = (refine_mesh(replace(problem, engine=each), 0, problem.initial_theta) for each in ("auto", "jax"))
    (stiffness,) = native.stiffness
    assert 2.5 * stiffness.implicit_steps < stiffness.explicit_steps < 6 * stiffness.implicit_steps
    assert by_jax.stiffness == ()


@pytest.mark.parametrize(("samples", "modes"), [(20, ["m"]), (20_000, [])])
def test_rows_between_samples_count(samples, modes):
    """30,000 explicit steps or 500 implicit ones; 20,000 samples need twice as many rows, or as many."""
    times = np.linspace(0.0, 10.0, samples)
    problem = relaxing(1e4, data=sf.Measurements(times, np.cos(times), sigma=0.1))
    assert [each.mode for each in refine_mesh(problem, 0, problem.initial_theta).stiffness] == modes


# By mode


THREE = sf.HybridSystem(
    {
        "cool": lambda t, x, p: jnp.array([-p["k"] * x[0], x[0]]),
        "follow": lambda t, x, p: jnp.array([-p["rate"] * (x[0] - jnp.cos(t)), x[0]]),
        "fade": lambda t, x, p: jnp.array([-2.0 * p["k"] * x[0], x[0]]),
    },
    [1.5, 0.0],
)
"""Three linear modes in x and its integral, of which the second is stiff."""


def three(rate=1e5):
    """The three modes with samples of both states."""
    data = sf.Measurements(np.linspace(0.1, 9.9, 50), np.ones((50, 2)), sigma=1.0)
    run = sf.Experiment(data, ("cool", "follow", "fade"), (3.03, 6.08), 0.0, 10.0)
    return sf.Problem(THREE, run, {"k": sf.Parameter(0.3, lower=0.01), "rate": sf.Parameter(rate, fixed=True)})


def test_only_the_stiff_mode_takes_implicit_steps():
    """The other modes have the cells they need."""
    evaluator = evaluator_of(three())
    (structure,), (mesh,) = evaluator.structures, evaluator.meshes
    assert structure.implicit == (False, True, False)
    alone = evaluator_of(three(rate=1.0)).meshes[0]
    for ends in ((0.0, 2.9), (6.1, 10.0)):  # up to the samples beside the transitions
        cells, expected = (np.sum((m.times > ends[0]) & (m.times <= ends[1])) for m in (mesh, alone))
        assert cells == pytest.approx(expected, rel=0.05)


def relaxations(rates, **settings):
    """A sequence of relaxations with these rates, a second each."""
    modes = {f"m{i}": lambda t, x, p, i=i: -p[f"r{i}"] * (x - jnp.cos(10.0 * t)) for i in range(len(rates))}
    system = sf.HybridSystem(modes, [0.0])
    times = tuple(range(1, len(rates)))
    given = {f"r{i}": rate for i, rate in enumerate(rates)}
    return sf.Problem(system, sf.Experiment(SQUARE, tuple(modes), times, 0.0, float(len(rates))), given, **settings)


@pytest.mark.parametrize(
    ("rates", "stiff"),
    [
        # explicit steps give up in the first one: the last one is met later
        pytest.param((1e6, 3.0, 1e6), ("m0", "m2"), marks=pytest.mark.slow),
        ((1e6, 3000.0, 3.0), ("m0",)),
        pytest.param((3000.0, 1e6, 2e5), ("m1", "m2"), marks=pytest.mark.slow),
    ],
)
def test_each_mode_is_judged_by_itself(rates, stiff):
    problem = relaxations(rates)
    evaluator = evaluator_of(problem)
    assert evaluator.structures[0].list_implicit_modes() == stiff
    for each in evaluator.stiffness:
        rate = rates[int(each.mode[1:])]
        assert each.explicit_steps == pytest.approx(rate / 3.3, rel=0.1)
        assert 5 * each.implicit_steps < each.explicit_steps
    exact = Evaluator(problem, meshes=[evaluator.meshes[0].divide(4)]).cost(problem.initial_theta)
    assert evaluator.cost(problem.initial_theta) == pytest.approx(exact, rel=1e-7)


@pytest.mark.slow
def test_modes_that_are_stiff_at_one_of_several_thetas():
    """The mesh for both has implicit steps in both modes; that for the first has them in the first mode."""
    problem = relaxations((1e6, 3.0))
    before, after = problem.initial_theta, problem.initial_theta.copy()
    after[2] = 1e5
    mesh = refine_mesh(problem, 0, before)
    assert [each.mode for each in mesh.stiffness] == ["m0"]
    for thetas in ((before, after), (after, before)):
        assert {each.mode for each in refine_mesh(problem, 0, *thetas).stiffness} == {"m0", "m1"}
    found = refine_if_unstable(runs_of(problem)[0], mesh, before, after)
    assert {each.mode for each in found.stiffness} == {"m0", "m1"}
    assert refine_if_unstable(runs_of(problem)[0], found, before, after) is None


@pytest.mark.parametrize("rate", [60.0, 200.0])
def test_steps_at_the_limit_of_stability_are_as_dense_as_the_solvers(rate):
    """A few hundred steps of a lag and a mode without it lie between two samples: with half as many, J was 1e88."""

    def lag(t, x, p):
        return jnp.stack([rate * (1.0 + 0.2 * x[1] - x[0]), x[0] - 0.3 * x[1]])

    def slow(t, x, p):
        return jnp.stack([-p["k"] * x[0], x[0] - 0.3 * x[1]])

    system = sf.HybridSystem({"lag": lag, "slow": slow}, [0.0, 0.0])
    data = sf.Measurements([4.0, 8.0, 12.0], [3.0, 2.0, 1.0], observe=lambda t, x, p: x[1], sigma=0.1)
    run = sf.Experiment(data, ("lag", "slow"), (5.9,), 0.0, 12.0)
    explicit, implicit = (sf.Problem(system, run, {"k": 0.5}, solver=solver) for solver in ("auto", "stiff"))
    found, expected = sf.evaluate(explicit), sf.evaluate(implicit)
    assert not found.stiffness
    assert found.cost == pytest.approx(expected.cost, rel=1e-6)
    np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-5)


# Where the choice goes


def test_the_choice_is_said():
    problem = relaxing()
    (found,), engine = sf.evaluate(problem).stiffness, evaluator_of(problem).engine
    assert found.explicit_steps > 200_000 > 1000 > found.implicit_steps
    assert found.stability == pytest.approx(3.2, abs=0.4)
    assert str(found).startswith("mode 'm' is stiff: it takes 3")
    assert "explicit steps (limited by stability: |lambda| h is about 3." in str(found)
    assert str(found).endswith("implicit ones were chosen for this mode")
    assert str(engine) == "Evaluated in machine code, with implicit steps in 'm'."
    assert "implicit steps; mode 'm' is stiff" in write_steps(evaluator_of(problem))
    assert "explicit steps" in write_steps(evaluator_of(relaxing(1.0)))


def fitted_to(rate, guess, times, sigma=1e-3, **settings):
    """Relaxation measured without noise."""
    A, B = rate**2 / (1 + rate**2), rate / (1 + rate**2)
    values = A * np.cos(times) + B * np.sin(times) - A * np.exp(-rate * times)
    data = sf.Measurements(times, values, sigma=sigma)
    return one_mode(relax, [0.0], {"rate": guess}, 9.5, data=data, **settings)


EARLY = np.append(np.geomspace(1e-6, 1e-2, 15), [1.0, 3.0, 9.5])


@pytest.mark.parametrize("sigma", [pytest.param(1e-2, marks=pytest.mark.slow), 1e-4])
def test_a_mode_that_becomes_stiff_during_the_fit(sigma):
    """At the guess 1,600 explicit steps do, which are unstable above a rate of 550: meshes that follow have more."""
    insisted = sf.estimate(fitted_to(1e5, 100.0, EARLY, sigma, solver="explicit"), strategy="local")
    assert insisted.theta[0] == pytest.approx(1e5, rel=1e-6)
    assert insisted.evaluator_at_solution().meshes[0].cells > 100_000
    problem = fitted_to(1e5, 100.0, EARLY, sigma)
    assert evaluator_of(problem).stiffness == ()
    fit = sf.estimate(problem, strategy="local")
    assert fit.theta[0] == pytest.approx(1e5, rel=1e-6)
    assert str(fit.engine) == "Evaluated in machine code, with implicit steps in 'm'."
    assert fit.integration_error < 1e-8


@pytest.mark.parametrize(
    ("guess", "there", "solver"), [(2.0, 3.0, "auto"), (100.0, 1e5, "explicit"), (100.0, 1e5, "stiff")]
)
def test_steps_stay_where_they_are_stable_or_insisted_on(guess, there, solver):
    problem = fitted_to(there, guess, EARLY, solver=solver)
    mesh = refine_mesh(problem, 0, problem.initial_theta)
    assert refine_if_unstable(runs_of(problem)[0], mesh, problem.initial_theta, np.array([there])) is None


def test_each_experiment_has_steps_of_its_own():
    times = np.linspace(0.5, 9.5, 10)
    data = sf.Measurements(times, np.cos(times), sigma=0.1)
    system = sf.HybridSystem({"fast": relax, "slow": lambda t, x, p: -p["rate"] * 1e-6 * x}, [0.0])
    runs = [sf.Experiment(data, (mode,), (), 0.0, 10.0, name=mode) for mode in ("fast", "slow")]
    evaluator = evaluator_of(sf.Problem(system, runs, {"rate": 1e5}))
    assert [each.engine.implicit_modes for each in evaluator.engines] == [("fast",), ()]
    assert str(evaluator.engine) == "Evaluated in machine code, with implicit steps in 'fast'."


@pytest.mark.usefixtures("quick_certificates")
def test_a_problem_travels_and_its_fit_is_saved(tmp_path):
    problem = fitted_to(1e4, 2e4, np.append(np.geomspace(1e-5, 1e-3, 15), [1.0, 3.0, 9.5]))
    fit = sf.estimate(problem, strategy="local")
    fit.save(tmp_path / "fit.json")
    loaded = sf.Estimate.load(tmp_path / "fit.json", problem=problem)
    assert loaded.engine == fit.engine
    assert loaded.engine.implicit_modes == ("m",)
    assert loaded.evaluator_at_solution().stiffness
    mesh = evaluator_of(problem).meshes[0]
    assert pickle.loads(pickle.dumps(mesh)).stiffness == mesh.stiffness
