"""What `switchfit check` says about a problem before any fit: its data, its unknowns, what the data can tell."""

from __future__ import annotations

import numpy as np

from switchfit.data import Measurements, ReferenceSignal
from switchfit.evaluate import evaluator_of
from switchfit.experiment import Experiment
from switchfit.hidden import refuse_hidden_switches
from switchfit.problem import Problem

#: Eigenvalues of the scaled Gauss-Newton matrix below this are called undetermined.
UNDETERMINED = 1e-10


def describe(problem: Problem) -> str:
    """Experiments, data and unknowns of a problem as text.

    Parameters
    ----------
    problem : Problem
    """
    lines = []
    for k, experiment in enumerate(problem.experiments, start=1):
        lines.append(f"Experiment {k}{f' ({experiment.name})' if experiment.name else ''}")
        lines += [f"  {line}" for line in _experiment_lines(experiment)]
    unknowns = problem.unknowns
    width = max(len(name) for name in unknowns.names)
    lines.append("Unknowns, first guess and bounds")
    numbers = (unknowns.initial, unknowns.lower, unknowns.upper)
    columns = (unknowns.names, unknowns.units, *numbers, unknowns.priors.texts(), unknowns.log)
    for name, unit, value, lower, upper, prior, log in zip(*columns, strict=True):
        unit = "" if unit == "1" else f" {unit}"
        bounds = "" if np.isinf(lower) and np.isinf(upper) else f"   in [{lower:.6g}, {upper:.6g}]"
        known = f"   prior: {prior}" if prior else ""
        lines.append(f"  {name:<{width}}  {value:.6g}{unit}{bounds}{known}{'   (log scale)' if log else ''}")
    return "\n".join(lines)


def _experiment_lines(experiment: Experiment) -> list[str]:
    times = ", ".join(f"{t:.6g}" for t in experiment.initial_times)
    lines = [f"{' -> '.join(experiment.mode_sequence)} on [{experiment.t0:.6g}, {experiment.tf:.6g}] s, at {times} s"]
    for item in experiment.data:
        if isinstance(item, Measurements):
            step = np.median(np.diff(item.times)) if len(item.times) > 1 else np.nan
            missing = item.values.size - item.count
            lines.append(
                f"{len(item.times)} samples of {_names(item.names, item.values.shape[1])}, "
                f"{item.times[0]:.6g} to {item.times[-1]:.6g} s, typically {step:.4g} s apart, {missing} values missing"
                f"{_sensor(item)}"
            )
        elif isinstance(item, ReferenceSignal):
            knots = item.signal.knots
            names = _names(item.names, item.signal.channels)
            lines.append(f"reference signal of {names}, {knots[0]:.6g} to {knots[-1]:.6g} s, {len(knots)} knots")
        else:
            lines.append(type(item).__name__)
    return lines


def _sensor(item: Measurements) -> str:
    """What is to be said of delay, noise and loss, where there is anything."""
    named = sorted({name for name in item.sigma_names if name})
    said = [
        f"late by {item.delay}" if item.delay else "",
        "noise unknown" if item.sigma is None else "",
        f"sigma: {', '.join(named)}" if named else "",
        f"loss {item.loss} ({item.loss_scale:g} sigma)" if item.loss != "linear" else "",
    ]
    return "".join(f", {text}" for text in said if text)


def _names(names: tuple[str, ...] | None, channels: int) -> str:
    return ", ".join(names) if names else f"{channels} channels"


def identifiability(problem: Problem) -> str:
    """How well the data determine the unknowns at the first guess, by the Gauss-Newton matrix, as text.

    Parameters
    ----------
    problem : Problem

    Raises
    ------
    ValueError
        For a parameter that changes the cost while its derivative is zero: a switch hidden in a function.
    """
    evaluator, theta = evaluator_of(problem), problem.initial_theta
    here = evaluator(theta, matrix="gauss-newton")
    refuse_hidden_switches(evaluator, theta, here.gradient)
    H = here.hessian
    scale = np.sqrt(np.diag(H))
    names = np.array(problem.theta_names)
    without = names[~(scale > 0)]
    if len(without):
        return f"At the first guess the cost does not depend on {', '.join(without)}, to first order."
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    worst = vectors[:, 0] * np.sign(vectors[np.argmax(np.abs(vectors[:, 0])), 0])
    order = [k for k in np.argsort(-np.abs(worst), kind="stable") if abs(worst[k]) > 0.2]
    together = " ".join(f"{worst[k]:+.2f} {names[k]}" for k in order)
    if values[0] < UNDETERMINED:
        return f"At the first guess the data do not determine this combination of the scaled unknowns: {together}."
    return (
        f"At the first guess the data determine all {len(names)} unknowns; condition number of the scaled problem "
        f"{values[-1] / values[0]:.3g}, worst determined: {together}."
    )
