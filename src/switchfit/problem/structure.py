"""The structure of an experiment: everything on which a compiled program depends, with the user's functions traced.

It consists of the functions, their order and their shapes. Experiments with equal structure and equal (padded) lengths
share one program, and nothing is recompiled when transition times, parameters or data change.

Lengths to which arrays are padded, so that experiments of similar size share one compiled program.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from switchfit.problem.corners import choose_sides
from switchfit.problem.data import (
    Measurements,
    ReferenceSignal,
    RunningCost,
    TerminalConstraint,
    TerminalCost,
    TransitionCost,
)
from switchfit.problem.experiment import Experiment, initial_state_of, insert_jumps
from switchfit.problem.functions import Call, Function, Shape, trace_function
from switchfit.problem.parameter import Parameter
from switchfit.problem.system import AtTransitions, HybridSystem


def pad_length(length: int) -> int:
    """Return `length` rounded up to four significant bits: at most an eighth too long, few distinct values."""
    unit = 1 << max(int(length).bit_length() - 4, 3)
    return -(-length // unit) * unit


LONGEST_PADDING = 2.0
"""Largest ratio of a common padded length to the own length of a run. Runs with a common length share a program:
compiling one costs as much as some thousand evaluations, while a row of padding costs as much as any other row."""


def choose_common_lengths(lengths: Sequence[int]) -> list[int]:
    """Return padded lengths from `pad_length`, with as few distinct ones as `LONGEST_PADDING` allows."""
    padded = [pad_length(length) for length in lengths]
    common: dict[int, int] = {}
    for length in sorted(set(padded), reverse=True):
        shared = min(common.values(), default=0)
        common[length] = shared if 0 < shared <= LONGEST_PADDING * length else length
    return [common[length] for length in padded]


REST = ""
"""Internal name of the mode after a free tf; no mode of a system can have it."""


def stay_at_rest(t: Any, x: Any, p: Any, u: Any = None) -> Any:
    """Return the vector field after a free tf: 0, so that x remains x(tf)."""
    return jnp.zeros_like(x)


class Sensor(NamedTuple):
    """The part of one `Measurements` on which programs depend: functions, names and the loss."""

    observe: Function | None  # None: the whole state
    channels: int
    sigma: tuple[str | None, ...]  # the parameter that is the sigma of each channel; empty if all are numbers
    loss: str
    loss_scale: float
    delay: str | None  # the parameter that is the delay; None if it is a number, which is subtracted from the times

    @property
    def named(self) -> set[str]:
        """Names of the parameters that are its sigma or delay."""
        return {name for name in (*self.sigma, self.delay) if name is not None}


@dataclass(frozen=True)
class Structure:
    """All on which a compiled program depends, except the shapes of its arguments. Hashable; functions by content."""

    mode_names: tuple[str, ...]
    modes: tuple[Function, ...]
    mode_of_segment: tuple[int, ...]
    reset_maps: tuple[Function | None, ...]
    initial_state: Function | None
    n: int
    unknown_states: tuple[int, ...]  # entries of the initial state that are estimated
    # The model's name, shape, and the positions of the entries that are in p: those that are read, none if it is fixed.
    parameters: tuple[tuple[str, tuple[int, ...], tuple[int, ...]], ...]
    running: tuple[Function, ...]
    references: tuple[tuple[Function | None, int], ...]  # observe, channels
    measurements: tuple[Sensor, ...]
    terminal: tuple[Function, ...]
    guards: tuple[Function | None, ...]
    terminal_constraints: tuple[Function, ...]
    input_shape: tuple[int, ...] | None
    implicit: tuple[bool, ...]  # whether each mode takes implicit steps
    transitions: int  # largest number of transitions of a sequence of its library
    reset_library: tuple[Function, ...]  # reset maps and guards that sequences of these modes may have
    guard_library: tuple[Function, ...]
    transition_costs: tuple[Function | None, ...] = ()
    transition_cost_library: tuple[Function, ...] = ()
    jumps: tuple[int, ...] = ()
    """The transitions (from 0) that are jumps at known times: samples at the same time are of the state before them."""
    known: int = 0
    """Number of jumps, also in a library, where `jumps` is empty: machine code has no derivatives in their times."""
    has_free_tf: bool = False
    """Whether the last of `modes` is the rest after a free tf, in which the state is constant and costs are 0."""
    has_rough_hessian: bool = False
    """Whether second derivatives are wrong beside an infinite slope: the Gauss-Newton matrix stands for them."""

    @property
    def outputs(self) -> tuple[tuple[Function | None, int], ...]:
        """Function and number of channels of each output: reference signals first, then the Measurements."""
        return (*self.references, *((sensor.observe, sensor.channels) for sensor in self.measurements))

    @property
    def N(self) -> int:
        """Number of transitions, including a free tf, which is the transition to rest."""
        return len(self.reset_maps)

    @property
    def has_one_method(self) -> bool:
        """Whether all modes take the same kind of steps, explicit or implicit."""
        return len(set(self.implicit)) == 1

    def list_implicit_modes(self) -> tuple[str, ...]:
        """Return the names of the modes that take implicit steps, without the rest after a free tf."""
        named = zip(self.mode_names, self.implicit, strict=True)
        return tuple(name for name, implicit in named if implicit and name != REST)

    def is_rest(self, mode: int) -> bool:
        """Return whether a mode is the rest after a free tf."""
        return self.has_free_tf and mode == len(self.modes) - 1

    @cached_property
    def M(self) -> int:
        """Length of p: the entries of free parameters that are read, then the unknown entries of the initial state."""
        return sum(len(read) for _, _, read in self.parameters) + len(self.unknown_states)

    @property
    def functions(self) -> Structure:
        """The same with one segment, for programs that work in one mode at a time."""
        alone = replace(self, reset_library=(), guard_library=(), transition_cost_library=()).library
        return replace(alone, mode_of_segment=(0,), terminal_constraints=(), transitions=0, known=0)

    @cached_property
    def library(self) -> Structure:
        """The common structure of all sequences of these modes, with all their reset maps and guards.

        Machine code is written for a library; it reads the order of modes, reset maps and guards at run time.
        """
        return replace(
            self,
            mode_of_segment=(),
            reset_maps=self.reset_library,
            guards=self.guard_library,
            transition_costs=self.transition_cost_library,
            jumps=(),
        )

    @property
    def resets(self) -> tuple[int, ...]:
        """The transitions (from 0) at which a reset map acts."""
        return tuple(i for i, reset in enumerate(self.reset_maps) if reset is not None)

    @property
    def has_resets(self) -> bool:
        """Whether a reset map acts at a transition that is no jump: what is measured jumps as it passes a sample."""
        return not set(self.resets) <= set(self.jumps)

    def fix_sides(self, side: Any, xp: Any) -> Any:
        """Return the side of each transition time at a node: `side` (), or an array (N,) with +1 for the jumps."""
        if not self.jumps:
            return side
        return xp.where(np.isin(np.arange(self.N), self.jumps), 1.0, side)

    @property
    def guarded(self) -> tuple[int, ...]:
        """The transitions (from 0) that have a guard."""
        return tuple(i for i, guard in enumerate(self.guards) if guard is not None)

    @property
    def terminal_constraint_count(self) -> int:
        """Number of terminal constraints, m."""
        return sum(math.prod(psi.shape) for psi in self.terminal_constraints)

    @property
    def roles(self) -> dict[str, Function]:
        """All functions by their roles, such as "mode 'slip'" and "observe 1"."""
        found = {f"mode {name!r}": mode for name, mode in zip(self.mode_names, self.modes, strict=True)}
        for kind, functions in (
            ("initial_state", (self.initial_state,)),
            ("reset map", self.reset_maps),
            ("guard", self.guards),
            ("TransitionCost", self.transition_costs),
            ("RunningCost", self.running),
            ("observe", tuple(observe for observe, _ in self.outputs)),
            ("TerminalCost", self.terminal),
            ("TerminalConstraint", self.terminal_constraints),
        ):
            found |= {f"{kind} {k + 1}": function for k, function in enumerate(functions) if function is not None}
        return found

    @property
    def acting(self) -> dict[str, Function]:
        """The functions that act in its own sequence, by their roles: all but the modes that do not occur in it."""
        idle = {f"mode {name!r}" for k, name in enumerate(self.mode_names) if k not in self.mode_of_segment}
        return {role: function for role, function in self.roles.items() if role not in idle}

    @property
    def digests(self) -> dict[str, str]:
        """Hash of each function's content, the same in every process, by the role of the function."""
        return {role: function.digest for role, function in self.roles.items()}

    @property
    def has_only_residuals(self) -> bool:
        """Whether all costs are those of data, whose Gauss-Newton matrix is near the Hessian, without constraints."""
        at_transitions = self.transition_cost_library or self.guard_library
        return not (self.running or self.terminal or self.terminal_constraints or at_transitions)


