"""Machine code: functions as scalars, threads, the cache, fall-backs to JAX, the layout of what XLA hands over."""

from __future__ import annotations

import inspect
import logging
import re
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.models import decay, one_run
from support.systems import problem_of
from switchfit.engine.native import program as program_module
from switchfit.engine.native import program_cache
from switchfit.engine.native.llvm import compilation
from switchfit.engine.native.llvm.module import Module
from switchfit.engine.native.loops import xla_handler
from switchfit.engine.native.program_cache import drop_programs
from switchfit.engine.native.scalars.graph import Graph
from switchfit.meshes.evaluator import Evaluator, evaluator_of

# Functions as scalars


def test_structural_zeros_and_repetitions_are_gone():
    graph = Graph()
    x, y = graph.load("x", 0), graph.load("x", 1)
    assert (x * 0.0).number == (graph.unit(0) * 0.0).number == 0.0
    assert x * 1.0 is x + 0.0 is graph.apply("neg", -x) is x
    assert x * y is y * x is -((-x) * y)
    assert x - (-y) is x + y
    before = len(graph.nodes)
    assert x * y + x * y is x * y + x * y
    assert len(graph.nodes) == before + 1


# Derivatives


def test_threads_do_not_disturb_one_another():
    """Nor does an evaluation change the results of an earlier one."""
    evaluator = evaluator_of(problem_of("resets"))
    thetas = [evaluator.problem.initial_theta + 1e-3 * k for k in range(40)]
    expected = [evaluator(theta) for theta in thetas]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(evaluator, thetas * 5))
    for one, other in zip(found, expected * 5, strict=True):
        assert one.cost == other.cost
        np.testing.assert_array_equal(one.gradient, other.gradient)
        np.testing.assert_array_equal(one.hessian, other.hessian)


# The cache


def test_machine_code_is_kept_and_read_again(tmp_path, monkeypatch):
    module, parse = Module(2), compilation.llvm.parse_assembly
    module.write_straight_line("f", [("x", 1, Graph().load("x", 0) * 3.0)])
    text = module.take()

    def triple(cache, parse=parse):
        monkeypatch.setenv("SWITCHFIT_CACHE", str(cache))
        monkeypatch.setattr(compilation.llvm, "parse_assembly", parse)
        x = np.array([2.0, 0.0])
        program = compilation.compile_modules([text])
        program.function("f", 1)(x.ctypes.data)
        return x[1]

    def parse_nothing(text):
        assert text == ""
        return parse(text)

    assert triple(tmp_path) == 6.0
    (file,) = tmp_path.glob("native-*")
    assert triple(tmp_path, parse_nothing) == 6.0, "read, not compiled again"
    file.write_bytes(file.read_bytes()[:-100])
    assert triple(tmp_path) == 6.0, "a damaged file is compiled anew"
    assert triple("off") == 6.0


# Which engine, and why


def copied(t, x, p):
    return -p["k"] * jnp.copysign(x, x)


def inner_copied(t, x, p):
    return jax.lax.cond(x[0] > 0, lambda x: -p["k"] * jnp.copysign(x, x), lambda x: x, x)


TIMES = np.linspace(0.3, 3.0, 10)
SAMPLES = sf.Measurements(TIMES, np.stack([np.sin(TIMES), np.cos(TIMES)], 1), sigma=1.0)


def problem_with(mode, data=SAMPLES, **settings):
    return one_run(sf.HybridSystem({"m": mode}, [0.4, 0.1]), data, ("m",), (), 3.0, {"k": 1.0}, **settings)


@pytest.mark.parametrize("mode", [copied, pytest.param(inner_copied, marks=pytest.mark.slow)])
@pytest.mark.usefixtures("quick_certificates")
def test_an_estimate_says_which_line_of_the_model_has_no_machine_code(mode, tmp_path, caplog):
    drop_programs()
    with caplog.at_level(logging.INFO, "switchfit"):
        estimate = sf.estimate(problem_with(mode), max_iterations=1)
    reason = f"mode 'm' calls jnp.copysign (test_machine_code.py:{inspect.getsourcelines(mode)[1] + 1})"
    assert (estimate.engine.name, estimate.engine.reason) == ("jax", reason)
    assert " ".join(str(estimate).split()).count(f"Evaluated by JAX: {reason}.") == 1
    said = [record.getMessage() for record in caplog.records if record.name == "switchfit"]
    # Once a program: without derivatives beside them, and with first ones; of the mode, and of its branches.
    assert f"No machine code: {reason}." in said
    assert len(said) <= 4
    estimate.save(tmp_path / "fit.json")
    assert sf.Estimate.load(tmp_path / "fit.json").engine == estimate.engine


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (sf.RunningCost(lambda t, x, p: jnp.copysign(x, x)[0] ** 2), "mode 'm' or a running cost calls jnp.copysign"),
        (replace(SAMPLES, observe=lambda t, x, p: jnp.copysign(x, x)), "observe of Measure"),
        (sf.TerminalCost(lambda x, p: jnp.max(jnp.copysign(x, x))), "a terminal cost calls jnp.copysign"),
        ([SAMPLES, sf.TerminalConstraint(lambda x, p: jnp.fft.fft(x).real)], "a terminal constraint calls jnp.fft"),
    ],
    ids=["running cost", "observe", "terminal cost", "constraint"],
)
def test_other_reasons_for_jax(data, reason):
    engine = evaluator_of(problem_with(decay, data, solver="explicit")).engine
    assert engine.name == "jax"
    assert engine.reason.startswith(reason)


