"""Pacejka's Magic Formula of 1987, and a skid-steered vehicle whose wheel forces come from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from switchfit.problem.system import HybridSystem

#: Coefficients a_1 to a_8 of the longitudinal (x) and the lateral (y) force of 1987, by the parameter's name.
MAGIC_FORMULA: Mapping[str, float] = MappingProxyType(
    {
        **{f"a_x{i}": a for i, a in enumerate((-21.3, 1144.0, 49.6, 226.0, 0.069, -0.006, 0.056, 0.486), start=1)},
        **{f"a_y{i}": a for i, a in enumerate((-22.1, 1011.0, 1078.0, 1.82, 0.208, 0.0, -0.354, 0.707), start=1)},
    }
)

#: Shape factors C, which are not among the fitted coefficients.
C_X, C_Y = 1.65, 1.30
#: Slip below which a wheel's force is linear in the slip: at zero, the direction of the slip is undefined.
SMALL_SLIP = 1e-3


def longitudinal_force(slip: Any, load: Any, p: Mapping[str, Any]) -> Any:
    """Return the longitudinal force of a tyre (N) at a slip ratio in % and a load in kN; `p` holds a_x1 to a_x8."""
    a_1, a_2, a_3, a_4, a_5, a_6, a_7, a_8 = (p[f"a_x{i}"] for i in range(1, 9))
    D = a_1 * load**2 + a_2 * load
    BCD = (a_3 * load**2 + a_4 * load) * jnp.exp(-a_5 * load)
    E = a_6 * load**2 + a_7 * load + a_8
    return _magic_formula(slip, BCD / (C_X * D), C_X, D, E)


def lateral_force(angle: Any, load: Any, p: Mapping[str, Any]) -> Any:
    """Return the lateral force of a tyre (N) at a slip angle in degrees and a load in kN; `p` holds a_y1 to a_y8."""
    a_1, a_2, a_3, a_4, a_5, a_6, a_7, a_8 = (p[f"a_y{i}"] for i in range(1, 9))
    D = a_1 * load**2 + a_2 * load
    BCD = a_3 * jnp.sin(a_4 * jnp.arctan(a_5 * load))
    E = a_6 * load**2 + a_7 * load + a_8
    return _magic_formula(angle, BCD / (C_Y * D), C_Y, D, E)


def _magic_formula(X: Any, B: Any, C: float, D: Any, E: Any) -> Any:
    """Y = D sin(C atan(B phi)), phi = (1 − E) X + (E/B) atan(B X); the shifts are zero."""
    phi = (1 - E) * X + E / B * jnp.arctan(B * X)
    return D * jnp.sin(C * jnp.arctan(B * phi))


def magic_formula(
    *,
    wheel_radius: float = 0.15,
    low_speed: float = 0.1,
    initial_state: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    m_b: float = 70.0,
    m_w: float = 2.5,
    B_l: float = 0.89,
    B_w: float = 0.55,
    a: float = 0.25,
    b: float = 0.23,
    g: float = 9.81,
) -> HybridSystem:
    r"""Return the vehicle of `skid_steer` on tyres of the Magic Formula, driven by wheel speeds; one mode, ``"drive"``.

    The input ``u`` holds the angular velocities w1 to w4 of the wheels (rad/s). Wheels 1 and 4 are those on the right
    (front and rear), 2 and 3 those on the left, as in equation (18): more speed on 1 and 4 turns to the left. With the
    hub's velocity (V_x, V_y) in the body's frame and the tread's speed R w, a wheel's slip is

        (s_x, s_y) = (R w − V_x, −V_y) / V,    V² = (V_x² + (R w)²)/2 + low_speed²,

    for small slip the slip ratio and the tangent of the slip angle, and finite at standstill. The force has the
    direction of the slip s. Its longitudinal part is that of the Magic Formula at the slip ratio ‖s‖, its lateral
    part that at the slip angle atan ‖s‖ (each times its share of s), so that their sum is about inside the circle of
    friction. The load of a wheel is the static one, g (m_b + 4 m_w)/4.

    Parameters
    ----------
    wheel_radius : float, optional
        R (m).
    low_speed : float, optional
        Speed (m/s) below which slip becomes viscous friction, with a force proportional to velocity.
    initial_state : (6,) array_like, optional
        ``(X, dX, Y, dY, theta, dtheta)`` at t0 (m, m/s, m, m/s, rad, rad/s).
    m_b, m_w, B_l, B_w, a, b, g : float, optional
        As in `skid_steer`. The wheels are point masses at (±a, ±b), as in equation (18).

    Returns
    -------
    HybridSystem
        Its parameters are a_x1 to a_x8 and a_y1 to a_y8; `MAGIC_FORMULA` holds their published values.

    Raises
    ------
    ValueError
        If `wheel_radius` or `low_speed` is not positive.

    Notes
    -----
    The published coefficients were fitted to loads of 2 to 8 kN per tyre; at this vehicle's 0.2 kN they extrapolate. At
    a velocity V, slip decays at the rate 230 V⁻¹ m/s², so that the model is stiff at low speeds.

    References
    ----------
    E. Bakker, L. Nyborg, H. B. Pacejka, Tyre modelling for use in vehicle dynamics studies, SAE 870421, 1987.

    See Also
    --------
    switchfit.models.skid_steer : the same vehicle with linear friction.

    Examples
    --------
    >>> from switchfit.models import magic_formula

    >>> system = magic_formula(wheel_radius=0.2)
    >>> list(system.modes), system.state_names
    (['drive'], ('X', 'dX', 'Y', 'dY', 'theta', 'dtheta'))
    """
    for name, value in (("wheel_radius", wheel_radius), ("low_speed", low_speed)):
        if not value > 0:
            raise ValueError(f"{name} must be positive; got {value}.")
    return HybridSystem(
        modes={"drive": _drive(wheel_radius, low_speed, m_b, m_w, B_l, B_w, a, b, g)},
        initial_state=initial_state,
        state_names=("X", "dX", "Y", "dY", "theta", "dtheta"),
        state_units=("m", "m/s", "m", "m/s", "rad", "rad/s"),
    )


@cache
def _drive(
    radius: float,
    low_speed: float,
    m_b: float,
    m_w: float,
    B_l: float,
    B_w: float,
    a: float,
    b: float,
    g: float,
) -> Callable[..., Any]:
    """Return the vector field, cached by the constants so that nothing is compiled twice."""
    m = m_b + 4 * m_w
    inertia = m_b * (B_l**2 + B_w**2) / 12 + 4 * m_w * (a**2 + b**2)
    load = 1e-3 * g * m / 4
    ahead = np.array([a, a, -a, -a])  # wheels 1 and 2 in front,
    left = np.array([-b, b, b, -b])  # 2 and 3 on the left

    def drive(t: Any, x: Any, p: Any, u: Any) -> Any:
        _, dX, _, dY, theta, dtheta = x
        cos, sin = jnp.cos(theta), jnp.sin(theta)
        V_x = cos * dX + sin * dY - left * dtheta
        V_y = -sin * dX + cos * dY + ahead * dtheta
        V = jnp.sqrt(0.5 * (V_x**2 + (radius * u) ** 2) + low_speed**2)
        s_x, s_y = (radius * u - V_x) / V, -V_y / V
        s = jnp.sqrt(s_x**2 + s_y**2 + SMALL_SLIP**2)
        F_x = longitudinal_force(100 * s, load, p) * s_x / s
        F_y = lateral_force(jnp.degrees(jnp.arctan(s)), load, p) * s_y / s
        along, across = jnp.sum(F_x) / m, jnp.sum(F_y) / m
        ddtheta = jnp.sum(ahead * F_y - left * F_x) / inertia
        return jnp.stack([dX, along * cos - across * sin, dY, along * sin + across * cos, dtheta, ddtheta])

    return drive
