"""The numbers of a fit: plain data that can be saved, loaded, printed and plotted without the model.

How a fit ended, as data from which the report writes its message.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Engine
from switchfit.fit.trajectory import Comparison, Trajectory
from switchfit.optimize import IterationRecord, Result, Status
from switchfit.optimize.result import LineSearchFailure
from switchfit.optimize.threads import one_thread
from switchfit.problem.comparisons import find_comparisons
from switchfit.problem.constraints import ActiveConstraint
from switchfit.problem.problem import Problem
from switchfit.problem.reads import find_unread
from switchfit.problem.validation.arrays import as_level
from switchfit.runtime import special
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed

NAMED = 4
"""Largest number of unknowns named for a flat direction."""

SMALL_WEIGHT = 0.1
"""Unknowns with a weight below this in a direction of unit length are not named."""

Rival = tuple[str, float, float]

UNDETERMINED = 1e-14
"""Eigenvalue of the Hessian, scaled to a diagonal of one, up to which a direction is not determined."""

PART = 1e-6
"""Component of an unknown in such a direction above which the unknown has no standard error."""

STEEP = 100.0
"""Slope at a kink, times the standard deviation of the parabola beside it, from which on the curvature is left out: it
changes the variance by less than 1e-3, and further out integrals with it lose all digits."""


@dataclass(frozen=True)
class Kink(Printed):
    """An unknown that ended where the derivative of the cost jumps through zero; print it for a short sentence.

    Its standard error follows from both derivatives and the curvature, see `Fit.covariance`.

    Attributes
    ----------
    unknown : str
    value : float
        Value of the unknown at the kink.
    left, right : float
        Derivatives of J on both sides of it.

    See Also
    --------
    Estimate.kinks, Status

    Examples
    --------
    >>> kink = sf.Kink("tau_1", value=2.0, left=-0.3, right=0.4)
    >>> kink.left < 0 < kink.right
    True
    """

    unknown: str
    value: float
    left: float
    right: float


@dataclass(frozen=True)
class Termination(Printed):
    """How a fit ended; print it for the message. The fields are those of `Fit` of the same names.

    Attributes
    ----------
    status : Status
    cost, optimality, tolerance : float
    iterations, earlier_iterations : int
        All iterations, and those before the last refinement of the mesh.
    active : tuple of ActiveConstraint
    kinks : tuple of Kink
    idle : tuple of str
    smallest_eigenvalue : float
        Smallest eigenvalue of the Hessian on the free directions, each unknown scaled to unit curvature, if the status
        is SADDLE or SINGULAR; else NaN.
    flat_direction : tuple of (str, float)
        Unknowns with the largest components of its eigenvector, and these components.
    violated : tuple of (str, float)
        Guards and terminal constraints that are violated, and their values.
    reason : Issue or None
        Why the line search failed, or the error with which the fit ended. If a function compares with an unknown, and
        the fit ended at a jump of J in it or with a large integration error, a "switch": the unknown, which function
        and where; also of a fit that has converged.
    unread, absent : tuple of str

    See Also
    --------
    Estimate.termination, Status

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> fit.termination.status.name
    'CONVERGED'
    >>> bool(fit.termination.optimality < 1e-7)
    True
    """

    status: Status
    cost: float = np.nan
    optimality: float = np.nan
    tolerance: float = np.nan
    iterations: int = 0
    earlier_iterations: int = 0
    active: tuple[ActiveConstraint, ...] = ()
    kinks: tuple[Kink, ...] = ()
    idle: tuple[str, ...] = ()
    smallest_eigenvalue: float = np.nan
    flat_direction: tuple[tuple[str, float], ...] = ()
    violated: tuple[tuple[str, float], ...] = ()
    reason: Issue | None = None
    unread: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()


def termination_of(result: Result, problem: Problem, earlier: int = 0) -> Termination:
    """Return how a fit ended, from the optimizer's result.

    Parameters
    ----------
    result : Result
        In theta; its constraints are those of the problem.
    problem : Problem
    earlier : int
        Iterations before, on coarser meshes, where the optimizer resumed a fit.
    """
    names = problem.unknowns.names
    multipliers = dict(zip(problem.constraints.names, result.multipliers.tolist(), strict=True))
    smallest: float = np.nan
    flat: tuple[tuple[str, float], ...] = ()
    if result.status in (Status.SADDLE, Status.SINGULAR):  # eigenvalues take time, and no other status needs them
        smallest, direction = result.smallest_eigenvalue, result.curvature.spectrum.lowest
        largest = [i for i in np.argsort(-np.abs(direction), kind="stable") if abs(direction[i]) > SMALL_WEIGHT]
        flat = tuple((names[i], float(direction[i])) for i in largest[:NAMED])
    same = {name: getattr(result, name) for name in ("status", "cost", "optimality", "tolerance", "violated")}
    return Termination(
        **same,
        iterations=earlier + result.iterations,
        earlier_iterations=earlier,
        active=tuple(ActiveConstraint(**vars(each), multiplier=multipliers[each]) for each in result.active),
        kinks=tuple(Kink(names[i], float(result.theta[i]), left, right) for i, left, right in result.kinks),
        idle=tuple(names[i] for i in result.idle),
        smallest_eigenvalue=smallest,
        flat_direction=flat,
        reason=None if result.reason is None else _describe_failure(result, result.reason, problem),
        **find_unread(problem)._asdict(),
    )


def _describe_failure(result: Result, found: LineSearchFailure, problem: Problem) -> Issue | None:
    """Return why the line search failed, with the names of the unknowns; of a fit that has converged a "switch" alone.

    A jump of J is a switch if a function compares with the unknown: where, is the second subject of the issue.
    """
    names, comparisons = problem.unknowns.names, find_comparisons(problem) if found.kind == "jump" else {}
    for i, value in found.places:
        if i in comparisons:
            return Issue("switch", (names[i], comparisons[i]), {**found.figures, "at": value})
    if result.status.successful:
        return None
    figures: dict[str, float | tuple[float, ...]] = {**found.figures}
    if found.places:
        figures["at"] = tuple(value for _, value in found.places)
    if problem.estimates_delays:
        figures["delayed"] = 1.0
    return Issue(found.kind, tuple(names[i] for i, _ in found.places), figures)


if TYPE_CHECKING:  # a float or an array: what does arithmetic with both needs no cast
    Values = Mapping[str, Any]
else:  # what files are read as
    Values = Mapping[str, FloatArray]


@dataclass(frozen=True)
class Transition:
    """One transition of one experiment.

    Attributes
    ----------
    experiment : int, from 0
    run : str
        The experiment's name; empty if there is only one.
    name : str
        As in `Fit.theta_names`.
    time : float
    unit : str
        That of the experiment's times.
    before, after : str
        Modes before and after it.
    index : int or None
        Its index in theta; None if it is fixed.
    """

    experiment: int
    run: str
    name: str
    time: float
    unit: str
    before: str
    after: str
    index: int | None


@dataclass(frozen=True)
class Step:
    """One strategy of a fit: the cost it reached and the work it took.

    Attributes
    ----------
    strategy : str
        "local", the fit from the first guess, or the name of another; "interrupted".
    cost : float
        The lowest J after it; infinite as long as the model could not be integrated, constraints are not met, or a fit
        without convergence has a large integration error.
    evaluations : int
    seconds : float
    ended : str
        Why the many starts ended: "settled", no further minimum was likely; "most", as many as are tried at most;
        "good", the lowest leaves nothing but noise; "time" or "interrupted". For another strategy "time" if the limit
        of time ended it, or the message of an error. Otherwise empty.

    See Also
    --------
    estimate, Estimate.steps

    Examples
    --------
    >>> [step.strategy for step in sf.estimate(heater_problem(), strategy="thorough").steps][0]
    'local'
    """

    strategy: str
    cost: float
    evaluations: int
    seconds: float
    ended: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Termination):
    """Result of an estimation; d unknowns in the order of `theta_names`.

    Attributes
    ----------
    theta_names, theta_units : tuple of str
    initial_theta, theta, lower, upper : (d,)
    run_names : tuple of str, one per experiment
        Its name, or run1, run2, ...
    transition_times : tuple of (N,) arrays, one per experiment, fixed ones included
    transition_places : tuple of (N,) int arrays, one per experiment
        Index in theta of each transition time; -1 if it is fixed.
    final_places : tuple of int, one per experiment
        Index in theta of its tf; -1 if it is fixed.
    parameters : dict of name -> float, or array where there are several, fixed ones included
    parameter_units : dict of name -> str, fixed ones included
    fixed : tuple of str
        Names of the parameters that are fixed.
    cost : float
    gradient, hessian : (d,), (d, d), exact at theta
    optimality : float
        KKT residual; the norm of the gradient if no constraint is active.
    iterations, evaluations : int
        Iterations of the fit that found theta; evaluations of everything that was tried.
    status : Status
    history : tuple of IterationRecord
        Of the fit that found theta. Where strategies were tried, it begins where one of them ended.
    active : tuple of ActiveConstraint
        Bounds, and shortest durations of modes, that hold with equality.
    kinks : tuple of Kink
        Unknowns that ended where the derivative jumps through zero.
    free_basis : (d, k)
        Orthonormal basis of the directions that constraints and kinks leave free.
    trajectories : tuple of Trajectory, one per experiment
    comparisons : tuple of tuples of Comparison, one tuple per experiment
    sigma_known : bool or None
        Whether the noise of the measurements is known; None if the cost has no noise model.
    integration_error : float
        Largest relative change by halving all steps of J, the guards and the terminal constraints; see
        `Certificate.integration_error`.
    hessian_kind : str
        The argument of `estimate`; "sharp" where the Gauss-Newton matrix took the place of an exact Hessian that was
        not accurate.
    tolerance : float
    seconds : float
        Wall time of the estimation, always in seconds.
    constraints : tuple of (name, value, multiplier)
        Guards and terminal constraints. With them the Hessian is that of J plus multipliers times constraints.
    saved_gauss_newton : (d, d) or None
        The Gauss-Newton matrix of the samples, if it has been evaluated.
    saved_pieces : (T, 2, P, 5)
        Of transition times whose intervals follow from them, in a fit that was saved: as `Fits.pieces`.
    saved_piece_places : (T,) int
        Where in theta these transition times stand.
    priors : dict of name -> str
        The prior of each unknown that has one, in words.
    log_scaled : tuple of str
        Unknowns that were estimated on a logarithmic scale.
    log_origins : (d,)
        From where these logarithms count: t0 for a transition time, otherwise 0.
    least_squares : bool
        Whether the terms of measurements and priors in J are half a sum of squares: no sigma is a parameter, no loss is
        robust.
    engine : Engine or None
        Engine of cost and derivatives: machine code, or JAX with the reason. None if it is unknown.
    integration_error_of : str
        The output that has the `integration_error`: "J", or the name of a guard or terminal constraint.
    idle : tuple of str
        Unknowns on which J does not depend because modes have collapsed: the transition times of a mode of zero
        duration between two intervals of the same mode, and parameters that act in collapsed modes alone. Their values
        are arbitrary, and they are not in `free_basis`.
    unread : tuple of str
        Parameters that no function of the model reads: J does not depend on them.
    absent : tuple of str
        Parameters that are read only by modes, or at transitions, that do not occur in any mode_sequence.
    earlier_iterations : int
        Iterations before the last refinement of the mesh.
    smallest_eigenvalue : float
        Smallest eigenvalue of the Hessian on the free directions, each unknown scaled to unit curvature, as found by
        the optimizer.
    flat_direction : tuple of (str, float)
        Unknowns with the largest components of its eigenvector, and these components.
    violated : tuple of (str, float)
        Guards and terminal constraints that are violated, and their values.
    reason : Issue or None
        Why the line search failed, or the error with which the fit ended.
    starts : (tried, better, agreeing) or None
        Numbers of other starts that were fitted, that ended lower than this fit, and that ended at its J; None without
        other starts.
    rivals : tuple of (unknown, value, rise)
        Transition times of other minima that the data do not tell from this one, and by how much J is higher there.
    steps : tuple of Step
        The strategies that were tried, in order; empty if the first fit was enough.
    initial_cost : float
        J at `initial_theta`; NaN if it is unknown or cannot be evaluated there.
    """

    theta_names: tuple[str, ...]
    theta_units: tuple[str, ...]
    initial_theta: FloatArray
    theta: FloatArray
    lower: FloatArray
    upper: FloatArray
    run_names: tuple[str, ...]
    transition_times: tuple[FloatArray, ...]
    transition_places: tuple[NDArray[np.intp], ...]
    final_places: tuple[int, ...]
    parameters: Values
    parameter_units: Mapping[str, str]
    fixed: tuple[str, ...]
    gradient: FloatArray
    hessian: FloatArray
    evaluations: int
    history: tuple[IterationRecord, ...]
    free_basis: FloatArray
    trajectories: tuple[Trajectory, ...]
    comparisons: tuple[tuple[Comparison, ...], ...]
    sigma_known: bool | None
    integration_error: float
    hessian_kind: str
    seconds: float
    log_origins: FloatArray
    constraints: tuple[tuple[str, float, float], ...] = ()
    saved_gauss_newton: FloatArray | None = None
    saved_pieces: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 1, 5)))
    saved_piece_places: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    priors: Mapping[str, str] = field(default_factory=dict)
    log_scaled: tuple[str, ...] = ()
    least_squares: bool = True
    engine: Engine | None = None
    integration_error_of: str = "J"
    starts: tuple[int, int, int] | None = None
    rivals: tuple[Rival, ...] = ()
    steps: tuple[Step, ...] = ()
    initial_cost: float = np.nan

    __eq__, __hash__ = object.__eq__, object.__hash__

    def __post_init__(self) -> None:
        plain = {name: float(v) if np.ndim(v) == 0 else np.asarray(v) for name, v in self.parameters.items()}
        object.__setattr__(self, "parameters", plain)

    @property
    def termination(self) -> Termination:
        """How the fit ended, as data."""
        return Termination(**{f.name: getattr(self, f.name) for f in fields(Termination)})

    @property
    def message(self) -> str:
        """How the fit ended, in a sentence or two, and what to do next."""
        return str(self.termination)

    @property
    def transition_dates(self) -> tuple[tuple[datetime, ...] | None, ...]:
        """`transition_times` as dates, one tuple per experiment; None for an experiment whose times are no dates.

        They are `datetime.datetime`, which have a time zone and microseconds; the type of NumPy has no zone.
        """
        each = zip(self.trajectories, self.transition_times, strict=True)
        return tuple(
            None if run.origin is None else tuple(run.origin.to_dates(times, run.time_unit)) for run, times in each
        )

    @property
    def final_times(self) -> tuple[float, ...]:
        """tf of each experiment, estimated or given."""
        return tuple(float(trajectory.times[-1]) for trajectory in self.trajectories)

    @property
    def is_time(self) -> NDArray[np.bool_]:
        """Which of the unknowns are transition times or a free tf: (d,)."""
        return np.isin(np.arange(len(self.theta_names)), [*np.concatenate(self.transition_places), *self.final_places])

    @property
    def transitions(self) -> list[Transition]:
        """All transitions, experiment by experiment, fixed ones included."""
        single = len(self.trajectories) == 1
        found = []
        each = zip(self.run_names, self.trajectories, self.transition_times, self.transition_places, strict=True)
        for e, (run, trajectory, times, places) in enumerate(each):
            modes = [mode for mode, _, _ in trajectory.mode_spans]
            for i, (time, place) in enumerate(zip(times.tolist(), places.tolist(), strict=True)):
                name, label = (f"tau_{i + 1}", "") if single else (f"{run}.tau_{i + 1}", run)
                index = place if place >= 0 else None
                found.append(Transition(e, label, name, time, trajectory.time_unit, modes[i], modes[i + 1], index))
        return found

    @property
    def trajectory(self) -> Trajectory:
        """The fitted trajectory of the only experiment; with several experiments, use `trajectories`."""
        if len(self.trajectories) > 1:
            raise ValueError(f"There are {len(self.trajectories)} experiments: use .trajectories[e].")
        return self.trajectories[0]

    @property
    def initial_state(self) -> tuple[FloatArray, ...]:
        """The state at t0 of each experiment, with estimated and known entries: (n,) arrays."""
        return tuple(trajectory.states[0] for trajectory in self.trajectories)

    @property
    def samples(self) -> int:
        """Number of measured values that are not missing."""
        discrete = (c for run in self.comparisons for c in run if c.kind == "measurements")
        return sum(int(np.isfinite(comparison.measured).sum()) for comparison in discrete)

    @property
    def residual_variance(self) -> float:
        """``2 J / (samples + priors - free unknowns)``: near 1 if sigma is right.

        NaN without measurements, and if J is not a sum of squares (`least_squares`).
        """
        freedom = self.freedom
        judged = self.sigma_known is not None and self.least_squares and freedom > 0
        return 2 * self.cost / freedom if judged else np.nan

    @property
    def variance_scale(self) -> float:
        """By what the inverse of the Hessian is multiplied: 1 if sigma is known, the residual variance if it is not.

        NaN if the cost has no noise model.
        """
        return 1.0 if self.sigma_known else self.residual_variance

    @property
    def freedom(self) -> int:
        """Degrees of freedom: number of measured values and priors minus number of free unknowns."""
        return self.samples + len(self.priors) - self.free_basis.shape[1]

    @property
    def gauss_newton(self) -> FloatArray | None:
        """The Gauss-Newton matrix of the samples and priors: (d, d); None if it is unknown."""
        return self.saved_gauss_newton

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of theta from the exact Hessian on the free directions: (d, d).

        ``Z (Z' H Z)^-1 Z'``, times the residual variance if sigma is unknown. With priors it is the covariance of the
        posterior (Laplace's approximation). With a robust loss it is valid for noise with the loss as negative
        log-likelihood. A sigma that is a parameter is an unknown like others. An unknown at a kink has the second
        moment about theta of the density exp(-J), J having both slopes of the kink and the curvature beside it, and
        the unknowns that follow it have larger variances (`free_kinks`). An unknown held by a bound or a collapsed
        mode has variance 0 here; so has one at a kink if there are guards, terminal constraints or modes that are as
        short as they may be. NaN if the cost has no noise model (anything but `Measurements`) or there are too few
        samples, and for unknowns with a component in a direction along which the Hessian is not positive; the others
        keep their variances.
        """
        return self.variance_scale * invert(self, self.hessian, self.variance_scale)

    @cached_property
    def held_covariance(self) -> FloatArray:
        """`covariance` on the free directions alone: (d, d). Unknowns at kinks have variance 0."""
        if not self.kinks:
            return self.covariance
        return self.variance_scale * inverse_on(self.free_basis, self.hessian)

    @property
    def standard_errors(self) -> FloatArray:
        """Square roots of the variances: (d,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> FloatArray:
        """Correlation matrix of theta: (d, d); NaN for unknowns that are held."""
        errors = self.standard_errors
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.covariance / np.outer(errors, errors))

    def quantile(self, level: float) -> float:
        """Return the two-sided quantile: of Student's t if sigma is unknown, else of the normal distribution.

        See Also
        --------
        Estimate.confidence_intervals

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> round(fit.quantile(0.95), 2)
        1.96
        """
        return float(measure_quantile(as_level(level), max(self.freedom, 1), self.sigma_known))

    def confidence_intervals(self, level: float = 0.95) -> FloatArray:
        """Return the intervals theta +- quantile x standard error, cut off at the bounds: (d, 2).

        For unknowns on a logarithmic scale, theta is multiplied and divided by exp(quantile x relative standard
        error). At a kink too: the standard error allows for both slopes there, and an `Estimate` with its model has an
        interval that is not symmetric. NaN for an unknown that is held by a bound or a collapsed mode: use `profile`.

        Parameters
        ----------
        level : float, between 0 and 1
            The quantile is that of Student's t if sigma is unknown, of the normal distribution if it is known.

        See Also
        --------
        profile, bootstrap

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.confidence_intervals(0.95).round(2)
        array([[2.43, 2.5 ],
               [0.38, 0.4 ]])
        """
        return self.build_intervals(self.quantile(level) * self.standard_errors)

    def build_intervals(self, half: FloatArray) -> FloatArray:
        """Return the intervals theta +- half (d,), cut off at the bounds, as of `confidence_intervals`: (d, 2).

        See Also
        --------
        Estimate.confidence_intervals

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> bool((fit.build_intervals(0.0 * fit.theta + 1.0)[:, 1] == fit.theta + 1.0).all())
        True
        """
        log = np.isin(self.theta_names, self.log_scaled)
        low, high = interval(self.theta, np.where(half > 0, half, np.nan), log, self.log_origins).T
        return np.stack([np.maximum(low, self.lower), np.minimum(high, self.upper)], axis=1)


def measure_quantile(level: float, freedom: Any, sigma_known: bool | None) -> Any:
    """Return the two-sided quantiles of fits with these degrees of freedom, as of `Fit.quantile`: (R,)."""
    tail = 0.5 + level / 2
    return special.stdtrit(freedom, tail) if sigma_known is False else np.full(np.shape(freedom), special.ndtri(tail))


def count_samples(problem: Problem) -> int:
    """Return the measured values that are not missing."""
    return sum(item.count for item in problem.measurements)


def count_priors(problem: Problem) -> int:
    """Return the unknowns that have a prior."""
    return int(np.count_nonzero(problem.unknowns.priors.precision))


def measure_variance(cost: Any, freedom: Any, sigma_known: bool | None) -> Any:
    """Return by what covariances are multiplied: 1 if sigma is known, the residual variance if not; NaN where neither
    is: (R,), or one number.
    """
    if sigma_known:
        return np.ones(np.shape(cost))
    there = (freedom > 0) & (sigma_known is False)
    return np.where(there, 2 * cost / np.maximum(freedom, 1), np.nan)


class Disagreement(NamedTuple):
    """Difference between the standard errors from the exact Hessian and from the Gauss-Newton matrix.

    Attributes
    ----------
    factor : float
        Largest ratio of the larger to the smaller one, over all linear combinations of the unknowns.
    name : str
        The unknown whose own standard errors differ the most.
    exact, gauss_newton : float
        Its standard errors.
    """

    factor: float
    name: str
    exact: float
    gauss_newton: float


@one_thread()
def disagreement(fit: Fit) -> Disagreement | None:
    """Compare the two covariances of a fit; None if one of them is unknown.

    The ratios of the two variances over all linear combinations of the unknowns lie between the smallest and the
    largest eigenvalue of ``A v = lambda H v`` on the free directions, A being the Gauss-Newton matrix. Unknowns at
    kinks are held: their variances are mostly those of the slopes, which both matrices share.
    """
    Z, A = fit.free_basis, fit.gauss_newton
    if A is None or fit.sigma_known is None or Z.shape[1] == 0:
        return None
    both = fit.held_covariance, fit.variance_scale * inverse_on(Z, A)
    if not all(np.isfinite(covariance).all() for covariance in both):
        return None
    errors = np.sqrt([np.diag(covariance) for covariance in both])
    ratios = []
    for one, other in ((fit.hessian, A), (A, fit.hessian)):  # of each the largest, which no rounding hides
        values, vectors, size = compute_scaled_spectrum(one, Z)
        root = size[:, None] * vectors / np.sqrt(values)  # root' one root = 1
        ratios.append(float(np.linalg.eigvalsh(root.T @ other @ root)[-1]))
    held = errors[0] <= 0
    changes = np.where(held, 0.0, np.abs(np.log(np.where(held, 1.0, errors[0]) / np.where(held, 1.0, errors[1]))))
    k = int(np.argmax(changes))
    return Disagreement(max(ratios) ** 0.5, fit.theta_names[k], float(errors[0][k]), float(errors[1][k]))


def interval(theta: FloatArray, half: FloatArray, log: NDArray[np.bool_], origin: FloatArray) -> FloatArray:
    """Return ``theta -+ half``, or if `log` ``o + (theta - o) exp(-+ half / (theta - o))``, o the origin: (..., 2)."""
    away = theta - origin
    with np.errstate(over="ignore"):  # of an unknown that is not told from 0
        factor = np.exp(np.where(log, half / np.where(log, away, 1.0), 0.0))
    low, high = (np.where(log, origin + end, theta) for end in (away / factor, away * factor))
    return np.stack([np.where(log, low, theta - half), np.where(log, high, theta + half)], axis=-1)


def inverse_on(Z: FloatArray, hessian: FloatArray) -> FloatArray:
    """Return ``Z (Z' H Z)^-1 Z'``: (d, d); NaN if H is not finite, or not positive definite on Z (d, k).

    If it is not positive definite in some directions, only unknowns with a component in these are NaN. For the others
    the pseudo-inverse is used: if one of many runs is not determined, the other runs keep their variances.
    """
    if not np.isfinite(hessian).all():
        return np.full(hessian.shape, np.nan)
    values, vectors, size = compute_scaled_spectrum(hessian, Z)
    kept = values > UNDETERMINED
    root = size[:, None] * vectors[:, kept] / np.sqrt(values[kept])
    inverse: FloatArray = root @ root.T
    part = np.abs(vectors[:, ~kept]).max(axis=1, initial=0.0)
    unknown = ~(part <= PART * np.linalg.norm(vectors, axis=1))
    inverse[unknown] = np.nan
    inverse[:, unknown] = np.nan
    return inverse


def invert(fit: Fit, matrix: FloatArray, scale: float) -> FloatArray:
    """Return the inverse of a matrix that stands for the Hessian of a fit, unknowns at kinks being free: (d, d).

    Parameters
    ----------
    fit : Fit
        Whose directions and kinks are taken. Kinks stay held if a guard, a terminal constraint or the shortest duration
        of a mode may tie them to other unknowns.
    matrix : (d, d)
    scale : float
        By what the inverse will be multiplied to become a covariance.
    """
    tied = bool(fit.constraints) or any(constraint.position is not None for constraint in fit.active)
    return free_kinks(inverse_on(fit.free_basis, matrix), matrix, [] if tied else list_kinks(fit), scale)


def list_kinks(fit: Fit) -> list[tuple[int, float, float]]:
    """Return where in theta each kink is, and the derivatives of J to its left and right, as `Result.kinks`."""
    return [(fit.theta_names.index(kink.unknown), kink.left, kink.right) for kink in fit.kinks]


def free_kinks(
    inverse: FloatArray, hessian: FloatArray, kinks: Sequence[tuple[int, float, float]], scale: float
) -> FloatArray:
    """Return the inverse of a Hessian, as of `inverse_on`, with the unknowns at kinks free as well: (d, d).

    The K unknowns at kinks are those that `inverse`, C, holds. If they move by x, the others follow by -C H_.K x, and
    with the slopes g of J at the kinks

        J = J0 + sum_k g_k(x_k) |x_k| + x' S x / 2,     S = H_KK - H_K. C H_.K.                                    (1)

    The density exp(-J / scale) of one kinked x has the second moment v scale (`measure_kink_variance`): the normal one
    with the curvature 1 / v has it too. With 1 / v in place of the diagonal of S, V is the inverse of S, and

        inverse = C + F V F',     F = E_K - C H_.K,                                                                  (2)

    the columns of F being how all unknowns follow. A smooth J, g = 0, has 1 / v = S_kk: (2) is then the inverse of H.

    Parameters
    ----------
    inverse : (d, d)
        Not scaled; what is NaN stays NaN, and does not follow.
    hessian : (d, d)
    kinks : sequence of (int, float, float)
        Where in theta each of them is, and the derivatives of J to its left and right.
    scale : float
        By what the inverse will be multiplied to become a covariance.
    """
    if not kinks or not (np.isfinite(hessian).all() and np.isfinite(scale)):
        return inverse
    places = [place for place, _, _ in kinks]
    follow = np.eye(len(hessian))[:, places] - np.nan_to_num(inverse) @ hessian[:, places]  # F
    S = hessian[places] @ follow  # (1)
    # In units of sqrt(scale), J / scale has the curvature S and the slopes g / sqrt(scale).
    with np.errstate(divide="ignore"):  # residuals of 0
        slopes = np.array([(-left, right) for _, left, right in kinks]) / np.sqrt(scale)
    variances = measure_kink_variance(slopes, np.diag(S))
    # V = D (1 + D S D - diag(D S D))^-1 D, D^2 = diag(v): also where v = 0.
    root = np.sqrt(variances)
    coupled = root[:, None] * S * root
    np.fill_diagonal(coupled, 1.0)
    if np.linalg.eigvalsh(coupled)[0] > UNDETERMINED:
        V = root[:, None] * np.linalg.inv(coupled) * root
    else:  # J is no minimum along all kinks together: each of them as if the others were held
        V = np.diag(variances)
    return np.asarray(inverse + follow @ V @ follow.T)  # (2)


def measure_kink_variance(slopes: FloatArray, curvatures: FloatArray) -> FloatArray:
    """Return the second moment about 0 of the density exp(-g |x| - s x^2 / 2), g on each side another: (K,).

    With u = g / sqrt(s), the integrals of 1, x and x^2 times the density of one side, x > 0, are

        Z = sqrt(pi / 2 s) erfcx(u / sqrt(2)),     M1 = (1 - g Z) / s,     M2 = (Z - g M1) / s,                      (1)

    M1 and M2 by parts, from s x exp(-J) = -d exp(-J) / dx - g exp(-J). Without curvature Z = 1 / g and M2 = 2 / g^3.
    The result is (M2 + M2) / (Z + Z) of both sides. It is 0, the unknown stays held, where there is no slope and no
    curvature, and where J falls again before it has risen by 1/2: g x + s x^2 / 2 has its maximum -g^2 / 2 s.

    Parameters
    ----------
    slopes : (K, 2)
        g, of both sides; below 0 is rounding.
    curvatures : (K,)
    """
    g, s = np.maximum(slopes, 0.0), curvatures[:, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u = g / np.sqrt(np.where(s > 0.0, s, 0.0))
        Z = np.sqrt(np.pi / (2.0 * s)) * special.erfcx(u / np.sqrt(2.0))
        M2 = (Z - g * (1.0 - g * Z) / s) / s  # (1)
        steep = ~(u < STEEP)
        Z, M2 = np.where(steep, 1.0 / g, Z), np.where(steep, 2.0 / g**3, M2)
        variances = M2.sum(axis=1) / Z.sum(axis=1)
    falls = (g**2 < -s).any(axis=1)
    return np.where(np.isfinite(variances) & ~falls, variances, 0.0)


def moves_by_itself(basis: FloatArray) -> NDArray[np.bool_]:
    """Return which unknowns may change alone, others being as they are: (d,); of an orthonormal basis (d, k)."""
    return np.asarray(np.sum(basis**2, axis=1) > 1.0 - PART)


def list_without_effect(fit: Fit) -> tuple[str, ...]:
    """Return the free parameters and initial states on which J does not depend, to second order.

    Those that no function reads which acts, and any other whose row of the Hessian is exactly 0, such as an entry of an
    array that no function reads. Those that a bound, a kink, a guard or a collapsed mode holds are not among them.
    """
    flat = np.all(fit.hessian == 0.0, axis=1) & ~fit.is_time
    flat |= np.isin(fit.theta_names, (*fit.unread, *fit.absent))
    flat &= moves_by_itself(fit.free_basis)
    return tuple(np.array(fit.theta_names, dtype=object)[flat].tolist())


@one_thread()
def compute_scaled_spectrum(hessian: FloatArray, Z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return eigenvalues (k,), ascending, and eigenvectors (d, k) of a Hessian (d, d) scaled to unit curvature of each
    unknown, on the directions Z (d, k), which need not be orthonormal; and the scaling (d,): an eigenvector times it is
    a direction in theta.

    Eigenvalues of the size of rounding, whose digits differ from processor to processor, are 0. NaN if the Hessian is
    not finite, or its numbers are near the limits of float64.
    """
    diagonal = np.abs(np.diag(hessian))
    size = 1 / np.sqrt(np.where(diagonal > np.finfo(float).tiny, diagonal, 1.0))
    basis = np.linalg.qr(Z / size[:, None])[0]
    basis[~Z.any(axis=1)] = 0.0  # exactly, for what is held
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = basis.T @ (hessian * np.outer(size, size)) @ basis
    if not np.isfinite(scaled).all():
        return np.full(len(scaled), np.nan), np.full(basis.shape, np.nan), size
    values, vectors = np.linalg.eigh(scaled)
    rounding = len(values) * np.finfo(float).eps * np.abs(values).max(initial=0.0)
    return np.where(np.abs(values) > rounding, values, 0.0), basis @ vectors, size
