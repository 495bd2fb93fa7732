"""The times of a given order of modes: a beam over each log, then a fit, and hops of times over samples.

A beam (`beam`) needs no guess of the times: it follows hypotheses about them through the log, and the parameters move
along. It begins again at the parameters of the fit as long as that lowers J.

Beams of several runs are joined by what each says about shared parameters (`joint_beams`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.data_variation import assume_noise
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.strategy.beam import REPLAYS, REPLAYS_OF_ORDER, follow_order, prepare
from switchfit.strategy.followed_problem import fix_delays, soften
from switchfit.strategy.hops import hop_over_samples
from switchfit.strategy.joint_beams import Beams
from switchfit.strategy.proposal import Proposal, Quadratic
from switchfit.strategy.short_fit import End, fit_briefly, make_feasible, prepare_meshes
from switchfit.strategy.time_limit import OutOfTimeError

MOST_PASSES = 2
"""Most passes over all logs, each from the parameters of the last fit. Of the two turns of the benchmark 13 of 48
starts end right after one, all after two. A third lowers J in none of 17 problems of the benchmark, and took a quarter
of the time of ten joint tosses."""

RUNS_BEFORE_COMBINING = 2
"""Runs after which the others begin at the parameters that follow from what has been said of them. The few replays do
there that suit the parameters of a fit: the beams of 200 runs take 0.84 s in place of 1.27, with the same end."""

SETTLED_PART_OF_GRID = 0.5
"""Part of its grid by which a fit leaves a time where a beam has proposed it."""

LOWER = 1e-6
"""Part of itself by which J has to fall for another pass."""


def explain_no_beam(problem: Problem) -> str:
    """Return why no beam can follow the data of a problem; empty if one can. The machine code is compiled here."""
    for run in problem.experiments:
        if not any(isinstance(item, (Measurements, ReferenceSignal)) for item in run.data):
            return "there are no data to follow"
    try:
        for e in range(len(problem.experiments)):
            prepare(fix_delays(problem), e)
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
    best = _find_times(problem, theta, fix_delays(problem), is_enough)
    # A reset of the state at a wrong time puts the samples after it far off, and hypotheses that are nearly right are
    # lost. A log with more noise forgives that (`soften`).
    if not any(structure.has_resets for structure in problem.structures) or is_enough(best.cost):
        return best
    other = _find_times(problem, theta, soften(problem), is_enough)
    return min(best, other, key=lambda end: end.cost)._replace(evaluations=best.evaluations + other.evaluations)


def _find_times(problem: Problem, theta: FloatArray, followed: Problem, is_enough: Callable[[float], bool]) -> End:
    """Do what `find_times` does by beams along the data of another problem."""
    best, evaluations, evaluator = End(theta, np.inf, 0), 0, None
    beams = Beams(problem, [prepare(followed, e).own for e in range(len(problem.experiments))])
    settled: set[int] = set()
    with suppress(OutOfTimeError):
        for again in range(MOST_PASSES):
            follow = partial(_follow_run, followed, beams, is_fitted=again > 0)
            found, q = beams.follow(best.theta[beams.first :], follow, settled)
            # Times of the best proposal of each run; of settled runs, which propose nothing, those of the last fit.
            moved = np.append(best.theta[: beams.first], q)
            for where, proposals in zip(problem.unknowns.times, found, strict=True):
                for proposal in proposals[:1]:
                    moved[where[where >= 0]] = proposal.transition_times[0][where >= 0]
            start = make_feasible(problem, moved)
            evaluator = prepare_meshes(problem, start, evaluator)
            end = End(start, np.inf, 0) if evaluator is None else fit_briefly(problem, start, evaluator=evaluator)
            evaluations += end.evaluations
            # `best` begins at infinity, of which no part can be taken off.
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
    # A run without evidence has a matrix of zeros still.
    followed = np.any(beams.matrices, axis=(1, 2)).sum()  # runs that have said something about shared parameters
    if not len(beams.shared) or (not is_fitted and followed < RUNS_BEFORE_COMBINING):
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
            if away < SETTLED_PART_OF_GRID * prepare(problem, e).grid and rise < len(q) * noise:
                settled.add(e)
    return settled
