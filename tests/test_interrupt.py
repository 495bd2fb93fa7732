"""Ctrl-C is heard while machine code runs, and no loop in it goes on for ever."""

from __future__ import annotations

import signal
import threading
import time

import numpy as np
import pytest
from systems import NODES, P0, case, problem_of

from switchfit.batch.chunks import run_chunks
from switchfit.engine.native import experiment
from switchfit.engine.native.experiment import native_experiment, places_in_library
from switchfit.engine.native.templates import Order
from switchfit.fit.evaluator import evaluator_of


def test_a_long_evaluation_that_was_interrupted_leaves_nothing_behind(monkeypatch):
    """What Ctrl-C has left goes on in the background: the next evaluation waits for its end."""
    evaluator = evaluator_of(problem_of("resets"))
    theta = evaluator.problem.initial_theta
    expected = evaluator(theta)
    native = evaluator.engines[0].at(Order.HESSIAN)
    whole, ended = native._function, []

    def slowly(*given):
        time.sleep(0.3)
        whole(*given)
        ended.append(time.monotonic())

    native._function = slowly
    monkeypatch.setattr(experiment, "LONG", 0)
    threading.Timer(0.1, signal.raise_signal, [signal.SIGINT]).start()
    with pytest.raises(KeyboardInterrupt):
        evaluator(theta + 0.01)
    assert not ended
    native._function = whole
    again = evaluator(theta)
    assert ended
    assert again.cost == expected.cost
    np.testing.assert_array_equal(again.hessian, expected.hessian)


@pytest.mark.parametrize("at_once", [1, 3])
def test_costs_of_schedules_a_few_at_a_time_are_the_same(at_once, monkeypatch):
    this = case("plain")
    native = native_experiment(this.structure, this.arguments(), NODES, Order.COST)
    times = np.sort(np.random.default_rng(0).uniform(0.0, 2.0, (7, 2)))
    places = np.concatenate([which[:-1] for which in places_in_library(this.structure).values()])
    expected = [native.cost(each, P0) for each in times]
    monkeypatch.setattr(experiment, "LONG", at_once * native._work)
    np.testing.assert_array_equal(native.costs(np.tile(places, (7, 1)), times, P0), expected)


class Endless:
    """Work whose second chunk takes very long."""

    size = 1

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
