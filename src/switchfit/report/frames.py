"""The numbers of results as tables: their names, dimensions and units, for pandas, xarray and ArviZ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.batch.fits import Fits
from switchfit.batch.simulated import Bootstrap, MonteCarlo
from switchfit.batch.starts import Multistart
from switchfit.estimation.estimator import Estimate
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Trajectory
from switchfit.problem.data import FloatArray
from switchfit.report.formats import format_iso, format_unit, get_unit, list_dated
from switchfit.runtime.frames import Frame, Labels, Variable, describe_frame
from switchfit.uncertainty.prediction import Prediction
from switchfit.uncertainty.profiles import Profile
from switchfit.uncertainty.residuals import correct_errors, correct_intervals, list_channels

ERROR, LOW, HIGH = "{} std. error", "{} low", "{} high"
"""Names of the columns beside an unknown: its standard error, and the ends of its 95 % interval."""


@describe_frame.register(Estimate)
def describe_estimate(estimate: Estimate, *, what: str = "unknowns") -> Frame:
    """Return one of the tables of an estimate.

    Parameters
    ----------
    estimate : Estimate
    what : {"unknowns", "trajectories", "residuals", "history"}
    """
    tables = {
        "unknowns": _describe_unknowns,
        "trajectories": _describe_trajectories,
        "residuals": _describe_residuals,
        "history": _describe_history,
    }
    return tables[what](estimate)


def _describe_unknowns(estimate: Estimate) -> Frame:
    """Return a row for each unknown; standard errors and intervals allow for correlated residuals, as in the report."""
    names, naive, dated = estimate.theta_names, estimate.standard_errors, list_dated(estimate)
    low, high = correct_intervals(estimate).T
    joins = {transition.index: f"{transition.before} -> {transition.after}" for transition in estimate.transitions}
    columns: dict[str, Any] = {
        "value": estimate.theta,
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
    if any(run is not None for run in dated):
        for name, times in {"date": estimate.theta, "date_low": low, "date_high": high}.items():
            columns[name] = ["" if run is None else format_iso(t, run) for t, run in zip(times, dated, strict=True)]
    variables = _list_variables("unknown", columns)
    for name in ("covariance", "correlation", "hessian"):
        variables.append(Variable(name, getattr(estimate, name), ("unknown", "unknown_2"), column=""))
    ended: dict[str, str | float] = {"verdict": estimate.verdict.level, "status": estimate.status.name}
    ended |= {"cost": float(estimate.cost), "seconds": float(estimate.seconds)}
    (index,) = _list_variables("unknown", {"unknown": names})
    return Frame("unknown", (index,), tuple(variables), {"unknown_2": Labels(names)}, ended)


def _list_variables(rows: str, columns: Mapping[str, Any]) -> list[Variable]:
    """Return columns by their names as variables, one entry a row."""
    return [Variable(name, np.asarray(values), (rows,)) for name, values in columns.items()]


def list_holds(fit: Fit, name: str) -> Iterator[str]:
    """Yield what holds an unknown: a bound, a kink, or that the cost does not depend on it.

    Parameters
    ----------
    fit : Fit
    name : str
    """
    if name in fit.idle:
        yield "idle"
    if name in (*fit.unread, *fit.absent):
        yield "not read"
    yield from (f"at {c.kind}" for c in fit.active if c.unknown == name and c.position is None)
    if name in [kink.unknown for kink in fit.kinks]:
        yield "at a kink"


def _describe_trajectories(fit: Fit) -> Frame:
    """Return a row for each node of each run."""
    rows, each = ("node",), fit.trajectories
    runs = np.repeat(np.array(fit.run_names, dtype=str), [len(trajectory.times) for trajectory in each])
    times, modes, states = (
        np.concatenate([getattr(trajectory, name) for trajectory in each]) for name in ("times", "modes", "states")
    )
    index = Variable("run", runs, rows), Variable("time", times, rows, _get_time_unit(fit))
    own = _split(states, rows, each[0].state_names, each[0].state_units)
    return Frame("node", index, (Variable("mode", modes, rows), *own))


def _get_time_unit(fit: Fit) -> str:
    """Return the unit of all times; "" where runs differ in it."""
    units = {trajectory.time_unit for trajectory in fit.trajectories}
    return units.pop() if len(units) == 1 else ""


def _split(values: FloatArray, rows: tuple[str], names: Sequence[str], units: Sequence[str]) -> list[Variable]:
    """Return the columns of values (K, n) as variables of their own."""
    named = zip(names, units, values.T, strict=True)
    return [Variable(name, column, rows, format_unit(unit)) for name, unit, column in named]


def _describe_residuals(estimate: Estimate) -> Frame:
    """Return a row for each value that was measured, in the order of runs, data and channels."""
    parts: list[dict[str, NDArray[Any]]] = []
    for _, e, comparison, k in list_channels(estimate.comparisons, estimate.run_names):
        i = np.flatnonzero(np.isfinite(comparison.measured[:, k]))
        sigma = np.full(len(i), np.nan) if comparison.sigma is None else comparison.sigma[i, k]
        columns: dict[str, NDArray[Any]] = {
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
        parts.append(columns)
    names = list(parts[0]) if parts else []
    variables = _list_variables("sample", {name: np.concatenate([part[name] for part in parts]) for name in names})
    index = tuple(v._replace(unit=_get_time_unit(estimate)) if v.name == "time" else v for v in variables[:3])
    return Frame("sample", index, tuple(variables[3:]))


def _describe_history(fit: Fit) -> Frame:
    """Return a row for each iteration."""
    kinds = {"iteration": np.int64, "cost": float, "optimality": float, "step": float, "evaluations": np.int64}
    columns = {name: np.array([getattr(r, name) for r in fit.history], dtype=kind) for name, kind in kinds.items()}
    index, *others = _list_variables("iteration", columns)
    theta = np.array([record.theta for record in fit.history]).reshape(-1, len(fit.theta_names))
    unknowns = _split(theta, ("iteration",), fit.theta_names, fit.theta_units)
    return Frame("iteration", (index,), (*others, *unknowns))


def _list_dates(result: Trajectory | Prediction, rows: tuple[str]) -> list[Variable]:
    """Return a column with the dates, in UTC if they have a zone; none where times are no dates."""
    origin = result.origin
    if origin is None:
        return []
    dates = [origin.find_date(time, result.time_unit) for time in result.times.tolist()]
    # As datetime64, which have no zone of their own.
    bare = [date and (date.astimezone(UTC).replace(tzinfo=None) if date.tzinfo else date) for date in dates]
    values = np.array(bare, dtype="datetime64[us]").astype("datetime64[ns]")
    return [Variable("date (UTC)" if origin.time_zone else "date", values, rows)]


@describe_frame.register(Trajectory)
def describe_trajectory(trajectory: Trajectory) -> Frame:
    """Return a row for each time.

    Parameters
    ----------
    trajectory : Trajectory
    """
    rows = ("time",)
    states = _split(trajectory.states, rows, trajectory.state_names, trajectory.state_units)
    variables = (*_list_dates(trajectory, rows), Variable("mode", trajectory.modes, rows), *states)
    return Frame("time", (Variable("time", trajectory.times, rows, trajectory.time_unit),), variables)


@describe_frame.register(Prediction)
def describe_prediction(prediction: Prediction) -> Frame:
    """Return a row for each time: states and outputs with standard errors and 95 % confidence bands, sigma of a sample.

    Parameters
    ----------
    prediction : Prediction
    """
    state, output = ("time", "state"), ("time", "output")
    low, high = np.moveaxis(prediction.state_band(), -1, 0)
    output_low, output_high = np.moveaxis(prediction.output_band(), -1, 0)
    variables = (
        *_list_dates(prediction, ("time",)),
        Variable("states", prediction.states, state),
        Variable("state_errors", prediction.state_errors, state, column=ERROR),
        Variable("states_low", low, state, column=LOW),
        Variable("states_high", high, state, column=HIGH),
        Variable("outputs", prediction.outputs, output, column="{} output"),
        Variable("output_errors", prediction.output_errors, output, column=ERROR.format("{} output")),
        Variable("outputs_low", output_low, output, column=LOW.format("{} output")),
        Variable("outputs_high", output_high, output, column=HIGH.format("{} output")),
        Variable("noise", prediction.noise, output, column="{} output noise"),
        Variable("near_transition", prediction.near_transition, ("time",)),
    )
    labels = {
        "state": Labels(prediction.state_names, tuple(map(format_unit, prediction.state_units))),
        "output": Labels(prediction.output_names),
    }
    return Frame("time", (Variable("time", prediction.times, ("time",), prediction.time_unit),), variables, labels)


@describe_frame.register(Profile)
def describe_profile(profile: Profile) -> Frame:
    """Return a row for each value at which the unknown was held.

    Parameters
    ----------
    profile : Profile
    """
    rows, fit = (profile.name,), profile.fit
    low, high = map(float, profile.interval())
    columns = {"cost": profile.costs, "zeta": profile.zeta, "converged": profile.converged}
    variables = _list_variables(profile.name, columns) + _split(profile.thetas, rows, fit.theta_names, fit.theta_units)
    others = tuple(variable for variable in variables if variable.name != profile.name)
    attributes = {"estimate": profile.value, "std_error": profile.standard_error, "level": profile.level}
    attributes |= {"low": low, "high": high, "widening": profile.widening}
    index = (Variable(profile.name, profile.values, rows, format_unit(profile.unit)),)
    return Frame(profile.name, index, others, attributes=attributes)


@describe_frame.register(Fits)
def describe_fits(fits: Fits) -> Frame:
    """Return a row for each fit.

    Parameters
    ----------
    fits : Fits
    """
    rows, both = ("run",), ("run", "unknown")
    low, high = np.moveaxis(fits.confidence_intervals(), -1, 0)
    variables = [
        Variable("level", fits.levels, rows),
        Variable("status", fits.status, rows),
        Variable("theta", fits.theta, both),
        Variable("std_error", np.where(fits.standard_errors > 0, fits.standard_errors, np.nan), both, column=ERROR),
        Variable("low", low, both, column=LOW),
        Variable("high", high, both, column=HIGH),
        Variable("start", fits.start, both, column="{} start"),
    ]
    names = ("cost", "explained", "samples", "optimality", "iterations", "evaluations", "collapsed", "at_bounds")
    variables += [Variable(name, getattr(fits, name), rows) for name in (*names, "message")]
    variables.append(Variable("covariance", fits.covariance, (*both, "unknown_2")))
    attributes: dict[str, str | float] = {"requested": fits.requested, "seconds": float(fits.seconds)}
    if isinstance(fits, Multistart):
        variables.insert(2, Variable("cluster", fits.clusters, rows))
    elif isinstance(fits, MonteCarlo):
        variables.append(Variable("truth", fits.truth, ("unknown",)))
    elif isinstance(fits, Bootstrap):
        variables.append(Variable("estimate", fits.estimate, ("unknown",)))
        attributes["resample"] = fits.resample
    units = tuple(map(format_unit, fits.theta_units))
    labels = {"unknown": Labels(fits.theta_names, units), "unknown_2": Labels(fits.theta_names)}
    return Frame("run", (Variable("run", fits.runs, rows),), tuple(variables), labels, attributes)
