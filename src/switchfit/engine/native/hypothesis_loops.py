"""Loops over hypotheses, cells and samples in hand-written LLVM IR, and the program that has them.

A hypothesis is a *record* of doubles, see `Record`. `advance` makes children from parents: it copies a record, changes
the mode if the child is a birth, takes it from node to node, computes its score, and moves its point of linearisation
to the minimum. `replay` propagates hypotheses anew from t0, with births at any times. If the estimate of the
integration error is too large, steps of half the length are taken from the node before: by `advance` from where it
began, by `replay` in that cell.
"""

from __future__ import annotations

import logging
import threading
from functools import lru_cache
from typing import NamedTuple

from switchfit.discretization.tableaus import STIFF
from switchfit.engine.native import llvm
from switchfit.engine.native.hypothesis_kernels import (
    BIRTH_SLOPE,
    COST,
    GUARD,
    MOVE,
    SHIFT,
    SHIFT_BACK,
    SQUARE,
    STEP,
    TRANSITION_COST,
    HypothesisKernels,
)
from switchfit.engine.native.kernels import CURVATURE, NEWTON, RESET, STAGES, START, Curvature
from switchfit.engine.native.llvm import Module, Program, literal
from switchfit.engine.native.scalars import CHECKED
from switchfit.engine.native.segments import solve_stages, write_newton
from switchfit.engine.native.templates import Order, Sizes
from switchfit.engine.native.trace import Unsupported
from switchfit.engine.native.writer import Writer
from switchfit.engine.protocol import Column
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure

log = logging.getLogger("switchfit")

_one_at_a_time = threading.Lock()

MOST_PARTS = 64
"""Largest number of steps in a cell."""

SMALL_ERROR = 1 / 64
"""Error, relative to the tolerances, at which steps of twice the length are tried next: their error is 16 times it."""

COLUMNS = len(Column)

GIVEN = (
    *("nodes", "signals", "c", "units", "tolerances", "low", "high", "most"),
    *(
        "jump_first",
        "jump_map",
        "rows",
        "reduced",
        "shift",
        "g_after",
        "slope",
        "along",
        "information",
        "XZ",
        "entries",
        "increments",
        "newton",
    ),
)
"""Pointers in the table, before those of the samples. `jump_first` (G + 2,) has the place in `jump_map` of the first
jump at each node; `low` and `high` (D,) are the bounds of `moved`, and `most` (D,) is how far it may move at once. From
`rows` on it is scratch space: the eliminated [H; g'], the entries of g as they were eliminated, and what the
straight-line functions exchange."""

OF_SAMPLES = ("first", "time", "value", "weight")
"""For each Measurements: the place of the first sample at each node (G + 2,), then as `workspace.OF_SAMPLES`."""


class Record(NamedTuple):
    """Offsets in a record, in doubles; `size` is its length.

    J : (), cost
    error : (), largest estimate of the error of a step since the last block, relative to the tolerances
    score : (), ``J - g' H^-1 g / 2``, the cost with all unknowns free, where the model is linear in them; NaN where H
        is not positive definite
    check : (), NaN once a value that was presumed finite is not
    parts : (), number of steps in a cell
    p, moved : (M,), the point of linearisation; (D,), how far the unknowns have moved there from where they began
    x, Z, g, H : (n,), (n, width), (width,), (D, width)
    """

    J: int
    error: int
    score: int
    check: int
    parts: int
    p: int
    moved: int
    x: int
    Z: int
    g: int
    H: int
    size: int

    @classmethod
    def of(cls, sizes: Sizes) -> Record:
        """Return the offsets for the sizes of a program."""
        p = 5
        moved = p + sizes.M
        x = moved + sizes.D
        Z = x + sizes.n
        g = Z + sizes.n * sizes.width
        H = g + sizes.width
        end = H + sizes.D * sizes.width
        return cls(0, 1, 2, 3, 4, p, moved, x, Z, g, H, end + -end % 4)


