"""Minimize a piecewise smooth cost under linear constraints and equalities; independent of differential equations."""

from switchfit.optimize.linear_constraints import LinearConstraints
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.optimize.result import IterationRecord, Result
from switchfit.optimize.sqp import minimize
from switchfit.optimize.status import Status

__all__ = ["HessianKind", "IterationRecord", "LinearConstraints", "Result", "Status", "minimize"]
