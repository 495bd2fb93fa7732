"""Trace the functions of a model and their derivatives into templates, from which kernels are written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.discretization.arguments import Arguments, Samples
from switchfit.discretization.model import Model, Piece, apply_weights
from switchfit.discretization.nodes import TransitionKind, get_end_constraints, get_end_cost, get_transition_function
from switchfit.engine.native.scalars import Template
from switchfit.engine.native.trace import trace_scalars
from switchfit.problem.structure import Structure

Shape = tuple[int, ...]

F, F_T, F_X, F_P, ELL, _, ELL_X = range(7)
SLOPES = tuple(range(8))
"""Positions in the outputs of `Templates.stage`: f, D_2 f, D_1 f, D_p f, ell and its derivatives in t, x and p."""

GRADIENT = (8, 9, 10)
SECOND = tuple(range(11, 17))
"""Positions of the derivatives of ``w . f + hb ell``: first in t, x and p; second in tt, xt, xx, pt, px, pp."""


class Order(IntEnum):
    """What a program computes: each order includes those before it, but GAUSS_NEWTON has its matrix for the Hessian."""

    COST = 0
    GRADIENT = 1
    HESSIAN = 2
    GAUSS_NEWTON = 3


@dataclass(frozen=True)
class Sizes:
    """Sizes on which a program depends, in addition to the library.

    Attributes
    ----------
    n, N, M : numbers of states, of transitions at most, and of entries of p
    T : number of transition times with derivatives: all but those of jumps, which are known
    signals : number of channels of all signals
    m : number of terminal constraints
    constants : shapes of the fixed parameters, the weights of references and the initial state
    """

    n: int
    N: int
    T: int
    M: int
    signals: int
    m: int
    constants: tuple[Shape, ...]

    @classmethod
    def of(cls, structure: Structure, arguments: Arguments) -> Sizes:
        """Return the sizes of one experiment."""
        constants = tuple(np.shape(a) for a in constants_of(arguments))
        count = structure.terminal_constraint_count
        N = structure.transitions
        return cls(structure.n, N, N - structure.known, structure.M, arguments.signals.shape[2], count, constants)

    @property
    def D(self) -> int:
        """Number of unknowns: all transition times but those of jumps, then p."""
        return self.T + self.M

    @property
    def width(self) -> int:
        """Number of entries of a vector: even above 1, to suit the vector instructions of the CPU."""
        return self.D if self.D == 1 else self.D + self.D % 2


def constants_of(arguments: Arguments) -> list[Any]:
    """Return the arrays that functions of the model read in addition to t, x, p and signals."""
    return [*arguments.fixed, *arguments.weights, arguments.initial_state]


class Templates:
    """Traces the functions of a library, with derivatives of an order.

    The derivatives of a scalar are listed in this order: first in t, x, p, then second in tt, xt, xx, pt, px, pp. At
    order GAUSS_NEWTON, the second ones are the entries of the Gauss-Newton matrix.
    """

    def __init__(self, library: Structure, sizes: Sizes, order: Order) -> None:
        self.library, self.sizes, self.order = library, sizes, order

    def model(self, constants: tuple[Any, ...]) -> Model:
        """Return the model with traced constants."""
        fixed = sum(not free for _, _, free in self.library.parameters)
        arguments = Arguments(
            nodes=jnp.zeros(2),
            signals=jnp.zeros((1, 4, self.sizes.signals)),
            fixed=tuple(constants[:fixed]),
            initial_state=constants[-1],
            samples=(),
            weights=tuple(constants[fixed:-1]),
        )
        return Model(self.library, arguments)

    def stage(self, mode: int, running: bool = True) -> Template:
        """Trace f, ell, their derivatives and those of ``w . f + hb ell``; `F` to `SECOND` are their positions.

        Without `running`, ell is zero. At order COST there are f and ell alone, with D_1 f and D_1 ell in a mode that
        takes implicit steps.
        """
        n, M, S = self.sizes.n, self.sizes.M, self.sizes.signals

        def stage(t: Any, x: Any, p: Any, w: Any, hb: Any, origin: Any, coefficients: Any, *constants: Any) -> Any:
            model = self.model(constants)
            piece = Piece(origin, coefficients)
            f, ell = model.field(mode, piece), model.density(mode, piece)
            costs = running and model.has_running_cost
            zero = jnp.zeros(())
            if self.order == Order.COST:
                if not self.library.implicit[mode]:
                    return [f(t, x, p), zero, zero, zero, ell(t, x, p) if running else zero]
                value, ell_x = jax.value_and_grad(ell, argnums=1)(t, x, p) if costs else (zero, jnp.zeros(n))
                return [f(t, x, p), zero, jax.jacfwd(f, argnums=1)(t, x, p), zero, value, zero, ell_x]
            slope = (f(t, x, p), *jax.jacfwd(f, argnums=(0, 1, 2))(t, x, p))
            cost = (zero, zero, jnp.zeros(n), jnp.zeros(M))
            if costs:
                value, gradient = jax.value_and_grad(ell, argnums=(0, 1, 2))(t, x, p)
                cost = (value, *gradient)

            def cost_to_go(t: Any, x: Any, p: Any) -> Any:
                return w @ f(t, x, p) + (hb * ell(t, x, p) if costs else 0.0)

            if self.order != Order.GAUSS_NEWTON:
                return [*slope, *cost, *_first_and_second(cost_to_go, t, x, p)]
            second = self._no_second()
            for residual, W in zip(
                model.reference_residuals(piece) if costs else (), model.arguments.weights, strict=False
            ):
                r_d = jax.jacfwd(residual, argnums=(0, 1, 2))(t, x, p)
                second = _add_all(second, _normal_matrix(r_d, partial(_weigh, W, hb)))
            if costs and self.library.running:

                def cost_of_state(x: Any, p: Any) -> Any:
                    return hb * sum(density(t, x, model.parameters(p)) for density in self.library.running)

                second = _add_all(second, self._second_in_state(cost_of_state, x, p))
            return [*slope, *cost, *jax.grad(cost_to_go, argnums=(0, 1, 2))(t, x, p), *second]

        also = " or a running cost" if running and (self.library.running or self.library.references) else ""
        name = f"mode {self.library.mode_names[mode]!r}{also}"
        return trace_scalars(stage, (), (n,), (M,), (n,), (), (), (4, S), *self.sizes.constants, name=name)

    def motion(self, mode: int) -> Template:
        """Trace f of a mode, D_1 f and D_p f at (t, x, p), given the first node of the cell and the signals there."""

        def motion(t: Any, x: Any, p: Any, origin: Any, coefficients: Any, *constants: Any) -> Any:
            f = self.model(constants).field(mode, Piece(origin, coefficients))
            return [f(t, x, p), *jax.jacfwd(f, argnums=(1, 2))(t, x, p)]

        shapes = (), (self.sizes.n,), (self.sizes.M,), (), (4, self.sizes.signals)
        name = f"mode {self.library.mode_names[mode]!r}"
        return trace_scalars(motion, *shapes, *self.sizes.constants, name=name)

    def sample(self, k: int) -> Template:
        """Trace the cost of a sample and its derivatives."""
        q = self.library.measurements[k].channels

        def sample(time: Any, value: Any, weight: Any, x: Any, p: Any, *constants: Any) -> Any:
            model = self.model(constants)

            def given(t: Any) -> Samples:
                return Samples(jnp.zeros((), int), t, value, weight)

            cost = lambda t, x, p: model.sample_cost(k, given(t), x, p)  # noqa: E731
            if self.order != Order.GAUSS_NEWTON:
                return self._cost(cost, time, x, p)
            residual = lambda t, x, p: model.sample_residual(k, given(t), x, p)  # noqa: E731
            information = model.sample_information(k, given(time), x, p)
            second = _normal_matrix(
                jax.jacfwd(residual, argnums=(0, 1, 2))(time, x, p), lambda A: apply_weights(information, A)
            )
            if self.library.measurements[k].sigma:
                # Fisher information of normal noise: 2 for log sigma, 0 between sigma and the rest.
                log_sigma = lambda t, x, p: model.log_sigma(k, given(t), p)  # noqa: E731
                s_d = jax.jacfwd(log_sigma, argnums=(0, 1, 2))(time, x, p)
                second = _add_all(second, _normal_matrix(s_d, lambda A: 2.0 * A))
            return [cost(time, x, p), *jax.grad(cost, argnums=(0, 1, 2))(time, x, p), *second]

        shapes = (), (q,), (q,), (self.sizes.n,), (self.sizes.M,)
        return trace_scalars(sample, *shapes, *self.sizes.constants, name="observe of Measurements")

    def late_time(self, k: int) -> Template:
        """Trace the time at which a late sample of the k-th Measurements saw the state, and its derivative in p."""

        def time(t: Any, p: Any, *constants: Any) -> Any:
            model = self.model(constants)
            nothing = jnp.zeros(0)
            seen = lambda p: model.correct_delay(k, Samples(jnp.zeros((), int), t, nothing, nothing), p).time  # noqa: E731
            return [seen(p), jax.grad(seen)(p)]

        return trace_scalars(time, (), (self.sizes.M,), *self.sizes.constants, name="delay of Measurements")

    def end(self) -> Template:
        """Trace the terminal costs."""

        def end(x: Any, p: Any, *constants: Any) -> Any:
            cost = get_end_cost(self.model(constants))
            if cost is None:
                raise ValueError("there is no terminal cost")
            if self.order != Order.GAUSS_NEWTON:
                return self._cost(cost, jnp.zeros(()), x, p)
            gradient = jax.grad(cost, argnums=(0, 1, 2))(0.0, x, p)
            return [cost(0.0, x, p), *gradient, *self._second_in_state(lambda x, p: cost(0.0, x, p), x, p)]

        return trace_scalars(end, (self.sizes.n,), (self.sizes.M,), *self.sizes.constants, name="a terminal cost")

    def transition(self, kind: TransitionKind, which: int) -> Template:
        """Trace a function at transitions: a cost, or a constraint and ``weight`` times it.

        The outputs of a constraint are its value and first derivatives, then those of the weighted one.
        """

        def at(t: Any, x: Any, p: Any, weight: Any, origin: Any, coefficients: Any, *constants: Any) -> Any:
            function = get_transition_function(self.model(constants), kind, which, Piece(origin, coefficients))
            if function is None:
                raise ValueError("there is no function at this transition")
            if not kind.constraint:  # the second derivatives of a cost belong to the Gauss-Newton matrix too
                first = [function(t, x, p)]
                return first if self.order == Order.COST else [*first, *_first_and_second(function, t, x, p)]
            return self._constraint(lambda t, x, p: function(t, x, p)[None], t, x, p, weight)

        shapes = (), (self.sizes.n,), (self.sizes.M,), (1,), (), (4, self.sizes.signals)
        return trace_scalars(at, *shapes, *self.sizes.constants, name=f"one of the {kind.name}")

    def end_constraint(self) -> Template:
        """Trace all terminal constraints and their first derivatives, then those of the weighted sum."""

        def end(x: Any, p: Any, weights: Any, *constants: Any) -> Any:
            function = get_end_constraints(self.model(constants))
            if function is None:
                raise ValueError("there is no terminal constraint")
            return self._constraint(function, jnp.zeros(()), x, p, weights)

        shapes = (self.sizes.n,), (self.sizes.M,), (self.sizes.m,)
        return trace_scalars(end, *shapes, *self.sizes.constants, name="a terminal constraint")

    def reset(self, which: int) -> Template:
        """Trace a reset map, its Jacobians, and the derivatives of ``w . R``."""

        def reset(t: Any, x: Any, p: Any, w: Any, *constants: Any) -> Any:
            R = self.model(constants).reset(which)
            if self.order == Order.COST:
                return [R(t, x, p)]
            jacobians = jax.jacfwd(R, argnums=(0, 1, 2))(t, x, p)
            return [R(t, x, p), *jacobians, *self._derivatives(lambda t, x, p: w @ R(t, x, p), t, x, p)]

        n = self.sizes.n
        return trace_scalars(reset, (), (n,), (self.sizes.M,), (n,), *self.sizes.constants, name="a reset map")

    def start(self) -> Template:
        """Trace x(t0), its Jacobian (n, M) in p, and the derivatives of ``w . x(t0)``: (M,) and (M, M)."""

        def start(p: Any, w: Any, *constants: Any) -> Any:
            x0 = self.model(constants).initial_state
            if self.order == Order.COST:
                return [x0(p)]
            value = lambda p: w @ x0(p)  # noqa: E731
            second = jnp.zeros((p.size, p.size)) if self.order == Order.GAUSS_NEWTON else jax.jacfwd(jax.grad(value))(p)
            return [x0(p), jax.jacfwd(x0)(p), jax.grad(value)(p), second]

        return trace_scalars(start, (self.sizes.M,), (self.sizes.n,), *self.sizes.constants, name="initial_state")

    def outputs(self) -> Template:
        """Trace the outputs, of references, then of Measurements, and their derivatives in x and p."""

        def outputs(t: Any, x: Any, p: Any, *constants: Any) -> Any:
            model = self.model(constants)

            def seen(x: Any, p: Any) -> Any:
                each = [model.observe(observe, t, x, p) for observe, _ in self.library.outputs]
                return jnp.concatenate([jnp.zeros(0), *each])

            return [seen(x, p), *(jax.jacfwd(seen, argnums=(0, 1))(x, p) if self.order > Order.GRADIENT else ())]

        return trace_scalars(outputs, (), (self.sizes.n,), (self.sizes.M,), *self.sizes.constants, name="observe")

    def _cost(self, value: Callable[..., Any], t: Any, x: Any, p: Any) -> list[Any]:
        """Return a cost with the derivatives of the order."""
        if self.order == Order.COST:
            return [value(t, x, p)]
        return [value(t, x, p), *self._derivatives(value, t, x, p)]

    def _constraint(self, function: Callable[..., Any], t: Any, x: Any, p: Any, weights: Any) -> list[Any]:
        """Return values (m,) with Jacobians in t, x and p, then the derivatives of ``weights . c``."""
        if self.order == Order.COST:
            return [function(t, x, p)]
        jacobians = jax.jacfwd(function, argnums=(0, 1, 2))(t, x, p)
        return [
            function(t, x, p),
            *jacobians,
            *self._derivatives(lambda t, x, p: weights @ function(t, x, p), t, x, p),
        ]

    def _derivatives(self, value: Callable[..., Any], t: Any, x: Any, p: Any) -> list[Any]:
        """Return first and second derivatives; at the order of Gauss-Newton the second ones are zero."""
        if self.order != Order.GAUSS_NEWTON:
            return _first_and_second(value, t, x, p)
        return [*jax.grad(value, argnums=(0, 1, 2))(t, x, p), *self._no_second()]

    def _no_second(self) -> list[Any]:
        n, M = self.sizes.n, self.sizes.M
        return [jnp.zeros(shape) for shape in ((), (n,), (n, n), (M,), (M, n), (M, M))]

    def _second_in_state(self, value: Callable[..., Any], x: Any, p: Any) -> list[Any]:
        """Return the second derivatives of a function of (x, p); those in t are zero."""
        (xx, _), (px, pp) = jax.jacfwd(jax.grad(value, argnums=(0, 1)), argnums=(0, 1))(x, p)
        tt, xt, _, pt, _, _ = self._no_second()
        return [tt, xt, xx, pt, px, pp]


def _first_and_second(value: Callable[..., Any], *at: Any) -> list[Any]:
    """Return the first derivatives of a scalar in t, x, p, and second in tt, xt, xx, pt, px, pp."""
    gradient = jax.grad(value, argnums=(0, 1, 2))
    (tt, _, _), (xt, xx, _), (pt, px, pp) = jax.jacfwd(gradient, argnums=(0, 1, 2))(*at)
    return [*gradient(*at), tt, xt, xx, pt, px, pp]


def _normal_matrix(r_d: tuple[Any, Any, Any], weigh: Callable[[Any], Any]) -> list[Any]:
    """Return ``r_d' W r_d`` along (t, x, p) by its parts tt, xt, xx, pt, px, pp; `weigh` multiplies by W."""
    t, x, p = r_d
    Wt, Wx, Wp = weigh(t[:, None])[:, 0], weigh(x), weigh(p)
    return [t @ Wt, x.T @ Wt, x.T @ Wx, p.T @ Wt, p.T @ Wx, p.T @ Wp]


def _weigh(W: Any, factor: Any, A: Any) -> Any:
    return factor * apply_weights(W, A)


def _add_all(one: list[Any], other: list[Any]) -> list[Any]:
    return [a + b for a, b in zip(one, other, strict=True)]
