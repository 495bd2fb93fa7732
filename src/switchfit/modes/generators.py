"""The generators of schedules by their names."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from switchfit.modes import exhaustive
from switchfit.modes.beam import beam
from switchfit.modes.criterion import CriterionName, Score
from switchfit.modes.fitter import Fitter
from switchfit.modes.matching import explain_no_matching, match_derivatives
from switchfit.modes.proposal import Proposal
from switchfit.problem.data import FloatArray

Method = Literal["auto", "beam", "insertion", "matching", "exhaustive"]
METHODS: tuple[Method, ...] = get_args(Method)


def choose_methods(method: Method, fitter: Fitter, score: Score, *, wider: bool) -> tuple[Method, ...]:
    """Return the generators to use: of "auto" the beam where there are data, insertion for other costs.

    Parameters
    ----------
    method : str
    fitter : Fitter
    score : Score
    wider : bool
        Whether the data were not explained: derivatives are then matched as well, if the whole state is measured.
    """
    if method != "auto":
        return (method,)
    if score.sigma_known is None:
        return ("insertion",)
    matched = wider and explain_no_matching(fitter.problem, fitter.library) is None
    return ("beam", "matching") if matched else ("beam",)


def generate(
    method: Method,
    fitter: Fitter,
    score: Score,
    criterion: CriterionName,
    parameters: FloatArray,
    width: int,
    grid: float | None,
) -> list[Proposal]:
    """Return the proposals of one generator for the problem of a fitter, the best first.

    Parameters
    ----------
    method : {"beam", "matching", "exhaustive"}
    fitter : Fitter
    score : Score
    criterion : str
        What a switch costs follows from it.
    parameters : (M,)
        At which the generator simulates.
    width : int
        Hypotheses that the beam keeps.
    grid : float or None
        Distance of times at which switches are looked for.
    """
    problem, library = fitter.problem, fitter.library
    if method == "matching":
        return match_derivatives(problem, library, parameters)
    penalty = compute_penalty(score, criterion)
    if method == "beam":
        with np.errstate(all="ignore"):
            return beam(
                problem,
                library,  # type: ignore[arg-type]  # its protocol has attributes that may be set
                parameters,
                penalty=penalty,
                width=width,
                grid=grid,
            )
    return exhaustive.generate(problem, library, parameters, cost=fitter.cost, grid=grid, penalty=penalty)


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
