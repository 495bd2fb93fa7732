"""Results as values that JSON can hold: what ``switchfit --json`` prints."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.experiment_design.result import Design, DesignRecord
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.trajectory import Trajectory
from switchfit.io.result_tables import list_unknowns
from switchfit.modes.result import ModeSearch
from switchfit.online.state import Now
from switchfit.problem.experiment import Experiment
from switchfit.report.dates import add_dates, format_iso
from switchfit.report.verdict import write_reason, write_step
from switchfit.strategy.comparison import ModelComparison
from switchfit.strategy.validation import Validation
from switchfit.uncertainty.derivative_check import DerivativeCheck
from switchfit.uncertainty.identification import Identifiability
from switchfit.uncertainty.verdict import Verdict


def summarize_estimate(estimate: Estimate) -> dict[str, Any]:
    """Return the verdict, the unknowns with their intervals, and how the fit went.

    Standard errors and 95 % intervals are those of the report, which allow for correlated residuals. A time that is a
    date has it in ISO 8601 beside the number, and so do the ends of its interval.

    Parameters
    ----------
    estimate : Estimate
    """
    held: dict[str, str] = {c.unknown: c.kind for c in estimate.active if c.unknown}
    held |= dict.fromkeys((*estimate.unread, *estimate.absent), "not read")
    held |= dict.fromkeys(estimate.idle, "idle") | {kink.unknown: "kink" for kink in estimate.kinks}
    return {
        **_summarize_verdict(estimate.verdict),
        "status": estimate.status.name,
        "converged": estimate.status.successful,
        "message": add_dates(estimate.message, estimate),
        **_pick(estimate, "cost", "iterations", "evaluations", "seconds"),
        "engine": None if estimate.engine is None else asdict(estimate.engine),
        "strategies": [_pick(step, "strategy", "cost", "seconds") for step in estimate.steps],
        "unknowns": [row | {"held": held.get(row["name"])} for row in list_unknowns(estimate)],
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
    run = trajectory if trajectory.origin is not None else None
    return {
        "name": name,
        "time_unit": trajectory.time_unit,
        **({} if run is None or run.origin is None else {"origin": run.origin.date}),
        "modes": [
            {"mode": mode, "begin": begin, "end": end, **_list_dates({"_begin": begin, "_end": end}, run)}
            for mode, begin, end in trajectory.mode_spans
        ],
        "jumps": trajectory.jump_times,
        **({} if run is None else {"jump_dates": [format_iso(time, run) for time in trajectory.jump_times.tolist()]}),
    }


def _list_dates(times: dict[str, float], run: Trajectory | None) -> dict[str, str | None]:
    """Return times as dates under the key "date" with a suffix each; {} where they are no dates."""
    return {} if run is None else {f"date{suffix}": format_iso(time, run) or None for suffix, time in times.items()}


def tabulate_trajectory(name: str, trajectory: Trajectory) -> dict[str, Any]:
    """Return all nodes of a trajectory.

    Parameters
    ----------
    name : str
    trajectory : Trajectory
    """
    names = trajectory.state_names
    return {
        "name": name,
        **_pick(trajectory, "time_unit", "times", "modes"),
        "states": dict(zip(names, trajectory.states.T, strict=True)),
        "units": dict(zip(names, trajectory.state_units, strict=True)),
    }


def summarize_validation(found: Validation) -> dict[str, Any]:
    """Return how well the parameters of a fit predict another run; standard errors allow for correlated residuals.

    Parameters
    ----------
    found : Validation
    """
    refit = () if found.refit is None else found.refit.theta_names
    sources = ["fit" if name in found.kept else "run" if name in refit else "guess" for name in found.theta_names]
    numbers = zip(
        found.theta_names,
        found.problem.unknowns.units,
        found.theta,
        found.corrected_standard_errors,
        sources,
        strict=True,
    )
    tests = dict(zip(found.residuals.labels, found.residuals.channels, strict=True))
    return {
        **_summarize_verdict(found.verdict),
        "converged": found.refit is None or found.refit.status.successful,
        "fit_percent": found.percent,
        "degrees_of_freedom": found.freedom,
        **_pick(found, "explained", "chi_square", "probability"),
        "unknowns": [
            dict(zip(("name", "unit", "value", "standard_error", "from"), entry, strict=True)) for entry in numbers
        ],
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
    rows = [dict(zip(columns, entries, strict=True)) for entries in zip(*columns.values(), strict=True)]
    return {**_pick(found, "best", "values"), "models": sorted(rows, key=lambda row: float(row["bic"]))}


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
    dates = {} if run.origin is None else {"date": format_iso(now.time, run), "since_date": format_iso(now.since, run)}
    return {
        "t": now.time,
        **_pick(now, "mode", "since", "mode_sequence", "transition_times", "mode_probability"),
        **_pick(now, "parameters", "standard_errors", "statistic", "threshold"),
        "status": now.status.name,
        "alarm": None if now.alarm is None else now.alarm._asdict(),
        "retracted": None if now.retracted is None else now.retracted._asdict(),
        "seconds": now.seconds,
        **dates,
    }


def summarize_check(evaluator: Evaluator, derivatives: DerivativeCheck, found: Identifiability) -> dict[str, Any]:
    """Return the unknowns of a problem, the steps of the integrator, and what was checked.

    Parameters
    ----------
    evaluator : Evaluator
    derivatives : DerivativeCheck
    found : Identifiability
    """
    problem = evaluator.problem
    names, structures = problem.run_names, evaluator.structures
    runs = zip(names, problem.experiments, evaluator.meshes, structures, strict=True)
    unknowns = problem.unknowns
    numbers = zip(unknowns.names, unknowns.units, unknowns.initial, unknowns.lower, unknowns.upper, strict=True)
    names = ("name", "unit", "first_guess", "lower", "upper")
    return {
        "unknowns": [dict(zip(names, entry, strict=True)) for entry in numbers],
        "runs": [
            {
                "name": name,
                "modes": list(run.mode_sequence),
                "implicit_modes": structure.list_implicit_modes(),
                "t0": run.t0,
                "tf": run.end,
                "steps": mesh.cells,
            }
            for name, run, mesh, structure in runs
        ],
        "engine": asdict(evaluator.engine),
        "derivatives": {
            "orders": derivatives.observed_orders,
            **_pick(derivatives, "passed", "gradient_gap", "hessian_gap"),
        },
        "identifiability": {
            "without_effect": found.without,
            **_pick(found, "undetermined", "condition_number"),
        },
    }