def scratch_sizes(sizes: Sizes) -> dict[str, int]:
    """Return the sizes of the scratch space, in doubles."""
    return {
        "rows": (sizes.D + 1) * sizes.width,
        "reduced": sizes.D,
        "shift": sizes.D,
        "g_after": sizes.width,
        "slope": sizes.n + 1,
        "along": sizes.width,
        "information": 1,
        "XZ": STAGES * sizes.n * sizes.width,
        "entries": STAGES * (1 + sizes.n + sizes.M) ** 2,
        "increments": STIFF.coupled * sizes.n,
        "newton": 2,
    }


def hypotheses_program(library: Structure, sizes: Sizes) -> Program | str:
    """Return the machine code of hypotheses of a library, or the reason why it cannot be compiled."""
    with _one_at_a_time:
        return _program_of(library, sizes)


@lru_cache(maxsize=16)
def _program_of(library: Structure, sizes: Sizes) -> Program | str:
    try:
        module = Module(sizes.width)
        with use_float64():
            _write(module, library, sizes)
        return llvm.compile_module(module.take())
    except Unsupported as error:
        log.info("No beam: %s.", error)
        return str(error)
    except Exception as error:
        log.info("No beam: internal: %s.", error, exc_info=True)
        return f"internal: {type(error).__name__}: {error}"


def _write(module: Module, library: Structure, sizes: Sizes) -> None:
    kernels = HypothesisKernels(library, sizes, Order.GAUSS_NEWTON, module)
    costs = bool(library.running or library.references)
    kernels.first()
    curvatures = []
    for mode in range(len(library.modes)):
        chosen = kernels.step(mode, costs)
        curvatures.append(kernels.share_curvature(f"curvature_{mode}", chosen, kernels.tableau(mode)))
        kernels.birth_slope(mode, costs)
    kernels.shift()
    kernels.move("move", 1.0, costs)
    kernels.move("hold", -1.0, costs)
    for which in range(len(library.reset_maps)):
        kernels.jump(which)
    for which in range(len(library.guards)):
        kernels.guard(which)
    if library.guards:
        kernels.square()
    for which in range(len(library.transition_costs)):
        kernels.transition_cost(which)
    for k in range(len(library.measurements)):
        kernels.sample_cost(k)
    if library.terminal:
        kernels.end_cost()
    writer = HypothesisWriter(library, sizes, kernels, module)
    for mode in (mode for mode, implicit in enumerate(library.implicit) if implicit):
        module.add(write_newton(writer, f"newton_{mode}", NEWTON))
    for text in (
        writer.write_node(),
        writer.write_score(),
        writer.write_recentre(),
        writer.write_birth(),
        writer.write_steps(curvatures),
        writer.write_begin(),
        writer.write_copy(),
        writer.write_advance(),
        writer.write_replay(),
    ):
        module.add(text)


