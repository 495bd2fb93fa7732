"""When to switch, without data: fishing, linear systems; and the linear example of the paper."""

from __future__ import annotations

import numpy as np

import switchfit as sf
from benchmarks import models, problems
from benchmarks.starts.case import Case, Collocated, draw_anywhere
from switchfit.paper.oscillator import LTI_TRUTH, build_oscillator

FIVE_SWITCHES = np.array([0.10021709786456, 0.29739223936426, 0.43294465994443, 0.64175816832317, 0.76662528600859])
"""Optimal switches of `linear` (DOP853 at 1e-12)."""
A1, A2 = np.array([[-1.0, 0.0], [1.0, 2.0]]), np.array([[1.0, 1.0], [1.0, -2.0]])
LINEAR = sf.HybridSystem({"A1": lambda t, x, p: A1 @ x, "A2": lambda t, x, p: A2 @ x}, [1.0, 1.0])


def fishing(count: int = 100) -> Case:
    """Lotka-Volterra fishing, eight switches anywhere in order."""
    problem = problems.case("fishing").problem()
    collocated = Collocated(models.FISHING, (np.zeros(0), np.zeros(0)))
    return Case(problem, np.array(models.FISHING_BEST), draw_anywhere(problem, count, seed=0), collocation=collocated)


def linear(count: int = 64) -> Case:
    """Two unstable linear modes of SwitchTimeOpt.jl, five switches anywhere in order."""
    sequence = ("A1", "A2") * 3
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: x @ x), sequence, tuple(np.arange(1, 6) / 6), 0.0, 1.0)
    problem = sf.Problem(LINEAR, run)
    return Case(problem, FIVE_SWITCHES, draw_anywhere(problem, count, seed=1))


def oscillator(count: int = 64) -> Case:
    """The paper's linear example: when its brake closes, stiffness and damping, over all bounds."""
    problem = build_oscillator()
    return Case(problem, np.array(LTI_TRUTH), draw_anywhere(problem, count, seed=2))
