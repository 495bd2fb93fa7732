"""Run a saved fit again: load its problem and data, list what has changed since, and compare the answers.

Saved estimates as the command line takes them: what they were made from, and the problem built again from that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.estimation.saved import FileDigest, Provenance, describe_platform, digest_data, find_versions, load_saved
from switchfit.fit.result import Fit
from switchfit.io.problem_file import OPTIONS, OptionsTable, check_table, load_problem
from switchfit.io.problem_file.building import ProblemFile, digest_file
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.problem import Problem
from switchfit.problem.validation import join_names
from switchfit.report.formats import format_rounded, format_table
from switchfit.runtime.errors import InputError
from switchfit.runtime.presentation import format_count
from switchfit.uncertainty.residuals import correct_errors


def check_provenance(path: Path, given: Provenance | None, python: str) -> Provenance:
    """Return the provenance of a saved estimate, whose problem can be built again.

    Parameters
    ----------
    path : Path
    given : Provenance or None
    python : str
        What to do with a problem that was built in Python, for the message.

    Raises
    ------
    InputError
        If the problem cannot be built again.
    """
    if given is None:
        raise InputError(f"{path} does not say what it was made from: fit its problem file again.")
    if not given.problem_file:
        raise InputError(
            f"{path} does not have its problem, which was built in Python: functions are not saved, only hashes of the "
            f"data. {python} switchfit fit PROBLEM.toml --out DIR saves what is needed."
        )
    return given


def rebuild_problem(
    path: Path, given: Provenance, folder: Path | None = None, log: Path | None = None
) -> tuple[ProblemFile, Path]:
    """Return the problem of a saved estimate, built from the text that was saved with it, and its folder.

    Parameters
    ----------
    path : Path
        Of the saved estimate.
    given : Provenance
        As from `check_provenance`.
    folder : Path, optional
        Where the files are; left out, where the problem file was, seen from the folder of the saved estimate.
    log : Path, optional
        A log in place of that which was fitted.

    Raises
    ------
    InputError
        If a file is missing or wrong.
    """
    where = Path(given.folder) if folder is None else folder
    own = where / given.log if given.log else None
    try:
        return load_problem(where / given.problem_file, own if log is None else log, text=given.text), where
    except InputError as error:
        needed = [digest.name for digest in given.files if log is None or digest.name.endswith(".py")]
        missing = [name for name in needed if not (where / name).exists()]
        if missing:
            raise InputError(
                f"{path} was made from {missing[0]}, which is not in {where}: put it there, or name the folder that it "
                "is in with --folder."
            ) from error
        now = {digest.name: digest_file(where, where / digest.name).sha256 for digest in given.files}
        changed = [d.name for d in given.files if d.name in needed and now[d.name] not in ("", d.sha256)]
        if not changed:
            raise
        raise InputError(
            f"{path} cannot be built again, since {join_names(changed)} in {where} has changed: {error} Fit again; or "
            "put the files as they were into a folder, and name it with --folder."
        ) from error


PYTHON_VALIDATE = "Validate in the script that fitted it: estimate.validate(...)."
PYTHON_COMPARE = "Compare in the script that fitted it: sf.compare([...])."


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
        As in `rebuild_problem`.
    """
    if other.suffix.lower() == ".toml":
        return load_problem(other)
    return rebuild_problem(path, check_provenance(path, given, PYTHON_VALIDATE), folder, other)[0]


def load_with_problem(path: Path, folder: Path | None = None) -> tuple[Estimate, ProblemFile]:
    """Return a saved estimate with its problem, and the problem file.

    Parameters
    ----------
    path : Path
        Of the saved estimate.
    folder : Path, optional
        As in `rebuild_problem`.

    Raises
    ------
    InputError
        If the problem cannot be built again, or its data are no longer those that were fitted.
    """
    given = check_provenance(path, load_saved(path).provenance, PYTHON_COMPARE)
    loaded, where = rebuild_problem(path, given, folder)
    estimate = Estimate.load(path, problem=loaded.problem)
    if not _has_data(estimate, loaded.problem):
        raise InputError(f"{path} was fitted to other values than the files in {where} have now: fit them again.")
    return estimate, loaded


