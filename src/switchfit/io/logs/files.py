"""Which logs a pattern or a folder stands for, and what to call them."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from pathlib import Path

from switchfit.runtime.errors import InputError

BAGS = (".bag", ".mcap", ".db3")
"""Endings of ROS bags."""

ENDINGS = (".csv", ".dat", ".gpx", ".log", ".mat", ".nma", ".nmea", ".parquet", ".pq", ".tsv", ".txt", *BAGS)
"""Endings of the files in a folder that are taken for logs, ``.gz`` after them left out."""


def find_logs(folder: Path, given: str) -> list[str] | None:
    """Return the logs that a pattern or a folder stands for, sorted; None for the name of one log.

    Parameters
    ----------
    folder : Path
        Where names begin.
    given : str
        Such as ``"drive.csv"``, ``"logs/*.csv"`` or ``"logs"``. The folder of a bag of ROS 2 is one log.

    Raises
    ------
    InputError
        If nothing matches the pattern, or there is no log in the folder.
    """
    path = folder / given
    # An empty name would be the folder of the problem file itself; the folder of a ROS 2 bag is one log.
    if os.path.isdir(path) and given.strip() and not _is_log(path):
        inside = sorted(name for name in os.listdir(path) if not name.startswith(".") and _is_log(path / name))
        if not inside:
            raise InputError(f"{path} has no logs: no file in it ends in {', '.join(ENDINGS)}.")
        return [os.path.join(given, name) for name in inside]
    # A file whose name has brackets or a question mark is itself, not a pattern.
    if os.path.exists(path) or not glob.has_magic(given):
        return None
    found = sorted(glob.glob(given, root_dir=folder, recursive=True))
    if not found:
        raise InputError(f"No file matches {path}; check the pattern and the folder.")
    return found


def _is_log(path: Path) -> bool:
    """Return whether a path is a log by its name, or the folder of a bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    name = path.name.lower().removesuffix(".gz")
    return name.endswith(ENDINGS)


def name_files(paths: Sequence[str | Path]) -> list[str]:
    """Return a short name for each file: what tells its path apart, without the ending where that is enough.

    Parameters
    ----------
    paths : sequence of str or Path
    """
    whole = [Path(os.path.abspath(path)).parts for path in paths]
    # Three steps: endings are left out unless two files differ in nothing else, the names alone are enough if all
    # differ, and otherwise folders are put before them, from where the paths part.
    stems = [(*folders, name.removesuffix(".gz").rpartition(".")[0] or name) for *folders, name in whole]
    parts = next((given for given in (stems, whole) if len(set(given)) == len(given)), None)
    if parts is None:  # the same file twice
        return list(map(str, paths))
    if len({own[-1] for own in parts}) == len(parts):
        return [own[-1] for own in parts]
    # run1/log.csv and run2/log.csv: what all of them end with tells nothing.
    while len({own[-1] for own in parts}) == 1:
        parts = [own[:-1] for own in parts]
    levels = enumerate(zip(*parts, strict=False))
    shared = next((k for k, level in levels if len(set(level)) > 1), min(map(len, parts)))
    return ["/".join(own[min(shared, len(own) - 1) :]) for own in parts]
