"""The persistent compilation cache: a program that was compiled once is read from the user's cache folder later.

It lies in the user's cache folder under ``switchfit`` (``~/.cache/switchfit`` on Linux), or in the folder that the
environment variable ``SWITCHFIT_CACHE`` names; ``SWITCHFIT_CACHE=off`` turns it off. A cache folder that the user has
configured for JAX is used in its place. JAX's configuration is changed only while switchfit compiles.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache as jax_cache

SETTINGS: dict[str, Any] = {
    "jax_compilation_cache_dir": None,  # the folder, when it is known
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


def folder() -> Path | None:
    """Where compiled programs are kept; None if the cache is off."""
    chosen = os.environ.get("SWITCHFIT_CACHE", "")
    if chosen.lower() == "off":
        return None
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("switchfit", appauthor=False))


@contextmanager
def compilation_cache() -> Iterator[None]:
    """Context in which JAX reads and writes compiled programs in `folder`; everything is as before afterwards."""
    path = usable_folder()
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    if path is None or before["jax_compilation_cache_dir"]:
        yield
        return
    settings = {**SETTINGS, "jax_compilation_cache_dir": str(path)}
    try:
        for name, value in settings.items():
            jax.config.update(name, value)
        jax_cache.reset_cache()  # JAX decides once whether it uses a cache; make it decide again
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        jax_cache.reset_cache()


def usable_folder() -> Path | None:
    """`folder`, made if it is not there; None where nothing can be written to it."""
    path = folder()
    if path is None:
        return None
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return path if os.access(path, os.W_OK) else None
