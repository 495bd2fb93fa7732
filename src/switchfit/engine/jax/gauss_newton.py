"""The Gauss-Newton matrix: the Hessian without the second derivatives of the trajectory and of the observations."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from switchfit.discretization.model import Model, Piece, apply_weights
from switchfit.discretization.nodes import get_end_cost, list_costs_at_transitions
from switchfit.discretization.propagation import (
    Path,
    compute_path_cost,
    map_stages,
    propagate,
    see_samples,
    weigh_stages,
)

Array = jax.Array


class Points(NamedTuple):
    """What costs without residuals depend on.

    Attributes
    ----------
    stages : (R, s, n), the states at the stages
    transitions : list of (), (n,): time and state of each transition with a cost
    end : (n,), x(tf)
    p : (M,)
    """

    stages: Array
    transitions: list[tuple[Array, Array]]
    end: Array
    p: Array


def differentiate_residuals(model: Model, theta: Array, side: Array) -> tuple[Array, Array, Array]:
    """Return the cost, its gradient (D,) and the Gauss-Newton matrix (D, D).

    A robust loss weighs each residual by rho', which is never negative; a sigma that is a parameter contributes its
    Fisher information. A cost without residuals contributes its own second derivative in what it depends on.
    """
    structure, N = model.structure, model.structure.N

    def simulate(theta: Array) -> tuple[Any, Any]:
        p = theta[N:]
        path = propagate(model, theta[:N], p, side)
        residuals, log_sigmas, information = [], [], []
        for k, sensor in enumerate(structure.measurements):
            seen = see_samples(model, path, k, p)
            residuals.append(jax.vmap(partial(model.sample_residual, k), in_axes=(0, 0, None))(*seen, p))
            information.append(jax.vmap(partial(model.sample_information, k), in_axes=(0, 0, None))(*seen, p))
            if sensor.sigma:
                log_sigmas.append(jax.vmap(partial(model.log_sigma, k), in_axes=(0, None))(seen[0], p))

        def track(mode: int, piece: Piece, t: Array, x: Array) -> list[Array]:
            found = [residual(t, x, p) for residual in model.reference_residuals(piece)]
            return [0.0 * r for r in found] if structure.is_rest(mode) else found

        transitions = [path.at_transition(i) for i, _ in list_costs_at_transitions(model)]
        points = Points(path.stages, transitions, path.after[-1], p)
        cost, tracked = compute_path_cost(model, path, p), map_stages(model, path, track, path.stages)
        return (cost, residuals, log_sigmas, tracked, points), (cost, path, points, information)

    derivatives, (cost, path, points, information) = jax.jacfwd(simulate, has_aux=True)(theta)
    gradient, residuals_d, log_sigmas_d, tracked_d, points_d = derivatives

    # The second derivative of a cost at theta + e whose points move linearly in e: D^2 cost along the tangents, without
    # the second derivatives of the trajectory.
    def add_other_costs(e: Array) -> Array:
        """Return the costs without residuals at theta + e, to first order in the points."""
        return sum_other_costs(model, path, jax.tree.map(lambda value, slope: value + slope @ e, points, points_d))

    H = jax.hessian(add_other_costs)(jnp.zeros_like(theta))
    for r_d, weight in zip(residuals_d, information, strict=True):
        H = H + jnp.einsum("kqd,kq,kqe->de", r_d, weight, r_d)
    for s_d in log_sigmas_d:  # Fisher information of normal noise: 2 for log sigma, 0 between sigma and the rest
        H = H + 2.0 * jnp.einsum("kqd,kqe->de", s_d, s_d)
    # A reference signal is a residual at each stage, of weight h b_j W.
    hb = weigh_stages(model, path.layout).reshape(-1)
    for r_d, W in zip(tracked_d, model.arguments.weights, strict=True):
        at_stages = r_d.reshape(-1, *r_d.shape[2:])
        H = H + jnp.einsum("sqd,s,sqe->de", at_stages, hb, jax.vmap(partial(apply_weights, W))(at_stages))
    return cost, gradient, H


def sum_other_costs(model: Model, path: Path, at: Points) -> Array:
    """Return the running costs, and those at transitions and at the end."""
    total, final = jnp.zeros(()), get_end_cost(model)
    for (_, cost), (t, x) in zip(list_costs_at_transitions(model), at.transitions, strict=True):
        total = total + cost(t, x, at.p)
    if final is not None:
        total = total + final(path.at_end()[0], at.end, at.p)
    if not model.structure.running:
        return total

    def ell(mode: int, piece: Piece, t: Array, x: Array) -> Array:
        rates = [jnp.asarray(ell(t, x, model.parameters(at.p))).reshape(()) for ell in model.structure.running]
        return jnp.zeros(()) if model.structure.is_rest(mode) else sum(rates, jnp.zeros(()))

    return total + (weigh_stages(model, path.layout) * map_stages(model, path, ell, at.stages)).sum()
