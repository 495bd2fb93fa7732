"""What is estimated: parameters, experiments, and the flat vector theta of all unknowns with its constraints.

``theta`` holds the free transition times of the first experiment, of the second, ..., then the free parameters
in the order given. Everything that is fixed stays out of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.data import (
    Data,
    FloatArray,
    Input,
    Measurements,
    PiecewisePolynomial,
    ReferenceSignal,
    RunningCost,
    TerminalCost,
)
from switchfit.system import HybridSystem, ResetMap, as_state


@dataclass(frozen=True, eq=False)
class Parameter:
    """One unknown, scalar or array: its initial guess and what is known about it.

    Parameters
    ----------
    value : float or array_like
        Initial guess, or the value itself where `fixed`.
    lower, upper : float or array_like, optional
        Bounds; broadcast to the shape of `value`.
    unit : str, optional
        For the report.
    fixed : bool, optional
        A fixed parameter is not estimated.

    Raises
    ------
    ValueError
        If a value is not finite, bounds cross, or the guess lies outside them.
    """

    value: Any
    lower: Any = -np.inf
    upper: Any = np.inf
    unit: str = ""
    fixed: bool = False

    def __post_init__(self) -> None:
        try:
            value = np.array(self.value, dtype=np.float64)
            lower = np.broadcast_to(np.asarray(self.lower, dtype=np.float64), value.shape).copy()
            upper = np.broadcast_to(np.asarray(self.upper, dtype=np.float64), value.shape).copy()
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"Parameter needs numbers: value {self.value!r}, lower {self.lower!r}, upper {self.upper!r}; {error}."
            ) from error
        if not np.all(np.isfinite(value)):
            raise ValueError(f"Parameter value must be finite; got {self.value!r}.")
        if not np.all(lower <= upper):
            raise ValueError(f"Parameter bounds must satisfy lower <= upper; got [{self.lower}, {self.upper}].")
        if not (np.all(lower <= value) and np.all(value <= upper)):
            raise ValueError(f"Parameter value {self.value} lies outside its bounds [{self.lower}, {self.upper}].")
        for name, array in (("value", value), ("lower", lower), ("upper", upper)):
            object.__setattr__(self, name, array)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the parameter, () for a scalar."""
        return tuple(self.value.shape)


