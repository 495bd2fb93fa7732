"""The start of a window: a state whose uncertainty is that of unknowns that the samples before it have left.

Samples before the window stay as J, g and H, the value, gradient and Gauss-Newton matrix of their cost (the arrival
cost), in the unknowns ``d = (e, tau, p)``: A = n entries e that shift the state at the start of the window, the
transition times in the window, and the parameters, ``x = x_w + Z d``. A transition time that leaves the window becomes
a further entry of e; as n + 1 directions cannot all move n entries of the state, one combination has no effect on the
state, and the cost takes its minimum along it (the Schur complement).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.hypotheses import Hypotheses

LEAST_RELATIVE_SINGULAR_VALUE = 1e-13
"""Singular value, relative to the largest, below which a combination of unknowns does not move the state."""


class Start(NamedTuple):
    """The start of a window.

    Attributes
    ----------
    moved : (D,), how far the point of linearisation has moved, 0 but for p
    cost, gradient, matrix : (), (D,), (D, D), of the samples up to the start, and of the priors
    state, tangent : (n,), (n, D)
    """

    moved: FloatArray
    cost: float
    gradient: FloatArray
    matrix: FloatArray
    state: FloatArray
    tangent: FloatArray

    def build(self, moved: FloatArray, artificial: FloatArray) -> Hypotheses:
        """Return B hypotheses at the start that have `moved` (B, D), the times in the window apart.

        Their matrices, of which there is one alone, have `artificial` (D, D) beside what is known.
        """
        # J + g'd + d'H d / 2 and g + H d: the quadratic cost of the past at the new point of linearisation.
        d = moved - self.moved
        D, rows = len(self.matrix), np.concatenate([self.matrix, self.tangent, self.gradient[None]])
        along = d @ rows.T
        slope = along[:, :D]
        costs = self.cost + along[:, -1] + 0.5 * (slope * d).sum(1)
        matrices, tangents, states = (self.matrix + artificial)[None], self.tangent[None], self.state + along[:, D:-1]
        return Hypotheses(costs, costs, self.gradient + slope, matrices, moved, states, tangents)


def forget(start: Start, entries: int, chosen: NDArray[np.intp], variances: FloatArray) -> tuple[Start, FloatArray]:
    """Return a start at which parameters have new values, each around its old one.

    The old values join e, since the state depends on them; what has no effect on the state is eliminated, as in `Past`.
    They are joined to the new ones by ``(p_new - p_old)^2 / (2 variance)``.

    Parameters
    ----------
    start : Start
    entries : int, A
    chosen : (m,) int, positions of the parameters among the D unknowns
    variances : (m,), infinite where the old value says nothing about the new one

    Returns
    -------
    start : Start
    turn : (A + m, A), how the new entries e follow from the old ones and the old parameters
    """
    D, m = len(start.gradient), len(chosen)
    old, new = np.concatenate([np.arange(entries), chosen]), np.arange(D, D + m)
    # Unknowns in the order e_old, tau, p; new values of the chosen ones are appended behind D until `into` puts them in
    # their places.
    others = np.setdiff1d(np.arange(D), old)
    # An infinite variance adds zeros: the new value begins without knowledge.
    H, g = np.zeros((D + m, D + m)), np.append(start.gradient, np.zeros(m))
    H[:D, :D] = start.matrix
    for pair, variance in zip(zip(chosen, new, strict=True), variances, strict=True):
        # (p_new - p_old)^2 / (2 variance) as a matrix in both.
        H[np.ix_(pair, pair)] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / variance
    # x = x_w + Z_old (e, p_old): the right singular vectors split these into combinations that move the state, the new
    # e, and those that do not.
    _, sizes, V = np.linalg.svd(start.tangent[:, old])
    # At most n combinations move n entries of the state, which is why A = n entries suffice for any past.
    rank = int(np.count_nonzero(sizes > LEAST_RELATIVE_SINGULAR_VALUE * sizes[0]))
    turn, idle = V[:rank].T, V[rank:].T
    # The unknowns in their new places, then the combinations without effect, which are eliminated.
    into = np.zeros((D + m, D + len(idle.T)))
    into[np.ix_(old, np.arange(rank))], into[np.ix_(old, np.arange(D, into.shape[1]))] = turn, idle
    into[others, others], into[new, chosen] = 1.0, 1.0
    H, g = into.T @ H @ into, g @ into
    # Minimum along the combinations without effect (index 2):
    #     H_11 - H_12 H_22^+ H_21,  g_1 - H_12 H_22^+ g_2,  J - g_2' H_22^+ g_2 / 2
    solved = np.linalg.pinv(H[D:, D:], hermitian=True) @ np.column_stack([H[D:, :D], g[D:]])
    matrix, empty = H[:D, :D] - H[:D, D:] @ solved[:, :-1], np.arange(rank, entries)
    # Entries of e that are not needed have no effect on the state; with curvature 1 they stay 0.
    matrix[empty, empty] = 1.0
    tangent = start.tangent.copy()
    tangent[:, :entries], tangent[:, chosen] = 0.0, 0.0
    tangent[:, :rank] = start.tangent[:, old] @ turn
    cost = start.cost - 0.5 * float(g[D:] @ solved[:, -1])
    found = start._replace(cost=cost, gradient=g[:D] - H[:D, D:] @ solved[:, -1], matrix=matrix, tangent=tangent)
    return found, np.pad(turn, ((0, 0), (0, entries - rank)))


class Past(NamedTuple):
    """How the first transition time of a window joins the A entries e before it.

    Attributes
    ----------
    rotation : (A + 1, A + 1), orthonormal: of the columns of Z, the last has no effect on the state
    births : int, transition times that there is room for
    """

    rotation: FloatArray
    births: int

    @classmethod
    def of(cls, tangent: FloatArray, entries: int, births: int) -> Past:
        """Return it for a tangent (n, D) at the start of the window."""
        # Right singular vectors of (n, n + 1): the last one is the null space, whatever the rank.
        return cls(np.linalg.svd(tangent[:, : entries + 1])[2].T, births)

    def turn(self, values: FloatArray) -> FloatArray:
        """Return values (..., D) along the unknowns in the new ones; the one without effect becomes the last time."""
        A = len(self.rotation) - 1
        # From (e, tau_1 | tau_2 ... | p) to (e' | tau_2 ... , tau without effect | p): slots move up by one.
        first, rest, p = np.split(values, [A + 1, A + self.births], axis=-1)
        turned = first @ self.rotation
        return np.concatenate([turned[..., :A], rest, turned[..., A:], p], axis=-1)

    def absorb(self, found: Hypotheses, prior: float) -> None:
        """Let the first time of B hypotheses join e, in place; its slot is then free for another birth.

        Parameters
        ----------
        found : Hypotheses
            Views of records.
        prior : float
            The second derivative that a birth begins with, which the absorbed time loses and the free slot gets.
        """
        A = len(self.rotation) - 1
        free = A + self.births - 1
        H = np.array(found.matrices)
        # H_0 of the birth has done its work, to keep the time near its node, unless the data say too little about it.
        lost = np.zeros(H.shape[1])
        lost[A] = prior
        reduced = H - np.diag(lost)
        # Without H_0 the block may be singular, as right after a birth that no sample has seen: its Schur complement
        # would divide by rounding.
        certain = np.linalg.eigvalsh(reduced[:, : A + 1, : A + 1])[:, 0] > 1e-9 * prior
        H = np.where(certain[:, None, None], reduced, H)
        H = self.turn(self.turn(H).swapaxes(1, 2))
        g = self.turn(np.array(found.gradients))
        # Schur complement of the combination without effect, now last among the times; infinity leaves all as it is.
        pivot = np.where(H[:, free, free] > 0, H[:, free, free], np.inf)
        row, slope = H[:, free].copy(), g[:, free].copy()
        found.costs[:] -= 0.5 * slope**2 / pivot
        g -= row * (slope / pivot)[:, None]
        H -= row[:, :, None] * row[:, None, :] / pivot[:, None, None]
        # Its slot is empty: no slope, the curvature of H_0 for the next birth, and no effect on the state.
        g[:, free], H[:, free], H[:, :, free], H[:, free, free] = 0.0, 0.0, 0.0, prior
        found.gradients[:], found.matrices[:] = g, H
        found.tangents[:] = self.turn(np.array(found.tangents))
        found.tangents[..., free] = 0.0
        found.moved[:] = self.turn(np.array(found.moved))
        found.moved[:, free] = 0.0
