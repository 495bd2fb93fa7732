"""J and its derivatives across crossings of corners: closed forms, differences, the order of the steps, all methods."""

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from benchmarks.sharp.corners import integrate
from support.models import one_run
from support.sharp_modes import (
    TIGHT,
    check_derivatives,
    clipped,
    contact,
    crossings_of,
    expect,
    measure_errors,
    problem_of,
    samples,
    spring,
    tank,
)
from switchfit.discretization.mesh import Mesh
from switchfit.meshes.evaluator import Evaluator, evaluator_of


def driven(t, x, p, u):
    return jnp.stack([x[1], u - p["d"] * x[1] - p["mu"] * 9.81 * jnp.sign(x[1])])


def everything(**settings):
    """A crossing in each of two modes, a reset map, an unknown start, an input, and all kinds of data, in two runs."""
    modes = {
        "one": lambda t, x, p, u: jnp.stack([x[1] + u, -p["k"] * x[0] - p["c"] * jnp.sign(x[1]) * x[0] ** 2]),
        "two": lambda t, x, p, u: jnp.stack([x[1], -p["k"] * jnp.where(x[0] > p["w"], x[0], 2.0 * x[0] - p["w"]) + u]),
    }
    reset = {("one", "two"): lambda t, x, p: jnp.stack([x[0] * 1.1, -0.8 * x[1] + p["c"] * t])}
    times, knots = np.linspace(0.0, 3.0, 13)[1:], np.linspace(0.0, 3.0, 4)
    data = [
        sf.Measurements(times, np.cos(times), lambda t, x, p: x[:1] * x[1], sigma=0.5),
        sf.ReferenceSignal.from_samples(knots, np.sin(knots), observe=lambda t, x, p: x[1:] * p["k"], weights=[0.3]),
        sf.RunningCost(lambda t, x, p: 0.2 * x[0] ** 2 * p["k"] + t * x[1]),
        sf.TransitionCost(lambda t, x, p: p["k"] * x[0] ** 2 + (t - 1.2) ** 2 * x[1]),
        sf.TerminalCost(lambda x, p: x[1] ** 2 * p["c"]),
    ]
    inputs = sf.Input([0.0, 1.7, 3.0], [0.1, 0.3, -0.2], kind="linear")
    runs = [
        sf.Experiment(data, ("one", "two"), (1.93,), 0.0, 3.0, inputs=inputs),
        sf.Experiment(data[:1], ("two", "one", "two"), (0.9, 2.1), 0.0, 3.0, inputs=inputs),
    ]
    system = sf.HybridSystem(modes, [sf.Parameter(1.0), 0.2], reset)
    return sf.Problem(system, runs, {"k": 2.3, "c": 0.3, "w": 0.4}, **TIGHT, **settings)


def written_twice(t, x, p):
    """One surface, which is not known to be one."""
    damping = jnp.where(x[0] - p["w"] > 0, p["c"], 0.0)
    return jnp.stack([x[1], -p["k"] * x[0] - damping * x[1] - 0.3 * jnp.where(x[0] > p["w"], x[0], p["w"])])


def two_springs(t, x, p):
    """They turn and stop at the same times."""
    return jnp.concatenate([x[2:], -p["k"] * x[:2] - p["c"] * jnp.sign(x[2:])])


def late_and_jumping():
    jump = sf.Jump(2.5, lambda t, x, p: jnp.stack([x[0], x[1] + p["c"]]))
    parameters = {"k": 4.0, "c": 0.3, "late": sf.Parameter(0.05, lower=0.0, upper=0.2)}
    return problem_of(spring, [1.0, 0.0], parameters, data=samples(count=20, delay="late"), jumps=[jump], **TIGHT)


def free_end():
    costs = [sf.TerminalCost(lambda x, p: (x[0] - 0.1) ** 2 + x[1] ** 2), sf.RunningCost(lambda t, x, p: x[0] ** 2)]
    return problem_of(spring, [1.0, 0.0], {"k": 4.0, "c": 0.3}, sf.Parameter(2.3, 1.0, 4.0), costs, **TIGHT)


PUSHES = sf.Input(np.array([0.0, 1.0, 2.0, 3.0, 4.0]), np.array([5.0, 1.0, -5.0, 0.0, 6.0]), kind="hold")

