"""estimate(): a problem in, an `Estimate` out. Puts mesh, derivatives and optimiser together."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from switchfit.certificate import certify
from switchfit.data import FloatArray, Measurements
from switchfit.evaluate import ArrowEvaluation, Evaluation, Evaluator, evaluator_of
from switchfit.hidden import refuse_hidden_switches
from switchfit.io.json import load_fit, save_fit
from switchfit.optimize import IterationRecord, LinearConstraints, Result, Status, minimize
from switchfit.optimize.arrow import Arrow
from switchfit.optimize.variables import Variables
from switchfit.problem import Problem
from switchfit.refine import refined_mesh
from switchfit.report.plot import plot_fit
from switchfit.report.text import report
from switchfit.result import Certificate, Fit
from switchfit.simulate import compare

HessianKind = Literal["exact", "block-diagonal", "gauss-newton", "none"]
HESSIANS = ("exact", "block-diagonal", "gauss-newton", "none")

REFINEMENTS = 2
"""Times the mesh may be refined at the solution and the fit resumed, if the integration error asks for it."""

LARGEST_INTEGRATION_ERROR = 1e-8
"""Relative error of J (by halving all steps) above which the mesh is refined again, unless rtol allows more."""

PERFECT_FIT = 1e-3
"""Where J has fallen to less than this part of its first value, the integration error is measured against that part:
the relative error of a cost that vanishes says nothing."""

MANY_RUNS = 16
"""Experiments from which on the Hessian's shape of an arrow is made use of; with fewer, the algebra of full matrices
takes no longer (the runs part of the benchmarks)."""

ORDER = 5
"""Order of both integrators: what dividing the steps gains."""


@dataclass(frozen=True, eq=False)
class Estimate(Fit):
    """Result of `estimate`: everything in `Fit`, and what can be done with it. Print it for the report."""

    saved_certificate: Certificate | None = None
    problem: Problem | None = None

    @cached_property
    def certificate(self) -> Certificate:
        """How the numbers were checked. The paper's equations are evaluated here, at the first access.

        An estimate that was loaded has no model: its certificate is the one that was saved.
        """
        if self.saved_certificate is not None:
            return self.saved_certificate
        return certify(self, None if self.problem is None else Evaluator(self.problem, theta=self.theta))

    def __str__(self) -> str:
        return report(self)

    def plot(self) -> Any:
        """Measured against fitted over time with the modes shaded, as a matplotlib Figure."""
        return plot_fit(self)

    def save(self, path: str | Path) -> None:
        """Write everything but the model to a JSON file, atomically; `load` reads it."""
        save_fit(self, self.certificate, Path(path))

    @classmethod
    def load(cls, path: str | Path) -> Estimate:
        """Read what `save` wrote.

        Raises
        ------
        ValueError
            If the file is not one of switchfit's.
        """
        fit, certificate = load_fit(Path(path))
        return cls(**{f.name: getattr(fit, f.name) for f in fields(Fit)}, saved_certificate=certificate)


@dataclass(frozen=True, eq=False)
class CostAndGradient:
    """All that steepest descent is given."""

    cost: float
    gradient: FloatArray
    hessian: None = None


def estimate(
    problem: Problem,
    *,
    hessian: HessianKind = "exact",
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    callback: Callable[[IterationRecord], object] | None = None,
    start: ArrayLike | None = None,
) -> Estimate:
    """Estimate all transition times and parameters of a problem together.

    Parameters
    ----------
    problem : Problem
    hessian : {"exact", "block-diagonal", "gauss-newton", "none"}
        Quadratic term of the sequential quadratic programme: equation (3), equation (4), the Gauss-Newton
        matrix, or none (steepest descent).
    tolerance : float
        On the KKT residual, the norm of the gradient where no constraint is active. An unknown on a logarithmic scale
        counts by its logarithm, one whose first guess is below 1e-3 or above 1e3 in units of (about) that guess.
    max_iterations : int
    callback : callable, optional
        Called with each `IterationRecord`; a true return value stops the fit. Ctrl-C does as well; both
        return the best point so far.
    start : (d,) array_like, optional
        Where to begin, in the order of ``problem.theta_names``; the problem's initial guess if left out.

    Returns
    -------
    Estimate
        Also when it did not converge: see ``.success`` and ``.message``.

    Raises
    ------
    ValueError
        For a bad setting, or a guess at which the model cannot be integrated.
    """
    if hessian not in HESSIANS:
        raise ValueError(f"hessian must be one of {', '.join(HESSIANS)}; got {hessian!r}.")
    if not tolerance > 0:
        raise ValueError(f"tolerance must be positive; got {tolerance}.")
    if max_iterations < 0:
        raise ValueError(f"max_iterations must not be negative; got {max_iterations}.")
    began = time.perf_counter()
    theta = problem.checked_theta(start)
    evaluator = evaluator_of(problem) if start is None else Evaluator(problem, theta)
    history: list[IterationRecord] = []
    evaluations = 0
    for attempt in range(REFINEMENTS + 1):
        numbered = partial(_numbered_on, after=history[-1] if history else None)
        told = None if callback is None else lambda record, on=numbered: callback(on(record))
        left = max_iterations - max(len(history) - 1, 0)
        result = minimized(evaluator, theta, hessian, tolerance, max(left, 0), told)
        records = [numbered(record) for record in result.history]
        history += records[1:] if history else records
        evaluations += result.evaluations
        theta = result.theta
        fine_cost, trajectories, comparisons = compare(problem, theta, [mesh.divided() for mesh in evaluator.meshes])
        first_cost = abs(history[0].cost) if history else 0.0
        error = abs(fine_cost - result.cost) / max(abs(fine_cost), PERFECT_FIT * first_cost, smallest_cost(problem))
        excess = error / max(LARGEST_INTEGRATION_ERROR, problem.rtol)
        done = result.status in (Status.INTERRUPTED, Status.NONFINITE_START) or attempt == REFINEMENTS
        if done or not excess > 1:
            break
        evaluator = _refined(evaluator, problem.checked_theta(start), theta, excess)
    return _estimate(
        problem,
        evaluator,
        result,
        history,
        hessian,
        tolerance,
        initial_theta=problem.checked_theta(start),
        evaluations=evaluations,
        trajectories=trajectories,
        comparisons=comparisons,
        integration_error=float(error),
        seconds=time.perf_counter() - began,
    )


def _refined(evaluator: Evaluator, start: FloatArray, theta: FloatArray, excess: float) -> Evaluator:
    """The problem on finer meshes: cells cut in two, or, where that is not enough, refined at the start and at theta.

    A mode that has come to be active in another part of the horizon may find cells there that are far too long for it.
    """
    problem = evaluator.problem
    if excess <= 2**ORDER:
        return evaluator.divided()
    return Evaluator(problem, meshes=[refined_mesh(problem, e, start, theta) for e in range(len(problem.experiments))])


def _numbered_on(record: IterationRecord, after: IterationRecord | None) -> IterationRecord:
    """`record` of a fit that was resumed, counted on from the last record before."""
    if after is None:
        return record
    return replace(
        record, iteration=record.iteration + after.iteration, evaluations=record.evaluations + after.evaluations
    )


def constraints_of(problem: Problem) -> LinearConstraints:
    """Ordering, minimum durations and bounds of a problem as the optimiser takes them."""
    unknowns = problem.unknowns
    names = [
        *unknowns.constraint_names,
        *(f"{name} at its lower bound {value:g}" for name, value in zip(unknowns.names, unknowns.lower, strict=True)),
        *(f"{name} at its upper bound {value:g}" for name, value in zip(unknowns.names, unknowns.upper, strict=True)),
    ]
    return LinearConstraints(unknowns.A, unknowns.b, unknowns.lower, unknowns.upper, tuple(names))


def minimized(
    evaluator: Evaluator,
    theta: Any,
    hessian: HessianKind,
    tolerance: float,
    max_iterations: int,
    callback: Callable[[IterationRecord], object] | None = None,
    by_blocks: bool | None = None,
) -> Result:
    """One run of the optimiser on the evaluator's meshes; arguments as of `estimate`.

    `by_blocks` says whether to use the shape that the Hessian of several runs has; left out, where it pays.
    """
    problem = evaluator.problem

    unknowns = problem.unknowns
    matrix = hessian if hessian in ("gauss-newton", "none") else "exact"
    if by_blocks is None:
        by_blocks = len(problem.experiments) >= MANY_RUNS and 2 * len(evaluator.layout.shared) < len(theta)
    variables, constraints = unknowns.variables, constraints_of(problem)
    identity = variables.identity
    seen: list[bool] = []

    def evaluate_theta(theta: Any, side: int) -> Evaluation | ArrowEvaluation | CostAndGradient:
        if hessian != "none" and by_blocks:
            return evaluator.arrow(theta, side, matrix)
        here = evaluator(theta, side, matrix=matrix)
        return CostAndGradient(here.cost, here.gradient) if hessian == "none" else here

    def evaluate(z: Any, side: int) -> Any:
        theta = z if identity else _outward(variables, constraints, z)
        here = evaluate_theta(theta, side)
        if not seen:
            seen.append(True)
            refuse_hidden_switches(evaluator, theta, here.gradient)
        return here if identity else _inward(variables, theta, here)

    is_time = np.zeros(len(theta), dtype=int)
    for where in problem.unknowns.times:
        is_time[where[where >= 0]] = 1
    told = callback
    if callback is not None and not identity:
        told = lambda record: callback(_told(variables, constraints, record))  # noqa: E731
    result = minimize(
        evaluate,
        theta if identity else variables.inward(np.asarray(theta)),
        constraints=constraints if identity else _constraints_inward(variables, constraints),
        breakpoints=evaluator.breakpoints(),
        hessian=hessian,
        blocks=is_time,
        tolerance=tolerance,
        max_iterations=max_iterations,
        callback=told,
    )
    return result if identity else _result_outward(variables, constraints, result)


def _outward(variables: Variables, constraints: LinearConstraints, z: FloatArray) -> FloatArray:
    """theta at z, inside its bounds whatever the rounding."""
    return np.asarray(np.clip(variables.outward(z), constraints.lower, constraints.upper))


def _inward(variables: Variables, theta: FloatArray, here: Any) -> Any:
    """An evaluation at theta as one of the optimiser's variables."""
    if here.hessian is None:
        return CostAndGradient(here.cost, variables.slopes(theta)[0] * here.gradient)
    if isinstance(here.hessian, Arrow):
        D, E = variables.slopes(theta)
        hessian = here.hessian.scaled(1.0 / D).plus_diagonal(E * here.gradient)
        return ArrowEvaluation(here.cost, D * here.gradient, hessian)
    return Evaluation(here.cost, *variables.derivatives_inward(theta, here.gradient, here.hessian))


