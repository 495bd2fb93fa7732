"""The public function `estimate`: what the strategies find for a problem, as an `Estimate`."""

from __future__ import annotations

from collections.abc import Callable

from numpy.typing import ArrayLike

from switchfit.estimation.estimates import Estimate
from switchfit.optimize import IterationRecord
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.problem.problem import Problem
from switchfit.strategy.choice import MOST_ITERATIONS_BY_DEFAULT, find_best_fit
from switchfit.strategy.search import Strategy


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
        be elsewhere. Left out, it also ends with the first that finds nothing lower, and strategies do at most 20 times
        the work of the fit, or a few seconds' worth. Work is counted, not timed: the same input gives the same output,
        however busy the machine is. "thorough" does as much as it needs.

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
    found = find_best_fit(
        problem,
        strategy=strategy,
        hessian=hessian,
        tolerance=tolerance,
        max_iterations=max_iterations,
        callback=callback,
        start=start,
        time_budget=time_budget,
    )
    return Estimate.take_over(found)
