"""Machine code against JAX: functions as scalars, derivatives, simulations, sensitivities, batches, fall-backs."""

from __future__ import annotations

import inspect
import logging
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import decay
from systems import KINDS, NODES, P0, case, problem_of

import switchfit as sf
from switchfit.engine.native import kernels, llvm
from switchfit.engine.native import program as program_module
from switchfit.engine.native.engine import foreign_derivatives
from switchfit.engine.native.experiment import native_experiment, places_in_library
from switchfit.engine.native.program import drop_programs
from switchfit.engine.native.scalars import Graph, Node
from switchfit.engine.native.templates import Order
from switchfit.fit.evaluator import Evaluator, evaluator_of
from switchfit.problem.functions import use_float64

# Functions as scalars


def test_structural_zeros_and_repetitions_are_gone():
    graph = Graph()
    x, y = graph.load("x", 0), graph.load("x", 1)
    assert (x * 0.0).number == 0.0
    assert x * 1.0 is x
    assert x + 0.0 is x
    assert x * y is y * x
    assert (-x) * y is -(x * y)
    assert graph.apply("neg", -x) is x
    assert x - (-y) is x + y
    before = len(graph.nodes)
    assert x * y + x * y is x * y + x * y
    assert len(graph.nodes) == before + 1
    assert (graph.unit(0) * 0.0).number == 0.0
    assert isinstance(graph.unit(0) * x, Node)
    assert (graph.unit(0) * x).vector


# Derivatives

INSIDE = {"plain": [0.613, 1.287], "resets": [0.413, 0.791, 1.336]}
CHOSEN = [pytest.param("plain", marks=pytest.mark.slow), "resets"]
"""What the plain system shows, the other one shows too."""


def natively(this, arguments, tau, p, side=1):
    nodes = np.asarray(arguments.nodes)
    native = native_experiment(this.structure, arguments, np.unique(nodes), Order.HESSIAN)
    found = native(np.asarray(tau, float), np.asarray(p, float), side)
    return found.cost, found.gradient, found.hessian


def assert_close(found, expected, relative=2e-12):
    assert found[0] == pytest.approx(expected.cost, rel=relative)
    np.testing.assert_allclose(found[1], expected.gradient, rtol=0, atol=relative * np.abs(expected.gradient).max())
    if np.isfinite(found[2]).all():
        np.testing.assert_allclose(found[2], expected.hessian, rtol=0, atol=relative * np.abs(expected.hessian).max())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", CHOSEN)
def test_machine_code_against_automatic_differentiation(name, kind):
    """... of the richer system; and of the other one against JAX's adjoint, whose program other files share."""
    this = case(name)
    at = this.arguments(kind), np.array(INSIDE[name]), P0
    expected = this.forward(*at) if name == "resets" else this.discrete(*at)
    assert np.abs(expected.hessian).min() > 1e-6, "an entry is not tested"
    assert_close(natively(this, *at), expected)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("tau", [NODES[[5, 9, 14]], NODES[[4, 4, 13]], NODES[[4, 4, 4]], [0.413, 0.413, 1.287]])
def test_transitions_on_nodes_and_samples_and_on_one_another(tau, side):
    this = case("resets")
    at = this.arguments(), np.array(tau), P0, side
    assert_close(natively(this, *at), this.forward(*at))


@settings(max_examples=25, deadline=None)
@given(
    times=st.lists(st.floats(0.0, 2.0), min_size=3, max_size=3),
    p=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    side=st.sampled_from([-1, 1]),
)
def test_machine_code_anywhere(times, p, side):
    this = case("resets")
    at = this.arguments(), np.sort(times), np.array(p), side
    found, expected = natively(this, *at), this.discrete(*at)
    scale = max(1.0, np.abs(expected.hessian).max())
    np.testing.assert_allclose(found[2], expected.hessian, rtol=0.0, atol=1e-11 * scale)


def test_stages_one_at_a_time(monkeypatch):
    """As where functions would become too long."""
    monkeypatch.setattr(kernels, "SHORT", 0)
    drop_programs()
    this = case("resets")
    at = this.arguments(), np.array(INSIDE["resets"]), P0
    assert_close(natively(this, *at), this.discrete(*at))
    drop_programs()


