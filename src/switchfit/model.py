"""From a problem to functions that JAX can compile: the structure (static) and the arguments (arrays) of a run.

`Structure` holds everything that shapes the compiled program: which functions, in which order, with which shapes.
`Arguments` holds the numbers. Experiments with equal structure and equal (padded) lengths share one program, and
nothing is compiled anew when transition times, parameters or data change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.data import (
    FloatArray,
    Measurements,
    Observe,
    PiecewisePolynomial,
    ReferenceSignal,
    RunningCost,
    TerminalConstraint,
    TerminalCost,
)
from switchfit.experiment import Experiment, Parameter, guards_of, initial_state_of, reset_maps_of, signals_of
from switchfit.losses import influence, robust
from switchfit.mesh import Mesh
from switchfit.rungekutta import Density, Field, Tableau, tableau_of
from switchfit.system import HybridSystem

Array = jax.Array


def float64() -> Any:
    """Context in which JAX computes in float64; the user's setting is back in force afterwards."""
    return jax.enable_x64(True)


class Sensor(NamedTuple):
    """What of one `Measurements` shapes the program: functions, names and the loss."""

    observe: Observe | None
    channels: int
    sigma: tuple[str | None, ...]  # the parameter that is the sigma of each channel; empty where all are numbers
    loss: str
    loss_scale: float
    delay: str | None  # the parameter that is the delay; None where it is a number, which is in the times

    @classmethod
    def of(cls, item: Measurements) -> Sensor:
        """That of one of the data."""
        delay = item.delay if isinstance(item.delay, str) else None
        return cls(item.observe, item.values.shape[1], item.sigma_names, item.loss, item.loss_scale, delay)


@dataclass(frozen=True)
class Structure:
    """What a compiled program depends on beside the shapes of its arguments. Hashable; functions by identity."""

    mode_names: tuple[str, ...]
    modes: tuple[Callable[..., Any], ...]
    mode_of_segment: tuple[int, ...]
    reset_maps: tuple[Callable[..., Any] | None, ...]
    initial_state: Callable[..., Any] | None
    n: int
    unknown_states: tuple[int, ...]  # entries of the initial state that are estimated
    parameters: tuple[tuple[str, tuple[int, ...], bool], ...]  # the model's name, shape, free
    running: tuple[Callable[..., Any], ...]
    references: tuple[tuple[Observe | None, int], ...]  # observe, channels
    measurements: tuple[Sensor, ...]
    terminal: tuple[Callable[..., Any], ...]
    guards: tuple[Callable[..., Any] | None, ...]
    terminal_constraints: tuple[Callable[..., Any], ...]
    input_shape: tuple[int, ...] | None
    solver: str

    @property
    def tableau(self) -> Tableau:
        """The Runge-Kutta method."""
        return tableau_of(self.solver)

    @property
    def outputs(self) -> tuple[tuple[Observe | None, int], ...]:
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
        function, name = structure.modes[mode], structure.mode_names[mode]

        def f(t: Array, x: Array, p: Array) -> Array:
            given: tuple[Any, ...] = (t, x, self.parameters(p))
            if structure.input_shape is not None:
                size = int(np.prod(structure.input_shape))
                given += (piece(t)[piece.coefficients.shape[-1] - size :].reshape(structure.input_shape),)
            what = f"mode {name!r}"
            return checked_vector(function, given, (structure.n,), what, f"f({'t, x, p, u'[: 3 * len(given) - 2]})")

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
                total = total + checked_vector(function, (t, x, self.parameters(p)), (), "RunningCost", "ell(t, x, p)")
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
        observe, q = self.structure.references[k]
        return self.observed(observe, t, x, p, q) - piece(t)[channels]

    def observed(self, observe: Observe | None, t: Array, x: Array, p: Array, channels: int) -> Array:
        """What a sensor sees: (q,)."""
        if observe is None:
            if x.shape != (channels,):
                raise ValueError(
                    f"Without observe the whole state is compared: its {x.shape[0]} entries need as many channels of "
                    f"data; got {channels}. Give observe=h(t, x, p) -> ({channels},)."
                )
            return x
        return checked_vector(observe, (t, x, self.parameters(p)), (channels,), "observe", "h(t, x, p)")

    def sample_residual(self, k: int, sample: Samples, x: Array, p: Array) -> Array:
        """``h - y`` of one sample of the k-th Measurements, 0 where it is missing: (q,)."""
        sensor = self.structure.measurements[k]
        h = self.observed(sensor.observe, sample.time, x, p, sensor.channels)
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
            total = total + checked_vector(phi, (x, self.parameters(p)), (), "TerminalCost", "phi(x, p)")
        return total

    def reset(self, i: int) -> Callable[[Array, Array, Array], Array]:
        """Reset map R_i(t, x, p) of transition i, which must have one."""
        function = self.structure.reset_maps[i]
        sequence = [self.structure.mode_names[m] for m in self.structure.mode_of_segment[i : i + 2]]
        if function is None:
            raise ValueError(f"transition {i + 1} has no reset map.")
        apply = function

        def R(t: Array, x: Array, p: Array) -> Array:
            given = (t, x, self.parameters(p))
            return checked_vector(apply, given, (self.structure.n,), f"reset map {tuple(sequence)}", "R(t, x, p)")

        return R

    def guard(self, i: int) -> Callable[[Array, Array, Array], Array]:
        """Guard g_i(t, x, p) of transition i, which must have one."""
        function = self.structure.guards[i]
        sequence = [self.structure.mode_names[m] for m in self.structure.mode_of_segment[i : i + 2]]
        if function is None:
            raise ValueError(f"transition {i + 1} has no guard.")
        apply = function

        def g(t: Array, x: Array, p: Array) -> Array:
            return checked_vector(apply, (t, x, self.parameters(p)), (), f"guard {tuple(sequence)}", "g(t, x, p)")

        return g

    def terminal_constraint(self, x: Array, p: Array) -> Array:
        """All terminal constraints in one: (m,)."""
        parts = []
        for psi in self.structure.terminal_constraints:
            value = called(psi, (x, self.parameters(p)), "TerminalConstraint", "psi(x, p)")
            if value.ndim > 1:
                raise ValueError(
                    f"TerminalConstraint: psi(x, p) must return a number or an array of shape (m,); got shape "
                    f"{value.shape}."
                )
            parts.append(checked_vector(psi, (x, self.parameters(p)), value.shape, "TerminalConstraint", "psi(x, p)"))
        return jnp.concatenate([part.reshape(-1) for part in parts])

    def initial_state(self, p: Array) -> Array:
        """x(t0), (n,)."""
        if self.structure.initial_state is None:
            unknown = self.structure.unknown_states
            x0 = self.arguments.initial_state
            return x0.at[np.array(unknown)].set(p[-len(unknown) :]) if unknown else x0
        given = (self.parameters(p),)
        return checked_vector(
            self.structure.initial_state, given, (self.structure.n,), "initial_state", "initial_state(p)"
        )


