"""Objects out of Python files that users write, and where in them an error came from."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from pathlib import Path
from typing import Any

from switchfit.runtime.errors import InputError, get_first_line
from switchfit.runtime.files import is_regular


def load_object(reference: str, folder: Path, what: str) -> Any:
    """Return the object that ``"file.py:object"`` names.

    Parameters
    ----------
    reference : str
        Path of a Python file, relative to `folder`, and the name of an object in it.
    folder : Path
        While the file runs it can also import its neighbours in its own folder.
    what : str
        What the object is for, used in messages.

    Raises
    ------
    InputError
        If the file or the object is missing, or running the file raises.
    """
    path, name = find_object(reference, folder, what)
    module = _run(path)
    if not hasattr(module, name):
        public = [key for key in vars(module) if not key.startswith("_")]
        raise InputError(f"{what} {reference!r}: {path} defines no {name!r}; it has {', '.join(public) or 'nothing'}.")
    return getattr(module, name)


def find_object(reference: str, folder: Path, what: str) -> tuple[Path, str]:
    """Return the file and the name that ``"file.py:object"`` stands for; the file is not run.

    Parameters
    ----------
    reference, folder, what : as of `load_object`

    Raises
    ------
    InputError
        If it is written in another way, or the file is missing.
    """
    file, colon, name = reference.rpartition(":")
    if not colon or not file.endswith(".py") or not name.isidentifier():
        raise InputError(f"{what} must be given as 'file.py:object'; got {reference!r}.")
    path = folder / file
    if not is_regular(path):
        raise InputError(f"{what} {reference!r}: there is no file {path}.")
    return path, name


def call(function: Any, what: str, **arguments: Any) -> Any:
    """Call a user's factory; InputError says where it failed."""
    try:
        with _use_double_precision():
            return function(**arguments)
    except (InputError, KeyboardInterrupt):
        raise
    except BaseException as error:  # whatever a user's file raises, SystemExit among it
        raise InputError(f"{what} failed: {describe_error(error)}.") from error


def describe_error(error: BaseException) -> str:
    """Return an exception with the place in a user's file it came from, as far as it has one."""
    explained = error.__cause__ is not None and isinstance(error, ValueError)
    place, what = find_user_place(error), (str(error) if explained else get_first_line(error)).rstrip(".")
    return f"{place}: {what}" if place else what


def find_user_place(error: BaseException | None) -> str | None:
    """Return ``"file.py, line 3, in slip"`` for the innermost frame that is in a file loaded by `load_object`.

    The exception that caused this one goes first: it was raised further inside.
    """
    if error is None:
        return None
    cause = find_user_place(error.__cause__)
    if cause is not None:
        return cause
    if isinstance(error, SyntaxError) and error.filename in _files:
        return f"{_files[error.filename]}, line {error.lineno}"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename in _files]
    if not frames:
        return None
    frame = frames[-1]
    inside = "" if frame.name == "<module>" else f", in {frame.name}"
    return f"{_files[frame.filename]}, line {frame.lineno}{inside}"


def _use_double_precision() -> Any:
    """Return a context in which what a file makes with jax.numpy is as precise as what it computes with later."""
    import jax  # here, since a file that is only read needs none of it

    return jax.enable_x64(True)


#: Every file that was run, absolute -> as the user named it.
_files: dict[str | None, Path] = {}

#: The modules of those that ran through, with the time of their last change (ns).
_modules: dict[str, tuple[int, Any]] = {}


def _run(path: Path) -> Any:
    """Return the module that a file makes; a file that several keys name runs once while it does not change."""
    key = str(path.resolve())
    stamp = path.stat().st_mtime_ns
    if key in _modules and _modules[key][0] == stamp:
        return _modules[key][1]
    specification = importlib.util.spec_from_file_location(f"switchfit_user_{path.stem}", key)
    if specification is None or specification.loader is None:
        raise InputError(f"{path} cannot be loaded as a Python file.")
    module = importlib.util.module_from_spec(specification)
    _files[key] = path
    sys.modules[module.__name__] = module
    sys.path.insert(0, str(path.parent))
    try:
        with _use_double_precision():
            specification.loader.exec_module(module)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise InputError(f"Running {path} failed: {describe_error(error)}.") from error
    finally:
        sys.path.remove(str(path.parent))
    _modules[key] = (stamp, module)
    return module