def both(problem, relative=1e-11):
    """Cost, gradient and Hessian by machine code and by JAX at the guess, which must agree; J alone as well."""
    theta = problem.initial_theta
    evaluator = evaluator_of(problem)
    assert evaluator.engine.name == "native", evaluator.engine
    found = evaluator(theta)
    expected = evaluator(theta, method="discrete-adjoint")
    assert_close((found.cost, found.gradient, found.hessian), expected, relative)
    for own in (found, expected):
        assert own.gradient.flags.writeable
        assert own.hessian.flags.writeable
    assert evaluator.cost(theta) == pytest.approx(expected.cost, rel=relative)
    first = evaluator(theta, matrix="none")
    assert_close((first.cost, first.gradient, first.hessian), expected, relative)
    return expected


def swing(t, x, p):
    return jnp.array([x[1], -p["k"] * jnp.sin(x[0]) - p["c"][0] * x[1] + p["c"][1] * jnp.cos(t)])


def fall(t, x, p):
    return jnp.array([x[1], -p["g"] - p["c"][0] * x[1] * jnp.abs(x[1])])


PENDULUM = sf.HybridSystem({"swing": swing, "fall": fall}, [0.4, 0.1])
TIMES = np.linspace(0.3, 3.0, 10)
VALUES = np.stack([np.sin(TIMES), np.cos(TIMES)], 1)


def fixed(value):
    return sf.Parameter(value, fixed=True)


@pytest.mark.slow
def test_one_unknown_and_none_in_an_experiment():
    """Vectors of one entry; an experiment without unknowns of its own is left to JAX, but not the others."""
    data = sf.Measurements(TIMES, VALUES, sigma=1.0)
    both(sf.Problem(PENDULUM, sf.Experiment(data, ("fall",), (), 0.0, 3.0), {"g": 1.0, "c": fixed([0.1, 0.2])}))
    runs = [
        sf.Experiment(data, ("fall",), (), 0.0, 3.0),
        sf.Experiment(data, ("swing",), (), 0.0, 3.0, parameter_map={"k": "other"}),
    ]
    problem = sf.Problem(PENDULUM, runs, {"g": fixed(1.0), "c": fixed([0.1, 0.2]), "other": sf.Parameter(2.0)})
    evaluator = evaluator_of(problem)
    theta = problem.initial_theta
    assert [each.engine.name for each in evaluator.engines] == ["jax", "native"]
    assert evaluator.engine.reason == (
        "an experiment has no unknowns (in run1; the other experiments run in machine code)"
    )
    assert evaluator(theta).cost == pytest.approx(evaluator(theta, method="discrete-adjoint").cost, rel=1e-12)
    assert evaluator.cost(theta) == pytest.approx(evaluator(theta).cost, rel=1e-12)


def test_results_of_one_evaluation_survive_the_next():
    evaluator = evaluator_of(problem_of("plain"))
    theta = evaluator.problem.initial_theta
    first = evaluator(theta)
    kept = first.gradient.copy(), first.hessian.copy()
    evaluator(theta + 0.01)
    np.testing.assert_array_equal(first.gradient, kept[0])
    np.testing.assert_array_equal(first.hessian, kept[1])


def test_threads_do_not_disturb_one_another():
    evaluator = evaluator_of(problem_of("resets"))
    thetas = [evaluator.problem.initial_theta + 1e-3 * k for k in range(40)]
    expected = [evaluator(theta) for theta in thetas]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(evaluator, thetas * 5))
    for one, other in zip(found, expected * 5, strict=True):
        assert one.cost == other.cost
        np.testing.assert_array_equal(one.hessian, other.hessian)


# What falls back to JAX


# Simulations, sensitivities, batches


def assert_same_simulation(one, other, relative):
    assert one.cost == pytest.approx(other.cost, rel=relative)
    for column in ("nodes", "first_cell", "start", "end", "before", "after", "y_before", "y_after"):
        found, expected = getattr(one, column), getattr(other, column)
        np.testing.assert_allclose(found, expected, rtol=relative, atol=1e-12, err_msg=column)
    for found, expected in zip(one.seen, other.seen, strict=True):
        np.testing.assert_allclose(found, expected, rtol=relative, atol=1e-12)
    for found, expected in zip(one.tangents or (), other.tangents or (), strict=True):
        np.testing.assert_allclose(found, expected, rtol=relative, atol=1e-12)