def _has_data(estimate: Estimate, problem: Problem) -> bool:
    """Return whether the measurements of a problem are those that an estimate was fitted to."""
    items = [item for run in problem.experiments for item in run.data if isinstance(item, Measurements)]
    fitted = [each for run in estimate.comparisons for each in run if each.kind == "measurements"]
    return len(items) == len(fitted) and all(
        np.array_equal(item.times, each.times) and np.array_equal(item.values, each.measured, equal_nan=True)
        for item, each in zip(items, fitted, strict=True)
    )


SAME = 0.01
"""Difference of an unknown, in its standard errors, up to which an answer is the same."""

SAME_WITHOUT_ERROR = 1e-6
"""Difference of an unknown that has no standard error, as a part of it, and of J, up to which they are the same."""

INITIAL_PART = 1e-3
"""Part of J at the first guess that counts as the size of J, where J is smaller: data without noise have J = 0."""

MOST_LISTED = 12
"""Unknowns, and changed files, that are listed."""

PYTHON = "Run the script again, and compare with sf.Estimate.load(...).theta."


class Prepared(NamedTuple):
    """A saved fit, and the problem that it was made from.

    Attributes
    ----------
    fit : Fit
        As it was saved.
    provenance : Provenance
    loaded : ProblemFile
        The problem, with the options of the saved fit.
    changes : tuple of str
        Changes of files and versions since it was saved.
    """

    fit: Fit
    provenance: Provenance
    loaded: ProblemFile
    changes: tuple[str, ...]


class Answers(NamedTuple):
    """Whether a fit that was run again has the same answer as the saved one, and the same in words."""

    same: bool
    text: str


def prepare_rerun(path: Path, folder: Path | None = None) -> Prepared:
    """Build the problem of a saved fit from the text that was saved with it, and the files that this names.

    Parameters
    ----------
    path : Path
        Of the saved estimate.
    folder : Path, optional
        Where the files are; left out, where the problem file was, from the folder of the saved estimate.

    Raises
    ------
    InputError
        If the estimate cannot be run again, or a file is missing or wrong.
    """
    saved = load_saved(path)
    given = check_provenance(path, saved.provenance, PYTHON)
    options = check_table(OptionsTable, dict(given.options), f"{path} is damaged: provenance.options")
    loaded, where = rebuild_problem(path, given, folder)
    loaded = replace(loaded, options=options.model_dump(include=OPTIONS, exclude_none=True))
    return Prepared(saved.fit, given, loaded, tuple(_list_changes(given, loaded, where / given.problem_file)))


def _list_changes(given: Provenance, loaded: ProblemFile, problem_file: Path) -> Iterator[str]:
    """Yield the changes since the fit was saved: files, then versions."""
    try:
        current = problem_file.read_bytes().decode()
    except (OSError, ValueError):
        current = given.text
    if current != given.text:
        yield f"{given.problem_file} has changed; what it was is fitted, and not what it is"
    yield from list_changed_files(given, loaded)
    versions = find_versions()
    for name, version in given.versions.items():
        if versions.get(name, version) != version:
            yield f"{name} was {version}, and is {versions[name]}"
    if given.platform != describe_platform():
        yield f"it was run on {given.platform}, and now on {describe_platform()}"


def list_changed_files(given: Provenance, loaded: ProblemFile, *, models_only: bool = False) -> list[str]:
    """Return the data files and Python files that are not as they were when a fit was saved, a line for each.

    Parameters
    ----------
    given : Provenance
        Of the saved fit.
    loaded : ProblemFile
        The problem that was built again.
    models_only : bool
        Only Python files.
    """
    before = {digest.name: digest for digest in given.files}
    now = {digest.name: digest for digest in loaded.provenance.files}
    names = [name for name in {**before, **now} if name.endswith(".py") or not models_only]
    changes = [change for name in names if (change := _describe_change(name, before.get(name), now.get(name)))]
    more = len(changes) - MOST_LISTED
    return [*changes[:MOST_LISTED], *([f"and {format_count(more, 'more file')}"] if more > 0 else [])]


def _describe_change(name: str, before: FileDigest | None, now: FileDigest | None) -> str:
    if before is None:
        return f"{name} is new"
    if now is None:
        return f"{name} is no longer there"
    if before.sha256 == now.sha256:
        return ""
    return f"{name} has changed: {before.size:,} bytes with SHA-256 {before.sha256[:12]}..., now {now.size:,} bytes"


