"""Formulas that the SQP shares with its traced version: constraints at a point, scales, and when a step is accepted.

Each is written once, for NumPy and for JAX: ``xp`` is the module whose arrays it is given, and constraints are anything
with ``A`` (m, d), ``b`` (m,), ``lower`` and ``upper`` (d,). What needs sets of changing size, or stops early, cannot be
traced; there the two programs differ, and `traced_qp`, `traced_sqp` say at each place why.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapter 3.
.. [2] W. W. Hager, H. Zhang, A new conjugate gradient method with guaranteed descent and an efficient line search,
   SIAM J. Optim. 16 (2005) 170-192.
.. [3] D. Ruiz, A scaling algorithm to equilibrate both rows and columns norms in matrices, Report RAL-TR-2001-034,
   Rutherford Appleton Laboratory 2001.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from switchfit.arrays import ArrayModule, FloatArray, Traced

EPS = float(np.finfo(np.float64).eps)

# The bed that comments here speak of: 40 costs of 2 to 6 unknowns, quartic and indefinite, with up to 40 convex and
# concave kinks each, drawn as `test_nonconvex_costs_with_kinks_of_all_sizes` draws them.

#: Eigenvalues of the diagonally scaled Hessian below this count as zero: what they are is rounding, whose digits differ
#: from one processor to the next, and a status must not.
EIGENVALUE_FLOOR = 1e-10

#: What such an eigenvalue is replaced by in the quadratic programme: a step along it is ten thousand times as long as
#: one along a usual eigenvalue with the same slope. The bed is indifferent to it from 1e-9 to 1e-2.
EIGENVALUE_REPLACEMENT = 1e-4

#: Fraction of the predicted linear decrease that a step must achieve (Armijo; [1]_, section 3.1). Newton's steps
#: achieve half of it near a minimum: the fraction has to be less, and hardly matters.
ARMIJO = 1e-4

#: The same for a step across a breakpoint, where the prediction may be wrong however short the step: with the fraction
#: above, a step may be accepted that hops over a kink and gains a ten-thousandth of what it would before it.
ARMIJO_ACROSS = 0.1

#: The same for steepest descent, whose steps cross a narrow valley from side to side if they may: 15 fits of the bed
#: take 812 evaluations, 880 with 0.1, and with 1e-4 one of them takes more than 9,000.
ARMIJO_DESCENT = 0.4

#: Differences of costs below this part of the cost say nothing: where residuals are small beside what is measured, the
#: rounding of a sum of their squares is a few hundred units, and a search by costs takes many short steps at the end.
#: Twelve such fits take 188 evaluations, 202 with 32 units in place of 4096. With 1e-10, steepest descent takes a
#: quarter more on the bed.
COST_NOISE = 4096 * EPS

#: A step below this part of the unknowns' size is negligible: Newton's next one would be of the size of its square.
NEGLIGIBLE_STEP = 1e-10

#: Iterations spent on making the last step negligible once the optimality is below the tolerance: the tolerance of a
#: badly scaled cost may be met far from its minimum. Newton's steps are negligible after one or two; where the Hessian
#: is singular they never are.
EXTRA_ITERATIONS = 5

#: Newton steps up to this multiple of the unknowns' size are never shortened by changing the Hessian: a start may be
#: wrong by a factor of hundreds. What is longer is a slope divided by rounding.
LONGEST_STEP = 1e3

#: Sizes below this count as unknown: their squares vanish.
SMALLEST_KNOWN_SIZE = 1e-150

#: Steps are tried inside the present smooth piece where they cross fewer breakpoints than this. One that crosses many
#: is halved before: a piece is then so short that the programme in it says nothing of the step as a whole. The bed
#: takes 393 evaluations, and 454 where each step that fails is tried inside; where none is, it does not end in five
#: times the time.
MANY_BREAKPOINTS = 3

#: Smaller jumps of a derivative, beside the largest one seen, are rounding: of two evaluations at one point that differ
#: in the sides, which add up the same terms in another order.
SMALLEST_JUMP = 1e-12

#: Rounds of equilibration after which the scaling of an indefinite matrix is good enough. Each round halves the
#: logarithm of what a row's largest entry is off ([3]_): from entries of 1e6, twenty leave one part in 1e5.
EQUILIBRATIONS = 20

#: Largest entry of a row with which equilibration ends; a semi-definite matrix has it from Jacobi's scaling.
EQUILIBRATED = 1.0 + 1e-9


class _Inequalities(Protocol):
    """``A theta >= b`` and ``lower <= theta <= upper``, in arrays of NumPy or JAX."""

    @property
    def A(self) -> Traced: ...
    @property
    def b(self) -> Traced: ...
    @property
    def lower(self) -> Traced: ...
    @property
    def upper(self) -> Traced: ...


def is_finite(array: FloatArray) -> bool:
    """Return whether all entries of an array are finite."""
    return np.count_nonzero(np.isfinite(array)) == array.size


def norm(vector: FloatArray) -> float:
    """Return the length of a vector (d,); `np.linalg.norm` takes five times longer on a short one."""
    return math.sqrt(vector.dot(vector))


def largest(vector: FloatArray) -> float:
    """Return the largest entry of a vector (d,), d > 0, without NaN; `vector.max()` takes six times longer on three."""
    return float(max(vector.tolist()))


def smallest(vector: FloatArray) -> float:
    """Return the smallest entry of a vector (d,), d > 0, without NaN."""
    return float(min(vector.tolist()))


# --- constraints at a point -------------------------------------------------------------------------------------------


def slack(constraints: _Inequalities, theta: Traced, xp: ArrayModule = np) -> Traced:
    """Return how far theta (d,) is inside rows, lower and upper bounds: (m + 2 d,); negative where violated."""
    rows = constraints.A.dot(theta) - constraints.b
    return xp.concatenate([rows, theta - constraints.lower, constraints.upper - theta])


def is_active(slack: Traced, size: Traced, abs_A: Traced, abs_b: Traced, xp: ArrayModule = np) -> Traced:
    """Return which constraints hold with equality up to the rounding of the rows: (m + 2 d,) of bool.

    Parameters
    ----------
    slack : (m + 2 d,)
    size : (d,)
        Sizes of the unknowns, of which rounding is a part.
    abs_A, abs_b : (m, d), (m,)
        Absolute values of the constraints' rows and right-hand sides.
    """
    # Products and a sum of numbers of the unknowns' size; bounds are compared as they are, since `feasibility.move`
    # puts unknowns on them bit for bit.
    rounding = 16 * EPS * (abs_b + abs_A @ size)
    return slack <= xp.concatenate([rounding, xp.zeros(2 * size.shape[0])])


def project_on_row(
    theta: Traced, normal: Traced, bound: Traced, movable: Traced, xp: ArrayModule = np
) -> tuple[Traced, Traced]:
    """Return the violation of the row ``normal . theta >= bound``, and theta moved onto it, an ulp to its inside.

    Parameters
    ----------
    theta, normal : (d,)
    bound : ()
    movable : (d,)
        The normal with zeros for what must stay where it is.
    """
    violation = bound - normal @ theta
    # An ulp to the inside: on the row itself, rounding decides on which side of it the slack is computed to be.
    margin = EPS * (xp.abs(normal) @ xp.abs(theta))
    square = movable @ movable
    return violation, theta + movable * ((violation + margin) / xp.where(square > 0.0, square, 1.0))


def unit_rows(rows: Traced, xp: ArrayModule = np) -> tuple[Traced, Traced]:
    """Return rows (k, d) of unit length, and their lengths (k,); a row of zeros stays one, with the length 1."""
    lengths = xp.sqrt((rows * rows).sum(1))
    lengths = xp.where(lengths > 0.0, lengths, 1.0)
    return rows / lengths[:, None], lengths


# --- scales -----------------------------------------------------------------------------------------------------------


def _replace_small(scale: Traced, least: float, other: float, xp: ArrayModule) -> Traced:
    """Return sizes (d,) with `other` in place of those that are not above the least."""
    if xp is np and smallest(scale) > least:  # mostly, and four times faster
        return scale
    return xp.where(scale > least, scale, other)


def flatness(scale: Traced, cost_scale: Traced, xp: ArrayModule = np) -> Traced:
    """Return diagonal Hessian entries so small that changing an unknown by its size changes J by rounding only: (d,).

    Parameters
    ----------
    scale : (d,)
        Sizes of the unknowns; zero where none is known.
    cost_scale : float
        Size of J.
    """
    # Of an unknown that has been 0 so far no size is known: infinity leaves 0 for its diagonal entry, and all curvature
    # counts.
    size = _replace_small(scale, SMALLEST_KNOWN_SIZE, xp.inf, xp)
    return (EPS * cost_scale) / (size * size)


def curvature_floor(scale: Traced, cost_scale: Traced, slopes: Traced, xp: ArrayModule = np) -> Traced:
    """Return the curvature below which an unknown's counts as none: (d,).

    Where J is nearly linear in an unknown, with a derivative of the size `slopes` (d,), its step is limited too.
    """
    size = _replace_small(scale, 0.0, 1.0, xp)
    return xp.maximum(flatness(scale, cost_scale, xp), slopes / (LONGEST_STEP * size))


def jacobi_scaling(diagonal: Traced, largest_in_rows: Traced, xp: ArrayModule = np) -> Traced:
    """Return the root of a matrix's diagonal (d,); where it is not positive, of the row's largest entry, or 1: (d,)."""
    square = xp.where(diagonal > 0.0, diagonal, xp.where(largest_in_rows > 0.0, largest_in_rows, 1.0))
    return xp.sqrt(square)


def equilibrate(scaling: Traced, largest_in_rows: Traced, xp: ArrayModule = np) -> Traced:
    """Return a scaling (d,) grown where the rows of the matrix scaled by it have entries above 1."""
    return scaling * xp.sqrt(xp.maximum(largest_in_rows, 1.0))


def positive_eigenvalues(values: Traced, xp: ArrayModule = np) -> Traced:
    """Return eigenvalues with those that are not positive replaced by their absolute values, or more."""
    # Along negative curvature a step descends as far as it would along positive curvature of the same size ([1]_,
    # section 3.4).
    replaced = xp.maximum(xp.abs(values), EIGENVALUE_REPLACEMENT)
    return xp.where(values > EIGENVALUE_FLOOR, values, replaced)


def is_negligible(step: Traced, scale: Traced, xp: ArrayModule = np) -> Traced:
    """Return whether a step (d,) is negligible beside unknowns of the size (d,)."""
    return xp.all(xp.abs(step) <= NEGLIGIBLE_STEP * scale)


def mix_sides(right: Traced, left: Traced, sides: Traced, xp: ArrayModule = np) -> Traced:
    """Return what is found on the right where the side is positive, on the left where it is negative, else the mean."""
    return xp.where(sides > 0, right, xp.where(sides < 0, left, 0.5 * (right + left)))


def find_least_jump(curvature: Traced, slopes: Traced, cost: Traced, xp: ArrayModule = np) -> Traced:
    """Return by how much a derivative of J jumps at least at a kink that holds an unknown: (d,).

    Smaller jumps are rounding, or what integration makes at nodes that are no kinks of the model: without the jump J
    would be lower by ``jump^2 / (2 curvature)`` at most, which is below its noise.

    Parameters
    ----------
    curvature : (d,)
        Second derivatives of J; those that are not positive, or NaN, count as 0.
    slopes, cost : float
        The largest derivative seen, and J.
    """
    return xp.maximum(SMALLEST_JUMP * slopes, xp.sqrt(2.0 * COST_NOISE * xp.abs(cost) * xp.fmax(curvature, 0.0)))


def choose_sides(left: Traced, right: Traced, xp: ArrayModule = np) -> Traced:
    """Return the side to which each coordinate at a kink descends by itself, given its derivatives (d,): (d,) int.

    It is held, 0, where 0 is in [g₋, g₊]; else it goes where the descent is steeper, −g₊ to the right and g₋ to the
    left.
    """
    return xp.where((left <= 0.0) & (right >= 0.0), 0, xp.where(-right >= left, 1, -1))


# --- when a step is accepted ------------------------------------------------------------------------------------------
# Where the predicted decrease is below the rounding error of J, comparing costs says nothing ([2]_):
# then a smaller KKT residual counts, or a cost below every earlier one.


def cost_allows(
    cost: Traced, before: Traced, lowest: Traced, decrease: Traced, noise: Traced, fraction: Traced
) -> Traced:
    """Return whether a trial's cost allows it, its optimality aside.

    Parameters
    ----------
    cost, before, lowest : float
        J at the trial, at the point it starts from, and the lowest so far.
    decrease, noise : float
        Predicted linear decrease, and the rounding error of J.
    fraction : float
        Of the decrease, which has to be achieved.
    """
    return (cost <= lowest + noise) & ((decrease <= noise) | (cost <= before - fraction * decrease))


def optimality_allows(
    optimality: Traced, before: Traced, cost: Traced, lowest: Traced, decrease: Traced, noise: Traced
) -> Traced:
    """Return whether a trial's optimality allows it: it has to fall where costs are not compared."""
    return (decrease > noise) | (optimality < before) | (cost < lowest)
