"""Build the problem of a problem file whose logs are open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from switchfit.estimation.provenance import Provenance
from switchfit.io.problem_file.experiments import Runs, build_experiments, build_parameter
from switchfit.io.problem_file.logs import Opened
from switchfit.io.problem_file.models import build_system, check_model_name
from switchfit.io.problem_file.tables import OPTIONS, Contents, ModelTable
from switchfit.io.python_file import build_at, call, load_object
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
    if contents.problem is not None:
        return Runs((), ())
    if contents.model is not None and contents.model.name not in BUILT_IN:
        check_model_name(f"{path}: model", contents.model)
    for name, table in contents.parameters.items():
        build_at(f"{path}: parameters.{name}", build_parameter, table)
    return build_experiments(path, contents, opened, None)


def _load_from_python(path: Path, contents: Contents) -> Problem:
    given = contents.options.model_dump(exclude=OPTIONS, exclude_none=True)
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


def _build_from_tables(
    path: Path, contents: Contents, opened: Sequence[Opened], *, searched: bool
) -> tuple[Problem, Runs]:
    system = build_system(path, contents.model or ModelTable(name=""))
    runs = build_experiments(path, contents, opened, system, searched=searched)
    parameters = {
        name: build_at(f"{path}: parameters.{name}", build_parameter, table)
        for name, table in contents.parameters.items()
    }
    options = contents.options.model_dump(exclude=OPTIONS, exclude_none=True)
    if searched:  # with room for transitions, a problem may have nothing else to estimate
        options["max_transitions"] = max(1, *(len(e.transition_times) + len(e.jump_times) for e in runs.experiments))
    return build_at(f"{path}", Problem, system, runs.experiments, parameters, **options), runs
