"""Routines that straight-line code calls: LU with partial pivoting of the coupled equations of an implicit row.

A node of a graph is a call (`Graph.call`), whose results are in memory:

    factors     (n, a, place, h, entries of f_x): L and U of ``I - h a_jl f_x[j]`` (m, m), m = s n, in rows of m and
                `LANES` doubles, then the row that each pivot is in, (m,). They lie at this place
                behind `kept`, if it is not None; without h and f_x they are there already
    solution    (factors, transposed, right-hand side): m scalars or vectors
    entry       (solution, k): the k-th of them
"""

from __future__ import annotations

from switchfit.engine.native.llvm.lines import Lines, Operand, Value, Variable

LANES = 8
"""Entries of a row that are computed together."""


def count_doubles(m: int) -> int:
    """Return the size of the factors of m equations."""
    return m * (m + LANES) + m


class _Matrix(Lines):
    """Emits the code of a routine for a matrix `%A` of `%m` rows, which have room for `LANES` entries behind them."""

    def set_rows(self, A: Value, m: Value) -> None:
        """Emit what all routines begin with."""
        self.A, self.columns = A, m + LANES
        self.pivots = self.at(A, m, self.columns)

    def entry(self, row: Value, column: Value) -> Value:
        """Emit the address of an entry of the matrix."""
        return self.at(self.at(self.A, row, self.columns), column)

    def subtract_multiple(self, kind: str, target: Value, factor: Value, source: Value) -> None:
        """Emit ``target -= factor * source`` for values of a kind in memory."""
        self.store(self.load(kind, target) - factor * self.load(kind, source), target)

    def exchange(self, kind: str, one: Value, other: Value) -> None:
        """Emit the exchange of two values in memory."""
        values = self.load(kind, one), self.load(kind, other)
        self.store(values[0], other)
        self.store(values[1], one)


def write_factorize() -> str:
    """Write the LU factorization with partial pivoting, whose columns are interleaved by lanes."""
    w, lanes = _Matrix(), f"<{LANES} x double>"
    A, f_x, a, h, n, s = w.begin("internal void @lu_factorize(ptr %A, ptr %f_x, ptr %a, double %h, i64 %n, i64 %s)")
    m = n * s
    w.set_rows(A, m)
    largest, place = Variable(w, "double", 0.0), Variable(w, "i64", 0)
    # Room behind each row, which is zero, lets all loops over columns take LANES at a time.
    with w.loop(0, m) as row, w.loop(0, w.columns) as column:
        w.store(0.0, w.entry(row, column))
    # Block (j, l) is -h a_jl f_x[j], and 1 is added on the diagonal.
    with w.loop(0, s) as j, w.loop(0, n) as row:
        line = j * n + row
        with w.loop(0, s) as block:
            factor = h * w.get("double", a, j * s + block)
            target, source = w.entry(line, block * n), w.at(f_x, line, n)
            with w.loop(0, n) as column:
                w.subtract_multiple("double", w.at(target, column), factor, w.at(source, column))
        diagonal = w.entry(line, line)
        w.store(w.load("double", diagonal) + 1.0, diagonal)
    with w.loop(0, m) as k:
        # Row k is exchanged with the one that has the largest entry of column k, as in LAPACK's dgetrf; then W_i -=
        # L_ik W_k.
        largest.value, place.value = -1.0, k
        with w.loop(k, m) as row:
            entry = w.load("double", w.entry(row, k))
            size = (entry < 0.0).choose(0.0 - entry, entry)
            is_larger = size > largest.value
            largest.value, place.value = is_larger.choose(size, largest.value), is_larger.choose(row, place.value)
        pivot = place.value
        w.put(pivot, w.pivots, k)
        with w.loop(0, m, LANES) as column:
            w.exchange(lanes, w.entry(k, column), w.entry(pivot, column))
        inverse = 1.0 / w.load("double", w.entry(k, k))
        with w.loop(k + 1, m) as row:
            target = w.entry(row, k)
            factor = inverse * w.load("double", target)
            w.store(factor, target)
            factors = w.spread(factor, LANES)
            with w.loop(k + 1, m, LANES) as column:
                w.subtract_multiple(lanes, w.entry(row, column), factors, w.entry(k, column))
    return w.end()


def write_solve(name: str, width: int) -> str:
    """Write the solution for a right-hand side `%b`, column by column of the factors, or of their transposes."""
    w, transposed = _Matrix(), name == "lu_solve_transposed"
    lanes = width if name == "lu_solve_vectors" else 1
    kind = f"<{lanes} x double>" if lanes > 1 else "double"
    A, b, m = w.begin(f"internal void @{name}(ptr %A, ptr %b, i64 %m)")

    def value(row: Value) -> Value:
        return w.at(b, row, lanes)

    def factor(row: Value, column: Value) -> Value:
        found = w.load("double", w.entry(column, row) if transposed else w.entry(row, column))
        return w.spread(found, lanes) if lanes > 1 else found

    def exchange(k: Value) -> None:
        w.exchange(kind, value(k), value(w.get("i64", w.pivots, k)))

    def subtract_column(column: Value, first: Operand, last: Value) -> None:
        with w.loop(first, last) as row:
            w.subtract_multiple(kind, value(row), factor(row, column), value(column))

    def divide(row: Value) -> None:
        w.store(w.load(kind, value(row)) / factor(row, row), value(row))

    # P A = L U. A x = b: exchange, L forward, U backward. A' x = b: U' forward, L' backward, exchange in the other
    # order.
    w.set_rows(A, m)
    if not transposed:
        with w.loop(0, m) as k:
            exchange(k)
    with w.loop(0, m) as column:
        if transposed:
            divide(column)
        subtract_column(column, column + 1, m)
    with w.loop(0, m) as k:
        column = m - 1 - k
        if not transposed:
            divide(column)
        subtract_column(column, 0, column)
    if transposed:
        with w.loop(0, m) as k:
            exchange(m - 1 - k)
    return w.end()
