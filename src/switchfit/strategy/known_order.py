"""The times of a given order of modes: a beam over each log, then a fit, and hops of times over samples.

A beam (`beam`) needs no guess of the times: it follows hypotheses about them through the log, and the parameters move
along. It begins again at the parameters of the fit as long as that lowers J. Of several runs each has a pass of its
own, in which what the others say about the shared parameters is a quadratic cost: the Schur complement of their linear
models.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.problem.data import FloatArray, Measurements, ReferenceSignal
from switchfit.problem.experiment import Experiment
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem
from switchfit.runtime.progress import show_detail
from switchfit.strategy.beam import REPLAYS, REPLAYS_OF_ORDER, follow_order, prepare
from switchfit.strategy.hops import hop_over_samples
from switchfit.strategy.proposal import Quadratic
from switchfit.strategy.quick import End, OutOfTimeError, fit_briefly, make_feasible

PASSES = 3
"""Most passes over all logs, each from the parameters of the last fit. Of the two turns of the benchmark 13 of 48
starts end right after one, all after two."""

LOWER = 1e-6
"""Part of itself by which J has to fall for another pass."""


def explain_no_beam(problem: Problem) -> str:
    """Return why no beam can follow the data of a problem; empty if one can. The machine code is compiled here."""
    for run in problem.experiments:
        if not any(isinstance(item, (Measurements, ReferenceSignal)) for item in run.data):
            return "there are no data to follow"
    try:
        for e in range(len(problem.experiments)):
            prepare(_fix_delays(problem), e)
    except ValueError as error:
        return str(error)
    return ""


def find_times(problem: Problem, theta: FloatArray, is_enough: Callable[[float], bool] = lambda cost: False) -> End:
    """Return the lowest end of fits that begin at what beams find, from the parameters in theta (d,).

    Parameters
    ----------
    problem : Problem
    theta : (d,)
        Its transition times do not matter.
    is_enough : callable
        Asked after each fit whether its J is low enough to end the search.
    """
    best, evaluations = End(theta, np.inf, 0), 0
    beams = _Beams(problem)
    with suppress(OutOfTimeError):
        for _ in range(PASSES):
            end = fit_briefly(problem, beams.follow(best.theta))
            evaluations += end.evaluations
            is_lower = end.cost < best.cost - LOWER * abs(best.cost) if np.isfinite(best.cost) else not end.failed
            best = end if is_lower else best
            if not is_lower or is_enough(best.cost):
                break
        if not best.failed and not is_enough(best.cost):
            end = hop_over_samples(problem, best)
            best, evaluations = end, evaluations + end.evaluations
    return best._replace(evaluations=evaluations)


class _Beams:
    """The beams of all runs of a problem, and what each says about the parameters that they share."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.followed = problem, _fix_delays(problem)
        self.own = [prepare(self.followed, e).own for e in range(len(problem.experiments))]
        places, times = np.unique(np.concatenate(self.own), return_counts=True)
        self.shared, self.first = places[times > 1], int(problem.unknowns.is_time.sum())
        self.replays = REPLAYS_OF_ORDER
        E, s = len(self.own), len(self.shared)
        self.matrices, self.slopes = np.zeros((E, s, s)), np.zeros((E, s))  # of b'q - q'A q / 2

    def follow(self, theta: FloatArray) -> FloatArray:
        """Return theta (d,) with the times and parameters that the beams find, which begin at its parameters."""
        moved, q = theta.copy(), theta[self.first :]
        for e, where in enumerate(self.problem.unknowns.times):
            show_detail(f"run {e + 1} of {len(self.own)}")
            for proposal in follow_order(self.followed, e, q, self._sum_others(e, q), self.replays)[:1]:
                moved[where[where >= 0]] = proposal.transition_times[0][where >= 0]
                moved[self.first + self.own[e]] = proposal.parameters[self.own[e]]
                self._add(e, proposal.evidence)
        moved[self.first + self.shared] = self._combine(q[self.shared])
        self.replays = REPLAYS if len(self.shared) else REPLAYS_OF_ORDER
        return make_feasible(self.problem, moved)

    def _locate(self, e: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return which of a run's parameters are shared, and their positions among the shared ones."""
        mine = np.flatnonzero(np.isin(self.own[e], self.shared))
        return mine, np.searchsorted(self.shared, self.own[e][mine])

    def _add(self, e: int, evidence: Quadratic | None) -> None:
        """Keep what the data of a run say about the shared parameters."""
        if evidence is None:
            return
        mine, at = self._locate(e)
        center, g, Q = evidence.restrict(mine)
        self.matrices[e][np.ix_(at, at)], self.slopes[e][at] = Q, Q @ center - g

    def _sum_others(self, e: int, q: FloatArray) -> Quadratic:
        """Return what all other runs have said about a run's parameters so far, with 0 as its lowest cost.

        Directions of which they say nothing stay at q (P,).
        """
        mine, at = self._locate(e)
        A, b = self.matrices.sum(0) - self.matrices[e], self.slopes.sum(0) - self.slopes[e]
        lowest = _solve(A, b, q[self.shared])
        curvature = Quadratic(lowest, np.zeros(len(A)), A).restrict(at).Q
        center, Q = q[self.own[e]], np.zeros((len(self.own[e]),) * 2)
        center[mine], Q[np.ix_(mine, mine)] = lowest[at], curvature
        return Quadratic(center, np.zeros(len(Q)), Q)

    def _combine(self, q: FloatArray) -> FloatArray:
        """Return the shared parameters at which the sum of what runs say, and of the priors about q (s,), is lowest."""
        unknowns, places = self.problem.unknowns, self.first + self.shared
        _, g, h = PriorTerms(*(values[places] for values in unknowns.priors)).evaluate(q, gauss_newton=True)
        solved = _solve(self.matrices.sum(0) + np.diag(h), self.slopes.sum(0) + h * q - g, q)
        return np.clip(solved, unknowns.lower[places], unknowns.upper[places])


def _solve(A: FloatArray, b: FloatArray, q: FloatArray) -> FloatArray:
    """Return the solution of A x = b that is nearest to q, where A is singular."""
    return np.asarray(q + np.linalg.pinv(A, rcond=1e-10, hermitian=True) @ (b - A @ q))


def _fix_delays(problem: Problem) -> Problem:
    """Return the problem with delays that are parameters at their guesses, as a beam follows it; built once."""
    if not any(sensor.delay for structure in problem.structures for sensor in structure.measurements):
        return problem
    if "with_fixed_delays" not in problem.__dict__:

        def fix(run: Experiment, item: Any) -> Any:
            if not (isinstance(item, Measurements) and isinstance(item.delay, str)):
                return item
            parameter = problem.parameters[run.parameter_map.get(item.delay, item.delay)]
            return replace(item, delay=float(parameter.value))

        runs = [replace(run, data=[fix(run, item) for item in run.data]) for run in problem.experiments]
        object.__setattr__(problem, "with_fixed_delays", replace(problem, experiments=runs))
    found: Problem = problem.__dict__["with_fixed_delays"]
    return found
