"""Evaluated points: cost, one-sided derivatives, active constraints, optimality and multipliers.

Away from breakpoints a point is one evaluation (`Sample`); on a breakpoint with room on both sides it is two, one for
each side. Sides are those of `first_order`: +1 right, -1 left, 0 held.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.optimize import algebra
from switchfit.optimize.arrow import Hessian
from switchfit.optimize.curvature import FreeCurvature
from switchfit.optimize.equalities import Equalities

#: Equality constraints below this value, in their units, count as met.
MET = 1e-8


class Sample(NamedTuple):
    """One evaluation: cost, gradient, shape (d,), and Hessian, symmetric.

    The k >= 0 equality constraints c are in the units of `Oracle.units`, `violation` is ‖c‖₂, and the Hessian is that
    of the Lagrangian with the multipliers of the oracle.
    """

    cost: float
    gradient: FloatArray
    hessian: Hessian
    equalities: Equalities
    violation: float

    def lagrangian(self, multipliers: FloatArray) -> tuple[float, FloatArray]:
        """Return ``J + lam . c`` and its gradient (d,)."""
        c, A = self.equalities
        return self.cost + float(multipliers @ c), self.gradient + A.T @ multipliers


@dataclass(eq=False)  # frozen, one takes five times longer to make
class Point:
    """A feasible point with its one-sided derivatives and first-order conditions.

    Attributes
    ----------
    theta : array, shape (d,)
    plus, minus : Sample
        Derivatives to the right of breakpoints and to the left; the same object away from breakpoints.
    kink : array of bool, shape (d,), or None
        Coordinates on a breakpoint with room on both sides; None if there are none.
    side : array of int, shape (d,)
        The only side there is, for a coordinate on a breakpoint and a bound; otherwise 0.
    slack : array, shape (m + 2 d,)
        Of rows, lower and upper bounds.
    active : array of int
        Places of the constraints that hold with equality.
    optimality : float
    multipliers : array, shape (m + 2 d,)
    downhill : array of int, shape (d,)
        Like side, and for each kink the side to descend to, 0 to hold it.
    idle : array of bool, shape (d,), or None
        Coordinates that are held because J does not depend on them; None if there are none.
    forces : array, shape (k,)
        Multipliers of the equality constraints, by least squares.
    curvatures : dict
        Curvatures found already, by the constraints' places.
    """

    theta: FloatArray
    plus: Sample
    minus: Sample
    kink: BoolArray | None
    side: IntArray
    slack: FloatArray
    active: IntArray
    optimality: float
    multipliers: FloatArray
    downhill: IntArray
    idle: BoolArray | None
    forces: FloatArray
    curvatures: dict[bytes, FreeCurvature] = field(default_factory=dict)

    @property
    def cost(self) -> float:
        """J, which is the same on all sides."""
        return self.plus.cost

    @property
    def violation(self) -> float:
        """‖c‖₂ of the equality constraints in the units of `Oracle.units`; 0 where there are none."""
        return self.plus.violation

    def is_stationary(self, tolerance: float) -> bool:
        """Return whether the optimality is below a tolerance, and the equality constraints are met."""
        return self.optimality <= tolerance and self.violation <= MET

    @property
    def is_interior(self) -> bool:
        """Whether no constraint is active and no coordinate at a kink."""
        return self.active.size == 0 and self.kink is None

    def find_jumps(self, least: FloatArray | float) -> BoolArray:
        """Return which derivatives jump upwards at a breakpoint here by more than this: (d,)."""
        # Upwards: a convex kink, which holds its coordinate. A derivative that jumps downwards holds nothing.
        kink = np.zeros(self.theta.size, dtype=bool) if self.kink is None else self.kink
        return np.asarray(kink & (self.plus.gradient - self.minus.gradient > least))

    @property
    def largest_derivative(self) -> float:
        """Largest one-sided derivative of all unknowns, in size."""
        return algebra.largest(self.largest_slopes)

    @property
    def largest_slopes(self) -> FloatArray:
        """Larger of the two one-sided derivatives of each unknown, in size: (d,)."""
        right = np.abs(self.plus.gradient)
        return right if self.plus is self.minus else np.maximum(right, np.abs(self.minus.gradient))

    @property
    def reported_sides(self) -> IntArray:
        """The right-hand side for every coordinate on a breakpoint that has one: (d,)."""
        return self.side if self.kink is None else np.where(self.kink, 1, self.side)

    def derivatives(self, sides: IntArray) -> tuple[FloatArray, Hessian]:
        """Return the gradient and Hessian on the given sides (+1, -1; 0 for their mean).

        An entry of the Hessian that joins a left and a right coordinate is known from neither evaluation: the mean.
        """
        plus, minus = self.plus, self.minus
        if plus is minus:
            return plus.gradient, plus.hessian
        # Two evaluations serve any number of kinks, although there are 2^k pieces around k of them: to first order J is
        # separable at breakpoints (`first_order`), so that one derivative is right by what its own coordinate does.
        gradient = algebra.mix_sides(plus.gradient, minus.gradient, sides)
        return gradient, plus.hessian.mix_sides(minus.hessian, sides.astype(float))

    def equalities(self, sides: IntArray) -> Equalities:
        """Return the equality constraints with their derivatives on the given sides."""
        (c, right), left = self.plus.equalities, self.minus.equalities.jacobian
        return self.plus.equalities if right is left else Equalities(c, algebra.mix_sides(right, left, sides))
