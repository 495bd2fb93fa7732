"""Bodies with friction: a block that slides until it sticks, a wheel or a ball that slides until it rolls, bristles."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
from numpy.typing import ArrayLike

from switchfit.models.constants import Constant, Constants, Values, check_constants, check_length, is_absent, read_input
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
    >>> import switchfit as sf
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


def _brake(constants: Constants, t: Any, x: Any, p: Any) -> Any:
    speed = jnp.sqrt(p["vx0"] ** 2 + p["vy0"] ** 2)
    deceleration = p["mu"] * Values(constants, p)["g"] / speed
    return jnp.stack([x[2], x[3], -deceleration * p["vx0"], -deceleration * p["vy0"]])


def _keep_velocity(t: Any, x: Any, p: Any) -> Any:
    return jnp.zeros_like(x)


def _start_block(p: Any) -> Any:
    return jnp.stack([p["x0"], p["y0"], p["vx0"], p["vy0"]])


def rolling_body(
    *,
    radius: Constant = 0.05,
    inertia: Constant = 0.4,
    mu: Constant = "mu",
    rolling: Constant = 0.0,
    slope: Constant = 0.0,
    g: Constant = 9.81,
) -> HybridSystem:
    r"""Return a body of revolution on a plane, modes ``"skid"``, ``"spin"`` and ``"roll"``, state ``(x, v, omega)``.

    x is the path, v the speed of the center and omega the angular velocity, positive where rolling has ``v = R omega``.
    With the moment of inertia ``k m R²`` and the slope angle s (uphill positive), Coulomb's friction makes ([1]_)

        skid (v > R omega):  v' = -g (mu cos s + sin s),   omega' =  mu g cos s / (k R);
        spin (v < R omega):  v' =  g (mu cos s - sin s),   omega' = -mu g cos s / (k R);
        roll (v = R omega):  v' = -g (sin s + rolling cos s) / (1 + k),   omega' = v' / R.

    Skid and spin end where v = R omega, their guard, so that the time of the transition need not be guessed well: the
    state decides. On the level from v_0 with omega = 0 it is ``v_0 / (mu g (1 + 1/k))``, and the body rolls with
    ``v_0 / (1 + k)``, whatever mu: for a ball 5/7 of v_0.

    Parameters
    ----------
    radius : float or str, optional
        R (m).
    inertia : float or str, optional
        k: 2/5 for a ball, 1/2 for a disk, 1 for a ring, 2/3 for a hollow ball (1).
    mu : float or str, optional
        Coefficient of friction (1).
    rolling : float or str, optional
        Rolling resistance (1), against a motion with v > 0.
    slope : float or str, optional
        Angle of the plane (rad), uphill positive.
    g : float or str, optional
        Acceleration of gravity (m/s²).

    Returns
    -------
    HybridSystem
        Its parameters are those constants that have names, and ``v_0`` and ``omega_0``, the state at t0 (m/s, rad/s);
        x is 0 there.

    Raises
    ------
    ValueError, TypeError
        For a wrong constant.

    See Also
    --------
    switchfit.models.sliding_block, switchfit.models.lugre

    References
    ----------
    .. [1] L. D. Landau, E. M. Lifshitz, Mechanics, 3rd ed., Butterworth-Heinemann 1976, section 38 (bodies in contact).

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import rolling_body
    >>> ball, rolls_at = rolling_body(radius=0.11, mu=0.2), 7.0 / (0.2 * 9.81 * 3.5)
    >>> run = sf.Experiment(sf.RunningCost(lambda t, x, p: x[0]), ("skid", "roll"), (rolls_at,), 0.0, 2.0)
    >>> path = sf.simulate(sf.Problem(ball, run, {"v_0": 7.0, "omega_0": 0.0}))
    >>> round(float(path.states[-1, 1]), 6)  # 5/7 of the first speed
    5.0
    """
    constants = check_constants(
        positive={"radius": radius, "inertia": inertia, "g": g},
        not_negative={"mu": mu, "rolling": rolling},
        others={"slope": slope},
    )
    return HybridSystem(
        modes={
            "skid": partial(_slide, constants, 1),
            "spin": partial(_slide, constants, -1),
            "roll": partial(_roll, constants),
        },
        initial_state=_start_body,
        guards=dict.fromkeys((("skid", "roll"), ("spin", "roll")), partial(_get_slip, constants)),
        state_names=("x", "v", "omega"),
        state_units=("m", "m/s", "rad/s"),
    )


def _start_body(p: Any) -> Any:
    return jnp.stack([0.0 * p["v_0"], p["v_0"], p["omega_0"]])


def _slope(constants: Constants, c: Values) -> tuple[Any, Any]:
    """Return the cosine and the sine of the slope."""
    if is_absent(constants["slope"]):
        return 1.0, 0.0
    return jnp.cos(c["slope"]), jnp.sin(c["slope"])


def _slide(constants: Constants, direction: int, t: Any, x: Any, p: Any) -> Any:
    c = Values(constants, p)
    cos, sin = _slope(constants, c)
    friction = direction * c["mu"] * c["g"] * cos
    dv = -friction - c["g"] * sin
    return jnp.stack([x[1], dv + 0.0 * x[1], friction / (c["inertia"] * c["radius"]) + 0.0 * x[1]])


def _roll(constants: Constants, t: Any, x: Any, p: Any) -> Any:
    c = Values(constants, p)
    cos, sin = _slope(constants, c)
    dv = -c["g"] * (sin + c["rolling"] * cos) / (1 + c["inertia"])
    return jnp.stack([x[1], dv + 0.0 * x[1], dv / c["radius"] + 0.0 * x[1]])


def _get_slip(constants: Constants, t: Any, x: Any, p: Any) -> Any:
    return x[1] - Values(constants, p)["radius"] * x[2]


def lugre(
    *,
    m: Constant = 1.0,
    k: Constant = 0.0,
    sigma_0: Constant = "sigma_0",
    sigma_1: Constant = "sigma_1",
    sigma_2: Constant = "sigma_2",
    F_c: Constant = "F_c",
    F_s: Constant = "F_s",
    v_s: Constant = "v_s",
    initial_state: ArrayLike = (0.0, 0.0, 0.0),
) -> HybridSystem:
    r"""Return a body with LuGre friction, modes ``"forward"`` and ``"backward"``, state ``(x, v, z)``.

    In the model of [1]_ z is the mean deflection of the bristles between the surfaces. With the input u, a force (N),
    or with a spring of stiffness k the position (m) of its far end,

        m v' = k (u - x) - F   or, with k = 0,   u - F,
        z' = v - sigma_0 abs(v) z / G(v),    G(v) = F_c + (F_s - F_c) exp(-(v / v_s)²),
        F = sigma_0 z + sigma_1 z' + sigma_2 v.

    ``|v|`` is v in "forward" and -v in "backward", so that the field of each mode is smooth; a transition between them
    is where v = 0, its guard. In steady sliding ``F = G(v) sign(v) + sigma_2 v`` (the Stribeck curve), and sticking is
    the slow motion while the bristles bend. Stiff where sigma_0 is large.

    Parameters
    ----------
    m : float or str, optional
        Mass (kg).
    k : float or str, optional
        Stiffness of a spring that pulls (N/m); 0: the input is the force.
    sigma_0, sigma_1 : float or str, optional
        Stiffness (N/m) and damping (N s/m) of the bristles.
    sigma_2 : float or str, optional
        Viscous friction (N s/m).
    F_c, F_s : float or str, optional
        Coulomb's friction and that at rest (N).
    v_s : float or str, optional
        Stribeck's velocity (m/s).
    initial_state : (3,) array_like, optional
        ``(x, v, z)`` at t0 (m, m/s, m).

    Returns
    -------
    HybridSystem
        Its parameters are those constants that have names: those of the friction if nothing else is said.

    Raises
    ------
    ValueError, TypeError
        For a wrong constant or an initial state of another length. In a `Problem`, if the input has not one channel.

    See Also
    --------
    switchfit.models.rolling_body, switchfit.models.sliding_block : bodies with Coulomb's friction.

    References
    ----------
    .. [1] C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky, A new model for control of systems with friction,
       IEEE Transactions on Automatic Control 40 (1995) 419-425.

    Examples
    --------
    >>> from switchfit.models import lugre
    >>> lugre(k=2.0, v_s=0.001).state_units
    ('m', 'm/s', 'm')
    """
    constants = check_constants(
        positive={"m": m, "sigma_0": sigma_0, "F_c": F_c, "F_s": F_s, "v_s": v_s},
        not_negative={"k": k, "sigma_1": sigma_1, "sigma_2": sigma_2},
    )
    return HybridSystem(
        modes={"forward": partial(_bend, constants, 1), "backward": partial(_bend, constants, -1)},
        initial_state=check_length(initial_state, ("x", "v", "z")),
        guards={("forward", "backward"): _get_speed, ("backward", "forward"): _get_speed},
        state_names=("x", "v", "z"),
        state_units=("m", "m/s", "m"),
    )


def _get_speed(t: Any, x: Any, p: Any) -> Any:
    return x[1]


def _bend(constants: Constants, direction: int, t: Any, x: Any, p: Any, u: Any) -> Any:
    position, v, z = x
    c = Values(constants, p)
    level = c["F_c"] + (c["F_s"] - c["F_c"]) * jnp.exp(-((v / c["v_s"]) ** 2))  # G(v)
    dz = v - direction * c["sigma_0"] * v * z / level
    friction = c["sigma_0"] * z + c["sigma_1"] * dz + c["sigma_2"] * v
    (force,) = read_input(jnp.ravel(u), ("force or position",))
    pull = force if constants["k"] == 0.0 else c["k"] * (force - position)
    return jnp.stack([v, (pull - friction) / c["m"], dz])
