"""Saved estimates with the problems that they came from: rebuild these, and say what has changed since."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from switchfit.estimation.estimates import Estimate
from switchfit.io.problem_file.building import ProblemFile
from switchfit.io.problem_file.digests import digest_file
from switchfit.io.problem_file.loading import load_problem
from switchfit.io.provenance import Provenance
from switchfit.problem.problem import Problem
from switchfit.problem.validation.messages import join_names
from switchfit.runtime.errors import InputError


def _rebuild_problem(
    path: Path, given: Provenance | None, folder: Path | None = None, log: Path | None = None
) -> ProblemFile:
    """Return the problem of a saved estimate, built from the text that was saved with it.

    Parameters
    ----------
    path : Path
        Of the saved estimate.
    given : Provenance or None
        Of the saved estimate.
    folder : Path, optional
        Where the files are; left out, where the problem file was, seen from the folder of the saved estimate.
    log : Path, optional
        A log in place of that which was fitted.

    Raises
    ------
    InputError
        If the problem cannot be built again, or a file is missing or wrong.
    """
    if given is None:
        raise InputError(f"{path} does not say what it was made from: fit its problem file again.")
    # Functions cannot be saved: without a problem file there is no way back to the model.
    if not given.problem_file:
        raise InputError(
            f"{path} does not have its problem, which was built in Python: functions are not saved, only hashes of the "
            "data. Validate and compare in the script that fitted it: estimate.validate(...), sf.compare([...]). "
            "switchfit fit PROBLEM.toml --out DIR saves what is needed."
        )
    where = Path(given.folder) if folder is None else folder
    # A log that was given by hand (--problem) is remembered beside the text of the file.
    own = where / given.log if given.log else None
    try:
        return load_problem(where / given.problem_file, own if log is None else log, text=given.text)
    except InputError as error:
        # With another log, only the model must be as it was. If nothing has changed, the error itself says what is
        # wrong.
        needed = [digest for digest in given.files if log is None or digest.name.endswith(".py")]
        changed = [each.name for each in needed if digest_file(where, where / each.name).sha256 != each.sha256]
        if not changed:
            raise
        raise InputError(
            f"{path} cannot be built again, since {join_names(changed)} in {where} is missing or has changed: {error} "
            "Put the files as they were into a folder, and name it with --folder; or fit again."
        ) from error


def load_other_run(path: Path, given: Provenance | None, other: Path, folder: Path | None) -> ProblemFile:
    """Return the problem of another run: that of a problem file, or that of the saved estimate with another log.

    Parameters
    ----------
    path : Path
        Of the saved estimate.
    given : Provenance or None
        Of the saved estimate.
    other : Path
        A problem file, whose name ends in .toml, or a log.
    folder : Path or None
        Where the files are; left out, where the problem file was, seen from the folder of the saved estimate.
    """
    if other.suffix.lower() == ".toml":
        return load_problem(other)
    return _rebuild_problem(path, given, folder, other)


def load_with_problem(path: Path, folder: Path | None = None) -> tuple[Estimate, list[str]]:
    """Return a saved estimate with its problem, and the files of the model that have changed, a line for each.

    Parameters
    ----------
    path : Path
        Of the saved estimate.
    folder : Path, optional
        Where the files are; left out, where the problem file was, seen from the folder of the saved estimate.

    Raises
    ------
    InputError
        If the problem cannot be built again, or its data are no longer those that were fitted.
    """
    given = Estimate.load(path).provenance
    loaded = _rebuild_problem(path, given, folder)
    estimate = Estimate.load(path, problem=loaded.problem)
    # By values, not by hashes: a log that was rewritten with the same numbers is the same data.
    if not _has_data(estimate, loaded.problem):
        raise InputError(
            f"{path} was fitted to other values than the files in {loaded.path.parent} have now: fit them again."
        )
    return estimate, list_changed_models(given, loaded)


def _has_data(estimate: Estimate, problem: Problem) -> bool:
    """Return whether the measurements of a problem are those that an estimate was fitted to."""
    fitted = [each for run in estimate.comparisons for each in run if each.kind == "measurements"]
    return len(problem.measurements) == len(fitted) and all(
        np.array_equal(item.times, each.times) and np.array_equal(item.values, each.measured, equal_nan=True)
        for item, each in zip(problem.measurements, fitted, strict=True)
    )


def list_changed_models(given: Provenance | None, loaded: ProblemFile) -> list[str]:
    """Return the Python files that are not as they were when a fit was saved, a line for each.

    Parameters
    ----------
    given : Provenance or None
        Of the saved fit.
    loaded : ProblemFile
        The problem that was built again.
    """
    if given is None:
        return []
    # By their hashes, of Python files alone: the data are compared by value.
    before, now = (
        {digest.name: digest.sha256 for digest in each.files if digest.name.endswith(".py")}
        for each in (given, loaded.provenance)
    )

    def describe(name: str) -> str:
        return "is new" if name not in before else "has changed" if name in now else "is no longer there"

    return [f"{name} {describe(name)}" for name in {**before, **now} if before.get(name) != now.get(name)]
