"""Vehicles on wheels: the single-track model of a car whose axles grip or slide, and robots that are driven by wheel
speeds, ideal and extended differential drive with delay and lag.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from switchfit.models.constants import (
    Constant,
    Constants,
    Values,
    check_constants,
    check_length,
    check_modes,
    is_absent,
    read_input,
)
from switchfit.problem.system import HybridSystem
from switchfit.problem.validation import as_choice

BICYCLE = ("X", "Y", "theta", "v_x", "v_y", "r")

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
    given = check_length(initial_state, BICYCLE)
    if not callable(given):
        v_x = given[3]
        if isinstance(v_x, int | float | np.number) and not v_x > 0:
            raise ValueError(f"initial_state must have a positive v_x, where slip angles are defined; got {v_x}.")
    return HybridSystem(
        modes={name: partial(_steer, SLIDING[name], constants) for name in names},
        initial_state=initial_state,
        state_names=BICYCLE,
        state_units=("m", "m", "rad", "m/s", "m/s", "rad/s"),
    )


def _steer(sliding: tuple[bool, bool], constants: dict[str, Constant], t: Any, x: Any, p: Any, u: Any) -> Any:
    front_slides, rear_slides = sliding
    _, _, theta, v_x, v_y, r = x
    delta, F_x = read_input(u, STEERING)
    c = Values(constants, p)
    cos, sin = jnp.cos(delta), jnp.sin(delta)
    front, rear = v_y + c["a"] * r, v_y - c["b"] * r  # lateral velocities of the axles
    weight = c["m"] * c["g"] / (c["a"] + c["b"])
    if front_slides:
        along, across = cos * v_x + sin * front, -sin * v_x + cos * front  # in the frame of the wheel
        friction = -c["mu"] * weight * c["b"] / jnp.sqrt(along**2 + across**2)
        ahead, left = friction * along, friction * across
    else:
        ahead, left = 0.0, c["C_f"] * (delta - jnp.arctan2(front, v_x))
    if rear_slides:
        friction = -c["mu"] * weight * c["a"] / jnp.sqrt(v_x**2 + rear**2)
        pushed, R = F_x + friction * v_x, friction * rear
    else:
        pushed, R = F_x, -c["C_r"] * jnp.arctan2(rear, v_x)
    steered = ahead * sin + left * cos  # the front axle's force across the body
    dv_x = r * v_y + (pushed + ahead * cos - left * sin) / c["m"]
    dv_y = -r * v_x + (steered + R) / c["m"]
    dr = (c["a"] * steered - c["b"] * R) / c["I_z"]
    heading, lateral = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([v_x * heading - v_y * lateral, v_x * lateral + v_y * heading, r, dv_x, dv_y, dr])


MODES = ("grip", "slip")
SPEEDS = ("w_l", "w_r (rad/s)")
LOW_SPEED = 0.001  # m/s: below it, |V| in the sharpness of a turn is rounded off, so that it stays differentiable


def differential_drive(
    *,
    modes: Sequence[str] = ("grip", "slip"),
    speeds: Literal["measured", "commanded"] = "measured",
    radius: Constant = 0.165,
    track: Constant = 0.57,
    alpha_l: Constant = 1.0,
    alpha_r: Constant = 1.0,
    y_l: Constant = "y_l",
    y_r: Constant = "y_r",
    x_v: Constant = "x_v",
    turn_slip: Constant = 0.0,
    lag: Constant = "lag",
    delay: Constant | None = None,
    initial_state: ArrayLike | None = None,
) -> HybridSystem:
    r"""Return a vehicle driven by the speeds of its wheels or tracks, modes ``"grip"``, ``"slip"`` and ``"wait"``.

    The input is ``u = (w_l, w_r)``, the angular velocities of the left and the right wheels (rad/s). In a plane motion
    each side rolls about a center of rotation of its own ([1]_): with the speeds ``V_l = alpha_l R w_l`` and
    ``V_r = alpha_r R w_r`` and the coordinates y_l (positive, left), y_r (negative) and x_v of these centers in the
    body's frame,

        yaw rate = (V_r - V_l) / (y_l - y_r),
        v_x = (V_r y_l - V_l y_r) / (y_l - y_r),    v_y = -x_v (yaw rate),

    extended differential drive. In ``"grip"`` the wheels roll: ``y_l = -y_r = track / 2``, ``x_v = 0``, alpha = 1
    (ideal differential drive). In ``"slip"`` they are parameters: skidding vehicles turn as if they were wider than
    they are.

    Centers that stay where they are make `v_x` linear in the wheel speeds. On soft or rough ground, wheels that are
    dragged sideways also lose speed forward: with `turn_slip`, "slip" has the empirical factor

        v_x (1 - turn_slip abs(V_r - V_l) / (abs(V_l) + abs(V_r))),

    which is 1 straight ahead and 1 - turn_slip where a side stands or turns back; each abs(V) is rounded off to
    ``sqrt(V^2 + s^2)``, less s above and once below the line, with s = 0.001 m/s.

    The state is ``(X, Y, theta)`` if the wheel speeds are measured. If they are commanded, the wheels follow with a
    first-order lag, ``w' = (u - w) / lag``, and the state is ``(X, Y, theta, w_l, w_r)``. With a delay the mode
    ``"wait"`` comes first, in which the wheels keep their speeds until ``t = delay``, its guard: one delay for all
    steps of the command that each have a run of their own, which begins at the step. A vehicle that already drives
    moves in "wait" as in the first of `modes`.

    Parameters
    ----------
    modes : sequence of str, optional
        Of "grip" and "slip": those that the system has; "wait" is added if there is a delay, and moves as the first.
    speeds : {"measured", "commanded"}, optional
    radius : float or str, optional
        Radius R of the wheels (m).
    track : float or str, optional
        Distance between left and right wheels (m).
    alpha_l, alpha_r : float or str, optional
        Ratio of the speeds of tread and ground in "slip" (1): below 1 where wheels are worn, soft or slip forward.
    y_l, y_r, x_v : float or str, optional
        Instantaneous centers of rotation in "slip" (m).
    turn_slip : float or str, optional
        Share of the forward speed that is lost in a turn on the spot in "slip", from 0 to 1. With 0, the factor is
        left out.
    lag : float or str, optional
        Time constant of the wheels (s); only with commanded speeds.
    delay : float or str, optional
        Time from t = 0 to the moment at which the wheels begin to follow (s); only with commanded speeds.
    initial_state : array_like, optional
        At t0, (3,) or (5,); zero if left out.

    Returns
    -------
    HybridSystem
        Its parameters are those constants that have names and that its modes read.

    Raises
    ------
    ValueError, TypeError
        For an unknown mode or kind of speeds, a wrong constant, an initial state of another length, or a delay without
        commands. In a `Problem`, if the input has not two channels.

    See Also
    --------
    switchfit.models.skid_steer, switchfit.models.bicycle : vehicles with forces.

    References
    ----------
    .. [1] A. Mandow, J. L. Martinez, J. Morales, J. L. Blanco, A. Garcia-Cerezo, J. Gonzalez, Experimental kinematics
       for wheeled skid-steer mobile robots, IEEE/RSJ IROS 2007, 1222-1227.

    Examples
    --------
    >>> from switchfit.models import differential_drive
    >>> differential_drive(speeds="commanded", delay="delay").state_names
    ('X', 'Y', 'theta', 'w_l', 'w_r')
    """
    names = check_modes(modes, MODES)
    commanded = as_choice(speeds, "speeds", ("measured", "commanded")) == "commanded"
    if delay is not None and not commanded:
        raise ValueError(f"delay is that of speeds='commanded', or else of the Measurements; got delay={delay!r}.")
    constants = check_constants(
        positive={"radius": radius, "track": track, "alpha_l": alpha_l, "alpha_r": alpha_r, "lag": lag},
        not_negative={"turn_slip": turn_slip, "delay": 0.0 if delay is None else delay},
        others={"y_l": y_l, "y_r": y_r, "x_v": x_v},
    )
    left, right, loss = constants["y_l"], constants["y_r"], constants["turn_slip"]
    if not isinstance(left, str) and not isinstance(right, str) and not left > right:
        raise ValueError(f"y_l, on the left, must be larger than y_r; got {left} and {right}.")
    if not isinstance(loss, str) and loss > 1:
        raise ValueError(f"turn_slip must be from 0 to 1; got {loss}.")
    motions = {name: name for name in names}
    if delay is not None:
        motions, names = {"wait": names[0]} | motions, ("wait", *names)
    count = 5 if commanded else 3
    states = ("X", "Y", "theta", "w_l", "w_r")[:count]
    return HybridSystem(
        modes={
            name: partial(_move, motion == "slip", commanded, name == "wait", constants)
            for name, motion in motions.items()
        },
        initial_state=[0.0] * count if initial_state is None else check_length(initial_state, states),
        guards={("wait", name): partial(_until, constants) for name in names[1:]} if delay is not None else {},
        state_names=states,
        state_units=("m", "m", "rad", "rad/s", "rad/s")[:count],
    )


def _until(constants: Constants, t: Any, x: Any, p: Any) -> Any:
    return t - Values(constants, p)["delay"]


def _magnitude(V: Any) -> Any:
    """Return |V|, rounded off at LOW_SPEED."""
    return jnp.sqrt(V * V + LOW_SPEED**2)


def _move(slips: bool, commanded: bool, waits: bool, constants: Constants, t: Any, x: Any, p: Any, u: Any) -> Any:
    """Return dx/dt; where the wheels wait they keep their speeds."""
    theta, c = x[2], Values(constants, p)
    given = read_input(u, SPEEDS)
    w_l, w_r = (x[3], x[4]) if commanded else given
    V_l, V_r = c["radius"] * w_l, c["radius"] * w_r
    if slips:
        y_l, y_r, V_l, V_r = c["y_l"], c["y_r"], c["alpha_l"] * V_l, c["alpha_r"] * V_r
    else:
        y_l, y_r = c["track"] / 2, -c["track"] / 2
    turn = (V_r - V_l) / (y_l - y_r)
    v_x = (V_r * y_l - V_l * y_r) / (y_l - y_r)
    if slips and not is_absent(constants["turn_slip"]):
        # Rounded off so that it is 0 straight ahead, and has a value where the wheels stand.
        sharpness = (_magnitude(V_r - V_l) - LOW_SPEED) / (_magnitude(V_l) + _magnitude(V_r) - LOW_SPEED)
        v_x = v_x * (1 - c["turn_slip"] * sharpness)
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    dX, dY = v_x * cos, v_x * sin
    if slips and not is_absent(constants["x_v"]):
        v_y = -c["x_v"] * turn
        dX, dY = dX - v_y * sin, dY + v_y * cos
    if not commanded:
        return jnp.stack([dX, dY, turn])
    if waits:
        return jnp.stack([dX, dY, turn, 0.0 * w_l, 0.0 * w_r])
    return jnp.stack([dX, dY, turn, (given[0] - w_l) / c["lag"], (given[1] - w_r) / c["lag"]])