CASES = {
    "contact": (lambda: problem_of(contact, [1.0, 0.0], {"k": 1e3, "c": 3.0}, 2.9, **TIGHT), 6),
    "clip": (lambda: problem_of(clipped, [1.0, 0.0], {"k": 4.0, "s": 0.5}, 5.0, **TIGHT), 4),
    "driven": (lambda: problem_of(driven, np.zeros(2), {"mu": 0.3, "d": 0.3}, 5.0, inputs=PUSHES, **TIGHT), 4),
    "everything": (everything, 2),
    "stiff": (lambda: problem_of(contact, [1.0, 0.0], {"k": 1e3, "c": 3.0}, 1.1, solver="stiff", **TIGHT), 2),
    "written twice": (lambda: problem_of(written_twice, [1.0, 0.0], {"k": 4.0, "c": 0.5, "w": 0.31}, 5.0, **TIGHT), 3),
    "two springs": (lambda: problem_of(two_springs, [1.0, 1.0, 0.0, 0.0], {"k": 4.0, "c": 0.9}, count=7, **TIGHT), 2),
    "late samples, a jump": (late_and_jumping, 2),
    "a free end": (free_end, 1),
}
"""Problems, and how many crossings their first experiments have at least."""


QUICK = ("contact", "clip", "driven", "everything")


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in QUICK)) for name in CASES])
def test_derivatives_are_those_of_differences(name):
    build, crossings = CASES[name]
    evaluator = check_derivatives(build())
    assert len(crossings_of(evaluator)) >= crossings
    assert evaluator.engine.name == "native"


@pytest.mark.slow
def test_the_lagrangian_of_guards_and_terminal_constraints_has_its_derivatives():
    """Crossings, and a transition whose time is an unknown that a guard constrains."""
    system = sf.HybridSystem({"a": spring, "b": clipped}, [1.0, 0.0], guards={("a", "b"): lambda t, x, p: x[0] + 0.31})
    data = [samples(count=30), sf.TerminalConstraint(lambda x, p: x[0] - 0.2)]
    problem = one_run(system, data, ("a", "b"), (2.1,), 4.0, {"k": 4.0, "c": 0.3, "s": 0.4}, **TIGHT)
    evaluator, multipliers = Evaluator(problem), np.array([0.7, -0.4])
    found = evaluator.constrained(problem.initial_theta, multipliers=multipliers)

    def lagrangian(theta):
        there = evaluator.constrained(theta, multipliers=multipliers)
        return there.cost + multipliers @ there.constraints

    gradient = found.gradient + multipliers @ found.jacobian
    assert measure_errors(problem.initial_theta, lagrangian, gradient, found.hessian).max() < 1e-6


@pytest.mark.parametrize("t", [0.31, 2.5])
def test_what_a_pulse_does_beside_a_corner_is_lost_as_it_slides_on(t):
    """A point slides along x_1 = x_0 / 2, its field jumps askew, and it comes back behind a pulse of another mode;
    at 0.31 it does not slide yet."""

    def askew(t, x, p):
        side = jnp.sign(x[1] - 0.5 * x[0])
        return jnp.stack([0.6 - 0.4 * side, p["k"] * x[0] - side])

    system = sf.HybridSystem({"askew": askew, "away": lambda t, x, p: jnp.stack([-p["k"], 0.7])}, [0.1, 0.8])

    def pose(sequence, times):
        return sf.Problem(system, sf.Experiment(samples(), sequence, times, 0.0, 4.0), {"k": 0.3}, **TIGHT)

    found = sf.insertion(pose(("askew",), ()))
    row = int(np.argmin(abs(found.times - t)))
    begin, length = found.times[row], 1e-4
    costs = [sf.evaluate(pose(("askew", "away", "askew"), (begin, begin + k * length))).cost for k in (1e-5, 1, 2)]
    slope = (4 * costs[1] - 3 * costs[0] - costs[2]) / (2 * length)
    assert found.rate[row, 1] == pytest.approx(slope, rel=1e-4)


# --- order ------------------------------------------------------------------------------------------------------------


def turning_on(cells):
    """A spring with friction that turns twice, at pi / sqrt(k) and twice that, and is far from rest."""
    problem = problem_of(spring, [1.0, 0.0], {"k": 3.0, "c": 0.3}, 4.0, count=4)
    return Evaluator(problem, meshes=[Mesh.from_times(np.linspace(0.0, 4.0, cells + 1))])