class Sources(NamedTuple):
    """What a problem has for all its structures, and the functions that were traced, each of them once."""

    system: HybridSystem
    parameters: Mapping[str, Parameter]
    solver: Literal["auto", "explicit", "stiff"]
    traced: dict[Any, Function]


class _Tracer:
    """Traces the functions of one experiment, and records which entries of parameters they read.

    Attributes
    ----------
    named : dict of str to Parameter, by the model's names
    read : dict of str to the positions of the entries that are read
    """

    def __init__(self, sources: Sources, experiment: Experiment) -> None:
        parameters, mapped = sources.parameters, experiment.parameter_map
        # The same order for every map, so that runs share a program.
        names = [*parameters, *sorted(mapped.keys() - parameters.keys())]
        self.named = {name: parameters[mapped.get(name, name)] for name in names}
        self.shapes = {name: q.shape for name, q in self.named.items()}
        self.read: dict[str, set[int]] = {}
        self._traced, self._key = sources.traced, tuple(self.shapes.items())

    def __call__(self, *given: Any) -> Function:
        """Trace a function, given what a `Call` consists of."""
        call = Call(*given)
        key = (id(call.function), call[1:], self._key)
        traced = self._traced.get(key)
        if traced is None:
            traced = self._traced[key] = trace_function(call, self.shapes)
        for name, entries in traced.read.items():
            self.read.setdefault(name, set()).update(entries)
        return traced


