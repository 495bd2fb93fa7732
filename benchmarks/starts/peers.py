"""SciPy's optimisers with switchfit's own costs and exact first derivatives; IPOPT on a collocation.

SciPy's begin on a mesh chosen at their start. Their answer is checked as `sf.estimate` checks its own: J, guards and
terminal constraints on steps cut in two; while they differ by more than `sf.estimate` allows, the fit goes on where it
has ended, on finer meshes chosen in the same way. What differs from switchfit is the way to the optimum.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import numpy as np
import scipy.optimize

import switchfit as sf
from benchmarks.starts.case import Case, Sampled
from benchmarks.starts.end import End
from switchfit.fit.local_fit import REFINEMENTS
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.halving import refine_meshes
from switchfit.meshes.integration_error import LARGEST_INTEGRATION_ERROR, judge_meshes
from switchfit.uncertainty.sample_derivatives import collect_sample_derivatives
from switchfit.uncertainty.sensitivity import Sensitivity

MOST_CALLS = 300
FTOL = 1e-12


Fit = Callable[[Case, np.ndarray, Evaluator], End]
"""Fits a case from a start, (d,), on the meshes of an evaluator."""


def resume(fit: Fit) -> Callable[[Case, np.ndarray], End]:
    """Return the method that fits again, on finer meshes, while the integration error of the answer is too large."""

    def fit_again(case: Case, start: np.ndarray) -> End:
        problem, began = case.problem, time.perf_counter()
        evaluator, theta = Evaluator(problem, start), start
        first_cost = evaluator.cost(start)
        calls, iterations, seconds = 0, 0, 0.0
        for attempt in range(REFINEMENTS + 1):
            end = fit(case, theta, evaluator)
            calls, iterations, seconds = calls + end.evaluations, iterations + end.iterations, seconds + end.optimizing
            theta = np.array(end.theta)
            held = evaluator.constrained(theta).constraints if problem.constraint_names else []
            _, _, error, _ = judge_meshes(evaluator, theta, end.said, first_cost, held)
            excess = error / max(LARGEST_INTEGRATION_ERROR, problem.rtol)
            if attempt == REFINEMENTS or not excess > 1:
                break
            evaluator = refine_meshes(evaluator, start, theta, excess, first=not attempt)
        fitting = time.perf_counter() - began
        return replace(end, evaluations=calls, iterations=iterations, fitting=fitting, optimizing=seconds)

    return fit_again


@resume
def fit_with_least_squares(case: Case, start: np.ndarray, evaluator: Evaluator) -> End:
    """Fit with `least_squares` (trust region reflective) in the modes' durations, which keeps the times in order."""
    problem = case.problem
    back = build_durations(problem)
    forth = np.linalg.solve(back, start)
    lower, upper = (np.array(bound, dtype=float) for bound in (problem.unknowns.lower, problem.unknowns.upper))
    for run, where in zip(problem.experiments, problem.unknowns.times, strict=True):
        # The first is a time, the others are durations; that the last is before tf is left to `residuals`.
        lower[where[:1]], upper[where[:1]] = np.maximum(lower[where[:1]], run.t0), np.minimum(upper[where[:1]], run.end)
        lower[where[1:]], upper[where[1:]] = 0.0, run.end - run.t0
    found: dict[bytes, Any] = {}

    def samples(z: np.ndarray) -> Any:
        key = z.tobytes()
        if key not in found:
            found.clear()
            theta = back @ z
            engines = enumerate(zip(evaluator.runs, evaluator.engines, strict=True))
            simulations = [(e, engine.simulate(*run.vectors(theta), tangents=True)) for e, (run, engine) in engines]
            runs = [Sensitivity(simulation, problem.places[e], theta) for e, simulation in simulations]
            found[key] = collect_sample_derivatives(problem, runs)
        return found[key]

    shape = len(samples(forth).residual)

    def residuals(z: np.ndarray) -> np.ndarray:
        if not is_in_order(problem, back @ z):
            return np.full(shape, np.inf)
        here = samples(z)
        return np.sqrt(here.weight) * here.residual

    def jacobian(z: np.ndarray) -> np.ndarray:
        here = samples(z)
        return np.sqrt(here.weight)[:, None] * here.derivative @ back

    began = time.perf_counter()
    result = scipy.optimize.least_squares(
        residuals,
        np.clip(forth, lower, upper),
        jac=jacobian,
        bounds=(lower, upper),
        x_scale="jac",
        ftol=1e-12,
        xtol=1e-10,
        gtol=1e-10,
        max_nfev=MOST_CALLS,
    )
    seconds = time.perf_counter() - began
    theta, status = back @ result.x, str(result.status)
    return _read(problem, theta, result.cost, result.success, status, result.nfev, result.njev, seconds)