def test_costs_and_derivatives_keep_the_order_of_the_steps_across_crossings():
    """On average over many places of the crossings in their cells."""
    counts, thetas = (20, 40, 80), [np.array([k, 0.3]) for k in np.linspace(3.0, 3.7, 12)]
    evaluators = {cells: turning_on(cells) for cells in (*counts, 640)}
    sizes = np.zeros((3, 3))
    for theta in thetas:
        exact = evaluators[640](theta)
        for row, cells in zip(sizes, counts, strict=True):
            found = evaluators[cells](theta)
            pairs = [(found.cost, exact.cost), (found.gradient, exact.gradient), (found.hessian, exact.hessian)]
            row += [np.log2(np.abs(one - other).max() / np.abs(other).max()) for one, other in pairs]
    orders = -np.diff(sizes, axis=0) / len(thetas)
    assert orders[:, :2].min() > 4.5, orders
    assert orders[:, 2].min() > 3.9, orders  # the second derivative of a row in its length has an order less


def test_costs_go_on_where_a_crossing_passes_a_node():
    """It is on the node 1.8 where k = (pi / 1.8)^2; the gradient jumps by the error of a row at most."""
    evaluator, k = turning_on(40), (np.pi / 1.8) ** 2
    before, on, after = (evaluator(np.array([k * (1.0 + s), 0.3])) for s in (-1e-13, 0.0, 1e-13))
    for one in (before, after):
        assert one.cost == pytest.approx(on.cost, rel=1e-12)
        np.testing.assert_allclose(one.gradient, on.gradient, rtol=1e-6)
        np.testing.assert_allclose(one.hessian, on.hessian, rtol=1e-4)


@pytest.mark.parametrize("rtol", [1e-6, 1e-8])
def test_costs_do_not_depend_on_what_was_evaluated_before(rtol):
    """The spring just reaches a stiffer part, and leaves it before a step is over: the dip must be found at a path that
    is new, and missed at one that had none.
    """

    def mode(t, x, p):
        beyond = jnp.where(x[0] < -p["s"], x[0] + p["s"], 0.0)
        return jnp.stack([x[1], -4.0 * jnp.maximum(x[0], -p["s"]) - 20.0 * beyond])

    def evaluator_at(s):
        problem = problem_of(mode, [1.0, 0.0], {"s": s}, 5.0, count=10, rtol=rtol, atol=rtol)
        return Evaluator(problem, meshes=meshes)

    meshes = None
    moved = evaluator_at(1.05)
    meshes = moved.meshes
    assert not len(moved.engines[0]._times)
    for dip in (-1e-3, 1e-4, 3e-4, 1e-3, 2e-3, 3e-3, 1e-2):
        theta, fresh = np.array([1.0 - dip]), evaluator_at(1.0 - dip)
        assert moved.cost(theta) == pytest.approx(fresh.cost(theta), rel=1e-9), dip
    assert len(crossings_of(moved)) == 4


# --- other matrices and methods ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("method", ["forward", "discrete-adjoint", "adjoint", "autodiff"])
@pytest.mark.parametrize("name", ["driven", "contact"])
def test_all_methods_agree(name, method):
    problem = CASES[name][0]()
    found, expected = evaluator_of(problem)(problem.initial_theta, method=method), sf.evaluate(problem)
    relative = 1e-5 if method == "adjoint" else 1e-9
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    for one, other in ((found.gradient, expected.gradient), (found.hessian, expected.hessian)):
        np.testing.assert_allclose(one, other, rtol=0, atol=relative * np.abs(other).max())


def outflow(t, x, p):
    return p["k"] * jnp.sqrt(jnp.maximum(x, 0.0))


def outflow_both_ways(t, x, p):
    return p["k"] * jnp.sign(x) * jnp.sqrt(jnp.abs(x))


def sinking(t, x, p):
    return -p["k"] * jnp.ones(1)


def flow_of_sinking(t, q):
    level = q[0] - q[1] * t
    return jnp.where(level > 0.0, q[1] * jnp.sqrt(jnp.where(level > 0.0, level, 1.0)), 0.0)


