"""The engine of experiments whose modes have corners: rows end at crossings, whose times are eliminated.

The crossings of a path are transitions of another structure, whose times sigma follow from theta by their guards
g(theta, sigma) = 0. With the derivatives of J and g in (theta, sigma), from an engine that knows nothing of corners,
the implicit function theorem gives those of J in theta alone: with the multipliers lam from

    ``g_sigma' lam = -J_sigma``,  and  ``S = dsigma/dtheta = -g_sigma^-1 g_theta``,

the gradient is ``J_theta + S' J_sigma``, and the Hessian ``T' D^2(J + lam . g) T`` with ``T = (1, S)``. A crossing at a
known time, as where an input jumps, has no guard: its S is 0.

The path is that of the last evaluation, and is looked for anew where it does not hold at another theta.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.adaptive.integrator import SolveSettings
from switchfit.engine.adaptive.step_times import find_path
from switchfit.engine.corners.branch_functions import are_equal
from switchfit.engine.corners.branches import Branches, BranchPath
from switchfit.engine.corners.course import Course, find_dips
from switchfit.engine.evaluation import DenseEvaluation, Engine, Evaluation, Matrix, build_undefined_evaluation
from switchfit.engine.jax.jax_engine import JaxEngine
from switchfit.engine.native.native_engine import NativeEngine
from switchfit.engine.run import Run
from switchfit.engine.simulation import Costates, Simulation, Tangents
from switchfit.problem.corners.branches import Corners, Sides
from switchfit.problem.structure import Structure
from switchfit.runtime.errors import NotIntegrableError

CROSSING_ITERATIONS, STEADY_ITERATIONS = 40, 8
"""After the second number steps have to become shorter: they halve where a crossing is nearly a tangent."""

TURNS = 0.25
"""Part of the last dg/dsigma below which the next one is beside an extremum of g: it halves at a tangent, where g is a
square and Newton's steps halve the distance."""

IDLE_ITERATIONS = 3
"""The same for crossings that change nothing: they may be tangents, and are where they are as far as `_holds` sees."""

CROSSING_FOUND, CROSSING_NEAR = 1e-15, 1e-8
"""Newton steps of the times of crossings, relative to the horizon, at which they are found: before and after it. A step
of 1e-8 leaves an error of its square, so that no evaluation is spent on seeing that."""

MAY_END = 1e-6
"""Part of the largest value of the function of an end below which a branch has passed it at a row: ten times what the
adaptive solve allows (`course.PASSED`), for rows of the mesh have errors of their own, and a path that just holds would
be looked for anew at each theta."""

LOST = "the trajectory cannot be followed through the corners of its modes at the guess: use a better guess."

SmoothEngine = NativeEngine | JaxEngine
"""Of a structure whose modes are smooth."""

Build = Callable[[Structure], SmoothEngine]
Evaluate = Callable[[Structure, SmoothEngine, FloatArray], DenseEvaluation]

OWN_TRANSITION = -2
"""A transition of the experiment, in the place of the end of a branch that a crossing is."""


class _Split(NamedTuple):
    """The engine of one path, and where its unknowns and constraints are among those of the engine.

    Attributes
    ----------
    path : BranchPath
    corners : list of Corners, of each mode
    structure : Structure
    engine : NativeEngine or JaxEngine
    own : (N,), the transitions of the experiment
    crossings : (K,), those of the path
    guarded : (K',), those of the crossings that have a guard
    idle : (I,), those that have one and change nothing, as in the middle of a play: J does not depend on their times
    own_constraints, guards, idle_guards : the rows of constraints of the experiment, and of these crossings
    """

    path: BranchPath
    corners: list[Corners]
    structure: Structure
    engine: SmoothEngine
    own: IntArray
    crossings: IntArray
    guarded: IntArray
    idle: IntArray
    own_constraints: IntArray
    guards: IntArray
    idle_guards: IntArray

    def hold(self, touched: BoolArray) -> _Split:
        """Return the same with some of the guarded crossings among the idle ones, at the times where they are."""
        return self._replace(
            guarded=self.guarded[~touched],
            guards=self.guards[~touched],
            idle=np.append(self.idle, self.guarded[touched]),
            idle_guards=np.append(self.idle_guards, self.guards[touched]),
        )

    @property
    def has_gauss_newton(self) -> bool:
        """Whether the engine has the Gauss-Newton matrix in place of second derivatives."""
        return self.structure.has_rough_hessian and isinstance(self.engine, NativeEngine)


