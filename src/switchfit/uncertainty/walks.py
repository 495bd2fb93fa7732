"""Profiles of J over transition times, followed from estimates to both sides: many ways at once.

Between two sample times J is smooth in a transition time; at each of them its slope and its curvature jump. A way goes
from the estimate outwards, and leaves a piece, a parabola, for each stretch between samples: the one-sided derivatives
where it begins give slope and curvature of the profile, all other unknowns (o) eliminated by a Newton step (the Schur
complement),

    J_p = J − ½ g_o' H_oo⁻¹ g_o,   s = g_k − H_ko H_oo⁻¹ g_o,   c = H_kk − H_ko H_oo⁻¹ H_ok.

It costs an evaluation for each piece but the first. The other unknowns follow a curve, so that a parabola that is
trusted as far as the end of the interval misses that end by a tenth of the interval: 95 % intervals then hold 92 to
93 % of the truths (`benchmarks/coverage.py`). Therefore the last stretch is covered in up to `MOST_HALVINGS` + 1
pieces, each of which begins halfway to where the one before it would end; the other unknowns are fitted by Newton's
method where each begins, and each piece meets the next. One that meets a bound is held there until J falls inwards; a
piece ends at either place, as the curvature of the profile jumps there.

All ways go on together, a piece at a time, so that those of many fits take few calls. A piece is an array of five
numbers: the transition times where it starts and stops, by how much the profile exceeds J of the estimate at the start,
and its slope and curvature there, in the direction in which the way goes.

Intervals of transition times across sample times, where the cost has kinks.

With samples within a few standard errors of the estimate one parabola is no picture of J. Here it is made of one
parabola for each stretch between samples, and the interval is where 2 (J_p − J) stays
below the squared quantile. Of many fits the pieces are kept (`switchfit.batch.study`), so that intervals can be had
at any level.

Where a state jumps that is measured, J jumps at samples, as that of a change point: 2 (J_p − J) at the truth is no
chi-square then, but up to twice as large at the same level ([1]_), and it falls below the quantile again behind higher
places. The time is a parameter of location, of which the density exp(−J_p) has intervals that hold the truth as often
as they say; so its quantiles are taken.

References
----------
.. [1] B. E. Hansen, Sample splitting and threshold estimation, Econometrica 68 (2000) 575-603.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.accuracy import Follower
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Fit
from switchfit.problem.problem import Problem

MOST_HALVINGS = 3
"""Times on one side that a piece is cut off halfway to the end of the interval that it predicts ..."""

NEAR_END = 0.75
"""... which is done until the root of the likelihood ratio has reached this part of the quantile, or ..."""

RIGHT = 0.01
"""... parabolas are right up to this part of the threshold."""

MOST_REPEATS = 20
"""Further Newton steps of the other unknowns at one place, while one lowers J by more than `RIGHT` thresholds."""

PART, SMALLEST_PART = 0.25, 1e-2
"""Part of a Newton step that is tried where it has not lowered J; and the smallest one, as where J has a kink."""

CONCAVE = 1e-9
"""Curvature, scaled by those of the unknowns alone, below minus which J has no minimum in the others."""

AT_SAMPLE = 1e-9
"""A transition time nearer to a sample time than this part of the horizon is at it."""

SMALLEST = 1e-3
"""Part of its estimate to which an unknown on a logarithmic scale may fall while it follows a transition time."""

LARGEST = 1e100
"""Derivative of J beyond which a profile is not followed: the mesh of the fit is too coarse for a lag that has become
so short, and the integration unstable."""

PIECE = 5
"""Numbers of a piece."""

MOST_PIECES = 60
"""Sample times that are passed in one direction; with more of them in an interval the kinks average out."""

MOST_RUNS = 15
"""Problems of more experiments, whose evaluations take long, keep the intervals of one parabola."""

NEAR = 5.0
"""Pieces are traced if a sample lies within this many standard errors, twice as far as a 99 % interval reaches. Where
most of what is known about a transition time comes from the samples next to it, its profile is far from a parabola
before it reaches them."""

JUMP = 0.9
"""Part of the rise of J up to a piece of which the piece before it says nothing where J jumps between them."""

BISECTIONS = 40
"""Halvings of a piece until its crossing of the threshold is known to rounding."""

HIGHEST_LEVEL = 0.99
"""Pieces are traced up to the end of an interval of this level, whatever lower level is asked for."""

HIGHEST_RISE = 8.0
"""Rise of J, in variances of the noise, up to which the density of a transition time with a reset map is followed."""

LEAST_JUMP = 0.25
"""Jump of J between two pieces, in variances of the noise, that is no error of parabolas."""

POINTS = 41
"""Points of a piece at which a density is taken."""


class Derivatives(NamedTuple):
    """Costs (n,), gradients (n, d) and Hessians (n, d, d) of n evaluations."""

    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray


Evaluate = Callable[[NDArray[np.intp], FloatArray], Derivatives]


class Walks(NamedTuple):
    """W ways from estimates of transition times, each to one side.

    Attributes
    ----------
    theta : (W, d)
        Where they begin.
    place : (W,) int
        Of the transition time in theta.
    side : (W,) int
        -1 or 1.
    free : (W, d) bool
        Unknowns that follow.
    stops : (W, S)
        Where J or its slope jumps, outwards, and then how far the transition time may move alone; NaN behind that.
    limit : (W,)
        The last of these.
    lower, upper : (W, d)
    threshold : (W,)
        Rise of J up to which the pieces are to be exact.
    """

    theta: FloatArray
    place: NDArray[np.intp]
    side: NDArray[np.intp]
    free: NDArray[np.bool_]
    stops: FloatArray
    limit: FloatArray
    lower: FloatArray
    upper: FloatArray
    threshold: FloatArray


def list_transitions(problem: Problem) -> Iterator[tuple[int, int]]:
    """Yield the experiment and the place in theta of each free transition time, and of a free tf."""
    for e, where in enumerate(problem.unknowns.times):
        for place in where[where >= 0].tolist():
            yield e, place


def list_sample_times(problem: Problem, theta: FloatArray, e: int) -> FloatArray:
    """Return the times of the states that were measured in an experiment, delays subtracted, in ascending order.

    Parameters
    ----------
    problem : Problem
    theta : (d,)
        With delays that are parameters.
    e : int, from 0
    """
    known = [item.seen_times for item in problem.experiments[e].measurements if not isinstance(item.delay, str)]
    return np.unique(np.concatenate([problem.late_times(theta, e), *known]))


def stack_sample_times(problem: Problem, thetas: FloatArray, e: int) -> FloatArray:
    """Return the times of the states that were measured in an experiment, of F fits, where the slope of J in a
    transition time jumps: (F, S), NaN where a fit has fewer than others.

    Parameters
    ----------
    problem : Problem
    thetas : (F, d)
    e : int, from 0
    """
    if not problem.late_times(thetas[0], e).size:
        return np.tile(list_sample_times(problem, thetas[0], e), (len(thetas), 1))
    each = [list_sample_times(problem, theta, e) for theta in thetas]
    times = np.full((len(thetas), max(map(len, each))), np.nan)
    for f, own in enumerate(each):
        times[f, : own.size] = own
    return times


def list_walks(
    problem: Problem,
    e: int,
    place: int,
    thetas: FloatArray,
    free: NDArray[np.bool_],
    thresholds: FloatArray,
    samples: FloatArray,
    most: int,
) -> Walks:
    """Return the ways from the estimates of one transition time of F fits: 2 F, first all to the left.

    Parameters
    ----------
    problem : Problem
    e, place : int
        The experiment, and the place in theta of the transition time.
    thetas : (F, d)
    free : (F, d) bool
        Unknowns that are not held.
    thresholds : (F,)
    samples : (F, S)
        Sample times of experiment e.
    most : int
        Sample times that are passed on one way; with more of them in an interval the kinks average out.
    """
    unknowns = problem.unknowns
    # Unknowns follow along a straight line, which may lead a lag or a sigma on a logarithmic scale to 0.
    smallest = unknowns.origin + SMALLEST * (thetas - unknowns.origin)
    lower = np.where(unknowns.log, np.maximum(unknowns.lower, smallest), unknowns.lower)
    upper = np.tile(unknowns.upper, (len(thetas), 1))
    for run, where in zip(problem.experiments, unknowns.times, strict=True):
        times = where[where >= 0]
        lower[:, times] = np.maximum(lower[:, times], run.t0)
        upper[:, times] = np.minimum(upper[:, times], run.end)
    # Bounds hold unknowns for a part of a way.
    at_bound = np.isclose(thetas, unknowns.lowest, rtol=AT_SAMPLE, atol=0.0) | (thetas >= unknowns.upper)
    others = free | (at_bound & ~unknowns.is_time)
    others[:, place] = False
    knots, tau = problem.ends_of_modes(thetas)[e], thetas[:, place]
    beyond = np.full((len(thetas), 1), np.inf)  # a free tf has no neighbour behind it
    i = int(np.flatnonzero(unknowns.times[e] == place)[0]) + 1
    near = AT_SAMPLE * (knots[:, -1] - knots[:, 0])[:, None]
    ways = []
    for side in (-1, 1):
        neighbour = np.concatenate([knots, beyond], axis=1)[:, i + side]
        limit = np.clip(neighbour, lower[:, place], upper[:, place])
        with np.errstate(invalid="ignore"):
            ahead = (side * (samples - tau[:, None]) > near) & (side * (samples - limit[:, None]) < 0)
        # Stop just behind: where a delay is a parameter, engines do not tell one side of a sample from the other.
        marks = samples + side * near
        # Samples ahead in the order in which the way meets them, then the limit, then NaN.
        outwards = np.sort(np.where(ahead, side * marks, np.inf), axis=1)[:, :most]
        stops = np.full((len(thetas), most + 2), np.nan)
        stops[:, : outwards.shape[1]] = np.where(np.isfinite(outwards), side * outwards, np.nan)
        stops[np.arange(len(thetas)), np.sum(np.isfinite(outwards), axis=1)] = limit
        each = np.full(len(thetas), place, dtype=np.intp), np.full(len(thetas), side, dtype=np.intp)
        ways.append(Walks(thetas, *each, others, stops, limit, lower, upper, thresholds))
    return join_walks(ways)


def join_walks(ways: Sequence[Walks]) -> Walks:
    """Return several lots of ways, with as many stops each, as one."""
    return Walks(*map(np.concatenate, zip(*ways, strict=True)))


def trace_walks(
    walks: Walks, cost: FloatArray, evaluate: Evaluate, most: int, times: Sequence[NDArray[np.intp]] = ()
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
    pieces, kept = np.full((count, most, PIECE), np.nan), np.zeros(count, dtype=int)
    passed, halvings, repeats = np.zeros((3, count), dtype=int)
    theta, part = walks.theta.copy(), np.ones(count)
    # The lowest J where each way is, and the other unknowns there.
    lowest, best = Derivatives(np.zeros(count), np.zeros((count, d)), np.zeros((count, d, d))), theta.copy()
    going = np.arange(count)
    # One piece a turn for all ways that go on.
    while going.size:
        at = _evaluate_ordered(evaluate, going, theta[going], times)
        # Ways whose derivatives are not finite end here; what they have so far is kept.
        sound = np.all(np.abs(at.gradient) < LARGEST, axis=1) & np.isfinite(at.hessian).all(axis=(1, 2))
        # A Newton step that has not lowered J is taken back, and a part of it tried.
        worse = (repeats[going] > 0) & ~(sound & (at.cost < lowest.cost[going]))
        part[going] = np.where(worse, PART * part[going], 1.0)
        for all_kept, new in zip((*lowest, best), (*at, theta[going]), strict=True):
            all_kept[going[~worse]] = new[~worse]
        going = going[sound | worse]
        if not going.size:
            break
        at, theta[going] = Derivatives(*(each[going] for each in lowest)), best[going]
        own = Walks(*(each[going] for each in walks))
        each, value = np.arange(going.size), theta[going, own.place]
        stop = own.stops[each, passed[going]]
        found = _eliminate_inside(at, own, theta[going], part[going], stop)
        curvature, lost = found.curvature, np.isnan(found.curvature)
        # Another Newton step of the others first, where the one just found would lower J by more than the piece may be
        # wrong, or where their minimum is farther away than one step tells.
        far = (found.decrement > part[going] * RIGHT * own.threshold) | found.concave
        repeat = ~lost & (repeats[going] < MOST_REPEATS) & (part[going] > SMALLEST_PART) & far
        rise, steepness = at.cost - found.decrement - cost[going], own.side * found.slope
        ahead = find_first_root(own.threshold - rise, steepness, curvature)
        reach = np.where(rise >= own.threshold, 0.0, ahead)  # how far it is to the threshold
        piece = np.column_stack([value, stop, rise, steepness, curvature])
        # A piece ends at the next stop, where another unknown meets or leaves its bound, or halfway to the threshold
        # where it is not to be trusted as far as that.
        earlier = _find_cut(piece, pieces[going, kept[going] - 1], reach, found.meets, own.threshold, own.side)
        cut = ~repeat & (halvings[going] < MOST_HALVINGS) & np.isfinite(earlier)
        piece[cut, 1] = earlier[cut]
        passed[going] += ~repeat & ~cut
        halvings[going] += cut
        repeats[going] = np.where(repeat, repeats[going] + 1, 0)
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
    evaluate: Evaluate, which: NDArray[np.intp], thetas: FloatArray, times: Sequence[NDArray[np.intp]]
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


class _Eliminated(NamedTuple):
    """The profiles of n ways where they are: slope and curvature in the transition time (n,); the step of the others at
    once and how they follow by length, outwards, (n, d); by how much the step lowers J; how far it is until another
    unknown meets a bound or leaves it; and whether J has no minimum in the others: (n,).
    """

    slope: FloatArray
    curvature: FloatArray
    step: FloatArray
    follow: FloatArray
    decrement: FloatArray
    meets: FloatArray
    concave: NDArray[np.bool_]


def _eliminate_inside(
    at: Derivatives, own: Walks, theta: FloatArray, part: FloatArray, stop: FloatArray
) -> _Eliminated:
    """Eliminate the other unknowns (n, d) inside their bounds, by a part (n,) of a Newton step.

    One that the step leads out of its bounds, or that would leave one before its way is at its stop (n,), is put at the
    bound, in the quadratic model of J, and held. Where J has no minimum, negative curvatures change their signs.
    """
    g = at.gradient
    each, inside = np.arange(len(g)), (theta > own.lower) & (theta < own.upper)
    free, step = own.free & (inside | at.hessian.any(axis=2)), np.zeros_like(g)
    length = (stop - theta[each, own.place])[:, None]
    while True:
        both = free[:, :, None] & free[:, None, :]
        size = np.sqrt(np.abs(np.diagonal(at.hessian, axis1=1, axis2=2)))
        size = np.where(free & (size > 0), size, 1.0)
        scale = size[:, :, None] * size[:, None, :]
        scaled, H, concave = np.where(both, at.hessian / scale, np.eye(g.shape[1])), at.hessian, np.zeros(len(g), bool)
        try:
            np.linalg.cholesky(scaled)  # in a tenth of the time, where all have a minimum
        except np.linalg.LinAlgError:
            values, vectors = np.linalg.eigh(scaled)
            concave = values[:, 0] < -CONCAVE
            turned = (np.abs(values)[:, None, :] * vectors) @ vectors.transpose(0, 2, 1) * scale
            H = np.where(concave[:, None, None] & both, turned, H)
        curvature, newton, follow = eliminate_others(g + _multiply(H, step), H, own.place, free)
        there, leaves = theta + step - newton, newton + follow * length
        low = free & ((there < own.lower) | ((theta <= own.lower) & (leaves > 0)))
        high = free & ((there > own.upper) | ((theta >= own.upper) & (leaves < 0)))
        to_bound = np.where(low, own.lower, own.upper) - theta
        # That which meets its bound first, as the others may turn round then.
        with np.errstate(divide="ignore", invalid="ignore"):
            reached = np.where(low | high, np.nan_to_num(np.abs(to_bound / (there - theta))), np.inf)
        first = np.argmin(reached, axis=1)
        out = np.flatnonzero((low | high).any(axis=1))
        if not out.size:
            break
        step[out, first[out]] = to_bound[out, first[out]]
        free[out, first[out]] = False
    step, follow = part[:, None] * (step - newton), -follow * own.side[:, None]
    # The slope of J in an unknown that is held, and how it changes: it leaves its bound where that is 0.
    slope, column = g + _multiply(H, step), H[each, own.place]
    change = column * own.side[:, None] + _multiply(H, follow)
    after = theta + step
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # what hardly changes has all room
        room = np.where(follow > 0, own.upper - after, after - own.lower) / np.abs(follow)
        room = np.where(free, room, -slope / change)
    meets = np.fmin.reduce(room, axis=1, where=own.free & (room > 0), initial=np.inf)
    decrement = -0.5 * np.sum(step * (g + slope), axis=1)
    return _Eliminated(slope[each, own.place], curvature, step, follow, decrement, meets, concave)


def _multiply(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the products of matrices (n, d, d) and vectors (n, d)."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def eliminate_others(
    g: FloatArray, H: FloatArray, place: NDArray[np.intp], free: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the curvatures H_kk - H_ko H_oo^-1 H_ok of profiles (n,), the Newton steps H_oo^-1 g_o, and how the others
    follow, H_oo^-1 H_ok, (n, d), from gradients (n, d) and Hessians (n, d, d). NaN where H_oo is singular.
    """
    each = np.arange(len(g))
    column = H[each, :, place]
    rest = np.stack([np.where(free, g, 0.0), np.where(free, column, 0.0)], axis=2)
    # Rows and columns of the identity for what is held: its solution is zero.
    both = free[:, :, None] & free[:, None, :]
    solved = _solve_each(np.where(both, H, np.eye(g.shape[1])), rest)
    newton, follow = solved[:, :, 0], solved[:, :, 1]
    return H[each, place, place] - np.sum(column * follow, axis=1), newton, follow


