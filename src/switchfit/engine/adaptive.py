"""Choose the mesh from an adaptive solve at one or more thetas.

The step sizes of the solve determine into how many cells each interval between two
required nodes is divided; the mesh is then frozen while theta moves. With ``solver="auto"``, the modes that are stiff
(`switchfit.engine.stiffness`) take implicit steps. Each mode thus has the cells that its own method needs.

The adaptive solve of one experiment, which tells how many steps the mesh needs where.

It has the same order as the fixed steps that follow, and integrates the running costs too, so that the mesh resolves
them. Solves run in machine code if possible: a hundred steps take less than a tenth of a millisecond there, and ten
milliseconds in Python. SciPy solves models without machine code, and repeats a solve that failed, for its error
message: by RK45, whose step size control is that of `switchfit.discretization.rows`, and in modes that take
implicit steps by Radau.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import sub
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.discretization.mesh import Mesh, Stiffness
from switchfit.discretization.model import Model, Piece, read_parameters
from switchfit.discretization.rows import EXPONENT, STIFF_EXPONENT, Tolerances, first_step
from switchfit.engine import branches
from switchfit.engine.branches import MOST_FOUND, BranchError, Branches, Course, Crossing, Path, SteepError
from switchfit.engine.jax import call_model
from switchfit.engine.native.engine import NativeExperiment, native_experiment
from switchfit.engine.native.program import AT
from switchfit.engine.native.templates import Order
from switchfit.engine.protocol import Run, runs_of, take_implicit_steps
from switchfit.engine.stiffness import STEPS_BETWEEN_AFTER_FAILURE, Choice, Look, TooManyStepsError, Watch
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.inspection import find_undefined
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache
from switchfit.runtime.errors import NotIntegrableError

Slope = Callable[[float, FloatArray], FloatArray]
"""The derivative (n + 1,) of the state and of the running cost so far at a time."""

MAX_STEPS = 200_000
"""Largest number of adaptive steps in one mode; a mode that needs more cannot be integrated."""

PACE = 1000
"""Steps over which the pace of a mode is measured, so that a stiff mode is refused early."""

MOST_PROJECTED = 1e15
"""Number of steps from which it does not matter how many they are: for an end of 1e308 they overflow."""

STEPS_OF_BRANCH = 16
"""Steps that the compiled solver accepts in one call in a mode with corners: those behind the end of a branch are lost.
In another mode, they are those between two looks of the watch.
"""


ROWS_BY_JAX = {True: 20_000, False: 200_000}
"""Work of an explicit and of an implicit row in JAX, in additions of machine code: 5 and 50 us, for 2 to 4 states."""


@dataclass(frozen=True)
class Settings:
    """How an experiment is solved adaptively.

    Attributes
    ----------
    implicit : names of the modes that take implicit steps although the problem does not say so
    watch : Watch or None
        Counts the steps.
    most : int
        Largest number of steps in a mode: if these are fewer than by default, a failure of machine code is not
        repeated in Python for its reason.
    """

    implicit: Container[str] = ()
    watch: Watch | None = None
    most: int = MAX_STEPS


def solve_adaptively(run: Run, theta: FloatArray, settings: Settings = Settings()) -> FloatArray:
    """Return the accepted times of the adaptive solver from t0 to tf, strictly increasing."""
    tau, p = run.vectors(theta)
    if run.branches is not None:
        try:
            return find_path(run, run.branches, tau, p, run.coarse, settings)[0]
        except branches.TooManyCrossingsError as error:
            if run.path is not None:  # a trial far from the guess
                raise
            # Too many crossings at the guess: once more without following them, with short steps at each corner.
            known, run.branches = run.branches, None
            try:
                return _Solve(run, run.structure, run.coarse, settings)(tau, p)
            except NotIntegrableError as stuck:  # for it rests, or switches ever faster
                run.branches = known
                if known.most == branches.MOST_AT_GUESS:
                    raise error from stuck
                known.most = branches.MOST_AT_GUESS
                return solve_adaptively(run, theta, settings)
    return _Solve(run, run.structure, run.coarse, settings)(tau, p)


def find_path(
    run: Run, branches: Branches, tau: FloatArray, p: FloatArray, coarse: Mesh, settings: Settings
) -> tuple[FloatArray, Path]:
    """Return what `solve_adaptively` does for an experiment whose modes have corners, and the path of the trajectory.

    Branches that no trajectory has run in before are solved in Python at first, so that machine code is compiled once
    for all of them.
    """
    # Each round ends with a path, or finds branches that are not compiled yet. Once no round adds a branch, the path
    # was followed with the final library, and its steps are those that machine code will take.
    while True:
        known = branches.get_structure(run.structure) if branches.count else run.structure
        smallest = run.problem.atol / run.problem.rtol
        course, count = Course(branches, known, run.build_arguments(coarse), p, smallest), branches.count
        steps = None
        try:
            steps = _Solve(run, known, coarse, settings, course)(tau, p)
        except SteepError:
            continue  # nothing is compiled yet with its margin
        except BranchError:
            pass
        branches.add(run.structure, course.path)
        if steps is not None and branches.count == count:
            return steps, course.path


class _NativeError(Exception):
    """Machine code cannot go on: SciPy finds out why."""


class _Stretch(NamedTuple):
    """A part of the horizon without a transition or a knot of the inputs: mode, start and end, state at the start
    (n,), and whether it is solved by explicit steps.
    """

    mode: int
    start: float
    end: float
    x: FloatArray
    is_explicit: bool = True

    @property
    def middle(self) -> float:
        """A time inside it."""
        return 0.5 * (self.start + self.end)


class _NativeSteps:
    """Adaptive steps in machine code through a stretch, in a mode of its own structure: up to `t` and `y` so far."""

    message = None  # of a failure: SciPy has it

    def __init__(self, native: NativeExperiment, mode: int, stretch: _Stretch, p: FloatArray, given: Tolerances):
        self._native, self._mode, self._p, self._end = native, mode, p, stretch.end
        self.y, (start, end) = np.append(stretch.x, 0.0), stretch[1:3]
        exponent = EXPONENT if stretch.is_explicit else STIFF_EXPONENT
        step = first_step(self.slope, start, self.y, end, given, exponent)
        self._state = np.zeros(len(AT))
        self._state[[AT.t, AT.step, AT.end, AT.rtol, AT.atol]] = start, step, end, *given
        # Times at which signals are read are kept strictly inside the stretch: at its ends an input may jump.
        self._state[[AT.low, AT.high]] = np.nextafter(start, end), np.nextafter(end, start)
        self.t, self.is_running = start, True

    def slope(self, t: float, y: FloatArray) -> FloatArray:
        """Return the slope at a time."""
        return self.slopes(np.array([t]), y[None])[0]

    def slopes(self, times: FloatArray, y: FloatArray) -> FloatArray:
        """Return the slopes at times (L,) and y (L, n + 1); NaN where the model is not defined."""
        return self._native.slopes_in(self._mode, times, y, self._p)

    def advance(self, most: int) -> tuple[FloatArray, FloatArray]:
        """Take up to `most` steps; return the accepted times (L,) and the states there (L, n)."""
        found = self._native.adaptive_steps(self._mode, self._state, self.y, self._p, most)
        self.t = float(self._state[AT.t])
        self.is_running = self.t < self._end and not self._state[AT.stuck]
        return found


class _PythonSteps:
    """Adaptive steps of SciPy through a stretch, with slopes from Python: up to `t` and `y` so far."""

    def __init__(self, slope: Slope, stretch: _Stretch, given: Tolerances) -> None:
        from scipy.integrate import RK45, Radau  # here, since importing it takes longer than most fits

        method, self._slope = RK45 if stretch.is_explicit else Radau, slope
        self.message: str | None = None
        self.t, self.y, self.is_running = stretch.start, np.append(stretch.x, 0.0), True
        with np.errstate(all="ignore"):  # a slope of 1e300 is refused with a message
            self._solver = method(slope, self.t, self.y, stretch.end, rtol=given.rtol, atol=given.atol)

    def slopes(self, times: FloatArray, y: FloatArray) -> FloatArray:
        """Return the slopes at times (L,) and y (L, n + 1), outside of the solve too; NaN where the model is not
        defined.
        """
        found = np.full(y.shape, np.nan)
        with use_float64(), use_compilation_cache():
            for k, t in enumerate(times.tolist()):
                with suppress(NotIntegrableError):
                    found[k] = self._slope(t, y[k])
        return found

    def advance(self, most: int) -> tuple[FloatArray, FloatArray]:
        """Take a step; return the accepted time (1,) and the state there (1, n), none if it has failed."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a state that overflows is refused
            self.message = self._solver.step()
        self.t, self.y, self.is_running = float(self._solver.t), self._solver.y, self._solver.status == "running"
        taken = slice(int(self.message is None))
        return np.array([self.t])[taken], self.y[None, :-1][taken]


