"""The loops around the straight lines of `switchfit.engine.native.kernels`, in LLVM's language, written by hand.

Rows are numbered by ``cell + segment``: each transition cuts one cell in two. Which mode a segment has, and which reset
map and other functions a transition, is read at run time. The segments that a sequence does not need are idle: they
begin and end at tf.

Python hears Ctrl-C only between two calls. Loops therefore stop when a budget is spent, and go on where they stopped
when they are called again. `progress` is what they leave in memory between two calls: three integers, the phase of the
evaluation (-1 at its end), how many turns of the loop in it are done, and what is left of the budget (`llvm.BUDGET`).
"""

from __future__ import annotations

from typing import Any

from switchfit.discretization.nodes import AT_TRANSITIONS
from switchfit.engine.native.adaptive import SLOPE, STAGE_TIMES, STEP, Adaptive, step_functions
from switchfit.engine.native.kernels import (
    BACKWARD,
    CONSTRAINT,
    CURVATURE,
    END_OF_LATE,
    FORWARD,
    LATE_TIME,
    LENGTH,
    NODE,
    OUTPUTS,
    RESET,
    RESET_BACK,
    SAMPLE,
    STAGES,
    START,
    START_BACK,
    STATES,
    Kernels,
)
from switchfit.engine.native.llvm import BUDGET, Module, literal
from switchfit.engine.native.templates import Order, Sizes
from switchfit.engine.native.workspace import OF_SAMPLES, constraint_rows, pointers
from switchfit.problem.structure import Structure

TABLE = "ptr %table"
SEGMENT = f"{TABLE}, i64 %segment, i64 %first, i64 %last, double %begins, double %finishes, ptr %progress"
WHOLE = f"{TABLE}, i64 %segment, ptr %progress"


