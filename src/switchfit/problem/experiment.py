"""Experiment: one run of the system, with its data, mode sequence, guesses, and whatever is its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress
from typing import TypeVar, get_args

import numpy as np

from switchfit.arrays import BoolArray, Converted, FloatArray, IntArray
from switchfit.problem.data import Data, count_from
from switchfit.problem.dates import list_dates, read_date, read_dates
from switchfit.problem.inputs import Input
from switchfit.problem.jump import Jump
from switchfit.problem.measurements import Measurements
from switchfit.problem.origin import choose_origin
from switchfit.problem.parameter import Parameter as Parameter
from switchfit.problem.parameter import as_parameter, require_time_unit
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.signals import PiecewisePolynomial
from switchfit.problem.system import HybridSystem, InitialState, ResetMap, as_state
from switchfit.problem.validation.arrays import as_number
from switchfit.problem.validation.messages import join_names, shorten, unit_suffix
from switchfit.problem.validation.names import as_name, as_sequence
from switchfit.problem.validation.objects import as_instance, as_instances, set_fields
from switchfit.runtime.presentation import format_line, join_first

A = TypeVar("A")
B = TypeVar("B")


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
    transition_times : sequence of float, date or Parameter, optional
        First guess of each transition, in the experiment's time unit, one fewer than modes, strictly increasing inside
        ``(t0, tf)``; an entry may be a `Parameter` with bounds, or fixed. Its unit, where given, must be `time_unit`.
        With ``scale="log"``, which all free times of an experiment then have, a free tf among them, the optimiser works
        in log(tau - t0): for times that may lie in other decades than their guess.
        Left out, `estimate` looks for them all over the horizon; the guess is evenly spaced. With `jumps` each stays
        between the two that enclose its guess.
    t0 : float or date, optional
        Start of the horizon, in the experiment's time unit. Left out, the first time of the data: the first sample of
        the `Measurements` (less a delay that is a number) and the beginning of the reference signals, whichever is
        first. Other costs have no times: where there are no others, t0 and tf must be given.
    tf : float, date or Parameter, optional
        End of the horizon. Left out, the last time of the data, or a time unit after t0 if they are empty. A
        `Parameter` that is not fixed is estimated, and called "tf" among the unknowns: give it a finite upper bound, up
        to which inputs and reference signals must be known, and a lower bound where there are samples, none of which
        may lie after it.
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
        The unit of all times of this run: of its samples, inputs, t0, tf, transition times, jumps and delays. Reports,
        figures and files print it; numbers are not converted. Dates become numbers of this unit since `origin`; it is
        then one of "ns", "us", "ms", "s", "min", "h" and "d".
    jumps : Jump or sequence of Jump, optional
        Changes of the state at known times or dates in ``[t0, tf)``, such as doses, without a change of mode.
    origin : date, optional
        The date at which times are 0; reports and figures then show times as dates. Left out, t0 if that is a date,
        else the earliest date of the data. As an attribute it is an `Origin` with the conversions, or None where times
        are no dates.
    time_zone : str, optional
        Such as "Europe/Berlin" or "UTC": where clocks showed those dates that have no zone, and in which zone dates are
        shown. Left out, dates without a zone stay so, with 24 hours to every day, and dates with zones are shown in
        theirs, or in UTC if they differ.

    Raises
    ------
    ValueError
        If lengths do not match, times are unordered or outside the horizon, data lies outside it, t0 or tf is left out
        and the data have no times to take it from, `time_unit` is empty, a transition time or tf has another unit, a
        free tf has bounds that do not fit, or a jump lies outside the horizon or where a transition is guessed. For
        dates of which some have a time zone and some have none, if `time_zone` does not say which; for numbers beside
        dates whose origin is not stated.
    TypeError
        If an argument is of the wrong type: times that are neither numbers nor dates, mode names that are no strings,
        data of another kind than those above.

    Notes
    -----
    ``p`` holds all parameters of the problem, and the names of the map. A run is differentiated with respect to the
    parameters on which its functions depend and to no others, so that many runs with parameters of their own cost each
    what it alone would.

    A copy with other data, made by `dataclasses.replace`, keeps the horizon, also where it came from the data; with
    ``t0=None, tf=None`` beside the data it is that of the new ones.

    See Also
    --------
    Problem, HybridSystem, Measurements, Input, Jump

    Examples
    --------
    >>> log = sf.Measurements([1.0, 2.0, 3.0, 4.0], [0.9, 1.8, 1.2, 0.7], sigma=0.1)
    >>> run = sf.Experiment(log, ("on", "off"), (2.2,), t0=0.0, time_unit="h")
    >>> run.mode_sequence, run.initial_times
    (('on', 'off'), array([2.2]))

    The horizon begins at t0 and ends, as tf is left out, with the last sample:

    >>> run.t0, run.tf
    (0.0, 4.0)

    Times may be dates:

    >>> days = ["2020-03-21", "2020-03-22", "2020-03-23", "2020-03-24"]
    >>> log = sf.Measurements(days, [0.9, 1.8, 1.2, 0.7], sigma=0.1)
    >>> run = sf.Experiment(log, ("on", "off"), ("2020-03-22T12:00",), time_unit="d")
    >>> run.initial_times, run.origin.date
    (array([1.5]), '2020-03-21T00:00:00')
    """

    data: Converted  # a tuple of `Data`
    mode_sequence: Sequence[str]
    transition_times: Converted = None  # a tuple of `Parameter`
    t0: float = None  # type: ignore[assignment]  # a number after __post_init__, as is tf
    tf: float | Parameter = None  # type: ignore[assignment]
    inputs: Input | None = None
    initial_state: Converted = None  # an `InitialState`, or None
    name: str | None = None
    parameter_map: Converted = None  # a dict of str to str
    time_unit: str = "s"
    jumps: Jump | Sequence[Jump] = ()
    origin: Converted = None  # an `Origin`, or None where times are no dates
    time_zone: str | None = None
    is_guess_proposed: bool = field(init=False, default=False)
    taken_from_data: tuple[str, ...] = field(init=False, default=())  # which of "t0" and "tf" were left out
    signals: tuple[PiecewisePolynomial, ...] = field(init=False)
    """Reference signals in the order of the data, then the input: all that varies in time beside the modes."""

    def __repr__(self) -> str:
        end = "free tf" if isinstance(self.tf, Parameter) else f"{self.tf:.6g}{unit_suffix(self.time_unit)}"
        modes = join_first(self.mode_sequence, 8)
        return format_line(
            self, self.name or "", f"modes {modes}", f"{self.t0:.6g} to {end}", join_first(map(repr, self.data), 2)
        )

    def __post_init__(self) -> None:
        self._convert_dates()
        missing = tuple(name for name in ("t0", "tf") if getattr(self, name) is None)
        # t0 and tf, which all that follows is checked against.
        span = self._find_span(missing) if missing else (0.0, 0.0)
        t0 = span[0] if self.t0 is None else as_number(self.t0, "t0")
        tf = span[1] if self.tf is None else _check_final_time(self.tf)
        last = float(tf.value) if isinstance(tf, Parameter) else tf
        if not (np.isfinite(t0) and np.isfinite(last) and t0 < last):
            why = f" ({' and '.join(missing)} from the data)" if missing else ""
            raise ValueError(
                "An experiment needs a finite horizon with t0 < tf; got "
                f"({show_time(self, t0)}, {show_time(self, last)}){why}."
            )
        modes = as_sequence(self.mode_sequence, "mode_sequence", "a sequence of mode names")
        sequence = tuple(as_name(mode, "each of mode_sequence", "the name of a mode") for mode in modes)
        if not sequence:
            raise ValueError("mode_sequence is empty; name at least one mode.")
        given = self.transition_times
        set_fields(self, taken_from_data=missing, is_guess_proposed=given is None and len(sequence) > 1)
        if given is None:
            # Evenly spaced only so that there is a theta: `estimate` looks for the times elsewhere
            # (`is_guess_proposed`).
            given = _propose_times(t0, last, len(sequence) - 1, self.jump_times.tolist())
        if len(given) != len(sequence) - 1:
            raise ValueError(f"transition_times must be one fewer than the {len(sequence)} modes; got {len(given)}.")
        times = tuple(as_parameter(tau, "a transition time") for tau in given)
        if self.name is not None:
            set_fields(self, name=as_name(self.name, "name of an experiment"))
        if self.initial_state is not None:
            set_fields(self, initial_state=as_state(self.initial_state))
        set_fields(self, t0=t0, tf=tf, mode_sequence=sequence, transition_times=times)
        set_fields(self, parameter_map=_check_map(self.parameter_map))
        # All fields are set: the checks below, and the cached properties that they ask for, read them.
        self._check_times()
        self._check_data_inside()
        signals = [item.signal for item in self.references]
        if self.inputs is not None:
            signals.append(as_instance(self.inputs, "inputs", Input, "an sf.Input").signal(t0, self.end))
        set_fields(self, signals=tuple(signals))

    def _convert_dates(self) -> None:
        """Replace all dates by numbers of the time unit since the origin, which is chosen here if it is left out."""
        set_fields(self, time_unit=as_name(self.time_unit, "time_unit", "a string such as 's' or 'min'"))
        kinds = ", ".join(f"sf.{kind.__name__}" for kind in get_args(Data))
        data: tuple[Data, ...] = as_instances(self.data, "data", Data, kinds)  # type: ignore[arg-type]
        if not data:
            raise ValueError("data is empty: an experiment needs at least one cost.")
        jumps, times = as_instances(self.jumps, "jumps", Jump, "an sf.Jump"), self.transition_times
        if times is not None:
            times = as_sequence(times, "transition_times", "a sequence of numbers or sf.Parameter")
            times = tuple(read_date(time, "a transition time") for time in times)
        parts: dict[str, Converted] = {"data": data, "jumps": jumps, "inputs": self.inputs, "transition_times": times}
        parts |= {name: read_date(getattr(self, name), name) for name in ("t0", "tf")}
        names = {"transition_times": "a transition time", "t0": "t0", "tf": "tf"}
        given = [dates for name, part in parts.items() for dates in list_dates(part, names.get(name, ""))]
        if given or self.origin is not None or self.time_zone is not None:
            timed = [item for item in data if isinstance(item, (Measurements, ReferenceSignal))]
            of_data = given[: len(timed)] if all(any(list_dates(item)) for item in timed) else []  # they stand first
            origin = choose_origin(given, of_data, self.origin, self.time_zone, parts["t0"])
            # All parts with one origin, so that differences between them are those between the dates.
            for name, part in parts.items():
                parts[name] = count_from(part, origin, self.time_unit, names.get(name, ""))
            parts |= {"origin": origin, "time_zone": origin.time_zone or None}
        set_fields(self, **parts)

    def _find_span(self, missing: tuple[str, ...]) -> tuple[float, float]:
        """Return the first and the last time of the data, from which t0 or tf is taken where it is left out."""
        spans = [item.seen_times[[0, -1]] for item in self.measurements if len(item.times)]
        spans += [item.signal.knots[[0, -1]] for item in self.references]
        if self.measurements and not spans and self.t0 is not None:  # of a stream
            spans = [as_number(self.t0, "t0") + np.array([0.0, 1.0])]
        if not spans:
            kinds = join_names(dict.fromkeys(type(item).__name__ for item in self.data))
            raise ValueError(f"{' and '.join(missing)} must be given, as nothing among the data ({kinds}) has times.")
        return float(np.min(spans)), float(np.max(spans))

    @property
    def measurements(self) -> tuple[Measurements, ...]:
        """The `Measurements` among the data, in their order."""
        return tuple(item for item in self.data if isinstance(item, Measurements))

    @property
    def references(self) -> tuple[ReferenceSignal, ...]:
        """The `ReferenceSignal` among the data, in their order."""
        return tuple(item for item in self.data if isinstance(item, ReferenceSignal))

    @property
    def has_free_tf(self) -> bool:
        """Whether tf is estimated."""
        return isinstance(self.tf, Parameter)

    @property
    def end(self) -> float:
        """Time to which the mesh reaches: tf, or the upper bound of a free tf."""
        return float(self.tf.upper) if isinstance(self.tf, Parameter) else self.tf

    @property
    def _own_times(self) -> tuple[Parameter, ...]:
        return (*self.transition_times, *((self.tf,) if isinstance(self.tf, Parameter) else ()))

    @cached_property
    def times(self) -> tuple[Parameter, ...]:
        """All transition times, then tf where it is free; each bounded by the jumps between which its guess lies."""
        # A jump at t0 acts before any transition and bounds none.
        edges = np.array([-np.inf, *self.jump_times[self.jump_times > self.t0], np.inf])
        bounded = []
        for tau, k in zip(self._own_times, np.searchsorted(edges, self.initial_times, "right"), strict=True):
            if len(edges) > 2 and not tau.fixed:
                tau = replace(tau, lower=np.maximum(edges[k - 1], tau.lower), upper=np.minimum(edges[k], tau.upper))
            bounded.append(tau)
        return tuple(bounded)

    @cached_property
    def acts(self) -> list[tuple[float, ResetMap]]:
        """Time and map of each jump, in the order in which they act."""
        acts = [(time, jump.map) for jump in self.jumps for time in np.atleast_1d(jump.time).tolist()]  # type: ignore[union-attr]
        return sorted(acts, key=lambda act: act[0])

    @cached_property
    def jump_times(self) -> FloatArray:
        """Times of all jumps, ascending: (K,)."""
        return np.array([time for time, _ in self.acts], dtype=np.float64)

    @cached_property
    def passed_by_jumps(self) -> IntArray:
        """How many of `times` each jump comes after: (K,). One at the time of a fixed transition comes before it."""
        return np.searchsorted(self.initial_times, self.jump_times, "left")

    @cached_property
    def is_jump(self) -> BoolArray:
        """Which of the N transitions that programs take, `times` and the jumps in between, are jumps: (N,)."""
        # Stable, with jumps first: two at one time keep the order in which they were given, and a jump acts before a
        # fixed transition at its time. `passed_by_jumps` says the same with "left".
        both = np.append(self.jump_times, self.initial_times)
        return np.argsort(both, kind="stable") < len(self.jump_times)  # at one time, a jump comes first

    @cached_property
    def initial_times_with_jumps(self) -> FloatArray:
        """Guess of all of `times`, with the times of the jumps in between: what programs take, (N,)."""
        return np.sort(np.append(self.initial_times, self.jump_times))

    @property
    def initial_times(self) -> FloatArray:
        """Guess of all of `times`, fixed ones included: an ``(N,)`` array."""
        return np.array([tau.value for tau in self._own_times], dtype=np.float64)

    def ends_of_modes(self, times: FloatArray) -> FloatArray:
        """Return where each mode begins and the last one ends, (..., N + 2), for values of `times` (..., N).

        See Also
        --------
        Problem.ends_of_modes : of all experiments, at a theta.

        Examples
        --------
        >>> cost = sf.RunningCost(lambda t, x, p: x[0])
        >>> run = sf.Experiment(cost, ("on", "off"), (1.0,), 0.0, sf.Parameter(2.5, upper=5.0))
        >>> run.ends_of_modes(run.initial_times)
        array([0. , 1. , 2.5])
        """
        begin = np.full((*times.shape[:-1], 1), self.t0)
        end = begin[..., :0] if self.has_free_tf else np.full_like(begin, self.end)
        return np.concatenate([begin, times, end], axis=-1)

    @cached_property
    def initial_length(self) -> float:
        """Length of the horizon at the guess."""
        return float(self.ends_of_modes(self.initial_times)[-1]) - self.t0

    @cached_property
    def clock(self) -> float:
        """Size of its times, of which rounding is a part: the horizon, or the clock's reading if more."""
        return max(self.initial_length, abs(self.t0), abs(self.t0 + self.initial_length))

    def _check_times(self) -> None:
        for i, tau in enumerate(self._own_times, start=1):
            what = "tf" if i > len(self.transition_times) else f"transition time {i}"
            _require_single(tau, what)
            require_time_unit(tau, what, self.time_unit)
            if not tau.fixed and np.any(self.jump_times == tau.value):
                raise ValueError(
                    f"the guess of {what} is {show_time(self, float(tau.value))}, the time of a jump. The two keep "
                    "their order: give a guess a little before or after the jump."
                )
        if len({tau.scale for tau in self._own_times if not tau.fixed}) > 1:
            raise ValueError(
                "transition times that are estimated, and a free tf, must be on one scale; got "
                f"{shorten([tau.scale for tau in self._own_times])}. Give scale='log' to all of them, or to none."
            )
        knots = self.ends_of_modes(self.initial_times)
        if np.any(np.diff(knots) <= 0):
            first, *times, last = (show_time(self, time) for time in knots)
            horizon, got = f"({first}, {last})", join_names(times)
            raise ValueError(f"transition_times must increase strictly inside (t0, tf) = {horizon}; got [{got}].")

    def _check_data_inside(self) -> None:
        # A jump at tf would change a state that nothing sees any more.
        acts, last = self.jump_times, self.t0 + self.initial_length
        self._require_inside("Jump time", acts, (acts < self.t0) | (acts >= last), last, ", the end left out")
        for item in self.data:
            if isinstance(item, Measurements) and not isinstance(item.delay, str):  # else its bounds decide
                late = f" less the delay of {item.delay:g}" if item.delay else ""
                times, bound = item.seen_times, ", the lower bound of tf" if self.has_free_tf else ""
                outside = (times < self.t0) | (times > self.earliest_end)
                self._require_inside(f"Measurements times{late}", times, outside, self.earliest_end, bound)
            elif isinstance(item, ReferenceSignal):
                first, last = item.signal.knots[[0, -1]]
                if first > self.t0 or last < self.end:
                    bound = ", the upper bound of tf" if self.has_free_tf else ""
                    raise ValueError(
                        f"A ReferenceSignal must reach over (t0, tf) = ({show_time(self, self.t0)}, "
                        f"{show_time(self, self.end)}{bound}); this one is known from {show_time(self, first)} to "
                        f"{show_time(self, last)}. Give t0 and tf inside that, or a longer signal."
                    )

    def _require_inside(self, what: str, times: FloatArray, outside: BoolArray, last: float, bound: str) -> None:
        if outside.any():
            raise ValueError(
                f"{what} must lie inside [t0, tf] = [{show_time(self, self.t0)}, {show_time(self, last)}{bound}]; "
                f"{outside.sum()} of {len(times)} do not, the first is {show_time(self, times[outside][0])}."
            )

    @property
    def earliest_end(self) -> float:
        """The earliest tf that there may be: tf, or the lower bound of a free tf, t0 where it has none."""
        return max(float(self.tf.lower), self.t0) if isinstance(self.tf, Parameter) else self.tf


