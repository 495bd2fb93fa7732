"""The files that a problem was built from, and their hashes."""

from __future__ import annotations

import ast
import hashlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from switchfit.estimation.provenance import (
    FileDigest,
    Provenance,
    describe_platform,
    find_versions,
    make_relative,
)
from switchfit.io.logs.files import find_logs
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import is_regular

PYTHON_FILE = re.compile(r"(?P<file>[^:]+\.py):\w+")
"""How a problem file names an object in a Python file."""


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
    files = [file for name in dict.fromkeys(_list_names(contents)) for file in _list_files(folder, name)]
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


def _list_names(contents: Any) -> Iterator[str]:
    """Yield the names of files: logs under the key ``file``, Python files with their objects."""
    if isinstance(contents, Mapping):
        for key, value in contents.items():
            if key == "file" and isinstance(value, str):
                yield value
            else:
                yield from _list_names(value)
    elif isinstance(contents, (list, tuple)):
        for value in contents:
            yield from _list_names(value)
    elif isinstance(contents, str) and (match := PYTHON_FILE.fullmatch(contents)):
        yield match["file"]


def _list_files(folder: Path, name: str) -> list[Path]:
    """Return the files that a name stands for: those of a pattern or a bag, a Python file and those that it imports."""
    if name.endswith(".py"):
        return list(_follow_imports(folder / name))
    try:
        paths = [folder / found for found in find_logs(folder, name) or [name]]
    except InputError:  # an argument of the model that is called "file", and is no log
        return []
    return [
        file for path in paths for file in (sorted(path.rglob("*")) if path.is_dir() else [path]) if is_regular(file)
    ]


def _follow_imports(path: Path) -> dict[Path, None]:
    """Return a Python file and the files of its folder that it imports, and so on."""
    found, left = {path: None}, [path]
    while left:
        file = left.pop()
        try:
            tree = ast.parse(file.read_bytes())
        except (OSError, SyntaxError, ValueError):
            continue
        for node in ast.walk(tree):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            for name in names:
                base = path.parent.joinpath(*name.split("."))
                for candidate in (base.with_name(f"{base.name}.py"), base / "__init__.py"):
                    if candidate not in found and is_regular(candidate):
                        found[candidate] = None
                        left.append(candidate)
    return found


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
