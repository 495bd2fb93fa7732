"""The numbers of a fit: plain data that can be saved, loaded, printed and plotted without the model.

Covariances and intervals follow from these numbers: the exact Hessian, inverted on the free directions, and the slopes
at kinks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Engine
from switchfit.fit.comparison import Comparison
from switchfit.fit.kink_variance import free_kinks
from switchfit.fit.layout import Layout
from switchfit.fit.scaled_hessian import inverse_on
from switchfit.fit.search_record import SearchRecord
from switchfit.fit.statistics import interval, measure_quantile
from switchfit.fit.termination import Termination
from switchfit.fit.trajectory import Trajectory
from switchfit.problem.validation.arrays import as_level

if TYPE_CHECKING:  # a float or an array: what does arithmetic with both needs no cast
    Values = Mapping[str, Any]
else:  # what files are read as
    Values = Mapping[str, FloatArray]

FitKind = TypeVar("FitKind", bound="Fit")


@dataclass(frozen=True)
class FittedTransition:
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


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """The end of a fit in numbers.

    Attributes
    ----------
    theta : (d,)
    transition_times : tuple of (N,) arrays, one per experiment, fixed ones included
    parameters : dict of name -> float, or array where there are several, fixed ones included
    gradient, hessian : (d,), (d, d), exact at theta
    hessian_kind : str
        The argument of `estimate`; "sharp" where the Gauss-Newton matrix took the place of an exact Hessian that was
        not accurate.
    constraints : tuple of (name, value, multiplier)
        Guards and terminal constraints. With them the Hessian is that of J plus multipliers times constraints.
    free_basis : (d, k)
        Orthonormal basis of the directions that constraints and kinks leave free.
    engine : Engine or None
        Engine of cost and derivatives: machine code, or JAX with the reason. None if it is unknown.
    integration_error : float
        Largest relative change by halving all steps of J, the guards and the terminal constraints; see
        `Certificate.integration_error`.
    integration_error_of : str
        The output that has the `integration_error`: "J", or the name of a guard or terminal constraint.
    """

    theta: FloatArray
    transition_times: tuple[FloatArray, ...]
    parameters: Values
    gradient: FloatArray
    hessian: FloatArray
    hessian_kind: str
    constraints: tuple[tuple[str, float, float], ...] = ()
    free_basis: FloatArray
    engine: Engine | None = None
    integration_error: float
    integration_error_of: str = "J"

    def __post_init__(self) -> None:
        plain = {name: float(v) if np.ndim(v) == 0 else np.asarray(v) for name, v in self.parameters.items()}
        object.__setattr__(self, "parameters", plain)


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Termination, Layout, Solution, SearchRecord):
    """Result of an estimation: the fields of its four records, and what follows from them.

    How it ended (`Termination`), what its numbers stand for (`Layout`), these numbers (`Solution`), and how they were
    found (`SearchRecord`). `dataclasses.replace` changes any field.

    Attributes
    ----------
    trajectories : tuple of Trajectory, one per experiment
    comparisons : tuple of tuples of Comparison, one tuple per experiment
    saved_gauss_newton : (d, d) or None
        The Gauss-Newton matrix of the samples, if it has been evaluated.
    saved_pieces : (T, 2, P, 5)
        Of transition times whose intervals follow from them, in a fit that was saved: as `Fits.pieces`.
    saved_piece_places : (T,) int
        Where in theta these transition times stand.
    """

    trajectories: tuple[Trajectory, ...]
    comparisons: tuple[tuple[Comparison, ...], ...]
    saved_gauss_newton: FloatArray | None = None
    saved_pieces: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 1, 5)))
    saved_piece_places: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    __eq__, __hash__ = object.__eq__, object.__hash__

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
    def transitions(self) -> list[FittedTransition]:
        """All transitions, experiment by experiment, fixed ones included."""
        single = len(self.trajectories) == 1
        found = []
        each = zip(self.run_names, self.trajectories, self.transition_times, self.transition_places, strict=True)
        for e, (run, trajectory, times, places) in enumerate(each):
            modes = [mode for mode, _, _ in trajectory.mode_spans]
            for i, (time, place) in enumerate(zip(times.tolist(), places.tolist(), strict=True)):
                name, label = (f"tau_{i + 1}", "") if single else (f"{run}.tau_{i + 1}", run)
                index = place if place >= 0 else None
                found.append(
                    FittedTransition(e, label, name, time, trajectory.time_unit, modes[i], modes[i + 1], index)
                )
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


def build_fit(
    kind: type[FitKind], termination: Termination, layout: Layout, solution: Solution, search: SearchRecord, **own: Any
) -> FitKind:
    """Return a fit of a kind that is made of these records; `own`: the fields that are in none of them.

    Parameters
    ----------
    kind : type
        `Fit` or a subclass.
    termination : Termination
    layout : Layout
    solution : Solution
    search : SearchRecord
    own
    """
    return kind(**vars(termination), **vars(layout), **vars(solution), **vars(search), **own)


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
