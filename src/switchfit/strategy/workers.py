"""Short fits on all cores, by processes: in threads they wait for one another, since most of a fit is Python.

A worker is a new Python process with a pipe each way, and not one of `multiprocessing`, which would run the user's
script again in each of them. The problem travels once, by cloudpickle, so that it may be made of functions of a script
or a notebook; its programs come from the cache on disk. A worker whose pipe is closed ends, also where this process is
killed.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Generator
from contextlib import suppress
from typing import IO, Any, cast

import numpy as np

from switchfit.fit.evaluator import evaluator_of
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.runtime.cores import count_cores
from switchfit.strategy.quick import End, check_time, fit_briefly

START_UP = 2.0
"""Seconds that fits have lasted, and may last yet, before workers are started: a worker is ready after 1.1 to 1.6 s of
CPU time, most of them for JAX's import, and its first fit takes 0.2 to 0.8 s longer than others."""

AHEAD = 4
"""Fits for each process that may be under way or done beyond the one that is waited for."""

POLL = 0.05
"""Longest wait in seconds: Ctrl-C is handled between two waits."""

MOST_WORKERS = 15
"""Workers at most: each takes some 300 MB."""

SETTINGS = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM")} | {
    "JAX_PLATFORMS": "cpu"  # JAX would take most of a GPU's memory for each worker, and only traces
}
"""Environment of a worker."""


def fit_all(problem: Problem, starts: FloatArray, cores: int | None = None) -> Generator[End, None, None]:
    """Yield where short fits from starts (S, d) end, in their order, on all cores where they last long enough.

    Parameters
    ----------
    problem : Problem
    starts : (S, d)
    cores : int, optional
        Processes to work with, this one among them; as many as there are cores if left out.
    """
    cores = count_cores() if cores is None else cores
    began = time.monotonic()
    for k, start in enumerate(starts):
        elapsed = time.monotonic() - began
        if k and cores > 1 and elapsed >= START_UP:
            worth = int(elapsed / k * (len(starts) - k) / START_UP)
            blob = _pack(problem) if worth else None
            if blob is not None:
                yield from _fit_with_workers(problem, starts[k:], blob, min(cores - 1, worth, MOST_WORKERS))
                return
            cores = 1
        yield fit_briefly(problem, start)


def _pack(problem: Problem) -> bytes | None:
    """Return the pickled problem; None if it cannot be pickled, or workers would have to compile it again."""
    if not sys.executable or evaluator_of(problem).engine.name != "native":
        return None
    import cloudpickle  # here, since few fits need it

    try:
        blob: bytes = cloudpickle.dumps(problem)
    except Exception:  # pickling calls methods of the user's objects, which may raise anything
        return None
    return blob


def _fit_with_workers(problem: Problem, starts: FloatArray, blob: bytes, count: int) -> Generator[End, None, None]:
    """Yield the ends in the order of the starts; this process fits as well."""
    shared = _Shared(starts, AHEAD * (count + 1))
    workers: list[_Worker] = []
    try:
        for _ in range(count):
            workers.append(_Worker(blob, shared))
        for k in range(len(starts)):
            while (end := shared.wait_for(k)) is None:
                check_time()
                mine = shared.take()
                if mine is not None:
                    shared.put(mine, fit_briefly(problem, starts[mine]))
            yield end
    finally:
        shared.close()
        for worker in workers:
            worker.end()


class _Shared:
    """Thread-safe queue of starts, and the ends of those that are done."""

    def __init__(self, starts: FloatArray, ahead: int) -> None:
        self.starts, self.ahead = starts, ahead
        self._ends: dict[int, End] = {}
        self._next, self._wanted, self.closed = 0, 0, False
        self._changed = threading.Condition()

    def take(self) -> int | None:
        """Return the number of the next start; None if enough of them are under way."""
        with self._changed:
            if self.closed or self._next >= min(len(self.starts), self._wanted + self.ahead):
                return None
            self._next += 1
            return self._next - 1

    def put(self, k: int, end: End) -> None:
        """Store the end of a fit."""
        with self._changed:
            self._ends[k] = end
            self._changed.notify_all()

    def wait_for(self, k: int) -> End | None:
        """Return the end of a fit; None if it is not done and another start can be taken, or after `POLL` seconds."""
        with self._changed:
            self._wanted = k
            if k not in self._ends and self._next >= min(len(self.starts), k + self.ahead):
                self._changed.wait(POLL)
            return self._ends.pop(k, None)

    def wait(self) -> None:
        """Wait until a start can be taken, at most `POLL` seconds."""
        with self._changed:
            if not self.closed:
                self._changed.wait(POLL)

    def close(self) -> None:
        """Hand out no more starts."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()


class _Worker:
    """A process that fits, and the thread that feeds it."""

    def __init__(self, blob: bytes, shared: _Shared) -> None:
        self._shared = shared
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", "from switchfit.strategy.workers import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | SETTINGS | {"PYTHONPATH": path},
            start_new_session=True,  # Ctrl-C is for this process alone
        )
        self._thread = threading.Thread(target=self._feed, args=(blob,), daemon=True)
        self._thread.start()

    def _feed(self, blob: bytes) -> None:
        sent, received = (cast("IO[bytes]", pipe) for pipe in (self._process.stdin, self._process.stdout))
        taken: int | None = None
        try:
            pickle.dump(blob, sent)
            sent.flush()
            pickle.load(received)  # it is ready
            while not self._shared.closed:
                taken = self._shared.take()
                if taken is None:
                    self._shared.wait()
                    continue
                pickle.dump(self._shared.starts[taken], sent)
                sent.flush()
                self._shared.put(taken, End(*pickle.load(received)))
                taken = None
        except (OSError, EOFError, ValueError, pickle.UnpicklingError):
            if taken is not None:  # the process has crashed: a start that failed
                self._shared.put(taken, End(self._shared.starts[taken], np.inf, 0))

    def end(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.wait()
        self._thread.join()
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):  # closing flushes what was not sent
                cast("IO[bytes]", pipe).close()


def serve() -> None:
    """Run a worker: fit the starts that come through the pipe until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    received, sent = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a model prints must not get between the answers
    try:
        import cloudpickle

        problem: Problem = cloudpickle.loads(pickle.load(received))
        answer: Any = "ready"
        while True:
            pickle.dump(answer, sent)
            sent.flush()
            answer = tuple(fit_briefly(problem, pickle.load(received)))
    except (EOFError, BrokenPipeError):
        return
