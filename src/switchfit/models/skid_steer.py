"""Skid-steered vehicles after Miller and Murphey, equation (18): axles stick or slip, together or one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import permutations
from typing import Literal

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import Traced
from switchfit.models.arguments import check_length, check_modes, read_input
from switchfit.models.constants import Constant, Constants, Values, check_constants, is_absent
from switchfit.problem.system import HybridSystem, VectorField
from switchfit.problem.validation.arrays import as_finite
from switchfit.problem.validation.messages import shorten
from switchfit.problem.validation.names import as_choice
from switchfit.problem.validation.objects import as_flag

WheelForces = tuple[float, float, float, float]

STUCK_AXLES: Mapping[str, tuple[int, ...]] = {"stick": (1, -1), "front_slip": (-1,), "rear_slip": (1,), "slip": ()}
"""Axles that cannot move sideways in each mode: 1 is the one in front, -1 the one behind."""

FRICTIONS: Mapping[int, tuple[str, str]] = {1: ("mu_front", "coulomb_front"), -1: ("mu_rear", "coulomb_rear")}
"""Viscous and Coulomb's friction of each axle."""

SKID_STEER_STATES: tuple[str, ...] = ("X", "dX", "Y", "dY", "theta", "dtheta")
SKID_STEER_UNITS: tuple[str, ...] = ("m", "m/s", "m", "m/s", "rad", "rad/s")

FORCES = ("F1", "F2", "F3", "F4 (N)")
"""Channels of the input: the driving forces of the wheels."""

STICK_FORCES, SLIP_FORCES = (15.0, 15.0, 15.0, 15.0), (27.0, 0.0, 0.0, 27.0)
"""Driving forces of the wheels in the paper's simulations (N), F1 to F4."""


