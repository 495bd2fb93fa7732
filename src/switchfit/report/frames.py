"""The numbers of results as tables for pandas: names, values and units of their columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Trajectory
from switchfit.problem.time_units import SECONDS_OF_UNIT, normalize_time_unit
from switchfit.report.numbers import format_unit, get_unit
from switchfit.report.times import format_iso, list_dated
from switchfit.report.unknowns import list_holds
from switchfit.runtime.frames import Column, Frame, describe_frame
from switchfit.uncertainty.corrected_errors import correct_errors, correct_intervals
from switchfit.uncertainty.judged_fit import JudgedFit
from switchfit.uncertainty.prediction import Prediction
from switchfit.uncertainty.profiles import Profile
from switchfit.uncertainty.residuals import list_channels

ERROR, LOW, HIGH = "{} std. error", "{} low", "{} high"
"""Names of the columns beside an unknown: its standard error, and the ends of its 95 % interval."""


@describe_frame.register(JudgedFit)
def describe_estimate(estimate: JudgedFit, *, what: str = "unknowns") -> Frame:
    """Return one of the tables of an estimate.

    Parameters
    ----------
    estimate : JudgedFit
    what : {"unknowns", "trajectories", "residuals", "history"}
    """
    tables = {
        "unknowns": _describe_unknowns,
        "trajectories": _describe_trajectories,
        "residuals": _describe_residuals,
        "history": _describe_history,
    }
    return tables[what](estimate)


def _describe_unknowns(estimate: JudgedFit) -> Frame:
    """Return a row for each unknown; standard errors and intervals allow for correlated residuals, as in the report."""
    names, naive, dated = estimate.theta_names, estimate.standard_errors, list_dated(estimate)
    low, high = correct_intervals(estimate).T
    joins = {transition.index: f"{transition.before} -> {transition.after}" for transition in estimate.transitions}
    columns: dict[str, Any] = {
        "value": estimate.theta,
        # A standard error of 0 says that an unknown was held, by a bound or a kink: as a number, it would be believed.
        "std_error": np.where(naive == 0, np.nan, correct_errors(estimate)),  # held
        "low": low,
        "high": high,
        "unit": list(map(format_unit, estimate.theta_units)),
        "naive_std_error": np.where(naive == 0, np.nan, naive),
        "guess": estimate.initial_theta,
        "lower": estimate.lower,
        "upper": estimate.upper,
        "transition": [joins.get(i, "") for i in range(len(names))],
        "held": ["; ".join(list_holds(estimate, name)) for name in names],
    }
    # Columns of dates only where there are any; ISO 8601 with the zone, as text, since zones may differ by run.
    if any(run is not None for run in dated):
        for name, times in {"date": estimate.theta, "date_low": low, "date_high": high}.items():
            columns[name] = ["" if run is None else format_iso(t, run) for t, run in zip(times, dated, strict=True)]
    ended: dict[str, str | float] = {"verdict": estimate.verdict.level, "status": estimate.status.name}
    ended |= {"cost": float(estimate.cost), "seconds": float(estimate.seconds)}
    return Frame((Column("unknown", np.array(names)),), _list_columns(columns), ended)


def _list_columns(columns: Mapping[str, Any]) -> tuple[Column, ...]:
    """Return columns without units by their names."""
    return tuple(Column(name, np.asarray(values)) for name, values in columns.items())


def split_columns(values: FloatArray, names: Sequence[str], units: Sequence[str], label: str = "{}") -> list[Column]:
    """Return the columns of values (K, n), whose names are put into a label."""
    named = zip(names, units, values.T, strict=True)
    return [Column(label.format(name), column, format_unit(unit)) for name, unit, column in named]


def _describe_trajectories(fit: Fit) -> Frame:
    """Return a row for each node of each run."""
    each = fit.trajectories
    runs = np.repeat(np.array(fit.run_names, dtype=str), [len(trajectory.times) for trajectory in each])
    times, modes, states = (
        np.concatenate([getattr(trajectory, name) for trajectory in each]) for name in ("times", "modes", "states")
    )
    index = Column("run", runs), Column("time", times, _get_time_unit(fit))
    return Frame(index, (Column("mode", modes), *split_columns(states, each[0].state_names, each[0].state_units)))


def _get_time_unit(fit: Fit) -> str:
    """Return the unit of all times; "" where runs differ in it."""
    units = {trajectory.time_unit for trajectory in fit.trajectories}
    return units.pop() if len(units) == 1 else ""


def _describe_residuals(estimate: JudgedFit) -> Frame:
    """Return a row for each value that was measured, in the order of runs, data and channels."""
    parts: list[dict[str, NDArray[Any]]] = []
    for _, e, comparison, k in list_channels(estimate.comparisons, estimate.run_names):
        # Missing values have no residual, and no row.
        i = np.flatnonzero(np.isfinite(comparison.measured[:, k]))
        sigma = np.full(len(i), np.nan) if comparison.sigma is None else comparison.sigma[i, k]
        part: dict[str, NDArray[Any]] = {
            "run": np.full(len(i), estimate.run_names[e]),
            "channel": np.full(len(i), comparison.names[k]),
            "time": comparison.times[i],
            "measured": comparison.measured[i, k],
            "fitted": comparison.fitted[i, k],
            "residual": comparison.residuals[i, k],
            "sigma": sigma,
            "standardized": comparison.residuals[i, k] / sigma,
            "unit": np.full(len(i), get_unit(comparison, k, estimate.trajectories[e])),
        }
        parts.append(part)
    names = list(parts[0]) if parts else []
    columns = _list_columns({name: np.concatenate([part[name] for part in parts]) for name in names})
    # Run, channel and time tell a row from all others.
    index = tuple(c._replace(unit=_get_time_unit(estimate)) if c.name == "time" else c for c in columns[:3])
    return Frame(index, columns[3:])


def _describe_history(fit: Fit) -> Frame:
    """Return a row for each iteration."""
    kinds = {"iteration": np.int64, "cost": float, "optimality": float, "step": float, "evaluations": np.int64}
    columns = {name: np.array([getattr(r, name) for r in fit.history], dtype=kind) for name, kind in kinds.items()}
    index, *others = _list_columns(columns)
    # A history may be empty: its table then has no rows, but the same columns.
    theta = np.array([record.theta for record in fit.history]).reshape(-1, len(fit.theta_names))
    return Frame((index,), (*others, *split_columns(theta, fit.theta_names, fit.theta_units)))


def _list_dates(result: Trajectory | Prediction) -> list[Column]:
    """Return a column with the dates, in UTC if they have a zone; none where times are no dates."""
    origin = result.origin
    if origin is None:
        return []
    # Rounded to microseconds, to which dates are known; nanoseconds would show the rounding of doubles.
    microseconds = 1e6 * SECONDS_OF_UNIT[normalize_time_unit(result.time_unit)] * result.times
    values = origin.instant + np.round(microseconds).astype("timedelta64[us]")
    return [Column("date (UTC)" if origin.time_zone else "date", values.astype("datetime64[ns]"))]


@describe_frame.register(Trajectory)
def describe_trajectory(trajectory: Trajectory) -> Frame:
    """Return a row for each time.

    Parameters
    ----------
    trajectory : Trajectory
    """
    states = split_columns(trajectory.states, trajectory.state_names, trajectory.state_units)
    columns = (*_list_dates(trajectory), Column("mode", trajectory.modes), *states)
    return Frame((Column("time", trajectory.times, trajectory.time_unit),), columns)


@describe_frame.register(Prediction)
def describe_prediction(prediction: Prediction) -> Frame:
    """Return a row for each time: states and outputs with standard errors and 95 % confidence bands, sigma of a sample.

    Parameters
    ----------
    prediction : Prediction
    """
    band, output_band = (np.moveaxis(ends, -1, 0) for ends in (prediction.state_band(), prediction.output_band()))
    states = {"{}": prediction.states, ERROR: prediction.state_errors, LOW: band[0], HIGH: band[1]}
    outputs = {"{}": prediction.outputs, ERROR: prediction.output_errors, LOW: output_band[0], HIGH: output_band[1]}
    columns, names = _list_dates(prediction), prediction.output_names
    for label, values in states.items():
        columns += split_columns(values, prediction.state_names, prediction.state_units, label)
    for label, values in (outputs | {"{} noise": prediction.noise}).items():
        columns += split_columns(values, names, [""] * len(names), label.format("{} output"))
    return Frame((Column("time", prediction.times, prediction.time_unit),), tuple(columns))


@describe_frame.register(Profile)
def describe_profile(profile: Profile) -> Frame:
    """Return a row for each value at which the unknown was held.

    Parameters
    ----------
    profile : Profile
    """
    fit = profile.fit
    low, high = map(float, profile.interval())
    measured = {"cost": profile.costs, "zeta": profile.zeta, "converged": profile.converged}
    columns = (*_list_columns(measured), *split_columns(profile.thetas, fit.theta_names, fit.theta_units))
    others = tuple(column for column in columns if column.name != profile.name)
    attributes = {"estimate": profile.value, "std_error": profile.standard_error, "level": profile.level}
    attributes |= {"low": low, "high": high, "widening": profile.widening}
    return Frame((Column(profile.name, profile.values, format_unit(profile.unit)),), others, attributes)
