"""Find the logs that a problem file names: one run a log where a pattern stands for several."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from switchfit.io.logs.files import find_logs, name_logs
from switchfit.io.problem_file.places import build_at
from switchfit.io.problem_file.tables import Contents, ExperimentTable, LogTable
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors


def expand_experiments(path: Path, contents: Contents) -> list[list[ExperimentTable]]:
    """Return for each experiment one for each log that its patterns stand for; raise if a log is missing.

    Parameters
    ----------
    path : Path
        The problem file.
    contents : Contents
    """
    return [
        build_at(f"{path}: experiments[{k}]", _expand_patterns, path.parent, table)
        for k, table in enumerate(contents.experiments, start=1)
    ]


def _expand_patterns(folder: Path, table: ExperimentTable) -> list[ExperimentTable]:
    """Return an experiment for each log that patterns and folders in it stand for; logs of one name go together."""
    given = {item.file for item in list_log_tables(table) if item.file is not None}
    found = {pattern: find_logs(folder, pattern) for pattern in sorted(given)}
    for single in (folder / pattern for pattern, logs in found.items() if logs is None):
        with explain_read_errors(single):
            single.stat()
    named = {pattern: dict(zip(name_logs(logs), logs, strict=True)) for pattern, logs in found.items() if logs}
    if not named:
        return [table]
    names = set.union(*(set(logs) for logs in named.values()))
    for pattern, logs in named.items():
        if missing := sorted(names - set(logs)):
            raise ValueError(f"{folder / pattern} has no log {missing[0]!r}, which another pattern of the run has.")
    prefix = "" if table.name is None else f"{table.name} "
    return [
        _replace_files(table, {pattern: logs[name] for pattern, logs in named.items()}, f"{prefix}{name}")
        for name in sorted(names)
    ]


def list_log_tables(table: ExperimentTable) -> list[LogTable]:
    """Return the tables of an experiment that name a log: its data, then its inputs.

    Parameters
    ----------
    table : ExperimentTable
    """
    return [*table.data, *([] if table.inputs is None else [table.inputs])]


def _replace_files(table: ExperimentTable, files: Mapping[str | None, str], name: str | None) -> ExperimentTable:
    """Return an experiment with other files in place of some."""

    def replace(item: Any) -> Any:
        return item.model_copy(update={"file": files.get(item.file, item.file)})

    inputs = None if table.inputs is None else replace(table.inputs)
    return table.model_copy(update={"data": [replace(item) for item in table.data], "inputs": inputs, "name": name})


def replace_log(path: Path, contents: Contents, log: str) -> Contents:
    """Return the contents with a log in place of the files that are left out, or else of the first file of the data.

    Parameters
    ----------
    path : Path
        The problem file.
    contents : Contents
    log : str
    """
    if len(contents.experiments) != 1:
        raise InputError(
            f"{path} must have one [[experiments]], in which a log can take the place of the data; got "
            f"{len(contents.experiments)}. Write a problem file for the log."
        )
    (table,) = contents.experiments
    left_out = any(item.file is None for item in list_log_tables(table))
    files = {None if left_out else table.data[0].file: log}
    return contents.model_copy(update={"experiments": [_replace_files(table, files, table.name)]})
