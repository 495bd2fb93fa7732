"""Straight-line functions for rows and nodes, with derivatives as vectors over theta.

The equations are those of `switchfit.discretization.rows`.

Second derivatives need no matrix (n, n) that goes backward. With a step, sample or reset as a map z -> F(z, theta) of
cost L, the recursions of Omega (12), of Theta (15) and of H (13), (14), (16) in the discretized system,

    Omega  = F_z' Omega+ F_z + psi+ . F_zz + L_zz
    Theta  = F_z' (Omega+ F_theta + Theta+) + psi+ . F_ztheta + L_ztheta
    H      = H+ + F_theta' Omega+ F_theta + F_theta' Theta+ + Theta+' F_theta + psi+ . F_thetatheta + L_thetatheta

unroll to the sum over all maps of ``(Z, 1)' (psi+ . D^2 F + D^2 L) (Z, 1)``, with the tangents Z that the forward sweep
has kept. The backward sweep takes psi alone; what it adds to H is Z' S Z, S being the entries of a stage or a node.

A straight-line function reads and writes through pointers. The name of a pointer means the same in all functions:

    c, p            constants, parameters
    row, signal     (start, end, first node of the cell), coefficients (4, S) of the signals there
    x, Z            state and its derivative: before a row, at a sample, at a transition
    x_after, Z_after  the same after a row or a reset map
    X, XZ           at the stages of a row: (s, n), (s, n, width)
                    at those of an implicit row that moves with theta, also its slopes behind them: (2 s, ...)
    kept            functions of the C library at the stages of a row, for its backward step: (s, count); then the
                    factors of the coupled equations of an implicit row: see `elimination`
    increments      increments of an implicit row: (s, n)
    newton          of the increments: 0 if their last change was small for the largest state, else 1; 1 if they have
                    converged, else 0
    opens, closes   derivatives of the start and the end of a row: two vectors
    moves           derivative of the time of a node: a vector
    origin          first node of the cell that ends at a node, whose signals are in `signal`
    psi, jump, late  costate; what nodes at the end of a row add to it; what late samples add to it at its start
    costate         of a row, the costate at its start: (n,)
    J, g, H         cost, gradient (width,), Hessian (D, width): sums
    errors          largest estimate of the error of a row in each state: (n,)
    time, y, Y      a time, the outputs of the sensors at it, and their derivatives
    multiplier, constraint, jacobian
                    of some constraints: (m,), their values (m,) and derivatives (m, width)
    moment          (t, first node of the cell), for the adaptive solver; its y is (x, running cost)
    entries         second derivatives at the stages of a row, (s, count)
    check           0, or NaN once a value that was presumed finite is not
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from switchfit.arrays import FloatArray, Traced
from switchfit.discretization import row_errors, rows, tableaus
from switchfit.discretization.model import AT_TRANSITIONS
from switchfit.discretization.rows import Stages, Tangent, combine, times_vector
from switchfit.discretization.runge_kutta import Tableau
from switchfit.discretization.tableaus import EXPLICIT, STIFF
from switchfit.engine.native.elimination import Elimination, Routine, eliminate
from switchfit.engine.native.layout import MOST_KEPT_VALUES, has_jumps
from switchfit.engine.native.llvm.module import Module
from switchfit.engine.native.scalars.graph import CHECKED, Graph, Namespace, Node, Objects, Scalar
from switchfit.engine.native.scalars.operations import MAY_FAIL
from switchfit.engine.native.scalars.template import Template
from switchfit.engine.native.sizes import Order, Sizes
from switchfit.engine.native.templates import COST_TO_GO, ELL, ELL_X, F_P, F_T, F_X, SLOPES, F, Templates
from switchfit.problem.structure import Structure

Store = tuple[str, int, Node]
Places = list[tuple[int, int]]

Second = dict[tuple[int, int], Node]
"""Entries of a second derivative along (t, x, p), by their places: the lower half, or less."""

TakeInputs: TypeAlias = "Callable[..., tuple[Scalar | Objects, ...]]"
"""(t, x, w, hb) -> inputs of the template of a stage; w and hb are zero if they are left out."""

Factors = Elimination | Routine | None
"""Those of the coupled equations of an implicit row; None for an explicit one."""

Along = list[tuple[Node | None, list[Node]]]
"""Derivatives of some scalars along theta, each as a vector and as a list of its entries."""

NO_DERIVATIVE: tuple[None, list[Node]] = (None, [])
"""The derivative of a time that does not depend on theta."""

JUMP_WEIGHT = 1e4
"""Error that counts as much as a jump of the state by 1 inside a row: even a small one spoils derivatives."""

LARGE = 1e200
"""States beyond 1e308 / LARGE count as infinite."""

CHANGE, SMALLEST_CHANGE = 1e-10, 1e-12
"""Relative change of a state at a stage in the last iteration of Newton's method, whose error is the square of the
change before; and the change relative to the largest state at which rounding errors may be all that is left."""

MOST_CURVATURE_AT_ONCE = 120
"""Largest n D, times the number of modes, for which one function adds the curvature of all stages; above it, each call
adds one stage: compiling these functions would take longer than all others."""


class CurvatureFunction(NamedTuple):
    """A function that adds the second derivatives of the stages of a row to H.

    Attributes
    ----------
    name : str
    size : int
        Numbers that it reads at each stage; 0 if there is nothing to add.
    stages : range
        The first stage of each call.
    """

    name: str = ""
    size: int = 0
    stages: range = range(0)


class Kernels:
    """Writes the straight-line functions of a library into a module, with derivatives of an order."""

    adjoint = True
    """Whether derivatives are propagated backward, by a costate."""

    def __init__(self, library: Structure, sizes: Sizes, order: Order, module: Module) -> None:
        self.library, self.sizes, self.order, self.module = library, sizes, order, module
        self.goes_back = self.adjoint and order > Order.COST  # else the functions forward check that they are finite
        self.with_tangents = order > Order.GRADIENT  # the gradient takes the costate alone
        self.templates = Templates(library, sizes, order)
        self.has_late = any(sensor.delay is not None for sensor in library.measurements)
        self.has_jumps = has_jumps(library)
        self.chosen: Places = []
        self._curvatures: dict[tuple[int, tuple[tuple[int, int], ...]], CurvatureFunction] = {}

    def tableau(self, mode: int) -> Tableau:
        """Return the method of a mode."""
        return STIFF if self.library.implicit[mode] else EXPLICIT

    # Rows

    def newton(self, name: str, stage: Template) -> None:
        """Write an iteration of Newton's method for the increments of an implicit row."""
        graph = Graph()
        at, (start, _, h), x = self._row(graph), self._load_times(graph), graph.loads("x", self.sizes.n)

        def field(j: int, X: Objects) -> list[Objects]:
            return stage(graph, *at(start + STIFF.c[j] * h, X), only=(F, F_X))

        self.module.write_straight_line(name, self.correct(graph, h, x, field))

    def correct(
        self, graph: Graph, h: Node, x: Objects, field: Callable[[int, Objects], Sequence[Objects]]
    ) -> list[Store]:
        """Return the stores of an iteration of Newton's method; `field` returns f and D_1 f at a stage.

        The increments have converged once the states of the stages change by less than `CHANGE`, or twice by less than
        `SMALLEST_CHANGE` of the largest state: a state that is the small rest of large terms has rounding errors that
        are large for it.
        """
        xp, k = Namespace(graph), self.load_increments(graph)
        # One step of (I - h a_jl D_1 f_j) dk = h f(t_j, X_j) - k_j. It is judged by the states X_j, not by the
        # increments: f is evaluated at these next, and k_j tends to zero with h.
        states = [x + combine(row, k) for row in STIFF.a]
        found = [field(j, X) for j, X in enumerate(states)]
        slopes, jacobians = zip(*found, strict=True)
        right = [h * slope - own for slope, own in zip(slopes, k, strict=True)]
        changes = eliminate(STIFF.a, h, jacobians).solve(right)
        corrected = [own + change for own, change in zip(k, changes, strict=True)]
        after = np.concatenate([x + combine(row, corrected) for row in STIFF.a])
        change = xp.abs(after - np.concatenate(states))
        size = xp.abs(after) + xp.abs(np.concatenate([x] * len(k)))
        # newton[0] is the verdict of the iteration before (1 at the first): small twice in a row is rounding, once may
        # be luck.
        few = reduce(xp.maximum, change) <= SMALLEST_CHANGE * reduce(xp.maximum, size)
        converged = (reduce(xp.maximum, change - CHANGE * size) <= 0.0) | (few & (graph.load("newton", 0) < 1.0))
        stores = [("newton", 0, graph.apply("select", few, 0.0, 1.0))]
        stores.append(("newton", 1, graph.apply("select", converged, 1.0, 0.0)))
        return stores + store_all("increments", 0, np.concatenate(corrected))

    def load_increments(self, graph: Graph) -> list[Objects]:
        """Load the increments of an implicit row: s arrays (n,)."""
        n = self.sizes.n
        return [graph.loads("increments", n, j * n) for j in range(STIFF.coupled)]

    def forward_row(self, name: str, stage: Template, moving: bool, costs: bool, tableau: Tableau) -> Factors:
        """Write the forward step of a row: its stages, the state after it, their derivatives and its running cost.

        Return the factors that it keeps.
        """
        graph, n = Graph(), self.sizes.n
        at, (start, end, h), x = self._row(graph), self._load_times(graph), graph.loads("x", n)
        checked = not self.goes_back
        wanted, kept = self._find_needs(stage, costs)
        at_stages: list[list[Objects]] = []

        def field(t: Scalar, X: Objects) -> Objects:
            at_stages.append(stage(graph, *at(t, X), only=wanted, also=kept, checked=checked))
            return at_stages[-1][0]

        # The increments k_j = h K_j were found by the loop of `program.write_newton` before; here they are inputs.
        k = self.load_increments(graph) if tableau.coupled else []
        found = rows.stages(tableau, field, start, end, x, k)
        after = x + (combine(tableau.b, k) if k else h * combine(tableau.b, found.slopes))
        stores, factors = store_all("x_after", 0, after), None
        # Without a backward step nothing is kept for it.
        keep: Callable[..., list[Store]] = store_all if self.goes_back else lambda *_: []
        if self.order > Order.COST:
            at_points = found.states
            # The backward step needs slopes only if the row moves: V multiplies them by h'. Those of an explicit row it
            # has from its stages, those of an implicit row are k / h and have to be stored.
            if k:
                f_x = stage(graph, *at(start, x), only=(F_X,))[0]
                found = found._replace(slopes=rows.choose_slopes(h, k, found.slopes, f_x, Namespace(graph)))
                at_points = at_points + (found.slopes if moving else [])
            stores += keep("X", 0, np.concatenate(at_points))
            if kept:
                stores += keep("kept", 0, np.concatenate([values[-1] for values in at_stages]))
            of_x = [values[2] for values in at_stages]
            if k:
                # That the backward step reads them takes 12 to 15 % off (J, g, H) where 8 states depend on each other,
                # 5 % where 4 do. With fewer, or a sparse Jacobian, to compute them again would take as long.
                factors = eliminate(tableau.a, h, of_x, len(tableau.b) * len(kept) if self.goes_back else None)
                stores += factors.stores if self.goes_back else ()
        if self.with_tangents:
            # X_j', K_j' and x+' of `discretization.rows`, with one entry of each vector per unknown: for p this is (10)
            # of the paper discretized, and for tau the products with h' of the rows on both sides of it leave X^i, (8).
            Z = graph.loads("Z", n, vector=True)
            jacobians = [values[1:4] for values in at_stages]
            forcing = [self._along_p(graph, f_p) for _, _, f_p in jacobians]
            h_d = None
            if moving:
                start_d, end_d = self._ends(graph)
                h_d = end_d - start_d
                times_d = rows.times_derivative(tableau, start_d, end_d)
                # D_2 f t_j' + D_p f p', the part of K_j' that does not depend on X_j'.
                forcing = [given + J[0] * t_d for given, J, t_d in zip(forcing, jacobians, times_d, strict=True)]
            # Without `moving` h_d is None: the graph then has none of the products with h', which all other rows would
            # pay for.
            along = rows.tangent(tableau, h, found.slopes, of_x, forcing, Z, h_d, factors)
            vectors = along.states + (along.slopes if k and moving else [])
            stores += keep("XZ", 0, [_as_vector(graph, value) for value in np.concatenate(vectors)])
            stores += store_all("Z_after", 0, [_as_vector(graph, value) for value in along.after])
            stores += () if self.adjoint else self._add_to_step(graph, stage, tableau, found, along, costs)
        if costs:
            densities = [values[wanted.index(ELL)].item() for values in at_stages]
            stores.append(("J", 0, graph.load("J", 0) + h * combine(tableau.b, densities)))
        if checked:
            stores += graph.check()
        self.module.write_straight_line(name, stores)
        return factors

    def _add_to_step(
        self, graph: Graph, stage: Template, tableau: Tableau, found: Stages, along: Tangent, costs: bool
    ) -> list[Store]:
        """Return what a step without a backward one stores: the largest error so far, and what running costs add to g
        and H.

        The ends of such a step do not move. `chosen` becomes which second derivatives are stored for each stage.
        """
        at, (start, _, h), x = self._row(graph), self._load_times(graph), graph.loads("x", self.sizes.n)
        if tableau.coupled:
            slope, jacobian = stage(graph, *at(start, x), only=(F, F_X), checked=True)
            error = row_errors.estimate_error(h, self.load_increments(graph), slope, jacobian, eliminate)
        else:
            error = h * combine(tableaus.EXPLICIT_ERROR, found.slopes)
        # The larger of the error so far and that of this step, relative to rtol (smallest + |x|).
        (rtol, smallest), xp, largest = graph.loads("tolerances", 2), Namespace(graph), graph.load("error", 0)
        for relative in xp.abs(error) / (rtol * (smallest + xp.abs(x))):
            largest = xp.where(relative <= largest, largest, relative)  # false for NaN, which then is the error
        stores = [("error", 0, largest)]
        if not costs:
            return stores
        g, second = graph.load("g", 0, vector=True), []
        for j, (weight, t, X, X_d) in enumerate(zip(tableau.b.tolist(), *found[:2], along.states, strict=True)):
            # With w = 0 the second derivatives of w . f + h b_j ell are those of the running cost alone, weighted as in
            # J.
            given = at(t, X, hb=h * weight)
            g_x, g_p, S = stage(graph, *given, only=COST_TO_GO[1:], checked=True)
            # Forward, g' = sum_j h b_j (D_x ell X_j' + D_p ell p'): no costate, since thousands of children share no
            # future.
            g = g + (g_x * X_d).sum() + self._along_p(graph, g_p)
            second.append(list_entries(S, with_time=False))
            stores += store_all("XZ", j * self.sizes.n, [_as_vector(graph, value) for value in X_d])
        self.chosen, entries = self._store_entries(graph, tableau, second)
        return [*stores, ("g", 0, _as_vector(graph, g)), *entries]

    def judge_row(self, mode: int, stage: Template, tableau: Tableau) -> None:
        """Write what a row that was computed adds to the largest errors: its own one; and a jump inside, which counts
        more.
        """
        graph = Graph()
        at, (x, h, _, after) = self._row(graph), self._load_row(graph, tableau)
        # The slopes are not in memory, but h K_j follow from the states: a linear map, whose weights are known numbers.
        inverse = rows.invert_stages(tableau)
        if tableau.coupled:
            slope, f_x = stage(graph, *at(graph.load("row", 0), x), only=(F, F_X))
            k = [combine(row, [X - x for X in after]) for row in inverse]
            errors = row_errors.estimate_error(h, k, slope, f_x, eliminate)
        else:
            # sum_j e_j h K_j with h K = inverse (X - x): the weights of the states, and what they leave of x.
            weights = tableaus.EXPLICIT_ERROR @ inverse
            errors = combine(weights, after) - weights.sum() * x
        self._add_to_errors(f"error_{mode}", graph, Namespace(graph).abs(errors))

        graph = Graph()
        at, (x, h, states, after) = self._row(graph), self._load_row(graph, tableau)
        # The middle stage and the bend see a jump that the first and the last one straddle; see `rows.measure_jump`.
        changes = [X - x for X in after]
        first, middle, last = (combine(inverse[j], changes) for j in (0, len(inverse) // 2, -1))
        bend = combine((tableaus.STIFF_BEND if tableau.coupled else tableaus.EXPLICIT_BEND) @ inverse, changes)
        times = [graph.load("row", 0) + c * h for c in tableau.c[[0, -1]].tolist()]
        ends = [stage(graph, *at(t, X), only=(F_T, F_X)) for t, X in zip(times, (states[0], states[-1]), strict=True)]
        # The mean of the derivatives at both ends times the change of (t, X) is how f would change if it were smooth.
        f_t, f_x = (one + other for one, other in zip(*ends, strict=True))
        smooth = 0.5 * h * (times_vector(f_x, states[-1] - states[0]) + f_t * (times[1] - times[0]))
        jump = row_errors.measure_jump(first, middle, last, bend, smooth, Namespace(graph))
        self._add_to_errors(f"jump_{mode}", graph, JUMP_WEIGHT * jump)

    def _load_row(self, graph: Graph, tableau: Tableau) -> tuple[Objects, Node, list[Objects], list[Objects]]:
        """Return the state at the start of a row, its length, the states at its stages, those of `invert_stages`."""
        n, x = self.sizes.n, graph.loads("x", self.sizes.n)
        states = [graph.loads("X", n, j * n) for j in range(len(tableau.b))]
        after = states if tableau.coupled else [*states[1:], graph.loads("x_after", n)]
        return x, self._load_times(graph)[2], states, after

    def _load_times(self, graph: Graph) -> tuple[Node, Node, Node]:
        """Return the start, the end and the length of a row."""
        start, end = graph.load("row", 0), graph.load("row", 1)
        return start, end, end - start

    def _add_to_errors(self, name: str, graph: Graph, found: Objects) -> None:
        xp, so_far = Namespace(graph), graph.loads("errors", self.sizes.n)
        largest = xp.where(xp.less(so_far, found), found, so_far)  # where one is NaN, J is
        self.module.write_straight_line(name, store_all("errors", 0, largest))

    def backward_row(
        self, name: str, stage: Template, moving: bool, costs: bool, tableau: Tableau, factors: Factors, late: bool
    ) -> Places:
        """Write the backward step of a row: the costate before it, its part of the gradient, second derivatives.

        Return which entries of the second derivative along (t, x, p) are stored for each stage. If time is among them,
        c_j is stored after them. `factors` are those that the forward step of an implicit row keeps. The row of a
        `late` sample belongs to no segment: no node lies at its ends, so that no jump is added to the costate.
        """
        graph, n = Graph(), self.sizes.n
        at, (start, _, h), count = self._row(graph), self._load_times(graph), len(tableau.b)
        states = [graph.loads("X", n, j * n) for j in range(count)]
        times = [start + c * h for c in tableau.c.tolist()]
        _, kept = self._find_needs(stage, costs)
        # Sines and the like are taken from the forward row. What was infinite there is infinite here: still to be
        # checked.
        known: list[dict[int, Node]] = [{} for _ in range(count)]
        for j, k in np.ndindex(count, len(kept)):
            known[j][kept[k].index] = graph.load("kept", j * len(kept) + k, certain=kept[k].op not in MAY_FAIL)
        # psi(t_k-) = psi(t_k+) + D l_k: samples and functions at the node behind the row have put D_x l into `jump`.
        psi = graph.loads("psi", n)
        if self.has_jumps and not late:
            psi = psi + graph.loads("jump", n)
        # Filled by `pull`: second derivatives of w_j . f + h b_j ell, and f, ell and their first derivatives for V.
        second: list[Second] = [{}] * count
        slopes: list[list[Objects]] = [[]] * count

        def pull(j: int, w: Objects, hb: Scalar) -> tuple[Node, Objects, Objects]:
            given = at(times[j], states[j], w, hb)
            g_t, g_x, g_p, S = stage(graph, *given, only=COST_TO_GO, checked=True, known=known[j])
            second[j] = list_entries(S, with_time=moving)
            if moving:
                slopes[j] = stage(graph, *given, only=SLOPES, known=known[j])
            return g_t.item(), g_x, g_p

        ell_x: list[Objects] = []
        if factors is not None:
            # The w_j of an implicit row depend on one another: D_1 ell at all stages is needed before any `pull`.
            points = zip(times, states, known, strict=True)
            ell_x = [stage(graph, *at(t, X), only=(ELL_X,), known=kept_there)[0] for t, X, kept_there in points]
            factors = factors.load(graph)
        # psi, w_j and mu_j of `discretization.rows`: (7) of the paper for the discretized system.
        found = rows.adjoint(tableau, h, psi, pull, ell_x, factors)
        # A late sample ends a row of its own, which starts where the row around it does: `late` is its costate there.
        before = found.before + graph.loads("late", n) if self.has_late else found.before
        stores = store_all("late" if late else "psi", 0, before)
        if not late:
            stores += store_all("costate", 0, before)
        g = graph.load("g", 0, vector=True) + self._along_p(graph, found.parameters)
        if moving:
            # D_tau J of a row that tau opens or closes: t_j' times D_2 (w_j . f + h b_j ell), and h' times V. Summed
            # over the two rows beside tau this is psi X^i, (6), of the discretized cost.
            start_d, end_d = self._ends(graph)
            times_d = rows.times_derivative(tableau, start_d, end_d)
            K = [graph.loads("X", n, (count + j) * n) if tableau.coupled else s[0] for j, s in enumerate(slopes)]
            factor = rows.length_factor(tableau, psi, found.states, K, [s[4].item() for s in slopes])
            g = g + factor * (end_d - start_d) + sum(g_t * t_d for g_t, t_d in zip(found.times, times_d, strict=True))
            if self.order == Order.HESSIAN:
                # V' along theta with psi and mu held: how these move is in Z' S Z already. V is linear in K_j and
                # ell_j, so that `length_factor` of K_j' and ell_j' is V'. The explicit K_j' are those of the forward
                # row, computed anew.
                K_d, ell_d = [], []
                for j, (_, f_t, D_1f, f_p, _, l_t, l_x, l_p) in enumerate(slopes):
                    X_d = graph.loads("XZ", n, j * n, vector=True)
                    if tableau.coupled:
                        K_d.append(graph.loads("XZ", n, (count + j) * n, vector=True))
                    else:
                        K_d.append(times_vector(D_1f, X_d) + self._along_p(graph, f_p) + f_t * times_d[j])
                    ell_d.append((l_x * X_d).sum() + self._along_p(graph, l_p) + l_t.item() * times_d[j])
                factor_d = rows.length_factor(tableau, psi, found.states, K_d, ell_d)
                stores.append(("length", 0, _as_vector(graph, factor_d)))
        stores.append(("g", 0, _as_vector(graph, g)))
        # S_j goes to memory, not to H: Z' S Z is long, and rows of all modes share the functions that add it.
        chosen, entries = self._store_entries(graph, tableau, second)
        self.module.write_straight_line(name, stores + entries + graph.check())
        return chosen

    def _store_entries(self, graph: Graph, tableau: Tableau, second: Sequence[Second]) -> tuple[Places, list[Store]]:
        """Return which entries of the second derivatives at the stages of a row are stored, and the stores."""
        # One list of entries for all stages: what is a structural zero at each is neither stored nor multiplied.
        chosen, stores = sorted({key for each in second for key, node in each.items() if node.number != 0.0}), []
        for c_j, each in zip(tableau.c.tolist(), second, strict=True):
            stores += [each[key] for key in chosen] + [graph.constant(c_j)] * _has_time(chosen)
        return chosen, store_all("entries", 0, stores)

    def curvature(self, name: str, chosen: Places, tableau: Tableau) -> CurvatureFunction:
        """Return the function ``H += Z' S Z`` at all stages of a row or at one, for entries of S from `backward_row`;
        write it unless an earlier row has the same entries.

        Rows that move with theta have the entries of the others unless the mode depends on time, and modes may have the
        same ones. These functions are the longest: shared, a program of two modes compiles in 0.7 s, not 0.9 s.
        """
        stages = len(tableau.b)
        key = stages, tuple(chosen)
        if key in self._curvatures or not chosen:
            return self._curvatures.get(key, CurvatureFunction())
        graph, n, D = Graph(), self.sizes.n, self.sizes.D
        H = [graph.load("H", d, vector=True) for d in range(D)]
        sums = H
        moving = _has_time(chosen)
        # One function for all stages of a row, else for each, since it would be too long.
        size, at_once = len(chosen) + moving, stages if n * D * len(self.library.modes) <= MOST_CURVATURE_AT_ONCE else 1
        for j in range(at_once):
            second = {key: graph.load("entries", j * size + k) for k, key in enumerate(chosen)}
            of_time = NO_DERIVATIVE
            if moving:
                # t_j' = start' + c_j h'; c_j comes from memory because a function for one stage is called for each of
                # them.
                c_j = graph.load("entries", j * size + len(chosen))
                start_d, end_d = self._ends(graph)
                starts, ends = ([graph.load(name, d) for d in range(D)] for name in ("opens", "closes"))
                entries = [one + c_j * (other - one) for one, other in zip(starts, ends, strict=True)]
                of_time = start_d + c_j * (end_d - start_d), entries
            sums = self._add_curvature(graph, sums, second, [of_time, *self._directions(graph, "XZ", n, j * n)])
        self.module.write_straight_line(name, _store_changed_rows(H, sums))
        self._curvatures[key] = CurvatureFunction(name, size, range(0, stages, at_once))
        return self._curvatures[key]

    def length(self) -> None:
        """Write ``H += h' x V' + V' x h'``, V' being what `backward_row` stored for a row that moves."""
        graph = Graph()
        start_d, end_d = self._ends(graph)
        along = graph.load("length", 0, vector=True)
        stores = []
        for d in range(self.sizes.D):
            # Row d of h' x V' + V' x h': both vectors are also read entry by entry.
            h_d = graph.load("closes", d) - graph.load("opens", d)
            row = graph.load("H", d, vector=True) + h_d * along + graph.load("length", d) * (end_d - start_d)
            stores.append(("H", d, row))
        self.module.write_straight_line("length", stores)

    # Nodes

    def nodes(self) -> None:
        """Write the functions of all nodes."""
        library = self.library
        # x(t0) of p is a reset map without a state before it.
        maps = {"start": self.templates.start()}
        maps |= {f"reset_{which}": self.templates.reset(which) for which in range(len(library.reset_maps))}
        for name, template in maps.items():
            self._map_forward(name, template)
            if self.goes_back:
                self._map_back(name, template, of_start=name == "start")
        for kind in AT_TRANSITIONS:
            inputs = "time", "x", "p", "multiplier", "origin", "signal"
            add = self._constraint if kind == "guards" else self._cost
            for which in range(len(getattr(library, kind))):
                template = self.templates.transition(kind, which)
                self._write_node(f"{kind}_{which}", add, template, True, *inputs, multiplier=1)
        for k, sensor in enumerate(library.measurements):
            template, lengths = self.templates.sample(k), dict.fromkeys(("value", "weight"), sensor.channels)
            is_late = sensor.delay is not None  # its time depends on theta then
            self._write_node(f"sample_{k}", self._cost, template, is_late, "time", *lengths, "x", "p", **lengths)
        if library.terminal:
            self._write_node("end", self._cost, self.templates.end(), False, "x", "p")
        if library.terminal_constraints:
            given = False, "x", "p", "multiplier"
            template = self.templates.end_constraint()
            self._write_node("end_constraint", self._constraint, template, *given, multiplier=self.sizes.m)

    def _map_forward(self, name: str, template: Template) -> None:
        graph, n, checked = Graph(), self.sizes.n, not self.goes_back
        t, x, p, *constants = self._load_inputs(graph, "time", "x", "p")
        given = t, x, p, np.full(n, graph.constant(0.0), dtype=object), *constants
        (after,) = template(graph, *given, only=(0,), checked=checked)
        stores = store_all("x_after", 0, after)
        if self.with_tangents:
            # Z is the derivative of x(tau-) at a tau that moves, so that f_{i-1} dtau is in it, and Z+ that of x(tau+):
            #     Z+ = D_x R Z + D_p R p' + D_t R tau'
            # The term -f_i(x+) dtau of X^i, (8), comes from the row behind tau, which starts later.
            R_t, R_x, R_p = template(graph, *given, only=(1, 2, 3))
            Z, moves = graph.loads("Z", n, vector=True), graph.load("moves", 0, vector=True)
            Z_after = times_vector(R_x, Z) + self._along_p(graph, R_p) + R_t * moves
            stores += store_all("Z_after", 0, [_as_vector(graph, v) for v in Z_after])
        self.module.write_straight_line(name, stores + (graph.check() if checked else []))

    def _map_back(self, name: str, template: Template, of_start: bool) -> None:
        graph, n = Graph(), self.sizes.n
        t, x, p, *constants = self._load_inputs(graph, "time", "x", "p")
        # derivatives: those of psi . R, first in t, x, p, then second. psi(tau-) = psi(tau+) D_x R is the second of
        # them.
        psi = graph.loads("psi", n)
        # No row ends at t0 whose backward step would add what samples there have put into `jump`.
        if of_start and self.has_jumps:
            psi = psi + graph.loads("jump", n)
        derivatives = template(graph, t, x, p, psi, *constants, only=range(4, len(template.shapes)), checked=True)
        stores = [] if of_start else store_all("psi", 0, derivatives[1])
        stores += self._scalar(graph, derivatives, moving=not of_start)
        self.module.write_straight_line(f"{name}_back", stores + graph.check())

    def late_time(self, k: int) -> None:
        """Write the time at which a late sample saw the state, which is the end of its row, and its derivative."""
        graph = Graph()
        t, t_p = self.templates.late_time(k)(graph, *self._load_inputs(graph, "time", "p"), checked=True)
        stores = [("row", 1, t.item())]
        if self.order > Order.COST:
            stores.append(("closes", 0, _as_vector(graph, self._along_p(graph, t_p))))
        self.module.write_straight_line(f"late_time_{k}", stores + graph.check())

    def _write_node(
        self, name: str, add: Callable[..., Any], template: Template, moving: bool, *inputs: str, **lengths: int
    ) -> None:
        """Write the stores that `add` returns for a cost, or constraints, at a node; `moving` if its time depends on
        theta.
        """
        graph = Graph()
        found = template(graph, *self._load_inputs(graph, *inputs, **lengths), checked=True)
        self.module.write_straight_line(name, add(graph, found, moving) + graph.check())

    def state(self) -> None:
        """Write a check that a state and its tangents are finite.

        A state counts as infinite above a bound below which products of a few entries do not overflow. The check is
        needed because products of zero with states were left out: the results may not show that a state is infinite.
        """
        graph, n = Graph(), self.sizes.n
        total = graph.load(CHECKED, 0)
        for x in graph.loads("x", n):
            # 0 times infinity or NaN is NaN: the sum is 0, or NaN if any factor is not finite. LARGE takes large ones
            # there too.
            total = total + graph.find_failure(x * LARGE)
        if self.with_tangents:
            for k in range(n):
                for Z in graph.loads("Z", self.sizes.D, k * self.sizes.width):
                    total = total + graph.find_failure(Z)
        self.module.write_straight_line("check_state", [(CHECKED, 0, total)])

    def outputs(self) -> None:
        """Write the outputs of all sensors and their derivatives."""
        graph = Graph()
        y, *jacobians = self.templates.outputs()(graph, *self._load_inputs(graph, "time", "x", "p"), checked=True)
        stores = store_all("y", 0, y)
        if self.order > Order.COST:
            h_x, h_p = jacobians
            y_d = times_vector(h_x, graph.loads("Z", self.sizes.n, vector=True)) + self._along_p(graph, h_p)
            stores += store_all("Y", 0, [_as_vector(graph, value) for value in y_d])
        self.module.write_straight_line("outputs", stores + graph.check())

    # Shared parts

    def _find_needs(self, stage: Template, costs: bool) -> tuple[tuple[int, ...], list[Node]]:
        """Return which outputs of a stage the forward step of a row needs, and what it keeps for the backward one.

        Kept are values of functions of the C library. The vehicle's sines and cosines take a quarter of an evaluation
        where both steps compute them.
        """
        outputs = (F, *((F_T, F_X, F_P) if self.order > Order.COST else ()), *((ELL,) if costs else ()))
        most = MOST_KEPT_VALUES * self.sizes.n if self.goes_back else 0
        return outputs, stage.list_long(outputs)[:most]

    def _load_constants(self, graph: Graph) -> tuple[Objects, list[Objects]]:
        """Load p and the constants."""
        p, offset, constants = graph.loads("p", self.sizes.M), 0, []
        for shape in self.sizes.constants:
            count = int(np.prod(shape))
            constants.append(graph.loads("c", count, offset))
            offset += count
        return p, constants

    def _load_inputs(self, graph: Graph, *names: str, **lengths: int) -> list[Objects]:
        """Load the inputs of the template of a node, and the constants."""
        p, constants = self._load_constants(graph)
        lengths = {"time": 1, "x": self.sizes.n, "origin": 1, "signal": 4 * self.sizes.signals} | lengths
        return [*(p if name == "p" else graph.loads(name, lengths[name]) for name in names), *constants]

    def _row(self, graph: Graph) -> TakeInputs:
        """Return the inputs of a stage of a row as a function, as `take_inputs` does."""
        return self.take_inputs(graph, graph.load("row", 2), "signal")

    def take_inputs(self, graph: Graph, origin: Node, signal_at: str) -> TakeInputs:
        """Return the inputs of a stage as a function of (t, x, w, hb); w and hb default to zero."""
        (p, constants), zero = self._load_constants(graph), graph.constant(0.0)
        signal = graph.loads(signal_at, 4 * self.sizes.signals)
        zeros = np.full(self.sizes.n, zero, dtype=object)
        return lambda t, x, w=zeros, hb=zero: (t, x, p, w, hb, origin, signal, *constants)

    def _ends(self, graph: Graph) -> tuple[Node, Node]:
        return graph.load("opens", 0, vector=True), graph.load("closes", 0, vector=True)

    def _units(self, graph: Graph) -> list[Node]:
        """Return the derivatives of p along theta."""
        return [graph.unit(self.sizes.T + k) for k in range(self.sizes.M)]

    def _along_p(self, graph: Graph, derivatives: Objects) -> Traced:
        """Return ``sum_k derivatives[..., k] p_k'``: of shape (...)."""
        total: Scalar | Objects | FloatArray = 0.0 if derivatives.ndim == 1 else np.zeros(derivatives.shape[:-1])
        for k, unit in enumerate(self._units(graph)):
            total = total + derivatives[..., k] * unit
        return total

    def _scalar(self, graph: Graph, derivatives: Sequence[Objects], moving: bool) -> list[Store]:
        """Return stores that add the derivatives of a scalar, g_t, g_x, g_p and the second ones, to g and H."""
        # g_x is left to the costate, if there is one: the caller adds it to `jump`, and D_x of it reaches theta by the
        # rows before.
        g_t, g_x, g_p, second = derivatives
        g = graph.load("g", 0, vector=True) + self._along_p(graph, g_p)
        if not self.adjoint:
            g = g + (g_x * graph.loads("Z", self.sizes.n, vector=True)).sum()
        if moving:
            g = g + g_t.item() * graph.load("moves", 0, vector=True)
        stores = [("g", 0, _as_vector(graph, g))]
        H = [graph.load("H", d, vector=True) for d in range(self.sizes.D)]
        of_time = self._directions(graph, "moves", 1) if moving else [NO_DERIVATIVE]
        along = [*of_time, *self._directions(graph, "Z", self.sizes.n)]
        sums = self._add_curvature(graph, H, list_entries(second, with_time=moving), along)
        return stores + _store_changed_rows(H, sums)

    def _cost(self, graph: Graph, found: Sequence[Objects], moving: bool) -> list[Store]:
        """Return stores that add a cost at a node to J, g, H and the costate."""
        cost, *derivatives = found
        stores = [("J", 0, graph.load("J", 0) + cost.item())]
        if self.order == Order.COST:
            return stores
        if self.adjoint:
            stores += store_all("jump", 0, graph.loads("jump", self.sizes.n) + derivatives[1])
        return stores + self._scalar(graph, derivatives, moving)

    def _constraint(self, graph: Graph, found: Sequence[Objects], moving: bool) -> list[Store]:
        """Return stores of constraints and their tangents, and those that add ``multipliers . c`` to g, H and psi."""
        stores = store_all("constraint", 0, found[0])
        if self.order == Order.COST:
            return stores
        _, c_t, c_x, c_p, *derivatives = found
        # The row of the Jacobian follows forward, by Z; lam . c goes backward with the costate, as a cost, for the
        # Lagrangian.
        if self.with_tangents:
            c_d = times_vector(c_x, graph.loads("Z", self.sizes.n, vector=True)) + self._along_p(graph, c_p)
            if moving:
                c_d = c_d + c_t * graph.load("moves", 0, vector=True)
            stores += store_all("jacobian", 0, [_as_vector(graph, value) for value in c_d])
        stores += store_all("jump", 0, graph.loads("jump", self.sizes.n) + derivatives[1])
        return stores + self._scalar(graph, derivatives, moving)

    def _directions(self, graph: Graph, pointer: str, count: int, first: int = 0) -> Along:
        """Load the derivatives along theta of some scalars."""
        D, width = self.sizes.D, self.sizes.width
        return [
            (graph.load(pointer, k, vector=True), [graph.load(pointer, k * width + d) for d in range(D)])
            for k in range(first, first + count)
        ]

    def _add_curvature(self, graph: Graph, H: list[Node], second: Second, along: Along) -> list[Node]:
        """Add ``Z' S Z`` to the rows of H, S given by its lower half along (t, x, p); `along` is Z of t and x."""
        n, T = self.sizes.n, self.sizes.T
        # H_d += Z_kd (S_km Z_m), summed over k and m along (t, x, p). S is symmetric and given by its lower half: each
        # entry beside the diagonal counts for (k, m) and for (m, k). The inner product is a vector, the outer a scalar
        # times it.
        vectors = [vector for vector, _ in along] + self._units(graph)
        product: dict[int, Any] = {}
        for (k, m), value in second.items():
            for one, other in {(k, m), (m, k)}:
                product[one] = product.get(one, 0.0) + value * vectors[other]
        rows = []
        for d, row in enumerate(H):
            for k, entries in enumerate(entries for _, entries in along):
                if k in product:
                    row = row + entries[d] * product[k]
            # Z of p_k is the unit vector e_{T + k}: only row T + k gets it, with factor 1.
            if 1 + n + d - T in product and d >= T:
                row = row + product[1 + n + d - T]
            rows.append(row)
        return rows


def list_entries(second: Objects, with_time: bool) -> Second:
    """Return the lower half of a second derivative along (t, x, p), all of it or that along (x, p)."""
    first = 0 if with_time else 1
    return {(k, m): second[k, m] for k in range(first, len(second)) for m in range(first, k + 1)}


def _has_time(chosen: Iterable[tuple[int, int]]) -> bool:
    """Return whether time is among the entries of a second derivative."""
    return any(column == 0 for _, column in chosen)


def _store_changed_rows(H: list[Node], rows: list[Node]) -> list[Store]:
    return [("H", d, row) for d, (old, row) in enumerate(zip(H, rows, strict=True)) if row is not old]


def _as_vector(graph: Graph, value: Scalar) -> Node:
    """Return a vector node, also if the value turned out to be a scalar zero."""
    if isinstance(value, Node) and value.vector:
        return value
    return graph.unit(-1)


def store_all(pointer: str, offset: int, values: Iterable[Node]) -> list[Store]:
    """Return stores of values at consecutive places."""
    return [(pointer, offset + k, node) for k, node in enumerate(values)]
