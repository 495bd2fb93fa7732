"""Integrate a piecewise smooth model accurately: stop at each corner, go on behind it, or slide along it (Filippov).

A corner is where an affine function g(x) is zero. A field takes the sides s_i = ±1 of all corners, so that it is smooth
while they are constant. Where both sides push towards a corner, the state moves along it with the convex combination
``a f(s_i = 1) + (1 - a) f(s_i = -1)`` that keeps g constant, until a leaves (0, 1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

Field = Callable[[float, Any, Sequence[int]], Sequence[float]]
Corners = Callable[[Any], Sequence[float]]

TOUCHING = 1e-10
"""Distance from a corner below which a state is on it."""

MOST_CORNERS = 10_000


def find_sides(distances: Sequence[float]) -> list[int]:
    """Return on which side of each corner a state is."""
    return [1 if g > 0 else -1 for g in distances]


def integrate(
    field: Field, corners: Corners, x: Any, t0: float, tf: float, times: np.ndarray, **settings: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Return the states at times in (t0, tf] and at tf, (K, n) and (n,); the settings are those of `solve_ivp`."""
    x, t = np.asarray(x, dtype=float), t0
    found = np.empty((len(times), len(x)))
    sides = find_sides(corners(x))
    for i in [i for i, g in enumerate(corners(x)) if abs(g) < TOUCHING]:
        sides[i] = choose_side(field, corners, t, x, sides, i)
    for _ in range(MOST_CORNERS):
        held = sides.index(0) if 0 in sides else None
        move = Piece(field, corners, sides, held)
        events = [move.leave if i == held else move.cross(i) for i in range(len(sides))]
        part = (times > t) & (times <= tf)
        path = solve_ivp(move, (t, tf), x, events=events or None, dense_output=True, **settings)
        if path.status < 0:
            raise ArithmeticError(path.message)
        t, x = path.t[-1], path.y[:, -1]
        part &= times <= t
        if part.any():
            found[part] = path.sol(times[part]).T
        if path.status == 0:
            return found, x
        i = next(i for i, when in enumerate(path.t_events) if len(when))
        sides[i] = choose_side(field, corners, t, x, sides, i)
    raise ArithmeticError(f"more than {MOST_CORNERS} corners until t = {t}")


def choose_side(field: Field, corners: Corners, t: float, x: np.ndarray, sides: list[int], i: int) -> int:
    """Return on which side of corner i a state on it goes on; 0 if it slides."""
    up, down = Piece(field, corners, sides, i).rates(t, x)
    return 0 if up < 0 < down else 1 if up + down > 0 else -1


class Piece:
    """The field with constant sides, sliding along corner `held` if there is one."""

    def __init__(self, field: Field, corners: Corners, sides: list[int], held: int | None) -> None:
        self.field, self.corners, self.held, self.sides = field, corners, held, sides
        if held is not None:
            self.up, self.down = ([*sides[:held], side, *sides[held + 1 :]] for side in (1, -1))

    def __call__(self, t: float, x: np.ndarray) -> Sequence[float]:
        """Return the derivative."""
        if self.held is None:
            return self.field(t, x, self.sides)
        up, down = self.rates(t, x)
        a = down / (down - up)
        return a * np.asarray(self.field(t, x, self.up)) + (1 - a) * np.asarray(self.field(t, x, self.down))

    def rates(self, t: float, x: np.ndarray) -> tuple[float, float]:
        """Return dg/dt of the held corner on both its sides."""
        here = self.corners(x)[self.held]
        return tuple(self.corners(x + self.field(t, x, sides))[self.held] - here for sides in (self.up, self.down))

    def leave(self, t: float, x: np.ndarray) -> float:
        """Return a number that falls below 0 where the state stops sliding."""
        up, down = self.rates(t, x)
        return min(-up, down)

    def cross(self, i: int) -> Callable[[float, np.ndarray], float]:
        """Return the event at which the state crosses corner i from its side."""

        def cross(t: float, x: np.ndarray) -> float:
            return self.corners(x)[i]

        cross.terminal, cross.direction = True, -self.sides[i]
        return cross

    leave.terminal, leave.direction = True, -1
