"""The Hessian scaled to unit curvature of each unknown: its spectrum, and its inverse on free directions.

``S H S`` with ``S = diag(H)^(-1/2)`` does not depend on units. Eigenvalues up to rounding belong to directions that the
data do not determine, and unknowns with a component in such a direction have no variance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.optimize.threads import one_thread

LEAST_DETERMINED_EIGENVALUE = 1e-14
"""Eigenvalue of the Hessian, scaled to a diagonal of one, up to which a direction is not determined."""

LEAST_COMPONENT = 1e-6
"""Component of an unknown in such a direction above which the unknown has no standard error."""


def inverse_on(Z: FloatArray, hessian: FloatArray) -> FloatArray:
    """Return ``Z (Z' H Z)^-1 Z'``: (d, d); NaN if H is not finite, or not positive definite on Z (d, k).

    If it is not positive definite in some directions, only unknowns with a component in these are NaN. For the others
    the pseudo-inverse is used: if one of many runs is not determined, the other runs keep their variances.
    """
    if not np.isfinite(hessian).all():
        return np.full(hessian.shape, np.nan)
    values, vectors, size = compute_scaled_spectrum(hessian, Z)
    kept = values > LEAST_DETERMINED_EIGENVALUE
    root = size[:, None] * vectors[:, kept] / np.sqrt(values[kept])
    inverse: FloatArray = root @ root.T
    part = np.abs(vectors[:, ~kept]).max(axis=1, initial=0.0)
    unknown = ~(part <= LEAST_COMPONENT * np.linalg.norm(vectors, axis=1))
    inverse[unknown] = np.nan
    inverse[:, unknown] = np.nan
    return inverse


def moves_by_itself(basis: FloatArray) -> NDArray[np.bool_]:
    """Return which unknowns may change alone, others being as they are: (d,); of an orthonormal basis (d, k)."""
    return np.asarray(np.sum(basis**2, axis=1) > 1.0 - LEAST_COMPONENT)


@one_thread()
def compute_scaled_spectrum(hessian: FloatArray, Z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return eigenvalues (k,), ascending, and eigenvectors (d, k) of a Hessian (d, d) scaled to unit curvature of each
    unknown, on the directions Z (d, k), which need not be orthonormal; and the scaling (d,): an eigenvector times it is
    a direction in theta.

    Eigenvalues of the size of rounding, whose digits differ from processor to processor, are 0. NaN if the Hessian is
    not finite, or its numbers are near the limits of float64.
    """
    diagonal = np.abs(np.diag(hessian))
    size = 1 / np.sqrt(np.where(diagonal > np.finfo(float).tiny, diagonal, 1.0))
    basis = np.linalg.qr(Z / size[:, None])[0]
    basis[~Z.any(axis=1)] = 0.0  # exactly, for what is held
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = basis.T @ (hessian * np.outer(size, size)) @ basis
    if not np.isfinite(scaled).all():
        return np.full(len(scaled), np.nan), np.full(basis.shape, np.nan), size
    values, vectors = np.linalg.eigh(scaled)
    rounding = len(values) * np.finfo(float).eps * np.abs(values).max(initial=0.0)
    return np.where(np.abs(values) > rounding, values, 0.0), basis @ vectors, size
