"""The generators of schedules by their names."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from switchfit.modes.criterion import CriterionName, Score
from switchfit.modes.fitter import Fitter
from switchfit.problem.data import FloatArray
from switchfit.strategy.beam import beam
from switchfit.strategy.proposal import Proposal

Method = Literal["auto", "beam", "insertion"]
METHODS: tuple[Method, ...] = get_args(Method)


def follow_log(
    fitter: Fitter, score: Score, criterion: CriterionName, parameters: FloatArray, width: int, grid: float | None
) -> list[Proposal]:
    """Return the proposals of the beam for the problem of a fitter, the best first.

    Parameters
    ----------
    fitter : Fitter
    score : Score
    criterion : str
        What a switch costs follows from it.
    parameters : (M,)
        At which the beam begins.
    width : int
        Hypotheses that it keeps.
    grid : float or None
        Distance of times at which switches are looked for.
    """
    penalty, library = compute_penalty(score, criterion), fitter.library
    with np.errstate(all="ignore"):
        return beam(
            fitter.problem,
            library,  # type: ignore[arg-type]  # its protocol has attributes that may be set
            parameters,
            penalty=penalty,
            width=width,
            grid=grid,
        )


def compute_penalty(score: Score, criterion: CriterionName) -> float:
    """Return what a switch costs by a criterion, in units of J.

    Parameters
    ----------
    score : Score
    criterion : str
    """
    if criterion == "cost":
        return score.switch_cost
    if criterion == "aicc":
        return 1.0
    return (1.0 if criterion == "mbic" else 0.5) * float(np.log(max(score.values, 2)))
