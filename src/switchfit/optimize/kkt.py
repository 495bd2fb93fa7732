"""First-order optimality: how far a gradient is from the cone of the active constraints, and the multipliers there.

References
----------
.. [1] C. L. Lawson, R. J. Hanson, Solving Least Squares Problems, SIAM 1995, chapter 23.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from switchfit.optimize.algebra import FloatArray, unit_rows


def kkt_residual(low: FloatArray, high: FloatArray, normals: FloatArray) -> tuple[float, FloatArray]:
    """Return the distance of the gradient from the cone of the active constraints, and the multipliers that attain it.

    min over lam >= 0 and low <= g <= high of ‖g − Nᵀ lam‖₂, where low = high except at coordinates held at a kink.

    Parameters
    ----------
    low, high : array, shape (d,)
        The interval of one-sided derivatives.
    normals : array, shape (k, d)
        Inward normals N of the active constraints.

    Returns
    -------
    residual : float
    multipliers : array, shape (k,)
    """
    if normals.shape[0] == 0:
        nearest = low if low is high else np.clip(0.0, low, high)
        return math.sqrt(nearest.dot(nearest)), np.zeros(0)
    size = float(max(np.max(np.abs(low), initial=0.0), np.max(np.abs(high), initial=0.0)))
    if size == 0.0:
        return 0.0, np.zeros(normals.shape[0])
    wide = np.flatnonzero(high > low)
    unit, lengths = unit_rows(normals)
    if wide.size == 0:
        multipliers = _cone_projection(unit, low / size)
        shift = np.zeros(0)
    else:
        multipliers, shift = _box_projection(unit, low / size, (high - low)[wide] / size, wide)
    gradient = low / size
    gradient[wide] += shift
    residual = size * float(np.linalg.norm(gradient - unit.T @ multipliers))
    return residual, size * multipliers / lengths


def _cone_projection(unit: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return the argument of min over lam >= 0 of ‖g − Nᵀ lam‖.

    SciPy's nnls is fast, but from version 1.15 on its answer may be wrong for dependent rows, and its residual with it
    (https://github.com/scipy/scipy/issues/25389), so that the answer is checked.
    """
    if gradient.size == 0:
        return np.zeros(unit.shape[0])
    from scipy.optimize import lsq_linear, nnls  # here, since importing it takes longer than most fits, which need none

    try:
        multipliers = np.asarray(nnls(unit.T, gradient, maxiter=10 * unit.shape[0] + 30)[0])
    except RuntimeError:
        multipliers = np.full(unit.shape[0], np.nan)
    pull = unit @ (gradient - unit.T @ multipliers)
    wrong = np.where(multipliers > 0.0, np.abs(pull), pull)
    if np.all(wrong <= 1e-12 * (1.0 + np.max(multipliers))):
        return multipliers
    return np.asarray(lsq_linear(unit.T, gradient, bounds=(0.0, np.inf), method="bvls").x)


def _box_projection(
    unit: FloatArray, low: FloatArray, width: FloatArray, wide: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """Return the arguments of min over lam >= 0, 0 <= s <= width of ‖low + s − Nᵀ lam‖: lam and s.

    With s inside its interval a coordinate puts no condition on lam, at an end of it an ordinary one: nonnegative
    least squares with the coordinates so labelled, until the labels agree with the solution. In case they cycle, the
    solution of a general, less accurate solver is compared too.
    """
    label = np.zeros(wide.size)  # −1 and +1: at the lower and upper end
    candidates = []
    for _ in range(3 * wide.size + 5):
        target = low.copy()
        target[wide] += np.where(label > 0, width, 0.0)
        fitted = np.ones(low.size, dtype=bool)
        fitted[wide] = label != 0.0
        multipliers = _cone_projection(unit[:, fitted], target[fitted])
        above = (unit.T @ multipliers - low)[wide]
        shifts = np.clip(above, 0.0, width)
        candidates.append((multipliers, shifts))
        relabelled = np.where(above > width, 1.0, np.where(above < 0.0, -1.0, 0.0))
        if np.array_equal(relabelled, label):
            return multipliers, shifts
        label = relabelled
    candidates.append(_solve_bounded_least_squares(unit, low, width, wide))
    return min(candidates, key=lambda pair: _distance(unit, low, wide, *pair))


def _distance(
    unit: FloatArray, low: FloatArray, wide: NDArray[np.intp], multipliers: FloatArray, shifts: FloatArray
) -> float:
    """Return ‖low + s − Nᵀ lam‖."""
    difference = low - unit.T @ multipliers
    difference[wide] += shifts
    return float(np.linalg.norm(difference))


def _solve_bounded_least_squares(
    unit: FloatArray, low: FloatArray, width: FloatArray, wide: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """Solve the problem of `_box_projection` by a general solver."""
    from scipy.optimize import lsq_linear

    k, d = unit.shape
    columns = np.zeros((d, wide.size))
    columns[wide, np.arange(wide.size)] = -1.0
    upper = np.concatenate([np.full(k, np.inf), width])
    solution = lsq_linear(np.hstack([unit.T, columns]), low, bounds=(np.zeros(k + wide.size), upper), method="bvls").x
    return np.maximum(solution[:k], 0.0), np.clip(solution[k:], 0.0, width)
