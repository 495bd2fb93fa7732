"""From a problem to functions that JAX can compile: the structure (static) and the arguments (arrays) of a run.

`Structure` holds everything that shapes the compiled program: which functions, in which order, with which shapes.
`Arguments` holds the numbers. Experiments with equal structure and equal (padded) lengths share one program, and
nothing is compiled anew when transition times, parameters or data change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.data import (
    FloatArray,
    Measurements,
    PiecewisePolynomial,
    ReferenceSignal,
    RunningCost,
    TerminalConstraint,
    TerminalCost,
)
from switchfit.experiment import Experiment, Parameter, guards_of, initial_state_of, reset_maps_of, signals_of
from switchfit.functions import Function, Shape, trace_function
from switchfit.functions import float64 as float64
from switchfit.losses import influence, robust
from switchfit.mesh import Mesh
from switchfit.rungekutta import Density, Field, Tableau, tableau_of
from switchfit.system import HybridSystem

Array = jax.Array


class Sensor(NamedTuple):
    """What of one `Measurements` shapes the program: functions, names and the loss."""

    observe: Function | None  # None: the whole state
    channels: int
    sigma: tuple[str | None, ...]  # the parameter that is the sigma of each channel; empty where all are numbers
    loss: str
    loss_scale: float
    delay: str | None  # the parameter that is the delay; None where it is a number, which is in the times

    @classmethod
    def of(cls, item: Measurements, observe: Function | None) -> Sensor:
        """That of one of the data."""
        delay = item.delay if isinstance(item.delay, str) else None
        return cls(observe, item.values.shape[1], item.sigma_names, item.loss, item.loss_scale, delay)

    @property
    def named(self) -> set[str]:
        """Parameters that it is measured with."""
        return {name for name in (*self.sigma, self.delay) if name is not None}


@dataclass(frozen=True)
class Structure:
    """What a compiled program depends on beside the shapes of its arguments. Hashable; functions by what they do."""

    mode_names: tuple[str, ...]
    modes: tuple[Function, ...]
    mode_of_segment: tuple[int, ...]
    reset_maps: tuple[Function | None, ...]
    initial_state: Function | None
    n: int
    unknown_states: tuple[int, ...]  # entries of the initial state that are estimated
    parameters: tuple[tuple[str, tuple[int, ...], bool], ...]  # the model's name, shape, free
    running: tuple[Function, ...]
    references: tuple[tuple[Function | None, int], ...]  # observe, channels
    measurements: tuple[Sensor, ...]
    terminal: tuple[Function, ...]
    guards: tuple[Function | None, ...]
    terminal_constraints: tuple[Function, ...]
    input_shape: tuple[int, ...] | None
    solver: str

    @property
    def tableau(self) -> Tableau:
        """The Runge-Kutta method."""
        return tableau_of(self.solver)

    @property
    def outputs(self) -> tuple[tuple[Function | None, int], ...]:
        """What sees the state, reference signals first, then the Measurements: function and channels of each."""
        return (*self.references, *((sensor.observe, sensor.channels) for sensor in self.measurements))

    @property
    def N(self) -> int:
        """Number of transitions."""
        return len(self.reset_maps)

    @cached_property
    def M(self) -> int:
        """Length of p: the free scalar parameters, then the unknown entries of the initial state."""
        return sum(int(np.prod(shape)) for _, shape, free in self.parameters if free) + len(self.unknown_states)

    @property
    def functions(self) -> Structure:
        """The same with one segment: what programs depend on that work in one mode at a time."""
        return replace(self, mode_of_segment=(0,), reset_maps=(), guards=(), terminal_constraints=())

    @property
    def resets(self) -> tuple[int, ...]:
        """The transitions (from 0) at which a reset map acts."""
        return tuple(i for i, reset in enumerate(self.reset_maps) if reset is not None)

    @property
    def guarded(self) -> tuple[int, ...]:
        """The transitions (from 0) that have a guard."""
        return tuple(i for i, guard in enumerate(self.guards) if guard is not None)

    @property
    def terminal_constraint_count(self) -> int:
        """Number of terminal constraints, m."""
        return sum(int(np.prod(psi.shape)) for psi in self.terminal_constraints)

    @property
    def digests(self) -> dict[str, str]:
        """What identifies each of its functions in every process, by what the function is."""
        found = {f"mode {name!r}": mode for name, mode in zip(self.mode_names, self.modes, strict=True)}
        for kind, functions in (
            ("initial_state", (self.initial_state,)),
            ("reset map", self.reset_maps),
            ("guard", self.guards),
            ("RunningCost", self.running),
            ("observe", tuple(observe for observe, _ in self.outputs)),
            ("TerminalCost", self.terminal),
            ("TerminalConstraint", self.terminal_constraints),
        ):
            found |= {f"{kind} {k + 1}": function for k, function in enumerate(functions) if function is not None}
        return {name: function.digest for name, function in found.items()}

    @property
    def constrained(self) -> bool:
        """Whether anything has to hold beside the differential equation."""
        return bool(self.guarded or self.terminal_constraints)


class Samples(NamedTuple):
    """Discrete samples: cell that ends at each (K,), time (K,), value (K, q), weight (K, q), 0 where missing."""

    cell: Array
    time: Array
    value: Array
    weight: Array


class Arguments(NamedTuple):
    """Numbers of a run, none of them estimated.

    Attributes
    ----------
    nodes : (G + 1,)
    signals : (G, 4, S)
        Polynomial of each signal channel in each cell, in powers of time since the cell's first node: the
        references in the order of the data, then the input.
    fixed : values of the fixed parameters, in order
    initial_state : (n,), zeros where it is a function of the parameters; unknown entries are not looked at
    samples : one `Samples` for each `Measurements`
    weights : W of each `ReferenceSignal`, its diagonal (q,) where it is diagonal, else (q, q)
    """

    nodes: Array
    signals: Array
    fixed: tuple[Array, ...]
    initial_state: Array
    samples: tuple[Samples, ...]
    weights: tuple[Array, ...]

    def without_mesh(self) -> Arguments:
        """What the functions of the model need of them: shapes do not depend on the number of nodes or samples."""
        return self._replace(nodes=np.zeros(2), signals=np.zeros((1, *self.signals.shape[1:])), samples=())  # type: ignore[arg-type]


class Piece(NamedTuple):
    """The signals in one cell: first node (), coefficients (4, S)."""

    origin: Array
    coefficients: Array

    def __call__(self, t: Array) -> Array:
        """All channels at time t: (S,)."""
        return _polynomial(t - self.origin, self.coefficients)


@jax.custom_jvp
def _polynomial(s: Array, c: Array) -> Array:
    """``c[0] + c[1] s + c[2] s**2 + ...``: (S,).

    Its derivative in s is given as a polynomial too. Differentiated by JAX, Horner's scheme carries a tangent through
    each of its steps in every direction: with a reference signal a quarter of an evaluation went into that.
    The coefficients are data and have no derivative.
    """
    value = c[-1]
    for k in reversed(range(c.shape[0] - 1)):
        value = c[k] + s * value
    return value


@_polynomial.defjvp
def _polynomial_jvp(at: tuple[Array, Array], direction: tuple[Array, Array]) -> tuple[Array, Array]:
    s, c = at
    powers = jnp.arange(1.0, c.shape[0])[:, None]
    slope = _polynomial(s, powers * c[1:]) if c.shape[0] > 1 else jnp.zeros_like(c[0])
    return _polynomial(s, c), slope * direction[0]


class Model:
    """The functions of one experiment, bound to its arguments while a program is traced.

    All functions take the flat vector p (M,) of the free parameters and the unknown entries of the initial state.
    """

    def __init__(self, structure: Structure, arguments: Arguments) -> None:
        self.structure = structure
        self.arguments = arguments
        self.tableau = structure.tableau

    def parameters(self, p: Array) -> Mapping[str, Array]:
        """The dict the user's functions get."""
        named: dict[str, Array] = {}
        fixed = iter(self.arguments.fixed)
        position = 0
        for name, shape, free in self.structure.parameters:
            if free:
                size = int(np.prod(shape))
                named[name] = p[position : position + size].reshape(shape)
                position += size
            else:
                named[name] = next(fixed)
        return named

    def field(self, mode: int, piece: Piece) -> Field:
        """Vector field of a mode inside one cell."""
        structure = self.structure
        function = structure.modes[mode]

        def f(t: Array, x: Array, p: Array) -> Array:
            given: tuple[Any, ...] = (t, x, self.parameters(p))
            if structure.input_shape is not None:
                size = int(np.prod(structure.input_shape))
                given += (piece(t)[piece.coefficients.shape[-1] - size :].reshape(structure.input_shape),)
            return function(*given)

        return f

    @property
    def has_running_cost(self) -> bool:
        """Whether anything is integrated along the trajectory."""
        return bool(self.structure.running or self.structure.references)

    def density(self, piece: Piece) -> Density:
        """Sum of all running costs inside one cell, reference signals included."""

        def ell(t: Array, x: Array, p: Array) -> Array:
            total = jnp.zeros(())
            for function in self.structure.running:
                total = total + function(t, x, self.parameters(p))
            for residual, W in zip(self.reference_residuals(piece), self.arguments.weights, strict=True):
                r = residual(t, x, p)
                total = total + 0.5 * r @ weighted(W, r)
            return total

        return ell

    def reference_residuals(self, piece: Piece) -> list[Callable[[Array, Array, Array], Array]]:
        """``y(t, x, p) - y_m(t)`` of each reference signal, (q,)."""
        ends = np.cumsum([0, *(channels for _, channels in self.structure.references)]).tolist()
        return [
            partial(self._reference_residual, k, slice(first, last), piece)
            for k, (first, last) in enumerate(pairwise(ends))
        ]

    def _reference_residual(self, k: int, channels: slice, piece: Piece, t: Array, x: Array, p: Array) -> Array:
        return self.observed(self.structure.references[k][0], t, x, p) - piece(t)[channels]

    def observed(self, observe: Function | None, t: Array, x: Array, p: Array) -> Array:
        """What a sensor sees: (q,)."""
        return x if observe is None else observe(t, x, self.parameters(p))

    def sample_residual(self, k: int, sample: Samples, x: Array, p: Array) -> Array:
        """``h - y`` of one sample of the k-th Measurements, 0 where it is missing: (q,)."""
        sensor = self.structure.measurements[k]
        h = self.observed(sensor.observe, sample.time, x, p)
        return jnp.where(sample.weight > 0, h - sample.value, 0.0)

    def seen_at(self, k: int, sample: Samples, p: Array) -> Samples:
        """A late sample with the time of the state that it is of, ``t - delay``, in place of its own."""
        delay = self.structure.measurements[k].delay
        return sample if delay is None else sample._replace(time=sample.time - self.parameters(p)[delay])

    def log_sigma(self, k: int, sample: Samples, p: Array) -> Array:
        """Logarithm of the sigma of each channel that is a parameter and has a value in this sample, else 0: (q,)."""
        named = self.structure.measurements[k].sigma
        parameters = self.parameters(p)
        sigma = [jnp.ones(()) if name is None else parameters[name] for name in named]
        return jnp.where(sample.weight > 0, jnp.log(jnp.stack(sigma)), 0.0)

    def sample_cost(self, k: int, sample: Samples, x: Array, p: Array) -> Array:
        """``1/2 sum C**2 rho(((h - y) / sigma)**2 / C**2) + sum log sigma`` of one sample.

        Without a robust loss rho is the identity; log sigma is there where sigma is a parameter.
        """
        sensor = self.structure.measurements[k]
        r = self.sample_residual(k, sample, x, p)
        u = sample.weight * r * r
        if not sensor.sigma:
            return 0.5 * jnp.sum(robust(sensor.loss, sensor.loss_scale, u, jnp))
        log_sigma = self.log_sigma(k, sample, p)
        u = u * jnp.exp(-2.0 * log_sigma)
        return jnp.sum(0.5 * robust(sensor.loss, sensor.loss_scale, u, jnp) + log_sigma)

    def sample_information(self, k: int, sample: Samples, x: Array, p: Array) -> Array:
        """Weight of each channel of one sample in the Gauss-Newton matrix, ``rho' / sigma**2``: (q,)."""
        sensor = self.structure.measurements[k]
        weight = sample.weight
        if sensor.sigma:
            weight = weight * jnp.exp(-2.0 * self.log_sigma(k, sample, p))
        if sensor.loss == "linear":
            return weight
        r = self.sample_residual(k, sample, x, p)
        return weight * influence(sensor.loss, sensor.loss_scale, weight * r * r, jnp)

    def terminal(self, x: Array, p: Array) -> Array:
        """Sum of the terminal costs."""
        total = jnp.zeros(())
        for phi in self.structure.terminal:
            total = total + phi(x, self.parameters(p))
        return total

    def reset(self, i: int) -> Callable[[Array, Array, Array], Array]:
        """Reset map R_i(t, x, p) of transition i, which must have one."""
        return self._at_transition(self.structure.reset_maps[i], f"transition {i + 1} has no reset map.")

    def guard(self, i: int) -> Callable[[Array, Array, Array], Array]:
        """Guard g_i(t, x, p) of transition i, which must have one."""
        return self._at_transition(self.structure.guards[i], f"transition {i + 1} has no guard.")

    def _at_transition(self, function: Function | None, missing: str) -> Callable[[Array, Array, Array], Array]:
        if function is None:
            raise ValueError(missing)
        return lambda t, x, p: function(t, x, self.parameters(p))

    def terminal_constraint(self, x: Array, p: Array) -> Array:
        """All terminal constraints in one: (m,)."""
        parts = [psi(x, self.parameters(p)) for psi in self.structure.terminal_constraints]
        return jnp.concatenate([part.reshape(-1) for part in parts])

    def initial_state(self, p: Array) -> Array:
        """x(t0), (n,)."""
        if self.structure.initial_state is None:
            unknown = self.structure.unknown_states
            x0 = self.arguments.initial_state
            return x0.at[np.array(unknown)].set(p[-len(unknown) :]) if unknown else x0
        return self.structure.initial_state(self.parameters(p))


