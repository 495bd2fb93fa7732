"""Change between theta and the optimizer's variables, which are logarithms for unknowns on such a scale.

Constraints, breakpoints and derivatives go into the variables, and the optimizer's records and result come back in
theta. A transition time that is at a node in one is exactly at that node in the other.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Evaluation
from switchfit.meshes.evaluator import Evaluator
from switchfit.optimize import IterationRecord, LinearConstraints, Result
from switchfit.optimize.arrow import Arrow
from switchfit.optimize.breakpoints import Breakpoints
from switchfit.optimize.result import LineSearchFailure
from switchfit.problem.variables import Variables


@np.errstate(divide="ignore", over="ignore", invalid="ignore")  # a point whose derivatives are not finite is refused
def convert_to_variables(variables: Variables, theta: FloatArray, here: Any, multipliers: FloatArray | None) -> Any:
    """Convert an evaluation at theta, of constraints too if there are multipliers, to the optimizer's variables."""
    # D = dtheta/dz and E = d2theta/dz2, each for itself: J_zz = D J'' D + diag(E J').
    D, E = variables.slopes(theta)
    if isinstance(here.hessian, Arrow):
        hessian = here.hessian.scale(1.0 / D).plus_diagonal(E * here.gradient)
        return replace(here, gradient=D * here.gradient, hessian=hessian)
    if multipliers is None:
        return Evaluation(here.cost, *variables.derivatives_inward(theta, here.gradient, here.hessian))
    # The second derivative of theta(z) multiplies the slope of the Lagrangian, whose Hessian this is.
    slope = here.gradient + multipliers @ here.jacobian
    hessian = variables.derivatives_inward(theta, slope, here.hessian)[1]
    return replace(here, gradient=D * here.gradient, hessian=hessian, jacobian=here.jacobian * D)


class ChangeOfVariables(NamedTuple):
    """The change between theta and the optimizer's variables z in one problem.

    Attributes
    ----------
    variables : Variables
    constraints : LinearConstraints
        Of theta.
    breakpoints : Breakpoints
        Of the variables.
    nodes : dict of int -> two (K,) arrays
        For times on a logarithmic scale, the breakpoints of z and what these are in theta: a transition is at a node
        where z is at its breakpoint, and not beside it by the rounding of a logarithm.
    log_rows : list of (row, (d,))
        Rows of the constraints that join times on a logarithmic scale, and which.
    """

    variables: Variables
    constraints: LinearConstraints
    breakpoints: Breakpoints
    nodes: dict[int, tuple[FloatArray, FloatArray]]
    log_rows: list[tuple[int, NDArray[np.intp]]]

    @classmethod
    def of(cls, evaluator: Evaluator, constraints: LinearConstraints) -> ChangeOfVariables:
        """Return the change of the variables of an evaluator's problem."""
        variables, log_times = evaluator.problem.unknowns.variables, evaluator.problem.unknowns.log_times
        if not log_times.any():
            return cls(variables, constraints, evaluator.sorted_breakpoints, {}, [])
        points, nodes = evaluator.breakpoints(), {}
        for i in np.flatnonzero(log_times).tolist():
            away = points[i] - variables.origin[i]
            # Nodes that are nearer to each other than their logarithms tell are one breakpoint, that of the first.
            logs, first = np.unique(np.log(away[away > 0]), return_index=True)
            points[i], nodes[i] = logs, (logs, points[i][away > 0][first])
        joined = (constraints.A != 0) & log_times
        rows = [(k, np.flatnonzero(joined[k])) for k in np.flatnonzero(joined.any(axis=1)).tolist()]
        return cls(variables, constraints, Breakpoints.of(points), nodes, rows)

    def to_theta(self, z: FloatArray) -> FloatArray:
        """Return theta at z, inside its bounds whatever the rounding, and on the nodes that z is on."""
        theta = np.asarray(np.clip(self.variables.outward(z), self.constraints.lower, self.constraints.upper))
        for i, (logs, nodes) in self.nodes.items():
            k = int(np.searchsorted(logs, z[i]))
            # Bit for bit: a transition beside its node by the rounding of exp would take the other one-sided
            # derivative.
            if k < len(nodes) and logs[k] == z[i]:
                theta[i] = nodes[k]
        return theta

    def convert_constraints(self, sizes: FloatArray) -> LinearConstraints:
        """Return the constraints on z, which are linear too.

        The order of two times is that of their logarithms. A time that comes after or before a fixed one has a bound;
        behind t0, whose logarithm is minus infinity, it is at least what rounding leaves of the clock, a part of its
        size (d,).
        """
        given = self.constraints
        lower, upper = self.variables.inward(given.lower), self.variables.inward(given.upper)
        b = given.b.copy()
        for k, where in self.log_rows:
            if len(where) == 1:
                i, sign = int(where[0]), float(given.A[k, where[0]])
                rounding = float(np.finfo(float).eps * sizes[i])
                b[k] = sign * np.log(max(sign * given.b[k] - self.variables.origin[i], rounding))
        return replace(given, b=b, lower=lower, upper=upper)

    def convert_record(self, record: IterationRecord) -> IterationRecord:
        """Return a record of the optimizer's with theta in place of its own variables."""
        return replace(record, theta=self.to_theta(record.theta))

    def convert_result(self, result: Result) -> Result:
        """Return the optimizer's result in theta; its optimality and its eigenvalues stay those of its own variables.

        Of times that are joined by a row that holds with equality, all are equal, and so are their slopes.
        """
        theta = self.to_theta(result.theta)
        slopes = self.variables.slopes(theta)[0]
        rows = np.ones(len(self.constraints.b))
        for k, where in self.log_rows:
            rows[k] = slopes[where[0]]
        gradient, hessian = self.variables.derivatives_outward(theta, result.gradient, result.hessian)
        history = tuple(self.convert_record(record) for record in result.history)
        find = result.explain
        return replace(
            result,
            theta=theta,
            gradient=gradient,
            hessian=hessian,
            history=history,
            multipliers=result.multipliers / np.concatenate([rows, slopes, slopes]),
            kinks=tuple((i, left / float(slopes[i]), right / float(slopes[i])) for i, left, right in result.kinks),
            explain=find and cache(lambda: self._convert_finding(result.theta, find())),
        )

    def _convert_finding(self, z: FloatArray, found: LineSearchFailure) -> LineSearchFailure:
        """Return why the line search failed, in theta instead of the variables z (d,)."""
        moved = ((i, np.where(np.arange(len(z)) == i, value, z)) for i, value in found.places)
        return found._replace(places=tuple((i, float(self.variables.outward(there)[i])) for i, there in moved))


def convert_constrained(evaluator: Evaluator, result: Result) -> Result:
    """Return a result of the optimizer's variables with the Hessian and the free directions that it has in theta.

    Both mix what bends the change of variables with what bends the constraints.
    """
    here = evaluator.constrained(result.theta, 1, [multiplier for _, _, multiplier in result.equalities])
    slopes = evaluator.problem.unknowns.variables.slopes(result.theta)[0]
    basis = np.linalg.qr(slopes[:, None] * result.free_basis)[0]
    return replace(result, hessian=here.hessian, curvature=replace(result.curvature, basis=basis))
