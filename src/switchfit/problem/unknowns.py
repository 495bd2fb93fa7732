"""The flat vector theta of everything that is estimated, and the linear constraints on it.

``theta`` holds the free transition times of the first experiment and its tf where it is free, of the second, ..., then
the free parameters in the order given, then the unknown entries of the initial states, again experiment by experiment.
Everything that is fixed stays out of it.

The linear constraints on theta as data: order and durations of the modes, and bounds.

Variables of the optimizer: unknowns scaled to the size of one, or their logarithms.

    theta = s z,  or  theta = o + exp(z):      d theta / dz = D,    g_z = D g,    H_z = D H D + diag(E g),

with E = d^2 theta / dz^2, 0 or theta - o. Unknowns whose size is near one are not scaled: s = 1. The origin o of a
logarithm is 0; for a transition time it is the t0 of its experiment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import Experiment, initial_state_of, name_runs, prefix_runs
from switchfit.problem.parameter import Parameter, PriorTerms, unit_suffix
from switchfit.problem.system import HybridSystem
from switchfit.problem.validation import join_names
from switchfit.runtime.presentation import Printed

ConstraintKind = Literal["collapsed", "minimum duration", "lower bound", "upper bound", "known jump"]


@dataclass(frozen=True)
class Constraint(Printed):
    """A linear constraint; print it for a sentence about it when it is active.

    Attributes
    ----------
    kind : {"collapsed", "minimum duration", "lower bound", "upper bound", "known jump"}
        "collapsed" is a minimum duration of 0: when it is active, the mode has zero duration. "known jump" is the bound
        of a transition time at the time of a `Jump`, on whose other side its guess does not lie.
    value : float
        The minimum duration in the time unit of the run, or the bound in the unit of the unknown.
    unknown : str
        Name of the unknown that has the bound; empty for a duration.
    mode : str
        Name of the mode that has the duration; empty for a bound.
    position : int or None
        Index of that mode in the mode sequence, from 0; None for a bound.
    run : str
        Name of the experiment that has the mode; empty for a bound, and if there is only one experiment.
    """

    kind: ConstraintKind
    value: float
    unknown: str = ""
    mode: str = ""
    position: int | None = None
    run: str = ""


@dataclass(frozen=True)
class ActiveConstraint(Constraint):
    """A linear constraint that holds with equality at a solution; print it for a short sentence.

    Attributes
    ----------
    kind, value, unknown, mode, position, run : as in `Constraint`
    multiplier : float
        Its Lagrange multiplier, 0 or more: the decrease of J per unit by which the constraint is relaxed; where a
        transition time is at a sample time, of J on the side that the constraint allows.

    See Also
    --------
    Estimate.active : those of a fit.
    Termination, Issue

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> problem = heater_problem()
    >>> bounded = {**problem.parameters, "k": sf.Parameter(0.3, upper=0.35, unit="1/h")}
    >>> fit = sf.estimate(sf.Problem(problem.system, problem.experiments[0], bounded))
    >>> active = fit.active[0]
    >>> active.kind, active.unknown, active.value, active.multiplier > 0
    ('upper bound', 'k', 0.35, True)
    >>> print(active)
    k at its upper bound 0.35
    """

    multiplier: float = 0.0


ORDINARY = (1e-3, 1e3)
"""Range of sizes in which an unknown is not scaled; the tolerance on the gradient is then that of theta itself."""


SMALLEST = 1e-15
"""Part of its first guess that an unknown on a logarithmic scale keeps without a lower bound of its own. At 0 the cost
has no slope in the logarithm, and far below there is nothing left of its curvature but rounding."""


class Variables(NamedTuple):
    """The change of variables: ``size`` (d,), powers of 2, of a logarithm the first guess, ``log`` (d,) of bool, and
    ``origin`` (d,) of logarithms.
    """

    size: Any
    log: Any
    origin: Any = 0.0

    @classmethod
    def of(
        cls, theta: FloatArray, bounds: FloatArray, log: NDArray[np.bool_], keep: NDArray[np.bool_], origin: FloatArray
    ) -> Variables:
        """Return variables scaled by the first guess, or by the bounds if it is 0.

        Parameters
        ----------
        theta : (d,)
        bounds : (2, d), lower and upper
        log : (d,) of bool
        keep : (d,) of bool, unknowns that are not scaled
        origin : (d,)
        """
        largest = np.where(np.isfinite(bounds), np.abs(bounds), 0.0).max(axis=0)
        typical = np.where(theta != 0.0, np.abs(theta), largest)
        outside = (typical > 0) & ((typical < ORDINARY[0]) | (typical > ORDINARY[1])) & ~keep & ~log
        # A power of 2, so that scaling causes no rounding.
        size = 2.0 ** np.round(np.log2(np.where(outside, typical, 1.0)))
        return cls(np.where(log, np.abs(theta - origin), size), log, origin)

    @property
    def identity(self) -> bool:
        """Whether the variables equal theta."""
        return not self.log.any() and bool(np.all(self.size == 1.0))

    @np.errstate(over="ignore")  # a step too far on a logarithmic scale is refused, as J is not finite there
    def outward(self, z: Any, xp: Any = np) -> Any:
        """Return theta at z: (d,)."""
        return xp.where(self.log, self.origin + xp.exp(xp.where(self.log, z, 0.0)), self.size * z)

    def inward(self, theta: Any, xp: Any = np) -> Any:
        """Return z at theta (d,): of a logarithm, a bound at the origin is `SMALLEST` first guesses away from it."""
        away = theta - self.origin
        positive = xp.where(self.log, xp.where(away > 0, away, SMALLEST * self.size), 1.0)
        return xp.where(self.log, xp.log(positive), theta / self.size)

    def sizes_inward(self, sizes: FloatArray) -> FloatArray:
        """Return sizes of z for sizes of theta (d,); the size of a logarithm is 1."""
        return np.where(self.log, 1.0, sizes / self.size)

    def slopes(self, theta: Any, xp: Any = np) -> tuple[Any, Any]:
        """Return D and E at theta: (d,) each."""
        away = theta - self.origin
        return xp.where(self.log, away, self.size), xp.where(self.log, away, 0.0)

    def derivatives_outward(self, theta: Any, gradient: Any, hessian: Any, xp: Any = np) -> tuple[Any, Any]:
        """Return the gradient and Hessian in theta from those in z."""
        D, E = self.slopes(theta, xp)
        gradient = gradient / D
        return gradient, (hessian - xp.diag(E * gradient)) / xp.outer(D, D)

    def derivatives_inward(self, theta: Any, gradient: Any, hessian: Any, xp: Any = np) -> tuple[Any, Any]:
        """Return the gradient and Hessian in z from those in theta."""
        D, E = self.slopes(theta, xp)
        return D * gradient, hessian * xp.outer(D, D) + xp.diag(E * gradient)


@dataclass(frozen=True)
class Unknowns:
    """Where each unknown stands in theta, and the linear constraints on theta.

    A free tf stands behind the transition times of its experiment, and counts as one of them.

    Attributes
    ----------
    names, units : tuple of str, length d
    initial, lower, upper : (d,) arrays
    times : for each experiment the positions in theta of its `Experiment.times`, -1 where fixed: (N,) int arrays
    parameters : dict of name -> slice into theta of the free parameters
    initial_states : for each experiment the positions in theta of the entries of its initial state, -1 where it is not
        estimated: (n,) int arrays; (0,) where it is a function
    A, b : ordering and minimum durations as ``A theta >= b``, (m, d) and (m,)
    rows : tuple of Constraint, what each row of A theta >= b is
    priors : PriorTerms
    log : (d,) bool, whether an unknown is estimated on a logarithmic scale
    starts : tuple of float, t0 of each experiment
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    initial: FloatArray
    lower: FloatArray
    upper: FloatArray
    times: tuple[NDArray[np.intp], ...]
    parameters: Mapping[str, slice]
    initial_states: tuple[NDArray[np.intp], ...]
    A: FloatArray
    b: FloatArray
    rows: tuple[Constraint, ...]
    priors: PriorTerms
    log: NDArray[np.bool_]
    starts: tuple[float, ...]

    @cached_property
    def is_time(self) -> NDArray[np.bool_]:
        """Which of the unknowns are transition times or a free tf: (d,)."""
        return self.put_at_times(np.zeros(len(self.names), dtype=bool), [True] * len(self.times))

    def put_at_times(self, array: NDArray[Any], values: Sequence[Any]) -> NDArray[Any]:
        """Return an array (d,) with the value of each experiment in place of the entries of its free times."""
        changed = array.copy()
        for value, where in zip(values, self.times, strict=True):
            changed[where[where >= 0]] = value
        return changed

    @cached_property
    def origin(self) -> FloatArray:
        """From where a logarithm counts, (d,): t0 for a transition time or a free tf, otherwise 0."""
        return self.put_at_times(np.zeros(len(self.names)), self.starts)

    @cached_property
    def variables(self) -> Variables:
        """What the optimiser works with: logarithms, transition times as they are, other unknowns scaled."""
        bounds = np.array([self.lower, self.upper])
        return Variables.of(self.initial, bounds, self.log, keep=self.is_time, origin=self.origin)

    @cached_property
    def lowest(self) -> FloatArray:
        """Lower bounds, those of logarithms above their origins: (d,)."""
        return np.where(self.log, np.maximum(self.lower, self.origin + SMALLEST * self.variables.size), self.lower)

    @cached_property
    def log_times(self) -> NDArray[np.bool_]:
        """Which of the unknowns are transition times, or a free tf, on a logarithmic scale: (d,)."""
        return self.log & self.is_time

    @cached_property
    def log_names(self) -> tuple[str, ...]:
        """Names of the unknowns that are estimated on a logarithmic scale."""
        return tuple(name for name, log in zip(self.names, self.log, strict=True) if log)


