"""The Gauss-Newton matrix of one experiment by JAX: second derivatives of trajectory and outputs are left out."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from switchfit.discretization import path_costs, propagation, sampled_states
from switchfit.discretization.model import Model, apply_weights
from switchfit.discretization.signals import Piece


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
            seen = sampled_states.see_samples(model, path, k, p)
            residuals.append(jax.vmap(partial(model.sample_residual, k), in_axes=(0, 0, None))(*seen, p))
            information.append(jax.vmap(partial(model.sample_information, k), in_axes=(0, 0, None))(*seen, p))
            if sensor.sigma:
                log_sigmas.append(jax.vmap(partial(model.log_sigma, k), in_axes=(0, None))(seen[0], p))

        def track(mode: int, piece: Piece, t: Array, x: Array) -> list[Array]:
            found = [residual(t, x, p) for residual in model.reference_residuals(piece)]
            return [0.0 * r for r in found] if structure.is_rest(mode) else found

        points = path.stages, path.after, path.layout.end, p
        cost = path_costs.compute_path_cost(model, path, p)
        tracked = path_costs.map_stages(model, path, track, path.stages)
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
        return path_costs.integrate_running_cost(others, moved, p) + path_costs.add_point_costs(model, at_points, p)

    H = jax.hessian(add_other_costs)(jnp.zeros_like(theta))
    for r_d, weight in zip(residuals_d, information, strict=True):
        H = H + jnp.einsum("kqd,kq,kqe->de", r_d, weight, r_d)
    for s_d in log_sigmas_d:  # Fisher information of normal noise: 2 for log sigma, 0 between sigma and the rest
        H = H + 2.0 * jnp.einsum("kqd,kqe->de", s_d, s_d)
    # A reference signal is a residual at each stage, of weight h b_j W.
    hb = path_costs.weigh_stages(model, path.layout).reshape(-1)
    for r_d, W in zip(tracked_d, model.arguments.weights, strict=True):
        at_stages = r_d.reshape(-1, *r_d.shape[2:])
        H = H + jnp.einsum("sqd,s,sqe->de", at_stages, hb, jax.vmap(partial(apply_weights, W))(at_stages))
    return cost, gradient, H
