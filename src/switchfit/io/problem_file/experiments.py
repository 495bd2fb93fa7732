"""Build the experiments of a problem file from its tables and their logs.

Load what a problem file names in Python: the model, observations, jumps.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from switchfit.io.logs.log import Log
from switchfit.io.problem_file.logs import Opened, cut_log, find_parameters, list_columns
from switchfit.io.problem_file.tables import (
    Contents,
    DataTable,
    ExperimentTable,
    InputTable,
    JumpTable,
    LibraryTable,
    ModelTable,
    ParameterTable,
    PriorTable,
)
from switchfit.io.user_files import build_at, call, find_object, load_object
from switchfit.models import BUILT_IN
from switchfit.problem.data import Input, Measurements, ReferenceSignal
from switchfit.problem.experiment import Experiment, Jump, Parameter
from switchfit.problem.parameter import LogNormal, Normal, Prior
from switchfit.problem.system import HybridSystem
from switchfit.runtime.errors import InputError, Issue

T = TypeVar("T")


def build_system(path: Path, table: ModelTable, *, run: bool = True) -> HybridSystem | None:
    """Return the system of a model that is built in, or in a Python file; None if that is not to be run.

    Parameters
    ----------
    path : Path
        The problem file.
    table : ModelTable
    run : bool
    """
    what = f"{path}: model"
    if ".py" not in table.name and table.name not in BUILT_IN:
        raise InputError(
            f"{what} {table.name!r} is not known; the built-in models are {', '.join(BUILT_IN)}. Give a model of your "
            "own as 'file.py:object'."
        )
    if not run:
        return None
    found = BUILT_IN.get(table.name) or load_object(table.name, path.parent, what)
    return make(found, table, what, HybridSystem)


def make(found: Any, table: ModelTable, what: str, kind: type[T]) -> T:
    """Return an object of some kind that a Python file has, or that a function in it returns.

    Parameters
    ----------
    found : object
    table : ModelTable
        Its name, and the arguments of the function.
    what : str
        Place in the problem file, for messages.
    kind : type
    """
    if callable(found):
        found = _call(found, table, what)
    elif table.arguments:
        raise InputError(f"{what} {table.name!r} is not a function; leave out its arguments.")
    if not isinstance(found, kind):
        raise InputError(
            f"{what} {table.name!r} must be an sf.{kind.__name__} or a function that returns one; "
            f"got {type(found).__name__}."
        )
    return found


def _call(factory: Callable[..., Any], table: ModelTable, what: str) -> Any:
    """Return what a function of a user returns with the arguments of a table; raise if it does not take them."""
    try:
        inspect.signature(factory).bind(**table.arguments)
    except TypeError as error:
        takes = ", ".join(inspect.signature(factory).parameters) or "no arguments"
        raise InputError(f"{what} {table.name!r}: {error}; it takes {takes}.") from error
    return call(factory, f"{what} {table.name!r}", **table.arguments)


@functools.cache
def select_states(indices: tuple[int, ...]) -> Callable[..., Any]:
    """Return the observation ``h(t, x, p) = x[indices]``, cached by indices so that it compiles once.

    Parameters
    ----------
    indices : tuple of int
        Positions in the state.
    """
    picked = np.array(indices)

    def observe(t: Any, x: Any, p: Any) -> Any:
        return x[picked]

    return observe


class Runs(NamedTuple):
    """The experiments of a problem file, and what is odd about their logs.

    Attributes
    ----------
    experiments : tuple of Experiment
    issues : tuple of Issue
        As of a `ProblemFile`.
    tables : tuple of ExperimentTable, one for each experiment
        With a log of its own where the file has a pattern.
    """

    experiments: tuple[Experiment, ...]
    issues: tuple[Issue, ...]
    tables: tuple[ExperimentTable, ...] = ()


def build_experiments(
    path: Path,
    contents: Contents,
    opened: Sequence[Opened],
    system: HybridSystem | None,
    *,
    searched: bool = False,
) -> Runs:
    """Return the experiments, one for each log that a pattern stands for; without a system they observe nothing.

    Parameters
    ----------
    path : Path
        The problem file.
    contents : Contents
    opened : sequence of Opened
        The logs of each experiment.
    system : HybridSystem or None
    searched : bool
        Whether mode sequences are to be found, so that they may be left out.
    """
    experiments: list[Experiment] = []
    used: list[ExperimentTable] = []
    issues: dict[str, Issue] = {}
    for k, runs in enumerate(opened, start=1):
        where = f"{path}: experiments[{k}]"
        refused: list[ValueError] = []
        for table, logs in runs:
            if table.mode_sequence is None:
                found = system if searched else None
                table = build_at(where, _add_first_sequence, path, table, contents.library, found)
            try:
                if isinstance(logs, ValueError):
                    raise logs
                issues |= {str(issue): issue for log in logs for issue in log.issues}
                run = _Run(path.parent, where, table, system, find_parameters(contents, table))
                experiments.append(build_at(where, run.build, logs))
                used.append(table)
            except ValueError as error:
                refused.append(error)
        if len(refused) == len(runs):
            raise refused[0]
        issues |= {str(error): Issue("log: refused", (str(error),)) for error in refused}
    return Runs(tuple(experiments), tuple(issues.values()), tuple(used))


def _add_first_sequence(
    path: Path, table: ExperimentTable, library: LibraryTable | None, system: HybridSystem | None
) -> ExperimentTable:
    """Return an experiment without a mode sequence with one of a single mode, from which a search begins.

    Raises ValueError without a system: there is no search, which alone needs no sequence.
    """
    if library is None:
        raise ValueError(
            "the key 'mode_sequence' is missing: name the modes in the order of their activity. If that is what you "
            f"want to know, add [library] to the file: switchfit modes {path} then finds the sequence."
        )
    if system is None:
        raise ValueError(
            f"the key 'mode_sequence' is missing, and [library] leaves it to be found: switchfit modes {path} "
            "--out DIR finds it, and writes DIR/best.toml, a problem file with the sequence."
        )
    if table.transition_times is not None:
        raise ValueError("transition_times belong to a mode_sequence, which is missing: leave out both, or none.")
    names = [*(library.first or ()), *(library.modes or ()), *system.modes]
    first = next(name for name in names if name in system.modes)
    return table.model_copy(update={"mode_sequence": [first], "transition_times": []})


FOREIGN = {"measurements": ("lowpass_hz", "weights"), "reference": ("sigma", "loss", "delay")}
"""Of each kind of data, the keys of the other one."""


@dataclass(frozen=True)
class _Run:
    """A run of a problem file: `where` it stands, for messages, and the names of its parameters."""

    folder: Path
    where: str
    table: ExperimentTable
    system: HybridSystem | None
    parameters: frozenset[str]

    def build(self, logs: Sequence[Log]) -> Experiment:
        table, built = self.table, {}
        for (place, item), log in zip(table.list_logs().items(), logs, strict=True):
            build = self._build_input if isinstance(item, InputTable) else self._build_data
            built[place] = build_at(f"{self.where}.{place}", build, place, item, log)
        inputs, times, state = built.pop("inputs", None), table.transition_times, table.initial_state
        jumps = {f"jumps[{k}]": jump for k, jump in enumerate(table.jumps, start=1)}
        return Experiment(
            data=list(built.values()),
            mode_sequence=tuple(table.mode_sequence or ()),
            transition_times=None if times is None else tuple(map(build_parameter, times)),
            t0=table.t0,
            tf=None if table.tf is None else build_parameter(table.tf),  # type: ignore[arg-type]
            inputs=inputs,
            initial_state=None if state is None else [e.value if e.fixed else build_parameter(e) for e in state],
            parameter_map=table.parameter_map,
            name=table.name,
            time_unit=table.time_unit,
            jumps=[build_at(f"{self.where}.{at}", self._build_jump, at, jump) for at, jump in jumps.items()],
            origin=table.origin,
            time_zone=table.time_zone,
        )

    def _load_function(self, place: str, reference: str) -> Any:
        """Return a function of a Python file, or one in its place if that is not to be run."""
        if self.system is not None:
            return load_object(reference, self.folder, f"{self.where}.{place}")
        find_object(reference, self.folder, f"{self.where}.{place}")
        return lambda t, x, p: x

    def _build_jump(self, place: str, table: JumpTable) -> Jump:
        found = self._load_function(f"{place}.map", table.map.name)
        if table.map.arguments and self.system is not None:
            found = _call(found, table.map, f"{self.where}.{place}.map")
        return Jump(table.time, found)

    def _build_observe(self, place: str, table: DataTable) -> Callable[..., Any] | None:
        """Return the observation h(t, x, p); None for the whole state."""
        if isinstance(table.observe, str):
            return self._load_function(f"{place}.observe", table.observe)
        if self.system is None or table.observe is None:
            return None
        states = self.system.state_names
        if states is None:
            raise ValueError("observe names states, but the model has no state_names; add them to it.")
        if unknown := [name for name in table.observe if name not in states]:
            raise ValueError(f"observe names the unknown state {unknown[0]!r}; the states are {', '.join(states)}.")
        return select_states(tuple(map(states.index, table.observe)))

    def _build_data(self, place: str, item: DataTable, log: Log) -> Measurements | ReferenceSignal:
        observe = self._build_observe(place, item)
        for key in FOREIGN[item.kind]:
            if key in item.model_fields_set:
                raise ValueError(
                    f"{key} does not belong to kind = {item.kind!r}: measurements have sigma, loss and delay, a "
                    "reference has lowpass_hz and weights."
                )
        kind = Measurements if item.kind == "measurements" else ReferenceSignal
        columns, q = list_columns(item, self.parameters), len(item.columns)
        times, values, units = cut_log(log, item, columns, self.table, kind.__name__)
        names = tuple(item.observe if isinstance(item.observe, list) else item.columns)
        more: dict[str, Any] = {"observe": observe, "names": names, "units": units[:q]}
        if kind is ReferenceSignal:
            return ReferenceSignal.from_samples(times, values, lowpass_hz=item.lowpass_hz, weights=item.weights, **more)
        sigma = values[:, q:] if len(columns) > q else item.sigma
        given = item.model_dump(include={"loss", "loss_scale", "delay"})
        return Measurements(times, values[:, :q], sigma=sigma, **given, **more)

    def _build_input(self, place: str, item: InputTable, log: Log) -> Input:
        times, values, units = cut_log(log, item, list_columns(item, self.parameters), self.table, "Input")
        given: Any = times
        if not len(log):  # of a stream, whose inputs hold until others come
            given, values = [self.table.t0 or 0.0], np.zeros((1, len(units)))
        if isinstance(item.columns, dict):
            named = dict(zip(item.columns, values.T, strict=True))
            ordered = tuple(unit for _, unit in sorted(zip(item.columns, units, strict=True)))
            return Input(given, named, kind=item.kind, units=ordered)
        return Input(given, values[:, 0] if len(item.columns) == 1 else values, kind=item.kind, units=units)


def build_parameter(table: ParameterTable) -> Parameter:
    """Return the unknown that a table describes.

    Parameters
    ----------
    table : ParameterTable
    """
    return Parameter(
        **table.model_dump(exclude={"prior"}), prior=None if table.prior is None else _build_prior(table.prior)
    )


def _build_prior(table: PriorTable) -> Prior:
    given = table.model_dump(exclude_none=True)
    if set(given) == {"mean", "sd"}:
        return Normal(**given)
    if set(given) == {"median", "log_sd"}:
        return LogNormal(**given)
    raise ValueError(f"prior needs mean and sd (normal), or median and log_sd (log-normal); got {given}.")