def list_unknowns(
    system: HybridSystem,
    experiments: tuple[Experiment, ...],
    parameters: Mapping[str, Parameter],
    durations: Mapping[str, float],
) -> Unknowns:
    """Return the unknowns of a problem in their order, with bounds, priors, scales and the order of times.

    Parameters
    ----------
    system : HybridSystem
    experiments : tuple of Experiment
    parameters : mapping of str to Parameter
    durations : mapping of str to float
        Shortest time each mode may last.
    """
    names: list[str] = []
    units: list[str] = []
    pieces: list[Parameter] = []

    def add(name: str, unit: str, parameter: Parameter) -> slice:
        first = len(names)
        entries = [f"[{','.join(map(str, k))}]" for k in np.ndindex(parameter.shape)] if parameter.shape else [""]
        names.extend(f"{name}{entry}" for entry in entries)
        units.extend([unit] * parameter.value.size)
        pieces.append(parameter)
        return slice(first, len(names))

    where: list[NDArray[np.intp]] = []
    prefixes = prefix_runs(experiments)
    for prefix, experiment in zip(prefixes, experiments, strict=True):
        positions = np.full(len(experiment.times), -1, dtype=np.intp)
        for i, tau in enumerate(experiment.times):
            if not tau.fixed:
                name = f"tau_{i + 1}" if i < len(experiment.transition_times) else "tf"
                positions[i] = add(f"{prefix}{name}", experiment.time_unit, tau).start
        where.append(positions)
    spans = {name: add(name, q.unit, q) for name, q in parameters.items() if not q.fixed}
    states: list[NDArray[np.intp]] = []
    for prefix, experiment in zip(prefixes, experiments, strict=True):
        initial = initial_state_of(system, experiment)
        positions = np.full(0 if callable(initial) else len(initial), -1, dtype=np.intp)
        for k in range(len(positions)):
            if isinstance(initial[k], Parameter) and not initial[k].fixed:
                name = system.state_names[k] if system.state_names else f"x{k + 1}"
                unit = initial[k].unit or (system.state_units[k] if system.state_units else "")
                positions[k] = add(f"{prefix}{name}(t0)", unit, initial[k]).start
        states.append(positions)
    if len(set(names)) != len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"Two unknowns share a name: {join_names(twice)}; rename the parameter or the experiment.")
    columns = ([getattr(q, key).ravel() for q in pieces] for key in ("value", "lower", "upper"))
    value, lower, upper = (np.concatenate([np.zeros(0), *column]) for column in columns)
    priors = PriorTerms.join([PriorTerms.of(None, (0,)), *(PriorTerms.of(q.prior, q.shape) for q in pieces)])
    log = np.array([q.scale == "log" for q in pieces for _ in range(q.value.size)], dtype=bool)
    starts = tuple(experiment.t0 for experiment in experiments)
    A, b, rows = _build_ordering(experiments, where, len(names), durations)
    places = tuple(where), spans, tuple(states)
    return Unknowns(tuple(names), tuple(units), value, lower, upper, *places, A, b, rows, priors, log, starts)


