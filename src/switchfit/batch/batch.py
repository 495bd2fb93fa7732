"""Fits of one problem on meshes that they share, each with data of its own.

The compiled programs do all of them. What they do not settle, and fits with features that `minimize_traced` does not
support, are done by `minimize`, like a single fit.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray, Traced
from switchfit.batch.ends import Chunk
from switchfit.batch.failures import describe_error, is_raised_in_callback
from switchfit.batch.layout import ProgramLayout, Varying, choose_layout, has_gpu
from switchfit.batch.program_inputs import ProgramInputs, replace_leaves
from switchfit.batch.programs import GPU_LOCK, Limits, compile_once, evaluate_fits, minimize_fits
from switchfit.discretization.mesh import Mesh
from switchfit.engine.corners.branches import has_corners
from switchfit.fit.minimization import minimize_cost
from switchfit.fit.result import list_kinks
from switchfit.fit.solved_fit import SolvedFit
from switchfit.fit.termination import Kink, Termination, termination_of
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.follower import Follower
from switchfit.optimize import Result, Status
from switchfit.optimize.traced_state import Outcome
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem
from switchfit.uncertainty.walks import Derivatives

EVALUATIONS = 256
"""Evaluations in one call of the program; shorter calls are padded, which costs nothing."""

UNDEFINED = (ValueError, ArithmeticError, np.linalg.LinAlgError)
"""What a model raises where it is undefined."""

_NO_PROGRAM = (
    "The compiled program of many fits failed ({error}); they are done one by one, which takes much longer. This is an "
    "error in switchfit itself: please report it."
)


def _pad_fits(values: ArrayLike, size: int) -> FloatArray:
    """Repeat the last of `values` (R, ...) up to `size`: the number of fits must not shape the program."""
    array = np.asarray(values)
    return np.concatenate([array, np.repeat(array[-1:], size - len(array), axis=0)]) if len(array) < size else array


class Batch:
    """Fits of one problem on meshes that they share, each with data of its own, in compiled programs.

    Parameters
    ----------
    problem : Problem
    meshes : one an experiment, the same for all fits
    varying : Varying
        What replaces the problem's own numbers.
    limits : Limits

    Attributes
    ----------
    own : dict of int to callable
        What returns the evaluators of fits that were done again, on meshes of their own.
    """

    def __init__(self, problem: Problem, meshes: Sequence[Mesh], varying: Varying, limits: Limits) -> None:
        self.evaluator = Evaluator(problem, meshes=meshes)
        self.varying, self.limits = varying, limits
        self.own: dict[int, Callable[[], Evaluator]] = {}
        self._base = tuple(self.evaluator.arguments)

    @cached_property
    def layout(self) -> ProgramLayout:
        """Layout of the programs."""
        return choose_layout(self.evaluator, tuple(self.varying))

    def _use_device(self) -> AbstractContextManager[Any]:
        """Return a context in which programs with machine code run on the CPU, whatever JAX's default device is, and
        those in lockstep one after another: each takes gigabytes.
        """
        if self.layout.lockstep:
            return GPU_LOCK
        return jax.default_device(jax.devices("cpu")[0]) if has_gpu() else nullcontext()

    @cached_property
    def _inputs(self) -> ProgramInputs:
        return ProgramInputs.of(self.evaluator, self.layout)

    @cached_property
    def _values(self) -> tuple[jax.Array, ...]:
        """Return the data of all fits as arrays of JAX, which otherwise copies them in each call of a program."""
        return tuple(jnp.asarray(_pad_fits(value, self.layout.size)) for value in self.varying.values())

    def fit(self, starts: FloatArray) -> Chunk:
        """Fit all of them.

        The program of all fits has no trust region, and a step too long may lead one astray: `minimize` begins anew at
        the start of what it does not settle, with the iterations that are left.

        Parameters
        ----------
        starts : (R, d)
            Feasible.
        """
        problem = self.evaluator.problem
        # The program has no guards, no logarithmic times and no corners: such fits begin at their starts, and
        # `minimize` does all of them.
        has_crossings = any(map(has_corners, problem.structures))
        if problem.constraint_names or problem.unknowns.log_times.any() or has_crossings:  # unknown to the program
            outcome = Outcome.at_starts(starts, np)
        else:
            outcome = self._run_program(starts)
        return self._finish_rest(outcome, starts)

    def replace_fit(self, chunk: Chunk, k: int, again: SolvedFit) -> None:
        """Replace the k-th fit by an estimate, on meshes of its own."""
        ordinary = again.status is Status.CONVERGED and not again.active
        chunk.replace_fit(k, again, list_kinks(again), "" if ordinary else again.message)
        self.own[k] = again.evaluator_at_solution

    def evaluate(self, fits: NDArray[np.intp], thetas: FloatArray, sides: NDArray[np.int64]) -> Derivatives:
        """Return costs, gradients and Hessians at thetas (n, d), to one side (n,) of breakpoints.

        `fits` (n,) says whose data are taken. NaN where the model is undefined.
        """
        n, d = thetas.shape
        at = Derivatives(np.full(n, np.nan), np.full((n, d), np.nan), np.full((n, d, d), np.nan))
        # Fits on meshes of their own, and those that JAX would have to compile once more, are evaluated one by one.
        alone = np.isin(fits, list(self.own)) | (not self.layout.natively)
        together = np.flatnonzero(~alone)
        for first in range(0, len(together), EVALUATIONS):
            call = together[first : first + EVALUATIONS]
            # Every call has the same length, whatever is left: another shape would be another program.
            padded = [_pad_fits(each[call], EVALUATIONS) for each in (fits, thetas, sides.astype(float))]
            found = self._run(evaluate_fits, *padded, len(call))
            for all_, each in zip(at, found, strict=True):
                all_[call] = each[: len(call)]
        for s in np.flatnonzero(alone).tolist():
            k = int(fits[s])
            with suppress(*UNDEFINED):
                evaluator = self.own[k]() if k in self.own else self._give_data(k)
                here = evaluator(thetas[s], int(sides[s]))
                at.cost[s], at.gradient[s], at.hessian[s] = here.cost, here.gradient, here.hessian
        return at

    def _run(self, program: Callable[..., Traced], *own: Traced) -> Traced:
        """Return the results of a program as arrays of NumPy; `own` is what it is given beside inputs and data."""
        with use_float64(), self._use_device():
            given = (self._inputs, self._values, *own)
            with compile_once(self.layout, given):
                return jax.tree.map(np.asarray, program(*given, layout=self.layout))

    def _give_data(self, k: int) -> Evaluator:
        """Return the evaluator with the data of the k-th fit."""
        with use_float64():
            values = [jnp.asarray(value[k]) for value in self.varying.values()]
            arguments = replace_leaves(self._base, self.varying, values)
        given = zip(self.evaluator.meshes, arguments, strict=True)
        # Data may bring times of their own, whose nodes are in the arguments: the mesh of this fit is made of these.
        meshes = [Mesh.from_times(np.asarray(own.nodes), mesh.stiffness) for mesh, own in given]
        return Evaluator(self.evaluator.problem, meshes=meshes, arguments=arguments)

    def _run_program(self, starts: FloatArray) -> Outcome:
        """Return where the program leaves all fits: at their starts if it fails, or if one mesh does not suit them."""
        # What it does not settle has as many iterations left for the optimiser that finishes it.
        limits = self.limits._replace(max_iterations=self.limits.max_iterations // 2)
        inward = self.evaluator.problem.unknowns.variables.inward(starts)
        try:
            found = self._run(minimize_fits, limits, _pad_fits(inward, self.layout.size), len(starts))
        except Exception as error:
            # A function of the model that calls back into Python may raise for one fit and ends the whole program: the
            # fits are then done one by one, and that one is listed. Any other error is a defect of the program.
            if not is_raised_in_callback(error):
                warnings.warn(_NO_PROGRAM.format(error=describe_error(error)), RuntimeWarning, stacklevel=3)
            return Outcome.at_starts(starts, np)
        outcome: Outcome = jax.tree.map(lambda a: a[: len(starts)], found)
        # A program has one mesh for all fits, and takes all of them or none: it is refused where the mesh does not suit
        # the first and the last, which stand for the others.
        is_sharp = self.layout.natively and not all(map(Follower(self.evaluator).suits, outcome.theta[[0, -1]]))
        return Outcome.at_starts(starts, np) if is_sharp else outcome

    def _fit_one(self, k: int, start: FloatArray, limits: Limits) -> Result:
        """Fit the data of fit k from a start. Meshes follow, unless each fit has times of its own, with which no mesh
        is made.
        """
        problem, varying, evaluator = self.evaluator.problem, self.varying, self._give_data(k)

        def build(meshes: Sequence[Mesh]) -> Evaluator:
            return Batch(problem, meshes, varying, limits)._give_data(k)

        # All leaves vary: sample times too, so that a mesh for the data of this fit alone cannot be shared by a
        # follower.
        if len(varying) == len(jax.tree.leaves(self._base)):
            return minimize_cost(evaluator, start, "exact", *limits)
        # A trust region takes fewer steps.
        return minimize_cost(Follower(evaluator, build), start, "auto", *limits)

    def _finish_rest(self, outcome: Outcome, starts: FloatArray) -> Chunk:
        """Return the outcomes as a chunk; fits that did not settle are done by `minimize`, one by one."""
        problem, limits, chunk = self.evaluator.problem, self.limits, Chunk.of(outcome)
        settled, held = np.asarray(outcome.settled), np.asarray(outcome.held)
        # Held coordinates are left out of the covariance: rows of the identity in H, zero in its inverse.
        either = (held[:, :, None] | held[:, None, :])[settled]
        hessians = np.where(either, np.eye(held.shape[1]), chunk.hessian[settled])
        # The batch inverts all Hessians in one call; those of fits that are done again are inverted there.
        chunk.covariance[settled] = np.linalg.inv(hessians) * ~either
        chunk.free[settled] -= held[settled].sum(axis=1)
        sides = np.stack([outcome.left, outcome.gradient], axis=2)
        chunk.kinks[:] = np.where((held & settled[:, None])[:, :, None], sides, 0.0)
        for k in np.flatnonzero(settled & held.any(axis=1)).tolist():
            chunk.status[k] = Status.CONVERGED_AT_KINK.name
            chunk.message[k] = str(_describe_kink(problem, outcome, k, limits.tolerance))
        for k in np.flatnonzero(~settled).tolist():
            before = int(chunk.iterations[k])
            try:
                found = self._fit_one(k, starts[k], limits._replace(max_iterations=limits.max_iterations - before))
            except Exception as error:  # of any kind: the other fits go on
                chunk.set_error(k, error)
                chunk.free[k] = 0
                continue
            termination = termination_of(replace(found, iterations=before + found.iterations), problem)
            chunk.replace_fit(k, found, found.kinks, str(termination))
        return chunk


def _describe_kink(problem: Problem, outcome: Outcome, k: int, tolerance: float) -> Termination:
    """Return the termination of fit k, which ended at kinks."""
    names, columns = problem.unknowns.names, (outcome.theta[k], outcome.left[k], outcome.gradient[k])
    kinks = tuple(Kink(names[i], *(float(column[i]) for column in columns)) for i in np.flatnonzero(outcome.held[k]))
    figures = {name: getattr(outcome, name)[k].item() for name in ("cost", "optimality", "iterations")}
    return Termination(Status.CONVERGED_AT_KINK, tolerance=tolerance, kinks=kinks, **figures)
