"""Results as values that JSON can hold: what ``switchfit --json`` prints."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.trajectory import Trajectory
from switchfit.modes.result import ModeFit, ModeSearch
from switchfit.problem.experiment import name_runs
from switchfit.report.dates import add_dates, format_iso, list_dated
from switchfit.report.verdict import write_reason, write_step
from switchfit.strategy.comparison import ModelComparison
from switchfit.strategy.validation import Validation
from switchfit.uncertainty.derivative_check import DerivativeCheck
from switchfit.uncertainty.identification import Identifiability
from switchfit.uncertainty.residuals import correct_errors, correct_intervals


def summarize_estimate(estimate: Estimate) -> dict[str, Any]:
    """Return the verdict, the unknowns with their intervals, and how the fit went.

    Standard errors and 95 % intervals are those of the report, which allow for correlated residuals. A time that is a
    date has it in ISO 8601 beside the number, and so do the ends of its interval.

    Parameters
    ----------
    estimate : Estimate
    """
    errors, intervals = correct_errors(estimate), correct_intervals(estimate)
    dated = list_dated(estimate)
    held: dict[str, str] = {c.unknown: c.kind for c in estimate.active if c.unknown}
    held |= dict.fromkeys((*estimate.unread, *estimate.absent), "not read")
    held |= dict.fromkeys(estimate.idle, "idle") | {kink.unknown: "kink" for kink in estimate.kinks}
    unknowns = [
        {
            "name": name,
            "unit": estimate.theta_units[i],
            "value": estimate.theta[i],
            "standard_error": errors[i],
            "low": intervals[i][0],
            "high": intervals[i][1],
            "first_guess": estimate.initial_theta[i],
            "held": held.get(name),
            **_list_dates({"": estimate.theta[i], "_low": intervals[i][0], "_high": intervals[i][1]}, dated[i]),
        }
        for i, name in enumerate(estimate.theta_names)
    ]
    verdict = estimate.verdict
    return {
        "verdict": verdict.level,
        "summary": str(verdict),
        "reasons": [write_reason(reason) for reason in verdict.reasons],
        "next_steps": [write_step(step) for step in verdict.next_steps],
        "status": estimate.status.name,
        "converged": estimate.status.successful,
        "message": add_dates(estimate.message, estimate),
        "cost": estimate.cost,
        "iterations": estimate.iterations,
        "evaluations": estimate.evaluations,
        "seconds": estimate.seconds,
        "engine": None if estimate.engine is None else asdict(estimate.engine),
        "strategies": [{"strategy": s.strategy, "cost": s.cost, "seconds": s.seconds} for s in estimate.steps],
        "unknowns": unknowns,
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
    states = {state: trajectory.states[:, k] for k, state in enumerate(trajectory.state_names)}
    units = dict(zip(trajectory.state_names, trajectory.state_units, strict=True))
    return {
        "name": name,
        "time_unit": trajectory.time_unit,
        "times": trajectory.times,
        "modes": trajectory.modes,
        "states": states,
        "units": units,
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
    percents, tests = found.channels, dict(zip(found.residuals.labels, found.residuals.channels, strict=True))
    return {
        "verdict": found.verdict.level,
        "summary": str(found.verdict),
        "reasons": [write_reason(reason) for reason in found.verdict.reasons],
        "next_steps": [write_step(step) for step in found.verdict.next_steps],
        "converged": found.refit is None or found.refit.status.successful,
        "fit_percent": found.percent,
        "explained": found.explained,
        "chi_square": found.chi_square,
        "degrees_of_freedom": found.freedom,
        "probability": found.probability,
        "unknowns": [
            dict(zip(("name", "unit", "value", "standard_error", "from"), entry, strict=True)) for entry in numbers
        ],
        "channels": [
            {
                "name": name,
                "fit_percent": percent,
                "whiteness": tests[name].whiteness if name in tests else None,
            }
            for name, percent in percents.items()
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
    left_out = (
        [
            {"score": score, "fit_percent": percent}
            for score, percent in zip(found.held_out.sum(axis=1), found.held_out_percent.mean(axis=1), strict=True)
        ]
        if found.folds
        else [None] * len(found.names)
    )
    rows = [
        {
            "name": name,
            "converged": fit.status.successful,
            "unknowns": found.unknown_counts[k],
            "log_likelihood": found.log_likelihood[k],
            "aicc": found.aicc[k],
            "delta_aicc": found.delta_aicc[k],
            "weight": found.weights[k],
            "bic": found.bic[k],
            "delta_bic": found.delta_bic[k],
            "runs_left_out": left_out[k],
        }
        for k, (name, fit) in enumerate(zip(found.names, found.estimates, strict=True))
    ]
    return {
        "best": found.best,
        "values": found.values,
        "models": sorted(rows, key=lambda row: float(row["bic"])),
        "nested": [pair._asdict() for pair in found.nested],
        "folds": found.folds,
    }


def summarize_modes(search: ModeSearch) -> dict[str, Any]:
    """Return the status of a search for the mode sequence, the best for each number of switches, and alternatives.

    Parameters
    ----------
    search : ModeSearch
    """
    return {
        "status": search.status.name,
        "success": search.success,
        "message": search.message,
        "warnings": [str(warning) for warning in search.warnings],
        "criterion": search.criterion,
        "modes": search.modes,
        "runs": search.run_names,
        "by_switches": [_summarize_sequence(fit) for fit in search.fitted],
        "alternatives": [_summarize_sequence(fit) | {"weight": fit.weight} for fit in search.chosen],
        "fits": search.fits,
        "evaluations": search.evaluations,
        "seconds": search.seconds,
        "best": None if search.best is None else summarize_estimate(search.best),
    }


def _summarize_sequence(fit: ModeFit) -> dict[str, Any]:
    names = ("switches", "sequences", "transition_times", "cost", "criterion", "bic", "mbic", "aicc")
    return {name: getattr(fit, name) for name in names}


def summarize_check(evaluator: Evaluator, derivatives: DerivativeCheck, found: Identifiability) -> dict[str, Any]:
    """Return the unknowns of a problem, the steps of the integrator, and what was checked.

    Parameters
    ----------
    evaluator : Evaluator
    derivatives : DerivativeCheck
    found : Identifiability
    """
    problem = evaluator.problem
    names, structures = name_runs(problem.experiments), evaluator.structures
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
            "passed": derivatives.passed,
            "orders": derivatives.observed_orders,
            "gradient_gap": derivatives.gradient_gap,
            "hessian_gap": derivatives.hessian_gap,
        },
        "identifiability": {
            "undetermined": found.undetermined,
            "condition_number": found.condition_number,
            "without_effect": found.without,
        },
    }