def _propose_times(t0: float, tf: float, count: int, jumps: Sequence[float]) -> list[float]:
    """Return evenly spaced transition times, moved on a little from the time of a jump."""
    aside = 0.0237 * (tf - t0) / (count + 1)  # at which no other jump is likely
    return [time + aside if time in jumps else time for time in np.linspace(t0, tf, count + 2)[1:-1].tolist()]


def insert_jumps(experiment: Experiment, of_times: Iterable[A], of_jumps: Iterable[B]) -> list[A | B]:
    """Return an entry for each of an experiment's `times`, with those of the jumps in between.

    Parameters
    ----------
    experiment : Experiment
    of_times, of_jumps : iterable
    """
    times, jumps = iter(of_times), iter(of_jumps)
    return [next(jumps) if is_jump else next(times) for is_jump in experiment.is_jump.tolist()]


def drop_jumps(experiment: Experiment, of_all: Iterable[A]) -> list[A]:
    """Return the entries of the transitions, of those of all transitions and jumps.

    Parameters
    ----------
    experiment : Experiment
    of_all : iterable
    """
    return list(compress(of_all, (~experiment.is_jump).tolist()))


def show_time(experiment: Experiment, time: float) -> str:
    """Return a time of an experiment as text for a message: a date where its times are dates."""
    origin = experiment.origin
    date = None if origin is None else origin.find_date(time, experiment.time_unit)
    return str(time if date is None else date)