def compare_fits(prepared: Prepared, again: Fit) -> Answers:
    """Return whether a fit that was run again has the same answer, in words.

    Parameters
    ----------
    prepared : Prepared
    again : Fit
    """
    saved = prepared.fit
    if saved.theta_names != again.theta_names:
        only = [name for name in saved.theta_names if name not in again.theta_names]
        new = [name for name in again.theta_names if name not in saved.theta_names]
        parts = [f"without {', '.join(only[:MOST_LISTED])}"] if only else []
        parts += [f"with {', '.join(new[:MOST_LISTED])}"] if new else []
        return Answers(False, f"Another problem: its unknowns are now {' and '.join(parts) or 'in another order'}.")
    errors, difference = correct_errors(saved), again.theta - saved.theta
    known = np.isfinite(errors) & (errors > 0)
    allowed = np.where(known, SAME * errors, SAME_WITHOUT_ERROR * np.abs(saved.theta))
    with np.errstate(divide="ignore", invalid="ignore"):
        unlike = np.nan_to_num(np.abs(difference) / allowed, nan=np.inf)
    unlike[saved.theta == again.theta] = 0.0
    size = np.nanmax([abs(saved.cost), INITIAL_PART * abs(saved.initial_cost), np.finfo(float).tiny])
    costs_agree = np.array_equal(saved.cost, again.cost, equal_nan=True)
    costs_agree |= bool(abs(again.cost - saved.cost) <= SAME_WITHOUT_ERROR * size)
    same = bool((unlike <= 1.0).all()) and costs_agree and saved.status.successful == again.status.successful
    counts = np.where(known, difference, np.nan) / np.where(known, errors, 1.0)
    lines = [_say_outcome(saved, again, counts, unlike, same)]
    if {digest.sha256 for digest in prepared.provenance.data} != {d.sha256 for d in digest_data(again)}:
        lines.append("The values that were fitted are not those of the saved fit.")
    if not np.array_equal(saved.theta, again.theta, equal_nan=True):
        lines += ["", *_tabulate(saved, again, errors, counts, unlike)]
    return Answers(same, "\n".join(lines))


def _say_outcome(saved: Fit, again: Fit, counts: FloatArray, unlike: FloatArray, same: bool) -> str:
    """Return the sentence that says whether the answers are the same."""
    costs = f"J was {saved.cost:.9g}, and is {again.cost:.9g}"
    if same and np.array_equal(saved.theta, again.theta) and saved.cost == again.cost:
        return f"The same answer, to the last bit: J is {saved.cost:.9g}."
    if saved.status.successful != again.status.successful:
        ends = ["converged" if fit.status.successful else "did not converge" for fit in (saved, again)]
        return f"Another answer: the saved fit {ends[0]}, this one {ends[1]}; {costs}."
    if not same and (unlike <= 1.0).all():
        return f"Another cost at the same answer: {costs}."
    if not len(unlike):
        return f"The same answer: {costs}."
    i = int(np.argmax(unlike))
    how = f"{saved.theta_names[i]} was {saved.theta[i]:.9g}, and is {again.theta[i]:.9g}"
    if np.isfinite(counts[i]):
        how = f"{saved.theta_names[i]} differs by {_format_count(abs(counts[i]))} standard errors"
    return f"The same answer: {how}, and no unknown by more; {costs}." if same else f"Another answer: {how}; {costs}."


def _format_count(number: float) -> str:
    """Return a number of standard errors to two digits, and large ones in full."""
    return f"{number:.2g}" if number < 99.5 else f"{number:,.0f}"


def _tabulate(saved: Fit, again: Fit, errors: FloatArray, counts: FloatArray, unlike: FloatArray) -> list[str]:
    """Return the unknowns that differ most, as lines."""
    order = np.argsort(-unlike, kind="stable")[:MOST_LISTED]
    rows = [("", "saved", "", "now", "", "difference")]
    for i in sorted(order.tolist()):
        value, error, _ = format_rounded(saved.theta[i], errors[i])
        now = format_rounded(again.theta[i], errors[i])[0]
        apart = f"{again.theta[i] - saved.theta[i]:+.2g}"
        if np.isfinite(counts[i]):
            apart = f"{'-' if counts[i] < 0 else '+'}{_format_count(abs(counts[i]))} std. errors"
        rows.append((saved.theta_names[i], value, error, now, unit_suffix(saved.theta_units[i]).strip(), apart))
    more = len(saved.theta) - len(order)
    rest = [f"  and {format_count(more, 'more unknown')} with smaller differences"] if more else []
    return [*format_table(rows, "<><><>"), *rest]
