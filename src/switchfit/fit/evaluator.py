"""The cost of a problem and its exact derivatives at any theta, on a fixed mesh; on guards; and J of the means alone.

State-triggered transitions: their times as functions of the other unknowns.

A guard makes tau_i a function of the other unknowns q: ``c(tau(q), q) = 0``. By the implicit function theorem
``D tau = -C_tau^-1 C_q``, and with the multipliers ``lam = -C_tau^-T D_tau J`` the derivatives of ``J(tau(q), q)`` are

    D J = D_q J + lam C_q,      D² J = Z' D² (J + lam . c) Z,   Z = (-C_tau^-1 C_q; I).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.discretization.stiffness import Stiffness
from switchfit.engine.choice import engine_of, summarize
from switchfit.engine.corners.split_engine import SmoothEngine, SplitEngine
from switchfit.engine.evaluation import DenseEvaluation, Engine, Evaluation, Matrix
from switchfit.engine.native.native_engine import NativeEngine
from switchfit.engine.run import Run, runs_of
from switchfit.engine.simulation import Simulation
from switchfit.meshes.refinement import refine_if_unstable, refine_mesh_of_run
from switchfit.optimize.arrow import Arrow, ArrowLayout
from switchfit.optimize.breakpoints import Breakpoints
from switchfit.paper_adjoint import evaluate_paper
from switchfit.problem.costs import TerminalConstraint
from switchfit.problem.experiment import Experiment
from switchfit.problem.functions import use_float64
from switchfit.problem.measurements import Measurements
from switchfit.problem.padding import choose_common_lengths
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.structure import Structure
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_choice
from switchfit.problem.validation.objects import as_instance
from switchfit.runtime.cache import use_compilation_cache
from switchfit.runtime.presentation import format_line, join_first

Method = Literal["auto", "forward", "discrete-adjoint", "adjoint", "autodiff"]
METHODS: tuple[Method, ...] = ("auto", "forward", "discrete-adjoint", "adjoint", "autodiff")
ITERATIONS = 60

#: After a Newton step below this part of a transition time, its error is rounding.
NEGLIGIBLE = 1e-10

#: Part of the way to the next transition that one step may take.
ROOM = 0.9

NO_VARIATION = 1e-9
"""Standard deviation of a channel, relative to its largest value, below which it counts as constant (rounding)."""

REFERENCE_POINTS = 400
"""Points at which a reference signal is compared with its mean."""

ASSUMED_NOISE = 0.01
"""Noise where sigma is unknown, as a part of the variation of the data."""


class Evaluator:
    """A problem on fixed meshes, one per experiment: cost, gradient and Hessian as functions of theta alone.

    Parameters
    ----------
    problem : Problem
    *thetas : (d,) arrays
        Points at which the meshes are refined; the problem's initial guess if left out.
    meshes : sequence of Mesh, optional
        Meshes to use instead of refined ones.
    arguments : sequence of Arguments, optional
        Data and constants on these meshes, where they are not the problem's own.
    finer : float
        Multiplies the number of cells of refined meshes.
    """

    def __init__(
        self,
        problem: Problem,
        *thetas: FloatArray,
        meshes: Sequence[Mesh] | None = None,
        arguments: Sequence[Arguments] | None = None,
        finer: float = 1.0,
    ) -> None:
        self.problem = problem
        if meshes is None:
            points = thetas or (problem.initial_theta,)
            meshes = [refine_mesh_of_run(run, *points, finer=finer) for run in self.runs]
        self.meshes = list(meshes)
        if arguments is None:
            arguments = [run.build_arguments(mesh) for run, mesh in zip(self.runs, self._pad_meshes(), strict=True)]
        self.arguments = list(arguments)
        self.engines = list(map(engine_of, self.runs, self.arguments, self.meshes))

    def __reduce__(self) -> tuple[Any, ...]:
        """How it is copied and pickled: on the same meshes, with programs of its own."""
        return partial(Evaluator, meshes=self.meshes), (self.problem,)

    @cached_property
    def runs(self) -> tuple[Run, ...]:
        """The experiments, as all evaluators of the problem share them."""
        return runs_of(self.problem)

    def _pad_meshes(self) -> list[Mesh]:
        """Return the meshes; those of experiments with equal structure are padded to common lengths."""
        padded = list(self.meshes)
        for group in self.problem.alike if len(padded) > 1 else ():
            lengths = choose_common_lengths([padded[e].cells for e in group])
            for e, length in zip(group, lengths, strict=True):
                padded[e] = padded[e] if len(group) == 1 else padded[e].pad_to(length)
        return padded

    def divide(self, parts: int) -> Evaluator:
        """Return the same problem with every cell of its meshes cut into equal parts."""
        return Evaluator(self.problem, meshes=[mesh.divide(parts) for mesh in self.meshes])

    @cached_property
    def _priors(self) -> PriorTerms | None:
        return self.problem.unknowns.priors if self.problem.unknowns.priors.any else None

    @cached_property
    def halved(self) -> Evaluator:
        """The same problem with every cell of its meshes cut in two."""
        return self.divide(2)

    def halve_rows(self, theta: FloatArray) -> Evaluator:
        """Return the same problem with every step at theta cut in two, to estimate the integration error."""
        each = zip(self.meshes, self._vectors(theta), strict=True)
        return Evaluator(self.problem, meshes=[mesh.halve_rows(tau) for mesh, (tau, _) in each])

    def stabilize(self, *thetas: FloatArray) -> Evaluator | None:
        """Return the same problem with implicit steps where explicit ones are unstable near the last of some thetas;
        None if all are stable.

        A fit cannot go beyond a theta at which the steps of its mesh become unstable: J is not finite there.
        """
        found = [refine_if_unstable(run, mesh, *thetas) for run, mesh in zip(self.runs, self.meshes, strict=True)]
        if not any(found):
            return None
        return Evaluator(self.problem, meshes=[new or mesh for new, mesh in zip(found, self.meshes, strict=True)])

    def __call__(
        self, theta: FloatArray, side: int = 1, method: Method = "auto", matrix: Matrix = "exact", arrow: bool = False
    ) -> Evaluation[Any]:
        """Return the cost, gradient and Hessian; for a transition time on a node, the derivatives on its `side`.

        `matrix` selects the Hessian, the Gauss-Newton matrix in its place, or neither (NaN). As an `arrow`, it takes
        time and memory that are linear in the number of experiments.
        """
        whole = self._add_runs(self._evaluate_experiments(theta, side, method, matrix), len(theta), arrow)
        return self._add_priors(whole, theta, matrix)

    def constrained(self, theta: FloatArray, side: int = 1, multipliers: ArrayLike = 0.0) -> Evaluation[FloatArray]:
        """Return cost and constraints, with the Hessian of the Lagrangian for the multipliers, (m,) or ()."""
        multipliers = np.full(len(self.problem.constraint_names), multipliers, dtype=float)
        parts = np.split(multipliers, np.cumsum(self.problem.constraint_counts)[:-1])
        each = zip(self.engines, self._vectors(theta), parts, strict=True)
        results = [engine.constrained(*at, side, own) for engine, at, own in each]
        return self._add_priors(self._add_runs(results, len(theta)), theta)

    def _add_runs(self, results: list[Evaluation[FloatArray]], d: int, arrow: bool = False) -> Evaluation[Any]:
        """Return the sum of the evaluations of all experiments, which are in their own unknowns, in theta (d,)."""
        if self.problem.one_to_one and not arrow:
            return results[0]
        size = self.layout.own.shape[1] + len(self.layout.shared) if arrow else d
        parts = np.zeros((len(results) if arrow else 1, size, size))
        cost, gradient, slopes = 0.0, np.zeros(d), []
        for e, (one, (own, mine)) in enumerate(zip(results, self.problem.own_places, strict=True)):
            cost += one.cost
            # Two names of the model may refer to one parameter: its index then occurs twice, and both count.
            np.add.at(gradient, mine, one.gradient[own])
            part, places = (parts[e], self._slots[e]) if arrow else (parts[0], mine)
            np.add.at(part, (places[:, None], places), one.hessian[own[:, None], own])
            slopes.append(np.zeros((len(one.constraints), d)))
            if len(one.constraints):
                np.add.at(slopes[-1].T, mine, one.jacobian[:, own].T)
        hessian = Arrow.of_runs(self.layout, parts) if arrow else parts[0]
        constraints, jacobian = np.concatenate([one.constraints for one in results]), np.concatenate(slopes)
        row_errors = tuple(one.row_errors[0] if one.row_errors else np.nan for one in results)
        return Evaluation(cost, gradient, hessian, constraints, jacobian, row_errors)

    def _add_priors(self, found: Evaluation[Any], theta: FloatArray, matrix: Matrix = "exact") -> Evaluation[Any]:
        """Return an evaluation with the priors in cost, gradient and Hessian."""
        if self._priors is None:
            return found
        J, g, h = self._priors.evaluate(theta, gauss_newton=matrix == "gauss-newton")
        hessian = found.hessian.plus_diagonal(h) if isinstance(found.hessian, Arrow) else found.hessian + np.diag(h)
        return replace(found, cost=found.cost + float(J), gradient=found.gradient + g, hessian=hessian)

    @cached_property
    def layout(self) -> ArrowLayout:
        """Layout of the arrow-shaped Hessian: the unknowns of each experiment, and shared ones."""
        return ArrowLayout.of(len(self.problem.theta_names), self.problem.places)

    @cached_property
    def _slots(self) -> list[NDArray[np.intp]]:
        return [self.layout.slots(e, mine) for e, (_, mine) in enumerate(self.problem.own_places)]

    @cached_property
    def structures(self) -> tuple[Structure, ...]:
        """The structure of each experiment, with the method of the steps of each mode on its mesh."""
        return tuple(run.get_structure(mesh) for run, mesh in zip(self.runs, self.meshes, strict=True))

    @property
    def stiffness(self) -> tuple[Stiffness, ...]:
        """The modes of each experiment in which ``solver="auto"`` has chosen implicit steps, and why."""
        return tuple(each for mesh in self.meshes for each in mesh.stiffness)

    @property
    def takes_implicit_steps(self) -> bool:
        """Whether a mode of an experiment takes implicit steps."""
        return any(any(structure.implicit) for structure in self.structures)

    def judge_rows(self) -> Evaluator:
        """Estimate the errors of rows in all evaluations from now on; return the evaluator."""
        for engine in self.engines:
            engine.judge_rows()
        return self

    def cost(self, theta: FloatArray) -> float:
        """Return J alone."""
        of_priors = 0.0 if self._priors is None else float(self._priors.evaluate(theta)[0])
        return sum((engine.cost(*at) for engine, at in zip(self.engines, self._vectors(theta), strict=True)), of_priors)

    @property
    def engine(self) -> Engine:
        """Engine of cost, gradient and exact Hessian by the method "auto": machine code, or JAX with the reason."""
        return summarize(self.engines, self.problem.run_names)

    @property
    def paths(self) -> list[tuple[Any, ...]]:
        """The path of the last trajectory of each experiment through the corners of its modes; empty without any."""
        return [engine.path if isinstance(engine, SplitEngine) else () for engine in self.engines]

    def simulate(self, theta: FloatArray, *, tangents: bool = False) -> list[Simulation]:
        """Simulate all experiments row by row, with the derivatives of rows if `tangents`."""
        each = zip(self.engines, self._vectors(theta), strict=True)
        return [engine.simulate(*at, tangents=tangents) for engine, at in each]

    def _vectors(self, theta: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return the transition times (N,) and parameters (M,) of each experiment."""
        return [self.problem.vectors(theta, e) for e in range(len(self.engines))]

    def _evaluate_experiments(
        self, theta: FloatArray, side: int, method: Method, matrix: Matrix
    ) -> list[Evaluation[FloatArray]]:
        """Return the cost, gradient and Hessian of each experiment in its own unknowns."""
        theta = np.asarray(theta, dtype=np.float64)
        if method == "auto":
            find = self.problem.vectors
            return [engine.derivatives(*find(theta, e), side, matrix) for e, engine in enumerate(self.engines)]
        if method == "adjoint" and not is_covered_by_paper(self.problem):
            raise ValueError("the paper's equations have no TransitionCost: choose another method.")
        by: Any = "forward" if method == "autodiff" else method

        def evaluate(
            e: int, p: FloatArray, structure: Structure, engine: SmoothEngine, tau: FloatArray
        ) -> DenseEvaluation:
            if method == "adjoint":
                with use_float64(), use_compilation_cache():
                    J, g, H = evaluate_paper(self.arguments[e], tau, p, float(side), structure=structure)
                return Evaluation(float(J), np.array(g), np.array(H))
            by_jax = engine.fallback if isinstance(engine, NativeEngine) else engine
            return by_jax.derivatives(tau, p, side, matrix, by)

        found = []
        for e, (engine, (tau, p)) in enumerate(zip(self.engines, self._vectors(theta), strict=True)):
            if isinstance(engine, SplitEngine):
                found.append(engine.derivatives(tau, p, side, matrix, partial(evaluate, e, p)))
            else:
                found.append(evaluate(e, p, self.structures[e], engine, tau))
        return found

    @cached_property
    def sorted_breakpoints(self) -> Breakpoints:
        """The breakpoints of theta in the optimizer's form."""
        return Breakpoints.of(self.breakpoints())

    def breakpoints(self) -> list[FloatArray]:
        """Return the nodes at which derivatives may jump for each entry of theta: an empty array for parameters."""
        points = [np.zeros(0)] * len(self.problem.theta_names)
        for mesh, where in zip(self.meshes, self.problem.unknowns.times, strict=True):
            times = mesh.times
            for place in where[where >= 0].tolist():
                points[place] = times
        return points


