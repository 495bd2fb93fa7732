"""What a problem of the study is: the problem, its starts, and which end is the right one."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.stats import qmc

import switchfit as sf
from benchmarks.models import Model
from switchfit.meshes.evaluator import Evaluator

TOLERANCE = 1e-6
"""A cost that is above the best known by no more than this part of it is the best."""

PERFECT = 1e-6
"""Part of J at the problem's guess below which the optimum is a perfect fit: excesses are then parts of that J."""

MISJUDGED = 1e-3
"""Part of J (of the same part of J at the guess where that is more) by which the J that a fit reports may be off."""

NOISE = 2.0
"""Of noisy data, ends whose J (half of chi²) is higher by this much are as good as the best."""

MET = 1e-6
"""Largest value of a guard or a terminal constraint that counts as met."""

MET_BY_BEST = 3e-7
"""The same for an end whose J may become the best known: a violated constraint can make J lower. Fits at the default
rtol meet theirs to 2e-7 where they are judged on a mesh of their own."""


@dataclass(frozen=True, eq=False)
class Collocated:
    """What `benchmarks.peers.casadi_collocation` makes a program of.

    Attributes
    ----------
    model : Model
    bounds : lower and upper bounds of the parameters, (M,) each
    reference : knots (K,) and values (K, n) of the reference signal, if there is one
    """

    model: Model
    bounds: tuple[np.ndarray, np.ndarray]
    reference: tuple[np.ndarray, np.ndarray] | None = None


@dataclass(frozen=True, eq=False)
class Sampled:
    """What `benchmarks.peers.casadi_samples` makes a program of; all else follows from the problem.

    Attributes
    ----------
    problem : of one experiment and one `Measurements`, its own parameters in the order of theta
    field : ``field(mode, x, p, u, functions) -> list``, the vector fields entry by entry
    observed : places of the observed states
    input_times, inputs : times (L,) from which inputs (L, m) are held
    resets : ``reset(x, functions) -> list`` by pair of modes
    elements : elements of the collocation between two samples
    """

    problem: sf.Problem
    field: Callable[..., list[Any]]
    observed: tuple[int, ...]
    input_times: tuple[float, ...] = ()
    inputs: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    resets: Mapping[tuple[str, str], Callable[..., list[Any]]] = field(default_factory=dict)
    elements: int = 1


@dataclass(frozen=True, eq=False)
class Case:
    """One problem with its starts.

    Attributes
    ----------
    problem : sf.Problem
    near : (d,)
        The truth, or another point from which a fit ends at the best known cost.
    starts : (S, d)
        In the order of ``problem.theta_names``.
    noisy : bool
        Whether the data are simulated at `near` with noise of known size. An end is right then if it fits no worse
        than the true values and its J is at most `NOISE` above the best: with kinks at the samples there are many
        minima about the truth, and the noise decides which is the lowest.
    collocation : Collocated, optional
        The same problem as IPOPT gets it.
    """

    problem: sf.Problem
    near: np.ndarray
    starts: np.ndarray
    noisy: bool = False
    collocation: Collocated | Sampled | None = None

    @cached_property
    def cost_near(self) -> float:
        """J at `near`."""
        return float(Evaluator(self.problem, self.near).cost(self.near))

    @cached_property
    def cost_of_guess(self) -> float:
        """J at the problem's own guess, the scale of a perfect fit."""
        return float(sf.evaluate(self.problem).cost)

    def excess(self, cost: float, best: float) -> float:
        """Return how far a cost is above the best known, as a part of it (of J at the guess for a perfect fit)."""
        scale = abs(best) if abs(best) > PERFECT * abs(self.cost_of_guess) else abs(self.cost_of_guess)
        return (cost - best) / scale

    def is_misjudged(self, said: float, cost: float) -> bool:
        """Return whether the J that a fit reports is not the J of where it ended."""
        return not abs(said - cost) <= MISJUDGED * max(abs(cost), MISJUDGED * abs(self.cost_of_guess))

    def is_best(self, cost: float, best: float, violation: float = 0.0) -> bool:
        """Return whether a cost is the best known, with all constraints met."""
        return bool(violation <= MET and self.excess(cost, best) <= TOLERANCE)

    def is_right(self, cost: float, best: float, violation: float = 0.0) -> bool:
        """Return whether an end is right: the best known cost, or, of noisy data, in the basin of the truth."""
        if self.is_best(cost, best, violation):
            return True
        return bool(self.noisy and violation <= MET and cost <= min(self.cost_near, best + NOISE))

    @cached_property
    def identity(self) -> str:
        """A digest of the problem that stays the same from version to version: `near`, and J at the guess."""
        return hashlib.sha256(self.near.tobytes() + f"{self.cost_of_guess:.6g}".encode()).hexdigest()[:12]

    def digest(self, start: int) -> str:
        """Return a digest of the problem and one start: an outcome on file belongs to them if its digest is this."""
        own = np.ascontiguousarray(self.starts[start]).tobytes()
        return hashlib.sha256(self.identity.encode() + own).hexdigest()[:12]


def bound_around(truth: dict[str, float]) -> dict[str, sf.Parameter]:
    """Return parameters that may be ten times as small or as large as the truth, and begin at twice of it."""
    return {name: sf.Parameter(2 * value, lower=value / 10, upper=10 * value) for name, value in truth.items()}


def draw_anywhere(problem: sf.Problem, count: int, seed: int) -> np.ndarray:
    """Return starts (count, d) from a Sobol sequence over all bounds, the times of each run in order."""
    unknowns = problem.unknowns
    cube = qmc.Sobol(len(unknowns.names), rng=seed).random(1 << max(count - 1, 0).bit_length())[:count]
    low, high = np.where(unknowns.is_time, 0.0, unknowns.lower), np.where(unknowns.is_time, 1.0, unknowns.upper)
    points = low + cube * (high - low)
    for run, where in zip(problem.experiments, unknowns.times, strict=True):
        points[:, where] = run.t0 + (run.end - run.t0) * np.sort(points[:, where], axis=1)
    return points


def draw_around(centre: np.ndarray, spread: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Return starts (count, d), uniform within `spread` of a centre."""
    return centre + np.random.default_rng(seed).uniform(-1.0, 1.0, (count, len(centre))) * spread


def sample_states(problem: sf.Problem, theta: np.ndarray, times: np.ndarray, experiment: int = 0) -> np.ndarray:
    """Return the states at sample times (K, n), before the transition where a sample is at one."""
    path = sf.simulate(problem, theta, experiment=experiment)
    at = np.searchsorted(path.times, times)
    if not np.array_equal(path.times[at], times):
        raise ValueError("sample times must be nodes of the problem's mesh: give it Measurements at these times.")
    return path.states[at]


Make = Callable[[int], Case]
"""A function that builds a case with so many starts."""
