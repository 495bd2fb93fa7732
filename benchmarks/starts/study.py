"""Run all starts and keep their outcomes on file, so that a study that was interrupted goes on."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import switchfit as sf
from benchmarks.starts.end import judge
from benchmarks.starts.methods import list_methods, why_not
from benchmarks.starts.problems import build_case

REFERENCE = "from the truth"
"""Name of the method that fits from where the best known answer is; start -1."""

Outcome = dict[str, Any]
"""problem and case (its identity), method, start and its digest, seconds; an error, or what `End` and `judge` have."""


@dataclass(frozen=True)
class Job:
    """One start (-1: from the truth) of one problem with one method."""

    problem: str
    method: str
    start: int
    digest: str

    @property
    def key(self) -> tuple[str, str, int, str]:
        """What outcomes on file are found by."""
        return self.problem, self.method, self.start, self.digest


@cache
def digest_source() -> str:
    """Return a digest of the sources of switchfit and of the methods: outcomes of other versions do not count."""
    folder, here = Path(sf.__file__).parent, Path(__file__).parent
    found = hashlib.sha256()
    for path in [*sorted(folder.rglob("*.py")), *(here / name for name in ("end.py", "methods.py", "peers.py"))]:
        name = path.relative_to(folder) if path.is_relative_to(folder) else path.name
        found.update(str(name).encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()[:10]


def read_outcomes(path: Path) -> list[Outcome]:
    """Return the outcomes in a file, without a last line that a killed study left unfinished."""
    text = path.read_text(encoding="utf-8")
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]


class Outcomes:
    """The outcomes of one version of switchfit in a file of JSON lines; each is appended by one write."""

    def __init__(self, path: Path, fresh: bool = False) -> None:
        self.path = path
        self.found: dict[tuple[str, str, int, str], Outcome] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        if fresh:
            path.unlink(missing_ok=True)
        if path.exists():
            for outcome in read_outcomes(path):
                self._take(outcome)
            os.truncate(path, path.read_bytes().rfind(b"\n") + 1)

    def add(self, outcome: Outcome) -> None:
        """Write one outcome."""
        line = json.dumps(outcome) + "\n"
        with self.path.open("ab", buffering=0) as file:
            file.write(line.encode())
            os.fsync(file.fileno())
        self._take(outcome)

    def _take(self, outcome: Outcome) -> None:
        self.found[(outcome["problem"], outcome["method"], outcome["start"], outcome["digest"])] = outcome


def list_jobs(problems: Iterable[str], methods: Iterable[str], count: int | None) -> list[Job]:
    """Return all jobs, problem by problem, each beginning with the fit from the truth."""
    jobs = []
    for problem in problems:
        case = build_case(problem, count)
        jobs.append(Job(problem, REFERENCE, -1, case.identity))
        for method in methods:
            if not why_not(method, case):
                jobs += [Job(problem, method, k, case.digest(k)) for k in range(len(case.starts))]
    return jobs


def run_job(job: Job) -> Outcome:
    """Fit one start; an error is an outcome like any other."""
    case = build_case(job.problem)
    known: Outcome = {"problem": job.problem, "case": case.identity, "method": job.method}
    known |= {"start": job.start, "digest": job.digest}
    reference = job.method == REFERENCE
    fit = list_methods()["exact" if reference else job.method]
    start = case.near if reference else case.starts[job.start]
    began = time.perf_counter()
    try:
        end = fit(case, start)
        seconds = time.perf_counter() - began
        return {**known, "seconds": seconds, **asdict(end), **judge(case.problem, end.theta)}
    except Exception as error:
        return {**known, "seconds": time.perf_counter() - began, "error": f"{type(error).__name__}: {error}"}


def run_jobs(jobs: list[Job], outcomes: Outcomes, processes: int = 1) -> None:
    """Run the jobs that have no outcome yet, and say on stderr how far it is."""
    missing = [job for job in jobs if job.key not in outcomes.found]
    began, last = time.monotonic(), 0.0
    for number, outcome in enumerate(_run_all(missing, processes), start=1):
        outcomes.add(outcome)
        now = time.monotonic()
        if now - last > 1.0 or number == len(missing):
            last, elapsed = now, now - began
            left = elapsed / number * (len(missing) - number)
            what = f"{outcome['problem']}, {outcome['method']}, start {outcome['start'] + 1}"
            print(
                f"{number} of {len(missing)} starts, {elapsed:.0f} s, some {left:.0f} s left: {what}", file=sys.stderr
            )


def _run_all(jobs: list[Job], processes: int) -> Iterator[Outcome]:
    if processes == 1:
        yield from map(run_job, jobs)
        return
    # Processes are started anew: a fork of one in which JAX has threads may hang.
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures: list[Future[Outcome]] = [pool.submit(run_job, job) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
