"""Load a problem file: read it, open its logs, build the problem.

Each step imports what it needs, the second one NumPy, the third one JAX: what is wrong with the file or with its logs
is said before, in a quarter of the time, and that a log is missing before NumPy.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from switchfit.io.logs.files import find_logs, name_files
from switchfit.io.problem_file.contents import read_contents
from switchfit.io.problem_file.tables import Contents, DataTable, ExperimentTable, InputTable
from switchfit.io.user_files import build_at, find_object
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors

if TYPE_CHECKING:
    from switchfit.io.problem_file.building import ProblemFile
    from switchfit.io.problem_file.experiments import Runs
    from switchfit.io.problem_file.logs import Opened

NamesLog = TypeVar("NamesLog", DataTable, InputTable)


def load_problem(
    path: str | Path,
    log: str | Path | None = None,
    *,
    text: str | None = None,
    searched: bool = False,
    streamed: bool = False,
) -> ProblemFile:
    """Read a problem file, the data files it names, and the Python file of its model.

    Parameters
    ----------
    path : str or Path
        A TOML file. Paths in it are relative to its folder.
    log : str or Path, optional
        Instead of the file that the data of the only experiment name; inputs and further data from other files stay.
    text : str, optional
        Instead of what the problem file contains, which then need not be there.
    searched : bool
        Whether mode sequences are to be found: a file with [library] may then leave them out.
    streamed : bool
        Whether samples come later: data and inputs without a file then have none, and inputs are 0.

    Returns
    -------
    ProblemFile

    Raises
    ------
    InputError
        For any error in the file or in the files that it names; the message has the file, the key, the value that was
        given, and what to do.

    See Also
    --------
    switchfit.Estimate.save : stores where a fit comes from.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from switchfit.cli.first_problem import write_first_problem
    >>> from switchfit.io.problem_file import load_problem

    >>> with TemporaryDirectory() as folder:
    ...     write_first_problem(Path(folder) / "room", None)[0].name
    ...     loaded = load_problem(Path(folder) / "room" / "problem.toml")
    'problem.toml'
    >>> loaded.problem.theta_names, loaded.options
    (('tau_1', 'heating', 'loss', 'T(t0)'), {})
    """
    path = Path(path)
    text, contents = read_contents(path, text)
    contents, opened = _open(path, contents, log, streamed=streamed)
    # The third step, with JAX.
    from switchfit.io.problem_file.building import build_problem

    return build_problem(path, text, contents, opened, log, searched=searched)


def read_experiments(path: str | Path) -> Runs:
    """Read a problem file and the data files it names, but do not run the Python file that it names.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Runs
        With data and horizon, but without observation functions; empty if the whole problem is built in Python.

    Raises
    ------
    InputError
        As in `load_problem`.
    """
    path = Path(path)
    contents, opened = _open(path, read_contents(path)[1], None)
    from switchfit.io.problem_file.experiments import build_experiments
    from switchfit.io.problem_file.parameters import build_parameters

    build_parameters(path, contents)
    return build_experiments(path, contents, opened, run=False)


def _open(
    path: Path, contents: Contents, log: str | Path | None, *, streamed: bool = False
) -> tuple[Contents, list[Opened]]:
    """Return the tables of a file, with another log in them if one is given, and its open logs."""
    # Files that are missing are named before any log is read.
    for key, table in (("problem", contents.problem), ("model", contents.model)):
        if table is not None and (key == "problem" or ".py" in table.name):
            find_object(table.name, path.parent, f"{path}: {key}")
    if log is not None:
        contents = _replace_log(path, contents, os.path.abspath(log))
    expanded = [
        build_at(f"{path}: experiments[{k}]", _expand_patterns, path.parent, table)
        for k, table in enumerate(contents.experiments, start=1)
    ]
    from switchfit.io.problem_file.logs import open_experiments

    return contents, open_experiments(path, contents, expanded, streamed=streamed)


def _expand_patterns(folder: Path, table: ExperimentTable) -> list[ExperimentTable]:
    """Return an experiment for each log that patterns and folders in it stand for; logs of one name go together."""
    given = {item.file for item in table.list_logs().values() if item.file is not None}
    found = {pattern: find_logs(folder, pattern) for pattern in sorted(given)}
    for single in (folder / pattern for pattern, logs in found.items() if logs is None):
        with explain_read_errors(single):
            single.stat()
    # Data and inputs may have patterns of their own, `gps/*.csv` and `wheels/*.csv`: logs of one name are one run, and
    # one without its counterpart is an error, not a run with less data.
    named = {pattern: dict(zip(name_files(logs), logs, strict=True)) for pattern, logs in found.items() if logs}
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


def _replace_files(table: ExperimentTable, files: Mapping[str | None, str], name: str | None) -> ExperimentTable:
    """Return an experiment with other files in place of some."""

    def replace(item: NamesLog) -> NamesLog:
        return item.model_copy(update={"file": files.get(item.file, item.file)})

    inputs = None if table.inputs is None else replace(table.inputs)
    return table.model_copy(update={"data": [replace(item) for item in table.data], "inputs": inputs, "name": name})


def _replace_log(path: Path, contents: Contents, log: str) -> Contents:
    """Return the contents with a log in place of the files that are left out, or else of the first file of the data."""
    if len(contents.experiments) != 1:
        raise InputError(
            f"{path} must have one [[experiments]], in which a log can take the place of the data; got "
            f"{len(contents.experiments)}. Write a problem file for the log."
        )
    (table,) = contents.experiments
    left_out = any(item.file is None for item in table.list_logs().values())
    # A file that is left out is the place for a log; else the first data, since a run has always some.
    files = {None if left_out else table.data[0].file: log}
    return contents.model_copy(update={"experiments": [_replace_files(table, files, table.name)]})
