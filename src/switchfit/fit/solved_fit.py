"""A fit with the problem that it solves and the meshes it was made on, whose trajectories are simulated when asked for.

What is built of fits begins here: each room above adds what it can say of a fit as a subclass (`JudgedFit` of
`switchfit.uncertainty`, `Estimate` on top), and takes over what is known already with `SolvedFit.take_over`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from switchfit.fit.comparison import compare
from switchfit.fit.result import Fit, Solution
from switchfit.meshes.evaluator import Evaluator
from switchfit.optimize import Result
from switchfit.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class SolvedFit(Fit):
    """A fit with its model: what a single fit returns.

    Attributes
    ----------
    problem : Problem or None
        None for a fit that was loaded without its model.
    evaluator : Evaluator or None
        On the meshes at the end of the fit; None after loading, which makes new ones at the first need.
    """

    problem: Problem | None = None
    evaluator: Evaluator | None = None

    @classmethod
    def take_over(cls, fit: Fit) -> Self:
        """Return a fit as one of this class, with all that has been computed of it: nothing is computed twice.

        Parameters
        ----------
        fit : Fit

        See Also
        --------
        estimate

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> sf.Estimate.take_over(fit).hessian is fit.hessian
        True
        """
        found = object.__new__(cls)  # not by its fields: trajectories would be simulated, cached values lost
        found.__dict__.update(fit.__dict__)
        return found

    def simulate_later(self, evaluator: Evaluator) -> None:
        """Compute `trajectories` and `comparisons` on some meshes at the first access; many fits never need them.

        See Also
        --------
        Estimate.complete

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> len(fit.trajectories)
        1
        >>> fit.simulate_later(fit.evaluator_at_solution())
        >>> fit.trajectory.states.shape[1]
        1
        """
        for name in ("trajectories", "comparisons"):
            del self.__dict__[name]
        self.__dict__["_shown_on"] = evaluator

    def __getattr__(self, name: str) -> Any:
        """Compute `trajectories` or `comparisons` at the first access."""
        if "_shown_on" not in self.__dict__ or name not in ("trajectories", "comparisons"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
        trajectories, comparisons = compare(self.__dict__.pop("_shown_on"), self.theta)
        self.__dict__.update(trajectories=trajectories, comparisons=comparisons)
        return self.__dict__[name]

    def evaluator_at_solution(self) -> Evaluator:
        """Return the problem on the meshes of the fit; of a loaded estimate on meshes refined at the solution.

        Raises
        ------
        ValueError
            If the estimate was loaded from a file without its problem.

        See Also
        --------
        evaluate

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> evaluator = fit.evaluator_at_solution()
        >>> abs(evaluator(fit.theta).cost - fit.cost) < 1e-12
        True
        """
        if self.problem is None:
            raise ValueError(
                "This estimate was loaded without its model: load it with Estimate.load(path, problem=problem)."
            )
        evaluator = self.evaluator or Evaluator(self.problem, self.theta)  # the meshes of an estimate are not saved
        object.__setattr__(self, "evaluator", evaluator)
        return evaluator


def describe_solution(evaluator: Evaluator, result: Result, kind: str, error: float, output: str) -> Solution:
    """Return the numbers at the end: with the exact Hessian even if the optimizer used another one, of this kind.

    A model may be too sharp for an exact Hessian: see `Follower`.
    """
    times, parameters = evaluator.problem.split(result.theta)
    is_other = kind in ("gauss-newton", "none") and np.isfinite(result.cost)
    return Solution(
        theta=result.theta,
        transition_times=tuple(times),
        parameters={name: np.array(value) for name, value in parameters.items()},
        gradient=result.gradient,
        hessian=evaluator(result.theta).hessian if is_other else result.hessian,
        hessian_kind=kind,
        constraints=result.equalities,
        free_basis=result.free_basis,
        engine=evaluator.engine,
        integration_error=error,
        integration_error_of=output,
    )
