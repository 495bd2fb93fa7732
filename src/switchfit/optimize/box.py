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

from switchfit.optimize.algebra import FloatArray, largest
from switchfit.optimize.direction import Direction, Piece, find_direction
from switchfit.optimize.problem import Problem
from switchfit.optimize.state import State

#: Factors by which the radius falls after a step that the model misjudged, and grows after one that it judged well.
SHRINK, GROW = 0.25, 2.0
#: Ratios of the actual to the predicted reduction below and above which it does so.
POOR, GOOD = 0.25, 0.75
#: Steps are tried inside the present smooth piece where they cross fewer breakpoints than this.
MANY_BREAKPOINTS = 3
MAX_BACKTRACKS = 60


def measure(problem: Problem, step: FloatArray) -> float:
    """Return the radius of the smallest box that holds a step (d,)."""
    return largest(np.abs(step) / problem.reach)


def next_radius(
    problem: Problem, direction: Direction, decrease: float, predicted: float, noise: float, shrink: float = SHRINK
) -> float:
    """Return the radius that follows an accepted step, from the actual and the predicted decrease and their error."""
    radius = direction.radius
    if predicted <= noise:
        return radius
    ratio = decrease / predicted
    if ratio < POOR:
        return min(radius, shrink * measure(problem, direction.step))
    grows = ratio > GOOD and radius < math.inf and measure(problem, direction.step) > 0.9 * radius
    return GROW * radius if grows else radius


def shrink_region(
    problem: Problem, state: State, direction: Direction, piece: Piece | None, shrink: float = SHRINK
) -> tuple[Direction, Piece | None]:
    """Return the direction after one that failed: in a smaller trust region, and the smooth piece that it keeps to.

    A step that failed across few breakpoints is tried in the present smooth piece before the region shrinks.
    """
    theta, radius = state.point.theta, direction.radius
    if piece is None and 0 < problem.breakpoints.count_crossed(theta, direction.step) < MANY_BREAKPOINTS:
        piece = problem.breakpoints.piece(theta, problem.constraints)
    else:
        radius = shrink * measure(problem, direction.step)
    return find_direction(problem, state._replace(radius=radius), piece), piece
