"""Names of arrays by what they hold; the letters of shapes mean the same everywhere.

d unknowns, n states, m parameters of a mode, q outputs, K samples or nodes, R rows of the mesh, D directions along
which derivatives are taken, E experiments, N transitions. Every room may import this module, which imports none.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.intp]
BoolArray: TypeAlias = NDArray[np.bool_]

Theta: TypeAlias = FloatArray
"""All unknowns, or one number for each of them, such as a gradient or a step: (d,)."""

SquareMatrix: TypeAlias = FloatArray
"""A Hessian, a covariance, a Gauss-Newton matrix: (d, d)."""

Traced: TypeAlias = Any
"""What generic code computes with: an array of NumPy or JAX, a tracer, or an object array of nodes of a graph. These
have no common type; they have the operators of arrays."""

ArrayModule: TypeAlias = Any
"""The module that computes with them, ``xp``: `numpy`, `jax.numpy`, or the namespace of a graph of scalars."""

Converted: TypeAlias = Any
"""A field of a dataclass that takes what users give, in every form that its docstring lists, and holds one checked form
once the object is built: the comment beside the field says which."""
