"""Derivative matching: which mode explains each interval between samples, where the whole state is measured.

Between two samples y_i and y_(i+1), h apart, mode k leaves the residual

    r_(i,k) = y_(i+1) - y_i - h f_k,     f_k = (f_k(y_i) + 4 f_k(y_m) + f_k(y_(i+1))) / 6,

y_m being Hermite's interpolation in the middle, in units of the noise of the difference. Nothing is simulated. With
the parameters given, the costs of the intervals add up, and dynamic programming finds the lowest sum for each number of
switches (optimal partitioning [1]_) with the shortest durations and the successions of a library. The parameters follow
from the residuals of a partition by Gauss and Newton's method, and both are repeated.

References
----------
.. [1] C. Truong, L. Oudre, N. Vayatis, Selective review of offline change point detection methods, Signal Processing
   167 (2020) 107299.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Mesh
from switchfit.engine.adaptive import list_fixed_nodes
from switchfit.engine.protocol import ExperimentEngine
from switchfit.fit.evaluator import Evaluator
from switchfit.modes.library import Library
from switchfit.modes.proposal import Proposal
from switchfit.modes.rates import add_all_modes
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.functions import use_float64
from switchfit.problem.losses import influence, robust
from switchfit.problem.problem import Problem

ROUNDS = 5
"""Partitions and estimates of the parameters in turn, at most."""

STEPS = 6
"""Steps of Gauss and Newton's method for one partition, at most."""

ENOUGH = 1e-4
"""Decrease, relative to the cost, below which these steps end: a fit follows."""

DIFFERENCE = 1e-7
"""Step of a parameter, relative to its size, by which residuals are differentiated."""

LARGE = 1e12
"""Cost of an interval in which a mode cannot be evaluated."""


class Partition(NamedTuple):
    """The best partition with one number of switches.

    Attributes
    ----------
    cost : float
    modes : tuple of int
        Index of the mode of each segment.
    starts : tuple of int
        The interval with which each segment begins.
    """

    cost: float
    modes: tuple[int, ...]
    starts: tuple[int, ...]

    def spread_modes(self, intervals: int) -> NDArray[np.intp]:
        """Return the index of the mode in each of all intervals."""
        return np.repeat(self.modes, np.diff([*self.starts, intervals])).astype(np.intp)


def find_partitions(
    costs: FloatArray, times: FloatArray, library: Library, switches: int | None = None
) -> list[Partition]:
    """Return the best partition of intervals into segments, for each number of switches with which there is one.

    Let V(s, i, k) be the lowest cost of the first i intervals with s switches, the last of them in mode k for as long
    as it must last, and C(i, k) the cost of the first i intervals in mode k alone. Then

        V(s, i, k) = C(i, k) + min over a of [ min over j of V(s - 1, a, j) - C(a, k) ],

    j being the modes that k may follow, and a the intervals with ``times[i] - times[a]`` at least the shortest duration
    of k. The minimum over a is a running one, so that all takes O(switches n K^2).

    Parameters
    ----------
    costs : (n, K) array
        Of each interval in each mode of the library.
    times : (n + 1,) array
        Ends of the intervals, ascending.
    library : Library
    switches : int, optional
        The largest number of switches; that of the library if left out.

    Returns
    -------
    list of Partition
        By the number of switches.
    """
    n, K = costs.shape
    names = library.modes
    most = library.max_switches if switches is None else switches
    sums = np.concatenate([np.zeros((1, K)), np.cumsum(costs, axis=0)])
    follows = np.array([[0.0 if library.allows(j, k) else np.inf for k in names] for j in names])
    shortest = np.array([library.min_duration(k) for k in names])
    slack = 1e-9 * (times[-1] - times[0])
    # The last interval with which a segment that ends with interval i may begin; -1 if there is none.
    latest = np.searchsorted(times, times[:, None] - shortest + slack, "right") - 1
    latest = np.minimum(latest, np.arange(n + 1)[:, None] - 1)
    begins = np.where([k in library.first for k in names], 0.0, np.inf)
    ends = np.where([k in library.last for k in names], 0.0, np.inf)
    lowest = np.where(latest >= 0, sums + begins, np.inf)
    chosen: list[tuple[NDArray[np.intp], NDArray[np.intp]]] = []
    found: list[Partition] = []
    for s in range(min(most, n - 1) + 1):
        if s:
            reached = lowest[:, :, None] + follows
            entry = reached.min(1) - sums
            running = np.minimum.accumulate(entry, axis=0)
            is_new = np.concatenate([np.ones((1, K), dtype=bool), running[1:] < running[:-1]])
            where = np.maximum.accumulate(np.where(is_new, np.arange(n + 1)[:, None], 0), axis=0)
            starts = np.where(latest >= 0, np.take_along_axis(where, np.maximum(latest, 0), axis=0), 0)
            best = np.where(latest >= 0, np.take_along_axis(running, np.maximum(latest, 0), axis=0), np.inf)
            chosen.append((starts, reached.argmin(1)))
            lowest = sums + best
        total = lowest[-1] + ends
        k = int(total.argmin())
        if not np.isfinite(total[k]):
            continue
        cost, i, modes, firsts = float(total[k]), n, [k], []
        for starts, before in reversed(chosen):
            i, k = int(starts[i, k]), k
            firsts.append(i)
            k = int(before[i, k])
            modes.append(k)
        found.append(Partition(cost, tuple(reversed(modes)), (0, *reversed(firsts))))
    return found


