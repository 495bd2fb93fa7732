"""Minimisation of a piecewise smooth cost under linear constraints; knows nothing of differential equations."""

from switchfit.optimize.augmented import ConstrainedResult, minimize_constrained
from switchfit.optimize.constraints import LinearConstraints
from switchfit.optimize.problem import Evaluation, HessianKind
from switchfit.optimize.qp import QPSolution, solve_qp
from switchfit.optimize.sqp import minimize
from switchfit.optimize.status import IterationRecord, Result, Status

__all__ = [
    "ConstrainedResult",
    "Evaluation",
    "HessianKind",
    "IterationRecord",
    "LinearConstraints",
    "QPSolution",
    "Result",
    "Status",
    "minimize",
    "minimize_constrained",
    "solve_qp",
]