def _constraints_inward(variables: Variables, constraints: LinearConstraints) -> LinearConstraints:
    """Bounds of the optimiser's variables; the rows join transition times alone, which are not changed."""
    lower, upper = variables.inward(constraints.lower), variables.inward(constraints.upper)
    return replace(constraints, lower=lower, upper=upper)


def _told(variables: Variables, constraints: LinearConstraints, record: IterationRecord) -> IterationRecord:
    """A record of the optimiser's with theta in place of its own variables."""
    return replace(record, theta=_outward(variables, constraints, record.theta))


def _result_outward(variables: Variables, constraints: LinearConstraints, result: Result) -> Result:
    """The optimiser's result in theta; its optimality and its eigenvalues stay those of its own variables."""
    theta = _outward(variables, constraints, result.theta)
    gradient, hessian = variables.derivatives_outward(theta, result.gradient, result.hessian)
    history = tuple(_told(variables, constraints, record) for record in result.history)
    return replace(result, theta=theta, gradient=gradient, hessian=hessian, history=history)


def _estimate(
    problem: Problem,
    evaluator: Evaluator,
    result: Result,
    history: list[IterationRecord],
    hessian: HessianKind,
    tolerance: float,
    **rest: Any,
) -> Estimate:
    """Collect what the optimiser found into an Estimate, with the exact Hessian whatever it worked with."""
    unknowns = problem.unknowns
    times, parameters = problem.split(result.theta)
    exact = result.hessian
    if hessian in ("gauss-newton", "none") and np.isfinite(result.cost):
        exact = evaluator(result.theta).hessian
    return Estimate(
        theta_names=unknowns.names,
        theta_units=unknowns.units,
        theta=result.theta,
        lower=unknowns.lower,
        upper=unknowns.upper,
        transition_times=tuple(times),
        parameters={name: np.array(value) for name, value in parameters.items()},
        cost=result.cost,
        gradient=result.gradient,
        hessian=exact,
        optimality=result.optimality,
        iterations=max(len(history) - 1, 0),
        status=result.status,
        message=with_names(result.message, unknowns.names),
        history=tuple(history),
        active=result.active,
        kinks=tuple((unknowns.names[i], left, right) for i, left, right in result.kinks),
        free_basis=result.free_basis,
        sigma_known=sigma_known(problem),
        priors={name: text for name, text in zip(unknowns.names, unknowns.priors.texts(), strict=True) if text},
        log_scaled=unknowns.log_names,
        least_squares=least_squares(problem),
        hessian_kind=hessian,
        tolerance=tolerance,
        problem=problem,
        **rest,
    )


def with_names(message: str, names: tuple[str, ...]) -> str:
    """The optimiser's message with the unknowns called by their names."""
    return re.sub(r"theta\[(\d+)\]", lambda match: names[int(match.group(1))], message)


def smallest_cost(problem: Problem) -> float:
    """A cost below which an error is not measured against it.

    The negative logarithm of a likelihood may be anything, 0 too; its parts are of the size of half the samples.
    """
    items = [item for e in problem.experiments for item in e.data if isinstance(item, Measurements)]
    return 1e-300 if least_squares(problem) else 0.5 * sum(item.count for item in items)


def least_squares(problem: Problem) -> bool:
    """Whether J is half a sum of squares: no loss is robust, no sigma a parameter."""
    items = [item for e in problem.experiments for item in e.data if isinstance(item, Measurements)]
    return not any(item.sigma_names or item.loss != "linear" for item in items)


def sigma_known(problem: Problem) -> bool | None:
    """Whether sigma is known for all measurements, as a number or as a parameter beside the others.

    None where the cost is not made of measurements alone.
    """
    items = [item for experiment in problem.experiments for item in experiment.data]
    if not all(isinstance(item, Measurements) for item in items):
        return None
    return all(item.sigma is not None for item in items)
