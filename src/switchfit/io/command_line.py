"""What the command line reads and shows: times, samples, saved estimates, results as JSON, tables as CSV."""

from __future__ import annotations

import contextlib
import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from switchfit.estimation.estimator import Estimate, Provenance
from switchfit.experiment_design import Design, DesignRecord
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.trajectory import Trajectory
from switchfit.io.logs import find_logs, name_files
from switchfit.io.problem_file import load_problem
from switchfit.io.problem_file.building import ProblemFile, digest_file
from switchfit.modes.result import ModeSearch
from switchfit.online.state import Now
from switchfit.problem.data import FloatArray
from switchfit.problem.dates import as_date
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.problem.validation import join_names, shorten
from switchfit.report import formats
from switchfit.report.frames import ERROR
from switchfit.report.sentences import write_reason, write_step
from switchfit.report.text import SCREEN
from switchfit.runtime.errors import InputError, import_library
from switchfit.runtime.frames import describe_frame
from switchfit.strategy.comparison import ModelComparison
from switchfit.strategy.validation import Validation
from switchfit.uncertainty.certificate import DerivativeCheck, Identifiability
from switchfit.uncertainty.residuals import measure_quality
from switchfit.uncertainty.verdict import Verdict

MOST_TIMES = 10_000_000


def choose_times(given: str, experiment: Experiment) -> FloatArray | Literal["samples"] | None:
    """Return the times that ``--times`` stands for, (K,): a step from t0 to tf, "samples", or None if it is left out.

    Parameters
    ----------
    given : str
    experiment : Experiment

    Raises
    ------
    InputError
        If it is neither, or the step makes no or too many times.
    """
    if given in ("", "samples"):
        return "samples" if given else None
    t0, tf = experiment.ends_of_modes(experiment.initial_times)[[0, -1]].tolist()
    step = np.nan
    with contextlib.suppress(ValueError):
        step = float(given)
    if not (0 < step < np.inf and (tf - t0) / step < MOST_TIMES):
        raise InputError(
            f"--times must be 'samples', or a positive step, such as 0.1, that makes at most {MOST_TIMES:,} times from "
            f"t0 = {t0:g} to tf = {tf:g}; got {given!r}."
        )
    count = int(np.floor((tf - t0) / step * (1 + 1e-12)))
    return np.minimum(t0 + step * np.arange(count + 1), tf)


EXAMPLE = '{"t": 0.1, "y": [1.2, 0.3]} or {"t": 0.1, "y": {"X": 1.2}, "u": {"force": 4.0}}'


def read_sample(line: bytes, run: Experiment) -> tuple[Any, Any, Any]:
    """Return t, y and u of a line, for `OnlineEstimator.update`; null is a missing value.

    Parameters
    ----------
    line : bytes
    run : Experiment
        If it has an origin, t may be a date.

    Raises
    ------
    ValueError
        If the line is no JSON object with t; what the values must be, the estimator checks.
    """
    try:
        given = json.loads(line)
    except (ValueError, RecursionError):
        given = None
    if not isinstance(given, dict) or "t" not in given or not set(given) <= {"t", "y", "u"}:
        got = shorten(line.decode(errors="replace").strip())
        raise ValueError(f"a sample is one line of JSON with the keys t, y and u, such as {EXAMPLE}; got {got}.")
    t, y, u = (given.get(key) for key in "tyu")
    if isinstance(t, str) and run.origin is not None:
        t = float(run.origin.to_numbers(as_date(t, "t"), run.time_unit, "t"))
    return t, _fill(y), u


def _fill(y: Any) -> Any:
    """Return values with NaN for null."""
    if isinstance(y, dict):
        return {name: np.nan if value is None else value for name, value in y.items()}
    return [np.nan if value is None else value for value in y] if isinstance(y, list) else y


KEYS = {
    "unknown": "name",
    "std_error": "standard_error",
    "naive_std_error": "naive_standard_error",
    "guess": "first_guess",
}
"""What columns of the table of unknowns are called in JSON, where it is another name."""


