"""Runge-Kutta methods as the books have them: the class of their coefficients, and the three that are used.

`tableaus` says what each of them is for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray


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
    # b is Boole's rule at c = 0, 1/4, 1/2, 3/4, 1; the c_j are the sums of the rows of a.
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