class _Asked(dict[str, Array]):
    """The dict the user's functions get while it is found out which parameters they ask for.

    Parameters
    ----------
    shown : what the dict holds
    others : what it holds only for a function that asks by name: the targets of parameter maps
    asked : set of str, to which every name that is asked for is added
    """

    def __init__(self, shown: Mapping[str, Array], others: Mapping[str, Array], asked: set[str]) -> None:
        super().__init__(shown)
        self.others = others
        self.asked = asked

    def __getitem__(self, name: str) -> Array:
        value = super().__getitem__(name) if name in self.keys_alone() else self.others[name]
        self.asked.add(name)
        return value

    def __contains__(self, name: object) -> bool:
        there = name in self.keys_alone()
        if there:
            self.asked.add(str(name))
        return there

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self.keys_alone() or name in self.others else default

    def keys_alone(self) -> Any:
        """The names, without asking for them."""
        return super().keys()

    def __iter__(self) -> Iterator[str]:
        return iter(self.whole())

    def __len__(self) -> int:
        return len(self.whole())

    def keys(self) -> Any:
        return self.whole().keys()

    def values(self) -> Any:
        return self.whole().values()

    def items(self) -> Any:
        return self.whole().items()

    def whole(self) -> dict[str, Array]:
        """All that is shown, which counts as asked for."""
        self.asked.update(self.keys_alone())
        return {name: super(_Asked, self).__getitem__(name) for name in self.keys_alone()}


class _Asking(Model):
    """A model whose functions are watched: which parameters do they ask for?"""

    def __init__(self, structure: Structure, arguments: Arguments, others: frozenset[str], asked: set[str]) -> None:
        super().__init__(structure, arguments)
        self.others = others
        self.asked = asked

    def parameters(self, p: Array) -> Mapping[str, Array]:
        named = super().parameters(p)
        shown = {name: value for name, value in named.items() if name not in self.others}
        return _Asked(shown, {name: named[name] for name in self.others}, self.asked)


UNTRACEABLE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
"""What JAX raises where Python code wants to know a number that is not known yet."""


