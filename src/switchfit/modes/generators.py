"""The generators of schedules by their names."""

from __future__ import annotations

from importlib import import_module
from typing import Any, Literal, get_args

import numpy as np

from switchfit.modes import exhaustive
from switchfit.modes.criterion import Score
from switchfit.modes.fitter import Fitter
from switchfit.modes.proposal import Proposal
from switchfit.problem.data import FloatArray

Method = Literal["auto", "beam", "insertion", "matching", "exhaustive"]
METHODS: tuple[Method, ...] = get_args(Method)


def choose_methods(method: Method, score: Score) -> tuple[Method, ...]:
    """Return the generators to use: of "auto" the beam where there are data, insertion for other costs."""
    if method != "auto":
        return (method,)
    return ("beam",) if score.values and score.sigma_known is not None else ("insertion",)


def generate(
    method: Method, fitter: Fitter, score: Score, parameters: FloatArray, width: int, grid: float | None
) -> list[Proposal]:
    """Return the proposals of one generator for the problem of a fitter, the best first.

    Parameters
    ----------
    method : str
    fitter : Fitter
    score : Score
    parameters : (M,)
        At which the generator simulates.
    width : int
        Hypotheses that the beam keeps.
    grid : float or None
        Distance of times at which switches are looked for.
    """
    given: dict[str, Any] = {}
    if method == "exhaustive":
        penalty = score.switch_cost if score.sigma_known is None else 0.5 * float(np.log(max(score.values, 2)))
        return exhaustive.generate(
            fitter.problem, fitter.library, parameters, cost=fitter.cost, grid=grid, penalty=penalty
        )
    if method == "beam":
        given = {"width": width, "grid": grid}
    # Each is imported where it is used: a search with one of them does not wait for the others.
    found: list[Proposal] = import_module(f"switchfit.modes.{method}").generate(
        fitter.problem, fitter.library, parameters, **given
    )
    return found
