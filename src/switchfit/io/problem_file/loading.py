"""Load a problem file: read it, open its logs, build the problem.

Each step imports what it needs, the second one NumPy, the third one JAX: what is wrong with the file or with its logs
is said before, in a quarter of the time, and that a log is missing before NumPy.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from switchfit.io.problem_file.contents import parse_contents, read_text
from switchfit.io.problem_file.files import expand_experiments, replace_log
from switchfit.io.problem_file.tables import Contents
from switchfit.io.python_file import find_object

if TYPE_CHECKING:
    from switchfit.io.problem_file.building import ProblemFile
    from switchfit.io.problem_file.experiments import Runs
    from switchfit.io.problem_file.logs import Opened


def load_problem(
    path: str | Path, log: str | Path | None = None, *, text: str | None = None, searched: bool = False
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
    >>> import switchfit as sf
    >>> from switchfit.io.first_problem import write_first_problem
    >>> from switchfit.io.problem_file import load_problem

    >>> with TemporaryDirectory() as folder:
    ...     write_first_problem(Path(folder) / "room", None)[0].name
    ...     loaded = load_problem(Path(folder) / "room" / "problem.toml")
    'problem.toml'
    >>> loaded.problem.theta_names, loaded.options
    (('tau_1', 'heating', 'loss', 'T(t0)'), {})
    """
    path = Path(path)
    text = read_text(path) if text is None else text
    contents, opened = _open(path, text, log)
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
    contents, opened = _open(path, read_text(path), None)
    from switchfit.io.problem_file.building import build_without_python

    return build_without_python(path, contents, opened)


def _open(path: Path, text: str, log: str | Path | None) -> tuple[Contents, list[Opened]]:
    """Return the checked tables of a file and its open logs; arguments as of `load_problem`."""
    contents = parse_contents(path, text)
    if contents.problem is not None:
        find_object(contents.problem, path.parent, f"{path}: problem")
    elif contents.model is not None and ".py" in contents.model.name:
        find_object(contents.model.name, path.parent, f"{path}: model")
    if log is not None:
        contents = replace_log(path, contents, os.path.abspath(log))
    expanded = expand_experiments(path, contents)
    from switchfit.io.problem_file.logs import open_experiments

    return contents, open_experiments(path, contents, expanded)
