"""Certified estimates of the schedules that a search has fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from switchfit.estimation.estimates import Estimate
from switchfit.fit.local_fit import fit_locally
from switchfit.modes.fitted import Fitted
from switchfit.modes.schedule import keep_off, spread
from switchfit.problem.problem import Problem
from switchfit.problem.variants import fix_unknowns
from switchfit.strategy.library import Library


class Certifier:
    """Certified estimates of what a search has fitted, each made once.

    Parameters
    ----------
    searched : Problem
        That of the search, whose program the estimates share.
    given : Problem
        That of the user, with its tolerances.
    library : Library
    """

    def __init__(self, searched: Problem, given: Problem, library: Library) -> None:
        self.searched, self.given, self.library = searched, given, library
        self._estimates: dict[tuple[tuple[str, ...], ...], Estimate] = {}

    def build_problem(self, fitted: Fitted) -> Problem:
        """Return the problem of a schedule: its times are guesses, and parameters that act in none of its modes fixed.

        Parameters
        ----------
        fitted : Fitted
        """
        searched, library = self.searched, self.library
        runs = []
        for schedule, run in zip(fitted.schedules, searched.experiments, strict=True):
            times = keep_off(spread(schedule, library) or schedule, run.jump_times).times
            runs.append(replace(run, mode_sequence=schedule.sequence, transition_times=tuple(times)))
        durations = dict(library.durations)
        # A number where all are alike: durations by mode are for libraries whose modes differ.
        shortest = durations if len(set(durations.values())) > 1 else max(durations.values())
        # The search may work more coarsely; what is reported has the tolerances that were asked for.
        rtol, atol = self.given.rtol, self.given.atol
        problem = replace(searched, experiments=runs, min_duration=shortest, rtol=rtol, atol=atol)
        first, acting = fitted.switches, fitted.acting
        # Fixed where they do not act: the Hessian has no row of zeros, and the report no unknown without effect.
        spans = problem.unknowns.parameters.values()
        # The entries of an array are estimated all together, or none of them.
        idle = [range(s.start, s.stop) for s in spans if not acting[s.start - first : s.stop - first].any()]
        held = [problem.theta_names[i] for span in idle for i in span]
        return fix_unknowns(problem, held) if held else problem

    def estimate(self, fitted: Fitted) -> Estimate:
        """Return the certified estimate of a schedule, from where the search has fitted it.

        Parameters
        ----------
        fitted : Fitted
            With something to estimate.
        """
        if fitted.sequences not in self._estimates:
            problem = self.build_problem(fitted)
            names = self.searched.theta_names[len(self.searched.theta_names) - len(fitted.parameters) :]
            known = dict(zip(names, fitted.parameters, strict=True))
            rest = [known[name] for name in problem.theta_names[fitted.switches :]]
            start = np.concatenate([*(run.initial_times for run in problem.experiments), rest])
            self._estimates[fitted.sequences] = Estimate.take_over(fit_locally(problem, start=start))
        return self._estimates[fitted.sequences]

    def find(self, sequences: tuple[tuple[str, ...], ...]) -> Estimate | None:
        """Return the estimate of some sequences; None if it has not been made."""
        return self._estimates.get(sequences)