def skid_steer(
    *,
    modes: Sequence[str] = ("stick", "slip"),
    stick_forces: WheelForces | None = None,
    slip_forces: WheelForces | None = None,
    forces_from_input: bool = False,
    restick: Literal["continuous", "reset"] = "continuous",
    initial_state: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    m_b: Constant = 70.0,
    m_w: Constant = 2.5,
    B_l: Constant = 0.89,
    B_w: Constant = 0.55,
    a: Constant = 0.25,
    b: Constant = 0.23,
    c_1: Constant = 0.72,
    c_2: Constant = 0.92,
    g: Constant = 9.81,
    mu_front: Constant = "mu",
    mu_rear: Constant = "mu",
    coulomb_front: Constant = 0.0,
    coulomb_rear: Constant = 0.0,
    rolling: Constant = 0.0,
    slope_x: Constant = 0.0,
    slope_y: Constant = 0.0,
    small_speed: Constant = 0.01,
) -> HybridSystem:
    r"""Return a vehicle with four driven wheels that turns by skidding.

    As it stands it is the vehicle of equation (18) of [1]_, with the modes ``"stick"`` and ``"slip"``. With
    ``m = m_b + 4 m_w``, ``F`` the sum of the wheel forces and the lateral velocity
    ``v = -sin(theta) dX + cos(theta) dY``:

    stick: ``ddX = (F cos(theta) - c_1 dX)/m``, ``ddY = (F sin(theta) - c_1 dY)/m``, ``ddtheta = 0``;

    slip: ``ddX = (F cos(theta) - c_2 dX)/m + g mu sin(theta) v``,
    ``ddY = (F sin(theta) - c_2 dY)/m - g mu cos(theta) v``,
    ``ddtheta = (12 b (F1 - F2 - F3 + F4) - 12 a² g m mu dtheta) / (4 m_w (12 a² + 12 b²) + m_b (B_l² + B_w²))``.

    Each constant is a number, or the name of a parameter, which the `Problem` fixes or estimates. With other frictions
    of the axles, the lateral force of an axle whose lateral velocity is v_i (``v + a dtheta`` in front, ``v - a
    dtheta`` behind) is half the weight times

        mu_i v_i + coulomb_i v_i / sqrt(v_i² + small_speed²).

    There are two more modes, ``"front_slip"`` and ``"rear_slip"``, in which one axle slips ([2]_): the other one has
    the lateral force that keeps its lateral velocity at zero.

    Parameters
    ----------
    modes : sequence of str, optional
        Of "stick", "front_slip", "rear_slip", "slip": those that the system has.
    stick_forces, slip_forces : (float, float, float, float), optional
        Driving force of each wheel in stick and in all other modes (N), in the paper's order F1 to F4: front right,
        front left, rear left, rear right. 15 N each in stick; 27, 0, 0, 27 N in slip.
    forces_from_input : bool, optional
        The four forces are the input ``u`` of the experiment, in all modes.
    restick : {"continuous", "reset"}, optional
        Behavior at a transition to a mode in which an axle sticks that has slipped. ``"continuous"``, the paper's model
        taken literally: the state is continuous, so that the yaw rate is constant from there on. ``"reset"``: a lateral
        impulse at each axle that sticks stops it, see Notes. Modes in which one axle slips need it.
    initial_state : (6,) array_like, optional
        ``(X, dX, Y, dY, theta, dtheta)`` at t0 (m, m/s, m, m/s, rad, rad/s).
    m_b, m_w : float or str, optional
        Mass of the body and of a wheel (kg).
    B_l, B_w : float or str, optional
        Length and width of the body (m).
    a, b : float or str, optional
        Distance of the wheels from the center of mass along and across the vehicle (m).
    c_1, c_2 : float or str, optional
        Viscous drag in stick and in all other modes (kg/s).
    g : float or str, optional
        Acceleration of gravity (m/s²).
    mu_front, mu_rear : float or str, optional
        Viscous lateral friction of the axles (s/m): factors of a velocity, as in (18).
    coulomb_front, coulomb_rear : float or str, optional
        Coulomb's lateral friction of the axles (1).
    rolling : float or str, optional
        Rolling resistance (1), against the velocity along the body.
    slope_x, slope_y : float or str, optional
        Slope of the ground along X and Y (1): positive uphill, small.
    small_speed : float or str, optional
        Speed below which Coulomb's friction and rolling resistance are about viscous (m/s).

    Returns
    -------
    HybridSystem
        Its parameters are those constants that have names; ``mu`` (s/m) if nothing else is said.

    Raises
    ------
    ValueError
        For an unknown mode or `restick`, constants that are not finite or not positive where they must be, forces that
        are not four, or that are given beside an input, an initial state of another length, or a mode with one axle
        that slips without resets. In a `Problem`, if the input has not four channels.
    TypeError
        If a constant is neither a number nor a name, or another argument of the wrong type.

    See Also
    --------
    switchfit.models.differential_drive, switchfit.models.bicycle, switchfit.models.magic_formula : other vehicles.

    Notes
    -----
    Where an axle at the distance s a sticks (s = 1 in front, -1 behind), its force lambda follows from
    ``d/dt (v + s a dtheta) = 0``:

        lambda (1/m + a²/I) = -(v' + s a ddtheta),

    v' and ddtheta without it. At the transition the impulse ``P = -(v + s a dtheta) / (1/m + a²/I)`` stops the axle: v
    changes by P/m, dtheta by s a P/I. Where both stick, v and dtheta are zero. The velocity along the body stays.

    References
    ----------
    .. [1] L. M. Miller, T. D. Murphey, Simultaneous optimal estimation of mode transition times and parameters applied
       to simple traction models, equation (18).
    .. [2] T. M. Caldwell, T. D. Murphey, Switching mode generation and optimal estimation with application to
       skid-steering, Automatica 47 (2011) 50-64.

    Examples
    --------
    >>> from switchfit.models import skid_steer
    >>> vehicle = skid_steer(modes=("stick", "front_slip", "slip"), restick="reset", mu_front="mu_f", mu_rear=0.6)
    >>> sorted(vehicle.reset_maps)
    [('front_slip', 'stick'), ('slip', 'front_slip'), ('slip', 'stick')]
    """
    names = _check_modes(modes, restick)
    forces = _check_forces(forces_from_input, stick_forces=stick_forces, slip_forces=slip_forces)
    constants = check_constants(
        positive={"m_b": m_b, "B_l": B_l, "B_w": B_w, "a": a, "b": b, "g": g, "small_speed": small_speed},
        not_negative={
            "m_w": m_w, "c_1": c_1, "c_2": c_2, "mu_front": mu_front, "mu_rear": mu_rear,
            "coulomb_front": coulomb_front, "coulomb_rear": coulomb_rear, "rolling": rolling,
        },
        others={"slope_x": slope_x, "slope_y": slope_y},
    )  # fmt: skip
    fields, resets = {}, {}
    for name in names:
        field: VectorField = _move_by_input if forces is None else partial(_move, forces[0 if name == "stick" else 1])
        fields[name] = partial(field, STUCK_AXLES[name], constants)
    if restick == "reset":
        # Only where an axle sticks that has slipped: an impulse at one that sticks already would be zero.
        resets = {
            (before, after): partial(_stop_axles, STUCK_AXLES[after], constants)
            for before, after in permutations(names, 2)
            if not set(STUCK_AXLES[after]) <= set(STUCK_AXLES[before])
        }
    return HybridSystem(
        modes=fields,
        initial_state=check_length(initial_state, SKID_STEER_STATES),
        reset_maps=resets,
        state_names=SKID_STEER_STATES,
        state_units=SKID_STEER_UNITS,
    )


