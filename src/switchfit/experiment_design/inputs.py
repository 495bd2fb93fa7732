"""The input of a run as a table of values at its knots: names, values and limits of its entries."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.problem.validation import arrays
from switchfit.problem.validation.messages import join_names, shorten


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
    values, names = run.inputs.values, run.inputs.names
    return np.stack([values[name] for name in names], 1) if names else values.reshape(len(values), -1)


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
        # "u" stands for all entries of an input that has no names.
        columns = [k for k, each in enumerate(names) if each == name or (name == "u" and each.startswith("u["))]
        if not columns:
            raise ValueError(f"free must name inputs of the run: {join_names(names)}; got {shorten(name)}.")
        try:
            # Whatever does not broadcast, or is no pair, is told as one mistake with its remedy below.
            pair = np.stack([np.broadcast_to(arrays.as_array(limit, name), len(ends[0])) for limit in limits])
        except (TypeError, ValueError):
            pair = np.full((2, 1), np.nan)
        if pair.shape[0] != 2 or not np.isfinite(pair).all() or np.any(pair[0] > pair[1]):
            raise ValueError(
                f"free must have (lower, upper) for {name}, lower <= upper, finite numbers or one for each of the "
                f"{len(ends[0])} knots; got {shorten(limits)}."
            )
        ends[:, :, columns] = pair[:, :, None]
    return ends[0], ends[1]
