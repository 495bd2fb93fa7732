"""The times of a given order of modes: a beam over each log, then a fit, and hops of times over samples.

A beam (`beam`) needs no guess of the times: it follows hypotheses about them through the log, and the parameters move
along. It begins again at the parameters of the fit as long as that lowers J.

Beams over all runs of a problem, each in turn: what the others say about shared parameters is a quadratic cost.

Problems some of whose unknowns are fixed at their guesses.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.evaluator import assume_noise
from switchfit.problem.experiment import Experiment
from switchfit.problem.measurements import Measurements
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.runtime.progress import show_detail
from switchfit.strategy.beam import REPLAYS, REPLAYS_OF_ORDER, Proposal, Quadratic, follow_order, prepare
from switchfit.strategy.hops import hop_over_samples
from switchfit.strategy.starts import End, OutOfTimeError, fit_briefly, make_feasible, prepare_meshes

PASSES = 2
"""Most passes over all logs, each from the parameters of the last fit. Of the two turns of the benchmark 13 of 48
starts end right after one, all after two. A third lowers J in none of 17 problems of the benchmark, and took a quarter
of the time of ten joint tosses."""

SOFTER = 3.0
"""Standard deviations of a channel that a beam takes for noise where transitions reset the state and nothing good is
found otherwise. Births are on a grid, and each sample between one and where the state jumps is off by all of the jump.
With 1, 11 of 16 gearboxes that shift at a speed end right, with 3, 15; with 10, 9 of 16 balls whose speed is measured,
not 16."""

KNOWN = 2
"""Runs after which the others begin at the parameters that follow from what has been said of them. The few replays do
there that suit the parameters of a fit: the beams of 200 runs take 0.84 s in place of 1.27, with the same end."""

SETTLED = 0.5
"""Part of its grid by which a fit leaves a time where a beam has proposed it."""

LOWER = 1e-6
"""Part of itself by which J has to fall for another pass."""


class Beams:
    """The beams of all runs of a problem, and what each says about the parameters that they share.

    Parameters
    ----------
    problem : Problem
    own : sequence of (U,) int arrays, one for each run
        Positions of the run's parameters and initial states among those of the problem.
    """

    def __init__(self, problem: Problem, own: Sequence[NDArray[np.intp]]) -> None:
        self.problem, self.own = problem, own
        places, times = np.unique(np.concatenate(own), return_counts=True)
        self.shared, self.first = places[times > 1], int(problem.unknowns.is_time.sum())
        E, s = len(own), len(self.shared)
        self.matrices, self.slopes = np.zeros((E, s, s)), np.zeros((E, s))  # of b'q - q'A q / 2

    def follow(
        self,
        q: FloatArray,
        follow_run: Callable[[int, FloatArray, Quadratic | None], list[Proposal]],
        settled: Collection[int] = (),
    ) -> tuple[list[list[Proposal]], FloatArray]:
        """Return the proposals of each run, best first, and the parameters (P,) that follow from the best ones.

        Parameters
        ----------
        q : (P,)
            Parameters and initial states at which the beams begin.
        follow_run : callable (e, q, evidence) -> list of Proposal
            The beam of one run; the evidence is what the others have said.
        settled : collection of int
            Runs that are not followed, without proposals: what they have said before stands.
        """
        found, moved = [], q.copy()
        for e, own in enumerate(self.own):
            show_detail(f"run {e + 1} of {len(self.own)}")
            found.append([] if e in settled else follow_run(e, q, self._sum_others(e, q)))
            for best in found[e][:1]:
                moved[own] = best.parameters[own]
                if best.evidence is not None:  # what the data of the run say about shared parameters
                    mine, at = self._locate(e)
                    center, g, Q = best.evidence.restrict(mine)
                    self.matrices[e][np.ix_(at, at)], self.slopes[e][at] = Q, Q @ center - g
        moved[self.shared] = self.combine(q)[self.shared]
        return found, moved

    def join(self, found: Sequence[Sequence[Proposal]], q: FloatArray) -> list[Proposal]:
        """Return proposals for all runs together, at shared parameters of q (P,): the best of each run, then those in
        which one run has another one; none if a run has none.
        """
        if not all(found):
            return []
        best = [proposals[0] for proposals in found]
        others = [[*best[:e], other, *best[e + 1 :]] for e, own in enumerate(found) for other in own[1:]]
        return [self._join(chosen, q.copy()) for chosen in (best, *others)]

    def _join(self, chosen: Sequence[Proposal], moved: FloatArray) -> Proposal:
        for own, proposal in zip(self.own, chosen, strict=True):
            private = np.setdiff1d(own, self.shared)
            moved[private] = proposal.parameters[private]
        sequences = tuple(proposal.sequences[0] for proposal in chosen)
        times = tuple(proposal.transition_times[0] for proposal in chosen)
        return Proposal(sequences, times, moved, sum(proposal.cost for proposal in chosen))

    def _locate(self, e: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return which of a run's parameters are shared, and their positions among the shared ones."""
        mine = np.flatnonzero(np.isin(self.own[e], self.shared))
        return mine, np.searchsorted(self.shared, self.own[e][mine])

    def _sum_others(self, e: int, q: FloatArray) -> Quadratic | None:
        """Return what all other runs have said about a run's parameters so far, with 0 as its lowest cost.

        Directions of which they say nothing stay at q (P,).
        """
        if not len(self.shared):
            return None
        mine, at = self._locate(e)
        A, b = self.matrices.sum(0) - self.matrices[e], self.slopes.sum(0) - self.slopes[e]
        lowest = _solve(A, b, q[self.shared])
        curvature = Quadratic(lowest, np.zeros(len(A)), A).restrict(at).Q
        center, Q = q[self.own[e]], np.zeros((len(self.own[e]),) * 2)
        center[mine], Q[np.ix_(mine, mine)] = lowest[at], curvature
        return Quadratic(center, np.zeros(len(Q)), Q)

    def combine(self, q: FloatArray) -> FloatArray:
        """Return q (P,) with those shared parameters at which the sum of what runs say, and of the priors about q, is
        lowest.
        """
        unknowns, places, moved, near = self.problem.unknowns, self.first + self.shared, q.copy(), q[self.shared]
        _, g, h = PriorTerms(*(values[places] for values in unknowns.priors)).evaluate(near, gauss_newton=True)
        solved = _solve(self.matrices.sum(0) + np.diag(h), self.slopes.sum(0) + h * near - g, near)
        moved[self.shared] = np.clip(solved, unknowns.lowest[places], unknowns.upper[places])
        return moved