def weighted(W: Array, r: Array) -> Array:
    """``W r`` for a W given by its diagonal (q,) or in full (q, q); r is (q,) or (q, D)."""
    return W @ r if W.ndim == 2 else (W * r.T).T


def _compact(W: FloatArray) -> FloatArray:
    """The diagonal of a diagonal matrix: it costs q products instead of q squared at every stage of every step."""
    diagonal = np.diag(W)
    return diagonal if np.array_equal(W, np.diag(diagonal)) else W


class Functions:
    """Traces the functions of a problem's experiments, each of them once.

    Parameters
    ----------
    parameters : mapping of str to Parameter
        Of the problem.
    targets : set of str
        Those that some experiment's map names as what it maps to. They are an experiment's where it maps to them, or
        asks for them by their own name.
    """

    def __init__(self, parameters: Mapping[str, Parameter], targets: frozenset[str]) -> None:
        self.parameters, self.targets = parameters, targets
        self._traced: dict[Any, Function] = {}

    def of(self, experiment: Experiment) -> _Tracer:
        """What traces the functions of one experiment."""
        mapped = experiment.parameter_map
        order = {name: k for k, name in enumerate(self.parameters)}
        # The same order in every run, whatever its map: runs then share a program.
        named = sorted({*self.parameters, *mapped}, key=lambda name: (order.get(name, len(order)), name))
        hidden = frozenset(name for name in self.targets if name not in mapped)
        return _Tracer({name: self.parameters[mapped.get(name, name)] for name in named}, hidden, self._traced)