def _check_modes(modes: Sequence[str], restick: str) -> tuple[str, ...]:
    names = check_modes(modes, STUCK_AXLES)
    as_choice(restick, "restick", ("continuous", "reset"))
    single = [name for name in names if len(STUCK_AXLES[name]) == 1]
    if restick == "continuous" and single:
        raise ValueError(f"mode {single[0]!r}, in which one axle sticks, needs restick='reset'; got 'continuous'.")
    return names


def _check_forces(from_input: bool, **given: Sequence[float] | None) -> list[tuple[float, ...]] | None:
    """Return the driving forces of the wheels in stick and in all other modes; None if they are the input."""
    if as_flag(from_input, "forces_from_input"):
        for name, forces in given.items():
            if forces is not None:
                raise ValueError(f"{name} must be left out where the forces are the input; got {forces!r}.")
        return None
    found = []
    for (name, own), default in zip(given.items(), (STICK_FORCES, SLIP_FORCES), strict=True):
        forces = default if own is None else own
        if np.shape(forces) != (4,):
            raise ValueError(f"{name} must be four numbers (N), one for each wheel; got {shorten(forces)}.")
        found.append(tuple(as_finite(force, f"{name}[{k}]") for k, force in enumerate(forces)))
    return found


def _move_by_input(
    stuck: tuple[int, ...], constants: Constants, t: Traced, x: Traced, p: Mapping[str, Traced], u: Traced
) -> Traced:
    return _move(read_input(u, FORCES), stuck, constants, t, x, p)


