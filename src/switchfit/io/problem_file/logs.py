"""Open the logs that a problem file names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from switchfit.io.logs.log import Log
from switchfit.io.logs.options import Options
from switchfit.io.logs.reader import read_source
from switchfit.io.logs.times import align_starts
from switchfit.io.problem_file.tables import Contents, DataTable, ExperimentTable, InputTable
from switchfit.io.user_files import build_at

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
        runs: Opened = []
        # The error of a log is kept in its place: what the others are built of is not known yet.
        for table in tables:
            where = f"{path}: experiments[{k}]"
            try:
                logs = [
                    build_at(f"{where}.{place}", _open_log, path.parent, item, contents, table, streamed)
                    for place, item in table.list_logs().items()
                ]
                # GPS and wheels of one run began at different moments; only here are they known to belong together.
                runs.append((table, align_starts(logs)))
            except ValueError as error:
                runs.append((table, error))
        errors = [logs for _, logs in runs if isinstance(logs, ValueError)]
        if len(errors) == len(runs):
            raise errors[0]
        opened.append(runs)
    return opened


def _open_log(
    folder: Path, table: DataTable | InputTable, contents: Contents, run: ExperimentTable, streamed: bool
) -> Log:
    # A column may be both a value and, by its name, sigma of another one.
    columns = list(dict.fromkeys(list_value_columns(table, contents, run)))
    if table.file is None and streamed:
        return Log(np.zeros(0), dict.fromkeys(columns, np.zeros(0)), dict.fromkeys(columns, ""), "", "the stream")
    if table.file is None:
        raise ValueError("the key 'file' is missing: name the log, or give logs: switchfit fit LOG ... --problem FILE.")
    # `keep_epoch`: numbers since 1970 become dates only if the file says so by `epoch`, since a window or a guess in
    # the file may count them as they are.
    given = table.model_dump(include={"time", "topic", "origin", "range_error", "repair"})
    log = read_source(folder / table.file, Options(columns=columns, keep_epoch=True, **given))
    return log if table.epoch is None else _count_from_1970(log, table.epoch)


def list_value_columns(table: DataTable | InputTable, contents: Contents, run: ExperimentTable) -> list[str]:
    """Return the columns of a log with values, and after them those that hold sigma, unless parameters do."""
    parameters = {*contents.parameters, *run.parameter_map}
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