def summarize_estimate(estimate: Estimate) -> dict[str, Any]:
    """Return the verdict, the unknowns with their intervals, and how the fit went.

    Standard errors and 95 % intervals are those of the report, which allow for correlated residuals. A time that is a
    date has it in ISO 8601 beside the number, and so do the ends of its interval.

    Parameters
    ----------
    estimate : Estimate
    """
    return {
        **_summarize_verdict(estimate.verdict),
        "status": estimate.status.name,
        "converged": estimate.status.successful,
        **_pick(estimate, "message", "cost", "iterations", "evaluations", "seconds"),
        "engine": None if estimate.engine is None else asdict(estimate.engine),
        "strategies": [_pick(step, "strategy", "cost", "seconds") for step in estimate.steps],
        "unknowns": [{KEYS.get(name, name): cell for name, cell in row.items()} for row in list_unknowns(estimate)],
        "fixed": {name: estimate.parameters[name] for name in estimate.fixed},
        "runs": [
            {
                **summarize_run(run, trajectory),
                "channels": [
                    {"name": name, "samples": int(np.isfinite(c.measured[:, k]).sum()), "rmse": c.rmse[k]}
                    for c in comparisons
                    for k, name in enumerate(c.names)
                ],
            }
            for run, trajectory, comparisons in zip(
                estimate.run_names, estimate.trajectories, estimate.comparisons, strict=True
            )
        ],
    }


def _pick(result: object, *names: str) -> dict[str, Any]:
    """Return some attributes of a result by their names."""
    return {name: getattr(result, name) for name in names}


def _summarize_verdict(verdict: Verdict) -> dict[str, Any]:
    return {
        "verdict": verdict.level,
        "summary": str(verdict),
        "reasons": list(map(write_reason, verdict.reasons)),
        "next_steps": list(map(write_step, verdict.next_steps)),
    }


def summarize_run(name: str, trajectory: Trajectory) -> dict[str, Any]:
    """Return the modes of a run and the times of its jumps.

    Parameters
    ----------
    name : str
    trajectory : Trajectory
    """
    modes: list[dict[str, Any]] = [
        dict(zip(("mode", "begin", "end"), span, strict=True)) for span in trajectory.mode_spans
    ]
    found = {"name": name, "time_unit": trajectory.time_unit, "modes": modes, "jumps": trajectory.jump_times}
    if trajectory.origin is None:
        return found
    for span in modes:
        span |= {f"date_{end}": formats.format_iso(span[end], trajectory) or None for end in ("begin", "end")}
    dates = [formats.format_iso(time, trajectory) for time in trajectory.jump_times.tolist()]
    return found | {"origin": trajectory.origin.date, "jump_dates": dates}


def summarize_validation(found: Validation) -> dict[str, Any]:
    """Return how well the parameters of a fit predict another run; standard errors allow for correlated residuals.

    Parameters
    ----------
    found : Validation
    """
    refit = () if found.refit is None else found.refit.theta_names
    sources = ["fit" if name in found.kept else "run" if name in refit else "guess" for name in found.theta_names]
    columns = {
        "name": found.theta_names,
        "unit": found.problem.unknowns.units,
        "value": found.theta,
        "standard_error": found.corrected_standard_errors,
        "from": sources,
    }
    tests = dict(zip(found.residuals.labels, found.residuals.channels, strict=True))
    return {
        **_summarize_verdict(found.verdict),
        "converged": found.refit is None or found.refit.status.successful,
        "fit_percent": found.percent,
        "degrees_of_freedom": found.freedom,
        **_pick(found, "explained", "chi_square", "probability"),
        "unknowns": zip_rows(columns),
        "channels": [
            {"name": name, "fit_percent": percent, "whiteness": tests[name].whiteness if name in tests else None}
            for name, percent in found.channels.items()
        ],
        "inputs": [test._asdict() for test in found.inputs],
        "runs": [summarize_run(*named) for named in zip(found.run_names, found.trajectories, strict=True)],
    }


