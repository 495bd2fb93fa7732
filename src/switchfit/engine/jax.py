"""JAX as an engine, the plain reference: for any model, on any device.

The programs that JAX compiles: cost and derivatives of one experiment.

They differentiate the simulation as it is. A step is one row of `switchfit.discretization.propagation.propagate`, whose
derivatives JAX finds; those of an implicit step follow from the implicit function theorem
(`switchfit.discretization.propagation`). A Hessian is differentiated forward first, then backward: the other
way round, JAX would lose the rules of users' `jax.custom_jvp` functions inside a scan at the second derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from switchfit.discretization import propagation
from switchfit.discretization.mesh import Arguments, Mesh, Rows, build_rows
from switchfit.discretization.model import Model, Piece, apply_weights
from switchfit.engine.protocol import (
    Costates,
    DenseEvaluation,
    Engine,
    Evaluation,
    Matrix,
    Simulation,
    Tangents,
    finish_simulation,
)
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure, pad_length
from switchfit.runtime.cache import use_compilation_cache

Array = jax.Array


def differentiate_residuals(model: Model, theta: Array, side: Array) -> tuple[Array, Array, Array]:
    """Return the cost, its gradient (D,) and the Gauss-Newton matrix (D, D).

    A robust loss weighs each residual by rho', which is never negative; a sigma that is a parameter contributes its
    Fisher information. A cost without residuals contributes its own second derivative in what it depends on.
    """
    structure, N = model.structure, model.structure.N

    def simulate(theta: Array) -> tuple[Any, Any]:
        p = theta[N:]
        path = propagation.propagate(model, theta[:N], p, side)
        residuals, log_sigmas, information = [], [], []
        for k, sensor in enumerate(structure.measurements):
            seen = propagation.see_samples(model, path, k, p)
            residuals.append(jax.vmap(partial(model.sample_residual, k), in_axes=(0, 0, None))(*seen, p))
            information.append(jax.vmap(partial(model.sample_information, k), in_axes=(0, 0, None))(*seen, p))
            if sensor.sigma:
                log_sigmas.append(jax.vmap(partial(model.log_sigma, k), in_axes=(0, None))(seen[0], p))

        def track(mode: int, piece: Piece, t: Array, x: Array) -> list[Array]:
            found = [residual(t, x, p) for residual in model.reference_residuals(piece)]
            return [0.0 * r for r in found] if structure.is_rest(mode) else found

        points = path.stages, path.after, path.layout.end, p
        cost = propagation.compute_path_cost(model, path, p)
        tracked = propagation.map_stages(model, path, track, path.stages)
        return (cost, residuals, log_sigmas, tracked, points), (cost, path, points, information)

    derivatives, (cost, path, points, information) = jax.jacfwd(simulate, has_aux=True)(theta)
    gradient, residuals_d, log_sigmas_d, tracked_d, points_d = derivatives

    # Without the references, which are residuals.
    others = Model(replace(structure, references=()), model.arguments._replace(weights=()))

    # The second derivative of a cost at theta + e whose points move linearly in e: D^2 cost along the tangents, without
    # the second derivatives of the trajectory.
    def add_other_costs(e: Array) -> Array:
        """Return the costs without residuals at theta + e, to first order in the points."""
        stages, after, end, p = jax.tree.map(lambda value, slope: value + slope @ e, points, points_d)
        moved = path._replace(stages=stages, after=after)  # weights of stages stay, times of transitions do not
        at_points = moved._replace(layout=path.layout._replace(end=end))
        return propagation.integrate_running_cost(others, moved, p) + propagation.add_point_costs(model, at_points, p)

    H = jax.hessian(add_other_costs)(jnp.zeros_like(theta))
    for r_d, weight in zip(residuals_d, information, strict=True):
        H = H + jnp.einsum("kqd,kq,kqe->de", r_d, weight, r_d)
    for s_d in log_sigmas_d:  # Fisher information of normal noise: 2 for log sigma, 0 between sigma and the rest
        H = H + 2.0 * jnp.einsum("kqd,kqe->de", s_d, s_d)
    # A reference signal is a residual at each stage, of weight h b_j W.
    hb = propagation.weigh_stages(model, path.layout).reshape(-1)
    for r_d, W in zip(tracked_d, model.arguments.weights, strict=True):
        at_stages = r_d.reshape(-1, *r_d.shape[2:])
        H = H + jnp.einsum("sqd,s,sqe->de", at_stages, hb, jax.vmap(partial(apply_weights, W))(at_stages))
    return cost, gradient, H


Method = Literal["forward", "discrete-adjoint"]

NOT_BACKWARD = "Reverse-mode differentiation does not work"
"""What JAX says of a loop of unknown length."""


@partial(jax.jit, static_argnames=("structure", "method", "matrix"))
def derivatives(
    arguments: Arguments,
    tau: Array,
    p: Array,
    side: Array,
    multipliers: Array | None = None,
    *,
    structure: Structure,
    method: Method,
    matrix: Matrix = "exact",
) -> tuple[Array, ...]:
    """Return the cost, gradient (D,) and Hessian (D, D) of one experiment in its transition times (N,) and its p (M,).

    With multipliers (m,), the derivatives are those of ``J + multipliers . c``, and the constraints (m,) and their
    derivatives (m, D) follow.

    The method "discrete-adjoint" differentiates the slopes of J backward for the Hessian, where JAX can, "forward"
    forward. With the matrix "none" the Hessian is NaN.
    """
    model, theta = Model(structure, arguments), jnp.concatenate([tau, p])
    if matrix == "gauss-newton":
        return differentiate_residuals(model, theta, side)

    if matrix == "none":
        g, J = _differentiate(method, lambda theta: (_evaluate(model, theta, side)[0],) * 2, theta)
        return J, g, jnp.full((theta.size, theta.size), jnp.nan)
    lam = jnp.zeros(0) if multipliers is None else multipliers
    evaluate = partial(_evaluate, model, side=side, constrained=multipliers is not None)

    # Row k of H: the slope of the Lagrangian along e_k by one tangent, and its gradient is D (D J . e_k).
    def along(direction: Array) -> tuple[Array, ...]:
        def slope(theta: Array) -> tuple[Array, tuple[Array, ...]]:
            (J, c), (J_d, c_d) = jax.jvp(evaluate, (theta,), (direction,))
            # c_d is the column of the Jacobian along this direction: vmap stacks them on axis 1.
            lagrangian_d = J_d + lam @ c_d
            return lagrangian_d, (J, lagrangian_d, c, c_d)

        row, (J, lagrangian_d, c, c_d) = _differentiate(method, slope, theta)
        return J, lagrangian_d, row, c, c_d

    found: tuple[Array, ...] = jax.vmap(along, out_axes=(None, 0, 0, None, 1))(jnp.eye(theta.size))
    return found[:3] if multipliers is None else found


def _evaluate(model: Model, theta: Array, side: Array, constrained: bool = False) -> tuple[Array, Array]:
    """Return the cost, and the constraints (m,) if they are asked for."""
    N = model.structure.N
    path, p = propagation.propagate(model, theta[:N], theta[N:], side), theta[N:]
    c = propagation.compute_path_constraints(model, path, p) if constrained else jnp.zeros(0)
    return propagation.compute_path_cost(model, path, p), c


def _differentiate(method: Method, function: Callable[[Array], tuple[Array, Any]], theta: Array) -> Any:
    """Return the derivative (D,) of the first result, and the second; JAX cannot go back through an endless loop."""
    found = _try_backward(function, theta) if method == "discrete-adjoint" else None
    return found or jax.jacfwd(function, has_aux=True)(theta)


def _try_backward(function: Callable[[Array], tuple[Array, Any]], at: Array) -> Any:
    """Return the derivative of the first result, and the second; None if there is a loop of unknown length."""
    try:
        return jax.grad(function, has_aux=True)(at)
    except ValueError as error:
        if NOT_BACKWARD not in str(error):
            raise
        return None


@partial(jax.jit, static_argnames=("structure",))
def differentiate_in_states(
    arguments: Arguments, tau: Array, p: Array, multipliers: Array, *, structure: Structure
) -> tuple[Array, Array]:
    """Return the states at the starts of all rows, and the derivatives of ``J + multipliers . c`` in them: (R, n).

    Samples at t0 lie before the first row, and are left out.
    """
    # The nudge of row 0 comes behind the samples at t0, which it does not change; late samples are steps from there on.
    later = [
        s if sensor.delay is not None else s._replace(weight=jnp.where(s.cell[:, None] < 0, 0.0, s.weight))
        for s, sensor in zip(arguments.samples, structure.measurements, strict=True)
    ]
    model = Model(structure, arguments._replace(samples=tuple(later)))

    def lagrangian(nudges: Array) -> tuple[Array, Array]:
        path = propagation.propagate(model, tau, p, jnp.ones(()), nudges)
        J, c = propagation.compute_path_cost(model, path, p), propagation.compute_path_constraints(model, path, p)
        return J + multipliers @ c, path.before

    rows = arguments.nodes.shape[0] - 1 + structure.N
    found = _try_backward(lagrangian, jnp.zeros((rows, structure.n)))
    if found is None:
        raise ValueError(
            "costates, from which insertion rates follow, need derivatives that JAX does not have through a loop of "
            "unknown length, as jax.lax.while_loop: write jax.lax.scan, or jax.lax.fori_loop with fixed ends."
        )
    costates, states = found
    return states, costates


@partial(jax.jit, static_argnames=("structure", "tangents"))
def simulate_rows(
    arguments: Arguments, tau: Array, p: Array, *, structure: Structure, tangents: bool
) -> tuple[Array, list[Array], tuple[Array, ...], tuple[Array, ...]]:
    """Simulate one experiment.

    Returns
    -------
    cost : J
    late : for each late Measurements the outputs of all sensors at its samples, (K, q)
    rows : states before and after each of R rows, 2 x (R, n), and the outputs of all sensors there, 2 x (R, q)
    derivatives : those of the rows at fixed times, along an additional last axis of length D; empty without `tangents`
    """
    model, N, theta = Model(structure, arguments), structure.N, jnp.concatenate([tau, p])

    def see(t: Array, x: Array, p: Array) -> Array:
        return jnp.concatenate([jnp.zeros(0), *(model.observe(h, t, x, p) for h, _ in structure.outputs)])

    def run(theta: Array) -> tuple[Any, Any]:
        path = propagation.propagate(model, theta[:N], theta[N:], jnp.ones(()))
        return (path.before, path.after), path

    see_all = jax.vmap(see, in_axes=(0, 0, None))
    moving, path = jax.jacfwd(run, has_aux=True)(theta) if tangents else run(theta)
    times, opening = (path.layout.start, path.layout.end), path.layout.first_row[1:]
    states, J = (path.before, path.after), propagation.compute_path_cost(model, path, p)
    rows = *states, *(see_all(*at, p) for at in zip(times, states, strict=True))
    late = [k for k, sensor in enumerate(structure.measurements) if sensor.delay is not None]
    seen = [see_all(samples.time, x, p) for samples, x in (propagation.see_samples(model, path, k, p) for k in late)]
    if not tangents:
        return J, seen, rows, ()

    # At the rows that begin or end at a transition, dx/dt times the derivative of the time is subtracted.
    def fix_times(values: Array, moving: Array, side: int) -> Array:
        for i in range(N):
            row = opening[i] - 1 + side
            piece = jax.tree.map(lambda a, row=row: a[row], path.pieces)
            slope = propagation.switch_mode(model, i + side, partial(model.field, piece=piece), tau[i], values[row], p)
            moving = moving.at[row, :, i].add(-slope)
        return moving

    def see_along(t: Array, x: Array, x_d: Array) -> Array:
        in_x, in_p = jax.jacfwd(see, argnums=(1, 2))(t, x, p)
        return in_x @ x_d + jnp.pad(in_p, ((0, 0), (N, 0)))

    derivatives = fix_times(path.before, moving[0], 1), fix_times(path.after, moving[1], 0)
    return J, seen, rows, (*derivatives, *map(jax.vmap(see_along), times, states, derivatives))


@partial(jax.jit, static_argnames=("structure", "function", "which"))
def call_model(
    arguments: Arguments, *given: Any, structure: Structure, function: Callable[..., Array], which: tuple[int, ...] = ()
) -> Array:
    """Return ``function(model, *which, *given)``, compiled."""
    return function(Model(structure, arguments), *which, *given)


def _compute_fields(model: Model, times: Array, states: Array, pieces: Piece, p: Array) -> Array:
    """Return the vector fields of all modes at times (L,), with the signals of L cells, and states (L, n)."""

    def at_point(t: Array, x: Array, piece: Piece) -> Array:
        return jnp.stack([model.field(mode, piece)(t, x, p) for mode in range(len(model.structure.modes))])

    return jax.vmap(at_point)(times, states, pieces)


class JaxEngine:
    """Evaluates one experiment on one mesh with JAX programs.

    Parameters
    ----------
    structure : Structure
    arguments : Arguments
    mesh : Mesh
    reason : str, optional
        Why the experiment is not evaluated in machine code.
    """

    def __init__(self, structure: Structure, arguments: Arguments, mesh: Mesh, reason: str = "") -> None:
        self._structure, self._arguments, self._mesh = structure, arguments, mesh
        self._reason = reason
        self._compiled: set[Any] = set()

    @cached_property
    def _any_sequence(self) -> Structure:
        # All sequences of as many modes share a program, unless reset maps, guards or costs at transitions differ: a
        # search for the sequence would compile each of them for seconds.
        return replace(self._structure, mode_of_segment=())

    @property
    def engine(self) -> Engine:
        """JAX, with the reason."""
        return Engine("jax", self._reason, self._structure.list_implicit_modes())

    def judge_rows(self) -> None:
        """Do nothing: programs of JAX estimate no errors."""

    def cost(self, tau: FloatArray, p: FloatArray) -> float:
        """Return J alone."""
        return self.simulate(tau, p, tangents=False).cost

    def derivatives(
        self, tau: FloatArray, p: FloatArray, side: float, matrix: Matrix, method: Method = "discrete-adjoint"
    ) -> DenseEvaluation:
        """Return J and its derivatives, by one of the methods of `derivatives`."""
        J, g, H = self._run(derivatives, tau, p, float(side), method=method, matrix=matrix)
        return Evaluation(float(J), np.array(g), np.array(H))  # copies: arrays of JAX are read-only

    def _run(self, program: Callable[..., Any], *given: Any, **settings: Any) -> Any:
        """Return what a program yields for the experiment; only once it looks for it among the compiled ones."""
        key = program, *settings.values()
        with use_float64(), nullcontext() if key in self._compiled else use_compilation_cache():
            found = program(self._on_device, *given, structure=self._any_sequence, **settings)
        self._compiled.add(key)
        return found

    def constrained(self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray) -> DenseEvaluation:
        """Return J and the constraints, with the Hessian of ``J + multipliers . c``."""
        found = self._run(derivatives, tau, p, float(side), multipliers, method="discrete-adjoint")
        J, slope, H, c, A = map(np.array, found)
        return Evaluation(float(J), slope - multipliers @ A, H, c, A)

    def find_constraints(self, tau: FloatArray, p: FloatArray, side: float) -> DenseEvaluation:
        """Return J and the constraints with their derivatives, and those of J."""
        count = len(self._structure.guarded) + self._structure.terminal_constraint_count
        return self.constrained(tau, p, side, np.zeros(count))

    def costates(self, tau: FloatArray, p: FloatArray, multipliers: FloatArray) -> Costates:
        """Return the costates of ``J + multipliers . c`` at the starts of all rows."""
        found = self._run(differentiate_in_states, tau, p, multipliers)
        layout, rows = self._cut_rows(tau)
        states, costates = (np.asarray(values)[rows] for values in found)
        return Costates.of_rows(self._structure, layout.first_row, layout.start[rows], states, costates)

    def slopes(self, times: FloatArray, cells: NDArray[np.intp], states: FloatArray, p: FloatArray) -> FloatArray:
        """Return the vector fields of all modes at given points."""
        count, padded = len(times), pad_length(len(times))  # for few different programs
        pieces = Piece(self._arguments.nodes[cells], self._arguments.signals[cells])
        points = jax.tree.map(lambda a: np.resize(a, (padded, *a.shape[1:])), (times, states, pieces))
        with use_float64(), use_compilation_cache():
            given = self._arguments.without_mesh(), *points, p
            found = call_model(*given, structure=self._structure.functions, function=_compute_fields)
        return np.asarray(found)[:count]

    def simulate(self, tau: FloatArray, p: FloatArray, *, tangents: bool) -> Simulation:
        """Return all rows, with their derivatives if `tangents`."""
        found = self._run(simulate_rows, tau, p, tangents=tangents)
        layout, rows = self._cut_rows(tau)
        J, late, values, derivatives = jax.tree.map(np.asarray, found)
        which = [k for k, sensor in enumerate(self._structure.measurements) if sensor.delay is not None]
        of_rows = (each[rows] for each in (layout.start, layout.end, *values))
        simulation = Simulation(float(J), self._mesh.times, layout.first_cell, *of_rows)
        if tangents:
            simulation = replace(simulation, tangents=Tangents(*(each[rows] for each in derivatives)))
        seen = dict(zip(which, late, strict=True))
        return finish_simulation(simulation, self._structure, self._arguments, seen)

    def _cut_rows(self, tau: FloatArray) -> tuple[Rows, slice]:
        """Return the rows at given transition times, and which of them are no padding of the mesh."""
        layout = build_rows(self._mesh.nodes, tau, self._structure.fix_sides(1.0, np), np)
        return layout, slice(self._mesh.cells + len(tau))

    @cached_property
    def _on_device(self) -> Arguments:
        with use_float64():
            sequence = np.array(self._structure.mode_of_segment)
            return jax.device_put(self._arguments._replace(sequence=sequence))  # type: ignore[arg-type]
