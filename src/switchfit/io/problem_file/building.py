"""Build the problem of a problem file whose logs are open, and note where it comes from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from switchfit.io.problem_file.digests import digest_file, list_files
from switchfit.io.problem_file.experiments import Runs, build_experiments, load_named_object
from switchfit.io.problem_file.logs import Opened
from switchfit.io.problem_file.parameters import build_parameters
from switchfit.io.problem_file.tables import OPTIONS, Contents
from switchfit.io.provenance import Provenance, make_relative
from switchfit.io.user_files import build_at
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import InputError
from switchfit.runtime.issue import Issue
from switchfit.strategy.library import build_library

if TYPE_CHECKING:
    from switchfit.problem.system import HybridSystem


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
    runs = build_experiments(path, contents, opened, searched=searched)
    problem = _build_problem(path, contents, runs, searched)
    library = {} if contents.library is None else contents.library.model_dump(exclude_none=True, by_alias=True)
    # Built and dropped: a library that is wrong is an error of the file, also where a fit does not need it. The number
    # of switches is the command's, and any will do for the check.
    build_at(f"{path}: library", build_library, problem, **library, max_switches=1)
    # [options] has two readers: what `Problem` takes is left out here, and taken below.
    options = contents.options.model_dump(include=OPTIONS, exclude_none=True)
    folder = path.absolute().parent
    provenance = Provenance(
        problem_file=path.name,
        folder=str(folder),
        text=text,
        log="" if log is None else make_relative(log, folder),
        options=options,
        files=tuple(digest_file(folder, file) for file in list_files(folder, contents)),
    )
    # A pattern was replaced by the logs that it stands for: the mode search writes its result as a file of these.
    used = contents.model_copy(update={"experiments": list(runs.tables)})
    return ProblemFile(path, problem, options, provenance, runs.issues, library, used)


def _build_problem(path: Path, contents: Contents, runs: Runs, searched: bool) -> Problem:
    options = contents.options.model_dump(exclude=OPTIONS, exclude_none=True)
    if contents.problem is None:
        if searched:  # with room for transitions, a problem may have nothing else to estimate
            counts = (len(run.transition_times) + len(run.jump_times) for run in runs.experiments)
            options["max_transitions"] = max(1, *counts)
        parameters = build_parameters(path, contents)
        system = cast("HybridSystem", runs.system)  # a file without 'problem' has a model, and its file has run
        return build_at(str(path), Problem, system, runs.experiments, parameters, **options)
    if options:
        raise InputError(
            f"{path}: with 'problem', {', '.join(options)} is set where the sf.Problem is built, not here."
        )
    return load_named_object(path, "problem", contents.problem, Problem)
