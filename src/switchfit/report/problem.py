"""A problem before its fit, as text: experiments, data, unknowns with first guesses, integrator steps."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.data import Data
from switchfit.problem.experiment import Experiment
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.validation.messages import unit_suffix
from switchfit.report import numbers as numbers_module
from switchfit.report import times as times_module
from switchfit.report.selection import SCREEN
from switchfit.report.tables import format_table
from switchfit.report.times import format_time
from switchfit.runtime.presentation import format_text


@format_text.register(Problem)
def write_problem(problem: Problem, *, full: bool = False) -> str:
    """Return experiments, data and unknowns of a problem.

    Parameters
    ----------
    problem : Problem
    full : bool
        All of them, not one screen.
    """
    unknowns, rows = problem.unknowns, []
    numbers = (unknowns.initial, unknowns.lower, unknowns.upper)
    columns = (unknowns.names, unknowns.units, *numbers, unknowns.priors.texts(), unknowns.log)
    dated = times_module.list_dated(problem)
    for run, (name, unit, value, lower, upper, prior, log) in zip(dated, zip(*columns, strict=True), strict=True):
        first, least, most = (format_time(number, run) for number in (value, lower, upper))
        bounds = "" if np.isinf(lower) and np.isinf(upper) else f"in [{least}, {most}]"
        known, scale = f"prior: {prior}" if prior else "", "(log scale)" if log else ""
        rows.append((name, f"{first}{'' if run else unit_suffix(unit)}", bounds, known, scale))
    lines = format_table(rows, "<<<<<", most=sys.maxsize if full else SCREEN["unknowns"])
    experiments = write_experiments(problem.experiments, full=full)
    return "\n".join([experiments, "Unknowns, first guess and bounds", *lines])


def write_experiments(experiments: Sequence[Experiment], *, full: bool = False) -> str:
    """Return modes, horizon and data of experiments.

    Parameters
    ----------
    experiments : sequence of Experiment
    full : bool
        All of them, not one screen.
    """
    shown = experiments if full else experiments[: SCREEN["experiments"]]
    lines = []
    for k, experiment in enumerate(shown, start=1):
        lines.append(f"Experiment {k}{f' ({experiment.name})' if experiment.name else ''}")
        lines += [f"  {line}" for line in _describe_experiment(experiment)]
    if left := len(experiments) - len(shown):
        lines.append(f"and {left} more experiments: --full lists them")
    return "\n".join(lines)


def _describe_experiment(experiment: Experiment) -> list[str]:
    unit = times_module.suffix_time(experiment)
    # Also where the times are unknown: at the first guess.
    ends = experiment.ends_of_modes(experiment.initial_times)
    start, *times, end = (format_time(time, experiment) for time in ends)
    sequence = f"{' -> '.join(experiment.mode_sequence)} on [{start}, {end}]{unit}"
    if experiment.has_free_tf:
        sequence += " (tf is estimated)"
    if experiment.taken_from_data:
        sequence += f" ({' and '.join(experiment.taken_from_data)} from the data)"
    lines = [f"{sequence}, at {', '.join(times)}{unit}" if times else sequence]
    lines.append(times_module.list_jumps(experiment.jump_times, experiment))
    lines += [f"times in {text}"] if (text := times_module.describe_origin(experiment)) else []
    lines += [_describe_data(item, experiment) for item in experiment.data]
    return [line for line in lines if line]


def _describe_data(item: Data, experiment: Experiment) -> str:
    """Return the channels of data, their span and number, and what is known of the sensor."""
    if isinstance(item, ReferenceSignal):
        knots, names = item.signal.knots, _join_channel_names(item.names, item.units, item.signal.channels)
        span = times_module.format_span(knots[0], knots[-1], experiment)
        return f"reference signal of {names}, {span}, {len(knots)} knots"
    if not isinstance(item, Measurements):
        return type(item).__name__
    unit = unit_suffix(experiment.time_unit)
    # The usual distance: logs with gaps have another mean.
    step = np.median(np.diff(item.times)) if len(item.times) > 1 else np.nan
    named = sorted({name for name in item.sigma_names if name})
    said = [
        f"{len(item.times)} samples of {_join_channel_names(item.names, item.units, item.values.shape[1])}",
        times_module.format_span(item.times[0], item.times[-1], experiment),
        f"typically {step:.4g}{unit} apart",
        f"{item.values.size - item.count} values missing",
        f"late by {item.delay}{'' if isinstance(item.delay, str) else unit}" if item.delay else "",
        "noise unknown" if item.sigma is None else "",
        f"sigma: {', '.join(named)}" if named else "",
        f"loss {item.loss} ({item.loss_scale:g} sigma)" if item.loss != "linear" else "",
    ]
    return ", ".join(filter(None, said))


def _join_channel_names(names: Sequence[str] | None, units: Sequence[str] | None, channels: int) -> str:
    """Return names with their units, or the number of channels where they have no names."""
    if names is None:
        return f"{channels} channels"
    return ", ".join(map(numbers_module.label_quantity, names, units or ("",) * channels))


def write_steps(evaluator: Evaluator, *, full: bool = False) -> str:
    """Return which steps the integrator takes in each experiment at the first guess, how many, and why.

    Parameters
    ----------
    evaluator : Evaluator
    full : bool
        For all of them, not one screen.
    """
    rows, names = [], evaluator.problem.run_names
    for name, structure, mesh in zip(names, evaluator.structures, evaluator.meshes, strict=True):
        # Modes that are stiff get implicit steps; if all are, or none, one word is enough.
        implicit = " and ".join(map(repr, structure.list_implicit_modes()))
        kind = "implicit steps" if structure.has_one_method else f"steps, implicit ones in {implicit}, else explicit"
        kind = kind if implicit else "explicit steps"
        rows.append(("; ".join([f"{mesh.cells:,} {kind}", *map(str, mesh.stiffness)]), name if len(names) > 1 else ""))
    lines = format_table(rows, "<<", most=sys.maxsize if full else SCREEN["experiments"])
    return "\n".join(["Integration at the first guess", *lines])
