"""solver="auto": explicit steps, and implicit ones in the modes where explicit ones are hopeless."""

import logging
import pickle
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import switchfit as sf
from switchfit.engine.adaptive import refine_if_unstable, refine_mesh
from switchfit.engine.stiffness import Watch
from switchfit.fit.evaluator import Evaluator, evaluator_of
from switchfit.io.problem_file import load_problem
from switchfit.io.summary import describe_steps
from switchfit.models import magic_formula
from switchfit.models.magic_formula import MAGIC_FORMULA

SQUARE = sf.RunningCost(lambda t, x, p: x[0] ** 2)


def relax(t, x, p):
    """A fast linear mode that follows cos t."""
    return -p["rate"] * (x - jnp.cos(t))


def van_der_pol(t, x, p):
    return jnp.array([x[1], p["mu"] * (1.0 - x[0] ** 2) * x[1] - x[0]])


def robertson(t, x, p):
    first, second, third = p["a"] * x[0], p["c"] * x[1] ** 2, p["b"] * x[1] * x[2]
    return jnp.array([third - first, first - third - second, second])


def oscillate(t, x, p):
    return jnp.array([x[1], -(p["omega"] ** 2) * x[0]])


def one_mode(mode, start, parameters, tf, data=SQUARE, **settings):
    system = sf.HybridSystem({"m": mode}, start)
    return sf.Problem(system, sf.Experiment(data, ("m",), (), 0.0, tf), parameters, **settings)


def relaxing(rate=1e5, **settings):
    return one_mode(relax, [0.0], {"rate": rate}, 10.0, **settings)


def relaxation_cost(rate, tf=10.0):
    """Return the integral of x**2 for x = A cos t + B sin t - A exp(-rate t)."""
    A, B = rate**2 / (1 + rate**2), rate / (1 + rate**2)
    s, c = np.sin(tf), np.cos(tf)
    of_waves = A**2 * (tf + s * c) / 2 + B**2 * (tf - s * c) / 2 + A * B * s**2
    # exp(-rate t) at tf is zero for a fast mode: the integrals of exp cos and exp sin up to infinity
    return of_waves - 2 * A * (A * rate + B) / (1 + rate**2) + A**2 / (2 * rate)


# What is taken for stiff


def test_a_fast_linear_mode_has_the_cost_and_gradient_of_its_closed_form():
    rate = 1e5
    problem = relaxing(rate)
    found = sf.evaluate(problem)
    assert found.cost == pytest.approx(relaxation_cost(rate), rel=1e-9)
    h = 1e-3 * rate
    slope = (relaxation_cost(rate + h) - relaxation_cost(rate - h)) / (2 * h)
    assert found.gradient[0] == pytest.approx(slope, rel=1e-4)
    (stiffness,) = found.stiffness
    assert stiffness.mode == "m"
    assert stiffness.explicit_steps > 200_000
    assert stiffness.implicit_steps < 1000
    assert stiffness.stability == pytest.approx(3.2, abs=0.4)


@pytest.mark.parametrize(
    "build",
    [
        lambda **settings: one_mode(van_der_pol, [2.0, 0.0], {"mu": 1000.0}, 300.0, **settings),
        lambda **settings: one_mode(robertson, [1.0, 0.0, 0.0], {"a": 0.04, "b": 1e4, "c": 3e7}, 40.0, **settings),
        relaxing,
    ],
    ids=["van der Pol", "Robertson", "linear"],
)
def test_the_mesh_is_that_of_the_stiff_solver(build):
    problem, stiff = build(), build(solver="stiff")
    mesh, given = (refine_mesh(p, 0, p.initial_theta) for p in (problem, stiff))
    np.testing.assert_array_equal(mesh.nodes, given.nodes)
    assert [each.mode for each in mesh.stiffness] == ["m"]
    assert given.stiffness == ()
    assert evaluator_of(problem).cost(problem.initial_theta) == evaluator_of(stiff).cost(stiff.initial_theta)


def test_robertsons_problem_agrees_with_scipy():
    """Explicit steps at the limit of stability are wrong by 1e-3 on their own mesh."""
    problem = one_mode(robertson, [1.0, 0.0, 0.0], {"a": 0.04, "b": 1e4, "c": 3e7}, 40.0)

    def slope(t, y):
        return [*np.asarray(robertson(t, y[:3], {"a": 0.04, "b": 1e4, "c": 3e7})), y[0] ** 2]

    y = scipy.integrate.solve_ivp(slope, (0.0, 40.0), [1.0, 0, 0, 0], method="Radau", rtol=1e-9, atol=1e-12).y[:, -1]
    cost = evaluator_of(problem).cost(problem.initial_theta)
    assert cost == pytest.approx(y[3], rel=1e-7)
    explicit = replace(problem, solver="explicit")
    assert abs(evaluator_of(explicit).cost(problem.initial_theta) / y[3] - 1) > 1e-4