class _Solve:
    """An adaptive solve of one experiment; arguments as in `solve_adaptively`.

    Parameters
    ----------
    structure : Structure
        Of the library whose machine code is used; if modes have corners, it is that of the branches of the `course`.
    """

    def __init__(
        self, run: Run, structure: Structure, coarse: Mesh, settings: Settings, course: Course | None = None
    ) -> None:
        self._problem, self._structure, self._coarse, self._course = run.problem, run.structure, coarse, course
        self._library = structure
        self._experiment, self._settings, self._watch = run.experiment, settings, settings.watch or Watch()
        inputs = run.experiment.inputs
        # Inputs may jump at their knots: a step across one would be rejected down to its smallest size.
        self._stops = np.union1d([] if inputs is None else inputs.times, run.corner_times)
        self._unit = unit_suffix(self._experiment.time_unit)
        self._tolerances = Tolerances(self._problem.rtol, self._problem.atol)
        self._whole = whole = run.build_arguments(coarse)
        self._arguments = whole.without_mesh()
        self._native: NativeExperiment | None = None
        # Modes that were found stiff take implicit steps here, which the structure does not say yet: a program apart.
        chosen = take_implicit_steps(structure, settings.implicit)
        if course is None or course.branches.count:
            known = run.solvers.__dict__ if coarse is run.coarse else {}
            key = f"{'' if course is None else course.branches.version} {chosen.implicit}"
            if key not in known:
                made = (native_experiment(each, whole, coarse.times, Order.COST) for each in (chosen, structure))
                known[key] = next(filter(None, made), None)
            self._native = known[key]
        self._p = np.zeros(0)

    def __call__(self, tau: FloatArray, p: FloatArray) -> FloatArray:
        """Return the accepted times from t0 to tf, strictly increasing."""
        structure, experiment, self._p = self._structure, self._experiment, p
        ends = np.concatenate([[experiment.t0], tau, [experiment.end]])
        steps, x = [ends[:1]], self._find_initial_state()
        for i, mode in enumerate(structure.mode_of_segment):
            if i > 0 and structure.reset_maps[i - 1] is not None:
                x = self._apply_reset(i - 1, ends[i], x)
            inside = (self._stops > ends[i]) & (self._stops < ends[i + 1])
            stops = np.concatenate([[ends[i]], self._stops[inside], [ends[i + 1]]])
            name = structure.mode_names[mode]
            is_explicit = not structure.implicit[mode] and name not in self._settings.implicit
            self._watch.enter(name, self._find_row_work(name, is_explicit))
            if self._course is not None:
                self._course.enter(mode, ends[i], x, 0.5 * (stops[0] + stops[1]))
            middle = ends[i]
            for start, end in pairwise(stops.tolist()):
                if end > start:
                    before, middle = middle, 0.5 * (start + end)
                    if self._course is not None and start > ends[i]:
                        self._course.resume(start, x, middle, before)
                    accepted, x = self._follow(_Stretch(mode, start, end, x, is_explicit))
                    steps += accepted
                    if self._settings.watch is not None:
                        self._watch.mode.rows += _count_rows(np.concatenate([[start], *accepted]), self._coarse.times)
        return np.concatenate(steps)

    def _find_initial_state(self) -> FloatArray:
        native, p = self._native, self._p
        if native is None:
            x = self._call_model(Model.initial_state, structure=self._structure.functions)
        else:
            x = native.initial_state(p)
        if not np.isfinite(x).all():
            named = read_parameters(self._structure, self._arguments, p)
            rounded = {name: np.round(value, 6).tolist() for name, value in named.items()}
            raise _report_infinite(f"initial_state at p = {rounded}", x)
        return x

    def _apply_reset(self, i: int, t: float, x: FloatArray) -> FloatArray:
        """Return the state after the reset map of transition i (from 0)."""
        structure, native, p = self._structure, self._native, self._p
        if native is None:
            after = self._call_model(_apply_reset, t, x, structure=structure, which=(i,))
        else:
            after = native.after_reset(i, t, x, p)
        if not np.isfinite(after).all():
            names = tuple(structure.mode_names[k] for k in structure.mode_of_segment[i : i + 2])
            what = "the map of a Jump" if i in structure.jumps else f"reset map {names}"
            raise _report_infinite(f"{what} at t = {t:.6g}{self._unit}, x = {x.tolist()}", after)
        return after

    def _find_row_work(self, name: str, is_explicit: bool) -> float:
        """Return the work of a row of a mode on the engine that will evaluate it."""
        native = self._native
        if native is not None and self._problem.engine != "jax" and name in native.structure.mode_names:
            place = native.structure.mode_names.index(name)
            if native.structure.implicit[place] is not is_explicit:
                return native.row_work[place]
        return ROWS_BY_JAX[is_explicit]

    def _follow(self, stretch: _Stretch) -> tuple[list[FloatArray], FloatArray]:
        """Return the accepted times after the start of a stretch, from branch to branch, and the state at its end."""
        steps: list[FloatArray] = []
        # From branch to branch: each ends where the trajectory crosses a corner, at a state on the cubic of the step.
        while True:
            accepted, x, crossing = self._solve(stretch)
            steps.append(accepted[accepted > stretch.start])
            if crossing is None or self._course is None:
                return steps, x
            # The middle of what is left of the stretch says which cell of the signals is meant at its ends.
            rest = stretch._replace(start=crossing.time, x=x)
            is_end = crossing.time >= stretch.end
            self._course.cross(crossing, (stretch if is_end else rest).middle)
            if is_end:
                return steps, x
            stretch = rest

    def _solve(self, stretch: _Stretch) -> tuple[FloatArray, FloatArray, Crossing | None]:
        """Return the accepted times after the start of a stretch, the state at its end, and where it leaves a branch,
        if it does: it ends there.
        """
        native, course, watch, mode = self._native, self._course, self._watch, stretch.mode
        if course is not None:
            # A branch that is not compiled yet goes on in Python, without running costs: the path alone is wanted from
            # this round.
            place = course.branches.find(self._structure, mode, course.sides)
            if place is None:
                branch, stretch = course.corners.branch(course.sides), stretch._replace(is_explicit=True)

                def slope(t: float, y: FloatArray) -> FloatArray:
                    """Return the slope in a branch that is not in the library yet, without running costs."""
                    value = course.evaluate(branch, t, y[:-1], stretch.middle)
                    if t == stretch.start and np.isnan(value).any():  # SciPy would look for a first step without end
                        raise BranchError
                    return np.append(value, 0.0)

                return self._take_steps(stretch, _PythonSteps(slope, stretch, self._tolerances), Watch(), MOST_FOUND)
            mode = place
        # Machine code has one method per mode: it serves where that is the method asked for.
        if native is not None and native.structure.implicit[mode] is not stretch.is_explicit:
            with suppress(_NativeError):
                return self._take_steps(stretch, _NativeSteps(native, mode, stretch, self._p, self._tolerances), watch)
            if self._settings.most < MAX_STEPS:
                raise self._report_stuck(stretch, stretch.start, stretch.x, None)
            watch = Watch()  # machine code has counted its steps
        with use_float64(), use_compilation_cache():
            steps = _PythonSteps(self._build_slope(stretch, mode), stretch, self._tolerances)
            return self._take_steps(stretch, steps, watch)

    def _take_steps(
        self, stretch: _Stretch, steps: _NativeSteps | _PythonSteps, watch: Watch, most_of_branch: float = np.inf
    ) -> tuple[FloatArray, FloatArray, Crossing | None]:
        """Do what `_solve` does by steps of one kind."""
        course, natively = self._course, isinstance(steps, _NativeSteps)
        accepted, x, reason = [stretch.start], stretch.x, None
        # Between two calls Python looks: for corners that the steps have passed, and for stiffness.
        at_once = watch.between if course is None else STEPS_OF_BRANCH
        while steps.is_running:
            if len(accepted) > most_of_branch:
                raise BranchError
            # At the pace of the last steps: a stiff mode is given up after thousands of steps, not after MAX_STEPS.
            if len(accepted) >= 5 * PACE and _project_steps(accepted, stretch.end) > self._settings.most:
                if natively and not np.isfinite(steps.y).all():
                    raise _NativeError
                watch.mode.projected = _project_steps(accepted, stretch.end)
                reason = f"it needs more than {self._settings.most} steps"
                break
            times, states = steps.advance(at_once)
            if course is not None:
                # Steps behind a crossing were taken by the field of the wrong branch, and are dropped.
                crossing = course.look(np.append(accepted[-1], times), np.concatenate([x[None], states]))
                if crossing is not None:
                    accepted += times[times < crossing.time].tolist()
                    return np.array([*accepted[1:], crossing.time]), crossing.state, crossing
            accepted += times.tolist()
            x = steps.y[:-1].copy()
            # From time to time the watch estimates whether stability limits the explicit steps, from the last one of
            # them.
            if watch.add(len(times), not steps.is_running) and len(times) and stretch.is_explicit:
                smallest = self._tolerances.atol / self._tolerances.rtol
                step = max(map(sub, accepted[-1:-3:-1], accepted[-2:-4:-1]))  # the end may cut the last one
                watch.look(Look(step, steps.slopes, accepted[-1], steps.y.copy(), smallest))
                if len(accepted) > PACE and watch.is_clear():
                    watch.mode.projected = _project_steps(accepted, stretch.end)
                    raise TooManyStepsError
        # Stuck, or at rest, beside a corner beyond which the field is undefined.
        if course is not None:
            course.look_beyond(steps.t, steps.y[:-1], 0.5 * (steps.t + stretch.end))
        if steps.t < stretch.end or not np.isfinite(steps.y).all():
            if natively and reason is None:
                raise _NativeError
            raise self._report_stuck(stretch, steps.t, steps.y[:-1], reason or steps.message)
        return np.array(accepted[1:]), steps.y[:-1], None

    def _build_slope(self, stretch: _Stretch, mode: int) -> Slope:
        """Return the slope of a mode of the library by JAX; it raises where it is not finite."""
        functions = self._library.functions
        functions = replace(functions, implicit=(False,) * len(functions.modes))  # one program for both methods
        times, start, end = self._coarse.times, stretch.start, stretch.end
        first, last = np.nextafter(start, end), np.nextafter(end, start)

        def slope(t: float, y: FloatArray) -> FloatArray:
            cell = min(int(times.searchsorted(min(max(t, first), last), "right")) - 1, len(times) - 2)
            piece = Piece(times[cell], self._whole.signals[cell])
            given = self._arguments, piece, t, y[:-1], self._p
            value = np.asarray(call_model(*given, structure=functions, function=_field_and_density, which=(mode,)))
            if not np.isfinite(value).all():
                raise self._report_infinite_slope(mode, t, y[:-1], value, piece)
            return value

        return slope

    def _call_model(self, function: Callable[..., jax.Array], *given: Any, **settings: Any) -> FloatArray:
        """Return the value of a function of the model, at the parameters."""
        with use_float64(), use_compilation_cache():
            return np.asarray(call_model(self._arguments, *given, self._p, function=function, **settings))

    def _report_stuck(self, stretch: _Stretch, t: float, x: FloatArray, reason: str | None) -> NotIntegrableError:
        """Return the error of a solve that cannot go on beyond t, where x is the state."""
        remedy = "use solver='stiff', or a better guess" if stretch.is_explicit else "use a better guess"
        if self._problem.solver == "auto":
            remedy = "use a better guess, or solver='stiff' if the mode is stiff"
        return NotIntegrableError(
            f"mode {self._structure.mode_names[stretch.mode]!r} cannot be integrated at the guess beyond t = {t:.6g}"
            f"{self._unit}, where x = {x.tolist()} ({reason}): {remedy}."
        )

    def _report_infinite_slope(
        self, mode: int, t: float, x: FloatArray, value: FloatArray, piece: Piece
    ) -> NotIntegrableError:
        """Return the error of a slope or a running cost, the last of the values (n + 1,), that is not finite."""
        name = self._library.mode_names[mode]
        if np.isfinite(value[:-1]).all():
            what, operation = f"a running cost in mode {name!r} returned {value[-1]}", ""
        else:
            what, operation = f"mode {name!r} returned {value[:-1].tolist()}", self._find_operation(mode, t, x, piece)
        return NotIntegrableError(
            f"{what} at t = {t:.6g}{self._unit}, x = {x.tolist()}{operation}: the guess leads to where the model is "
            "not defined or grows without bound; use a better guess, or change the model there."
        )

    def _find_operation(self, mode: int, t: float, x: FloatArray, piece: Piece) -> str:
        """Return which operation of the mode is not finite at t and x (n,), " (log at tank.py:5)"; empty if all are."""
        model, function = Model(self._library, self._arguments), self._library.modes[mode]
        points = t, x, *model.inputs(function, t, piece)  # type: ignore[arg-type]  # of NumPy
        parameters = model.parameters(self._p)  # type: ignore[arg-type]
        found = find_undefined(function, [np.asarray(a)[None] for a in points], parameters, derivatives=False)
        return "" if found is None else f" ({' at '.join(filter(None, (found.operation, found.line)))})"