def trace_structure(sources: Sources, experiment: Experiment, transitions: int | None) -> Structure:
    """Trace and check the functions of one experiment, and return its structure.

    All modes take implicit steps if the solver is "stiff", else all take explicit ones.
    With `transitions`, its library has all modes of the system and at most that many transitions; with None, it has
    those of the experiment.

    Raises
    ------
    ValueError
        With the name of the mode or function, what it should return and what it returned.
    """
    trace, system = _Tracer(sources, experiment), sources.system
    used = system.modes if transitions is not None else set(experiment.mode_sequence)
    names = tuple(name for name in system.modes if name in used)  # in the same order for every sequence
    x0, n, unknown = _trace_initial_state(trace, initial_state_of(system, experiment))

    def items(kind: type) -> list[Any]:
        return [item for item in experiment.data if isinstance(item, kind)]

    at: tuple[Shape | None, ...] = ((), (n,), None)
    inputs = None if experiment.inputs is None else experiment.inputs.shape
    input_names = () if experiment.inputs is None else experiment.inputs.names
    in_mode, form = (at, "f(t, x, p)") if inputs is None else ((*at, inputs), "f(t, x, p, u)")

    end = [None] if experiment.has_free_tf else []  # the transition to rest, which has no functions
    own: list[Any] = [*pairwise(experiment.mode_sequence), *end]

    def at_transitions(
        given: AtTransitions, shape: Shape, what: str, form: str, at_jumps: Sequence[Function | None] = ()
    ) -> tuple[tuple[Function | None, ...], tuple[Function, ...]]:
        """Return the function of each transition and jump, None for one without, and those of all possible ones."""
        here = given if transitions is not None else own
        traced = {pair: trace(g, at, shape, f"{what} {pair}", form) for pair, g in given.items() if pair in here}
        found = insert_jumps(experiment, [traced.get(pair) for pair in own], at_jumps or [None] * len(jump_maps))
        return tuple(found), tuple(dict.fromkeys([*traced.values(), *filter(None, at_jumps)]))

    modes = tuple(trace(system.modes[name], in_mode, (n,), f"mode {name!r}", form, input_names) for name in names)
    own_modes = [names.index(mode) for mode in experiment.mode_sequence]
    if experiment.has_free_tf:  # a free tf is the transition to one more mode
        modes += (trace(stay_at_rest, in_mode, (n,), "the rest after tf", form, input_names),)
        own_modes.append(len(names))
        names = (*names, REST)
    after_jumps = (own_modes[i] for i in experiment.passed_by_jumps)  # the mode before it
    sequence = (own_modes[0], *insert_jumps(experiment, own_modes[1:], after_jumps))
    jump_maps = [trace(jump, at, (n,), "the map of a Jump", "map(t, x, p)") for _, jump in experiment.acts]
    references = ((item, item.signal.channels) for item in experiment.references)
    reset_maps, reset_library = at_transitions(system.reset_maps, (n,), "reset map", "R(t, x, p)", jump_maps)
    guards, guard_library = at_transitions(system.guards, (), "guard", "g(t, x, p)")
    costs = _choose_transition_costs(items(TransitionCost), names)
    transition_costs, transition_cost_library = at_transitions(costs, (), "TransitionCost", "mu(t, x, p)")
    structure = Structure(
        mode_names=names,
        modes=modes,
        mode_of_segment=sequence,
        reset_maps=reset_maps,
        initial_state=x0,
        n=n,
        unknown_states=unknown,
        parameters=(),
        running=tuple(trace(item.ell, at, (), "RunningCost", "ell(t, x, p)") for item in items(RunningCost)),
        references=tuple((_trace_observe(trace, item, q, n), q) for item, q in references),
        measurements=tuple(_trace_sensor(trace, item, n) for item in experiment.measurements),
        terminal=tuple(trace(item.phi, at[1:], (), "TerminalCost", "phi(x, p)") for item in items(TerminalCost)),
        guards=guards,
        terminal_constraints=tuple(_trace_terminal_constraint(trace, item, n) for item in items(TerminalConstraint)),
        input_shape=inputs,
        implicit=(sources.solver == "stiff",) * len(modes),
        transitions=len(reset_maps) if transitions is None else transitions + len(end),
        reset_library=reset_library,
        guard_library=guard_library,
        transition_costs=transition_costs,
        transition_cost_library=transition_cost_library,
        known=len(jump_maps),
        jumps=tuple(np.flatnonzero(experiment.is_jump).tolist()),
        has_free_tf=experiment.has_free_tf,
    )
    return replace(structure, parameters=_select_parameters(trace, structure))


