"""Unknowns of a problem: where each stands in the vector theta, with bounds, priors and order of times.

``theta`` holds the free transition times of the first experiment and its tf where it is free, of the second, ..., then
the free parameters in the order given, then the unknown entries of the initial states, again experiment by experiment.
Everything that is fixed stays out of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.problem.constraints import Constraint, ConstraintKind
from switchfit.problem.experiment import Experiment, initial_state_of, name_runs, prefix_runs
from switchfit.problem.functions import Shape
from switchfit.problem.parameter import Parameter
from switchfit.problem.priors import PriorTerms
from switchfit.problem.system import HybridSystem
from switchfit.problem.validation.messages import join_names, unit_suffix
from switchfit.problem.variables import LEAST_PART_OF_GUESS, Variables

N = TypeVar("N", bound=np.generic)


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
    times: tuple[IntArray, ...]
    parameters: Mapping[str, slice]
    initial_states: tuple[IntArray, ...]
    A: FloatArray
    b: FloatArray
    rows: tuple[Constraint, ...]
    priors: PriorTerms
    log: BoolArray
    starts: tuple[float, ...]

    @cached_property
    def is_time(self) -> BoolArray:
        """Which of the unknowns are transition times or a free tf: (d,)."""
        return self.put_at_times(np.zeros(len(self.names), dtype=bool), [True] * len(self.times))

    def put_at_times(self, array: NDArray[N], values: Sequence[float]) -> NDArray[N]:
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
        return np.where(
            self.log, np.maximum(self.lower, self.origin + LEAST_PART_OF_GUESS * self.variables.size), self.lower
        )

    @cached_property
    def log_times(self) -> BoolArray:
        """Which of the unknowns are transition times, or a free tf, on a logarithmic scale: (d,)."""
        return self.log & self.is_time

    def place(
        self, e: int, read: Iterable[tuple[str, Shape, tuple[int, ...]]], mapped: Mapping[str, str]
    ) -> NDArray[np.intp]:
        """Return the positions in theta of the p (M,) of experiment e: of the entries of parameters that a structure
        reads, under names that the experiment maps to those of the problem, then of free initial states.
        """
        states = self.initial_states[e]
        parts = [states[:0]]
        for name, _, entries in read:
            if entries:
                parts.append(self.parameters[mapped.get(name, name)].start + np.array(entries))
        return np.concatenate([*parts, states[states >= 0]]).astype(np.intp)

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

    # Transition times first, then parameters, then initial states: files of results and warm starts rely on this order.
    where: list[IntArray] = []
    prefixes = prefix_runs(experiments)
    for prefix, experiment in zip(prefixes, experiments, strict=True):
        # -1 for what is fixed, here and below: it has no place in theta.
        positions = np.full(len(experiment.times), -1, dtype=np.intp)
        for i, tau in enumerate(experiment.times):
            if not tau.fixed:
                name = f"tau_{i + 1}" if i < len(experiment.transition_times) else "tf"
                positions[i] = add(f"{prefix}{name}", experiment.time_unit, tau).start
        where.append(positions)
    spans = {name: add(name, q.unit, q) for name, q in parameters.items() if not q.fixed}
    states: list[IntArray] = []
    for prefix, experiment in zip(prefixes, experiments, strict=True):
        initial = initial_state_of(system, experiment)
        # A function of p has no unknown entries of its own: what it reads are parameters.
        entries = () if callable(initial) else tuple(initial)
        positions = np.full(len(entries), -1, dtype=np.intp)
        for k, entry in enumerate(entries):
            if isinstance(entry, Parameter) and not entry.fixed:
                name = system.state_names[k] if system.state_names else f"x{k + 1}"
                unit = entry.unit or (system.state_units[k] if system.state_units else "")
                positions[k] = add(f"{prefix}{name}(t0)", unit, entry).start
        states.append(positions)
    # A parameter may be called `tau_1`, or two experiments alike: results are looked up by these names.
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
    experiments: tuple[Experiment, ...], where: list[IntArray], d: int, durations: Mapping[str, float]
) -> tuple[FloatArray, FloatArray, tuple[Constraint, ...]]:
    """Return rows ``tau_{i+1} - tau_i >= min_duration`` for every mode of every experiment with a free end."""
    rows, bounds, constraints = [], [], []
    labels, units = name_runs(experiments), {experiment.time_unit for experiment in experiments}
    # The rows are linear in theta. In log(tau - t0) they would not be, and a duration in minutes is not one in seconds.
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
        # What the ends of a mode contribute to the right-hand side where they are no unknowns: t0, tf, fixed
        # transitions.
        known = np.where(ends < 0, knots, 0.0)
        for i, mode in enumerate(experiment.mode_sequence):
            dwell, unit = durations[mode], unit_suffix(experiment.time_unit)
            length = knots[i + 1] - knots[i]
            # Within rounding: a guess may be exactly one minimum duration apart.
            if length < dwell * (1 - 1e-12):
                raise ValueError(
                    f"min_duration is {dwell}{unit}, but the guess gives mode {i + 1} ({mode!r}){run and f' of {run}'} "
                    f"only {length:.6g}{unit}."
                )
            # A mode between two fixed times has no row: nothing could change its duration.
            if ends[i] >= 0 or ends[i + 1] >= 0:
                row = np.zeros(d + 1)  # the last entry is that of times that are fixed
                row[ends[i + 1]] += 1.0
                row[ends[i]] -= 1.0
                rows.append(row[:-1])
                bounds.append(dwell - (known[i + 1] - known[i]))
                kind: ConstraintKind = "collapsed" if dwell == 0 else "minimum duration"
                constraints.append(Constraint(kind, dwell, mode=mode, position=i, run=run))
    return np.array(rows).reshape(len(rows), d), np.array(bounds), tuple(constraints)
