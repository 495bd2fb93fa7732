"""Short fits in processes of their own: the same ends as in one, whatever happens to the processes."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from itertools import islice

import numpy as np
import pytest
from test_strategy import FAR, thermostat

from switchfit.fit.random_starts import draw_starts
from switchfit.strategy import workers
from switchfit.strategy.quick import fit_briefly
from switchfit.strategy.starts import try_starts


@pytest.fixture
def started(monkeypatch):
    """The processes that are started, from the first moment on."""
    found, popen = [], subprocess.Popen

    def start(*given, **settings):
        process = popen(*given, **settings)
        if "serve()" in given[0][-1]:  # others are of libraries
            found.append(process)
        return process

    monkeypatch.setattr(workers, "START_UP", 1e-6)
    monkeypatch.setattr(workers.subprocess, "Popen", start)
    return found


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def wait_until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


def wait_for_workers(monkeypatch, number):
    """Let this process fit only after workers have answered so often; return the numbers of the starts it fitted."""
    mine, others, put = [], [], workers._Shared.put

    def note(self, k, end):
        (mine if threading.current_thread() is threading.main_thread() else others).append(k)
        put(self, k, end)

    def fit(*given):
        assert wait_until(lambda: len(others) >= number)
        return fit_briefly(*given)

    monkeypatch.setattr(workers._Shared, "put", note)
    monkeypatch.setattr(workers, "fit_briefly", fit)
    return mine


@pytest.mark.slow
def test_ends_come_in_the_order_of_the_starts(started, monkeypatch):
    """Each says by its theta which start it belongs to; workers have machine code of another kind than the tests."""
    problem = thermostat(FAR)
    starts = draw_starts(problem, 25, 0)[1:]
    first = fit_briefly(problem, starts[0])
    mine = wait_for_workers(monkeypatch, 4)
    together = [first, *workers._fit_with_workers(problem, starts[1:], workers._pack(problem), 2)]
    assert len(started) == 2
    assert 0 < len(mine) <= 19
    for start, other in zip(starts, together, strict=True):
        one = fit_briefly(problem, start)
        assert other.cost == pytest.approx(one.cost, rel=1e-6)
    assert all(process.poll() is not None for process in started)


def test_no_process_is_started_for_a_search_that_ends_soon():
    problem = thermostat(FAR)
    called = []
    popen = workers._Worker
    workers._Worker = lambda *given: called.append(given)
    try:
        list(workers.fit_all(problem, draw_starts(problem, 9, 0)[1:], cores=4))
    finally:
        workers._Worker = popen
    assert called == []


def test_a_crashed_worker_is_a_start_that_failed(started, monkeypatch):
    problem = thermostat(FAR)
    starts = draw_starts(problem, 33, 0)[1:]
    take = workers._Shared.take

    def crash(self):
        taken = take(self)
        if taken is not None and threading.current_thread() is not threading.main_thread():
            started[0].kill()
        return taken

    monkeypatch.setattr(workers._Shared, "take", crash)
    wait_for_workers(monkeypatch, 1)
    ends = list(workers._fit_with_workers(problem, starts, workers._pack(problem), 1))
    failed = [k for k, end in enumerate(ends) if end.failed]
    assert len(failed) == 1
    np.testing.assert_array_equal(ends[failed[0]].theta, starts[failed[0]])


def test_a_worker_that_never_starts_costs_nothing(started, monkeypatch):
    problem = thermostat(FAR)
    starts = draw_starts(problem, 9, 0)[1:]
    monkeypatch.setattr(workers.sys, "executable", "/bin/false")
    ends = list(workers.fit_all(problem, starts, cores=3))
    assert len(started) == 2
    assert [end.cost for end in ends] == [fit_briefly(problem, start).cost for start in starts]


def test_workers_end_with_the_search(started):
    problem = thermostat(FAR)
    starts = draw_starts(problem, 33, 0)[1:]
    found = workers.fit_all(problem, starts, cores=3)
    assert len(list(islice(found, 3))) == 3
    assert all(is_running(process.pid) for process in started)
    found.close()
    assert all(process.poll() is not None for process in started)
    began = time.monotonic()
    answers = iter((False, True))
    few = try_starts(problem, problem.initial_theta, is_enough=lambda cost: next(answers), cores=3)
    assert (len(few.costs), few.ended) == (1, "good")
    assert time.monotonic() - began < 20.0


def test_ctrl_c_ends_the_workers(started, monkeypatch):
    problem = thermostat(FAR)
    count = [0]

    def interrupted(*given):
        count[0] += 1
        if count[0] == 5:
            raise KeyboardInterrupt
        return fit_briefly(*given)

    monkeypatch.setattr(workers, "fit_briefly", interrupted)
    found = try_starts(problem, problem.initial_theta, cores=3)
    assert found.ended == "interrupted"
    assert len(found.costs) >= 1
    assert all(process.poll() is not None for process in started)


SCRIPT = """
import os, sys, time
import numpy as np
import switchfit as sf
from switchfit.fit.random_starts import draw_starts
from switchfit.strategy import starts, workers
workers.START_UP = 1e-6
gain = 0.8
def on(t, x, p):
    return p["power"] - gain * p["k"] * x
