"""Save fits as JSON files that can be read without switchfit, and load them without losing a bit.

A file holds ``{"verdict": {...}, "format": "switchfit fit", "version": 9, "seal": "...", "fit": {...}, "certificate":
{...}}`` with the fields of `Verdict`, `Fit` and `Certificate` under their own names. The verdict, with its line of
text, and the "transition_dates" that a fit to dates has beside them are meant for readers of the file; `load` computes
them again from the rest. ``"provenance"`` holds the fields of `Provenance`: what the fit was made from. Files without
it are read too.

`runtime.json_records` says how numbers, arrays and dataclasses are written.

The seal is a digest of fit and certificate: a file in which a number was changed, or lost, is refused.

What a fit was made from: the problem file, hashes of data and models, versions. Enough to run it again.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from switchfit.fit.result import Fit
from switchfit.runtime.json_records import from_json, read_document, to_json, write_document
from switchfit.uncertainty.certificate import Certificate
from switchfit.uncertainty.verdict import Verdict, judge

PACKAGES = ("switchfit", "daqp", "jax", "jaxlib", "llvmlite", "numpy", "scipy")
"""Whose versions are kept."""


@dataclass(frozen=True)
class FileDigest:
    """A file that a fit was made from, or an array.

    Attributes
    ----------
    name : str
        Path of a file from the folder of the problem file, with forward slashes; channels of an array.
    size : int
        Bytes.
    sha256 : str
        Empty if it could not be read.
    """

    name: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Provenance:
    """What a fit was made from.

    Attributes
    ----------
    problem_file : str
        Name of the problem file; empty for a problem that was built in Python.
    folder : str
        Its folder. In a saved file it is the path from the folder of that file where there is one, so that both may be
        moved together.
    text : str
        The problem file, as it was read.
    log : str
        The log that was fitted in place of the file that the problem file names, from its folder; empty for none.
    options : mapping of str to int, float or str
        Arguments of `estimate`.
    files : tuple of FileDigest
        The data files and the Python files of the model.
    data : tuple of FileDigest
        Times and values of each of the measurements, as they were fitted.
    versions : mapping of str to str
        Of Python, switchfit and the libraries.
    platform : str
    """

    problem_file: str
    folder: str
    text: str
    log: str
    options: Mapping[str, int | float | str]
    files: tuple[FileDigest, ...]
    data: tuple[FileDigest, ...]
    versions: Mapping[str, str]
    platform: str

    def place_beside(self, path: Path) -> Provenance:
        """Return this with the folder as the path from that of a saved file.

        Parameters
        ----------
        path : Path
            Of the saved file.
        """
        return replace(self, folder=make_relative(self.folder, path.resolve().parent)) if self.folder else self

    def find_from(self, path: Path) -> Provenance:
        """Return this with the folder found from that of a saved file.

        Parameters
        ----------
        path : Path
            Of the saved file.

        Raises
        ------
        ValueError
            If no folder can have that name.
        """
        if "\0" in self.folder:
            raise ValueError("provenance.folder has a null character")
        return replace(self, folder=os.path.normpath(path.resolve().parent / self.folder)) if self.folder else self


def make_relative(path: str | Path, folder: str | Path) -> str:
    """Return a path from a folder, with forward slashes; the whole path where none leads there, as to another drive.

    Parameters
    ----------
    path, folder : str or Path
    """
    whole = os.path.abspath(path)
    try:
        return Path(os.path.relpath(whole, os.path.abspath(folder))).as_posix()
    except ValueError:
        return Path(whole).as_posix()


def describe_python_problem(fit: Fit) -> Provenance:
    """Return what is known of a fit whose problem was built in Python: data, versions, platform.

    Parameters
    ----------
    fit : Fit
    """
    return Provenance("", "", "", "", {}, (), digest_data(fit), find_versions(), describe_platform())


def digest_data(fit: Fit) -> tuple[FileDigest, ...]:
    """Return the digest of times and values of each Measurements, as float64 of little-endian machines.

    Parameters
    ----------
    fit : Fit
    """
    found, single = [], len(fit.comparisons) == 1
    for run, comparisons in zip(fit.run_names, fit.comparisons, strict=True):
        for comparison in comparisons:
            if comparison.kind == "measurements":
                columns = np.column_stack([comparison.times, comparison.measured]).astype("<f8")
                label = ", ".join(comparison.names) if single else f"{run}: {', '.join(comparison.names)}"
                raw = columns.tobytes()  # row by row
                found.append(FileDigest(label, len(raw), hashlib.sha256(raw).hexdigest()))
    return tuple(found)


def find_versions() -> dict[str, str]:
    """Return the versions of Python and of `PACKAGES`."""
    return {"Python": platform.python_version(), **{package: find_version(package) for package in PACKAGES}}


@cache
def find_version(package: str) -> str:
    """Return the version of a package.

    Parameters
    ----------
    package : str
    """
    try:
        return version(package)
    except PackageNotFoundError:  # a copy of the sources that is not installed
        return "not installed as a package"


def describe_platform() -> str:
    """Return operating system and processor."""
    return f"{platform.platform()}, {platform.machine()}"


FORMAT = "switchfit fit"
VERSION = 9


def save_fit(fit: Fit, certificate: Certificate, path: Path, provenance: Provenance | None = None) -> None:
    """Write a fit to a file, whole or not at all.

    Parameters
    ----------
    fit : Fit
        Only the fields of `Fit` are written, also for a subclass.
    certificate : Certificate
    path : Path
        An existing file is replaced.
    provenance : Provenance, optional
        What the fit was made from.

    Raises
    ------
    OSError
        If the file cannot be written; an existing one is then left as it was.
    """
    content = write_fit(fit, certificate)
    if provenance is not None:
        content["provenance"] = to_json(provenance.place_beside(Path(path)), Provenance)
    write_document(content, Path(path))


def write_fit(fit: Fit, certificate: Certificate) -> dict[str, Any]:
    """Return the content of the file of a fit, without its provenance.

    Parameters
    ----------
    fit : Fit
    certificate : Certificate
    """
    verdict = judge(fit, certificate)
    sealed = {"fit": to_json(fit, Fit), "certificate": to_json(certificate, Certificate)}
    return {
        "verdict": {"level": verdict.level, "text": str(verdict)} | to_json(verdict, Verdict),
        "format": FORMAT,
        "version": VERSION,
        "seal": _compute_seal(sealed),
        **_list_dates(fit),
        **sealed,
    }


def _compute_seal(content: Mapping[str, Any]) -> str:
    """Return a digest of the fit and the certificate in the content of a file, whatever its layout."""
    sealed = [content.get("fit"), content.get("certificate")]
    return hashlib.sha256(json.dumps(sealed, sort_keys=True).encode()).hexdigest()


class SavedFit(NamedTuple):
    """What a file holds; a fit that was saved without its provenance has None."""

    fit: Fit
    certificate: Certificate
    provenance: Provenance | None


def load_saved(path: Path) -> SavedFit:
    """Read what `save_fit` wrote; every field is equal, and arrays have the same bits, dtype and shape.

    Parameters
    ----------
    path : Path

    Returns
    -------
    SavedFit

    Raises
    ------
    OSError
        If there is no such file (FileNotFoundError) or it cannot be read.
    ValueError
        If it is not valid JSON, not written by switchfit, of another version, or not as it was written.
    """
    content = read_document(Path(path), "a saved estimate", FORMAT, VERSION)
    try:
        fit, certificate = parse_fit(content)
        given = content.get("provenance")
        provenance = None if given is None else from_json(Provenance, given, "provenance")
        return SavedFit(fit, certificate, None if provenance is None else provenance.find_from(Path(path)))
    except (ValueError, OverflowError, RecursionError, MemoryError) as error:
        raise ValueError(f"{path} is damaged: {error}.") from error


def _list_dates(fit: Fit) -> dict[str, Any]:
    """Return the transition times that are dates by their names, for readers of the file; {} where none is."""
    dates = {}
    for transition in fit.transitions:
        origin = fit.trajectories[transition.experiment].origin
        date = None if origin is None else origin.find_date(transition.time, transition.unit)
        if date is not None:
            dates[transition.name] = date.isoformat()
    return {"transition_dates": dates} if dates else {}


def parse_fit(content: Mapping[str, Any]) -> tuple[Fit, Certificate]:
    """Return a fit and its certificate from the content of a file of this version.

    Parameters
    ----------
    content : mapping

    Raises
    ------
    ValueError
        If the content is not what `write_fit` returned.
    """
    if content.get("seal") != _compute_seal(content):
        raise ValueError("its content is not what was written")
    return from_json(Fit, content["fit"], "fit"), from_json(Certificate, content["certificate"], "certificate")
