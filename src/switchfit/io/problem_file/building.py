"""Build the problem of a problem file whose logs are open.

The files that a problem was built from, and their hashes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from modulefinder import ModuleFinder
from pathlib import Path
from typing import Any

from switchfit.estimation.estimator import FileDigest, Provenance, describe_platform, find_versions, make_relative
from switchfit.io.logs import find_logs
from switchfit.io.problem_file.experiments import (
    Runs,
    build_experiments,
    build_parameter,
    build_system,
    make,
)
from switchfit.io.problem_file.logs import Opened
from switchfit.io.problem_file.tables import OPTIONS, Contents, ModelTable
from switchfit.io.user_files import build_at, load_object, replace_files
from switchfit.problem.parameter import Parameter
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import InputError, Issue
from switchfit.strategy.library import build_library


def describe_sources(
    path: Path, text: str, log: str | Path | None, contents: Mapping[str, Any], options: Mapping[str, Any]
) -> Provenance:
    """Return what a problem was built from: its file, and the hashes of the files that this names.

    Parameters
    ----------
    path : Path
        The problem file.
    text : str
        What it contains.
    log : str or Path or None
        The log that was fitted in place of the file that it names.
    contents : mapping
        Its tables, with that log in them.
    options : mapping
        Arguments of `estimate`.
    """
    folder = path.absolute().parent
    names: list[str] = []

    def note(name: str) -> str:
        names.append(name)
        return name

    replace_files(contents, note)
    files = [file for name in names for file in _list_files(folder, name)]
    return Provenance(
        problem_file=path.name,
        folder=str(folder),
        text=text,
        log="" if log is None else make_relative(log, folder),
        options=dict(options),
        files=tuple(digest_file(folder, file) for file in dict.fromkeys(files)),
        data=(),
        versions=find_versions(),
        platform=describe_platform(),
    )


def _list_files(folder: Path, name: str) -> list[Path]:
    """Return the files that a name stands for: those of a pattern or a bag, a Python file and those that it imports."""
    if name.endswith(".py"):
        finder = ModuleFinder([str((folder / name).parent)])
        finder.run_script(str(folder / name))
        files = [getattr(module, "__file__", None) for module in finder.modules.values()]
        return [Path(file) for file in files if file is not None]
    paths = [folder / found for found in find_logs(folder, name) or [name]]
    return [file for path in paths for file in (sorted(path.rglob("*")) if path.is_dir() else [path])]


def digest_file(folder: Path, path: Path) -> FileDigest:
    """Return the digest of a file, named by its path from a folder; one that cannot be read has none.

    Parameters
    ----------
    folder, path : Path
    """
    name = make_relative(path, folder)
    try:
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            return FileDigest(name, file.tell(), sha256)
    except OSError:
        return FileDigest(name, 0, "")


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


def build_problem(
    path: Path,
    text: str,
    contents: Contents,
    opened: Sequence[Opened],
    log: str | Path | None,
    *,
    searched: bool,
) -> ProblemFile:
    """Return the problem of a file; arguments as of `load_problem`, which has opened the logs.

    Parameters
    ----------
    path : Path
    text : str
    contents : Contents
    opened : sequence of Opened
    log : str, Path or None
    searched : bool
    """
    options = contents.options.model_dump(include=OPTIONS, exclude_none=True)
    if contents.problem is None:
        problem, runs = _build_from_tables(path, contents, opened, searched=searched)
        built = contents.model_copy(update={"experiments": list(runs.tables)})
    else:
        problem, runs, built = _load_from_python(path, contents), Runs((), ()), contents
    library = {} if contents.library is None else contents.library.model_dump(exclude_none=True)
    given = {"library": library.pop("modes")} | library if "modes" in library else library
    build_at(f"{path}: library", partial(build_library, **given, max_switches=1), problem)
    provenance = describe_sources(path, text, log, contents.model_dump(exclude_none=True), options)
    return ProblemFile(path, problem, options, provenance, runs.issues, given, built)


def build_without_python(path: Path, contents: Contents, opened: Sequence[Opened]) -> Runs:
    """Return the experiments of a file; the Python file that it names is not run.

    Parameters
    ----------
    path : Path
    contents : Contents
    opened : sequence of Opened
    """
    if contents.model is None:
        return Runs((), ())
    _build_parameters(path, contents)
    return build_experiments(path, contents, opened, build_system(path, contents.model, run=False))


def _load_from_python(path: Path, contents: Contents) -> Problem:
    given = contents.options.model_dump(exclude=OPTIONS, exclude_none=True)
    if given:
        raise InputError(f"{path}: with 'problem', {', '.join(given)} is set where the sf.Problem is built, not here.")
    reference = contents.problem or ""
    what = f"{path}: problem"
    return make(load_object(reference, path.parent, what), ModelTable(name=reference), what, Problem)


def _build_from_tables(
    path: Path, contents: Contents, opened: Sequence[Opened], *, searched: bool
) -> tuple[Problem, Runs]:
    system = build_system(path, contents.model or ModelTable(name=""))
    runs = build_experiments(path, contents, opened, system, searched=searched)
    options = contents.options.model_dump(exclude=OPTIONS, exclude_none=True)
    if searched:  # with room for transitions, a problem may have nothing else to estimate
        options["max_transitions"] = max(1, *(len(e.transition_times) + len(e.jump_times) for e in runs.experiments))
    return build_at(f"{path}", Problem, system, runs.experiments, _build_parameters(path, contents), **options), runs


def _build_parameters(path: Path, contents: Contents) -> dict[str, Parameter]:
    tables = contents.parameters
    return {name: build_at(f"{path}: parameters.{name}", build_parameter, tables[name]) for name in tables}
