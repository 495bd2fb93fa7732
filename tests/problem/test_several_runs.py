"""Several runs: what they share, what is their own, initial states that are estimated, and what all this costs."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.derivatives import differentiate
from support.models import refused
from switchfit.batch.layout import ProgramLayout
from switchfit.batch.program_inputs import ProgramInputs
from switchfit.engine.native.program_cache import _program_of
from switchfit.meshes.evaluator import evaluator_of
from switchfit.problem.functions import Call, trace_function
from switchfit.strategy.beam import follow_order


def swing(t, x, p):
    """k is a vector, b a number."""
    return jnp.stack([x[1], -p["k"][0] * x[0] - p["k"][1] * x[1]])


MODES = {"swing": swing, "sway": lambda t, x, p: -p["b"] * x}
SWING = sf.HybridSystem(MODES, [0.7, 0.9], state_names=("q", "v"))
GUESS = {"k": [0.8, 0.5], "b": 1.2, "k_2": [0.7, 0.6], "b_2": 1.1}


def run(**given):
    return sf.Experiment(sf.TerminalCost(lambda x, p: x @ x), ("sway", "swing"), (0.63,), 0.0, 2.0, **given)


# --- names ------------------------------------------------------------------------------------------------------------


def test_theta_in_its_order():
    """Free times of the first experiment, of the second, parameters as given, entry by entry, states of each run."""
    system = sf.HybridSystem({"a": lambda t, x, p: x, "b": lambda t, x, p: -x}, [1.0, 2.0], state_units=("m", "m/s"))

    def start(times, **given):
        return sf.Experiment(sf.TerminalCost(lambda x, p: x[0]), ("a", "b", "a"), times, 0.0, 1.0, **given)

    fixed, bounded = sf.Parameter(0.3, fixed=True), sf.Parameter(0.6, lower=0.5, upper=0.7, unit="ms")
    unknown = [sf.Parameter(0.75, lower=0.0), sf.Parameter(0.85, upper=4.0, unit="mm/s")]
    first = start((fixed, bounded), name="city", time_unit="ms", initial_state=unknown)
    second = start((0.2, 0.8), initial_state=[unknown[0], 2.0])
    matrix = sf.Parameter([[1.0, 2.0], [3.0, 4.0]], lower=[[0.0], [3.0]], unit="N")
    given = {"z": 7.0, "held": sf.Parameter([1.0, 2.0], fixed=True), "A": matrix}
    problem = sf.Problem(system, [first, second], given)
    assert problem.theta_names == (
        "city.tau_2", "run2.tau_1", "run2.tau_2", "z", "A[0,0]", "A[0,1]", "A[1,0]", "A[1,1]",
        "city.x1(t0)", "city.x2(t0)", "run2.x1(t0)",
    )  # fmt: skip
    initial = [0.6, 0.2, 0.8, 7.0, 1.0, 2.0, 3.0, 4.0, 0.75, 0.85, 0.75]
    np.testing.assert_array_equal(problem.initial_theta, initial)
    assert problem.unknowns.units == ("ms", "s", "s", "", "N", "N", "N", "N", "m", "mm/s", "m")
    inf = np.inf
    lower, upper = [0.5, -inf, -inf, -inf, 0.0, 0.0, 3.0, 3.0, 0.0, -inf, 0.0], [0.7, *[inf] * 8, 4.0, inf]
    np.testing.assert_array_equal([problem.unknowns.lower, problem.unknowns.upper], [lower, upper])
    times, parameters = problem.split(np.array([0.65, 0.1, 0.9, *range(8)]))
    assert [tau.tolist() for tau in times] == [[0.3, 0.65], [0.1, 0.9]]
    found = {name: value.tolist() for name, value in parameters.items()}
    assert found == {"z": 0.0, "held": [1.0, 2.0], "A": [[1.0, 2.0], [3.0, 4.0]]}
    problem.initial_theta[0] = -1.0  # what is handed out is a copy
    assert problem.initial_theta[0] == 0.6
    system = sf.HybridSystem({"m": lambda t, x, p: -x}, [1.0, sf.Parameter(2.0), sf.Parameter(3.0, fixed=True)])
    one = sf.Experiment(sf.TerminalCost(lambda x, p: x @ x), ("m",), (), 0.0, 1.0)
    assert sf.Problem(system, one).theta_names == ("x2(t0)",)
    assert sf.Problem(system, [one, one]).theta_names == ("run1.x2(t0)", "run2.x2(t0)")


# --- derivatives ------------------------------------------------------------------------------------------------------


def test_two_names_may_mean_one_parameter():
    """Derivatives in it are those in both names together."""
    system = sf.HybridSystem({"m": lambda t, x, p: -p["slow"] * p["fast"] ** 2 * x}, [1.0])
    cost = sf.TerminalCost(lambda x, p: x[0] * p["fast"])
    once = sf.Experiment(cost, ("m",), (), 0.0, 1.0, parameter_map={"slow": "rate", "fast": "rate"})
    found = sf.evaluate(sf.Problem(system, once, {"rate": 0.7}, rtol=1e-11))
    J, slope, bend = differentiate(lambda q: q * jnp.exp(-(q**3)), 0.7)
    assert found.cost == pytest.approx(J, rel=1e-10)
    np.testing.assert_allclose(found.gradient, [slope], rtol=1e-7)
    np.testing.assert_allclose(found.hessian, [[bend]], rtol=1e-7)


# --- which parameters a run has ---------------------------------------------------------------------------------------


def names_of(problem, e=0):
    return [name for name, _, _ in problem.structures[e].parameters]


def test_a_run_is_differentiated_in_what_its_functions_ask_for():
    """In names of the model, whatever their parameters are called."""
    maps = {}, {"k": "k_2", "b": "b_2"}, {"b": "b_2"}
    problem = sf.Problem(SWING, [run(parameter_map=given or None) for given in maps], GUESS | {"idle": 1.0})
    assert [names_of(problem, e) for e in range(3)] == [["k", "b"]] * 3
    assert sf.evaluate(problem).gradient[-1] == 0.0


@pytest.mark.parametrize("whole", [lambda p: jax.jit(lambda q: q["a"] + q["b"])(p), lambda p: {**p}["a"] + p["b"]])
def test_a_function_may_take_p_as_a_whole(whole):
    """What it does not read is not a parameter of the run."""
    system = sf.HybridSystem({"m": lambda t, x, p: -whole(p) * x}, [1.0])
    runs = [
        sf.Experiment(sf.TerminalCost(lambda x, p: x[0]), ("m",), (), 0.0, 1.0, parameter_map={"b": name})
        for name in ("b_1", "b_2")
    ]
    problem = sf.Problem(system, runs, {"a": 0.3, "b_1": 0.1, "b_2": sf.Parameter(0.2, fixed=True)})
    assert sf.evaluate(problem).cost == pytest.approx(np.exp(-0.4) + np.exp(-0.5), rel=1e-8)
    assert [names_of(problem, e) for e in range(2)] == [["a", "b"]] * 2


# --- errors -----------------------------------------------------------------------------------------------------------


def pose(*runs, **guess):
    return sf.Problem(SWING, list(runs), guess or GUESS)


THREE = [sf.Parameter(1.0), 2.0, 3.0]
UNEQUAL = {"k": [0.8, 0.5], "k_2": [0.7, 0.6]}
test_what_is_wrong_is_said = refused(
    (lambda: pose(run(), run(parameter_map={"k": "k_3"})), "parameter_map has 'k' -> 'k_3', but the problem has k, b"),
    (lambda: pose(run(parameter_map={"k": "k_2"}), **UNEQUAL), "reads 'b', which is not there: p has k"),
    (lambda: pose(run(parameter_map={"k": "b"})), "mode 'swing': .* raised IndexError"),
    (lambda: run(initial_state=[sf.Parameter(1.0), "v"]), "must be a number or an sf.Parameter: .*; got 'v'"),
    (lambda: run(initial_state=[sf.Parameter([1.0, 2.0]), 0.0]), r"got the shapes \[\(2,\), \(\)\]"),
    (lambda: run(initial_state=sf.Parameter([1.0])), "must be an array of numbers, one for each state; got Parameter"),
    (lambda: pose(run(), run(initial_state=THREE)), "as many entries in the system and all experiments; got {2, 3}"),
    (lambda: sf.HybridSystem({"swing": swing}, THREE, state_names=("q", "v")), "one entry for each of the 3 states"),
    (lambda: pose(run(initial_state=[sf.Parameter(0.75), 0.9]), **GUESS | {"q(t0)": 1.0}), r"share a name: q\(t0\)"),
    (lambda: run(parameter_map=["k"]), "must be a dict of the model's name"),
    (lambda: run(parameter_map={"k": 1}), "parameter_map must be a dict"),
)


# --- fits -------------------------------------------------------------------------------------------------------------

TRUTH = {"k": 1.3, "c": 0.25}
GROWTH = (0.7, 0.4)


def fall(t, x, p):
    return -p["k"] * x + p["c"]


def rise(t, x, p):
    return p["r"] * jnp.ones(1)


TANK = sf.HybridSystem({"fall": fall, "rise": rise}, [0.0], state_names=("h",), state_units=("m",))


def level(t, tau, x0, r, k=TRUTH["k"], c=TRUTH["c"]):
    """x' = c - k x, then x' = r: the closed form."""
    falling = c / k + (x0 - c / k) * np.exp(-k * np.minimum(t, tau))
    return falling + r * np.maximum(t - tau, 0.0)


def tank(e, samples=25, sigma=0.02, seed=0, names=None, **given):
    """A tank that falls and then rises: of each run its own are tau, x(0) and, by its map, r."""
    times = np.linspace(0.0, 4.0, samples)
    x0, r, tau = 2.0 + e, GROWTH[e % 2], 1.93 + 0.2 * (e % 3)
    values = level(times, tau, x0, r) + sigma * np.random.default_rng([seed, e]).normal(size=samples)
    data = sf.Measurements(times, values, sigma=sigma)
    own = {"r": f"r_{e}"} if names is None else names
    start = [sf.Parameter(1.5 + e, lower=0.0, upper=20.0)]
    settings = {"initial_state": start, "parameter_map": own, "name": f"tank{e}"} | given
    return sf.Experiment(data, ("fall", "rise"), (2.0,), 0.0, 4.0, **settings)


def tanks(count, samples=None, system=TANK, **given):
    guess = {"k": 1.0, "c": 0.2} | {f"r_{e}": sf.Parameter(0.5, lower=0.0, upper=3.0) for e in range(count)}
    runs = [tank(e, samples=25 if samples is None else samples[e], **given) for e in range(count)]
    return sf.Problem(system, runs, guess)


def test_the_truth_is_found():
    fitted = sf.estimate(tanks(2))
    assert fitted.theta_names == (
        "tank0.tau_1", "tank1.tau_1", "k", "c", "r_0", "r_1", "tank0.h(t0)", "tank1.h(t0)",
    )  # fmt: skip
    truth = [1.93, 2.13, *TRUTH.values(), *GROWTH, 2.0, 3.0]
    assert np.all(np.abs(fitted.theta - truth) < 3.5 * fitted.standard_errors)
    assert [x.tolist() for x in fitted.initial_state] == [[fitted.theta[6]], [fitted.theta[7]]]


def test_a_batch_of_runs_with_times_that_are_known():
    """In the loop over runs that are alike, known transition times are not mixed up with those of others."""
    known = sf.Parameter(1.9, fixed=True)
    given = tanks(2)
    runs = [replace(run, transition_times=(known,), name=f"known{e}") for e, run in enumerate(given.experiments)]
    problem = sf.Problem(TANK, [*given.experiments, *runs], given.parameters)
    evaluator, theta = evaluator_of(problem), problem.initial_theta + 0.1
    places = tuple(tuple(where.tolist()) for where in problem.places)
    for lockstep in (False, True):
        natively = not lockstep
        structures = tuple(s.library for s in problem.structures) if natively else problem.structures
        layout = ProgramLayout(structures, places, (), lockstep, natively)
        with jax.enable_x64(True):
            evaluate = partial(ProgramInputs.of(evaluator, layout).evaluate, layout, ())
            found = jax.jit(evaluate)(theta, jnp.ones(()))
        expected = evaluator(theta)
        for one, other in zip(found, (expected.cost, expected.gradient, expected.hessian), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-8)


def test_one_program_for_ten_runs_of_different_lengths():
    """For the first of them, and nothing for the others, nor for the ten together."""
    samples = [29, 37, 31, 42, 51, 38, 49, 54, 59, 33]

    def compiled(problem):
        before = _program_of.cache_info().misses
        sf.evaluate(problem)
        sf.estimate(problem, max_iterations=1)
        return _program_of.cache_info().misses - before

    new = sf.HybridSystem({"fall": lambda t, x, p: 1.0 * fall(t, x, p), "rise": rise}, [0.0], state_names=("h",))
    problem = tanks(10, samples, new)
    assert len(set(problem.structures)) == 1
    assert compiled(problem) == 1
    assert compiled(tanks(10, samples[::-1], new)) == 0
    assert compiled(tanks(12, [*samples, 40, 45], new)) == 0


# --- arrays of which a run reads some entries -------------------------------------------------------------------------

Q = np.arange(12).reshape(3, 4)
READ = {
    "from the end": (lambda q: q[-1, ::2], Q[2, ::2]),
    "a column": (lambda q: q[:, 1], Q[:, 1]),
    "a row of columns": (lambda q: q.T[3], Q[:, 3]),
    "after a reshape": (lambda q: q.reshape(2, 6)[1, 1:3] + q.ravel()[:2], [0, 1, 7, 8]),
    "in another order": (lambda q: jax.lax.reshape(q, (12,), (1, 0))[:3], Q[:, 0]),
    "rows by name": (lambda q: (lambda a, b, c: a * c)(*q), [*Q[0], *Q[2]]),
    "a row twice": (lambda q: q[1] * q[1:, 2].sum(), [*Q[1], Q[2, 2]]),
    "a row of all that is changed": (lambda q: jnp.sin(q)[0], Q),
    "where a value says": (lambda q: q[jnp.argmax(q[0])], Q),
    "by an array": (lambda q: q[np.array([0, 2])], Q),
    "inside a jitted function": (lambda q: jax.jit(lambda a: a[0])(q), Q),
    "inside a loop": (lambda q: jax.lax.fori_loop(0, 2, lambda k, x: x + q[0, 0], 0.0), Q),
}


@pytest.mark.parametrize("name", READ)
def test_entries_that_no_operation_reads(name):
    """At any other value of these the result is the same, not a number included."""
    read, expected = READ[name]
    traced = trace_function(Call(lambda p: read(p["q"]), (None,), None, "f", "f(p)"), {"q": Q.shape})
    assert traced.read["q"] == tuple(sorted(set(np.ravel(expected).tolist())))
    values = np.sin(1.0 + Q)
    holes = np.where(np.isin(Q, traced.read["q"]), values, np.nan)
    with jax.enable_x64(True):
        np.testing.assert_array_equal(traced({"q": holes}), traced({"q": values}))


def arrays(take, engine="auto", sequences=(("fall", "rise"),) * 3):
    """Runs that begin at a row each, of which the last has rows of its own; `take` is called with each array."""

    def begin(p, e):
        return take(p["starts"])[e, :1] * take(p["starts"])[e, 1]

    def look(t, x, p, e):
        return x * take(p["gain"])[e]

    system = sf.HybridSystem(
        {
            "fall": lambda t, x, p: -take(p["k"])[0] * x + take(p["c"])[1],
            "rise": lambda t, x, p: take(p["k"])[2] ** 2 * jnp.ones(1),
        },
        [0.0],
        {("fall", "rise"): lambda t, x, p: x + take(p["k"])[1] * t},
    )
    runs = []
    for e, sequence in enumerate(sequences):
        values = np.random.default_rng(e).normal(1.0, 0.3, size=(9, 1))
        seen = sf.Measurements(np.linspace(0.4, 3.6, 9), values, observe=partial(look, e=e), sigma="sigma")
        data = [seen, sf.TerminalCost(lambda x, p: x[0] * take(p["k"])[3])] if e == 1 else [seen]
        own = {"starts": "others"} if e == 2 else {}
        times = np.linspace(1.9, 2.3, len(sequence) - 1)
        start = partial(begin, e=e)
        runs.append(sf.Experiment(data, sequence, times, 0.0, 4.0, initial_state=start, parameter_map=own))
    parameters = {
        "k": [0.9, 0.3, 0.8, 0.2, 0.7],
        "c": sf.Parameter([0.1, 0.2], fixed=True),
        "starts": sf.Parameter(1.0 + 0.1 * np.arange(6.0).reshape(3, 2), prior=sf.Normal(1.0, 0.5)),
        "others": 2.0 - 0.1 * np.arange(6.0).reshape(3, 2),
        "gain": [1.1, 0.9, 1.2],
        "sigma": sf.Parameter(0.4, lower=0.01),
    }
    return sf.Problem(system, runs, parameters, engine=engine)


@pytest.mark.parametrize("engine", ["native", "jax"])
def test_a_run_takes_the_entries_that_it_reads(engine):
    """All that is computed is what it is where each run takes whole arrays."""
    few, whole = arrays(lambda q: q, engine), arrays(lambda q: 1.0 * q, engine)
    assert [structure.M for structure in few.structures] == [3 + 2 + 1 + 1, 4 + 2 + 1 + 1, 3 + 2 + 1 + 1]
    assert [structure.M for structure in whole.structures] == [5 + 6 + 3 + 1] * 3
    named = [[few.theta_names[place] for place in places[1:]] for places in few.places]
    assert named[1] == ["k[0]", "k[1]", "k[2]", "k[3]", "starts[1,0]", "starts[1,1]", "gain[1]", "sigma"]
    assert named[2] == ["k[0]", "k[1]", "k[2]", "others[2,0]", "others[2,1]", "gain[2]", "sigma"]
    theta = few.initial_theta * np.linspace(0.97, 1.03, len(few.theta_names))
    (one, arrow), (other, _) = ((each(theta), each(theta, arrow=True)) for each in map(evaluator_of, (few, whole)))
    for name in ("cost", "gradient", "hessian"):
        expected = getattr(other, name)
        np.testing.assert_allclose(getattr(one, name), expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(arrow.hessian.dense(), one.hessian, rtol=1e-12, atol=1e-12)
    for e in range(3):
        states = [sf.simulate(problem, theta, experiment=e).states for problem in (few, whole)]
        np.testing.assert_allclose(*states, rtol=1e-12)


def test_beams_and_fits_of_runs_that_read_entries():
    few, whole = arrays(lambda q: q), arrays(lambda q: 1.0 * q)
    q = few.initial_theta[3:]
    for e in range(3):
        one, other = (follow_order(problem, e, q)[0] for problem in (few, whole))
        np.testing.assert_allclose(one.transition_times[0], other.transition_times[0], rtol=1e-6)
        own = few.places[e][1:] - 3  # a beam that has no use for an entry leaves it where it is
        np.testing.assert_allclose(one.parameters[own], other.parameters[own], rtol=1e-6)
    sequences, times = [("fall", "rise"), ("fall",), ("rise",)], [(2.0,), (), ()]
    changed = (each.with_sequences(sequences, times) for each in (few, whole))
    one, other = (sf.evaluate(replace(each, experiments=each.experiments[1:])) for each in changed)
    np.testing.assert_allclose(one.hessian, other.hessian, rtol=1e-12, atol=1e-12 * np.abs(other.hessian).max())
    one, other = (sf.estimate(problem, strategy="local") for problem in (few, whole))
    np.testing.assert_allclose(one.cost, other.cost, rtol=1e-9)
    np.testing.assert_allclose(one.standard_errors, other.standard_errors, rtol=1e-5)