@pytest.mark.parametrize(
    ("mode", "output", "flow"),
    [
        (tank, outflow, lambda t, q: q[1] * jnp.maximum(jnp.sqrt(q[0]) - 0.5 * q[1] * t, 0.0)),
        (tank, outflow_both_ways, lambda t, q: q[1] * jnp.maximum(jnp.sqrt(q[0]) - 0.5 * q[1] * t, 0.0)),
        (sinking, outflow, flow_of_sinking),
    ],
    ids=["outflow", "outflow_both_ways", "sinking"],
)
def test_an_output_with_an_infinite_slope_at_a_corner_has_derivatives_beyond(mode, output, flow):
    """The flow out of a tank, which is measured, is 0 once it is empty, or once its level is below the outlet."""
    times = np.linspace(0.1, 4.5, 45)
    data = sf.Measurements(times, np.cos(times), output, sigma=1.0)
    start, parameters = lambda p: jnp.stack([p["x0"]]), {"x0": 1.53, "k": 0.8}
    problem = problem_of(mode, start, parameters, 4.5, data, rtol=1e-12, atol=1e-12)
    (J, g, *_), found = expect(flow, problem), sf.evaluate(problem)
    assert found.cost == pytest.approx(J, rel=1e-4)
    np.testing.assert_allclose(found.gradient, g, rtol=0, atol=1e-3 * np.abs(g).max())


# --- random systems ---------------------------------------------------------------------------------------------------


def one_plane(t, x, p):
    """A linear field on each side of a plane."""
    return jnp.where(p["n"][0] @ x > p["d"], p["A"][0] @ x * p["a"] + p["b"][0], p["A"][1] @ x + p["b"][1])


def two_planes(t, x, p):
    """One more jump at another plane."""
    return one_plane(t, x, p) + jnp.sign(p["n"][1] @ x - 0.3 * p["d"]) * (p["b"][2] + p["a"] * x * p["b"][3])


