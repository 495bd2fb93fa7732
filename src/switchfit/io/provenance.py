"""What a fit was made from: the problem file, hashes of the files that it names, versions. Enough to run it again."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

RECORDED_PACKAGES = ("switchfit", "daqp", "jax", "jaxlib", "llvmlite", "numpy", "scipy")
"""Whose versions are kept."""


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


def _find_versions() -> dict[str, str]:
    """Return the versions of Python and of `RECORDED_PACKAGES`."""
    return {"Python": platform.python_version(), **{package: find_version(package) for package in RECORDED_PACKAGES}}


@dataclass(frozen=True)
class FileDigest:
    """A file that a fit was made from.

    Attributes
    ----------
    name : str
        Its path from the folder of the problem file, with forward slashes.
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
    """What a fit was made from; by default a problem that was built in Python, here.

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
    versions : mapping of str to str
        Of Python, switchfit and the libraries.
    platform : str
        Operating system and processor.
    """

    problem_file: str = ""
    folder: str = ""
    text: str = ""
    log: str = ""
    options: Mapping[str, int | float | str] = field(default_factory=dict)
    files: tuple[FileDigest, ...] = ()
    versions: Mapping[str, str] = field(default_factory=_find_versions)
    platform: str = field(default_factory=lambda: f"{platform.platform()}, {platform.machine()}")


def make_relative(path: str | Path, folder: str | Path) -> str:
    """Return a path from a folder, with forward slashes; the whole path where none leads there, as to another drive.

    Parameters
    ----------
    path, folder : str or Path
    """
    whole = os.path.abspath(path)
    try:
        # Forward slashes on all systems: a folder that is moved to another machine is found there, too.
        return Path(os.path.relpath(whole, os.path.abspath(folder))).as_posix()
    except ValueError:
        return Path(whole).as_posix()
