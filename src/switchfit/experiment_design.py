"""Which experiment tells most: inputs, sample times and sensors by which unknowns will be known best.

The criterion says how large the covariance of some unknowns will be, as one number.

With the information F (d, d) and a basis Z (d, r) of the changes of theta that guards allow, the covariance of all
unknowns is ``V = Z (Z' F Z)^-1 Z'``, and C (s, s) that of the s unknowns that count, each divided by its scale. With
the eigenvalues v_1, ..., v_s of C, the mean variance of power q,

    m(F) = ((v_1^q + ... + v_s^q) / s)^(1/q),

is Kiefer's criterion ([1]_, chapter 6): D for q = 0, A for q = 1, and E for infinity. Where an experiment is done n
times, m is 1/n of its value: m of the best design over m of another one is the *efficiency* of that.

Sample times and sensors are chosen from candidates, each of which adds its information, by an exchange algorithm (Cook
and Nachtsheim, [2]_): candidates are dropped one by one, that which is missed least first, until as many are left as
are allowed; then each of them is exchanged for the best that is left out, until no exchange helps.

Inputs that lower the criterion are found by L-BFGS-B between limits, with the exact gradient, from many starts. JAX
differentiates the sensitivities of all samples, forward in theta, backward in the input. The information of a
sample is ``C' C / sigma**2`` with the sensitivities C (q, D) of its q values: it does not depend on what is measured.
That of a sigma which is a parameter is ``2 / sigma**2`` for each value, apart from everything else.

References
----------
.. [1] F. Pukelsheim, Optimal Design of Experiments, SIAM, 2006.
.. [2] R. D. Cook, C. J. Nachtsheim, A comparison of algorithms for constructing exact D-optimal designs, Technometrics
   22 (1980) 315-324.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments, build_arguments, split_by_cell
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import propagate
from switchfit.discretization.sampled_states import see_samples
from switchfit.engine.choice import engine_of
from switchfit.engine.corners.branches import has_corners
from switchfit.fit.evaluator import Evaluator, find_free_directions, place_on_guards
from switchfit.fit.result import inverse_on
from switchfit.fit.trajectory import Trajectory, compare, simulate
from switchfit.optimize.threads import one_thread
from switchfit.problem.experiment import Experiment
from switchfit.problem.functions import use_float64
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.structure import Structure
from switchfit.problem.validation import arrays, objects
from switchfit.problem.validation import names as names_module
from switchfit.problem.validation.arrays import as_count, as_positive
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_names
from switchfit.runtime.cache import use_compilation_cache
from switchfit.runtime.json_documents import write_document
from switchfit.runtime.json_records import to_json
from switchfit.runtime.presentation import Figure, Printed, draw_figure, format_line, join_first

POWERS = {"D": 0.0, "A": 1.0, "E": 1e3}
"""Powers q of the criteria; that of E stands for infinity, from which log m differs by less than 0.001 log s."""

SMOOTH = 20.0
"""Largest power while inputs are optimised: m has a kink where the largest eigenvalue changes places with the next."""

RIDGE = 1e-12
"""Added to the information, scaled to about 1 for each unknown, so that a singular one has a finite criterion."""

SIDES = (1, -1)
"""Sensitivities jump where a transition time is at a sample or a knot of an input: the information is the mean of both
sides, since the true time may be on either."""

GAIN = 1e-9
"""An exchange must lower log m by more: equal candidates would be exchanged for ever."""

UNUSABLE = 1e3
"""log m of a design whose trajectory cannot be integrated."""

ROUNDS = 6
"""Most turns of inputs, mesh and samples."""

ENOUGH = 1e-4
"""The turns end where log m falls by less."""

MOST_SENSORS = 12
"""Sensors of which all sets are looked at."""


class Criterion(NamedTuple):
    """What of the covariance counts.

    Attributes
    ----------
    chosen : (s,) int, positions in theta of the unknowns that count
    scales : (s,), by which these are divided
    basis : (d, r), Z
    size : (r,), typical standard errors of the unknowns that guards leave free
    """

    chosen: NDArray[np.intp]
    scales: FloatArray
    basis: FloatArray
    size: FloatArray

    def rate(self, information: Any, power: float, xp: Any = np) -> tuple[Any, Any]:
        """Return log m (...,), and its derivative in the information (..., d, d).

        Parameters
        ----------
        information : (..., d, d) array
        power : float
            q.
        xp : module, optional
            NumPy or `jax.numpy`.
        """
        basis = self.basis * self.size[None, :]
        across = basis[self.chosen] / self.scales[:, None]
        half = across @ xp.linalg.inv(basis.T @ information @ basis + RIDGE * xp.eye(len(self.size)))
        values, vectors = xp.linalg.eigh(half @ across.T)
        logs = xp.log(xp.maximum(values, 1e-300))
        parts = xp.exp(power * (logs - logs[..., -1:]))
        mean = xp.log(parts.mean(-1)) / power + logs[..., -1] if power else logs.mean(-1)
        weights = parts / parts.sum(-1, keepdims=True) / xp.exp(logs)
        root = xp.sqrt(weights)[..., None] * (xp.swapaxes(vectors, -1, -2) @ half @ basis.T)
        return mean, -xp.swapaxes(root, -1, -2) @ root

    def measure(self, kind: str, covariance: FloatArray) -> float:
        """Return the criterion as textbooks have it: log det C (D), its trace (A) or its largest eigenvalue (E).

        Infinite where an unknown that counts cannot be estimated: its covariance is NaN.

        Parameters
        ----------
        kind : {"D", "A", "E"}
        covariance : (d, d) array
            Of all unknowns.
        """
        C = covariance[np.ix_(self.chosen, self.chosen)] / np.outer(self.scales, self.scales)
        if not np.isfinite(C).all():
            return np.inf
        values = np.linalg.eigvalsh(C)
        return float({"D": np.log(values).sum, "A": values.sum, "E": values.max}[kind]())


class Candidates(NamedTuple):
    """Samples that may be taken: the sensor of each (n,), its information (n, d, d), and that of all else (d, d)."""

    sensor: NDArray[np.intp]
    information: FloatArray
    others: FloatArray

    def add(self, taken: NDArray[np.bool_]) -> FloatArray:
        """Return the information with the candidates that are taken (n,)."""
        return self.others + self.information[taken].sum(0)


def choose_samples(
    candidates: Candidates, most: NDArray[np.intp], rate: Callable[[FloatArray], FloatArray]
) -> tuple[float, NDArray[np.bool_]]:
    """Return the lowest log m within a limit that no exchange of one sample improves, and the samples taken for it
    (n,).

    Parameters
    ----------
    candidates : Candidates
    most : (S,) int array
        Most samples of each sensor.
    rate : callable
        log m (...,) for information (..., d, d).
    """
    sensor, each = candidates.sensor, candidates.information
    taken = most[sensor] > 0
    while (over := np.flatnonzero(taken & (np.bincount(sensor, taken, len(most)) > most)[sensor])).size:
        taken[over[np.argmin(rate(candidates.add(taken) - each[over]))]] = False
    value, improved = float(rate(candidates.add(taken))), True
    while improved:
        improved = False
        for out in np.flatnonzero(taken):
            spare = np.flatnonzero(~taken & (sensor == sensor[out]))
            values = rate(candidates.add(taken) - each[out] + each[spare])
            if values.min(initial=np.inf) < value - GAIN:
                taken[out], taken[spare[np.argmin(values)]] = False, True
                value, improved = float(values.min()), True
    return value, taken


class Nominal:
    """A problem at theta, with guarded transition times on their guards; run e is that which is designed.

    Attributes
    ----------
    theta : (d,)
    basis : (d, r), of the changes of theta that guards allow
    information, covariance : (d, d), with everything that the problem has; NaN for what cannot be estimated
    """

    def __init__(self, problem: Problem, e: int, theta: FloatArray) -> None:
        self.problem, self.e, self.theta, self.evaluator = problem, e, theta, Evaluator(problem, theta)
        self.basis = np.eye(len(theta))
        if problem.constraint_names:
            self.evaluator, self.theta = place_on_guards(problem, theta)
            self.basis = find_free_directions(problem, self.evaluator.constrained(self.theta).jacobian)
        each_side = (self.evaluator(self.theta, side, matrix="gauss-newton").hessian for side in SIDES)
        self.information = 0.5 * sum(each_side, np.zeros((len(theta),) * 2))
        self.covariance = inverse_on(self.basis, self.information)

    @cached_property
    def candidates(self) -> Candidates:
        """The information of each sample of run e, all others being left out."""
        problem, e, found = self.problem, self.e, []
        arguments, (own, mine) = self.evaluator.arguments[e], problem.own_places[e]
        counts = [len(item.times) for item in problem.experiments[e].data]
        for s, count in enumerate(counts):
            for k in range(count):
                weights: list[Any] = [np.zeros_like(each.weight) for each in arguments.samples]
                weights[s][k] = arguments.samples[s].weight[k]
                pairs = zip(arguments.samples, weights, strict=True)
                only = arguments._replace(samples=tuple(each._replace(weight=weight) for each, weight in pairs))
                engine = engine_of(self.evaluator.runs[e], only, self.evaluator.meshes[e])
                found.append(np.zeros_like(self.information))
                for side in SIDES:
                    H = engine.derivatives(*problem.vectors(self.theta, e), side, "gauss-newton").hessian
                    np.add.at(found[-1], (mine[:, None], mine), 0.5 * H[own[:, None], own])
        return Candidates(np.repeat(np.arange(len(counts)), counts), np.array(found), self.information - sum(found))


def simulate_values(problem: Problem, e: int, theta: FloatArray, taken: list[NDArray[np.bool_]]) -> Problem:
    """Return the problem with values simulated at theta in run e, of those samples of each sensor that are taken.

    Parameters
    ----------
    problem : Problem
        Whose data are `Measurements`; missing values stay missing.
    e : int
    theta : (d,) array
    taken : list of (K,) bool
        Sensors without any are left out.
    """
    run, data = problem.experiments[e], []
    comparisons = compare(Evaluator(problem, theta), theta)[1][e]
    for item, comparison, kept in zip(run.data, comparisons, taken, strict=True):
        if kept.any():
            sigma = item.sigma[kept] if getattr(item.sigma, "ndim", 0) == 2 else item.sigma
            values = np.where(np.isnan(item.values), np.nan, comparison.fitted)[kept]
            data.append(replace(item, times=item.times[kept], values=values, sigma=sigma))
    runs = list(problem.experiments)
    runs[e] = replace(run, data=data)
    return replace(problem, experiments=runs)


class Background(NamedTuple):
    """What does not change while an input is looked for; D unknowns of the run, d of the problem.

    Attributes
    ----------
    arguments : Arguments
        On the mesh of the run.
    cells : (G, 4, K)
        The signal of each knot whose value is 1, as cubics in the cells of the mesh.
    theta : (D,), transition times and p of the run
    taken : tuple of (K,), 1 for samples that are taken and 0 for others, one for each sensor
    others : (d, d), information of priors and other runs
    places : (d, D) of 0 and 1, which unknown of the problem is which of the run
    criterion : Criterion
    """

    arguments: Arguments
    cells: Any
    theta: Any
    taken: tuple[Any, ...]
    others: Any
    places: Any
    criterion: Criterion


@partial(jax.jit, static_argnames=("structure", "power"))
def differentiate_criterion(
    inputs: Array, at: Background, *, structure: Structure, power: float
) -> tuple[Array, Array]:
    """Return log m, as of `Criterion.rate`, and its derivatives in an input at its knots, (K, q)."""

    def rate(inputs: Array) -> Array:
        model = Model(structure, at.arguments._replace(signals=jnp.einsum("gck,kq->gcq", at.cells, inputs)))

        def inform(side: Array) -> Array:
            slopes, weights = jax.jacfwd(partial(_see, model, side), has_aux=True)(at.theta)
            own = jnp.zeros((at.theta.size, at.theta.size))
            for taken, (C, L), w in zip(at.taken, slopes, weights, strict=True):
                own += jnp.einsum("k,kqd,kq,kqe->de", taken, C, w, C) + 2.0 * jnp.einsum("k,kqd,kqe->de", taken, L, L)
            return own

        own = jax.lax.map(inform, jnp.array(SIDES, dtype=float)).mean(0)
        return at.criterion.rate(at.others + at.places @ own @ at.places.T, power, jnp)[0]

    return jax.value_and_grad(rate)(inputs)


def _see(model: Model, side: Array, theta: Array) -> tuple[list[tuple[Array, Array]], list[Array]]:
    """Return the values of all samples of each sensor and log sigma, (K, q) each; and the weights ``1 / sigma**2``."""
    p = theta[model.structure.N :]
    path = propagate(model, theta[: model.structure.N], p, side)
    found, weights = [], []
    for k, sensor in enumerate(model.structure.measurements):
        samples, states = see_samples(model, path, k, p)
        values = jax.vmap(partial(model.sample_residual, k), in_axes=(0, 0, None))(samples, states, p)
        logs = jnp.zeros_like(values)
        if sensor.sigma:
            logs = jax.vmap(partial(model.log_sigma, k), in_axes=(0, None))(samples, p)
        found.append((values, logs))
        weights.append(samples.weight * jnp.exp(-2.0 * logs))
    return found, weights


def name_inputs(run: Experiment) -> tuple[str, ...]:
    """Return what the entries of the input of a run are called: by their names, or u, or u[0], u[1], ...

    Parameters
    ----------
    run : Experiment
    """
    if run.inputs is None or run.inputs.names:
        return () if run.inputs is None else run.inputs.names
    return tuple(f"u[{k}]" for k in range(run.inputs.shape[0])) if run.inputs.shape else ("u",)


def stack_inputs(run: Experiment) -> FloatArray:
    """Return the values of the input of a run at its knots, (K, q); (0, 0) without one.

    Parameters
    ----------
    run : Experiment
    """
    if run.inputs is None:
        return np.zeros((0, 0))
    values, names = run.inputs.values, run.inputs.names
    return np.stack([values[name] for name in names], 1) if names else values.reshape(len(values), -1)


def replace_inputs(problem: Problem, e: int, table: FloatArray) -> Problem:
    """Return the problem with other values (K, q) of the input of run e.

    Parameters
    ----------
    problem : Problem
    e : int
    table : (K, q) array
    """
    runs, inputs = list(problem.experiments), problem.experiments[e].inputs
    values = dict(zip(inputs.names, table.T, strict=True)) if inputs.names else table.reshape(inputs.values.shape)
    runs[e] = replace(runs[e], inputs=replace(inputs, values=values))
    return replace(problem, experiments=runs)


def read_limits(run: Experiment, free: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Return lower and upper limits of the input of a run at its knots, (K, q) each; equal where it is not free.

    Parameters
    ----------
    run : Experiment
    free : mapping of str to (lower, upper)
    """
    if not isinstance(free, Mapping):
        raise TypeError(f"free must be a dict of inputs and their limits; got {shorten(free)}.")
    names, ends = name_inputs(run), np.stack([stack_inputs(run)] * 2)
    for name, limits in free.items():
        columns = [k for k, each in enumerate(names) if each == name or (name == "u" and each.startswith("u["))]
        if not columns:
            raise ValueError(f"free must name inputs of the run: {join_names(names)}; got {shorten(name)}.")
        try:
            pair = np.stack([np.broadcast_to(arrays.as_array(limit, name), len(ends[0])) for limit in limits])
        except (TypeError, ValueError):
            pair = np.full((2, 1), np.nan)
        if pair.shape[0] != 2 or not np.isfinite(pair).all() or np.any(pair[0] > pair[1]):
            raise ValueError(
                f"free must have (lower, upper) for {name}, lower <= upper, finite numbers or one for each of the "
                f"{len(ends[0])} knots; got {shorten(limits)}."
            )
        ends[:, :, columns] = pair[:, :, None]
    return ends[0], ends[1]


