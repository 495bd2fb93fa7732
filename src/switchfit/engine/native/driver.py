"""The loops around the straight lines of `switchfit.engine.native.kernels`, in LLVM's language, written by hand.

Rows are numbered by ``cell + segment``: each transition cuts one cell in two.

Python hears Ctrl-C only between two calls. Loops therefore stop when a budget is spent, and go on where they stopped
when they are called again. `PROGRESS` is what they leave in memory between two calls: three integers, the phase of the
evaluation (-1 at its end), how many turns of the loop in it are done, and what is left of the budget (`llvm.BUDGET`).
"""

from __future__ import annotations

from typing import Any

from scipy.integrate import RK45

from switchfit.engine.native.kernels import (
    ADAPTIVE,
    BACKWARD,
    CURVATURE,
    END,
    FORWARD,
    LENGTH,
    OUTPUTS,
    RESET,
    RESET_BACK,
    SAMPLE,
    SLOPE,
    STAGES,
    START,
    START_BACK,
    STATES,
    Adaptive,
    Sizes,
)
from switchfit.engine.native.llvm import BUDGET, Module, literal
from switchfit.engine.native.scalars import CHECKED
from switchfit.problem.structure import Structure

POINTERS = (
    *("nodes", "signals", "c", "p", "tau", "first_cell", "states", "tangents", "stages", "stage_tangents", "jumps"),
    *("units", "psi", "J", "g", "H", "reset_states", "reset_tangents", "entries", "length", CHECKED),
)
"""What the driver finds in its table of pointers; then four for each Measurements: cell, time, value, weight."""


