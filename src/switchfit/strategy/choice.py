"""What `estimate` does: one fit, and strategies that need no first guess where its verdict is not good.

Three ways lead out: the fit is good and no lower minimum is near; it is good but another minimum near by may be lower,
which is all that is tried then; or a whole `Search` follows. Which of them it is, `stopping` says. How long a search
may take is counted in work and not in seconds, unless a budget is given.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.fit.local_fit import HESSIANS, check_settings, fit_on_meshes
from switchfit.fit.search_record import Rival
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.optimize import IterationRecord, Status
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.problem.problem import Problem, check_start, require_estimable
from switchfit.problem.validation.arrays import as_positive
from switchfit.problem.validation.names import as_choice
from switchfit.problem.validation.objects import as_callable, as_instance
from switchfit.runtime.errors import NotIntegrableError
from switchfit.runtime.progress import Line, show_line
from switchfit.runtime.work import measure_work
from switchfit.strategy.known_order import explain_no_beam
from switchfit.strategy.other_minima import find_other_minima
from switchfit.strategy.search import Search, Strategy
from switchfit.strategy.stopping import is_enough, is_shallow
from switchfit.strategy.time_limit import limit_time
from switchfit.uncertainty.judged_fit import JudgedFit

STRATEGIES = get_args(Strategy)

LEAST_WORK, TIMES_LOCAL = 5.0, 20.0
"""Work of searches where no budget is given, in seconds of `measure_work`, or so many times that of the first fit. It
is counted: in seconds of a clock, answers would depend on what else the machine does."""

MOST_ITERATIONS_BY_DEFAULT = 200
"""Most iterations of a fit on one mesh, unless said otherwise."""


def find_best_fit(
    problem: Problem,
    *,
    strategy: Strategy = "auto",
    hessian: HessianKind = "auto",
    tolerance: float = 1e-7,
    max_iterations: int = MOST_ITERATIONS_BY_DEFAULT,
    callback: Callable[[IterationRecord], object] | None = None,
    start: ArrayLike | None = None,
    time_budget: float | None = None,
) -> JudgedFit:
    """Return the best fit that one fit, and the strategies that apply, have found; see `estimate` for the arguments.

    Raises
    ------
    ValueError
        For a bad setting, or where neither the guess nor any other start can be integrated.
    TypeError
        If an argument is of the wrong type.
    """
    as_instance(problem, "problem", Problem, "an sf.Problem; several are what sf.estimate_many takes")
    require_estimable(problem)
    begin = check_start(problem, start)
    strategy = as_choice(strategy, "strategy", STRATEGIES)
    budget = None if time_budget is None else as_positive(time_budget, "time_budget")
    if callback is not None:
        as_callable(callback, "callback", "a function callback(record)", arguments=1)
    hessian = as_choice(hessian, "hessian", HESSIANS)
    tolerance, max_iterations = check_settings(tolerance, max_iterations)

    began = time.perf_counter()
    with show_line("fit: not begun, or compiling (only the first time)") as line:
        # Its meshes are made before work is counted: those of a problem that was fitted before are there already.
        own: Evaluator | None = None
        with suppress(NotIntegrableError):  # the fit says why
            own = evaluator_of(problem)

        def fit(evaluator: Evaluator, theta: FloatArray, name: str, first_cost: float = 0.0) -> JudgedFit:
            """Return a fit from theta on its meshes; `name` is what it is called on the line of progress."""
            report = _write_to(line, name, callback)
            return JudgedFit.take_over(
                fit_on_meshes(evaluator, theta, hessian, tolerance, max_iterations, report, first_cost)
            )

        prepared = measure_work()
        best, failure = None, None
        try:
            at_start = Evaluator(problem, begin) if start is not None or own is None else own
            best = fit(at_start, begin, "fit")
        except NotIntegrableError as error:
            if strategy == "local":
                raise
            failure = error
        most = np.inf if strategy == "thorough" else max(LEAST_WORK, TIMES_LOCAL * (measure_work() - prepared))

        def limit_searches() -> AbstractContextManager[None]:
            """Return the limit of searches that begin now: what is left of the budget, or else counted work."""
            if budget is None:
                return limit_time(most, measure_work, callback)
            return limit_time(budget - (time.perf_counter() - began), time.perf_counter, callback)

        others: list[FloatArray] = []
        rivals: tuple[Rival, ...] = ()
        is_over, only_others = strategy == "local", False
        if best is not None and strategy == "auto":
            only_few = (
                best.status is Status.MAX_ITERATIONS and max_iterations < MOST_ITERATIONS_BY_DEFAULT
            )  # were asked for
            # Who asks for a certain Hessian or for few iterations wants to see what that fit does, and no other one.
            is_over = hessian != "auto" or only_few
            if not is_over and is_enough(problem, best):
                with limit_searches():
                    others, rivals = find_other_minima(best, own)
                # A minimum that is deep, or that no beam can doubt, is left for a lower one near by alone; others are
                # searched for in full.
                only_others = not is_shallow(problem, best) or bool(explain_no_beam(problem))
                is_over = only_others and not others
        if best is not None and is_over:
            return replace(best, rivals=rivals) if rivals else best
        search = Search(problem, own, best, begin, strategy, fit, began, line, others, rivals, only_others)
        search.has_budget = budget is not None
        search.run(limit_searches)
        # No search has found a start either: what was wrong with the guess says more than that.
        if failure is not None and search.best is None:
            raise failure
        return search.finish()


def _write_to(
    line: Line, name: str, callback: Callable[[IterationRecord], object] | None
) -> Callable[[IterationRecord], object] | None:
    """Return the callback of a fit, which writes to the line of progress as well if that can be shown."""
    if not line.is_shown:
        return callback

    def report(record: IterationRecord) -> object:
        line.write(f"{name}: iteration {record.iteration}, J = {record.cost:.6g}, optimality {record.optimality:.1e}")
        return callback is not None and callback(record)

    return report
