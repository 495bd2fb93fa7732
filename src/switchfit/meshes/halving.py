"""Finer meshes of a problem: cells or rows cut in two, rows that are implicit, or all made anew.

A mesh is only as good as the theta that it was made for. Halved meshes show how much of J is integration error
(`integration_error`), and are the next ones of a fit where that is too large.
"""

from __future__ import annotations

from switchfit.arrays import FloatArray
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.refinement import refine_if_unstable
from switchfit.runtime.errors import NotIntegrableError

ORDER_OF_METHODS = 5
"""Order of both integrators, and of the decrease of their error as steps are divided."""


def halve_cells(evaluator: Evaluator) -> Evaluator:
    """Return the same problem with every cell of its meshes cut in two; the evaluator keeps it for the next fit."""
    if evaluator.halved is None:
        evaluator.halved = evaluator.divide(2)
    return evaluator.halved


def halve_rows(evaluator: Evaluator, theta: FloatArray) -> Evaluator:
    """Return the same problem with every step at theta cut in two.

    Halved cells are not enough away from where the meshes were made: the two rows in a cell that a transition cuts
    late keep nearly their lengths.
    """
    problem = evaluator.problem
    halved = [mesh.halve_rows(problem.vectors(theta, e)[0]) for e, mesh in enumerate(evaluator.meshes)]
    return Evaluator(problem, meshes=halved)


def stabilize(evaluator: Evaluator, *thetas: FloatArray) -> Evaluator | None:
    """Return the same problem with implicit steps where explicit ones are unstable near the last of some thetas;
    None if all are stable.

    A fit cannot go beyond a theta at which the steps of its mesh become unstable: J is not finite there.
    """
    each = list(zip(evaluator.runs, evaluator.meshes, strict=True))
    found = [refine_if_unstable(run, mesh, *thetas) for run, mesh in each]
    if not any(found):
        return None
    return Evaluator(evaluator.problem, meshes=[new or mesh for new, (_, mesh) in zip(found, each, strict=True)])


def choose_next_meshes(
    evaluator: Evaluator,
    start: FloatArray,
    theta: FloatArray,
    excess: float,
    *,
    failed: bool,
    stopped: bool,
    first: bool,
) -> Evaluator | None:
    """Return the problem on the meshes on which a fit goes on from theta; None if it is over.

    Parameters
    ----------
    evaluator : Evaluator
        On the meshes of the fit so far.
    start, theta : (d,)
        Where the fit began, and where it is now.
    excess : float
        Integration error in units of the largest one that is allowed.
    failed : bool
        Whether the fit has not converged: its steps may be unstable.
    stopped : bool
        Whether it was stopped, and goes on only with stable steps in place of unstable ones.
    first : bool
        Whether it has worked on its first meshes so far.
    """
    stable = stabilize(evaluator, start, theta) if failed or excess > 2**ORDER_OF_METHODS else None
    if stable is not None or stopped or not excess > 1:
        return stable
    try:
        return refine_meshes(evaluator, start, theta, excess, first=first)
    except NotIntegrableError:  # what was found stays, with its integration error
        return None


def refine_meshes(
    evaluator: Evaluator, start: FloatArray, theta: FloatArray, excess: float, *, first: bool
) -> Evaluator:
    """Return the problem on finer meshes: halved, or, if that is not enough, refined at the start and at theta.

    A mode that has become active in another part of the horizon may meet cells there that are far too long for it.
    The first meshes have their cells halved, later ones their rows at theta.
    """
    if excess <= 2**ORDER_OF_METHODS:
        return halve_cells(evaluator) if first else halve_rows(evaluator, theta)
    return Evaluator(evaluator.problem, start, theta)