def _count_rows(steps: FloatArray, nodes: FloatArray) -> int:
    """Return how many rows a mesh with these nodes has that has such steps, which begin and end at these times."""
    ends = np.concatenate([steps[:1], nodes[(nodes > steps[0]) & (nodes < steps[-1])], steps[-1:]])
    # As `Mesh.refine`: the number of steps in each cell, rounded up, and one at least.
    return int(np.maximum(np.ceil(np.diff(np.interp(ends, steps, np.arange(len(steps))))), 1).sum())


def _project_steps(accepted: Sequence[float], end: float) -> float:
    """Return how many steps a solve takes to the end at the pace of the last `PACE` steps, or `MOST_PROJECTED`."""
    left, recent = float(end - accepted[-1]), float(accepted[-1] - accepted[-PACE - 1])
    return min(len(accepted) + PACE * left / recent, MOST_PROJECTED)  # in floats, which overflow without a warning


def _report_infinite(what: str, state: FloatArray) -> NotIntegrableError:
    return NotIntegrableError(f"{what} returned {state.tolist()}, which is not finite: use a better guess.")


def _apply_reset(model: Model, i: int, t: jax.Array, x: jax.Array, p: jax.Array) -> jax.Array:
    """Return the state after the reset map of transition i (from 0): (n,)."""
    return model.reset(i)(t, x, p)