def off(t, x, p):
    return -gain * p["k"] * x
system = sf.HybridSystem({"on": on, "off": off}, [0.2])
times = np.linspace(0.25, 10.0, 40)
data = sf.Measurements(times, np.exp(-times / 5), sigma=0.02)
run = sf.Experiment(data, ("on", "off") * 2, (2.0, 4.0, 6.0), 0.0, 10.0)
bounds = {"power": sf.Parameter(1.2, lower=0.2, upper=5.0), "k": sf.Parameter(0.6, lower=0.05, upper=3.0)}
problem = sf.Problem(system, run, bounds)
real, answered = workers.fit_briefly, []
def fit(*given):
    while made_any and len(answered) < WAIT:
        time.sleep(0.05)
    return real(*given)
workers.fit_briefly, made_any = fit, []
starts._is_enough = lambda costs: len(costs) == 30
made = workers._Worker
def make(*given):
    worker = made(*given)
    made_any.append(worker)
    print("worker", worker._process.pid, flush=True)
    return worker
workers._Worker = make
put = workers._Shared.put
def note(self, k, end):
    if workers.threading.current_thread() is not workers.threading.main_thread() and not end.failed:
        answered.append(k)
        print("by a worker", flush=True)
    put(self, k, end)
workers._Shared.put = note
one, several = (starts.try_starts(problem, problem.initial_theta, most=COUNT, cores=cores) for cores in (1, 2))
print("ends", len(several.costs), several.ended)
same = np.array_equal(one.costs, several.costs) and np.array_equal(one.end.theta, several.end.theta)
print("same", same and (one.ended, one.end[1:]) == (several.ended, several.end[1:]))
"""


def run_script(tmp_path, wait, count):
    """A script without a guard for its main part, whose model is its own: what users write."""
    path = tmp_path / "script.py"
    path.write_text(textwrap.dedent(SCRIPT).replace("WAIT", str(wait)).replace("COUNT", str(count)))
    return subprocess.Popen([sys.executable, str(path)], stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_models_of_a_script_are_fitted_by_workers(tmp_path):
    """Without the guard that `multiprocessing` asks for; what is found, bit by bit, is what one process finds."""
    with run_script(tmp_path, 4, 41) as script:
        said = script.communicate(timeout=300)[0].splitlines()
    assert script.returncode == 0
    assert said[-2:] == ["ends 29 settled", "same True"]
    assert said.count("by a worker") > 3
    assert sum(line.startswith("worker") for line in said) == 1


@pytest.mark.slow
def test_a_killed_process_leaves_no_worker_behind(tmp_path):
    with run_script(tmp_path, 1000, 200) as script:
        lines = iter(script.stdout.readline, "")
        pid = int(next(line for line in lines if line.startswith("worker")).split()[1])
        next(line for line in lines if line.startswith("by"))
        os.kill(script.pid, signal.SIGKILL)
    assert wait_until(lambda: not is_running(pid))
