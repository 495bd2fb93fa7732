"""Which parameters the functions of a problem read, and what a fit says of those that none reads."""

import jax.numpy as jnp
import numpy as np
import pytest
from models import decay

import switchfit as sf
from switchfit.problem.inspection import find_unread
from switchfit.uncertainty.verdict import find_issues

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