class _Tracer:
    """Traces the functions of one experiment, and notes which parameters they ask for.

    Attributes
    ----------
    named : dict of str to Parameter, by the model's names
    hidden : set of str
        Those that a function sees only if it asks for them by name.
    asked : set of str
    """

    def __init__(self, named: dict[str, Parameter], hidden: frozenset[str], traced: dict[Any, Function]) -> None:
        self.named, self.hidden, self._traced = named, hidden, traced
        self.shapes = {name: q.shape for name, q in named.items()}
        self.asked: set[str] = set()
        self._key = tuple(self.shapes.items()), hidden

    def __call__(
        self,
        function: Callable[..., Any],
        arguments: tuple[Shape | None, ...],
        shape: Shape | None,
        what: str,
        form: str,
    ) -> Function:
        """A function that takes arguments of these shapes, None standing for p, and returns an array of a shape."""
        key = (id(function), arguments, shape, what, self._key)
        traced = self._traced.get(key)
        if traced is None:
            traced = trace_function(function, arguments, self.shapes, self.hidden, what=what, form=form, shape=shape)
            self._traced[key] = traced
        self.asked.update(traced.parameters)
        return traced


def structure_of(system: HybridSystem, experiment: Experiment, functions: Functions, solver: str) -> Structure:
    """The structure of one experiment, its functions traced and checked.

    Raises
    ------
    ValueError
        Naming the mode or function, what it should return and what it returned.
    """
    trace = functions.of(experiment)
    names = tuple(dict.fromkeys(experiment.mode_sequence))
    initial = initial_state_of(system, experiment)
    x0 = trace(initial, (None,), None, "initial_state", "initial_state(p)") if callable(initial) else None
    if x0 is not None and (len(x0.shape) != 1 or x0.shape == (0,)):
        raise ValueError(f"initial_state(p) must return an array of shape (n,); got shape {x0.shape}.")
    n = len(initial) if x0 is None else x0.shape[0]
    unknown = () if callable(initial) else tuple(k for k, x in enumerate(initial) if not getattr(x, "fixed", True))
    of_kind = partial(_of_kind, experiment.data)
    at: tuple[Shape | None, ...] = ((), (n,), None)
    inputs = None if experiment.inputs is None else tuple(experiment.inputs.values.shape[1:])
    in_mode, form = (at, "f(t, x, p)") if inputs is None else ((*at, inputs), "f(t, x, p, u)")

    def transitions(kind: tuple[Callable[..., Any] | None, ...], shape: Shape, what: str, form: str) -> tuple[Any, ...]:
        pairs = zip(kind, pairwise(experiment.mode_sequence), strict=True)
        return tuple(None if g is None else trace(g, at, shape, f"{what} {pair}", form) for g, pair in pairs)

    def observe(item: Measurements | ReferenceSignal, channels: int) -> Function | None:
        if item.observe is not None:
            return trace(item.observe, at, (channels,), "observe", "h(t, x, p)")
        if channels != n:
            raise ValueError(
                f"Without observe the whole state is compared: its {n} entries need as many channels of data; got "
                f"{channels}. Give observe=h(t, x, p) -> ({channels},)."
            )
        return None

    modes = tuple(trace(system.modes[name], in_mode, (n,), f"mode {name!r}", form) for name in names)
    references = ((item, item.signal.channels) for item in of_kind(ReferenceSignal))
    measurements = ((item, item.values.shape[1]) for item in of_kind(Measurements))
    constraints = tuple(
        trace(item.psi, at[1:], None, "TerminalConstraint", "psi(x, p)") for item in of_kind(TerminalConstraint)
    )
    for psi in constraints:
        if len(psi.shape) > 1:
            raise ValueError(
                f"TerminalConstraint: psi(x, p) must return a number or an array of shape (m,); got shape {psi.shape}."
            )
    structure = Structure(
        mode_names=names,
        modes=modes,
        mode_of_segment=tuple(names.index(mode) for mode in experiment.mode_sequence),
        reset_maps=transitions(reset_maps_of(system, experiment.mode_sequence), (n,), "reset map", "R(t, x, p)"),
        initial_state=x0,
        n=n,
        unknown_states=unknown,
        parameters=(),
        running=tuple(trace(item.ell, at, (), "RunningCost", "ell(t, x, p)") for item in of_kind(RunningCost)),
        references=tuple((observe(item, channels), channels) for item, channels in references),
        measurements=tuple(Sensor.of(item, observe(item, channels)) for item, channels in measurements),
        terminal=tuple(trace(item.phi, at[1:], (), "TerminalCost", "phi(x, p)") for item in of_kind(TerminalCost)),
        guards=transitions(guards_of(system, experiment.mode_sequence), (), "guard", "g(t, x, p)"),
        terminal_constraints=constraints,
        input_shape=inputs,
        solver=solver,
    )
    asked = trace.asked.union(*(sensor.named for sensor in structure.measurements))
    # What is fixed costs nothing.
    used = tuple(
        (name, q.shape, not q.fixed)
        for name, q in trace.named.items()
        if name in asked or (q.fixed and name not in trace.hidden)
    )
    return replace(structure, parameters=used)


