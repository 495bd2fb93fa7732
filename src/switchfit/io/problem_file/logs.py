"""Open the logs that a problem file names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from switchfit.io.logs.log import Log
from switchfit.io.logs.reader import align_starts, read_source
from switchfit.io.problem_file.places import build_at
from switchfit.io.problem_file.tables import Contents, DataTable, ExperimentTable, InputTable, LogTable

Opened = list[tuple[ExperimentTable, list[Log] | ValueError]]
"""The runs of an experiment of a problem file: each with its logs, or with what is wrong with them."""


def open_experiments(path: Path, contents: Contents, expanded: Sequence[Sequence[ExperimentTable]]) -> list[Opened]:
    """Return the logs of each experiment; raise what is wrong with the first if none of an experiment can be used.

    Parameters
    ----------
    path : Path
        The problem file.
    contents : Contents
    expanded : sequence of sequences of ExperimentTable
        As `expand_experiments` returns them.
    """
    opened = []
    for k, tables in enumerate(expanded, start=1):
        where = f"{path}: experiments[{k}]"
        runs = [(table, _try_to_open(path.parent, table, where, find_parameters(contents, table))) for table in tables]
        errors = [logs for _, logs in runs if isinstance(logs, ValueError)]
        if len(errors) == len(runs):
            raise errors[0]
        opened.append(runs)
    return opened


def find_parameters(contents: Contents, table: ExperimentTable) -> frozenset[str]:
    """Return the names of parameters in an experiment, which a sigma may have without being a column.

    Parameters
    ----------
    contents : Contents
    table : ExperimentTable
    """
    return frozenset(contents.parameters) | frozenset(table.parameter_map)


def _try_to_open(
    folder: Path, table: ExperimentTable, where: str, parameters: frozenset[str]
) -> list[Log] | ValueError:
    try:
        return open_logs(folder, table, where, parameters)
    except ValueError as error:
        return error


def open_logs(folder: Path, table: ExperimentTable, where: str, parameters: frozenset[str]) -> list[Log]:
    """Return the logs of data and inputs, in this order; the times of those with dates begin together.

    Parameters
    ----------
    folder : Path
        Of the problem file.
    table : ExperimentTable
    where : str
        Place in the problem file, for messages.
    parameters : frozenset of str
        Names that a sigma may have without being a column.
    """
    logs = [
        build_at(f"{where}.data[{k}]", _open_data, folder, item, parameters)
        for k, item in enumerate(table.data, start=1)
    ]
    if table.inputs is not None:
        logs.append(build_at(f"{where}.inputs", _open_input, folder, table.inputs))
    return align_starts(logs)


def _open_data(folder: Path, table: DataTable, parameters: frozenset[str]) -> Log:
    return _open_log(folder, table, [*table.columns, *find_sigma_columns(table, parameters)])


def _open_input(folder: Path, table: InputTable) -> Log:
    return _open_log(folder, table, list(table.columns.values() if isinstance(table.columns, dict) else table.columns))


def _open_log(folder: Path, table: LogTable, columns: Sequence[str]) -> Log:
    if table.file is None:
        raise ValueError("the key 'file' is missing: name the log, or give logs: switchfit fit LOG ... --problem FILE.")
    log = read_source(
        folder / table.file,
        columns=list(dict.fromkeys(columns)),
        keep_epoch=True,
        **table.model_dump(include={"time", "topic", "origin", "range_error", "repair"}),
    )
    return log if table.epoch is None else _count_from_1970(log, table.epoch)


def find_sigma_columns(table: DataTable, parameters: frozenset[str]) -> list[str]:
    """Return the columns that hold sigma; an empty list if it is numbers, or names of parameters.

    Parameters
    ----------
    table : DataTable
    parameters : frozenset of str
    """
    given = table.sigma if isinstance(table.sigma, list) else []
    named = [entry for entry in given if isinstance(entry, str)]
    if not named or all(name in parameters for name in named):
        return []
    if len(named) < len(given) or any(name in parameters for name in named):
        raise ValueError(
            f"sigma must name columns of the file alone, or parameters and numbers; got {table.sigma}, and the "
            f"parameters are {', '.join(sorted(parameters)) or 'none'}."
        )
    return named


def _count_from_1970(log: Log, unit: str) -> Log:
    """Return a log whose times are numbers since 1970 as one with dates."""
    if log.offset:
        raise ValueError(f"{log.source} has dates already: leave out epoch = {unit!r}.")
    if log.time_unit not in ("", unit):
        raise ValueError(f"{log.source}: the times are in {log.time_unit}, but epoch is {unit!r}.")
    first = float(log.times[0])
    if not first > 0:
        raise ValueError(f"{log.source}: epoch = {unit!r} needs numbers that count from 1970; the first is {first:g}.")
    return replace(log, times=log.times - first, offset=first, time_unit=unit, time_zone="UTC")