def _solve_each(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solutions (n, d, 2) of n systems, NaN of those that are singular."""
    try:
        return np.asarray(np.linalg.solve(matrices, right))
    except np.linalg.LinAlgError:  # of one of them; nothing is returned of the others
        if len(matrices) == 1:
            return np.full_like(right, np.nan)
        return np.concatenate([_solve_each(matrices[k : k + 1], right[k : k + 1]) for k in range(len(matrices))])


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
        right = np.abs(error) * reach**3 <= RIGHT * thresholds * length**3
        holds = (rise >= NEAR_END**2 * thresholds) | (0.5 * reach >= sides * (stop - start)) | right
        met = np.where(meets < np.minimum(reach, sides * (stop - start)), meets, np.inf)
        return start + sides * np.minimum(met, np.where(holds, np.inf, 0.5 * reach))


def find_first_root(height: FloatArray, slope: FloatArray, curvature: FloatArray) -> FloatArray:
    """Return the smallest x > 0 with slope x + ½ curvature x² = height > 0; infinite where there is none: (n,)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        # 2 height / (slope + sqrt(slope^2 + 2 curvature height)) loses no digits where the curvature is small; NaN and
        # a root that is not positive mean that the parabola never gets so high.
        root = slope + np.sqrt(slope * slope + 2.0 * curvature * height)
        return np.where(root > 0.0, 2.0 * height / root, np.inf)


def replace_intervals(
    intervals: FloatArray, pieces: FloatArray, places: NDArray[np.intp], thresholds: FloatArray
) -> FloatArray:
    """Return intervals (..., d, 2) with those of transition times with samples near, or at a kink, from their pieces.

    Parameters
    ----------
    intervals : (..., d, 2)
        From one standard error each.
    pieces : (..., T, 2, P, 5)
        To both sides, NaN after the last.
    places : (T,) int
        Where in theta they stand.
    thresholds : (...)
        By how much J may exceed its minimum.
    """
    found = intervals.copy()
    if not len(places):
        return found
    replaced = ~np.isnan(pieces[..., 0, 0, 0])
    for end, side in enumerate((-1, 1)):
        ends = find_ends(pieces[..., end, :, :], thresholds[..., None], side)
        found[..., places, end] = np.where(replaced, ends, found[..., places, end])
    return found


def list_resets(fit: Fit) -> list[int]:
    """Return where in theta the transition times stand at which the state jumps."""
    found: list[int] = []
    for path, places in zip(fit.trajectories, fit.transition_places, strict=True):
        after = path.segments[1:-1]
        jumps = (path.states[after] != path.states[after - 1]).any(axis=1)
        found += places[jumps & (places >= 0)].tolist()
    return found


def replace_where_cost_jumps(
    intervals: FloatArray, pieces: FloatArray, places: NDArray[np.intp], fit: Fit, level: float
) -> FloatArray:
    """Return intervals (d, 2) with those of transition times at which J jumps between pieces from its density.

    Parameters
    ----------
    intervals : (d, 2)
    pieces : (T, 2, P, 5)
    places : (T,) int
    fit : Fit
    level : float
    """
    found, scale, resets = intervals.copy(), fit.variance_scale, list_resets(fit)
    for own, place in zip(pieces, places.tolist(), strict=True):
        sides = [side[~np.isnan(side[:, 0])] for side in own]
        if place in resets and any(_find_jumps(side).max() > LEAST_JUMP * scale for side in sides):
            low, high = _find_quantiles(sides, scale, level)
            # J may be lowest at the edge of what is likely, beside a sample: the estimate is never left out.
            found[place] = min(low, fit.theta[place]), max(high, fit.theta[place])
    return found


def _find_jumps(pieces: FloatArray) -> FloatArray:
    """Return by how much each of the pieces to a side (P, 5) begins beside where the one before it ends: (P,)."""
    start, stop, rise, slope, curvature = pieces.T
    length = np.abs(stop - start)
    ends = rise + length * (slope + 0.5 * curvature * length)
    return np.abs(rise - np.append(0.0, ends[:-1]))


def _find_quantiles(sides: Sequence[FloatArray], scale: float, level: float) -> FloatArray:
    """Return the ends of the interval that has the middle part, its level, of the density of pieces to both sides."""
    values, costs = [], []
    for sign, pieces in zip((-1, 1), sides, strict=True):
        start, stop, rise, slope, curvature = pieces.T[..., None]
        length, left = np.abs(stop - start), HIGHEST_RISE * scale - rise[-1]
        # The last piece as far as it is known.
        reach = find_first_root(left, slope[-1], curvature[-1]) if left > 0.0 else 0.0
        length[-1] = np.minimum(length[-1], reach)
        along = length * np.linspace(0.0, 1.0, POINTS)
        values.append((start + sign * along).ravel()[::sign])
        costs.append((rise + along * (slope + 0.5 * curvature * along)).ravel()[::sign])
    x, density = np.concatenate(values), np.exp(-np.concatenate(costs) / scale)
    below = np.append(0.0, np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(x)))
    return np.interp([0.5 * (1.0 - level), 0.5 * (1.0 + level)], below / below[-1], x)


