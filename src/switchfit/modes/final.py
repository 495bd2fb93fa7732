"""The problem of a mode sequence, and its certified estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from switchfit.estimation.estimator import Estimate
from switchfit.estimation.local_fit import fit_locally
from switchfit.modes.fitter import Fitted
from switchfit.modes.schedule import Schedule, keep_off, spread
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.strategy.library import Library
from switchfit.strategy.other_run import fix_unknowns


def build_final_problem(
    searched: Problem, given: Problem, library: Library, schedules: tuple[Schedule, ...], acting: NDArray[np.bool_]
) -> Problem:
    """Return the problem of one schedule: its times are guesses, and parameters that act in none of its modes fixed.

    Parameters
    ----------
    searched : Problem
        That of the search, whose program it shares.
    given : Problem
        That of the user, with its tolerances.
    library : Library
    schedules : tuple of Schedule, one for each experiment
    acting : (M,) bool
    """
    moved = [
        keep_off(spread(schedule, library) or schedule, run.jump_times)
        for schedule, run in zip(schedules, searched.experiments, strict=True)
    ]
    pairs = zip(searched.experiments, moved, strict=True)
    runs = [replace(run, mode_sequence=s.sequence, transition_times=tuple(s.times)) for run, s in pairs]
    durations = {mode: library.min_duration(mode) for mode in searched.system.modes}
    alike = len(set(durations.values())) == 1
    shortest = next(iter(durations.values())) if alike else durations
    problem = replace(searched, experiments=runs, min_duration=shortest, rtol=given.rtol, atol=given.atol)
    first = sum(schedule.switches for schedule in schedules)
    spans = problem.unknowns.parameters.values()
    # The entries of an array are estimated all together, or none of them.
    idle = [range(s.start, s.stop) for s in spans if not acting[s.start - first : s.stop - first].any()]
    held = [problem.theta_names[i] for span in idle for i in span]
    return fix_unknowns(problem, held) if held else problem


def certify_schedule(
    searched: Problem,
    given: Problem,
    library: Library,
    schedules: tuple[Schedule, ...],
    parameters: FloatArray,
    acting: NDArray[np.bool_],
) -> Estimate:
    """Return the estimate of one schedule, from where the search has fitted it.

    Parameters
    ----------
    searched, given, library, schedules, acting
        As in `build_final_problem`.
    parameters : (M,)
        Fitted free parameters and initial states.
    """
    problem = build_final_problem(searched, given, library, schedules, acting)
    times = [run.initial_times for run in problem.experiments]
    known = dict(zip(searched.theta_names[-len(parameters) :], parameters, strict=True)) if len(parameters) else {}
    first = sum(len(own) for own in times)
    rest = [known[name] for name in problem.theta_names[first:]]
    return fit_locally(problem, start=np.concatenate([*times, rest]))


class Certifier:
    """Certified estimates of what a search has fitted, each made once.

    Parameters
    ----------
    searched, given, library
        As in `build_final_problem`.
    """

    def __init__(self, searched: Problem, given: Problem, library: Library) -> None:
        self._of_search = searched, given, library
        self._estimates: dict[tuple[tuple[str, ...], ...], Estimate | None] = {}

    def estimate(self, fitted: Fitted) -> Estimate | None:
        """Return the certified estimate of a schedule; None if there is nothing to estimate."""
        if fitted.sequences not in self._estimates:
            found = None
            if fitted.switches or fitted.acting.any():
                found = certify_schedule(*self._of_search, fitted.schedules, fitted.parameters, fitted.acting)
            self._estimates[fitted.sequences] = found
        return self._estimates[fitted.sequences]

    def find(self, sequences: tuple[tuple[str, ...], ...]) -> Estimate | None:
        """Return the estimate of some sequences; None if it has not been made."""
        return self._estimates.get(sequences)
