"""Choosing the mesh: how short the steps have to be, from one adaptive solve at a given theta.

The adaptive solve has the same order as the fixed steps that follow. It also integrates the running costs, so that
they are resolved as well. Its steps are turned into a refinement of the intervals between the nodes that have to be
there anyway; the mesh then stays as it is while theta moves.

Explicit solves take SciPy's RK45 step by step, in a compiled loop: a hundred steps cost a tenth of a millisecond there,
ten in Python. SciPy itself solves stiff modes, and says what is wrong where a solve fails.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
from jax import lax
from scipy.integrate import RK45

from switchfit.cache import compilation_cache
from switchfit.data import FloatArray, Measurements
from switchfit.experiment import Experiment, signals_of
from switchfit.mesh import Mesh
from switchfit.model import Arguments, Model, Piece, Structure, float64
from switchfit.problem import Problem
from switchfit.rungekutta import combine

MAX_STEPS = 200_000
"""Adaptive steps in one mode before it is called stiff."""

PACE = 1000
"""Steps over which the pace of a mode is measured; a stiff one is thus refused before it has cost much."""


def fixed_nodes(experiment: Experiment) -> FloatArray:
    """Moments that must be nodes: t0, tf, sample times, knots of inputs and reference signals inside the horizon."""
    t0, tf = experiment.t0, experiment.tf
    times = [np.array([t0, tf])]
    times += [item.seen_times for item in experiment.data if isinstance(item, Measurements)]
    times += [signal.knots for signal in signals_of(experiment)]
    nodes = np.unique(np.concatenate(times))
    return nodes[(nodes >= t0) & (nodes <= tf)]


def refined_mesh(problem: Problem, e: int, *thetas: FloatArray, finer: float = 1.0) -> Mesh:
    """Mesh of experiment e on which its trajectory meets the problem's tolerances at each of the given thetas.

    Parameters
    ----------
    finer : float
        Multiplies the number of cells.

    Raises
    ------
    ValueError
        If a mode returns a value that is not finite, or the trajectory cannot be integrated to its end.
    """
    nodes = fixed_nodes(problem.experiments[e])
    coarse = Mesh.from_times(nodes)
    steps = _Steps.densest([_adaptive_steps(problem, e, theta, coarse) for theta in thetas])
    pieces = np.maximum(np.ceil(finer * np.diff(steps.up_to(nodes)) - 0.05).astype(int), 1)
    inside = [_graded(nodes[k : k + 2], steps, int(pieces[k])) for k in np.flatnonzero(pieces > 1)]
    return Mesh.from_times(np.concatenate([nodes, *inside]))


class _Steps(NamedTuple):
    """How many steps a solver takes up to each time: linear between `times` (K,), where it is `counts` (K,)."""

    times: FloatArray
    counts: FloatArray

    @classmethod
    def densest(cls, solutions: list[FloatArray]) -> _Steps:
        """The steps of several solutions (all their times), at every moment those of the one with the shortest."""
        times = np.unique(np.concatenate(solutions))
        middles = 0.5 * (times[:-1] + times[1:])
        lengths = [np.diff(steps)[np.searchsorted(steps, middles) - 1] for steps in solutions]
        return cls(times, np.concatenate([[0.0], np.cumsum(np.diff(times) / np.min(lengths, axis=0))]))

    def up_to(self, t: FloatArray) -> FloatArray:
        """Steps taken up to times t."""
        return np.interp(t, self.times, self.counts)


def _graded(ends: FloatArray, steps: _Steps, pieces: int) -> FloatArray:
    """Nodes between two ends: half of them as dense as the solver's steps are, half of them evenly.

    The steps are short in the layers of a stiff mode, which evenly spaced nodes would miss; but layers move with the
    transition times, and the mesh does not.
    """
    inner = steps.times[(steps.times > ends[0]) & (steps.times < ends[1])]
    times = np.concatenate([ends[:1], inner, ends[1:]])
    count = steps.up_to(times)
    density = 0.5 * (count - count[0]) / (count[-1] - count[0]) + 0.5 * (times - ends[0]) / (ends[1] - ends[0])
    return np.interp(np.linspace(0.0, 1.0, pieces + 1)[1:-1], density, times)


def _adaptive_steps(problem: Problem, e: int, theta: FloatArray, coarse: Mesh) -> FloatArray:
    """All times at which the adaptive solver stopped, from t0 to tf, strictly increasing."""
    experiment, structure = problem.experiments[e], problem.structures[e]
    whole = problem.arguments(e, coarse)
    arguments, signals = whole.without_mesh(), np.asarray(whole.signals)
    tau, p = problem.vectors(theta, e)
    ends = np.concatenate([[experiment.t0], tau, [experiment.tf]])
    inputs = np.array([]) if experiment.inputs is None else experiment.inputs.times
    steps = [np.array([experiment.t0])]
    with float64(), compilation_cache():
        x = _finite(
            initial_state(arguments, p, structure=structure.functions),
            f"initial_state at p = {_rounded(problem.split(theta)[1])}",
        )
        for i, mode in enumerate(structure.mode_of_segment):
            if i > 0 and structure.reset_maps[i - 1] is not None:
                names = tuple(experiment.mode_sequence[i - 1 : i + 1])
                value = after_reset(arguments, ends[i], x, p, structure=structure, i=i - 1)
                x = _finite(value, f"reset map {names} at t = {ends[i]:.6g}, x = {x.tolist()}")
            knots = inputs[(inputs > ends[i]) & (inputs < ends[i + 1])]
            stops = np.concatenate([[ends[i]], knots, [ends[i + 1]]])
            for start, end in pairwise(stops.tolist()):
                if end > start:
                    solve = _solve_compiled if problem.solver == "explicit" else _solve
                    accepted, x = solve(problem, structure, arguments, signals, coarse, mode, start, end, x, p)
                    steps.append(accepted)
    return np.concatenate(steps)


def _solve(
    problem: Problem,
    structure: Structure,
    arguments: Arguments,
    signals: FloatArray,
    coarse: Mesh,
    mode: int,
    start: float,
    end: float,
    x: FloatArray,
    p: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Adaptive solve of one mode from start to end: accepted times (start left out) and the final state."""
    name = structure.mode_names[mode]
    function = partial(_field_and_density, structure=structure.functions, mode=mode)
    last = len(coarse.times) - 2

    def right_hand_side(t: float, y: FloatArray) -> FloatArray:
        inside = min(max(t, np.nextafter(start, end)), np.nextafter(end, start))
        cell = min(int(np.searchsorted(coarse.times, inside, side="right")) - 1, last)
        value = np.asarray(function(arguments, coarse.nodes[cell], signals[cell], t, y[:-1], p))
        if not np.isfinite(value).all():
            slope, density = value[:-1].tolist(), value[-1]
            finite = np.isfinite(slope).all()
            what = (
                f"a running cost in mode {name!r} returned {density}" if finite else f"mode {name!r} returned {slope}"
            )
            raise ValueError(
                f"{what} at t = {t:.6g}, x = {y[:-1].tolist()}: the guess leads to where the model is not defined or "
                "grows without bound; use a better guess, or change the model there."
            )
        return value

    method = scipy.integrate.RK45 if problem.solver == "explicit" else scipy.integrate.Radau
    solver = method(right_hand_side, start, np.append(x, 0.0), end, rtol=problem.rtol, atol=problem.atol)
    accepted = [start]
    while solver.status == "running":
        with np.errstate(over="ignore", invalid="ignore"):  # a state that overflows is refused in words
            message = solver.step()
        if solver.status == "failed" or _too_many(accepted, end):
            remedy = "use solver='stiff', or a better guess" if problem.solver == "explicit" else "use a better guess"
            reason = message or f"it needs more than {MAX_STEPS} steps"
            raise ValueError(
                f"mode {name!r} cannot be integrated at the guess beyond t = {solver.t:.6g}, where x = "
                f"{solver.y[:-1].tolist()} ({reason}): {remedy}."
            )
        accepted.append(float(solver.t))
    return np.array(accepted[1:]), np.asarray(solver.y[:-1])