def _field_and_density(model: Model, mode: int, piece: Piece, t: jax.Array, x: jax.Array, p: jax.Array) -> jax.Array:
    """Return the vector field of a mode and the running cost: (n + 1,)."""
    cost = model.density(mode, piece)(t, x, p) if model.has_running_cost else jnp.zeros(())
    return jnp.append(model.field(mode, piece)(t, x, p), cost)


MOST_TIMES = 10
"""Times the fewest steps of several problems beyond which a problem is left out of their common mesh."""


def refine_mesh(problem: Problem, e: int, *thetas: FloatArray, **settings: Any) -> Mesh:
    """Return a mesh of experiment e of a problem, as `refine_mesh_of_run` does."""
    return refine_mesh_of_run(runs_of(problem)[e], *thetas, **settings)


def refine_mesh_of_run(
    run: Run, *thetas: FloatArray, finer: float = 1.0, most: int = MAX_STEPS, stiffness: Sequence[Stiffness] = ()
) -> Mesh:
    """Return a mesh of an experiment that meets the problem's tolerances at each of the given thetas.

    Parameters
    ----------
    finer : float
        Multiplies the number of cells.
    most : int
        Largest number of steps of the adaptive solve in a mode.
    stiffness : sequence of Stiffness
        Modes that take implicit steps as on an earlier mesh, if ``solver="auto"`` decides.

    Raises
    ------
    ValueError
        If a mode returns a value that is not finite, or the trajectory cannot be integrated to its end.
    """
    choice = Choice(stiffness)
    return run.coarse.refine(_solve_at(run, thetas, choice, most), choice.stiffness, choice.has_limits, finer)


