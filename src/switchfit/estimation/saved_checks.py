"""Whether the sizes, names and times of a fit that was read from a file match one another.

A fit that passes can be printed and plotted, and has intervals.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Comparison, Trajectory
from switchfit.problem.data import FloatArray
from switchfit.problem.dates import normalize_time_unit
from switchfit.runtime.json_records import shorten_json


def check_fit(fit: Fit) -> None:
    """Raise ValueError if sizes, names or times do not match one another."""
    d, experiments = len(fit.theta_names), len(fit.trajectories)
    unknowns = f"since fit.theta_names has {d} entries"
    _check_size("fit.theta_units", fit.theta_units, (d,), unknowns)
    for name in ("initial_theta", "theta", "lower", "upper", "gradient"):
        _check_size(f"fit.{name}", getattr(fit, name), (d,), unknowns)
    for name in ("hessian", "saved_gauss_newton"):
        if getattr(fit, name) is not None:
            _check_size(f"fit.{name}", getattr(fit, name), (d, d), unknowns)
    for k, profile in enumerate(fit.saved_profiles):
        _check_names(f"fit.saved_profiles[{k}].unknown", (profile.unknown,), fit.theta_names)
        for name in ("below", "above"):
            pieces = getattr(profile, name)
            _check_size(f"fit.saved_profiles[{k}].{name}", pieces, (len(pieces), 5), "rows of five numbers")
            if not len(pieces) or not np.isfinite(pieces).all():
                raise ValueError(f"fit.saved_profiles[{k}].{name} must hold one row or more of finite numbers")
    for k, record in enumerate(fit.history):
        _check_size(f"fit.history[{k}].theta", record.theta, (d,), unknowns)
    _check_basis(fit.free_basis, d)
    _check_names("fit.kinks", (kink.unknown for kink in fit.kinks), fit.theta_names)
    _check_names("fit.active", (c.unknown for c in fit.active if c.position is None), fit.theta_names)
    for name in ("idle", "unread", "absent"):
        _check_names(f"fit.{name}", getattr(fit, name), fit.theta_names)
    _check_names("fit.priors", fit.priors, fit.theta_names)
    _check_names("fit.log_scaled", fit.log_scaled, fit.theta_names)
    for name in fit.parameters:
        if name not in fit.parameter_units:
            raise ValueError(f"fit.parameter_units lacks the parameter {name!r}")
    for name in fit.fixed:
        if name not in fit.parameters:
            raise ValueError(f"fit.fixed has the name {name!r}, which is not in fit.parameters")
    if experiments == 0:
        raise ValueError("fit.trajectories must have one entry or more; got none")
    runs = f"since fit.trajectories has {experiments} entries"
    _check_size("fit.run_names", fit.run_names, (experiments,), runs)
    _check_size("fit.transition_places", fit.transition_places, (experiments,), runs)
    _check_size("fit.transition_times", fit.transition_times, (experiments,), runs)
    _check_size("fit.comparisons", fit.comparisons, (experiments,), runs)
    for e, (trajectory, times) in enumerate(zip(fit.trajectories, fit.transition_times, strict=True)):
        _check_trajectory(trajectory, times, e)
        places = fit.transition_places[e]
        _check_size(f"fit.transition_places[{e}]", places, times.shape, f"as fit.transition_times[{e}]")
        if np.any((places < -1) | (places >= d)):
            raise ValueError(f"fit.transition_places[{e}] must lie between -1 and {d - 1}; got {places.tolist()}")
        for k, comparison in enumerate(fit.comparisons[e]):
            _check_comparison(comparison, f"fit.comparisons[{e}][{k}]")


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
    for name in ("measured", "fitted", "sigma", "downweighted"):
        if getattr(comparison, name) is not None:
            _check_size(f"{where}.{name}", getattr(comparison, name), (K, q), sizes)
    if comparison.units:
        _check_size(f"{where}.units", comparison.units, (q,), f"since its names has {q} entries")
    if comparison.weights is not None:
        _check_size(f"{where}.weights", comparison.weights, (q,), f"since its names has {q} entries")
    _check_size(f"{where}.curve", comparison.curve, (L, q), f"since its curve_times has {L} entries and its names {q}")


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


def _check_names(where: str, given: Iterable[str], known: tuple[str, ...]) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"{where} has the name {name!r}, which is not in fit.theta_names")
