"""Write files atomically, and explain why a file cannot be read.

What is written as a whole goes through `write_atomically`: whoever reads it finds the old or the new content, also
after a kill or on a full disk.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from switchfit.runtime.errors import InputError

TEMPORARY_PREFIX, TEMPORARY_SUFFIX = ".switchfit-", ".tmp"
"""Prefix and suffix of the names of temporary files."""


def write_atomically(content: str | bytes, path: Path, *, sync: bool = True) -> None:
    """Write a temporary file in the folder of `path`, then rename it to `path`; text as UTF-8.

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
    # In the same folder, so that the rename stays on one file system; a random name, for others may write the same
    # file.
    temporary = path.with_name(f"{TEMPORARY_PREFIX}{secrets.token_hex(8)}{TEMPORARY_SUFFIX}")
    try:
        # Never a file that is there: "x" fails on a link that somebody has put in its place.
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            if sync:
                # A rename may reach the disk before the content does: after a loss of power the file would be empty.
                os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def explain_read_errors(path: Path, what: str = "file", inside: str = "a file") -> Iterator[None]:
    """Return a context that turns an OSError into an InputError with the reason.

    Parameters
    ----------
    path : Path
        A device, such as ``/dev/zero``, which can be read without end, is refused too.
    what, inside : str
        What it is, and what to name in a folder, for messages.
    """
    # The operating system would say "embedded null byte", as a ValueError without the name.
    if "\0" in str(path):
        raise InputError(f"{str(path)!r} is not a file name: it has a null character.")
    try:
        # Before it is opened: to open a device may change it, and to read one may never end.
        if path.is_char_device() or path.is_block_device():
            raise InputError(f"{path} is a device; name a {what}.")
        yield
    except FileNotFoundError as error:
        raise InputError(f"There is no {what} {path}; check the name and the folder.") from error
    except IsADirectoryError as error:
        raise InputError(f"{path} is a folder; name {inside} in it.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
