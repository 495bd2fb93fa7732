"""Studies of one problem: its data differ from run to run, or where its fits begin.

What is said of a fit beyond its end is the same in every study, and in a batch of logs: `finish_fits` does fits again
that need it, and adds the pieces of profiles and how well each fit explains its data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

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
from switchfit.fit.variation import measure_variation
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem

CHUNK_FORMAT = "fits 2"
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

    def __call__(self, runs: range) -> Arrays:
        """Return the fits of some of the runs."""
        data, errors = self.stack_data(runs)
        starts = self.starts[runs.start : runs.stop] if len(self.starts) > 1 else self.starts.repeat(len(runs), axis=0)
        room = self.size * self.most_chunks
        chunk = fit_chunk(self.problem, self.meshes, data, starts, self.limits, room=room, retry=self.retry)
        for k, error in errors.items():
            chunk.clear_fit(k, error)
        lot = Lot(self.problem, self.meshes, data, starts, lambda k: self.problem_of(runs[k]), shared=True, room=room)
        if not self.is_finished:
            return describe_fits(chunk, lot, self.measure_variation(runs))
        return finish_fits(chunk, lot, self.measure_variation(runs), self.limits)

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


@dataclass
class Lot:
    """Fits that one call of the program does.

    Attributes
    ----------
    problem, meshes, data, starts, room : as of `fit_chunk`
    problem_of : callable
        The problem of the k-th fit, with its own data.
    shared : bool
        Whether bounds, sample times and meshes are those of `problem`; each fit has its own otherwise.
    """

    problem: Problem
    meshes: list[Mesh]
    data: Varying
    starts: FloatArray
    problem_of: Callable[[int], Problem]
    shared: bool
    room: int = 0

    def group_fits(self) -> Iterator[tuple[Problem, NDArray[np.intp]]]:
        """Yield each problem whose bounds and sample times fits share, with these fits."""
        every = np.arange(len(self.starts))
        if self.shared:
            yield self.problem, every
        else:
            yield from ((self.problem_of(k), every[k : k + 1]) for k in every.tolist())

    def prepare_evaluations(self) -> Evaluations:
        """Return what evaluates the fits on the meshes on which they were fitted."""
        return Evaluations(self.problem, self.meshes, self.data, self.room)


def finish_fits(chunk: Chunk, lot: Lot, variation: FloatArray | float, limits: Limits) -> Arrays:
    """Return the arrays of fits, of which those that need it are done again, with pieces of profiles."""
    before = chunk.theta.copy()
    redo_unresolved(chunk, lot.problem_of, lot.meshes if lot.shared else None, limits)
    if lot.problem.constraint_names:
        redo_doubted(chunk, lot.problem_of, lot.starts, variation, limits)
    pieces = trace_chunk(chunk, find_replaced(before, chunk), lot.group_fits(), lot.prepare_evaluations, lot.problem_of)
    return describe_fits(chunk, lot, variation) | {"pieces": pieces}


def describe_fits(chunk: Chunk, lot: Lot, variation: FloatArray | float) -> Arrays:
    """Return the arrays of fits as they are, without pieces of profiles.

    Parameters
    ----------
    chunk : Chunk
    lot : Lot
    variation : float or (R,)
        As of `describe_ends`.
    """
    totals = np.broadcast_to(np.asarray(variation, dtype=float), len(lot.starts))
    described: list[dict[str, Any]] = []
    for problem, fits in lot.group_fits():
        ends = describe_ends(problem, chunk.theta[fits], chunk.cost[fits], totals[fits])
        described.append(ends | {"samples": np.full(len(fits), count_samples(problem))})
    ends = {name: np.concatenate([one[name] for one in described]) for name in described[0]}
    pieces = make_no_pieces(lot.problem, len(lot.starts))
    return {**chunk.to_arrays(), **ends, "start": lot.starts, "pieces": pieces}


def find_replaced(before: FloatArray, chunk: Chunk) -> NDArray[np.bool_]:
    """Return which fits of a chunk are not those that ended at these thetas: (R,)."""
    return np.asarray(np.any(before != chunk.theta, axis=1))