def is_covered_by_paper(problem: Problem) -> bool:
    """Return whether the paper's equations cover all terms of the cost."""
    return not any(any(f is not None for f in s.transition_costs) for s in problem.structures)


@keep_with_problem
def evaluator_of(problem: Problem) -> Evaluator:
    """Return the problem's own evaluator, built once and cached; its meshes are refined at the initial guess."""
    return Evaluator(problem)


def evaluate(problem: Problem, theta: ArrayLike | None = None, *, method: Method = "auto") -> Evaluation[FloatArray]:
    """Evaluate the cost, the exact gradient and the exact Hessian of a problem.

    Parameters
    ----------
    problem : Problem
    theta : (d,) array_like, optional
        In the order of ``problem.theta_names``; the initial guess if left out.
    method : {"auto", "forward", "discrete-adjoint", "adjoint", "autodiff"}
        "forward" and "discrete-adjoint" differentiate the discretized cost by JAX: forward, and for the Hessian a
        second time forward or backward; "autodiff" is the same as "forward". "auto" evaluates the same derivatives by
        equations written by hand in machine code, which takes a tenth of the time; JAX evaluates where a function of
        the model cannot be compiled as straight-line code. "adjoint" evaluates the paper's equations (6)-(17), which
        agree with the others to the integration error.

    Returns
    -------
    Evaluation
        cost, gradient (d,), hessian (d, d); constraints (m,) and jacobian (m, d) if there are guards or terminal
        constraints.

    Raises
    ------
    ValueError
        For a theta of the wrong shape or with transition times out of order, or an unknown method.
    TypeError
        If an argument is of the wrong type.

    Notes
    -----
    The mesh is refined once, at the initial guess, so that J is one smooth function of theta. If a transition time
    equals a sample time, the derivatives are those for increasing it.

    See Also
    --------
    check_derivatives, evaluate_on_guards

    Examples
    --------
    >>> problem = heater_problem()

    >>> exact, paper = (sf.evaluate(problem, method=method) for method in ("autodiff", "adjoint"))
    >>> bool(abs(exact.gradient - paper.gradient).max() < 1e-4 * abs(exact.gradient).max())
    True
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    method = as_choice(method, "method", METHODS)
    evaluator = evaluator_of(problem)
    at = problem.check_theta(theta)
    found = evaluator(at, method=method)
    held = evaluator.constrained(at) if problem.constraint_names else found
    return replace(found, constraints=held.constraints, jacobian=held.jacobian, stiffness=evaluator.stiffness)


@dataclass(frozen=True, eq=False)
class GuardedEvaluation:
    """Cost and derivatives in the unknowns that guards leave free, r of them.

    Attributes
    ----------
    theta : (d,), with the guarded transition times on their guards
    names : tuple of str, the r free unknowns
    cost : J
    gradient : (r,)
    hessian : (r, r)
    times : (g,), the guarded transition times
    times_slope : (g, r), their derivatives

    See Also
    --------
    evaluate_on_guards, Evaluation

    Examples
    --------
    >>> one = np.ones(1)
    >>> found = sf.GuardedEvaluation(np.array([0.45, 9.8]), ("g",), 2.0, one, np.eye(1), 0.45 * one, -0.02 * np.eye(1))
    >>> found.names, found.cost
    (('g',), 2.0)
    """

    theta: FloatArray
    names: tuple[str, ...]
    cost: float
    gradient: FloatArray
    hessian: FloatArray
    times: FloatArray
    times_slope: FloatArray

    def __repr__(self) -> str:
        return format_line(self, f"J = {self.cost:.9g}", join_first(self.names))


def evaluate_on_guards(problem: Problem, theta: ArrayLike | None = None) -> GuardedEvaluation:
    """Evaluate cost, exact gradient and exact Hessian with guarded transitions where their guards put them.

    Parameters
    ----------
    problem : Problem
        With guards; every guarded transition time must be free.
    theta : (d,) array_like, optional
        The guarded times in it are where the search for them begins. The initial guess if left out.

    Returns
    -------
    GuardedEvaluation

    Raises
    ------
    ValueError
        Without guards, or if no transition times near `theta` meet them.
    TypeError
        If an argument is of the wrong type.

    See Also
    --------
    evaluate, HybridSystem

    Examples
    --------
    >>> fall = lambda t, x, p: jnp.array([x[1], -p["g"]])
    >>> rest = lambda t, x, p: jnp.zeros(2)
    >>> guards = {("fall", "rest"): lambda t, x, p: x[0]}
    >>> system = sf.HybridSystem({"fall": fall, "rest": rest}, [1.0, 0.0], guards=guards)
    >>> run = sf.Experiment(sf.TerminalCost(lambda x, p: x[1] ** 2), ("fall", "rest"), (0.4,), 0.0, 1.0)
    >>> found = sf.evaluate_on_guards(sf.Problem(system, run, {"g": 9.81}))
    >>> found.names, found.times.round(3)
    (('g',), array([0.452]))
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    evaluator, at = place_on_guards(problem, problem.check_theta(theta))
    guarded, rows = find_guards(problem)
    # lam = -C_g^-T J_g, gradient Z'J', Hessian Z' D^2 (J + lam . c) Z
    here = evaluator.constrained(at)
    Z = find_free_directions(problem, here.jacobian)
    multipliers = np.zeros(len(problem.constraint_names))
    multipliers[rows] = -np.linalg.solve(here.jacobian[np.ix_(rows, guarded)].T, here.gradient[guarded])
    return GuardedEvaluation(
        theta=at,
        names=tuple(name for k, name in enumerate(problem.theta_names) if k not in guarded),
        cost=here.cost,
        gradient=here.gradient @ Z,
        hessian=Z.T @ evaluator.constrained(at, multipliers=multipliers).hessian @ Z,
        times=at[guarded],
        times_slope=Z[guarded],
    )


