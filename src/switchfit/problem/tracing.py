"""Trace and check the functions of an experiment, and build its structure of them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, product
from typing import Literal, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from switchfit.arrays import Traced
from switchfit.problem.corners.outputs import choose_sides
from switchfit.problem.costs import RunningCost, TerminalConstraint, TerminalCost, TransitionCost
from switchfit.problem.experiment import Experiment, initial_state_of, insert_jumps
from switchfit.problem.functions import Call, Function, Shape, trace_function
from switchfit.problem.measurements import Measurements
from switchfit.problem.parameter import Parameter
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.structure import REST, Sensor, Structure
from switchfit.problem.system import AtTransitions, HybridSystem, InitialState

Item = TypeVar("Item")


def stay_at_rest(t: Traced, x: Traced, p: Mapping[str, Traced], u: Traced = None) -> Traced:
    """Return the vector field after a free tf: 0, so that x remains x(tf)."""
    return jnp.zeros_like(x)


class Sources(NamedTuple):
    """What a problem has for all its structures, and the functions that were traced, each of them once."""

    system: HybridSystem
    parameters: Mapping[str, Parameter]
    solver: Literal["auto", "explicit", "stiff"]
    traced: dict[Hashable, Function]


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

    def __call__(
        self,
        function: Callable[..., Traced],
        arguments: tuple[Shape | None, ...],
        shape: Shape | None,
        what: str,
        form: str,
        inputs: tuple[str, ...] = (),
    ) -> Function:
        """Trace a function, given what a `Call` consists of."""
        call = Call(function, arguments, shape, what, form, inputs)
        # By identity, before `trace_function` compares contents, which takes longer: the functions live as long as the
        # system and the data of this problem, so that no other can have their ids meanwhile. Shapes of parameters
        # count, as a map may give a name another parameter.
        key = (id(call.function), call[1:], self._key)
        traced = self._traced.get(key)
        if traced is None:
            traced = self._traced[key] = trace_function(call, self.shapes)
        # What is read is noted also where the trace was found: it belongs to this experiment, as the cache does not.
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
    # A library has all modes, so that every sequence of them shares one program; without one, a mode that does not
    # occur is not traced, and may need parameters that the problem lacks.
    used = system.modes if transitions is not None else set(experiment.mode_sequence)
    names = tuple(name for name in system.modes if name in used)  # in the same order for every sequence
    x0, n, unknown = _trace_initial_state(trace, initial_state_of(system, experiment))

    def items(kind: type[Item]) -> list[Item]:
        return [item for item in experiment.data if isinstance(item, kind)]

    at: tuple[Shape | None, ...] = ((), (n,), None)
    inputs = None if experiment.inputs is None else experiment.inputs.shape
    input_names = () if experiment.inputs is None else experiment.inputs.names
    in_mode, form = (at, "f(t, x, p)") if inputs is None else ((*at, inputs), "f(t, x, p, u)")

    end = [None] if experiment.has_free_tf else []  # the transition to rest, which has no functions
    own: list[tuple[str, str] | None] = [*pairwise(experiment.mode_sequence), *end]

    def at_transitions(
        given: AtTransitions, shape: Shape, what: str, form: str, at_jumps: Sequence[Function | None] = ()
    ) -> tuple[tuple[Function | None, ...], tuple[Function, ...]]:
        """Return the function of each transition and jump, None for one without, and those of all possible ones."""
        # Of a library all functions, else those between the modes of this sequence.
        here = given if transitions is not None else own
        traced = {pair: trace(g, at, shape, f"{what} {pair}", form) for pair, g in given.items() if pair in here}
        of_transitions = [traced.get(pair) if pair else None for pair in own]
        found = insert_jumps(experiment, of_transitions, at_jumps or [None] * len(jump_maps))
        return tuple(found), tuple(dict.fromkeys([*traced.values(), *filter(None, at_jumps)]))

    modes = tuple(trace(system.modes[name], in_mode, (n,), f"mode {name!r}", form, input_names) for name in names)
    own_modes = [names.index(mode) for mode in experiment.mode_sequence]
    if experiment.has_free_tf:  # a free tf is the transition to one more mode
        modes += (trace(stay_at_rest, in_mode, (n,), "the rest after tf", form, input_names),)
        own_modes.append(len(names))
        names = (*names, REST)
    after_jumps = (own_modes[i] for i in experiment.passed_by_jumps)  # the mode before it
    sequence = (own_modes[0], *insert_jumps(experiment, own_modes[1:], after_jumps))
    # A jump is a transition from a mode to itself at a known time, with the jump's map as its reset map.
    jump_maps = [trace(jump, at, (n,), "the map of a Jump", "map(t, x, p)") for _, jump in experiment.acts]
    # The order of the outputs: reference signals first, then the Measurements (`Structure.outputs`).
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
    # Last, since only now all functions have been traced and it is known what they read.
    return replace(structure, parameters=_select_parameters(trace, structure))


def _trace_initial_state(trace: _Tracer, initial: InitialState) -> tuple[Function | None, int, tuple[int, ...]]:
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