class Driver:
    """Writes the loops around the straight lines of a library."""

    def __init__(self, library: Structure, sizes: Sizes, order: Order, kernels: Kernels, module: Module) -> None:
        self.library, self.sizes, self.order, self.kernels, self.module = library, sizes, order, kernels, module
        self.names = pointers(library, sizes, order)
        self.rows = constraint_rows(library, sizes)
        self.lines: list[str] = []
        self.count = 0

    # Lines

    def line(self, text: str) -> None:
        """Emit a line."""
        self.lines.append(f"  {text}")

    def label(self, name: str) -> None:
        """Emit a label: the start of a block."""
        self.lines.append(f"{name}:")

    def let(self, text: str) -> str:
        """Emit an instruction; return the name of its value."""
        self.count += 1
        self.line(f"%t{self.count} = {text}")
        return f"%t{self.count}"

    def load(self, kind: str, pointer: str) -> str:
        """Emit a load from a pointer; return the name of the value."""
        return self.let(f"load {kind}, ptr {pointer}")

    def at(self, pointer: str, *factors: Any) -> str:
        """Emit the address of ``pointer[product of the factors]``, in doubles."""
        offset = str(factors[0])
        for factor in factors[1:]:
            offset = self.let(f"mul i64 {offset}, {factor}")
        return self.let(f"getelementptr inbounds double, ptr {pointer}, i64 {offset}")

    def pointers(self) -> dict[str, str]:
        """Load all pointers of the table."""
        return {name: self.load("ptr", self.at("%table", k)) for k, name in enumerate(self.names)}

    def samples_of(self, k: int) -> dict[str, str]:
        """Load the pointers of the k-th Measurements."""
        first = len(self.names) + len(OF_SAMPLES) * k
        return {name: self.load("ptr", self.at("%table", first + m)) for m, name in enumerate(OF_SAMPLES)}

    def into(self, pointer: str, offset: int) -> str:
        """Emit an address, in bytes from a pointer."""
        return self.let(f"getelementptr inbounds i8, ptr {pointer}, i64 {offset}")

    def call(self, name: str, order: tuple[str, ...], given: dict[str, str]) -> int:
        """Call a straight line with its pointers in order; return its cost."""
        self.line(f"call void @{name}({', '.join(f'ptr {given[key]}' for key in order)})")
        return self.module.work(name)

    def choose(self, which: str, count: int, name: str) -> list[str]:
        """Switch to one of `count` blocks at run time; return their labels. Each block continues at ``{name}_end``.

        A choice of -1 goes there at once.
        """
        labels = [f"{name}_{k}" for k in range(count)]
        cases = " ".join(f"i64 {k}, label %{label}" for k, label in enumerate(labels))
        self.line(f"switch i64 {which}, label %{name}_end [{cases}]")
        return labels

    def load_progress(self) -> tuple[str, str]:
        """Load from `progress` how many turns of a loop are done, and what is left of the budget."""
        places = (self.let(f"getelementptr inbounds i64, ptr %progress, i64 {k}") for k in (1, 2))
        turns, left = (self.load("i64", place) for place in places)
        return turns, left

    def next_turn(self, turns: str, done: str) -> None:
        """End a turn of a loop: leave it if it is `done`, return if the budget is spent, else start the next one.

        The loop has the label `loop`, this block the label `next`. `%left` is what is left after this turn.
        """
        self.line(f"%turns = add i64 {turns}, 1")
        self.line("%spent = icmp sle i64 %left, 0")
        self.line(f"%stop = or i1 {done}, %spent")
        self.line("br i1 %stop, label %out, label %loop")
        self.label("out")
        self.line(f"%place = select i1 {done}, i64 0, i64 %turns")
        for k, value in ((1, "%place"), (2, "%left")):
            place = self.let(f"getelementptr inbounds i64, ptr %progress, i64 {k}")
            self.line(f"store i64 {value}, ptr {place}")
        self.line(f"ret i1 {done}")

    def end_function(self, signature: str, returns: bool = True) -> str:
        """Wrap the emitted lines into one LLVM function and reset; `returns` adds a return at its end."""
        end = "\n  ret void" if returns else ""
        text = f"define {signature} {{\nentry:\n" + "\n".join(self.lines) + f"{end}\n}}\n"
        self.lines, self.count = [], 0
        return text

    # Rows of one mode

    def _row(self, found: dict[str, str], cell: str) -> dict[str, str]:
        """Find times, signals and directions of the row of a segment in a cell, and whether it moves."""
        N, S, width = self.sizes.N, self.sizes.signals, self.sizes.width
        first, last = self.let(f"icmp eq i64 {cell}, %first"), self.let(f"icmp eq i64 {cell}, %last")
        here = self.load("double", self.at(found["nodes"], cell))
        after = self.let(f"add i64 {cell}, 1")
        there = self.load("double", self.at(found["nodes"], after))
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
            "moves": self.let(f"or i1 {opens}, {closes}"),
        }

    def _at_row(self, found: dict[str, str], row: str) -> dict[str, str]:
        n, width = self.sizes.n, self.sizes.width
        return {
            "X": self.at(found["stages"], row, STAGES * n),
            "XZ": self.at(found["stage_tangents"], row, STAGES * n * width),
        }

    def _state(self, found: dict[str, str], index: str) -> dict[str, str]:
        """Return pointers to the state and its tangent at the end of a row, by its index."""
        n, width = self.sizes.n, self.sizes.width
        return {"x": self.at(found["states"], index, n), "Z": self.at(found["tangents"], index, n * width)}

    def forward_segment(self, mode: int) -> str:
        """Write the loop over all rows of a segment in a mode, forward."""
        self.line("%row = alloca [3 x double]")
        found = self.pointers()
        before, left = self.load_progress()
        self.line(f"%start = add i64 %first, {before}")
        self.line("br label %loop")
        self.label("loop")
        self.line("%cell = phi i64 [%start, %entry], [%more, %next]")
        self.line(f"%budget = phi i64 [{left}, %entry], [%left, %next]")
        place = self._row(found, "%cell")
        row = self.let("add i64 %cell, %segment")
        own = self._state(found, row)
        x = self.let(f"select i1 {place['first']}, ptr %x, ptr {own['x']}")
        Z = self.let(f"select i1 {place['first']}, ptr %Z, ptr {own['Z']}")
        after = self._state(found, self.let(f"add i64 {row}, 1"))
        given = found | place | self._at_row(found, row)
        given |= {"x": x, "Z": Z, "x_after": after["x"], "Z_after": after["Z"]}
        self.line(f"br i1 {place['moves']}, label %is_end, label %is_inner")
        work = {}
        for kind in ("end", "inner"):
            self.label(f"is_{kind}")
            work[kind] = self.call(f"forward_{kind}_{mode}", FORWARD, given)
            self.line("br label %next")
        self.label("next")
        self.line(f"%work = phi i64 [{work['end']}, %is_end], [{work['inner']}, %is_inner]")
        self.line("%left = sub i64 %budget, %work")
        self.line("%more = add i64 %cell, 1")
        self.line("%done = icmp sgt i64 %more, %last")
        self.next_turn(self.let("sub i64 %cell, %first"), "%done")
        return self.end_function(f"internal i1 @forward_{mode}({SEGMENT}, ptr %x, ptr %Z)", returns=False)

    def backward_segment(self, mode: int, inner: int, end: int) -> str:
        """Write the loop over all rows of a segment in a mode, backward.

        `inner` and `end` count the entries of the second derivatives at each stage.
        """
        n = self.sizes.n
        self.line("%row = alloca [3 x double]")
        found = self.pointers()
        before, left = self.load_progress()
        self.line(f"%start = sub i64 %last, {before}")
        self.line("br label %loop")
        self.label("loop")
        self.line("%cell = phi i64 [%start, %entry], [%less, %next]")
        self.line(f"%budget = phi i64 [{left}, %entry], [%left, %next]")
        place = self._row(found, "%cell")
        row = self.let("add i64 %cell, %segment")
        after = self.let(f"add i64 {row}, 1")
        given = found | place | self._at_row(found, row)
        given |= {"jump": self.at(found["jumps"], after, n), "late": self.at(found["late"], row, n)}
        self.line(f"br i1 {place['moves']}, label %is_end, label %is_inner")
        work = {}
        for kind, count in (("end", end + 1), ("inner", inner)):
            self.label(f"is_{kind}")
            work[kind] = self.call(f"backward_{kind}_{mode}", BACKWARD, given)
            work[kind] += self._curvature(f"{kind}_{mode}", given, count, moving=kind == "end")
            self.line("br label %next")
        self.label("next")
        self.line(f"%work = phi i64 [{work['end']}, %is_end], [{work['inner']}, %is_inner]")
        self.line("%left = sub i64 %budget, %work")
        self.line("%less = sub i64 %cell, 1")
        self.line("%done = icmp slt i64 %less, %first")
        self.next_turn(self.let("sub i64 %last, %cell"), "%done")
        return self.end_function(f"internal i1 @backward_{mode}({SEGMENT})", returns=False)

    def _curvature(self, name: str, given: dict[str, str], count: int, moving: bool) -> int:
        """Add to H what `count` entries a stage say, and the length of a row that moves: what it costs."""
        n, width, work = self.sizes.n, self.sizes.width, 0
        if self.order < Order.HESSIAN:
            return work
        if moving and self.order == Order.HESSIAN:
            work += self.call("length", LENGTH, given)
        if count > moving:
            for j in range(0, STAGES, self.kernels.stages_at_once):
                at_stage = {"entries": self.at(given["entries"], j * count), "XZ": self.at(given["XZ"], j * n * width)}
                work += self.call(f"curvature_{name}", CURVATURE, given | at_stage)
        return work

    # Segments, whatever their mode

    def _segment(self, found: dict[str, str]) -> dict[str, str]:
        """Find where a segment begins and ends: cells, times, indices of states; and the arguments of its rows."""
        next_ = self.let("add i64 %segment, 1")
        first, last = (self.load("i64", self.at(found["first_cell"], k)) for k in ("%segment", next_))
        begins, finishes = (self.load("double", self.at(found["bounds"], k)) for k in ("%segment", next_))
        before = self.let(f"add i64 {first}, %segment")
        after = self.let(f"add i64 {self.let(f'add i64 {last}, %segment')}, 1")
        given = f"{TABLE}, i64 %segment, i64 {first}, i64 {last}, double {begins}, double {finishes}, ptr %progress"
        return {"next": next_, "before": before, "after": after, "given": given}

    def _reset_of(self, found: dict[str, str], name: str) -> tuple[str, dict[str, str], list[str]]:
        """Switch to the reset map at the start of a segment; return which it is, its pointers, and the blocks."""
        n, width = self.sizes.n, self.sizes.width
        transition = self.let("sub i64 %segment, 1")
        opens = self.let("icmp sgt i64 %segment, 0")
        safe = self.let(f"select i1 {opens}, i64 {transition}, i64 0")
        of_transition = self.load("i64", self.at(found["resets"], safe))
        which = self.let(f"select i1 {opens}, i64 {of_transition}, i64 -1")
        given = {
            "time": self.at(found["bounds"], "%segment"),
            "moves": self.at(found["units"], "%segment", width),
            "x_after": self.at(found["reset_states"], safe, n),
            "Z_after": self.at(found["reset_tangents"], safe, n * width),
        }
        return which, given, self.choose(which, len(self.library.reset_maps), name)

    def forward_any(self) -> str:
        """Write a segment of any mode forward: its reset map, its rows, and the functions at its end."""
        found = self.pointers()
        place = self._segment(found)
        state = self._state(found, place["before"])
        if self.library.reset_maps:
            which, given, labels = self._reset_of(found, "reset")
            for k, label in enumerate(labels):
                self.label(label)
                self.call(f"reset_{k}", RESET, found | state | given)
                self.line("br label %reset_end")
            self.label("reset_end")
            there = self.let(f"icmp sge i64 {which}, 0")
            for name, after in (("x", "x_after"), ("Z", "Z_after")):
                state[name] = self.let(f"select i1 {there}, ptr {given[after]}, ptr {state[name]}")
        mode = self.load("i64", self.at(found["modes"], "%segment"))
        labels = self.choose(mode, len(self.library.modes), "mode")
        for k, label in enumerate(labels):
            self.label(label)
            self.line(f"%done_{k} = call i1 @forward_{k}({place['given']}, ptr {state['x']}, ptr {state['Z']})")
            self.line(f"br i1 %done_{k}, label %mode_end, label %pause")
        self.label("pause")
        self.line("ret i1 false")
        self.label("mode_end")
        state = self._state(found, place["after"])
        self.call("check_state", STATES, found | state)
        if self.sizes.N:
            self._transition(found, place, state)
        self.line("ret i1 true")
        return self.end_function(f"internal i1 @forward_any({WHOLE})", returns=False)

    def _transition(self, found: dict[str, str], place: dict[str, str], state: dict[str, str]) -> None:
        """Call the functions at the transition that ends a segment."""
        n, width = self.sizes.n, self.sizes.width
        kinds = [kind for kind in AT_TRANSITIONS if getattr(self.library, kind.name)]
        if not kinds:
            return
        closes = self.let(f"icmp slt i64 %segment, {self.sizes.N}")
        self.line(f"br i1 {closes}, label %transition, label %no_transition")
        self.label("transition")
        given = found | state
        given |= {
            "time": self.at(found["bounds"], place["next"]),
            "moves": self.at(found["units"], place["next"], width),
            "jump": self.at(found["jumps"], place["after"], n) if self.order else found["jumps"],
        }
        for kind in kinds:
            which = self.load("i64", self.at(found[kind.name], "%segment"))
            if kind.constraint:
                given |= self._constraint(found, self.let(f"add i64 %segment, {self.rows[kind.name]}"))
            for k, label in enumerate(self.choose(which, len(getattr(self.library, kind.name)), kind.name)):
                self.label(label)
                self.call(f"{kind.name}_{k}", CONSTRAINT if kind.constraint else NODE, given)
                self.line(f"br label %{kind.name}_end")
            self.label(f"{kind.name}_end")
        self.line("br label %no_transition")
        self.label("no_transition")

    def _constraint(self, found: dict[str, str], row: str) -> dict[str, str]:
        """Return pointers to the constraints from a row on."""
        return {
            "multiplier": self.at(found["multipliers"], row),
            "penalty": self.at(found["penalties"], row),
            "constraint": self.at(found["constraints"], row),
            "jacobian": self.at(found["jacobian"], row, self.sizes.width),
        }

    def backward_any(self) -> str:
        """Write a segment of any mode backward: its rows, then the reset map at its start."""
        found = self.pointers()
        place = self._segment(found)
        mode = self.load("i64", self.at(found["modes"], "%segment"))
        for k, label in enumerate(self.choose(mode, len(self.library.modes), "mode")):
            self.label(label)
            self.line(f"%done_{k} = call i1 @backward_{k}({place['given']})")
            self.line(f"br i1 %done_{k}, label %mode_end, label %pause")
        self.label("pause")
        self.line("ret i1 false")
        self.label("mode_end")
        if self.library.reset_maps:
            state = self._state(found, place["before"])
            _, given, labels = self._reset_of(found, "reset")
            for k, label in enumerate(labels):
                self.label(label)
                self.call(f"reset_back_{k}", RESET_BACK, found | state | given)
                self.line("br label %reset_end")
            self.label("reset_end")
        self.line("ret i1 true")
        return self.end_function(f"internal i1 @backward_any({WHOLE})", returns=False)

    # Samples

    def samples(self, k: int) -> str:
        """Write the loop over the samples of the k-th Measurements, which are at the ends of rows."""
        n, N, q = self.sizes.n, self.sizes.N, self.library.measurements[k].channels
        found, own = self.pointers(), self.samples_of(k)
        begins = [self.load("i64", self.at(found["first_cell"], i)) for i in range(1, N + 1)]
        before, left = self.load_progress()
        self.line("br label %loop")
        self.label("loop")
        self.line(f"%sample = phi i64 [{before}, %entry], [%more, %loop]")
        self.line(f"%budget = phi i64 [{left}, %entry], [%left, %loop]")
        cell = self.load("i64", self.at(own["cell"], "%sample"))
        index = self.let(f"add i64 {cell}, 1")
        for begin in begins:
            beyond = self.let(f"icmp sge i64 {cell}, {begin}")
            index = self.let(f"add i64 {index}, {self.let(f'zext i1 {beyond} to i64')}")
        given = found | self._state(found, index) | self._sample(own, q)
        given |= {"moves": found["units"], "time": self.at(own["time"], "%sample")}
        given["jump"] = self.at(found["jumps"], index, n) if self.order else found["jumps"]
        self._next_sample(self.call(f"sample_{k}", SAMPLE, given))
        return self.end_function(f"internal i1 @samples_{k}({TABLE}, i64 %count, ptr %progress)", returns=False)

    def _sample(self, own: dict[str, str], q: int) -> dict[str, str]:
        return {"value": self.at(own["value"], "%sample", q), "weight": self.at(own["weight"], "%sample", q)}

    def _next_sample(self, work: int) -> None:
        self.line(f"%left = sub i64 %budget, {work}")
        self.line("%more = add i64 %sample, 1")
        self.line("%done = icmp sge i64 %more, %count")
        self.next_turn("%sample", "%done")

    def _late_row(self, k: int, found: dict[str, str], own: dict[str, str]) -> tuple[str, dict[str, str], str, int]:
        """Take the row of a late sample forward; return the index of the row that holds it, pointers, mode and work."""
        n, S, width = self.sizes.n, self.sizes.signals, self.sizes.width
        cell, segment = (self.load("i64", self.at(own[name], "%sample")) for name in ("cell", "segment"))
        row = self.let(f"add i64 {cell}, {segment}")
        first = self.let(f"icmp eq i64 {cell}, {self.load('i64', self.at(found['first_cell'], segment))}")
        opens = self.let(f"and i1 {first}, {self.let(f'icmp sgt i64 {segment}, 0')}")
        opening = self.let(f"select i1 {opens}, i64 {segment}, i64 0")
        node = self.load("double", self.at(found["nodes"], cell))
        begins = self.load("double", self.at(found["bounds"], segment))
        start = self.let(f"select i1 {opens}, double {begins}, double {node}")
        for place, value in ((0, start), (2, node)):
            self.line(f"store double {value}, ptr {self.at(found['late_row'], place)}")
        given = found | self._state(found, row)
        if self.library.reset_maps:
            transition = self.let(f"sub i64 {opening}, 1")
            safe = self.let(f"select i1 {opens}, i64 {transition}, i64 0")
            which = self.load("i64", self.at(found["resets"], safe))
            behind = self.let(f"and i1 {opens}, {self.let(f'icmp sge i64 {which}, 0')}")
            for name, after, size in (("x", "reset_states", n), ("Z", "reset_tangents", n * width)):
                jumped = self.at(found[after], safe, size)
                given[name] = self.let(f"select i1 {behind}, ptr {jumped}, ptr {given[name]}")
        given |= {
            "time": self.at(own["time"], "%sample"),
            "row": found["late_row"],
            "closes": found["late_closes"],
            "opens": self.at(found["units"], opening, width),
            "signal": self.at(found["signals"], cell, 4 * S),
            "X": found["late_stages"],
            "XZ": found["late_stage_tangents"],
            "x_after": found["late_state"],
            "Z_after": found["late_tangent"],
            "psi": found["late_psi"],
            "jump": found["late_psi"],
            "J": found["late_J"],
        }
        work = self.call(f"late_time_{k}", LATE_TIME, given)
        mode = self.load("i64", self.at(found["modes"], segment))
        longest = 0
        for m, label in enumerate(self.choose(mode, len(self.library.modes), "forward")):
            self.label(label)
            longest = max(longest, self.call(f"forward_late_{m}", FORWARD, given))
            self.line("br label %forward_end")
        self.label("forward_end")
        return row, given, mode, work + longest

    def late_samples(self, k: int, counts: list[int]) -> str:
        """Write the loop over the samples of the k-th Measurements, which are late: each ends a row of its own.

        `counts` are the numbers of entries of the second derivatives of such a row, by modes.
        """
        n, q = self.sizes.n, self.library.measurements[k].channels
        found, own = self.pointers(), self.samples_of(k)
        before, left = self.load_progress()
        self.line("br label %loop")
        self.label("loop")
        self.line(f"%sample = phi i64 [{before}, %entry], [%more, %next]")
        self.line(f"%budget = phi i64 [{left}, %entry], [%left, %next]")
        row, given, mode, work = self._late_row(k, found, own)
        at_end = {"x": found["late_state"], "Z": found["late_tangent"], "J": found["J"]} | self._sample(own, q)
        at_end |= {"time": self.at(found["late_row"], 1), "moves": found["late_closes"]}
        for entry in range(n):
            self.line(f"store double 0.0, ptr {self.at(found['late_psi'], entry)}")
        work += self.call(f"sample_{k}", SAMPLE, given | at_end)
        if self.order > Order.COST:
            longest = 0
            for m, label in enumerate(self.choose(mode, len(self.library.modes), "backward")):
                self.label(label)
                here = self.call(f"backward_late_{m}", BACKWARD, given)
                if self.order == Order.HESSIAN:
                    here += self._curvature(f"late_{m}", given, counts[m] + 1, moving=True)
                longest = max(longest, here)
                self.line("br label %backward_end")
            self.label("backward_end")
            work += longest
            work += self.call("end_of_late", END_OF_LATE, given | {"late": self.at(found["late"], row, n)})
        self.line("br label %next")
        self.label("next")
        self._next_sample(work)
        return self.end_function(f"internal i1 @samples_{k}({TABLE}, i64 %count, ptr %progress)", returns=False)

    def late_states(self, k: int) -> str:
        """Write a loop that stores the times at which late samples saw the state, and these states."""
        n = self.sizes.n
        found, own = self.pointers(), self.samples_of(k)
        self.line("br label %loop")
        self.label("loop")
        self.line("%sample = phi i64 [0, %entry], [%more, %forward_end]")
        self._late_row(k, found, own)
        moment = self.load("double", self.at(found["late_row"], 1))
        self.line(f"store double {moment}, ptr {self.at('%times', '%sample')}")
        for entry in range(n):
            value = self.load("double", self.at(found["late_state"], entry))
            place = self.let(f"getelementptr inbounds double, ptr {self.at('%states', '%sample', n)}, i64 {entry}")
            self.line(f"store double {value}, ptr {place}")
        self.line("%more = add i64 %sample, 1")
        self.line("%done = icmp sge i64 %more, %count")
        self.line("br i1 %done, label %out, label %loop")
        self.label("out")
        return self.end_function(f"void @late_states_{k}({TABLE}, i64 %count, ptr %times, ptr %states)")

    # Everything

    def whole(self) -> str:
        """Write `evaluate`: all phases in order; those that are loops return whether they are finished.

        They are the segments forward, the Measurements, the end, and the segments backward.
        """
        N, K = self.sizes.N, len(self.library.measurements)
        found = self.pointers()
        before = self.load("i64", "%progress")
        counts = [f"%count_{k}" for k in range(K)]
        self.line("br label %phase")
        self.label("phase")
        self.line(f"%now = phi i64 [{before}, %entry], [%following, %done]")
        self.line(f"%is_forward = icmp sle i64 %now, {N}")
        self.line("br i1 %is_forward, label %forward, label %later")
        self.label("forward")
        self.line("%is_start = icmp eq i64 %now, 0")
        self.line("br i1 %is_start, label %start, label %segment")
        self.label("start")
        self.call("start", START, found | self._state(found, "0"))
        self.line("br label %segment")
        self.label("segment")
        self.line(f"%passed = call i1 @forward_any({TABLE}, i64 %now, ptr %progress)")
        self.line("br i1 %passed, label %done, label %pause")
        self.label("later")
        cases = [f"i64 {N + 1 + k}, label %samples_{k}" for k in range(K)] + [f"i64 {N + 1 + K}, label %at_end"]
        self.line(f"switch i64 %now, label %backward [{' '.join(cases)}]")
        for k, count in enumerate(counts):
            self.label(f"samples_{k}")
            self.line(f"%counted_{k} = call i1 @samples_{k}({TABLE}, i64 {count}, ptr %progress)")
            self.line(f"br i1 %counted_{k}, label %done, label %pause")
        self.label("at_end")
        index = self.let(f"add i64 {self.load('i64', self.at(found['first_cell'], N + 1))}, {N + 1}")
        last = found | self._state(found, index) | {"jump": found["psi"]}
        last |= {"time": self.at(found["bounds"], N + 1), "moves": found["units"]}
        if self.library.terminal:
            self.call("end", NODE, last)
        if self.library.terminal_constraints:
            self.call("end_constraint", CONSTRAINT, last | self._constraint(found, str(self.rows["end"])))
        self.line("br label %done")
        self.label("backward")
        if self.order > Order.COST:
            self.line(f"%segment_back = sub i64 {2 * N + K + 2}, %now")
            self.line("%is_back = icmp sge i64 %segment_back, 0")
            self.line("br i1 %is_back, label %back, label %start_back")
            self.label("back")
            self.line(f"%returned = call i1 @backward_any({TABLE}, i64 %segment_back, ptr %progress)")
            self.line("br i1 %returned, label %done, label %pause")
            self.label("start_back")
            self.call("start_back", START_BACK, found | {"jump": found["jumps"]})
        self.line("store i64 -1, ptr %progress")
        self.line("ret void")
        self.label("done")
        self.line("%following = add i64 %now, 1")
        self.line("br label %phase")
        self.label("pause")
        self.line("store i64 %now, ptr %progress")
        given = "".join(f", i64 {count}" for count in counts)
        return self.end_function(f"void @evaluate({TABLE}, ptr %progress{given})")

    def outputs(self) -> str:
        """Write the loop over the outputs of given states at given times."""
        n, width = self.sizes.n, self.sizes.width
        q = sum(channels for _, channels in self.library.outputs)
        found = self.pointers()
        before, left = self.load_progress()
        self.line("br label %loop")
        self.label("loop")
        self.line(f"%k = phi i64 [{before}, %entry], [%more, %loop]")
        self.line(f"%budget = phi i64 [{left}, %entry], [%left, %loop]")
        given = {
            "time": self.at("%times", "%k"),
            "x": self.at("%x", "%k", n),
            "Z": self.at("%Z", "%k", n * width),
            "y": self.at("%y", "%k", q),
            "Y": self.at("%Y", "%k", q * width),
        }
        work = self.call("outputs", OUTPUTS, found | given)
        self.line(f"%left = sub i64 %budget, {work}")
        self.line("%more = add i64 %k, 1")
        self.line("%done = icmp sge i64 %more, %count")
        self.line("%phase = select i1 %done, i64 -1, i64 0")
        self.line("store i64 %phase, ptr %progress")
        self.next_turn("%k", "%done")
        given_ = "ptr %times, ptr %x, ptr %Z, ptr %y, ptr %Y"
        return self.end_function(f"i1 @all_outputs({TABLE}, ptr %progress, i64 %count, {given_})", returns=False)

    # The adaptive solver

    def slope_at(self, mode: int) -> str:
        """Write the slope of one mode at any time, with the signals of its cell; `low` and `high` limit the search."""
        S, at = self.sizes.signals, Adaptive()
        self.line("%moment = alloca [2 x double]")
        found = self.pointers()
        self.line("store double %time, ptr %moment")
        if S:
            low, high = (self.load("double", self.at("%state", k)) for k in (at.low, at.high))
            above = self.let(f"fcmp olt double %time, {low}")
            later = self.let(f"select i1 {above}, double {low}, double %time")
            below = self.let(f"fcmp ogt double {later}, {high}")
            inside = self.let(f"select i1 {below}, double {high}, double {later}")
            self.line("br label %search")
            self.label("search")  # the first node of the cell is at or before the time, the one at %right after
            self.line("%left = phi i64 [0, %entry], [%left_next, %halve]")
            self.line("%right = phi i64 [%cells, %entry], [%right_next, %halve]")
            self.line("%width = sub i64 %right, %left")
            self.line("%many = icmp sgt i64 %width, 1")
            self.line("br i1 %many, label %halve, label %found")
            self.label("halve")
            self.line("%sum = add i64 %left, %right")
            self.line("%middle = lshr i64 %sum, 1")
            node = self.load("double", self.at(found["nodes"], "%middle"))
            self.line(f"%before = fcmp ole double {node}, {inside}")
            self.line("%left_next = select i1 %before, i64 %middle, i64 %left")
            self.line("%right_next = select i1 %before, i64 %right, i64 %middle")
            self.line("br label %search")
            self.label("found")
            origin = self.load("double", self.at(found["nodes"], "%left"))
            self.line(f"store double {origin}, ptr {self.at('%moment', 1)}")
            found["signals"] = self.at(found["signals"], "%left", 4 * S)
        given = found | {"moment": "%moment", "signal": found["signals"], "y": "%y", "K": "%K"}
        self.call(f"slope_{mode}", SLOPE, given)
        signature = f"internal void @slope_at_{mode}({TABLE}, i64 %cells, ptr %state, double %time, ptr %y, ptr %K)"
        return self.end_function(signature)

    def adaptive(self, mode: int) -> str:
        """Write adaptive steps in one mode, until the end, `most` of them or the budget; they store the accepted times.

        Refused steps count for the budget too.
        """
        size, at = self.sizes.n + 1, Adaptive()
        given = {name: f"%{name}" for name in STEP}
        functions = step_functions()
        self.line(f"%argument = alloca [{size} x double]")
        self.line(f"%K = alloca [{len(STAGE_TIMES) * size} x double]")
        self.line("br label %loop")
        self.label("loop")
        self.line("%done = phi i64 [0, %entry], [%more, %next]")
        self.line("%tried = phi i64 [0, %entry], [%tries, %next]")
        t, end, stuck = (self.load("double", self.at("%state", k)) for k in (at.t, at.end, at.stuck))
        flags = [self.let(f"fcmp olt double {t}, {end}"), self.let(f"fcmp oeq double {stuck}, 0.0")]
        flags.append(self.let("icmp slt i64 %done, %most"))
        work = len(STAGE_TIMES) * self.module.work(f"slope_{mode}") + sum(map(self.module.work, functions))
        flags.append(self.let(f"icmp slt i64 %tried, {max(1, BUDGET // work)}"))
        goes_on = flags[0]
        for flag in flags[1:]:
            goes_on = self.let(f"and i1 {goes_on}, {flag}")
        self.line(f"br i1 {goes_on}, label %try, label %out")
        self.label("try")
        step = self.load("double", self.at("%state", at.step))
        for j, (c, function) in enumerate(zip(STAGE_TIMES, functions, strict=True)):
            ahead = self.let(f"fmul double {step}, {literal(c)}")
            time = self.let(f"fadd double {t}, {ahead}")
            slope = self.at("%K", j * size)
            at_state = f"double {time}, ptr {'%argument' if j else '%y'}, ptr {slope}"
            self.line(f"call void @slope_at_{mode}({TABLE}, i64 %cells, ptr %state, {at_state})")
            self.call(function, STEP, given)
        refused = self.load("double", self.at("%state", at.refused))
        accepted = self.let(f"fcmp oeq double {refused}, 0.0")
        self.line(f"br i1 {accepted}, label %keep, label %next")
        self.label("keep")
        reached = self.load("double", self.at("%state", at.t))
        self.line(f"store double {reached}, ptr {self.at('%times', '%done')}")
        self.line("br label %next")
        self.label("next")
        self.line(f"%more = add i64 %done, {self.let(f'zext i1 {accepted} to i64')}")
        self.line("%tries = add i64 %tried, 1")
        self.line("br label %loop")
        self.label("out")
        self.line("store i64 %done, ptr %count")
        return self.end_function(
            f"void @adaptive_{mode}_steps({TABLE}, i64 %cells, ptr %state, ptr %y, ptr %times, i64 %most, ptr %count)"
        )