def arguments_of(
    structure: Structure,
    system: HybridSystem,
    experiment: Experiment,
    parameters: Mapping[str, Parameter],
    mesh: Mesh,
    sample_lengths: Sequence[int],
) -> Arguments:
    """The arrays (NumPy's) of one experiment on a mesh that holds all its sample times and knots as nodes.

    The samples of each of its Measurements are padded to the given lengths.
    """
    initial = initial_state_of(system, experiment)
    mapped = experiment.parameter_map
    fixed = tuple(parameters[mapped.get(name, name)].value for name, _, free in structure.parameters if not free)
    measurements = _of_kind(experiment.data, Measurements)
    samples = tuple(_padded_samples(*given, mesh) for given in zip(measurements, sample_lengths, strict=True))
    weights = tuple(_compact(item.weights) for item in _of_kind(experiment.data, ReferenceSignal))
    x0 = np.zeros(structure.n) if callable(initial) else initial_values(initial)
    return Arguments(mesh.nodes, _signals_by_cell(experiment, mesh), fixed, x0, samples, weights)  # type: ignore[arg-type]


def initial_values(initial: Any) -> FloatArray:
    """An initial state that is no function, as numbers (n,): where it is unknown, its guess."""
    return np.array([x.value if isinstance(x, Parameter) else x for x in initial], dtype=np.float64)


