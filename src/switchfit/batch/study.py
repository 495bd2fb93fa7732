"""Studies of one problem: its data differ from run to run, or where its fits begin.

What is said of a fit beyond its end is the same in every study, and in a batch of logs: fits are done again that need
it, and pieces of profiles are added, and how well each fit explains its data.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, partial

import jax
import numpy as np
from numpy.typing import NDArray

from switchfit.batch.again import redo_doubted, redo_unresolved
from switchfit.batch.chunks import Arrays, compute_fingerprint
from switchfit.batch.evaluations import Evaluations
from switchfit.batch.intervals import make_no_pieces, trace_chunk
from switchfit.batch.layout import Varying, choose_chunk_size, count_chunks_together
from switchfit.batch.program import Chunk, Limits, fit_chunk
from switchfit.batch.quality import count_samples, describe_ends
from switchfit.discretization.arguments import Arguments, build_arguments
from switchfit.discretization.mesh import Mesh
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.variation import measure_variation
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem

CHUNK_FORMAT = "fits 3"
"""Part of every fingerprint: it changes where the arrays of a chunk do, so that folders of before are not used."""


@dataclass
class Study:
    """Fits of one problem on meshes that they share, for `run_chunks`.

    Derived classes say what differs between the runs: `stack_data`, `problem_of` and `measure_variation`.

    Attributes
    ----------
    problem : Problem
    meshes : list of Mesh
    starts : (runs, d), or (1, d)
        Where the fits begin; one row for all of them.
    limits : Limits
    seed : int
    """

    problem: Problem
    meshes: list[Mesh]
    starts: FloatArray
    limits: Limits
    seed: int

    shares_problem = True  # whether bounds, sample times and meshes are those of `problem`
    retry = True  # whether a fit that strayed is fitted from its start too
    is_finished = True  # whether fits are done again that need it, and get pieces
    sound = 0  # a run whose data can be made

    @property
    def size(self) -> int:
        """Runs in a chunk."""
        return choose_chunk_size()

    @cached_property
    def most_chunks(self) -> int:
        """Neighbouring chunks that one call may take."""
        return count_chunks_together(self.problem, self.meshes, self.stack_data([self.sound])[0])

    @property
    def room(self) -> int:
        """Most fits of any call."""
        return self.size * self.most_chunks

    @cached_property
    def arguments(self) -> tuple[Arguments, ...]:
        """Those of the problem itself."""
        return tuple(build_arguments(self.problem, e, mesh) for e, mesh in enumerate(self.meshes))

    def stack_data(self, runs: Iterable[int]) -> tuple[Varying, dict[int, Exception]]:
        """Return the data of some runs, and the errors of those that have none, by their places."""
        return Varying((), ()), {}

    def problem_of(self, run: int) -> Problem:
        """Return the problem with the data of one run."""
        return self.problem

    def measure_variation(self, runs: range) -> FloatArray | float:
        """Return J of data that are met by their means: (R,), or that of all runs."""
        return float(measure_variation(self.problem).sum())

    def group_fits(self, runs: range) -> list[tuple[Problem, NDArray[np.intp]]]:
        """Return each problem whose bounds and sample times fits share, with these fits."""
        every = np.arange(len(runs))
        if self.shares_problem:
            return [(self.problem, every)]
        return [(self.problem_of(run), every[k : k + 1]) for k, run in enumerate(runs)]

    def __call__(self, runs: range) -> Arrays:
        """Return the fits of some of the runs."""
        data, errors = self.stack_data(runs)
        starts = self.list_starts(runs)
        chunk = fit_chunk(self.problem, self.meshes, data, starts, self.limits, room=self.room, retry=self.retry)
        for k, error in errors.items():
            chunk.clear_fit(k, error)
        return self.finish_fits(chunk, runs, data) if self.is_finished else self.describe_fits(chunk, runs)

    def list_starts(self, runs: range) -> FloatArray:
        """Return where some of the runs begin: (R, d)."""
        return self.starts[runs.start : runs.stop] if len(self.starts) > 1 else self.starts.repeat(len(runs), axis=0)

    def finish_fits(self, chunk: Chunk, runs: range, data: Varying) -> Arrays:
        """Return the arrays of fits, of which those that need it are done again, with pieces of profiles."""

        def problem_of(k: int) -> Problem:
            return self.problem_of(runs[k])

        before = chunk.theta.copy()
        redo_unresolved(chunk, problem_of, self.meshes if self.shares_problem else None, self.limits)
        if self.problem.constraint_names:
            redo_doubted(chunk, problem_of, self.list_starts(runs), self.measure_variation(runs), self.limits)
        if any(mesh.has_layers for mesh in self.meshes):  # J is rough on one mesh
            return self.describe_fits(chunk, runs)
        redone = find_replaced(before, chunk), lambda k: Evaluator(problem_of(k), chunk.theta[k])
        prepare = partial(Evaluations, self.problem, self.meshes, data, self.room, *redone)
        pieces = trace_chunk(chunk, self.group_fits(runs), prepare)
        return self.describe_fits(chunk, runs) | {"pieces": pieces}

    def describe_fits(self, chunk: Chunk, runs: range) -> Arrays:
        """Return the arrays of fits as they are, without pieces of profiles."""
        variation, described = np.broadcast_to(self.measure_variation(runs), len(runs)), []
        for problem, fits in self.group_fits(runs):
            ends = describe_ends(problem, chunk.theta[fits], chunk.cost[fits], variation[fits])
            described.append(ends | {"samples": np.full(len(fits), count_samples(problem))})
        ends = {name: np.concatenate([one[name] for one in described]) for name in described[0]}
        pieces = make_no_pieces(self.problem, len(runs))
        return {**chunk.to_arrays(), **ends, "start": self.list_starts(runs), "pieces": pieces}

    def fingerprint(self) -> str:
        """Return a digest of everything that a result depends on."""
        unknowns, data = self.problem.unknowns, self.stack_data([self.sound])[0]  # stands for all runs
        bounds = unknowns.lower, unknowns.upper, unknowns.A, unknowns.b, *unknowns.priors
        leaves = jax.tree.leaves(self.arguments)
        shared = [np.asarray(leaf) for place, leaf in enumerate(leaves) if place not in data.places]
        settings = type(self).__name__, self.limits, self.seed, unknowns.names, self.problem.solver
        return compute_fingerprint(
            CHUNK_FORMAT, settings, self.problem.digests, self.starts, *bounds, *data.values, *shared
        )


def find_replaced(before: FloatArray, chunk: Chunk) -> NDArray[np.bool_]:
    """Return which fits of a chunk are not those that ended at these thetas: (R,)."""
    return np.asarray(np.any(before != chunk.theta, axis=1))
