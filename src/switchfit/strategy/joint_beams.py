"""Beams over all runs of a problem, each in turn: what the others say about shared parameters is a quadratic.

Run e says of the shared parameters q that they cost ``q'A_e q / 2 - b_e'q``, its own parameters and times following
(`Proposal.evidence`). The beam of a run is given the sum over all others; what it said before is replaced by what it
says then, so that no data count twice.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem
from switchfit.runtime.progress import show_detail
from switchfit.strategy.proposal import Proposal, Quadratic


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
        # Only what two runs or more have is passed on; private parameters follow from a run's own data.
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
                    # Private parameters of the run are eliminated (a Schur complement): they follow the shared ones.
                    center, g, Q = best.evidence.restrict(mine)
                    self.matrices[e][np.ix_(at, at)], self.slopes[e][at] = Q, Q @ center - g
        # The last run has left its own opinion there; all of them together, with the priors, say where to go on.
        moved[self.shared] = self.combine(q)[self.shared]
        return found, moved

    def join(self, found: Sequence[Sequence[Proposal]], q: FloatArray) -> list[Proposal]:
        """Return proposals for all runs together, at shared parameters of q (P,): the best of each run, then those in
        which one run has another one; none if a run has none.
        """
        if not all(found):
            return []
        # Runs times proposals, not all combinations: these grow as the product over the runs.
        best = [proposals[0] for proposals in found]
        others = [[*best[:e], other, *best[e + 1 :]] for e, own in enumerate(found) for other in own[1:]]
        return [self._join(chosen, q.copy()) for chosen in (best, *others)]

    def _join(self, chosen: Sequence[Proposal], moved: FloatArray) -> Proposal:
        for own, proposal in zip(self.own, chosen, strict=True):
            # Shared parameters differ from proposal to proposal; q has the one value for all of them.
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
        # Without the run's own part, which its data will say again: evidence that counts twice makes the beam too sure
        # of where it was.
        A, b = self.matrices.sum(0) - self.matrices[e], self.slopes.sum(0) - self.slopes[e]
        lowest = _solve(A, b, q[self.shared])
        # Shared parameters that this run does not have are free to follow.
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
        # What runs say costs q'A q / 2 - b'q, the priors g'd + d'h d / 2 with d = q - near: (A + h) q = b + h near - g.
        solved = _solve(self.matrices.sum(0) + np.diag(h), self.slopes.sum(0) + h * near - g, near)
        moved[self.shared] = np.clip(solved, unknowns.lowest[places], unknowns.upper[places])
        return moved


def _solve(A: FloatArray, b: FloatArray, q: FloatArray) -> FloatArray:
    """Return the solution of A x = b that is nearest to q, where A is singular."""
    return np.asarray(q + np.linalg.pinv(A, rcond=1e-10, hermitian=True) @ (b - A @ q))
