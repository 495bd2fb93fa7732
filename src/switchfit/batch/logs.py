"""One model, many logs: every log a problem of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from switchfit.batch.again import find_replaced, is_resolved, redo_doubted, replace_fit
from switchfit.batch.chunks import Arrays, compute_fingerprint
from switchfit.batch.evaluations import Evaluations
from switchfit.batch.fits import CHUNK_FORMAT, Fits, check_long_run, list_origins, repeat
from switchfit.batch.intervals import make_no_pieces, trace_chunk
from switchfit.batch.layout import Varying, choose_chunk_size
from switchfit.batch.program import Chunk, describe_failure, fit_chunk, make_failed_chunk
from switchfit.batch.quality import count_samples, describe_ends
from switchfit.estimation.local_fit import check_settings, fit_locally
from switchfit.fit.evaluator import evaluator_of
from switchfit.fit.solution import is_sigma_known
from switchfit.fit.variation import measure_variation
from switchfit.optimize import Status
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem, require_unknowns
from switchfit.problem.validation import as_instance, as_sequence, join_names


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

    See Also
    --------
    estimate, monte_carlo, multistart

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fits = sf.estimate_many([heater_problem() for _ in range(3)])
    >>> fits.theta.shape, bool(fits.success.all())
    ((3, 2), True)
    """
    problems = list(as_sequence(problems, "problems", "a sequence of sf.Problem"))
    tolerance, max_iterations = check_settings(tolerance, max_iterations)
    check_long_run(client, folder, callback)
    if not problems:
        raise ValueError("estimate_many needs one problem or more; got none.")
    first = problems[0]
    for k, problem in enumerate(problems):
        as_instance(problem, f"problems[{k}]", Problem, "an sf.Problem")
        require_unknowns(problem)
        if problem.theta_names != first.theta_names or is_sigma_known(problem) is not is_sigma_known(first):
            raise ValueError(
                f"problem {k} differs from the first one in more than its numbers: it has the unknowns "
                f"{join_names(problem.theta_names)}, the first one {join_names(first.theta_names)}. Fit it by itself."
            )
        units = [[run.time_unit for run in of.experiments] for of in (problem, first)]
        if units[0] != units[1]:
            raise ValueError(
                f"problem {k} has its times in {', '.join(units[0])}, the first one in {', '.join(units[1])}: their "
                "estimates would stand in one array. Give all logs the same time_unit, with their times in it."
            )
    began = time.perf_counter()
    work = _Work(problems, tolerance, max_iterations)
    found = repeat(first, work, len(problems), "Logs", began, client=client, folder=folder, callback=callback)
    every = zip(*map(list_origins, problems), strict=True)
    return Fits(**found | {"date_origins": tuple(own[0] if len(set(own)) == 1 else None for own in every)})


