"""The single-track model of a car or a robot that steers, whose axles grip or slide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import Traced
from switchfit.models.arguments import check_length, check_modes, read_input
from switchfit.models.constants import Constant, Values, check_constants
from switchfit.problem.system import HybridSystem

BICYCLE_STATES = ("X", "Y", "theta", "v_x", "v_y", "r")

STEERING = ("delta (rad)", "F_x (N)")
"""Channels of the input: steering angle and driving force."""

SLIDING: Mapping[str, tuple[bool, bool]] = {
    "grip": (False, False),
    "front_slide": (True, False),
    "rear_slide": (False, True),
    "slide": (True, True),
}
"""Whether the front and the rear axle slide in each mode."""


def bicycle(
    *,
    modes: Sequence[str] = ("grip", "rear_slide"),
    initial_state: ArrayLike = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
    m: Constant = "m",
    I_z: Constant = "I_z",
    a: Constant = "a",
    b: Constant = "b",
    C_f: Constant = "C_f",
    C_r: Constant = "C_r",
    mu: Constant = "mu",
    g: Constant = 9.81,
) -> HybridSystem:
    r"""Return the single-track model: both wheels of an axle are one; drift is the mode in which the rear axle slides.

    The state is ``(X, Y, theta, v_x, v_y, r)``: position and heading, the velocity in the body's frame, and the yaw
    rate. The input is ``u = (delta, F_x)``: the steering angle (rad) and the driving force at the rear axle (N). With
    the slip angles of the axles ([1]_, chapter 1)

        alpha_f = delta - atan((v_y + a r) / v_x),    alpha_r = -atan((v_y - b r) / v_x),

        m (v_x' - r v_y) = F_x - F_f sin(delta),    m (v_y' + r v_x) = F_f cos(delta) + F_r,
        I_z r' = a F_f cos(delta) - b F_r.

    An axle that grips has the lateral force ``C alpha``. One that slides has Coulomb's force of its static load,

        -mu F_z w_y / sqrt(w_x² + w_y²),    F_zf = m g b / (a + b),    F_zr = m g a / (a + b),

    against its velocity (w_x, w_y), at the front in the frame of the wheel; the part of it along the wheel, that of a
    locked wheel, acts on the vehicle too. F_x is added to it: let it be 0 while the rear wheels are locked.

    Parameters
    ----------
    modes : sequence of str, optional
        Of "grip", "front_slide" (understeer), "rear_slide" (drift, as with a pulled handbrake) and "slide": those that
        the system has.
    initial_state : (6,) array_like, optional
        At t0 (m, m, rad, m/s, m/s, rad/s). v_x must stay positive.
    m, I_z : float or str, optional
        Mass (kg) and moment of inertia about the vertical (kg m²).
    a, b : float or str, optional
        Distance of the front and of the rear axle from the center of mass (m).
    C_f, C_r : float or str, optional
        Cornering stiffness of the axles (N/rad).
    mu : float or str, optional
        Coefficient of friction of an axle that slides (1).
    g : float or str, optional
        Acceleration of gravity (m/s²).

    Returns
    -------
    HybridSystem
        Its parameters are those constants that have names, all but g if nothing else is said.

    Raises
    ------
    ValueError, TypeError
        For an unknown mode, a wrong constant or an initial state of another length. In a `Problem`, if the input has
        not two channels.

    See Also
    --------
    switchfit.models.skid_steer, switchfit.models.magic_formula : other vehicles.

    References
    ----------
    .. [1] H. B. Pacejka, Tire and Vehicle Dynamics, 3rd ed., Butterworth-Heinemann 2012, chapter 1.

    Examples
    --------
    >>> from switchfit.models import bicycle
    >>> car = bicycle(m=1500.0, I_z=2500.0, a=1.2, b=1.4)
    >>> tuple(car.modes), car.state_names
    (('grip', 'rear_slide'), ('X', 'Y', 'theta', 'v_x', 'v_y', 'r'))
    """
    names = check_modes(modes, SLIDING)
    constants = check_constants(
        positive={"m": m, "I_z": I_z, "a": a, "b": b, "g": g}, not_negative={"C_f": C_f, "C_r": C_r, "mu": mu}
    )
    given = check_length(initial_state, BICYCLE_STATES)
    if not callable(given):
        v_x = given[3]
        if isinstance(v_x, int | float | np.number) and not v_x > 0:
            raise ValueError(f"initial_state must have a positive v_x, where slip angles are defined; got {v_x}.")
    return HybridSystem(
        modes={name: partial(_steer, SLIDING[name], constants) for name in names},
        initial_state=initial_state,
        state_names=BICYCLE_STATES,
        state_units=("m", "m", "rad", "m/s", "m/s", "rad/s"),
    )


def _steer(
    sliding: tuple[bool, bool], constants: dict[str, Constant], t: Traced, x: Traced, p: Mapping[str, Traced], u: Traced
) -> Traced:
    front_slides, rear_slides = sliding
    _, _, theta, v_x, v_y, r = x
    delta, F_x = read_input(u, STEERING)
    c = Values(constants, p)
    cos, sin = jnp.cos(delta), jnp.sin(delta)
    front, rear = v_y + c["a"] * r, v_y - c["b"] * r  # lateral velocities of the axles
    weight = c["m"] * c["g"] / (c["a"] + c["b"])
    if front_slides:
        # A locked wheel: friction against the whole velocity of the contact point, so that it also brakes.
        along, across = cos * v_x + sin * front, -sin * v_x + cos * front  # in the frame of the wheel
        friction = -c["mu"] * weight * c["b"] / jnp.sqrt(along**2 + across**2)
        ahead, left = friction * along, friction * across
    else:
        # A rolling wheel: the slip angle alone; `arctan2` has a value also where v_x passes 0 in a step of the
        # optimizer.
        ahead, left = 0.0, c["C_f"] * (delta - jnp.arctan2(front, v_x))
    if rear_slides:
        friction = -c["mu"] * weight * c["a"] / jnp.sqrt(v_x**2 + rear**2)
        pushed, R = F_x + friction * v_x, friction * rear
    else:
        pushed, R = F_x, -c["C_r"] * jnp.arctan2(rear, v_x)
    # From the frame of the steered wheel into that of the body.
    steered = ahead * sin + left * cos  # the front axle's force across the body
    dv_x = r * v_y + (pushed + ahead * cos - left * sin) / c["m"]
    dv_y = -r * v_x + (steered + R) / c["m"]
    dr = (c["a"] * steered - c["b"] * R) / c["I_z"]
    # The velocity from the body's frame into that of the ground.
    heading, lateral = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([v_x * heading - v_y * lateral, v_x * lateral + v_y * heading, r, dv_x, dv_y, dr])
