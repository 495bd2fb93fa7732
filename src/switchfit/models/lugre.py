"""A body with LuGre friction: bristles that bend, stick and slide."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import jax.numpy as jnp
from numpy.typing import ArrayLike

from switchfit.arrays import Traced
from switchfit.models.arguments import check_length, read_input
from switchfit.models.constants import Constant, Constants, Values, check_constants
from switchfit.problem.system import HybridSystem


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


def _get_speed(t: Traced, x: Traced, p: Mapping[str, Traced]) -> Traced:
    return x[1]


def _bend(constants: Constants, direction: int, t: Traced, x: Traced, p: Mapping[str, Traced], u: Traced) -> Traced:
    position, v, z = x
    c = Values(constants, p)
    level = c["F_c"] + (c["F_s"] - c["F_c"]) * jnp.exp(-((v / c["v_s"]) ** 2))  # G(v)
    # |v| is direction * v, so that the field is smooth within a mode.
    dz = v - direction * c["sigma_0"] * v * z / level
    friction = c["sigma_0"] * z + c["sigma_1"] * dz + c["sigma_2"] * v
    (force,) = read_input(jnp.ravel(u), ("force or position",))
    # Without a spring the input is the force itself: not k (u - x) with k = 0.
    pull = force if constants["k"] == 0.0 else c["k"] * (force - position)
    return jnp.stack([v, (pull - friction) / c["m"], dz])
