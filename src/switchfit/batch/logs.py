"""One model, many logs: every log a problem of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from switchfit.arrays import FloatArray
from switchfit.batch.archives import Arrays, compute_fingerprint
from switchfit.batch.ends import Chunk
from switchfit.batch.failures import describe_failure
from switchfit.batch.fits import Fits
from switchfit.batch.interval_pieces import make_no_pieces
from switchfit.batch.layout import Varying
from switchfit.batch.long_run import LongRun, list_origins, repeat
from switchfit.batch.study import CHUNK_FORMAT, Study
from switchfit.discretization.mesh import Mesh
from switchfit.fit.data_variation import measure_variation
from switchfit.meshes.evaluator import evaluator_of
from switchfit.optimize.traced_state import Outcome
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.validation.messages import join_names
from switchfit.problem.validation.names import as_sequence
from switchfit.problem.validation.objects import as_instance


@dataclass
class StudyOfLogs(Study):
    """Problems of one model, each with data, guess and meshes of its own."""

    problems: list[Problem]

    shares_problem = False

    def __call__(self, runs: range) -> Arrays:
        """Fits of some of the problems: those whose programs agree go together, and then back into their order."""
        groups: dict[Any, list[int]] = {}
        parts, order = [], []
        for k in runs:
            try:
                groups.setdefault(_get_kind(self.problems[k]), []).append(k)
            except Exception as error:  # as where its guess cannot be integrated: listed, it must not end the others
                parts.append(self._select([k], []).describe_failed(error))
                order.append(k)
        for members in groups.values():
            meshes = evaluator_of(self.problems[members[0]]).meshes
            parts.append(super(StudyOfLogs, self._select(members, meshes)).__call__(range(len(members))))
            order += members
        # Groups have mixed the runs; this is the inverse of the order in which they were done.
        place = np.argsort(order)
        return {name: np.concatenate([part[name] for part in parts])[place] for name in parts[0]}

    def _select(self, members: list[int], meshes: list[Mesh]) -> StudyOfLogs:
        """Return some of the problems, on meshes that they share."""
        problems = [self.problems[k] for k in members]
        return replace(self, problem=problems[0], meshes=meshes, starts=self.starts[members], problems=problems)

    def fingerprint(self) -> str:
        """Return a digest of everything that a result depends on."""
        parts: list[Any] = [CHUNK_FORMAT, "logs", len(self.problems), self.limits]
        for problem in self.problems:
            parts += [problem.theta_names, problem.initial_theta, *problem.unknowns.priors, problem.digests]
            try:
                evaluator = evaluator_of(problem)
            except Exception as error:  # this one will be listed as failed
                parts.append(describe_failure(error))
            else:
                parts += map(np.asarray, jax.tree.leaves(tuple(evaluator.arguments)))
        return compute_fingerprint(*parts)

    def stack_data(self, runs: Iterable[int]) -> tuple[Varying, dict[int, Exception]]:
        """Return all arguments of some problems."""
        leaves = [jax.tree.leaves(tuple(evaluator_of(self.problems[k]).arguments)) for k in runs]
        stacked = (np.stack([np.asarray(leaf) for leaf in column]) for column in zip(*leaves, strict=True))
        return dict(enumerate(stacked)), {}

    def problem_of(self, run: int) -> Problem:
        """Return one of the problems."""
        return self.problems[run]

    def measure_variation(self, runs: range) -> FloatArray:
        """Return J of the data of each problem that are met by their means: (R,)."""
        return np.array([measure_variation(self.problems[k]).sum() for k in runs])

    def describe_failed(self, error: Exception) -> Arrays:
        """Return the arrays of the only problem, whose fit failed before it began."""
        chunk, runs = Chunk.of(Outcome.at_starts(self.starts, np)), range(1)
        chunk.clear_fit(0, error)
        return self.describe_fits(chunk, runs) | {"pieces": make_no_pieces(self.problem, 1)}


def _get_kind(problem: Problem) -> tuple[object, ...]:
    """Return a key that is equal for problems that one program can fit with one set of constraints."""
    evaluator = evaluator_of(problem)
    shapes = tuple(np.shape(leaf) for leaf in jax.tree.leaves(tuple(evaluator.arguments)))
    unknowns = problem.unknowns
    numbers = [unknowns.A, unknowns.b, unknowns.lower, unknowns.upper, *problem.places]
    numbers += [*unknowns.priors, *unknowns.variables]
    times = [experiment.initial_times_with_jumps for experiment in problem.experiments]
    # Fixed transition times are constants of a program's inputs, one set for a group; free ones are in theta.
    fixed = [np.where(where[: len(t)] < 0, t, 0.0) for where, t in zip(problem.places, times, strict=True)]
    return evaluator.structures, shapes, tuple(np.asarray(a).tobytes() for a in (*numbers, *fixed))


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
    >>> fits = sf.estimate_many([heater_problem() for _ in range(3)])
    >>> fits.theta.shape, bool(fits.success.all())
    ((3, 2), True)
    """
    problems = list(as_sequence(problems, "problems", "a sequence of sf.Problem"))
    how = LongRun.check(tolerance, max_iterations, client, folder, callback)
    if not problems:
        raise ValueError("estimate_many needs one problem or more; got none.")
    first = problems[0]
    for k, problem in enumerate(problems):
        as_instance(problem, f"problems[{k}]", Problem, "an sf.Problem")
        require_estimable(problem)
        if problem.theta_names != first.theta_names or problem.is_sigma_known is not first.is_sigma_known:
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
    starts = np.array([problem.initial_theta for problem in problems])
    study = StudyOfLogs(first, [], starts, how.limits, 0, problems)
    found = repeat(first, study, len(problems), "Logs", how)
    every = zip(*map(list_origins, problems), strict=True)
    return Fits(**found | {"date_origins": tuple(own[0] if len(set(own)) == 1 else None for own in every)})