def improve_input(
    here: Nominal,
    criterion: Criterion,
    power: float,
    taken: Sequence[NDArray[np.bool_]],
    limits: tuple[FloatArray, FloatArray],
    starts: Sequence[FloatArray],
) -> FloatArray:
    """Return the best values of the input at its knots, (K, q).

    Parameters
    ----------
    here : Nominal
        On whose mesh.
    criterion : Criterion
    power : float
    taken : sequence of (K,) bool, one for each sensor
        Samples that are taken.
    limits : lower and upper, (K, q)
    starts : sequence of (K, q) arrays
    """
    from scipy.optimize import minimize  # here, since importing it takes longer than most fits

    lower, width = limits[0], limits[1] - limits[0]
    free, background, structure = width > 0, _describe(here, criterion, taken), here.evaluator.structures[here.e]

    def place(x: FloatArray) -> FloatArray:
        table = lower.copy()
        table[free] += x * width[free]
        return table

    def rate(x: FloatArray) -> tuple[float, FloatArray]:
        value, slope = differentiate_criterion(place(x), background, structure=structure, power=power)
        slope = np.asarray(slope * width)[free]
        return (float(value), slope) if np.isfinite([value, *slope]).all() else (UNUSABLE, np.zeros_like(slope))

    found = []
    with use_float64(), use_compilation_cache():
        for start in starts:
            x = np.clip((start - lower)[free] / width[free], 0.0, 1.0)
            found.append(minimize(rate, x, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * len(x)))
    return place(min(found, key=lambda end: end.fun).x)


