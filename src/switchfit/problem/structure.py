"""Structure of an experiment: everything on which a compiled program depends, except array shapes.

It consists of the functions, their order and their shapes. Experiments with equal structure and equal (padded) lengths
share one program, and nothing is recompiled when transition times, parameters or data change.
"""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import NamedTuple

import numpy as np

from switchfit.arrays import Traced
from switchfit.problem.functions import Function

REST = ""
"""Internal name of the mode after a free tf; no mode of a system can have it."""


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
        # What is compiled for one mode at a time, as the search for step sizes, must not be compiled again because a
        # transition elsewhere has another reset map.
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

    def take_implicit_steps(self, modes: Container[str]) -> Structure:
        """Return the structure in which these modes take implicit steps too; itself if they do already."""
        named = zip(self.mode_names, self.implicit, strict=True)
        implicit = tuple(is_set or name in modes for name, is_set in named)
        return self if implicit == self.implicit else replace(self, implicit=implicit)

    @property
    def resets(self) -> tuple[int, ...]:
        """The transitions (from 0) at which a reset map acts."""
        return tuple(i for i, reset in enumerate(self.reset_maps) if reset is not None)

    @property
    def has_resets(self) -> bool:
        """Whether a reset map acts at a transition that is no jump: what is measured jumps as it passes a sample."""
        return not set(self.resets) <= set(self.jumps)

    def fix_sides(self, side: Traced, xp: ModuleType) -> Traced:
        """Return the side of each transition time at a node: `side` (), or an array (N,) with +1 for the jumps."""
        if not self.jumps:
            return side
        # At a jump the sample belongs to the state before it, whatever side is asked for: its time is no unknown, and
        # has no derivative.
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
        # A mode of the library that does not occur in the sequence: what it reads or compares with does not act on J.
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