STEPS_AT_ONCE = 256
"""Steps of the compiled solver in one call."""


def _solve_compiled(
    problem: Problem,
    structure: Structure,
    arguments: Arguments,
    signals: FloatArray,
    coarse: Mesh,
    mode: int,
    start: float,
    end: float,
    x: FloatArray,
    p: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """The same as `_solve` for the explicit method, which takes over where this one fails."""
    if signals.shape[2]:
        length = 1 << (len(coarse.nodes) - 1).bit_length()  # few shapes, few programs
        nodes = np.concatenate([coarse.nodes, np.repeat(coarse.nodes[-1:], length - len(coarse.nodes))])
        cells = np.concatenate([signals, np.repeat(signals[-1:], length - 1 - len(signals), axis=0)])
    else:
        nodes, cells = np.asarray(arguments.nodes), np.asarray(arguments.signals)
    accepted = np.array([start])
    t, y, h = np.asarray(start), np.append(x, 0.0), np.asarray(np.nan)
    while t < end and not _too_many(accepted, end):
        now = (t, start, end, y, h, p, problem.rtol, problem.atol)
        result = _steps(arguments, nodes, cells, mode, *now, structure=structure.functions)
        times, count, t, y, h = (np.asarray(value) for value in result)
        accepted = np.append(accepted, times[:count])
        if count < STEPS_AT_ONCE:
            break
    if t < end or not np.isfinite(y).all():
        return _solve(problem, structure, arguments, signals, coarse, mode, start, end, x, p)
    return accepted[1:], y[:-1]


@partial(jax.jit, static_argnames=("structure",))
def _steps(
    arguments: Arguments,
    nodes: jax.Array,
    signals: jax.Array,
    mode: jax.Array,
    t: jax.Array,
    start: jax.Array,
    end: jax.Array,
    y: jax.Array,
    h: jax.Array,
    p: jax.Array,
    rtol: jax.Array,
    atol: jax.Array,
    *,
    structure: Structure,
) -> tuple[jax.Array, ...]:
    """Up to `STEPS_AT_ONCE` accepted steps of SciPy's RK45 from t: their ends, their number, t, y, and the next step.

    NaN for h asks for a first step. A step that would be too short to change t ends the loop.
    """
    model = Model(structure, arguments)
    A, B, C, E = RK45.A, RK45.B, RK45.C, RK45.E
    tiny = jnp.finfo(float).eps

    def f(t: jax.Array, y: jax.Array) -> jax.Array:
        inside = jnp.clip(t, jnp.nextafter(start, end), jnp.nextafter(end, start))
        cell = jnp.clip(jnp.searchsorted(nodes, inside, side="right") - 1, 0, len(signals) - 1)
        piece = Piece(nodes[cell], signals[cell])
        cost = model.density(piece)(t, y[:-1], p) if model.has_running_cost else jnp.zeros(())
        fields = [model.field(k, piece) for k in range(len(structure.modes))]
        slope = fields[0](t, y[:-1], p) if len(fields) == 1 else lax.switch(mode, fields, t, y[:-1], p)
        return jnp.append(slope, cost)

    def size(error: jax.Array, y: jax.Array, other: jax.Array) -> jax.Array:
        """Error in units of the tolerance: root mean square."""
        scale = atol + rtol * jnp.maximum(jnp.abs(y), jnp.abs(other))
        return jnp.sqrt(jnp.mean((error / scale) ** 2))

    def first_step() -> jax.Array:
        """Hairer, Norsett and Wanner I, section II.4, as SciPy has it."""
        slope = f(t, y)
        of_state, of_slope = size(y, y, y), size(slope, y, y)
        small = (of_state < 1e-5) | (of_slope < 1e-5)
        guess = jnp.minimum(jnp.where(small, 1e-6, 0.01 * of_state / of_slope), end - t)
        bend = size(f(t + guess, y + guess * slope) - slope, y, y) / guess
        flat = (of_slope <= 1e-15) & (bend <= 1e-15)
        other = jnp.where(flat, jnp.maximum(1e-6, guess * 1e-3), (0.01 / jnp.maximum(of_slope, bend)) ** 0.2)
        return jnp.minimum(jnp.minimum(100 * guess, other), end - t)

    def turn(state: Any) -> Any:
        t, y, h, times, count, refused, stuck = state
        h = jnp.where(t + h >= end, end - t, h)
        K = [f(t, y)]
        for row, c in zip(A[1:], C[1:], strict=True):
            K.append(f(t + c * h, y + h * combine(row[: len(K)], K)))
        after = y + h * combine(B, K)
        K.append(f(t + h, after))
        error = size(h * combine(E, K), y, after)
        accepted = error < 1
        factor = jnp.where(error == 0, 10.0, jnp.clip(0.9 * error**-0.2, 0.2, 10.0))
        factor = jnp.where(jnp.isnan(error), 0.2, jnp.where(accepted & refused, jnp.minimum(1.0, factor), factor))
        reached = jnp.where(h == end - t, end, t + h)
        times = times.at[count].set(jnp.where(accepted, reached, times[count]))
        stuck = jnp.minimum(h, h * factor) <= 10 * tiny * jnp.abs(t)
        t, y = jnp.where(accepted, reached, t), jnp.where(accepted, after, y)
        return t, y, h * factor, times, count + accepted, ~accepted, stuck

    def goes_on(state: Any) -> jax.Array:
        t, _, _, _, count, _, stuck = state
        return (t < end) & (count < STEPS_AT_ONCE) & ~stuck

    none = jnp.zeros((), bool)
    begin = (t, y, jnp.where(jnp.isnan(h), first_step(), h), jnp.zeros(STEPS_AT_ONCE), jnp.zeros((), int), none, none)
    t, y, h, times, count, _, _ = lax.while_loop(goes_on, turn, begin)
    return times, count, t, y, h


def _too_many(accepted: Sequence[float] | FloatArray, end: float) -> bool:
    """Whether more than `MAX_STEPS` have been taken, or will be at the pace of the last `PACE` steps."""
    if len(accepted) < 5 * PACE:
        return False
    return len(accepted) + PACE * (end - accepted[-1]) / (accepted[-1] - accepted[-PACE - 1]) > MAX_STEPS


def _finite(value: jax.Array, what: str) -> FloatArray:
    state = np.asarray(value)
    if not np.isfinite(state).all():
        raise ValueError(f"{what} returned {state.tolist()}, which is not finite: use a better guess.")
    return state


def _rounded(parameters: Mapping[str, FloatArray]) -> dict[str, Any]:
    """Parameters for a message."""
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
    cost = model.density(piece)(t, x, p) if model.has_running_cost else jnp.zeros(())
    return jnp.append(model.field(mode, piece)(t, x, p), cost)


@partial(jax.jit, static_argnames=("structure",))
def initial_state(arguments: Arguments, p: jax.Array, *, structure: Structure) -> jax.Array:
    """x(t0): (n,)."""
    return Model(structure, arguments).initial_state(p)


@partial(jax.jit, static_argnames=("structure", "i"))
def after_reset(
    arguments: Arguments, t: jax.Array, x: jax.Array, p: jax.Array, *, structure: Structure, i: int
) -> jax.Array:
    """State after the reset map of transition i (from 0): (n,)."""
    return Model(structure, arguments).reset(i)(t, x, p)
