"""The adaptive solve of one experiment, which tells how many steps the mesh needs where.

It has the same order as the fixed steps that follow, and integrates the running costs too, so that the mesh resolves
them. Solves run in machine code if possible: a hundred steps take less than a tenth of a millisecond there, and ten
milliseconds in Python. Python solves models without machine code, and repeats a solve that failed, for its error
message. Both use the step size control of `switchfit.discretization.step_size`, but for the modes that take implicit
steps, which SciPy's Radau solves in Python.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.discretization.arguments import Arguments, build_arguments
from switchfit.discretization.mesh import Mesh
from switchfit.discretization.model import Model, Piece, read_parameters
from switchfit.discretization.step_size import EXPONENT, STIFF_EXPONENT, Tolerances, first_step
from switchfit.engine.branches import MOST_FOUND, Branches, Path, find_branches, is_split, leave_whole, list_paths
from switchfit.engine.course import Course, Crossing, TooManyCrossingsError
from switchfit.engine.native.adaptive import Adaptive
from switchfit.engine.native.experiment import NativeExperiment, native_experiment
from switchfit.engine.native.templates import Order
from switchfit.engine.stiffness import Watch
from switchfit.problem.data import FloatArray
from switchfit.problem.finiteness import find_undefined
from switchfit.problem.functions import use_float64
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache
from switchfit.runtime.errors import NotIntegrableError

T = TypeVar("T")

MAX_STEPS = 200_000
"""Largest number of adaptive steps in one mode; a mode that needs more cannot be integrated."""

PACE = 1000
"""Steps over which the pace of a mode is measured, so that a stiff mode is refused early."""

MOST_PROJECTED = 1e15
"""Number of steps from which it does not matter how many they are: for an end of 1e308 they overflow."""

STEPS_AT_ONCE = 256
"""Steps that the compiled solver accepts in one call, at most."""

STEPS_OF_BRANCH = 16
"""The same in a mode with corners: steps behind the end of a branch are lost."""

ROWS_BY_JAX = {True: 20_000, False: 200_000}
"""Work of an explicit and of an implicit row in JAX, in additions of machine code: 5 and 50 us, for 2 to 4 states."""


@dataclass(frozen=True)
class _Stretch:
    """A part of the horizon without a transition or a knot of the inputs, to be solved adaptively.

    Attributes
    ----------
    problem : Problem
    structure : Structure
    mode : int
        Index of the active mode.
    start, end : float
    x : (n,), state at the start
    p : (M,), parameters of the experiment
    is_explicit : bool
        Whether it is solved by explicit steps.
    unit : str
        Suffix of times in messages.
    watch : Watch or None
        Counts the steps.
    most : int
        Largest number of steps.
    course : Course or None
        Follows the branches of a mode with corners.
    """

    problem: Problem
    structure: Structure
    mode: int
    start: float
    end: float
    x: FloatArray
    p: FloatArray
    is_explicit: bool = True
    unit: str = ""
    watch: Watch | None = None
    most: int = MAX_STEPS
    course: Course | None = None

    @property
    def name(self) -> str:
        """The name of the mode."""
        return self.structure.mode_names[self.mode]

    @property
    def smallest_state(self) -> float:
        """The size of a state at which the absolute and the relative tolerance count the same."""
        return self.problem.atol / self.problem.rtol

    def report_stuck(self, t: float, y: FloatArray, reason: str | None) -> NotIntegrableError:
        """Return the error of a solve that cannot go on beyond t, where y (n + 1,) is the state and the cost."""
        remedy = "use solver='stiff', or a better guess" if self.is_explicit else "use a better guess"
        if self.problem.solver == "auto":
            remedy = "use a better guess, or solver='stiff' if the mode is stiff"
        return NotIntegrableError(
            f"mode {self.name!r} cannot be integrated at the guess beyond t = {t:.6g}{self.unit}, where x = "
            f"{y[:-1].tolist()} ({reason}): {remedy}."
        )

    def report_too_many_steps(self, accepted: Sequence[float] | FloatArray, y: FloatArray) -> NotIntegrableError:
        """Return the error of a solve that needs too many steps, and note it in the watch."""
        if self.watch is not None:
            self.watch.give_up(_project_steps(accepted, self.end))
        return self.report_stuck(accepted[-1], y, f"it needs more than {self.most} steps")

    def report_infinite_slope(
        self, t: float, y: FloatArray, value: FloatArray, arguments: Arguments, piece: Piece
    ) -> NotIntegrableError:
        """Return the error of a slope or a running cost, the last of the values (n + 1,), that is not finite."""
        slope, density, x = value[:-1].tolist(), value[-1], y[:-1]
        if np.isfinite(slope).all():
            what, operation = f"a running cost in mode {self.name!r} returned {density}", ""
        else:
            what, operation = f"mode {self.name!r} returned {slope}", self._find_operation(t, x, arguments, piece)
        return NotIntegrableError(
            f"{what} at t = {t:.6g}{self.unit}, x = {x.tolist()}{operation}: the guess leads to where the model is not "
            "defined or grows without bound; use a better guess, or change the model there."
        )

    def _find_operation(self, t: float, x: FloatArray, arguments: Arguments, piece: Piece) -> str:
        """Return which operation of the mode is not finite at t and x (n,), " (log at tank.py:5)"; empty if all are."""
        model = Model(self.structure, arguments)
        given = [np.asarray(a)[None] for a in (t, x, *model.inputs(t, piece))]  # type: ignore[arg-type]  # of NumPy
        parameters = model.parameters(self.p)  # type: ignore[arg-type]
        found = find_undefined(self.structure.modes[self.mode], given, parameters, derivatives=False)
        return "" if found is None else f" ({' at '.join(filter(None, (found.operation, found.line)))})"


def solve_adaptively(
    problem: Problem,
    e: int,
    theta: FloatArray,
    coarse: Mesh,
    implicit: Container[str] = (),
    watch: Watch | None = None,
    most: int = MAX_STEPS,
) -> FloatArray:
    """Return the accepted times of the adaptive solver from t0 to tf, strictly increasing.

    The problem's solver determines the method of each mode, with ``solver="auto"`` also the names of the `implicit`
    ones; a watch counts the steps. A mode may take `most` steps: if these are fewer than by default, a failure of
    machine code is not repeated in Python for its reason.
    """
    tau, p = problem.vectors(theta, e)
    structure = problem.structures[e]
    if is_split(problem, e, structure):
        try:
            return find_path(problem, e, tau, p, coarse, implicit, watch, most)[0]
        except TooManyCrossingsError:
            if e in list_paths(problem):  # a trial far from the guess
                raise
            leave_whole(problem, e)
    return _Solve(problem, e, structure, coarse, implicit, watch, most)(tau, p)


def find_path(
    problem: Problem,
    e: int,
    tau: FloatArray,
    p: FloatArray,
    coarse: Mesh,
    implicit: Container[str] = (),
    watch: Watch | None = None,
    most: int = MAX_STEPS,
) -> tuple[FloatArray, Path]:
    """Return what `solve_adaptively` does for an experiment whose modes have corners, and the path of the trajectory.

    Branches that no trajectory has run in before are solved in Python at first, so that machine code is compiled once
    for all of them.
    """
    structure = problem.structures[e]
    branches = find_branches(structure.library)
    while True:
        known = branches.get_structure(structure) if branches.count else structure
        solve, count = _Solve(problem, e, known, coarse, implicit, watch, most, branches), branches.count
        steps = None
        with suppress(BranchError):
            steps = solve(tau, p)
        branches.add(structure, solve.path)
        if steps is not None and branches.count == count:
            return steps, solve.path


class BranchError(Exception):
    """A branch takes many steps in Python, or ends where its field is undefined: the path has to be found anew."""


class _Solve:
    """An adaptive solve of one experiment; arguments as in `solve_adaptively`.

    Parameters
    ----------
    structure : Structure
        Of the library whose machine code is used; if modes have corners, it is that of `branches`.
    """

    def __init__(
        self,
        problem: Problem,
        e: int,
        structure: Structure,
        coarse: Mesh,
        implicit: Container[str],
        watch: Watch | None,
        most: int,
        branches: Branches | None = None,
    ) -> None:
        self._problem, self._e, self._structure, self._coarse = problem, e, structure, coarse
        self._implicit, self._watch, self._most, self._branches = implicit, watch, most, branches
        whole = build_arguments(problem, e, coarse)
        self._arguments, self._signals = whole.without_mesh(), np.asarray(whole.signals)
        self._native: NativeExperiment | None = None
        named = zip(structure.mode_names, structure.implicit, strict=True)
        methods = tuple(is_set or name in implicit for name, is_set in named)
        if branches is None or branches.count:
            if methods != structure.implicit:
                chosen = replace(structure, implicit=methods)
                self._native = native_experiment(chosen, whole, coarse.times, order=Order.COST)
            self._native = self._native or native_experiment(structure, whole, coarse.times, order=Order.COST)
        self._course: Course | None = None

    @property
    def path(self) -> Path:
        """The branches of the trajectory, as far as it was solved."""
        if self._course is None:
            raise ValueError("modes without corners have one branch each")
        return self._course.path

    def __call__(self, tau: FloatArray, p: FloatArray) -> FloatArray:
        """Return the accepted times from t0 to tf, strictly increasing."""
        problem, native, structure = self._problem, self._native, self._problem.structures[self._e]
        experiment = problem.experiments[self._e]
        unit = unit_suffix(experiment.time_unit)
        ends = np.concatenate([[experiment.t0], tau, [experiment.end]])
        inputs = np.array([]) if experiment.inputs is None else experiment.inputs.times
        steps = [np.array([experiment.t0])]
        if native is None:
            x = np.asarray(_call_jax(initial_state, self._arguments, p, structure=structure.functions))
        else:
            x = native.initial_state(p)
        if not np.isfinite(x).all():
            named = read_parameters(structure, self._arguments, p)
            raise _report_infinite(f"initial_state at p = {_round_parameters(named)}", x)
        if self._branches is not None:
            self._course = Course(self._branches, structure, self._arguments, self._coarse.nodes, self._signals, p)
        for i, mode in enumerate(structure.mode_of_segment):
            if i > 0 and structure.reset_maps[i - 1] is not None:
                if native is None:
                    given = self._arguments, ends[i], x, p
                    after = np.asarray(_call_jax(after_reset, *given, structure=structure, i=i - 1))
                else:
                    after = np.asarray(native.after_reset(i - 1, ends[i], x, p))
                if not np.isfinite(after).all():
                    before = f"t = {ends[i]:.6g}{unit}, x = {x.tolist()}"
                    names = tuple(structure.mode_names[k] for k in structure.mode_of_segment[i - 1 : i + 1])
                    what = "the map of a Jump" if i - 1 in structure.jumps else f"reset map {names}"
                    raise _report_infinite(f"{what} at {before}", after)
                x = after
            knots = inputs[(inputs > ends[i]) & (inputs < ends[i + 1])]
            stops = np.concatenate([[ends[i]], knots, [ends[i + 1]]])
            name = structure.mode_names[mode]
            is_explicit = not structure.implicit[mode] and name not in self._implicit
            if self._watch is not None:
                self._watch.enter(name, self._find_row_work(name, is_explicit))
            if self._course is not None:
                self._course.enter(mode, ends[i], x, 0.5 * (stops[0] + stops[1]))
            for start, end in pairwise(stops.tolist()):
                if end > start:
                    if self._course is not None and start > ends[i]:
                        self._course.resume(start, x, 0.5 * (start + end))
                    settings = is_explicit, unit, self._watch, self._most, self._course
                    accepted, x = self._follow(_Stretch(problem, structure, mode, start, end, x, p, *settings))
                    steps += accepted
                    if self._watch is not None:
                        self._watch.add_rows(_count_rows(np.concatenate([[start], *accepted]), self._coarse.times))
        return np.concatenate(steps)

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
        if stretch.course is None:
            accepted, x, _ = self._solve(stretch)
            return [accepted], x
        while True:
            accepted, x, crossing = self._solve(stretch)
            steps.append(accepted[accepted > stretch.start])
            if crossing is None:
                return steps, x
            if crossing.time >= stretch.end:
                stretch.course.cross(crossing, 0.5 * (stretch.start + stretch.end))
                return steps, crossing.state
            stretch.course.cross(crossing, 0.5 * (crossing.time + stretch.end))
            stretch = replace(stretch, start=crossing.time, x=crossing.state)

    def _solve(self, stretch: _Stretch) -> tuple[FloatArray, FloatArray, Crossing | None]:
        """Return the accepted times after the start of a stretch, the state at its end, and where it leaves a branch,
        if it does: it ends there.
        """
        found, native, course = None, self._native, stretch.course
        if course is not None:
            place = course.branches.find(stretch.structure, stretch.mode, course.sides)
            if place is None:
                return _solve_branch(stretch, course)
            stretch = replace(stretch, mode=place, structure=self._structure)
        if native is not None and native.structure.implicit[stretch.mode] is not stretch.is_explicit:
            found = _solve_natively(stretch, native)
            if found is None:
                if stretch.most < MAX_STEPS:
                    raise stretch.report_stuck(stretch.start, np.append(stretch.x, 0.0), None)
                stretch = replace(stretch, watch=None)  # machine code has counted its steps
        if found is None:
            found = _call_jax(_solve_in_python, stretch, self._arguments, self._signals, self._coarse)
        return found


def _call_jax(function: Callable[..., T], *given: Any, **settings: Any) -> T:
    """Call a function that runs programs of JAX; entering these contexts takes longer than most native solves."""
    with use_float64(), use_compilation_cache():
        return function(*given, **settings)


def _solve_in_python(
    stretch: _Stretch, arguments: Arguments, signals: FloatArray, coarse: Mesh
) -> tuple[FloatArray, FloatArray, Crossing | None]:
    """Do what `_Solve._solve` does with slopes from JAX."""
    functions = stretch.structure.functions
    functions = replace(functions, implicit=(False,) * len(functions.modes))  # one program for both methods
    function = partial(_field_and_density, structure=functions, mode=stretch.mode)
    first, last = np.nextafter(stretch.start, stretch.end), np.nextafter(stretch.end, stretch.start)

    def right_hand_side(t: float, y: FloatArray) -> FloatArray:
        inside = min(max(t, first), last)
        cell = min(int(np.searchsorted(coarse.times, inside, side="right")) - 1, len(coarse.times) - 2)
        value = np.asarray(function(arguments, coarse.nodes[cell], signals[cell], t, y[:-1], stretch.p))
        if not np.isfinite(value).all():
            piece = Piece(coarse.nodes[cell], signals[cell])
            raise stretch.report_infinite_slope(t, y, value, arguments, piece)
        return value

    return _step_in_python(stretch, right_hand_side)


def _solve_branch(stretch: _Stretch, course: Course) -> tuple[FloatArray, FloatArray, Crossing | None]:
    """Do what `_Solve._solve` does in a branch that is not in the library yet, without running costs."""
    branch, inside = course.corners.branch(course.sides), 0.5 * (stretch.start + stretch.end)
    return _step_in_python(
        replace(stretch, most=MOST_FOUND, watch=None, is_explicit=True),
        lambda t, y: np.append(course.evaluate(branch, t, y[:-1], inside), 0.0),
    )


def _step_in_python(
    stretch: _Stretch, right_hand_side: Callable[[float, FloatArray], FloatArray]
) -> tuple[FloatArray, FloatArray, Crossing | None]:
    """Take adaptive steps with slopes (n + 1,) from Python."""
    problem, watch, course = stretch.problem, stretch.watch, stretch.course
    from scipy.integrate import Radau  # here, since importing it takes longer than most fits

    from switchfit.engine.explicit_solver import ExplicitSolver

    method = ExplicitSolver if stretch.is_explicit else Radau
    with np.errstate(all="ignore"):  # a slope of 1e300 is refused with a message
        y = np.append(stretch.x, 0.0)
        solver = method(right_hand_side, stretch.start, y, stretch.end, rtol=problem.rtol, atol=problem.atol)
    accepted = [stretch.start]
    while solver.status == "running":
        before = float(solver.t), solver.y[:-1]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a state that overflows is refused below
            message = solver.step()
        if solver.status == "failed":
            if course is not None and course.free_nearest(solver.t, solver.y[:-1], 0.5 * (solver.t + stretch.end)):
                raise BranchError
            raise stretch.report_stuck(solver.t, solver.y, message)
        if _has_too_many_steps(accepted, stretch.end, stretch.most):
            raise stretch.report_too_many_steps(accepted, solver.y)
        if stretch.most == MOST_FOUND and len(accepted) > MOST_FOUND:
            raise BranchError
        rows = np.array([before[0], solver.t]), np.array([before[1], solver.y[:-1]])
        crossing = None if course is None else course.look(*rows)
        if crossing is not None:
            return np.array([*accepted[1:], crossing.time]), crossing.state, crossing
        accepted.append(float(solver.t))
        if watch is not None and watch.add(1) and stretch.is_explicit:
            slope = partial(_call_jax, right_hand_side)  # it is called later, outside these contexts
            watch.look(accepted[-1] - accepted[-2], slope, accepted[-1], solver.y, stretch.smallest_state)
    return np.array(accepted[1:]), np.asarray(solver.y[:-1]), None


def _solve_natively(
    stretch: _Stretch, native: NativeExperiment
) -> tuple[FloatArray, FloatArray, Crossing | None] | None:
    """Do what `_solve_in_python` does, in machine code; None if it fails: `_solve_in_python` then gives the reason."""
    problem, watch, course = stretch.problem, stretch.watch, stretch.course
    start, end = stretch.start, stretch.end
    y, at = np.append(stretch.x, 0.0), Adaptive()
    state = np.zeros(at.size)
    state[at.t], state[at.end], state[at.rtol], state[at.atol] = start, end, problem.rtol, problem.atol
    state[at.low], state[at.high] = np.nextafter(start, end), np.nextafter(end, start)

    def slope(t: float, y: FloatArray) -> FloatArray:
        return native.slope(stretch.mode, t, y, stretch.p)

    exponent = EXPONENT if stretch.is_explicit else STIFF_EXPONENT
    tolerances = Tolerances(problem.rtol, problem.atol)
    state[at.step] = first_step(slope, start, y, slope(start, y), end, tolerances, exponent)
    accepted = np.array([start])
    while state[at.t] < end and not state[at.stuck]:
        if _has_too_many_steps(accepted, end, stretch.most):
            if watch is None or not np.isfinite(y).all():
                return None
            raise stretch.report_too_many_steps(accepted, y)
        at_once = min(STEPS_AT_ONCE if course is None else STEPS_OF_BRANCH, watch.between if watch else STEPS_AT_ONCE)
        before = y[:-1].copy()
        more, states = native.adaptive_steps(stretch.mode, state, y, stretch.p, at_once)
        if course is not None:
            crossing = course.look(np.append(accepted[-1], more), np.concatenate([before[None], states]))
            if crossing is not None:
                accepted = np.append(accepted[1:], more[more < crossing.time])
                return np.append(accepted, crossing.time), crossing.state, crossing
        accepted = np.append(accepted, more)
        if watch is not None and watch.add(len(more)) and len(more) and stretch.is_explicit:
            watch.look(accepted[-1] - accepted[-2], slope, accepted[-1], y, stretch.smallest_state)
    if course is not None and state[at.stuck] and course.free_nearest(state[at.t], y[:-1], 0.5 * (state[at.t] + end)):
        raise BranchError
    return None if state[at.t] < end or not np.isfinite(y).all() else (accepted[1:], y[:-1], None)


def _has_too_many_steps(accepted: Sequence[float] | FloatArray, end: float, most: int) -> bool:
    """Return whether more than `most` steps have been taken, or will be at the pace of the last `PACE` steps."""
    return len(accepted) >= 5 * PACE and _project_steps(accepted, end) > most


def _count_rows(steps: FloatArray, nodes: FloatArray) -> int:
    """Return how many rows a mesh with these nodes has that has such steps, which begin and end at these times."""
    ends = np.concatenate([steps[:1], nodes[(nodes > steps[0]) & (nodes < steps[-1])], steps[-1:]])
    return int(np.maximum(np.ceil(np.diff(np.interp(ends, steps, np.arange(len(steps))))), 1).sum())


def _project_steps(accepted: Sequence[float] | FloatArray, end: float) -> float:
    """Return how many steps a solve takes to the end at the pace of the last `PACE` steps, or `MOST_PROJECTED`."""
    left, recent = float(end - accepted[-1]), float(accepted[-1] - accepted[-PACE - 1])
    return min(len(accepted) + PACE * left / recent, MOST_PROJECTED)  # in floats, which overflow without a warning


def _report_infinite(what: str, state: FloatArray) -> NotIntegrableError:
    return NotIntegrableError(f"{what} returned {state.tolist()}, which is not finite: use a better guess.")


def _round_parameters(parameters: Mapping[str, FloatArray]) -> dict[str, Any]:
    """Return the parameters rounded for a message."""
    return {name: np.round(value, 6).tolist() for name, value in parameters.items()}


@partial(jax.jit, static_argnames=("structure", "mode"))
def _field_and_density(
    arguments: Arguments,
    origin: jax.Array,
    coefficients: jax.Array,
    t: jax.Array,
    x: jax.Array,
    p: jax.Array,
    *,
    structure: Structure,
    mode: int,
) -> jax.Array:
    model = Model(structure, arguments)
    piece = Piece(origin, coefficients)
    cost = model.density(mode, piece)(t, x, p) if model.has_running_cost else jnp.zeros(())
    return jnp.append(model.field(mode, piece)(t, x, p), cost)


@partial(jax.jit, static_argnames=("structure",))
def initial_state(arguments: Arguments, p: jax.Array, *, structure: Structure) -> jax.Array:
    """Return x(t0): (n,)."""
    return Model(structure, arguments).initial_state(p)


@partial(jax.jit, static_argnames=("structure", "i"))
def after_reset(
    arguments: Arguments, t: jax.Array, x: jax.Array, p: jax.Array, *, structure: Structure, i: int
) -> jax.Array:
    """Return the state after the reset map of transition i (from 0): (n,)."""
    return Model(structure, arguments).reset(i)(t, x, p)