def refine_mesh_of_many(problems: Sequence[Problem], e: int) -> Mesh:
    """Return a mesh of experiment e that meets the tolerances at the guess of each of several problems.

    They have the same data. Problems that cannot be integrated to the end are left out, unless none can, and those
    that need far more steps than another one: they grow without bound.

    Raises
    ------
    NotIntegrableError
        If none can be integrated; the error is that of the first.
    """
    runs = [runs_of(problem)[e] for problem in problems]
    solutions: list[FloatArray] = []
    stiffness: dict[str, Stiffness] = {}
    choices = []
    for run in runs:
        with suppress(NotIntegrableError):
            choices.append(Choice())
            solutions += _solve_at(run, (run.problem.initial_theta,), choices[-1])
            stiffness = choices[-1].found | stiffness  # as it was found first
    if not solutions:
        _solve_at(runs[0], (runs[0].problem.initial_theta,), Choice())  # it raises
    fewest = min(map(len, solutions))
    kept = [steps for steps in solutions if len(steps) <= MOST_TIMES * fewest + PACE]
    return runs[0].coarse.refine(kept, tuple(stiffness.values()), lambda: any(each.has_limits() for each in choices))


def refine_if_unstable(run: Run, mesh: Mesh, *thetas: FloatArray) -> Mesh | None:
    """Return a mesh that meets the tolerances at each theta, with implicit steps in the modes whose explicit ones are
    unstable.

    It is called after a fit on `mesh` has failed, at the last of the thetas. None if the problem sets the solver; if
    all explicit steps are stable; or if implicit ones take longer.
    """
    if run.problem.solver != "auto":
        return None
    watch, choice = Watch(between=STEPS_BETWEEN_AFTER_FAILURE), Choice(mesh.stiffness)
    with suppress(NotIntegrableError):
        solve_adaptively(run, thetas[-1], Settings(choice.found, watch))
    if not choice.add(watch.find_unstable(mesh), watch, 0):
        return None
    try:
        found = _solve_at(run, thetas[::-1], choice)
    except NotIntegrableError:
        return None
    is_new = choice.found.keys() - {each.mode for each in mesh.stiffness}
    return run.coarse.refine(found, choice.stiffness, choice.has_limits) if is_new else None