class HypothesisWriter(Writer):
    """Emits the loops of hypotheses."""

    def __init__(self, library: Structure, sizes: Sizes, kernels: HypothesisKernels, module: Module) -> None:
        super().__init__(library, sizes, Order.GAUSS_NEWTON, kernels, module)
        own = (f"{name}_{k}" for k in range(len(library.measurements)) for name in OF_SAMPLES)
        self.names = (*GIVEN, *own)
        self.record = Record.of(sizes)

    def fields(self, record: str) -> dict[str, str]:
        """Emit the addresses of the fields of a record."""
        at = self.record
        names = ("J", "error", "p", "moved", "x", "Z", "g", "H")
        places = {name: getattr(at, name) for name in names} | {CHECKED: at.check}
        return {name: self.at(record, place) for name, place in places.items()}

    def _child(self, child: str, column: Column) -> str:
        return self.load("i64", self.at(child, int(column)))

    def write_node(self) -> str:
        """Write what happens at a node: samples add their costs, then jumps at known times act."""
        width = self.sizes.width
        found = self.pointers() | self.fields("%record")
        # Nodes are at known times: `moves` is the row of zeros. A jump maps x and Z in place.
        found |= {"moves": self.at(found["units"], 0, width), "x_after": found["x"], "Z_after": found["Z"]}
        found["time"] = self.at(found["nodes"], "%node")
        after = self.let("add i64 %node, 1")
        for k, sensor in enumerate(self.library.measurements):
            here = {name: found[f"{name}_{k}"] for name in OF_SAMPLES}
            begin, end = (self.load("i64", self.at(here["first"], node)) for node in ("%node", after))
            with self.loop(begin, end) as place:
                given = found | {"time": self.at(here["time"], place)}
                given |= {name: self.at(here[name], place, sensor.channels) for name in ("value", "weight")}
                self.call(f"sample_{k}", COST, given)
        if self.library.reset_maps:
            begin, end = (self.load("i64", self.at(found["jump_first"], node)) for node in ("%node", after))
            with self.loop(begin, end) as place:
                # Jumps come after the samples: a sample at the time of a jump sees the state before it.
                which = self.load("i64", self.at(found["jump_map"], place))
                for k in self.cases(which, len(self.library.reset_maps), "jump"):
                    self.call(f"reset_{k}", RESET, found)
        return self.end_function("void @at_node(ptr %table, ptr %record, i64 %node)")

    def write_score(self) -> str:
        """Write the elimination of all unknowns from ``J + g'd + d'H d / 2``, row by row of [H; g']."""
        D, width = self.sizes.D, self.sizes.width
        vector = self.module.vector
        found = self.pointers() | self.fields("%record")
        W, at = found["rows"], self.record
        # L D L' of [H; g'] on a copy W (D + 1, width). For k = 0 .. D - 1, with the pivot W_kk and the slope W_Dk:
        #     score -= slope^2 / (2 pivot),  reduced_k = slope,  W_i -= (W_ik / pivot) W_k for the rows i = k + 1 .. D
        # so that after all k the score is J - g' H^-1 g / 2. H needs no pivoting: H_0 makes it positive definite.
        rows = [(self.at(found["H"], k * width), self.at(W, k * width)) for k in range(D)]
        for source, target in [*rows, (found["g"], self.at(W, D * width))]:
            value = self.let(f"load {vector}, ptr {source}, align 8")
            self.line(f"store {vector} {value}, ptr {target}, align 8")
        J = self.load("double", found["J"])
        last = self.at(W, D * width)
        self.line("br label %outer")
        self.label("outer")
        self.line("%k = phi i64 [0, %entry], [%next, %eliminated]")
        self.line(f"%before = phi double [{J}, %entry], [%total, %eliminated]")
        row = self.at(W, "%k", width)
        pivot = self.load("double", self.at(row, "%k"))
        slope = self.load("double", self.at(last, "%k"))
        # `recentre` solves backward from the slopes as they were when their unknown was eliminated: W_D is overwritten.
        self.line(f"store double {slope}, ptr {self.at(found['reduced'], '%k')}")
        inverse = self.let(f"fdiv double {literal(1.0)}, {pivot}")
        square = self.let(f"fmul double {slope}, {slope}")
        gain = self.let(f"fmul double {self.let(f'fmul double {square}, {inverse}')}, {literal(0.5)}")
        # A pivot that is not positive, or NaN, makes the score NaN: the hypothesis drops out when the lowest are
        # selected.
        positive = self.let(f"fcmp ogt double {pivot}, {literal(0.0)}")
        lower = self.let(f"fsub double %before, {gain}")
        self.line(f"%total = select i1 {positive}, double {lower}, double {literal(float('nan'))}")
        # Whole rows are subtracted as vectors: what becomes of the columns before k is never read.
        own = self.let(f"load {vector}, ptr {row}, align 8")
        self.line("%next = add i64 %k, 1")
        self.line("br label %inner")
        self.label("inner")
        self.line("%i = phi i64 [%next, %outer], [%following, %inner]")
        other = self.at(W, "%i", width)
        factor = self.let(f"fmul double {self.load('double', self.at(other, '%k'))}, {inverse}")
        product = self.let(f"fmul contract {vector} {self.spread(factor, width)}, {own}")
        new = self.let(f"fsub contract {vector} {self.load(vector, other)}, {product}")
        self.store(vector, new, other)
        self.line("%following = add i64 %i, 1")
        self.line(f"%more = icmp sle i64 %following, {D}")
        self.line("br i1 %more, label %inner, label %eliminated")
        self.label("eliminated")
        self.line(f"%again = icmp slt i64 %next, {D}")
        self.line("br i1 %again, label %outer, label %out")
        self.label("out")
        # The check is 0 or NaN.
        checked = self.let(f"fadd double %total, {self.load('double', found[CHECKED])}")
        self.line(f"store double {checked}, ptr {self.at('%record', at.score)}")
        return self.end_function("void @score(ptr %table, ptr %record)")

    def write_recentre(self) -> str:
        """Write the change of the point of linearisation to the minimum of the cost, inside its bounds.

        It follows from the rows that `score` has eliminated. Those of p are the last: birth times are the best for p
        inside its bounds.
        """
        D, width = self.sizes.D, self.sizes.width
        found = self.pointers() | self.fields("%record")
        score = self.load("double", self.at("%record", self.record.score))
        # Only where the score is a number: W has been eliminated then.
        there = self.let(f"fcmp ord double {score}, {score}")
        self.line(f"br i1 {there}, label %begin, label %out")
        self.label("begin")
        self.line("br label %outer")
        self.label("outer")
        # Backward from the last unknown: step_k = (reduced_k + sum_{j > k} W_kj shift_j) / W_kk, whose shift_j are
        # final. So an unknown at its limit is a limit for those before it: the birth times are the best for the p that
        # was possible.
        self.line(f"%k = phi i64 [{D - 1}, %begin], [%less, %solved]")
        row = self.at(found["rows"], "%k", width)
        own = self.load("double", self.at(found["reduced"], "%k"))
        self.line("%behind = add i64 %k, 1")
        self.line("br label %sum")
        self.label("sum")
        self.line("%j = phi i64 [%behind, %outer], [%j_next, %add]")
        self.line(f"%total = phi double [{own}, %outer], [%total_next, %add]")
        self.line(f"%inside = icmp slt i64 %j, {D}")
        self.line("br i1 %inside, label %add, label %solved")
        self.label("add")
        factor, other = self.load("double", self.at(row, "%j")), self.load("double", self.at(found["shift"], "%j"))
        self.line(f"%total_next = fadd double %total, {self.let(f'fmul double {factor}, {other}')}")
        self.line("%j_next = add i64 %j, 1")
        self.line("br label %sum")
        self.label("solved")
        step = self.let(f"fdiv double %total, {self.load('double', self.at(row, '%k'))}")
        moved, low, high, most = (
            self.load("double", self.at(found[name], "%k")) for name in ("moved", "low", "high", "most")
        )
        # First the limit of one move, then the bounds, which hold in any case.
        target = self.let(f"fsub double {moved}, {step}")
        least, largest = self.let(f"fsub double {moved}, {most}"), self.let(f"fadd double {moved}, {most}")
        for bound, condition in ((least, "olt"), (largest, "ogt"), (low, "olt"), (high, "ogt")):
            outside = self.let(f"fcmp {condition} double {target}, {bound}")
            target = self.let(f"select i1 {outside}, double {bound}, double {target}")
        self.line(f"store double {self.let(f'fsub double {target}, {moved}')}, ptr {self.at(found['shift'], '%k')}")
        self.line("%less = sub i64 %k, 1")
        self.line("%more = icmp sge i64 %less, 0")
        self.line("br i1 %more, label %outer, label %shifting")
        self.label("shifting")
        self.call("shift", SHIFT, found)
        self.call("shift_back", SHIFT_BACK, found)
        self.line("br label %out")
        self.label("out")
        return self.end_function("void @recentre(ptr %table, ptr %record)")

    def write_birth(self) -> str:
        """Write a change of mode at a time inside a cell, or at its first node.

        With tau the time of the change, x(tau-) moves by f_before dtau. The cost and the reset map of the transition
        are differentiated along that, and at a fixed time after it the state moves by ``- f_after dtau`` more: without
        a reset map the derivative along tau is ``f_before - f_after``.
        """
        S, width = self.sizes.signals, self.sizes.width
        self.line("%row = alloca [3 x double]")
        found = self.pointers() | self.fields("%record")
        node = self.load("double", self.at(found["nodes"], "%cell"))
        # A row without length: start, end and first node of the cell, for functions that read their time from it.
        for k, value in enumerate(("%time", "%time", node)):
            self.line(f"store double {value}, ptr {self.at('%row', k)}")
        # Row 0 of `units` is zero: the unit vector of birth time k is row k + 1.
        slot = self.let(f"add i64 {self._child('%child', Column.SLOT)}, 1")
        found |= {"row": "%row", "time": "%row", "signal": self.at(found["signals"], "%cell", 4 * S)}
        found |= {"moves": self.at(found["units"], slot, width)}
        found |= {"x_after": found["x"], "Z_after": found["Z"], "value": found["x"], "weight": found["x"]}
        # Z += f_before dtau: from here to "hold", Z and g are those at the time of the birth, which moves.
        self._call_mode(found, Column.BEFORE, "leave")
        self.call("move", MOVE, found)
        if self.library.guards:
            for k in self.cases(self._child("%child", Column.GUARD), len(self.library.guards), "guard"):
                self.call(f"guard_{k}", GUARD, found)
                self.call("square", SQUARE, found)
        if self.library.transition_costs:
            which = self._child("%child", Column.TRANSITION_COST)
            for k in self.cases(which, len(self.library.transition_costs), "cost"):
                self.call(f"transition_cost_{k}", TRANSITION_COST, found)
        if self.library.reset_maps:
            for k in self.cases(self._child("%child", Column.RESET_MAP), len(self.library.reset_maps), "reset"):
                self.call(f"reset_{k}", RESET, found)
        # Z -= f_after dtau at the state behind the reset map: back to derivatives at a fixed time. Without a reset map
        # the column of this birth is now X^i, (8) of the paper, and all others are as before.
        self._call_mode(found, Column.AFTER, "enter")
        self.call("hold", MOVE, found)
        return self.end_function("void @birth(ptr %table, ptr %record, ptr %child, i64 %cell, double %time)")

    def _call_mode(self, found: dict[str, str], column: Column, name: str) -> None:
        """Emit the call of the slope of the mode in a column of the child."""
        for k in self.cases(self._child("%child", column), len(self.library.modes), name):
            self.call(f"slope_{k}", BIRTH_SLOPE, found)

    def write_steps(self, curvatures: list[Curvature]) -> str:
        """Write steps in a mode between two times of a cell."""
        n, S, width = self.sizes.n, self.sizes.signals, self.sizes.width
        self.line("%row = alloca [3 x double]")
        found = self.pointers() | self.fields("%record")
        node = self.load("double", self.at(found["nodes"], "%cell"))
        self.line(f"store double {node}, ptr {self.at('%row', 2)}")
        length = self.let("fsub double %end, %begin")
        count = self.let("sitofp i64 %parts to double")
        found |= {"row": "%row", "signal": self.at(found["signals"], "%cell", 4 * S)}
        self.line("br label %loop")
        self.label("loop")
        self.line("%part = phi i64 [0, %entry], [%next, %step_end]")
        self.line("%start = phi double [%begin, %entry], [%stop, %step_end]")
        self.line("%next = add i64 %part, 1")
        # Ends of steps are begin + length k / parts, and the last one is `end` itself: sums of steps would miss the
        # node.
        share = self.let(f"fdiv double {self.let('sitofp i64 %next to double')}, {count}")
        inside = self.let(f"fadd double %begin, {self.let(f'fmul double {length}, {share}')}")
        self.line("%done = icmp sge i64 %next, %parts")
        self.line(f"%stop = select i1 %done, double %end, double {inside}")
        for k, value in enumerate(("%start", "%stop")):
            self.line(f"store double {value}, ptr {self.at('%row', k)}")
        for mode in self.cases("%mode", len(self.library.modes), "step"):
            solve_stages(self, mode, found)
            self.call(f"step_{mode}", STEP, found)
            name, size, stages = curvatures[mode]
            for j in stages:
                given = {"entries": self.at(found["entries"], j * size), "XZ": self.at(found["XZ"], j * n * width)}
                # Ends of steps do not move with theta.
                unmoved = {"opens": found["units"], "closes": found["units"]}
                self.call(name, CURVATURE, found | given | unmoved)
        self.line("br i1 %done, label %out, label %loop")
        self.label("out")
        settings = "i64 %mode, i64 %cell, i64 %parts, double %begin, double %end"
        return self.end_function(f"void @steps(ptr %table, ptr %record, {settings})")

    def write_copy(self) -> str:
        """Write the copy of a record."""
        # Records are padded to a multiple of four doubles.
        with self.loop("0", str(self.record.size), 4) as k:
            self.store("<4 x double>", self.load("<4 x double>", self.at("%source", k)), self.at("%target", k))
        # A copy begins an attempt: its largest error is that of the steps to come.
        self.line(f"store double {literal(0.0)}, ptr {self.at('%target', self.record.error)}")
        return self.end_function("void @copy(ptr %source, ptr %target)")

    def write_begin(self) -> str:
        """Write the start of a record whose J, g and H are those of the priors: x(t0), and the samples there."""
        found = self.pointers() | self.fields("%record")
        self.call("start", START, found)
        self.line("call void @at_node(ptr %table, ptr %record, i64 0)")
        self.line("call void @score(ptr %table, ptr %record)")
        return self.end_function("void @begin(ptr %table, ptr %record)")

    def write_advance(self) -> str:
        """Write the loop over children: from parents at one node to their records at another."""
        # each record: attempt: copy the parent -> birth -> cells first .. last -> judge -> again with twice the steps,
        # or accept
        self._open_records("%children", COLUMNS)
        child = "%own"
        source = self.at("%parents", self._child(child, Column.PARENT), self.record.size)
        slot, after = self._child(child, Column.SLOT), self._child(child, Column.AFTER)
        self._open_attempt(source)
        # Without a birth the child is its parent, further along.
        is_birth = self.let(f"icmp sge i64 {slot}, 0")
        self.line(f"br i1 {is_birth}, label %born, label %moving")
        self.label("born")
        time = self.load("double", self.at(self.load("ptr", self.at("%table", 0)), "%first"))
        self.line(f"call void @birth(ptr %table, ptr %record, ptr {child}, i64 %first, double {time})")
        self.line("br label %moving")
        self.label("moving")
        self.line("br label %cell")
        self.label("cell")
        self.line("%here = phi i64 [%first, %moving], [%there, %cell]")
        self.line("%there = add i64 %here, 1")
        nodes = self.load("ptr", self.at("%table", 0))
        begin, end = (self.load("double", self.at(nodes, k)) for k in ("%here", "%there"))
        given = f"i64 {after}, i64 %here, i64 %parts, double {begin}, double {end}"
        self.line(f"call void @steps(ptr %table, ptr %record, {given})")
        self.line("call void @at_node(ptr %table, ptr %record, i64 %there)")
        self.line("%arrived = icmp sge i64 %there, %last")
        self.line("br i1 %arrived, label %judge, label %cell")
        self._close_attempt()
        return self._close_records("advance", "ptr %children, ptr %parents", "i64 %first, i64 %last")

    def write_replay(self) -> str:
        """Write the loop over hypotheses that are propagated anew from a node, with births at any times.

        Each cell has the steps that it needs: where the estimate of the error is too large, it alone begins again.

        The records of `%parents` have p, moved, and the J, g and H of the priors there; unless `%restarts`, which is
        only possible at the first node, also x and Z, and the samples of the node are in J, g and H. `%children` (B,
        births, columns) are the births of each, `%times` (B, births) when they are, `%counts` (B, 2) their number and
        the first mode.
        """
        births, error = self.sizes.N, self.record.error
        self.line(f"%before = alloca [{self.record.size} x double]")
        # each record: cell: save it in `before` -> attempt: restore it -> inside: steps to the next birth while one is
        # in this cell -> cross: steps to the end of the cell -> again with twice the steps, or crossed: samples, next
        # cell
        self._open_records("%counts", 2)
        count, mode = self.load("i64", self.at("%own", 0)), self.load("i64", self.at("%own", 1))
        source = self.at("%parents", "%index", self.record.size)
        children, times = self.at("%children", "%index", births * COLUMNS), self.at("%times", "%index", births)
        self.line(f"call void @copy(ptr {source}, ptr %record)")
        found = self.pointers() | self.fields("%record")
        restarts = self.let("icmp ne i64 %restarts, 0")
        self.line(f"br i1 {restarts}, label %start, label %begin")
        self.label("start")
        self.call("start", START, found)
        self.line("call void @at_node(ptr %table, ptr %record, i64 0)")
        self.line("br label %begin")
        self.label("begin")
        self.line("br label %cell")
        self.label("cell")
        # Carried from cell to cell: node, births so far, mode, steps in a cell. Inside an attempt births and mode are
        # its own, so that another attempt begins with those of the cell.
        self.line("%here = phi i64 [%first, %begin], [%there, %crossed]")
        self.line("%birth_of_cell = phi i64 [0, %begin], [%birth, %crossed]")
        self.line(f"%mode_of_cell = phi i64 [{mode}, %begin], [%mode, %crossed]")
        self.line("%parts_of_cell = phi i64 [1, %begin], [%parts_after, %crossed]")
        self.line("%there = add i64 %here, 1")
        begin, end = (self.load("double", self.at(found["nodes"], k)) for k in ("%here", "%there"))
        self.line("call void @copy(ptr %record, ptr %before)")
        self.line("br label %attempt")
        self.label("attempt")
        self.line("%parts = phi i64 [%parts_of_cell, %cell], [%twice, %again]")
        self.line("call void @copy(ptr %before, ptr %record)")
        self.line("br label %inside")
        self.label("inside")
        self.line("%birth = phi i64 [%birth_of_cell, %attempt], [%birth_next, %change]")
        self.line("%mode = phi i64 [%mode_of_cell, %attempt], [%mode_next, %change]")
        self.line(f"%from = phi double [{begin}, %attempt], [%tau, %change]")
        self.line(f"%is_left = icmp slt i64 %birth, {count}")
        self.line("br i1 %is_left, label %look, label %cross")
        self.label("look")
        self.line(f"%tau = load double, ptr {self.at(times, '%birth')}")
        # A birth exactly at the end of the cell belongs to the next one, behind the samples of that node.
        self.line(f"%is_here = fcmp olt double %tau, {end}")
        self.line("br i1 %is_here, label %change, label %cross")
        self.label("change")
        step = "i64 %mode, i64 %here, i64 %parts, double %from, double"
        self.line(f"call void @steps(ptr %table, ptr %record, {step} %tau)")
        child = self.at(children, "%birth", COLUMNS)
        self.line(f"call void @birth(ptr %table, ptr %record, ptr {child}, i64 %here, double %tau)")
        self.line(f"%mode_next = load i64, ptr {self.at(child, int(Column.AFTER))}")
        self.line("%birth_next = add i64 %birth, 1")
        self.line("br label %inside")
        self.label("cross")
        self.line(f"call void @steps(ptr %table, ptr %record, {step} {end})")
        estimated = self.load("double", self.at("%record", error))
        good = self.let(f"fcmp ole double {estimated}, {literal(1.0)}")
        most = self.let(f"icmp sge i64 %parts, {MOST_PARTS}")
        self.line(f"br i1 {self.let(f'or i1 {good}, {most}')}, label %crossed, label %again")
        self.label("again")
        self.line("%twice = mul i64 %parts, 2")
        self.line("br label %attempt")
        self.label("crossed")
        # The next cell begins with half as many steps where this one was far more accurate than it has to be.
        small = self.let(f"fcmp olt double {estimated}, {literal(SMALL_ERROR)}")
        several = self.let("icmp sgt i64 %parts, 1")
        half = self.let("lshr i64 %parts, 1")
        fewer = self.let(f"and i1 {small}, {several}")
        self.line(f"%parts_after = select i1 {fewer}, i64 {half}, i64 %parts")
        self.line("call void @at_node(ptr %table, ptr %record, i64 %there)")
        self.line("%arrived = icmp sge i64 %there, %last")
        self.line("br i1 %arrived, label %accepted, label %cell")
        self.label("accepted")
        taken = self.let("sitofp i64 %parts to double")
        self.line(f"store double {taken}, ptr {self.at('%record', self.record.parts)}")
        places = "i64 %first, i64 %last, i64 %restarts"
        return self._close_records("replay", "ptr %children, ptr %times, ptr %counts, ptr %parents", places)

    def _open_records(self, table: str, columns: int) -> None:
        """Begin the loop over records: `%record` from `%own`, its row of a table."""
        self.line("br label %each")
        self.label("each")
        self.line("%index = phi i64 [%first_record, %entry], [%next_record, %scored]")
        self.line(f"%row = mul i64 %index, {columns}")
        self.line(f"%own = getelementptr inbounds double, ptr {table}, i64 %row")
        self.line(f"%offset = mul i64 %index, {self.record.size}")
        self.line("%record = getelementptr inbounds double, ptr %records, i64 %offset")

    def _open_attempt(self, source: str) -> None:
        """Begin the loop over attempts with more steps in a cell each, which begin with the record at `source`."""
        at, one = self.record, literal(1.0)
        # As many steps as the parent needed, or half of them; parts are doubles, since a record has nothing else.
        before = self.load("double", self.at(source, at.parts))
        small = self.let(f"fcmp olt double {self.load('double', self.at(source, at.error))}, {literal(SMALL_ERROR)}")
        fewer = self.let(f"fmul double {before}, {literal(0.5)}")
        least = self.let(f"select i1 {small}, double {fewer}, double {before}")
        enough = self.let(f"fcmp ogt double {least}, {one}")
        parts = self.let(f"fptosi double {self.let(f'select i1 {enough}, double {least}, double {one}')} to i64")
        self.line("br label %attempt")
        self.label("attempt")
        self.line(f"%parts = phi i64 [{parts}, %each], [%twice, %again]")
        self.line(f"call void @copy(ptr {source}, ptr %record)")

    def _close_attempt(self) -> None:
        """End an attempt: accept it, or begin another with twice as many steps."""
        at = self.record
        self.label("judge")
        # The error is the largest of all cells: where one of them is too large, all get steps of half the length.
        good = self.let(f"fcmp ole double {self.load('double', self.at('%record', at.error))}, {literal(1.0)}")
        # NaN fails the comparison too: such a hypothesis tries up to the most, then its score is NaN.
        most = self.let(f"icmp sge i64 %parts, {MOST_PARTS}")
        self.line(f"br i1 {self.let(f'or i1 {good}, {most}')}, label %accepted, label %again")
        self.label("again")
        self.line("%twice = mul i64 %parts, 2")
        self.line("br label %attempt")
        self.label("accepted")
        self.line(f"store double {self.let('sitofp i64 %parts to double')}, ptr {self.at('%record', at.parts)}")

    def _close_records(self, name: str, given: str, places: str) -> str:
        """End the loop over records with their scores."""
        ends = self.let("icmp ne i64 %at_end, 0")
        self.line(f"br i1 {ends}, label %ending, label %scoring")
        self.label("ending")
        if self.library.terminal:
            table = self.pointers()
            # The cost of the end has no sample: these pointers are passed and not read.
            unused = {"time": "nodes", "moves": "units", "value": "nodes", "weight": "nodes"}
            at_end = table | self.fields("%record") | {key: table[value] for key, value in unused.items()}
            self.call("end", COST, at_end)
        self.line("br label %scoring")
        self.label("scoring")
        self.line("call void @score(ptr %table, ptr %record)")
        self.line(f"br i1 {self.let('icmp ne i64 %recentres, 0')}, label %recentring, label %scored")
        self.label("recentring")
        self.line("call void @recentre(ptr %table, ptr %record)")
        self.line("br label %scored")
        self.label("scored")
        self.line("%next_record = add i64 %index, 1")
        self.line("%all = icmp sge i64 %next_record, %end_record")
        self.line("br i1 %all, label %out, label %each")
        self.label("out")
        settings = "i64 %first_record, i64 %end_record, i64 %at_end, i64 %recentres"
        return self.end_function(f"void @{name}(ptr %table, ptr %records, {given}, {places}, {settings})")
