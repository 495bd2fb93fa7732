"""What a problem is: the model as a user of switchfit writes it, its twin for SciPy, the truth, data and starts."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import switchfit as sf
from benchmarks.sharp.corners import find_sides, integrate

SPREAD = 0.3
"""Part of each unknown, the transition times included, by which a start may be off."""

RELATIVE, ABSOLUTE = 1e-3, 0.1
"""J (half of chi²) of a right end is above the best by no more than this part of it and this much."""

JUDGING = 60.0
"""Seconds after which an end is given up, as none that can be integrated accurately."""

Parameters = Sequence[float]
Span = tuple[float, float]
States = tuple[np.ndarray, np.ndarray]
"""Those at the samples, (K, n), and at the end, (n,)."""

Twin = Callable[[str, float, Any, Parameters, Sequence[int]], Sequence[float]]


@dataclass(frozen=True, eq=False)
class Case:
    """One problem.

    Attributes
    ----------
    modes : the vector fields in jax.numpy
    twin : ``twin(mode, t, x, p, s) -> list`` in plain Python; s has the sides (±1) of all corners
    sequence, tau, parameters : modes, and the true times and values
    x0 : initial state
    times : of the samples; the last one is tf
    observed : places of the measured states
    sigma : of their noise
    corners : ``corners(x, p) -> list``, affine in x: the twin is smooth between their zeros
    smooth : the twin that SciPy's fit gets where that serves it better
    """

    modes: dict[str, Callable[..., Any]]
    twin: Twin
    sequence: tuple[str, ...]
    tau: tuple[float, ...]
    parameters: dict[str, float]
    x0: tuple[float, ...]
    times: np.ndarray
    observed: tuple[int, ...] = (0,)
    sigma: float = 1e-3
    corners: Callable[[Any, Parameters], Sequence[float]] = field(default=lambda x, p: ())
    smooth: Twin | None = None

    @property
    def truth(self) -> np.ndarray:
        """The true theta: times, then parameters."""
        return np.array([*self.tau, *self.parameters.values()])

    @cached_property
    def values(self) -> np.ndarray:
        """The samples, (K, q)."""
        exact = self.simulate(self.truth, rtol=1e-12, atol=1e-14)
        return exact + self.sigma * np.random.default_rng(1).standard_normal(exact.shape)

    def draw_starts(self, count: int) -> np.ndarray:
        """Return starts (count, d), the times in order and within the log."""
        factors = np.random.default_rng(0).uniform(1 - SPREAD, 1 + SPREAD, (count, len(self.truth)))
        starts, n = self.truth * factors, len(self.tau)
        starts[:, :n] = np.clip(np.sort(starts[:, :n]), 0.0, self.times[-1])
        return starts

    def build_problem(self) -> sf.Problem:
        """Return the problem as a user writes it, with the first start as its guess."""
        guess, n = self.draw_starts(1)[0], len(self.tau)
        observed = list(self.observed)
        log = sf.Measurements(self.times, self.values, observe=lambda t, x, p: x[np.array(observed)], sigma=self.sigma)
        run = sf.Experiment(log, self.sequence, tuple(guess[:n]), 0.0, float(self.times[-1]))
        names = zip(self.parameters, guess[n:], strict=True)
        parameters = {name: sf.Parameter(float(value), lower=0.0) for name, value in names}
        return sf.Problem(sf.HybridSystem(self.modes, list(self.x0)), run, parameters)

    def simulate(
        self, theta: np.ndarray, until: float = np.inf, rtol: float = 1e-10, atol: float = 1e-13
    ) -> np.ndarray:
        """Return the measured states at the samples, (K, q), from an integration that stops at all corners.

        Raises a TimeoutError at `until`, in seconds of `time.monotonic`.
        """
        twin = limit(self.twin, until)

        def advance(mode: str, p: Parameters, x: np.ndarray, span: Span, times: np.ndarray) -> States:
            settings = {"method": "LSODA", "rtol": rtol, "atol": atol}
            if self.corners(x, p):
                settings |= {"method": "DOP853", "max_step": self.times[-1] / len(self.times)}
            return integrate(
                lambda t, x, s: twin(mode, t, x, p, s), lambda x: self.corners(x, p), x, *span, times, **settings
            )

        return self._join_modes(theta, advance)

    def simulate_plainly(self, theta: np.ndarray, until: float, rtol: float, atol: float) -> np.ndarray:
        """Return the same from LSODA without stops, as SciPy's fit gets it."""
        twin = limit(self.smooth or self.twin, until)

        def advance(mode: str, p: Parameters, x: np.ndarray, span: Span, times: np.ndarray) -> States:
            path = solve_ivp(
                lambda t, x: twin(mode, t, x, p, find_sides(self.corners(x, p))),
                span,
                x,
                method="LSODA",
                t_eval=np.union1d(times, span[1]),
                rtol=rtol,
                atol=atol,
            )
            if path.status < 0:
                raise ArithmeticError(path.message)
            return path.y[:, : len(times)].T, path.y[:, -1]

        return self._join_modes(theta, advance)

    def _join_modes(self, theta: np.ndarray, advance: Callable[..., States]) -> np.ndarray:
        n = len(self.tau)
        p, ends = tuple(float(value) for value in theta[n:]), (0.0, *theta[:n], float(self.times[-1]))
        x, parts = np.array(self.x0), []
        for mode, span in zip(self.sequence, pairwise(ends), strict=True):
            if span[1] > span[0]:
                times = self.times[(self.times > span[0]) & (self.times <= span[1])]
                states, x = advance(mode, p, x, span, times)
                parts.append(states[:, list(self.observed)])
        return np.concatenate(parts)

    def weigh(self, simulated: np.ndarray) -> np.ndarray:
        """Return the residuals in units of sigma; J is half their sum of squares."""
        return ((simulated - self.values) / self.sigma).ravel()

    def judge(self, theta: np.ndarray) -> float:
        """Return J of an end, by an accurate integration."""
        r = self.weigh(self.simulate(theta, time.monotonic() + JUDGING))
        return float(0.5 * r @ r)


def limit(twin: Twin, until: float) -> Twin:
    """Return a twin that raises a TimeoutError at a time of `time.monotonic`."""

    def check(*given: Any) -> Sequence[float]:
        if time.monotonic() > until:
            raise TimeoutError("the integration takes too long")
        return twin(*given)

    return check


def is_right(cost: float, best: float) -> bool:
    """Return whether an end is as good as the best known one."""
    return cost <= best * (1 + RELATIVE) + ABSOLUTE
