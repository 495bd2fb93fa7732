"""One model, many logs: every log a problem of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from switchfit.accuracy import cost_error
from switchfit.batch.chunks import Arrays, fingerprint
from switchfit.batch.fits import Fits, check_long_run, repeat, sample_count
from switchfit.batch.program import Varying, chunk_size, fit_chunk
from switchfit.estimate import LARGEST_INTEGRATION_ERROR, checked_settings, estimate
from switchfit.evaluate import evaluator_of
from switchfit.optimize import Status
from switchfit.problem import Problem
from switchfit.result import inverse_on
from switchfit.solve import sigma_known
from switchfit.validation import as_instance, as_sequence, listed


def estimate_many(
    problems: Sequence[Problem],
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    client: Any = None,
    folder: str | Path | None = None,
    callback: Callable[[int, int], object] | None = None,
) -> Fits:
    """Fit many problems of one model, each with its own data, guess and mesh.

    Parameters
    ----------
    problems : sequence of Problem
        With the same modes, mode sequences, kinds of data and unknowns. Numbers of samples may differ; problems whose
        padded lengths agree share one compiled program.
    tolerance, max_iterations : as of `estimate`
    client, folder, callback : as of `monte_carlo`

    Returns
    -------
    Fits
        In the order of the problems. Fits whose integration error turns out too large are done again by `estimate`.

    Raises
    ------
    ValueError
        If the problems differ in more than their numbers, or the folder holds something else.
    TypeError
        If an argument is of the wrong type.
    """
    problems = list(as_sequence(problems, "problems", "a sequence of sf.Problem"))
    tolerance, max_iterations = checked_settings(tolerance, max_iterations)
    check_long_run(client, folder, callback)
    if not problems:
        raise ValueError("estimate_many needs one problem or more; got none.")
    first = problems[0]
    for k, problem in enumerate(problems):
        as_instance(problem, f"problems[{k}]", Problem, "an sf.Problem")
        if problem.theta_names != first.theta_names or sigma_known(problem) is not sigma_known(first):
            raise ValueError(
                f"problem {k} differs from the first one in more than its numbers: it has the unknowns "
                f"{listed(problem.theta_names)}, the first one {listed(first.theta_names)}. Fit it by itself."
            )
        units = [[run.time_unit for run in of.experiments] for of in (problem, first)]
        if units[0] != units[1]:
            raise ValueError(
                f"problem {k} has its times in {', '.join(units[0])}, the first one in {', '.join(units[1])}: their "
                "estimates would stand in one array. Give all logs the same time_unit, with their times in it."
            )
    began = time.perf_counter()
    work = _Work(problems, tolerance, max_iterations)
    return Fits(**repeat(first, work, len(problems), "Logs", began, client=client, folder=folder, callback=callback))


@dataclass
class _Work:
    """The problems, for `run_chunks`."""

    problems: list[Problem]
    tolerance: float
    max_iterations: int

    @property
    def size(self) -> int:
        return chunk_size()

    def __call__(self, runs: range) -> Arrays:
        """Fits of some of the problems: those whose programs agree go together, and then back into their order."""
        groups: dict[Any, list[int]] = {}
        for k in runs:
            groups.setdefault(_kind(self.problems[k]), []).append(k)
        order, parts = [], []
        for members in groups.values():
            order += members
            parts.append(self._group([self.problems[k] for k in members]))
        place = np.argsort(order)
        return {name: np.concatenate([part[name] for part in parts])[place] for name in parts[0]}

    def _group(self, problems: list[Problem]) -> Arrays:
        leaves = [jax.tree.leaves(tuple(evaluator_of(problem).arguments)) for problem in problems]
        stacked = tuple(np.stack([np.asarray(leaf) for leaf in column]) for column in zip(*leaves, strict=True))
        varying = Varying(tuple(range(len(stacked))), stacked)
        starts = np.array([problem.initial_theta for problem in problems])
        found = fit_chunk(
            problems[0],
            evaluator_of(problems[0]).meshes,
            varying,
            starts,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
        )
        arrays = {name: np.array(value) for name, value in found._asdict().items()}
        arrays["message"] = arrays["message"].astype(object)
        for k, problem in enumerate(problems):
            self._check(problem, k, arrays)
        arrays["message"] = arrays["message"].astype(str)
        return {**arrays, "start": starts, "samples": np.array([sample_count(problem) for problem in problems])}

    def _check(self, problem: Problem, k: int, arrays: Arrays) -> None:
        """Do a fit again by `estimate` if its integration error is too large."""
        theta, cost = arrays["theta"][k], arrays["cost"][k]
        fine = evaluator_of(problem).divided().cost(theta)
        if cost_error(problem, fine, cost, 0.0) <= max(LARGEST_INTEGRATION_ERROR, problem.rtol):
            return
        again = estimate(problem, tolerance=self.tolerance, max_iterations=self.max_iterations, start=theta)
        for name in ("theta", "cost", "gradient", "hessian", "optimality"):
            arrays[name][k] = getattr(again, name)
        arrays["iterations"][k] += again.iterations
        arrays["evaluations"][k] += again.evaluations
        arrays["status"][k] = again.status.name
        arrays["free"][k] = again.free_basis.shape[1]
        arrays["covariance"][k] = inverse_on(again.free_basis, again.hessian)
        ordinary = again.status is Status.CONVERGED and not again.active
        arrays["message"][k] = "" if ordinary else again.message

    def fingerprint(self) -> str:
        parts: list[Any] = ["logs", len(self.problems), self.tolerance, self.max_iterations]
        for problem in self.problems:
            leaves = jax.tree.leaves(tuple(evaluator_of(problem).arguments))
            parts += [problem.theta_names, problem.initial_theta, *problem.unknowns.priors, *map(np.asarray, leaves)]
            parts.append(problem.digests)
        return fingerprint(*parts)


def _kind(problem: Problem) -> Any:
    """Equal for problems that one program can fit with one set of constraints."""
    evaluator = evaluator_of(problem)
    shapes = tuple(np.shape(leaf) for leaf in jax.tree.leaves(tuple(evaluator.arguments)))
    unknowns = problem.unknowns
    numbers = [unknowns.A, unknowns.b, unknowns.lower, unknowns.upper, *problem.places]
    numbers += [*unknowns.priors, *unknowns.variables]
    times = [experiment.initial_times for experiment in problem.experiments]
    fixed = [np.where(where < 0, t, 0.0) for where, t in zip(unknowns.times, times, strict=True)]
    return problem.structures, shapes, tuple(np.asarray(a).tobytes() for a in (*numbers, *fixed))
