"""Evaluations: cost, constraints and derivatives at one theta, and which engine computed them and why."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, Literal, TypeAlias, TypeVar

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.discretization.stiffness import Stiffness
from switchfit.runtime.presentation import format_line

Matrix = Literal["exact", "gauss-newton", "none"]
"""What to return as the Hessian: the exact one, the Gauss-Newton matrix, or NaN."""

H_co = TypeVar("H_co", covariant=True)

DenseEvaluation: TypeAlias = "Evaluation[FloatArray]"
"""With the Hessian as an array."""


def build_undefined_evaluation(D: int, m: int, row_errors: tuple[float, ...] = ()) -> DenseEvaluation:
    """Return an evaluation without numbers, of D unknowns and with m constraints."""
    gradient, hessian, c, A = (np.full(shape, np.nan) for shape in (D, (D, D), m, (m, D)))
    return Evaluation(np.nan, gradient, hessian, c, A, row_errors)


@dataclass(frozen=True)
class Engine:
    """Name of what evaluated a cost and its derivatives, and the reason.

    Attributes
    ----------
    name : str
        "native" for machine code, or "jax".
    reason : str or None
        Why JAX evaluates: the part of the problem that has no machine code. A reason that begins with "internal: " is
        a defect of switchfit, not of the model. None for machine code.
    implicit_modes : tuple of str
        The modes that take implicit steps, in any of the experiments.
    """

    name: str
    reason: str | None = None
    implicit_modes: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.reason is not None:
            return f"Evaluated by JAX: {self.reason}."
        modes = " and ".join(map(repr, self.implicit_modes))
        return f"Evaluated in machine code{f', with implicit steps in {modes}' if modes else ''}."


@dataclass(frozen=True, eq=False)
class Evaluation(Generic[H_co]):
    """Cost, constraints and their derivatives at one theta, of an experiment or of a whole problem.

    Attributes
    ----------
    cost : J
    gradient : (d,), J's derivative in theta
    hessian : (d, d)
        Of J; where constraints were evaluated with multipliers, of ``J + multipliers . constraints``. Inside the
        optimizer, of many runs an arrow-shaped matrix.
    constraints, jacobian : (m,), (m, d)
        Guards and terminal constraints, in the order of ``problem.constraint_names``, and their derivatives in theta.
        Empty if the problem has none.
    row_errors : tuple of float
        Of each experiment the largest error of a row, relative to the largest value of its state on the first
        trajectory on this mesh; NaN if its engine has none, empty where none was asked for. The estimate compares the
        method of order 5 with one of order 3: on the same stages, or, in implicit rows, with the slope before the row,
        as Hairer and Wanner do. Where a row is fine, it is far larger than the error.
    stiffness : tuple of Stiffness
        From `evaluate`: each mode of each experiment in which ``solver="auto"`` chose implicit steps, and why; empty if
        there is none.

    See Also
    --------
    evaluate, GuardedEvaluation

    Examples
    --------
    >>> problem = heater_problem()

    >>> evaluation = sf.evaluate(problem)
    >>> evaluation.gradient.shape, evaluation.hessian.shape
    ((2,), (2, 2))
    """

    cost: float
    gradient: FloatArray
    hessian: H_co
    constraints: FloatArray = field(default_factory=lambda: np.zeros(0))
    jacobian: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    row_errors: tuple[float, ...] = ()
    stiffness: tuple[Stiffness, ...] = ()

    def __repr__(self) -> str:
        return format_line(self, f"J = {self.cost:.9g}", f"{len(self.gradient)} unknowns")
