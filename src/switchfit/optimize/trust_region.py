"""Trust region: the radius of the box around a point in which the quadratic model of the cost is trusted.

Far from the solution the Hessian is often indefinite. Where eigenvalues are replaced by their absolute values, a line
search along the step goes far in directions in which the model says nothing. Inside a trust region the Hessian is
shifted instead, in the metric of the region, until it is positive definite ([1]_, section 4.3), and no unknown moves
further than a radius times its `reach`. The radius follows from how well the model predicted the last step ([1]_,
algorithm 4.1). The region is a box, for then it adds nothing but bounds to the quadratic programme. As long as the
Hessian is positive definite and its steps succeed, there is no box.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapter 4.
"""

from __future__ import annotations

import math

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.optimize import algebra
from switchfit.optimize.minimization_problem import MinimizationProblem
from switchfit.optimize.search_direction import SearchDirection

#: Factors by which the radius falls after a step that the model misjudged, and grows after one that it judged well.
SHRINK, GROW = 0.25, 2.0

#: The first of them where there are equality constraints.
CONSTRAINED_SHRINK = 0.5

#: Ratios of the actual to the predicted reduction below and above which it does so.
POOR, GOOD = 0.25, 0.75


def measure_in_box(problem: MinimizationProblem, step: FloatArray) -> float:
    """Return the radius of the smallest box that holds a step (d,)."""
    return algebra.largest(np.abs(step) / problem.reach)


def get_shrink_factor(problem: MinimizationProblem) -> float:
    """Return the factor by which a refused step shrinks the trust region."""
    return CONSTRAINED_SHRINK if problem.equalities else SHRINK


def next_radius(
    problem: MinimizationProblem, direction: SearchDirection, decrease: float, predicted: float, noise: float
) -> float:
    """Return the radius that follows an accepted step, from the actual and the predicted decrease and their error."""
    radius = direction.radius
    # A ratio of two numbers that are rounding says nothing about the model.
    if predicted <= noise or not problem.has_region:
        return radius
    ratio = decrease / predicted
    if ratio < POOR:
        return min(radius, get_shrink_factor(problem) * measure_in_box(problem, direction.step))
    # It grows only where the region has cut the step: the model was good there, which says nothing about how good it is
    # farther out ([1]_, algorithm 4.1).
    grows = ratio > GOOD and radius < math.inf and measure_in_box(problem, direction.step) > 0.9 * radius
    return GROW * radius if grows else radius