def _describe(here: Nominal, criterion: Criterion, taken: Sequence[NDArray[np.bool_]]) -> Background:
    """Return what does not change."""
    problem, e, mesh = here.problem, here.e, here.evaluator.meshes[here.e]
    run, mesh = problem.experiments[e], mesh.pad_to(1 << mesh.cells.bit_length())  # few lengths: few programs
    knots = replace(run.inputs, values=np.eye(len(run.inputs.times)), units=None)
    (own, mine), (tau, p) = problem.own_places[e], problem.vectors(here.theta, e)
    places = np.zeros((len(here.theta), len(problem.places[e])))
    places[mine, own] = 1.0
    lengths = zip(taken, problem.sample_lengths[e], strict=True)
    return Background(
        arguments=build_arguments(problem, e, mesh),
        cells=split_by_cell(knots.signal(run.t0, run.end), mesh),
        theta=np.append(tau, p),
        taken=tuple(np.pad(each.astype(float), (0, length - len(each))) for each, length in lengths),
        others=here.candidates.others,
        places=places,
        criterion=criterion,
    )


@dataclass(frozen=True, eq=False)
class DesignRecord:
    """What of a design is saved; see `Design`."""

    run: str
    theta_names: tuple[str, ...]
    theta: FloatArray
    names: tuple[str, ...]
    criterion: str
    criterion_before: float
    criterion_after: float
    covariance_before: FloatArray
    covariance: FloatArray
    inputs: dict[str, FloatArray]
    sample_times: dict[str, FloatArray]
    shares: dict[str, FloatArray]
    seconds: float


