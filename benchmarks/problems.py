"""The problems of the comparison with other libraries, as switchfit takes them.

`case(name)` gives a model of `models.py` with its `sf.Problem`; `tosses()` is the joint fit of ten measured tosses.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks import models
from benchmarks.models import Model
from switchfit.models import skid_steer

DATA = Path(__file__).parent / "data"


@dataclass(frozen=True, eq=False)
class Case:
    """A model, its system and cost as switchfit takes them."""

    model: Model
    system: sf.HybridSystem
    cost: sf.RunningCost
    parameters: dict[str, Any]

    def problem(self, theta: np.ndarray | None = None, **settings: Any) -> sf.Problem:
        """The problem from the model's guess, or from another theta."""
        model = self.model
        theta = model.theta if theta is None else theta
        N = len(model.times)
        run = sf.Experiment(self.cost, model.sequence, tuple(theta[:N]), *model.horizon)
        settings = {"solver": "stiff" if model.stiff else "explicit"} | settings
        return sf.Problem(self.system, run, self._at(theta[N:]), **settings)

    def pack(self, p: Any) -> dict[str, Any]:
        """The parameters by name from one vector (M,)."""
        found, used = {}, 0
        for name, given in self.parameters.items():
            found[name] = p[used : used + given.value.size].reshape(given.shape)
            used += given.value.size
        return found

    def _at(self, p: np.ndarray) -> dict[str, sf.Parameter]:
        given = self.parameters
        return {name: sf.Parameter(value, given[name].lower, given[name].upper) for name, value in self.pack(p).items()}


def case(name: str) -> Case:
    """One of `models.MODELS`."""
    special = {"vehicle": _vehicle, "fishing": _fishing, "chain": _chain}
    return special[name]() if name in special else _written(models.MODELS[name])


def _vehicle() -> Case:
    cost = sf.RunningCost(lambda t, x, p: 0.5 * (x @ x))
    return Case(models.VEHICLE, skid_steer(), cost, {"mu": sf.Parameter(0.8, lower=0.05, upper=2.0)})


def _fishing() -> Case:
    def mode(u: float) -> Callable[..., Any]:
        def f(t: Any, x: Any, p: Any) -> Any:
            return jnp.stack([x[0] - x[0] * x[1] - 0.4 * u * x[0], x[0] * x[1] - x[1] - 0.2 * u * x[1]])

        return f

    system = sf.HybridSystem({"idle": mode(0.0), "fishing": mode(1.0)}, models.FISHING.x0)
    cost = sf.RunningCost(lambda t, x, p: (x[0] - 1.0) ** 2 + (x[1] - 1.0) ** 2)
    return Case(models.FISHING, system, cost, {})


def _chain() -> Case:
    m = models.MASSES

    def mode(push: float) -> Callable[..., Any]:
        end = np.append(np.zeros(m - 1), push)

        def f(t: Any, x: Any, p: Any) -> Any:
            q, v = x[:m], x[m:]
            pull = p["k"] * (jnp.append(0.0, q[:-1]) - q)
            return jnp.concatenate([v, pull - jnp.append(pull[1:], 0.0) - 0.1 * v + end])

        return f

    system = sf.HybridSystem({"pushed": mode(1.0), "free": mode(0.0)}, models.CHAIN.x0)
    cost = sf.RunningCost(lambda t, x, p: 0.5 * (x @ x))
    return Case(models.CHAIN, system, cost, {"k": sf.Parameter(models.CHAIN.p)})


def _written(model: Model) -> Case:
    """A model of `models.py` as it is written there; its parameters are one vector."""

    def field(mode: str) -> Callable[..., Any]:
        def f(t: Any, x: Any, p: Any) -> Any:
            return jnp.stack(model.field(mode, x, p["p"], jnp))

        return f

    cost = sf.RunningCost(lambda t, x, p: model.density(x))
    system = sf.HybridSystem({mode: field(mode) for mode in model.modes}, model.x0)
    return Case(model, system, cost, {"p": sf.Parameter(model.p)})


# --- ten measured tosses, one friction coefficient --------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Toss:
    """Samples of one toss from the moment the cube lies flat: times from 0 (K,), positions (K, 2)."""

    times: np.ndarray
    positions: np.ndarray

    @property
    def start(self) -> np.ndarray:
        """Guess of (x, y, vx, vy) at time 0: the first sample, and the velocity over the first tenth of a second."""
        k = int(np.searchsorted(self.times, 0.1))
        velocity = (self.positions[k] - self.positions[0]) / self.times[k]
        return np.concatenate([self.positions[0], velocity])


def read_tosses() -> list[Toss]:
    """The samples in ``data/tosses.csv``."""
    with (DATA / "tosses.csv").open(newline="", encoding="utf-8") as file:
        table = np.array([[float(entry) for entry in row] for row in list(csv.reader(file))[1:]])
    found = []
    for number in np.unique(table[:, 0]):
        rows = table[table[:, 0] == number]
        found.append(Toss(rows[:, 1] - rows[0, 1], rows[:, 2:]))
    return found


GRAVITY = 9.81
MU, MU_BOUNDS = 0.3, (0.01, 2.0)
STICKS_AT, STICKS_AFTER = 0.7, 0.02
"""Guess of when a cube sticks, as a part of its samples' length, and the earliest moment (s)."""


def tosses_theta(tosses: list[Toss]) -> np.ndarray:
    """First guess: ten times of sticking, mu, then (x, y, vx, vy) of each toss."""
    times = [STICKS_AT * toss.times[-1] for toss in tosses]
    return np.concatenate([times, [MU], *[toss.start for toss in tosses]])


def tosses(theta: np.ndarray | None = None) -> sf.Problem:
    """Joint fit: one mu, ten times of sticking, ten initial states; 51 unknowns."""
    measured = read_tosses()
    theta = tosses_theta(measured) if theta is None else theta
    K = len(measured)
    experiments = [
        sf.Experiment(
            sf.Measurements(toss.times, toss.positions, observe=_position),
            ("slide", "stick"),
            (sf.Parameter(theta[e], lower=STICKS_AFTER, upper=toss.times[-1] - 1e-3),),
            0.0,
            float(toss.times[-1]),
            initial_state=STARTS[e],
            name=f"toss{e}",
        )
        for e, toss in enumerate(measured)
    ]
    parameters = {
        "mu": sf.Parameter(theta[K], lower=MU_BOUNDS[0], upper=MU_BOUNDS[1]),
        "starts": sf.Parameter(theta[K + 1 :].reshape(K, 4)),
    }
    return sf.Problem(BLOCK, experiments, parameters)


def _slide(t: Any, x: Any, p: Any) -> Any:
    return jnp.concatenate([x[2:4], -GRAVITY * p["mu"] * x[4:], jnp.zeros(2)])


def _start(p: Any, e: int) -> Any:
    start = p["starts"][e]
    return jnp.concatenate([start, start[2:] / jnp.sqrt(start[2] ** 2 + start[3] ** 2)])


STARTS = [partial(_start, e=e) for e in range(10)]
"""Made once: a function that switchfit has not seen before is compiled again."""

BLOCK = sf.HybridSystem({"slide": _slide, "stick": lambda t, x, p: jnp.zeros_like(x)}, np.zeros(6))
"""`switchfit.models.sliding_block` for several starts: the direction of the first velocity is part of the state."""


def _position(t: Any, x: Any, p: Any) -> Any:
    return x[:2]
