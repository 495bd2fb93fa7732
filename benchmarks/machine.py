"""What the figures were measured on, and on which core."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("switchfit", "jax", "jaxlib", "numpy", "scipy", "casadi", "diffrax", "filterpy", "heyoka")


def all_cores() -> set[int] | None:
    """Cores this process may use; None where the system does not tell."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None


def use_one_core() -> set[int] | None:
    """Bind this process, and with it XLA's thread pools, to one core. Before JAX starts; returns the cores it had."""
    cores = all_cores()
    if cores is not None:
        os.sched_setaffinity(0, {max(cores)})
    return cores


def describe(cores: set[int] | None) -> dict[str, object]:
    """CPU, number of cores, system, versions, load."""
    return {
        "cpu": _cpu(),
        "cores": len(cores) if cores is not None else os.cpu_count(),
        "system": platform.platform(),
        "python": sys.version.split()[0],
        "packages": {name: _version(name) for name in PACKAGES},
        "load": [round(x, 2) for x in os.getloadavg()] if hasattr(os, "getloadavg") else None,
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"
