"""A skid-steered vehicle whose wheel forces come from Pacejka's Magic Formula (`tyre_forces`)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import Traced
from switchfit.models.arguments import check_length, read_input
from switchfit.models.constants import Constant, Constants, Values, check_constants, is_absent
from switchfit.models.skid_steer import SKID_STEER_STATES, SKID_STEER_UNITS
from switchfit.models.tyre_forces import compute_aligning_moment, lateral_force, longitudinal_force
from switchfit.problem.system import HybridSystem
from switchfit.problem.validation.objects import as_flag

#: Channels of the input: angular velocities of the wheels.
WHEELS = ("w1", "w2", "w3", "w4 (rad/s)")

#: Slip below which a wheel's force is linear in the slip: at zero, the direction of the slip is undefined.
SMALL_SLIP = 1e-3

#: Part of the static load that a wheel keeps, about, where it would lift.
LEAST_LOAD = 0.005


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
    start, names, units = check_length(initial_state, SKID_STEER_STATES), SKID_STEER_STATES, SKID_STEER_UNITS
    if not is_absent(constants["height"]):
        start = [*np.asarray(initial_state, dtype=float), 0.0, 0.0]
        names, units = (*SKID_STEER_STATES, "a_x", "a_y"), (*SKID_STEER_UNITS, "m/s^2", "m/s^2")
    drive = partial(_drive, constants, as_flag(aligning, "aligning"))
    return HybridSystem({"drive": drive}, start, state_names=names, state_units=units)


def _drive(constants: Constants, aligning: bool, t: Traced, x: Traced, p: Mapping[str, Traced], u: Traced) -> Traced:
    c = Values(constants, p)
    a, b, height = c["a"], c["b"], c["height"]
    m = c["m_b"] + 4 * c["m_w"]
    inertia = c["m_b"] * (c["B_l"] ** 2 + c["B_w"] ** 2) / 12 + 4 * c["m_w"] * (a**2 + b**2)
    static = 1e-3 * c["g"] * m / 4
    ahead = a * np.array([1.0, 1.0, -1.0, -1.0])  # wheels 1 and 2 in front,
    left = b * np.array([-1.0, 1.0, 1.0, -1.0])  # 2 and 3 on the left

    def loads(acceleration: Traced) -> Traced:
        load = static - 1e-3 * m * height / 4 * (acceleration[0] * ahead / a**2 + acceleration[1] * left / b**2)
        least = LEAST_LOAD * static
        return least + 0.5 * (load - least + jnp.sqrt((load - least) ** 2 + least**2))

    _, dX, _, dY, theta, dtheta = x[:6]
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    V_x = cos * dX + sin * dY - left * dtheta
    V_y = -sin * dX + cos * dY + ahead * dtheta
    tread = c["wheel_radius"] * jnp.stack(read_input(u, WHEELS))
    # The mean square of the speeds of the ground and of the tread, rounded off at low speeds, where slip has no
    # meaning.
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