def test_explicit_steps_that_make_the_cost_nan_at_the_guess_are_not_taken():
    problem = one_mode(van_der_pol, [2.0, 0.0], {"mu": 100.0}, 300.0)
    explicit = replace(problem, solver="explicit")
    with np.errstate(all="ignore"):
        assert np.isnan(evaluator_of(explicit).cost(problem.initial_theta))
    assert np.isfinite(evaluator_of(problem).cost(problem.initial_theta))


# What is not


@pytest.mark.parametrize("rtol", [1e-8, 1e-3])
def test_a_fast_oscillation_is_not_stiff(rtol):
    """It takes 36,000 explicit steps at the first tolerance, because accuracy asks for them."""
    problem = one_mode(oscillate, [1.0, 0.0], {"omega": 300.0}, 10.0 if rtol == 1e-8 else 100.0, rtol=rtol)
    explicit = replace(problem, solver="explicit")
    meshes = [refine_mesh(p, 0, p.initial_theta) for p in (problem, explicit)]
    np.testing.assert_array_equal(meshes[0].nodes, meshes[1].nodes)
    assert meshes[0].cells > 3000
    assert meshes[0].stiffness == ()


def test_a_fast_mode_that_grows_is_not_stiff():
    def grow(t, x, p):
        return p["rate"] * (x - jnp.cos(100.0 * t))

    problem = one_mode(grow, [0.0], {"rate": 1.0}, 10.0)
    mesh = refine_mesh(problem, 0, problem.initial_theta)
    assert mesh.cells > 1000
    assert mesh.stiffness == ()


@pytest.mark.parametrize("rate", [1.0, 30.0, 300.0, 1000.0])
def test_a_mode_that_takes_few_explicit_steps_keeps_them_to_the_bit(rate):
    problem, explicit = relaxing(rate), relaxing(rate, solver="explicit")
    meshes = [refine_mesh(p, 0, p.initial_theta) for p in (problem, explicit)]
    np.testing.assert_array_equal(meshes[0].nodes, meshes[1].nodes)
    one, other = sf.evaluate(problem), sf.evaluate(explicit)
    assert (one.cost, one.gradient[0], one.hessian[0, 0]) == (other.cost, other.gradient[0], other.hessian[0, 0])
    assert one.stiffness == ()
    assert evaluator_of(problem).engine.name == "native"


def test_who_insists_on_explicit_steps_gets_them():
    with pytest.raises(ValueError, match=r"needs more than 200000 steps.*use solver='stiff'"):
        sf.evaluate(relaxing(solver="explicit"))
    slower = relaxing(1e4, solver="explicit")
    assert refine_mesh(slower, 0, slower.initial_theta).cells > 30_000


def test_what_neither_can_integrate_is_refused():
    """An oscillation that needs millions of steps of either kind."""
    with pytest.raises(ValueError, match=r"mode 'm' cannot be integrated.*more than 200000 steps.*use a better guess"):
        sf.evaluate(one_mode(oscillate, [1.0, 0.0], {"omega": 1e5}, 10.0))


def test_the_look_at_eigenvalues_survives_a_model_that_is_undefined_beside_the_trajectory():
    watch = Watch()
    watch.enter("m")

    def slope(t, y):
        return np.array([np.nan, 0.0]) if y[0] > 1.0 else np.array([-1e6, 0.0])

    watch.look(1e-3, slope, 0.0, np.array([1.0, 0.0]), 1e-2)
    assert watch.modes["m"].rates == [0.0]


def test_eigenvalues_are_those_of_the_vector_field():
    """Complex ones by their size, growing ones not at all, whatever the size of the states."""
    A = np.array([[-3.0, 400.0, 0.0], [-400.0, -3.0, 0.0], [0.0, 0.0, 5000.0]])
    for size in (1e-6, 1.0, 1e6):
        watch = Watch()
        watch.enter("m")
        y = size * np.array([1.0, -2.0, 0.5, 0.0])
        watch.look(0.01, lambda t, y: np.append(A @ y[:3], 0.0), 0.0, y, 1e-2 * size)
        (rate,) = watch.modes["m"].rates
        assert rate == pytest.approx(np.hypot(3.0, 400.0), rel=1e-5)
        assert watch.modes["m"].limited == [0.01 * rate]


