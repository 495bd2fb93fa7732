"""The functions of one experiment, bound to its arguments while JAX traces a program.

Those between two nodes are the vector field of each mode and the running cost; those at a node map the state, cost, or
constrain:

start        ``x(t0) = x0(p)``
reset        ``x(tau_i+) = R(tau_i, x(tau_i-), p)``
sample       a cost of (t, x, p) at the end of a row; of a late sample at the end of a step of its own, which begins
             with the row that holds ``t - delay(p)`` and ends there
transition   costs of, and constraints on, ``(tau_i, x(tau_i-), p)``
end          costs of, and constraints on, ``(x(tf), p)``

Engines differentiate these functions without distinguishing kinds by name. All functions take (t, x, p). For a
constraint, engines add ``weight . c`` to the cost, with the weights of a Lagrangian.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import accumulate
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments, Samples
from switchfit.discretization.signals import Piece
from switchfit.discretization.tableaus import select_tableaus
from switchfit.problem.functions import Function
from switchfit.problem.losses import influence, robust
from switchfit.problem.structure import Structure

Field = Callable[[Array, Array, Array], Array]
"""``f(t, x, p) -> (n,)`` of one mode, p being the flat vector of free parameters."""

Density = Callable[[Array, Array, Array], Array]
"""``ell(t, x, p) -> ()``: the sum of all running costs."""

NodeFunction = Callable[[Any, Any, Any], Any]

AT_TRANSITIONS = "guards", "transition_costs"
"""Fields of `Structure` with a function for each transition, None for transitions without one. Guards are constraints,
which have to be zero; the others are costs."""


class Model:
    """The functions of one experiment, bound to its arguments while a program is traced.

    All functions take the flat vector p (M,) of the free parameters and the unknown entries of the initial state.
    """

    def __init__(self, structure: Structure, arguments: Arguments) -> None:
        self.structure = structure
        self.arguments = arguments
        self.tableaus = select_tableaus(structure.implicit)  # one for each mode, all with equally many stages

    @property
    def mode_of_segment(self) -> Array:
        """The mode of each segment, by its position: (N + 1,); read at run time in programs for any sequence."""
        given = self.arguments.sequence
        return jnp.asarray(self.structure.mode_of_segment) if given is None else given

    def parameters(self, p: Array) -> Mapping[str, Array]:
        """Return the parameters by name, as the user's functions receive them."""
        named: dict[str, Array] = {}
        fixed = iter(self.arguments.fixed)
        position = 0
        for name, shape, read in self.structure.parameters:
            if not read:
                named[name] = next(fixed)
                continue
            entries = p[position : position + len(read)]
            position += len(read)
            if len(read) < np.prod(shape):  # what stands at the others does not matter: nothing reads them
                entries = entries[np.minimum(np.searchsorted(read, np.arange(np.prod(shape))), len(read) - 1)]
            named[name] = entries.reshape(shape)
        return named

    def field(self, mode: int, piece: Piece) -> Field:
        """Return the vector field of a mode inside one cell."""
        function = self.structure.modes[mode]
        return lambda t, x, p: function(t, x, self.parameters(p), *self.inputs(function, t, piece))

    def inputs(self, function: Function, t: Array, piece: Piece) -> tuple[Array, ...]:
        """Return what a function takes of the input at a time inside one cell, as a tuple of one: u, or u and du/dt, as
        branches of modes do; an empty one if it takes none.
        """
        if not function.takes_input:
            return ()
        shape, size = function.structs[2].shape, int(np.prod(self.structure.input_shape or ()))
        # References come first in the channels of a cell, the input last.
        own = Piece(piece.origin, piece.coefficients[:, piece.coefficients.shape[1] - size :])
        both = own(t) if shape == self.structure.input_shape else jnp.stack([own(t), own.rate(t)])
        return (both.reshape(shape),)

    def find_piece(self, t: Array) -> Piece:
        """Return the signals in the cell that ends at a time or holds it."""
        # The cell that ends at t: guards and costs at a transition are those before it. Which it is has no derivative.
        nodes = jnp.asarray(self.arguments.nodes)
        cell = jnp.clip(jnp.searchsorted(nodes, jax.lax.stop_gradient(t)) - 1, 0, len(nodes) - 2)
        return Piece(nodes[cell], jnp.asarray(self.arguments.signals)[cell])

    @property
    def has_running_cost(self) -> bool:
        """Whether anything is integrated along the trajectory."""
        return bool(self.structure.running or self.structure.references)

    def density(self, mode: int, piece: Piece) -> Density:
        """Return the sum of all running costs in a mode inside one cell, reference signals included; 0 after a free
        tf.
        """
        # Behind a free tf nothing is measured: the rest adds nothing to J, whatever the state does there.
        if self.structure.is_rest(mode):
            return lambda t, x, p: jnp.zeros(())

        def ell(t: Array, x: Array, p: Array) -> Array:
            total = jnp.zeros(())
            for function in self.structure.running:
                total = total + function(t, x, self.parameters(p))
            for residual, W in zip(self.reference_residuals(piece), self.arguments.weights, strict=True):
                r = residual(t, x, p)
                total = total + 0.5 * r @ apply_weights(W, r)
            return total

        return ell

    def reference_residuals(self, piece: Piece) -> list[Callable[[Array, Array, Array], Array]]:
        """Return ``y(t, x, p) - y_m(t)`` of each reference signal, (q,)."""

        def residual(observe: Function | None, channels: slice, t: Array, x: Array, p: Array) -> Array:
            return self.observe(observe, t, x, p) - piece(t)[channels]

        # Each reference has its channels behind those of the references before it.
        ends = accumulate(channels for _, channels in self.structure.references)
        each = zip(self.structure.references, ends, strict=True)
        return [partial(residual, observe, slice(end - channels, end)) for (observe, channels), end in each]

    def observe(self, observe: Function | None, t: Array, x: Array, p: Array) -> Array:
        """Return the output of a sensor: (q,)."""
        return x if observe is None else observe(t, x, self.parameters(p))

    def sample_residual(self, k: int, sample: Samples, x: Array, p: Array) -> Array:
        """Return ``h - y`` of one sample of the k-th Measurements, 0 where it is missing: (q,)."""
        sensor = self.structure.measurements[k]
        h = self.observe(sensor.observe, sample.time, x, p)
        # The residual of a missing value is 0, not the product of its weight 0 with what h may be there.
        return jnp.where(sample.weight > 0, h - sample.value, 0.0)

    def correct_delay(self, k: int, sample: Samples, p: Array) -> Samples:
        """Return a late sample with its time replaced by ``t - delay``, the time of the state that it saw."""
        delay = self.structure.measurements[k].delay
        return sample if delay is None else sample._replace(time=sample.time - self.parameters(p)[delay])

    def log_sigma(self, k: int, sample: Samples, p: Array) -> Array:
        """Return the logarithm of the sigma of each channel that is a parameter and has a value in this sample, else 0:
        (q,).
        """
        named = self.structure.measurements[k].sigma
        parameters = self.parameters(p)
        sigma = [jnp.ones(()) if name is None else parameters[name] for name in named]
        return jnp.where(sample.weight > 0, jnp.log(jnp.stack(sigma)), 0.0)

    def sample_cost(self, k: int, sample: Samples, x: Array, p: Array) -> Array:
        """Return ``1/2 sum C**2 rho(((h - y) / sigma)**2 / C**2) + sum log sigma`` of one sample.

        Without a robust loss, rho is the identity. The term log sigma is present only where sigma is a parameter.
        """
        sensor = self.structure.measurements[k]
        r = self.sample_residual(k, sample, x, p)
        # weight = 1 / sigma^2 where sigma is known, 1 where it is a parameter, and 0 where the value is missing.
        u = sample.weight * r * r
        if not sensor.sigma:
            return 0.5 * jnp.sum(robust(sensor.loss, sensor.loss_scale, u, jnp))
        log_sigma = self.log_sigma(k, sample, p)
        u = u * jnp.exp(-2.0 * log_sigma)
        return jnp.sum(0.5 * robust(sensor.loss, sensor.loss_scale, u, jnp) + log_sigma)

    def sample_information(self, k: int, sample: Samples, x: Array, p: Array) -> Array:
        """Return the weight of each channel of one sample in the Gauss-Newton matrix, ``rho' / sigma**2``: (q,)."""
        sensor = self.structure.measurements[k]
        weight = sample.weight
        if sensor.sigma:
            weight = weight * jnp.exp(-2.0 * self.log_sigma(k, sample, p))
        if sensor.loss == "linear":
            return weight
        r = self.sample_residual(k, sample, x, p)
        return weight * influence(sensor.loss, sensor.loss_scale, weight * r * r, jnp)

    def terminal(self, x: Array, p: Array) -> Array:
        """Return the sum of the terminal costs."""
        return sum((phi(x, self.parameters(p)) for phi in self.structure.terminal), jnp.zeros(()))

    def reset(self, i: int) -> Callable[[Array, Array, Array], Array]:
        """Return the reset map R_i(t, x, p) of transition i, which must have one."""
        function = cast(Function, self.structure.reset_maps[i])
        return lambda t, x, p: function(t, x, self.parameters(p))

    def terminal_constraint(self, x: Array, p: Array) -> Array:
        """Return all terminal constraints, concatenated: (m,)."""
        # In the order of `problem.constraint_names`, behind the guards.
        parts = [psi(x, self.parameters(p)) for psi in self.structure.terminal_constraints]
        return jnp.concatenate([part.reshape(-1) for part in parts])

    def initial_state(self, p: Array) -> Array:
        """Return x(t0), (n,)."""
        if self.structure.initial_state is None:
            unknown = self.structure.unknown_states
            # The unknown entries are the last unknowns of p, in the order of the states.
            x0 = self.arguments.initial_state
            return x0.at[np.array(unknown)].set(p[-len(unknown) :]) if unknown else x0
        return self.structure.initial_state(self.parameters(p))


