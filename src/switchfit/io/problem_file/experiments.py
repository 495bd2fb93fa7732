"""Build the experiments of a problem file from its tables and their logs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from switchfit.io.logs.log import Log
from switchfit.io.problem_file.logs import Opened, find_parameters, find_sigma_columns
from switchfit.io.problem_file.models import build_jump, build_observe
from switchfit.io.problem_file.places import build_at
from switchfit.io.problem_file.tables import (
    Contents,
    DataTable,
    ExperimentTable,
    InputTable,
    LibraryTable,
    ParameterTable,
    PriorTable,
)
from switchfit.io.problem_file.times import cut_log, find_origin
from switchfit.problem.data import Input, Measurements, ReferenceSignal
from switchfit.problem.experiment import Experiment, Parameter
from switchfit.problem.priors import LogNormal, Normal, Prior
from switchfit.problem.system import HybridSystem
from switchfit.runtime.issue import Issue


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
                known = find_parameters(contents, table)
                experiments.append(build_at(where, _build_experiment, path.parent, table, logs, system, where, known))
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


def _build_experiment(
    folder: Path,
    table: ExperimentTable,
    logs: Sequence[Log],
    system: HybridSystem | None,
    where: str,
    parameters: frozenset[str],
) -> Experiment:
    places = [f"{where}.data[{k}]" for k in range(1, len(table.data) + 1)]
    data = [
        build_at(place, _build_data, folder, item, log, system, place, parameters, table)
        for place, item, log in zip(places, table.data, logs, strict=False)  # that of the inputs comes after them
    ]
    times = table.transition_times
    return Experiment(
        data=data,
        mode_sequence=tuple(table.mode_sequence or ()),
        transition_times=None if times is None else tuple(map(build_parameter, times)),
        t0=table.t0,
        tf=None if table.tf is None else build_parameter(table.tf),  # type: ignore[arg-type]
        inputs=None
        if table.inputs is None
        else build_at(f"{where}.inputs", _build_input, table.inputs, logs[-1], table),
        initial_state=_build_initial_state(table),
        parameter_map=table.parameter_map,
        name=table.name,
        time_unit=table.time_unit,
        jumps=[
            build_at(f"{where}.jumps[{k}]", build_jump, folder, item, system, f"{where}.jumps[{k}].map")
            for k, item in enumerate(table.jumps, start=1)
        ],
        origin=find_origin(table, logs),
        time_zone=table.time_zone,
    )


FOREIGN = {"measurements": ("lowpass_hz", "weights"), "reference": ("sigma", "loss", "delay")}
"""Of each kind of data, the keys of the other one."""


def _build_data(
    folder: Path,
    table: DataTable,
    log: Log,
    system: HybridSystem | None,
    where: str,
    parameters: frozenset[str],
    run: ExperimentTable,
) -> Measurements | ReferenceSignal:
    observe = build_observe(folder, table, system, where)
    names = tuple(table.observe) if isinstance(table.observe, list) else tuple(table.columns)
    for key in FOREIGN[table.kind]:
        if getattr(table, key) != DataTable.model_fields[key].default:
            raise ValueError(
                f"{key} does not belong to kind = {table.kind!r}: measurements have sigma, loss and delay, a reference "
                "has lowpass_hz and weights."
            )
    if table.kind == "reference":
        times, values, units = cut_log(log, table, table.columns, run, "ReferenceSignal")
        return ReferenceSignal.from_samples(
            times, values, observe=observe, lowpass_hz=table.lowpass_hz, weights=table.weights, names=names, units=units
        )
    sigma_columns = find_sigma_columns(table, parameters)
    times, values, units = cut_log(log, table, [*table.columns, *sigma_columns], run, "Measurements")
    q = len(table.columns)
    sigma = values[:, q:] if sigma_columns else table.sigma
    return Measurements(
        times,
        values[:, :q],
        observe=observe,
        sigma=sigma,
        names=names,
        loss=table.loss,
        loss_scale=table.loss_scale,
        delay=table.delay,
        units=units[:q],
    )


def _build_input(table: InputTable, log: Log, run: ExperimentTable) -> Input:
    if isinstance(table.columns, dict):
        times, values, units = cut_log(log, table, list(table.columns.values()), run, "Input")
        named = dict(zip(table.columns, values.T, strict=True))
        ordered = tuple(unit for _, unit in sorted(zip(table.columns, units, strict=True)))
        return Input(times, named, kind=table.kind, units=ordered)
    times, values, units = cut_log(log, table, table.columns, run, "Input")
    return Input(times, values[:, 0] if len(table.columns) == 1 else values, kind=table.kind, units=units)


def _build_initial_state(table: ExperimentTable) -> list[Parameter] | list[float] | None:
    """Return the state at t0 for an Experiment: numbers if all of it is known."""
    if table.initial_state is None:
        return None
    if all(entry.fixed for entry in table.initial_state):
        return [entry.value for entry in table.initial_state]
    return [build_parameter(entry) for entry in table.initial_state]


def build_parameter(table: ParameterTable, **more: Any) -> Parameter:
    """Return the unknown that a table describes.

    Parameters
    ----------
    table : ParameterTable
    more
        Further arguments of `Parameter`.
    """
    given = table.model_dump(exclude={"prior"})
    return Parameter(**given, prior=None if table.prior is None else _build_prior(table.prior), **more)


def _build_prior(table: PriorTable) -> Prior:
    given = table.model_dump(exclude_none=True)
    if set(given) == {"mean", "sd"}:
        return Normal(**given)
    if set(given) == {"median", "log_sd"}:
        return LogNormal(**given)
    raise ValueError(f"prior needs mean and sd (normal), or median and log_sd (log-normal); got {given}.")
