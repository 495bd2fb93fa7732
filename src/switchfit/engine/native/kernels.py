"""The functions of a model with their derivatives, and one step of the discretised system, as straight lines.

The mathematics is that of `switchfit.engine.jax.second_order`, backward in second order. For one row with stages
``X_j = x + h sum_l a_jl K_l``, ``K_j = f(t_j, X_j, p)``:

forward    x and its derivative Z along theta, a vector an entry: ``X_j' = Z + h' (..) + h sum_l a_jl K_l'``,
           ``K_j' = D_1 f X_j' + D_2 f t_j' + D_p f p'``;
backward   ``w_j = h b_j psi + h sum_l a_lj mu_l``, ``mu_j = D_x (w_j . f + h b_j ell)``,
           ``psi_before = psi + sum mu_j``, and the Hessian gains ``Z_j' D^2 (w_j . f + h b_j ell) Z_j`` at every stage.

Only rows that open or close a mode have a length and times that depend on theta: these *end rows* have their own form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import RK45

from switchfit.discretization.arguments import Arguments, Samples
from switchfit.discretization.model import Model, Piece
from switchfit.discretization.tableaus import EXPLICIT
from switchfit.engine.native.llvm import Module
from switchfit.engine.native.scalars import CHECKED, Graph, Node, Objects, Template, as_objects
from switchfit.engine.native.trace import traced
from switchfit.problem.structure import Structure

a, b, c = EXPLICIT.a.tolist(), EXPLICIT.b.tolist(), EXPLICIT.c.tolist()
STAGES = len(b)

Shape = tuple[int, ...]
Store = tuple[str, int, Node]


@dataclass(frozen=True)
class Sizes:
    """What a program depends on beside the structure.

    Attributes
    ----------
    n, N, M : states, transitions, entries of p
    signals : channels of all signals
    constants : shapes of all that is given and no signal: fixed parameters, weights of references, initial state
    """

    n: int
    N: int
    M: int
    signals: int
    constants: tuple[Shape, ...]

    @classmethod
    def of(cls, structure: Structure, arguments: Arguments) -> Sizes:
        """Those of one experiment."""
        constants = tuple(np.shape(a) for a in constants_of(arguments))
        return cls(structure.n, structure.N, structure.M, arguments.signals.shape[2], constants)

    @property
    def D(self) -> int:
        """Unknowns: all transition times, then p."""
        return self.N + self.M

    @property
    def width(self) -> int:
        """Entries of a vector: even, so that vector instructions of the processor fit."""
        return self.D if self.D == 1 else self.D + self.D % 2

    @property
    def stages_at_once(self) -> int:
        """Stages that one function adds to the Hessian: all of a row, unless the function became too long."""
        return STAGES if self.n * self.D <= SHORT else 1


LARGE = 1e200
"""States beyond 1e308 / LARGE count as infinite."""

SHORT = 100
"""Products of a row with a vector that are written out for each stage."""


def constants_of(arguments: Arguments) -> list[Any]:
    """What functions of the model look at beside t, x, p and signals."""
    return [*arguments.fixed, *arguments.weights, arguments.initial_state]


class Adaptive(NamedTuple):
    """Places in the state of the adaptive solver.

    t, h : where it is, and how long a step it will try; `step` is what it tries, which may be cut by the `end`
    rtol, atol : tolerances
    refused, stuck : 1 if the last step was refused; if the next would not change t
    low, high : between which moments the field may be asked
    """

    t: int = 0
    h: int = 1
    end: int = 2
    rtol: int = 3
    atol: int = 4
    refused: int = 5
    stuck: int = 6
    low: int = 7
    high: int = 8
    step: int = 9

    @property
    def size(self) -> int:
        """Number of places."""
        return len(self)


class Kernels:
    """Writes the functions of one structure into a module, with derivatives up to an order.

    Every pointer means the same wherever its name stands:

        c, p            constants, parameters
        row, signal     (start, end, first node of the cell), coefficients (4, S) of the signals there
        x, Z            state and its derivative: before a row, at a sample, at a transition
        x_after, Z_after  the same behind a row or a reset map
        X, XZ           at the stages of a row: (s, n), (s, n, width)
        opens, closes   derivatives of the start and the end of a row: two vectors
        psi, jump       costate; what samples at the end of a row add to it
        J, g, H         cost, gradient (width,), Hessian (D, width): sums
        time, y, Y      a moment, what the sensors see then, and its derivative
        moment          (t, first node of the cell), for the adaptive solver; its y is (x, running cost)
        entries         second derivatives at the stages of a row, (s, count)
        check           not a number once something was not finite that had been presumed so, else 0
    """

    def __init__(self, structure: Structure, sizes: Sizes, order: int, module: Module) -> None:
        self.structure, self.sizes, self.order, self.module = structure, sizes, order, module
        self.second = order == 2
        self.has_samples = bool(structure.measurements)

    # The functions of the model, traced

    def model(self, constants: tuple[Any, ...]) -> Model:
        """The model with traced constants."""
        fixed = sum(not free for _, _, free in self.structure.parameters)
        arguments = Arguments(
            nodes=jnp.zeros(2),
            signals=jnp.zeros((1, 4, self.sizes.signals)),
            fixed=tuple(constants[:fixed]),
            initial_state=constants[-1],
            samples=(),
            weights=tuple(constants[fixed:-1]),
        )
        return Model(self.structure, arguments)

    def at_stage(self, mode: int) -> Template:
        """f, ell, their derivatives and those of ``w . f + hb ell``; `F` and what follows it say the places."""
        n, M, S = self.sizes.n, self.sizes.M, self.sizes.signals

        def stage(t: Any, x: Any, p: Any, w: Any, hb: Any, origin: Any, coefficients: Any, *constants: Any) -> Any:
            model = self.model(constants)
            piece = Piece(origin, coefficients)
            f, ell = model.field(mode, piece), model.density(piece)
            zero = jnp.zeros(())
            if self.order == 0:
                nothing = [zero] * 3
                return [f(t, x, p), *nothing, ell(t, x, p)]
            slope = (f(t, x, p), *jax.jacfwd(f, argnums=(0, 1, 2))(t, x, p))
            cost = (zero, zero, jnp.zeros(n), jnp.zeros(M))
            if model.has_running_cost:
                value, gradient = jax.value_and_grad(ell, argnums=(0, 1, 2))(t, x, p)
                cost = (value, *gradient)

            def weighted(t: Any, x: Any, p: Any) -> Any:
                return w @ f(t, x, p) + (hb * ell(t, x, p) if model.has_running_cost else 0.0)

            return [*slope, *cost, *_first_and_second(weighted, t, x, p)]

        also = " or a running cost" if self.structure.running or self.structure.references else ""
        name = f"mode {self.structure.mode_names[mode]!r}{also}"
        return traced(stage, (), (n,), (M,), (n,), (), (), (4, S), *self.sizes.constants, name=name)

    def at_sample(self, k: int) -> Template:
        """Cost of a sample and its derivatives along (t, x, p), that along t being nothing."""
        q = self.structure.measurements[k].channels

        def sample(time: Any, value: Any, weight: Any, x: Any, p: Any, *constants: Any) -> Any:
            model = self.model(constants)
            given = Samples(jnp.zeros((), int), time, value, weight)
            cost = lambda t, x, p: model.sample_cost(k, given, x, p)  # noqa: E731
            if self.order == 0:
                return [cost(time, x, p)]
            return [cost(time, x, p), *_first_and_second(cost, time, x, p)]

        shapes = (), (q,), (q,), (self.sizes.n,), (self.sizes.M,)
        return traced(sample, *shapes, *self.sizes.constants, name="observe of Measurements")

    def at_end(self) -> Template:
        """The terminal costs and their derivatives."""

        def end(x: Any, p: Any, *constants: Any) -> Any:
            model = self.model(constants)
            cost = lambda t, x, p: model.terminal(x, p)  # noqa: E731
            if self.order == 0:
                return [cost(0.0, x, p)]
            return [cost(0.0, x, p), *_first_and_second(cost, jnp.zeros(()), x, p)]

        return traced(end, (self.sizes.n,), (self.sizes.M,), *self.sizes.constants, name="a terminal cost")

    def at_reset(self, i: int) -> Template:
        """The reset map of transition i, its Jacobians, and the derivatives of ``w . R``."""

        def reset(t: Any, x: Any, p: Any, w: Any, *constants: Any) -> Any:
            R = self.model(constants).reset(i)
            if self.order == 0:
                return [R(t, x, p)]
            jacobians = jax.jacfwd(R, argnums=(0, 1, 2))(t, x, p)
            return [R(t, x, p), *jacobians, *_first_and_second(lambda t, x, p: w @ R(t, x, p), t, x, p)]

        n, structure = self.sizes.n, self.structure
        name = f"reset map {tuple(structure.mode_names[mode] for mode in structure.mode_of_segment[i : i + 2])}"
        return traced(reset, (), (n,), (self.sizes.M,), (n,), *self.sizes.constants, name=name)

    def at_start(self) -> Template:
        """x(t0), its Jacobian (n, M) in p, and the derivatives of ``w . x(t0)``: (M,) and (M, M)."""

        def start(p: Any, w: Any, *constants: Any) -> Any:
            x0 = self.model(constants).initial_state
            if self.order == 0:
                return [x0(p)]
            weighted = lambda p: w @ x0(p)  # noqa: E731
            return [x0(p), jax.jacfwd(x0)(p), jax.grad(weighted)(p), jax.jacfwd(jax.grad(weighted))(p)]

        return traced(start, (self.sizes.M,), (self.sizes.n,), *self.sizes.constants, name="initial_state")

    # Straight lines

    def inputs(self, graph: Graph) -> tuple[Objects, list[Objects]]:
        """p and the constants."""
        p, offset, constants = graph.loads("p", self.sizes.M), 0, []
        for shape in self.sizes.constants:
            count = int(np.prod(shape))
            constants.append(graph.loads("c", count, offset))
            offset += count
        return p, constants

    def units(self, graph: Graph) -> list[Node]:
        """Derivatives of p along theta."""
        return [graph.unit(self.sizes.N + k) for k in range(self.sizes.M)]

    def forward_row(self, name: str, stage: Template, end_row: bool) -> None:
        """One row: states at its stages and behind it, their derivatives, and what it costs."""
        graph, n = Graph(), self.sizes.n
        p, constants = self.inputs(graph)
        start, end, origin = graph.loads("row", 3)
        signal = graph.loads("signal", 4 * self.sizes.signals)
        h = end - start
        x, nothing = graph.loads("x", n), graph.constant(0.0)
        w = np.full(n, nothing, dtype=object)
        Z = graph.loads("Z", n, vector=True)
        units = self.units(graph)
        start_d, end_d = (graph.load(name, 0, vector=True) for name in ("opens", "closes"))
        h_d = end_d - start_d
        K: list[Objects] = []
        K_d: list[Objects] = []
        stores: list[Store] = []
        cost = nothing
        for j in range(STAGES):
            X_j = x + h * _combined(a[j], K) if any(a[j]) else x
            t_j = start + c[j] * h
            given = (t_j, X_j, p, w, nothing, origin, signal, *constants)
            f, ell = stage(graph, *given, only=(F, ELL), checked=self.order == 0)
            if self.order > 0:
                stores += _stored("X", j * n, X_j)
            cost = cost + b[j] * ell.item()
            if self.second:
                f_t, f_x, f_p = stage(graph, *given, only=(F_T, F_X, F_P))
                X_d = Z + h * _combined(a[j], K_d) if any(a[j]) else Z
                if end_row:
                    X_d = X_d + h_d * _combined(a[j], K) if any(a[j]) else X_d
                slope_d = f_x @ X_d + _along(f_p, units)
                if end_row:
                    slope_d = slope_d + f_t * (start_d + c[j] * h_d)
                stores += _stored("XZ", j * n, X_d)
                K_d.append(slope_d)
            K.append(f)
        stores += _stored("x_after", 0, x + h * _combined(b, K))
        if self.second:
            after_d = Z + h * _combined(b, K_d)
            stores += _stored("Z_after", 0, after_d + h_d * _combined(b, K) if end_row else after_d)
        if self.structure.running or self.structure.references:
            stores.append(("J", 0, graph.load("J", 0) + h * cost))
        if self.order == 0:  # else the backward row checks
            stores += graph.check()
        self.module.straight(name, FORWARD, stores)

    def backward_row(self, name: str, stage: Template, end_row: bool) -> list[tuple[int, int]]:
        """One row: the costate before it, its part of the gradient, and second derivatives for `curvature_function`.

        Returns which entries of the second derivative along (t, x, p) these are; behind them, for an end row, stands
        c_j.
        """
        graph, n, M = Graph(), self.sizes.n, self.sizes.M
        p, constants = self.inputs(graph)
        start, end, origin = graph.loads("row", 3)
        signal = graph.loads("signal", 4 * self.sizes.signals)
        h = end - start
        units = self.units(graph)
        start_d, end_d = (graph.load(name, 0, vector=True) for name in ("opens", "closes"))
        h_d = end_d - start_d
        psi = graph.loads("psi", n)
        if self.has_samples:
            psi = psi + graph.loads("jump", n)
        nothing = graph.constant(0.0)
        mu: list[Objects] = [np.full(n, nothing, dtype=object)] * STAGES
        gradient = np.full(M, nothing, dtype=object)
        gradient_t = [nothing] * STAGES
        found: list[dict[tuple[int, int], Node]] = [{}] * STAGES
        slopes: list[list[Objects]] = [[]] * STAGES
        for j in reversed(range(STAGES)):
            X_j, t_j = graph.loads("X", n, j * n), start + c[j] * h
            w = h * (b[j] * psi + _combined([row[j] for row in a], mu))
            given = (t_j, X_j, p, w, h * b[j], origin, signal, *constants)
            g_t, mu[j], g_p, *second = stage(
                graph, *given, only=GRADIENT + (SECOND if self.second else ()), checked=True
            )
            gradient = gradient + g_p
            gradient_t[j] = g_t.item()
            if self.second:
                found[j] = _entries(second, with_time=end_row)
            if end_row:
                slopes[j] = stage(graph, *given, only=SLOPES)
        stores = _stored("psi", 0, psi + sum(mu[1:], mu[0]))
        g = graph.load("g", 0, vector=True) + _along(gradient, units)
        if end_row:
            # Derivatives in the times of the stages, and in the length of the row, which multiplies slopes.
            K, ell = [s[0] for s in slopes], [s[4].item() for s in slopes]
            by_length = sum(b[j] * (psi @ K[j] + ell[j]) + (mu[j] * _combined(a[j], K)).sum() for j in range(STAGES))
            times_d = [start_d + c[j] * h_d for j in range(STAGES)]
            g = g + by_length * h_d + sum(gradient_t[j] * times_d[j] for j in range(STAGES))
            if self.second:
                K_d, ell_d = [], []
                for j in range(STAGES):
                    _, f_t, f_x, f_p, _, l_t, l_x, l_p = slopes[j]
                    X_d = graph.loads("XZ", n, j * n, vector=True)
                    K_d.append(f_x @ X_d + _along(f_p, units) + f_t * times_d[j])
                    ell_d.append(l_x @ X_d + _along(l_p, units) + l_t.item() * times_d[j])
                total = sum(
                    b[j] * (psi @ K_d[j] + ell_d[j]) + (mu[j] * _combined(a[j], K_d)).sum() for j in range(STAGES)
                )
                stores.append(("length", 0, _as_vector(graph, total)))
        stores.append(("g", 0, _as_vector(graph, g)))
        chosen = sorted({key for at in found for key, node in at.items() if node.number != 0.0})
        for j in range(STAGES if self.second else 0):
            values = [found[j][key] for key in chosen] + [graph.constant(c[j])] * end_row
            stores += [("entries", j * len(values) + k, node) for k, node in enumerate(values)]
        self.module.straight(name, BACKWARD, stores + graph.check())
        return chosen

    def curvature_function(self, name: str, chosen: list[tuple[int, int]], end_row: bool) -> None:
        """H gains ``Z' S Z`` at `stages_at_once` stages; `chosen` are the entries of S, whose values it is given."""
        graph, n, D = Graph(), self.sizes.n, self.sizes.D
        H = [graph.load("H", d, vector=True) for d in range(D)]
        rows = H
        size = len(chosen) + end_row
        for j in range(self.sizes.stages_at_once):
            second = {key: graph.load("entries", j * size + k) for k, key in enumerate(chosen)}
            of_time = graph.constant(0.0), [graph.constant(0.0)] * D
            if end_row:
                c_j = graph.load("entries", j * size + len(chosen))
                start_d, end_d = (graph.load(name, 0, vector=True) for name in ("opens", "closes"))
                starts, ends = ([graph.load(name, d) for d in range(D)] for name in ("opens", "closes"))
                entries = [one + c_j * (other - one) for one, other in zip(starts, ends, strict=True)]
                of_time = start_d + c_j * (end_d - start_d), entries
            rows = self.curved(graph, rows, second, [of_time, *self.state_directions(graph, "XZ", j * n)])
        self.module.straight(name, CURVATURE, _changed(H, rows))

    def length_function(self) -> None:
        """H gains the products of a row's length with what `backward_row` stored for it."""
        graph = Graph()
        start_d, end_d, along = (graph.load(name, 0, vector=True) for name in ("opens", "closes", "length"))
        stores = []
        for d in range(self.sizes.D):
            h_d = graph.load("closes", d) - graph.load("opens", d)
            row = graph.load("H", d, vector=True) + h_d * along + graph.load("length", d) * (end_d - start_d)
            stores.append(("H", d, row))
        self.module.straight("length", LENGTH, stores)

    def state_directions(self, graph: Graph, pointer: str, first: int = 0) -> list[tuple[Node, list[Node]]]:
        """The derivative of each entry of x along theta: as a vector and entry by entry."""
        n, D, width = self.sizes.n, self.sizes.D, self.sizes.width
        return [
            (graph.load(pointer, k, vector=True), [graph.load(pointer, k * width + d) for d in range(D)])
            for k in range(first, first + n)
        ]

    def curved(
        self, graph: Graph, H: list[Node], second: dict[tuple[int, int], Node], along: list[tuple[Node, list[Node]]]
    ) -> list[Node]:
        """Rows of H with ``Z' S Z`` added, S given by its lower half along (t, x, p); `along` is Z of t and x."""
        n, N = self.sizes.n, self.sizes.N
        vectors = [vector for vector, _ in along] + self.units(graph)
        product: dict[int, Any] = {}
        for (k, m), value in second.items():
            for one, other in {(k, m), (m, k)}:
                product[one] = product.get(one, 0.0) + value * vectors[other]
        rows = []
        for d, row in enumerate(H):
            for k, entries in enumerate(entries for _, entries in along):
                if k in product:
                    row = row + entries[d] * product[k]
            if 1 + n + d - N in product and d >= N:
                row = row + product[1 + n + d - N]
            rows.append(row)
        return rows

    def curved_once(
        self, graph: Graph, second: dict[tuple[int, int], Node], along: list[tuple[Node, list[Node]]]
    ) -> list[Store]:
        """Stores of H with ``Z' S Z`` added."""
        H = [graph.load("H", d, vector=True) for d in range(self.sizes.D)]
        return _changed(H, self.curved(graph, H, second, along))

    def cost_function(self, name: str, pointers: tuple[str, ...], at: Callable[..., list[Objects]], jump: str) -> None:
        """A cost of (x, p) at one moment: J, g and H grow, and the costate by its derivative."""
        graph = Graph()
        p, constants = self.inputs(graph)
        x = graph.loads("x", self.sizes.n)
        cost, *derivatives = at(graph, x, p, constants)
        stores = [("J", 0, graph.load("J", 0) + cost.item())]
        if self.order == 0:
            self.module.straight(name, pointers, stores + graph.check())
            return
        _, g_x, g_p, *second = derivatives
        stores += _stored(jump, 0, graph.loads(jump, self.sizes.n) + g_x)
        g = graph.load("g", 0, vector=True) + _along(g_p, self.units(graph))
        stores.append(("g", 0, g))
        if self.second:
            none = graph.constant(0.0)
            along = [(none, [none] * self.sizes.D), *self.state_directions(graph, "Z")]
            stores += self.curved_once(graph, _entries(second, with_time=False), along)
        self.module.straight(name, pointers, stores + graph.check())

    def reset_functions(self, i: int) -> None:
        """A reset map, forward and backward."""
        template = self.at_reset(i)
        graph, n = Graph(), self.sizes.n
        p, constants = self.inputs(graph)
        x, t = graph.loads("x", n), graph.load("tau", i)
        none = np.full(n, graph.constant(0.0), dtype=object)
        (after,) = template(graph, t, x, p, none, *constants, only=(0,), checked=self.order == 0)
        stores = _stored("x_after", 0, after)
        if self.second:
            R_t, R_x, R_p = template(graph, t, x, p, none, *constants, only=(1, 2, 3))
            Z = graph.loads("Z", n, vector=True)
            Z_after = R_x @ Z + _along(R_p, self.units(graph)) + R_t * graph.unit(i)
            stores += [("Z_after", k, _as_vector(graph, v)) for k, v in enumerate(Z_after)]
        if self.order == 0:
            stores += graph.check()
        self.module.straight(f"reset_{i}", RESET, stores, seen=True)
        if self.order == 0:
            return

        graph = Graph()
        p, constants = self.inputs(graph)
        x, t, psi = graph.loads("x", n), graph.load("tau", i), graph.loads("psi", n)
        g_t, g_x, g_p, *second = template(graph, t, x, p, psi, *constants, only=range(4, 13), checked=True)
        g = graph.load("g", 0, vector=True) + _along(g_p, self.units(graph)) + g_t.item() * graph.unit(i)
        stores = [*_stored("psi", 0, g_x), ("g", 0, g)]
        if self.second:
            numbers = [graph.constant(float(d == i)) for d in range(self.sizes.D)]
            along = [(graph.unit(i), numbers), *self.state_directions(graph, "Z")]
            stores += self.curved_once(graph, _entries(second, with_time=True), along)
        self.module.straight(f"reset_back_{i}", RESET_BACK, stores + graph.check())

    def start_functions(self) -> None:
        """The initial state, forward and backward."""
        template, n, N = self.at_start(), self.sizes.n, self.sizes.N
        graph = Graph()
        p, constants = self.inputs(graph)
        none = np.full(n, graph.constant(0.0), dtype=object)
        (x,) = template(graph, p, none, *constants, only=(0,), checked=self.order == 0)
        stores = _stored("x", 0, x)
        if self.second:
            (x_p,) = template(graph, p, none, *constants, only=(1,))
            Z = _along(x_p, self.units(graph))
            stores += [("Z", k, _as_vector(graph, v)) for k, v in enumerate(Z)]
        if self.order == 0:
            stores += graph.check()
        self.module.straight("start", START, stores, seen=True)
        if self.order == 0:
            return

        graph = Graph()
        p, constants = self.inputs(graph)
        psi = graph.loads("psi", n)
        if self.has_samples:
            psi = psi + graph.loads("jump", n)
        g_p, g_pp = template(graph, p, psi, *constants, only=(2, 3), checked=True)
        units = self.units(graph)
        stores = [("g", 0, graph.load("g", 0, vector=True) + _along(g_p, units))]
        if self.second:
            rows = [(N + k, graph.load("H", N + k, vector=True), _along(g_pp[k], units)) for k in range(len(units))]
            stores += [("H", d, row + more) for d, row, more in rows]
        self.module.straight("start_back", START_BACK, stores + graph.check())

    def state_function(self) -> None:
        """Check that a state is finite, and so small that products of a few entries do not overflow; and its tangents.

        Products with zero have been left out without a look at it.
        """
        graph, n = Graph(), self.sizes.n
        total = graph.load(CHECKED, 0)
        for x in graph.loads("x", n):
            total = total + graph.certain_product(0.0, x * LARGE)
        if self.second:
            for k in range(n):
                for Z in graph.loads("Z", self.sizes.D, k * self.sizes.width):
                    total = total + graph.certain_product(0.0, Z)
        self.module.straight("check_state", STATES, [(CHECKED, 0, total)])

    def slope_function(self, name: str, stage: Template) -> None:
        """f and ell at one moment, for the adaptive solver: derivatives of y = (x, running cost so far)."""
        graph, n = Graph(), self.sizes.n
        p, constants = self.inputs(graph)
        t, origin = graph.loads("moment", 2)
        signal = graph.loads("signal", 4 * self.sizes.signals)
        none = np.full(n, graph.constant(0.0), dtype=object)
        given = (t, graph.loads("y", n), p, none, graph.constant(0.0), origin, signal, *constants)
        f, ell = stage(graph, *given, only=(F, ELL), checked=True)
        self.module.straight(name, SLOPE, _stored("K", 0, [*f, ell.item()]) + graph.check(), seen=True)

    def adaptive_functions(self) -> None:
        """What the adaptive solver does between its slopes: SciPy's RK45, with the same control of its steps.

        Of its state, which lies in memory, `Adaptive` says the places.
        """
        size = self.sizes.n + 1
        A, B, E = RK45.A, RK45.B, RK45.E
        at = Adaptive()

        def begun() -> tuple[Graph, Objects, Objects]:
            graph = Graph()
            return graph, graph.loads("state", at.size), graph.loads("y", size)

        graph, state, _ = begun()
        t, h, end = state[at.t], state[at.h], state[at.end]
        step = graph.apply("select", graph.apply("le", end, t + h), end - t, h)
        self.module.straight("adaptive_begin", ADAPTIVE, [("state", at.step, step)])
        for j in range(1, len(A)):
            graph, state, y = begun()
            K = [graph.loads("K", size, k * size) for k in range(j)]
            argument = y + state[at.step] * _combined(A[j].tolist(), K)
            self.module.straight(f"adaptive_{j}", ADAPTIVE, _stored("argument", 0, argument))
        graph, state, y = begun()
        K = [graph.loads("K", size, k * size) for k in range(len(B))]
        after = y + state[at.step] * _combined(B.tolist(), K)
        self.module.straight("adaptive_after", ADAPTIVE, _stored("argument", 0, after))

        graph, state, y = begun()
        after = graph.loads("argument", size)
        K = [graph.loads("K", size, k * size) for k in range(len(E))]
        t, step, end = state[at.t], state[at.step], state[at.end]
        error = step * _combined(E.tolist(), K)
        sizes = ((graph.apply("abs", old), graph.apply("abs", new)) for old, new in zip(y, after, strict=True))
        larger = as_objects([graph.apply("max", old, new) for old, new in sizes])
        relative = error / (state[at.atol] + state[at.rtol] * larger)
        norm = graph.apply("sqrt", (relative * relative).sum() / size)
        accepted = graph.apply("lt", norm, 1.0)
        factor = 0.9 * graph.apply("pow", norm, -0.2)
        factor = graph.apply("min", graph.apply("max", factor, 0.2), 10.0)
        factor = graph.apply("select", graph.apply("eq", norm, 0.0), 10.0, factor)
        again = graph.apply("and", accepted, graph.apply("ne", state[at.refused], 0.0))
        factor = graph.apply("select", again, graph.apply("min", factor, 1.0), factor)
        factor = graph.apply("select", graph.apply("ne", norm, norm), 0.2, factor)
        reached = graph.apply("select", graph.apply("eq", step, end - t), end, t + step)
        shortest = graph.apply("min", step, step * factor)
        # Written so that a step which is not a number is stuck as well: it would be tried for ever.
        goes_on = graph.apply("lt", 10 * np.finfo(float).eps * graph.apply("abs", t), shortest)
        stuck = graph.apply("not", goes_on)
        number = {name: graph.apply("select", flag, 1.0, 0.0) for name, flag in (("yes", accepted), ("stuck", stuck))}
        stores = [
            ("state", at.t, graph.apply("select", accepted, reached, t)),
            ("state", at.h, step * factor),
            ("state", at.refused, 1.0 - number["yes"]),
            ("state", at.stuck, number["stuck"]),
        ]
        stores += [
            ("y", k, graph.apply("select", accepted, new, old))
            for k, (new, old) in enumerate(zip(after, y, strict=True))
        ]
        self.module.straight("adaptive_judge", ADAPTIVE, stores)

    def output_function(self) -> None:
        """What all sensors see, references first, then Measurements; in second order with its derivatives."""

        def outputs(t: Any, x: Any, p: Any, *constants: Any) -> Any:
            model = self.model(constants)

            def seen(x: Any, p: Any) -> Any:
                each = [model.observed(observe, t, x, p) for observe, _ in self.structure.outputs]
                return jnp.concatenate([jnp.zeros(0), *each])

            return [seen(x, p), *(jax.jacfwd(seen, argnums=(0, 1))(x, p) if self.second else ())]

        template = traced(outputs, (), (self.sizes.n,), (self.sizes.M,), *self.sizes.constants, name="observe")
        graph = Graph()
        p, constants = self.inputs(graph)
        given = graph.load("time", 0), graph.loads("x", self.sizes.n), p
        y, *jacobians = template(graph, *given, *constants, checked=True)
        stores = _stored("y", 0, y)
        if self.second:
            h_x, h_p = jacobians
            y_d = h_x @ graph.loads("Z", self.sizes.n, vector=True) + _along(h_p, self.units(graph))
            stores += [("Y", k, _as_vector(graph, value)) for k, value in enumerate(y_d)]
        self.module.straight("outputs", OUTPUTS, stores + graph.check())


