"""Whether the sizes, names and times of a fit that was read from a file match one another.

A fit that passes can be printed and plotted, and has intervals.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import numpy as np

from switchfit.fit.result import Fit, TimeProfile
from switchfit.fit.trajectory import Comparison, Trajectory
from switchfit.problem.data import FloatArray
from switchfit.problem.dates import normalize_time_unit
from switchfit.runtime.json_records import shorten_json


def check_fit(fit: Fit) -> None:
    """Raise ValueError if sizes, names or times do not match one another."""
    d, experiments = len(fit.theta_names), len(fit.trajectories)
    unknowns, runs = f"since fit.theta_names has {d} entries", f"since fit.trajectories has {experiments} entries"
    if experiments == 0:
        raise ValueError("fit.trajectories must have one entry or more; got none")
    vectors = ("theta_units", "initial_theta", "theta", "lower", "upper", "gradient")
    _check_sizes("fit", fit, vectors, (d,), unknowns)
    _check_sizes("fit", fit, ("hessian", "saved_gauss_newton"), (d, d), unknowns)
    _check_sizes(
        "fit", fit, ("run_names", "transition_places", "transition_times", "comparisons"), (experiments,), runs
    )
    for k, record in enumerate(fit.history):
        _check_sizes(f"fit.history[{k}]", record, ("theta",), (d,), unknowns)
    _check_basis(fit.free_basis, d)
    named = {name: getattr(fit, name) for name in ("idle", "unread", "absent", "priors", "log_scaled")}
    named["kinks"] = [kink.unknown for kink in fit.kinks]
    named["active"] = [c.unknown for c in fit.active if c.position is None]
    for name, given in named.items():
        _check_names(f"fit.{name}", given, fit.theta_names)
    for k, profile in enumerate(fit.saved_profiles):
        _check_profile(profile, f"fit.saved_profiles[{k}]", fit.theta_names)
    for name in fit.parameters:
        if name not in fit.parameter_units:
            raise ValueError(f"fit.parameter_units lacks the parameter {name!r}")
    _check_names("fit.fixed", fit.fixed, fit.parameters, "fit.parameters")
    for e, (trajectory, times) in enumerate(zip(fit.trajectories, fit.transition_times, strict=True)):
        _check_trajectory(trajectory, times, e)
        places = fit.transition_places[e]
        _check_size(f"fit.transition_places[{e}]", places, times.shape, f"as fit.transition_times[{e}]")
        if np.any((places < -1) | (places >= d)):
            raise ValueError(f"fit.transition_places[{e}] must lie between -1 and {d - 1}; got {places.tolist()}")
        for k, comparison in enumerate(fit.comparisons[e]):
            _check_comparison(comparison, f"fit.comparisons[{e}][{k}]")


def _check_profile(profile: TimeProfile, where: str, names: tuple[str, ...]) -> None:
    _check_names(f"{where}.unknown", (profile.unknown,), names)
    for name in ("below", "above"):
        pieces = getattr(profile, name)
        _check_size(f"{where}.{name}", pieces, (len(pieces), 5), "rows of five numbers")
        if not len(pieces) or not np.isfinite(pieces).all():
            raise ValueError(f"{where}.{name} must hold one row or more of finite numbers")


def _check_trajectory(trajectory: Trajectory, transition_times: FloatArray, e: int) -> None:
    where = f"fit.trajectories[{e}]"
    _check_times(f"{where}.times", trajectory.times)
    if trajectory.origin is not None:
        normalize_time_unit(trajectory.time_unit)
    n, K = len(trajectory.state_names), len(trajectory.times)
    _check_size(f"{where}.state_units", trajectory.state_units, (n,), f"since its state_names has {n} entries")
    nodes = f"since its times has {K} entries"
    _check_size(f"{where}.states", trajectory.states, (K, n), f"{nodes} and its state_names {n}")
    _check_size(f"{where}.modes", trajectory.modes, (K,), nodes)
    _check_size(f"fit.transition_times[{e}]", transition_times, (transition_times.size,), "a list of numbers")
    N = len(transition_times)
    _check_size(f"{where}.segments", trajectory.segments, (N + 2,), f"since fit.transition_times[{e}] has {N} entries")
    ends = trajectory.segments
    if ends[0] != 0 or ends[-1] != K or np.any(np.diff(ends) <= 0):
        raise ValueError(f"{where}.segments must increase from 0 to {K}, the number of times; got {ends.tolist()}")


def _check_comparison(comparison: Comparison, where: str) -> None:
    if comparison.kind not in ("measurements", "reference"):
        raise ValueError(f'{where}.kind must be "measurements" or "reference"; got {shorten_json(comparison.kind)}')
    _check_times(f"{where}.times", comparison.times)
    _check_times(f"{where}.curve_times", comparison.curve_times)
    q, K, L = len(comparison.names), len(comparison.times), len(comparison.curve_times)
    sizes = f"since its times has {K} entries and its names {q}"
    _check_sizes(where, comparison, ("measured", "fitted", "sigma", "downweighted"), (K, q), sizes)
    channels = ("units", "weights") if comparison.units else ("weights",)
    _check_sizes(where, comparison, channels, (q,), f"since its names has {q} entries")
    _check_size(f"{where}.curve", comparison.curve, (L, q), f"since its curve_times has {L} entries and its names {q}")


def _check_sizes(where: str, record: Any, names: Iterable[str], shape: tuple[int, ...], reason: str) -> None:
    """Raise ValueError unless all fields of these names that are not None have a shape."""
    for name in names:
        if getattr(record, name) is not None:
            _check_size(f"{where}.{name}", getattr(record, name), shape, reason)


def _check_size(where: str, value: Any, shape: tuple[int, ...], reason: str) -> None:
    found = value.shape if isinstance(value, np.ndarray) else (len(value),)
    if found != shape:
        raise ValueError(f"{where} must have the shape {shape}, {reason}; got {found}")


def _check_times(where: str, times: FloatArray) -> None:
    """Raise ValueError for times above 1e100 in size, for which no axis can be drawn."""
    if times.ndim != 1 or not (np.abs(times) < 1e100).all() or np.any(np.diff(times) < 0):
        raise ValueError(f"{where} must be a list of finite numbers (below 1e100) that do not decrease")


def _check_basis(basis: FloatArray, d: int) -> None:
    """Raise ValueError unless all columns have length 1 and are at right angles to one another."""
    if basis.ndim != 2 or basis.shape[0] != d or basis.shape[1] > d:
        raise ValueError(f"fit.free_basis must have {d} rows and at most as many columns; got the shape {basis.shape}")
    if not (np.abs(basis) <= 2).all() or not np.allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-6):
        raise ValueError("fit.free_basis must have orthonormal columns")


def _check_names(where: str, given: Iterable[str], known: Collection[str], of: str = "fit.theta_names") -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"{where} has the name {name!r}, which is not in {of}")
