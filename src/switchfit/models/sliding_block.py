"""A body that slides on a plane with Coulomb friction until it sticks."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import jax.numpy as jnp

from switchfit.arrays import Traced
from switchfit.models.constants import Constant, Constants, Values, check_constants
from switchfit.problem.system import HybridSystem


def sliding_block(*, g: Constant = 9.81) -> HybridSystem:
    r"""Return a body sliding on a level plane, modes ``"slide"`` and ``"stick"``, state ``(x, y, vx, vy)``.

    Friction acts opposite to the velocity, so that the body moves on a straight line. With ``e`` the unit vector along
    the initial velocity ``(vx0, vy0)``,

    slide: ``d(vx, vy)/dt = -mu g e``; stick: ``d(x, y, vx, vy)/dt = 0``.

    With the constant ``e`` instead of ``v/|v|``, the field is smooth where the velocity passes zero: if the optimizer
    tries a transition time that is too late, the body turns back, and there is no division by zero.

    Parameters
    ----------
    g : float or str, optional
        Acceleration of gravity (m/s²).

    Returns
    -------
    HybridSystem
        Its parameters are ``mu`` (friction coefficient, 1), ``x0``, ``y0`` (position at t0, m) and ``vx0``,
        ``vy0`` (velocity at t0, m/s; not both zero).

    See Also
    --------
    switchfit.models.rolling_body, switchfit.models.lugre

    Notes
    -----
    In ``"stick"`` the velocity is constant, not set to zero: a body sticks when it has come to rest, and a remaining
    velocity at the transition is a misfit to measured velocities. Positions alone determine the time of sticking badly:
    the rest position is stationary in it exactly where the body comes to rest by itself.

    Examples
    --------
    >>> from switchfit.models import sliding_block

    A block that starts with 2 m/s and comes to rest after ``v / (mu g)`` = 0.51 s:

    >>> log = sf.Measurements([0.2, 0.4, 0.6], [[1.215], [0.431], [0.0]], observe=lambda t, x, p: x[2:3], sigma=0.01)
    >>> start = {"x0": 0.0, "y0": 0.0, "vx0": 2.0, "vy0": 0.0}
    >>> known = {name: sf.Parameter(value, fixed=True) for name, value in start.items()}
    >>> run = sf.Experiment(log, ("slide", "stick"), (0.5,), 0.0, 0.8)
    >>> fit = sf.estimate(sf.Problem(sliding_block(), run, {"mu": sf.Parameter(0.3, lower=0.0)} | known))
    >>> fit.theta.round(2)
    array([0.51, 0.4 ])
    """
    return HybridSystem(
        modes={"slide": partial(_brake, check_constants(positive={"g": g})), "stick": _keep_velocity},
        initial_state=_start_block,
        state_names=("x", "y", "vx", "vy"),
        state_units=("m", "m", "m/s", "m/s"),
    )


def _brake(constants: Constants, t: Traced, x: Traced, p: Mapping[str, Traced]) -> Traced:
    # The direction of the initial velocity, and not of the present one: see the docstring.
    speed = jnp.sqrt(p["vx0"] ** 2 + p["vy0"] ** 2)
    deceleration = p["mu"] * Values(constants, p)["g"] / speed
    return jnp.stack([x[2], x[3], -deceleration * p["vx0"], -deceleration * p["vy0"]])


def _keep_velocity(t: Traced, x: Traced, p: Mapping[str, Traced]) -> Traced:
    return jnp.zeros_like(x)


def _start_block(p: Mapping[str, Traced]) -> Traced:
    return jnp.stack([p["x0"], p["y0"], p["vx0"], p["vy0"]])
