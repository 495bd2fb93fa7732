"""The problems: friction, contacts, tanks, valves, tables and relays, as a user writes them in an hour."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import cos, hypot, sin, sqrt, tanh
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks.sharp.case import Case

G = 9.81
AT_50_HZ = np.arange(1, 101) * 0.02


def block(eps: float) -> Case:
    """A block that is pushed, then slides to rest: friction regularised at a speed of `eps`."""
    modes = {
        "push": lambda t, x, p: jnp.stack([x[1], p["a"] - p["mu"] * G * x[1] / jnp.sqrt(x[1] ** 2 + eps**2)]),
        "slide": lambda t, x, p: jnp.stack([x[1], -p["mu"] * G * x[1] / jnp.sqrt(x[1] ** 2 + eps**2)]),
    }

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        mu, a = p
        return [x[1], (a if mode == "push" else 0.0) - mu * G * x[1] / sqrt(x[1] ** 2 + eps**2)]

    return Case(modes, twin, ("push", "slide"), (0.6,), {"mu": 0.3, "a": 6.0}, (0.0, 1e-6), AT_50_HZ)


def spring() -> Case:
    """A mass on a spring with dry friction, driven, then released."""

    def move(t, x, p, force):
        return jnp.stack([x[1], force - p["k"] * x[0] - p["mu"] * G * x[1] / jnp.sqrt(x[1] ** 2 + 1e-12)])

    modes = {"driven": lambda t, x, p: move(t, x, p, p["a"]), "free": lambda t, x, p: move(t, x, p, 0.0)}

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        k, mu, a = p
        return [x[1], (a if mode == "driven" else 0.0) - k * x[0] - mu * G * x[1] / sqrt(x[1] ** 2 + 1e-12)]

    parameters = {"k": 40.0, "mu": 0.25, "a": 12.0}
    return Case(modes, twin, ("driven", "free"), (0.9,), parameters, (0.0, 1e-6), AT_50_HZ)


def slope() -> Case:
    """A block that is pushed up a slope of 10 degrees, slides on and stays there."""
    down, normal = G * sin(np.deg2rad(10.0)), G * cos(np.deg2rad(10.0))

    def move(x, p, push):
        return jnp.stack([x[1], push - down - p["mu"] * normal * x[1] / jnp.sqrt(x[1] ** 2 + 1e-12)])

    modes = {"push": lambda t, x, p: move(x, p, p["a"]), "slide": lambda t, x, p: move(x, p, 0.0)}

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        mu, a = p
        return [x[1], (a if mode == "push" else 0.0) - down - mu * normal * x[1] / sqrt(x[1] ** 2 + 1e-12)]

    return Case(modes, twin, ("push", "slide"), (0.7,), {"mu": 0.35, "a": 9.0}, (0.0, 1e-6), AT_50_HZ)


def plane() -> Case:
    """A block on a table, pushed across its own motion: friction against the direction of the velocity."""

    def move(x, p, push):
        v = x[2:]
        return jnp.concatenate([v, push - p["mu"] * G * v / jnp.sqrt(v @ v + 1e-12)])

    modes = {
        "push": lambda t, x, p: move(x, p, jnp.stack([p["ax"], p["ay"]])),
        "slide": lambda t, x, p: move(x, p, jnp.zeros(2)),
    }

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        mu, ax, ay = p
        _, _, vx, vy = x
        friction, on = mu * G / hypot(vx, vy, 1e-6), mode == "push"
        return [vx, vy, on * ax - friction * vx, on * ay - friction * vy]

    parameters = {"mu": 0.3, "ax": 6.0, "ay": 3.0}
    return Case(modes, twin, ("push", "slide"), (0.6,), parameters, (0.0, 0.0, 0.0, 1.0), AT_50_HZ, (0, 1))


def dry() -> Case:
    """A mass on a spring, let go, with the sign of the velocity for friction: it sticks after some swings."""
    modes = {"swing": lambda t, x, p: jnp.stack([x[1], -p["k"] * x[0] - p["f"] * jnp.sign(x[1])])}

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        k, f = p
        return [x[1], -k * x[0] - f * s[0]]

    return Case(
        modes, twin, ("swing",), (), {"k": 40.0, "f": 2.2}, (0.3, 0.0), AT_50_HZ,
        corners=lambda x, p: [x[1]], smooth=lambda mode, t, x, p, s: twin(mode, t, x, p, [x[1] / hypot(x[1], 1e-6)]),
    )  # fmt: skip


def tank() -> Case:
    """A tank that is filled while it drains, then runs empty."""
    modes = {
        "fill": lambda t, x, p: jnp.stack([p["q"] - p["k"] * jnp.sqrt(jnp.maximum(x[0], 0.0))]),
        "drain": lambda t, x, p: jnp.stack([-p["k"] * jnp.sqrt(jnp.maximum(x[0], 0.0))]),
    }

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        k, q = p
        return [(q if mode == "fill" else 0.0) - k * sqrt(max(x[0], 0.0))]

    return Case(
        modes, twin, ("fill", "drain"), (10.0,), {"k": 0.2, "q": 0.3}, (0.1,), np.linspace(0.3, 30.0, 100), sigma=0.01
    )


def refilled() -> Case:
    """A tank that runs empty, and is filled again."""
    modes = {
        "drain": lambda t, x, p: jnp.stack([-p["k"] * jnp.sqrt(jnp.maximum(x[0], 0.0))]),
        "fill": lambda t, x, p: jnp.stack([p["q"] - p["k"] * jnp.sqrt(jnp.maximum(x[0], 0.0))]),
    }

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        k, q = p
        return [(q if mode == "fill" else 0.0) - k * sqrt(max(x[0], 0.0))]

    return Case(
        modes, twin, ("drain", "fill"), (6.0,), {"k": 0.5, "q": 0.3}, (1.0,), np.linspace(0.1, 10.0, 60), sigma=0.01
    )


def check_valve() -> Case:
    """Two tanks with a check valve between them, which opens as the first is filled and shuts as it is drained."""

    def move(x, p, flow):
        through = p["c"] * jnp.sqrt(jnp.where(x[0] > x[1], x[0] - x[1], 0.0))
        return jnp.stack([flow - through, through - p["d"] * x[1]])

    modes = {"fill": lambda t, x, p: move(x, p, p["q"]), "drain": lambda t, x, p: move(x, p, -p["q"] * x[0])}

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        c, d, q = p
        through = c * sqrt(max(x[0] - x[1], 0.0))
        return [(q if mode == "fill" else -q * x[0]) - through, through - d * x[1]]

    parameters, times = {"c": 0.6, "d": 0.3, "q": 0.4}, np.linspace(0.2, 12.0, 60)
    return Case(modes, twin, ("fill", "drain"), (5.0,), parameters, (0.0, 0.3), times, (0, 1), 0.01)


def contact() -> Case:
    """A ball that falls onto a stiff floor with a damper, and bounces until it lies."""

    def move(t, x, p):
        return jnp.stack([x[1], -G - jnp.where(x[0] < 0, p["K"] * x[0] + p["d"] * x[1], 0.0)])

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        K, d = p
        return [x[1], -G - (K * x[0] + d * x[1] if s[0] < 0 else 0.0)]

    return Case(
        {"move": move}, twin, ("move",), (), {"K": 2e4, "d": 40.0}, (0.3, 0.0), np.arange(1, 201) * 0.01,
        corners=lambda x, p: [x[0]],
    )  # fmt: skip


def valve() -> Case:
    """A vessel that a pump fills and a leak empties; above a pressure a valve opens at once."""

    def move(x, p, q):
        return jnp.stack([q - p["leak"] * x[0] - jnp.where(x[0] > p["opens"], p["c"] * x[0], 0.0)])

    modes = {"pump": lambda t, x, p: move(x, p, p["q"]), "off": lambda t, x, p: move(x, p, 0.0)}

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        q, leak, c, _ = p
        return [(q if mode == "pump" else 0.0) - leak * x[0] - c * x[0] * (1 + s[0]) / 2]

    def smooth(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        return twin(mode, t, x, p, [tanh((x[0] - p[3]) / 1e-3)])

    return Case(
        modes, twin, ("pump", "off"), (5.0,), {"q": 2.0, "leak": 0.3, "c": 0.3, "opens": 2.0}, (0.0,),
        np.arange(1, 101) * 0.1, sigma=0.02, corners=lambda x, p: [x[0] - p[3]], smooth=smooth,
    )  # fmt: skip


def backlash() -> Case:
    """A motor drives a load through a gap; the motor is reversed."""

    def move(x, p, u):
        gap = x[0] - x[2]
        force = p["K"] * jnp.where(gap > p["w"], gap - p["w"], jnp.where(gap < -p["w"], gap + p["w"], 0.0))
        return jnp.stack([x[1], u - x[1] - force, x[3], force - p["c"] * x[3]])

    modes = {"ahead": lambda t, x, p: move(x, p, 2.0), "back": lambda t, x, p: move(x, p, -2.0)}

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        K, w, c = p
        gap = x[0] - x[2]
        force = K * (gap - w if s[0] > 0 else gap + w if s[1] < 0 else 0.0)
        return [x[1], (2.0 if mode == "ahead" else -2.0) - x[1] - force, x[3], force - c * x[3]]

    return Case(
        modes, twin, ("ahead", "back"), (1.5,), {"K": 100.0, "w": 0.05, "c": 1.0}, (0.0, 0.0, 0.0, 0.0),
        np.arange(1, 151) * 0.02, (0, 2), corners=lambda x, p: [x[0] - x[2] - p[1], x[0] - x[2] + p[1]],
    )  # fmt: skip


def dead_zone() -> Case:
    """A mass that swings between two springs with play."""

    def move(t, x, p):
        stretch = jnp.sign(x[0]) * jnp.maximum(jnp.abs(x[0]) - p["w"], 0.0)
        return jnp.stack([x[1], -p["k"] * stretch - p["c"] * x[1]])

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        k, w, c = p
        stretch = x[0] - w if s[0] > 0 else x[0] + w if s[1] < 0 else 0.0
        return [x[1], -k * stretch - c * x[1]]

    return Case(
        {"swing": move}, twin, ("swing",), (), {"k": 40.0, "w": 0.05, "c": 0.3}, (0.3, 0.0), np.arange(1, 201) * 0.02,
        corners=lambda x, p: [x[0] - p[1], x[0] + p[1]],
    )  # fmt: skip


def hysteresis() -> Case:
    """Bouc and Wen's hysteretic spring under a harmonic force, which is switched off."""

    def move(t, x, p, force):
        slip = p["beta"] * jnp.abs(x[1]) * x[2] + 0.3 * x[1] * jnp.abs(x[2])
        return jnp.stack([x[1], force - p["k"] * x[0] - 0.2 * x[1] - x[2], p["A"] * x[1] - slip])

    modes = {
        "driven": lambda t, x, p: move(t, x, p, 3.0 * jnp.sin(t)),
        "free": lambda t, x, p: move(t, x, p, 0.0),
    }

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        k, A, beta = p
        force = 3.0 * sin(t) if mode == "driven" else 0.0
        slip = beta * s[0] * x[1] * x[2] + 0.3 * x[1] * s[1] * x[2]
        return [x[1], force - k * x[0] - 0.2 * x[1] - x[2], A * x[1] - slip]

    return Case(
        modes, twin, ("driven", "free"), (5.0,), {"k": 2.0, "A": 3.0, "beta": 2.0}, (0.0, 0.1, 0.0),
        np.linspace(0.1, 10.0, 100), sigma=0.01, corners=lambda x, p: [x[1], x[2]],
    )  # fmt: skip


