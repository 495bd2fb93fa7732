"""The persistent compilation cache: a program that was compiled once is read from the user's cache folder later.

It lies in the user's cache folder under ``switchfit`` (``~/.cache/switchfit`` on Linux), or in the folder that the
environment variable ``SWITCHFIT_CACHE`` names; ``SWITCHFIT_CACHE=off`` turns it off. A cache folder that the user has
configured for JAX is used in its place. JAX's configuration is changed only while switchfit compiles.

What is in the folder is run, so it must belong to the user, and nobody else may write to it; otherwise it is not used.
Each file begins with a digest of the rest: one that was cut off is compiled and written again.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import Any

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache as jax_cache

from switchfit.runtime.files import write_atomically

SETTINGS: dict[str, Any] = {
    "jax_compilation_cache_dir": None,  # the folder, when it is known
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


def find_folder() -> Path | None:
    """Return where compiled programs are kept; None if the cache is off."""
    chosen = os.environ.get("SWITCHFIT_CACHE", "")
    if chosen.lower() == "off":
        return None
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("switchfit", appauthor=False))


@contextmanager
def use_compilation_cache() -> Iterator[None]:
    """Return a context in which JAX reads and writes compiled programs in `find_folder`; everything is as before
    afterwards.
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
        jax_cache.reset_cache()  # JAX decides once whether it uses a cache; make it decide again
        _use_whole_files(path)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        jax_cache.reset_cache()


def get_usable_folder() -> Path | None:
    """Return the cache folder, made if it is missing; None if it cannot be written to, or others can write to it."""
    path = find_folder()
    if path is None:
        return None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.stat()
    except OSError:
        return None
    if reason := can_others_write(found):
        _warn_once(path, reason)
        return None
    return path if os.access(path, os.W_OK) else None


def can_others_write(found: os.stat_result) -> str:
    """Return why somebody else may have written a file or a folder; "" if nobody may, or the system does not tell."""
    if not hasattr(os, "geteuid"):
        return ""
    if found.st_uid != os.geteuid():
        return f"it belongs to the user with the number {found.st_uid}, not to you ({os.geteuid()})"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"others may write to it ({stat.filemode(found.st_mode)})"
    return ""


@cache
def _warn_once(path: Path, reason: str) -> None:
    warnings.warn(
        f"The cache folder {path} is not used, since what is in it is run: {reason}. Delete it, or name one of your "
        "own with the environment variable SWITCHFIT_CACHE. Until then everything is compiled anew.",
        stacklevel=2,
    )


def read_code(path: Path) -> bytes | None:
    """Return what `write_code` wrote; None if the file is missing, damaged or not the user's own.

    Parameters
    ----------
    path : Path
        In the folder of `get_usable_folder`.
    """
    try:
        with path.open("rb") as file:
            found = os.fstat(file.fileno())
            content = file.read()
    except OSError:
        return None
    check, code = content[:32], content[32:]
    return code if hashlib.sha256(code).digest() == check and not can_others_write(found) else None


def write_code(path: Path, code: bytes) -> None:
    """Write machine code with its digest; where that fails nothing is left behind.

    Parameters
    ----------
    path : Path
        In the folder of `get_usable_folder`.
    code : bytes
    """
    with suppress(OSError):  # a cache that cannot be written is no reason to stop
        write_atomically(hashlib.sha256(code).digest() + code, path, sync=False)


class _WholeFiles:
    """JAX's compiled programs in files as of `write_code`, with the methods of JAX's own cache.

    JAX writes its files in place: one that was cut off, or is read while another process writes it, gives a warning and
    is never replaced.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def get(self, key: str) -> bytes | None:
        return read_code(self._path / f"jax-{key}")

    def put(self, key: str, value: bytes) -> None:
        write_code(self._path / f"jax-{key}", value)


def _use_whole_files(path: Path) -> None:
    """Hand JAX a `_WholeFiles`. The names are private: should JAX change them, it goes on with its own cache."""
    internals: Any = sys.modules[jax_cache.reset_cache.__module__]
    with getattr(internals, "_cache_initialized_mutex", nullcontext()):
        internals._cache_initialized, internals._cache = True, _WholeFiles(path)
