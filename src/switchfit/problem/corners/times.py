"""Times of the corners of a model that follow from t, the input and fixed parameters alone, as of ``clip(u, -2, 2)``.

Whatever theta is, they are where they are: they are nodes of every mesh, as the knots of the input are. The function g
of each corner is evaluated on a grid in each cell between samples and knots, and bisected where its sign changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.problem.corners.timed import compile_timed_corners
from switchfit.problem.experiment import Experiment
from switchfit.problem.functions import use_float64
from switchfit.problem.padding import pad_length
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache

GRID_PARTS, CROSSING_HALVINGS = 16, 60
"""Parts of a cell at whose ends the sign of g is compared, and halvings of the part in which it changes."""

FEWEST_COMPILED_TIMES = 1024
"""Smallest number of times for which a program is compiled."""

APART = 1e-10
"""Part of the horizon between a jump and the nodes beside it. Corners nearer than half of that to a node are on it."""

ZERO_LEVEL = 1e-13
"""Part of the largest |g| that counts as 0: a signal that stays at its limit does not cross it by rounding."""


def find_corner_times(
    structure: Structure, experiment: Experiment, fixed: Sequence[Any], nodes: FloatArray
) -> FloatArray:
    """Return the times of these corners in modes and running costs; of a jump, the times just before and behind it.

    `fixed` are the values of the parameters that are not estimated, in the order of the structure; `nodes` the times
    that are nodes of every mesh of the experiment anyway, among them its ends.
    """
    named = dict(zip((name for name, _, read in structure.parameters if not read), fixed, strict=True))
    found: list[FloatArray] = []
    for function in (*structure.modes, *structure.running):
        known = tuple(name for name in function.parameters if name in named)
        corners = compile_timed_corners(function, known)
        if corners is not None:
            evaluate = partial(_evaluate, corners, experiment, structure, [np.asarray(named[k], float) for k in known])
            bends, jumps = _find_crossings(evaluate, nodes)
            # At a jump f has two values: with nodes just before and behind it, a row of the length 2e-10 of the horizon
            # is all that has stages on both sides.
            apart = APART * (nodes[-1] - nodes[0])
            found += [bends, jumps - apart, jumps + apart]
    if not found:
        return np.zeros(0)
    times = np.unique(np.concatenate(found))
    times = times[np.diff(times, prepend=-np.inf) > 0.5 * apart]
    # Those that lie on nodes that are there already add nothing but a row as short as rounding.
    return times[np.searchsorted(nodes, times - 0.5 * apart) == np.searchsorted(nodes, times + 0.5 * apart)]


def _evaluate(
    corners: Callable[..., Any],
    experiment: Experiment,
    structure: Structure,
    values: list[FloatArray],
    times: FloatArray,
) -> list[FloatArray]:
    """Return g of the corners of a function at times (L,): (L, k) of bends, (L, l) of jumps."""
    # Of all times at once; the input may be an array, flat in the signals.
    shape = structure.input_shape
    u = [] if shape is None else [experiment.signals[-1](times).reshape(-1, *shape)]
    # Padded by repeating them, so that the grid and the bisection, and logs of similar length, share a program.
    size = pad_length(max(len(times), FEWEST_COMPILED_TIMES))
    t, *u = (np.resize(each, (size, *each.shape[1:])) for each in (times, *u))
    with use_float64(), use_compilation_cache():
        return [np.asarray(g)[: len(times)] for g in corners(t, u, values)]


def _find_crossings(evaluate: Callable[[FloatArray], list[FloatArray]], nodes: FloatArray) -> list[FloatArray]:
    """Return the times at which bends and at which jumps change their signs between nodes."""
    # Up to an ulp before the end of a cell: at its end itself a held input has the value of the next cell.
    grid, found = np.linspace(nodes[:-1], np.nextafter(nodes[1:], nodes[:-1]), GRID_PARTS + 1, axis=1), []
    for kind, g in enumerate(evaluate(grid.ravel())):
        level = ZERO_LEVEL * np.fmax.reduce(np.abs(g), axis=0, initial=0.0)
        signs = _find_signs(g, level).reshape(*grid.shape, -1)
        cell, part, which = np.nonzero(signs[:, 1:] != signs[:, :-1])
        low, high, begins = grid[cell, part], grid[cell, part + 1], signs[cell, part, which]
        for _ in range(CROSSING_HALVINGS if len(cell) else 0):
            middle = 0.5 * (low + high)
            is_before = _find_signs(evaluate(middle)[kind][range(len(cell)), which], level[which]) == begins
            low, high = np.where(is_before, middle, low), np.where(is_before, high, middle)
        found.append(high)
    return found


def _find_signs(g: FloatArray, level: FloatArray) -> FloatArray:
    """Return the sign of each g, 0 within its level: at a node a jump may be touched from one side alone."""
    return np.sign(np.where(np.abs(g) > level, g, 0.0))
