"""What a fit was made from: the problem file, hashes of data and models, versions. Enough to run it again."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from switchfit.fit.result import Fit

PACKAGES = ("switchfit", "jax", "jaxlib", "llvmlite", "numpy", "scipy")
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


def digest_bytes(name: str, raw: bytes) -> FileDigest:
    """Return the digest of a file or an array.

    Parameters
    ----------
    name : str
    raw : bytes
    """
    return FileDigest(name, len(raw), hashlib.sha256(raw).hexdigest())


def digest_data(fit: Fit) -> tuple[FileDigest, ...]:
    """Return the digest of times and values of each Measurements, as float64 of little-endian machines.

    Parameters
    ----------
    fit : Fit
    """
    return tuple(_digest_each(fit))


def _digest_each(fit: Fit) -> Iterator[FileDigest]:
    single = len(fit.comparisons) == 1
    for run, comparisons in zip(fit.run_names, fit.comparisons, strict=True):
        for comparison in comparisons:
            if comparison.kind == "measurements":
                columns = np.column_stack([comparison.times, comparison.measured]).astype("<f8")
                label = ", ".join(comparison.names) if single else f"{run}: {', '.join(comparison.names)}"
                yield digest_bytes(label, np.ascontiguousarray(columns).tobytes())


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