def _of_kind(data: tuple[Any, ...], kind: type) -> list[Any]:
    return [item for item in data if isinstance(item, kind)]


def _padded_samples(item: Measurements, length: int, mesh: Mesh) -> Samples:
    """Samples of one Measurements, padded with missing ones to a length."""
    extra = length - len(item.times)
    rows = ((0, extra), (0, 0))
    return Samples(
        np.pad(mesh.cell_ending_at(item.seen_times), (0, extra), mode="edge"),  # type: ignore[arg-type]  # made jax arrays
        np.pad(item.seen_times, (0, extra), mode="edge"),  # type: ignore[arg-type]
        np.pad(np.nan_to_num(item.values), rows),  # type: ignore[arg-type]
        np.pad(item.weights, rows),  # type: ignore[arg-type]
    )


def _signals_by_cell(experiment: Experiment, mesh: Mesh) -> FloatArray:
    """Every signal as a cubic in each cell, in powers of the time since the cell's first node: (G, 4, S)."""
    none = np.zeros((len(mesh.nodes) - 1, 4, 0))
    return np.concatenate([none, *(by_cell(signal, mesh) for signal in signals_of(experiment))], axis=2)


def by_cell(signal: PiecewisePolynomial, mesh: Mesh) -> FloatArray:
    """One signal as a cubic in each cell of a mesh that has its knots as nodes: (G, 4, q)."""
    starts = mesh.nodes[:-1]
    middles = 0.5 * (mesh.nodes[:-1] + mesh.nodes[1:])
    k = signal.interval(middles)
    s = (starts - signal.knots[k])[:, None]
    shifted = signal.coefficients[k]
    c1, c2, c3 = shifted[:, 1].copy(), shifted[:, 2].copy(), shifted[:, 3]
    shifted[:, 0] += s * (c1 + s * (c2 + s * c3))
    shifted[:, 1] += s * (2 * c2 + 3 * s * c3)
    shifted[:, 2] += 3 * s * c3
    return shifted
