"""Fits of any schedule of a library, in one program of machine code and on meshes that are built once.

A sequence takes a problem of its own, whose functions are traced and whose program is compiled already; parameters that
act in none of its modes are held where they are.

The cost of any schedule takes the microseconds of its simulation: a problem for each sequence takes a millisecond to
build, so that a scan over hundreds of schedules changes the sequence inside one experiment of machine code instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.mesh import Mesh
from switchfit.engine.corners.branches import has_corners
from switchfit.engine.native.library_places import places_in_library
from switchfit.engine.native.native_experiment import FailedCheckError, NativeExperiment, native_experiment
from switchfit.engine.native.sizes import Order
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.refinement import refine_mesh_of_many
from switchfit.modes.fitted import Fitted
from switchfit.modes.library_problem import build_library_problem
from switchfit.modes.schedule import Schedule, collapse, keep_off, space_evenly, spread
from switchfit.modes.shared_engine import ExperimentsByOrder, SharedEngine
from switchfit.optimize import LinearConstraints, lapack
from switchfit.problem.problem import Problem
from switchfit.problem.reads import find_read
from switchfit.problem.structure import Structure
from switchfit.strategy.library import Library
from switchfit.strategy.library_structure import trace_transition
from switchfit.strategy.short_fit import fit_briefly

COLLAPSED_BELOW = 1e-6
"""Duration, as a part of the horizon, below which a mode is left out."""

TOURS = 6
"""Sequences at which the meshes are refined, so that each mode is met in all parts of the horizon."""


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
        self._experiments: list[ExperimentsByOrder] = [{} for _ in self.runs]
        self._results: dict[Any, Fitted] = {}
        # Caches that end with the fitter: with `lru_cache` on the methods, every fitter of a process would stay in
        # memory.
        self._trace = cache(lambda e, pair: trace_transition(self.problem, self.problem.experiments[e], pair))
        self._build_structure = cache(self._place_functions)
        self.find_acting = cache(self._find_acting)
        counts = [len(run.times) + len(run.jump_times) for run in self.problem.experiments]
        self._places = [places[N:] - self.first for places, N in zip(self.problem.places, counts, strict=True)]

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Bounds of the parameters and initial states: (M,), (M,)."""
        unknowns = self.problem.unknowns
        return unknowns.lowest[self.first :], unknowns.upper[self.first :]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters and initial states, M."""
        return self.problem.theta_names[self.first :]

    @cached_property
    def meshes(self) -> list[Mesh]:
        """The meshes of all fits, one for each experiment, fine enough for every mode anywhere in the horizon."""
        return [self._build_mesh(e) for e in range(len(self.runs))]

    def _build_mesh(self, e: int) -> Mesh:
        # Other runs keep their sequences: the mesh is that of run e alone.
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
        # The sequence alone is no key where the state jumps at known times: on which side of a jump a transition lies
        # decides which transitions the structure has.
        key = tuple(schedule.sequence for schedule in schedules), jumps
        if key not in self._evaluators:
            self._evaluators[key] = self._build_evaluator(schedules)
        return self._evaluators[key]

    @cached_property
    def evaluator(self) -> Evaluator:
        """That of the problem as it is, with which those of all sequences share what they can."""
        return Evaluator(self.problem, meshes=self.meshes)

    @cached_property
    def _simulators(self) -> list[NativeExperiment | None]:
        """What simulates any sequence of each experiment in machine code; None where that cannot be."""
        found = []
        for e, (run, engine) in enumerate(zip(self.runs, self.evaluator.engines, strict=True)):
            is_native = engine.engine.name == "native" and not len(run.jump_times)
            given = self.problem.structures[e], self.evaluator.arguments[e], self.meshes[e].times
            found.append(native_experiment(*given, Order.COST) if is_native else None)
        return found

    def cost(self, schedules: Sequence[Schedule], parameters: FloatArray) -> float:
        """Return J of one schedule for each experiment; infinite where it cannot be simulated.

        Parameters
        ----------
        schedules : sequence of Schedule
        parameters : (M,)
            Free parameters and initial states, in the order of theta.
        """
        return float(self.compute_costs(schedules, 0, schedules[:1], parameters)[0])

    def compute_costs(
        self, schedules: Sequence[Schedule], e: int, moved: Sequence[Schedule], parameters: FloatArray
    ) -> FloatArray:
        """Return J with each of some schedules in the place of that of experiment e: (B,).

        Parameters
        ----------
        schedules : sequence of Schedule, one for each experiment
        e : int
        moved : sequence of Schedule
        parameters : (M,)
        """
        with np.errstate(all="ignore"):
            found = self._simulate(e, moved, parameters)
            for k, schedule in enumerate(schedules):
                if k != e:
                    found += self._simulate(k, [schedule], parameters)
            priors = self.problem.unknowns.priors
            if priors.any:
                found += priors.evaluate(np.concatenate([self.problem.initial_theta[: self.first], parameters]))[0]
            # NaN is what machine code could not say, as where a check of finiteness failed: the evaluator, which falls
            # back to JAX, says whether J is finite there.
            for i in np.flatnonzero(np.isnan(found)).tolist():
                found[i] = self._evaluate([*schedules[:e], moved[i], *schedules[e + 1 :]], parameters)
            return np.where(np.isfinite(found), found, np.inf)

    def _simulate(self, e: int, schedules: Sequence[Schedule], parameters: FloatArray) -> FloatArray:
        """Return what an experiment adds to J with each of some schedules; NaN where machine code cannot say: (B,)."""
        native, p = self._simulators[e], parameters[self._places[e]]
        found = np.full(len(schedules), np.nan)
        if native is not None:
            # Those of one sequence together: to assign one takes half as long as J.
            for i, schedule in sorted(enumerate(schedules), key=lambda each: each[1].sequence):
                structure = self._build_structure(e, schedule.sequence)
                if structure is not native.structure:
                    native.assign_sequence(structure, places_in_library(structure))
                with suppress(FailedCheckError):
                    found[i] = native.cost(schedule.times, p)
        return found

    def _evaluate(self, schedules: Sequence[Schedule], parameters: FloatArray) -> float:
        """Return J by the evaluator of a sequence."""
        if not len(parameters) and not any(schedule.switches for schedule in schedules):
            # A problem needs an unknown: a transition from a mode to itself has no effect.
            first = schedules[0]
            middle = np.array([0.5 * (first.t0 + first.tf)])
            schedules = [first.replace(first.sequence * 2, middle), *schedules[1:]]
        times = [keep_off(s, run.jump_times).times for s, run in zip(schedules, self.runs, strict=True)]
        return self.get_evaluator(schedules).cost(np.concatenate([*times, parameters]))

    def _place_functions(self, e: int, sequence: tuple[str, ...]) -> Structure:
        """Return the structure of an experiment with another sequence."""
        base = self.problem.structures[e]
        modes = tuple(base.mode_names.index(mode) for mode in sequence)
        if base.jumps:  # among whose reset maps those of the jumps stand
            return replace(base, mode_of_segment=modes)
        found = [self._trace(e, pair) for pair in pairwise(sequence)]
        resets, costs, guards = zip(*found, strict=True) if found else ((), (), ())
        return replace(base, mode_of_segment=modes, reset_maps=resets, guards=guards, transition_costs=costs)

    @property
    def shares_programs(self) -> bool:
        """Whether another sequence compiles nothing: always in machine code, and with JAX one program for each number
        of switches if no functions act at transitions.
        """
        return None not in self._simulators or not any(
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
        acting = self.find_acting(tuple(schedule.sequence for schedule in given))
        guards = self.problem.system.guards
        guarded = sum(pair in guards for schedule in given for pair in pairwise(schedule.sequence))
        failed = Fitted(given, start, acting, np.inf, guarded)
        feasible = [schedule for schedule in moved if schedule is not None]
        if len(feasible) < len(given):
            return failed
        theta = np.concatenate([*(schedule.times for schedule in feasible), start])
        key = tuple(schedule.sequence for schedule in feasible), theta.tobytes()
        # Different moves lead to the same schedule and parameters, to the last bit: each such fit is done once.
        if key not in self._results:
            self.fits += 1
            self._results[key] = self._fit(feasible, theta, failed)
        return self._results[key]

    def _fit(self, schedules: list[Schedule], theta: FloatArray, failed: Fitted) -> Fitted:
        if not failed.has_unknowns:
            self.evaluations += 1
            cost = self._evaluate(schedules, failed.parameters)
            return replace(failed, cost=cost if np.isfinite(cost) else np.inf)
        with np.errstate(all="ignore"):  # far from the data numbers may overflow
            evaluator = self.get_evaluator(schedules)
        # Parameters that act in no mode of the sequence have zero rows in the Hessian, which would be taken for flat
        # directions: they are held.
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
        is_plain = None not in self._simulators and not any(map(has_corners, problem.structures))
        if problem.constraint_names or not is_plain:
            return Evaluator(problem, meshes=self.meshes)
        # Not by its constructor, which makes meshes and engines for this sequence: those of the library serve all of
        # them.
        found = object.__new__(Evaluator)
        found.problem, found.meshes, found.arguments = problem, self.evaluator.meshes, self.evaluator.arguments
        given = zip(problem.structures, found.arguments, found.meshes, self._experiments, strict=True)
        found.engines = [SharedEngine(*each) for each in given]
        return found

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
        while not found.failed and (shorter := self.collapse(found)) is not None:
            found = self.fit(shorter, found.parameters)
        return found

    def collapse(self, fitted: Fitted) -> tuple[Schedule, ...] | None:
        """Return the schedules of a fit without the modes that have collapsed; None if none has."""
        shorter = tuple(collapse(s, self.library, COLLAPSED_BELOW * (s.tf - s.t0)) for s in fitted.schedules)
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
        acting = self.find_acting(tuple(schedule.sequence for schedule in schedules))
        free = np.concatenate([np.ones(len(theta) - len(acting), dtype=bool), acting])
        if not free.any():
            return self.cost(schedules, parameters)
        try:
            with np.errstate(all="ignore"):
                here = self.get_evaluator(schedules)(theta)
        except (ValueError, ArithmeticError):
            return np.inf
        self.evaluations += 1
        if not np.isfinite(here.cost):
            return np.inf
        # min over d of J + g'd + d'H d / 2 is J - g'H^-1 g / 2; Cholesky fails where H is not positive definite.
        _, step, has_no_minimum = lapack.dposv(here.hessian[np.ix_(free, free)], -here.gradient[free])
        return -np.inf if has_no_minimum else here.cost + 0.5 * float(here.gradient[free] @ step)

    def _find_acting(self, sequences: tuple[tuple[str, ...], ...]) -> NDArray[np.bool_]:
        """Return which parameters and initial states act in the modes of the sequences: (M,)."""
        structures = [self._build_structure(e, sequence) for e, sequence in enumerate(sequences)]
        return find_read(self.problem, structures, library=False)