def _build_ordering(
    experiments: tuple[Experiment, ...], where: list[NDArray[np.intp]], d: int, durations: Mapping[str, float]
) -> tuple[FloatArray, FloatArray, tuple[Constraint, ...]]:
    """Return rows ``tau_{i+1} - tau_i >= min_duration`` for every mode of every experiment with a free end."""
    rows, bounds, constraints = [], [], []
    labels, units = name_runs(experiments), {experiment.time_unit for experiment in experiments}
    is_log = any(tau.scale == "log" and not tau.fixed for experiment in experiments for tau in experiment.times)
    if (is_log or len(units) > 1) and any(durations.values()):
        raise ValueError(
            "min_duration must be 0 where transition times are on a logarithmic scale, or in different units "
            f"({join_names(sorted(units))}); got {max(durations.values())}."
        )
    for e, (experiment, positions) in enumerate(zip(experiments, where, strict=True)):
        run = "" if len(experiments) == 1 else labels[e]
        knots = experiment.ends_of_modes(experiment.initial_times)
        ends = np.concatenate([[-1], positions, [] if experiment.has_free_tf else [-1]]).astype(np.intp)
        known = np.where(ends < 0, knots, 0.0)
        for i, mode in enumerate(experiment.mode_sequence):
            dwell, unit = durations[mode], unit_suffix(experiment.time_unit)
            length = knots[i + 1] - knots[i]
            if length < dwell * (1 - 1e-12):
                raise ValueError(
                    f"min_duration is {dwell}{unit}, but the guess gives mode {i + 1} ({mode!r}){run and f' of {run}'} "
                    f"only {length:.6g}{unit}."
                )
            if ends[i] >= 0 or ends[i + 1] >= 0:
                row = np.zeros(d + 1)  # the last entry is that of times that are fixed
                row[ends[i + 1]] += 1.0
                row[ends[i]] -= 1.0
                rows.append(row[:-1])
                bounds.append(dwell - (known[i + 1] - known[i]))
                kind: ConstraintKind = "collapsed" if dwell == 0 else "minimum duration"
                constraints.append(Constraint(kind, dwell, mode=mode, position=i, run=run))
    return np.array(rows).reshape(len(rows), d), np.array(bounds), tuple(constraints)
