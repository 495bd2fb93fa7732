"""Build the experiments of a problem file from its open logs.

What they name in Python is loaded: the model, observations, jumps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.io.logs.log import Log
from switchfit.io.problem_file import tables
from switchfit.io.problem_file.logs import Opened
from switchfit.io.problem_file.parameters import build_parameter
from switchfit.io.problem_file.samples import cut_log
from switchfit.io.problem_file.tables import Contents, DataTable, ExperimentTable, InputTable, ModelTable
from switchfit.io.user_files import UserObject, build_at, call, find_object, load_object
from switchfit.models import BUILT_IN
from switchfit.problem.dates import Dates
from switchfit.problem.experiment import Experiment
from switchfit.problem.inputs import Input
from switchfit.problem.jump import Jump
from switchfit.problem.measurements import Measurements
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.system import HybridSystem
from switchfit.runtime.errors import InputError
from switchfit.runtime.issue import Issue

Kind = TypeVar("Kind")

PREFIXES = "pnµmcdhkMGT"
"""Of units that differ by a power of ten."""

KEYS_OF_ONE_KIND = {"measurements": ("sigma", "loss", "delay"), "reference": ("lowpass_hz", "weights")}
"""Of each kind of data, the keys that the other one does not have."""


class Runs(NamedTuple):
    """The experiments of a problem file, and what is odd about their logs.

    Attributes
    ----------
    experiments : tuple of Experiment
    issues : tuple of Issue
        As of a `ProblemFile`.
    tables : tuple of ExperimentTable, one for each experiment
        With a log of its own where the file has a pattern.
    system : HybridSystem or None
    """

    experiments: tuple[Experiment, ...]
    issues: tuple[Issue, ...]
    tables: tuple[ExperimentTable, ...]
    system: HybridSystem | None


def load_named_object(path: Path, key: str, table: ModelTable, kind: type[Kind]) -> Kind:
    """Return what a key names: something built in, or in a Python file, or what a function there returns."""
    what = f"{path}: {key} {table.name!r}"
    found = BUILT_IN.get(table.name) or load_object(table.name, path.parent, f"{path}: {key}")
    if callable(found):
        found = call(found, what, **table.arguments)
    elif table.arguments:
        raise InputError(f"{what} is not a function; leave out its arguments.")
    if not isinstance(found, kind):
        raise InputError(
            f"{what} must be an sf.{kind.__name__} or a function that returns one; got {type(found).__name__}."
        )
    return found


def build_experiments(
    path: Path, contents: Contents, opened: Sequence[Opened], *, searched: bool = False, run: bool = True
) -> Runs:
    """Return the experiments, one for each log that a pattern stands for; without a system they observe nothing.

    Parameters
    ----------
    path : Path
        The problem file.
    contents : Contents
    opened : sequence of Opened
        The logs of each experiment.
    searched : bool
        Whether mode sequences are to be found, so that they may be left out.
    run : bool
        Whether to run the Python file of the model; without, there is no system.
    """
    model = contents.model
    if model is not None and ".py" not in model.name and model.name not in BUILT_IN:
        raise InputError(
            f"{path}: model {model.name!r} is not known; the built-in models are {', '.join(BUILT_IN)}. Give a model "
            "of your own as 'file.py:object'."
        )
    system = load_named_object(path, "model", model, HybridSystem) if run and model is not None else None
    experiments: list[Experiment] = []
    used: list[ExperimentTable] = []
    issues: dict[str, Issue] = {}
    for k, runs in enumerate(opened, start=1):
        where = f"{path}: experiments[{k}]"
        # Of many logs, one that cannot be used does not stop the others; if none can be used, the first error is
        # raised.
        refused: list[ValueError] = []
        for table, logs in runs:
            try:
                if table.mode_sequence is None:
                    found = system if searched else None
                    table = build_at(where, _add_first_sequence, path, table, contents.library, found)
                if isinstance(logs, ValueError):
                    raise logs
                # By their sentences: a log that several experiments name is odd once.
                issues |= {str(issue): issue for log in logs for issue in log.issues}
                experiments.append(build_at(where, _Run(path.parent, where, contents, table, system).build, logs))
                used.append(table)
            except ValueError as error:
                refused.append(error)
        if len(refused) == len(runs):
            raise refused[0]
        issues |= {str(error): Issue("log: refused", (str(error),)) for error in refused}
    return Runs(tuple(experiments), tuple(issues.values()), tuple(used), system)


def _add_first_sequence(
    path: Path, table: ExperimentTable, library: tables.LibraryTable | None, system: HybridSystem | None
) -> ExperimentTable:
    """Return an experiment without a mode sequence with one of a single mode, from which a search begins.

    Raises ValueError without a system: there is no search, which alone needs no sequence.
    """
    if library is None or system is None:
        add = "add [library] to the file: " if library is None else ""
        raise ValueError(
            "the key 'mode_sequence' is missing: name the modes in the order of their activity. If that is what you "
            f"want to know, {add}switchfit modes {path} --out DIR finds it, and writes a problem file, DIR/best.toml."
        )
    if table.transition_times is not None:
        raise ValueError("transition_times belong to a mode_sequence, which is missing: leave out both, or none.")
    # Any mode will do for the search to begin with, but one that may be first needs no repair.
    names = [*(library.first or ()), *(library.modes or ()), *system.modes]
    first = next(name for name in names if name in system.modes)
    return table.model_copy(update={"mode_sequence": [first], "transition_times": []})


def _check_units(item: DataTable, units: Sequence[str], system: HybridSystem) -> None:
    """Refuse a column in the unit of the state that it measures, but for its prefix: nothing converts it."""
    # The Greek mu, the micro sign and the u of files are one prefix.
    states, simple = system.state_names or (), str.maketrans("uμ", "µµ")
    known = dict(zip(states, system.state_units or (), strict=False))
    for column, state, unit in zip(item.columns, item.observe or states, units, strict=False):
        pair = [found.translate(simple) for found in (unit, known.get(state, ""))]
        # Each unit as it is and without its first letter, if that is a prefix: m and mm share m. A unit that is
        # altogether another one is left to the user, who may know that they are the same.
        bare, other = ({name, name[name[:1] in PREFIXES :]} - {""} for name in pair)
        if pair[0] != pair[1] and bare & other:
            raise ValueError(
                f"column {column!r} is in {unit}, but the model has the state {state!r} in {known[state]}, and nothing "
                "converts it: change that unit in state_units, with the guesses, or the column of the log."
            )


@dataclass(frozen=True)
class _Run:
    """A run of a problem file, and `where` it stands, for messages."""

    folder: Path
    where: str
    contents: Contents
    table: ExperimentTable
    system: HybridSystem | None

    def build(self, logs: Sequence[Log]) -> Experiment:
        table = self.table
        data: list[Measurements | ReferenceSignal] = []
        inputs: Input | None = None
        for (place, item), log in zip(table.list_logs().items(), logs, strict=True):
            where = f"{self.where}.{place}"
            if isinstance(item, InputTable):
                inputs = build_at(where, self._build_input, place, item, log)
            else:
                data.append(build_at(where, self._build_data, place, item, log))
        times, state = table.transition_times, table.initial_state
        jumps = {f"jumps[{k}]": jump for k, jump in enumerate(table.jumps, start=1)}
        # Keys that `Experiment` takes as they are; all others are built first.
        given: dict[str, Any] = table.model_dump(
            include={"t0", "parameter_map", "name", "time_unit", "origin", "time_zone"}
        )
        return Experiment(
            **given,
            mode_sequence=tuple(table.mode_sequence or ()),
            inputs=inputs,
            data=data,
            transition_times=None if times is None else tuple(map(build_parameter, times)),
            tf=None if table.tf is None else build_parameter(table.tf),  # type: ignore[arg-type]
            initial_state=None if state is None else [e.value if e.fixed else build_parameter(e) for e in state],
            jumps=[build_at(f"{self.where}.{at}", self._build_jump, at, jump) for at, jump in jumps.items()],
        )

    def _load_function(self, place: str, reference: str) -> UserObject:
        """Return a function of a Python file, or one in its place if that is not to be run."""
        if self.system is not None:
            return load_object(reference, self.folder, f"{self.where}.{place}")
        # Without running it (`switchfit check --no-run`), it can be said that the file is there.
        find_object(reference, self.folder, f"{self.where}.{place}")
        return lambda t, x, p: x

    def _build_jump(self, place: str, table: tables.JumpTable) -> Jump:
        found = self._load_function(f"{place}.map", table.map.name)
        if table.map.arguments and self.system is not None:
            found = call(found, f"{self.where}.{place}.map {table.map.name!r}", **table.map.arguments)
        return Jump(table.time, found)

    def _build_observe(self, place: str, table: DataTable) -> Callable[..., Any] | None:
        """Return the observation h(t, x, p); None for the whole state."""
        if isinstance(table.observe, str):
            return self._load_function(f"{place}.observe", table.observe)
        states = None if self.system is None else self.system.state_names
        if table.observe is None and states and len(table.columns) != len(states):
            raise ValueError(
                f"{len(table.columns)} columns are not the whole state ({', '.join(states)}): add observe, a list of "
                "the states that they measure, or 'file.py:function'."
            )
        if self.system is None or table.observe is None:
            return None
        if states is None:
            raise ValueError("observe names states, but the model has no state_names; add them to it.")
        if unknown := [name for name in table.observe if name not in states]:
            raise ValueError(f"observe names the unknown state {unknown[0]!r}; the states are {', '.join(states)}.")
        # By their places: names of states mean nothing inside a traced function.
        picked = np.array([states.index(name) for name in table.observe])
        return lambda t, x, p: x[picked]

    def _build_data(self, place: str, item: DataTable, log: Log) -> Measurements | ReferenceSignal:
        observe = self._build_observe(place, item)
        # What the user has set, not what a field has by default: loss = "linear" is an error for a reference, too, if
        # it stands in the file.
        if foreign := item.model_fields_set & {
            key for kind in KEYS_OF_ONE_KIND if kind != item.kind for key in KEYS_OF_ONE_KIND[kind]
        }:
            raise ValueError(
                f"{min(foreign)} does not belong to kind = {item.kind!r}: measurements have sigma, loss and delay, a "
                "reference has lowpass_hz and weights."
            )
        kind = Measurements if item.kind == "measurements" else ReferenceSignal
        times, values, units = cut_log(log, item, self.contents, self.table, kind.__name__)
        q = len(item.columns)
        if self.system is not None and not isinstance(item.observe, str):
            _check_units(item, units, self.system)
        names = tuple(item.observe if isinstance(item.observe, list) else item.columns)
        more: dict[str, Any] = {"observe": observe, "names": names, "units": units[:q]}
        if kind is ReferenceSignal:
            return ReferenceSignal.from_samples(times, values, lowpass_hz=item.lowpass_hz, weights=item.weights, **more)
        # Columns that hold sigma stand behind the values in what was cut from the log.
        sigma = values[:, q:] if values.shape[1] > q else item.sigma
        given = item.model_dump(include={"loss", "loss_scale", "delay"})
        return Measurements(times, values[:, :q], sigma=sigma, **given, **more)

    def _build_input(self, place: str, item: InputTable, log: Log) -> Input:
        times, values, units = cut_log(log, item, self.contents, self.table, "Input")
        given: FloatArray | Dates | list[float] = times
        if not len(log):  # of a stream, whose inputs hold until others come
            given, values = [self.table.t0 or 0.0], np.zeros((1, len(units)))
        if isinstance(item.columns, dict):
            named = dict(zip(item.columns, values.T, strict=True))
            # `Input` sorts named entries by name, as JAX does with dicts; units have the same order.
            ordered = tuple(unit for _, unit in sorted(zip(item.columns, units, strict=True)))
            return Input(given, named, kind=item.kind, units=ordered)
        return Input(given, values[:, 0] if len(item.columns) == 1 else values, kind=item.kind, units=units)
