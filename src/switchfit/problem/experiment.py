"""One run of the system: its data, its sequence of modes, its guesses, and what in it is its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from switchfit.problem.data import (
    Data,
    FloatArray,
    Input,
    Measurements,
    PiecewisePolynomial,
    ReferenceSignal,
    RunningCost,
    TerminalConstraint,
    TerminalCost,
    TransitionCost,
)
from switchfit.problem.parameter import Parameter as Parameter
from switchfit.problem.parameter import as_parameter
from switchfit.problem.system import HybridSystem, as_state
from switchfit.problem.validation import as_instance, as_name, as_number, as_sequence, shorten


@dataclass(frozen=True, eq=False)
class Experiment:
    """One run: its data, its sequence of modes, and the first guess of when they switch.

    Parameters
    ----------
    data : cost or list of costs
        `Measurements`, `ReferenceSignal`, `RunningCost`, `TransitionCost`, `TerminalCost`; several add up. A
        `TerminalConstraint` beside them has to hold.
    mode_sequence : sequence of str
        Names of the modes in the order in which they are active; a mode may return.
    transition_times : sequence of float or Parameter, or None
        First guess of each transition, in the experiment's time unit, one fewer than modes, strictly increasing inside
        ``(t0, tf)``; an entry may be a `Parameter` with bounds, or fixed. Its unit, where given, must be `time_unit`.
        None: `estimate` looks for them all over the horizon; the guess is evenly spaced.
    t0, tf : float
        Horizon, in the experiment's time unit.
    inputs : Input, optional
        Known input; modes are then called as ``f(t, x, p, u)``.
    initial_state : (n,) array_like or callable ``p -> (n,)``, optional
        Overrides the system's. An entry may be a `Parameter`: it is then estimated for this run, or fixed.
    name : str, optional
        Used in the names of this run's own unknowns when there are several experiments.
    parameter_map : mapping of str to str, optional
        The model's name of a parameter -> the problem's: with ``{"beta": "beta_run3"}`` the functions of this run find
        the problem's ``beta_run3`` under ``p["beta"]``. Names that are not in it mean themselves, and several names
        may mean one parameter.
    time_unit : str, optional
        The unit of all times of this run: of its samples, inputs, t0, tf, transition times and delays. Reports, figures
        and files print it; nothing is converted.

    Raises
    ------
    ValueError
        If lengths do not match, times are unordered or outside the horizon, data lies outside it, `time_unit` is empty,
        or a transition time has another unit.
    TypeError
        If an argument is of the wrong type: times that are not numbers (dates among them), mode names that are no
        strings, data of another kind than those above.

    Notes
    -----
    ``p`` holds the names of the map, and all parameters of the problem that no run's map has as its target; a target
    is there under its own name only if a function asks for it. A run is differentiated with respect to the parameters
    that its functions ask for and to no others, so that many runs with parameters of their own cost each what it alone
    would. (Functions that look at ``p`` as a whole, or hand it to ``jax.jit``, ask for all that it holds.)

    See Also
    --------
    Problem, HybridSystem, Measurements, Input

    Examples
    --------
    >>> import switchfit as sf
    >>> log = sf.Measurements([1.0, 2.0, 3.0, 4.0], [0.9, 1.8, 1.2, 0.7], sigma=0.1)
    >>> run = sf.Experiment(log, ("on", "off"), (2.2,), 0.0, 4.0, time_unit="h")
    >>> run.mode_sequence, run.initial_times
    (('on', 'off'), array([2.2]))
    """

    data: Any
    mode_sequence: tuple[str, ...]
    transition_times: tuple[Any, ...]
    t0: float
    tf: float
    inputs: Input | None = None
    initial_state: Any = None
    name: str | None = None
    parameter_map: Any = None
    time_unit: str = "s"
    is_guess_proposed: bool = field(init=False, default=False)

    def __post_init__(self) -> None:
        t0, tf = as_number(self.t0, "t0"), as_number(self.tf, "tf")
        if not (np.isfinite(t0) and np.isfinite(tf) and t0 < tf):
            raise ValueError(f"An experiment needs a finite horizon with t0 < tf; got ({t0}, {tf}).")
        modes = as_sequence(self.mode_sequence, "mode_sequence", "a sequence of mode names")
        sequence = tuple(as_name(mode, "each of mode_sequence", "the name of a mode") for mode in modes)
        if not sequence:
            raise ValueError("mode_sequence is empty; name at least one mode.")
        object.__setattr__(self, "is_guess_proposed", self.transition_times is None and len(sequence) > 1)
        given = self.transition_times
        if given is None:
            given = np.linspace(t0, tf, len(sequence) + 1)[1:-1].tolist()
        several = isinstance(given, Iterable) and getattr(given, "ndim", 1) > 0
        given = as_sequence(given, "transition_times", "a sequence of numbers or sf.Parameter") if several else (given,)
        if len(given) != len(sequence) - 1:
            raise ValueError(
                f"transition_times must be one fewer than the {len(sequence)} modes of mode_sequence; "
                f"got {len(given)}, needed {len(sequence) - 1}."
            )
        times = tuple(as_parameter(tau, "a transition time") for tau in given)
        if self.inputs is not None:
            as_instance(self.inputs, "inputs", Input, "an sf.Input")
        if self.name is not None:
            object.__setattr__(self, "name", as_name(self.name, "name of an experiment"))
        if self.initial_state is not None and not callable(self.initial_state):
            object.__setattr__(self, "initial_state", as_state(self.initial_state, "initial_state"))
        for name, value in (("t0", t0), ("tf", tf), ("mode_sequence", sequence), ("transition_times", times)):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "data", _check_data(self.data))
        object.__setattr__(self, "parameter_map", _check_map(self.parameter_map))
        self._check_time_unit()
        self._check_times()
        self._check_data_inside()
        if self.inputs is not None:
            self.inputs.signal(t0, tf)

    @property
    def initial_times(self) -> FloatArray:
        """Guess of all transition times, fixed ones included: an ``(N,)`` array."""
        return np.array([tau.value for tau in self.transition_times], dtype=np.float64)

    def _check_time_unit(self) -> None:
        unit = as_name(self.time_unit, "time_unit", "a string such as 's' or 'min'")
        for i, tau in enumerate(self.transition_times, start=1):
            if tau.unit not in ("", unit):
                raise ValueError(
                    f"transition time {i} has the unit {tau.unit!r}, but time_unit of the experiment is {unit!r}, and "
                    f"times are not converted. If all times of the experiment are in {tau.unit}, give it "
                    f"time_unit={tau.unit!r}; otherwise give the transition time in {unit}."
                )

    def _check_times(self) -> None:
        if any(tau.scale != "linear" for tau in self.transition_times):
            raise ValueError("transition_times are estimated as they are; leave out scale='log'.")
        if any(tau.shape != () for tau in self.transition_times):
            shapes = [tau.shape for tau in self.transition_times]
            raise ValueError(
                f"transition_times must be single numbers or Parameters of one; got the shapes {shorten(shapes)}."
            )
        knots = np.concatenate([[self.t0], self.initial_times, [self.tf]])
        if np.any(np.diff(knots) <= 0):
            raise ValueError(
                f"transition_times must increase strictly inside (t0, tf) = ({self.t0}, {self.tf}); "
                f"got {shorten(self.initial_times)}."
            )

    def _check_data_inside(self) -> None:
        for item in self.data:
            if isinstance(item, Measurements):
                if not isinstance(item.delay, str):  # otherwise its bounds decide, which the Problem knows
                    late = f" less the delay of {item.delay:g}" if item.delay else ""
                    _require_inside(item.seen_times, self.t0, self.tf, f"Measurements times{late}")
            elif isinstance(item, ReferenceSignal):
                first, last = item.signal.knots[[0, -1]]
                if first > self.t0 or last < self.tf:
                    raise ValueError(
                        f"A ReferenceSignal must reach over (t0, tf) = ({self.t0}, {self.tf}); "
                        f"this one is known from {first} to {last}."
                    )


def initial_state_of(system: HybridSystem, experiment: Experiment) -> Any:
    """Return the experiment's initial state, or the system's where it has none of its own."""
    return system.initial_state if experiment.initial_state is None else experiment.initial_state


def list_signals(experiment: Experiment) -> tuple[PiecewisePolynomial, ...]:
    """Return reference signals in the order of the data, then the input: all that varies in time beside the modes."""
    signals = [item.signal for item in experiment.data if isinstance(item, ReferenceSignal)]
    if experiment.inputs is not None:
        signals.append(experiment.inputs.signal(experiment.t0, experiment.tf))
    return tuple(signals)


def name_runs(experiments: Sequence[Experiment]) -> tuple[str, ...]:
    """Return what each experiment is called: its name, or run1, run2, ..."""
    return tuple(experiment.name or f"run{e + 1}" for e, experiment in enumerate(experiments))


def _check_map(given: Any) -> Mapping[str, str]:
    """Return a map of the model's names to the problem's; empty for None."""
    names = {} if given is None else given
    strings = isinstance(names, Mapping) and all(isinstance(name, str) for pair in names.items() for name in pair)
    if not strings:
        raise TypeError(
            "parameter_map must be a dict of the model's name -> the problem's name, such as "
            f"{{'beta': 'beta_run3'}}; got {shorten(given)}."
        )
    return {as_name(here, "parameter_map"): as_name(target, "parameter_map") for here, target in names.items()}


def _check_data(data: Any) -> tuple[Data, ...]:
    kinds = (Measurements, ReferenceSignal, RunningCost, TransitionCost, TerminalCost, TerminalConstraint)
    items = (data,) if isinstance(data, kinds) else tuple(data) if isinstance(data, (list, tuple)) else (data,)
    for item in items:
        if not isinstance(item, kinds):
            raise TypeError(
                "data must be sf.Measurements, sf.ReferenceSignal, sf.RunningCost, sf.TransitionCost, sf.TerminalCost, "
                f"sf.TerminalConstraint or a list of them; got {type(item).__name__}."
            )
    if not items:
        raise ValueError("data is empty: an experiment needs at least one cost.")
    return items


def _require_inside(times: FloatArray, t0: float, tf: float, what: str) -> None:
    outside = (times < t0) | (times > tf)
    if outside.any():
        raise ValueError(
            f"{what} must lie inside [t0, tf] = [{t0}, {tf}]; {outside.sum()} of {len(times)} do not, "
            f"the first is {times[outside][0]}."
        )
