"""Python files of users: load objects from them, and locate the errors that are raised in them."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import inspect
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, ParamSpec, TypeAlias, TypeVar

from switchfit.runtime.errors import InputError, get_first_line

UserObject: TypeAlias = Any
"""An object of a user's Python file, or what one returns: whoever asks for it checks what it is."""

Given = ParamSpec("Given")
Built = TypeVar("Built")

_REFERENCE = re.compile(r"(.+\.py):(\w+)")
"""How a problem file names an object in a Python file."""

#: Files that were run: absolute path -> path as the user wrote it.
_files: dict[str | None, Path] = {}


def load_object(reference: str, folder: Path, what: str) -> UserObject:
    """Return the object that ``"file.py:object"`` names.

    Parameters
    ----------
    reference : str
        Path of a Python file, relative to `folder`, and the name of an object in it.
    folder : Path
        While the file runs, it can import other files of its own folder.
    what : str
        What the object is for, used in messages.

    Raises
    ------
    InputError
        If the file or the object is missing, or running the file raises.
    """
    # The absolute path is the key: two problem files name one model by different relative paths, and it runs once. What
    # messages and tracebacks show is the path as it was last written.
    path, name = find_object(reference, folder, what)
    key = str(path.resolve())
    _files[key] = path
    # The time of the last change is a part of the cache's key: in a notebook, a model that was edited runs again.
    module = _run(key, path.stat().st_mtime_ns)
    if not hasattr(module, name):
        public = [key for key in vars(module) if not key.startswith("_")]
        raise InputError(f"{what} {reference!r}: {path} defines no {name!r}; it has {', '.join(public) or 'nothing'}.")
    return getattr(module, name)


def find_object(reference: str, folder: Path, what: str) -> tuple[Path, str]:
    """Return the file and the name in ``"file.py:object"``; the file is not run.

    Parameters
    ----------
    reference, folder, what : as in `load_object`

    Raises
    ------
    InputError
        If it has another form, or the file is missing.
    """
    match = _REFERENCE.fullmatch(reference)
    if match is None:
        raise InputError(f"{what} must be given as 'file.py:object'; got {reference!r}.")
    path = folder / match[1]
    if not os.path.isfile(path):
        raise InputError(f"{what} {reference!r}: there is no file {path}.")
    return path, match[2]


def replace_files(table: Mapping[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """Return a table of a problem file with other names of files: of logs, and of Python files with their objects.

    Parameters
    ----------
    table : mapping
        Arguments of models in it are left as they are.
    change : callable
        Returns the new name for a name.
    """
    changed = {key: value if key == "arguments" else _replace_in(value, change) for key, value in table.items()}
    # The name of a log is any text: it is told by its key, and that also by `columns`, which all tables of logs have.
    if "columns" in table and "file" in table:
        changed["file"] = change(table["file"])
    return changed


def _replace_in(value: object, change: Callable[[str], str]) -> object:
    """Return the value of a key with other names of files: of Python files by their form, ``"file.py:object"``."""
    if isinstance(value, Mapping):
        return replace_files(value, change)
    if isinstance(value, (list, tuple)):
        return [_replace_in(entry, change) for entry in value]
    # Only text of the form of a reference is changed: units and names of channels look different.
    match = _REFERENCE.fullmatch(value) if isinstance(value, str) else None
    return value if match is None else f"{change(match[1])}:{match[2]}"


def call(function: Callable[..., UserObject], what: str, **arguments: object) -> UserObject:
    """Call a user's factory; raise InputError if it does not take the arguments, or with the place if it fails."""
    try:
        # Bound before the call, so that a TypeError that the function raises inside is not taken for wrong arguments.
        inspect.signature(function).bind(**arguments)
    except TypeError as error:
        takes = ", ".join(inspect.signature(function).parameters) or "no arguments"
        raise InputError(f"{what}: {error}; it takes {takes}.") from error
    with _explain_failure(what):
        return function(**arguments)


@contextlib.contextmanager
def _explain_failure(what: str) -> Iterator[None]:
    """Return a context for a user's code: arrays that it makes with jax.numpy have float64, errors have their place."""
    import jax  # imported here, since files that are not run do not need it

    try:
        with jax.enable_x64(True):
            yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # any exception of a user's file, including SystemExit
        raise InputError(f"{what} failed: {describe_error(error)}.") from error


def build_at(where: str, build: Callable[Given, Built], *arguments: Given.args, **named: Given.kwargs) -> Built:
    """Return what a function builds; add the place in the problem file to its error messages.

    Parameters
    ----------
    where : str
        The place, such as "problem.toml: experiments[1].data[2]".
    build : callable
    arguments, named
        Of the function.

    Raises
    ------
    InputError
        For its ValueError or TypeError, and for any error in a Python file of the user.
    """
    try:
        return build(*arguments, **named)
    # An InputError has its place already; a second one would hide it behind that of the table around it.
    except (InputError, KeyboardInterrupt):
        raise
    except BaseException as error:
        # A user's function may raise anything, at any depth below ours: what counts is whether the traceback passes a
        # file that was loaded here. ValueError and TypeError without such a place are our own checks of what the file
        # says.
        if find_user_place(error) is not None:
            raise InputError(f"{where}: {describe_error(error)}.") from error
        if isinstance(error, (ValueError, TypeError)):
            raise InputError(f"{where}: {error}") from error
        raise


def describe_error(error: BaseException) -> str:
    """Return an exception as text, with its place in a user's file if it has one."""
    # An error of ours that was raised from another one explains it in several lines; of a foreign one the first line is
    # enough.
    explained = error.__cause__ is not None and isinstance(error, ValueError)
    place, what = find_user_place(error), (str(error) if explained else get_first_line(error)).rstrip(".")
    return f"{place}: {what}" if place else what


def find_user_place(error: BaseException | None) -> str | None:
    """Return ``"file.py, line 3, in slip"`` for the innermost frame that is in a file loaded by `load_object`.

    The exception that caused this one is searched first: it was raised further inside.
    """
    if error is None:
        return None
    cause = find_user_place(error.__cause__)
    if cause is not None:
        return cause
    # A file with a syntax error has no frame of its own: it never ran.
    if isinstance(error, SyntaxError) and error.filename in _files:
        return f"{_files[error.filename]}, line {error.lineno}"
    # Frames by file name: JAX puts its own between those of the user, and the innermost of the user is where the
    # mistake is.
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename in _files]
    if not frames:
        return None
    frame = frames[-1]
    inside = "" if frame.name == "<module>" else f", in {frame.name}"
    return f"{_files[frame.filename]}, line {frame.lineno}{inside}"


@functools.cache
def _run(key: str, changed: int) -> ModuleType:
    """Return the module of a file; one that several keys name runs once, until the time of its last change differs."""
    path = _files[key]
    specification = importlib.util.spec_from_file_location(f"switchfit_user_{path.stem}", key)
    if specification is None or specification.loader is None:
        raise InputError(f"{path} cannot be loaded as a Python file.")
    module = importlib.util.module_from_spec(specification)
    # Registered before it runs: dataclasses and pickle look their module up there. Its own folder is searched only
    # while it runs, as Python does for a script, so that names in it hide nothing from other files.
    sys.modules[module.__name__] = module
    sys.path.insert(0, str(path.parent))
    try:
        with _explain_failure(f"Running {path}"):
            specification.loader.exec_module(module)
    finally:
        sys.path.remove(str(path.parent))
    return module
