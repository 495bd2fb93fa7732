"""First-order optimality: how far a gradient is from the cone of the active constraints, and the multipliers there.

References
----------
.. [1] C. L. Lawson, R. J. Hanson, Solving Least Squares Problems, SIAM 1995, chapter 23.
"""

from __future__ import annotations

import math

import numpy as np

from switchfit.optimize.algebra import FloatArray, IntArray, unit_rows


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
    # Unit rows and a gradient of size 1: the tolerances of the two projections are absolute.
    unit, lengths = unit_rows(normals)
    wide = np.flatnonzero(high > low)
    gradient, width = low / size, (high - low)[wide] / size
    multipliers = _cone_projection(unit, gradient) if wide.size == 0 else None
    if multipliers is None:
        multipliers, gradient[wide] = _box_projection(unit, gradient, width, wide)
    residual = size * float(np.linalg.norm(gradient - unit.T @ multipliers))
    return residual, size * multipliers / lengths


def _cone_projection(unit: FloatArray, gradient: FloatArray) -> FloatArray | None:
    """Return the argument of min over lam >= 0 of ‖g − Nᵀ lam‖; None where it is not found.

    SciPy's nnls is fast, but from version 1.15 on its answer may be wrong for dependent rows, and its residual with it
    (https://github.com/scipy/scipy/issues/25389), so that the answer is checked.
    """
    from scipy.optimize import nnls  # here, since importing it takes longer than most fits, which need none

    try:
        multipliers = np.asarray(nnls(unit.T, gradient, maxiter=10 * unit.shape[0] + 30)[0])
    except RuntimeError:
        return None
    pull = unit @ (gradient - unit.T @ multipliers)
    wrong = np.where(multipliers > 0.0, np.abs(pull), pull)
    return multipliers if np.all(wrong <= 1e-12 * (1.0 + np.max(multipliers))) else None


def _box_projection(
    unit: FloatArray, low: FloatArray, width: FloatArray, wide: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the arguments of min over lam >= 0 and low <= g <= low + width of ‖g − Nᵀ lam‖: lam, and g at `wide`."""
    from scipy.optimize import lsq_linear

    k, d = unit.shape
    # Unknowns (lam, s): g = low + s at the kinks, so that N' lam - s is to be near to low, 0 <= s <= width.
    columns = np.zeros((d, wide.size))
    columns[wide, np.arange(wide.size)] = -1.0
    upper = np.concatenate([np.full(k, np.inf), width])
    solution = lsq_linear(np.hstack([unit.T, columns]), low, bounds=(np.zeros(k + wide.size), upper), method="bvls").x
    return np.maximum(solution[:k], 0.0), low[wide] + np.clip(solution[k:], 0.0, width)