class Driver:
    """The loops around the straight lines, written by hand."""

    def __init__(self, structure: Structure, sizes: Sizes, order: int, module: Module) -> None:
        self.structure, self.sizes, self.order, self.module = structure, sizes, order, module
        self.lines: list[str] = []
        self.count = 0

    def line(self, text: str) -> None:
        """One more line."""
        self.lines.append(f"  {text}")

    def let(self, text: str) -> str:
        """One more line with a value: its name."""
        self.count += 1
        self.line(f"%t{self.count} = {text}")
        return f"%t{self.count}"

    def at(self, pointer: str, *factors: Any) -> str:
        """Address of ``pointer[product of the factors]``, in doubles."""
        offset = str(factors[0])
        for factor in factors[1:]:
            offset = self.let(f"mul i64 {offset}, {factor}")
        return self.let(f"getelementptr inbounds double, ptr {pointer}, i64 {offset}")

    def pointers(self) -> dict[str, str]:
        """All pointers of the table, loaded."""
        found = {}
        for k, name in enumerate(POINTERS):
            found[name] = self.let(f"load ptr, ptr {self.at('%table', k)}")
        return found

    def into(self, pointer: str, offset: int) -> str:
        """Address of a byte behind a pointer."""
        return self.let(f"getelementptr inbounds i8, ptr {pointer}, i64 {offset}")

    def call(self, name: str, order: tuple[str, ...], given: dict[str, str]) -> None:
        """Call a straight line with its pointers in order."""
        self.line(f"call void @{name}({', '.join(f'ptr {given[key]}' for key in order)})")

    def resumed(self) -> tuple[str, str]:
        """How many turns of a loop are done, and what is left of the budget, when its function is called."""
        places = (self.let(f"getelementptr inbounds i64, ptr %progress, i64 {k}") for k in (1, 2))
        turns, left = (self.let(f"load i64, ptr {place}") for place in places)
        return turns, left

    def next_turn(self, turns: str, done: str) -> None:
        """End a turn of a loop: leave it if it is `done`, return if the budget is spent, else start the next one.

        The loop has the label `loop`, this block the label `next`. `%left` is what is left after this turn.
        """
        self.line(f"%turns = add i64 {turns}, 1")
        self.line("%spent = icmp sle i64 %left, 0")
        self.line(f"%stop = or i1 {done}, %spent")
        self.line("br i1 %stop, label %out, label %loop")
        self.lines.append("out:")
        self.line(f"%place = select i1 {done}, i64 0, i64 %turns")
        for k, value in ((1, "%place"), (2, "%left")):
            place = self.let(f"getelementptr inbounds i64, ptr %progress, i64 {k}")
            self.line(f"store i64 {value}, ptr {place}")
        self.line(f"ret i1 {done}")

    def finished(self, signature: str, returns: bool = True) -> str:
        """The lines since the last function as a function, with a return at its end unless it has one."""
        end = "\n  ret void" if returns else ""
        text = f"define {signature} {{\nentry:\n" + "\n".join(self.lines) + f"{end}\n}}\n"
        self.lines, self.count = [], 0
        return text

    def _row(self, found: dict[str, str], cell: str) -> dict[str, str]:
        """Times, signals and directions of the row of a segment in a cell, and whether it is an end row."""
        N, S, width = self.sizes.N, self.sizes.signals, self.sizes.width
        first, last = self.let(f"icmp eq i64 {cell}, %first"), self.let(f"icmp eq i64 {cell}, %last")
        here = self.let(f"load double, ptr {self.at(found['nodes'], cell)}")
        after = self.let(f"add i64 {cell}, 1")
        there = self.let(f"load double, ptr {self.at(found['nodes'], after)}")
        start = self.let(f"select i1 {first}, double %begins, double {here}")
        end = self.let(f"select i1 {last}, double %finishes, double {there}")
        for k, value in enumerate((start, end, here)):
            self.line(f"store double {value}, ptr {self.at('%row', k)}")
        later, earlier = self.let("icmp sgt i64 %segment, 0"), self.let(f"icmp slt i64 %segment, {N}")
        opens, closes = self.let(f"and i1 {first}, {later}"), self.let(f"and i1 {last}, {earlier}")
        next_ = self.let("add i64 %segment, 1")
        opening, closing = (
            self.at(found["units"], self.let(f"select i1 {flag}, i64 {index}, i64 0"), width)
            for flag, index in ((opens, "%segment"), (closes, next_))
        )
        return {
            "row": "%row",
            "signal": self.at(found["signals"], cell, 4 * S),
            "opens": opening,
            "closes": closing,
            "first": first,
            "end row": self.let(f"or i1 {opens}, {closes}"),
        }

    def _at_row(self, found: dict[str, str], row: str) -> dict[str, str]:
        n, width = self.sizes.n, self.sizes.width
        return {
            "X": self.at(found["stages"], row, STAGES * n),
            "XZ": self.at(found["stage_tangents"], row, STAGES * n * width),
        }

    def forward_segment(self, mode: int) -> str:
        """All rows of a segment, forward."""
        n, width = self.sizes.n, self.sizes.width
        self.line("%row = alloca [3 x double]")
        found = self.pointers()
        before, left = self.resumed()
        self.line(f"%start = add i64 %first, {before}")
        self.line("br label %loop")
        self.lines.append("loop:")
        self.line("%cell = phi i64 [%start, %entry], [%more, %next]")
        self.line(f"%budget = phi i64 [{left}, %entry], [%left, %next]")
        place = self._row(found, "%cell")
        row = self.let("add i64 %cell, %segment")
        after = self.let(f"add i64 {row}, 1")
        x = self.let(f"select i1 {place['first']}, ptr %x, ptr {self.at(found['states'], row, n)}")
        Z = self.let(f"select i1 {place['first']}, ptr %Z, ptr {self.at(found['tangents'], row, n * width)}")
        given = found | place | self._at_row(found, row) | {"x": x, "Z": Z}
        given |= {
            "x_after": self.at(found["states"], after, n),
            "Z_after": self.at(found["tangents"], after, n * width),
        }
        self.line(f"br i1 {place['end row']}, label %is_end, label %is_inner")
        self.lines.append("is_end:")
        self.call(f"forward_end_{mode}", FORWARD, given)
        self.line("br label %next")
        self.lines.append("is_inner:")
        self.call(f"forward_inner_{mode}", FORWARD, given)
        self.line("br label %next")
        work = {kind: self.module.work(f"forward_{kind}_{mode}") for kind in ("end", "inner")}
        self.lines.append("next:")
        self.line(f"%work = phi i64 [{work['end']}, %is_end], [{work['inner']}, %is_inner]")
        self.line("%left = sub i64 %budget, %work")
        self.line("%more = add i64 %cell, 1")
        self.line("%done = icmp sgt i64 %more, %last")
        self.next_turn(self.let("sub i64 %cell, %first"), "%done")
        return self.finished(f"internal i1 @forward_{mode}({SEGMENT}, ptr %x, ptr %Z)", returns=False)

    def backward_segment(self, mode: int, inner: int, end: int) -> str:
        """All rows of a segment, backward; with the numbers of entries of the second derivatives."""
        n, width = self.sizes.n, self.sizes.width
        self.line("%row = alloca [3 x double]")
        found = self.pointers()
        before, left = self.resumed()
        self.line(f"%start = sub i64 %last, {before}")
        self.line("br label %loop")
        self.lines.append("loop:")
        self.line("%cell = phi i64 [%start, %entry], [%less, %next]")
        self.line(f"%budget = phi i64 [{left}, %entry], [%left, %next]")
        place = self._row(found, "%cell")
        row = self.let("add i64 %cell, %segment")
        after = self.let(f"add i64 {row}, 1")
        given = found | place | self._at_row(found, row) | {"jump": self.at(found["jumps"], after, n)}
        self.line(f"br i1 {place['end row']}, label %is_end, label %is_inner")
        work = {}
        for kind, count in (("end", end + 1), ("inner", inner)):
            self.lines.append(f"is_{kind}:")
            self.call(f"backward_{kind}_{mode}", BACKWARD, given)
            work[kind] = self.module.work(f"backward_{kind}_{mode}")
            if self.order == 2:
                if kind == "end":
                    self.call("length", LENGTH, given)
                for j in range(0, STAGES, self.sizes.stages_at_once):
                    at_stage = {
                        "entries": self.at(found["entries"], j * count),
                        "XZ": self.at(given["XZ"], j * n * width),
                    }
                    self.call(f"curvature_{kind}_{mode}", CURVATURE, given | at_stage)
                    work[kind] += self.module.work(f"curvature_{kind}_{mode}")
            self.line("br label %next")
        self.lines.append("next:")
        self.line(f"%work = phi i64 [{work['end']}, %is_end], [{work['inner']}, %is_inner]")
        self.line("%left = sub i64 %budget, %work")
        self.line("%less = sub i64 %cell, 1")
        self.line("%done = icmp slt i64 %less, %first")
        self.next_turn(self.let("sub i64 %last, %cell"), "%done")
        return self.finished(f"internal i1 @backward_{mode}({SEGMENT})", returns=False)

    def samples(self, k: int, q: int) -> str:
        """All samples of the k-th Measurements."""
        n, N, width = self.sizes.n, self.sizes.N, self.sizes.width
        found = self.pointers()
        place = len(POINTERS) + 4 * k
        cells, times, values, weights = (self.let(f"load ptr, ptr {self.at('%table', place + m)}") for m in range(4))
        begins = [self.let(f"load i64, ptr {self.at(found['first_cell'], i)}") for i in range(1, N + 1)]
        before, left = self.resumed()
        self.line("br label %loop")
        self.lines.append("loop:")
        self.line(f"%sample = phi i64 [{before}, %entry], [%more, %loop]")
        self.line(f"%budget = phi i64 [{left}, %entry], [%left, %loop]")
        cell = self.let(f"load i64, ptr {self.at(cells, '%sample')}")
        state = self.let(f"add i64 {cell}, 1")
        for begin in begins:
            beyond = self.let(f"icmp sge i64 {cell}, {begin}")
            state = self.let(f"add i64 {state}, {self.let(f'zext i1 {beyond} to i64')}")
        given = found | {
            "x": self.at(found["states"], state, n),
            "Z": self.at(found["tangents"], state, n * width),
            "jump": self.at(found["jumps"], state, n),
            "time": self.at(times, "%sample"),
            "value": self.at(values, "%sample", q),
            "weight": self.at(weights, "%sample", q),
        }
        self.call(f"sample_{k}", SAMPLE, given)
        self.line(f"%left = sub i64 %budget, {self.module.work(f'sample_{k}')}")
        self.line("%more = add i64 %sample, 1")
        self.line("%done = icmp sge i64 %more, %count")
        self.next_turn("%sample", "%done")
        return self.finished(f"internal i1 @samples_{k}(ptr %table, i64 %count, ptr %progress)", returns=False)

    def slope_at(self, mode: int) -> str:
        """Slope of one mode at any time: in the cell that holds it, or would if it were between `low` and `high`."""
        S, at = self.sizes.signals, Adaptive()
        self.line("%moment = alloca [2 x double]")
        found = self.pointers()
        self.line("store double %time, ptr %moment")
        if S:
            low, high = (self.let(f"load double, ptr {self.at('%state', k)}") for k in (at.low, at.high))
            above = self.let(f"fcmp olt double %time, {low}")
            later = self.let(f"select i1 {above}, double {low}, double %time")
            below = self.let(f"fcmp ogt double {later}, {high}")
            inside = self.let(f"select i1 {below}, double {high}, double {later}")
            self.line("br label %search")
            self.lines.append("search:")  # the first node of the cell is at or before the time, the one at %right after
            self.line("%left = phi i64 [0, %entry], [%left_next, %halve]")
            self.line("%right = phi i64 [%cells, %entry], [%right_next, %halve]")
            self.line("%width = sub i64 %right, %left")
            self.line("%many = icmp sgt i64 %width, 1")
            self.line("br i1 %many, label %halve, label %found")
            self.lines.append("halve:")
            self.line("%sum = add i64 %left, %right")
            self.line("%middle = lshr i64 %sum, 1")
            node = self.let(f"load double, ptr {self.at(found['nodes'], '%middle')}")
            self.line(f"%before = fcmp ole double {node}, {inside}")
            self.line("%left_next = select i1 %before, i64 %middle, i64 %left")
            self.line("%right_next = select i1 %before, i64 %right, i64 %middle")
            self.line("br label %search")
            self.lines.append("found:")
            origin = self.let(f"load double, ptr {self.at(found['nodes'], '%left')}")
            self.line(f"store double {origin}, ptr {self.at('%moment', 1)}")
            found["signals"] = self.at(found["signals"], "%left", 4 * S)
        given = found | {"moment": "%moment", "signal": found["signals"], "y": "%y", "K": "%K"}
        self.call(f"slope_{mode}", SLOPE, given)
        signature = f"internal void @slope_at_{mode}(ptr %table, i64 %cells, ptr %state, double %time, ptr %y, ptr %K)"
        return self.finished(signature)

    def adaptive(self, mode: int) -> str:
        """Adaptive steps in one mode until its end, `most` of them, or the budget: the moments reached, and how many.

        Steps that are refused count for the budget too.
        """
        size, at = self.sizes.n + 1, Adaptive()
        given = {name: f"%{name}" for name in ADAPTIVE}
        self.line(f"%argument = alloca [{size} x double]")
        self.line(f"%K = alloca [{(len(RK45.C) + 1) * size} x double]")
        self.line("br label %loop")
        self.lines.append("loop:")
        self.line("%done = phi i64 [0, %entry], [%more, %next]")
        self.line("%tried = phi i64 [0, %entry], [%tries, %next]")
        t = self.let(f"load double, ptr {self.at('%state', at.t)}")
        end = self.let(f"load double, ptr {self.at('%state', at.end)}")
        stuck = self.let(f"load double, ptr {self.at('%state', at.stuck)}")
        flags = [self.let(f"fcmp olt double {t}, {end}"), self.let(f"fcmp oeq double {stuck}, 0.0")]
        flags.append(self.let("icmp slt i64 %done, %most"))
        steps = (f"adaptive_{j}" for j in range(1, len(RK45.C)))
        between = sum(map(self.module.work, ("adaptive_begin", *steps, "adaptive_after", "adaptive_judge")))
        work = (len(RK45.C) + 1) * self.module.work(f"slope_{mode}") + between
        flags.append(self.let(f"icmp slt i64 %tried, {max(1, BUDGET // work)}"))
        goes_on = flags[0]
        for flag in flags[1:]:
            goes_on = self.let(f"and i1 {goes_on}, {flag}")
        self.line(f"br i1 {goes_on}, label %try, label %out")
        self.lines.append("try:")
        self.call("adaptive_begin", ADAPTIVE, given)
        step = self.let(f"load double, ptr {self.at('%state', at.step)}")
        slope = f"call void @slope_at_{mode}(ptr %table, i64 %cells, ptr %state"
        self.line(f"{slope}, double {t}, ptr %y, ptr %K)")
        for j, c in enumerate([*RK45.C.tolist()[1:], 1.0], start=1):
            self.call(f"adaptive_{j}" if j < len(RK45.C) else "adaptive_after", ADAPTIVE, given)
            ahead = self.let(f"fmul double {step}, {literal(c)}")
            time = self.let(f"fadd double {t}, {ahead}")
            self.line(f"{slope}, double {time}, ptr %argument, ptr {self.at('%K', j * size)})")
        self.call("adaptive_judge", ADAPTIVE, given)
        refused = self.let(f"load double, ptr {self.at('%state', at.refused)}")
        accepted = self.let(f"fcmp oeq double {refused}, 0.0")
        self.line(f"br i1 {accepted}, label %keep, label %next")
        self.lines.append("keep:")
        reached = self.let(f"load double, ptr {self.at('%state', at.t)}")
        self.line(f"store double {reached}, ptr {self.at('%times', '%done')}")
        self.line("br label %next")
        self.lines.append("next:")
        self.line(f"%more = add i64 %done, {self.let(f'zext i1 {accepted} to i64')}")
        self.line("%tries = add i64 %tried, 1")
        self.line("br label %loop")
        self.lines.append("out:")
        self.line("store i64 %done, ptr %count")
        return self.finished(
            f"void @adaptive_{mode}_steps"
            "(ptr %table, i64 %cells, ptr %state, ptr %y, ptr %times, i64 %most, ptr %count)"
        )

    def whole(self) -> str:
        """Everything, in order."""
        structure, n, N, width = self.structure, self.sizes.n, self.sizes.N, self.sizes.width
        found = self.pointers()
        taus = [self.let(f"load double, ptr {self.at(found['tau'], i)}") for i in range(N)]
        bounds = ["%t0", *taus, "%tf"]
        firsts = [self.let(f"load i64, ptr {self.at(found['first_cell'], i)}") for i in range(N + 1)]
        lasts = [*firsts[1:], self.let("sub i64 %cells, 1")]
        spans = [
            f"ptr %table, i64 {i}, i64 {firsts[i]}, i64 {lasts[i]}, double {bounds[i]}, double {bounds[i + 1]}"
            for i in range(N + 1)
        ]
        befores = [{"x": found["states"], "Z": found["tangents"]}]
        for i in range(N):
            state = self.let(f"add i64 {lasts[i]}, {i + 1}")
            befores.append({"x": self.at(found["states"], state, n), "Z": self.at(found["tangents"], state, n * width)})
        afters = list(befores)
        for i in structure.resets:
            afters[i + 1] = {
                "x": self.at(found["reset_states"], i * n),
                "Z": self.at(found["reset_tangents"], i * n * width),
            }
        state = self.let(f"add i64 %cells, {N}")
        last = {"x": self.at(found["states"], state, n), "Z": self.at(found["tangents"], state, n * width)}
        # Straight lines, which are called with their pointers, and loops, which say whether they came to their end.
        phases: list[str | tuple[str, tuple[str, ...], dict[str, str]]] = [("start", START, found | befores[0])]
        for i, mode in enumerate(structure.mode_of_segment):
            if i - 1 in structure.resets:
                behind = {"x_after": afters[i]["x"], "Z_after": afters[i]["Z"]}
                phases.append((f"reset_{i - 1}", RESET, found | befores[i] | behind))
            phases.append(f"forward_{mode}({spans[i]}, ptr %progress, ptr {afters[i]['x']}, ptr {afters[i]['Z']})")
            phases.append(("check_state", STATES, found | (befores[i + 1] if i < N else last)))
        for k in range(len(structure.measurements)):
            phases.append(f"samples_{k}(ptr %table, i64 %count_{k}, ptr %progress)")
        if structure.terminal:
            phases.append(("end", END, found | last))
        if self.order > 0:
            for i, mode in reversed(list(enumerate(structure.mode_of_segment))):
                phases.append(f"backward_{mode}({spans[i]}, ptr %progress)")
                if i - 1 in structure.resets:
                    phases.append((f"reset_back_{i - 1}", RESET_BACK, found | befores[i]))
            phases.append(("start_back", START_BACK, found | {"jump": found["jumps"]}))
        phase = self.let("load i64, ptr %progress")
        places = " ".join(f"i64 {k}, label %phase_{k}" for k in range(1, len(phases)))
        self.line(f"switch i64 {phase}, label %phase_0 [{places}]")
        for k, what in enumerate(phases):
            self.lines.append(f"phase_{k}:")
            if isinstance(what, str):
                self.line(f"%ended_{k} = call i1 @{what}")
                self.line(f"br i1 %ended_{k}, label %phase_{k + 1}, label %pause_{k}")
                self.lines.append(f"pause_{k}:")
                self.line(f"store i64 {k}, ptr %progress")
                self.line("ret void")
            else:
                self.call(*what)
                self.line(f"br label %phase_{k + 1}")
        self.lines.append(f"phase_{len(phases)}:")
        self.line("store i64 -1, ptr %progress")
        counts = "".join(f", i64 %count_{k}" for k in range(len(structure.measurements)))
        return self.finished(f"void @evaluate(ptr %table, ptr %progress, i64 %cells, double %t0, double %tf{counts})")

    def outputs(self) -> str:
        """Outputs of any states, at moments."""
        n, width = self.sizes.n, self.sizes.width
        q = sum(channels for _, channels in self.structure.outputs)
        found = self.pointers()
        before, left = self.resumed()
        self.line("br label %loop")
        self.lines.append("loop:")
        self.line(f"%k = phi i64 [{before}, %entry], [%more, %loop]")
        self.line(f"%budget = phi i64 [{left}, %entry], [%left, %loop]")
        given = {
            "time": self.at("%times", "%k"),
            "x": self.at("%x", "%k", n),
            "Z": self.at("%Z", "%k", n * width),
            "y": self.at("%y", "%k", q),
            "Y": self.at("%Y", "%k", q * width),
        }
        self.call("outputs", OUTPUTS, found | given)
        self.line(f"%left = sub i64 %budget, {self.module.work('outputs')}")
        self.line("%more = add i64 %k, 1")
        self.line("%done = icmp sge i64 %more, %count")
        self.line("%phase = select i1 %done, i64 -1, i64 0")
        self.line("store i64 %phase, ptr %progress")
        self.next_turn("%k", "%done")
        pointers = "ptr %times, ptr %x, ptr %Z, ptr %y, ptr %Y"
        return self.finished(f"i1 @all_outputs(ptr %table, ptr %progress, i64 %count, {pointers})", returns=False)


SEGMENT = "ptr %table, i64 %segment, i64 %first, i64 %last, double %begins, double %finishes, ptr %progress"
