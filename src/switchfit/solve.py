"""One run of the optimiser on a problem whose meshes are given: what fits, profiles and many fits have in common."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from switchfit.data import FloatArray, Measurements, TerminalConstraint
from switchfit.evaluate import ArrowEvaluation, Evaluation, Evaluator
from switchfit.optimize import IterationRecord, LinearConstraints, Result, minimize
from switchfit.optimize.sqp import HessianKind
from switchfit.problem import Problem

MANY_RUNS = 16
"""Experiments from which on the Hessian's shape of an arrow is made use of; with fewer, the algebra of full matrices
takes no longer (the runs part of the benchmarks)."""


@dataclass(frozen=True, eq=False)
class CostAndGradient:
    """All that steepest descent is given."""

    cost: float
    gradient: FloatArray
    hessian: None = None


def constraints_of(problem: Problem) -> LinearConstraints:
    """Ordering, minimum durations and bounds of a problem as the optimiser takes them."""
    unknowns = problem.unknowns
    names = [
        *unknowns.constraint_names,
        *(f"{name} at its lower bound {value:g}" for name, value in zip(unknowns.names, unknowns.lower, strict=True)),
        *(f"{name} at its upper bound {value:g}" for name, value in zip(unknowns.names, unknowns.upper, strict=True)),
    ]
    return LinearConstraints(unknowns.A, unknowns.b, unknowns.lower, unknowns.upper, tuple(names))


def minimized(
    evaluator: Evaluator,
    theta: Any,
    hessian: HessianKind,
    tolerance: float,
    max_iterations: int,
    callback: Callable[[IterationRecord], object] | None = None,
    constraints: LinearConstraints | None = None,
    by_blocks: bool | None = None,
) -> Result:
    """One run of the optimiser on the evaluator's meshes; arguments as of `estimate`.

    The problem's own constraints hold unless others are given. `by_blocks` says whether to use the shape that the
    Hessian of several runs has; left out, where it pays.
    """
    problem = evaluator.problem

    matrix = hessian if hessian in ("gauss-newton", "none") else "exact"
    if by_blocks is None:
        by_blocks = len(problem.experiments) >= MANY_RUNS and 2 * len(evaluator.layout.shared) < len(theta)

    def evaluate(theta: Any, side: int) -> Evaluation | ArrowEvaluation | CostAndGradient:
        if hessian not in ("none", "descent-first") and by_blocks:
            return evaluator.arrow(theta, side, matrix)
        here = evaluator(theta, side, matrix=matrix)
        return CostAndGradient(here.cost, here.gradient) if hessian == "none" else here

    is_time = np.zeros(len(theta), dtype=int)
    for where in problem.unknowns.times:
        is_time[where[where >= 0]] = 1
    return minimize(
        evaluate,
        theta,
        constraints=constraints_of(problem) if constraints is None else constraints,
        breakpoints=evaluator.breakpoints(),
        hessian=hessian,
        blocks=is_time,
        tolerance=tolerance,
        max_iterations=max_iterations,
        callback=callback,
    )


def with_names(message: str, names: tuple[str, ...]) -> str:
    """The optimiser's message with the unknowns called by their names."""
    return re.sub(r"theta\[(\d+)\]", lambda match: names[int(match.group(1))], message)


def sigma_known(problem: Problem) -> bool | None:
    """Whether sigma is known for all measurements; None where the cost is not made of measurements alone."""
    items = [item for run in problem.experiments for item in run.data if not isinstance(item, TerminalConstraint)]
    if not items or not all(isinstance(item, Measurements) for item in items):
        return None
    return all(item.sigma is not None for item in items)