@pytest.mark.parametrize("guarded", [False, True])
def test_a_loop_of_unknown_length_is_differentiated_forward(guarded):
    """JAX has no reverse derivatives of it. Half of the state is reached by halving it until it is below one."""

    def halve(x):
        return jax.lax.while_loop(lambda y: y[0] > 1.0, lambda y: 0.5 * y, x)

    def build(scale):
        system = sf.HybridSystem(
            {"a": lambda t, x, p: -p["k"] * scale(x), "b": lambda t, x, p: -x},
            [1.9],
            guards={("a", "b"): lambda t, x, p: x[0] - 1.3} if guarded else {},
        )
        data = sf.Measurements(np.linspace(0.1, 1.0, 10), np.exp(-np.linspace(0.1, 1.0, 10)), sigma=0.1)
        return sf.Problem(system, sf.Experiment(data, ("a", "b"), (0.4,), 0.0, 1.0), {"k": 0.9})

    looping, plain = evaluator_of(build(halve)), evaluator_of(build(lambda x: 0.5 * x))
    theta = looping.problem.initial_theta
    assert "while_loop" in looping.engine.reason
    for matrix in ("exact", "none", "gauss-newton"):
        found, expected = (each(theta, matrix=matrix) for each in (looping, plain))
        np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-7)
        np.testing.assert_allclose(found.hessian, expected.hessian, rtol=1e-6)
    if guarded:
        found, expected = (each.constrained(theta, 1, np.array([0.7])) for each in (looping, plain))
        np.testing.assert_allclose(found.hessian, expected.hessian, rtol=1e-6)
    with pytest.raises(ValueError, match=r"write jax\.lax\.scan"):
        looping.engines[0].costates(*looping.problem.vectors(theta, 0), np.zeros(int(guarded)))


@pytest.mark.parametrize(
    ("module", "place", "error"),
    [
        (program_module, "_write", KeyError("add")),
        (program_cache, "compile_modules", RuntimeError("LLVM IR parsing error")),
    ],
)
def test_a_defect_of_ours_falls_back_and_says_so(module, place, error, monkeypatch):
    def fails(*_):
        raise error

    drop_programs()
    monkeypatch.setattr(module, place, fails)
    engine = sf.estimate(problem_with(decay), max_iterations=1).engine
    assert (engine.name, engine.reason) == ("jax", f"internal: {type(error).__name__}: {error}")
    drop_programs()


def test_a_program_that_is_compiled_can_be_interrupted(monkeypatch):
    """Compiling takes seconds for long functions: the wait for it ends with Ctrl-C."""
    drop_programs()
    monkeypatch.setenv("SWITCHFIT_CACHE", "off")
    waiting, release, done = threading.Event(), threading.Event(), []
    parse, wait = compilation.llvm.parse_assembly, compilation.wait

    def parse_slowly(text):
        release.wait(60.0)
        done.append(True)
        return parse(text)

    def wait_seen(*given, **settings):
        waiting.set()
        return wait(*given, **settings)

    def press_ctrl_c():
        waiting.wait()
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    monkeypatch.setattr(compilation.llvm, "parse_assembly", parse_slowly)
    monkeypatch.setattr(compilation, "wait", wait_seen)
    threading.Thread(target=press_ctrl_c).start()
    with pytest.raises(KeyboardInterrupt):
        Evaluator(problem_of("resets"))
    assert not done, "not heard before the code was there"
    release.set()
    drop_programs()


# XLA's frames, against the header of the JAX that is installed


HEADER = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text()


def fields_of(name):
    """Names of the fields of a struct, in order."""
    body = re.search(rf"struct XLA_FFI_{name} \{{(.*?)\n\}}[^;]*;", HEADER, re.S)[1]
    code = re.sub(r"//[^\n]*|/\*.*?\*/", "", body, flags=re.S)
    return [declaration.split()[-1] for declaration in code.split(";") if declaration.strip()]


@pytest.mark.parametrize(
    ("name", "fields"),
    [  # up to the last one that is read; each takes eight bytes, but `args` in a frame, a struct of five such
        ("CallFrame", "struct_size extension_start api ctx stage args rets"),
        ("Args", "struct_size extension_start size types args"),
        ("Rets", "struct_size extension_start size types rets"),
        ("Buffer", "struct_size extension_start dtype data rank dims"),
        ("Extension_Base", "struct_size type next"),
        ("Metadata_Extension", "extension_base metadata"),
        ("Metadata", "struct_size api_version traits"),
        ("Api_Version", "struct_size extension_start major_version minor_version"),
    ],
)
def test_structs_have_the_fields_of_which_the_offsets_are_known(name, fields):
    assert fields_of(name)[: len(fields.split())] == fields.split()


def test_the_offsets_and_the_version_are_those_of_the_header():
    args, rets = (8 * fields_of(name).index(name.lower()) for name in ("Args", "Rets"))
    assert 8 * fields_of("CallFrame").index("extension_start") == xla_handler.FRAME_EXTENSION
    assert (5 * 8 + args, 5 * 8 + 5 * 8 + rets) == (xla_handler.FRAME_ARGUMENTS, xla_handler.FRAME_RESULTS)
    data, dimensions = (8 * fields_of("Buffer").index(name) for name in ("data", "dims"))
    assert (data, dimensions) == (xla_handler.BUFFER_DATA, xla_handler.BUFFER_DIMENSIONS)
    major, minor = (int(re.search(rf"#define XLA_FFI_API_{name} (\d+)", HEADER)[1]) for name in ("MAJOR", "MINOR"))
    assert major == xla_handler.FFI_MAJOR
    assert minor >= xla_handler.FFI_MINOR
