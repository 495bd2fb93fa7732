"""The library of a search: which modes may occur, which may follow which, how long each lasts at least.

The structure of an experiment with the modes and transitions of a library.

The mode sequences of many hypotheses, as arrays: which births may follow, and which hypotheses are kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.mesh import Mesh
from switchfit.problem.consistency import check_durations
from switchfit.problem.costs import TerminalConstraint, TransitionCost
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Function, Structure
from switchfit.problem.tracing import trace_structure
from switchfit.problem.validation.arrays import as_count
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_name, as_names, require_known

Integers = NDArray[np.int64]

PER_SEQUENCE = 3
"""Hypotheses with the same sequence that are kept, at most: without a limit, all would soon have the same."""

RESERVED = 0.5
"""Part of the width that is shared out among the numbers of switches; the best of all have the rest."""

SMALLEST = float(np.finfo(float).smallest_subnormal)
"""Difference of two times of which one is later."""

MULTIPLIER = 1_000_003
"""Of the hash of sequences, which is exact for short sequences of few modes."""


@dataclass(frozen=True)
class Library:
    """The mode sequences among which a search chooses.

    Attributes
    ----------
    modes : tuple of str
        Names of the modes that may occur, in the order of the system.
    first, last : tuple of str
        Modes with which a sequence may begin and end.
    successions : mapping of str to tuple of str
        The modes that may follow each mode.
    durations : mapping of str to float
        Shortest time that each mode lasts, in the time unit of the experiments; 0 where it may be any.
    max_switches : int
        Largest number of switches of a sequence.
    """

    modes: tuple[str, ...]
    first: tuple[str, ...]
    last: tuple[str, ...]
    successions: Mapping[str, tuple[str, ...]]
    durations: Mapping[str, float]
    max_switches: int

    def allows(self, before: str, after: str) -> bool:
        """Return whether one mode may follow another."""
        return after in self.successions.get(before, ())

    def admits(self, sequence: Sequence[str]) -> bool:
        """Return whether a mode sequence is one of the library, with at most `max_switches` switches."""
        if not 1 <= len(sequence) <= self.max_switches + 1:
            return False
        if sequence[0] not in self.first or sequence[-1] not in self.last:
            return False
        return all(self.allows(a, b) for a, b in pairwise(sequence))

    def list_sequences(self, switches: int, before: str | None = None) -> Iterator[tuple[str, ...]]:
        """Yield all sequences with that number of switches, from the beginning or after a mode."""
        for mode in self.first if before is None else self.successions[before]:
            if mode in self.ends_after[switches]:
                rest = self.list_sequences(switches - 1, mode) if switches else iter([()])
                yield from ((mode, *modes) for modes in rest)

    @cached_property
    def ends_after(self) -> list[frozenset[str]]:
        """The modes from which a sequence can end after k more switches, for k = 0 ... max_switches."""
        found = [frozenset(self.last)]
        for _ in range(self.max_switches):
            found.append(frozenset(mode for mode in self.modes if found[-1] & set(self.successions[mode])))
        return found

    @cached_property
    def possible_switches(self) -> tuple[int, ...]:
        """The numbers of switches up to `max_switches` with which there is a sequence."""
        return tuple(k for k, modes in enumerate(self.ends_after) if modes & set(self.first))


def build_library(
    problem: Problem,
    library: Any = None,
    *,
    first: Any = None,
    last: Any = None,
    successions: Any = None,
    min_duration: Any = None,
    max_switches: Any = 8,
) -> Library:
    """Return the library of a search from the arguments of `find_modes`, checked.

    Parameters
    ----------
    problem : Problem
    library : sequence of str, optional
    first, last : str or sequence of str, optional
    successions : mapping of str to sequence of str, optional
    min_duration : float or mapping of str to float, optional
    max_switches : int

    Raises
    ------
    ValueError
        For names that the system lacks, successions from a mode that is not in the library, a `last` that cannot be
        reached from any `first`, or a negative duration.
    TypeError
        If an argument is of the wrong type.
    """
    most = as_count(max_switches, "max_switches")
    names = _choose_modes(library, "library", tuple(problem.system.modes))
    begins, ends = _choose_modes(first, "first", names), _choose_modes(last, "last", names)
    followers = _check_successions(successions, names)
    found = Library(names, begins, ends, followers, _read_durations(problem, min_duration, names), most)
    if not replace(found, max_switches=len(names)).possible_switches:  # however many switches there may be
        raise ValueError(
            f"no mode of last ({join_names(ends)}) can be reached from first ({join_names(begins)}) by the "
            "successions: add the missing successions, or change first or last."
        )
    return found


def _choose_modes(given: Any, what: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the given modes among some names, in their order; all if they are left out."""
    if given is None:
        return names
    chosen = (as_name(given, what),) if isinstance(given, str) else as_names(given, what, "a mode or a list of modes")
    if not chosen:
        raise ValueError(f"{what} is empty: name at least one mode, or leave it out for all modes.")
    require_known(chosen, what, names)
    return tuple(name for name in names if name in chosen)