def count_times(experiment: Experiment, times: object) -> object:
    """Return dates as numbers of an experiment's unit since its origin; anything else as it is.

    Raises
    ------
    ValueError
        For dates if the times of the experiment are numbers.
    """
    dates = read_dates(times, "times")
    if dates is None:
        return times
    if experiment.origin is None:
        raise ValueError(f"times are dates ({dates!r}), but the times of the experiment are numbers.")
    return experiment.origin.to_numbers(dates, experiment.time_unit)


def initial_state_of(system: HybridSystem, experiment: Experiment) -> InitialState:
    """Return the experiment's initial state, or the system's where it has none of its own."""
    return system.initial_state if experiment.initial_state is None else experiment.initial_state


def name_runs(experiments: Sequence[Experiment]) -> tuple[str, ...]:
    """Return what each experiment is called: its name, or run1, run2, ..."""
    return tuple(experiment.name or f"run{e + 1}" for e, experiment in enumerate(experiments))


def prefix_runs(experiments: Sequence[Experiment]) -> list[str]:
    """Return with what the names of each experiment's own unknowns begin: nothing for a single experiment."""
    return [""] if len(experiments) == 1 else [f"{name}." for name in name_runs(experiments)]


def _check_map(given: object) -> Mapping[str, str]:
    """Return a map of the model's names to the problem's; empty for None."""
    names = {} if given is None else given
    form = "a dict of the model's name -> the problem's name, such as {'beta': 'beta_run3'}"
    if not isinstance(names, Mapping):
        raise TypeError(f"parameter_map must be {form}; got {shorten(given)}.")
    return {
        as_name(here, "parameter_map", form): as_name(there, "parameter_map", form) for here, there in names.items()
    }


def _require_single(time: Parameter, what: str) -> None:
    if time.shape != ():
        raise ValueError(f"{what} must be a single number or a Parameter of one; got the shape {time.shape}.")


def _check_final_time(given: object) -> float | Parameter:
    """Return tf as a number, or as a `Parameter` where it is free."""
    if not isinstance(given, Parameter):
        return as_number(given, "tf")
    _require_single(given, "tf")
    if given.fixed:
        return float(given.value)
    if not np.isfinite(given.upper):
        raise ValueError(
            f"A free tf needs a finite upper bound, as sf.Parameter(2.0, upper=5.0); got the upper bound {given.upper}."
        )
    return given
