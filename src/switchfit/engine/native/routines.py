"""Routines that straight-line code calls: LU with partial pivoting of the coupled equations of an implicit row.

A node of a graph is a call (`scalars.Graph.call`), whose results are in memory:

    factors     (n, a, h, entries of f_x): L and U of ``I - h a_jl f_x[j]`` (m, m), m = s n, in rows of `_count_columns`
                doubles, then the row that each pivot is in, (m,)
    solution    (factors, transposed, right-hand side): m scalars or vectors
    entry       (solution, k): the k-th of them
"""

from __future__ import annotations

from typing import Any

from switchfit.engine.native.lines import Lines

LANES = 8
"""Entries of a row that are computed together."""

OPERATIONS = "factors", "solution", "entry"


def find_name(node: Any) -> str:
    """Return the name of the routine of a node."""
    if node.op == "factors":
        return "lu_factorize"
    return "lu_solve_vectors" if node.vector else "lu_solve_transposed" if node.args[1] else "lu_solve"


def estimate_cost(node: Any) -> int:
    """Return the cost of a call, in additions, so that rows of 7 to 10 states have about the work of their time."""
    if node.op == "factors":
        m = int(node.args[0]) * len(node.args[1])
        return m**3 // 3 + 10 * m**2
    return 2 * len(node.args) ** 2 if node.op == "solution" else 1


def count_doubles(m: int) -> int:
    """Return the size of the factors of m equations."""
    return m * (m + LANES) + m


def write(name: str, width: int) -> str:
    """Write a routine; vectors have this width."""
    return _write_factorize() if name == "lu_factorize" else _write_solve(name, width)


class _Matrix(Lines):
    """Emits the code of a routine for a matrix `%A` of `%m` rows, which have room for `LANES` entries behind them."""

    def begin(self) -> None:
        """Emit what all routines begin with."""
        self.line(f"%columns = add i64 %m, {LANES}")
        self.line("%pivots = getelementptr inbounds double, ptr %A, i64 " + self.let("mul i64 %m, %columns"))

    def entry(self, row: str, column: str) -> str:
        """Emit the address of an entry of the matrix."""
        return self.at(self.at("%A", row, "%columns"), column)

    def subtract_multiple(self, kind: str, target: str, factor: str, source: str) -> None:
        """Emit ``target -= factor * source`` for values of a kind in memory."""
        product = self.let(f"fmul {kind} {factor}, {self.load(kind, source)}")
        difference = self.let(f"fsub {kind} {self.load(kind, target)}, {product}")
        self.line(f"store {kind} {difference}, ptr {target}, align 8")

    def exchange(self, kind: str, one: str, other: str) -> None:
        """Emit the exchange of two values in memory."""
        values = self.load(kind, one), self.load(kind, other)
        self.line(f"store {kind} {values[0]}, ptr {other}, align 8")
        self.line(f"store {kind} {values[1]}, ptr {one}, align 8")

    def reverse(self, k: str) -> str:
        """Emit the k-th index from the end."""
        return self.let(f"sub i64 {self.let('sub i64 %m, 1')}, {k}")


