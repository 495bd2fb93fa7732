"""The cost of any schedule of a library, in the microseconds that its simulation takes.

A problem for each sequence takes a millisecond to build, more than many simulations: a scan over hundreds of schedules
changes the sequence inside one experiment of machine code instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Mesh
from switchfit.engine.native.experiment import NativeExperiment, native_experiment, places_in_library
from switchfit.engine.native.templates import Order
from switchfit.fit.evaluator import Evaluator
from switchfit.modes.schedule import Schedule, keep_off
from switchfit.problem.costs import TransitionCost
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Function, Structure, trace_structure


class ScheduleCosts:
    """Costs of schedules of one problem, on fixed meshes.

    Parameters
    ----------
    problem : Problem
        With `max_transitions`.
    evaluator : Evaluator
        Of any of its sequences.
    """

    def __init__(self, problem: Problem, evaluator: Evaluator) -> None:
        self.problem, self._evaluator = problem, evaluator
        self._rows: dict[tuple[int, tuple[str, ...]], NDArray[np.int64]] = {}
        self._pairs: dict[tuple[int, tuple[str, str]], tuple[Function | None, ...]] = {}
        self._native = [self._build(e, mesh) for e, mesh in enumerate(evaluator.meshes)]
        times = sum(len(run.transition_times) for run in problem.experiments)
        counts = [len(run.times) + len(run.jump_times) for run in problem.experiments]
        self._places = [places[N:] - times for places, N in zip(problem.places, counts, strict=True)]

    def _build(self, e: int, mesh: Mesh) -> NativeExperiment | None:
        """Return an experiment that simulates any sequence; None where there is none in machine code."""
        problem = self.problem
        if len(problem.experiments[e].jump_times) or self._evaluator.engines[e].engine.name != "native":
            return None
        return native_experiment(problem.structures[e], self._evaluator.arguments[e], mesh.times, Order.COST)

    @property
    def is_native(self) -> bool:
        """Whether machine code simulates every sequence."""
        return all(experiment is not None for experiment in self._native)

    def __call__(self, schedules: Sequence[Schedule], parameters: FloatArray) -> float:
        """Return J of one schedule for each experiment; infinite where it cannot be simulated.

        Parameters
        ----------
        schedules : sequence of Schedule
        parameters : (M,)
            Free parameters and initial states, in the order of theta.
        """
        return float(self.compute_all(schedules, 0, schedules[:1], parameters)[0])

    def compute_all(
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
                times = self.problem.initial_theta[: len(self.problem.theta_names) - len(parameters)]
                found += priors.evaluate(np.concatenate([times, parameters]))[0]
            for i in np.flatnonzero(np.isnan(found)).tolist():
                found[i] = self._evaluate([*schedules[:e], moved[i], *schedules[e + 1 :]], parameters)
            return np.where(np.isfinite(found), found, np.inf)

    def _simulate(self, e: int, schedules: Sequence[Schedule], parameters: FloatArray) -> FloatArray:
        """Return what an experiment adds to J with each of some schedules; NaN where machine code cannot say: (B,)."""
        native, p = self._native[e], parameters[self._places[e]]
        if native is None or not schedules:
            return np.full(len(schedules), np.nan)
        times = np.full((len(schedules), native.sizes.N), native.times[-1])
        for row, schedule in zip(times, schedules, strict=True):
            row[: schedule.switches] = schedule.times
        found = native.costs(np.array([self._list_places(e, each.sequence) for each in schedules]), times, p)
        if found is None:  # samples come late
            found = np.empty(len(schedules))
            for i, schedule in enumerate(schedules):
                native.assign_sequence(self.structure_of(e, schedule.sequence))
                cost = native.cost(schedule.times, p)
                found[i] = np.nan if cost is None else cost
        return found

    def _list_places(self, e: int, sequence: tuple[str, ...]) -> NDArray[np.int64]:
        """Return what is active where in a sequence, for machine code."""
        key = e, sequence
        if key not in self._rows:
            places = places_in_library(self.structure_of(e, sequence))
            self._rows[key] = np.concatenate([which[:-1] for which in places.values()])
        return self._rows[key]

    def _evaluate(self, schedules: Sequence[Schedule], parameters: FloatArray) -> float:
        """Return J by a problem of its own."""
        if not len(parameters) and not any(schedule.switches for schedule in schedules):
            # A problem needs an unknown: a transition from a mode to itself has no effect.
            first = schedules[0]
            middle = np.array([0.5 * (first.t0 + first.tf)])
            schedules = [first.replace(first.sequence * 2, middle), *schedules[1:]]
        given = zip(schedules, self.problem.experiments, strict=True)
        times = [keep_off(schedule, run.jump_times).times for schedule, run in given]
        problem = self.problem.with_sequences([schedule.sequence for schedule in schedules], times)
        evaluator = Evaluator(problem, meshes=self._evaluator.meshes)
        return evaluator.cost(np.concatenate([*times, parameters]))

    def structure_of(self, e: int, sequence: tuple[str, ...]) -> Structure:
        """Return the structure of an experiment with another sequence."""
        base = self.problem.structures[e]
        modes = tuple(base.mode_names.index(mode) for mode in sequence)
        if base.jumps:  # among whose reset maps those of the jumps stand
            return replace(base, mode_of_segment=modes)
        found = [self._functions_between(e, pair) for pair in pairwise(sequence)]
        resets, guards, costs = zip(*found, strict=True) if found else ((), (), ())
        return replace(base, mode_of_segment=modes, reset_maps=resets, guards=guards, transition_costs=costs)

    def _functions_between(self, e: int, pair: tuple[str, str]) -> tuple[Function | None, ...]:
        """Return the reset map, the guard and the transition cost of a transition."""
        if (e, pair) not in self._pairs:
            problem, run = self.problem, self.problem.experiments[e]
            found: tuple[Function | None, ...] = (None, None, None)
            costs = any(isinstance(item, TransitionCost) for item in run.data)
            if costs or pair in problem.system.reset_maps or pair in problem.system.guards:
                run = replace(run, mode_sequence=pair, transition_times=None)
                alone = trace_structure(problem.system, run, problem._functions, problem.solver, 1)
                found = alone.reset_maps[0], alone.guards[0], alone.transition_costs[0]
            self._pairs[e, pair] = found
        return self._pairs[e, pair]
