"""Vehicles that are driven by wheel speeds: ideal and extended differential drive, with delay and lag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Literal

import jax.numpy as jnp
from numpy.typing import ArrayLike

from switchfit.arrays import Traced
from switchfit.models.arguments import check_length, check_modes, read_input
from switchfit.models.constants import Constant, Constants, Values, check_constants, is_absent
from switchfit.problem.system import HybridSystem
from switchfit.problem.validation.names import as_choice

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

    Centers that stay where they are make ``v_x`` linear in the wheel speeds. On soft or rough ground, wheels that are
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
    # "wait" moves as the first mode does, its wheels at constant speeds.
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


def _until(constants: Constants, t: Traced, x: Traced, p: Mapping[str, Traced]) -> Traced:
    return t - Values(constants, p)["delay"]


def _magnitude(V: Traced) -> Traced:
    """Return |V|, rounded off at LOW_SPEED."""
    return jnp.sqrt(V * V + LOW_SPEED**2)


def _move(
    slips: bool,
    commanded: bool,
    waits: bool,
    constants: Constants,
    t: Traced,
    x: Traced,
    p: Mapping[str, Traced],
    u: Traced,
) -> Traced:
    """Return dx/dt; where the wheels wait they keep their speeds."""
    theta, c = x[2], Values(constants, p)
    given = read_input(u, SPEEDS)
    w_l, w_r = (x[3], x[4]) if commanded else given
    V_l, V_r = c["radius"] * w_l, c["radius"] * w_r
    if slips:
        y_l, y_r, V_l, V_r = c["y_l"], c["y_r"], c["alpha_l"] * V_l, c["alpha_r"] * V_r
    else:
        y_l, y_r = c["track"] / 2, -c["track"] / 2
    # Both sides roll about centers of their own: y_l and y_r where they slip, half the track where they grip.
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
        # Before the delay has passed, the wheels have not heard of the command.
        return jnp.stack([dX, dY, turn, 0.0 * w_l, 0.0 * w_r])
    return jnp.stack([dX, dY, turn, (given[0] - w_l) / c["lag"], (given[1] - w_r) / c["lag"]])
