"""Inputs that lower a criterion: L-BFGS-B between limits, with the exact gradient, from many starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.arguments import build_arguments, split_by_cell
from switchfit.experiment_design.criterion import Criterion
from switchfit.experiment_design.gradient import Background, differentiate_criterion
from switchfit.experiment_design.nominal import Nominal
from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import Experiment
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem
from switchfit.problem.validation import as_array, join_names, shorten
from switchfit.runtime.cache import use_compilation_cache

UNUSABLE = 1e3
"""log m of a design whose trajectory cannot be integrated."""


def name_inputs(run: Experiment) -> tuple[str, ...]:
    """Return what the entries of the input of a run are called: by their names, or u, or u[0], u[1], ...

    Parameters
    ----------
    run : Experiment
    """
    if run.inputs is None or run.inputs.names:
        return () if run.inputs is None else run.inputs.names
    return tuple(f"u[{k}]" for k in range(run.inputs.shape[0])) if run.inputs.shape else ("u",)


def stack_inputs(run: Experiment) -> FloatArray:
    """Return the values of the input of a run at its knots, (K, q); (0, 0) without one.

    Parameters
    ----------
    run : Experiment
    """
    if run.inputs is None:
        return np.zeros((0, 0))
    values = run.inputs.values
    return (
        np.stack([values[name] for name in run.inputs.names], 1)
        if run.inputs.names
        else values.reshape(len(values), -1)
    )


def replace_inputs(problem: Problem, e: int, table: FloatArray) -> Problem:
    """Return the problem with other values (K, q) of the input of run e.

    Parameters
    ----------
    problem : Problem
    e : int
    table : (K, q) array
    """
    runs, inputs = list(problem.experiments), problem.experiments[e].inputs
    values = dict(zip(inputs.names, table.T, strict=True)) if inputs.names else table.reshape(inputs.values.shape)
    runs[e] = replace(runs[e], inputs=replace(inputs, values=values))
    return replace(problem, experiments=runs)


def read_limits(run: Experiment, free: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Return lower and upper limits of the input of a run at its knots, (K, q) each; equal where it is not free.

    Parameters
    ----------
    run : Experiment
    free : mapping of str to (lower, upper)
    """
    if not isinstance(free, Mapping):
        raise TypeError(f"free must be a dict of inputs and their limits; got {shorten(free)}.")
    names, ends = name_inputs(run), np.stack([stack_inputs(run)] * 2)
    for name, limits in free.items():
        columns = [k for k, each in enumerate(names) if each == name or (name == "u" and each.startswith("u["))]
        if not columns:
            raise ValueError(f"free must name inputs of the run: {join_names(names)}; got {shorten(name)}.")
        try:
            pair = np.stack([np.broadcast_to(as_array(limit, name), len(ends[0])) for limit in limits])
        except (TypeError, ValueError):
            pair = np.full((2, 1), np.nan)
        if pair.shape[0] != 2 or not np.isfinite(pair).all() or np.any(pair[0] > pair[1]):
            raise ValueError(
                f"free must have (lower, upper) for {name}, lower <= upper, finite numbers or one for each of the "
                f"{len(ends[0])} knots; got {shorten(limits)}."
            )
        ends[:, :, columns] = pair[:, :, None]
    return ends[0], ends[1]


def improve_input(
    here: Nominal,
    criterion: Criterion,
    power: float,
    taken: Sequence[NDArray[np.bool_]],
    limits: tuple[FloatArray, FloatArray],
    starts: Sequence[FloatArray],
) -> FloatArray:
    """Return the best values of the input at its knots, (K, q).

    Parameters
    ----------
    here : Nominal
        On whose mesh.
    criterion : Criterion
    power : float
    taken : sequence of (K,) bool, one for each sensor
        Samples that are taken.
    limits : lower and upper, (K, q)
    starts : sequence of (K, q) arrays
    """
    from scipy.optimize import minimize  # here, since importing it takes longer than most fits

    lower, width = limits[0], limits[1] - limits[0]
    free, background, structure = width > 0, _describe(here, criterion, taken), here.evaluator.structures[here.e]

    def place(x: FloatArray) -> FloatArray:
        table = lower.copy()
        table[free] += x * width[free]
        return table

    def rate(x: FloatArray) -> tuple[float, FloatArray]:
        value, slope = differentiate_criterion(place(x), background, structure=structure, power=power)
        slope = np.asarray(slope * width)[free]
        return (float(value), slope) if np.isfinite([value, *slope]).all() else (UNUSABLE, np.zeros_like(slope))

    found = []
    with use_float64(), use_compilation_cache():
        for start in starts:
            x = np.clip((start - lower)[free] / width[free], 0.0, 1.0)
            found.append(minimize(rate, x, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * len(x)))
    return place(min(found, key=lambda end: end.fun).x)


def _describe(here: Nominal, criterion: Criterion, taken: Sequence[NDArray[np.bool_]]) -> Background:
    """Return what does not change."""
    problem, e, mesh = here.problem, here.e, here.evaluator.meshes[here.e]
    run, mesh = problem.experiments[e], mesh.pad_to(1 << mesh.cells.bit_length())  # few lengths: few programs
    knots = replace(run.inputs, values=np.eye(len(run.inputs.times)), units=None)
    (own, mine), (tau, p) = problem.own_places[e], problem.vectors(here.theta, e)
    places = np.zeros((len(here.theta), len(problem.places[e])))
    places[mine, own] = 1.0
    lengths = zip(taken, problem.sample_lengths[e], strict=True)
    return Background(
        arguments=build_arguments(problem, e, mesh),
        cells=split_by_cell(knots.signal(run.t0, run.end), mesh),
        theta=np.append(tau, p),
        taken=tuple(np.pad(each.astype(float), (0, length - len(each))) for each, length in lengths),
        others=here.candidates.others,
        places=places,
        criterion=criterion,
    )