def _solve(A: FloatArray, b: FloatArray, q: FloatArray) -> FloatArray:
    """Return the solution of A x = b that is nearest to q, where A is singular."""
    return np.asarray(q + np.linalg.pinv(A, rcond=1e-10, hermitian=True) @ (b - A @ q))


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
    best = _find_times(problem, theta, _fix_delays(problem), is_enough)
    if not any(structure.has_resets for structure in problem.structures) or is_enough(best.cost):
        return best
    other = _find_times(problem, theta, _soften(problem), is_enough)
    return min(best, other, key=lambda end: end.cost)._replace(evaluations=best.evaluations + other.evaluations)


def _find_times(problem: Problem, theta: FloatArray, followed: Problem, is_enough: Callable[[float], bool]) -> End:
    """Do what `find_times` does by beams along the data of another problem."""
    best, evaluations, evaluator = End(theta, np.inf, 0), 0, None
    beams = Beams(problem, [prepare(followed, e).own for e in range(len(problem.experiments))])
    settled: set[int] = set()
    with suppress(OutOfTimeError):
        for again in range(PASSES):
            follow = partial(_follow_run, followed, beams, is_fitted=again > 0)
            found, q = beams.follow(best.theta[beams.first :], follow, settled)
            moved = np.append(best.theta[: beams.first], q)
            for where, proposals in zip(problem.unknowns.times, found, strict=True):
                for proposal in proposals[:1]:
                    moved[where[where >= 0]] = proposal.transition_times[0][where >= 0]
            start = make_feasible(problem, moved)
            evaluator = prepare_meshes(problem, start, evaluator)
            end = End(start, np.inf, 0) if evaluator is None else fit_briefly(problem, start, evaluator=evaluator)
            evaluations += end.evaluations
            is_lower = end.cost < best.cost - LOWER * abs(best.cost) if np.isfinite(best.cost) else not end.failed
            best = end if is_lower else best
            settled = _list_settled(followed, beams, found, end) if len(found) > 1 else set()
            if not is_lower or is_enough(best.cost) or len(settled) == len(found):
                break
        if not best.failed and not is_enough(best.cost):
            end = hop_over_samples(problem, best, evaluator)
            best, evaluations = end, evaluations + end.evaluations
    return best._replace(evaluations=evaluations)


