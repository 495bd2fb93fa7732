"""`estimate`: one fit, and where its verdict is not good, strategies that do not depend on the first guess.

When `estimate` tries no more: noise of a known size is left, or a search has looked and found nothing lower.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.estimation.estimator import Estimate
from switchfit.estimation.local_fit import fit_locally
from switchfit.fit.accuracy import Follower
from switchfit.fit.evaluator import evaluator_of, measure_variation
from switchfit.fit.result import Rival, Step, count_priors, count_samples
from switchfit.optimize import IterationRecord, Status
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.validation.arrays import as_positive
from switchfit.problem.validation.names import as_choice
from switchfit.problem.validation.objects import as_callable, as_instance
from switchfit.runtime.errors import NotIntegrableError, get_first_line
from switchfit.runtime.progress import Line, show_line
from switchfit.runtime.work_clock import measure_work
from switchfit.strategy.hops import (
    WORTH,
    can_reinsert,
    find_far_minima,
    is_lower,
    look_beyond_corners,
    look_near,
    reinsert_modes,
)
from switchfit.strategy.known_order import explain_no_beam, find_times
from switchfit.strategy.starts import (
    End,
    OutOfTimeError,
    Starts,
    fit_briefly,
    is_late,
    is_minimum_time,
    limit_time,
    make_feasible,
    try_shorter_horizons,
    try_starts,
)
from switchfit.uncertainty.certificate import LARGE_INTEGRATION_ERROR
from switchfit.uncertainty.residuals import CLEARLY_OFF, UNLIKELY, compare_with_sigma
from switchfit.uncertainty.verdict import NEARLY_ALL, find_without_effect
from switchfit.uncertainty.walks import compute_threshold

MORE_STARTS = "next: more starts"
"""Step that a verdict advises where the fit may be better elsewhere."""

logger = logging.getLogger("switchfit")
Strategy = Literal["local", "auto", "thorough"]
STRATEGIES = get_args(Strategy)
OTHER = "another minimum near by"

BEAM, REINSERT, FEW, STARTS = "beam along the log", "removal and re-insertion", "a few starts", "many starts"
"""Names of strategies. The re-insertion is for costs without data: of the fishing of the benchmark a fit takes 40 ms
with it, 100 ms with a few starts behind it, and 1 s with many."""

FEW_STARTS = 12
"""Starts that look whether re-insertion has missed a minimum: one that is met from a fifth of them is missed by 7 %."""

MOST_LEFT = 4
"""Times that a search goes on to another minimum near by."""

RIVAL_LEVEL, RIVAL_ITERATIONS = 0.95, 20
"""Confidence level at which the data do not tell two minima apart; and the most iterations of a fit of the other."""

MORE = "more iterations"
"""Name of what is no search: a fit that has not converged goes on."""

DEEP = 10.0
"""Multiple of what chi-square hides by which J rises at least around a time that is in no doubt. Wrong ends of weak
events reach 9.7; the times of a thermostat that switches five times in 40 samples begin at 59."""

LEAST_TIME, TIMES_LOCAL = 2.0, 20.0
"""Seconds that searches take at most where no budget is given, or so many times what the first fit took."""

ITERATIONS = 200
"""Most iterations of a fit on one mesh, unless said otherwise."""

MORE_ITERATIONS = 2000
"""Iterations of a fit that goes on where the first has not converged within those that it was allowed."""

LOWER = 1e-7
"""Part of the cost by which an end has to be lower to replace the best so far."""


def is_enough(problem: Problem, fit: Estimate, steps: Sequence[Step] = ()) -> bool:
    """Return whether nothing more has to be tried.

    Where the size of the noise is known, a right end leaves that noise. Where it is not, a minimum near the lowest may
    leave as little: a search has to have looked elsewhere. Where what is left is no noise, the end may be wrong or the
    model: it is the model if a search has looked and found nothing lower.

    Parameters
    ----------
    problem : Problem
    fit : Estimate
        The best so far.
    steps : sequence of Step
        The fit from the first guess, and the searches since.
    """
    if fit.status is Status.INTERRUPTED or _is_model_at_fault(problem, fit) or is_confirmed(problem, fit):
        return True
    if not fit.status.successful:
        return False
    if len(steps) < 2:
        if not any(run.transition_times for run in problem.experiments):
            return not is_doubted(fit)
        # A verdict takes as long as many steps, and so does a beam, which finds other minima that leave nearly noise.
        is_noise = not problem.is_least_squares or is_explained(problem, fit.cost, 1.0)
        if not is_noise and not (is_explained(problem, fit.cost) and explain_no_beam(problem)):
            return False
        answer = fit.verdict.answers[-1]
        return not is_doubted(fit) and answer.kind == "fits" and answer.figures.get("known") == 1.0
    items = [item for run in problem.experiments for item in run.data]
    if not any(isinstance(item, Measurements | ReferenceSignal) for item in items):
        # No quality of fit tells a local minimum from the lowest: a few starts have to.
        return len(steps) > 2 and steps[-1].cost == steps[-2].cost
    if not is_doubted(fit):
        return True
    # The beam has no derivative to follow where an unknown has no effect, as the height of a weir that is not reached.
    is_blind = len(steps) == 2 and any(issue.kind == "without effect" for issue in find_without_effect(fit))
    return steps[-1].cost == steps[-2].cost and not steps[-1].ended and not is_blind


def _is_model_at_fault(problem: Problem, fit: Estimate) -> bool:
    """Return whether what is doubted of a fit is how a function is written alone, from wherever the fit begins.

    Derivatives leave a switch out, also at the best end, and where there are none in the initial state, other starts
    have as few.
    """
    if fit.reason is None:
        return False
    if fit.reason.kind == "switch":
        return not is_doubted(fit)
    is_known = fit.reason.kind == "undefined" and fit.reason.figures["valued"] == 1.0
    begins = [run.t0 for run in problem.experiments]
    return fit.status is Status.NONFINITE_START and is_known and fit.reason.figures.get("t", begins[0]) in begins


def is_confirmed(problem: Problem, fit: Estimate) -> bool:
    """Return whether J alone says that nothing is in doubt, without a simulation of what was fitted.

    Parameters
    ----------
    problem : Problem
    fit : Estimate
    """
    if fit.status is not Status.CONVERGED or fit.active or fit.idle or fit.integration_error > problem.rtol:
        return False
    # A larger J may be that of another minimum, and noise all the same by chi-square: residuals tell them apart. Of a
    # flame that is quenched, 100 samples, a wrong end has a reduced chi-square of 1.26, and outliers.
    return is_explained(problem, fit.cost, 1.0)


def is_explained(problem: Problem, cost: float, least: float = UNLIKELY) -> bool:
    """Return whether J leaves nothing but noise of the data, whose size is known, or next to nothing of references.

    Parameters
    ----------
    problem : Problem
    cost : float
    least : float
        Probability that chi-square has at least; 1 is that of one that is not clearly too large (`CLEARLY_OFF`).
    """
    items = [item for run in problem.experiments for item in run.data]
    if all(isinstance(item, ReferenceSignal) for item in items):
        return cost <= (1 - NEARLY_ALL) * float(measure_variation(problem).sum())
    if not (problem.is_sigma_known and problem.is_least_squares):
        return False
    freedom = _count_freedom(problem)
    return freedom > 0 and bool(compare_with_sigma(2 * cost, freedom)[0] >= least)


def _count_freedom(problem: Problem) -> int:
    """Return the degrees of freedom, with all unknowns free, without a simulation."""
    return count_samples(problem) + count_priors(problem) - len(problem.theta_names)


def is_shallow(problem: Problem, fit: Estimate) -> bool:
    """Return whether chi-square may hide that a transition of a good fit is in the wrong place: J does not rise by a
    large multiple of what it hides before the time is half through the shorter mode beside it.

    Parameters
    ----------
    problem : Problem
    fit : Estimate
    """
    freedom = _count_freedom(problem)
    if not (problem.is_sigma_known and problem.is_least_squares and freedom > 0):
        return False
    # J is accepted up to this above its mean, freedom / 2, and the lowest may be two standard deviations below it.
    hidden = 0.5 * CLEARLY_OFF * freedom + 2 * np.sqrt(0.5 * freedom)
    for e, run in enumerate(problem.experiments):
        places = problem.unknowns.times[e]
        modes = np.diff(run.ends_of_modes(np.where(places >= 0, fit.theta[places], run.initial_times)))
        for i in np.flatnonzero(places[: len(modes) - 1] >= 0).tolist():
            half, error = 0.5 * min(modes[i], modes[i + 1]), fit.standard_errors[places[i]]
            if not error > 0.0 or not 0.5 * (half / error) ** 2 > DEEP * hidden:
                return True
    return False


def is_doubted(fit: Estimate) -> bool:
    """Return whether a better end may be elsewhere, by what the verdict says.

    Parameters
    ----------
    fit : Estimate
    """
    return not fit.status.successful or any(step.kind == MORE_STARTS for step in fit.verdict.next_steps)


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
        most = np.inf if strategy == "thorough" else max(LEAST_TIME, TIMES_LOCAL * (measure_work() - prepared))

        def limit_searches() -> AbstractContextManager[None]:
            """Return the limit of time of searches that begin now: what is left of the budget; without one, no time in
            which programs are compiled counts, so that no verdict depends on what is compiled already.
            """
            if budget is None:
                return limit_time(most, measure_work, callback)
            return limit_time(budget - (time.perf_counter() - began), time.perf_counter, callback)

        others: list[FloatArray] = []
        rivals: tuple[Rival, ...] = ()
        is_over, only_others = strategy == "local", False
        if best is not None and strategy == "auto":
            only_few = best.status is Status.MAX_ITERATIONS and max_iterations < ITERATIONS  # were asked for
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


def find_other_minima(fit: Estimate) -> tuple[list[FloatArray], tuple[Rival, ...]]:
    """Return starts at other minima that may be lower than the end of a good fit, the best first: in a transition time,
    or where the state meets corners in another way; and the minima in a time that the data do not tell from it.
    """
    evaluator, theta, scale = fit.evaluator_at_solution(), fit.theta, fit.variance_scale
    hops: list[FloatArray] = []
    rivals: dict[str, Rival] = {}
    if not (fit.status.is_strict_minimum and scale > 0.0):
        return hops, ()
    try:
        first = evaluator_of(evaluator.problem)  # its meshes may be coarser: a look takes half the time
        evaluator = first if Follower(first).suits(theta) else evaluator
        cost = evaluator.cost(theta)
        errors = np.sqrt(np.diag(fit.held_covariance))  # 0 at kinks, which hold their times
        hops, close = find_far_minima(evaluator, theta, cost, errors, scale)
        hops += look_near(evaluator, theta, cost - WORTH * scale, errors)
        if not hops and not evaluator.problem.constraint_names:
            hops = look_beyond_corners(evaluator, theta, cost - WORTH * scale, fit.held_covariance)
        for place, point in [] if hops else close:
            end = fit_briefly(evaluator.problem, point, RIVAL_ITERATIONS, evaluator)
            if is_lower(end.cost, cost):
                hops.append(end.theta)
            elif end.cost < cost + compute_threshold(fit, RIVAL_LEVEL):
                name, value = fit.theta_names[place], float(end.theta[place])
                low, high = fit.confidence_intervals(RIVAL_LEVEL)[place]
                if not low <= value <= high:
                    rival = name, value, end.cost - cost
                    rivals[name] = min(rivals.get(name, rival), rival, key=itemgetter(2))
    except (KeyboardInterrupt, OutOfTimeError):
        pass
    except Exception:  # the fit is not lost by what is met elsewhere
        logger.info("the look at other minima has failed", exc_info=True)
    return hops, tuple(rivals.values())


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


def is_searching() -> bool:
    """Return whether strategies are being tried: Ctrl-C then keeps the best so far, wherever it comes."""
    return Search.running > 0


def was_interrupted(fit: Estimate) -> bool:
    """Return whether Ctrl-C or a callback ended a fit, or the search that found it."""
    last = fit.steps[-1] if fit.steps else None
    searching = last is not None and "interrupted" in (last.strategy, last.ended)
    return searching or fit.status is Status.INTERRUPTED


@dataclass
class Search:
    """A search by several strategies in turn: the best fit so far, and a record of each step."""

    problem: Problem
    best: Estimate | None
    theta: FloatArray
    strategy: Strategy
    fit: Callable[..., Estimate]
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
        Search.running += 1
        try:
            strategies = [] if self.only_others else self._list_strategies()
            with limit_searches():
                for name, find in strategies:
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
        is_coarse = best is not None and not best.status.successful and best.integration_error > LARGE_INTEGRATION_ERROR
        return np.inf if best is None or best.violated or is_coarse or np.isnan(best.cost) else best.cost

    def finish(self) -> Estimate:
        """Return the best fit with the record of the whole search."""
        best = self.best
        if best is None:
            raise ValueError("nothing was found.")
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
            rivals=self.rivals,
            evaluations=self.evaluations,
            seconds=time.perf_counter() - self.began,
        )

    def _list_strategies(self) -> list[tuple[str, Callable[[FloatArray], End]]]:
        """Return the strategies that apply to the problem, the cheapest first."""
        problem, best = self.problem, self.best
        reason = explain_no_beam(problem)
        if not reason:
            return [(BEAM, lambda theta: find_times(problem, self.theta, self._is_good)), (STARTS, self._try_starts)]
        logger.info("no beam: %s", reason)
        found: list[tuple[str, Callable[[FloatArray], End]]] = []
        if best is not None and best.status is Status.MAX_ITERATIONS:
            found.append((MORE, lambda theta: fit_briefly(problem, theta, MORE_ITERATIONS)))
        if can_reinsert(problem):
            found.append((REINSERT, lambda theta: reinsert_modes(problem, theta)))
            found.append((FEW, lambda theta: try_starts(problem, theta, most=1 + FEW_STARTS).end))
        return [*found, (STARTS, self._try_starts)]

    def _leave_minimum(self) -> None:
        """Go on to lower minima near the best, if any."""
        starts = self.others
        for _ in range(MOST_LEFT):
            if not starts and self.best is not None and is_enough(self.problem, self.best, self.steps):
                starts, self.rivals = find_other_minima(self.best)
            before = self.lowest
            for start in starts:
                if not is_late() and self.lowest == before:
                    self._try(OTHER, partial(fit_briefly, self.problem), make_feasible(self.problem, start))
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
        return self.lowest == np.inf > cost or cost < self.lowest - self._compute_margin(self.lowest)

    def _compute_margin(self, cost: float) -> float:
        """Return by how much an end must be lower than a cost to replace it; for a perfect fit, J is rounding error."""
        size = self.problem.smallest_cost
        return max(LOWER * abs(cost), size if self.problem.is_least_squares else LOWER * size)

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
            if self._is_lower(end.cost):
                fit = self.fit(end.theta, f"{name}, fit of its end", np.nan_to_num(self.first_cost))
                evaluations += fit.evaluations
                if self.best is None or (fit.cost < before and not fit.violated) or self.best.violated:
                    self.best = fit
        except OutOfTimeError:
            ended = "time"
        except Exception as error:  # the best so far is not lost by what a search meets elsewhere
            logger.info("%s has failed", name, exc_info=True)
            ended = get_first_line(error)
        self.evaluations += evaluations
        if self.starts is not None and name == STARTS:
            ended = self.starts.ended
        elif not ended and is_late():
            ended = "time"
        self.steps.append(Step(name, self.lowest, evaluations, time.perf_counter() - began, ended))
        if self.best is None:
            return ended != "interrupted"
        looked = self.steps[:1] if name == MORE else self.steps  # which goes on from where the fit ended
        # Who gives seconds wants them used as long as a better end may be elsewhere.
        goes_on = self.has_budget and is_doubted(self.best)
        is_settled = self.strategy == "auto" and is_enough(self.problem, self.best, looked) and not goes_on
        return not (is_settled or was_interrupted(self.best) or ended == "interrupted")