def called(function: Callable[..., Any], arguments: tuple[Any, ...], what: str, signature: str) -> Array:
    """Call a function of the user's while tracing; whatever it raises becomes one sentence that names it."""
    try:
        value = function(*arguments)
    except KeyError as error:
        parameters = next(given for given in arguments if isinstance(given, dict))
        raise ValueError(
            f"{what} asks for the parameter {error}, which the problem lacks; it has {', '.join(parameters) or 'none'}."
        ) from error
    except UNTRACEABLE as error:
        raise ValueError(
            f"{what} decides by the value of t, x or p (an `if`, a `while`, float() or numpy function), which JAX "
            "cannot differentiate. Write it with jax.numpy; if the dynamics change there, make it a mode with a "
            "transition time."
        ) from error
    except Exception as error:
        said = str(error).rstrip(".")
        raise ValueError(f"{what}: {signature} raised {type(error).__name__}: {said}.") from error
    try:
        return jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: {signature} must return an array of numbers; got {value!r}.") from error


def weighted(W: Array, r: Array) -> Array:
    """``W r`` for a W given by its diagonal (q,) or in full (q, q); r is (q,) or (q, D)."""
    return W @ r if W.ndim == 2 else (W * r.T).T


def _compact(W: FloatArray) -> FloatArray:
    """The diagonal of a diagonal matrix: it costs q products instead of q squared at every stage of every step."""
    diagonal = np.diag(W)
    return diagonal if np.array_equal(W, np.diag(diagonal)) else W


def checked_vector(
    function: Callable[..., Any], arguments: tuple[Any, ...], shape: tuple[int, ...], what: str, signature: str
) -> Array:
    """What a function of the user's returns, checked (while tracing) to be a float64 array of the given shape."""
    array = called(function, arguments, what, signature)
    if array.shape != shape and array.size == int(np.prod(shape)) == 1:
        array = array.reshape(shape)
    if array.shape != shape:
        raise ValueError(f"{what}: {signature} must return an array of shape {shape}; got shape {array.shape}.")
    if jnp.issubdtype(array.dtype, jnp.integer) or array.dtype == jnp.bool_:
        return array.astype(jnp.float64)
    if array.dtype != jnp.float64:
        raise ValueError(
            f"{what}: {signature} must return float64; got {array.dtype}. Its arguments are float64: do not cast them."
        )
    return array


def structure_of(
    system: HybridSystem,
    experiment: Experiment,
    parameters: Mapping[str, Parameter],
    solver: str,
    targets: frozenset[str] = frozenset(),
) -> Structure:
    """The structure of one experiment, its functions checked.

    Parameters
    ----------
    targets : set of str
        Parameters of the problem that some experiment's map names as what it maps to. They are this experiment's
        where it maps to them, or asks for them by their own name.
    """
    names = tuple(dict.fromkeys(experiment.mode_sequence))
    initial = initial_state_of(system, experiment)
    of_kind = partial(_of_kind, experiment.data)
    mapped = experiment.parameter_map
    order = {name: k for k, name in enumerate(parameters)}
    # The same order in every run, whatever its map: runs then share a program.
    named = sorted({*parameters, *mapped}, key=lambda name: (order.get(name, len(order)), name))
    others = frozenset(name for name in targets if name not in mapped)
    meant = {name: parameters[mapped.get(name, name)] for name in named}
    unknown = () if callable(initial) else tuple(k for k, x in enumerate(initial) if not getattr(x, "fixed", True))
    structure = Structure(
        mode_names=names,
        modes=tuple(system.modes[name] for name in names),
        mode_of_segment=tuple(names.index(mode) for mode in experiment.mode_sequence),
        reset_maps=reset_maps_of(system, experiment.mode_sequence),
        initial_state=initial if callable(initial) else None,
        n=_state_size(initial, meant),
        unknown_states=unknown,
        parameters=tuple((name, q.shape, not q.fixed) for name, q in meant.items()),
        running=tuple(item.ell for item in of_kind(RunningCost)),
        references=tuple((item.observe, item.signal.channels) for item in of_kind(ReferenceSignal)),
        measurements=tuple(map(Sensor.of, of_kind(Measurements))),
        terminal=tuple(item.phi for item in of_kind(TerminalCost)),
        guards=guards_of(system, experiment.mode_sequence),
        terminal_constraints=tuple(item.psi for item in of_kind(TerminalConstraint)),
        input_shape=None if experiment.inputs is None else tuple(experiment.inputs.values.shape[1:]),
        solver=solver,
    )
    asked = checked_functions(structure, others)
    # What is fixed costs nothing, and functions may look at it in ways that do not show.
    used = tuple(q for q in structure.parameters if q[0] in asked or not (q[2] or q[0] in others))
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


