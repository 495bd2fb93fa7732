"""Implicit rows in machine code: JAX's results, Newton's method, elimination, errors of rows, adaptive steps."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.derivatives import differentiate
from support.models import decay, first_state, one_run
from support.stiff_modes import one_mode, robertson, van_der_pol
from support.systems import P0, case
from switchfit.discretization.row_errors import measure_jump
from switchfit.discretization.tableaus import STIFF, STIFF_BEND
from switchfit.engine.adaptive import integrator, step_times
from switchfit.engine.choice import derivatives_inside_program
from switchfit.engine.native import elimination, kernels
from switchfit.engine.native.library_places import places_in_library
from switchfit.engine.native.llvm import compilation
from switchfit.engine.native.llvm import module as module_module
from switchfit.engine.native.native_experiment import native_experiment
from switchfit.engine.native.program_cache import drop_programs
from switchfit.engine.native.scalars.graph import Graph
from switchfit.engine.native.sizes import Order
from switchfit.engine.run import runs_of
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.follower import Follower
from switchfit.meshes.refinement import refine_mesh
from switchfit.problem.functions import use_float64

G, SLOW = 9.81, 1e-6
TIMES, KNOTS = np.linspace(0.1, 3.0, 30), np.linspace(0.0, 3.0, 9)


def friction(v, p):
    return p["mu"] * G * v / jnp.sqrt(v**2 + SLOW**2)


def block(**settings):
    """A block is pushed, slides, and comes to rest after half a second."""
    modes = {
        "push": lambda t, x, p: jnp.stack([x[1], p["a"] - friction(x[1], p)]),
        "slide": lambda t, x, p: jnp.stack([x[1], -friction(x[1], p)]),
    }
    run = sf.Experiment(sf.Measurements(TIMES, np.cos(TIMES), first_state, 1.0), ("push", "slide"), (0.47,), 0.0, 3.0)
    return sf.Problem(sf.HybridSystem(modes, [0.0, SLOW]), run, {"mu": 0.3, "a": 6.0}, solver="stiff", **settings)


def everything(**settings):
    """One mode of two is stiff: inputs, all kinds of data, a reset, a guard, a delay, an unknown initial state."""
    system = sf.HybridSystem(
        {
            "cool": lambda t, x, p, u: jnp.array([-p["k"] * x[0] + u, x[0] * x[1]]),
            "follow": lambda t, x, p, u: jnp.array([-p["rate"] * (x[0] - jnp.cos(t)) - u, x[0] - p["k"] * x[1]]),
        },
        [1.5, sf.Parameter(0.1)],
        {("follow", "cool"): lambda t, x, p: jnp.array([x[0] + p["k"] * t, x[1] ** 2])},
        guards={("cool", "follow"): lambda t, x, p: x[0] - 0.6 * p["k"]},
    )
    data = [
        sf.Measurements(TIMES[1:25], np.cos(TIMES[1:25]), lambda t, x, p: x[:1] * x[1], sigma=0.1, delay="late"),
        sf.ReferenceSignal.from_samples(KNOTS, np.sin(KNOTS), observe=lambda t, x, p: x[1:] * p["k"], weights=[1.3]),
        sf.RunningCost(lambda t, x, p: x[0] ** 2 * x[1] * p["k"] + t * x[1]),
        sf.TransitionCost(lambda t, x, p: p["k"] * x[0] ** 2 * x[1] + (t - 1.2) ** 2 * x[1]),
        sf.TerminalCost(lambda x, p: x[1] ** 2 * p["k"]),
    ]
    inputs = sf.Input([0.0, 1.4, 3.0], [0.1, 0.3, 0.2], kind="linear")
    given = {"k": 0.3, "rate": 1e5, "late": sf.Parameter(0.0513, lower=0.0, upper=0.08)}
    return one_run(system, data, ("cool", "follow", "cool"), (1.03, 2.08), 3.0, given, inputs=inputs, **settings)


PROBLEMS = {
    "van der Pol": lambda **more: one_mode(van_der_pol, [2.0, 0.0], {"mu": 1000.0}, 300.0, **more),
    "Robertson": lambda **more: one_mode(robertson, [1.0, 0.0, 0.0], {"a": 0.04, "b": 1e4, "c": 3e7}, 40.0, **more),
    "block": block,
    "everything": everything,
}


@cache
def both(name):
    """The evaluators of machine code and of JAX on one mesh."""
    native = Evaluator(PROBLEMS[name](engine="native"))
    return native, Evaluator(PROBLEMS[name](engine="jax"), meshes=native.meshes)


def assert_close(found, expected, relative):
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * np.abs(expected).max())


# JAX's results


@pytest.mark.parametrize(
    ("name", "matrix"),
    [("Robertson", "exact"), ("everything", "exact"), ("everything", "gauss-newton"), ("everything", "none")],
)
def test_derivatives_are_those_of_jax(name, matrix):
    native, by_jax = both(name)
    assert any(native.structures[0].implicit)
    theta = native.problem.initial_theta
    found, expected = native(theta, matrix=matrix), by_jax(theta, matrix=matrix)
    assert found.cost == pytest.approx(expected.cost, rel=1e-12)
    assert native.cost(theta) == pytest.approx(found.cost, rel=1e-13)
    assert_close(found.gradient, expected.gradient, 1e-12)
    if matrix != "none":
        assert_close(found.hessian, expected.hessian, 1e-11)


AT = np.array([0.6187, 1.2812]), P0
"""Transition times and parameters of `case("mixed")`: a mode that depends on time takes implicit steps beside explicit
ones; a reset map and an initial state depend on parameters.
"""


def assert_same(found, expected):
    """J, gradient and Hessian."""
    J, g, H = map(np.asarray, found)
    assert pytest.approx(expected.cost, rel=1e-12) == J
    assert_close(g, expected.gradient, 1e-11)
    assert_close(H, expected.hessian, 1e-9)


def test_stages_one_at_a_time(monkeypatch):
    """As where functions would become too long."""
    monkeypatch.setattr(kernels, "MOST_CURVATURE_AT_ONCE", 0)
    drop_programs()
    this = case("mixed")
    arguments = this.arguments()
    native = native_experiment(this.structure, arguments, np.unique(np.asarray(arguments.nodes)), Order.HESSIAN)
    found = native(*AT, 1)
    assert_same((found.cost, found.gradient, found.hessian), this.discrete(arguments, *AT))
    drop_programs()


def last_of_chain(n, times, q):
    """The last of n states at times (K,), ``x_i' = k (x_{i-1} - 2 x_i + x_{i+1}) + c`` between walls at 0, from 1."""
    rates, V = np.linalg.eigh(2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    gone = jnp.exp(-q[0] * jnp.outer(times, rates))
    return (gone + q[1] / q[0] * (1 - gone) / rates[None]) @ (V.T @ np.ones(n) * V[-1])


@pytest.mark.parametrize("n", [12, pytest.param(40, marks=pytest.mark.slow)])
def test_many_states_have_the_derivatives_of_their_closed_form(n):
    """The heat equation by lines."""

    def conduct(t, x, p):
        return p["k"] * (jnp.append(x[1:], 0.0) - 2.0 * x + jnp.append(0.0, x[:-1])) + p["c"]

    times = np.linspace(0.05, 1.0, 8)
    data = sf.Measurements(times, np.zeros((8, 1)), lambda t, x, p: x[-1:], sigma=1.0)
    given = {"k": float(n**2), "c": 0.7}
    problem = one_mode(conduct, np.ones(n), given, 1.0, data, engine="native", rtol=1e-10, atol=1e-12)
    found = Evaluator(problem)(problem.initial_theta)
    x, first, second = differentiate(lambda q: last_of_chain(n, times, q), problem.initial_theta)
    assert found.cost == pytest.approx(0.5 * x @ x, rel=1e-8)
    assert_close(found.gradient, x @ first, 1e-7)
    assert_close(found.hessian, first.T @ first + np.einsum("k,kij->ij", x, second), 1e-6)


def test_inside_a_program_of_jax():
    """The operation that batches use: alone, in a loop, and for several at once, on a padded mesh."""
    this = case("mixed")
    arguments, taus = this.arguments(), AT[0] + np.array([[0.0], [0.01]])
    places = places_in_library(this.structure)

    def evaluate(tau):
        return derivatives_inside_program(this.structure, arguments, tau, P0, 1, places)

    with use_float64():
        alone = [jax.jit(evaluate)(tau) for tau in taus]
        loop, at_once = jax.jit(lambda taus: (jax.lax.map(evaluate, taus), jax.vmap(evaluate)(taus)))(taus)
    for k, tau in enumerate(taus):
        expected = this.discrete(arguments, tau, P0)
        for found in (alone[k], *([part[k] for part in each] for each in (loop, at_once))):
            assert_same(found, expected)


def test_constraints_costates_and_simulations_are_those_of_jax():
    native, by_jax = both("everything")
    theta = native.problem.initial_theta
    one, other = (each.constrained(theta, 1, np.array([0.7])) for each in (native, by_jax))
    for name in ("cost", "gradient", "hessian", "constraints", "jacobian"):
        assert_close(getattr(one, name), getattr(other, name), 1e-10)
    tau, p = native.problem.vectors(theta, 0)
    one, other = (each.engines[0].costates(tau, p, np.array([0.7])) for each in (native, by_jax))
    assert_close(one.costates, other.costates, 1e-11)
    one, other = (each.engines[0].simulate(tau, p, tangents=True) for each in (native, by_jax))
    for name in ("before", "after", "y_before", "y_after"):
        assert_close(getattr(one, name), getattr(other, name), 1e-12)
        assert_close(getattr(one.tangents, name), getattr(other.tangents, name), 1e-11)
    assert_close(one.seen[0], other.seen[0], 1e-12)


@pytest.mark.parametrize("away", [0.0, 1e-14, 1e-9])
def test_rows_of_hardly_any_length(away):
    """The slopes of such a row are f at its stages: increments over the length have no digits left."""
    native, by_jax = both("everything")
    theta = native.problem.initial_theta.copy()
    nodes = native.meshes[0].times
    theta[0] = nodes[np.argmin(np.abs(nodes - 1.0))] + away
    found, expected = native(theta), by_jax(theta)
    assert_close(found.gradient, expected.gradient, 1e-11)
    assert_close(found.hessian, expected.hessian, 1e-9)


@pytest.mark.parametrize("name", ["van der Pol", "block", "everything"])
def test_derivatives_are_those_of_differences(name):
    """The steps of the differences are short beside the layers of the stiff modes."""
    native, theta = both(name)[0], both(name)[0].problem.initial_theta
    found = native(theta)
    for k, unit in enumerate(np.eye(len(theta))):
        step = 3e-8 * max(abs(theta[k]), 0.1)
        before, after = native(theta - step * unit), native(theta + step * unit)
        slope, bend = ((getattr(after, name) - getattr(before, name)) / (2 * step) for name in ("cost", "gradient"))
        assert slope == pytest.approx(found.gradient[k], rel=2e-5, abs=1e-7 * np.abs(found.gradient).max())
        assert_close(bend, found.hessian[k], 1e-3)


def test_the_engine_names_the_modes():
    native, by_jax = both("everything")
    assert native.engine.implicit_modes == by_jax.engine.implicit_modes == ("follow",)
    assert str(native.engine) == "Evaluated in machine code, with implicit steps in 'follow'."
    assert "engine='jax' is set; mode 'follow' is stiff: it takes" in by_jax.engine.reason


def test_a_routine_for_the_linear_systems(monkeypatch):
    """It takes the place of straight-line code in large and dense systems: here in all rows, and adaptive steps."""
    native, by_jax = both("everything")
    theta = native.problem.initial_theta
    monkeypatch.setattr(elimination, "MOST_PRODUCTS", 0)
    drop_programs()
    assert refine_mesh(native.problem, 0, theta).cells == native.meshes[0].cells
    found, expected = Evaluator(native.problem, meshes=native.meshes)(theta), by_jax(theta)
    assert found.cost == pytest.approx(expected.cost, rel=1e-12)
    assert (found.hessian != native(theta).hessian).any()
    assert_close(found.gradient, expected.gradient, 1e-12)
    assert_close(found.hessian, expected.hessian, 1e-11)
    drop_programs()


# Newton's method


def test_a_row_that_does_not_converge_has_no_cost():
    """A block of 3 m/s that friction stops within one long row: Newton's method jumps from one side to the other."""
    problem = block(engine="native")
    coarse = Evaluator(problem, meshes=[refine_mesh(problem, 0, problem.initial_theta)])
    theta = coarse.problem.check_theta([0.9, 0.6, 9.0])
    found = coarse(theta)
    assert np.isnan([found.cost, coarse.cost(theta)]).all()
    fine = Evaluator(problem, theta)
    assert Follower(coarse)(theta).cost == pytest.approx(fine(theta).cost, rel=1e-12)


def test_meshes_that_follow_keep_the_methods_of_their_modes():
    """To decide anew takes thousands of explicit steps, and another decision another program."""
    problem = replace(block(), solver="auto")
    follower = Follower(Evaluator(problem))
    stiffness = follower.evaluator.stiffness
    assert [each.mode for each in stiffness] == ["slide"]
    theta = problem.check_theta([0.9, 0.6, 9.0])
    follower.accept(theta, follower(theta).cost)
    assert follower.evaluator.stiffness == stiffness


def test_a_late_sample_in_a_row_that_does_not_converge_has_no_cost():
    problem = block(engine="native")
    run = problem.experiments[0]
    late = replace(run.data[0], times=np.array([2.0]), values=np.array([[0.3]]), delay="late")
    parameters = problem.parameters | {"late": sf.Parameter(0.01, 0.0, 0.5)}
    coarse = Evaluator(replace(problem, experiments=[replace(run, data=late)], parameters=parameters))
    assert np.isfinite(coarse(coarse.problem.initial_theta).cost)
    assert np.isnan(coarse(coarse.problem.check_theta([0.9, 0.6, 9.0, 0.01])).cost)


def test_states_of_rounding_errors_and_zeros_converge():
    """A body at rest on a spring under a load: its velocity is the rest of forces that cancel, 1e-17 and less."""

    def hang(t, x, p):
        return jnp.stack([x[1], 1e6 * (p["load"] - 3.0 * x[0]) - 1e5 * x[1]])

    evaluator = Evaluator(one_mode(hang, [0.1 / 3.0 + 1e-3, 0.0], {"load": 0.1}, 100.0, engine="native"))
    theta = evaluator.problem.initial_theta
    assert np.abs(evaluator.simulate(theta)[0].after[-1, 1]) < 1e-12
    assert np.isfinite(evaluator(theta).cost)
    zero = Evaluator(one_mode(decay, [0.0, 1.0], {"k": 1e3}, 1.0, engine="native"))
    assert zero(zero.problem.initial_theta).cost == 0.0


# Elimination


def make_jacobian(rng, n, kind):
    """A random Jacobian times a step, with sizes up to 1e9.

    That of a network is sparse: a chain of states, two of which are coupled to a third one.
    """
    if kind == "any":
        return rng.normal(size=(n, n)) * 10.0 ** rng.uniform(0, 9)
    if kind == "network":
        J = np.zeros((n, n))
        for i, j in [*pairwise(range(n)), (0, n // 2), (n - 1, n // 2)]:
            J[np.ix_([i, j], [i, j])] += 10.0 ** rng.uniform(-2, 9) * np.array([[-1.0, 1.0], [1.0, -1.0]])
        return J
    sizes, Q = 10.0 ** rng.uniform(-2, 9, n), np.linalg.qr(rng.normal(size=(n, n)))[0]
    unstable = (kind == "unstable") & (rng.random(n) < 0.3)
    return Q @ np.diag(np.where(unstable, np.minimum(sizes, 3.0), -sizes)) @ Q.T


def compile_solve(filled, kind):
    """Return a function that solves the coupled equations for Jacobians (3, n, n) with these entries."""
    n = len(filled)
    module, graph = module_module.Module(6), Graph()
    f_x = [graph.loads("f_x", n * n, n * n * j).reshape(n, n) * filled for j in range(3)]
    right = [graph.loads("right", n, n * j, vector=kind == "vectors") for j in range(3)]
    factors = elimination.eliminate(STIFF.a, graph.constant(1.0), f_x)
    x = np.concatenate(factors.solve(right, transposed=kind == "transposed"))
    module.write_straight_line("run", [("x", k, node) for k, node in enumerate(x)])
    program = compilation.compile_modules([module.take()])
    run = program.function("run", 3)

    def solve(f_x, right):
        assert program.key  # its code is freed with it
        x = np.empty_like(right)
        run(f_x.ctypes.data, right.ctypes.data, x.ctypes.data)
        return x

    return solve


def measure_backward_errors(solve, jacobians, kind, rng):
    """Return the largest backward error of a solution, and of LAPACK's."""
    worst = [0.0, 0.0]
    for J in jacobians:
        n = len(J)
        f_x = np.stack([J * (1 + 0.01 * rng.normal()) for _ in range(3)])
        A = np.block([[np.eye(n) * (i == j) - STIFF.a[i, j] * f_x[i] for j in range(3)] for i in range(3)])
        b, M = rng.normal(size=(n * 3, 6) if kind == "vectors" else n * 3), A.T if kind == "transposed" else A
        for k, x in enumerate((solve(f_x, b), np.linalg.solve(M, b))):
            size = np.abs(M).max() * np.abs(x).max() + np.abs(b).max()
            worst[k] = max(worst[k], np.abs(M @ x - b).max() / size)
    return worst


WAYS = "plain", "transposed", "vectors"


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("kind", "n", "limit"), [("stable", 3, 5e-15), ("unstable", 3, 5e-15), ("any", 3, 1e-11), ("network", 20, 5e-15)]
)
def test_elimination_needs_no_pivots(kind, n, limit, way):
    """The backward error is hardly larger than that of LAPACK, which chooses pivots; `any` grows by 1e9 in a step.

    The states of a network are taken in another order.
    """
    rng = np.random.default_rng(2)
    jacobians = [make_jacobian(rng, n, kind) for _ in range(3000 // n)]
    solve = compile_solve(np.any(jacobians, axis=0) if kind == "network" else np.ones((n, n)), way)
    worst, of_lapack = measure_backward_errors(solve, jacobians, way, rng)
    assert of_lapack < 1e-15
    assert worst < limit


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("n", [3, 9, 40])
def test_a_routine_eliminates_with_pivots(n, way, monkeypatch):
    monkeypatch.setattr(elimination, "MOST_PRODUCTS", 0)
    rng = np.random.default_rng(4)
    solve = compile_solve(np.ones((n, n)), way)
    jacobians = (make_jacobian(rng, n, kind) for kind in ("stable", "unstable", "any") for _ in range(1000 // n))
    worst, of_lapack = measure_backward_errors(solve, jacobians, way, rng)
    assert worst < max(3.0 * of_lapack, 1e-15)


def test_the_order_of_elimination_keeps_an_arrow_sparse():
    """The first state is coupled to all others, which know only it: in another order all entries arise."""
    n = 30
    arrow = np.eye(n, dtype=bool)
    arrow[0] = arrow[:, 0] = True
    order, products = elimination.order_states(arrow)
    assert order[-2:] == [0, n - 1]
    assert products == 4 * (n - 1) + 1


# Errors of rows and adaptive steps


def test_the_errors_of_rows_are_those_of_hairer_and_wanner():
    """SciPy's constants, with stages computed anew in NumPy."""
    from scipy.integrate._ivp.radau import MU_REAL, E

    native, _ = both("block")
    theta = native.problem.initial_theta
    rows, (tau, mu, a) = native.simulate(theta)[0], theta
    largest = np.zeros(2)
    for start, end, x in zip(rows.start, rows.end, rows.before, strict=True):
        h, push = end - start, a if end <= tau else 0.0

        def field(X, push=push):
            return np.array([X[1], push - mu * G * X[1] / np.sqrt(X[1] ** 2 + SLOW**2)])

        def slopes(X):
            return np.array([[0.0, 1.0], [0.0, -mu * G * SLOW**2 / (X[1] ** 2 + SLOW**2) ** 1.5]])

        Z = np.zeros((3, 2))
        for _ in range(20):
            residual = Z - h * STIFF.a @ np.stack([field(x + z) for z in Z])
            matrix = np.eye(6) - h * np.hstack([np.kron(STIFF.a[:, [j]], slopes(x + Z[j])) for j in range(3)])
            Z = Z - np.linalg.solve(matrix, residual.ravel()).reshape(3, 2)
        error = np.linalg.solve(MU_REAL / h * np.eye(2) - slopes(x), field(x) + Z.T @ E / h)
        k = h * np.stack([field(x + z) for z in Z])
        smooth = 0.5 * h * (slopes(x + Z[0]) + slopes(x + Z[2])) @ (Z[2] - Z[0])
        jumps = kernels.JUMP_WEIGHT * measure_jump(*k, STIFF_BEND @ k, smooth, np)
        largest = np.maximum(largest, np.maximum(np.abs(error), jumps))
    found = native.judge_rows()(theta).row_errors[0]
    errors = native.engines[0].at(Order.HESSIAN)._named["errors"]
    # They are made of differences of states, which are of size 1 and have rounding errors.
    np.testing.assert_allclose(errors, largest, rtol=1e-6, atol=1e-15)
    assert found >= errors.max() / 4.0  # no state is larger than 4


@pytest.mark.parametrize("name", ["van der Pol", "Robertson", "block"])
def test_adaptive_steps_are_about_as_many_as_those_of_scipy(name, monkeypatch):
    problem = PROBLEMS[name](engine="native")
    (run,), theta = runs_of(problem), problem.initial_theta
    own = len(step_times.solve_adaptively(run, theta))
    monkeypatch.setattr(integrator, "native_experiment", lambda *_, **__: None)
    assert own / 1.2 < len(step_times.solve_adaptively(run, theta)) < 1.5 * own