def _write_factorize() -> str:
    w, lanes = _Matrix(), f"<{LANES} x double>"
    w.line("%m = mul i64 %n, %s")
    w.begin()
    w.line("%largest = alloca double")
    w.line("%place = alloca i64")
    # Room behind each row, which is zero, lets all loops over columns take LANES at a time.
    with w.loop("0", "%m") as row, w.loop("0", "%columns") as column:
        w.line(f"store double 0.0, ptr {w.entry(row, column)}")
    # Block (j, l) is -h a_jl f_x[j], and 1 is added on the diagonal.
    with w.loop("0", "%s") as j, w.loop("0", "%n") as row:
        line = w.let(f"add i64 {w.let(f'mul i64 {j}, %n')}, {row}")
        with w.loop("0", "%s") as block:
            weight = w.load("double", w.at("%a", w.let(f"add i64 {w.let(f'mul i64 {j}, %s')}, {block}")))
            factor = w.let(f"fmul double %h, {weight}")
            target, source = w.entry(line, w.let(f"mul i64 {block}, %n")), w.at("%f_x", line, "%n")
            with w.loop("0", "%n") as column:
                w.subtract_multiple("double", w.at(target, column), factor, w.at(source, column))
        diagonal = w.entry(line, line)
        total = w.let(f"fadd double 1.0, {w.load('double', diagonal)}")
        w.line(f"store double {total}, ptr {diagonal}")
    with w.loop("0", "%m") as k:
        after = w.let(f"add i64 {k}, 1")
        # Row k is exchanged with the one that has the largest entry of column k, as in LAPACK's dgetrf; then W_i -=
        # L_ik W_k.
        w.line("store double -1.0, ptr %largest")
        w.line(f"store i64 {k}, ptr %place")
        with w.loop(k, "%m") as row:
            entry = w.load("double", w.entry(row, k))
            negative = w.let(f"fcmp olt double {entry}, 0.0")
            size = w.let(f"select i1 {negative}, double {w.let(f'fneg double {entry}')}, double {entry}")
            larger = w.let(f"fcmp ogt double {size}, {w.load('double', '%largest')}")
            for kind, value, target in (("double", size, "%largest"), ("i64", row, "%place")):
                best = w.let(f"select i1 {larger}, {kind} {value}, {kind} {w.load(kind, target)}")
                w.line(f"store {kind} {best}, ptr {target}")
        pivot = w.load("i64", "%place")
        w.line(f"store i64 {pivot}, ptr {w.at('%pivots', k)}")
        with w.loop("0", "%m", LANES) as column:
            w.exchange(lanes, w.entry(k, column), w.entry(pivot, column))
        inverse = w.let(f"fdiv double 1.0, {w.load('double', w.entry(k, k))}")
        with w.loop(after, "%m") as row:
            target = w.entry(row, k)
            factor = w.let(f"fmul double {inverse}, {w.load('double', target)}")
            w.line(f"store double {factor}, ptr {target}")
            factors = w.spread(factor, LANES)
            with w.loop(after, "%m", LANES) as column:
                w.subtract_multiple(lanes, w.entry(row, column), factors, w.entry(k, column))
    return w.end_function("internal void @lu_factorize(ptr %A, ptr %f_x, ptr %a, double %h, i64 %n, i64 %s)")


def _write_solve(name: str, width: int) -> str:
    """Write the solution for a right-hand side `%b`, column by column of the factors, or of their transposes."""
    w, transposed = _Matrix(), name == "lu_solve_transposed"
    lanes = width if name == "lu_solve_vectors" else 1
    kind = f"<{lanes} x double>" if lanes > 1 else "double"

    def value(row: str) -> str:
        return w.at("%b", row, lanes)

    def factor(row: str, column: str) -> str:
        found = w.load("double", w.entry(column, row) if transposed else w.entry(row, column))
        return w.spread(found, lanes) if lanes > 1 else found

    def exchange(k: str) -> None:
        w.exchange(kind, value(k), value(w.load("i64", w.at("%pivots", k))))

    def subtract_column(column: str, first: str, last: str) -> None:
        with w.loop(first, last) as row:
            w.subtract_multiple(kind, value(row), factor(row, column), value(column))

    def divide(row: str) -> None:
        quotient = w.let(f"fdiv {kind} {w.load(kind, value(row))}, {factor(row, row)}")
        w.line(f"store {kind} {quotient}, ptr {value(row)}, align 8")

    # P A = L U. A x = b: exchange, L forward, U backward. A' x = b: U' forward, L' backward, exchange in the other
    # order.
    w.begin()
    if not transposed:
        with w.loop("0", "%m") as k:
            exchange(k)
    with w.loop("0", "%m") as column:
        if transposed:
            divide(column)
        subtract_column(column, w.let(f"add i64 {column}, 1"), "%m")
    with w.loop("0", "%m") as k:
        column = w.reverse(k)
        if not transposed:
            divide(column)
        subtract_column(column, "0", column)
    if transposed:
        with w.loop("0", "%m") as k:
            exchange(w.reverse(k))
    return w.end_function(f"internal void @{name}(ptr %A, ptr %b, i64 %m)")