@pytest.mark.parametrize("tangents", [False, True])
@pytest.mark.parametrize("name", CHOSEN)
def test_simulations_are_those_of_jax(name, tangents):
    problem = problem_of(name)
    theta = problem.initial_theta
    (found,) = evaluator_of(problem).simulate(theta, tangents=tangents)
    (expected,) = Evaluator(replace(problem, engine="jax")).simulate(theta, tangents=tangents)
    assert (found.tangents is not None) is tangents
    assert_same_simulation(found, expected, 1e-11)


def test_inside_a_program_of_jax():
    """The operation that batches use, alone and in a loop, on a padded mesh."""
    this = case("resets")
    arguments, tau = this.arguments(), np.array(INSIDE["resets"])
    expected = this.discrete(arguments, tau, P0)
    places = places_in_library(this.structure)
    with use_float64():
        one = jax.jit(lambda a, tau, p: foreign_derivatives(this.structure, a, tau, p, 1.0, places))
        assert_close(tuple(map(np.asarray, one(arguments, tau, P0))), expected)
        many = jax.jit(
            lambda a, taus, p: jax.lax.map(lambda t: foreign_derivatives(this.structure, a, t, p, 1.0, places), taus)
        )
        J, g, H = map(np.asarray, many(arguments, np.stack([tau, tau + 0.01]), P0))
        at_once = jax.jit(
            jax.vmap(lambda a, t, p: foreign_derivatives(this.structure, a, t, p, 1.0, places), in_axes=(None, 0, None))
        )
        together = tuple(map(np.asarray, at_once(arguments, np.stack([tau, tau + 0.01]), P0)))
    for k, shift in enumerate((0.0, 0.01)):
        expected = this.discrete(arguments, tau + shift, P0)
        assert_close((J[k], g[k], H[k]), expected)
        assert_close(tuple(found[k] for found in together), expected)


# The cache


def test_machine_code_is_kept_and_read_again(tmp_path, monkeypatch):
    monkeypatch.setenv("SWITCHFIT_CACHE", str(tmp_path))
    module = llvm.Module(2)
    graph = Graph()
    module.write_straight_line("f", [("x", 1, graph.load("x", 0) * 3.0)])

    text = module.take()

    def tripled():
        x = np.array([2.0, 0.0])
        program = llvm.compile_modules([text])
        program.function("f", llvm.ctypes.c_void_p)(x.ctypes.data)
        return x[1]

    assert tripled() == 6.0
    (file,) = tmp_path.glob("native-*")
    monkeypatch.setattr(llvm.llvm, "parse_assembly", _only_empty(llvm.llvm.parse_assembly))
    assert tripled() == 6.0, "read, not compiled again"
    monkeypatch.undo()
    monkeypatch.setenv("SWITCHFIT_CACHE", str(tmp_path))
    file.write_bytes(file.read_bytes()[:-100])
    assert tripled() == 6.0, "a damaged file is compiled anew"
    monkeypatch.setenv("SWITCHFIT_CACHE", "off")
    assert tripled() == 6.0


def _only_empty(parse):
    def checked(text):
        assert text == ""
        return parse(text)

    return checked


# Which engine, and why


def copied(t, x, p):
    return -p["k"] * jnp.copysign(x, x)


def inner_copied(t, x, p):
    return jax.lax.cond(x[0] > 0, lambda x: -p["k"] * jnp.copysign(x, x), lambda x: x, x)


def fitted_with(mode, **settings):
    data = settings.pop("data", sf.Measurements(TIMES, VALUES, sigma=1.0))
    run = sf.Experiment(data, ("m",), (), 0.0, 3.0)
    problem = sf.Problem(sf.HybridSystem({"m": mode}, [0.4, 0.1]), run, {"k": sf.Parameter(1.0)}, **settings)
    return sf.estimate(problem, max_iterations=1)


def line_of(function, text):
    """The line of this file in which a function has a text."""
    lines, first = inspect.getsourcelines(function)
    return first + next(k for k, line in enumerate(lines) if text in line)


@pytest.mark.usefixtures("quick_certificates")
def test_an_estimate_says_that_machine_code_evaluated_it(tmp_path):
    estimate = fitted_with(decay)
    assert (estimate.engine.name, estimate.engine.reason) == ("native", None)
    assert "Evaluated in machine code." in str(estimate)
    estimate.save(tmp_path / "fit.json")
    assert sf.Estimate.load(tmp_path / "fit.json").engine == estimate.engine


