"""Second derivatives of the cost of a hypothesis: without artificial terms, and inverted.

The diagonal of H has terms that are no knowledge: what a birth begins with, and weak ones of parameters without a
prior. Errors follow from the inverse without them, infinite where the samples say nothing.
"""

from __future__ import annotations

import numpy as np

from switchfit.arrays import FloatArray

LEFT_BY_ROUNDING = 1e-9
"""Part of the artificial terms of H below which what is left without them is rounding."""


def drop_artificial(matrix: FloatArray, artificial: FloatArray) -> FloatArray:
    """Return H (D, D) without artificial terms (D,) of its diagonal; zeros where nothing else is left."""
    matrix = matrix - np.diag(artificial)
    nothing = np.diag(matrix) <= LEFT_BY_ROUNDING * artificial
    matrix[nothing], matrix[:, nothing] = 0.0, 0.0
    return matrix


def invert(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a matrix (D, D) of second derivatives, with an infinite diagonal where it is singular."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    there = np.flatnonzero(scale)
    found = np.diag(np.where(scale > 0, 0.0, np.inf))
    # Scaled to a unit diagonal: unknowns differ by many decades, and an inverse would lose the small ones.
    sizes = np.outer(scale[there], scale[there])
    try:
        found[np.ix_(there, there)] = np.linalg.inv(matrix[np.ix_(there, there)] / sizes) / sizes
    except np.linalg.LinAlgError:
        found[there, there] = np.inf
    diagonal = np.diag(found)
    np.fill_diagonal(found, np.where(diagonal > 0, diagonal, np.inf))
    return found