@dataclass
class _Work:
    """The problems, for `run_chunks`."""

    problems: list[Problem]
    tolerance: float
    max_iterations: int

    @property
    def size(self) -> int:
        return choose_chunk_size()

    @property
    def most_chunks(self) -> int:
        return 1  # the meshes of a chunk are those of one of its logs

    def __call__(self, runs: range) -> Arrays:
        """Fits of some of the problems: those whose programs agree go together, and then back into their order."""
        groups: dict[Any, list[int]] = {}
        errors: dict[int, Exception] = {}
        for k in runs:
            try:
                groups.setdefault(_get_kind(self.problems[k]), []).append(k)
            except (
                Exception
            ) as error:  # where its guess cannot be integrated, say: listed, as it must not end the others
                errors[k] = error
        parts = [self._fit_group([self.problems[k] for k in members]) for members in groups.values()]
        order = [k for members in groups.values() for k in members]
        if errors:
            order += errors
            parts.append(self._list_failed(errors))
        place = np.argsort(order)
        return {name: np.concatenate([part[name] for part in parts])[place] for name in parts[0]}

    def _fit_group(self, problems: list[Problem]) -> Arrays:
        leaves = [jax.tree.leaves(tuple(evaluator_of(problem).arguments)) for problem in problems]
        stacked = tuple(np.stack([np.asarray(leaf) for leaf in column]) for column in zip(*leaves, strict=True))
        varying = Varying(tuple(range(len(stacked))), stacked)
        starts = np.array([problem.initial_theta for problem in problems])
        first = found = fit_chunk(
            problems[0],
            evaluator_of(problems[0]).meshes,
            varying,
            starts,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
        )
        if problems[0].constraint_names:
            variation = np.array([measure_variation(problem).sum() for problem in problems])
            settings: Any = {"tolerance": self.tolerance, "max_iterations": self.max_iterations}
            found = redo_doubted(found, problems.__getitem__, starts, variation, **settings)
        arrays = {name: np.array(value) for name, value in found._asdict().items()}
        arrays["message"], arrays["status"] = arrays["message"].astype(object), arrays["status"].astype(object)
        for k, problem in enumerate(problems):
            if arrays["status"][k] != Status.ERROR.name:
                try:
                    self._redo_unresolved(problem, k, arrays)
                except Exception as error:
                    arrays["status"][k], arrays["message"][k] = Status.ERROR.name, describe_failure(error)
        arrays["message"], arrays["status"] = arrays["message"].astype(str), arrays["status"].astype(str)
        arrays |= _describe_each(problems, arrays["theta"], arrays["cost"])
        evaluations = partial(Evaluations, problems[0], evaluator_of(problems[0]).meshes, varying)
        last = Chunk(**{name: arrays[name] for name in Chunk._fields})
        of = problems.__getitem__
        arrays["pieces"] = trace_chunk(last, find_replaced(first, last), of, evaluations, of)
        return {**arrays, "start": starts, "samples": np.array([count_samples(problem) for problem in problems])}

    def _list_failed(self, errors: dict[int, Exception]) -> Arrays:
        """Return the arrays of problems whose fits failed before they began."""
        starts = np.array([self.problems[k].initial_theta for k in errors])
        found = make_failed_chunk(starts, dict(enumerate(errors.values())))
        samples = np.array([count_samples(self.problems[k]) for k in errors])
        ends = _describe_each([self.problems[k] for k in errors], found.theta, found.cost)
        ends["pieces"] = make_no_pieces(self.problems[0], len(errors))
        return {**found._asdict(), **ends, "start": starts, "samples": samples}

    def _redo_unresolved(self, problem: Problem, k: int, arrays: Arrays) -> None:
        """Do a fit again by `estimate` if its integration error is too large."""
        theta, cost = arrays["theta"][k], float(arrays["cost"][k])
        if not is_resolved(problem, evaluator_of(problem).meshes, theta, cost):
            replace_fit(
                arrays,
                k,
                fit_locally(problem, tolerance=self.tolerance, max_iterations=self.max_iterations, start=theta),
            )

    def fingerprint(self) -> str:
        parts: list[Any] = [CHUNK_FORMAT, "logs", len(self.problems), self.tolerance, self.max_iterations]
        for problem in self.problems:
            parts += [problem.theta_names, problem.initial_theta, *problem.unknowns.priors, problem.digests]
            try:
                evaluator = evaluator_of(problem)
            except Exception as error:  # this one will be listed as failed
                parts.append(describe_failure(error))
            else:
                parts += map(np.asarray, jax.tree.leaves(tuple(evaluator.arguments)))
        return compute_fingerprint(*parts)


def _describe_each(problems: Sequence[Problem], theta: FloatArray, cost: FloatArray) -> Arrays:
    """Return how well each problem's fit explains its data, and where it ended, as `describe_ends` does."""
    each = [
        describe_ends(problem, theta[k : k + 1], cost[k : k + 1], measure_variation(problem).sum())
        for k, problem in enumerate(problems)
    ]
    return {name: np.concatenate([one[name] for one in each]) for name in each[0]}


def _get_kind(problem: Problem) -> Any:
    """Return a key that is equal for problems that one program can fit with one set of constraints."""
    evaluator = evaluator_of(problem)
    shapes = tuple(np.shape(leaf) for leaf in jax.tree.leaves(tuple(evaluator.arguments)))
    unknowns = problem.unknowns
    numbers = [unknowns.A, unknowns.b, unknowns.lower, unknowns.upper, *problem.places]
    numbers += [*unknowns.priors, *unknowns.variables]
    times = [experiment.initial_times_with_jumps for experiment in problem.experiments]
    fixed = [np.where(where[: len(t)] < 0, t, 0.0) for where, t in zip(problem.places, times, strict=True)]
    return evaluator.structures, shapes, tuple(np.asarray(a).tobytes() for a in (*numbers, *fixed))
