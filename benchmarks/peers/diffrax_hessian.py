"""diffrax: `diffeqsolve` segment by segment in one jitted function, the switches as traced times, float64.

Forward over forward (`jax.jacfwd` twice) with ``adjoint=ForwardMode()`` is what the documentation recommends for
forward-mode differentiation, and few unknowns ask for it. ``jax.hessian``, forward over reverse, is the documentation's
own example of a Hessian: ``Tsit5(scan_kind="bounded")`` with the default adjoint; maintainers advise `DirectAdjoint`
for it. Both are built by `build`, by the names in `WAYS`. The gradient of the second is reverse mode through
`RecursiveCheckpointAdjoint`, the default and recommended for reverse mode. Solvers are the documentation's: Tsit5 for
moderate and Dopri8 for high accuracy, Kvaerno5 for stiff problems, with a PIDController (its default coefficients;
those the documentation gives for stiff problems there).

Segments that are many are run by one `lax.scan` with a `lax.switch` between the modes, which keeps the program small.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.models import Model
from benchmarks.peers import Functions

LADDER = (1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
WAYS = ("forward over forward", "forward over reverse")
UNROLLED = 3
"""Segments up to which each has a `diffeqsolve` of its own."""

MAX_STEPS = 4096


def build(
    model: Model, rtol: float, modes: dict[str, Callable[..., Any]], pack: Callable[[Any], dict[str, Any]], way: str
) -> Functions:
    """J and its derivatives; `modes` are ``f(t, x, p)`` in `jax.numpy`, `pack` makes their p from the parameters."""
    forward = way == WAYS[0]
    with jax.enable_x64(True):
        cost = _cost(model, rtol, modes, pack, "lax" if forward else "bounded", _adjoint(forward, 2))
        first = _cost(model, rtol, modes, pack, "lax" if forward else None, _adjoint(forward, 1))
        plain = _cost(model, rtol, modes, pack, None, diffrax.RecursiveCheckpointAdjoint())
    if forward:
        gradient = _with_value(jax.jacfwd(_twice(first), has_aux=True))
        hessian = _with_gradient(jax.jacfwd(_with_aux(jax.jacfwd(_twice(cost), has_aux=True)), has_aux=True))
    else:
        gradient = jax.value_and_grad(first)
        hessian = _with_gradient(jax.jacfwd(_with_aux(jax.value_and_grad(cost), True), has_aux=True))
    solver = type(_solver(model, rtol, None)).__name__
    return Functions(
        f"{solver}, rtol {rtol:.0e}, {way}", _numpy(jax.jit(plain)), _numpy(jax.jit(gradient)), _numpy(jax.jit(hessian))
    )


def _twice(function: Any) -> Any:
    def both(theta: Any) -> Any:
        value = function(theta)
        return value, value

    return both


def _with_value(derivative: Any) -> Any:
    def swapped(theta: Any) -> Any:
        gradient, value = derivative(theta)
        return value, gradient

    return swapped


def _with_aux(derivative: Any, value_first: bool = False) -> Any:
    """(gradient, (gradient, value)) of a function that gives the two in either order."""

    def both(theta: Any) -> Any:
        value, gradient = derivative(theta) if value_first else derivative(theta)[::-1]
        return gradient, (gradient, value)

    return both


def _with_gradient(second: Any) -> Any:
    def all_three(theta: Any) -> Any:
        H, (gradient, value) = second(theta)
        return value, gradient, H

    return all_three


def _adjoint(forward: bool, order: int) -> Any:
    if forward:
        return diffrax.ForwardMode()
    return diffrax.RecursiveCheckpointAdjoint() if order == 1 else diffrax.DirectAdjoint()


def _solver(model: Model, rtol: float, scan_kind: str | None) -> Any:
    if model.stiff:
        return diffrax.Kvaerno5(scan_kind=scan_kind)
    return diffrax.Dopri8(scan_kind=scan_kind) if rtol < 1e-7 else diffrax.Tsit5(scan_kind=scan_kind)


def _cost(model: Model, rtol: float, modes: Any, pack: Any, scan_kind: str | None, adjoint: Any) -> Any:
    """J as a function of theta that JAX can differentiate."""
    solver = _solver(model, rtol, scan_kind)
    gains = {"pcoeff": 0.3, "icoeff": 0.3} if model.stiff else {}
    names = list(model.modes)

    def rates(mode: str) -> Any:
        def f(t: Any, y: Any, p: Any) -> Any:
            return jnp.append(modes[mode](t, y[:-1], p), model.density(y[:-1]))

        return f

    def solve(f: Any, y: Any, start: Any, end: Any, args: Any) -> Any:
        controller = diffrax.PIDController(rtol=rtol, atol=rtol / 100, **gains)
        return diffrax.diffeqsolve(
            diffrax.ODETerm(f),
            solver,
            start,
            end,
            None,
            y,
            args,
            stepsize_controller=controller,
            adjoint=adjoint,
            max_steps=MAX_STEPS,
        ).ys[-1]

    def cost(theta: Any) -> Any:
        N = len(model.times)
        p = pack(theta[N:])
        y = jnp.append(jnp.array(model.x0), 0.0)
        if len(model.sequence) <= UNROLLED:
            for mode, start, end in model.segments(theta):
                y = solve(rates(mode), y, jnp.asarray(start, float), jnp.asarray(end, float), p)
            return y[-1]
        which = jnp.array([names.index(mode) for mode in model.sequence])
        ends = jnp.concatenate([jnp.array([model.horizon[0]]), theta[:N], jnp.array([model.horizon[1]])])
        branches = [rates(mode) for mode in names]

        def f(t: Any, y: Any, args: Any) -> Any:
            mode, p = args
            return jax.lax.switch(mode, branches, t, y, p)

        def segment(y: Any, given: Any) -> Any:
            mode, start, end = given
            return solve(f, y, start, end, (mode, p)), None

        return jax.lax.scan(segment, y, (which, ends[:-1], ends[1:]))[0][-1]

    return cost


def _numpy(program: Any) -> Any:
    """The program as a function of NumPy arrays."""

    def call(theta: np.ndarray) -> Any:
        with jax.enable_x64(True):
            found = program(theta)
        if isinstance(found, tuple):
            return (float(found[0]), *(np.asarray(array) for array in found[1:]))
        return float(found)

    return call