@dataclass(frozen=True, eq=False)
class Design(DesignRecord, Printed):
    """Result of `design`: an experiment, and how well it will determine the unknowns. Print it for the tables.

    Attributes
    ----------
    run : str
        The run that was designed.
    theta_names : tuple of str, d unknowns of the problem
    theta : (d,)
        At which the information is computed.
    names : tuple of str
        The unknowns that count.
    criterion : {"D", "A", "E"}
    criterion_before, criterion_after : float
        Of the problem as it was given, with all of its samples, and of the design: log det (D), trace (A) or largest
        eigenvalue (E) of the covariance of the unknowns that count, divided by their scales. Infinite where one of them
        cannot be estimated.
    covariance_before, covariance : (d, d)
        Of all unknowns; NaN for those that cannot be estimated.
    inputs : dict of str to (K,) array
        Values of each entry of the input at its knots; empty without an input.
    sample_times : dict of sensor to (K,) array
        Times of the samples, of the sensors that are used.
    shares : dict of sensor to (K,) array
        Share of the information of each sample of `given`. Those of the samples that are taken, of priors and of other
        runs add up to 1; the share of one that is left out says what it would bring.
    seconds : float
    problem : Problem
        With the designed run, ready to simulate and, once its simulated values are replaced by measured ones, to fit.
    given : Problem
        As it was given.
    experiment : int
        Index of the run.

    See Also
    --------
    design

    Examples
    --------
    >>> plan = sf.design(heater_problem(), samples=4)
    >>> plan.sample_times["thermometer"].shape, plan.undetermined
    ((4,), ())
    """

    problem: Problem
    given: Problem
    experiment: int

    def __repr__(self) -> str:
        change = f"{self.criterion_before:.4g} -> {self.criterion_after:.4g}"
        return format_line(self, self.run, f"{self.criterion} of {join_first(self.names)}: {change}")

    @property
    def standard_errors(self) -> FloatArray:
        """Of all unknowns, with the design: (d,); NaN for those that cannot be estimated."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def standard_errors_before(self) -> FloatArray:
        """Of all unknowns, with the problem as it was given: (d,)."""
        return np.sqrt(np.diag(self.covariance_before))

    @property
    def undetermined(self) -> tuple[str, ...]:
        """The unknowns that the design cannot determine, whatever will be measured."""
        return tuple(np.array(self.theta_names)[np.isnan(self.standard_errors)].tolist())

    @property
    def doubtful(self) -> tuple[str, ...]:
        """The unknowns whose standard error is larger than their distance to a bound or to the next transition: the
        errors of a fit will not be those of a linear model.
        """
        u, errors = self.problem.unknowns, np.nan_to_num(self.standard_errors)
        beyond = (self.theta - errors < u.lower) | (self.theta + errors > u.upper)
        beyond |= np.any(np.abs(u.A) * errors > (u.A @ self.theta - u.b)[:, None], axis=0)
        return tuple(np.array(self.theta_names)[beyond].tolist())

    @cached_property
    def trajectory(self) -> Trajectory:
        """The designed run at `theta`."""
        return simulate(self.problem, self.theta, experiment=self.experiment)

    def plot(self) -> Figure:
        """Draw the input as it was given and as designed, the states, and the share of the information of each sample.

        See Also
        --------
        design

        Examples
        --------
        >>> figure = sf.design(heater_problem(), samples=4).plot()
        >>> [ax.get_ylabel() for ax in figure.axes]
        ['T (K)', 'share of information']
        """
        figure: Figure = draw_figure(self)
        return figure

    def save(self, path: str | Path) -> None:
        """Write everything but the problems to a JSON file, atomically.

        Parameters
        ----------
        path : path

        See Also
        --------
        design

        Examples
        --------
        >>> import json
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> plan = sf.design(heater_problem(), samples=4)
        >>> with TemporaryDirectory() as folder:
        ...     plan.save(Path(folder) / "design.json")
        ...     json.loads((Path(folder) / "design.json").read_text())["design"]["names"]
        ['tau_1', 'k']
        """
        content = {"format": "switchfit design", "version": 1, "design": to_json(self, DesignRecord)}
        write_document(content, objects.as_path(path, "path"))


@one_thread()
def design(
    problem: Problem,
    theta: ArrayLike | None = None,
    *,
    free: Mapping[str, Any] | None = None,
    names: str | Sequence[str] | Mapping[str, float] | None = None,
    criterion: Literal["D", "A", "E"] = "D",
    samples: int | Mapping[str, int] | None = None,
    sensors: int | Mapping[str, float] | None = None,
    budget: float | None = None,
    experiment: int | None = None,
    starts: int = 8,
    seed: int = 0,
) -> Design:
    """Find the experiment that will determine unknowns best: inputs, sample times, sensors.

    Parameters
    ----------
    problem : Problem
        With the planned run: its input and its samples, whose times are the candidates and whose values are not used
        (zeros will do). Sigma must be a number or a parameter. Priors count as information, and so do other runs.
    theta : (d,) array_like, optional
        Values of the unknowns for which the experiment is designed; the initial guess if left out.
    free : mapping of str to (lower, upper), optional
        Inputs whose values at the knots may be changed, and their limits: numbers, or an array with one for each knot.
        An entry of the input is called by its name; "u" if it has none, or "u[0]", "u[1]", ... for several. What is
        constant during a run, such as a dose, can be an input with one knot.
    names : str, sequence of str, or mapping of str to float, optional
        The unknowns that count, such as "mu"; all of them if left out. A mapping has the scale of each, such as the
        standard error that is wanted, by which it is divided.
    criterion : {"D", "A", "E"}, optional
        What of their covariance is made small: the determinant, that is the volume of the confidence ellipsoid; the
        trace, that is the sum of variances; the largest eigenvalue. A and E depend on units, or on the scales.
    samples : int or mapping of sensor to int, optional
        Most sample times of each sensor, chosen among those of the problem; all of them if left out.
    sensors : int or mapping of sensor to float, optional
        Most `Measurements` of the run that are used, or what each costs; all are used if left out. A sensor is called
        by the names of its channels, such as "X, Y".
    budget : float, optional
        Most that the sensors may cost together.
    experiment : int, optional
        Index of the run that is designed, from 0; the last one if left out.
    starts : int, optional
        How many inputs at random the search begins from, beside the given one.
    seed : int, optional
        Of these.

    Returns
    -------
    Design

    Raises
    ------
    ValueError
        For data that are no `Measurements` or have no sigma; limits, names and numbers that do not fit; a free input in
        a problem with guards, or with corners of the state in the run; transition times that do not meet guards.
    TypeError
        If an argument is of the wrong type.

    Notes
    -----
    The information is ``sum C' C / sigma**2``, with the sensitivities C of all samples at theta, plus the inverse
    variances of priors. Inputs are found by L-BFGS-B with the exact gradient: a local optimum, the best of all starts.
    Samples and sensors are found by an exchange algorithm, in turns with the inputs.

    See Also
    --------
    Design, identifiability, monte_carlo

    Examples
    --------
    Four measurements instead of 24, those that tell most about the cooling k and the end of heating tau_1:

    >>> plan = sf.design(heater_problem(), samples=4)
    >>> plan.sample_times["thermometer"]
    array([1.75, 2.  , 2.25, 3.75])

    >>> plan.standard_errors_before.round(3), plan.standard_errors.round(3)
    (array([0.02 , 0.008]), array([0.027, 0.014]))
    """
    began = time.perf_counter()
    objects.as_instance(problem, "problem", Problem, "an sf.Problem")
    require_estimable(problem)
    last = len(problem.experiments) - 1
    e = last if experiment is None else arrays.as_index(experiment, "experiment", last + 1)
    nominal, kind = problem.check_theta(theta), names_module.as_choice(criterion, "criterion", tuple(POWERS))
    starts, seed = as_count(starts, "starts"), arrays.as_seed(seed)
    _check_data(problem)
    run, (chosen, scales) = problem.experiments[e], _find_chosen(problem, names)
    labels = name_sensors(run)
    most = _list_limits(run, labels, samples, sensors, budget)
    lower, upper = read_limits(run, {} if free is None else free)
    if free and (problem.constraint_names or has_corners(problem.structures[e])):
        raise ValueError(
            "free cannot be used where transitions have guards, or modes have corners of the state (as jnp.sign of a "
            "state has): choose samples and sensors alone, and compare inputs by a call for each."
        )
    every = taken = [np.ones(len(item.times), dtype=bool) for item in run.data]
    before = here = Nominal(simulate_values(problem, e, nominal, every), e, nominal)
    rule, power = _build_criterion(before, chosen, scales), POWERS[kind]
    begin = [stack_inputs(run), *np.random.default_rng(seed).uniform(lower, upper, (starts, *lower.shape))]
    best, lowest = here, np.inf
    for _ in range(ROUNDS if free else 1):
        if free:
            begin = [improve_input(here, rule, min(power, SMOOTH), taken, (lower, upper), begin)]
            changed = replace_inputs(before.problem, e, begin[0])
            here = Nominal(simulate_values(changed, e, nominal, every), e, nominal)
        choices = (choose_samples(here.candidates, own, lambda F: rule.rate(F, power)[0]) for own in most)
        value, chosen_samples = min(choices, key=lambda choice: choice[0])
        gain = lowest - value
        if gain > 0:
            best, lowest = here, value
            taken = np.split(chosen_samples, np.cumsum([len(each) for each in every])[:-1])
        if gain < ENOUGH:
            break
    planned = Nominal(simulate_values(best.problem, e, best.theta, taken), e, best.theta)
    slope = rule.rate(best.candidates.add(np.concatenate(taken)), power)[1]
    shares = -np.einsum("de,kde->k", slope, best.candidates.information)
    return Design(
        run=problem.run_names[e],
        theta_names=problem.theta_names,
        theta=planned.theta,
        names=tuple(problem.theta_names[k] for k in chosen),
        criterion=kind,
        criterion_before=rule.measure(kind, before.covariance),
        criterion_after=rule.measure(kind, planned.covariance),
        covariance_before=before.covariance,
        covariance=planned.covariance,
        inputs=dict(zip(name_inputs(run), stack_inputs(planned.problem.experiments[e]).T, strict=True)),
        sample_times={
            label: item.times[own] for label, item, own in zip(labels, run.data, taken, strict=True) if own.any()
        },
        shares={label: shares[best.candidates.sensor == s] for s, label in enumerate(labels)},
        seconds=time.perf_counter() - began,
        problem=planned.problem,
        given=problem,
        experiment=e,
    )


def name_sensors(run: Experiment) -> tuple[str, ...]:
    """Return what each of the `Measurements` of a run is called: the names of its channels, or sensor 1, 2, ...

    Parameters
    ----------
    run : Experiment
    """
    names = [", ".join(item.names or ()) or f"sensor {k}" for k, item in enumerate(run.data, start=1)]
    return tuple(f"{name} ({k})" if names.count(name) > 1 else name for k, name in enumerate(names, start=1))


def _check_data(problem: Problem) -> None:
    """Raise ValueError unless all data are `Measurements` with sigma: their information does not depend on values."""
    for name, run in zip(problem.run_names, problem.experiments, strict=True):
        for item in run.data:
            if not isinstance(item, Measurements):
                raise ValueError(f"design needs Measurements, for the data of {name}; got {shorten(item)}.")
            if item.sigma is None:
                raise ValueError(f"design needs sigma, the standard deviation of the noise, for the data of {name}.")


def _find_chosen(problem: Problem, names: Any) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the positions in theta of the unknowns that count, and their scales: (s,) each."""
    known, spans = list(problem.theta_names), problem.unknowns.parameters
    given = known if names is None else [names] if isinstance(names, str) else names
    scaled = given if isinstance(given, Mapping) else dict.fromkeys(as_names(given, "names", "names of unknowns"), 1.0)
    found: dict[int, float] = {}
    for name, scale in scaled.items():
        if name not in known and name not in spans:
            raise ValueError(f"names has {shorten(name)}, which is no unknown of the problem: {join_names(known)}.")
        places = [known.index(name)] if name in known else range(len(known))[spans[name]]
        found |= dict.fromkeys(places, as_positive(scale, f"scale of {name}"))
    if not found:
        raise ValueError("names is empty: name the unknowns that count, or leave it out for all.")
    return np.array(list(found), dtype=np.intp), np.array(list(found.values()))