def trace_profiles(
    fit: Fit, problem: Problem, evaluator: Evaluator, level: float = HIGHEST_LEVEL
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return the pieces of the profiles of transition times with samples near, or at a kink: (T, 2, P, 5); and where in
    theta these times stand: (T,).

    They go up to the ends of intervals of a level. A model with thin layers has none, as its J is rough on one mesh:
    the mesh would have to be made anew at every step.

    Parameters
    ----------
    fit : Fit
    problem : Problem
    evaluator : Evaluator
    level : float
    """
    nothing = fit.saved_pieces[:0], fit.saved_piece_places[:0]
    highest = compute_threshold(fit, max(level, HIGHEST_LEVEL))
    rise = max(highest, HIGHEST_RISE * fit.variance_scale)
    if np.isnan(highest) or fit.constraints or len(problem.experiments) > MOST_RUNS:
        return nothing
    if any(mesh.has_layers for mesh in evaluator.meshes):
        return nothing
    # Unknowns that are free one by one, and have an effect on J.
    movable = (np.sum(fit.free_basis**2, axis=1) > 1 - 1e-9) & fit.hessian.any(axis=1)
    kinks, resets, at, places = {kink.unknown for kink in fit.kinks}, list_resets(fit), fit.theta[None], []
    ways: list[Walks] = []
    for e, k in list_transitions(problem):
        samples = stack_sample_times(problem, at, e)
        near = is_any_near(samples, at[:, k], fit.standard_errors[k : k + 1])[0]
        if fit.theta_names[k] in kinks or (movable[k] and (near or k in resets)):
            threshold = np.array([rise if k in resets else highest])
            ways.append(list_walks(problem, e, k, at, movable[None], threshold, samples, MOST_PIECES))
            places.append(k)
    if not ways:
        return nothing
    walks, follower = join_walks(ways), Follower(evaluator.halved)  # its meshes suit the estimate alone

    def evaluate(which: NDArray[np.intp], thetas: FloatArray) -> Derivatives:
        found = [follower(theta, side) for theta, side in zip(thetas, walks.side[which].tolist(), strict=True)]
        return Derivatives(*(np.array([getattr(one, name) for one in found]) for name in Derivatives._fields))

    most = MOST_PIECES + MOST_HALVINGS + 1
    costs = np.full(len(walks.place), fit.cost)
    pieces = trace_walks(walks, costs, evaluate, most, problem.unknowns.times).reshape(-1, 2, most, PIECE)
    known = ~np.isnan(pieces[..., 0])
    complete = known[:, :, 0].all(axis=1)
    return pieces[complete, :, : int(known.sum(axis=2).max())], np.array(places)[complete]


def compute_threshold(fit: Fit, level: float) -> float:
    """Return by how much J may exceed its minimum: half the squared quantile, times the residual variance.

    NaN for a fit without a noise model, or one that did not converge.
    """
    return 0.5 * fit.quantile(level) ** 2 * fit.variance_scale if fit.status.successful else np.nan


def is_any_near(samples: FloatArray, values: FloatArray, errors: FloatArray) -> NDArray[np.bool_]:
    """Return of which fits a sample is so near to a transition time that one parabola does not give its interval: (F,).

    Parameters
    ----------
    samples : (F, S)
        Sample times.
    values, errors : (F,)
        Of the transition time, and its standard errors.
    """
    with np.errstate(invalid="ignore"):
        near = np.abs(samples - values[:, None]) <= NEAR * errors[:, None]
    return np.asarray((errors > 0) & near.any(axis=1))


def find_ends(pieces: FloatArray, thresholds: FloatArray, side: int) -> FloatArray:
    """Return where profiles first reach thresholds above the estimate; where the last piece ends if they do not.

    A piece is the cubic that also has the rise with which the piece after it begins; the last one is a parabola, and so
    is one behind which J jumps, as where a transition with a reset map passes a sample.

    Parameters
    ----------
    pieces : (..., P, 5)
        Outwards; after the last of them NaN.
    thresholds : (...)
    side : -1 or 1
    """
    found = np.full(pieces.shape[:-2], np.nan)
    searched = np.ones(found.shape, dtype=bool)
    for p in range(pieces.shape[-2]):
        start, stop, rise, slope, curvature = np.moveaxis(pieces[..., p, :], -1, 0)
        after = pieces[..., p + 1, 2] if p + 1 < pieces.shape[-2] else np.full_like(found, np.nan)
        length, height, last = side * (stop - start), thresholds - rise, np.isnan(after)
        with np.errstate(invalid="ignore", divide="ignore"):
            parabola = find_first_root(height, slope, curvature)
            cubic, risen = np.full_like(found, np.inf), searched & (after >= thresholds)
            if risen.any():
                cubic = np.where(risen, _bisect(after - rise, slope, curvature, length, height), np.inf)
            said = rise + length * (slope + 0.5 * curvature * length)
            jumps = (after >= thresholds) & (after - said > JUMP * after)
            cubic = np.where(jumps, np.minimum(parabola, length), cubic)
            reach = np.where(height <= 0, 0.0, np.where(last, parabola, cubic))
        searched &= ~np.isnan(start)
        found = np.where(searched, start + side * np.minimum(reach, length), found)
        searched &= ~(reach <= length)
    return found


def _bisect(
    gain: FloatArray, slope: FloatArray, curvature: FloatArray, length: FloatArray, height: FloatArray
) -> FloatArray:
    """Return where cubics from 0, with slope and curvature there and a gain after a length, reach a height."""
    third = (gain - slope * length - 0.5 * curvature * length**2) / length**3
    low, high = np.zeros_like(length), length
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        below = middle * (slope + middle * (0.5 * curvature + middle * third)) < height
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return high
