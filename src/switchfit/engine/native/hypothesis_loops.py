"""Loops over hypotheses, cells, samples and births in hand-written LLVM IR, and the program that has them.

A hypothesis is a *record* of doubles. `propagate` takes it from node to node, changes its mode at births, computes its
score, and moves its point of linearisation to the minimum; `follow_order` does so for a given order of modes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from switchfit.engine.hypotheses import Column
from switchfit.engine.native import program_cache
from switchfit.engine.native.hypothesis_kernels import HypothesisKernels
from switchfit.engine.native.hypothesis_memory import (
    COLUMN_COUNT,
    HYPOTHESIS_POINTERS,
    HYPOTHESIS_SAMPLE_POINTERS,
    PER_PLACE,
    WINDOW,
    divide_record,
    measure_record,
    scratch_sizes,
)
from switchfit.engine.native.kernels import CurvatureFunction
from switchfit.engine.native.llvm.compilation import Program
from switchfit.engine.native.llvm.lines import Value, Variable
from switchfit.engine.native.llvm.module import Module
from switchfit.engine.native.loops import adaptive_steps, segments
from switchfit.engine.native.loops.writer import Pointers, Writer
from switchfit.engine.native.scalars.graph import CHECKED
from switchfit.engine.native.sizes import Order, Sizes
from switchfit.problem.structure import Structure

MOST_PARTS = 64
"""Largest number of steps in a cell."""

SMALL_ERROR = 1 / 64
"""Error, relative to the tolerances, at which steps of twice the length are tried next: their error is 16 times it."""


class HypothesisWriter(Writer):
    """Emits the loops of hypotheses."""

    def __init__(self, library: Structure, sizes: Sizes, module: Module) -> None:
        super().__init__(library, sizes, Order.GAUSS_NEWTON, module)
        own = (f"{name} {k}" for k in range(len(library.measurements)) for name in HYPOTHESIS_SAMPLE_POINTERS)
        self.names = (*HYPOTHESIS_POINTERS, *scratch_sizes(sizes), *own)

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

    def write_steps(self, curvatures: list[CurvatureFunction]) -> str:
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
                segments.add_curvature(self, curvatures[k], found, moving=False)
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
            of_times, of_births = self.at(times, index, births), self.at(children, index, births * COLUMN_COUNT)
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
                        child = self.at(of_births, birth.value, COLUMN_COUNT)
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
                        birth, before = self.at(children, place, COLUMN_COUNT), self.at(records, parent, size)
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
    return program_cache.compile_library(library, sizes, (Order.GAUSS_NEWTON,), _write)


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
        adaptive_steps.write_slope(kernels, mode, stage)
    kernels.shift()
    kernels.move("move", 1.0, costs)
    kernels.move("hold", -1.0, costs)
    kernels.nodes()
    writer = HypothesisWriter(library, sizes, module)
    for mode in (mode for mode, implicit in enumerate(library.implicit) if implicit):
        module.add(segments.write_newton(writer, f"newton_{mode}"))
    module.add(writer.write_steps(curvatures))
    module.add(writer.write_node())
    module.add(writer.write_score())
    module.add(writer.write_birth())
    module.add(writer.write_propagation())
    module.add(writer.write_following())
    yield module.take()
