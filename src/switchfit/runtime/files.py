"""Write files atomically, say why one cannot be read, and set damaged files aside."""

from __future__ import annotations

import contextlib
import os
import secrets
import warnings
from collections.abc import Iterator
from pathlib import Path

from switchfit.runtime.errors import InputError

try:
    import fcntl
except ImportError:  # Windows, where a file that another process has open cannot be deleted
    fcntl = None  # type: ignore[assignment]

PREFIX, SUFFIX = ".switchfit-", ".tmp"
"""Prefix and suffix of the names of temporary files."""
ATTEMPTS = 100


def write_atomically(content: str | bytes, path: Path, *, sync: bool = True) -> None:
    """Write a temporary file in the folder of `path`, then rename it to `path`; text as UTF-8.

    Temporary files of killed processes in the same folder are deleted first. A file that is being written is locked,
    and the lock ends with its process, so that files of running processes are not deleted.

    Parameters
    ----------
    content : str or bytes
    path : Path
    sync : bool
        Whether to wait until the content is on the disk; not needed for files that are checked when they are read.

    Raises
    ------
    OSError
        If the file cannot be written; the error names the file. An existing file is then unchanged.
    """
    data = content.encode() if isinstance(content, str) else content
    if path.exists() and not path.is_file() and not path.is_dir():
        path.write_bytes(data)  # a device or a pipe, which cannot be replaced
        return
    path = path.resolve()  # write the target of a link; the link remains
    try:
        _delete_abandoned(path.parent)
        for attempt in range(ATTEMPTS):
            try:
                return _write(data, path, sync)
            except FileNotFoundError:
                # Another process saw the temporary file before it was locked, and deleted it.
                if attempt == ATTEMPTS - 1 or not path.parent.is_dir():
                    raise
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _write(data: bytes, path: Path, sync: bool) -> None:
    temporary = path.with_name(f"{PREFIX}{secrets.token_hex(8)}{SUFFIX}")
    try:
        with temporary.open("xb") as file:
            if fcntl is not None:
                with contextlib.suppress(OSError):  # a file system without locks
                    fcntl.flock(file, fcntl.LOCK_EX)
            file.write(data)
            file.flush()
            if sync:
                os.fsync(file.fileno())
            if fcntl is not None:
                temporary.replace(path)  # while locked
        if fcntl is None:
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _delete_abandoned(folder: Path) -> None:
    """Delete the temporary files in a folder that no process is writing."""
    found = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        found = [entry.path for entry in entries if entry.name.startswith(PREFIX) and entry.name.endswith(SUFFIX)]
    for name in found:
        with contextlib.suppress(OSError):  # locked, or deleted in the meantime
            if fcntl is None:
                os.unlink(name)
                continue
            with open(name, "r+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.unlink(name)


def is_regular(path: Path) -> bool:
    """Return whether a regular file has that name; False for invalid names."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long; a null character
        return False


@contextlib.contextmanager
def explain_read_errors(path: Path, what: str = "file", inside: str = "a file") -> Iterator[None]:
    """Return a context that turns an OSError into an InputError with the reason.

    Parameters
    ----------
    path : Path
        A device, such as ``/dev/zero``, which can be read without end, is refused too.
    what, inside : str
        What it is, and what to name in a folder, for messages.
    """
    if "\0" in str(path):
        raise InputError(f"{str(path)!r} is not a file name: it has a null character.")
    try:
        if path.is_char_device() or path.is_block_device():
            raise InputError(f"{path} is a device; name a {what}.")
        yield
    except FileNotFoundError as error:
        raise InputError(f"There is no {what} {path}; check the name and the folder.") from error
    except IsADirectoryError as error:
        raise InputError(f"{path} is a folder; name {inside} in it.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def set_aside(path: Path, reason: str, remedy: str) -> None:
    """Rename a damaged file to ``NAME.damaged`` (``.damaged-2``, ... if there is one), and warn.

    Parameters
    ----------
    path : Path
    reason : str
        The damage, as the end of a sentence.
    remedy : str
        What happens next, as a sentence.
    """
    number, target = 1, path.with_name(f"{path.name}.damaged")
    while target.exists():
        number += 1
        target = path.with_name(f"{path.name}.damaged-{number}")
    with contextlib.suppress(FileNotFoundError):  # another process has renamed it already
        path.rename(target)
    warnings.warn(f"{path} is damaged: {reason}. It is now {target.name}. {remedy}", stacklevel=2)
