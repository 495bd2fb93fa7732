"""Results as the JSON that commands print with --json."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any

import numpy as np

from switchfit.cli.tables import list_unknowns, zip_rows
from switchfit.estimation.comparison import ModelComparison
from switchfit.estimation.estimates import Estimate
from switchfit.experiment_design.result import Design, DesignRecord
from switchfit.fit.trajectory import Trajectory
from switchfit.meshes.evaluator import Evaluator
from switchfit.modes.result import ModeSearch
from switchfit.report import times
from switchfit.report.verdict import write_reason, write_step
from switchfit.strategy.validation import Validation
from switchfit.uncertainty.derivative_check import DerivativeCheck
from switchfit.uncertainty.identification import Identifiability
from switchfit.uncertainty.verdict import Verdict

KEYS = {
    "unknown": "name",
    "std_error": "standard_error",
    "naive_std_error": "naive_standard_error",
    "guess": "first_guess",
}
"""What columns of the table of unknowns are called in JSON, where it is another name."""

MODE_FIT_KEYS = ("switches", "sequences", "transition_times", "cost", "criterion", "bic", "mbic", "aicc")
"""What is said of each fit of a search."""


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
        **pick_attributes(estimate, "message", "cost", "iterations", "evaluations", "seconds"),
        "engine": None if estimate.engine is None else asdict(estimate.engine),
        "strategies": [pick_attributes(step, "strategy", "cost", "seconds") for step in estimate.steps],
        "unknowns": [{KEYS.get(name, name): cell for name, cell in row.items()} for row in list_unknowns(estimate)],
        "fixed": {name: estimate.parameters[name] for name in estimate.fixed},
        "runs": [
            {
                **_summarize_run(run, trajectory),
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


def pick_attributes(result: object, *names: str) -> dict[str, Any]:
    """Return some attributes of a result by their names."""
    return {name: getattr(result, name) for name in names}


def _summarize_verdict(verdict: Verdict) -> dict[str, Any]:
    return {
        "verdict": verdict.level,
        "summary": str(verdict),
        "reasons": list(map(write_reason, verdict.reasons)),
        "next_steps": list(map(write_step, verdict.next_steps)),
    }


def _summarize_run(name: str, trajectory: Trajectory) -> dict[str, Any]:
    """Return the modes of a run and the times of its jumps."""
    modes: list[dict[str, Any]] = [
        dict(zip(("mode", "begin", "end"), span, strict=True)) for span in trajectory.mode_spans
    ]
    found = {"name": name, "time_unit": trajectory.time_unit, "modes": modes, "jumps": trajectory.jump_times}
    if trajectory.origin is None:
        return found
    for span in modes:
        span |= {f"date_{end}": times.format_iso(span[end], trajectory) or None for end in ("begin", "end")}
    dates = [times.format_iso(time, trajectory) for time in trajectory.jump_times.tolist()]
    return found | {"origin": trajectory.origin.date, "jump_dates": dates}


def summarize_validation(found: Validation) -> dict[str, Any]:
    """Return how well the parameters of a fit predict another run; standard errors allow for correlated residuals.

    Parameters
    ----------
    found : Validation
    """
    refit = () if found.refit is None else found.refit.theta_names
    # From where a value comes: kept from the fit, estimated from this run, or a guess that nothing determines.
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
        **pick_attributes(found, "explained", "chi_square", "probability"),
        "unknowns": zip_rows(columns),
        "channels": [
            {"name": name, "fit_percent": percent, "whiteness": tests[name].whiteness if name in tests else None}
            for name, percent in found.channels.items()
        ],
        "inputs": [test._asdict() for test in found.inputs],
        "runs": [_summarize_run(*named) for named in zip(found.run_names, found.trajectories, strict=True)],
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
        **pick_attributes(found, "log_likelihood", "aicc", "delta_aicc", "bic", "delta_bic"),
    }
    # The columns of a comparison are in the order in which the models were given.
    rows = sorted(zip_rows(columns), key=lambda row: float(row["bic"]))
    return {**pick_attributes(found, "best", "values"), "models": rows}


def summarize_modes(search: ModeSearch) -> dict[str, Any]:
    """Return the status of a search for the mode sequence, the best for each number of switches, and alternatives.

    Parameters
    ----------
    search : ModeSearch
    """
    return {
        "status": search.status.name,
        **pick_attributes(search, "success", "message", "criterion", "modes", "fits", "evaluations", "seconds"),
        "warnings": list(map(str, search.warnings)),
        "runs": search.run_names,
        "by_switches": [pick_attributes(fit, *MODE_FIT_KEYS) for fit in search.fitted],
        "alternatives": [pick_attributes(fit, *MODE_FIT_KEYS, "weight") for fit in search.chosen],
        "best": None if search.best is None else summarize_estimate(search.best),
    }


def summarize_design(design: Design) -> dict[str, Any]:
    """Return an experiment design without its problems.

    Parameters
    ----------
    design : Design
    """
    return pick_attributes(design, *(field.name for field in fields(DesignRecord)), "undetermined")


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
        "unknowns": zip_rows(columns | pick_attributes(unknowns, "lower", "upper")),
        "runs": problem.run_names,
        "steps": [mesh.cells for mesh in evaluator.meshes],
        "engine": asdict(evaluator.engine),
        "derivatives": {
            "orders": derivatives.observed_orders,
            **pick_attributes(derivatives, "passed", "gradient_gap", "hessian_gap"),
        },
        "identifiability": {
            "without_effect": found.without,
            **pick_attributes(found, "undetermined", "condition_number"),
        },
    }
