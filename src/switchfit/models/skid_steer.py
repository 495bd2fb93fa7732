"""The skid-steered vehicle of Miller and Murphey, equation (18)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Literal

import jax.numpy as jnp
from numpy.typing import ArrayLike

from switchfit.problem.system import HybridSystem

WheelForces = tuple[float, float, float, float]


def skid_steer(
    *,
    stick_forces: WheelForces = (15.0, 15.0, 15.0, 15.0),
    slip_forces: WheelForces = (27.0, 0.0, 0.0, 27.0),
    restick: Literal["continuous", "reset"] = "continuous",
    initial_state: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    m_b: float = 70.0,
    m_w: float = 2.5,
    B_l: float = 0.89,
    B_w: float = 0.55,
    a: float = 0.25,
    b: float = 0.23,
    c_1: float = 0.72,
    c_2: float = 0.92,
    g: float = 9.81,
) -> HybridSystem:
    r"""Return a vehicle with four driven wheels that turns by skidding, modes ``"stick"`` and ``"slip"``, equation
    (18).

    With ``m = m_b + 4 m_w``, ``F`` the sum of the wheel forces and the lateral velocity
    ``v = -sin(theta) dX + cos(theta) dY``:

    stick: ``ddX = (F cos(theta) - c_1 dX)/m``, ``ddY = (F sin(theta) - c_1 dY)/m``, ``ddtheta = 0``;

    slip: ``ddX = (F cos(theta) - c_2 dX)/m + g mu sin(theta) v``,
    ``ddY = (F sin(theta) - c_2 dY)/m - g mu cos(theta) v``,
    ``ddtheta = (12 b (F1 - F2 - F3 + F4) - 12 a² g m mu dtheta) / (4 m_w (12 a² + 12 b²) + m_b (B_l² + B_w²))``.

    Parameters
    ----------
    stick_forces, slip_forces : (float, float, float, float), optional
        Driving force of each wheel in each mode (N), in the paper's order F1 to F4.
    restick : {"continuous", "reset"}, optional
        Behavior at a transition from slip to stick. ``"continuous"``, the paper's model taken literally: the state is
        continuous, so that the yaw rate is constant from there on. ``"reset"``: a reset map sets yaw rate and lateral
        velocity to zero and keeps the velocity along the body.
    initial_state : (6,) array_like, optional
        ``(X, dX, Y, dY, theta, dtheta)`` at t0 (m, m/s, m, m/s, rad, rad/s).
    m_b, m_w : float, optional
        Mass of the body and of a wheel (kg).
    B_l, B_w : float, optional
        Length and width of the body (m).
    a, b : float, optional
        Distance of the wheels from the center of mass along and across the vehicle (m).
    c_1, c_2 : float, optional
        Viscous drag in stick and in slip (kg/s).
    g : float, optional
        Acceleration of gravity (m/s²).

    Returns
    -------
    HybridSystem
        Its parameter is ``mu``, the coefficient of lateral friction (as in (18), a factor of a velocity).

    Raises
    ------
    ValueError
        For an unknown `restick`, or if there are not four forces.

    References
    ----------
    L. M. Miller, T. D. Murphey, Simultaneous optimal estimation of mode transition times and parameters applied to
    simple traction models, equation (18).

    See Also
    --------
    switchfit.models.magic_formula : the same vehicle on tyres.

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import skid_steer

    Two measured positions of the fifteen seconds in which it sticks, slips, and sticks again:

    >>> log = sf.Measurements([5.0, 10.0, 15.0], [[2.3, 0.0], [7.5, 1.4], [9.6, 4.7]], sigma=0.1,
    ...     observe=lambda t, x, p: x[0:3:2], names=("X", "Y"))
    >>> drive = sf.Experiment(log, ("stick", "slip", "stick"), (4.0, 9.0), 0.0, 15.0)
    >>> sf.Problem(skid_steer(), drive, {"mu": sf.Parameter(0.8, lower=0.05)}).theta_names
    ('tau_1', 'tau_2', 'mu')
    """
    for name, forces in (("stick_forces", stick_forces), ("slip_forces", slip_forces)):
        if len(forces) != 4:
            raise ValueError(f"{name} must be four numbers, one for each wheel; got {forces!r}.")
    if restick not in ("continuous", "reset"):
        raise ValueError(f"restick must be 'continuous' or 'reset'; got {restick!r}.")
    driving = tuple(map(float, stick_forces)), tuple(map(float, slip_forces))
    stick, slip, at_restick = _functions(*driving, m_b, m_w, B_l, B_w, a, b, c_1, c_2, g)
    return HybridSystem(
        modes={"stick": stick, "slip": slip},
        initial_state=initial_state,
        reset_maps={("slip", "stick"): at_restick} if restick == "reset" else {},
        state_names=("X", "dX", "Y", "dY", "theta", "dtheta"),
        state_units=("m", "m/s", "m", "m/s", "rad", "rad/s"),
    )


@cache
def _functions(
    stick_forces: tuple[float, ...],
    slip_forces: tuple[float, ...],
    m_b: float,
    m_w: float,
    B_l: float,
    B_w: float,
    a: float,
    b: float,
    c_1: float,
    c_2: float,
    g: float,
) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """Return vector fields and reset map, cached by the constants so that nothing is compiled twice."""
    m = m_b + 4 * m_w
    inertia = 4 * m_w * (12 * a**2 + 12 * b**2) + m_b * (B_l**2 + B_w**2)
    total_stick, total_slip = sum(stick_forces), sum(slip_forces)
    F_1, F_2, F_3, F_4 = slip_forces
    turning = 12 * b * (F_1 - F_2 - F_3 + F_4)

    def stick(t: Any, x: Any, p: Any) -> Any:
        _, dX, _, dY, theta, dtheta = x
        ddX = (total_stick * jnp.cos(theta) - c_1 * dX) / m
        ddY = (total_stick * jnp.sin(theta) - c_1 * dY) / m
        return jnp.stack([dX, ddX, dY, ddY, dtheta, jnp.zeros_like(dtheta)])

    def slip(t: Any, x: Any, p: Any) -> Any:
        _, dX, _, dY, theta, dtheta = x
        cos, sin = jnp.cos(theta), jnp.sin(theta)
        v = -sin * dX + cos * dY
        ddX = (total_slip * cos - c_2 * dX) / m + g * p["mu"] * sin * v
        ddY = (total_slip * sin - c_2 * dY) / m - g * p["mu"] * cos * v
        ddtheta = (turning - 12 * a**2 * g * m * p["mu"] * dtheta) / inertia
        return jnp.stack([dX, ddX, dY, ddY, dtheta, ddtheta])

    def at_restick(t: Any, x: Any, p: Any) -> Any:
        X, dX, Y, dY, theta, dtheta = x
        cos, sin = jnp.cos(theta), jnp.sin(theta)
        along = cos * dX + sin * dY
        return jnp.stack([X, along * cos, Y, along * sin, theta, jnp.zeros_like(dtheta)])

    return stick, slip, at_restick
