"""Forces and aligning moment of a tyre by Pacejka's Magic Formula of 1987, with derivatives in closed form."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from types import MappingProxyType

import jax
import jax.numpy as jnp

from switchfit.arrays import Traced

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

#: Shape factors C, which are not among the fitted coefficients.
C_X, C_Y, C_Z = 1.65, 1.30, 2.40


def longitudinal_force(slip: Traced, load: Traced, p: Mapping[str, Traced]) -> Traced:
    """Return the longitudinal force of a tyre (N) at a slip ratio in % and a load in kN; `p` holds a_x1 to a_x8."""
    a_1, a_2, a_3, a_4, a_5, a_6, a_7, a_8 = (p[f"a_x{i}"] for i in range(1, 9))
    peak = a_1 * load + a_2  # D / load; that D and BCD have load as a factor saves operations
    B = (a_3 * load + a_4) * jnp.exp(-a_5 * load) / (C_X * peak)
    E = (a_6 * load + a_7) * load + a_8
    return _magic_formula(slip, B, C_X, peak * load, E)


def lateral_force(angle: Traced, load: Traced, p: Mapping[str, Traced]) -> Traced:
    """Return the lateral force of a tyre (N) at a slip angle in degrees and a load in kN; `p` holds a_y1 to a_y8."""
    a_1, a_2, a_3, a_4, a_5, a_6, a_7, a_8 = (p[f"a_y{i}"] for i in range(1, 9))
    D = (a_1 * load + a_2) * load
    BCD = a_3 * jnp.sin(a_4 * jnp.arctan(a_5 * load))
    E = (a_6 * load + a_7) * load + a_8
    return _magic_formula(angle, BCD / (C_Y * D), C_Y, D, E)


def compute_aligning_moment(angle: Traced, load: Traced, p: Mapping[str, Traced]) -> Traced:
    """Return the aligning moment of a tyre (N m) at a slip angle in degrees and a load in kN, from a_z1 to a_z8."""
    a_1, a_2, a_3, a_4, a_5, a_6, a_7, a_8 = (p[f"a_z{i}"] for i in range(1, 9))
    D = a_1 * load**2 + a_2 * load
    BCD = (a_3 * load**2 + a_4 * load) * jnp.exp(-a_5 * load)
    E = a_6 * load**2 + a_7 * load + a_8
    return _magic_formula(angle, BCD / (C_Z * D), C_Z, D, E)


def _magic_formula(X: Traced, B: Traced, C: float, D: Traced, E: Traced) -> Traced:
    """Y = D sin(C atan(B phi)), phi = (1 − E) X + (E/B) atan(B X); the shifts are zero."""
    return D * _curve(B * X, E, C)


# Derivatives of the curve in closed form. Those that JAX derives from its operations, twice in each unknown and for two
# forces of four tyres, are a quarter more operations than these, and machine code takes no more than 10,000 of a mode.


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _curve(x: Traced, E: Traced, C: float) -> Traced:
    """Return ``y = sin(C atan q)``, ``q = x + E (atan x - x)``; x is B X, and q is B phi."""
    return jnp.sin(C * jnp.arctan(x + E * (jnp.arctan(x) - x)))


@_curve.defjvp
def _move_along_curve(C: float, at: tuple[Traced, Traced], moves: tuple[Traced, Traced]) -> tuple[Traced, Traced]:
    y_x, y_E = _slopes(*at, C)
    return _curve(*at, C), y_x * moves[0] + y_E * moves[1]


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _slopes(x: Traced, E: Traced, C: float) -> tuple[Traced, Traced]:
    """Return dy/dx and dy/dE."""
    first, _ = _derive_sine(x, E, C)
    q_x, q_E = _derive_angle(x, E)
    return first * q_x, first * q_E


@_slopes.defjvp
def _move_slopes(C: float, at: tuple[Traced, Traced], moves: tuple[Traced, Traced]) -> tuple[Traced, Traced]:
    x, E = at
    first, second = _derive_sine(x, E, C)
    q_x, q_E = _derive_angle(x, E)
    y_xx = second * q_x**2 - first * E * 2 * x / (1 + x**2) ** 2
    y_xE = second * q_x * q_E - first * x**2 / (1 + x**2)
    y_EE = second * q_E**2
    return _slopes(x, E, C), (y_xx * moves[0] + y_xE * moves[1], y_xE * moves[0] + y_EE * moves[1])


def _derive_angle(x: Traced, E: Traced) -> tuple[Traced, Traced]:
    """Return dq/dx and dq/dE."""
    return 1 - E * x**2 / (1 + x**2), jnp.arctan(x) - x


def _derive_sine(x: Traced, E: Traced, C: float) -> tuple[Traced, Traced]:
    """Return dy/dq and d²y/dq²."""
    q = x + E * (jnp.arctan(x) - x)
    angle, slope = C * jnp.arctan(q), C / (1 + q**2)
    first = slope * jnp.cos(angle)
    return first, -(slope**2) * jnp.sin(angle) - first * 2 * q / (1 + q**2)
