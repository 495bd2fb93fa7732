"""The compiled programs of many fits: one minimizes, one evaluates J, gradient and Hessian.

On a CPU a program takes the fits of a chunk one after the other: each stays in the processor's cache, a fit that has
converged costs nothing more, and chunks run side by side, one a core: with a GPU too, which is no faster than 16 cores
with machine code. What only JAX evaluates goes there, all fits of a chunk in lockstep.
Either way each is the same function of its data and start. (Lockstep on a CPU gains little, and two programs at once
can deadlock there: XLA splits large operations among the same threads.)
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from switchfit.batch.layout import ProgramLayout
from switchfit.batch.program_inputs import ProgramInputs, replace_leaves
from switchfit.discretization.arguments import Arguments
from switchfit.optimize.traced_constraints import TracedBreakpoints
from switchfit.optimize.traced_sqp import minimize_traced
from switchfit.optimize.traced_state import Outcome, TracedProblem
from switchfit.runtime.cache import use_compilation_cache

ONE_BY_ONE = (
    {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"} if jax.__version_info__ >= (0, 10) else {}
)
"""Options of XLA with which the operations of a program run one after another. They take a microsecond each; to hand
some of them to other threads takes an eighth of the time of all fits."""

compile_for_layout = partial(jax.jit, static_argnames=("layout",), compiler_options=ONE_BY_ONE)
_known: set[Any] = set()
COMPILE_LOCK, GPU_LOCK = threading.Lock(), threading.Lock()


@contextmanager
def compile_once(layout: ProgramLayout, given: object) -> Iterator[None]:
    """Compile the program in the first call that needs it, using the compilation cache; other threads wait."""
    # JAX compiles for each set of shapes; two threads that ask at once would compile twice.
    key = (layout, tuple(np.shape(leaf) for leaf in jax.tree.leaves(given)))
    with COMPILE_LOCK:
        if key not in _known:
            with use_compilation_cache():
                yield
            _known.add(key)
            return
    yield


class Limits(NamedTuple):
    """When a fit ends: arguments of the program, which serves other limits too."""

    tolerance: float
    max_iterations: int


@compile_for_layout
def minimize_fits(
    inputs: ProgramInputs,
    values: tuple[jax.Array, ...],
    limits: Limits,
    starts: jax.Array,
    count: jax.Array,
    *,
    layout: ProgramLayout,
) -> Outcome:
    """Return the outcomes of the first `count` fits."""
    variables = inputs.variables

    def fit(own: tuple[jax.Array, ...], start: jax.Array) -> Outcome:
        # In the optimiser's own variables z (theta on its scales): derivatives follow by the chain rule.
        def evaluate(z: jax.Array, side: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            theta = inputs.find_theta(z)
            J, g, H = inputs.evaluate(layout, own, theta, side)
            return J, *variables.derivatives_inward(theta, g, H, jnp)

        # Breakpoints are data, too: with sample times of its own, each fit has kinks elsewhere.
        breakpoints = _list_breakpoints(layout, inputs.times, replace_leaves(inputs.arguments, layout.varying, own))
        found = minimize_traced(TracedProblem(evaluate, inputs.constraints, breakpoints, *limits), start)
        theta = inputs.find_theta(found.theta)
        left = variables.derivatives_outward(theta, found.left, found.hessian, jnp)[0]
        gradient, hessian = variables.derivatives_outward(theta, found.gradient, found.hessian, jnp)
        return found._replace(theta=theta, gradient=gradient, hessian=hessian, left=left)

    # On a GPU all fits take a step together, and wait for the slowest; on cores one after the other is faster, as none
    # waits.
    if layout.lockstep:
        return jax.vmap(fit)(values, starts)
    empty = Outcome.at_starts(starts)

    def one(k: jax.Array, outcomes: Outcome) -> Outcome:
        outcome = fit(tuple(value[k] for value in values), starts[k])
        return jax.tree.map(lambda all_, new: all_.at[k].set(new), outcomes, outcome)

    return lax.fori_loop(0, count, one, empty)


@compile_for_layout
def evaluate_fits(
    inputs: ProgramInputs,
    values: tuple[jax.Array, ...],
    fits: jax.Array,
    thetas: jax.Array,
    sides: jax.Array,
    count: jax.Array,
    *,
    layout: ProgramLayout,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return cost, gradient and Hessian of the first `count` fits at their thetas."""
    n, d = thetas.shape

    def one(s: jax.Array, found: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        new = inputs.evaluate(layout, [value[fits[s]] for value in values], thetas[s], sides[s])
        return tuple(all_.at[s].set(each) for all_, each in zip(found, new, strict=True))  # type: ignore[return-value]

    empty = jnp.zeros(n), jnp.zeros((n, d)), jnp.zeros((n, d, d))
    return lax.fori_loop(0, count, one, empty)


def _list_breakpoints(
    layout: ProgramLayout, times: tuple[Any, ...], arguments: tuple[Arguments, ...]
) -> TracedBreakpoints:
    """Return the nodes of each free transition time; these are not scaled."""
    nodes = {
        place: own.nodes
        for own, tau, places in zip(arguments, times, layout.places, strict=True)
        for place in places[: len(tau)]
        if place >= 0
    }
    if not nodes:
        return TracedBreakpoints(np.zeros(0, np.intp), jnp.zeros((0, 1)))
    longest = max(len(a) for a in nodes.values())
    # Infinite breakpoints are never met: they make the arrays of all times as long as the longest.
    padded = [jnp.pad(a, (0, longest - len(a)), constant_values=jnp.inf) for a in nodes.values()]
    return TracedBreakpoints(np.array(list(nodes)), jnp.stack(padded))