def place_on_guards(problem: Problem, theta: FloatArray) -> tuple[Evaluator, FloatArray]:
    """Return theta with guarded transition times on their guards, and the problem on meshes for where they are.

    On the mesh of the first guess, the times of a stiff model miss their guards by more than their standard errors.

    Raises
    ------
    ValueError
        Without guards, or if no transition times near `theta` meet them.
    """
    near = _solve_guards(Evaluator(problem, theta), theta)
    evaluator = Evaluator(problem, near)
    return evaluator, _solve_guards(evaluator, near)


def find_free_directions(problem: Problem, jacobian: FloatArray) -> FloatArray:
    """Return the changes of theta that guards allow, one for each of the r unknowns that they leave free: (d, r).

    By the implicit function theorem, C being the Jacobian of the guards, g the guarded times and f the free unknowns,
    ``Z = (1, S)`` with ``S = -C_g^-1 C_f``.

    Parameters
    ----------
    problem : Problem
    jacobian : (m, d)
        Of all constraints.
    """
    guarded, rows = find_guards(problem)
    C, Z = jacobian[rows], np.delete(np.eye(jacobian.shape[1]), guarded, axis=1)
    Z[guarded] = -np.linalg.solve(C[:, guarded], np.delete(C, guarded, axis=1))
    return Z


