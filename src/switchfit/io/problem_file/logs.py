"""Open the logs that a problem file names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from switchfit.io.logs.log import Log, Options
from switchfit.io.logs.reader import align_starts, read_source
from switchfit.io.problem_file.tables import Contents, DataTable, ExperimentTable, InputTable
from switchfit.io.python_file import build_at

Opened = list[tuple[ExperimentTable, list[Log] | ValueError]]
"""The runs of an experiment of a problem file: each with its logs, or with what is wrong with them."""


def open_experiments(
    path: Path, contents: Contents, expanded: Sequence[Sequence[ExperimentTable]], *, streamed: bool = False
) -> list[Opened]:
    """Return the logs of each experiment; raise what is wrong with the first if none of an experiment can be used.

    Parameters
    ----------
    path : Path
        The problem file.
    contents : Contents
    expanded : sequence of sequences of ExperimentTable
        Of each experiment a table for each log that its patterns stand for.
    streamed : bool
        Whether a table without a file has an empty log.
    """
    opened = []
    for k, tables in enumerate(expanded, start=1):
        runs = [(table, _open_logs(path, f"experiments[{k}]", contents, table, streamed)) for table in tables]
        errors = [logs for _, logs in runs if isinstance(logs, ValueError)]
        if len(errors) == len(runs):
            raise errors[0]
        opened.append(runs)
    return opened


def _open_logs(
    path: Path, where: str, contents: Contents, table: ExperimentTable, streamed: bool
) -> list[Log] | ValueError:
    """Return the logs of data and inputs, in this order, whose dates begin together; or what is wrong with them."""
    open_log = _build_empty_log if streamed else _open_log
    try:
        return align_starts(
            [
                build_at(f"{path}: {where}.{place}", open_log, path.parent, item, find_parameters(contents, table))
                for place, item in table.list_logs().items()
            ]
        )
    except ValueError as error:
        return error


def find_parameters(contents: Contents, table: ExperimentTable) -> frozenset[str]:
    """Return the names of parameters in an experiment, which a sigma may have without being a column.

    Parameters
    ----------
    contents : Contents
    table : ExperimentTable
    """
    return frozenset(contents.parameters) | frozenset(table.parameter_map)


def _open_log(folder: Path, table: DataTable | InputTable, parameters: frozenset[str]) -> Log:
    if table.file is None:
        raise ValueError("the key 'file' is missing: name the log, or give logs: switchfit fit LOG ... --problem FILE.")
    given = table.model_dump(include={"time", "topic", "origin", "range_error", "repair"})
    columns = list(dict.fromkeys(list_columns(table, parameters)))
    log = read_source(folder / table.file, Options(columns=columns, keep_epoch=True, **given))
    return log if table.epoch is None else _count_from_1970(log, table.epoch)


def _build_empty_log(folder: Path, table: DataTable | InputTable, parameters: frozenset[str]) -> Log:
    """Return the log of a table, an empty one if it names no file."""
    if table.file is not None:
        return _open_log(folder, table, parameters)
    columns = list_columns(table, parameters)
    return Log(np.zeros(0), dict.fromkeys(columns, np.zeros(0)), dict.fromkeys(columns, ""), "", "the stream")


def list_columns(table: DataTable | InputTable, parameters: frozenset[str]) -> list[str]:
    """Return the columns of a log with values, and after them those that hold sigma.

    Parameters
    ----------
    table : DataTable or InputTable
    parameters : frozenset of str
        Names that a sigma may have without being a column.
    """
    columns = list(table.columns.values() if isinstance(table.columns, dict) else table.columns)
    given = table.sigma if isinstance(table, DataTable) and isinstance(table.sigma, list) else []
    named = [entry for entry in given if isinstance(entry, str)]
    if not named or all(name in parameters for name in named):
        return columns
    if len(named) < len(given) or any(name in parameters for name in named):
        raise ValueError(
            f"sigma must name columns of the file alone, or parameters and numbers; got {given}, and the "
            f"parameters are {', '.join(sorted(parameters)) or 'none'}."
        )
    return [*columns, *named]


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
