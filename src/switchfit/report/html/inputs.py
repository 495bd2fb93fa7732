"""What is needed to run a fit again: the problem file, the files that it names, the data, versions, the platform."""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from switchfit.estimation.provenance import describe_platform, find_version, find_versions
from switchfit.fit.result import Fit

DRAWN_BY = ("bokeh", "jinja2")
"""Libraries whose versions a page names beside those that a fit depends on."""
PYTHON_FILE = re.compile(r"(?P<file>[^:]+\.py):\w+")
"""How a problem file names an object in a Python file."""
MOST_DATA = 100
"""Data whose hashes are listed; the others are counted."""


@dataclass(frozen=True)
class Digest:
    """A file or an array.

    Attributes
    ----------
    name : str
    size : str
        Such as "1,234 bytes"; or why there is no hash.
    sha256 : str
    """

    name: str
    size: str
    sha256: str


@dataclass(frozen=True)
class Inputs:
    """What is needed to run a fit again.

    Attributes
    ----------
    name, text : str
        Of the problem file; both empty where there is none.
    options : mapping of str to object
        Arguments of `estimate` that were given, in the file or on the command line.
    files : tuple of Digest
        The problem file and the files that it names; the arrays of the data where there is no problem file.
    more : int
        How many more there are than are listed.
    versions : tuple of (str, str)
    platform : str
    """

    name: str
    text: str
    options: Mapping[str, object]
    files: tuple[Digest, ...]
    more: int
    versions: tuple[tuple[str, str], ...]
    platform: str


def collect_inputs(fit: Fit, problem_file: Path | None = None, options: Mapping[str, object] | None = None) -> Inputs:
    """Return what is needed to run a fit again.

    Parameters
    ----------
    fit : Fit
    problem_file : Path, optional
        The TOML file with the problem; left out, the data are hashed as arrays.
    options : mapping of str to object, optional

    Raises
    ------
    OSError
        If the problem file cannot be read.
    ValueError
        If it is no TOML file.
    """
    name = text = ""
    if problem_file is not None:
        raw = problem_file.read_bytes()
        name, text = problem_file.name, raw.decode()
        named = _list_files(tomllib.loads(text))
        digests = [_digest(name, raw), *(_digest_file(problem_file.parent, file) for file in dict.fromkeys(named))]
    else:
        digests = list(_digest_data(fit))
    listed = tuple(digests[:MOST_DATA])
    versions = (*find_versions().items(), *((package, find_version(package)) for package in DRAWN_BY))
    more = len(digests) - len(listed)
    return Inputs(name, text, dict(options or {}), listed, more, versions, describe_platform())


def _list_files(contents: Any) -> Iterator[str]:
    """Yield the files that a problem file names: data under the key ``file``, Python files with their objects."""
    if isinstance(contents, dict):
        for key, value in contents.items():
            if key == "file" and isinstance(value, str):
                yield value
            else:
                yield from _list_files(value)
    elif isinstance(contents, list):
        for value in contents:
            yield from _list_files(value)
    elif isinstance(contents, str) and (match := PYTHON_FILE.fullmatch(contents)):
        yield match["file"]


def _digest(name: str, raw: bytes) -> Digest:
    return Digest(name, f"{len(raw):,} bytes", hashlib.sha256(raw).hexdigest())


def _digest_file(folder: Path, name: str) -> Digest:
    try:
        return _digest(name, (folder / name).read_bytes())
    except OSError as error:
        return Digest(name, f"not read: {error.strerror}", "")


def _digest_data(fit: Fit) -> Iterator[Digest]:
    """Yield the hash of the times and values of each Measurements, as float64 of little-endian machines."""
    single = len(fit.comparisons) == 1
    for run, comparisons in zip(fit.run_names, fit.comparisons, strict=True):
        for comparison in comparisons:
            if comparison.kind == "measurements":
                columns = np.column_stack([comparison.times, comparison.measured]).astype("<f8")
                digest = hashlib.sha256(np.ascontiguousarray(columns).tobytes()).hexdigest()
                label = ", ".join(comparison.names) if single else f"{run}: {', '.join(comparison.names)}"
                rows, width = columns.shape
                yield Digest(label, f"array of {rows} × {width}: times, then values", digest)