@pytest.mark.parametrize("mode", [copied, pytest.param(inner_copied, marks=pytest.mark.slow)])
@pytest.mark.usefixtures("quick_certificates")
def test_an_estimate_says_which_line_of_the_model_has_no_machine_code(mode, tmp_path, caplog):
    drop_programs()
    with caplog.at_level(logging.INFO, "switchfit"):
        estimate = fitted_with(mode)
    reason = f"mode 'm' calls jnp.copysign (test_native.py:{line_of(mode, 'jnp.copysign')})"
    assert (estimate.engine.name, estimate.engine.reason) == ("jax", reason)
    assert " ".join(str(estimate).split()).count(f"Evaluated by JAX: {reason}.") == 1
    said = [record.getMessage() for record in caplog.records if record.name == "switchfit"]
    # Once a program: without derivatives beside them, and with first ones; of the mode, and of its branches.
    assert f"Evaluated by JAX: {reason}." in said
    assert len(said) <= 4
    assert all(each.endswith(f"(test_native.py:{line_of(mode, 'jnp.copysign')}).") for each in said)
    estimate.save(tmp_path / "fit.json")
    assert sf.Estimate.load(tmp_path / "fit.json").engine == estimate.engine


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (sf.RunningCost(lambda t, x, p: jnp.copysign(x, x)[0] ** 2), "mode 'm' or a running cost calls jnp.copysign"),
        (sf.Measurements(TIMES, VALUES, observe=lambda t, x, p: jnp.copysign(x, x), sigma=1.0), "observe of Measure"),
        (sf.TerminalCost(lambda x, p: jnp.max(jnp.copysign(x, x))), "a terminal cost calls jnp.copysign"),
        (
            [sf.RunningCost(lambda t, x, p: x @ x), sf.TerminalConstraint(lambda x, p: jnp.fft.fft(x).real)],
            "a terminal constraint calls jnp.fft",
        ),
    ],
    ids=["running cost", "observe", "terminal cost", "constraint"],
)
def test_other_reasons_for_jax(data, reason):
    run = sf.Experiment(data, ("m",), (), 0.0, 3.0)
    problem = sf.Problem(sf.HybridSystem({"m": decay}, [0.4, 0.1]), run, {"k": sf.Parameter(1.0)}, solver="explicit")
    assert evaluator_of(problem).engine.name == "jax"
    assert evaluator_of(problem).engine.reason.startswith(reason)


@pytest.mark.parametrize("place", ["_write", "compile_modules"])
@pytest.mark.parametrize("error", [KeyError("add"), TypeError("truth"), RuntimeError("LLVM IR parsing error")])
def test_a_defect_of_ours_falls_back_and_says_so(place, error, monkeypatch):
    def fails(*_):
        raise error

    drop_programs()
    monkeypatch.setattr(program_module, place, fails)
    estimate = fitted_with(decay)
    assert estimate.engine.name == "jax"
    assert estimate.engine.reason == f"internal: {type(error).__name__}: {error}"
    assert estimate.iterations == 1
    monkeypatch.undo()
    drop_programs()


def test_a_program_that_is_compiled_can_be_interrupted(monkeypatch):
    """Compiling takes seconds for long functions: the wait for it ends with Ctrl-C."""
    drop_programs()
    monkeypatch.setenv("SWITCHFIT_CACHE", "off")
    waiting, release, done = threading.Event(), threading.Event(), []
    parse, wait = llvm.llvm.parse_assembly, llvm.wait

    def slow(text):
        release.wait(60.0)
        done.append(True)
        return parse(text)

    def wait_seen(*given, **settings):
        waiting.set()
        return wait(*given, **settings)

    def ctrl_c():
        waiting.wait()
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    monkeypatch.setattr(llvm.llvm, "parse_assembly", slow)
    monkeypatch.setattr(llvm, "wait", wait_seen)
    problem = problem_of("plain")
    threading.Thread(target=ctrl_c).start()
    with pytest.raises(KeyboardInterrupt):
        Evaluator(problem)
    assert not done, "not heard before the code was there"
    release.set()
    monkeypatch.undo()
    drop_programs()
