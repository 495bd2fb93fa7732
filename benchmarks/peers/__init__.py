"""Other libraries on the same models, one file each, used as their documentation recommends.

Those for derivatives have ``LADDER``, settings (loose to tight), and ``build(model, setting, ...) -> Functions``;
`side_by_side.py` takes the loosest setting that is accurate enough. Those for whole fits are `casadi_collocation` and
`scipy_fits`. Nothing here imports switchfit; diffrax is given the vector fields that switchfit is given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

Gradient = Callable[[np.ndarray], tuple[float, np.ndarray]]
Hessian = Callable[[np.ndarray], tuple[float, np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Functions:
    """What a library offers for one model: J, (J, gradient), (J, gradient, Hessian) of theta; None where it cannot."""

    setting: str
    cost: Callable[[np.ndarray], float] | None
    gradient: Gradient | None
    hessian: Hessian | None


def symmetric(d: int, pairs: list[tuple[int, int]], values: Any) -> np.ndarray:
    """The (d, d) matrix with `values` at `pairs` and their mirror images."""
    matrix = np.zeros((d, d))
    for (i, j), value in zip(pairs, values, strict=True):
        matrix[i, j] = matrix[j, i] = value
    return matrix
