"""Prefix beam: the mode sequences that explain a log best, found in one pass over it.

A *hypothesis* is a sequence of modes with the times of their changes on a grid. It is propagated over the log together
with ``Z = dx / d(tau, p)``, the derivative of its state along all its transition times and parameters. With r the
residuals of the samples so far, W their weights and ``C = h_x Z + h_p``,

    ``c = sum r'W r / 2,   g = sum C'W r,   H = H_0 + sum C'W C``,

and its *score* is ``c - g'H^-1 g / 2``: the cost with all times and parameters free, in the linearised model. At each
time of the grid every hypothesis has children in the modes that may follow, a *birth*. The derivative of the state
along the time of a birth is the jump of the vector field, ``f_before - f_after``; with a reset map R it is
``D_t R + D_x R f_before - f_after(R)``. The best hypotheses are kept, few of them with the same sequence.

After each grid interval the point of linearisation moves to the minimum, ``x += Z d`` with ``d = -H^-1 g``, as in an
extended Kalman filter; a few times along the log, and at its end, all hypotheses are propagated anew from t0 with the
times and parameters to which they have moved, since the sum of many steps of a linear model is not where the system is.
What is left at the end are thus fits of a few Gauss-Newton iterations each. Of 20 random truths of `tests/test_beam.py`
the true sequence is the best proposal in 20; in 19 if only the end is propagated anew, in 11 without that, and in none
if the point of linearisation does not move and the parameter is 20 % off.

A guard ``c(tau, x(tau-), p) = 0`` counts as a measurement of c at the birth, so precise that it determines tau:
``dtau = -(D_x c Z + D_p c) / (D_x c f + D_t c)``. Births that are far from where their guard is met have a high cost.

H_0 has the priors, ``12 / grid^2`` for each time, which is known to half a grid interval, and a weak term for each
parameter without a prior, since the linear model would otherwise explain anything by a parameter that is far away.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.arguments import build_arguments
from switchfit.engine.choice import hypotheses_of
from switchfit.engine.native.hypotheses import NativeHypotheses
from switchfit.engine.protocol import Column, Hypotheses, Limits, Tolerances
from switchfit.fit.variation import assume_noise
from switchfit.modes.branching import Children, Integers, Rules, Sequences, select_lowest
from switchfit.modes.grid import build_mesh, choose_grid, choose_stops, count_values
from switchfit.modes.proposal import Proposal
from switchfit.modes.transitions import Library, list_jumps, refuse_unsupported, trace_library
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem
from switchfit.problem.structure import select_kind

FUNCTIONS = slice(Column.RESET_MAP, Column.GUARD + 1)

GUARD_SD = 1e-3
"""Standard deviation of the time of a transition with a guard, as a part of the grid, given the state and p."""


RTOL = 1e-3
"""Estimated error of a step, relative to the state. The estimate is of order 3, the error of order 5."""

SPREAD, SPREAD_OF_STATES = 0.5, 10.0
"""Standard deviation of a parameter and of an entry of the initial state without a prior, relative to its size."""

MOST_AT_ONCE = 1.0
"""How far a parameter moves after one grid interval, at most, in its standard deviation without data."""

SMALLEST_PART = 0.1
"""Part of a positive parameter below which a beam does not go."""

REPLAYS, LAST_REPLAYS = 4, 3
"""How often the hypotheses are propagated anew along the log, and at its end."""

SAMPLES_OF_NOISE = 4.0
"""Weight, in samples, of the noise that is assumed where sigma is unknown, beside that of the residuals."""


def beam(
    problem: Problem,
    library: Library,
    parameters: FloatArray,
    *,
    penalty: float,
    width: int,
    grid: float | None = None,
    first: Sequence[str] | None = None,
    e: int = 0,
) -> list[Proposal]:
    """Return the best schedules that a prefix beam finds for one experiment, best first.

    Parameters
    ----------
    problem : Problem
    library : Library
    parameters : (P,) array
        Point of linearisation: the problem's free parameters and initial states, in the order of theta after the times.
    penalty : float
        Added to J for each switch; in units of log likelihood where sigma is unknown.
    width : int
        Number of hypotheses kept.
    grid : float, optional
        Time between births; by default that between samples, or a 60th of the horizon if that is more.
    first : sequence of str, optional
        Modes with which a sequence may begin, if fewer than those of the library.
    e : int
        Position of the experiment.

    Raises
    ------
    ValueError
        If the experiment has what a beam cannot follow: a free tf, a delay that is a parameter, terminal constraints,
        or a model that has no machine code.
    """
    at = np.asarray(parameters, dtype=np.float64)
    return _prepare(problem, e, library, grid).run(library, at, penalty, width, first)


class _Beam(NamedTuple):
    """The beam of one experiment on one grid, for any data of its library but the modes and `max_switches`.

    Attributes
    ----------
    problem : Problem
    e : int
    modes : tuple of str
    births : int
        Largest number of births, at least 1.
    engine : NativeHypotheses
    times : (G + 1,) nodes
    stops : (L,) int
        Nodes of t0, of all births, and of tf.
    grid : float
    places : (M,) int
        Position of each entry of p among the parameters.
    functions : (3, K, K) int64
        Places of the reset map, the cost and the guard of each transition in the library, -1 for none.
    counts : (G + 1,) or None
        Where sigma is unknown: number of measured values up to each node.
    noise : float
        Standard deviation that residuals may be expected to have, in units of sqrt(J).
    lock : Lock
        Held during a pass, whose settings and scratch space are the engine's.
    """

    problem: Problem
    e: int
    modes: tuple[str, ...]
    births: int
    engine: NativeHypotheses
    times: FloatArray
    stops: NDArray[np.intp]
    grid: float
    places: NDArray[np.intp]
    functions: Integers
    counts: FloatArray | None
    noise: float
    lock: Any

    def run(
        self, library: Library, parameters: FloatArray, penalty: float, width: int, first: Sequence[str] | None
    ) -> list[Proposal]:
        """Return the proposals of one pass, see `beam`; none if no hypothesis can be evaluated to its end."""
        with self.lock:
            return self._run(library, parameters, penalty, width, first)

    def _run(
        self, library: Library, parameters: FloatArray, penalty: float, width: int, first: Sequence[str] | None
    ) -> list[Proposal]:
        rules = Rules.of(library, self.modes, library.first if first is None else first)
        if not len(rules.first):
            return []
        kept = Sequences.start(rules.first, self.births, float(self.times[0]))
        start = self._start(parameters, np.zeros((1, self.births + len(self.places))))
        of_guards = (self.noise / (GUARD_SD * self.grid)) ** 2
        tolerances = Tolerances(max(RTOL, self.problem.rtol), self.problem.atol / self.problem.rtol, of_guards)
        states = self.engine.begin(parameters[self.places], start, tolerances, self._limits(parameters))
        chosen, value = np.zeros(len(kept.mode), dtype=np.int64), np.zeros(0)
        end, since = float(self.times[-1]), 0
        for begin, stop in pairwise(self.stops.tolist()):
            t = float(self.times[begin])
            children = kept.list_children(*rules.list_births(kept, t, end))
            states = self.engine.advance(states, self._table(kept, children, chosen), begin, stop)
            value = self._penalise(states.scores, stop) + penalty * children.switches
            if stop == self.stops[-1]:
                value = np.where(rules.last[children.mode], value, np.nan)
            chosen = select_lowest(value, children.code, children.switches, width)
            kept = kept.follow(children, chosen, t)
            since += 1
            if REPLAYS * since >= len(self.stops) and stop != self.stops[-1]:
                kept, states = self._replay(kept, states, chosen, parameters, stop)
                chosen, since = np.arange(len(chosen)), 0
        left, value = states.take(chosen), value[chosen]
        for each in range(LAST_REPLAYS if len(chosen) else 0):
            # Where they converge, hypotheses with the same sequence become one.
            best = np.arange(len(value)) if each == 0 else select_lowest(value, kept.code, kept.switches, width, 1)
            kept, left = self._replay(kept.take(best), left, best, parameters, int(self.stops[-1]))
            value = self._penalise(left.scores, int(self.stops[-1])) + penalty * kept.switches
        return self._propose(kept, left, parameters, penalty, rules.shortest)

    def _replay(
        self, kept: Sequences, states: Hypotheses, chosen: Integers, parameters: FloatArray, stop: int
    ) -> tuple[Sequences, Hypotheses]:
        """Return hypotheses with all births where they have moved, and their states at a node.

        The sum of many steps of a linear model is not where the system is: they are propagated anew from t0.
        """
        B, S = len(chosen), self.births
        moved = states.moved[chosen]
        is_born = np.arange(S) < kept.switches[:, None]
        t0, t = float(self.times[0]), float(self.times[stop])
        times = np.clip(kept.times + moved[:, :S], t0, np.nextafter(t, t0))
        times = np.where(is_born, np.maximum.accumulate(times, axis=1), 0.0)
        last = np.where(kept.switches > 0, times[np.arange(B), kept.switches - 1], t0)
        moved[:, :S] = 0.0
        start = self._start(parameters, moved)
        children = np.full((B, S, len(Column)), -1, dtype=np.int64)
        children[..., Column.BEFORE], children[..., Column.AFTER] = before, after = (
            kept.modes[:, :-1],
            kept.modes[:, 1:],
        )
        children[..., Column.SLOT] = np.arange(S)
        children[..., FUNCTIONS] = np.moveaxis(self.functions[:, before, after], 0, -1)
        counts = np.stack([kept.switches, kept.modes[:, 0]], axis=1)
        p = parameters[self.places] + moved[:, S:]
        found = self.engine.replay(start, p, counts, children, times, stop)
        return kept._replace(times=times, last=last), found

    def _start(self, parameters: FloatArray, moved: FloatArray) -> Hypotheses:
        """Return the priors as B hypotheses that have `moved` (B, D): their J and g there, and H_0.

        The terms of H_0 that are no priors have their minimum there.
        """
        S = self.births
        priors, B, P = self._priors, len(moved), len(parameters)
        J, g, h = np.zeros(B), np.zeros((B, P)), np.zeros((B, P))
        if priors.any:
            for k, q in enumerate(self._move(parameters, moved)):
                J[k], g[k], h[k] = priors.evaluate(q, gauss_newton=True)
        weak = (self.noise / self._spread(parameters)) ** 2
        gradients, diagonals = np.zeros_like(moved), np.full(moved.shape, 12.0 * (self.noise / self.grid) ** 2)
        gradients[:, S:] = g[:, self.places]
        diagonals[:, S:] = np.where(h > 0, h, weak)[:, self.places]
        matrices = diagonals[..., None] * np.eye(moved.shape[1])
        unused = np.zeros(len(moved))
        return Hypotheses(unused, J, gradients, matrices, moved, unused, unused)

    def _move(self, parameters: FloatArray, moved: FloatArray) -> FloatArray:
        """Return the parameters of hypotheses that have moved: (B, P)."""
        found = np.tile(parameters, (len(moved), 1))
        found[:, self.places] += moved[:, self.births :]
        return found

    def _limits(self, parameters: FloatArray) -> Limits:
        """Return the limits of how far birth times and parameters may move from where they began."""
        lower, upper = self._bounds
        near = np.where((lower >= 0) & (parameters > 0), SMALLEST_PART * parameters, lower)  # 0 may be no value
        times = np.full(self.births, self.grid)
        low, high = np.maximum(lower, near) - parameters, upper - parameters
        most = MOST_AT_ONCE * self._spread(parameters)
        return Limits(*(np.append(at, of_p[self.places]) for at, of_p in ((-times, low), (times, high), (times, most))))

    @property
    def _first(self) -> int:
        """Number of transition times in theta, before the parameters."""
        return sum(int((where >= 0).sum()) for where in self.problem.unknowns.times)

    @property
    def _priors(self) -> PriorTerms:
        return PriorTerms(*(values[self._first :] for values in self.problem.unknowns.priors))

    @property
    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        unknowns = self.problem.unknowns
        return unknowns.lower[self._first :], unknowns.upper[self._first :]

    def _spread(self, parameters: FloatArray) -> FloatArray:
        """Return the standard deviation of each parameter without a prior: (P,)."""
        lower, upper = self._bounds
        half = 0.5 * (upper - lower)
        bounded = np.isfinite(half) & (half > 0)
        size = np.where(parameters != 0, np.abs(parameters), np.where(bounded, half, 1.0))
        factor = np.full(len(parameters), SPREAD)
        for states in self.problem.unknowns.initial_states:
            factor[states[states >= 0] - self._first] = SPREAD_OF_STATES
        return np.minimum(factor * size, np.where(bounded, half, np.inf))

    def _table(self, kept: Sequences, children: Children, chosen: Integers) -> Integers:
        """Return the table of children for the engine; `chosen` are the records of the hypotheses that were kept."""
        B, parent = len(kept.mode), children.parent
        table = np.full((len(parent), len(Column)), -1, dtype=np.int64)
        table[:, Column.PARENT], table[:, Column.BEFORE] = chosen[parent], kept.mode[parent]
        table[:, Column.AFTER] = children.mode
        table[B:, Column.SLOT] = children.switches[B:] - 1
        pairs = table[B:, Column.BEFORE], children.mode[B:]
        table[B:, FUNCTIONS] = self.functions[:, *pairs].T
        return table

    def _penalise(self, scores: FloatArray, node: int) -> FloatArray:
        """Return the scores; where sigma is unknown, ``n/2 log(2 J / n)``, with a few samples of the assumed noise."""
        if self.counts is None:
            return scores
        n = self.counts[node] + SAMPLES_OF_NOISE
        with np.errstate(invalid="ignore", divide="ignore"):
            return 0.5 * n * np.log((2 * scores / self.noise**2 + SAMPLES_OF_NOISE) / n)

    def _propose(
        self,
        kept: Sequences,
        states: Hypotheses,
        parameters: FloatArray,
        penalty: float,
        shortest: FloatArray,
    ) -> list[Proposal]:
        """Return a proposal for each hypothesis: the minimum of its linearised cost, inside the bounds and in order.

        Its cost is that of the linear model there, not the score: without bounds, a mode between two others could gain
        by a negative duration.
        """
        S, B = self.births, len(kept.mode)
        own, into = self._own_parameters()
        H, g = into.T @ states.matrices @ into, states.gradients @ into
        q = self._move(parameters, states.moved)
        at = q[:, own]
        lower, upper = (bound[own] for bound in self._bounds)
        q[:, own] = np.clip(at - np.linalg.solve(H, g[..., None])[:, S:, 0], lower, upper)
        d = np.concatenate([np.zeros((B, S)), q[:, own] - at], axis=1)
        # Best times for these parameters; of births that have not happened, the columns are zero.
        d[:, :S] = -np.linalg.solve(H[:, :S, :S], (g + (H @ d[..., None])[..., 0])[:, :S, None])[..., 0]
        before = kept.times + states.moved[:, :S]
        times = np.clip(before + d[:, :S], kept.times - self.grid, kept.times + self.grid)
        names, t0, tf = [], float(self.times[0]), float(self.times[-1])
        for k, N in enumerate(kept.switches.tolist()):
            modes = kept.modes[k, : N + 1]
            times[k, :N] = _keep_apart(times[k, :N], shortest[modes], t0, tf)
            names.append(tuple(self.modes[mode] for mode in modes.tolist()))
        is_born = np.arange(S) < kept.switches[:, None]
        d[:, :S] = np.where(is_born, times - before, 0.0)
        costs = states.costs + ((g + 0.5 * (H @ d[..., None])[..., 0]) * d).sum(1)
        value = self._penalise(costs, int(self.stops[-1])) + penalty * kept.switches
        return [
            Proposal((names[k],), (times[k, : kept.switches[k]],), q[k], float(value[k]))
            for k in np.argsort(value, kind="stable").tolist()
        ]

    def _own_parameters(self) -> tuple[NDArray[np.intp], FloatArray]:
        """Return the positions of this experiment's parameters (U,), and the matrix (D, S + U) from its unknowns to the
        times and these.

        Two names of the model may refer to one parameter: the derivatives along both of its columns then add up.
        """
        own, S = np.unique(self.places), self.births
        into = np.zeros((S + len(self.places), S + len(own)))
        into[:S, :S], into[S:, S:] = np.eye(S), self.places[:, None] == own
        return own, into


def _keep_apart(times: FloatArray, shortest: FloatArray, t0: float, tf: float) -> FloatArray:
    """Return transition times in order, moved as far as modes with these shortest durations (N + 1,) need."""
    ahead, behind = np.cumsum(shortest[:-1]), np.cumsum(shortest[:0:-1])[::-1]
    low, high = t0 + ahead, tf - behind
    later = np.maximum.accumulate(np.maximum(times, low) - ahead) + ahead
    return np.minimum.accumulate((np.minimum(later, high) + behind)[::-1])[::-1] - behind


def _prepare(problem: Problem, e: int, library: Library, grid: float | None) -> _Beam:
    """Return the beam of an experiment; it is built once for each problem, library and grid."""
    known: dict[Any, _Beam] = problem.__dict__.setdefault("beams", {})
    pairs = tuple(pair for pair in product(library.modes, library.modes) if library.allows(*pair))
    key = e, frozenset(library.modes), pairs, library.max_switches, grid
    if key not in known:
        known[key] = _build(problem, e, library, grid)
    return known[key]


def _build(problem: Problem, e: int, library: Library, grid: float | None) -> _Beam:
    run, births = problem.experiments[e], max(library.max_switches, 1)
    refuse_unsupported(problem, e)
    structure, functions = trace_library(problem, e, library, births)
    step = choose_grid(run) if grid is None else grid
    mesh = build_mesh(run, step)
    mapped = run.parameter_map
    fixed = [problem.parameters[mapped.get(name, name)].value for name, _, free in structure.parameters if not free]
    arguments = build_arguments(problem, e, mesh)._replace(fixed=tuple(fixed))
    engine = hypotheses_of(problem, structure, arguments, mesh, list_jumps(run, structure, mesh))
    if isinstance(engine, str):
        raise ValueError(
            f"a beam needs machine code, but {engine}. Use method='exhaustive', or 'matching' if the whole state is "
            "measured."
        )
    unknowns = problem.unknowns
    names = [mapped.get(name, name) for name, _, free in structure.parameters if free]
    spans = [np.arange(unknowns.parameters[name].start, unknowns.parameters[name].stop) for name in names]
    states = unknowns.initial_states[e]
    places = np.concatenate([np.zeros(0, dtype=np.intp), *spans, states[states >= 0]]).astype(np.intp)
    measured = select_kind(run.data, Measurements)
    counts = count_values(measured, mesh.times) if any(item.sigma is None for item in measured) else None
    stops, names_of_modes = choose_stops(mesh.times, step), structure.mode_names
    places = places - sum(int((where >= 0).sum()) for where in unknowns.times)
    noise = assume_noise(problem)
    return _Beam(
        problem,
        e,
        names_of_modes,
        births,
        engine,
        mesh.times,
        stops,
        step,
        places,
        functions,
        counts,
        noise,
        threading.Lock(),
    )
