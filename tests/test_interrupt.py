"""Ctrl-C is heard while machine code runs, and no loop in it goes on for ever."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from systems import NODES, P0, case, problem_of

from switchfit.batch.chunks import run_chunks
from switchfit.engine.adaptive import refine_mesh
from switchfit.engine.native import experiment, program
from switchfit.engine.native.experiment import native_experiment
from switchfit.engine.native.program import drop_programs
from switchfit.engine.native.templates import Order
from switchfit.fit.evaluator import Evaluator, evaluator_of

SLOW = """
import sys, time
import jax
import jax.numpy as jnp
import numpy as np
import switchfit as sf

def slow(t, x, p):
    term = lambda c, k: (jnp.sin(c + p["a"]) * x[0] / k, None)
    return jnp.stack([jax.lax.scan(term, x[0], jnp.arange(1.0, 25.0))[0]])

times = np.linspace(0.0, 3.0, 500_000)
data = sf.Measurements(times, np.zeros((len(times), 1)), sigma=1.0)
problem = sf.Problem(sf.HybridSystem({"slow": slow}, [0.4]), sf.Experiment(data, ("slow",), (), 0.0, 3.0), {"a": 1.0})
assert sf.evaluate(problem).cost > 0  # everything is compiled now
began = time.perf_counter()
sf.evaluate(problem)
print("seconds", time.perf_counter() - began, flush=True)
try:
    while True:
        print("again", flush=True)
        sf.WHAT(problem)
except KeyboardInterrupt:
    print("heard", time.monotonic(), flush=True)
"""


def next_word(process, word):
    """The rest of the next line that the process writes, which must begin with a word."""
    line = process.stdout.readline()
    if not line.startswith(word):
        raise AssertionError(f"{line!r}, not {word}: {process.stderr.read()}")
    return line[len(word) :]


@pytest.mark.slow
@pytest.mark.parametrize("what", ["evaluate", "simulate", "estimate"])
def test_ctrl_c_is_heard_during_machine_code(what):
    """One evaluation takes much longer than the delay that is allowed."""
    script = SLOW.replace("WHAT", what)
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", script], stdout=pipe, stderr=pipe, text=True) as process:
        assert float(next_word(process, "seconds")) > 1.5
        next_word(process, "again")
        time.sleep(0.4)
        sent = time.monotonic()
        process.send_signal(signal.SIGINT)
        heard = float(next_word(process, "heard"))
        process.kill()
    assert heard - sent < 0.5


@pytest.fixture
def row_by_row(monkeypatch):
    """Machine code that returns to Python after each row, sample and step."""

    def switch():
        drop_programs()
        monkeypatch.setattr(experiment, "BUDGET", 1)
        monkeypatch.setattr(program, "BUDGET", 1)

    yield switch
    monkeypatch.undo()
    drop_programs()


def test_evaluations_row_by_row_are_the_same_bit_by_bit(row_by_row):
    """With transitions anywhere, and two of them at one node."""
    this = case("resets")
    arguments = this.arguments()
    nodes = np.unique(np.asarray(arguments.nodes))

    def found(tau):
        given = np.asarray(tau, float), np.asarray(P0, float)
        orders = [native_experiment(this.structure, arguments, nodes, order) for order in (Order.COST, Order.HESSIAN)]
        simulated = orders[1].simulate(*given)
        seen = orders[1].outputs(simulated.times[1:], simulated.after, given[1], simulated.after_d)
        sides = orders[1](*given, 1.0), orders[1](*given, -1.0)
        values = [value for one in sides for value in (one.cost, one.gradient, one.hessian)]
        return [orders[0].cost(*given), *values, *simulated[:-1], *seen]

    times = [0.413, 0.791, 1.336], NODES[[4, 4, 13]]
    expected = [found(tau) for tau in times]
    row_by_row()
    for tau, wanted in zip(times, expected, strict=True):
        for one, other in zip(found(tau), wanted, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_meshes_step_by_step_are_the_same(row_by_row):
    problem = problem_of("resets")
    theta = problem.initial_theta
    expected = refine_mesh(problem, 0, theta)
    cost = Evaluator(problem, meshes=[expected]).cost(theta)
    row_by_row()
    np.testing.assert_array_equal(refine_mesh(problem, 0, theta).times, expected.times)
    assert Evaluator(problem, meshes=[expected]).cost(theta) == cost


def test_an_evaluation_that_was_interrupted_leaves_nothing_behind(row_by_row):
    row_by_row()
    evaluator = evaluator_of(problem_of("resets"))
    theta = evaluator.problem.initial_theta
    expected = evaluator(theta)
    native = evaluator.engines[0].at(Order.HESSIAN)
    whole, calls = native._call_evaluate, []

    def interrupted(*given):
        calls.append(whole(*given))
        if len(calls) == 7:
            raise KeyboardInterrupt

    native._call_evaluate = interrupted
    with pytest.raises(KeyboardInterrupt):
        evaluator(theta + 0.01)
    native._call_evaluate = whole
    again = evaluator(theta)
    assert again.cost == expected.cost
    np.testing.assert_array_equal(again.hessian, expected.hessian)


class Endless:
    """Work whose second chunk takes very long."""

    size = 1
    most_chunks = 1

    def __init__(self):
        self.released = threading.Event()

    def __call__(self, runs):
        if runs.start:
            self.released.wait(60.0)
        return {"run": np.array(runs)}

    def fingerprint(self):
        return "endless"


def test_a_batch_that_is_stopped_does_not_wait_for_the_chunk_under_way():
    work = Endless()
    began = time.monotonic()
    runs, _ = run_chunks(work, 2, progress=lambda done, total: True)
    waited = time.monotonic() - began
    work.released.set()
    assert runs.tolist() == [0]
    assert waited < 30.0, "as long as the chunk"