def summarize_comparison(found: ModelComparison) -> dict[str, Any]:
    """Return the table of models that were fitted to the same data, the one with the smallest BIC first.

    Parameters
    ----------
    found : ModelComparison
    """
    columns = {
        "name": found.names,
        "converged": [fit.status.successful for fit in found.estimates],
        "unknowns": found.unknown_counts,
        "weight": found.weights,
        **_pick(found, "log_likelihood", "aicc", "delta_aicc", "bic", "delta_bic"),
    }
    rows = sorted(zip_rows(columns), key=lambda row: float(row["bic"]))
    return {**_pick(found, "best", "values"), "models": rows}


SEQUENCE = ("switches", "sequences", "transition_times", "cost", "criterion", "bic", "mbic", "aicc")
"""What is said of each fit of a search."""


def summarize_modes(search: ModeSearch) -> dict[str, Any]:
    """Return the status of a search for the mode sequence, the best for each number of switches, and alternatives.

    Parameters
    ----------
    search : ModeSearch
    """
    return {
        "status": search.status.name,
        **_pick(search, "success", "message", "criterion", "modes", "fits", "evaluations", "seconds"),
        "warnings": list(map(str, search.warnings)),
        "runs": search.run_names,
        "by_switches": [_pick(fit, *SEQUENCE) for fit in search.fitted],
        "alternatives": [_pick(fit, *SEQUENCE, "weight") for fit in search.chosen],
        "best": None if search.best is None else summarize_estimate(search.best),
    }


def summarize_design(design: Design) -> dict[str, Any]:
    """Return an experiment design without its problems.

    Parameters
    ----------
    design : Design
    """
    return _pick(design, *(field.name for field in fields(DesignRecord)), "undetermined")


def summarize_now(now: Now, run: Experiment) -> dict[str, Any]:
    """Return what an online estimator says after a sample; where times are dates, also its date and that of the mode.

    Parameters
    ----------
    now : Now
    run : Experiment
    """
    found = {
        "t": now.time,
        **_pick(now, "mode", "since", "mode_sequence", "transition_times", "mode_probability"),
        **_pick(now, "parameters", "standard_errors", "statistic", "threshold"),
        "status": now.status.name,
        "alarm": None if now.alarm is None else now.alarm._asdict(),
        "retracted": None if now.retracted is None else now.retracted._asdict(),
        "seconds": now.seconds,
    }
    if run.origin is not None:
        found |= {"date": formats.format_iso(now.time, run), "since_date": formats.format_iso(now.since, run)}
    return found


def summarize_check(evaluator: Evaluator, derivatives: DerivativeCheck, found: Identifiability) -> dict[str, Any]:
    """Return the unknowns of a problem, and what was checked.

    Parameters
    ----------
    evaluator : Evaluator
    derivatives : DerivativeCheck
    found : Identifiability
    """
    problem, unknowns = evaluator.problem, evaluator.problem.unknowns
    columns = {"name": unknowns.names, "unit": unknowns.units, "first_guess": unknowns.initial}
    return {
        "unknowns": zip_rows(columns | _pick(unknowns, "lower", "upper")),
        "runs": problem.run_names,
        "steps": [mesh.cells for mesh in evaluator.meshes],
        "engine": asdict(evaluator.engine),
        "derivatives": {
            "orders": derivatives.observed_orders,
            **_pick(derivatives, "passed", "gradient_gap", "hessian_gap"),
        },
        "identifiability": {"without_effect": found.without, **_pick(found, "undetermined", "condition_number")},
    }


# --- tables -----------------------------------------------------------------------------------------------------------


def list_unknowns(estimate: Estimate) -> list[dict[str, Any]]:
    """Return a row for each unknown, with the columns of `Estimate.to_pandas`.

    Parameters
    ----------
    estimate : Estimate
    """
    frame = describe_frame(estimate)
    return zip_rows({each.name: each.values.tolist() for each in (*frame.index, *frame.columns)})