SPEEDS, TRACTION = (0.0, 2.0, 4.0, 7.0, 10.0), (3.0, 4.0, 2.5, 1.5, 1.0)
"""A table of few knots: m/s, m/s²."""


def table() -> Case:
    """A cart whose traction is a table over its speed, until it coasts."""

    def drive(t, x, p):
        return jnp.stack([p["gain"] * jnp.interp(x[0], jnp.array(SPEEDS), jnp.array(TRACTION)) - p["c"] * x[0]])

    modes = {"drive": drive, "coast": lambda t, x, p: jnp.stack([-p["c"] * x[0]])}

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        gain, c = p
        if mode == "coast":
            return [-c * x[0]]
        if s[0] < 0 or s[-1] > 0:
            return [gain * (TRACTION[0] if s[0] < 0 else TRACTION[-1]) - c * x[0]]
        i = s.count(1) - 1
        slope = (TRACTION[i + 1] - TRACTION[i]) / (SPEEDS[i + 1] - SPEEDS[i])
        return [gain * (TRACTION[i] + slope * (x[0] - SPEEDS[i])) - c * x[0]]

    return Case(
        modes, twin, ("drive", "coast"), (5.0,), {"gain": 1.0, "c": 0.1}, (0.1,), np.arange(1, 101) * 0.1, sigma=0.05,
        corners=lambda x, p: [x[0] - knot for knot in SPEEDS],
    )  # fmt: skip