def _build_criterion(before: Nominal, chosen: NDArray[np.intp], scales: FloatArray) -> Criterion:
    """Return the criterion, with typical standard errors from the information of the problem as it was given."""
    diagonal = np.diag(before.basis.T @ before.information @ before.basis)
    return Criterion(chosen, scales, before.basis, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))


def _list_limits(
    run: Experiment, labels: tuple[str, ...], samples: Any, sensors: Any, budget: float | None
) -> list[NDArray[np.intp]]:
    """Return the most samples of each sensor, (S,), for each largest set of sensors that number or costs allow."""
    counts = samples if isinstance(samples, Mapping) else dict.fromkeys(labels, samples)
    costs = sensors if isinstance(sensors, Mapping) else dict.fromkeys(labels, 1.0)
    for what, given in (("samples", counts), ("sensors", costs)):
        if unknown := [name for name in given if name not in labels]:
            raise ValueError(f"{what} names {shorten(unknown[0])}; the sensors are {join_names(labels)}.")
    if (budget is None) == isinstance(sensors, Mapping):
        raise ValueError("budget and the costs of sensors belong together: give sensors={name: cost} and budget.")
    whole = np.array([len(item.times) for item in run.data])
    for s, name in enumerate(labels):
        if counts.get(name) is not None:
            whole[s] = min(whole[s], as_count(counts[name], f"samples of {name}", at_least=1))
    if sensors is None:
        return [whole]
    if len(labels) > MOST_SENSORS:
        raise ValueError(f"sensors can be chosen among {MOST_SENSORS}; there are {len(labels)}.")
    prices = np.array([as_positive(costs[name], f"cost of {name}") if name in costs else 0.0 for name in labels])
    most = as_count(sensors, "sensors", at_least=1) if budget is None else as_positive(budget, "budget")
    every = np.array(list(product((0, 1), repeat=len(labels))))
    allowed = every[every @ prices <= most]
    largest = [own for own in allowed if not any(np.all(other >= own) and np.any(other > own) for other in allowed)]
    if not np.any(largest):
        raise ValueError(f"no sensor is within the budget of {most:g}; got costs {shorten(dict(costs))}.")
    return [whole * own for own in largest]