def _move(
    forces: tuple[Traced, ...],
    stuck: tuple[int, ...],
    constants: Constants,
    t: Traced,
    x: Traced,
    p: Mapping[str, Traced],
) -> Traced:
    """Return dx/dt with driving forces (4,) where some axles do not move sideways."""
    _, dX, _, dY, theta, dtheta = x
    c = Values(constants, p)
    m, inertia = _masses(c)
    F_1, F_2, F_3, F_4 = forces
    F = F_1 + F_2 + F_3 + F_4
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    drag = c["c_1"] if len(stuck) == 2 else c["c_2"]
    along, v = cos * dX + sin * dY, -sin * dX + cos * dY
    ddX = (F * cos - drag * dX) / m  # (18)
    ddY = (F * sin - drag * dY) / m  # (18)
    if not is_absent(constants["rolling"]):
        resistance = c["g"] * c["rolling"] * along / jnp.sqrt(along**2 + c["small_speed"] ** 2)
        ddX, ddY = ddX - resistance * cos, ddY - resistance * sin
    sloped = not (is_absent(constants["slope_x"]) and is_absent(constants["slope_y"]))
    if len(stuck) == 2:
        if sloped:  # what acts across the body is taken by the axles
            downhill = c["g"] * (c["slope_x"] * cos + c["slope_y"] * sin)
            ddX, ddY = ddX - downhill * cos, ddY - downhill * sin
        return jnp.stack([dX, ddX, dY, ddY, dtheta, jnp.zeros_like(dtheta)])
    if sloped:
        ddX, ddY = ddX - c["g"] * c["slope_x"], ddY - c["g"] * c["slope_y"]
    turning = 12 * c["b"] * (F_1 - F_2 - F_3 + F_4)
    slipping = {side: names for side, names in FRICTIONS.items() if side not in stuck}
    # The paper's own terms where both axles have one friction: in this form, and to the last bit, they are (18).
    if not stuck and constants["mu_front"] == constants["mu_rear"]:
        mu = c["mu_front"]
        ddX = ddX + c["g"] * mu * sin * v  # (18)
        ddY = ddY - c["g"] * mu * cos * v  # (18)
        turning = turning - 12 * c["a"] ** 2 * c["g"] * m * mu * dtheta  # (18)
        slipping = {side: ("", coulomb) for side, (_, coulomb) in slipping.items()}
    for side, (viscous, coulomb) in slipping.items():
        speed = v + side * c["a"] * dtheta
        terms = []
        if viscous:
            terms.append(c[viscous] * speed)
        if not is_absent(constants[coulomb]):
            terms.append(c[coulomb] * speed / jnp.sqrt(speed**2 + c["small_speed"] ** 2))
        if terms:
            force = 0.5 * c["g"] * sum(terms)  # a unit of mass, against the speed
            ddX, ddY = ddX + force * sin, ddY - force * cos
            turning = turning - 12 * side * c["a"] * m * force
    ddtheta = turning / inertia
    for side in stuck:  # lambda of the Notes, a unit of mass
        # The lateral acceleration of the axle without its force: v' + s a ddtheta, v' = -sin ddX + cos ddY - dtheta
        # along.
        slowing = -sin * ddX + cos * ddY - dtheta * along + side * c["a"] * ddtheta
        force = -slowing / (1 + 12 * m * c["a"] ** 2 / inertia)
        ddX, ddY = ddX - force * sin, ddY + force * cos
        ddtheta = ddtheta + side * c["a"] * 12 * m * force / inertia
    return jnp.stack([dX, ddX, dY, ddY, dtheta, ddtheta])


def _stop_axles(stuck: tuple[int, ...], constants: Constants, t: Traced, x: Traced, p: Mapping[str, Traced]) -> Traced:
    """Return the state after impulses at one axle or both that stop their lateral motion."""
    X, dX, Y, dY, theta, dtheta = x
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    along = cos * dX + sin * dY
    if len(stuck) == 2:
        return jnp.stack([X, along * cos, Y, along * sin, theta, jnp.zeros_like(dtheta)])
    (side,) = stuck
    c = Values(constants, p)
    m, inertia = _masses(c)
    # m a²/I, with twelve times the moment of inertia, as (18) has it.
    ratio = 12 * m * c["a"] ** 2 / inertia
    v = -sin * dX + cos * dY
    impulse = -(v + side * c["a"] * dtheta) / (1 + ratio)  # a unit of mass
    across, turn = v + impulse, dtheta + side * c["a"] * 12 * m * impulse / inertia
    return jnp.stack([X, along * cos - across * sin, Y, along * sin + across * cos, theta, turn])


def _masses(c: Values) -> tuple[Traced, Traced]:
    """Return the mass, and twelve times the moment of inertia, as in (18)."""
    m = c["m_b"] + 4 * c["m_w"]
    return m, 4 * c["m_w"] * (12 * c["a"] ** 2 + 12 * c["b"] ** 2) + c["m_b"] * (c["B_l"] ** 2 + c["B_w"] ** 2)