@lru_cache(maxsize=256)
def checked_functions(structure: Structure, others: frozenset[str] = frozenset()) -> frozenset[str]:
    """Call every function of the user's once, abstractly: that shapes, dtypes and parameter names are right.

    What has been found right is not looked at again when another problem is made of it.

    Parameters
    ----------
    structure : Structure
        With all parameters that functions may ask for.
    others : set of str
        Those among them that a function sees only if it asks for them by name.

    Returns
    -------
    asked : set of str
        The parameters that they ask for; all but the `others` where that cannot be told, since a function does
        something with the dict that only an ordinary one allows.

    Raises
    ------
    ValueError
        Naming the mode or function, what it should return and what it returned.
    """
    asked: set[str] = set()
    try:
        _call_functions(structure, partial(_Asking, others=others, asked=asked))
        return frozenset(asked)
    except Exception:
        shown = tuple(q for q in structure.parameters if q[0] not in others)
    try:
        _call_functions(replace(structure, parameters=shown), Model)
    except ValueError:
        if not others:
            raise
        shown = structure.parameters  # one of the others may be asked for; if not, this says what is wrong
        _call_functions(structure, Model)
    return frozenset(name for name, _, _ in shown)


def _call_functions(structure: Structure, model_of: Callable[[Structure, Arguments], Model]) -> None:
    def call_all(arguments: Arguments, t: Array, x: Array, p: Array, samples: list[Samples]) -> list[Array]:
        model = model_of(structure, arguments)
        piece = Piece(t, arguments.signals[0])
        values = [model.field(mode, piece)(t, x, p) for mode in range(len(structure.modes))]
        values += [model.reset(i)(t, x, p) for i in structure.resets]
        values += [model.guard(i)(t, x, p) for i in structure.guarded]
        if structure.terminal_constraints:
            values.append(model.terminal_constraint(x, p))
        values.append(model.density(piece)(t, x, p))
        values += [model.sample_cost(k, model.seen_at(k, s, p), x, p) for k, s in enumerate(samples)]
        return [*values, model.terminal(x, p), model.initial_state(p)]

    with float64():
        t, x, p = (jax.ShapeDtypeStruct(shape, jnp.float64) for shape in ((), (structure.n,), (structure.M,)))
        rows = [jax.ShapeDtypeStruct((sensor.channels,), jnp.float64) for sensor in structure.measurements]
        samples: Any = [Samples(jax.ShapeDtypeStruct((), jnp.int64), t, row, row) for row in rows]  # type: ignore[arg-type]
        jax.eval_shape(call_all, _shapes_of_arguments(structure), t, x, p, samples)


@lru_cache(maxsize=256)
def terminal_constraint_count(structure: Structure) -> int:
    """Number of terminal constraints, m."""
    if not structure.terminal_constraints:
        return 0

    def constraint(arguments: Arguments, x: Array, p: Array) -> Array:
        return Model(structure, arguments).terminal_constraint(x, p)

    with float64():
        x, p = (jax.ShapeDtypeStruct((size,), jnp.float64) for size in (structure.n, structure.M))
        return int(jax.eval_shape(constraint, _shapes_of_arguments(structure), x, p).shape[0])


def _shapes_of_arguments(structure: Structure) -> Arguments:
    """Arguments on a mesh of one cell: shapes alone."""
    channels = sum(q for _, q in structure.references) + int(np.prod(structure.input_shape or ()))

    def shaped(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, jnp.float64)

    return Arguments(
        nodes=shaped(2),
        signals=shaped(1, 4, channels),
        fixed=tuple(shaped(*shape) for _, shape, free in structure.parameters if not free),
        initial_state=shaped(structure.n),
        samples=(),
        weights=tuple(shaped(q) for _, q in structure.references),
    )


def _of_kind(data: tuple[Any, ...], kind: type) -> list[Any]:
    return [item for item in data if isinstance(item, kind)]


def _state_size(initial: Any, parameters: Mapping[str, Parameter]) -> int:
    """Number of states, from the initial state or what its function returns."""
    if not callable(initial):
        return len(initial)
    with float64():
        p = {name: jax.ShapeDtypeStruct(q.shape, jnp.float64) for name, q in parameters.items()}
        shape = jax.eval_shape(lambda p: called(initial, (p,), "initial_state", "initial_state(p)"), p).shape
    if len(shape) != 1 or shape[0] == 0:
        raise ValueError(f"initial_state(p) must return an array of shape (n,); got shape {shape}.")
    return int(shape[0])


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