@dataclass(frozen=True, eq=False)
class _Log:
    """Samples of the whole state of one experiment.

    Attributes
    ----------
    times, states : (n + 1,), (n + 1, d)
    sigma : (n, d)
        Noise of the differences of neighbours.
    is_known : bool
        Whether sigma is that of the data.
    used : (n,) bool
        Intervals without a jump at a known time.
    loss, loss_scale : of the Measurements
    t0, tf : the horizon
    """

    times: FloatArray
    states: FloatArray
    sigma: FloatArray
    is_known: bool
    used: NDArray[np.bool_]
    loss: str
    loss_scale: float
    t0: float
    tf: float

    @property
    def knots(self) -> FloatArray:
        """Ends of the intervals, the first and the last one reaching to the ends of the horizon: (n + 1,)."""
        return np.concatenate([[self.t0], self.times[1:-1], [self.tf]])

    def weigh(self, residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the cost of residuals (..., d) in units of sigma: (...), and their weights (..., d)."""
        u = residuals**2
        cost = 0.5 * robust(self.loss, self.loss_scale, u).sum(-1)
        return np.where(np.isfinite(cost), cost, LARGE), influence(self.loss, self.loss_scale, u)


def explain_no_matching(problem: Problem, library: Library) -> str | None:
    """Return why derivatives cannot be matched, as a sentence; None if they can.

    Parameters
    ----------
    problem : Problem
    library : Library
    """
    special = {*problem.system.reset_maps, *problem.system.guards}
    for before, after in special:
        if before in library.modes and after in library.modes and library.allows(before, after):
            return f"the transition {before!r} -> {after!r} has a reset map or a guard"
    for e, run in enumerate(problem.experiments):
        where = f" of {run.name}" if run.name else ""
        if run.has_free_tf:
            return f"tf{where} is estimated"
        if _read_log(problem, e, problem.initial_theta) is None:
            return f"no Measurements{where} see the whole state at two times or more"
    return None


def match_derivatives(problem: Problem, library: Library, parameters: FloatArray) -> list[Proposal]:
    """Return the schedules whose derivatives match the measured states best, one for each number of switches.

    Parameters
    ----------
    problem : Problem
        With Measurements of the whole state: of all states, or of linear combinations from which they follow.
    library : Library
    parameters : (M,)
        Guess of the free parameters and initial states, in the order of theta.

    Returns
    -------
    list of Proposal
        The lowest ``cost + switches log(n) / 2`` first, n being the measured values. Costs are half the squared
        residuals of the intervals in units of their noise. With several experiments, the best schedules of all, then
        those that differ in one of them.

    Raises
    ------
    ValueError
        If the state is not measured, or the library has transitions with reset maps or guards.
    """
    reason = explain_no_matching(problem, library)
    if reason is not None:
        raise ValueError(f"derivative matching needs the whole state, and free transitions without jumps: {reason}.")
    matcher = _Matcher(problem, library, parameters)
    p, partitions = np.array(parameters, dtype=float), []
    chosen: list[Partition] = []
    for _ in range(ROUNDS):
        residuals = matcher.compute_residuals(p)
        partitions = matcher.partition(residuals)
        before, chosen = chosen, [min(each, key=matcher.criterion_of(e)) for e, each in enumerate(partitions)]
        p = matcher.estimate(chosen, p)
        if chosen and [c[1:] for c in chosen] == [c[1:] for c in before]:
            break
    partitions = matcher.partition(matcher.compute_residuals(p))
    best = [min(each, key=matcher.criterion_of(e)) for e, each in enumerate(partitions)]
    alternatives = [best]
    for e, each in enumerate(partitions):
        alternatives += [[*best[:e], other, *best[e + 1 :]] for other in each if other is not best[e]]
    found = [matcher.propose(each, p) for each in alternatives]
    return [proposal for _, proposal in sorted(found, key=lambda pair: pair[0])]


class _Matcher:
    """Residuals of all intervals in all modes, as functions of the parameters."""

    def __init__(self, problem: Problem, library: Library, parameters: FloatArray) -> None:
        self.library = library
        self.problem = add_all_modes(problem)
        self._first = len(self.problem.theta_names) - len(parameters)
        meshes = [Mesh.from_times(list_fixed_nodes(run)) for run in problem.experiments]
        self._engines: list[ExperimentEngine] = Evaluator(self.problem, meshes=meshes).engines
        self._nodes = [mesh.times for mesh in meshes]
        logs = [_read_log(self.problem, e, self._extend(parameters)) for e in range(len(meshes))]
        self.logs = [log for log in logs if log is not None]
        for e, log in enumerate(self.logs):
            if not log.is_known:
                self.logs[e] = replace(log, sigma=self._guess_noise(e, parameters))

    def _extend(self, p: FloatArray) -> FloatArray:
        """Return theta (d,) with the guess of the transition times."""
        return np.concatenate([self.problem.initial_theta[: self._first], p])

    def _guess_noise(self, e: int, p: FloatArray) -> FloatArray:
        """Return the noise of the differences where sigma is left out: what the best mode leaves, (n, d)."""
        log = self.logs[e]
        residuals = self._residuals_of(e, p)
        size = np.abs(residuals) / np.maximum(np.abs(np.diff(log.states, axis=0)).mean(0), 1e-300)
        best = np.take_along_axis(residuals, size.sum(-1).argmin(1)[:, None, None], axis=1)[:, 0]
        typical = np.median(np.abs(best), axis=0) / 0.6745
        floor = 1e-9 * np.maximum(np.abs(log.states).max(0), 1e-300)
        return np.broadcast_to(np.maximum(typical, floor), best.shape)

    def _residuals_of(self, e: int, p: FloatArray) -> FloatArray:
        """Return the residuals of one experiment: (n, K, d)."""
        log, nodes, engine = self.logs[e], self._nodes[e], self._engines[e]
        own = self.problem.vectors(self._extend(p), e)[1]
        names = self.problem.structures[e].mode_names
        modes = [names.index(mode) for mode in self.library.modes]
        t, y, h = log.times, log.states, np.diff(log.times)[:, None]
        after = np.clip(np.searchsorted(nodes, t, "right") - 1, 0, len(nodes) - 2)
        before = np.clip(np.searchsorted(nodes, t, "left") - 1, 0, len(nodes) - 2)
        with np.errstate(all="ignore"):  # a mode may not be defined at all states
            at_start = engine.slopes(t[:-1], after[:-1], y[:-1], own)[:, modes]
            at_end = engine.slopes(t[1:], before[1:], y[1:], own)[:, modes]
            middle, found = 0.5 * (t[:-1] + t[1:]), np.empty_like(at_start)
            inside = np.searchsorted(nodes, middle, "right") - 1
            for k in range(len(modes)):
                # Hermite's interpolation, as in collocation by Hermite and Simpson
                x = 0.5 * (y[:-1] + y[1:]) + h / 8 * (at_start[:, k] - at_end[:, k])
                f = engine.slopes(middle, inside, x, own)[:, modes[k]]
                found[:, k] = y[1:] - y[:-1] - h / 6 * (at_start[:, k] + 4 * f + at_end[:, k])
        return found

    def compute_residuals(self, p: FloatArray) -> list[FloatArray]:
        """Return the residuals of each experiment in units of their noise, 0 across jumps: (n, K, d)."""
        found = [self._residuals_of(e, p) / log.sigma[:, None] for e, log in enumerate(self.logs)]
        return [np.where(log.used[:, None, None], r, 0.0) for r, log in zip(found, self.logs, strict=True)]

    def partition(self, residuals: Sequence[FloatArray]) -> list[list[Partition]]:
        """Return the best partitions of each experiment by the number of switches."""
        found = []
        for log, r in zip(self.logs, residuals, strict=True):
            own = find_partitions(log.weigh(r)[0], log.knots, self.library)
            if not own:
                raise ValueError("no sequence of the library fits between the samples: shorten min_duration.")
            found.append(own)
        return found

    def criterion_of(self, e: int) -> Callable[[Partition], float]:
        """Return the function by which the number of switches of an experiment is chosen."""
        each = 0.5 * float(np.log(self.logs[e].states.size))
        return lambda partition: partition.cost + each * (len(partition.modes) - 1)

    def _stack(self, chosen: Sequence[Partition], p: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Return the cost of partitions with the priors, and their residuals and weights, all in one row."""
        residuals, weights, cost = [], [], 0.0
        for log, partition, r in zip(self.logs, chosen, self.compute_residuals(p), strict=True):
            own = r[np.arange(len(r)), partition.spread_modes(len(r))]
            costs, weight = log.weigh(own)
            cost += float(costs.sum())
            residuals.append(own.ravel())
            weights.append(weight.ravel())
        priors = self.problem.unknowns.priors
        cost += float(priors.evaluate(self._extend(p))[0]) if priors.any else 0.0
        return cost, np.concatenate(residuals), np.concatenate(weights)

    def estimate(self, chosen: Sequence[Partition], p: FloatArray) -> FloatArray:
        """Return the parameters that minimize the residuals of partitions, by Gauss and Newton's method: (M,)."""
        unknowns, M = self.problem.unknowns, len(p)
        low, high = unknowns.lower[self._first :], unknowns.upper[self._first :]
        cost, r, w = self._stack(chosen, p)
        for _ in range(STEPS if M else 0):
            jacobian = np.zeros((len(r), M))
            for m in range(M):
                step = DIFFERENCE * max(abs(p[m]), 1e-3)
                step = -step if p[m] + step > high[m] else step
                moved = p.copy()
                moved[m] += step
                jacobian[:, m] = (self._stack(chosen, moved)[1] - r) / step
            if not np.isfinite(jacobian).all():
                break
            _, slope, bend = unknowns.priors.evaluate(self._extend(p), gauss_newton=True)
            gradient = jacobian.T @ (w * r) + slope[self._first :]
            matrix = (jacobian.T * w) @ jacobian + np.diag(bend[self._first :])
            direction = -np.linalg.lstsq(matrix, gradient, rcond=1e-12)[0]
            length = 1.0
            while length > 1e-3:
                trial = np.clip(p + length * direction, low, high)
                found = self._stack(chosen, trial)
                if found[0] < cost:
                    break
                length /= 2
            else:
                break
            fell = cost - found[0]
            p, (cost, r, w) = trial, found
            if fell < ENOUGH * (1.0 + cost):
                break
        return p

    def propose(self, chosen: Sequence[Partition], p: FloatArray) -> tuple[float, Proposal]:
        """Return partitions with parameters of their own as a proposal, and its criterion."""
        p = self.estimate(chosen, p)
        residuals = self.compute_residuals(p)
        placed = [self._place(e, *pair) for e, pair in enumerate(zip(chosen, residuals, strict=True))]
        sequences = tuple(tuple(self.library.modes[k] for k in partition.modes) for partition in chosen)
        cost = self._stack(chosen, p)[0] + sum(gain for _, gain in placed)
        penalty = sum(self.criterion_of(e)(each) - each.cost for e, each in enumerate(chosen))
        return cost + penalty, Proposal(
            sequences, tuple(times for times, _ in placed), self._with_initial_states(p), cost
        )

    def _place(self, e: int, partition: Partition, r: FloatArray) -> tuple[FloatArray, float]:
        """Return the transition times (N,), each inside one of the two intervals beside its sample, and by how much
        that changes the cost.

        A switch from j to k after the part theta of an interval leaves ``theta r_j + (1 - theta) r_k``.
        """
        log = self.logs[e]
        times, total = [], 0.0
        for start, j, k in zip(partition.starts[1:], partition.modes[:-1], partition.modes[1:], strict=True):
            best = (0.0, float(log.times[start]))
            for i, own in ((start - 1, j), (start, k)):
                change = r[i, j] - r[i, k]
                square = float(change @ change)
                if not (square > 0.0 and np.isfinite(square)):
                    continue
                theta = min(max(-float(r[i, k] @ change) / square, 0.0), 1.0)
                mixed = r[i, k] + theta * change
                gain = float(log.weigh(mixed)[0] - log.weigh(r[i, own])[0])
                best = min(best, (gain, float(log.times[i] + theta * (log.times[i + 1] - log.times[i]))))
            total += best[0]
            times.append(best[1])
        return np.array(times), total

    def _with_initial_states(self, p: FloatArray) -> FloatArray:
        """Return the parameters with unknown entries of initial states as measured, where there is a sample at t0."""
        unknowns, p = self.problem.unknowns, p.copy()
        for log, places in zip(self.logs, unknowns.initial_states, strict=True):
            if log.times[0] == log.t0:
                for k in np.flatnonzero(places >= 0).tolist():
                    place = int(places[k])
                    p[place - self._first] = np.clip(log.states[0, k], unknowns.lower[place], unknowns.upper[place])
        return p


def _read_log(problem: Problem, e: int, theta: FloatArray) -> _Log | None:
    """Return the samples of the whole state of an experiment; None if there are none."""
    run, named = problem.experiments[e], problem.name_parameters(theta, e)
    items = [item for item in run.data if isinstance(item, Measurements)]
    for k, item in enumerate(items):
        there = np.isfinite(item.values).all(1)
        if isinstance(item.delay, str) or there.sum() < 2:
            continue
        inverse = _invert_sensor(problem, e, k, item, theta)
        if inverse is None:
            continue
        A, b = inverse
        times, states = item.seen_times[there], (item.values[there] - b) @ A.T
        noise = item.noise(named)
        is_known = noise is not None
        variance = np.ones_like(item.values) if noise is None else np.asarray(noise, dtype=float) ** 2
        variance = variance[there] @ (A**2).T
        sigma = np.sqrt(variance[1:] + variance[:-1])
        acts = run.jump_times[:, None]
        used = ~((times[:-1] <= acts) & (acts < times[1:])).any(0)
        return _Log(times, states, sigma, is_known, used, item.loss, item.loss_scale, run.t0, run.end)
    return None


def _invert_sensor(
    problem: Problem, e: int, k: int, item: Measurements, theta: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return A (n, q) and b (q,) with ``x = A (y - b)`` for the k-th Measurements; None if y does not determine x."""
    structure = problem.structures[e]
    n = structure.n
    observe = structure.measurements[k].observe
    if observe is None:
        return np.eye(n), np.zeros(n)
    named = problem.name_parameters(theta, e)
    points = (float(item.times[0]), np.zeros(n)), (float(item.times[-1]), np.arange(1.0, n + 1))
    with use_float64():
        found = [
            (np.asarray(jax.jacfwd(observe, argnums=1)(t, x, named)), np.asarray(observe(t, x, named)))
            for t, x in points
        ]
    (H, b), (other, value) = found
    is_linear = np.allclose(H, other, rtol=1e-9) and np.allclose(value, b + other @ points[1][1], rtol=1e-9)
    if not is_linear or np.linalg.matrix_rank(H) < n:
        return None
    return np.linalg.pinv(H), b
