"""`estimate`: one fit, and where its verdict is not good, strategies that do not depend on the first guess."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from switchfit.estimation.estimator import Estimate
from switchfit.estimation.local_fit import fit_locally
from switchfit.fit.result import Step
from switchfit.fit.solution import is_least_squares, smallest_cost
from switchfit.optimize import IterationRecord, Status
from switchfit.optimize.problem import HessianKind
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import GIVEN, Problem
from switchfit.problem.validation import as_callable, as_choice, as_positive
from switchfit.runtime.errors import NotIntegrableError
from switchfit.runtime.progress import Line, show_line
from switchfit.strategy.enough import is_doubted, is_enough, is_explained
from switchfit.strategy.horizon import can_grow, grow_horizon
from switchfit.strategy.minimum_time import is_minimum_time, try_shorter_horizons
from switchfit.strategy.quick import End, OutOfTimeError, fit_briefly, is_late, limit_time
from switchfit.strategy.reinsertion import can_reinsert, reinsert_modes
from switchfit.strategy.runs import fit_runs_alone, has_runs
from switchfit.strategy.scan import can_scan, scan_intervals
from switchfit.strategy.starts import MOST, SAME_COST, Starts, try_starts
from switchfit.uncertainty.certificate import LARGE_INTEGRATION_ERROR

logger = logging.getLogger("switchfit")

Strategy = Literal["local", "auto", "thorough"]
STRATEGIES = get_args(Strategy)

SCAN, GROW, REINSERT, STARTS = (
    "scan over sample intervals",
    "growing horizon",
    "removal and re-insertion",
    "many starts",
)
"""Names of strategies."""

GROWTH_AGREES = "growing horizon agrees"
"""The growing horizon, which does not start from the guess, has ended at the same cost as the fit."""

FEW_STARTS = 16
"""Starts where the scan and the growing horizon have found nothing lower than the fit: it is the model that is doubted
then, mostly, and each start of a model that is wrong takes long."""

ITERATIONS = 200
"""Most iterations of a fit on one mesh, unless said otherwise."""

MORE_ITERATIONS = 2000
"""Iterations of a fit that goes on where the first has not converged within those that it was allowed."""

LOWER = 1e-7
"""Part of the cost by which an end has to be lower to replace the best so far."""


def estimate(
    problem: Problem,
    *,
    strategy: Strategy = "auto",
    hessian: HessianKind = "auto",
    tolerance: float = 1e-7,
    max_iterations: int = ITERATIONS,
    callback: Callable[[IterationRecord], object] | None = None,
    start: ArrayLike | None = None,
    time_budget: float | None = None,
) -> Estimate:
    """Estimate all transition times and parameters of a problem together.

    Parameters
    ----------
    problem : Problem
    strategy : {"auto", "local", "thorough"}
        "local": one fit from the first guess. "auto": more unless that leaves noise of a known size: transitions free
        of their guards first, a scan over the sample intervals, a growing horizon, removal and re-insertion of modes,
        many starts, as far as they apply, until noise of a known size is left or one of them has found nothing lower.
        "thorough": all of them.
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
        Called with each `IterationRecord` of the first fit and of those that end a strategy; a true return value stops.
        Ctrl-C does as well; both return the best point so far.
    start : (d,) array_like, optional
        Where to begin, in the order of ``problem.theta_names``; the problem's initial guess if left out.
    time_budget : float, optional
        Seconds after which strategies end, at the next evaluation of J. The fit from the first guess is made in any
        case, and so is the one that ends the search.

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
    for how long. Many starts that last are fitted by other processes as well, one a core, where the model runs in
    machine code and can be pickled; what is found does not depend on them.

    See Also
    --------
    estimate_many, multistart : many fits.
    Estimate : what it returns.

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> problem = heater_problem()

    >>> fit = sf.estimate(problem)
    >>> fit.success
    True
    >>> fit.transition_times[0].round(2), round(float(fit.parameters["k"]), 2)
    (array([2.46]), 0.39)
    """
    strategy = as_choice(strategy, "strategy", STRATEGIES)
    budget = np.inf if time_budget is None else as_positive(time_budget, "time_budget")
    if callback is not None:
        as_callable(callback, "callback", "a function callback(record)", arguments=1)
    settings: dict[str, Any] = {"tolerance": tolerance, "max_iterations": max_iterations, "hessian": hessian}
    began = time.perf_counter()
    with limit_time(budget), show_line("fit: not begun, or compiling (only the first time)") as line:
        settings["callback"] = _write_to(line, "fit", callback)
        try:
            best = fit_locally(problem, start=start, **settings)
        except NotIntegrableError:
            if strategy == "local":
                raise
            search = Search(problem, None, problem.check_theta(start), strategy, settings, began)
            search.run(line, callback)
            if search.best is None:
                raise
            return search.finish(search.best)
        limited = best.status is Status.MAX_ITERATIONS and max_iterations < ITERATIONS
        if strategy == "local" or (strategy == "auto" and (hessian != "auto" or limited or is_enough(problem, best))):
            return best
        search = Search(problem, best, problem.check_theta(start), strategy, settings, began)
        search.run(line, callback)
        return search.finish(search.best or best)


def _write_to(
    line: Line, name: str, callback: Callable[[IterationRecord], object] | None
) -> Callable[[IterationRecord], object] | None:
    """Return the callback of a fit, which writes to the line of progress as well if that can be shown."""
    if not line.is_started:
        return callback

    def report(record: IterationRecord) -> object:
        line.write(f"{name}: iteration {record.iteration}, J = {record.cost:.6g}, optimality {record.optimality:.1e}")
        return callback is not None and callback(record)

    return report


def is_searching() -> bool:
    """Return whether strategies are being tried: Ctrl-C then keeps the best so far, wherever it comes."""
    return Search.running > 0


def was_interrupted(fit: Estimate) -> bool:
    """Return whether Ctrl-C or a callback ended a fit, or the search that found it."""
    last = fit.steps[-1] if fit.steps else None
    searching = last is not None and "interrupted" in (last.strategy, last.ended)
    return searching or fit.status is Status.INTERRUPTED


def remove_guards(problem: Problem) -> Problem:
    """Return the problem without its guards, so that transitions may happen anywhere.

    Parameters
    ----------
    problem : Problem
    """
    given = {name: getattr(problem, name) for name in GIVEN}
    return Problem(**given | {"system": replace(problem.system, guards={})})


class Search:
    """A search by several strategies in turn: the best fit so far, and a record of each step."""

    running: ClassVar[int] = 0

    def __init__(
        self,
        problem: Problem,
        best: Estimate | None,
        theta: FloatArray,
        strategy: Strategy,
        settings: dict[str, Any],
        began: float,
    ) -> None:
        self.problem, self.best, self.theta = problem, best, theta
        self.strategy, self.settings, self.began = strategy, settings, began
        self.evaluations = 0 if best is None else best.evaluations
        proposed = any(run.is_guess_proposed for run in problem.experiments)
        name = "local, from evenly spaced times" if proposed else "local"
        self.steps = [Step(name, self.lowest, self.evaluations, time.perf_counter() - began)]
        self.first_cost = np.nan if best is None else best.initial_cost
        self.starts: Starts | None = None
        self.tried: set[str] = set()

    def run(self, line: Line, callback: Callable[[IterationRecord], object] | None) -> None:
        """Try one strategy after the other until the verdict is good; Ctrl-C ends it with the best so far."""
        self.line, self.callback = line, callback
        Search.running += 1
        try:
            self._run()
        finally:
            Search.running -= 1

    @property
    def lowest(self) -> float:
        """The lowest J so far; infinite before the first fit, and where it means nothing: constraints are violated, or
        a fit that has not converged has gone down into the integration error.
        """
        best = self.best
        is_coarse = best is not None and not best.status.successful and best.integration_error > LARGE_INTEGRATION_ERROR
        return np.inf if best is None or best.violated or is_coarse else best.cost

    def _begin(self, name: str) -> None:
        """Show on the line of progress which strategy begins, and the lowest J before it."""
        logger.info("strategy: %s (lowest J so far: %.6g)", name, self.lowest)
        self.settings["callback"] = _write_to(self.line, f"{name}, fit of its end", self.callback)
        self.line.write(name, self.lowest)

    def _run(self) -> None:
        tried = self.tried
        try:
            for name, find in self._list_strategies():
                if is_late():
                    break
                if name == REINSERT and self._is_model_doubted:
                    continue
                before = self.lowest
                agrees = self._try(name, find)
                tried.add(name)
                is_finished = self.starts is not None and self.starts.ended in ("settled", "most")
                if is_finished and self.lowest < before and SCAN in tried:
                    self._try(SCAN, lambda theta: scan_intervals(self.problem, theta))
                if agrees and name == GROW:
                    tried.add(GROWTH_AGREES)
                if self.strategy == "auto" and self.best is not None and is_enough(self.problem, self.best, self.steps):
                    break
                if self.best is not None and was_interrupted(self.best):
                    break
                if self.starts is not None and self.starts.ended == "interrupted":
                    break
        except KeyboardInterrupt:
            if self.best is None:
                raise
            self.steps.append(Step("interrupted", self.lowest, 0, 0.0))

    def finish(self, best: Estimate) -> Estimate:
        """Return the best fit with the record of the whole search.

        Parameters
        ----------
        best : Estimate
        """
        starts = None
        if self.starts is not None:
            accuracy = max(self.problem.rtol * abs(best.cost), self._compute_margin(best.cost))
            agreeing = self.starts.count_agreeing(best.cost, accuracy)
            starts = len(self.starts.costs), 0, agreeing  # the lowest of them is what `best` began at
        return replace(
            best,
            initial_theta=self.theta,
            initial_cost=self.first_cost,
            steps=tuple(self.steps),
            starts=starts,
            evaluations=self.evaluations,
            seconds=time.perf_counter() - self.began,
        )

    def _list_strategies(self) -> list[tuple[str, Callable[[FloatArray], End]]]:
        """Return the strategies that apply to the problem, the cheapest first."""
        problem, best = self.problem, self.best
        found: list[tuple[str, Callable[[FloatArray], End]]] = []
        doubted = best is None or is_doubted(best)
        if problem.constraint_names:
            if any(structure.guarded for structure in problem.structures):
                found.append(("transitions free of their guards", self._free_transitions))
            return [*found, (STARTS, self._try_starts)]
        unfinished = best is not None and best.status is Status.MAX_ITERATIONS
        if unfinished and (has_runs(problem) or not can_grow(problem)):
            found.append(("more iterations", lambda theta: fit_briefly(problem, theta, MORE_ITERATIONS)))
        if has_runs(problem) and (doubted or self.strategy == "thorough"):
            found.append(("each run alone", self._fit_runs_alone))
        if can_scan(problem):
            found.append((SCAN, lambda theta: scan_intervals(problem, theta)))
        if can_grow(problem):
            # Intervals near by say little of a doubted end, or of one whose guess nobody made; several runs have been
            # fitted alone by then.
            far = doubted or any(run.is_guess_proposed for run in problem.experiments)
            place = 0 if far and not has_runs(problem) else len(found)
            found.insert(place, (GROW, lambda theta: grow_horizon(problem, theta)))
        if can_reinsert(problem):
            found.append((REINSERT, lambda theta: reinsert_modes(problem, theta)))
        return [*found, (STARTS, self._try_starts)]

    def _free_transitions(self, theta: FloatArray) -> End:
        """Fit with transitions that may happen anywhere, and from there with their guards."""
        free = self._estimate_inside(remove_guards(self.problem), self.theta)
        end = fit_briefly(self.problem, free.theta)
        return end._replace(evaluations=end.evaluations + free.evaluations)

    def _fit_runs_alone(self, theta: FloatArray) -> End:
        """Fit each run by itself, then all together."""

        def fit(part: Problem, start: FloatArray) -> tuple[FloatArray, FloatArray, int]:
            found = self._estimate_inside(part, start)
            return found.theta, found.hessian, found.evaluations

        return fit_runs_alone(self.problem, self.theta, fit)

    def _estimate_inside(self, problem: Problem, start: FloatArray) -> Estimate:
        """Estimate another problem; Ctrl-C then ends this search as well."""
        found = estimate(problem, start=start)
        if was_interrupted(found):
            raise KeyboardInterrupt
        return found

    @property
    def _is_model_doubted(self) -> bool:
        """Whether it is the model that is doubted, and not the minimum: two searches found nothing lower."""
        return self.strategy == "auto" and {SCAN, GROWTH_AGREES} <= self.tried

    def _try_starts(self, theta: FloatArray) -> End:
        if self.best is not None and is_minimum_time(self.problem, self.best):
            self.starts = try_shorter_horizons(self.problem, self.best)
        else:
            most = FEW_STARTS if self._is_model_doubted else MOST
            self.starts = try_starts(self.problem, theta, most=most, is_enough=self._is_good)
        return self.starts.end

    def _is_good(self, cost: float) -> bool:
        """Return whether an end with this J is what was looked for: lower than the best, and nothing more is left."""
        return self.strategy == "auto" and self._is_lower(cost) and is_explained(self.problem, cost)

    def _is_lower(self, cost: float) -> bool:
        """Return whether J of an end is lower than that of the best; no J is lower than one whose constraints are
        violated: that says nothing.
        """
        return self.lowest == np.inf > cost or cost < self.lowest - self._compute_margin(self.lowest)

    def _compute_margin(self, cost: float) -> float:
        """Return by how much an end must be lower than a cost to replace it; for a perfect fit, J is rounding error."""
        size = smallest_cost(self.problem)
        return max(LOWER * abs(cost), size if is_least_squares(self.problem) else LOWER * size)

    def _fit_at(self, theta: FloatArray) -> Estimate | None:
        """Return the full fit from theta (d,), on meshes made for it; None where the model cannot be integrated there.

        A short fit on the meshes of its start may end where the adaptive solve for new meshes gets stuck.
        """
        try:
            return fit_locally(self.problem, start=theta, first_cost=np.nan_to_num(self.first_cost), **self.settings)
        except NotIntegrableError as error:
            logger.info("the end of the strategy is no start of a fit: %s", error)
            return None

    def _try(self, name: str, find: Callable[[FloatArray], End]) -> bool:
        """Run one strategy; a full fit follows where its end is lower than the best so far.

        Returns whether it ended at the same cost as the best.
        """
        began = time.perf_counter()
        self._begin(name)
        theta, before, ended = self.theta if self.best is None else self.best.theta, self.lowest, ""
        try:
            end = find(theta)
        except OutOfTimeError:
            end, ended = End(theta, np.inf, 0), "time"
        evaluations = end.evaluations
        if self._is_lower(end.cost):
            fit = self._fit_at(end.theta)
            if fit is not None:
                evaluations += fit.evaluations
                if self.best is None or (fit.cost < before and not fit.violated) or self.best.violated:
                    self.best = fit
        self.evaluations += evaluations
        ended = self.starts.ended if self.starts is not None and name == STARTS else ended
        self.steps.append(Step(name, self.lowest, evaluations, time.perf_counter() - began, ended))
        return bool(np.isfinite(before) and abs(end.cost - before) <= SAME_COST * abs(before))