def test_the_magic_formula_without_a_solver():
    """Its tyres are stiff at low speeds, where explicit steps are wrong by 7e-5 on their own mesh."""
    wheels = sf.Input([0.0, 1.0, 2.0, 4.0], np.array([[0.0] * 4, [2.0] * 4, [3.0, 1, 1, 3], [0.0] * 4]), kind="linear")
    run = sf.Experiment(SQUARE, ("drive",), (), 0.0, 4.0, inputs=wheels)
    problem = sf.Problem(magic_formula(wheel_radius=0.1), run, dict(MAGIC_FORMULA))
    mesh, explicit, stiff = (
        refine_mesh(replace(problem, solver=solver), 0, problem.initial_theta)
        for solver in ("auto", "explicit", "stiff")
    )
    assert [each.mode for each in mesh.stiffness] == ["drive"]
    np.testing.assert_array_equal(mesh.nodes, stiff.nodes)
    insisted = Evaluator(replace(problem, solver="explicit"), meshes=[explicit]).cost(problem.initial_theta)
    exact = Evaluator(problem, meshes=[mesh.divide(4)]).cost(problem.initial_theta)
    assert Evaluator(problem, meshes=[mesh]).cost(problem.initial_theta) == pytest.approx(exact, rel=1e-7)
    assert abs(insisted / exact - 1) > 1e-5


# Where the choice goes


def test_the_choice_is_said(caplog):
    problem = relaxing()
    with caplog.at_level(logging.INFO, logger="switchfit"):
        fit = sf.estimate(problem, strategy="local", max_iterations=1)
    said = "ode 'm' is stiff: it takes 3"
    assert f"M{said}" in caplog.text
    assert "explicit steps (limited by stability: |lambda| h is about 3." in caplog.text
    assert caplog.text.count("implicit ones were chosen for this mode.") == 1
    assert fit.engine.name == "jax"
    assert f"m{said}" in fit.engine.reason
    assert f"m{said}" in " ".join(fit.report(full=True).split())
    assert "implicit steps; mode 'm' is stiff" in describe_steps(problem)
    assert "explicit steps" in describe_steps(relaxing(1.0))
    by_jax = relaxing(engine="jax")
    assert "engine='jax' is set; mode 'm' is stiff" in evaluator_of(by_jax).engine.reason
    with pytest.raises(ValueError, match="engine='native' requires machine code, but mode 'm' is stiff"):
        sf.evaluate(relaxing(engine="native"))


def fitted_to(rate, guess, times, sigma=1e-3, **settings):
    """Relaxation measured without noise."""
    A, B = rate**2 / (1 + rate**2), rate / (1 + rate**2)
    values = A * np.cos(times) + B * np.sin(times) - A * np.exp(-rate * times)
    data = sf.Measurements(times, values, sigma=sigma)
    return one_mode(relax, [0.0], {"rate": guess}, 9.5, data=data, **settings)


EARLY = np.append(np.geomspace(1e-6, 1e-2, 15), [1.0, 3.0, 9.5])


@pytest.mark.parametrize("sigma", [1e-2, 1e-4])
def test_a_mode_that_becomes_stiff_during_the_fit(sigma):
    """At the guess 1,600 explicit steps do, which are unstable above a rate of 550.

    A fit that insists on them stops there, or ends at a minimum that they make.
    """
    insisted = sf.estimate(fitted_to(1e5, 100.0, EARLY, sigma, solver="explicit"), strategy="local")
    assert insisted.verdict.level == "bad"
    assert insisted.theta[0] < 1e4
    problem = fitted_to(1e5, 100.0, EARLY, sigma)
    assert evaluator_of(problem).stiffness == ()
    fit = sf.estimate(problem, strategy="local")
    assert fit.status.successful
    assert fit.theta[0] == pytest.approx(1e5, rel=1e-6)
    assert len(fit.evaluator_at_solution().stiffness) == 1
    assert "is stiff" in str(fit.engine)
    assert fit.integration_error < 1e-8


def test_a_fit_that_fails_where_its_steps_are_stable_keeps_them():
    problem = fitted_to(3.0, 2.0, np.linspace(0.5, 9.5, 10))
    evaluator = evaluator_of(problem)
    assert refine_if_unstable(problem, 0, evaluator.meshes[0], np.array([2.0]), np.array([3.0])) is None
    stopped = sf.estimate(problem, strategy="local", max_iterations=0)
    assert stopped.engine.name == "native"