def read_parameters(structure: Structure, arguments: Arguments, p: FloatArray) -> dict[str, FloatArray]:
    """Return the parameters by name, as NumPy arrays."""
    named = Model(structure, arguments).parameters(p)  # type: ignore[arg-type]  # it only takes parts of p
    return {name: np.asarray(value) for name, value in named.items()}


def apply_weights(W: Array, r: Array) -> Array:
    """Return ``W r`` for a W given by its diagonal (q,) or in full (q, q); r is (q,) or (q, D)."""
    if W.ndim == 2:
        return W @ r
    return W * r if r.ndim == 1 else W[:, None] * r


def get_transition_function(model: Model, kind: str, i: int, piece: Piece | None = None) -> NodeFunction:
    """Return the scalar function of a kind at transition i (from 0), which must have one.

    One that takes an input gets the one of a `piece`; by default, of the cell that ends at the transition or holds it.
    """
    function = getattr(model.structure, kind)[i]
    if not function.takes_input:
        return lambda t, x, p: function(t, x, model.parameters(p))
    return lambda t, x, p: function(t, x, model.parameters(p), *model.inputs(function, t, piece or model.find_piece(t)))


def list_transition_functions(model: Model, kind: str) -> list[tuple[int, NodeFunction]]:
    """Return the functions of a kind, each with its transition (from 0)."""
    there = [i for i in range(model.structure.N) if getattr(model.structure, kind)[i] is not None]
    return [(i, get_transition_function(model, kind, i)) for i in there]
