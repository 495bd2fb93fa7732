"""Summary of a problem for `switchfit check`: its data and its unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from switchfit.fit.evaluator import evaluator_of
from switchfit.problem.data import Measurements, ReferenceSignal
from switchfit.problem.experiment import Experiment
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.report.dates import describe_origin, format_time, format_unknown, list_dated_unknowns
from switchfit.report.tables import format_table, list_jumps

MOST_EXPERIMENTS = 3
"""Experiments that are described on one screen."""

MOST_UNKNOWNS = 10


def describe(problem: Problem, *, full: bool = False) -> str:
    """Return experiments, data and unknowns of a problem as text.

    Parameters
    ----------
    problem : Problem
    full : bool
        All of them, not one screen.
    """
    lines = [describe_experiments(problem.experiments, full=full)]
    unknowns = problem.unknowns
    rows = []
    numbers = (unknowns.initial, unknowns.lower, unknowns.upper)
    columns = (unknowns.names, unknowns.units, *numbers, unknowns.priors.texts(), unknowns.log)
    dated = list_dated_unknowns(problem)
    for run, (name, unit, value, lower, upper, prior, log) in zip(dated, zip(*columns, strict=True), strict=True):
        ends = [format_unknown(end, run) for end in (lower, upper)]
        bounds = "" if np.isinf(lower) and np.isinf(upper) else f"in [{ends[0]}, {ends[1]}]"
        known, scale = f"prior: {prior}" if prior else "", "(log scale)" if log else ""
        rows.append((name, f"{format_unknown(value, run)}{'' if run else unit_suffix(unit)}", bounds, known, scale))
    if not full and len(rows) > MOST_UNKNOWNS:
        kept = MOST_UNKNOWNS - 2
        rows = [*rows[:kept], (f"and {len(rows) - kept} more", "", "", "", "")]
    return "\n".join([*lines, "Unknowns, first guess and bounds", *format_table(rows, "<<<<<")])


def describe_experiments(experiments: Sequence[Experiment], *, full: bool = False) -> str:
    """Return modes, horizon and data of experiments as text.

    Parameters
    ----------
    experiments : sequence of Experiment
    full : bool
        All of them, not one screen.
    """
    lines = []
    for k, experiment in enumerate(experiments, start=1):
        lines.append(f"Experiment {k}{f' ({experiment.name})' if experiment.name else ''}")
        lines += [f"  {line}" for line in _describe_experiment(experiment)]
        if not full and k == MOST_EXPERIMENTS < len(experiments):
            lines.append(f"and {len(experiments) - k} more experiments: --full lists them")
            break
    return "\n".join(lines)


def describe_steps(problem: Problem, *, full: bool = False) -> str:
    """Return which steps the integrator takes in each experiment at the first guess, how many, and why, as text.

    Parameters
    ----------
    problem : Problem
    full : bool
        For all of them, not one screen.

    Raises
    ------
    ValueError
        If the model cannot be integrated at the guess.
    """
    evaluator = evaluator_of(problem)
    rows = []
    given = zip(problem.run_names, evaluator.structures, evaluator.meshes, strict=True)
    for name, structure, mesh in given:
        run = "" if len(problem.experiments) == 1 else f"{name}: "
        rows.append(f"  {run}{mesh.cells:,} {_describe_method(structure)}{''.join(f'; {s}' for s in mesh.stiffness)}")
    if not full and len(rows) > MOST_EXPERIMENTS:
        total = sum(mesh.cells for mesh in evaluator.meshes)
        rows = [*rows[:MOST_EXPERIMENTS], f"  {total:,} steps in all {len(rows)} experiments"]
    return "\n".join(["Integration at the first guess", *rows])


def _describe_method(structure: Structure) -> str:
    """Return the kind of steps that the modes take, with the names of the implicit ones if they are not all."""
    implicit = structure.list_implicit_modes()
    if not implicit:
        return "explicit steps"
    if structure.has_one_method:
        return "implicit steps"
    return f"steps, implicit ones in {' and '.join(map(repr, implicit))}, else explicit"


def _describe_experiment(experiment: Experiment) -> list[str]:
    step_unit = unit_suffix(experiment.time_unit)
    unit = step_unit if experiment.origin is None else ""
    ends = experiment.ends_of_modes(experiment.initial_times)
    show = partial(format_time, run=experiment)
    times = ", ".join(map(show, ends[1:-1]))
    sequence, horizon = " -> ".join(experiment.mode_sequence), f"[{show(ends[0])}, {show(ends[-1])}]{unit}"
    if experiment.has_free_tf:
        horizon += " (tf is estimated)"
    if experiment.taken_from_data:
        horizon += f" ({' and '.join(experiment.taken_from_data)} from the data)"
    lines = [f"{sequence} on {horizon}, at {times}{unit}" if times else f"{sequence} on {horizon}"]
    jumps = list_jumps(experiment.jump_times, experiment)
    lines += [jumps] if jumps else []
    lines += [f"times in {text}"] if (text := describe_origin(experiment)) else []
    for item in experiment.data:
        if isinstance(item, Measurements):
            step = np.median(np.diff(item.times)) if len(item.times) > 1 else np.nan
            missing = item.values.size - item.count
            lines.append(
                f"{len(item.times)} samples of {_join_channel_names(item.names, item.units, item.values.shape[1])}, "
                f"{show(item.times[0])} to {show(item.times[-1])}{unit}, typically {step:.4g}{step_unit} apart, "
                f"{missing} values missing{_describe_sensor(item, step_unit)}"
            )
        elif isinstance(item, ReferenceSignal):
            knots = item.signal.knots
            names = _join_channel_names(item.names, item.units, item.signal.channels)
            lines.append(
                f"reference signal of {names}, {show(knots[0])} to {show(knots[-1])}{unit}, {len(knots)} knots"
            )
        else:
            lines.append(type(item).__name__)
    return lines


def _describe_sensor(item: Measurements, unit: str) -> str:
    """Return a description of delay, noise and loss, empty for a sensor without these."""
    named = sorted({name for name in item.sigma_names if name})
    said = [
        f"late by {item.delay}{'' if isinstance(item.delay, str) else unit}" if item.delay else "",
        "noise unknown" if item.sigma is None else "",
        f"sigma: {', '.join(named)}" if named else "",
        f"loss {item.loss} ({item.loss_scale:g} sigma)" if item.loss != "linear" else "",
    ]
    return "".join(f", {text}" for text in said if text)


def _join_channel_names(names: Sequence[str] | None, units: Sequence[str] | None, channels: int) -> str:
    """Return names with their units, or the number of channels where they have no names."""
    if names is None:
        return f"{channels} channels"
    return ", ".join(
        f"{name} ({unit})" if unit else name for name, unit in zip(names, units or ("",) * channels, strict=True)
    )