FORWARD = ("c", "p", "row", "signal", "opens", "closes", "x", "Z", "X", "XZ", "x_after", "Z_after", "J", CHECKED)
BACKWARD = ("c", "p", "row", "signal", "opens", "closes", "psi", "jump", "X", "XZ", "g", "entries", "length", CHECKED)
STATES = ("x", "Z", CHECKED)
LENGTH = ("opens", "closes", "length", "H")
CURVATURE = ("entries", "opens", "closes", "XZ", "H")
SLOPE = ("c", "p", "moment", "signal", "y", "K", CHECKED)
ADAPTIVE = ("state", "y", "argument", "K")
START = ("c", "p", "x", "Z", CHECKED)
START_BACK = ("c", "p", "psi", "jump", "g", "H", CHECKED)
OUTPUTS = ("c", "p", "time", "x", "Z", "y", "Y", CHECKED)
RESET = ("c", "p", "tau", "x", "Z", "x_after", "Z_after", CHECKED)
RESET_BACK = ("c", "p", "tau", "x", "Z", "psi", "g", "H", CHECKED)
SAMPLE = ("c", "p", "time", "value", "weight", "x", "Z", "jump", "J", "g", "H", CHECKED)
END = ("c", "p", "x", "Z", "psi", "J", "g", "H", CHECKED)

