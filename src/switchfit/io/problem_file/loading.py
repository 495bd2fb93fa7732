"""Load a problem file: read it, open its logs, build the problem."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from switchfit.estimation.provenance import Provenance
from switchfit.io.problem_file.contents import parse_contents, read_text
from switchfit.io.problem_file.experiments import Runs, build_experiments, build_parameter
from switchfit.io.problem_file.logs import replace_log
from switchfit.io.problem_file.models import build_system, check_model_name
from switchfit.io.problem_file.places import build_at
from switchfit.io.problem_file.tables import OPTIONS, Contents, ModelTable
from switchfit.io.python_file import call, find_object, load_object
from switchfit.io.sources import describe_sources
from switchfit.models import BUILT_IN
from switchfit.modes.library import build_library
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import InputError
from switchfit.runtime.issue import Issue


@dataclass(frozen=True)
class ProblemFile:
    """Contents of a problem file.

    Attributes
    ----------
    path : Path
    problem : Problem
    options : dict
        Keyword arguments for `switchfit.estimate` that the file sets.
    provenance : Provenance
        The text of the file, and hashes of the files that it names: for `Estimate.save`.
    issues : tuple of Issue
        What is odd about the logs; of kind "log: refused" for those of many that could not be used.
    library : dict
        Keyword arguments for `switchfit.find_modes` that the file sets.
    contents : Contents
        The tables of the file, with an experiment for each log that could be used.
    """

    path: Path
    problem: Problem
    options: dict[str, Any]
    provenance: Provenance
    issues: tuple[Issue, ...] = ()
    library: dict[str, Any] = field(default_factory=dict)
    contents: Contents = field(default_factory=Contents, repr=False)


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
    contents = parse_contents(path, text)
    if log is not None:
        contents = replace_log(path, contents, os.path.abspath(log))
    options = contents.options.model_dump(include=OPTIONS, exclude_none=True)
    if contents.problem is None:
        problem, runs = _build_from_tables(path, contents, searched=searched)
        built = contents.model_copy(update={"experiments": list(runs.tables)})
    else:
        problem, runs, built = _load_from_python(path, contents), Runs((), ()), contents
    library = {} if contents.library is None else contents.library.model_dump(exclude_none=True)
    given = {"library": library.pop("modes")} | library if "modes" in library else library
    build_at(f"{path}: library", partial(build_library, **given, max_switches=1), problem)
    provenance = describe_sources(path, text, log, contents.model_dump(exclude_none=True), options)
    return ProblemFile(path, problem, options, provenance, runs.issues, given, built)


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
    contents = parse_contents(path, read_text(path))
    if contents.problem is not None:
        find_object(contents.problem, path.parent, f"{path}: problem")
        return Runs((), ())
    if contents.model is not None and contents.model.name not in BUILT_IN:
        check_model_name(f"{path}: model", contents.model)
        find_object(contents.model.name, path.parent, f"{path}: model")
    for name, table in contents.parameters.items():
        build_at(f"{path}: parameters.{name}", build_parameter, table)
    return build_experiments(path, contents, None)


def _load_from_python(path: Path, contents: Contents) -> Problem:
    given = contents.options.model_dump(include={"min_duration", "solver", "rtol", "atol"}, exclude_none=True)
    if given:
        raise InputError(f"{path}: with 'problem', {', '.join(given)} is set where the sf.Problem is built, not here.")
    reference = contents.problem or ""
    found = load_object(reference, path.parent, f"{path}: problem")
    if callable(found):
        found = call(found, f"{path}: problem {reference!r}")
    if not isinstance(found, Problem):
        raise InputError(
            f"{path}: problem {reference!r} must be an sf.Problem or a function that returns one; "
            f"got {type(found).__name__}."
        )
    return found


def _build_from_tables(path: Path, contents: Contents, *, searched: bool) -> tuple[Problem, Runs]:
    system = build_system(path, contents.model or ModelTable(name=""))
    runs = build_experiments(path, contents, system, searched=searched)
    parameters = {
        name: build_at(f"{path}: parameters.{name}", build_parameter, table)
        for name, table in contents.parameters.items()
    }
    options = contents.options.model_dump(include={"min_duration", "solver", "rtol", "atol"}, exclude_none=True)
    if searched:  # with room for transitions, a problem may have nothing else to estimate
        options["max_transitions"] = max(1, *(len(e.transition_times) + len(e.jump_times) for e in runs.experiments))
    return build_at(f"{path}", Problem, system, runs.experiments, parameters, **options), runs
