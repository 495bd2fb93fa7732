"""Which parameters the functions of a problem read or compare with, and what a fit says of those that none reads."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.models import decay
from switchfit.problem.comparisons import find_comparisons
from switchfit.problem.reads import find_unread
from switchfit.uncertainty.issues import find_issues

TIMES = np.linspace(0.0, 3.0, 31)


def relax(t, x, p):
    return p["h"] - p["k"] * x


def lift(t, x, p):
    return p["w"] - p["k"] * x


def push(t, x, p):
    return jnp.array([x[0] + p["q"]])


def at(t, x, p):
    return x[0] - p["q"]


def at_end(x, p):
    return x[0] - p["q"]


def observe(t, x, p):
    return p["q"] * x


def start(p):
    return jnp.array([p["q"]])


def make_data(**given):
    """Samples of decay from 1 until 1.3, then of relaxation to 4/3, k = 0.9."""
    level, before = 1.2 / 0.9, np.exp(-0.9 * TIMES)
    after = level + (np.exp(-0.9 * 1.3) - level) * np.exp(-0.9 * (TIMES - 1.3))
    noise = 0.01 * np.random.default_rng(0).standard_normal(len(TIMES))
    return sf.Measurements(TIMES, np.where(TIMES < 1.3, before, after) + noise, **{"sigma": 0.01} | given)


def make_problem(extra, data=None, modes=None, initial=(1.0,), reset_maps=None, guards=None, settings=None, **run):
    modes = {"a": decay, "b": relax} | (modes or {})
    system = sf.HybridSystem(modes, initial, reset_maps or {}, guards=guards or {})
    given = {"tf": 3.0} | run
    experiment = sf.Experiment([make_data(), *(data or [])], ("a", "b"), (1.0,), 0.0, **given)
    return sf.Problem(system, experiment, {"k": 0.7, "h": 1.0} | extra, **settings or {})


FREE = {"q": sf.Parameter(0.5, lower=0.1, upper=0.9)}


@pytest.mark.parametrize(
    "problem",
    [
        make_problem({"k": sf.Parameter(0.7), **FREE}, modes={"b": lambda t, x, p: relax(t, x, p) + 0 * p["q"]}),
        make_problem(FREE, [sf.Measurements(TIMES, np.ones((31, 1)), sigma="q")]),
        make_problem(FREE, [sf.Measurements(TIMES, np.ones(31), sigma=0.1, observe=observe)]),
        make_problem(FREE, [sf.Measurements([1.0, 2.0], [1.0, 1.0], sigma=0.1, delay="q")]),
        make_problem(FREE, [sf.RunningCost(at)]),
        make_problem(FREE, [sf.TerminalCost(at_end)]),
        make_problem(FREE, [sf.TerminalConstraint(at_end)]),
        make_problem(FREE, [sf.TransitionCost(at)]),
        make_problem(FREE, initial=start),
        make_problem(FREE, initial_state=start),
        make_problem(FREE, reset_maps={("a", "b"): push}),
        make_problem(FREE, guards={("a", "b"): at}),
        make_problem(FREE, jumps=sf.Jump(0.2, push)),
        make_problem({"q": sf.Parameter(0.5, prior=sf.Normal(0.5, 0.1))}),
        make_problem({"q": sf.Parameter(0.5, fixed=True)}),
        make_problem({"q": 0.7}, parameter_map={"k": "q"}),
    ],
)
def test_each_kind_of_function_reads(problem):
    found = find_unread(problem)
    assert "q" not in found.unread + found.absent


def test_what_no_function_reads_and_what_acts_elsewhere():
    assert find_unread(make_problem({"q": [1.0, 2.0]})) == (("q[0]", "q[1]"), ())
    assert find_unread(make_problem({"q": 1.0, "w": 2.0}, modes={"c": lift})) == (("q",), ("w",))
    assert find_unread(make_problem({"w": 2.0}, modes={"c": lift}, settings={"max_transitions": 2})) == ((), ("w",))
    assert find_unread(make_problem(FREE, guards={("b", "a"): at})) == ((), ("q",))
    assert find_unread(make_problem(FREE, reset_maps={("b", "a"): push})) == ((), ("q",))
    assert find_unread(make_problem(FREE, [sf.TransitionCost(at, before="b")])) == ((), ("q",))
    # the mode that does not occur cannot be traced without w: nobody knows what else it would read
    assert find_unread(make_problem({"q": 1.0}, modes={"c": lift})) == ((), ())


def test_a_parameter_of_another_run_is_read():
    system = sf.HybridSystem({"a": decay, "b": relax}, [1.0])
    runs = [sf.Experiment(make_data(), modes, times, 0.0, 3.0) for modes, times in [(("a",), ()), (("a", "b"), (1.0,))]]
    assert find_unread(sf.Problem(system, runs, {"k": 0.7, "h": 1.0})) == ((), ())
    assert find_unread(sf.Problem(system, runs[0], {"k": 0.7, "h": 1.0})) == ((), ("h",))


@pytest.mark.usefixtures("quick_certificates")
def test_the_report_says_what_nothing_reads(tmp_path):
    fit = sf.estimate(make_problem({"q": [1.0, 1.5], "w": 2.0}, modes={"c": lift}))
    assert (fit.unread, fit.absent) == (("q[0]", "q[1]"), ("w",))
    assert str(fit.verdict).endswith(
        "; no function of the model reads q; only modes or transitions that do not occur read w: remove q from "
        "parameters or use in the model, or fix w, or fit a log with other modes."
    )
    assert "but no function of the model reads q: remove q from parameters" in fit.message
    assert [issue.kind for issue in find_issues(fit)] == ["not read", "acts elsewhere"], "not: hardly determined"
    rows = {line.split()[0]: line for line in fit.report(full=True).splitlines() if line.strip()}
    assert rows["q[0]"].endswith("NOT READ")
    assert rows["w"].endswith("MODE DOES NOT OCCUR")
    known = sf.estimate(make_problem({}))
    np.testing.assert_allclose(fit.standard_errors[:3], known.standard_errors, rtol=1e-6)
    said = " ".join(str(fit.identifiability).split())
    assert "No function of the model reads q: remove q from parameters" in said
    fit.save(tmp_path / "fit.json")
    assert str(sf.Estimate.load(tmp_path / "fit.json").verdict) == str(fit.verdict)


def make_comparing(mode, observe=None, parameter_map=None, **others):
    times = np.linspace(0.1, 1.0, 5)
    log = sf.Measurements(times, times, sigma=1.0, observe=observe)
    run = sf.Experiment(log, ("m",), (), 0.0, 1.0, parameter_map=parameter_map)
    return sf.Problem(sf.HybridSystem({"m": mode, **others}, [0.3]), run, {"a": 1.0, "b": 2.0}, max_transitions=1)


FOUND = {
    "where": lambda t, x, p: jnp.where(t < 2.0 * p["a"] + 1.0, x, -x) * p["b"],
    "modulo": lambda t, x, p: jnp.where(t % p["a"] < 0.5, x, -x) * p["b"],
    "branch": lambda t, x, p: jax.lax.cond(t < p["a"], lambda y: y * p["b"], lambda y: y, x),
    "in a branch": lambda t, x, p: jax.lax.cond(t < 0.5, lambda y: y * (t > p["a"]), lambda y: y, x) * p["b"],
    "in a loop": lambda t, x, p: jax.lax.fori_loop(0, 3, lambda k, y: y * jnp.where(t < p["a"], p["b"], 1.0), x),
    "loop": lambda t, x, p: p["b"] * jax.lax.while_loop(lambda y: y < p["a"], lambda y: y + 1.0, t) * x,
    "jitted": lambda t, x, p: jax.jit(lambda a: jnp.where(t < a, x, -x))(p["a"]) * p["b"],
    "heaviside": lambda t, x, p: jnp.heaviside(t - p["a"], 0.5) * p["b"] * x,
    "floor": lambda t, x, p: jnp.floor(p["a"] * t) * x * p["b"],
    "round": lambda t, x, p: jnp.round(p["a"] * t) * x * p["b"],
    "integers": lambda t, x, p: (p["a"] * t).astype(int) * x * p["b"],
    "sign": lambda t, x, p: jnp.sign(t - p["a"]) * p["b"],
    "search": lambda t, x, p: jnp.searchsorted(jnp.stack([0.0 * t, p["a"]]), t) * p["b"] * x,
}


SAID = {"floor": "rounds what depends on", "round": "rounds what depends on", "integers": "rounds what depends on"}
SAID["sign"] = "takes the sign of what depends on"


@pytest.mark.promotes
@pytest.mark.parametrize("name", FOUND)
def test_a_comparison_is_found_with_its_line(name):
    first = FOUND[name].__code__.co_firstlineno
    found = find_comparisons(make_comparing(FOUND[name]))
    said = SAID.get(name, "compares with")
    assert found.get(0) in [f"mode 'm' {said} a at test_what_functions_read.py:{line}" for line in (first, first + 1)]
    assert found.get(1) is None


NOT_FOUND = {
    "corner of the state": lambda t, x, p: jnp.where(x > p["a"], p["b"], -p["b"]) * jnp.sign(x - p["a"]),
    "state alone": lambda t, x, p: jnp.sign(x) * p["a"] + p["b"] * (t < 0.5),
    "continuous": lambda t, x, p: jnp.maximum(t - p["a"], 0.0) * jnp.clip(x, 0.0, p["a"]) * p["b"],
    "interpolation": lambda t, x, p: jnp.interp(t, jnp.stack([0.0 * t, p["a"]]), jnp.array([0.0, 1.0])) * x * p["b"],
    "rule of its own": lambda t, x, p: jax.nn.softplus(p["a"]) * x + jax.nn.relu(p["b"] - x),
    "is it a number": lambda t, x, p: jnp.where(jnp.isnan(p["a"]), 0.0, p["a"]) * x * p["b"],
    "overwritten": lambda t, x, p: jnp.where(t < jax.jit(lambda a, b: b)(p["a"], t), x, p["a"]) * p["b"],
}


@pytest.mark.promotes
@pytest.mark.parametrize("name", NOT_FOUND)
def test_nothing_is_accused_that_does_not_jump_with_the_parameter(name):
    """A mode that does not occur is not named either."""
    found = find_comparisons(make_comparing(NOT_FOUND[name], n=FOUND["where"]))
    assert (found.get(0), found.get(1)) == (None, None)


def test_other_functions_and_the_names_of_a_map():
    observe = lambda t, x, p: jnp.where(t < p["own"], x, 2.0 * x)  # noqa: E731
    problem = make_comparing(lambda t, x, p: -p["b"] * x, observe=observe, parameter_map={"own": "a"})
    line = observe.__code__.co_firstlineno
    assert find_comparisons(problem).get(0) == f"observe 1 compares with own at test_what_functions_read.py:{line}"
