"""Criteria of optimal design: how large the covariance of some unknowns will be, as one number.

With the information F (d, d) and a basis Z (d, r) of the changes of theta that guards allow, the covariance of all
unknowns is ``V = Z (Z' F Z)^-1 Z'``, and C (s, s) that of the s unknowns that count, each divided by its scale. With
the eigenvalues v_1, ..., v_s of C, the mean variance of power q,

    m(F) = ((v_1^q + ... + v_s^q) / s)^(1/q),

is Kiefer's criterion ([1]_, chapter 6): D for q = 0, A for q = 1, and E for infinity. Where an experiment is done n
times, m is 1/n of its value: m of the best design over m of another one is the *efficiency* of that.

Choose sample times and sensors from candidates, each of which adds its information.

An exchange algorithm (Cook and Nachtsheim, [2]_): candidates are dropped one by one, that which is missed least first,
until as many are left as are allowed; then each of them is exchanged for the best that is left out, until no exchange
helps.

The information of a planned run at the values of the unknowns for which it is designed.

The derivative of a criterion in the input of a run.

JAX differentiates the sensitivities of all samples, forward in theta, backward in the input. The information of a
sample is ``C' C / sigma**2`` with the sensitivities C (q, D) of its q values: it does not depend on what is measured.
That of a sigma which is a parameter is ``2 / sigma**2`` for each value, apart from everything else.

Inputs that lower a criterion: L-BFGS-B between limits, with the exact gradient, from many starts.

References
----------
.. [1] F. Pukelsheim, Optimal Design of Experiments, SIAM, 2006.
.. [2] R. D. Cook, C. J. Nachtsheim, A comparison of algorithms for constructing exact D-optimal designs, Technometrics
   22 (1980) 315-324.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Arguments, build_arguments, split_by_cell
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import propagate, see_samples
from switchfit.engine.choice import engine_of
from switchfit.fit.evaluator import Evaluator, find_guarded_places, on_guards
from switchfit.fit.result import inverse_on
from switchfit.fit.trajectory import compare
from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import Experiment
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.problem.validation import as_array, join_names, shorten
from switchfit.runtime.cache import use_compilation_cache

POWERS = {"D": 0.0, "A": 1.0, "E": 1e3}
"""Powers q of the criteria; that of E stands for infinity, from which log m differs by less than 0.001 log s."""

SMOOTH = 20.0
"""Largest power while inputs are optimised: m has a kink where the largest eigenvalue changes places with the next."""

RIDGE = 1e-12
"""Added to the information, scaled to about 1 for each unknown, so that a singular one has a finite criterion."""

SIDES = (1, -1)
"""Sensitivities jump where a transition time is at a sample or a knot of an input: the information is the mean of both
sides, since the true time may be on either."""


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


GAIN = 1e-9
"""An exchange must lower log m by more: equal candidates would be exchanged for ever."""


class Candidates(NamedTuple):
    """Samples that may be taken: the sensor of each (n,), its information (n, d, d), and that of all else (d, d)."""

    sensor: NDArray[np.intp]
    information: FloatArray
    others: FloatArray

    def add(self, taken: NDArray[np.bool_]) -> FloatArray:
        """Return the information with the candidates that are taken (n,)."""
        return self.others + self.information[taken].sum(0)


def choose_samples(
    candidates: Candidates, limits: Sequence[NDArray[np.intp]], rate: Callable[[FloatArray], FloatArray]
) -> tuple[float, NDArray[np.bool_]]:
    """Return the lowest log m within any of several limits, and the candidates that are taken for it (n,).

    Parameters
    ----------
    candidates : Candidates
    limits : sequence of (S,) int arrays
        Most samples of each sensor.
    rate : callable
        log m (...,) for information (..., d, d).
    """
    return min((_exchange(candidates, most, rate) for most in limits), key=lambda choice: choice[0])


def _exchange(
    candidates: Candidates, most: NDArray[np.intp], rate: Callable[[FloatArray], FloatArray]
) -> tuple[float, NDArray[np.bool_]]:
    """Return a choice within one limit that no exchange of one sample improves."""
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
            self.evaluator = Evaluator(problem, on_guards(self.evaluator, theta))
            self.theta = on_guards(self.evaluator, theta)
            slopes, guarded = self.evaluator.constrained(self.theta).jacobian, find_guarded_places(problem)
            free = np.setdiff1d(np.arange(len(theta)), guarded)
            self.basis = self.basis[:, free]
            self.basis[guarded] = -np.linalg.solve(slopes[:, guarded], slopes[:, free])
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
    comparisons = compare(problem, theta, Evaluator(problem, theta).simulate(theta))[1][e]
    for item, comparison, kept in zip(run.data, comparisons, taken, strict=True):
        if kept.any():
            sigma = item.sigma[kept] if getattr(item.sigma, "ndim", 0) == 2 else item.sigma
            values = np.where(np.isnan(item.values), np.nan, comparison.fitted)[kept]
            data.append(replace(item, times=item.times[kept], values=values, sigma=sigma))
    runs = list(problem.experiments)
    runs[e] = replace(run, data=data)
    return replace(problem, experiments=runs)


Array = jax.Array


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


UNUSABLE = 1e3
"""log m of a design whose trajectory cannot be integrated."""


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
    values = run.inputs.values
    return (
        np.stack([values[name] for name in run.inputs.names], 1)
        if run.inputs.names
        else values.reshape(len(values), -1)
    )


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
            pair = np.stack([np.broadcast_to(as_array(limit, name), len(ends[0])) for limit in limits])
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
