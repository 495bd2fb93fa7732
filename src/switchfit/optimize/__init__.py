"""Minimize a piecewise smooth cost under linear constraints and equalities; independent of differential equations."""

from switchfit.optimize.problem import HessianKind
from switchfit.optimize.qp import LinearConstraints
from switchfit.optimize.sqp import minimize
from switchfit.optimize.state import IterationRecord, Result, Status

__all__ = ["HessianKind", "IterationRecord", "LinearConstraints", "Result", "Status", "minimize"]