def random_problem(seed):
    rng = np.random.default_rng(seed)
    n, mode = 2 + seed % 2, (one_plane, two_planes)[seed // 2 % 2]
    fixed = {
        "A": rng.standard_normal((2, n, n)) - 0.5 * np.eye(n),
        "b": rng.standard_normal((4, n)) * np.array([1.5, 1.5, 1.0, 0.3])[:, None],
        "n": rng.standard_normal((2, n)),
    }
    data = sf.Measurements([0.71, 1.43, 2.0], rng.standard_normal((3, n)), sigma=1.0)
    start = [sf.Parameter(float(rng.standard_normal())), *rng.standard_normal(n - 1).tolist()]
    unknown = {"a": 1.0, "d": 0.5 * float(rng.standard_normal())}
    constants = {name: sf.Parameter(value, fixed=True) for name, value in fixed.items()}
    return problem_of(mode, start, unknown | constants, 2.0, data, **TIGHT), fixed


def integrate_with_one_corner(problem, fixed):
    """J of the model with one plane, from an integrator that knows its corner (`benchmarks.sharp.corners`)."""
    (a, d, x0), (A, b, normals) = problem.initial_theta, fixed.values()

    def field(t, x, sides):
        return A[0] @ x * a + b[0] if sides[0] > 0 else A[1] @ x + b[1]

    data = problem.experiments[0].data[0]
    start = [x0, *(entry.value for entry in problem.system.initial_state[1:])]
    settings = {"rtol": 1e-11, "atol": 1e-12, "method": "DOP853"}
    states, _ = integrate(field, lambda x: [normals[0] @ x - d], start, 0.0, 2.0, data.times, **settings)
    return 0.5 * np.sum((states - data.values) ** 2)


@pytest.mark.slow
def test_random_systems():
    """Differences of J, where the path and the samples between its crossings are the same at all of their points:
    J has corners of its own elsewhere, as where a trajectory grazes a plane.
    """
    skipped, slid, crossed = 0, 0, 0
    for seed in range(100):
        problem, fixed = random_problem(seed)
        theta, paths, evaluator = problem.initial_theta, set(), Evaluator(problem)
        engine = evaluator.engines[0]

        def cost(theta, evaluator=evaluator, engine=engine, paths=paths):
            J = evaluator.cost(theta)
            path = engine._split.path
            paths.add((path.sides, path.ends, tuple(np.searchsorted(crossings_of(evaluator), [0.71, 1.43]))))
            return J

        found = evaluator(theta)
        if seed // 2 % 2 == 0:
            assert found.cost == pytest.approx(integrate_with_one_corner(problem, fixed), rel=1e-7), seed
        errors = measure_errors(theta, cost, found.gradient, found.hessian)
        if len(paths) > 1:
            skipped += 1
            continue
        slid += any(0 in sides for sides in engine._split.path.sides[0])
        crossed += len(crossings_of(evaluator))
        assert np.all(errors < [1e-7, 1e-5]), seed
    assert skipped <= 2, "one, seed 11"
    assert slid > 20
    assert crossed > 60


def valve(t, x, p):
    """A tank that is filled, behind a valve that opens at the pressure of another."""
    flow = p["c"] * jnp.sqrt(jnp.maximum(x[0] - x[1], 0.0))
    return jnp.stack([p["q"] - flow, flow - 0.3 * x[1]])


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_derivatives_behind_a_valve_that_opens_are_those_of_differences(engine):
    """Beside an infinite slope, both matrices are what they are called."""
    problem = problem_of(valve, [0.0, 0.3], {"c": 0.6, "q": 0.4}, 5.0, engine=engine, **TIGHT)
    evaluator, theta = Evaluator(problem), problem.initial_theta
    exact, gauss_newton = (evaluator(theta, matrix=matrix).hessian for matrix in ("exact", "gauss-newton"))
    assert len(crossings_of(evaluator)) == 1
    slopes = [(evaluator.cost(theta + h) - evaluator.cost(theta - h)) / 2e-5 for h in 1e-5 * np.eye(2)]
    np.testing.assert_allclose(evaluator(theta).gradient, slopes, rtol=1e-6)
    times, steps = problem.experiments[0].data[0].times, 1e-4 * np.eye(2)

    def seen(theta):
        return sf.simulate(problem, theta, times=times).states[:, 0]

    slopes = np.stack([(seen(theta + h) - seen(theta - h)) / 2e-4 for h in steps], axis=1)
    np.testing.assert_allclose(gauss_newton, slopes.T @ slopes, rtol=1e-5)
    differences = [(evaluator(theta + h).gradient - evaluator(theta - h).gradient) / 2e-4 for h in steps]
    np.testing.assert_allclose(exact, differences, rtol=0.05)  # it is not accurate there
    assert np.abs(exact - gauss_newton).max() > 0.1 * np.abs(exact).max()


@pytest.mark.parametrize(
    "root",
    [
        lambda x: jnp.sqrt(jnp.maximum(x, 0.0)),
        lambda x: jnp.where(x > 0.0, jnp.sqrt(x), 0.0),
        lambda x: jnp.clip(x, 0.0, 9.0) ** 0.5,
        lambda x: jnp.where(x > 0.0, x / jnp.sqrt(jnp.abs(x)), 0.0),
    ],
    ids=["maximum", "where", "clip", "quotient"],
)
def test_levels_in_one_vector_are_those_of_their_entries(root):
    """One tank runs dry before the other: what is not chosen of an entry has no derivative, infinite or not."""

    def by_entry(t, x, p):
        first, second = p["k"][0] * root(x[0]), p["k"][1] * root(x[1])
        return jnp.array([-first, first - second])

    def together(t, x, p):
        out = p["k"] * root(x)
        return jnp.stack([0.0, out[0]]) - out

    found = []
    for mode in (by_entry, together):
        problem = problem_of(mode, [0.4, 0.9], {"k": [0.8, 0.5]})
        found.append(sf.evaluate(problem))
    for name in ("cost", "gradient", "hessian"):
        np.testing.assert_allclose(getattr(found[1], name), getattr(found[0], name), rtol=1e-9)
        assert np.isfinite(getattr(found[0], name)).all()


@pytest.mark.parametrize(
    ("rounded", "crossed"),
    [
        (jnp.floor, [-1.0, 0.0, 1.0]),
        (jnp.ceil, [-1.0, 0.0, 1.0]),
        (jnp.round, [-1.5, -0.5, 0.5]),
        (jnp.trunc, [-1.0, 1.0]),
    ],
)
def test_a_rounded_state_jumps_at_each_integer(rounded, crossed):
    """x' = w - r(x) / 4 is constant between the jumps of r, whose times move with w."""

    def cost(w):
        x, left = -1.75, 5.0
        for bound in (*crossed, np.inf):
            slope = w - 0.25 * float(rounded(x + 0.1))
            if x + slope * left < bound:
                return 0.5 * (x + slope * left - 1.0) ** 2
            x, left = bound, left - (bound - x) / slope

    data = sf.Measurements([5.0], [1.0], sigma=1.0)
    problem = problem_of(lambda t, x, p: p["w"] - 0.25 * rounded(x), [-1.75], {"w": 0.6}, tf=5.0, data=data)
    found = sf.evaluate(problem)
    np.testing.assert_allclose(found.cost, cost(0.6), rtol=1e-9)
    np.testing.assert_allclose(found.gradient, (cost(0.6 + 1e-6) - cost(0.6 - 1e-6)) / 2e-6, rtol=1e-6)
