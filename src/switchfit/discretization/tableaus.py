"""Tableaus: coefficients of the Runge-Kutta methods, and of their estimates of the error.

Fixed rows take Butcher's explicit method of order 5 (`EXPLICIT`) or Radau IIA of order 5 (`STIFF`), as each mode needs;
the adaptive solve that chooses the mesh takes the pair of Dormand and Prince (`ADAPTIVE`), or `STIFF`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray

# Stages 2 and 3 are both at c = 1/4; the third, which is the more accurate, makes the five times equidistant.
EXPLICIT_BEND = np.array([1.0, 0.0, -4.0, 6.0, -4.0, 1.0])
"""Fourth difference of the slopes at the stages of `EXPLICIT`."""

ADAPTIVE_ERROR = np.array([-71 / 57600, 0, 71 / 16695, -71 / 1920, 17253 / 339200, -22 / 525, 1 / 40])
"""Weights of the slopes of the stages, then of the slope behind the step, in the error of a step of `ADAPTIVE` of
length 1; its order is 4, its signs are those of SciPy."""

STIFF_DAMPING = 1 / (3 + 3 ** (2 / 3) - 3 ** (1 / 3))


class Tableau(NamedTuple):
    """Coefficients of a Runge-Kutta method with s stages.

    Attributes
    ----------
    a, b, c : (s, s), (s,), (s,)
    coupled : int
        Number of stages of an implicit method, whose equations are solved together; 0 for an explicit method. Stages
        behind them repeat the last of them, with weight zero: see `pad`.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    coupled: int = 0

    def pad(self, stages: int) -> Tableau:
        """Return the same method with that many stages: those added repeat the last one, with weight zero.

        The last one, because no other point is sure to be in the domain of the vector field.
        """
        behind = (0, stages - len(self.b))
        a = np.pad(np.pad(self.a, (behind, (0, 0)), mode="edge"), ((0, 0), behind))
        return self._replace(a=a, b=np.pad(self.b, behind), c=np.pad(self.c, behind, mode="edge"))


def butcher() -> Tableau:
    """Return the tableau of Butcher (1964), order 5 with six stages.

    All weights are positive or zero, so that the integral of a positive running cost is positive whatever the step;
    those of Dormand and Prince are not.
    """
    a = np.zeros((6, 6))
    a[1, :1] = [1 / 4]
    a[2, :2] = [1 / 8, 1 / 8]
    a[3, :3] = [0, -1 / 2, 1]
    a[4, :4] = [3 / 16, 0, 0, 9 / 16]
    a[5, :5] = [-3 / 7, 2 / 7, 12 / 7, -12 / 7, 8 / 7]
    return Tableau(a, np.array([7, 0, 32, 12, 32, 7]) / 90, a.sum(1))


def radau_iia() -> Tableau:
    """Return the tableau of Radau IIA of order 5 with three stages (Hairer and Wanner II, table IV.5.6): L-stable,
    stiffly accurate.
    """
    r = np.sqrt(6.0)
    a = np.array(
        [
            [(88 - 7 * r) / 360, (296 - 169 * r) / 1800, (-2 + 3 * r) / 225],
            [(296 + 169 * r) / 1800, (88 + 7 * r) / 360, (-2 - 3 * r) / 225],
            [(16 - r) / 36, (16 + r) / 36, 1 / 9],
        ]
    )
    # Stiffly accurate: b is the last row of a, so that x+ is the state of the last stage.
    return Tableau(a, a[2].copy(), np.array([(4 - r) / 10, (4 + r) / 10, 1.0]), coupled=3)


def dormand_prince() -> Tableau:
    """Return the tableau of Dormand and Prince (1980), order 5 (Hairer, Norsett and Wanner I, table II.5.2).

    It is that of SciPy's RK45, importing which takes longer than most fits.
    """
    a = np.zeros((6, 5))
    a[1, :1] = [1 / 5]
    a[2, :2] = [3 / 40, 9 / 40]
    a[3, :3] = [44 / 45, -56 / 15, 32 / 9]
    a[4, :4] = [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729]
    a[5, :5] = [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656]
    b = np.array([35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84])
    return Tableau(a, b, np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1]))


EXPLICIT, STIFF = butcher(), radau_iia()


# 1/9, 3/9, 5/9 at c = 0, 1/4, 3/4 satisfy the four conditions of order 3: sum b = 1, sum b c = 1/2, sum b c^2 = 1/3 and
# sum b a c = 1/6.
EXPLICIT_ERROR = EXPLICIT.b - np.array([1, 0, 3, 0, 5, 0]) / 9
"""Weights of the slopes in an estimate of the error of `EXPLICIT`: its difference to a method of order 3 with the same
stages."""


ADAPTIVE = dormand_prince()


# Weights of Z_j = X_j - x in the book; Z = a k turns them into weights of the increments.
STIFF_ERROR = np.array([-13 - 7 * np.sqrt(6.0), -13 + 7 * np.sqrt(6.0), -1]) / 3 @ STIFF.a
"""g, and weights e_j, of the estimate ``g (h f + sum_j e_j k_j)`` of the error of `STIFF`, of order 4.

Hairer and Wanner II, section IV.8: 1 / g is the real eigenvalue of a^-1; k_j are the increments ``h K_j``, f is the
slope before the row.
"""


STIFF_BEND = np.array([1.0 / np.prod([c - d for d in STIFF.c if d != c]) for c in STIFF.c])
STIFF_BEND /= np.abs(STIFF_BEND).max()
"""Second divided difference of the slopes at the stages of `STIFF`, whose largest weight is 1."""


STIFF_BESIDE_EXPLICIT = STIFF.pad(len(EXPLICIT.b))
"""`STIFF` in an experiment in which other modes take explicit steps: arrays of stages then have one shape for all."""


def select_tableaus(implicit: Sequence[bool]) -> tuple[Tableau, ...]:
    """Return the method of each mode, all with the same number of stages; `implicit` says which are implicit."""
    stiff = STIFF if all(implicit) else STIFF_BESIDE_EXPLICIT
    return tuple(stiff if each else EXPLICIT for each in implicit)