def _trace_initial_state(trace: _Tracer, initial: Any) -> tuple[Function | None, int, tuple[int, ...]]:
    """Return the function x0(p), None for an array; the number of states; and which entries are estimated."""
    if not callable(initial):
        return None, len(initial), tuple(k for k, x in enumerate(initial) if not getattr(x, "fixed", True))
    x0 = trace(initial, (None,), None, "initial_state", "initial_state(p)")
    if len(x0.shape) != 1 or x0.shape == (0,):
        raise ValueError(f"initial_state(p) must return an array of shape (n,); got shape {x0.shape}.")
    return x0, x0.shape[0], ()


def _trace_observe(trace: _Tracer, item: Measurements | ReferenceSignal, channels: int, n: int) -> Function | None:
    """Return the observation h(t, x, p) of one of the data; None if the whole state is compared."""
    if item.observe is not None:
        return choose_sides(trace(item.observe, ((), (n,), None), (channels,), "observe", "h(t, x, p)"))
    if channels != n:
        raise ValueError(
            f"Without observe=h(t, x, p) -> ({channels},) the whole state is compared: its {n} entries; got {channels}."
        )
    return None


def _trace_sensor(trace: _Tracer, item: Measurements, n: int) -> Sensor:
    """Return the part of Measurements on which programs depend."""
    channels, delay = item.values.shape[1], item.delay if isinstance(item.delay, str) else None
    observe = _trace_observe(trace, item, channels, n)
    return Sensor(observe, channels, item.sigma_names, item.loss, item.loss_scale, delay)


def _trace_terminal_constraint(trace: _Tracer, item: TerminalConstraint, n: int) -> Function:
    """Return the function psi(x, p) of a terminal constraint, which returns a number or (m,)."""
    psi = trace(item.psi, ((n,), None), None, "TerminalConstraint", "psi(x, p)")
    if len(psi.shape) > 1:
        raise ValueError(f"TerminalConstraint: psi(x, p) must return a number or (m,) of them; got {psi.shape}.")
    return psi


def _select_parameters(trace: _Tracer, structure: Structure) -> tuple[tuple[str, Shape, tuple[int, ...]], ...]:
    """Return `Structure.parameters`: all that the functions read."""
    read = trace.read | {name: {0} for sensor in structure.measurements for name in sensor.named}
    return tuple(
        (name, q.shape, () if q.fixed else tuple(sorted(read[name]))) for name, q in trace.named.items() if name in read
    )


def _choose_transition_costs(items: list[TransitionCost], modes: tuple[str, ...]) -> AtTransitions:
    """Return the cost of each transition that may happen and has one."""
    found = {}
    for before, after in product(modes, modes):
        here = [item.mu for item in items if item.before in (None, before) and item.after in (None, after)]
        if len(here) > 1:
            raise ValueError(
                f"{len(here)} TransitionCosts count at a transition from {before!r} to {after!r}, where one may: give "
                "their sum in one, or set before and after."
            )
        if here:
            found[before, after] = here[0]
    return found