def relay() -> Case:
    """A room with a relay that a slow sensor switches: the setpoint is lowered for the night."""

    def move(x, p, setpoint):
        heat, room, sensor = x
        on = jnp.where(sensor < setpoint, 1.0, 0.0)
        return jnp.stack([(on - heat) / 0.5, p["a"] * heat - p["b"] * (room - 15.0), (room - sensor) / p["lag"]])

    modes = {"day": lambda t, x, p: move(x, p, 22.0), "night": lambda t, x, p: move(x, p, 19.0)}

    def twin(mode: str, t: float, x: Any, p: Any, s: Any) -> list[float]:
        a, b, lag = p
        on = s[0 if mode == "day" else 1] < 0
        return [(on - x[0]) / 0.5, a * x[0] - b * (x[1] - 15.0), (x[1] - x[2]) / lag]

    return Case(
        modes, twin, ("day", "night"), (4.0,), {"a": 5.0, "b": 0.2, "lag": 0.6}, (0.0, 16.0, 16.0),
        np.linspace(0.1, 8.0, 80), (1,), 0.05, corners=lambda x, p: [x[2] - 22.0, x[2] - 19.0],
    )  # fmt: skip


PROBLEMS: dict[str, Callable[[], Case]] = {
    "block": partial(block, 1e-6),
    "block-1e-3": partial(block, 1e-3),
    "block-1e-4": partial(block, 1e-4),
    "block-1e-8": partial(block, 1e-8),
    "spring": spring,
    "slope": slope,
    "plane": plane,
    "dry": dry,
    "tank": tank,
    "refilled": refilled,
    "check-valve": check_valve,
    "contact": contact,
    "valve": valve,
    "backlash": backlash,
    "dead-zone": dead_zone,
    "hysteresis": hysteresis,
    "table": table,
    "relay": relay,
}
