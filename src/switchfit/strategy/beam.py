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
What is left at the end are thus fits of a few Gauss-Newton iterations each. Of 20 random truths of
`tests/strategy/test_beam.py` the true sequence is the best proposal in 20; in 19 if only the end is propagated anew, in
11 without that, and in none if the point of linearisation does not move and the parameter is 20 % off.

A guard ``c(tau, x(tau-), p) = 0`` counts as a measurement of c at the birth, so precise that it determines tau:
``dtau = -(D_x c Z + D_p c) / (D_x c f + D_t c)``. Births that are far from where their guard is met have a high cost.

H_0 has the priors, ``12 / grid^2`` for each time, which is known to half a grid interval, and a weak term for each
parameter without a prior, since the linear model would otherwise explain anything by a parameter that is far away.

Where the order of modes is known, it is the only path: hypotheses differ in their times alone. Of the problem of two
turns of the benchmark 24 of 24 starts then end right; 7 with `REPLAYS` as of a search for the order.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable
from functools import cached_property
from itertools import pairwise

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import build_arguments
from switchfit.engine.choice import hypotheses_of
from switchfit.engine.hypotheses import Column, Hypotheses, HypothesisLimits, HypothesisTolerances
from switchfit.engine.native.native_hypotheses import NativeHypotheses, OrderTables
from switchfit.fit.data_variation import assume_noise
from switchfit.problem.corners.branches import find_corners
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem
from switchfit.strategy.beam_grid import (
    MOST_GRID_INTERVALS,
    build_mesh,
    choose_grid,
    choose_stops,
    count_values,
    keep_apart,
    limit_times,
    list_sample_times,
)
from switchfit.strategy.library import Library
from switchfit.strategy.library_structure import trace_library
from switchfit.strategy.proposal import Proposal, Quadratic
from switchfit.strategy.sequences import MOST_PER_SEQUENCE, Children, Integers, Rules, Sequences, select_lowest
from switchfit.strategy.time_limit import check_time

CHILD_COLUMNS, (PARENT, BEFORE, AFTER, SLOT) = len(Column), map(int, list(Column)[:4])
FUNCTION_COLUMNS = slice(int(Column.RESET_MAP), int(Column.GUARD) + 1)

GUARD_SD = 1e-3
"""Standard deviation of the time of a transition with a guard, as a part of the grid, given the state and p."""

LEAST_BEAM_RTOL = 1e-3
"""Estimated error of a step, relative to the state. The estimate is of order 3, the error of order 5."""

SPREAD, SPREAD_OF_STATES = 0.5, 10.0
"""Standard deviation of a parameter and of an entry of the initial state without a prior, relative to its size."""

MOST_AT_ONCE = 1.0
"""How far a parameter moves after one grid interval, at most, in its standard deviation without data."""

SMALLEST_PART_OF_PARAMETER = 0.1
"""Part of a positive parameter below which a beam does not go."""

REPLAYS, REPLAYS_OF_ORDER, LAST_REPLAYS = 4, 24, 3
"""How often the hypotheses are propagated anew along the log, also where the order is known, and at its end."""

SMALLEST_WIDTH = 1e-6
"""Part of the grid by which a time that is fixed may move: H_0 stays finite."""

TIE_STIFFNESS = 1e12
"""Weight of what keeps names of one parameter equal, in units of what a parameter without a prior has: far above what
data say, and its rounding is far below 1."""

SAMPLES_OF_NOISE = 4.0
"""Weight, in samples, of the noise that is assumed where sigma is unknown, beside that of the residuals."""