class SplitEngine:
    """Evaluates one experiment whose modes have corners.

    Parameters
    ----------
    run : Run
    branches : Branches
        Of its modes.
    structure : Structure
        With the method of the steps of each mode.
    arguments : Arguments
    mesh : Mesh
    build : callable
        Returns the engine of a structure on the mesh.
    """

    def __init__(
        self, run: Run, branches: Branches, structure: Structure, arguments: Arguments, mesh: Mesh, build: Build
    ) -> None:
        self._run, self._branches, self._structure = run, branches, structure
        self._arguments, self._mesh, self._build = arguments, mesh, build
        self._split: _Split | None = None
        self._times: FloatArray = np.zeros(0)  # of all transitions of the path: (N + K,)
        self._judges_rows = False

    @property
    def engine(self) -> Engine:
        """The engine of the path; at the guess, where none is known."""
        at_guess = self._run.vectors(self._run.problem.initial_theta)
        return (self._split or self._recall_path() or self._find_path(*at_guess)).engine.engine

    @property
    def path(self) -> tuple[Any, ...]:
        """The branches that the last trajectory has run in, and their ends; empty where it could not be followed."""
        return () if self._split is None else self._split.path[:2]

    def judge_rows(self) -> None:
        """Estimate the errors of rows in all evaluations from now on."""
        self._judges_rows = True
        if self._split is not None:
            self._split.engine.judge_rows()

    @property
    def has_steep_corners(self) -> bool:
        """Whether trajectories have come to a corner beyond which a field is undefined."""
        return any(corners.margins for corners in self._branches.corners)

    def cost(self, tau: FloatArray, p: FloatArray) -> float:
        """Return J alone."""
        return self._solve(tau, p, 1.0)[1].cost

    @np.errstate(over="ignore", invalid="ignore")  # far from the data numbers may overflow
    def derivatives(
        self, tau: FloatArray, p: FloatArray, side: float, matrix: Matrix, method: Evaluate | None = None
    ) -> DenseEvaluation:
        """Return J and its derivatives; a `method` evaluates J of a structure and its times in another way."""
        split, found = self._solve(tau, p, side)
        if split is None:
            return found
        at = self._times, p, side
        found = split.engine.constrained(*at, np.zeros(len(found.constraints)))
        if split.has_gauss_newton and matrix == "exact":  # asked for all the same
            structure = replace(split.structure, has_rough_hessian=False)
            split = split._replace(structure=structure, engine=self._build_engine(structure))
            found = split.engine.constrained(*at, np.zeros(len(found.constraints)))
        own, (T, multipliers) = found, self._eliminate(split, found)
        if method is not None:
            own = method(split.structure, split.engine, self._times)
        elif matrix == "none" or (matrix == "gauss-newton" and not split.has_gauss_newton):
            own = split.engine.derivatives(*at, matrix)
        # T' D^2 (J + lam . g) T: the second derivatives of sigma(theta) enter by lam alone. `own` may be another matrix
        # of J; then lam . g is what the Hessian of the Lagrangian has beside that of J. Gauss-Newton is T' G T.
        second = own.hessian
        if matrix == "exact" and len(split.guards):
            second = second + split.engine.constrained(*at, multipliers).hessian - found.hessian
        return Evaluation(own.cost, own.gradient @ T, T.T @ second @ T, row_errors=found.row_errors)

    def constrained(self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray) -> DenseEvaluation:
        """Return J and the constraints, with the Hessian of ``J + multipliers . c``."""
        split, found = self._solve(tau, p, side, len(multipliers))
        if split is None:
            return found
        found = split.engine.constrained(self._times, p, side, np.zeros(len(found.constraints)))
        T, every_multiplier = self._eliminate(split, found, multipliers)
        second = split.engine.constrained(self._times, p, side, every_multiplier).hessian
        c, A = found.constraints[split.own_constraints], found.jacobian[split.own_constraints] @ T
        return Evaluation(found.cost, found.gradient @ T, T.T @ second @ T, c, A, found.row_errors)

    def costates(self, tau: FloatArray, p: FloatArray, multipliers: FloatArray) -> Costates:
        """Return the costates of ``J + multipliers . c`` at the starts of all rows."""
        split, found = self._solve(tau, p, 1.0)
        if split is None:
            raise NotIntegrableError(LOST)
        found = split.engine.constrained(self._times, p, 1.0, np.zeros(len(found.constraints)))
        inner = split.engine.costates(self._times, p, self._eliminate(split, found, multipliers)[1])
        # psi of a branch that slides holds along its corners alone: the trajectory comes back to these.
        psi, course = inner.costates.copy(), Course(self._branches, self._structure, self._arguments, p)
        for branch, function in self._branches.list_returns(self._structure).items():
            rows = inner.modes == branch
            back = course.evaluate(function, inner.times[rows], inner.states[rows], inner.times[rows])
            psi[rows] = np.einsum("rij,ri->rj", back, psi[rows])
        modes = np.array(self._structure.mode_of_segment)[np.searchsorted(tau, inner.times, "right")]
        return inner._replace(modes=modes, costates=psi)

    def slopes(self, times: FloatArray, cells: IntArray, states: FloatArray, p: FloatArray) -> FloatArray:
        """Return the vector fields of all modes at given points."""
        return self._plain.slopes(times, cells, states, p)

    @cached_property
    def _plain(self) -> SmoothEngine:
        return self._build(self._structure)

    def simulate(self, tau: FloatArray, p: FloatArray, *, tangents: bool) -> Simulation:
        """Return all rows, with their derivatives if `tangents`; crossings are nodes of the simulation."""
        split, found = self._solve(tau, p, 1.0)
        # States can be shown up to where the path is lost; derivatives are those of a path that holds.
        split = split or (None if tangents else self._split)
        if split is None:
            raise NotIntegrableError(LOST)
        times = self._move_own(split, tau)
        inner = split.engine.simulate(times, p, tangents=tangents)
        # Users see the experiment's own segments, with crossings as nodes inside them: cells = rows - segments again.
        begins = np.append(0, 1 + split.own)[: len(self._structure.mode_of_segment)]
        own = inner.first_row[begins[begins < len(inner.first_cell)]]  # without the rest after a free tf
        nodes = np.sort(np.concatenate([inner.nodes, times[split.crossings]]))
        simulation = replace(inner, nodes=nodes, first_cell=own - np.arange(len(own)))
        if inner.tangents is None:
            return simulation
        # dx/dtheta = x_theta + x_sigma S: the columns of the crossings are spread over those of theta.
        T, _ = self._eliminate(split, found)
        return replace(simulation, tangents=Tangents(*(values @ T for values in inner.tangents)))

    def _eliminate(
        self, split: _Split, found: DenseEvaluation, multipliers: FloatArray | float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return T (N + K + M, N + M), and the multipliers of all constraints, those of the experiment given."""
        A, rows, times, D = found.jacobian, split.guards, split.guarded, len(found.gradient)
        # theta = (tau, p), in the order of all unknowns (tau and sigma merged, then p).
        others = np.delete(np.arange(D), split.crossings)
        T, every = np.eye(D)[:, others], np.zeros(len(found.constraints))
        every[split.own_constraints] = multipliers
        slope = found.gradient + every @ A
        # g_sigma is lower triangular in exact arithmetic, a guard depending on the crossings before it; S =
        # -g_sigma^-1 g_theta.
        square = A[rows[:, None], times]
        try:
            T[times] = -np.linalg.solve(square, A[rows[:, None], others])
            every[rows] = -np.linalg.solve(square.T, slope[times])
        except np.linalg.LinAlgError:  # a corner is just touched: J has no derivatives
            T[times], every[rows] = np.nan, np.nan
        return T, every

    def _solve(self, tau: FloatArray, p: FloatArray, side: float, m: int = 0) -> tuple[_Split | None, DenseEvaluation]:
        """Return the path at a theta, J, and the constraints with their derivatives there, and keep its times.

        If the trajectory cannot be followed, J and m constraints are NaN and there is no path.
        """
        # First the path of the last theta, by Newton from its times: near the solution it holds, and no adaptive solve
        # is needed.
        last = self._split or self._recall_path()
        if last is not None:
            split, found, times = self._locate(last, tau, p, side)
            if found is not None and self._holds(split, times, p):
                self._times = times
                return split, found
        with suppress(NotIntegrableError):
            split, found, times = self._locate(self._find_path(tau, p), tau, p, side)
            if found is not None:
                self._times = times
                return split, found
        D, row_errors = len(tau) + len(p), (np.inf,) if self._judges_rows else ()  # another mesh may do
        return None, build_undefined_evaluation(D, m, row_errors)

    def _build_engine(self, structure: Structure) -> SmoothEngine:
        engine = self._build(structure)
        if self._judges_rows:
            engine.judge_rows()
        return engine

    def _recall_path(self) -> _Split | None:
        """Return the last path of the experiment on any mesh, None if there is none."""
        path = self._run.path
        if path is not None:
            self._branches.add(self._structure, path)
            self._take(path)
        return self._split

    def _find_path(self, tau: FloatArray, p: FloatArray) -> _Split:
        """Look for the path at a theta, and keep it."""
        settings = SolveSettings(implicit=[each.mode for each in self._mesh.stiffness])
        self._run.path = find_path(self._run, self._branches, tau, p, self._mesh, settings)[1]
        return self._take(self._run.path)

    def _take(self, path: BranchPath) -> _Split:
        """Keep a path with the times of its crossings."""
        split, corners = self._split, self._branches.corners
        # Programs and engine stay as long as the branches do, though the times change with each theta.
        known = None if split is None else (split.path.sides, split.path.ends, split.corners)
        if split is None or known != (path.sides, path.ends, corners):
            structure = self._branches.get_structure(self._structure, path)
            # Transitions in the order of time: the crossings of segment i, then its own transition i.
            kinds = np.concatenate([[*ends, OWN_TRANSITION] for ends in path.ends])[:-1]
            modes = [structure.modes[k] for k in structure.mode_of_segment]
            is_idle = np.array([kind >= 0 and are_equal(*modes[i : i + 2]) for i, kind in enumerate(kinds)], dtype=bool)
            every = kinds == OWN_TRANSITION, kinds != OWN_TRANSITION, (kinds >= 0) & ~is_idle, is_idle
            own, crossings, guarded, idle = map(np.flatnonzero, every)
            guards, idle_guards = (np.searchsorted(structure.guarded, which) for which in (guarded, idle))
            rows = np.arange(len(structure.guarded) + structure.terminal_constraint_count)
            others = np.delete(rows, np.append(guards, idle_guards))
            places = own, crossings, guarded, idle, others, guards, idle_guards
            split = _Split(path, corners.copy(), structure, self._build_engine(structure), *places)
        self._split, self._times = split, np.zeros(len(split.own) + len(split.crossings))
        # From here Newton's method starts at the next theta.
        self._times[split.crossings] = path.times
        return split

    def _move_own(self, split: _Split, tau: FloatArray) -> FloatArray:
        """Return the times of all transitions of a path, the experiment's being tau: (N + K,)."""
        times = self._times.copy()
        times[split.own] = tau
        return times

    def _locate(
        self, split: _Split, tau: FloatArray, p: FloatArray, side: float
    ) -> tuple[_Split, DenseEvaluation | None, FloatArray]:
        """Find the times of the crossings by Newton's method from the last ones; the evaluation is None if there are
        none. Crossings that turn out to touch their corner alone are idle in the split that is returned.
        """
        ends, times = self._mesh.times[[0, -1]], self._move_own(split, tau)
        most, last, previous = np.zeros(len(times)), np.inf, times.copy()
        most[split.crossings] = MAY_END * split.path.scales
        slopes, values, idle = np.zeros(len(times)), np.full(len(times), np.inf), split.idle
        for k in range(CROSSING_ITERATIONS):
            # A Newton step that changes the order of transitions leaves what the structure can say: the path is found
            # anew.
            if not (np.diff([ends[0], *times, ends[1]]) >= 0.0).all():
                break
            found = split.engine.find_constraints(times, p, side)
            # J may be no number yet: sqrt(x) of the branch behind a crossing that is a little too early. What ends the
            # branch before it, and its derivatives, are numbers all the same.
            try:
                # sigma -= g_sigma^-1 g, all other unknowns being fixed.
                square = found.jacobian[np.ix_(split.guards, split.guarded)]
                step = np.linalg.solve(square, found.constraints[split.guards])
            except np.linalg.LinAlgError:
                break
            # How far each crossing moves, as a part of the horizon, and how far from its corner it is.
            own, g = np.abs(step) / (ends[1] - ends[0]), np.abs(found.constraints[split.guards])
            size = float(own.max(initial=0.0))
            if not np.isfinite(size):
                break
            # Where g is all but zero and has no zero, the corner is touched, up to errors of the solver.
            slope, before, where = square.diagonal(), values[split.guarded], split.guarded
            turned = slope * slopes[where] < TURNS * slopes[where] ** 2
            touched = turned & (own > CROSSING_NEAR) & (np.minimum(g, before) <= most[where])
            if touched.any():
                back = where[touched & (before < g)]
                times[back] = previous[back]
                split = split.hold(touched)
                continue
            slopes[where], values[where], previous = slope, g, times.copy()
            if k >= STEADY_ITERATIONS and size > last:
                break
            last = size
            if len(idle) and k < IDLE_ITERATIONS:
                bounds = np.array([ends[0], *times, ends[1]])
                moved = times[idle] - self._step_idle(split, found, step)[: len(idle)]
                moved = np.clip(moved, bounds[idle], bounds[idle + 2])
                size = max(size, np.abs(moved - times[idle]).max() / (ends[1] - ends[0]))
                times[idle] = moved
            if size > CROSSING_FOUND:
                times[split.guarded] -= step
            if size <= CROSSING_NEAR:  # the next step is of the size of rounding
                if size > CROSSING_FOUND:
                    found = split.engine.find_constraints(times, p, side)
                return split, (found if np.isfinite(found.cost) else None), times
        return split, None, times

    def _step_idle(self, split: _Split, found: DenseEvaluation, step: NDArray[Any]) -> NDArray[Any]:
        """Return the Newton steps of crossings that change nothing beside the `step` of the others."""
        A, rows = found.jacobian, split.idle_guards
        with np.errstate(all="ignore"):
            own = found.constraints[rows] - A[np.ix_(rows, split.guarded)] @ step
            return np.nan_to_num(own / A[rows, split.idle], posinf=0.0, neginf=0.0)  # it may be touched alone

    def _holds(self, split: _Split, times: FloatArray, p: FloatArray) -> bool:
        """Return whether the trajectory is inside its branches at the ends of all rows, and in dips between them."""
        found = split.engine.simulate(times, p, tangents=False)
        course = Course(self._branches, self._structure, self._arguments, p)
        # All rows of one branch together: one call evaluates the functions of its ends for all of them.
        pairs = zip(self._structure.mode_of_segment, split.path.sides, strict=True)
        rows: dict[tuple[int, Sides], list[int]] = {}
        for branch, part in zip([(k, sides) for k, every in pairs for sides in every], found.segments, strict=False):
            rows.setdefault(branch, []).extend(range(part.start, part.stop))
        # g relative to its largest value in this mode, where it may rest at zero; s of a sliding corner to its range.
        scales = {mode: np.zeros(self._branches.corners[mode].count) for mode, _ in rows}
        seen = []
        for (mode, sides), here in rows.items():
            if here and sides:
                of_end, slides = course.list_ends(mode, sides)
                ends, at = self._branches.corners[mode].ends(sides), found.end[here]
                values = course.evaluate(ends, at, found.after[here], np.nextafter(at, -np.inf))
                np.maximum.at(scales[mode], of_end, np.where(slides, 0.0, np.abs(values).max(axis=0)))
                seen.append((mode, sides, np.array(here), values))
        for mode, sides, own, values in seen:
            of_end, slides = course.list_ends(mode, sides)
            least = MAY_END * np.where(slides, 1.0, scales[mode][of_end])
            if (values < -least).any():
                return False
            # Between two rows, in a branch that goes on at both sides of them.
            moves = np.abs(np.diff(values, axis=0)) > least
            dips = (find_dips(values)[1:-1] & (moves[:-2] | moves[2:])).any(axis=1) & (own[3:] - own[:-3] == 3)
            for row in np.flatnonzero(dips).tolist():
                step = own[row + 1 : row + 3]
                if course.leaves(mode, sides, found.end[step], found.after[step], -least):
                    return False
        return True