def _follow_run(
    problem: Problem, beams: Beams, e: int, q: FloatArray, evidence: Quadratic | None, *, is_fitted: bool
) -> list[Proposal]:
    """Return the proposals of one run, from parameters q (P,) that are or are not those of a fit."""
    followed = np.any(beams.matrices, axis=(1, 2)).sum()  # runs that have said something about shared parameters
    if not len(beams.shared) or (not is_fitted and followed < KNOWN):
        return follow_order(problem, e, q, evidence, REPLAYS_OF_ORDER)
    return follow_order(problem, e, q if is_fitted else beams.combine(q), evidence, REPLAYS)


def _list_settled(problem: Problem, beams: Beams, found: Sequence[Sequence[Proposal]], end: End) -> set[int]:
    """Return the runs whose beams would find the same times again: a fit has left them where they were proposed, and
    the parameters where they cost no more than noise does, for each about its variance. It is no rule for a run alone:
    at the parameters of its fit a beam may find other times still.
    """
    count = sum(item.count for item in problem.measurements)
    noise = min(assume_noise(problem) ** 2, 2 * end.cost / max(count, 1))
    settled = set()
    for e, (where, proposals) in enumerate(zip(problem.unknowns.times, found, strict=True)):
        for best in proposals[:1]:
            away = np.abs(end.theta[where] - best.transition_times[0])[where >= 0].max(initial=0.0)
            q = end.theta[beams.first + beams.own[e]]
            rise = np.inf if best.evidence is None else best.evidence.evaluate(q)[0]
            if away < SETTLED * prepare(problem, e).grid and rise < len(q) * noise:
                settled.add(e)
    return settled


def fix_unknowns(problem: Problem, names: Sequence[str]) -> Problem:
    """Return a problem with some of its unknowns fixed at their guesses.

    Parameters
    ----------
    problem : Problem
    names : sequence of str
        Of all entries of a parameter, or of none.
    """
    at = problem.initial_theta
    fixed = {problem.theta_names.index(name) for name in names}
    unknowns = problem.unknowns

    def fix(parameter: Any, place: int) -> Any:
        return replace(parameter, value=at[place], fixed=True) if place in fixed else parameter

    runs = []
    for e, run in enumerate(problem.experiments):
        times = tuple(fix(tau, i) for tau, i in zip(run.times, unknowns.times[e].tolist(), strict=True))
        count = len(run.transition_times)
        changes: dict[str, Any] = {"transition_times": times[:count]}
        if len(times) > count:
            changes["tf"] = times[count] if not times[count].fixed else float(times[count].value)
        states = unknowns.initial_states[e]
        if (states >= 0).any():
            initial = problem.system.initial_state if run.initial_state is None else run.initial_state
            changes["initial_state"] = [
                fix(x, i) if i >= 0 else x for x, i in zip(initial, states.tolist(), strict=True)
            ]
        runs.append(replace(run, **changes))
    parameters = dict(problem.parameters)
    for name, span in unknowns.parameters.items():
        held = [i in fixed for i in range(span.start, span.stop)]
        if any(held) and not all(held):
            raise ValueError(f"the entries of {name!r} are estimated all together, or none of them.")
        if all(held):
            given = parameters[name]
            parameters[name] = replace(given, value=at[span].reshape(given.shape), fixed=True)
    return replace(problem, experiments=runs, parameters=parameters)


@keep_with_problem
def _fix_delays(problem: Problem) -> Problem:
    """Return the problem with delays that are parameters at their guesses, as a beam follows it."""
    if not problem.estimates_delays:
        return problem

    def fix(run: Experiment, item: Measurements) -> Measurements:
        if not isinstance(item.delay, str):
            return item
        parameter = problem.parameters[run.parameter_map.get(item.delay, item.delay)]
        return replace(item, delay=float(parameter.value))

    return _replace_measurements(problem, fix)


@keep_with_problem
def _soften(problem: Problem) -> Problem:
    """Return the problem as a beam follows it, with more noise where its size is known."""

    def soften(run: Experiment, item: Measurements) -> Measurements:
        if item.sigma is None or item.sigma_names:
            return item
        return replace(item, sigma=np.maximum(item.sigma, SOFTER * np.nanstd(item.values, axis=0)))

    return _replace_measurements(_fix_delays(problem), soften)


def _replace_measurements(problem: Problem, change: Callable[[Experiment, Measurements], Measurements]) -> Problem:
    """Return a problem with other Measurements."""
    runs = []
    for run in problem.experiments:
        data = [change(run, item) if isinstance(item, Measurements) else item for item in run.data]
        runs.append(replace(run, data=data))
    return replace(problem, experiments=runs)