def _solve_guards(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Move the guarded transition times of `theta` onto their guards, by Newton's method."""
    problem = evaluator.problem
    guarded, rows = find_guards(problem)
    for _ in range(ITERATIONS):
        here = evaluator.constrained(theta)
        c, C = here.constraints[rows], here.jacobian[np.ix_(rows, guarded)]
        if not (np.isfinite(c).all() and np.isfinite(C).all()) or np.linalg.cond(C) > 1e14:
            break
        step = np.zeros(len(theta))
        step[guarded] = -np.linalg.solve(C, c)
        # Shortened so that transitions stay in order: behind one another the guards are those of other states.
        theta = theta + _fraction(problem, theta, step) * step
        if np.all(np.abs(step[guarded]) <= NEGLIGIBLE * np.maximum(np.abs(theta[guarded]), 1.0)):
            return theta
    near, names = shorten(theta[guarded].round(6)), join_names(problem.theta_names[k] for k in guarded)
    raise ValueError(
        f"No transition times near {near} put {names} on their guards: the state does not "
        "reach a guard there, or grazes it. Give transition_times nearer to where the guards vanish (sf.simulate shows "
        "the states), or another mode_sequence."
    )


def _fraction(problem: Problem, theta: FloatArray, step: FloatArray) -> float:
    """Return the fraction of a step that keeps the transitions in order."""
    unknowns = problem.unknowns
    room, change = unknowns.A @ theta - unknowns.b, unknowns.A @ step
    closing = change < -1e-300
    return float(min(1.0, ROOM * np.min(np.maximum(room[closing], 0.0) / -change[closing], initial=np.inf)))


def find_guards(problem: Problem) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the positions in theta of the guarded transition times, and those of their guards among the constraints.

    Raises
    ------
    ValueError
        Without guards, or if a guarded time is fixed.
    """
    places = [problem.places[e][list(s.guarded)] for e, s in enumerate(problem.structures)]
    first = np.cumsum([0, *problem.constraint_counts])
    rows = [first[e] + np.arange(len(s.guarded)) for e, s in enumerate(problem.structures)]
    found = np.concatenate(places).astype(np.intp)
    if len(found) == 0:
        raise ValueError("This problem has no guards: give sf.HybridSystem(guards={(before, after): g}).")
    if np.any(found < 0):
        raise ValueError("A transition with a guard cannot have a fixed time: its guard says when it happens.")
    return found, np.concatenate(rows).astype(np.intp)


@keep_with_problem
def measure_variation(problem: Problem) -> FloatArray:
    """Return J of data that are met by their means alone, one for each experiment: (E,).

    NaN where J is anything but half a sum of squares of data (and priors): costs of the trajectory, a robust loss, a
    sigma that is a parameter.
    """
    if not problem.is_least_squares:
        return np.full(len(problem.experiments), np.nan)
    found = []
    for run in problem.experiments:
        items = [item for item in run.data if not isinstance(item, TerminalConstraint)]
        found.append(sum(_vary(item, run) for item in items) if items else np.nan)
    return np.array(found, dtype=np.float64)


def _vary(item: Any, run: Experiment) -> float:
    """Return half the weighted squares of data about the means of their channels; about 0 where these do not vary."""
    if isinstance(item, Measurements):
        y, w = np.nan_to_num(item.values), item.weights  # 0 where a value is missing
        mean = (w * y).sum(axis=0) / np.maximum(w.sum(axis=0), np.finfo(float).tiny)
        about_mean, about_zero = (w * (y - mean) ** 2).sum(axis=0), (w * y**2).sum(axis=0)
        return 0.5 * float(np.where(about_mean > NO_VARIATION**2 * about_zero, about_mean, about_zero).sum())
    if isinstance(item, ReferenceSignal):
        times = np.linspace(run.t0, run.end, REFERENCE_POINTS)
        followed = item.signal(times)
        deviation = followed - followed.mean(axis=0)
        return 0.5 * float(np.einsum("ki,ij,kj->", deviation, item.weights, deviation)) * float(times[1] - times[0])
    return np.nan


@keep_with_problem
def assume_noise(problem: Problem) -> float:
    """Return the standard deviation, in units of sqrt(J), that residuals may be expected to have: 1 where sigma is
    known, by itself or as a parameter; else `ASSUMED_NOISE` of what the data vary.

    A prior that shall be weak beside the data, whatever their unit, is multiplied by its square. 1 for any other cost.

    Parameters
    ----------
    problem : Problem
    """
    items = [item for run in problem.experiments for item in run.data]
    unscaled = [i for i in items if isinstance(i, ReferenceSignal) or (isinstance(i, Measurements) and i.sigma is None)]
    count = sum(item.count if isinstance(item, Measurements) else REFERENCE_POINTS for item in unscaled)
    variation = float(measure_variation(problem).sum())
    if not unscaled or not (np.isfinite(variation) and variation > 0):
        return 1.0
    return ASSUMED_NOISE * float(np.sqrt(2 * variation / count))