def zip_rows(columns: Mapping[str, Iterable[Any]]) -> list[dict[str, Any]]:
    """Return the rows of a table, each a dict, from its columns.

    Parameters
    ----------
    columns : mapping of str to iterable
        All of one length.
    """
    return [dict(zip(columns, entries, strict=True)) for entries in zip(*columns.values(), strict=True)]


def write_unknowns(estimate: Estimate) -> str:
    """Return a CSV table with a line for each unknown, with the columns of `Estimate.to_pandas`.

    Parameters
    ----------
    estimate : Estimate
    """
    return write_rows(list_unknowns(estimate))


def write_runs(estimate: Estimate) -> str:
    """Return a CSV table with a line for each run: modes, data, how well it fits, and what is wrong with it.

    Parameters
    ----------
    estimate : Estimate
    """
    quality = measure_quality(estimate)
    rows = []
    for e, (name, trajectory) in enumerate(zip(estimate.run_names, estimate.trajectories, strict=True)):
        here = [channel for channel in quality.channels if channel.experiment == e]
        row = {
            "run": name,
            "modes": " -> ".join(mode for mode, _, _ in trajectory.mode_spans),
            "t0": trajectory.times[0],
            "tf": trajectory.times[-1],
            "time unit": trajectory.time_unit,
            "values": sum(channel.count for channel in here),
            "chi2": sum(channel.chi_square for channel in here) if here else np.nan,
            "explained": min((c.explained for c in here if np.isfinite(c.explained)), default=np.nan),
        }
        if trajectory.origin is not None:
            row["origin"] = trajectory.origin.date
        rows.append(row)
    return write_rows(rows)


def write_trajectories(names: Sequence[str], runs: Sequence[Trajectory]) -> str:
    """Return trajectories as CSV: a row for each node or time, with the run, the mode and the states.

    Parameters
    ----------
    names : sequence of str
    runs : sequence of Trajectory

    Raises
    ------
    ValueError
        If they have times in different units.
    """
    units = {run.time_unit for run in runs}
    if len(units) > 1:
        raise ValueError(
            f"the experiments have times in different units ({', '.join(sorted(units))}), and one column of the "
            "CSV file would mix them: give each its own problem file."
        )
    (unit,) = units
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\r\n")
    dated = any(run.origin is not None for run in runs)
    columns = ["t" if unit == "s" else f"t ({unit})", *(["date"] if dated else [])]
    table.writerow(["experiment", *columns, "mode", *runs[0].state_names])
    for name, run in zip(names, runs, strict=True):
        dates = [""] * len(run.times) if run.dates is None else [date.isoformat() for date in run.dates]
        for t, date, mode, x in zip(run.times.tolist(), dates, run.modes, run.states.tolist(), strict=True):
            table.writerow([name, t, *([date] if dated else []), mode, *x])
    return text.getvalue()


def write_rows(rows: Sequence[Mapping[str, Any]], columns: Iterable[str] = ()) -> str:
    """Return CSV; numbers have the digits that it takes to read the same ones, and NaN is an empty cell.

    Parameters
    ----------
    rows : sequence of mapping
        Of each row its cells by columns, an empty one where a column is left out.
    columns : iterable of str, optional
        Left out, those of all rows as they come.
    """
    text = io.StringIO()
    table = csv.DictWriter(text, list(columns) or list_columns(rows), restval="", lineterminator="\r\n")
    table.writeheader()
    for row in rows:
        table.writerow({name: "" if isinstance(cell, float) and np.isnan(cell) else cell for name, cell in row.items()})
    return text.getvalue()


