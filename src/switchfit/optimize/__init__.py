"""Minimisation of a piecewise smooth cost under linear constraints; knows nothing of differential equations."""

from switchfit.optimize.augmented import ConstrainedResult, minimize_constrained
from switchfit.optimize.qp import LinearConstraints, QPSolution, solve_qp
from switchfit.optimize.sqp import Evaluation, IterationRecord, Result, Status, minimize

__all__ = [
    "ConstrainedResult",
    "Evaluation",
    "IterationRecord",
    "LinearConstraints",
    "QPSolution",
    "Result",
    "Status",
    "minimize",
    "minimize_constrained",
    "solve_qp",
]
