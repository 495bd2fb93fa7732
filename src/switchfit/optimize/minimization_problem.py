"""The minimization problem: the caller's function, linear constraints, breakpoints and settings.

It is all that the optimizer knows of its caller: theta is a vector, J a function that returns numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.optimize.breakpoints import Breakpoints
from switchfit.optimize.linear_constraints import LinearConstraints

HessianKind = Literal["auto", "exact", "descent-first", "block-diagonal", "gauss-newton", "none"]
"""Matrix of the quadratic program:

- "auto": the exact Hessian inside a trust region (`trust_region`);
- "exact": the exact Hessian, made positive definite where needed, with a line search;
- "descent-first": the exact Hessian where it is positive definite, and steepest descent until then (Section II-A of the
  paper);
- "block-diagonal": "exact" without the entries between different blocks;
- "gauss-newton": "exact", for a caller whose evaluations return the Gauss-Newton matrix;
- "none": steepest descent in the metric of theta, as in the paper.
"""

Evaluate = Callable[..., Any]
"""``evaluate(theta, side)`` returns ``cost`` J, ``gradient`` (d,), and ``hessian``: (d, d), an `Arrow`, or None.

`side` is +1 or -1: the one-sided derivatives to return for coordinates that sit exactly on a breakpoint. If the
Hessian is an `Arrow`, the time of an iteration is linear in d. A cost or derivative that is not finite makes a point
unacceptable. With equality constraints c, ``evaluate(theta, side, multipliers)`` returns these too, ``constraints``
(k,), with their derivatives, ``jacobian`` (k, d); the Hessian is that of the Lagrangian ``J + multipliers . c``.
"""

Idle = Callable[[FloatArray, bool], BoolArray]
"""``idle(theta, everything)`` returns which coordinates, (d,), may be held at a theta with active rows.

J depends on none of them while these rows are active, whatever their derivatives are, which have the error of the
evaluation. Unless `everything`, only those that are found without an evaluation are needed.
"""


@dataclass(frozen=True, eq=False)
class MinimizationProblem:
    """A problem with its settings, which the caller has checked.

    Attributes
    ----------
    evaluate : callable
        Cost, gradient and Hessian, and equality constraints if there are any.
    constraints : LinearConstraints
        ``A theta >= b`` and bounds.
    breakpoints : Breakpoints
    hessian : HessianKind
    labels : array, shape (d,), or None
        Labels of the blocks, where the Hessian is cut into blocks ("block-diagonal").
    tolerance : float
        Bound on the KKT residual. Unless `hessian` is "none", the next step has to be negligible too: at most 1e-10 of
        the size of each unknown, or a few iterations later.
    max_iterations : int
    size : array, shape (d,)
        Typical size of each unknown, to which rounding errors are relative; zero if only its values are known. For a
        time this is the length of the horizon, even if the time itself is small.
    idle : callable or None
        Finds the coordinates on which J does not depend.
    reach : array, shape (d,)
        Largest change of each unknown in the first step inside a trust region.
    equalities : tuple of str
        Names of the equality constraints c(theta) = 0; empty if there are none.
    accuracy : callable or None
        Returns the relative accuracy of J, which may be known only after some evaluations: the minimum is found where
        less is to be gained. None where it is that of rounding.
    """

    evaluate: Evaluate
    constraints: LinearConstraints
    breakpoints: Breakpoints
    hessian: HessianKind
    labels: FloatArray | None
    tolerance: float
    max_iterations: int
    size: FloatArray
    idle: Idle | None
    reach: FloatArray
    equalities: tuple[str, ...]
    accuracy: Callable[[], float] | None

    @property
    def has_region(self) -> bool:
        """Whether steps are searched for in a trust region, in which equality constraints always are."""
        return self.hessian == "auto" or bool(self.equalities)

    @property
    def uses_hessian(self) -> bool:
        """Whether the quadratic programme uses the Hessian."""
        return self.hessian != "none"

    def rows_hold(self, active: IntArray) -> bool:
        """Return whether rows are among the active constraints, and not bounds alone; these are in ascending order."""
        return bool(active.size and active[0] < self.constraints.b.size)