@dataclass(frozen=True, eq=False)
class Experiment:
    """One run: its data, its sequence of modes, and the first guess of when they switch.

    Parameters
    ----------
    data : cost or list of costs
        `Measurements`, `ReferenceSignal`, `RunningCost`, `TerminalCost`; several add up.
    mode_sequence : sequence of str
        Names of the modes in the order in which they are active; a mode may return.
    transition_times : sequence of float or Parameter
        First guess (s) of each transition, one fewer than modes, strictly increasing inside ``(t0, tf)``;
        an entry may be a `Parameter` with bounds, or fixed.
    t0, tf : float
        Horizon (s).
    inputs : Input, optional
        Known input; modes are then called as ``f(t, x, p, u)``.
    initial_state : (n,) array_like or callable ``p -> (n,)``, optional
        Overrides the system's.
    name : str, optional
        Used in the names of transition times when there are several experiments.

    Raises
    ------
    ValueError
        If lengths do not match, times are unordered or outside the horizon, or data lies outside it.
    """

    data: Any
    mode_sequence: tuple[str, ...]
    transition_times: tuple[Any, ...]
    t0: float
    tf: float
    inputs: Input | None = None
    initial_state: Any = None
    name: str | None = None

    def __post_init__(self) -> None:
        t0, tf = float(self.t0), float(self.tf)
        if not (np.isfinite(t0) and np.isfinite(tf) and t0 < tf):
            raise ValueError(f"An experiment needs a finite horizon with t0 < tf; got ({self.t0}, {self.tf}).")
        if isinstance(self.mode_sequence, str):
            raise TypeError(f"mode_sequence must be a sequence of mode names; got the string {self.mode_sequence!r}.")
        sequence = tuple(self.mode_sequence)
        if not sequence:
            raise ValueError("mode_sequence is empty; name at least one mode.")
        times = tuple(_as_parameter(tau, "a transition time") for tau in np.atleast_1d(self.transition_times).tolist())
        if self.inputs is not None and not isinstance(self.inputs, Input):
            raise TypeError(f"inputs must be an sf.Input; got {type(self.inputs).__name__}.")
        if self.initial_state is not None and not callable(self.initial_state):
            object.__setattr__(self, "initial_state", as_state(self.initial_state, "initial_state"))
        for field, value in (("t0", t0), ("tf", tf), ("mode_sequence", sequence), ("transition_times", times)):
            object.__setattr__(self, field, value)
        object.__setattr__(self, "data", _checked_data(self.data))
        self._check_times()
        self._check_data_inside()
        if self.inputs is not None:
            self.inputs.signal(t0, tf)

    @property
    def initial_times(self) -> FloatArray:
        """Guess of all transition times, fixed ones included: an ``(N,)`` array."""
        return np.array([tau.value for tau in self.transition_times], dtype=np.float64)

    def _check_times(self) -> None:
        needed = len(self.mode_sequence) - 1
        if len(self.transition_times) != needed:
            raise ValueError(
                f"{len(self.mode_sequence)} modes need {needed} transition times; got {len(self.transition_times)}."
            )
        if any(tau.shape != () for tau in self.transition_times):
            raise ValueError("Each transition time must be a single number or a Parameter with a single value.")
        knots = np.concatenate([[self.t0], self.initial_times, [self.tf]])
        if np.any(np.diff(knots) <= 0):
            raise ValueError(
                f"transition_times must increase strictly inside (t0, tf) = ({self.t0}, {self.tf}); "
                f"got {self.initial_times.tolist()}."
            )

    def _check_data_inside(self) -> None:
        for item in self.data:
            if isinstance(item, Measurements):
                _require_inside(item.times, self.t0, self.tf, "Measurements")
            elif isinstance(item, ReferenceSignal):
                first, last = item.signal.knots[[0, -1]]
                if first > self.t0 or last < self.tf:
                    raise ValueError(
                        f"A ReferenceSignal must reach over (t0, tf) = ({self.t0}, {self.tf}); "
                        f"this one is known from {first} to {last}."
                    )


