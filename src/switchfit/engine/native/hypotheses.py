"""Many hypotheses on the mode sequence of one experiment, propagated over its mesh by machine code.

A hypothesis is a *record* of doubles, see `divide_record`. `propagate` takes it from node to node, changes its mode at
births, computes its score, and moves its point of linearisation to the minimum.

Names of the pointers of straight-line functions are those of `switchfit.engine.native.kernels`; x, Z, J, g, H and check
are those of one hypothesis. All derivatives are propagated forward, so that a cost of (t, x, p) adds ``Z' g_x + g_p``
to g and its Gauss-Newton matrix to H at once, without a costate. Further pointers:

    K           f and the running cost ell at a birth, (n + 1,)
    error       largest estimate of the error of a step so far, relative to the tolerances, which are the entries of
    tolerances  relative; size of a state at which the relative and the absolute error count the same; information of a
                guard on the time of its transition
    moved       the sum of all changes of the unknowns so far, (D,)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Arguments
from switchfit.discretization.rows import STIFF
from switchfit.engine.native import program
from switchfit.engine.native.engine import count_samples, get_address
from switchfit.engine.native.kernels import STAGES, Curvature, Kernels, Store, store_all
from switchfit.engine.native.llvm import Module, Program, Value, Variable
from switchfit.engine.native.program import Pointers, Writer
from switchfit.engine.native.scalars import CHECKED, Graph, Namespace, Objects
from switchfit.engine.native.templates import Order, Sizes, constants_of
from switchfit.engine.protocol import Column, Hypotheses, Limits, Tolerances
from switchfit.problem.data import FloatArray
from switchfit.problem.structure import Structure

MOST_PARTS = 64
"""Largest number of steps in a cell."""

SMALL_ERROR = 1 / 64
"""Error, relative to the tolerances, at which steps of twice the length are tried next: their error is 16 times it."""

COLUMNS = len(Column)

PER_PLACE = 3
"""Hypotheses that `follow_order` keeps in each place of a given order of modes: as many as a beam of one sequence."""

WINDOW = 4
"""What limits the births at the end of a place, in doubles: how long its mode lasts at least, the times between which
the birth is, and how long the next mode lasts at least."""

GIVEN = "nodes", "signals", "c", "units", "tolerances", "low", "high", "most", "jump_first", "jump_map"
"""Pointers in the table, before those of the scratch space and of the samples. `jump_first` (G + 2,) has the place in
`jump_map` of the first jump at each node; `low` and `high` (D,) are the bounds of `moved`, and `most` (D,) is how far
it may move at once."""

OF_SAMPLES = ("first", "time", "value", "weight")
"""For each Measurements: the place of the first sample at each node (G + 2,), then as `program.OF_SAMPLES`."""

SMALLEST_RATE = 1e-30
"""Square of the rate of a guard below which it says nothing on the time."""


def divide_record(sizes: Sizes) -> dict[str, slice]:
    """Return where the parts of a record are, in doubles.

    J : (), cost
    error : (), largest estimate of the error of a step since the last block, relative to the tolerances
    score : (), ``J - g' H^-1 g / 2``, the cost with all unknowns free, where the model is linear in them; NaN where H
        is not positive definite
    check : (), NaN once a value that was presumed finite is not
    parts : (), number of steps in a cell
    p, moved : (M,), the point of linearisation; (D,), how far the unknowns have moved there from where they began
    x, Z, g, H : (n,), (n, width), (width,), (D, width)
    """
    n, D, width = sizes.n, sizes.D, sizes.width
    lengths = dict.fromkeys(("J", "error", "score", CHECKED, "parts"), 1) | {"p": sizes.M, "moved": D}
    lengths |= {"x": n, "Z": n * width, "g": width, "H": D * width}
    ends = accumulate(lengths.values())
    return {name: slice(end - length, end) for (name, length), end in zip(lengths.items(), ends, strict=True)}


def measure_record(sizes: Sizes) -> int:
    """Return the length of a record."""
    return divide_record(sizes)["H"].stop


def scratch_sizes(sizes: Sizes) -> dict[str, int]:
    """Return the sizes of the scratch space, in doubles: the eliminated [H; g'], the entries of g as they were
    eliminated, and what the straight-line functions exchange.
    """
    n, D, width = sizes.n, sizes.D, sizes.width
    lengths = {"rows": (D + 1) * width, "reduced": D, "K": n + 1}
    lengths |= {"XZ": STAGES * n * width, "entries": STAGES * (1 + n + sizes.M) ** 2}
    return lengths | {"increments": STIFF.coupled * n, "newton": 2}


class HypothesisKernels(Kernels):
    """Writes the straight-line functions of hypotheses; the order of derivatives is that of Gauss-Newton."""

    adjoint = False

    def move(self, name: str, sign: float, costs: bool) -> None:
        """Write ``Z += sign * f moves'`` and ``g += sign * ell moves``.

        With 1 this leads from derivatives at a fixed time to those at the time of a transition, with -1 back.
        """
        graph, n = Graph(), self.sizes.n
        moves = graph.load("moves", 0, vector=True)
        Z = graph.loads("Z", n, vector=True) + sign * graph.loads("K", n) * moves
        stores = store_all("Z", 0, Z)
        if costs:
            stores.append(("g", 0, graph.load("g", 0, vector=True) + sign * graph.load("K", n) * moves))
        self.module.write_straight_line(name, stores)

    def _constraint(self, graph: Graph, found: Sequence[Objects], moving: bool) -> list[Store]:
        """Return stores of a guard as a measurement ``c(tau, x(tau-), p) = 0``, so precise that it determines tau.

        Its sigma is a small time, given by `tolerances`, times the rate ``D_t c + D_x c f`` at which c changes.
        """
        c, c_t, c_x, c_p = (np.ravel(each) for each in found[:4])
        # c changes by rate dtau: an error sigma_t of the time is one of rate sigma_t of c. J gets c^2 / (2 (rate
        # sigma_t)^2), in its own units.
        rate = (c_x * graph.loads("K", self.sizes.n)).sum() + c_t.item()
        weight = graph.load("tolerances", 2) / (rate * rate + SMALLEST_RATE)
        slopes = np.concatenate([c_t, c_x, c_p])
        first = np.split(weight * c.item() * slopes, [1, 1 + self.sizes.n])
        return self._cost(graph, [0.5 * weight * c * c, *first, weight * np.outer(slopes, slopes)], moving)

    def shift(self) -> None:
        """Write the change d of the point of linearisation to the minimum of the cost, inside its bounds: ``x += Z d``,
        ``g+ = g + H d``, then ``J += (g + g+)'d / 2`` and ``p += d``.

        It follows from the rows that `score` has eliminated. Those of p are the last: birth times are the best for p
        inside its bounds.
        """
        graph, n, D, N, width = Graph(), self.sizes.n, self.sizes.D, self.sizes.N, self.sizes.width
        W = [graph.loads("rows", D, k * width) for k in range(D)]
        reduced, moved, low, high, most = (graph.loads(name, D) for name in ("reduced", "moved", "low", "high", "most"))
        xp, d = Namespace(graph), np.full(D, graph.constant(0.0), dtype=object)
        # Backward from the last unknown: step_k = (reduced_k + sum_{j > k} W_kj d_j) / W_kk, whose d_j are final. So an
        # unknown at its limit is a limit for those before it: the birth times are the best for the p that was possible.
        for k in reversed(range(D)):
            step = (reduced[k] + (W[k][k + 1 :] * d[k + 1 :]).sum()) / W[k][k]
            # First the limit of one move, then the bounds, which hold in any case.
            target = xp.minimum(xp.maximum(moved[k] - step, moved[k] - most[k]), moved[k] + most[k])
            d[k] = xp.minimum(xp.maximum(target, low[k]), high[k]) - moved[k]
        # The quadratic model at the new point: g+ = g + H d and J + g'd + d'H d / 2 = J + (g + g+)'d / 2; H stays.
        x = [graph.load("x", i) + (graph.loads("Z", D, i * width) * d).sum() for i in range(n)]
        g = graph.loads("g", D)
        after = np.array([g[i] + (graph.loads("H", D, i * width) * d).sum() for i in range(D)])
        J = graph.load("J", 0) + 0.5 * (d * (g + after)).sum()
        stores = [("J", 0, J), *store_all("x", 0, x), *store_all("g", 0, after), *store_all("moved", 0, moved + d)]
        p = graph.loads("p", self.sizes.M) + d[N:]
        self.module.write_straight_line("shift", stores + store_all("p", 0, p))


class HypothesisWriter(Writer):
    """Emits the loops of hypotheses."""

    def __init__(self, library: Structure, sizes: Sizes, module: Module) -> None:
        super().__init__(library, sizes, Order.GAUSS_NEWTON, module)
        own = (f"{name} {k}" for k in range(len(library.measurements)) for name in OF_SAMPLES)
        self.names = (*GIVEN, *scratch_sizes(sizes), *own)

    def find(self, record: Value) -> Pointers:
        """Emit the addresses in the table, and those of the fields of a record."""
        parts = divide_record(self.sizes)
        return self.pointers() | {name: self.at(record, part.start) for name, part in parts.items()}

    def write_node(self) -> str:
        """Write what happens at a node: samples add their costs, then jumps at known times act."""
        _, record, node = self.begin("void @at_node(ptr %table, ptr %record, i64 %node)")
        found = self.find(record)
        # Nodes are at known times: `moves` is the row of zeros. A jump maps x and Z in place.
        found |= {"moves": found["units"], "x_after": found["x"], "Z_after": found["Z"]}
        found["time"] = self.at(found["nodes"], node)
        for k in range(len(self.library.measurements)):
            begin, end = (self.get("i64", found[f"first {k}"], at) for at in (node, node + 1))
            with self.loop(begin, end) as place:
                self.call(f"sample_{k}", found | self.at_sample(found, k, place))
        if self.library.reset_maps:
            begin, end = (self.get("i64", found["jump_first"], at) for at in (node, node + 1))
            with self.loop(begin, end) as place:
                # Jumps come after the samples: a sample at the time of a jump sees the state before it.
                which = self.get("i64", found["jump_map"], place)
                self.call_one_of(which, len(self.library.reset_maps), found, "reset_{}")
        return self.end()

    def write_score(self) -> str:
        """Write the elimination of all unknowns from ``J + g'd + d'H d / 2``, row by row of [H; g']."""
        _, record = self.begin("void @score(ptr %table, ptr %record)")
        D, width, vector, found = self.sizes.D, self.sizes.width, self.module.vector, self.find(record)
        W, score = found["rows"], Variable(self, "double", self.load("double", found["J"]))
        # L D L' of [H; g'] on a copy W (D + 1, width). For k = 0 .. D - 1, with the pivot W_kk and the slope W_Dk:
        #     score -= slope^2 / (2 pivot),  reduced_k = slope,  W_i -= (W_ik / pivot) W_k for the rows i = k + 1 .. D
        # so that after all k the score is J - g' H^-1 g / 2. H needs no pivoting: H_0 makes it positive definite.
        self.copy(W, found["H"], D * width)
        self.copy(self.at(W, D * width), found["g"], width)
        with self.loop(0, D) as k:
            row = self.at(W, k, width)
            pivot, slope = self.get("double", row, k), self.get("double", self.at(W, D * width), k)
            # `shift` solves backward from the slopes as they were when their unknown was eliminated: W_D is
            # overwritten.
            self.put(slope, found["reduced"], k)
            inverse = 1.0 / pivot
            # A pivot that is not positive, or NaN, makes the score NaN: the hypothesis drops out when the lowest are
            # selected.
            score.value = (pivot > 0.0).choose(score.value - slope * slope * inverse * 0.5, float("nan"))
            # Whole rows are subtracted as vectors: what becomes of the columns before k is never read.
            own = self.load(vector, row)
            with self.loop(k + 1, D + 1) as i:
                other = self.at(W, i, width)
                factor = self.spread(self.get("double", other, k) * inverse, width)
                product = self.let(vector, f"fmul contract {vector} {factor}, {own}")
                self.store(self.let(vector, f"fsub contract {vector} {self.load(vector, other)}, {product}"), other)
        # The check is 0 or NaN.
        self.store(score.value + self.load("double", found[CHECKED]), found["score"])
        return self.end()

    def write_birth(self) -> str:
        """Write a change of mode at a time inside a cell, or at its first node.

        With tau the time of the change, x(tau-) moves by f_before dtau. The cost and the reset map of the transition
        are differentiated along that, and at a fixed time after it the state moves by ``- f_after dtau`` more: without
        a reset map the derivative along tau is ``f_before - f_after``.
        """
        signature = "void @birth(ptr %table, ptr %record, ptr %child, i64 %cell, double %time)"
        _, record, child, cell, time = self.begin(signature)
        found, time_at, library = self.find(record), self.allocate("double", 2), self.library
        self.store(time, time_at)
        self.put(self.get("double", found["nodes"], cell), time_at, 1)
        # Row 0 of `units` is zero: the unit vector of birth time k is row k + 1.
        slot = self.get("i64", child, Column.SLOT) + 1
        found |= {"signal": self.at(found["signals"], cell, 4 * self.sizes.signals)}
        found |= {"time": time_at, "moment": time_at, "origin": self.at(time_at, 1), "y": found["x"]}
        found |= {"moves": self.at(found["units"], slot, self.sizes.width), "multiplier": found["units"]}
        found |= {"x_after": found["x"], "Z_after": found["Z"]}

        def call(column: Column, functions: Sequence[Any], *names: str) -> None:
            """Emit the calls of the functions of what is in a column of the child."""
            self.call_one_of(self.get("i64", child, column), len(functions), found, *names)

        # Z += f_before dtau: from here to "hold", Z and g are those at the time of the birth, which moves.
        call(Column.BEFORE, library.modes, "slope_{}", "move")
        call(Column.GUARD, library.guards, "guards_{}")
        call(Column.TRANSITION_COST, library.transition_costs, "transition_costs_{}")
        call(Column.RESET_MAP, library.reset_maps, "reset_{}")
        # Z -= f_after dtau at the state behind the reset map: back to derivatives at a fixed time. Without a reset map
        # the column of this birth is now X^i, (8) of the paper, and all others are as before.
        call(Column.AFTER, library.modes, "slope_{}", "hold")
        return self.end()

    def write_steps(self, curvatures: list[Curvature]) -> str:
        """Write steps in a mode between two times of a cell."""
        settings = "i64 %mode, i64 %cell, i64 %parts, double %begin, double %end"
        _, record, mode, cell, parts, begin, end = self.begin(f"void @steps(ptr %table, ptr %record, {settings})")
        found, row = self.find(record), self.allocate("double", 3)
        self.put(begin, row, 1)
        self.put(self.get("double", found["nodes"], cell), row, 2)
        found |= {"row": row, "signal": self.at(found["signals"], cell, 4 * self.sizes.signals)}
        # Ends of steps do not move with theta.
        found |= {"opens": found["units"], "closes": found["units"], "x_after": found["x"], "Z_after": found["Z"]}
        with self.loop(0, parts) as part:
            # Ends of steps are begin + length k / parts, and the last one is `end` itself: sums of steps would miss the
            # node.
            inside = begin + (end - begin) * ((part + 1).to("double") / parts.to("double"))
            self.store(self.get("double", row, 1), row)
            self.put((part + 1 >= parts).choose(end, inside), row, 1)
            for k in self.cases(mode, len(self.library.modes)):
                self.take_step(k, "step", found)
                program.add_curvature(self, curvatures[k], found, moving=False)
        return self.end()

    def write_propagation(self) -> str:
        """Write the loop over hypotheses that go on from one node to another, with births at any times.

        Each cell has the steps that it needs: where the estimate of the error is too large, it alone begins again, with
        steps of half the length; the next one begins with twice the length where this one was far more accurate than it
        has to be.

        If `restarts`, which is only possible at the first node, x and Z become those at t0, and the samples there are
        added; the records have p, moved, and the J, g and H of the priors. Of each hypothesis, `children` (B, births,
        columns) are its births, `times` (B, births) when they are, `counts` (B, 3) their number, the first mode, and
        which of the `parents` it is a copy of.
        """
        given = "ptr %records, ptr %parents, ptr %children, ptr %times, ptr %counts, i64 %births, i64 %first, i64 %last"
        settings = "i64 %restarts, i64 %count, i64 %at_end, i64 %recentres"
        arguments = self.begin(f"void @propagate(ptr %table, {given}, {settings})")
        table, records, parents, children, times, counts = arguments[:6]
        births, first, last, restarts, count, at_end, recentres = arguments[6:]
        size, place, library = measure_record(self.sizes), divide_record(self.sizes), self.library
        before, has_costs = self.allocate("double", size), library.running or library.references or library.guards

        def copy_changed(target: Value, source: Value) -> None:
            """Emit the copy of what steps change: if nothing costs on the way, neither g nor H."""
            end = place["H" if has_costs or library.transition_costs else "Z"].stop
            for part in (slice(0, place["p"].start), slice(place["x"].start, end)):
                self.copy(self.at(target, part.start), self.at(source, part.start), part.stop - part.start)

        with self.loop(0, count) as index:
            record, own = self.at(records, index, size), self.at(counts, index, 3)
            self.copy(record, self.at(parents, self.get("i64", own, 2), size), size)
            of_times, of_births = self.at(times, index, births), self.at(children, index, births * COLUMNS)
            found, birth = self.find(record), Variable(self, "i64", 0)
            mode, parts = Variable(self, "i64", self.get("i64", own, 1)), Variable(self, "i64", 1)
            with self.when(restarts > 0):
                self.call("start", found | {"x_after": found["x"], "Z_after": found["Z"]})
                self.invoke("at_node", table, record, 0)
            with self.loop(first, last) as here:
                start, end = (self.get("double", found["nodes"], k) for k in (here, here + 1))
                # Numbers of steps are doubles in a record, since it has nothing else.
                taken = self.load("double", found["parts"])
                is_small = self.load("double", found["error"]) < SMALL_ERROR
                parts.value = (is_small & (taken > 1.0)).choose(taken * 0.5, taken).to("i64")
                birth_of_cell, mode_of_cell, begin = birth.value, mode.value, Variable(self, "double", start)
                copy_changed(before, record)
                with self.repeat() as accept:
                    self.store(0.0, found["error"])
                    with self.repeat() as leave:
                        leave(birth.value >= self.load("i64", own))
                        # A birth exactly at the end of the cell belongs to the next one, behind the samples of that
                        # node.
                        tau = self.get("double", of_times, birth.value)
                        leave((tau < end).equals(False))
                        with self.when(tau > begin.value):
                            self.invoke("steps", table, record, mode.value, here, parts.value, begin.value, tau)
                        child = self.at(of_births, birth.value, COLUMNS)
                        self.invoke("birth", table, record, child, here, tau)
                        mode.value = self.get("i64", child, Column.AFTER)
                        birth.value, begin.value = birth.value + 1, tau
                    self.invoke("steps", table, record, mode.value, here, parts.value, begin.value, end)
                    # An error that is NaN fails the comparison: such a hypothesis tries up to the most, then its score
                    # is NaN.
                    accept((self.load("double", found["error"]) <= 1.0) | (parts.value >= MOST_PARTS))
                    parts.value, birth.value, mode.value = parts.value * 2, birth_of_cell, mode_of_cell
                    begin.value = start
                    copy_changed(record, before)
                self.store(parts.value.to("double"), found["parts"])
                self.invoke("at_node", table, record, here + 1)
            if library.terminal:
                with self.when(at_end > 0):
                    self.call("end", found)
            self.invoke("score", table, record)
            score = self.load("double", found["score"])
            with self.when((recentres > 0) & score.equals(score)):  # the rows have been eliminated then
                self.call("shift", found)
        return self.end()

    def write_following(self) -> str:
        """Write the loop over the stops of a beam whose modes are in a given order: hypotheses differ in their times.

        From stop to stop, those in each of the `places` go on as they are, then come births into the next place; of
        each place the `PER_PLACE` with the lowest scores are kept. There are two generations in memory, that at a stop
        and that at the next one; in each, a place has `PER_PLACE` + 1 records, of which the last is spare. For each
        place there are `numbers` (2, places) of hypotheses and the `ranks` (2, places, PER_PLACE + 1) of its records,
        the lowest score first; for each record, `births` (2, places, PER_PLACE + 1, births + 1) has the time of its
        last birth, or t0, then those of all. At the `final` node only the last place is left. The generation at the end
        is the first one after an even number of steps.
        """
        arrays = "ptr %records, ptr %numbers, ptr %ranks, ptr %births, ptr %children, ptr %counts, ptr %windows"
        settings = "ptr %stops, i64 %places, i64 %length, i64 %first, i64 %last, i64 %final"
        given = self.begin(f"void @follow_order(ptr %table, {arrays}, {settings})")
        table, records, numbers, ranks, births, children, counts, windows, stops = given[:9]
        places, length, first, last, final = given[9:]
        size, room, nodes = measure_record(self.sizes), PER_PLACE + 1, self.pointers()["nodes"]
        tf, now = self.get("double", nodes, final), Variable(self, "i64", 0)
        with self.loop(first, last) as step:
            here, there = (self.get("i64", stops, k) for k in (step, step + 1))
            time_at, at_end = self.at(nodes, here), (there >= final).to("i64")
            time, old, new = self.load("double", time_at), now.value, 1 - now.value
            self.zero(self.at(numbers, new * places), places)
            with self.loop(0, 2) as born, self.loop(0, places - born) as place:
                entry, window = place + born, self.at(windows, place, WINDOW)
                count = self.get("i64", numbers, old * places + place)
                is_open = (at_end < 1) | (entry + 1 >= places)
                with self.loop(0, is_open.choose(count, 0)) as rank:
                    parent = self.get("i64", ranks, (old * places + place) * room + rank)
                    past = self.at(births, parent, length)
                    least, earliest, latest, after = (self.get("double", window, k) for k in range(WINDOW))
                    may_leave = (time - self.load("double", past) >= least) & (time > earliest) & (time < latest)
                    with self.when((born < 1) | (may_leave & (time + after <= tf))):
                        kept = self.get("i64", numbers, new * places + entry)
                        own_ranks = self.at(ranks, new * places + entry, room)
                        child = self.get("i64", own_ranks, kept)
                        record, own_births = self.at(records, child, size), self.at(births, child, length)
                        own_counts = self.at(counts, born * places + place, 3)
                        birth, before = self.at(children, place, COLUMNS), self.at(records, parent, size)
                        whole = (table, record, before, birth, time_at, own_counts, 1, here, there, 0, 1, at_end, 1)
                        self.invoke("propagate", *whole)
                        with self.loop(0, length) as k:
                            self.put(self.get("double", past, k), own_births, k)
                        with self.when(born > 0):
                            self.store(time, own_births)
                            self.put(time, own_births, entry)
                        score = self._load_score(record)
                        with self.when((score < float("inf")) & (score > float("-inf"))):
                            self._insert(records, own_ranks, kept, child, score)
                            is_full = kept >= PER_PLACE
                            self.put(is_full.choose(kept, kept + 1), numbers, new * places + entry)
            now.value = new
        return self.end()

    def _load_score(self, record: Value) -> Value:
        return self.get("double", record, divide_record(self.sizes)["score"].start)

    def _insert(self, records: Value, ranks: Value, count: Value, child: Value, score: Value) -> None:
        """Emit the insertion of a record behind those of its place, `count` of them, whose scores are no higher."""
        size, rank = measure_record(self.sizes), Variable(self, "i64", count)
        with self.repeat() as leave:
            leave(rank.value < 1)
            other = self.get("i64", ranks, rank.value - 1)
            leave(score >= self._load_score(self.at(records, other, size)))
            self.put(other, ranks, rank.value)
            rank.value = rank.value - 1
        self.put(child, ranks, rank.value)


def hypotheses_program(library: Structure, sizes: Sizes) -> Program | str:
    """Return the machine code of hypotheses of a library, or the reason why it cannot be compiled."""
    return program.compile_library(library, sizes, (Order.GAUSS_NEWTON,), _write)


def _write(library: Structure, sizes: Sizes, order: Order, module: Module) -> Iterator[str]:
    kernels = HypothesisKernels(library, sizes, order, module)
    costs = bool(library.running or library.references)
    curvatures = []
    for mode in range(len(library.modes)):
        stage = kernels.templates.stage(mode, running=costs)
        if library.implicit[mode]:
            kernels.newton(f"newton_{mode}", stage)
        kernels.forward_row(f"step_{mode}", stage, False, costs, kernels.tableau(mode))
        curvatures.append(kernels.curvature(f"curvature_{mode}", kernels.chosen, kernels.tableau(mode)))
        program.write_slope(kernels, mode, stage)
    kernels.shift()
    kernels.move("move", 1.0, costs)
    kernels.move("hold", -1.0, costs)
    kernels.nodes()
    writer = HypothesisWriter(library, sizes, module)
    for mode in (mode for mode, implicit in enumerate(library.implicit) if implicit):
        module.add(program.write_newton(writer, f"newton_{mode}"))
    module.add(writer.write_steps(curvatures))
    module.add(writer.write_node())
    module.add(writer.write_score())
    module.add(writer.write_birth())
    module.add(writer.write_propagation())
    module.add(writer.write_following())
    yield module.take()


Integers = NDArray[np.int64]

SampleArrays = tuple[Integers, FloatArray, FloatArray, FloatArray]
"""Of one Measurements: the place of the first sample at each node (G + 2,), times (K,), values and weights (K, q)."""


class OrderTables(NamedTuple):
    """A given order of modes, N + 1 places, as machine code takes it.

    Attributes
    ----------
    children : (N + 1, 7), the birth at the end of each place, see `Column`; the last one is not read
    counts : (2, N + 1, 3), the number of births of a hypothesis that stays in a place and of one that leaves it, the
        mode of the place, and 0
    windows : (N + 1, 4), how long the mode of each place lasts at least, the times between which its end is, and how
        long the next mode lasts at least
    stops : (L,), nodes between which births are
    """

    children: Integers
    counts: Integers
    windows: FloatArray
    stops: Integers


class NativeHypotheses:
    """Propagates hypotheses on the mode sequence of one experiment from node to node of a mesh.

    Parameters
    ----------
    code : Program
        Of `hypotheses_program`.
    sizes : Sizes
    arguments : Arguments
    times : (G + 1,) array
        Nodes, the times of jumps among them.
    jumps : sequence of (int, int)
        Node of each jump at a known time, ascending, and the place of its map in the library.

    Attributes
    ----------
    record_size : int
        Length of a record, in doubles.
    """

    def __init__(
        self, code: Program, sizes: Sizes, arguments: Arguments, times: FloatArray, jumps: Sequence[tuple[int, int]]
    ) -> None:
        self._program, self._at = code, divide_record(sizes)
        self._cells, self.record_size = len(times) - 1, measure_record(sizes)
        self._shape = sizes.n, sizes.D, sizes.width
        nodes = np.arange(self._cells + 2)
        self._arrays: dict[str, Any] = {
            "nodes": np.array(times),
            "signals": np.ascontiguousarray(np.asarray(arguments.signals)[: self._cells]),
            "c": np.concatenate([*constants_of(arguments), np.zeros(1)], axis=None),
            "units": np.eye(sizes.D + 1, sizes.width, -1),  # row 0 is zero: the derivative of a time that does not move
            "tolerances": np.zeros(3),
            **{name: np.zeros(sizes.D) for name in ("low", "high", "most")},
            "jump_first": np.searchsorted([node for node, _ in jumps], nodes).astype(np.int64),
            "jump_map": np.array([*(which for _, which in jumps), -1], dtype=np.int64),
            **{name: np.zeros(size) for name, size in scratch_sizes(sizes).items()},
        }
        for k, samples in enumerate(arguments.samples):
            count = count_samples(samples)
            first = np.searchsorted(np.asarray(samples.cell)[:count] + 1, nodes).astype(np.int64)
            values = (np.array(np.asarray(a)[:count], dtype=np.float64, order="C") for a in samples[1:])
            self._set_samples(k, first, *values)
        self._table = np.array(list(map(get_address, self._arrays.values())), dtype=np.uintp)
        self._table_at = get_address(self._table)
        prefix = program.PREFIX[Order.GAUSS_NEWTON]
        self._propagate = code.function(f"{prefix}propagate", 13)
        self._follow_order = code.function(f"{prefix}follow_order", 14)

    def _set_samples(self, k: int, *arrays: NDArray[Any]) -> None:
        self._arrays |= {f"{name} {k}": array for name, array in zip(OF_SAMPLES, arrays, strict=True)}

    def reserve(self, cells: int, samples: int) -> tuple[FloatArray, FloatArray, list[SampleArrays]]:
        """Replace nodes (G + 1,), signals (G, 4, S) and samples by empty arrays, which are to be filled while a log
        grows; return them.

        Parameters
        ----------
        cells, samples : int
            Capacity: of cells, and of samples of each Measurements.
        """
        self._cells = cells + 1  # no node is the end
        wide = self._arrays["signals"].shape[1:]
        given: dict[str, Any] = {"nodes": np.zeros(cells + 1), "signals": np.zeros((cells, *wide))}
        self._arrays |= given | {"jump_first": np.zeros(cells + 2, dtype=np.int64)}
        of_sensors = []
        for k in range(sum(name.startswith("first ") for name in self._arrays)):
            channels = self._arrays[f"value {k}"].shape[1]
            first, time = np.zeros(cells + 2, dtype=np.int64), np.zeros(samples)
            of_sensors.append((first, time, np.zeros((samples, channels)), np.zeros((samples, channels))))
            self._set_samples(k, *of_sensors[-1])
        self._table[:] = [get_address(a) for a in self._arrays.values()]
        return given["nodes"], given["signals"], of_sensors

    def begin(self, p: FloatArray, start: Hypotheses, tolerances: Tolerances, limits: Limits | None) -> Hypotheses:
        """Return one hypothesis at t0, with the samples there.

        Parameters
        ----------
        p : (M,)
        start : Hypotheses
            One, whose costs, gradients and matrices are those of the priors.
        tolerances : Tolerances
        limits : Limits or None
            Within them the point of linearisation moves towards the minimum of the cost after each `advance` and
            `replay`; None if it stays.
        """
        self._arrays["tolerances"][:] = tolerances
        self._recentres = limits is not None
        if limits is not None:
            for name, values in limits._asdict().items():
                self._arrays[name][:] = values
        counts, children = np.zeros((1, 2), dtype=np.int64), np.zeros((1, 0, COLUMNS), dtype=np.int64)
        return self.replay(start, p[None], counts, children, np.zeros((1, 0)), 0, recentres=False)

    def advance(self, parents: Hypotheses, children: Integers, first: int, last: int) -> Hypotheses:
        """Return the children at node `last` of parents at node `first`: (C,) from a table (C, 7), see `Column`.

        The samples at the first node are those of the parents; the births come after them.
        """
        parent, before, after, slot = children.T[: Column.SLOT + 1]
        times = np.full((len(children), 1), self._arrays["nodes"][first])
        counts = np.stack([slot >= 0, np.where(slot >= 0, before, after), parent], axis=1)
        return self._go_on(parents.records, (children, times, counts), (first, last, False))

    def follow_order(
        self, parents: FloatArray, places: Integers, births: FloatArray, order: OrderTables, first: int, last: int
    ) -> tuple[Integers, FloatArray, Hypotheses]:
        """Take hypotheses from one stop to another in a given order of modes; the lowest scores of each place are kept.

        Parameters
        ----------
        parents : records (B, size) at the first stop
        places : (B,), their places in the order
        births : (B, S + 1), the time of their last birth, or t0, then those of all
        order : OrderTables
        first, last : int
            Among the stops of the order.

        Returns
        -------
        places, births, Hypotheses : at the last stop, the lowest score first
        """
        K, room = len(order.counts[0]), PER_PLACE + 1
        records, wide = np.empty((2, K * room, self.record_size)), np.empty((2, K * room, births.shape[1]))
        numbers, ranks = np.zeros((2, K), dtype=np.int64), np.arange(2 * K * room).reshape(2, K * room)
        rank = [places[:k].tolist().count(place) for k, place in enumerate(places.tolist())]
        at = places * room + np.array(rank, dtype=np.int64)
        records[0, at], wide[0, at], numbers[0] = parents, births, np.bincount(places, minlength=K)
        given = records, numbers, ranks, wide, *order
        sizes = K, births.shape[1], first, last, self._cells
        self._follow_order(self._table_at, *map(get_address, given), *sizes)
        end = (last - first) % 2
        kept = np.arange(room) < numbers[end, :, None]
        found = ranks[end].reshape(K, room)[kept] - end * K * room
        found = found[np.argsort(records[end, found, self._at["score"].start], kind="stable")]
        return found // room, wide[end, found], self.view(records[end, found])

    def replay(
        self,
        start: Hypotheses,
        p: FloatArray,
        counts: Integers,
        children: Integers,
        times: FloatArray,
        last: int,
        first: int | None = None,
        *,
        recentres: bool = True,
    ) -> Hypotheses:
        """Return hypotheses propagated anew from t0 to node `last`, with births at any times.

        Parameters
        ----------
        start : Hypotheses
            B, whose costs, gradients and matrices are those of the priors at p, and moved what it shall be.
        p : (B, M), points of linearisation
        counts : (B, 2), number of births, and first mode
        children : (B, S, 7), the births, see `Column`
        times : (B, S), when they are, ascending
        first : int, optional
            Node from which they are propagated instead, from the states and tangents of `start`.
        recentres : bool
            False leaves the point of linearisation where it is at the end.
        """
        at, own = self._at, self.view(np.zeros((len(counts), self.record_size)))
        own.costs[:], own.records[:, at["parts"]], own.records[:, at["error"]] = start.costs, 1.0, 1.0
        own.records[:, at["p"]], own.moved[:] = p, start.moved
        own.gradients[:], own.matrices[:] = start.gradients, start.matrices
        if first is not None:
            own.states[:], own.tangents[:] = start.states, start.tangents
        counts = np.column_stack([counts, np.arange(len(counts))])
        return self._go_on(own.records, (children, times, counts), (first or 0, last, first is None), recentres)

    def _go_on(
        self, parents: FloatArray, births: tuple[Any, ...], places: tuple[int, int, bool], recentres: bool = True
    ) -> Hypotheses:
        """Propagate copies of records; `births` are their children, times and counts."""
        children, times, counts = map(np.ascontiguousarray, births)
        records, last = np.empty((len(counts), self.record_size)), places[1]
        addresses = map(get_address, (records, parents, children, times, counts))
        ends = last == self._cells, recentres and self._recentres
        self._propagate(self._table_at, *addresses, times.shape[1], *places, len(records), *ends)
        return self.view(records)

    def view(self, records: FloatArray) -> Hypotheses:
        """Return what records (B, size) hold, as views."""
        at, B, (n, D, width) = self._at, len(records), self._shape
        H, Z = records[:, at["H"]].reshape(B, D, width)[..., :D], records[:, at["Z"]].reshape(B, n, width)[..., :D]
        g, scores, costs = records[:, at["g"]][:, :D], records[:, at["score"].start], records[:, at["J"].start]
        return Hypotheses(scores, costs, g, H, records[:, at["moved"]], records[:, at["x"]], Z, records)