F, F_T, F_X, F_P, ELL = range(5)
SLOPES = tuple(range(8))
"""f, D_2 f, D_1 f, D_p f, ell and its derivatives in t, x and p: places in what `Kernels.at_stage` returns."""

GRADIENT = (8, 9, 10)
SECOND = tuple(range(11, 17))
"""Of ``w . f + hb ell``: first derivatives in t, x and p; second in tt, xt, xx, pt, px, pp."""


def _first_and_second(value: Callable[..., Any], *at: Any) -> list[Any]:
    """First derivatives of a scalar in t, x, p, and second in tt, xt, xx, pt, px, pp."""
    gradient = jax.grad(value, argnums=(0, 1, 2))
    (tt, _, _), (xt, xx, _), (pt, px, pp) = jax.jacfwd(gradient, argnums=(0, 1, 2))(*at)
    return [*gradient(*at), tt, xt, xx, pt, px, pp]


def _entries(second: list[Objects], with_time: bool) -> dict[tuple[int, int], Node]:
    """The lower half of a second derivative along (t, x, p), as entries of one matrix; zeros are left out."""
    tt, xt, xx, pt, px, pp = second
    n, M = len(xt), len(pt)
    entries = {(1 + i, 1 + j): xx[i, j] for i in range(n) for j in range(i + 1)}
    entries |= {(1 + n + k, 1 + i): px[k, i] for k in range(M) for i in range(n)}
    entries |= {(1 + n + k, 1 + n + m): pp[k, m] for k in range(M) for m in range(k + 1)}
    if with_time:
        entries |= {(0, 0): tt.item()} | {(1 + i, 0): xt[i] for i in range(n)}
        entries |= {(1 + n + k, 0): pt[k] for k in range(M)}
    return entries


def _combined(weights: list[float], terms: list[Any]) -> Any:
    """Weighted sum of arrays of nodes."""
    parts = [weight * term for weight, term in zip(weights, terms, strict=False) if weight != 0.0]
    return sum(parts[1:], parts[0]) if parts else 0.0


def _along(derivatives: Objects, units: list[Node]) -> Any:
    """``sum_k derivatives[..., k] units[k]``: of shape (...)."""
    total = 0.0 if derivatives.ndim == 1 else np.zeros(derivatives.shape[:-1])
    for k, unit in enumerate(units):
        total = total + derivatives[..., k] * unit
    return total


def _changed(H: list[Node], rows: list[Node]) -> list[Store]:
    return [("H", d, row) for d, (old, row) in enumerate(zip(H, rows, strict=True)) if row is not old]


def _as_vector(graph: Graph, value: Any) -> Node:
    """A vector node, also where the value turned out to be zero."""
    if isinstance(value, Node) and value.vector:
        return value
    return graph.zeros()


def _stored(pointer: str, offset: int, values: Any) -> list[Store]:
    return [(pointer, offset + k, node) for k, node in enumerate(values)]
