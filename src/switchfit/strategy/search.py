"""A search by several strategies in turn: the best fit so far, and a record of each step.

The cheapest strategy that applies comes first; after each the verdict is asked whether to go on (`stopping`). Ctrl-C,
and the end of the time, keep the best so far.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.search_record import Rival, Step
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.integration_error import LARGE_INTEGRATION_ERROR
from switchfit.optimize import Status
from switchfit.problem.problem import Problem, check_start
from switchfit.runtime.errors import get_first_line
from switchfit.runtime.progress import Line
from switchfit.strategy.known_order import explain_no_beam, find_times
from switchfit.strategy.many_starts import Starts, try_starts
from switchfit.strategy.minimum_time import is_minimum_time, try_shorter_horizons
from switchfit.strategy.other_minima import find_other_minima
from switchfit.strategy.reinsertion import can_reinsert, reinsert_modes
from switchfit.strategy.short_fit import End, fit_briefly, make_feasible
from switchfit.strategy.stopping import is_doubted, is_enough, is_explained
from switchfit.strategy.time_limit import OutOfTimeError, is_late
from switchfit.uncertainty.judged_fit import JudgedFit

logger = logging.getLogger("switchfit")
Strategy = Literal["local", "auto", "thorough"]
BY_OTHER_MINIMUM = "another minimum near by"

BY_BEAM, BY_REINSERTION, BY_FEW_STARTS, BY_MANY_STARTS = (
    "beam along the log",
    "removal and re-insertion",
    "a few starts",
    "many starts",
)
"""Names of strategies. The re-insertion is for costs without data: of the fishing of the benchmark a fit takes 40 ms
with it, 100 ms with a few starts behind it, and 1 s with many."""

FEW_STARTS = 12
"""Starts that look whether re-insertion has missed a minimum: one that is met from a fifth of them is missed by 7 %."""

MOST_MINIMA_LEFT = 4
"""Times that a search goes on to another minimum near by."""

BY_MORE_ITERATIONS = "more iterations"
"""Name of what is no search: a fit that has not converged goes on."""

MORE_ITERATIONS = 2000
"""Iterations of a fit that goes on where the first has not converged within those that it was allowed."""

LEAST_GAIN_OF_STRATEGY = 1e-7
"""Part of the cost by which an end has to be lower to replace the best so far."""


def is_searching() -> bool:
    """Return whether strategies are being tried: Ctrl-C then keeps the best so far, wherever it comes."""
    return Search.running > 0


def was_interrupted(fit: JudgedFit) -> bool:
    """Return whether Ctrl-C or a callback ended a fit, or the search that found it."""
    last = fit.steps[-1] if fit.steps else None
    searching = last is not None and "interrupted" in (last.strategy, last.ended)
    return searching or fit.status is Status.INTERRUPTED


@dataclass
class Search:
    """A search by several strategies in turn: the best fit so far, and a record of each step."""

    problem: Problem
    own: Evaluator | None
    best: JudgedFit | None
    theta: FloatArray
    strategy: Strategy
    fit: Callable[..., JudgedFit]
    began: float
    line: Line
    others: Sequence[FloatArray] = ()
    rivals: tuple[Rival, ...] = ()
    only_others: bool = False
    starts: Starts | None = None
    has_budget: bool = False
    running: ClassVar[int] = 0

    def __post_init__(self) -> None:
        self.evaluations = 0 if self.best is None else self.best.evaluations
        proposed = any(run.is_guess_proposed for run in self.problem.experiments)
        name = "local, from evenly spaced times" if proposed else "local"
        self.steps = [Step(name, self.lowest, self.evaluations, time.perf_counter() - self.began)]
        self.first_cost = np.nan if self.best is None else self.best.initial_cost

    def run(self, limit_searches: Callable[[], AbstractContextManager[None]]) -> None:
        """Try one strategy after the other until the verdict is good, or no time is left; Ctrl-C ends it with the best
        so far.
        """
        # Ctrl-C means the end of the search from here on, not that of the program.
        Search.running += 1
        try:
            strategies = [] if self.only_others else self._list_strategies()
            with limit_searches():
                for name, find in strategies:
                    # The order is that of the cost, and each strategy begins where the best so far is.
                    if is_late() or not self._try(name, find):
                        break
                self._leave_minimum()
        except KeyboardInterrupt:
            if self.best is None:
                raise
            self.steps.append(Step("interrupted", self.lowest, 0, 0.0))
        finally:
            Search.running -= 1

    @property
    def lowest(self) -> float:
        """The lowest J so far; infinite before the first fit, and where it means nothing: it is no number, constraints
        are violated, or a fit that has not converged has gone down into the integration error.
        """
        best = self.best
        # A fit that has not converged may have gone down into the integration error: its J compares with nothing.
        is_coarse = best is not None and not best.status.successful and best.integration_error > LARGE_INTEGRATION_ERROR
        return np.inf if best is None or best.violated or is_coarse or np.isnan(best.cost) else best.cost

    def finish(self) -> JudgedFit:
        """Return the best fit with the record of the whole search."""
        best = self.best
        if best is None:
            raise ValueError("nothing was found.")
        starts = None
        if self.starts is not None:
            # Short fits have meshes of their own, whose J differs from that of the best by the integration error.
            accuracy = max(self.problem.rtol * abs(best.cost), self._compute_margin(best.cost))
            agreeing = self.starts.count_agreeing(best.cost, accuracy)
            starts = len(self.starts.costs), 0, agreeing  # the lowest of them is what `best` began at
        return replace(
            best,
            initial_theta=self.theta,
            initial_cost=self.first_cost,
            steps=tuple(self.steps),
            starts=starts,
            rivals=self.rivals,
            evaluations=self.evaluations,
            seconds=time.perf_counter() - self.began,
        )

    def _list_strategies(self) -> list[tuple[str, Callable[[FloatArray], End]]]:
        """Return the strategies that apply to the problem, the cheapest first."""
        problem, best = self.problem, self.best
        reason = explain_no_beam(problem)
        if not reason:
            return [
                (BY_BEAM, lambda theta: find_times(problem, self.theta, self._is_good)),
                (BY_MANY_STARTS, self._try_starts),
            ]
        logger.info("no beam: %s", reason)
        found: list[tuple[str, Callable[[FloatArray], End]]] = []
        if best is not None and best.status is Status.MAX_ITERATIONS:
            found.append((BY_MORE_ITERATIONS, lambda theta: fit_briefly(problem, theta, MORE_ITERATIONS)))
        if can_reinsert(problem):
            found.append((BY_REINSERTION, lambda theta: reinsert_modes(problem, theta)))
            found.append((BY_FEW_STARTS, lambda theta: try_starts(problem, theta, most=1 + FEW_STARTS).end))
        return [*found, (BY_MANY_STARTS, self._try_starts)]

    def _leave_minimum(self) -> None:
        """Go on to lower minima near the best, if any."""
        starts = self.others
        for _ in range(MOST_MINIMA_LEFT):
            if not starts and self.best is not None and is_enough(self.problem, self.best, self.steps):
                starts, self.rivals = find_other_minima(self.best, self.own)
            before = self.lowest
            # The first start that leads lower is enough: the others were found beside a minimum that is left then.
            for start in starts:
                if not is_late() and self.lowest == before:
                    self._try(BY_OTHER_MINIMUM, partial(fit_briefly, self.problem), make_feasible(self.problem, start))
            if self.lowest == before:
                break
            starts = ()

    def _try_starts(self, theta: FloatArray) -> End:
        if self.best is not None and is_minimum_time(self.problem, self.best):
            self.starts = try_shorter_horizons(self.problem, self.best)
        else:
            self.starts = try_starts(self.problem, theta, is_enough=self._is_good)
        return self.starts.end

    def _is_good(self, cost: float) -> bool:
        """Return whether an end with this J is what was looked for: lower than the best, and nothing more is left."""
        return self.strategy == "auto" and self._is_lower(cost) and is_explained(self.problem, cost)

    def _is_lower(self, cost: float) -> bool:
        """Return whether J of an end is lower than that of the best; no J is lower than one whose constraints are
        violated: that says nothing.
        """
        # inf - inf is no number: without a best so far, any finite J is lower.
        return self.lowest == np.inf > cost or cost < self.lowest - self._compute_margin(self.lowest)

    def _compute_margin(self, cost: float) -> float:
        """Return by how much an end must be lower than a cost to replace it; for a perfect fit, J is rounding error."""
        size = self.problem.smallest_cost
        return max(
            LEAST_GAIN_OF_STRATEGY * abs(cost), size if self.problem.is_least_squares else LEAST_GAIN_OF_STRATEGY * size
        )

    def _try(self, name: str, find: Callable[[FloatArray], End], start: FloatArray | None = None) -> bool:
        """Run one strategy, from the best so far unless it has a start of its own; a full fit follows where its end is
        lower. Return whether to go on.
        """
        began = time.perf_counter()
        logger.info("strategy: %s (lowest J so far: %.6g)", name, self.lowest)
        self.line.write(name, self.lowest)
        known = self.theta if self.best is None else self.best.theta
        before, evaluations, ended = self.lowest, 0, ""
        try:
            end = find(known if start is None else start)
            evaluations = end.evaluations
            # A short fit ends at a loose tolerance; only an end that is lower is worth the full one.
            if self._is_lower(end.cost):
                theta = check_start(self.problem, end.theta)
                named = f"{name}, fit of its end"
                fit = self.fit(Evaluator(self.problem, theta), theta, named, np.nan_to_num(self.first_cost))
                evaluations += fit.evaluations
                # Asked of the full fit again: on its own meshes it may not be lower, and what it meets may violate
                # constraints.
                if self.best is None or (fit.cost < before and not fit.violated) or self.best.violated:
                    self.best = fit
        except OutOfTimeError:
            ended = "time"
        except Exception as error:  # the best so far is not lost by what a search meets elsewhere
            logger.info("%s has failed", name, exc_info=True)
            ended = get_first_line(error)
        self.evaluations += evaluations
        if self.starts is not None and name == BY_MANY_STARTS:
            ended = self.starts.ended
        elif not ended and is_late():
            ended = "time"
        self.steps.append(Step(name, self.lowest, evaluations, time.perf_counter() - began, ended))
        if self.best is None:
            return ended != "interrupted"
        looked = self.steps[:1] if name == BY_MORE_ITERATIONS else self.steps  # which goes on from where the fit ended
        # Who gives seconds wants them used as long as a better end may be elsewhere.
        goes_on = self.has_budget and is_doubted(self.best)
        is_settled = self.strategy == "auto" and is_enough(self.problem, self.best, looked) and not goes_on
        return not (is_settled or was_interrupted(self.best) or ended == "interrupted")
