"""The public function `estimate`: one fit, and strategies that need no first guess where its verdict is not good."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.estimation.estimates import Estimate
from switchfit.estimation.local_fit import fit_locally
from switchfit.fit.search_record import Rival
from switchfit.meshes.evaluator import evaluator_of
from switchfit.optimize import IterationRecord, Status
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.problem.problem import Problem, require_estimable
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

STRATEGIES = get_args(Strategy)

LEAST_WORK, TIMES_LOCAL = 5.0, 20.0
"""Work of searches where no budget is given, in seconds of `measure_work`, or so many times that of the first fit. It
is counted: in seconds of a clock, answers would depend on what else the machine does."""

MOST_ITERATIONS_BY_DEFAULT = 200
"""Most iterations of a fit on one mesh, unless said otherwise."""


def estimate(
    problem: Problem,
    *,
    strategy: Strategy = "auto",
    hessian: HessianKind = "auto",
    tolerance: float = 1e-7,
    max_iterations: int = MOST_ITERATIONS_BY_DEFAULT,
    callback: Callable[[IterationRecord], object] | None = None,
    start: ArrayLike | None = None,
    time_budget: float | None = None,
) -> Estimate:
    """Estimate all transition times and parameters of a problem together.

    Parameters
    ----------
    problem : Problem
    strategy : {"auto", "local", "thorough"}
        "local": one fit from the first guess. "auto": more where the verdict on it is not good, and for costs without
        data, whose verdict knows no quality of fit: a beam that follows hypotheses about the times through the log,
        where it applies, then many starts, until the verdict is good. Where it is good, another minimum near by is
        tried if J may be lower there. "thorough": all of them, whatever the verdict.
    hessian : {"auto", "exact", "descent-first", "block-diagonal", "gauss-newton", "none"}
        Quadratic term of the sequential quadratic programme: equation (3), shifted inside a trust region where it is
        not positive definite; equation (3), its eigenvalues made positive where they are not, with a line search, which
        16 experiments or more have in any case; steepest descent until it is positive definite, then
        equation (3), as the paper does it (Section II-A); equation (4); the Gauss-Newton matrix; or none (steepest
        descent). With another than "auto" the strategy is "local" unless "thorough" is asked for.
    tolerance : float
        On the KKT residual, the norm of the gradient where no constraint is active. An unknown on a logarithmic scale
        counts by its logarithm, one whose first guess is below 1e-3 or above 1e3 in units of (about) that guess.
    max_iterations : int
        Most iterations on one mesh. Where a fit has converged but the integration error asks for a finer mesh, at most
        twice, it is resumed there with as many again; ``iterations`` counts all of them. With fewer than usual
        "auto" is "local" where they do not suffice.
    callback : callable, optional
        Called with each `IterationRecord` of all fits; a true return value stops. Ctrl-C does as well; both return the
        best point so far.
    start : (d,) array_like, optional
        Where to begin, in the order of ``problem.theta_names``; the problem's initial guess if left out.
    time_budget : float, optional
        Seconds after which strategies end, at the next evaluation of J. The fit from the first guess is made in any
        case, and so is the one that ends the search. With it, "auto" tries all strategies as long as a better end may
        be elsewhere. Left out, it also ends with the first that finds nothing lower, and strategies take at most 2 s
        after the fit, or 20 times what it took, beside the compilation of their programs; "thorough" as long as they
        need.

    Returns
    -------
    Estimate
        The lowest end that was found, also when it did not converge, or is far from the data: see ``.success`` and
        ``.verdict``. ``.steps`` says what was tried and what it brought.

    Raises
    ------
    ValueError
        For a bad setting, or where neither the guess nor any other start can be integrated.
    TypeError
        If an argument is of the wrong type.

    Notes
    -----
    On a terminal, a line on stderr says from a second on which strategy is under way, the lowest J, how far it is and
    for how long.

    See Also
    --------
    estimate_many, multistart : many fits.
    Estimate : what it returns.

    Examples
    --------
    >>> problem = heater_problem()

    >>> fit = sf.estimate(problem)
    >>> fit.success
    True
    >>> fit.transition_times[0].round(2), round(float(fit.parameters["k"]), 2)
    (array([2.46]), 0.39)
    """
    as_instance(problem, "problem", Problem, "an sf.Problem; several are what sf.estimate_many takes")
    require_estimable(problem)
    strategy = as_choice(strategy, "strategy", STRATEGIES)
    budget = None if time_budget is None else as_positive(time_budget, "time_budget")
    if callback is not None:
        as_callable(callback, "callback", "a function callback(record)", arguments=1)
    settings: dict[str, Any] = {"tolerance": tolerance, "max_iterations": max_iterations, "hessian": hessian}

    began = time.perf_counter()
    with show_line("fit: not begun, or compiling (only the first time)") as line:

        def fit(start: ArrayLike | None, name: str, first_cost: float = 0.0) -> Estimate:
            """Return a fit from a start; `name` is what it is called on the line of progress."""
            report = _write_to(line, name, callback)
            return fit_locally(problem, start=start, callback=report, first_cost=first_cost, **settings)

        with suppress(NotIntegrableError):  # the fit says why
            evaluator_of(problem)
        prepared = measure_work()
        best, failure = None, None
        try:
            best = fit(start, "fit")
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
            is_over = hessian != "auto" or only_few
            if not is_over and is_enough(problem, best):
                with limit_searches():
                    others, rivals = find_other_minima(best)
                only_others = not is_shallow(problem, best) or bool(explain_no_beam(problem))
                is_over = only_others and not others
        if best is not None and is_over:
            return replace(best, rivals=rivals) if rivals else best
        begin = problem.check_theta(start)
        search = Search(problem, best, begin, strategy, fit, began, line, others, rivals, only_others)
        search.has_budget = budget is not None
        search.run(limit_searches)
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
