"""The persistent compilation cache: compiled programs, stored in the user's cache folder and loaded again.

It is the folder ``switchfit`` in the user's cache folder (``~/.cache/switchfit`` on Linux), or the folder that the
environment variable ``SWITCHFIT_CACHE`` names; ``SWITCHFIT_CACHE=off`` turns it off. A cache folder that the user has
configured for JAX is used in its place. JAX's configuration is changed only while switchfit compiles.

The code in the folder is run: the folder must belong to the user, and nobody else may have write permission; otherwise
it is not used. Each file begins with a digest of the rest: a truncated file is compiled and written again.
"""

from __future__ import annotations

import hashlib
import os
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import jax
import platformdirs

from switchfit.runtime.files import write_atomically
from switchfit.runtime.jax_internals import replace_compilation_cache, reset_compilation_cache

SETTINGS: dict[str, Any] = {
    "jax_compilation_cache_dir": None,  # the folder, when it is known
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


@contextmanager
def use_compilation_cache() -> Iterator[None]:
    """Return a context in which JAX reads and writes compiled programs in `get_usable_folder`; it restores JAX's
    settings at its end.
    """
    path = get_usable_folder()
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    if path is None or before["jax_compilation_cache_dir"]:
        yield
        return
    settings = {**SETTINGS, "jax_compilation_cache_dir": str(path)}
    try:
        for name, value in settings.items():
            jax.config.update(name, value)
        reset_compilation_cache()
        replace_compilation_cache(_WholeFiles(path))
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        reset_compilation_cache()


def get_usable_folder() -> Path | None:
    """Return the cache folder, created if missing; None if it is not writable, or if others can write to it."""
    chosen = os.environ.get("SWITCHFIT_CACHE", "")
    if chosen.lower() == "off":
        return None
    path = Path(chosen) if chosen else Path(platformdirs.user_cache_dir("switchfit", appauthor=False))
    try:
        # Code in the folder will be run: it is made for its owner alone, and looked at afterwards, for it may have been
        # there.
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.stat()
    except OSError:
        return None
    if reason := _find_other_writers(found):
        _warn_once(path, reason)
        return None
    return path if os.access(path, os.W_OK) else None


def _find_other_writers(found: os.stat_result) -> str:
    """Return why others may have written a file or a folder; "" if they cannot, or the system does not tell."""
    if not hasattr(os, "geteuid"):
        return ""
    # Another owner could change the permissions at any time.
    if found.st_uid != os.geteuid():
        return f"it belongs to the user with the number {found.st_uid}, not to you ({os.geteuid()})"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"others may write to it ({stat.filemode(found.st_mode)})"
    return ""


@cache
def _warn_once(path: Path, reason: str) -> None:
    warnings.warn(
        f"The cache folder {path} is not used, since code in it would be run: {reason}. Delete it, or set the "
        "environment variable SWITCHFIT_CACHE to a folder of your own. Until then compiled programs are not cached.",
        stacklevel=2,
    )


def read_code(path: Path) -> bytes | None:
    """Read code that `write_code` wrote; None if the file is missing, damaged or not the user's own.

    Parameters
    ----------
    path : Path
        In the folder of `get_usable_folder`.
    """
    try:
        with path.open("rb") as file:
            # Of the open file, not of its name: between two look-ups by name another file may have been put there.
            found = os.fstat(file.fileno())
            content = file.read()
    except OSError:
        return None
    # A file cut short by a full disk or a killed process has another digest: it counts as missing, and is written
    # again.
    check, code = content[:32], content[32:]
    return code if hashlib.sha256(code).digest() == check and not _find_other_writers(found) else None


def write_code(path: Path, code: bytes) -> None:
    """Write machine code with its digest; if that fails, no file remains.

    Parameters
    ----------
    path : Path
        In the folder of `get_usable_folder`.
    code : bytes
    """
    with suppress(OSError):  # the cache is optional: a failed write is ignored
        write_atomically(hashlib.sha256(code).digest() + code, path, sync=False)


class _WholeFiles:
    """Stores JAX's compiled programs by `write_code`; has the methods of JAX's own cache.

    JAX's cache writes files in place. A file that is truncated, or read while another process writes it, causes a
    warning there and is never replaced.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def get(self, key: str) -> bytes | None:
        return read_code(self._path / f"jax-{key}")

    def put(self, key: str, value: bytes) -> None:
        write_code(self._path / f"jax-{key}", value)
