"""Templates of a model: its functions and their derivatives, traced once, from which kernels are written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp

from switchfit.discretization.arguments import Arguments, Samples
from switchfit.discretization.model import Model, apply_weights, get_transition_function
from switchfit.discretization.signals import Piece
from switchfit.engine.native.scalars.template import Template
from switchfit.engine.native.sizes import Order, Shape, Sizes
from switchfit.engine.native.tracing.trace import trace_scalars
from switchfit.problem.structure import Structure

Array = jax.Array

F, F_T, F_X, F_P, ELL, _, ELL_X = range(7)

SLOPES = tuple(range(8))
"""Positions in the outputs of `Templates.stage`: f, D_2 f, D_1 f, D_p f, ell and its derivatives in t, x and p."""

COST_TO_GO = (8, 9, 10, 11)
"""Positions of the derivatives of ``w . f + hb ell``: first in t, x and p; second along (t, x, p), as one matrix."""


class Templates:
    """Traces the functions of a library, with derivatives of an order.

    The derivatives of a scalar are listed in this order: first in t, x, p, then the matrix of the second ones along
    (t, x, p). At order GAUSS_NEWTON, it is the Gauss-Newton matrix.
    """

    def __init__(self, library: Structure, sizes: Sizes, order: Order) -> None:
        self.library, self.sizes, self.order = library, sizes, order

    def model(self, constants: tuple[Array, ...]) -> Model:
        """Return the model with traced constants."""
        fixed = sum(not read for _, _, read in self.library.parameters)
        parameters, weights, initial_state = constants[:fixed], constants[fixed:-1], constants[-1]
        nodes, signals = jnp.zeros(2), jnp.zeros((1, 4, self.sizes.signals))
        return Model(self.library, Arguments(nodes, signals, parameters, initial_state, (), weights))

    def stage(self, mode: int, running: bool = True) -> Template:
        """Trace f, ell, their derivatives and those of ``w . f + hb ell``; `F` to `COST_TO_GO` are their positions.

        Without `running`, ell is zero. At order COST there are f and ell alone, with D_1 f and D_1 ell in a mode that
        takes implicit steps. Libraries with the same mode share the template.
        """
        own = {name: (getattr(self.library, name)[mode],) for name in ("modes", "mode_names", "implicit")}
        return self._share("trace_stage", running, has_free_tf=self.library.is_rest(mode), **own)

    def trace_stage(self, running: bool) -> Template:
        """Trace the only mode of the library, as `stage` does."""
        n, M, mode = self.sizes.n, self.sizes.M, 0

        def stage(
            model: Model, t: Array, x: Array, p: Array, w: Array, hb: Array, origin: Array, coefficients: Array
        ) -> Sequence[Array]:
            piece, zero = Piece(origin, coefficients), jnp.zeros(())
            costs, f = running and model.has_running_cost, model.field(mode, piece)
            ell = model.density(mode, piece) if costs else lambda t, x, p: zero
            # A simulation has no derivatives, but Newton's method for implicit steps needs D_1 f, and their error D_1
            # ell too.
            if self.order == Order.COST:
                if not self.library.implicit[mode]:
                    return [f(t, x, p), zero, zero, zero, ell(t, x, p)]
                value, ell_x = jax.value_and_grad(ell, argnums=1)(t, x, p)
                return [f(t, x, p), zero, jax.jacfwd(f, argnums=1)(t, x, p), zero, value, zero, ell_x]
            slope = (f(t, x, p), *jax.jacfwd(f, argnums=(0, 1, 2))(t, x, p))
            value, gradient = jax.value_and_grad(ell, argnums=(0, 1, 2))(t, x, p)

            # With the w_j and h b_j of a row its derivatives are mu_j, and those in t_j and p, of
            # `discretization.rows.adjoint`.
            def cost_to_go(t: Array, x: Array, p: Array) -> Array:
                return w @ f(t, x, p) + hb * ell(t, x, p)

            def gauss_newton() -> Array:
                second = self._no_second()
                residuals = model.reference_residuals(piece) if costs else ()
                for residual, W in zip(residuals, model.arguments.weights, strict=False):
                    weigh = lambda A, W=W: hb * apply_weights(W, A)  # noqa: E731
                    second = second + _normal_matrix(residual, weigh, t, x, p)
                if not (costs and self.library.running):
                    return second

                # A running cost is no sum of squares: its own second derivatives stand for it in the Gauss-Newton
                # matrix.
                def cost_of_state(_: Array, x: Array, p: Array) -> Array:
                    return hb * sum(density(t, x, model.parameters(p)) for density in self.library.running)

                return second + _differentiate_twice(cost_of_state, t, x, p)

            return [*slope, value, *gradient, *self._differentiate(cost_to_go, (t, x, p), gauss_newton)]

        also = " or a running cost" if running and (self.library.running or self.library.references) else ""
        shapes = (), (n,), (M,), (n,), (), (), (4, self.sizes.signals)
        return self._trace(stage, *shapes, name=f"mode {self.library.mode_names[mode]!r}{also}")

    def sample(self, k: int) -> Template:
        """Trace the cost of a sample and its derivatives."""
        q = self.library.measurements[k].channels

        def sample(model: Model, time: Array, value: Array, weight: Array, x: Array, p: Array) -> Sequence[Array]:
            def given(t: Array) -> Samples:
                return Samples(jnp.zeros((), int), t, value, weight)

            def gauss_newton() -> Array:
                # rho' / sigma^2 weighs the residuals: the second derivatives of rho are left out with those of h.
                residual = lambda t, x, p: model.sample_residual(k, given(t), x, p)  # noqa: E731
                information = model.sample_information(k, given(time), x, p)
                second = _normal_matrix(residual, partial(apply_weights, information), time, x, p)
                if not self.library.measurements[k].sigma:
                    return second
                # Fisher information of normal noise: 2 for log sigma, 0 between sigma and the rest.
                log_sigma = lambda t, x, p: model.log_sigma(k, given(t), p)  # noqa: E731
                return second + _normal_matrix(log_sigma, lambda A: 2.0 * A, time, x, p)

            return self._cost(lambda t, x, p: model.sample_cost(k, given(t), x, p), (time, x, p), gauss_newton)

        shapes = (), (q,), (q,), (self.sizes.n,), (self.sizes.M,)
        return self._trace(sample, *shapes, name="observe of Measurements")

    def late_time(self, k: int) -> Template:
        """Trace the time at which a late sample of the k-th Measurements saw the state, and its derivative in p."""

        def time(model: Model, t: Array, p: Array) -> Sequence[Array]:
            sample = Samples(jnp.zeros((), int), t, jnp.zeros(0), jnp.zeros(0))
            return jax.value_and_grad(lambda p: model.correct_delay(k, sample, p).time)(p)

        return self._trace(time, (), (self.sizes.M,), name="delay of Measurements")

    def end(self) -> Template:
        """Trace the terminal costs."""

        def end(model: Model, x: Array, p: Array) -> Sequence[Array]:
            return self._cost(lambda t, x, p: model.terminal(x, p), (jnp.zeros(()), x, p))

        return self._trace(end, (self.sizes.n,), (self.sizes.M,), name="a terminal cost")

    def transition(self, kind: str, which: int) -> Template:
        """Trace a function at transitions: a cost, or a constraint and ``weight`` times it.

        The outputs of a constraint are its value and first derivatives, then those of the weighted one.
        """
        return self._share("trace_transition", kind, **{kind: (getattr(self.library, kind)[which],)})

    def trace_transition(self, kind: str) -> Template:
        """Trace the only transition of the library, as `transition` does."""

        def at(
            model: Model, t: Array, x: Array, p: Array, weight: Array, origin: Array, coefficients: Array
        ) -> Sequence[Array]:
            function = get_transition_function(model, kind, 0, Piece(origin, coefficients))
            if kind == "guards":
                return self._map(lambda t, x, p: function(t, x, p)[None], (t, x, p), weight)
            return self._cost(function, (t, x, p))

        shapes = (), (self.sizes.n,), (self.sizes.M,), (1,), (), (4, self.sizes.signals)
        return self._trace(at, *shapes, name=f"one of the {kind}")

    def end_constraint(self) -> Template:
        """Trace all terminal constraints and their first derivatives, then those of the weighted sum."""

        def end(model: Model, x: Array, p: Array, weights: Array) -> Sequence[Array]:
            constraints = lambda t, x, p: model.terminal_constraint(x, p)  # noqa: E731
            return self._map(constraints, (jnp.zeros(()), x, p), weights)

        shapes = (self.sizes.n,), (self.sizes.M,), (self.sizes.m,)
        return self._trace(end, *shapes, name="a terminal constraint")

    def reset(self, which: int) -> Template:
        """Trace a reset map, its Jacobians, and the derivatives of ``w . R``."""
        return self._trace_map(lambda model: model.reset(which), "a reset map")

    def start(self) -> Template:
        """Trace x(t0), as a reset map that does not depend on t and x."""
        return self._trace_map(lambda model: lambda t, x, p: model.initial_state(p), "initial_state")

    def _trace_map(self, get_map: Callable[[Model], Callable[..., Array]], name: str) -> Template:
        n = self.sizes.n
        call = lambda model, t, x, p, w: self._map(get_map(model), (t, x, p), w)  # noqa: E731
        return self._trace(call, (), (n,), (self.sizes.M,), (n,), name=name)

    def outputs(self) -> Template:
        """Trace the outputs, of references, then of Measurements, and their derivatives in x and p."""

        def outputs(model: Model, t: Array, x: Array, p: Array) -> Sequence[Array]:
            def seen(x: Array, p: Array) -> Array:
                each = [model.observe(observe, t, x, p) for observe, _ in self.library.outputs]
                return jnp.concatenate([jnp.zeros(0), *each])

            return [seen(x, p), *(jax.jacfwd(seen, argnums=(0, 1))(x, p) if self.order > Order.COST else ())]

        return self._trace(outputs, (), (self.sizes.n,), (self.sizes.M,), name="observe")

    def _share(self, method: str, setting: object, **own: Any) -> Template:
        """Return what a method traces in a library with nothing but its `own` functions."""
        alone = replace(self.library.functions, measurements=(), terminal=(), **own)
        return _trace_alone(alone, self.sizes._replace(N=0, T=0, m=0), self.order, method, setting)

    def _trace(self, function: Callable[..., Sequence[Array]], *shapes: Shape, name: str) -> Template:
        """Trace a function of the model and of arrays of these shapes; the constants are further inputs."""

        def call(*given: Array) -> Sequence[Array]:
            return function(self.model(given[len(shapes) :]), *given[: len(shapes)])

        return trace_scalars(call, *shapes, *self.sizes.constants, name=name)

    def _cost(
        self, value: Callable[..., Array], at: Sequence[Array], gauss_newton: Callable[[], Array] | None = None
    ) -> list[Array]:
        """Return a cost with the derivatives of the order at (t, x, p)."""
        return [value(*at), *self._differentiate(value, at, gauss_newton)]

    def _map(self, function: Callable[..., Array], at: Sequence[Array], weights: Array) -> list[Array]:
        """Return values (m,) with Jacobians in t, x and p, then the derivatives of ``weights . values``."""
        if self.order == Order.COST:
            return [function(*at)]
        jacobians = jax.jacfwd(function, argnums=(0, 1, 2))(*at)
        # Backward a map needs w . R alone, forward its Jacobians; a constraint needs lam . c in the same way.
        weighted = self._differentiate(lambda *at: weights @ function(*at), at, self._no_second)
        return [function(*at), *jacobians, *weighted]

    def _differentiate(
        self, value: Callable[..., Array], at: Sequence[Array], gauss_newton: Callable[[], Array] | None
    ) -> list[Array]:
        """Return the derivatives of the order; at order GAUSS_NEWTON, second ones that are given take their place."""
        if self.order == Order.COST:
            return []
        # First, since the machine code of both is then a little faster.
        if self.order == Order.GRADIENT:
            gauss_newton = self._no_second
        elif gauss_newton is None or self.order == Order.HESSIAN:
            gauss_newton = partial(_differentiate_twice, value, *at)
        second = gauss_newton()
        return [*jax.grad(value, argnums=(0, 1, 2))(*at), second]

    def _no_second(self) -> Array:
        return jnp.zeros((1 + self.sizes.n + self.sizes.M,) * 2)


@lru_cache(maxsize=256)
def _trace_alone(library: Structure, sizes: Sizes, order: Order, method: str, setting: object) -> Template:
    """Return the template of a library of one function: libraries grow in a search, and derivatives take long."""
    return getattr(Templates(library, sizes, order), method)(setting)


def _differentiate_twice(value: Callable[..., Array], t: Array, x: Array, p: Array) -> Array:
    """Return the matrix of the second derivatives of a scalar along (t, x, p)."""

    def along(z: Array) -> Array:
        t, *state = jnp.split(z, (1, 1 + x.size))
        return value(t.reshape(()), *state)

    return jax.hessian(along)(jnp.concatenate([t.reshape(1), x, p]))


def _normal_matrix(residual: Callable[..., Array], weigh: Callable[[Array], Array], *at: Array) -> Array:
    """Return ``r_d' W r_d`` along (t, x, p); `weigh` multiplies by W."""
    # A time that moves with theta, as of a late sample, is one more direction of the residual.
    t_d, *in_state = jax.jacfwd(residual, argnums=(0, 1, 2))(*at)
    r_d = jnp.concatenate([t_d[:, None], *in_state], axis=1)
    return r_d.T @ weigh(r_d)