@resume
def fit_with_slsqp(case: Case, start: np.ndarray, evaluator: Evaluator) -> End:
    """Fit with SLSQP from J and its exact gradient; guards and terminal constraints are its equalities.

    It is sensitive to scales: J counts in units of J at the start, parameters in units of theirs there. It asks for
    J, the constraints and their derivatives one after the other: one evaluation at a point serves them all.
    """
    problem = case.problem
    unknowns = problem.unknowns
    unit = np.where(unknowns.is_time | (start == 0), 1.0, np.abs(start))
    first = max(abs(evaluator.cost(start)), np.finfo(float).tiny)

    last: dict[bytes, Any] = {}

    def evaluate(z: np.ndarray) -> Any:
        key = z.tobytes()
        if key not in last:
            last.clear()
            held = bool(problem.constraint_names)
            last[key] = evaluator.constrained(unit * z) if held else evaluator(unit * z, matrix="none")
        return last[key]

    def cost(z: np.ndarray) -> tuple[float, np.ndarray]:
        here = evaluate(z)
        return here.cost / first, unit * here.gradient / first

    constraints: list[dict[str, Any]] = []
    if len(unknowns.b):
        order = {"fun": lambda z: unknowns.A @ (unit * z) - unknowns.b, "jac": lambda z: unknowns.A * unit}
        constraints.append({"type": "ineq", **order})
    if problem.constraint_names:
        equal = {"fun": lambda z: evaluate(z).constraints, "jac": lambda z: evaluate(z).jacobian * unit}
        constraints.append({"type": "eq", **equal})
    began = time.perf_counter()
    result = scipy.optimize.minimize(
        cost,
        start / unit,
        jac=True,
        method="SLSQP",
        bounds=scipy.optimize.Bounds(unknowns.lower / unit, unknowns.upper / unit),
        constraints=constraints,
        options={"ftol": FTOL, "maxiter": MOST_CALLS},
    )
    seconds = time.perf_counter() - began
    cost_there = float(result.fun) * first
    theta, status = unit * result.x, str(result.status)
    return _read(problem, theta, cost_there, result.success, status, result.nfev, result.nit, seconds)


ELEMENTS = 16
"""Elements of the collocation in each mode."""


def fit_with_ipopt(case: Case, start: np.ndarray) -> End:
    """Fit with IPOPT by collocation, the states simulated at the start as first guess."""
    collocation = _collocate(case)
    began = time.perf_counter()
    found = collocation(start)
    seconds = time.perf_counter() - began
    status = "success" if found.success else "failure"
    # IPOPT does not say how often it evaluated; it has one Hessian an iteration.
    return _read(case.problem, found.theta, found.cost, found.success, status, *[found.iterations] * 2, seconds)


@lru_cache(maxsize=4)
def _collocate(case: Case) -> Any:
    """Return the program of a case, built once."""
    # CasADi need not be there.
    from benchmarks.peers.casadi_collocation import Collocation
    from benchmarks.peers.casadi_samples import SampledCollocation

    given = case.collocation
    if given is None:
        raise ValueError("this case has no model for a collocation.")
    if isinstance(given, Sampled):
        return SampledCollocation(_sample_model(given))
    return Collocation(given.model, ELEMENTS, given.bounds, given.reference)


def _sample_model(given: Sampled) -> Any:
    """Return the model of a case for the collocation between samples."""
    from benchmarks.peers.casadi_samples import SampledModel

    problem = given.problem
    (run,) = problem.experiments
    (data,) = run.data
    parameters = ~problem.unknowns.is_time
    return SampledModel(
        field=given.field,
        sequence=run.mode_sequence,
        horizon=(run.t0, run.end),
        x0=tuple(np.asarray(problem.system.initial_state, dtype=float).tolist()),
        bounds=(problem.unknowns.lower[parameters], problem.unknowns.upper[parameters]),
        times=data.times,
        values=data.values,
        observed=given.observed,
        sigma=float(np.ravel(data.sigma)[0]),
        input_times=given.input_times,
        inputs=given.inputs,
        resets=given.resets,
        elements=given.elements,
    )


def why_no_ipopt(case: Case) -> str:
    """Return why IPOPT does not apply; empty where it does."""
    if case.collocation is None:
        return "the problem is not written for collocation"
    return "" if find_spec("casadi") else "CasADi is not installed"


def why_no_least_squares(case: Case) -> str:
    """Return why `least_squares` does not apply; empty where it does."""
    problem = case.problem
    if problem.constraint_names:
        return "it knows no guards and no terminal constraints"
    plain = problem.is_least_squares and problem.has_plain_samples
    if plain and all(isinstance(item, sf.Measurements) for run in problem.experiments for item in run.data):
        return ""
    return "its cost is no sum of squares over samples"


def build_durations(problem: sf.Problem) -> np.ndarray:
    """Return the matrix (d, d) that takes the first time and the durations after it to the times of each run."""
    matrix = np.eye(len(problem.theta_names))
    for where in problem.unknowns.times:
        matrix[np.ix_(where, where)] = np.tril(np.ones((len(where), len(where))))
    return matrix


def is_in_order(problem: sf.Problem, theta: np.ndarray) -> bool:
    """Return whether theta satisfies the order of the times and all bounds, but for rounding."""
    unknowns = problem.unknowns
    inside = np.all(theta >= unknowns.lower - 1e-12) and np.all(theta <= unknowns.upper + 1e-12)
    return bool(inside and np.all(unknowns.A @ theta - unknowns.b >= -1e-12))


def _read(
    problem: sf.Problem,
    theta: np.ndarray,
    cost: float,
    success: bool,
    status: str,
    calls: int,
    iterations: int,
    seconds: float,
) -> End:
    """Return where a peer ended, with violations by rounding taken away."""
    theta = np.clip(theta, problem.unknowns.lower, problem.unknowns.upper)
    for run, where in zip(problem.experiments, problem.unknowns.times, strict=True):
        theta[where] = np.clip(np.maximum.accumulate(theta[where]), run.t0, run.end)
    return End(theta.tolist(), cost, bool(success), "", status, int(calls), int(iterations), seconds, seconds)
