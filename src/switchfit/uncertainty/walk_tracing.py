"""Tracing of profiles of J over transition times: all walks at once, a piece of a parabola at a time.

A walk leaves a piece, a parabola, for each stretch between samples: the one-sided derivatives where it begins give
slope and curvature of the profile, all other unknowns eliminated (`switchfit.uncertainty.elimination`). It costs an
evaluation for each piece but the first. The other unknowns follow a curve, so that a parabola that is trusted as far as
the end of the interval misses that end by a tenth of the interval: 95 % intervals then hold 92 to 93 % of the truths
(`benchmarks/coverage.py`). Therefore the last stretch is covered in up to `MOST_HALVINGS` + 1 pieces, each of which
begins halfway to where the one before it would end; the other unknowns are fitted by Newton's method where each begins,
and each piece meets the next. One that meets a bound is held there until J falls inwards; a piece ends at either place,
as the curvature of the profile jumps there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.uncertainty.elimination import eliminate_inside
from switchfit.uncertainty.profile_pieces import NUMBERS_OF_PIECE, find_first_root
from switchfit.uncertainty.walks import Derivatives, Walks

MOST_HALVINGS = 3
"""Times on one side that a piece is cut off halfway to the end of the interval that it predicts ..."""

NEAR_END = 0.75
"""... which is done until the root of the likelihood ratio has reached this part of the quantile, or ..."""

ERROR_OF_PIECES = 0.01
"""... parabolas are right up to this part of the threshold."""

MOST_REPEATS = 20
"""Further Newton steps of the other unknowns at one place, while one lowers J by more than `RIGHT` thresholds."""

PART_OF_NEWTON_STEP, SMALLEST_PART_OF_NEWTON_STEP = 0.25, 1e-2
"""Part of a Newton step that is tried where it has not lowered J; and the smallest one, as where J has a kink."""

LARGEST_DERIVATIVE = 1e100
"""Derivative of J beyond which a profile is not followed: the mesh of the fit is too coarse for a lag that has become
so short, and the integration unstable."""

EvaluateWalks = Callable[[NDArray[np.intp], FloatArray], Derivatives]


def trace_walks(
    walks: Walks, cost: FloatArray, evaluate: EvaluateWalks, most: int, times: Sequence[NDArray[np.intp]] = ()
) -> FloatArray:
    """Go all ways up to their thresholds: pieces (W, `most`, 5), outwards, NaN behind the last, which has no end of its
    own: it holds up to the limit.

    Parameters
    ----------
    walks : Walks
    cost : (W,)
        J where they begin.
    evaluate : callable
        ``evaluate(which, thetas)`` returns the derivatives of some ways (n,) at thetas (n, d), to their sides.
    most : int
        Pieces that are kept.
    times : sequence of (N,) int, one for each experiment
        Places of its transition times in theta, -1 for those that are no unknowns; ways end where their order is lost.
    """
    count, d = walks.theta.shape
    pieces, kept = np.full((count, most, NUMBERS_OF_PIECE), np.nan), np.zeros(count, dtype=int)
    passed, halvings, repeats = np.zeros((3, count), dtype=int)
    theta, part = walks.theta.copy(), np.ones(count)
    # The lowest J where each way is, and the other unknowns there.
    lowest, best = Derivatives(np.zeros(count), np.zeros((count, d)), np.zeros((count, d, d))), theta.copy()
    going = np.arange(count)
    # One piece a turn for all ways that go on.
    while going.size:
        at = _evaluate_ordered(evaluate, going, theta[going], times)
        # Ways whose derivatives are not finite end here; what they have so far is kept.
        sound = np.all(np.abs(at.gradient) < LARGEST_DERIVATIVE, axis=1) & np.isfinite(at.hessian).all(axis=(1, 2))
        # A Newton step that has not lowered J is taken back, and a part of it tried.
        worse = (repeats[going] > 0) & ~(sound & (at.cost < lowest.cost[going]))
        part[going] = np.where(worse, PART_OF_NEWTON_STEP * part[going], 1.0)
        for all_kept, new in zip((*lowest, best), (*at, theta[going]), strict=True):
            all_kept[going[~worse]] = new[~worse]
        going = going[sound | worse]
        if not going.size:
            break
        at, theta[going] = Derivatives(*(each[going] for each in lowest)), best[going]
        # Only ways that go on are computed from here; `each` counts them, `going` says which of all they are.
        own = Walks(*(each[going] for each in walks))
        each, value = np.arange(going.size), theta[going, own.place]
        stop = own.stops[each, passed[going]]
        # The profile here: slope, curvature, and how the other unknowns follow (the Schur complement of the Hessian).
        found = eliminate_inside(at, own, theta[going], part[going], stop)
        curvature, lost = found.curvature, np.isnan(found.curvature)
        # Another Newton step of the others first, where the one just found would lower J by more than the piece may be
        # wrong, or where their minimum is farther away than one step tells.
        far = (found.decrement > part[going] * ERROR_OF_PIECES * own.threshold) | found.concave
        repeat = ~lost & (repeats[going] < MOST_REPEATS) & (part[going] > SMALLEST_PART_OF_NEWTON_STEP) & far
        rise, steepness = at.cost - found.decrement - cost[going], own.side * found.slope
        ahead = find_first_root(own.threshold - rise, steepness, curvature)
        reach = np.where(rise >= own.threshold, 0.0, ahead)  # how far it is to the threshold
        piece = np.column_stack([value, stop, rise, steepness, curvature])
        # A piece ends at the next stop, where another unknown meets or leaves its bound, or halfway to the threshold
        # where it is not to be trusted as far as that.
        earlier = _find_cut(piece, pieces[going, kept[going] - 1], reach, found.meets, own.threshold, own.side)
        cut = ~repeat & (halvings[going] < MOST_HALVINGS) & np.isfinite(earlier)
        piece[cut, 1] = earlier[cut]
        # A piece that is cut off does not reach its stop, and one that is repeated has none yet.
        passed[going] += ~repeat & ~cut
        halvings[going] += cut
        repeats[going] = np.where(repeat, repeats[going] + 1, 0)
        # Behind the threshold nothing is asked for, and behind the last stop nothing jumps any more: the piece holds to
        # the limit.
        ended = (reach <= own.side * (piece[:, 1] - value)) | np.isnan(own.stops[each, passed[going]])
        last = lost | (~repeat & ((~cut & ended) | (kept[going] == most - 1)))
        piece[last, 1] = own.limit[last]
        done = ~repeat & ~lost
        pieces[going[done], kept[going[done]]] = piece[done]
        kept[going] += done
        # On to where the piece ends, the others along their tangent.
        there = np.where(repeat, value, piece[:, 1])
        moved = theta[going] + found.step + found.follow * np.abs(there - value)[:, None]
        near = 1e-9 * np.abs(moved - theta[going])  # what should meet its bound is put there
        moved = np.where(moved <= own.lower + near, own.lower, np.where(moved >= own.upper - near, own.upper, moved))
        moved[each, own.place] = there
        theta[going] = moved
        going = going[~last]
    return pieces


def _evaluate_ordered(
    evaluate: EvaluateWalks, which: NDArray[np.intp], thetas: FloatArray, times: Sequence[NDArray[np.intp]]
) -> Derivatives:
    """Return the derivatives of ways at thetas (n, d), NaN where the transition times of a run are not in order."""
    steps = [np.diff(thetas[:, where[where >= 0]], axis=1) for where in times]
    ordered = np.all([(step >= 0).all(axis=1) for step in steps], axis=0)
    if ordered.all():
        return evaluate(which, thetas)
    n, d = thetas.shape
    found = Derivatives(np.full(n, np.nan), np.full((n, d), np.nan), np.full((n, d, d), np.nan))
    if ordered.any():
        for every, own in zip(found, evaluate(which[ordered], thetas[ordered]), strict=True):
            every[ordered] = own
    return found


def _find_cut(
    pieces: FloatArray,
    before: FloatArray,
    reach: FloatArray,
    meets: FloatArray,
    thresholds: FloatArray,
    sides: NDArray[np.intp],
) -> FloatArray:
    """Return where pieces (n, 5) are cut off, halfway to where they reach the threshold or where another unknown meets
    or leaves its bound; infinite if they hold to the end.

    A piece holds if it begins near the threshold, if it ends before it is halfway there, or if the piece before it, of
    NaN for the first one, was right about the rise here: errors of parabolas grow with the third power of their length.
    """
    start, stop, rise, _, _ = pieces.T
    begun, ended, height, steepness, bend = before.T
    length = sides * (ended - begun)
    error = rise - (height + steepness * length + 0.5 * bend * length**2)
    with np.errstate(invalid="ignore"):  # a piece that never reaches it
        right = np.abs(error) * reach**3 <= ERROR_OF_PIECES * thresholds * length**3
        holds = (rise >= NEAR_END**2 * thresholds) | (0.5 * reach >= sides * (stop - start)) | right
        met = np.where(meets < np.minimum(reach, sides * (stop - start)), meets, np.inf)
        return start + sides * np.minimum(met, np.where(holds, np.inf, 0.5 * reach))