def follow_order(
    problem: Problem, e: int, parameters: FloatArray, evidence: Quadratic | None = None, replays: int = REPLAYS_OF_ORDER
) -> list[Proposal]:
    """Return the best times of the given order of modes that a prefix beam finds for one experiment, best first.

    Parameters
    ----------
    problem : Problem
    e : int
        Position of the experiment.
    parameters, evidence
        As in `Beam.run`.
    replays : int
        Fewer do where the parameters are good.
    """
    found, run = prepare(problem, e), problem.experiments[e]
    modes = np.array([found.modes.index(mode) for mode in run.mode_sequence])
    shortest = np.array([problem.durations[mode] for mode in run.mode_sequence])
    # The limits are those of the time, which a birth at a node only begins: one that is born up to a grid interval
    # outside may still move inside.
    reach = np.array([[-found.grid], [found.grid]])  # a birth moves by up to the grid
    rules = Rules.of_order(modes, shortest, found.limits[: len(modes) - 1].T + reach)
    return found.run(rules, parameters, 0.0, MOST_PER_SEQUENCE * len(modes), replays, evidence)


class Beam:
    """The beam of one experiment on one grid, for any data of its library but the modes and `max_switches`.

    Parameters
    ----------
    problem : Problem
    e : int
        Position of the experiment.
    library : Library, optional
        Without one, the given order of modes is followed.
    grid : float, optional
        Time between births; by default that between samples, or a 60th of the horizon if that is more.

    Raises
    ------
    ValueError
        If the experiment has what a beam cannot follow: a free tf, a delay that is a parameter, terminal constraints,
        or a model that has no machine code.

    Attributes
    ----------
    modes : tuple of str
    corners : list of str
        Lines of the user's code with corners of the modes, which its steps do not know.
    births : int
        Largest number of births, S, at least 1.
    engine : NativeHypotheses
    times : (G + 1,) nodes
    stops : (L,) int
        Nodes of t0, of all births, and of tf.
    grid : float
    own : (U,) int
        Positions of this experiment's parameters and initial states among those of the problem.
    places : (M,) int
        Position of each entry of p among these: two names of the model may refer to one parameter.
    ties : (M, M)
        The part of a change of p in which entries of one parameter differ, what it has beside their mean, as a matrix.
    into : (S + M, S + U)
        How births and the entries of p, which may be one parameter under two names, follow from births and parameters.
    lower, upper : (U,)
    priors : PriorTerms
    spread : (U,)
        Standard deviation of each without a prior, as a part of its size.
    functions : (3, K, K) int64
        Places of the reset map, the cost and the guard of each transition in the library, -1 for none.
    counts : (G + 1,) or None
        Where sigma is unknown: number of measured values up to each node.
    noise : float
        Standard deviation that residuals may be expected to have, in units of sqrt(J).
    limits : (S, 2)
        Between which values each time of a transition is.
    tolerances : Tolerances
    lock : Lock
        Held during a pass, whose settings and scratch space are the engine's.
    """

    def __init__(self, problem: Problem, e: int, library: Library | None = None, grid: float | None = None) -> None:
        run, unknowns = problem.experiments[e], problem.unknowns
        self.births = max(len(run.transition_times) if library is None else library.max_switches, 1)
        self.limits = limit_times(run.times if library is None else (), self.births)
        self.grid = choose_grid(run) if grid is None else grid
        is_near = np.diff(self.limits)[:, 0] < self.grid
        marks = self.limits[is_near].mean(axis=1)  # births there, where limits are nearer to each other than the grid
        if any(tau.scale == "log" for tau in run.times):  # whose transitions are as close as the samples there
            seen = list_sample_times(run)
            marks = np.union1d(marks, seen[:: max(len(seen) // MOST_GRID_INTERVALS, 1)])
        mesh = build_mesh(run, self.grid, marks)
        self.times, self.stops = mesh.times, choose_stops(mesh.times, self.grid, marks)
        # Only n/2 log(2 J / n) needs the number of values; with sigma known, scores are log likelihoods as they are.
        is_unknown = any(item.sigma is None for item in run.measurements)
        self.counts = count_values(run.measurements, mesh.times) if is_unknown else None
        structure, self.functions, jumps = trace_library(problem, e, library, self.births, mesh)
        self.modes = structure.mode_names
        found = (line for mode in structure.modes for line in find_corners(mode).lines)
        self.corners = list(dict.fromkeys(filter(None, found)))
        mapped = run.parameter_map
        fixed = [problem.parameters[mapped.get(name, name)].value for name, _, read in structure.parameters if not read]
        arguments = build_arguments(problem, e, mesh)._replace(fixed=tuple(fixed))
        engine = hypotheses_of(problem, structure, arguments, mesh, jumps)
        if isinstance(engine, str):
            raise ValueError(f"a beam needs machine code, but {engine}. Use method='insertion'.")
        self.engine: NativeHypotheses = engine
        # p of the traced model: its free parameters, then free initial states. `in_theta` is sorted and without
        # repetitions.
        in_theta, self.places = np.unique(unknowns.place(e, structure.parameters, mapped), return_inverse=True)
        same, S = self.places[:, None] == self.places, self.births
        self.ties = np.eye(len(same)) - same / same.sum(1)
        self.own = in_theta - int(unknowns.is_time.sum())
        self.into = np.zeros((S + len(same), S + len(in_theta)))
        self.into[:S, :S], self.into[S:, S:] = np.eye(S), self.places[:, None] == np.arange(len(in_theta))
        self.lower, self.upper = unknowns.lowest[in_theta], unknowns.upper[in_theta]
        self.priors = PriorTerms(*(values[in_theta] for values in unknowns.priors))
        self.spread = np.where(np.isin(in_theta, unknowns.initial_states[e]), SPREAD_OF_STATES, SPREAD)
        self.noise = assume_noise(problem)  # that of all runs
        # The inverse of the variance of tau, given the state and p, in units of J.
        guards = (self.noise / (GUARD_SD * self.grid)) ** 2
        self.tolerances = HypothesisTolerances(max(LEAST_BEAM_RTOL, problem.rtol), problem.atol / problem.rtol, guards)
        self.lock = threading.Lock()

    @property
    def reaches(self) -> FloatArray:
        """How far each time may be from its birth on the grid: (S,)."""
        return np.clip(np.diff(self.limits)[:, 0], SMALLEST_WIDTH * self.grid, self.grid)

    def run(
        self, rules: Rules, parameters: FloatArray, penalty: float, width: int, replays: int, evidence: Quadratic | None
    ) -> list[Proposal]:
        """Return the best schedules that one pass finds, best first; none if none can be evaluated to its end.

        Parameters
        ----------
        rules : Rules
        parameters : (P,) array
            Point of linearisation: the problem's free parameters and initial states, in the order of theta after the
            times.
        penalty : float
            Added to J for each switch; in units of log likelihood where sigma is unknown.
        width : int
            Number of hypotheses kept.
        replays : int
            How often the hypotheses are propagated anew along the log.
        evidence : Quadratic or None
            A cost of the experiment's own parameters: what other experiments say about them.
        """
        if not len(rules.first):
            return []
        whole = np.asarray(parameters, dtype=np.float64)
        with self.lock, np.errstate(all="ignore"):  # far from the data numbers may overflow
            # One pass at a time: its settings and scratch space are the engine's, and a beam belongs to all who have
            # the problem.
            found = Pass(self, rules, whole[self.own], penalty, evidence).run(width, replays)
        for k, proposal in enumerate(found):
            placed = whole.copy()
            placed[self.own] = proposal.parameters
            found[k] = proposal._replace(parameters=placed)
        return found


class Pass:
    """One pass of a beam over its log.

    Parameters
    ----------
    beam : Beam
    rules : Rules
    parameters : (U,)
        Point of linearisation at the beginning.
    penalty : float
    evidence : Quadratic, optional
        A cost of the parameters.
    """

    def __init__(
        self, beam: Beam, rules: Rules, parameters: FloatArray, penalty: float, evidence: Quadratic | None = None
    ) -> None:
        self.beam, self.rules, self.parameters, self.penalty, self.evidence = beam, rules, parameters, penalty, evidence
        self.reaches = beam.reaches
        # A bound that is infinite, or equal to the other one, says nothing about the size of an unknown.
        half = 0.5 * (beam.upper - beam.lower)
        bounded = np.isfinite(half) & (half > 0)
        # Size of each unknown: its value; at zero, half its bounds; without either, 1. Bounds limit the spread too.
        size = np.where(parameters != 0, np.abs(parameters), np.where(bounded, half, 1.0))
        self.spread = np.minimum(beam.spread * size, np.where(bounded, half, np.inf))
        self.weak = (beam.noise / self.spread) ** 2
        self.has_priors = beam.priors.any
        self.matrix = self._build_matrix()

    def run(self, width: int, replays: int) -> list[Proposal]:
        """Return the proposals, best first, of so many hypotheses, with so many replays along the log."""
        beam, rules = self.beam, self.rules
        kept = Sequences.start(rules.first, beam.births, float(beam.times[0]))
        start = self.build_start(np.zeros((1, beam.births + len(beam.places))))
        states = beam.engine.begin(self.parameters[beam.places], start, beam.tolerances, self.build_limits())
        chosen, last = np.zeros(len(kept.mode), dtype=np.int64), len(beam.stops) - 1
        # The hypotheses are propagated anew every 1 / replays of the stops; not right after another time, nor at the
        # end, where LAST_REPLAYS come anyway.
        stretch = max(-(-len(beam.stops) // max(replays, 1)), 2)
        for first in range(0, last, stretch):
            check_time()
            until = min(first + stretch, last)
            kept, states, chosen = self._follow(kept, states, chosen, (first, until), width)
            if until < last:
                kept, states = self._replay(kept, states, chosen, int(beam.stops[until]))
                chosen = np.arange(len(chosen))
        left, best, node = states.take(chosen), np.arange(len(chosen)), int(beam.stops[last])
        for _ in range(LAST_REPLAYS if len(chosen) else 0):
            kept, left = self._replay(kept.take(best), left, best, node)
            # Where they converge, hypotheses with the same sequence become one.
            value = self._value(left.scores, kept.switches, node)
            best = select_lowest(value, kept.code, kept.switches, width, 1)
        return self._propose(kept, left)

    def _follow(
        self, kept: Sequences, states: Hypotheses, chosen: Integers, ends: tuple[int, int], width: int
    ) -> tuple[Sequences, Hypotheses, Integers]:
        """Return hypotheses, of which those with records in `chosen` are kept, at a later one of the stops."""
        beam, rules = self.beam, self.rules
        # A given order needs no selection by Python between stops: its whole stretch is one call of machine code, with
        # the same proposals to the last bit (a beam of ten tosses: 7.6 ms in place of 14.4).
        if self.order is not None:
            last, births = kept.last[:, None], kept.times
            given = states.records[chosen], kept.mode, np.concatenate([last, births], axis=1), self.order, *ends
            places, born, found = beam.engine.follow_order(*given)
            return Sequences.of_places(places, born[:, 1:], born[:, 0]), found, np.arange(len(places))
        tf = float(beam.times[-1])
        for begin, stop in pairwise(beam.stops[ends[0] : ends[1] + 1].tolist()):
            check_time()
            t = float(beam.times[begin])
            # All that were kept go on as they are, then come the births at this node; the engine takes both to the next
            # stop.
            children = kept.list_children(*rules.list_births(kept, t, tf))
            states = beam.engine.advance(states, self.build_table(kept, children, chosen), begin, stop)
            value = self._value(states.scores, children.switches, stop)
            # Sequences that may not end here drop out.
            if stop == beam.stops[-1]:
                value = np.where(rules.last[children.mode], value, np.nan)
            chosen = select_lowest(value, children.code, children.switches, width)
            kept = kept.follow(children, chosen, t)
        return kept, states, chosen

    @cached_property
    def order(self) -> OrderTables | None:
        """The order of modes, where it is given; else None."""
        rules = self.rules
        if rules.between is None:
            return None
        places, windows = np.arange(len(rules.modes)), np.zeros((len(rules.modes), 4))
        windows[:, 0], windows[:-1, 1:3], windows[:-1, 3] = rules.least, rules.between.T, rules.shortest[1:]
        children = self.steps[places, np.minimum(places + 1, places[-1])]
        children[:, SLOT] = places
        counts = np.zeros((2, len(places), 3), dtype=np.int64)
        # Row 0 for a hypothesis that stays in its place, row 1 for one that leaves it.
        counts[1, :, 0], counts[:, :, 1] = 1, rules.modes
        return OrderTables(children, counts, windows, self.beam.stops.astype(np.int64))

    def _replay(self, kept: Sequences, states: Hypotheses, chosen: Integers, stop: int) -> tuple[Sequences, Hypotheses]:
        """Return hypotheses with all births where they have moved, and their states at a node.

        The sum of many steps of a linear model is not where the system is: they are propagated anew from t0.
        """
        check_time()
        beam, B, S = self.beam, len(chosen), self.beam.births
        moved = states.moved[chosen]
        is_born = np.arange(S) < kept.switches[:, None]
        t0, t = float(beam.times[0]), float(beam.times[stop])
        # Times where the linear model has moved them, in order and before this node: a birth later than the node would
        # never happen, and its derivative be zero. Slots without a birth are 0.
        low, high = np.maximum(beam.limits[:, 0], t0), np.minimum(beam.limits[:, 1], np.nextafter(t, t0))
        times = np.minimum(np.maximum(kept.times + moved[:, :S], low), high)
        times = np.where(is_born, np.maximum.accumulate(times, axis=1), 0.0)
        last = np.where(kept.switches > 0, times[np.arange(B), kept.switches - 1], t0)
        # The births are where they have moved: from now on `moved` counts from there. The parameters go on from the
        # first p.
        moved[:, :S] = 0.0
        found = self.propagate(self.build_start(moved), kept, kept.switches, times, stop)
        return kept._replace(times=times, last=last), found

    def propagate(
        self, start: Hypotheses, kept: Sequences, births: Integers | int, times: FloatArray, stop: int,
        first: int | None = None, *, recentres: bool = True,
    ) -> Hypotheses:  # fmt: skip
        """Return hypotheses from a start, at node `first` or at t0, anew to another node, with so many births (B,) at
        times (B, S'), whose slots are the last ones.
        """
        beam, (B, S) = self.beam, times.shape
        entries, counts = beam.births - S, np.empty((B, 2), dtype=np.int64)
        counts[:, 0], counts[:, 1] = births, self.rules.modes[kept.modes[:, 0]]
        children, padded = np.empty((B, beam.births, CHILD_COLUMNS), dtype=np.int64), np.empty((B, beam.births))
        if counts[:, 0].any():  # no others are read
            children[:, :S], padded[:, :S] = self.steps[kept.modes[:, :-1], kept.modes[:, 1:]], times
            # Births fill the last slots: online, the first ones are entries e of what was before the window, which no
            # birth may use.
            children[:, :S, SLOT] = entries + np.arange(S)
        p = self.parameters[beam.places] + start.moved[:, beam.births :]
        return beam.engine.replay(start, p, counts, children, padded, stop, first, recentres=recentres)

    def build_start(self, moved: FloatArray) -> Hypotheses:
        """Return the priors as B hypotheses that have `moved` (B, D): their J and g there, and H_0.

        The terms of H_0 that are no priors have their minimum there.
        """
        beam, (B, D), unused = self.beam, moved.shape, np.zeros(len(moved))
        J, gradients, matrices = unused, np.zeros((B, D)), np.repeat(self.matrix[None], B, axis=0)
        if not self.has_priors and self.evidence is None:
            return Hypotheses(unused, J, gradients, matrices, moved, unused, unused)
        # The priors are taken where the hypothesis is, not where the pass began: J and g of a prior change as p moves.
        q = self._move(moved)
        g = np.zeros(q.shape)
        if self.has_priors:
            J, g, h = beam.priors.evaluate(q, gauss_newton=True)
            matrices.reshape(B, D * D)[:, (D + 1) * beam.births :: D + 1] += h[:, beam.places]
        if self.evidence is not None:
            rise, slope = self.evidence.evaluate(q)  # what other experiments say is not only curvature
            J, g = J + rise, g + slope
        # Under each name of a parameter, as the terms of H_0 are.
        gradients[:, beam.births :] = g[:, beam.places]
        return Hypotheses(unused, J, gradients, matrices, moved, unused, unused)

    def _build_matrix(self) -> FloatArray:
        """Return H_0 without the priors of parameters, and with what other experiments say: (D, D), in units of J.

        A time that is uniform on its width has the variance width^2 / 12; a parameter without a prior has its spread.
        Names of one parameter count as unknowns of their own, each with its term, until `_propose`; a stiff term keeps
        them equal.
        """
        beam, places = self.beam, self.beam.places
        weak = np.where(beam.priors.precision > 0, 0.0, self.weak)[places]
        # noise^2 turns the inverse of a variance into units of J where sigma is unknown; it is 1 where sigma is known.
        matrix = np.diag(np.append(12.0 * (beam.noise / self.reaches) ** 2, weak))
        matrix[beam.births :, beam.births :] += TIE_STIFFNESS * self.weak[places] * beam.ties
        if self.evidence is not None:
            matrix[beam.births :, beam.births :] += self.evidence.Q[places[:, None], places]
        return matrix

    def _move(self, moved: FloatArray) -> FloatArray:
        """Return the parameters of hypotheses that have moved: (B, U)."""
        found = np.repeat(self.parameters[None], len(moved), axis=0)
        found[:, self.beam.places] += moved[:, self.beam.births :]
        return found

    @cached_property
    def steps(self) -> Integers:
        """What a table of children has for each pair of places, (K, K, 7); a hypothesis that stays has no functions."""
        # Columns that are not set here, PARENT and SLOT, belong to a hypothesis and not to a pair of modes.
        functions, modes = self.beam.functions, self.rules.modes
        steps = np.full((*functions.shape[1:], CHILD_COLUMNS), -1, dtype=np.int64)
        steps[..., BEFORE], steps[..., AFTER] = modes[:, None], modes
        steps[..., FUNCTION_COLUMNS] = np.moveaxis(functions, 0, -1)
        return steps

    def build_limits(self) -> HypothesisLimits:
        """Return the limits of how far birth times and parameters may move from where they began."""
        beam, at = self.beam, self.parameters
        near = np.where((beam.lower >= 0) & (at > 0), SMALLEST_PART_OF_PARAMETER * at, beam.lower)  # 0 may be no value
        low, high, most = np.maximum(beam.lower, near) - at, beam.upper - at, MOST_AT_ONCE * self.spread
        # A step of a time is limited by nothing but its reach; that of p by one spread, since a linear model of the
        # first few samples may send it anywhere.
        pairs = (-self.reaches, low), (self.reaches, high), (self.reaches, most)
        return HypothesisLimits(*(np.append(of_time, of_p[beam.places]) for of_time, of_p in pairs))

    def build_table(self, kept: Sequences, children: Children, chosen: Integers) -> Integers:
        """Return the table of children for the engine; `chosen` are the records of the hypotheses that were kept."""
        # The first B rows are the parents themselves, which keep slot -1: they have no birth. A birth's slot is the
        # number of switches before it.
        B, table = len(kept.mode), self.steps[kept.mode[children.parent], children.mode]
        table[:, PARENT], table[B:, SLOT] = chosen[children.parent], children.switches[B:] - 1
        return table

    def _value(self, scores: FloatArray, switches: Integers, node: int) -> FloatArray:
        """Return the scores of hypotheses at a node with the penalty of switches.

        Where sigma is unknown, it is ``n/2 log(2 J / n)``, with a few samples of the assumed noise.
        """
        beam = self.beam
        if beam.counts is not None:
            # -log L with sigma^2 = 2 J / n put in. The few samples of the assumed noise keep it from minus infinity
            # where a model with many unknowns meets the first few samples exactly.
            n = beam.counts[node] + SAMPLES_OF_NOISE
            scores = 0.5 * n * np.log(scores * (2 / (n * beam.noise**2)) + SAMPLES_OF_NOISE / n)
        return np.asarray(scores + self.penalty * switches if self.penalty else scores)

    def _propose(self, kept: Sequences, states: Hypotheses) -> list[Proposal]:
        """Return a proposal for each hypothesis: the minimum of its linearised cost, inside the bounds and in order.

        Its cost is that of the linear model there, not the score: without bounds, a mode between two others could gain
        by a negative duration. The evidence of the best is what the data say about the parameters, the times following
        them.
        """
        beam, B, S = self.beam, len(kept.mode), self.beam.births
        into, U = beam.into, len(beam.own)  # H -> I' H I, g -> I' g: derivatives along all names of a parameter add up
        H, g = into.T @ states.matrices @ into, states.gradients @ into
        before_q = self._move(states.moved)
        # All unknowns free, then the parameters inside their bounds, then the times for these parameters: conditional
        # minima.
        q = np.clip(before_q - np.linalg.solve(H, g[..., None])[:, S:, 0], beam.lower, beam.upper)
        d = np.concatenate([np.zeros((B, S)), q - before_q], axis=1)
        # Best times for these parameters; of births that have not happened, the columns are zero.
        d[:, :S] = -np.linalg.solve(H[:, :S, :S], (g + (H @ d[..., None])[..., 0])[:, :S, None])[..., 0]
        before = kept.times + states.moved[:, :S]
        # A birth stands for the times up to a grid interval from it; beyond, another hypothesis is responsible.
        times = np.clip(before + d[:, :S], kept.times - beam.grid, kept.times + beam.grid)
        names, t0, tf = [], float(beam.times[0]), float(beam.times[-1])
        for k, N in enumerate(kept.switches.tolist()):
            at = kept.modes[k, : N + 1]
            # Times move one by one with the linear model, and may pass each other or leave a mode less than its
            # shortest duration.
            times[k, :N] = keep_apart(times[k, :N], self.rules.shortest[at], t0, tf)
            names.append(tuple(beam.modes[mode] for mode in self.rules.modes[at].tolist()))
        # Bounds of a time come last: a fixed transition, whose limits are equal, stays exactly where it is.
        times = np.clip(times, *beam.limits.T)
        is_born = np.arange(S) < kept.switches[:, None]
        d[:, :S] = np.where(is_born, times - before, 0.0)
        # J + g'd + d'H d / 2 at the times that are possible, not at the minimum.
        costs = states.costs + ((g + 0.5 * (H @ d[..., None])[..., 0]) * d).sum(1)
        value = self._value(costs, kept.switches, int(beam.stops[-1]))
        order = np.argsort(value, kind="stable").tolist()
        found = [Proposal((names[k],), (times[k, : kept.switches[k]],), q[k], float(value[k])) for k in order]
        for k in order[:1]:
            # Evidence must not have the priors of this experiment, which whoever adds it up has too. H_0 of the times
            # stays: it only makes them follow the parameters.
            known = self.build_start(states.moved[[k]])
            known.matrices[:, :S] = 0.0
            alone = H[k] - into.T @ known.matrices[0] @ into
            slope = g[k] - known.gradients[0] @ into + alone @ d[k]
            evidence = Quadratic(np.append(times[k], q[k]), slope, alone).restrict(np.arange(S, S + U))
            found[0] = found[0]._replace(evidence=evidence)
        return found


def prepare(problem: Problem, e: int, library: Library | None = None, grid: float | None = None) -> Beam:
    """Return the beam of an experiment, built once for each problem, library and grid; without a library that of the
    given order of modes. It raises ValueError as `Beam` does.
    """
    known: dict[Hashable, Beam] = problem.__dict__.setdefault("beams", {})
    # All of the library that tracing depends on. The modes with which a sequence begins and ends, and how long each
    # lasts, are rules of a pass.
    key: Hashable = e, grid, library and (library.modes, tuple(library.successions.items()), library.max_switches)
    if key not in known:
        known[key] = Beam(problem, e, library, grid)
    return known[key]
