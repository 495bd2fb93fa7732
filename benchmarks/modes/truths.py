"""Simulated logs with known mode sequences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks import vehicle
from benchmarks.many import positions
from benchmarks.starts.case import sample_states
from switchfit.models import skid_steer


@dataclass(frozen=True, eq=False)
class Truth:
    """One log with what is known of it.

    Attributes
    ----------
    problem : sf.Problem
        What is searched: one mode and no transition as the first guess.
    sequence, times : the true modes, and when they change
    parameters : (M,)
        The true values of the parameters, in the order of theta.
    settings : dict
        Arguments of `switchfit.find_modes`.
    is_complete : bool
        Whether all modes of the truth are in the library: where not, there is nothing to be found.
    """

    problem: sf.Problem
    sequence: tuple[str, ...]
    times: np.ndarray
    parameters: np.ndarray
    settings: dict[str, Any] = field(default_factory=dict)
    is_complete: bool = True

    @property
    def samples(self) -> int:
        """Number of measured values."""
        return sum(int(np.isfinite(item.values).sum()) for item in self.problem.experiments[0].data)

    def build_problem(self, sequence: Sequence[str], times: Sequence[float]) -> sf.Problem:
        """Return the same problem with another sequence."""
        run = self.problem.experiments[0]
        again = sf.Experiment(run.data, tuple(sequence), tuple(times), run.t0, run.tf)
        return sf.Problem(self.problem.system, again, self.problem.parameters)

    def fit_from_truth(self) -> sf.Estimate:
        """Return the fit that begins at the truth."""
        start = np.concatenate([self.times, self.parameters])
        return sf.estimate(self.build_problem(self.sequence, self.times), start=start, strategy="local")


Make = Callable[[int], Truth]
"""A function that simulates the truth of a seed."""

RATE, DURATION = 10.0, 15.0
"""Positions a second, and for how long (s)."""


def drive(times: Sequence[float], sigma: float) -> Make:
    """Return simulations of the paper's vehicle, seen by GPS; the friction is a quarter off at the guess."""

    def make(seed: int) -> Truth:
        sequence = ("stick", "slip") * (len(times) // 2 + 1)
        sequence = sequence[: len(times) + 1]
        truth = np.array([*times, vehicle.MU_TRUTH])
        at = np.arange(1, round(RATE * DURATION) + 1) / RATE
        values = _build_drive(np.zeros((len(at), 2)), at, sigma, sequence, tuple(times))
        clean = sample_states(values, truth, at)[:, [0, 2]]
        noisy = clean + np.random.default_rng(seed).normal(0.0, sigma, clean.shape)
        problem = _build_drive(noisy, at, sigma, ("stick",), ())
        return Truth(problem, sequence, np.array(times), truth[-1:], {"max_switches": len(times) + 2})

    return make


def _build_drive(
    values: np.ndarray, at: np.ndarray, sigma: float, sequence: tuple[str, ...], times: tuple[float, ...]
) -> sf.Problem:
    data = sf.Measurements(at, values, observe=positions, sigma=sigma, names=("X", "Y"))
    run = sf.Experiment(data, sequence, times, 0.0, DURATION)
    return sf.Problem(skid_steer(), run, {"mu": sf.Parameter(0.8, lower=0.05, upper=2.0)})


MATRICES = np.array([[[-0.5, 2.0], [-2.0, -0.5]], [[-1.0, 0.2], [0.0, -0.4]], [[-0.3, -1.0], [1.0, -0.8]]])
OFFSETS = np.array([[0.0, 0.0], [1.0, -0.5], [-0.5, 1.0]])
"""Of the three modes ``dx/dt = a A x + b`` of `three_modes`: a spiral, a node, and a spiral about another point."""

START, LENGTH, STEP, NOISE, SHORTEST = (1.0, -1.0), 12.0, 0.1, 0.05, 0.8
"""Initial state, duration and sample interval (s), sigma, and the shortest mode (s)."""

MOST = 4
"""Modes of the largest random system."""


def _linear_mode(k: int) -> Callable[..., Any]:
    def field_of_mode(t: Any, x: Any, p: Any) -> Any:
        return p["a"] * (p["A"][k] @ x) + p["b"][k]

    return field_of_mode


LINEAR = sf.HybridSystem(
    {name: _linear_mode(k) for k, name in enumerate("ABCD")}, jnp.array(START), state_names=("x", "y")
)
"""Matrices are parameters that stay, so that all random systems run in one program."""


def three_modes(seed: int) -> Truth:
    """Six segments of three linear modes, both states seen; the factor a of all rates is 20 % off at the guess."""
    random = np.random.default_rng(seed)
    sequence = draw_sequence(random, "ABC", 6)
    times = draw_times(random, 5, SHORTEST)
    padded = np.concatenate([MATRICES, MATRICES[:1]]), np.concatenate([OFFSETS, OFFSETS[:1]])
    return _simulate_linear(random, *padded, sequence, times, "ABC", 8)


def random_modes(seed: int) -> Truth:
    """Random stable modes, two to four, up to six segments; of every fiftieth the library lacks a mode of the truth."""
    random = np.random.default_rng(10_000 + seed)
    count = int(random.integers(2, MOST + 1))
    lacking = seed % 50 == 49
    if lacking:
        count = max(count, 3)
    matrices, offsets = np.zeros((MOST, 2, 2)), np.zeros((MOST, 2))
    for k in range(MOST):
        decay, turn = random.uniform(0.2, 1.5, 2), random.uniform(-2.0, 2.0)
        matrices[k] = np.diag(-decay) + turn * np.array([[0.0, 1.0], [-1.0, 0.0]])
        offsets[k] = random.uniform(-1.5, 1.5, 2)
    names = "ABCD"[:count]
    length = int(random.integers(2, 7))
    sequence = draw_sequence(random, names, length)
    missing = sequence[length // 2]
    times = draw_times(random, length - 1, SHORTEST)
    library = "".join(name for name in names if name != missing) if lacking else names
    return _simulate_linear(random, matrices, offsets, sequence, times, library, 8)


def draw_sequence(random: np.random.Generator, names: Sequence[str], length: int) -> tuple[str, ...]:
    """Return random modes, no two neighbours the same."""
    found = [str(random.choice(list(names)))]
    while len(found) < length:
        found.append(str(random.choice([name for name in names if name != found[-1]])))
    return tuple(found)


def draw_times(random: np.random.Generator, count: int, shortest: float) -> np.ndarray:
    """Return random transition times (count,) with at least `shortest` between two of them and at both ends."""
    free = LENGTH - (count + 1) * shortest
    return np.sort(random.uniform(0.0, free, count)) + shortest * np.arange(1, count + 1)


def _simulate_linear(
    random: np.random.Generator,
    matrices: np.ndarray,
    offsets: np.ndarray,
    sequence: tuple[str, ...],
    times: np.ndarray,
    library: str,
    most: int,
) -> Truth:
    at = STEP * np.arange(round(LENGTH / STEP) + 1)
    at[-1] = LENGTH

    def build(values: np.ndarray, sequence: Sequence[str], times: Sequence[float], guess: float) -> sf.Problem:
        run = sf.Experiment(
            sf.Measurements(at, values, sigma=NOISE, names=("x", "y")), tuple(sequence), tuple(times), 0.0, LENGTH
        )
        known = {"A": sf.Parameter(matrices, fixed=True), "b": sf.Parameter(offsets, fixed=True)}
        return sf.Problem(LINEAR, run, {"a": sf.Parameter(guess, lower=0.2, upper=5.0), **known})

    truth = np.array([*times, 1.0])
    clean = sample_states(build(np.zeros((len(at), 2)), sequence, times, 1.0), truth, at)
    noisy = clean + random.normal(0.0, NOISE, clean.shape)
    problem = build(noisy, library[:1], (), 1.2)
    settings = {"library": tuple(library), "max_switches": most, "min_duration": SHORTEST / 4}
    return Truth(problem, sequence, times, truth[-1:], settings, set(sequence) <= set(library))
