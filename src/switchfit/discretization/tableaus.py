"""Tableaus: which Runge-Kutta methods rows and adaptive steps take, and the weights of their estimates of the error.

Fixed rows take Butcher's explicit method of order 5 (`EXPLICIT`) or Radau IIA of order 5 (`STIFF`), as each mode needs;
the adaptive solve that chooses the mesh takes the pair of Dormand and Prince (`ADAPTIVE`), or `STIFF`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.discretization.runge_kutta import Tableau, butcher, dormand_prince, radau_iia

EXPLICIT, STIFF, ADAPTIVE = butcher(), radau_iia(), dormand_prince()
"""The methods of explicit rows, of implicit rows and steps, and of explicit adaptive steps."""

STIFF_BESIDE_EXPLICIT = STIFF.pad(len(EXPLICIT.b))
"""`STIFF` in an experiment in which other modes take explicit steps: arrays of stages then have one shape for all."""

# --- estimates of the error -------------------------------------------------------------------------------------------

# 1/9, 3/9, 5/9 at c = 0, 1/4, 3/4 satisfy the four conditions of order 3: sum b = 1, sum b c = 1/2, sum b c^2 = 1/3 and
# sum b a c = 1/6.
EXPLICIT_ERROR = EXPLICIT.b - np.array([1, 0, 3, 0, 5, 0]) / 9
"""Weights of the slopes in an estimate of the error of `EXPLICIT`: its difference to a method of order 3 with the same
stages."""

ADAPTIVE_ERROR = np.array([-71 / 57600, 0, 71 / 16695, -71 / 1920, 17253 / 339200, -22 / 525, 1 / 40])
"""Weights of the slopes of the stages, then of the slope behind the step, in the error of a step of `ADAPTIVE` of
length 1; its order is 4, its signs are those of SciPy."""

STIFF_DAMPING = 1 / (3 + 3 ** (2 / 3) - 3 ** (1 / 3))
"""g in the estimate of the error of `STIFF`: 1 / g is the real eigenvalue of a^-1."""

# Weights of Z_j = X_j - x in the book; Z = a k turns them into weights of the increments.
STIFF_ERROR = np.array([-13 - 7 * np.sqrt(6.0), -13 + 7 * np.sqrt(6.0), -1]) / 3 @ STIFF.a
"""Weights e_j of the estimate ``g (h f + sum_j e_j k_j)`` of the error of `STIFF`, of order 4.

Hairer and Wanner II, section IV.8: k_j are the increments ``h K_j``, f is the slope before the row.
"""

# --- jumps of the slope -----------------------------------------------------------------------------------------------

# Stages 2 and 3 are both at c = 1/4; the third, which is the more accurate, makes the five times equidistant.
EXPLICIT_BEND = np.array([1.0, 0.0, -4.0, 6.0, -4.0, 1.0])
"""Fourth difference of the slopes at the stages of `EXPLICIT`: `row_errors.measure_jump` takes it."""

_DIVIDED = np.array([1.0 / np.prod([c - d for d in STIFF.c if d != c]) for c in STIFF.c])
STIFF_BEND = _DIVIDED / np.abs(_DIVIDED).max()
"""Second divided difference of the slopes at the stages of `STIFF`, whose largest weight is 1."""


def select_tableaus(implicit: Sequence[bool]) -> tuple[Tableau, ...]:
    """Return the method of each mode, all with the same number of stages; `implicit` says which are implicit."""
    stiff = STIFF if all(implicit) else STIFF_BESIDE_EXPLICIT
    return tuple(stiff if each else EXPLICIT for each in implicit)