def _check_successions(given: Any, names: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return the modes that may follow each mode; a mode that a mapping leaves out has none."""
    if given is None:
        return {name: tuple(other for other in names if other != name) for name in names}
    if not isinstance(given, Mapping):
        raise TypeError(
            "successions must be a dict of mode -> the modes that may follow it, such as "
            f"{{'flight': ('slide',), 'slide': ('stick',)}}; got {shorten(given)}."
        )
    require_known(given, "successions", names)
    found: dict[str, tuple[str, ...]] = dict.fromkeys(names, ())
    for name, after in given.items():
        what = f"successions of {shorten(name)}"
        listed = (after,) if isinstance(after, str) else as_names(after, what, "a sequence of names of modes")
        require_known(listed, what, names)
        if name in listed:
            raise ValueError(f"{what} names the mode itself: a switch leads to another mode. Leave it out.")
        found[name] = tuple(other for other in names if other in listed)
    return found


def _read_durations(problem: Problem, given: Any, names: tuple[str, ...]) -> dict[str, float]:
    """Return the shortest duration of each mode; that of the problem where it is left out."""
    found = {name: problem.durations[name] for name in names}
    if given is not None:
        asked = check_durations(given, problem.system)
        found |= {name: asked.get(name, found[name]) if isinstance(asked, dict) else asked for name in names}
    return found


def refuse_unsupported(problem: Problem, e: int) -> None:
    """Raise ValueError for an experiment that a beam cannot follow."""
    run = problem.experiments[e]
    name = f"experiment {problem.run_names[e]!r}" if len(problem.experiments) > 1 else "the experiment"
    wrong = {
        "a free tf: give tf a number": run.has_free_tf,
        "a delay that is a parameter: give it a number": problem.estimates_delays,
        "terminal constraints: leave them out of the search": any(
            isinstance(item, TerminalConstraint) for item in run.data
        ),
    }
    for what, is_there in wrong.items():
        if is_there:
            raise ValueError(
                f"a beam follows the data from t0 to a known end, but {name} has {what}, or use method='insertion'."
            )


def trace_transition(problem: Problem, run: Experiment, pair: tuple[str, str]) -> tuple[Function | None, ...]:
    """Return the reset map, the cost and the guard of the transition from one mode to another in a run."""
    has_cost = any(isinstance(item, TransitionCost) for item in run.data)
    if not (has_cost or pair in problem.system.reset_maps or pair in problem.system.guards):
        return None, None, None
    alone = replace(run, mode_sequence=pair, transition_times=None, jumps=())
    found = trace_structure(problem._sources, alone, 1)
    return found.reset_maps[0], found.transition_costs[0], found.guards[0]


def trace_transitions(problem: Problem, e: int, library: Library | None, births: int) -> tuple[Structure, Integers]:
    """Return the structure of an experiment with the modes and transitions of a library, and the places of the reset
    map, of the cost and of the guard of each of its transitions: (3, K, K), -1 without one.

    Without a library, those of the given order of modes, whose N + 1 places stand for the modes.
    """
    run = problem.experiments[e]
    sequence = run.mode_sequence
    modes = tuple(m for m in problem.system.modes if m in (sequence if library is None else library.modes))
    if library is None:
        steps = [(pair, (k, k + 1)) for k, pair in enumerate(pairwise(sequence))]
    else:
        pairs = [pair for pair in product(modes, modes) if pair[0] != pair[1] and library.allows(*pair)]
        steps = [(pair, (modes.index(pair[0]), modes.index(pair[1]))) for pair in pairs]
    structure = trace_structure(problem._sources, run, births)
    known: list[list[Any]] = [list(dict.fromkeys(structure.reset_maps[i] for i in structure.jumps)), [], []]
    size = max(len(modes), *(1 + max(place) for _, place in steps), 1)
    tables = np.full((3, size, size), -1, dtype=np.int64)
    for pair, place in steps:
        for table, functions, function in zip(tables, known, trace_transition(problem, run, pair), strict=True):
            if function is not None:
                functions += [] if function in functions else [function]
                table[place] = functions.index(function)
    reset_maps, transition_costs, guards = map(tuple, known)
    structure = replace(
        structure,
        mode_names=modes,
        modes=tuple(structure.modes[structure.mode_names.index(name)] for name in modes),
        reset_library=reset_maps,
        transition_cost_library=transition_costs,
        guard_library=guards,
        known=0,  # jumps act at nodes, and are no transitions here
    )
    return structure, tables


def list_jumps(run: Experiment, structure: Structure, mesh: Mesh) -> list[tuple[int, int]]:
    """Return the node of each jump at a known time, and the place of its map in the library."""
    maps = [structure.reset_library.index(structure.reset_maps[i]) for i in structure.jumps]
    nodes = np.searchsorted(mesh.times, run.jump_times).tolist()
    return list(zip(nodes, maps, strict=True))


class Rules(NamedTuple):
    """Which of K places may follow each other: the modes of a library, or the places in a given order of modes.

    Attributes
    ----------
    modes : (K,) int, mode at each place
    shortest : (K,), shortest time that its mode lasts
    first : (F,) int
    last : (K,) bool
    follows : (most + 1, K, K) bool
        Whether one may follow another after so many switches, and the sequence still end in one of `last`.
    between : (2, most) or None
        Times between which each switch may be born.
    """

    modes: Integers
    shortest: FloatArray
    first: Integers
    last: NDArray[np.bool_]
    follows: NDArray[np.bool_]
    between: FloatArray | None

    @classmethod
    def of(cls, library: Library, modes: Sequence[str]) -> Rules:
        """Return the rules of a library."""
        allowed = np.array([[a != b and library.allows(a, b) for b in modes] for a in modes])
        shortest = np.array([library.durations[mode] for mode in modes])
        ends = np.logical_or.accumulate([[mode in after for mode in modes] for after in library.ends_after])
        begins = np.flatnonzero(np.isin(modes, library.first) & ends[-1])
        follows = np.zeros((len(ends), *allowed.shape), dtype=bool)
        follows[:-1] = allowed & ends[-2::-1, None]
        return cls(np.arange(len(modes)), shortest, begins, ends[0], follows, None)

    @classmethod
    def of_order(cls, modes: Integers, shortest: FloatArray, between: FloatArray) -> Rules:
        """Return the rules of a given order of modes (N + 1,), each of which lasts at least some time."""
        count = len(modes)
        follows = np.repeat(np.eye(count, k=1, dtype=bool)[None], count, axis=0)
        return cls(modes, shortest, np.zeros(1, dtype=np.int64), np.arange(count) == count - 1, follows, between)

    def list_births(self, kept: Sequences, t: float, end: float) -> tuple[Integers, Integers]:
        """Return the births at a time: positions of the parents (C,), and places of the children (C,)."""
        may_leave = t - kept.last >= self.least[kept.mode]
        if self.between is not None and self.between.size:
            earliest, latest = self.between[:, np.minimum(kept.switches, self.between.shape[1] - 1)]
            may_leave &= (earliest < t) & (t < latest)
        may_enter = t + self.shortest <= end
        K = len(self.modes)
        follows = self.follows.reshape(-1, K).take(kept.switches * K + kept.mode, axis=0)
        parents, after = (follows & may_leave[:, None] & may_enter).nonzero()
        return parents, after

    @property
    def least(self) -> FloatArray:
        """How long a hypothesis stays in each place, (K,): its mode's shortest time, and more than an instant."""
        return np.maximum(self.shortest * (1 - 1e-9), SMALLEST)


class Sequences(NamedTuple):
    """Sequences of B hypotheses.

    Attributes
    ----------
    mode : (B,) int, place of the mode that each is in
    switches : (B,) int
    last : (B,), time of its last birth, or t0
    code : (B,) int, equal for equal sequences
    modes : (B, S + 1) int
    times : (B, S), times of its births
    """

    mode: Integers
    switches: Integers
    last: FloatArray
    code: Integers
    modes: Integers
    times: FloatArray

    @classmethod
    def start(cls, first: Integers, births: int, t0: float) -> Sequences:
        """Return one hypothesis for each first mode."""
        B = len(first)
        modes = np.zeros((B, births + 1), dtype=np.int64)
        modes[:, 0] = first
        return cls(first, np.zeros(B, dtype=np.int64), np.full(B, t0), first + 1, modes, np.zeros((B, births)))

    @classmethod
    def of_places(cls, places: Integers, times: FloatArray, last: FloatArray) -> Sequences:
        """Return those of hypotheses in these places of a given order, with their births (B, S), and the last ones."""
        passed = np.arange(times.shape[1] + 1)
        return cls(places, places, last, places, np.where(passed <= places[:, None], passed, 0), times)

    def take(self, chosen: Integers | slice) -> Sequences:
        """Return some of them."""
        mode, switches, last, code, modes, times = self
        return Sequences(mode[chosen], switches[chosen], last[chosen], code[chosen], modes[chosen], times[chosen])

    def list_children(self, parents: Integers, after: Integers) -> Children:
        """Return all of them as they are, then births: positions of their parents (C,), and their modes (C,)."""
        parent = np.concatenate([np.arange(len(self.mode)), parents])
        # Equal sequences have equal codes: int64 wraps around for long ones, where two codes meet by chance at worst.
        born = self.code[parents] * MULTIPLIER + after + 1
        return Children(
            parent,
            np.concatenate([self.mode, after]),
            np.concatenate([self.switches, self.switches[parents] + 1]),
            np.concatenate([self.code, born]),
        )

    def follow(self, children: Children, chosen: Integers, t: float) -> Sequences:
        """Return the chosen ones of their children; births were at t."""
        parent, mode, switches = children.parent[chosen], children.mode[chosen], children.switches[chosen]
        modes, times, last = self.modes.take(parent, axis=0), self.times.take(parent, axis=0), self.last[parent]
        born = (chosen >= len(self.mode)).nonzero()[0]
        slot = switches[born]
        modes[born, slot], times[born, slot - 1], last[born] = mode[born], t, t
        return Sequences(mode, switches, last, children.code[chosen], modes, times)


def encode(modes: Sequence[int]) -> int:
    """Return the code of a sequence of modes."""
    code = 0
    for mode in modes:
        code = (code * MULTIPLIER + mode + 1) % 2**64
    return (code + 2**63) % 2**64 - 2**63


class Children(NamedTuple):
    """Children of hypotheses: position of the parent, place, number of switches and code of the sequence; (C,) each."""

    parent: Integers
    mode: Integers
    switches: Integers
    code: Integers


def select_lowest(
    value: FloatArray, code: Integers, switches: Integers, width: int, per_code: int = PER_SEQUENCE
) -> Integers:
    """Return the positions of the lowest values, at most `per_code` with the same code, in ascending order.

    A part of them is kept for each number of switches: where sigma is too small, or the model wrong, further switches
    pay everywhere, and hypotheses that have used up theirs would drive out all others.
    """
    order = value.argsort(kind="stable")
    order = order[np.isfinite(value[order])]
    # In the order of their values; the best of each number of switches first, then the others while there is room.
    most = int(np.maximum.reduce(switches, initial=0))
    first: list[int] = []  # places in this order
    others: list[int] = []
    codes = code[order].tolist()
    of_code, of_number = dict.fromkeys(codes, per_code), [int(RESERVED * width / (1 + most))] * (1 + most)  # left
    for place, (own, number) in enumerate(zip(codes, switches[order].tolist(), strict=True)):
        if of_code[own]:
            of_code[own] -= 1
            if of_number[number]:
                of_number[number] -= 1
                first.append(place)
            else:
                others.append(place)
    return order[sorted(first + others[: max(width - len(first), 0)])]