def test_who_insists_is_not_given_other_steps_where_a_fit_fails():
    for solver in ("explicit", "stiff"):
        problem = fitted_to(1e5, 100.0, EARLY, solver=solver)
        mesh = refine_mesh(problem, 0, problem.initial_theta)
        assert refine_if_unstable(problem, 0, mesh, problem.initial_theta, np.array([1e5])) is None


def test_each_experiment_has_steps_of_its_own():
    times = np.linspace(0.5, 9.5, 10)
    data = sf.Measurements(times, np.cos(times), sigma=0.1)
    system = sf.HybridSystem({"fast": relax, "slow": lambda t, x, p: -p["rate"] * 1e-6 * x}, [0.0])
    runs = [sf.Experiment(data, (mode,), (), 0.0, 10.0, name=mode) for mode in ("fast", "slow")]
    problem = sf.Problem(system, runs, {"rate": 1e5})
    evaluator = evaluator_of(problem)
    assert [structure.implicit for structure in evaluator.structures] == [(True,), (False,)]
    assert [each.engine.name for each in evaluator.engines] == ["jax", "native"]
    assert "(in fast; the other experiments run in machine code)" in evaluator.engine.reason
    alone = [
        sf.Problem(system, run, {"rate": 1e5}, solver=s) for run, s in zip(runs, ("stiff", "explicit"), strict=True)
    ]
    costs = [evaluator_of(each).cost(each.initial_theta) for each in alone]
    assert evaluator.cost(problem.initial_theta) == pytest.approx(sum(costs), rel=1e-12)


def test_everything_beside_the_fit_takes_the_same_steps():
    """Derivatives in all ways, halved meshes, predictions and bands, profiles."""
    problem = fitted_to(1e4, 2e4, np.append(np.geomspace(1e-5, 1e-3, 15), [1.0, 3.0, 9.5]))
    fit = sf.estimate(problem, strategy="local")
    stiff = sf.estimate(replace(problem, solver="stiff"), strategy="local")
    np.testing.assert_allclose(fit.theta, stiff.theta, rtol=1e-9)
    assert fit.evaluator_at_solution().stiffness
    assert sf.check_derivatives(problem).passed
    assert fit.certificate.taylor_orders == pytest.approx(stiff.certificate.taylor_orders, rel=0.1)
    at = [2e-4, 2.0]
    np.testing.assert_allclose(fit.predict(at).outputs, stiff.predict(at).outputs, rtol=1e-6)
    np.testing.assert_allclose(fit.standard_errors, stiff.standard_errors, rtol=1e-6)


def test_many_fits():
    fast, slow = (fitted_to(rate, 1.2 * rate, np.linspace(0.01, 9.5, 30) / rate) for rate in (1e5, 3.0))
    fits = sf.estimate_many([fast, slow, fast])
    assert fits.success.all()
    np.testing.assert_allclose(fits.theta[:, 0], [1e5, 3.0, 1e5], rtol=1e-6)


def test_a_problem_travels_and_its_fit_is_saved(tmp_path):
    problem = fitted_to(1e4, 2e4, np.append(np.geomspace(1e-5, 1e-3, 15), [1.0, 3.0, 9.5]))
    assert problem.solver == "auto"
    fit = sf.estimate(problem, strategy="local")
    fit.save(tmp_path / "fit.json")
    loaded = sf.Estimate.load(tmp_path / "fit.json", problem=problem)
    assert loaded.engine == fit.engine
    assert "is stiff" in loaded.engine.reason
    assert loaded.evaluator_at_solution().stiffness
    mesh = evaluator_of(problem).meshes[0]
    assert pickle.loads(pickle.dumps(mesh)).stiffness == mesh.stiffness


@pytest.mark.parametrize("solver", ["auto", "explicit", "stiff", None])
def test_problem_files(tmp_path, solver):
    (tmp_path / "log.csv").write_text("t,x\n0.5,0.6\n1,0.4\n")
    (tmp_path / "m.py").write_text(
        "import switchfit as sf\nmodel = sf.HybridSystem({'m': lambda t, x, p: -p['k'] * x}, [1.0])\n"
    )
    (tmp_path / "p.toml").write_text(
        'model = "m.py:model"\nparameters = { k = 1.0 }\n[[experiments]]\nmode_sequence = ["m"]\n'
        'transition_times = []\ndata = { file = "log.csv", time = "t", columns = ["x"] }\n'
        + ("" if solver is None else f'[options]\nsolver = "{solver}"\n')
    )
    assert load_problem(tmp_path / "p.toml").problem.solver == (solver or "auto")
