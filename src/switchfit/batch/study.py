"""Studies of one problem: fits whose data differ from run to run, or where they begin.

What is said of a fit beyond its end is the same in every study, and in a batch of logs: fits are done again that need
it, pieces of profiles are added, and how well each fit explains its data.

From a far guess guards pull transitions together, and the modes between them collapse. Each such fit of a batch is then
made alone, with the constraints inside the quadratic programme, and where that does not help with transitions that may
happen anywhere, and from there on their guards.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.batch import doubts as doubts_module
from switchfit.batch.archives import Arrays, compute_fingerprint
from switchfit.batch.batch import Batch
from switchfit.batch.doubts import has_converged
from switchfit.batch.ends import Chunk
from switchfit.batch.interval_pieces import make_no_pieces, trace_chunk
from switchfit.batch.layout import Varying, choose_chunk_size
from switchfit.batch.programs import Limits
from switchfit.discretization.arguments import build_arguments
from switchfit.discretization.mesh import Mesh
from switchfit.fit.data_variation import measure_variation
from switchfit.fit.local_fit import fit_locally
from switchfit.fit.statistics import count_priors, measure_variance
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.meshes.halving import halve_rows
from switchfit.meshes.integration_error import LARGEST_INTEGRATION_ERROR, cost_error
from switchfit.optimize import Status
from switchfit.problem.problem import Problem
from switchfit.strategy.short_fit import End, fit_briefly

CHUNK_FORMAT = "fits 4"
"""Part of every fingerprint: it changes where the arrays of a chunk do, so that folders of before are not used."""


def _fit_free_of_guards(problem: Problem, start: FloatArray) -> End:
    """Return where a fit ends whose transitions may happen anywhere, and one on the guards from there."""
    free = fit_briefly(replace(problem, system=replace(problem.system, guards={})), start)
    return free if free.failed else fit_briefly(problem, free.theta)


def _is_resolved(problem: Problem, meshes: Sequence[Mesh] | None, theta: FloatArray, cost: float) -> bool:
    """Return whether cutting all steps in two changes J at theta by no more than the integration error that is allowed.

    `cost` is J where it ended on meshes of its own; on shared ones, it is found anew, as what failed may have none.
    """
    evaluator = evaluator_of(problem) if meshes is None else Evaluator(problem, meshes=meshes)
    fine = halve_rows(evaluator, theta).cost(theta)
    error = cost_error(problem, fine, cost if meshes is None else evaluator.cost(theta), 0.0)
    return error <= max(LARGEST_INTEGRATION_ERROR, problem.rtol)


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
    is_finished = True  # whether fits are done again that need it, and get pieces

    @property
    def size(self) -> int:
        """Runs in a chunk."""
        return choose_chunk_size(self.problem)

    @cached_property
    def leaves(self) -> tuple[list[Any], Any]:
        """The leaves of the problem's own arguments, and arguments that have the place of each leaf instead."""
        arguments = tuple(build_arguments(self.problem, e, mesh) for e, mesh in enumerate(self.meshes))
        leaves, tree = jax.tree.flatten(arguments)
        return leaves, jax.tree.unflatten(tree, range(len(leaves)))

    def stack_data(self, runs: Iterable[int]) -> tuple[Varying, dict[int, Exception]]:
        """Return the data of some runs, and the errors of those that have none, by their places."""
        return {}, {}

    def problem_of(self, run: int) -> Problem:
        """Return the problem with the data of one run."""
        return self.problem

    def measure_variation(self, runs: range) -> FloatArray | float:
        """Return J of data that are met by their means: (R,), or that of one run, from which others differ by noise."""
        return self._variation

    @cached_property
    def _variation(self) -> float:
        return float(measure_variation(self.problem_of(0)).sum())

    def _group_fits(self, runs: range) -> list[tuple[Problem, NDArray[np.intp]]]:
        """Return each problem whose bounds and sample times fits share, with these fits."""
        every = np.arange(len(runs))
        if self.shares_problem:
            return [(self.problem, every)]
        return [(self.problem_of(run), every[k : k + 1]) for k, run in enumerate(runs)]

    def __call__(self, runs: range) -> Arrays:
        """Return the fits of some of the runs."""
        data, errors = self.stack_data(runs)
        batch = Batch(self.problem, self.meshes, data, self.limits)
        chunk = batch.fit(self.list_starts(runs))
        for k, error in errors.items():
            chunk.clear_fit(k, error)
        pieces = make_no_pieces(self.problem, len(runs))
        if self.is_finished:
            self._redo_unresolved(chunk, runs, batch)
            if self.problem.constraint_names:
                self._redo_doubted(chunk, runs, batch)
        self._free_kinks(chunk, runs)
        # Layers of the mesh move with theta: on the one mesh of a batch, J has steps there that a walk would take for
        # kinks.
        if self.is_finished and not any(mesh.has_layers for mesh in self.meshes):  # J is rough on one mesh
            pieces = trace_chunk(chunk, self._group_fits(runs), batch)
        return self.describe_fits(chunk, runs) | {"pieces": pieces}

    def _free_kinks(self, chunk: Chunk, runs: range) -> None:
        """Let unknowns at kinks have variances, unless guards, terminal constraints or short modes may tie them."""
        if self.problem.constraint_names or not chunk.at_kink.any():
            return
        found, known = self.describe_fits(chunk, runs), self.problem.is_sigma_known
        # As for a single fit (`Fit.free_kinks`), but for all of the chunk at once.
        freedom = found["samples"] + count_priors(self.problem) - chunk.free
        scale = measure_variance(chunk.cost, freedom, known)
        for k in np.flatnonzero(chunk.at_kink.any(axis=1) & (found["collapsed"] == 0)).tolist():
            chunk.free_kinks(k, float(scale[k]))

    def list_starts(self, runs: range) -> FloatArray:
        """Return where some of the runs begin: (R, d)."""
        return self.starts[runs.start : runs.stop] if len(self.starts) > 1 else self.starts.repeat(len(runs), axis=0)

    def _redo_unresolved(self, chunk: Chunk, runs: range, batch: Batch) -> None:
        """Replace fits whose integration error is too large by those that `estimate` finds.

        Of fits that share meshes, those that failed are looked at. A mode that is active elsewhere than where the
        meshes were refined may find cells there that are far too long for it: what stops the optimiser is then the mesh
        and not the model. A fit that fails again is left as it was.
        """
        failed = ~has_converged(chunk.status)
        looked_at = (chunk.status != Status.ERROR.name) & (failed | (not self.shares_problem))
        for k in np.flatnonzero(looked_at).tolist():
            theta = chunk.theta[k]
            try:
                problem = self.problem_of(runs[k])
                if _is_resolved(problem, self.meshes if self.shares_problem else None, theta, chunk.cost[k]):
                    continue
                again = fit_locally(problem, start=theta, **self.limits._asdict())
            except Exception as error:
                if not failed[k]:
                    chunk.set_error(k, error)
                continue  # a fit from this end fails too: the first one stays, and is listed as failed
            if again.status.successful or not failed[k]:
                batch.replace_fit(chunk, k, again)

    def _redo_doubted(self, chunk: Chunk, runs: range, batch: Batch) -> None:
        """Replace fits that did not converge, lost modes or are far from their data by better ones, if there are any.

        Only of problems with guards or terminal constraints, which the compiled program does not take.
        """
        starts, guarded = self.list_starts(runs), any(structure.guarded for structure in self.problem.structures)
        for find in (fit_briefly, _fit_free_of_guards) if guarded else (fit_briefly,):
            for k in np.flatnonzero(self._find_doubted(chunk, runs)).tolist():
                try:
                    problem = self.problem_of(runs[k])
                    end = find(problem, starts[k])
                    if end.failed:
                        continue
                    again = fit_locally(problem, start=end.theta, **self.limits._asdict())
                except Exception:  # nothing better from this start, or a problem that cannot be built: it is listed
                    continue
                before = chunk.cost[k] if has_converged(chunk.status)[k] else np.inf
                if again.status.successful and again.cost < before:
                    batch.replace_fit(chunk, k, again)

    def _find_doubted(self, chunk: Chunk, runs: range) -> NDArray[np.bool_]:
        """Return of which fits a better end may be elsewhere: not converged, a mode collapsed, or far from the data."""
        # Doubts that another start may settle; what the data cannot tell is no reason to fit once more.
        kinds = "not converged", "a mode collapsed", "little explained", *doubts_module.EXPLAINED_BADLY
        arrays, known = self.describe_fits(chunk, runs), self.problem.is_sigma_known
        doubts = [d for d in doubts_module.find_doubts(arrays, known, count_priors(self.problem)) if d.kind in kinds]
        return np.any([np.zeros(len(runs), dtype=bool), *(doubt.which for doubt in doubts)], axis=0)

    def describe_fits(self, chunk: Chunk, runs: range) -> Arrays:
        """Return the arrays of fits as they are."""
        variation = np.broadcast_to(self.measure_variation(runs), len(runs))
        described = [
            doubts_module.describe_ends(problem, chunk.theta[fits], chunk.cost[fits], variation[fits])
            for problem, fits in self._group_fits(runs)
        ]
        ends = {name: np.concatenate([one[name] for one in described]) for name in described[0]}
        return {**chunk.to_arrays(), **ends, "start": self.list_starts(runs)}

    def fingerprint(self) -> str:
        """Return a digest of everything that a result depends on."""
        unknowns, data = self.problem.unknowns, self.stack_data([0])[0]  # run 0 stands for all
        bounds = unknowns.lower, unknowns.upper, unknowns.A, unknowns.b, *unknowns.priors
        # What varies is in the data of each run; the digest has what all runs share, and run 0 for the shapes and seeds
        # of the rest.
        shared = [np.asarray(leaf) for place, leaf in enumerate(self.leaves[0]) if place not in data]
        settings = type(self).__name__, self.limits, self.seed, unknowns.names, self.problem.solver
        return compute_fingerprint(
            CHUNK_FORMAT, settings, self.problem.digests, self.starts, *bounds, *data.values(), *shared
        )
