"""Combinations of unknowns that the data determine badly, tested by evaluating J along them.

The Hessian scaled to unit curvature of each unknown, ``S H S`` with ``S = diag(H)^(-1/2)``, does not depend on units:
its eigenvalues would all be 1 if every unknown were determined independently of the others. An eigenvector v with a
small eigenvalue lambda is a badly determined combination: a step of length s along ``S v`` changes J by lambda s^2 / 2.

A statement such as "tau_2 later and mu lower leaves J as it is" is made for the step at which the quadratic form
predicts that J rises by `Identifiability.rise`. J is evaluated there on both sides, and the result is what is printed.
If J rises by more than twice the prediction, since the valley bends, the step is halved until it does not.

Before a fit, the same is done with noise-free data simulated at the first guess: the cost is 0 there, its gradient
vanishes, and its exact Hessian is the Gauss-Newton matrix (the expected information).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.comparison import compare
from switchfit.fit.data_variation import measure_variation
from switchfit.fit.hidden_switches import refuse_hidden_switches
from switchfit.fit.result import Fit
from switchfit.fit.scaled_hessian import compute_scaled_spectrum, moves_by_itself
from switchfit.fit.solved_fit import SolvedFit
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.optimize.curvature import null_space
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.reads import find_unread
from switchfit.problem.variants import replace_values
from switchfit.runtime import special
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed, format_line, join_first

WEAK = 0.05
"""Scaled eigenvalues below this are reported: standard errors along them are 4.5 times those of each unknown alone."""

MOST_DIRECTIONS = 3
"""Largest number of directions that are reported."""

LEAST_NAMED_WEIGHT = 0.2
"""Unknowns with less than this part of the largest weight in a direction are not named."""

UNDETERMINED_COMBINATION = 1e-10
"""Scaled eigenvalues below this are zero."""

HALVINGS_ALONG_DIRECTION = 20
Cost = Callable[[FloatArray], float]

Meaning = Literal["noise", "1 % of J", "1 % of variation"]
"""Meaning of a rise of J: hidden by noise in 95 % of all cases, 1 % of J, or caused by a change of all measured values
by 1 % of their variation."""


@dataclass(frozen=True, eq=False)
class Direction:
    """A combination of the unknowns, and the rise of J along it.

    Attributes
    ----------
    eigenvalue : float
        Eigenvalue of the Hessian scaled to unit curvature of each unknown.
    weights : (d,)
        Its eigenvector, in scaled unknowns, the largest entry positive.
    change : (d,)
        The change of theta that was tried, a multiple of the scaled eigenvector, in the units of theta.
    rises : (float, float)
        Rise of J at theta + change and at theta - change; NaN at a point that is not feasible.
    names : tuple of str
        Unknowns with the largest weights, the largest first.

    See Also
    --------
    Identifiability, identifiability

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> worst = fit.identifiability.directions[0]
    >>> worst.names
    ('tau_1', 'k')
    >>> worst.summary
    'tau_1 and k trade off'
    """

    eigenvalue: float
    weights: FloatArray
    change: FloatArray
    rises: tuple[float, float]
    names: tuple[str, ...]

    def __repr__(self) -> str:
        return format_line(self, self.summary, f"scaled eigenvalue = {self.eigenvalue:.2g}")

    @property
    def summary(self) -> str:
        """The combination in words, such as "tau_2 and mu trade off"."""
        return str(Issue("trade off", self.names))


@dataclass(frozen=True, eq=False)
class Identifiability(Printed):
    """How well data determine the unknowns; print it.

    Attributes
    ----------
    theta_names, theta_units : tuple of str
    is_time : (d,) bool
        Which of the unknowns are transition times.
    rise : float
        Rise of J for which the changes are chosen.
    meaning : {"noise", "1 % of J", "1 % of variation"}
        Meaning of that rise: hidden by noise in 95 % of all cases, 1 % of J, or caused by a change of all measured
        values by 1 % of their variation.
    where : {"solution", "first guess"}
    cost : float
        J there, to which a rise is compared; NaN if it is not compared.
    eigenvalues : (k,)
        Eigenvalues, ascending, of the Hessian scaled to unit curvature of each unknown, on the free directions.
    without : tuple of str
        Unknowns on which the cost does not depend at all, to second order.
    held : tuple of str
        Unknowns that a constraint, a kink or a collapsed mode holds; they are not analyzed.
    directions : tuple of Direction
        The badly determined directions, at most three; the worst direction is always among them.
    tried : bool
        Whether J was evaluated along the directions.
    idle, unread, absent : tuple of str
        Unknowns on which the cost does not depend because modes have collapsed, because no function of the model reads
        them, or because they are read only by modes that do not occur, as in `Fit`.

    See Also
    --------
    identifiability, Direction, profile

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> found = fit.identifiability
    >>> found.condition_number < 100, found.undetermined
    (True, 0)
    """

    theta_names: tuple[str, ...]
    theta_units: tuple[str, ...]
    is_time: NDArray[np.bool_]
    rise: float
    meaning: Meaning
    where: Literal["solution", "first guess"]
    cost: float
    eigenvalues: FloatArray = field(default_factory=lambda: np.zeros(0))
    without: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    directions: tuple[Direction, ...] = ()
    tried: bool = False
    idle: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()

    def __repr__(self) -> str:
        worst = self.directions[0].summary if self.directions else ""
        return format_line(self, join_first(self.theta_names), f"condition number = {self.condition_number:.2g}", worst)

    @property
    def condition_number(self) -> float:
        """Condition number of the scaled Hessian; infinite if it is singular."""
        if not len(self.eigenvalues) or self.without or self.eigenvalues[0] <= UNDETERMINED_COMBINATION:
            return np.inf if len(self.eigenvalues) or self.without else np.nan
        return float(self.eigenvalues[-1] / self.eigenvalues[0])

    @property
    def undetermined(self) -> int:
        """Number of combinations that the data do not determine at all."""
        return len(self.without) + int(np.sum(self.eigenvalues < UNDETERMINED_COMBINATION))


def identifiability(subject: SolvedFit | Problem) -> Identifiability:
    """Return how well the data determine the unknowns, at the solution of a fit or, before any fit, at the first guess.

    Parameters
    ----------
    subject : Estimate or Problem

    Returns
    -------
    Identifiability

    Raises
    ------
    TypeError
        For anything else.
    ValueError
        If a parameter of the problem changes the cost while its derivative is zero: a switch hidden in a function.

    See Also
    --------
    profile, Estimate.correlation

    Examples
    --------
    >>> problem = heater_problem()

    >>> found = sf.identifiability(problem)
    >>> found.where, found.undetermined
    ('first guess', 0)
    """
    if isinstance(subject, Problem):
        return _analyse_first_guess(subject)
    if isinstance(subject, SolvedFit):
        return analyse_solution(subject, None if subject.problem is None else subject.evaluator_at_solution())
    raise TypeError(f"identifiability needs an sf.Estimate or an sf.Problem; got {type(subject).__name__}.")


def analyse_solution(fit: Fit, evaluator: Evaluator | None) -> Identifiability:
    """Analyze the solution of a fit; without an evaluator, J is not evaluated along the directions.

    Parameters
    ----------
    fit : Fit
    evaluator : Evaluator or None
    """
    meaning: Meaning
    if fit.sigma_known is None:
        rise, meaning = 0.01 * abs(fit.cost), "1 % of J"
    else:
        scale = fit.variance_scale if fit.freedom > 0 else 1.0
        # The likelihood ratio 2 (J - J_0) / scale is at the square of the quantile there.
        rise, meaning = 0.5 * scale * fit.quantile(0.95) ** 2, "noise"
    about = Identifiability(fit.theta_names, fit.theta_units, fit.is_time, rise, meaning, "solution", fit.cost)
    about = replace(about, idle=fit.idle, unread=fit.unread, absent=fit.absent)
    cost = None if evaluator is None else _limit_cost(evaluator, fit.theta)
    return analyse(about, fit.hessian, fit.free_basis, fit.theta, cost)


def _analyse_first_guess(problem: Problem) -> Identifiability:
    """Analyze a problem at its first guess, with Measurements replaced by data simulated there."""
    theta, unknowns = problem.initial_theta, problem.unknowns
    own = evaluator_of(problem)
    refuse_hidden_switches(own, theta, own(theta).gradient)
    items = [item for run in problem.experiments for item in run.data]
    meaning: Meaning
    base = np.nan
    if all(isinstance(item, Measurements) for item in items):
        comparisons = compare(own, theta)[1]
        fitted = {(e, k): found.fitted for e, run in enumerate(comparisons) for k, found in enumerate(run)}
        clean = replace_values(problem, fitted)
        evaluator = Evaluator(clean, meshes=own.meshes)
        # If sigma is a parameter, J has no minimum without noise; its expected Hessian is the Gauss-Newton matrix.
        # Of data that the guess itself makes: residuals are 0, so that curvature shows what noise would hide, whatever
        # the log says.
        hessian = evaluator(theta, matrix="exact" if problem.is_least_squares else "gauss-newton").hessian
        if all(item.sigma is not None for item in items):
            rise, meaning = 0.5 * float(special.ndtri(0.975)) ** 2, "noise"
        else:
            rise, meaning = 1e-4 * float(measure_variation(clean).sum()), "1 % of variation"
    else:
        evaluator = own
        here = own(theta, matrix="gauss-newton")
        hessian, base = here.hessian, here.cost
        rise, meaning = 0.01 * abs(here.cost), "1 % of J"
    subject = unknowns.names, unknowns.units, unknowns.is_time
    about = Identifiability(*subject, rise, meaning, "first guess", base, **find_unread(problem)._asdict())
    # J of clean data has no slope, and guards no multipliers: its own curvature counts, along the guards.
    basis = null_space(own.constrained(theta).jacobian) if problem.constraint_names else np.eye(len(theta))
    return analyse(about, hessian, basis, theta, _limit_cost(evaluator, theta))


def _limit_cost(evaluator: Evaluator, centre: FloatArray) -> Cost:
    """Return J as a function of theta, NaN where bounds or the order of times are violated; not so at the centre, which
    may be on a constraint up to rounding.
    """

    def compute_cost(theta: FloatArray) -> float:
        is_allowed = theta is centre or bool(np.all(evaluator.problem.constraints.slack(theta) >= 0))
        return evaluator(theta).cost if is_allowed else np.nan

    return compute_cost


def analyse(
    about: Identifiability, hessian: FloatArray, basis: FloatArray, theta: FloatArray, cost: Cost | None
) -> Identifiability:
    """Return the badly determined directions of a Hessian, tested with the cost it belongs to.

    Parameters
    ----------
    about : Identifiability
        What is known before.
    hessian : (d, d)
    basis : (d, k)
        Orthonormal basis of the free directions.
    theta : (d,)
    cost : callable ``theta -> J``, or None
        NaN where theta is not feasible. With None, J is not evaluated along the directions.
    """
    names = np.array(about.theta_names, dtype=object)
    free = np.abs(basis).max(1, initial=0.0) > 1e-9
    about = replace(about, held=tuple(names[~free]), tried=cost is not None)
    if not free.any() or not np.isfinite(hessian).all():
        return about
    # Unknowns on which the cost does not depend at all are reported separately.
    without = moves_by_itself(basis) & np.all(hessian == 0.0, axis=1)
    values, vectors, size = compute_scaled_spectrum(hessian, basis)
    kept = ~(np.sum(vectors[without] ** 2, axis=0) > 0.5)
    values, vectors = values[kept], vectors[:, kept]
    shown = min(max(int(np.sum(values < WEAK)), 1), MOST_DIRECTIONS)  # the worst in any case
    directions = []
    for value, v in zip(values[:shown].tolist(), vectors.T[:shown], strict=True):
        # An eigenvector has no sign of its own: the largest entry is made positive.
        v = v * np.sign(v[np.argmax(np.abs(v))])
        change, rises = _try_direction(size * v, value, theta, cost, about.rise)
        strong = [i for i in np.argsort(-np.abs(v), kind="stable") if abs(v[i]) > LEAST_NAMED_WEIGHT * np.abs(v).max()]
        directions.append(Direction(value, v, change, rises, tuple(names[strong])))
    return replace(about, eigenvalues=values, without=tuple(names[without]), directions=tuple(directions))


def _try_direction(
    direction: FloatArray, eigenvalue: float, theta: FloatArray, cost: Cost | None, rise: float
) -> tuple[FloatArray, tuple[float, float]]:
    """Return the change along a direction (d,) at which J should rise by `rise`, and its actual rises on both sides."""
    known = theta != 0
    # No unknown moves by more than its own size, if it is not zero.
    # A flat direction would have a step without end: an unknown that changes by its own size says enough.
    share = np.max(np.abs(direction[known] / theta[known]), initial=0.0)
    reach = 1.0 / float(share or np.max(np.abs(direction)))
    # J rises by eigenvalue length^2 / 2 along a unit vector of the scaled Hessian.
    length = min(np.sqrt(2 * rise / eigenvalue), reach) if eigenvalue > 0 else reach
    change = length * direction
    if cost is None or not rise > 0:
        return change, (np.nan, np.nan)
    here = cost(theta)
    rises = (np.nan, np.nan)
    for _ in range(HALVINGS_ALONG_DIRECTION):
        rises = cost(theta + change) - here, cost(theta - change) - here
        # fmax passes over NaN: where one side is not feasible, the other one decides.
        if np.fmax(*rises) <= 2 * rise:
            break
        change = 0.5 * change
    return change, rises
