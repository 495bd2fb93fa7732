"""Integrate one experiment adaptively, segment by segment.

The method has the same order as the fixed steps that follow, and integrates the running costs too, so that the mesh
resolves them. If modes have corners, a `Course` looks at each step and ends it where the trajectory leaves a branch.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import sub

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.arrays import FloatArray, Traced
from switchfit.discretization.mesh import Mesh
from switchfit.discretization.model import Model, read_parameters
from switchfit.discretization.signals import Piece
from switchfit.discretization.step_size import Tolerances
from switchfit.engine.adaptive.steps import NativeSteps, NativeStepsError, PythonSteps, Slope, Stretch
from switchfit.engine.adaptive.stiffness import Look, TooManyStepsError, Watch
from switchfit.engine.corners.course import BranchError, Course, Crossing
from switchfit.engine.jax.programs import call_model
from switchfit.engine.native.native_experiment import NativeExperiment, native_experiment
from switchfit.engine.native.sizes import Order
from switchfit.engine.run import Run
from switchfit.problem.finiteness import find_undefined
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure
from switchfit.problem.validation.messages import unit_suffix
from switchfit.runtime.cache import use_compilation_cache
from switchfit.runtime.errors import NotIntegrableError

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

MOST_STEPS_IN_PYTHON = 500
"""Largest number of steps in a branch without machine code; then it is compiled."""


@dataclass(frozen=True)
class SolveSettings:
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


class Integrator:
    """An adaptive solve of one experiment; arguments as in `solve_adaptively`.

    Parameters
    ----------
    structure : Structure
        Of the library whose machine code is used; if modes have corners, it is that of the branches of the `course`.
    """

    def __init__(
        self, run: Run, structure: Structure, coarse: Mesh, settings: SolveSettings, course: Course | None = None
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
        chosen = structure.take_implicit_steps(settings.implicit)
        if course is None or course.branches.count:
            # A solver is kept for the coarse mesh alone, which lives as long as the run; others would pile up mesh by
            # mesh.
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
        # Of a free tf `end` is its upper bound; the last transition is tf then, and the rest behind it the last mode.
        ends = np.concatenate([[experiment.t0], tau, [experiment.end]])
        steps, x = [ends[:1]], self._find_initial_state()
        for i, mode in enumerate(structure.mode_of_segment):
            if i > 0 and structure.reset_maps[i - 1] is not None:
                x = self._apply_reset(i - 1, ends[i], x)
            # Strictly inside: a knot at a transition is the end of the stretch already.
            inside = (self._stops > ends[i]) & (self._stops < ends[i + 1])
            # Segment i: its reset map, then stretch by stretch between the knots of the input, then branch by branch
            # (`_follow`).
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
                    accepted, x = self._follow(Stretch(mode, start, end, x, is_explicit))
                    steps += accepted
                    if self._settings.watch is not None:
                        # How many rows the mesh will have there: what implicit and explicit steps are compared by.
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
            # Machine code that was compiled for the other method counts other operations.
            if native.structure.implicit[place] is not is_explicit:
                return native.row_work[place]
        return ROWS_BY_JAX[is_explicit]

    def _follow(self, stretch: Stretch) -> tuple[list[FloatArray], FloatArray]:
        """Return the accepted times after the start of a stretch, from branch to branch, and the state at its end."""
        steps: list[FloatArray] = []
        # From branch to branch: each ends where the trajectory crosses a corner, at a state on the cubic of the step.
        while True:
            accepted, x, crossing = self._solve(stretch)
            # A crossing at the very start of the stretch, as after another one, is no step.
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

    def _solve(self, stretch: Stretch) -> tuple[FloatArray, FloatArray, Crossing | None]:
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

                return self._take_steps(
                    stretch, PythonSteps(slope, stretch, self._tolerances), Watch(), MOST_STEPS_IN_PYTHON
                )
            mode = place
        # Machine code has one method per mode: it serves where that is the method asked for.
        if native is not None and native.structure.implicit[mode] is not stretch.is_explicit:
            with suppress(NativeStepsError):
                return self._take_steps(stretch, NativeSteps(native, mode, stretch, self._p, self._tolerances), watch)
            if self._settings.most < MAX_STEPS:
                # With few steps it is one of many trials, whose reason nobody asks for.
                raise self._report_stuck(stretch, stretch.start, stretch.x, None)
            watch = Watch()  # machine code has counted its steps
        with use_float64(), use_compilation_cache():
            steps = PythonSteps(self._build_slope(stretch, mode), stretch, self._tolerances)
            return self._take_steps(stretch, steps, watch)

    def _take_steps(
        self, stretch: Stretch, steps: NativeSteps | PythonSteps, watch: Watch, most_of_branch: float = np.inf
    ) -> tuple[FloatArray, FloatArray, Crossing | None]:
        """Do what `_solve` does by steps of one kind."""
        course, natively = self._course, isinstance(steps, NativeSteps)
        accepted, x, reason = [stretch.start], stretch.x, None
        # Between two calls Python looks: for corners that the steps have passed, and for stiffness.
        at_once = watch.between if course is None else STEPS_OF_BRANCH
        while steps.is_running:
            if len(accepted) > most_of_branch:
                raise BranchError
            # At the pace of the last steps: a stiff mode is given up after thousands of steps, not after MAX_STEPS.
            if len(accepted) >= 5 * PACE and _project_steps(accepted, stretch.end) > self._settings.most:
                if natively and not np.isfinite(steps.y).all():
                    raise NativeStepsError
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
            # Without the running cost, which restarts from 0 in each stretch: it is integrated for its share in the
            # error alone.
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
                raise NativeStepsError
            raise self._report_stuck(stretch, steps.t, steps.y[:-1], reason or steps.message)
        return np.array(accepted[1:]), steps.y[:-1], None

    def _build_slope(self, stretch: Stretch, mode: int) -> Slope:
        """Return the slope of a mode of the library by JAX; it raises where it is not finite."""
        functions = self._library.functions
        functions = replace(functions, implicit=(False,) * len(functions.modes))  # one program for both methods
        times, start, end = self._coarse.times, stretch.start, stretch.end
        first, last = np.nextafter(start, end), np.nextafter(end, start)

        def slope(t: float, y: FloatArray) -> FloatArray:
            # Inside the stretch by an ulp: at its ends an input may jump, and a trial step of Radau may pass them.
            cell = min(int(times.searchsorted(min(max(t, first), last), "right")) - 1, len(times) - 2)
            piece = Piece(times[cell], self._whole.signals[cell])
            given = self._arguments, piece, t, y[:-1], self._p
            value = np.asarray(call_model(*given, structure=functions, function=_field_and_density, which=(mode,)))
            if not np.isfinite(value).all():
                raise self._report_infinite_slope(mode, t, y[:-1], value, piece)
            return value

        return slope

    def _call_model(self, function: Callable[..., jax.Array], *given: Traced, **settings: object) -> FloatArray:
        """Return the value of a function of the model, at the parameters."""
        with use_float64(), use_compilation_cache():
            return np.asarray(call_model(self._arguments, *given, self._p, function=function, **settings))

    def _report_stuck(self, stretch: Stretch, t: float, x: FloatArray, reason: str | None) -> NotIntegrableError:
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
