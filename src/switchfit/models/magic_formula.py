"""Pacejka's Magic Formula of 1987, and a skid-steered vehicle whose wheel forces come from it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from switchfit.models.constants import Constant, Constants, Values, check_constants, check_length, is_absent, read_input
from switchfit.models.skid_steer import STATES, UNITS
from switchfit.problem.system import HybridSystem
from switchfit.problem.validation import as_flag

#: Coefficients a_1 to a_8 of the longitudinal (x) and the lateral (y) force of 1987, by the parameter's name.
MAGIC_FORMULA: Mapping[str, float] = MappingProxyType(
    {
        **{f"a_x{i}": a for i, a in enumerate((-21.3, 1144.0, 49.6, 226.0, 0.069, -0.006, 0.056, 0.486), start=1)},
        **{f"a_y{i}": a for i, a in enumerate((-22.1, 1011.0, 1078.0, 1.82, 0.208, 0.0, -0.354, 0.707), start=1)},
    }
)

#: Coefficients a_1 to a_8 of the aligning moment of 1987, by the parameter's name.
ALIGNING_MOMENT: Mapping[str, float] = MappingProxyType(
    {f"a_z{i}": a for i, a in enumerate((-2.72, -2.28, -1.86, -2.73, 0.110, -0.070, 0.643, -4.04), start=1)}
)

#: Channels of the input: angular velocities of the wheels.
WHEELS = ("w1", "w2", "w3", "w4 (rad/s)")
#: Shape factors C, which are not among the fitted coefficients.
C_X, C_Y, C_Z = 1.65, 1.30, 2.40
#: Slip below which a wheel's force is linear in the slip: at zero, the direction of the slip is undefined.
SMALL_SLIP = 1e-3
#: Part of the static load that a wheel keeps, about, where it would lift.
LEAST_LOAD = 0.005


def longitudinal_force(slip: Any, load: Any, p: Mapping[str, Any]) -> Any:
    """Return the longitudinal force of a tyre (N) at a slip ratio in % and a load in kN; `p` holds a_x1 to a_x8."""
    a_1, a_2, a_3, a_4, a_5, a_6, a_7, a_8 = (p[f"a_x{i}"] for i in range(1, 9))
    peak = a_1 * load + a_2  # D / load; that D and BCD have load as a factor saves operations
    B = (a_3 * load + a_4) * jnp.exp(-a_5 * load) / (C_X * peak)
    E = (a_6 * load + a_7) * load + a_8
    return _magic_formula(slip, B, C_X, peak * load, E)


def lateral_force(angle: Any, load: Any, p: Mapping[str, Any]) -> Any:
    """Return the lateral force of a tyre (N) at a slip angle in degrees and a load in kN; `p` holds a_y1 to a_y8."""
    a_1, a_2, a_3, a_4, a_5, a_6, a_7, a_8 = (p[f"a_y{i}"] for i in range(1, 9))
    D = (a_1 * load + a_2) * load
    BCD = a_3 * jnp.sin(a_4 * jnp.arctan(a_5 * load))
    E = (a_6 * load + a_7) * load + a_8
    return _magic_formula(angle, BCD / (C_Y * D), C_Y, D, E)


def compute_aligning_moment(angle: Any, load: Any, p: Mapping[str, Any]) -> Any:
    """Return the aligning moment of a tyre (N m) at a slip angle in degrees and a load in kN, from a_z1 to a_z8."""
    a_1, a_2, a_3, a_4, a_5, a_6, a_7, a_8 = (p[f"a_z{i}"] for i in range(1, 9))
    D = a_1 * load**2 + a_2 * load
    BCD = (a_3 * load**2 + a_4 * load) * jnp.exp(-a_5 * load)
    E = a_6 * load**2 + a_7 * load + a_8
    return _magic_formula(angle, BCD / (C_Z * D), C_Z, D, E)


def _magic_formula(X: Any, B: Any, C: float, D: Any, E: Any) -> Any:
    """Y = D sin(C atan(B phi)), phi = (1 − E) X + (E/B) atan(B X); the shifts are zero."""
    return D * _curve(B * X, E, C)


# Derivatives of the curve in closed form. Those that JAX derives from its operations, twice in each unknown and for two
# forces of four tyres, are a quarter more operations than these, and machine code takes no more than 10,000 of a mode.


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _curve(x: Any, E: Any, C: float) -> Any:
    """Return ``y = sin(C atan q)``, ``q = x + E (atan x - x)``; x is B X, and q is B phi."""
    return jnp.sin(C * jnp.arctan(x + E * (jnp.arctan(x) - x)))


@_curve.defjvp
def _move_along_curve(C: float, at: tuple[Any, Any], moves: tuple[Any, Any]) -> tuple[Any, Any]:
    y_x, y_E = _slopes(*at, C)
    return _curve(*at, C), y_x * moves[0] + y_E * moves[1]


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _slopes(x: Any, E: Any, C: float) -> tuple[Any, Any]:
    """Return dy/dx and dy/dE."""
    first, _ = _derive_sine(x, E, C)
    q_x, q_E = _derive_angle(x, E)
    return first * q_x, first * q_E


@_slopes.defjvp
def _move_slopes(C: float, at: tuple[Any, Any], moves: tuple[Any, Any]) -> tuple[Any, Any]:
    x, E = at
    first, second = _derive_sine(x, E, C)
    q_x, q_E = _derive_angle(x, E)
    y_xx = second * q_x**2 - first * E * 2 * x / (1 + x**2) ** 2
    y_xE = second * q_x * q_E - first * x**2 / (1 + x**2)
    y_EE = second * q_E**2
    return _slopes(x, E, C), (y_xx * moves[0] + y_xE * moves[1], y_xE * moves[0] + y_EE * moves[1])


def _derive_angle(x: Any, E: Any) -> tuple[Any, Any]:
    """Return dq/dx and dq/dE."""
    return 1 - E * x**2 / (1 + x**2), jnp.arctan(x) - x


def _derive_sine(x: Any, E: Any, C: float) -> tuple[Any, Any]:
    """Return dy/dq and d²y/dq²."""
    q = x + E * (jnp.arctan(x) - x)
    angle, slope = C * jnp.arctan(q), C / (1 + q**2)
    first = slope * jnp.cos(angle)
    return first, -(slope**2) * jnp.sin(angle) - first * 2 * q / (1 + q**2)


def magic_formula(
    *,
    wheel_radius: Constant = 0.15,
    low_speed: Constant = 0.1,
    height: Constant = 0.0,
    load_lag: Constant = 0.05,
    aligning: bool = False,
    initial_state: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    m_b: Constant = 70.0,
    m_w: Constant = 2.5,
    B_l: Constant = 0.89,
    B_w: Constant = 0.55,
    a: Constant = 0.25,
    b: Constant = 0.23,
    g: Constant = 9.81,
) -> HybridSystem:
    r"""Return the vehicle of `skid_steer` on tyres of the Magic Formula, driven by wheel speeds; one mode, ``"drive"``.

    The input ``u`` holds the angular velocities w1 to w4 of the wheels (rad/s). Wheels 1 and 4 are those on the right
    (front and rear), 2 and 3 those on the left, as in equation (18): more speed on 1 and 4 turns to the left. With the
    hub's velocity (V_x, V_y) in the body's frame and the tread's speed R w, a wheel's slip is

        (s_x, s_y) = (R w − V_x, −V_y) / V,    V² = (V_x² + (R w)²)/2 + low_speed²,

    for small slip the slip ratio and the tangent of the slip angle, and finite at standstill. The force has the
    direction of the slip s. Its longitudinal part is that of the Magic Formula at the slip ratio ‖s‖, its lateral
    part that at the slip angle atan ‖s‖ (each times its share of s), so that their sum is about inside the circle of
    friction (combined slip).

    The load of a wheel is the static one, ``g m / 4`` with ``m = m_b + 4 m_w``. If the center of mass is at a height h
    above the ground, the accelerations (a_x, a_y) of the vehicle in its own frame transfer load: with (x_i, y_i) the
    place of a wheel,

        F_zi = m g / 4 - (m h / 4) (a_x x_i / a² + a_y y_i / b²),

    which balances the moments of the forces at the ground. The body follows them with a lag, that of its pitch and
    roll: (a_x, a_y) are two more states, ``a' = (F / m - a) / load_lag``. A wheel that would lift keeps some of its
    load: the limit is smooth, and changes a load above a tenth of the static one by less than 1e-4 of that. With
    `aligning` the aligning moments of the tyres, each times its wheel's share of s, act on the vehicle too.

    Parameters
    ----------
    wheel_radius : float or str, optional
        R (m).
    height : float or str, optional
        Height h of the center of mass (m); 0: no transfer of load.
    load_lag : float or str, optional
        Time constant of the transfer of load (s).
    aligning : bool, optional
        Add the aligning moments.
    low_speed : float or str, optional
        Speed (m/s) below which slip becomes viscous friction, with a force proportional to velocity.
    initial_state : (6,) array_like, optional
        ``(X, dX, Y, dY, theta, dtheta)`` at t0 (m, m/s, m, m/s, rad, rad/s); a_x and a_y are zero there.
    m_b, m_w, B_l, B_w, a, b, g : float or str, optional
        As in `skid_steer`. The wheels are point masses at (±a, ±b), as in equation (18).

    Returns
    -------
    HybridSystem
        Its parameters are a_x1 to a_x8 and a_y1 to a_y8; `MAGIC_FORMULA` holds their published values. With `aligning`
        a_z1 to a_z8 too, whose published values `ALIGNING_MOMENT` holds.

    Raises
    ------
    ValueError
        For a constant that is not positive, but `height` and `m_w`, which may be zero, or an initial state of another
        length. In a `Problem`, if the input has not four channels.
    TypeError
        If a constant is no number.

    See Also
    --------
    switchfit.models.skid_steer, switchfit.models.bicycle

    Notes
    -----
    The published coefficients were fitted to loads of 2 to 8 kN per tyre; at this vehicle's 0.2 kN they extrapolate. At
    a velocity V, slip decays at the rate 230 V⁻¹ m/s², so that the model is stiff at low speeds.

    References
    ----------
    E. Bakker, L. Nyborg, H. B. Pacejka, Tyre modelling for use in vehicle dynamics studies, SAE 870421, 1987.

    Examples
    --------
    >>> from switchfit.models import magic_formula
    >>> magic_formula(height=0.2).state_names
    ('X', 'dX', 'Y', 'dY', 'theta', 'dtheta', 'a_x', 'a_y')
    """
    constants = check_constants(
        positive={
            "wheel_radius": wheel_radius, "low_speed": low_speed, "load_lag": load_lag, "m_b": m_b, "B_l": B_l,
            "B_w": B_w, "a": a, "b": b, "g": g,
        },
        not_negative={"height": height, "m_w": m_w},
    )  # fmt: skip
    start, names, units = check_length(initial_state, STATES), STATES, UNITS
    if not is_absent(constants["height"]):
        start = [*np.asarray(initial_state, dtype=float), 0.0, 0.0]
        names, units = (*STATES, "a_x", "a_y"), (*UNITS, "m/s^2", "m/s^2")
    drive = partial(_drive, constants, as_flag(aligning, "aligning"))
    return HybridSystem({"drive": drive}, start, state_names=names, state_units=units)


def _drive(constants: Constants, aligning: bool, t: Any, x: Any, p: Any, u: Any) -> Any:
    c = Values(constants, p)
    a, b, height = c["a"], c["b"], c["height"]
    m = c["m_b"] + 4 * c["m_w"]
    inertia = c["m_b"] * (c["B_l"] ** 2 + c["B_w"] ** 2) / 12 + 4 * c["m_w"] * (a**2 + b**2)
    static = 1e-3 * c["g"] * m / 4
    ahead = a * np.array([1.0, 1.0, -1.0, -1.0])  # wheels 1 and 2 in front,
    left = b * np.array([-1.0, 1.0, 1.0, -1.0])  # 2 and 3 on the left

    def loads(acceleration: Any) -> Any:
        load = static - 1e-3 * m * height / 4 * (acceleration[0] * ahead / a**2 + acceleration[1] * left / b**2)
        least = LEAST_LOAD * static
        return least + 0.5 * (load - least + jnp.sqrt((load - least) ** 2 + least**2))

    _, dX, _, dY, theta, dtheta = x[:6]
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    V_x = cos * dX + sin * dY - left * dtheta
    V_y = -sin * dX + cos * dY + ahead * dtheta
    tread = c["wheel_radius"] * jnp.stack(read_input(u, WHEELS))
    V_squared = 0.5 * (V_x**2 + tread**2) + c["low_speed"] ** 2
    creep = jnp.sqrt((tread - V_x) ** 2 + V_y**2 + SMALL_SLIP**2 * V_squared)
    slip = creep / jnp.sqrt(V_squared)  # the norm of s
    share_x, share_y = (tread - V_x) / creep, -V_y / creep  # s_x / slip, s_y / slip
    angle = jnp.degrees(jnp.arctan(slip))
    load = static if len(x) == 6 else loads(x[6:])
    F_x = longitudinal_force(100 * slip, load, p) * share_x
    F_y = lateral_force(angle, load, p) * share_y
    along, across = jnp.sum(F_x) / m, jnp.sum(F_y) / m
    torque = jnp.sum(ahead * F_y - left * F_x)
    if aligning:
        torque = torque + jnp.sum(compute_aligning_moment(angle, load, p) * share_y)
    rates = [dX, along * cos - across * sin, dY, along * sin + across * cos, dtheta, torque / inertia]
    if len(x) > 6:
        rates += [(along - x[6]) / c["load_lag"], (across - x[7]) / c["load_lag"]]
    return jnp.stack(rates)
