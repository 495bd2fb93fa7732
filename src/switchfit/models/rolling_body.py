"""A wheel or a ball that slides at first and then rolls."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import jax.numpy as jnp

from switchfit.arrays import Traced
from switchfit.models.constants import Constant, Constants, Values, check_constants, is_absent
from switchfit.problem.system import HybridSystem


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


def _start_body(p: Mapping[str, Traced]) -> Traced:
    return jnp.stack([0.0 * p["v_0"], p["v_0"], p["omega_0"]])


def _slope(constants: Constants, c: Values) -> tuple[Traced, Traced]:
    """Return the cosine and the sine of the slope."""
    if is_absent(constants["slope"]):
        return 1.0, 0.0
    return jnp.cos(c["slope"]), jnp.sin(c["slope"])


def _slide(constants: Constants, direction: int, t: Traced, x: Traced, p: Mapping[str, Traced]) -> Traced:
    c = Values(constants, p)
    cos, sin = _slope(constants, c)
    # Along the plane: the normal force times mu, against the slip of the contact point, whose sign is that of the mode
    # and not of the state. So the field stays smooth if a transition is tried too late.
    friction = direction * c["mu"] * c["g"] * cos
    dv = -friction - c["g"] * sin
    # ``0.0 * x[1]``: constants are floats, and `stack` needs the type of the state.
    return jnp.stack([x[1], dv + 0.0 * x[1], friction / (c["inertia"] * c["radius"]) + 0.0 * x[1]])


def _roll(constants: Constants, t: Traced, x: Traced, p: Mapping[str, Traced]) -> Traced:
    c = Values(constants, p)
    cos, sin = _slope(constants, c)
    dv = -c["g"] * (sin + c["rolling"] * cos) / (1 + c["inertia"])
    return jnp.stack([x[1], dv + 0.0 * x[1], dv / c["radius"] + 0.0 * x[1]])


def _get_slip(constants: Constants, t: Traced, x: Traced, p: Mapping[str, Traced]) -> Traced:
    # The speed of the contact point: zero where the body rolls.
    return x[1] - Values(constants, p)["radius"] * x[2]
