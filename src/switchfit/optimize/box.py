"""The trust region: a box around the point, in which the quadratic model of the cost is trusted.

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

from switchfit.optimize.algebra import NOISE, FloatArray, largest
from switchfit.optimize.problem import Problem

#: Radius of the first box.
FIRST_RADIUS = 1.0
#: The same where there are equality constraints, with which there always is one. The bed of poor starts is indifferent
#: to it between 5 and 40.
FIRST_CONSTRAINED_RADIUS = 5.0
#: Factors by which the radius falls after a step that the model misjudged, and grows after one that it judged well.
SHRINK, GROW = 0.25, 2.0
#: Ratios of the actual to the predicted reduction below and above which it does so.
POOR, GOOD = 0.25, 0.75


def measure(problem: Problem, step: FloatArray) -> float:
    """Return the radius of the smallest box that holds a step (d,)."""
    return largest(np.abs(step) / problem.reach)


def next_radius(
    problem: Problem, radius: float, step: FloatArray, predicted: float, before: float, after: float
) -> float:
    """Return the radius that follows an accepted step (d,) from the cost `before` to the cost `after`."""
    if predicted <= NOISE * abs(before):
        return radius
    ratio = (before - after) / predicted
    if ratio < POOR:
        return min(radius, SHRINK * measure(problem, step))
    grows = ratio > GOOD and radius < math.inf and measure(problem, step) > 0.9 * radius
    return GROW * radius if grows else radius
