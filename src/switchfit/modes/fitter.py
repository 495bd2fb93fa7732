"""Fits of any schedule of a library, in one program of machine code and on meshes that are built once.

A sequence takes a problem of its own, whose functions are traced and whose program is compiled already; parameters that
act in none of its modes are held where they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Mesh
from switchfit.engine.adaptive import refine_mesh_of_many
from switchfit.fit.evaluator import Evaluator
from switchfit.modes.acting import find_arrays, find_read
from switchfit.modes.costs import ScheduleCosts
from switchfit.modes.library_problem import build_library_problem
from switchfit.modes.schedule import Schedule, collapse, keep_off, space_evenly, spread
from switchfit.modes.sharing import Experiments, share_evaluator
from switchfit.optimize import LinearConstraints
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.strategy.library import Library
from switchfit.strategy.quick import fit_briefly

COLLAPSED = 1e-6
"""Duration, as a part of the horizon, below which a mode is left out."""

TOURS = 6
"""Sequences at which the meshes are refined, so that each mode is met in all parts of the horizon."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A schedule that was fitted.

    Attributes
    ----------
    schedules : tuple of Schedule, one for each experiment
    parameters : (M,)
        Free parameters and initial states, in the order of theta.
    acting : (M,) bool
        Those that act in the modes of the sequences; the others were held.
    cost : float
        J; infinite if the fit failed.
    guarded : int
        Transitions that have a guard.
    """

    schedules: tuple[Schedule, ...]
    parameters: FloatArray
    acting: NDArray[np.bool_]
    cost: float
    guarded: int = 0

    @property
    def sequences(self) -> tuple[tuple[str, ...], ...]:
        """The mode sequence of each experiment."""
        return tuple(schedule.sequence for schedule in self.schedules)

    @property
    def switches(self) -> int:
        """Number of transitions of all experiments."""
        return sum(schedule.switches for schedule in self.schedules)

    @property
    def free_switches(self) -> int:
        """Number of transitions whose times are unknowns: the time of one with a guard follows."""
        return self.switches - self.guarded

    @property
    def failed(self) -> bool:
        """Whether the model could not be evaluated, or a guard or terminal constraint is not met."""
        return not np.isfinite(self.cost)

    @property
    def has_unknowns(self) -> bool:
        """Whether there is anything to estimate."""
        return self.switches > 0 or bool(self.acting.any())

    @property
    def theta(self) -> FloatArray:
        """All times, then the parameters: (d,)."""
        return np.concatenate([*(schedule.times for schedule in self.schedules), self.parameters])


class Fitter:
    """Fits schedules of a library to the data of a problem.

    Parameters
    ----------
    problem : Problem
        Its sequences and transition times do not matter.
    library : Library

    Attributes
    ----------
    problem : Problem
        With the modes of the library alone, and room for `max_switches`.
    evaluations, fits : int
        Counts of evaluations of J, g and H, and of fits.
    """

    def __init__(self, problem: Problem, library: Library) -> None:
        self.library = library
        self.runs = problem.experiments
        self.problem = build_library_problem(problem, library)
        self.first = int(self.problem.unknowns.is_time.sum())
        self.start = self.problem.initial_theta[self.first :]
        self.fits = self.evaluations = 0
        self._evaluators: dict[Any, Evaluator] = {}
        self._experiments: list[Experiments] = [{} for _ in self.runs]
        self._acting: dict[Any, NDArray[np.bool_]] = {}
        self._results: dict[Any, Fitted] = {}

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Bounds of the parameters and initial states: (M,), (M,)."""
        unknowns = self.problem.unknowns
        return unknowns.lower[self.first :], unknowns.upper[self.first :]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters and initial states, M."""
        return self.problem.theta_names[self.first :]

    @cached_property
    def meshes(self) -> list[Mesh]:
        """The meshes of all fits, one for each experiment, fine enough for every mode anywhere in the horizon."""
        return [self._build_mesh(e) for e in range(len(self.runs))]

    def _build_mesh(self, e: int) -> Mesh:
        own = [run.mode_sequence for run in self.problem.experiments]
        spaced = [self._space_evenly([*own[:e], tour, *own[e + 1 :]]) for tour in self._list_tours()]
        return refine_mesh_of_many([self._build_problem(schedules) for schedules in spaced if schedules], e)

    def _space_evenly(self, sequences: Sequence[tuple[str, ...]]) -> list[Schedule]:
        """Return an evenly spaced schedule for each experiment; no schedules if there is no room for one of them."""
        pairs = zip(sequences, self.runs, strict=True)
        found = [space_evenly(sequence, run.t0, run.end, self.library) for sequence, run in pairs]
        return [schedule for schedule in found if schedule is not None] if None not in found else []

    def _list_tours(self) -> list[tuple[str, ...]]:
        """Return sequences in which each mode is active in many parts of the horizon.

        They need not be admitted: what counts is the step that each mode needs where the trajectory may be.
        """
        modes, count = self.library.modes, self.library.max_switches + 1
        if len(modes) == 1:
            return [modes]
        size = min(count, max(4, len(modes)))
        tours = [tuple(modes[(k + s) % len(modes)] for k in range(size)) for s in range(min(len(modes), TOURS))]
        return [self.problem.experiments[0].mode_sequence, *tours, *((mode,) for mode in modes)]

    def _build_problem(self, schedules: Sequence[Schedule]) -> Problem:
        """Return the problem of a schedule for each experiment, with its times as guesses."""
        times = [keep_off(s, run.jump_times).times for s, run in zip(schedules, self.runs, strict=True)]
        return self.problem.with_sequences([s.sequence for s in schedules], times)

    def get_evaluator(self, schedules: Sequence[Schedule]) -> Evaluator:
        """Return the evaluator of the sequences of some schedules, whatever their times: its guesses are others.

        Parameters
        ----------
        schedules : sequence of Schedule, one for each experiment
        """
        jumps = tuple(
            tuple(np.searchsorted(schedule.times, run.jump_times, "left").tolist())
            for schedule, run in zip(schedules, self.runs, strict=True)
        )
        key = tuple(schedule.sequence for schedule in schedules), jumps
        if key not in self._evaluators:
            self._evaluators[key] = self._build_evaluator(schedules)
        return self._evaluators[key]

    @cached_property
    def evaluator(self) -> Evaluator:
        """That of the problem as it is, with which those of all sequences share what they can."""
        return Evaluator(self.problem, meshes=self.meshes)

    @cached_property
    def costs(self) -> ScheduleCosts:
        """Costs of schedules without a fit."""
        return ScheduleCosts(self.problem, self.evaluator)

    @property
    def shares_programs(self) -> bool:
        """Whether another sequence compiles nothing: always in machine code, and with JAX one program for each number
        of switches if no functions act at transitions.
        """
        return self.costs.is_native or not any(
            structure.reset_library or structure.guard_library or structure.transition_cost_library or structure.known
            for structure in self.problem.structures
        )

    def fit(self, schedules: Sequence[Schedule], parameters: FloatArray) -> Fitted:
        """Fit times and parameters from a schedule for each experiment.

        Parameters
        ----------
        schedules : sequence of Schedule
            Moved apart first where modes last too short.
        parameters : (M,)
            Start of the parameters and initial states, clipped to their bounds.

        Returns
        -------
        Fitted
            With an infinite cost if the fit could not begin, or constraints are not met.
        """
        given = tuple(schedules)
        moved = [spread(schedule, self.library) for schedule in given]
        start = np.clip(parameters, *self.bounds)
        acting = self.find_acting([schedule.sequence for schedule in given])
        guards = self.problem.system.guards
        guarded = sum(pair in guards for schedule in given for pair in pairwise(schedule.sequence))
        failed = Fitted(given, start, acting, np.inf, guarded)
        feasible = [schedule for schedule in moved if schedule is not None]
        if len(feasible) < len(given):
            return failed
        theta = np.concatenate([*(schedule.times for schedule in feasible), start])
        key = tuple(schedule.sequence for schedule in feasible), theta.tobytes()
        if key not in self._results:
            self.fits += 1
            self._results[key] = self._fit(feasible, theta, failed)
        return self._results[key]

    def _fit(self, schedules: list[Schedule], theta: FloatArray, failed: Fitted) -> Fitted:
        if not failed.has_unknowns:
            self.evaluations += 1
            return replace(failed, cost=self.costs(schedules, failed.parameters))
        with np.errstate(all="ignore"):  # far from the data numbers may overflow
            evaluator = self.get_evaluator(schedules)
        held = self._hold(evaluator.problem.constraints, theta, failed.acting)
        end = fit_briefly(evaluator.problem, theta, evaluator=evaluator, constraints=held)
        self.evaluations += end.evaluations
        times = np.split(end.theta, np.cumsum([schedule.switches for schedule in schedules]))
        found = tuple(schedule.replace(schedule.sequence, own) for schedule, own in zip(schedules, times, strict=False))
        return replace(failed, schedules=found, parameters=times[-1], cost=end.cost)

    def _build_evaluator(self, schedules: Sequence[Schedule]) -> Evaluator:
        """Return the evaluator of a sequence; it shares what it can with earlier ones."""
        guesses = []  # that do not depend on the times, unless there are jumps between them
        for s, run in zip(schedules, self.runs, strict=True):
            even = None if len(run.jump_times) else space_evenly(s.sequence, s.t0, s.tf, self.library)
            guesses.append(even or spread(s, self.library) or s)
        problem = self._build_problem(guesses)
        if not self.costs.is_native or problem.system.guards or problem.constraint_names:
            return Evaluator(problem, meshes=self.meshes)
        return share_evaluator(self.evaluator, problem, self._experiments)

    @staticmethod
    def _hold(constraints: LinearConstraints, theta: FloatArray, acting: NDArray[np.bool_]) -> LinearConstraints:
        """Return the constraints with those parameters held that do not act."""
        if acting.all():
            return constraints
        held = len(theta) - len(acting) + np.flatnonzero(~acting)
        lower, upper = constraints.lower.copy(), constraints.upper.copy()
        lower[held] = upper[held] = theta[held]
        return replace(constraints, lower=lower, upper=upper)

    def polish(self, schedules: Sequence[Schedule], parameters: FloatArray) -> Fitted:
        """Fit, leave out modes that have collapsed, and fit again until none does.

        Parameters
        ----------
        schedules : sequence of Schedule
        parameters : (M,)
        """
        found = self.fit(schedules, parameters)
        while not found.failed:
            shorter = self.collapse(found)
            if shorter is None:
                return found
            found = self.fit(shorter, found.parameters)
        return found

    def collapse(self, fitted: Fitted) -> tuple[Schedule, ...] | None:
        """Return the schedules of a fit without the modes that have collapsed; None if none has."""
        shorter = tuple(collapse(s, self.library, COLLAPSED * (s.tf - s.t0)) for s in fitted.schedules)
        pairs = zip(shorter, fitted.schedules, strict=True)
        return None if all(a.sequence == b.sequence for a, b in pairs) else shorter

    def predict(self, schedules: Sequence[Schedule], parameters: FloatArray) -> float:
        """Return the lowest cost of the quadratic model at a schedule, without a fit.

        It is minus infinity where the model has no minimum, and infinite where the schedule cannot be evaluated.

        Parameters
        ----------
        schedules : sequence of Schedule
        parameters : (M,)
        """
        theta = np.concatenate([*(schedule.times for schedule in schedules), parameters])
        acting = self.find_acting([schedule.sequence for schedule in schedules])
        free = np.concatenate([np.ones(len(theta) - len(acting), dtype=bool), acting])
        if not free.any():
            return self.costs(schedules, parameters)
        try:
            with np.errstate(all="ignore"):
                here = self.get_evaluator(schedules)(theta)
                lower = np.linalg.cholesky(here.hessian[np.ix_(free, free)])
        except np.linalg.LinAlgError:
            return -np.inf
        except (ValueError, ArithmeticError):
            return np.inf
        self.evaluations += 1
        if not np.isfinite(here.cost):
            return np.inf
        whitened = np.linalg.solve(lower, here.gradient[free])
        return here.cost - 0.5 * float(whitened @ whitened)

    def find_acting(self, sequences: Sequence[tuple[str, ...]]) -> NDArray[np.bool_]:
        """Return which parameters and initial states act in the modes of the sequences: (M,).

        Parameters
        ----------
        sequences : sequence of tuple of str, one for each experiment
        """
        key = tuple(sequences)
        if key not in self._acting:
            structures = [self.costs.structure_of(e, sequence) for e, sequence in enumerate(key)]
            acting = find_read(self.problem, structures, library=False)
            arrays = find_arrays(self.problem) & acting
            if arrays.any():  # modes may read some entries of an array and not others
                acting &= ~(arrays & self._find_without_effect(key))
            self._acting[key] = acting
        return self._acting[key]

    def _find_without_effect(self, sequences: tuple[tuple[str, ...], ...]) -> NDArray[np.bool_]:
        """Return the parameters in which J has no first and second derivatives at two points: (M,)."""
        given = self._space_evenly(sequences)
        if not given:
            return np.zeros(len(self.start), dtype=bool)
        idle = np.ones(len(self.start), dtype=bool)
        for factor in (1.0, 1.1):
            theta = np.concatenate([*(s.times for s in given), np.clip(factor * self.start, *self.bounds)])
            with np.errstate(all="ignore"):
                here = self.get_evaluator(given)(theta)
            first = len(theta) - len(idle)
            idle &= (here.gradient[first:] == 0) & ~np.any(here.hessian[first:] != 0, axis=1)
        return idle