def _solve_at(run: Run, thetas: Sequence[FloatArray], choice: Choice, most: int = MAX_STEPS) -> list[FloatArray]:
    """Return the accepted times of an adaptive solve at each theta, by the problem's solver.

    With ``solver="auto"``, a mode that is stiff at one of the thetas is solved by implicit steps at all of them, unless
    these fail or take longer: the `choice` has the modes that are, and why, and those known before.
    """
    if run.problem.solver != "auto":
        choice.watches = [Watch() for _ in thetas]
        return [
            solve_adaptively(run, theta, Settings((), watch, most))
            for theta, watch in zip(thetas, choice.watches, strict=True)
        ]
    solutions: list[FloatArray] = []
    while len(solutions) < len(thetas):
        k = len(solutions)
        watch, failure = choice.watch(k), None
        try:
            solutions.append(solve_adaptively(run, thetas[k], Settings(choice.found, watch, most)))
        except (NotIntegrableError, TooManyStepsError) as error:
            failure = error
        refused = failure is None and choice.count_steps(watch, k)
        again = choice.add(watch.find_stiff(), watch, k) or refused
        if again or (failure is not None and choice.refuse(watch.current)):
            solutions = []  # again, with other steps in some mode
        elif failure is not None:
            raise failure
    return solutions