@dataclass(frozen=True)
class Unknowns:
    """Where each unknown stands in theta, and the linear constraints on theta.

    Attributes
    ----------
    names, units : tuple of str, length d
    initial, lower, upper : (d,) arrays
    times : for each experiment the positions in theta of its transition times, -1 where fixed: (N,) int arrays
    parameters : dict of name -> slice into theta of the free parameters
    A, b : ordering and minimum durations as ``A theta >= b``, (m, d) and (m,)
    constraint_names : what each row means when it is active
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    initial: FloatArray
    lower: FloatArray
    upper: FloatArray
    times: tuple[NDArray[np.intp], ...]
    parameters: Mapping[str, slice]
    A: FloatArray
    b: FloatArray
    constraint_names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Problem:
    """A system, the experiments made with it, and the parameters to estimate.

    Parameters
    ----------
    system : HybridSystem
    experiments : Experiment or list of Experiment
        Parameters are shared by all of them, each has its own transition times.
    parameters : mapping of str to Parameter, number or array
        A bare number is a free parameter without bounds.
    min_duration : float, optional
        Shortest time (s) a mode may last; 0 lets it vanish, which the result then reports.
    solver : {"explicit", "stiff"}, optional
        Dormand-Prince of order 5, or Radau IIA of order 5 for stiff modes.
    rtol, atol : float, optional
        Tolerances of the local error by which the mesh is refined.

    Raises
    ------
    ValueError
        For unknown modes, impossible minimum durations, or a vector field, reset map, observation or cost of
        the wrong shape or dtype.
    """

    system: HybridSystem
    experiments: Any
    parameters: Mapping[str, Any] | None = None
    min_duration: float = 0.0
    solver: Literal["explicit", "stiff"] = "explicit"
    rtol: float = 1e-9
    atol: float = 1e-11
    unknowns: Unknowns = field(init=False)

    def __post_init__(self) -> None:
        if not isinstance(self.system, HybridSystem):
            raise TypeError(f"system must be an sf.HybridSystem; got {type(self.system).__name__}.")
        experiments = (self.experiments,) if isinstance(self.experiments, Experiment) else tuple(self.experiments)
        if not experiments or not all(isinstance(e, Experiment) for e in experiments):
            raise TypeError("experiments must be an sf.Experiment or a non-empty list of them.")
        for experiment in experiments:
            for mode in experiment.mode_sequence:
                if mode not in self.system.modes:
                    raise ValueError(
                        f"mode_sequence names the unknown mode {mode!r}; the modes are {', '.join(self.system.modes)}."
                    )
        if self.solver not in ("explicit", "stiff"):
            raise ValueError(f"solver must be 'explicit' or 'stiff'; got {self.solver!r}.")
        for name in ("rtol", "atol"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive; got {getattr(self, name)!r}.")
        parameters = {
            str(name): _as_parameter(value, f"parameter {name!r}") for name, value in (self.parameters or {}).items()
        }
        object.__setattr__(self, "experiments", experiments)
        object.__setattr__(self, "parameters", parameters)
        object.__setattr__(self, "unknowns", _unknowns(experiments, parameters, float(self.min_duration)))


    @property
    def initial_theta(self) -> FloatArray:
        """The first guess of everything estimated: a ``(d,)`` array."""
        return self.unknowns.initial.copy()

    @property
    def theta_names(self) -> tuple[str, ...]:
        """Name of each entry of theta, transition times first."""
        return self.unknowns.names

    def checked_theta(self, theta: ArrayLike | None) -> FloatArray:
        """`theta`, or the initial guess for None, as a ``(d,)`` array; ValueError where shape or order is wrong."""
        if theta is None:
            return self.initial_theta
        checked = np.array(theta, dtype=np.float64)
        if checked.shape != self.unknowns.initial.shape:
            raise ValueError(
                f"theta must have shape ({len(self.theta_names)},): {', '.join(self.theta_names)}; "
                f"got shape {checked.shape}."
            )
        if not np.all(np.isfinite(checked)):
            raise ValueError(f"theta must be finite; got {checked.tolist()}.")
        for experiment, times in zip(self.experiments, self.split(checked)[0], strict=True):
            knots = np.concatenate([[experiment.t0], times, [experiment.tf]])
            if np.any(np.diff(knots) < 0):
                raise ValueError(
                    f"The transition times in theta must not decrease inside (t0, tf) = ({experiment.t0}, "
                    f"{experiment.tf}); got {times.tolist()}."
                )
        return checked

    def split(self, theta: FloatArray) -> tuple[list[FloatArray], dict[str, FloatArray]]:
        """All transition times, one ``(N,)`` array an experiment, and all parameters by name, fixed ones included."""
        times = []
        for experiment, where in zip(self.experiments, self.unknowns.times, strict=True):
            tau = experiment.initial_times
            tau[where >= 0] = theta[where[where >= 0]]
            times.append(tau)
        parameters = {}
        for name, parameter in self.parameters.items():
            span = self.unknowns.parameters.get(name)
            parameters[name] = parameter.value if span is None else theta[span].reshape(parameter.shape)
        return times, parameters


def initial_state_of(system: HybridSystem, experiment: Experiment) -> Any:
    """The experiment's initial state, or the system's where it has none of its own."""
    return system.initial_state if experiment.initial_state is None else experiment.initial_state


def reset_maps_of(system: HybridSystem, mode_sequence: Sequence[str]) -> tuple[ResetMap | None, ...]:
    """The reset map of each of the N transitions of a mode sequence, None where the state is continuous."""
    return tuple(system.reset_map(a, b) for a, b in zip(mode_sequence[:-1], mode_sequence[1:], strict=True))


def signals_of(experiment: Experiment) -> tuple[PiecewisePolynomial, ...]:
    """Reference signals in the order of the data, then the input: all that varies in time beside the modes."""
    signals = [item.signal for item in experiment.data if isinstance(item, ReferenceSignal)]
    if experiment.inputs is not None:
        signals.append(experiment.inputs.signal(experiment.t0, experiment.tf))
    return tuple(signals)


def _as_parameter(value: Any, what: str) -> Parameter:
    if isinstance(value, Parameter):
        return value
    try:
        return Parameter(value)
    except ValueError as error:
        raise ValueError(f"{what} must be a number, an array or an sf.Parameter: {error}") from error


def _checked_data(data: Any) -> tuple[Data, ...]:
    kinds = (Measurements, ReferenceSignal, RunningCost, TerminalCost)
    items = (data,) if isinstance(data, kinds) else tuple(data) if isinstance(data, (list, tuple)) else (data,)
    for item in items:
        if not isinstance(item, kinds):
            raise TypeError(
                "data must be sf.Measurements, sf.ReferenceSignal, sf.RunningCost, sf.TerminalCost or a list of them; "
                f"got {type(item).__name__}."
            )
    if not items:
        raise ValueError("data is empty: an experiment needs at least one cost.")
    return items


def _require_inside(times: FloatArray, t0: float, tf: float, what: str) -> None:
    outside = (times < t0) | (times > tf)
    if outside.any():
        raise ValueError(
            f"{what} times must lie inside [t0, tf] = [{t0}, {tf}]; {outside.sum()} of {len(times)} do not, "
            f"the first is {times[outside][0]}."
        )


def _unknowns(experiments: tuple[Experiment, ...], parameters: dict[str, Parameter], dwell: float) -> Unknowns:
    names: list[str] = []
    units: list[str] = []
    pieces: list[Parameter] = []
    where: list[NDArray[np.intp]] = []
    for e, experiment in enumerate(experiments):
        prefix = "" if len(experiments) == 1 else f"{experiment.name or f'run{e + 1}'}."
        positions = np.full(len(experiment.transition_times), -1, dtype=np.intp)
        for i, tau in enumerate(experiment.transition_times):
            if not tau.fixed:
                positions[i] = len(names)
                names.append(f"{prefix}tau_{i + 1}")
                units.append(tau.unit or "s")
                pieces.append(tau)
        where.append(positions)
    spans: dict[str, slice] = {}
    for name, parameter in parameters.items():
        if not parameter.fixed:
            spans[name] = slice(len(names), len(names) + parameter.value.size)
            names += [f"{name}{_index(k)}" for k in np.ndindex(parameter.shape)]
            units += [parameter.unit] * parameter.value.size
            pieces.append(parameter)
    if not names:
        raise ValueError("Nothing to estimate: every parameter and transition time is fixed.")
    if len(set(names)) != len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"Two unknowns share a name: {', '.join(twice)}; rename the parameter or the experiment.")
    flat = {key: np.concatenate([getattr(q, key).ravel() for q in pieces]) for key in ("value", "lower", "upper")}
    A, b, rows = _ordering(experiments, where, len(names), dwell)
    return Unknowns(
        tuple(names), tuple(units), flat["value"], flat["lower"], flat["upper"], tuple(where), spans, A, b, rows
    )


def _index(k: tuple[int, ...]) -> str:
    return f"[{','.join(map(str, k))}]" if k else ""


def _ordering(
    experiments: tuple[Experiment, ...], where: list[NDArray[np.intp]], d: int, dwell: float
) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Rows ``tau_{i+1} - tau_i >= min_duration`` for every mode of every experiment with a free end."""
    if not (np.isfinite(dwell) and dwell >= 0):
        raise ValueError(f"min_duration must be zero or positive; got {dwell}.")
    rows, bounds, names = [], [], []
    for e, (experiment, positions) in enumerate(zip(experiments, where, strict=True)):
        run = "" if len(experiments) == 1 else f" of {experiment.name or f'run{e + 1}'}"
        knots = np.concatenate([[experiment.t0], experiment.initial_times, [experiment.tf]])
        ends = np.concatenate([[-1], positions, [-1]])
        for i, mode in enumerate(experiment.mode_sequence):
            length = knots[i + 1] - knots[i]
            if length < dwell * (1 - 1e-12):
                raise ValueError(
                    f"min_duration is {dwell} s, but the guess gives mode {i + 1} ({mode!r}){run} only {length:.6g} s."
                )
            if ends[i] < 0 and ends[i + 1] < 0:
                continue
            row, bound = np.zeros(d), dwell
            for end, knot, sign in ((ends[i + 1], knots[i + 1], 1.0), (ends[i], knots[i], -1.0)):
                if end >= 0:
                    row[end] += sign
                else:
                    bound -= sign * knot
            rows.append(row)
            bounds.append(bound)
            state = "has collapsed to nothing" if dwell == 0 else "is at its minimum duration"
            names.append(f"mode {i + 1} ({mode!r}){run} {state}")
    return np.array(rows).reshape(len(rows), d), np.array(bounds), tuple(names)