def list_columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the columns that any row has.

    Parameters
    ----------
    rows : sequence of mapping
    """
    return list(dict.fromkeys(name for row in rows for name in row))


def list_tables(estimate: Estimate) -> dict[str, str]:
    """Return the tables that a screen of the report has no room for, as CSV, by the names of their files.

    Parameters
    ----------
    estimate : Estimate
    """
    runs = {"runs": write_runs(estimate)} if len(estimate.run_names) > SCREEN["experiments"] else {}
    return runs | ({"unknowns": write_unknowns(estimate)} if len(estimate.theta) > SCREEN["unknowns"] else {})


def list_logs(paths: Sequence[Path]) -> list[tuple[str, Path]]:
    """Return (name, path) of all logs that paths, patterns and folders stand for.

    Parameters
    ----------
    paths : sequence of Path

    Raises
    ------
    InputError
        If a pattern matches nothing.
    """
    named = [log for path in paths for log in find_logs(Path(), str(path)) or [str(path)]]
    found = list(dict.fromkeys(named))
    return list(zip(name_files(found), map(Path, found), strict=True))


PARQUET = (".parquet", ".pq")
"""Endings of tables that are written as Parquet; all others are CSV."""


def check_table(path: Path) -> None:
    """Raise for a table that cannot be written, before any log is fitted.

    Parameters
    ----------
    path : Path

    Raises
    ------
    InputError
        If it is to be Parquet, and pyarrow is not installed.
    """
    if path.suffix.lower() in PARQUET:
        import_library(
            "pyarrow.parquet", str(path), "'switchfit[parquet]'", ", or give the table a name that ends in .csv"
        )


def describe_fit(log: str, estimate: Estimate | None, error: str) -> dict[str, Any]:
    """Return the row of a log: its estimate, or the error that kept it from being fitted.

    A column that does not apply to it is left out. The message is empty for a fit that is good or doubtful.

    Parameters
    ----------
    log : str
    estimate : Estimate or None
    error : str
    """
    if estimate is None:
        return {"log": log, "verdict": "refused", "message": error}
    message = "" if estimate.status.successful else estimate.message
    if not message and not estimate.success:
        message = write_reason(estimate.verdict.reasons[0])
    quality, trajectory = measure_quality(estimate), estimate.trajectories[0]
    row: dict[str, Any] = {
        "log": log,
        "verdict": estimate.verdict.level,
        "status": estimate.status.name,
        "cost": float(estimate.cost),
        "values": estimate.samples,
        "chi2": float(quality.chi_square),
        "degrees of freedom": estimate.freedom,
        "explained": float(quality.explained),
        "t0": float(trajectory.times[0]),
        "tf": float(trajectory.times[-1]),
        "time unit": trajectory.time_unit,
        "iterations": estimate.iterations,
        "seconds": float(estimate.seconds),
    }
    unknowns = list_unknowns(estimate)
    for unknown in unknowns:
        shown = formats.label_quantity(unknown["unknown"], unknown["unit"])
        row |= {shown: unknown["value"], ERROR.format(shown): unknown["std_error"]}
    row |= {f"{unknown['unknown']} (date)": unknown["date"] for unknown in unknowns if unknown.get("date")}
    return {**row, "message": message}


def describe_row(row: Mapping[str, Any]) -> str:
    """Return the row of a log as one line of text: verdict and numbers, or the error.

    Parameters
    ----------
    row : mapping
    """
    numbers = []
    for name in (name for name in row if ERROR.format(name) in row):
        value, error, _ = formats.format_rounded(row[name], row[ERROR.format(name)])
        numbers.append(f"{name} = {value} {error}".rstrip())
    return ". ".join(filter(None, [f"{row['log']}: {row['verdict']}", ", ".join(numbers), row["message"]]))


def write_logs(rows: Sequence[Mapping[str, Any]], path: Path) -> str | bytes:
    """Return the content of the table of logs, with the columns that any of them has.

    Parameters
    ----------
    rows : sequence of mapping
    path : Path
        Its ending says whether it is Parquet or CSV.
    """
    columns = sorted(list_columns(rows), key=lambda name: name == "message")  # which comes last
    if path.suffix.lower() not in PARQUET:
        return write_rows(rows, columns)
    import pyarrow.parquet

    table, file = pyarrow.table({name: [row.get(name) for row in rows] for name in columns}), io.BytesIO()
    pyarrow.parquet.write_table(table, file)
    return file.getvalue()


# --- saved estimates, whose problem is built again from what they were made from --------------------------------------


def rebuild_problem(
    path: Path, given: Provenance | None, folder: Path | None = None, log: Path | None = None
) -> ProblemFile:
    """Return the problem of a saved estimate, built from the text that was saved with it.

    Parameters
    ----------
    path : Path
        Of the saved estimate.
    given : Provenance or None
        Of the saved estimate.
    folder : Path, optional
        Where the files are; left out, where the problem file was, seen from the folder of the saved estimate.
    log : Path, optional
        A log in place of that which was fitted.

    Raises
    ------
    InputError
        If the problem cannot be built again, or a file is missing or wrong.
    """
    if given is None:
        raise InputError(f"{path} does not say what it was made from: fit its problem file again.")
    if not given.problem_file:
        raise InputError(
            f"{path} does not have its problem, which was built in Python: functions are not saved, only hashes of the "
            "data. Validate and compare in the script that fitted it: estimate.validate(...), sf.compare([...]). "
            "switchfit fit PROBLEM.toml --out DIR saves what is needed."
        )
    where = Path(given.folder) if folder is None else folder
    own = where / given.log if given.log else None
    try:
        return load_problem(where / given.problem_file, own if log is None else log, text=given.text)
    except InputError as error:
        needed = [digest for digest in given.files if log is None or digest.name.endswith(".py")]
        changed = [each.name for each in needed if digest_file(where, where / each.name).sha256 != each.sha256]
        if not changed:
            raise
        raise InputError(
            f"{path} cannot be built again, since {join_names(changed)} in {where} is missing or has changed: {error} "
            "Put the files as they were into a folder, and name it with --folder; or fit again."
        ) from error


def load_other_run(path: Path, given: Provenance | None, other: Path, folder: Path | None) -> ProblemFile:
    """Return the problem of another run: that of a problem file, or that of the saved estimate with another log.

    Parameters
    ----------
    path : Path
        Of the saved estimate.
    given : Provenance or None
        Of the saved estimate.
    other : Path
        A problem file, whose name ends in .toml, or a log.
    folder : Path or None
        As in `rebuild_problem`.
    """
    if other.suffix.lower() == ".toml":
        return load_problem(other)
    return rebuild_problem(path, given, folder, other)


def load_with_problem(path: Path, folder: Path | None = None) -> tuple[Estimate, list[str]]:
    """Return a saved estimate with its problem, and the files of the model that have changed, a line for each.

    Parameters
    ----------
    path : Path
        Of the saved estimate.
    folder : Path, optional
        As in `rebuild_problem`.

    Raises
    ------
    InputError
        If the problem cannot be built again, or its data are no longer those that were fitted.
    """
    given = Estimate.load(path).provenance
    loaded = rebuild_problem(path, given, folder)
    estimate = Estimate.load(path, problem=loaded.problem)
    if not _has_data(estimate, loaded.problem):
        raise InputError(
            f"{path} was fitted to other values than the files in {loaded.path.parent} have now: fit them again."
        )
    return estimate, list_changed_models(given, loaded)


def _has_data(estimate: Estimate, problem: Problem) -> bool:
    """Return whether the measurements of a problem are those that an estimate was fitted to."""
    fitted = [each for run in estimate.comparisons for each in run if each.kind == "measurements"]
    return len(problem.measurements) == len(fitted) and all(
        np.array_equal(item.times, each.times) and np.array_equal(item.values, each.measured, equal_nan=True)
        for item, each in zip(problem.measurements, fitted, strict=True)
    )


def list_changed_models(given: Provenance | None, loaded: ProblemFile) -> list[str]:
    """Return the Python files that are not as they were when a fit was saved, a line for each.

    Parameters
    ----------
    given : Provenance or None
        Of the saved fit.
    loaded : ProblemFile
        The problem that was built again.
    """
    if given is None:
        return []
    before, now = (
        {digest.name: digest.sha256 for digest in each.files if digest.name.endswith(".py")}
        for each in (given, loaded.provenance)
    )

    def describe(name: str) -> str:
        return "is new" if name not in before else "has changed" if name in now else "is no longer there"

    return [f"{name} {describe(name)}" for name in {**before, **now} if before.get(name) != now.get(name)]
