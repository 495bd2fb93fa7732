"""A reference of its own for J, the constraints and all their derivatives: NumPy and SciPy, nothing of switchfit.

What is documented is written down again here in the plainest way: the run goes from event to event (nodes, samples,
transitions), each stretch is integrated by SciPy's method of order 8, costs are added up from their formulas.
Everything is analytic in theta and runs with complex numbers, so that gradients are complex steps without
cancellation. All columns of theta are integrated together, by the same steps. Hessians are central differences of
these gradients, extrapolated by Richardson's scheme.

The order of the events is that at the real theta for which derivatives are wanted, and stays the same while theta is
varied: stretches may become negative or complex. Where a transition time equals a node, `side` = +1 puts the transition
behind the node (the derivative for increasing it) and -1 before it; J is thereby the smooth branch to that side.

Arrays have the columns of theta as their last axis: theta (d, B), states (n, B), costs (B,).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

TOLERANCE = 1e-13
"""Of the integrator, relative and absolute."""

TINY = 1e-30
"""Imaginary step: its square is nothing beside 1."""

DIFFERENCES = (1e-3, 5e-4, 2.5e-4)
"""Real steps of the differences of gradients, each half the one before; what is left is of their sixth power."""


# Signals


@dataclass(frozen=True)
class Signal:
    """A piecewise cubic in time: knots (K,), coefficients (K - 1, 4, q), lowest power first."""

    knots: np.ndarray
    coefficients: np.ndarray

    @classmethod
    def spline(cls, times: np.ndarray, values: np.ndarray) -> Signal:
        """Not-a-knot cubic spline through values (K, q)."""
        return cls(times, np.moveaxis(CubicSpline(times, values, axis=0).c[::-1], 0, 1))

    @classmethod
    def linear(cls, times: np.ndarray, values: np.ndarray) -> Signal:
        """Straight lines through values (K, q)."""
        slopes = np.diff(values, axis=0) / np.diff(times)[:, None]
        return cls(times, np.stack([values[:-1], slopes, 0 * slopes, 0 * slopes], axis=1))

    @classmethod
    def hold(cls, times: np.ndarray, values: np.ndarray) -> Signal:
        """The last value (K, q), kept until the next one and for ever."""
        zeros = np.zeros_like(values)
        return cls(np.append(times, np.inf), np.stack([values, zeros, zeros, zeros], axis=1))

    def at(self, t: np.ndarray, cell: float) -> np.ndarray:
        """Values (q, B) at times (B,), by the polynomial that holds around the real time `cell`."""
        k = int(np.clip(np.searchsorted(self.knots, cell, side="right") - 1, 0, len(self.coefficients) - 1))
        s = t - self.knots[k]
        c = self.coefficients[k][:, :, None]
        return c[0] + s * (c[1] + s * (c[2] + s * c[3]))


# The description of a problem


@dataclass(frozen=True)
class Samples:
    """Noisy samples: times (K,), values (K, q) with NaN where missing, ``observe(t, x, p) -> (q, B)``.

    `sigma` is None, an array that broadcasts to (K, q), or a list of numbers and names of parameters, one a channel;
    `delay` a number or the name of a parameter.
    """

    times: np.ndarray
    values: np.ndarray
    observe: Callable[..., Any]
    sigma: Any = None
    loss: str = "linear"
    loss_scale: float = 1.0
    delay: Any = 0.0


@dataclass(frozen=True)
class Tracking:
    """``integral of 1/2 (y - y_m)' W (y - y_m) dt``, W of shape (q, q)."""

    signal: Signal
    observe: Callable[..., Any]
    weights: np.ndarray


@dataclass(frozen=True)
class Run:
    """One run. `modes` holds the field of each segment, `resets` and `guards` the function of each transition, or None.

    `times` holds for each transition its place in theta, or a number where it is fixed; `initial` a function of the
    parameters, or for each state its place in theta (an int) or a number (a float). `names` are the parameters that the
    functions see, and their names in the problem.
    """

    modes: Sequence[Callable[..., Any]]
    t0: float
    tf: float
    times: Sequence[Any]
    initial: Any
    names: dict[str, str]
    resets: Sequence[Any]
    guards: Sequence[Any]
    samples: Sequence[Samples] = ()
    tracking: Sequence[Tracking] = ()
    running: Sequence[Callable[..., Any]] = ()
    terminal: Sequence[Callable[..., Any]] = ()
    constraints: Sequence[Callable[..., Any]] = ()
    input: Signal | None = None


@dataclass(frozen=True)
class Reference:
    """A problem of several runs.

    `parameters` holds for each name its values, an array of the shape of the parameter, or a slice of theta and that
    shape; `priors` holds (place in theta, "normal" or "log-normal", center, spread).
    """

    runs: Sequence[Run]
    parameters: dict[str, Any]
    priors: Sequence[tuple[int, str, float, float]] = field(default=())

    def outputs(self, theta: np.ndarray, base: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
        """J (B,) and the constraints (m, B) at the columns of theta (d, B), events in their order at `base` (d,)."""
        named, at_base = self._named(theta), self._named(base[:, None])
        total, constraints = np.zeros(theta.shape[1], dtype=theta.dtype), []
        for run in self.runs:
            own, own_base = ({name: values[where] for name, where in run.names.items()} for values in (named, at_base))
            cost, held = _Walk(run, theta, base, own, own_base, side).outputs()
            total = total + cost
            constraints += held
        for place, kind, center, spread in self.priors:
            value = np.log(theta[place] / center) if kind == "log-normal" else theta[place] - center
            total = total + 0.5 * (value / spread) ** 2
        return total, np.array(constraints, dtype=theta.dtype).reshape(len(constraints), theta.shape[1])

    def _named(self, theta: np.ndarray) -> dict[str, np.ndarray]:
        named = {}
        for name, entry in self.parameters.items():
            if isinstance(entry, tuple):
                where, shape = entry
                named[name] = theta[where].reshape(*shape, theta.shape[1])
            else:
                named[name] = np.asarray(entry, dtype=float)[..., None] + np.zeros(theta.shape[1])
        return named

    def derivatives(self, theta: np.ndarray, side: int = 1) -> Derivatives:
        """J and the constraints with their first and second derivatives at theta (d,)."""
        d = len(theta)
        size = np.maximum(np.abs(theta), 0.5)
        shifts = [np.zeros(d)]
        for h in DIFFERENCES:
            for i in range(d):
                step = np.zeros(d)
                step[i] = h * size[i]
                shifts += [step, -step]
        points = theta[:, None] + np.array(shifts).T
        columns = np.repeat(points, d, axis=1).astype(complex)
        columns += 1j * TINY * np.tile(np.eye(d), points.shape[1])
        cost, held = self.outputs(columns, theta, side)
        both = np.concatenate([cost[None], held]).reshape(1 + len(held), points.shape[1], d)
        first = both.imag / TINY
        around = first[:, 1:].reshape(len(first), len(DIFFERENCES), d, 2, d)
        found = [(around[:, k, :, 0] - around[:, k, :, 1]) / (2 * h * size)[:, None] for k, h in enumerate(DIFFERENCES)]
        for factor in (4, 16):  # Richardson's extrapolation
            found = [(factor * fine - coarse) / (factor - 1) for coarse, fine in pairwise(found)]
        hessians = found[0]
        hessians = 0.5 * (hessians + np.swapaxes(hessians, 1, 2))
        values = both[:, 0, 0].real
        return Derivatives(values[0], first[0, 0], hessians[0], values[1:], first[1:, 0], hessians[1:])


@dataclass(frozen=True)
class Derivatives:
    """J, its gradient (d,) and Hessian (d, d); the constraints (m,), their Jacobian (m, d) and Hessians (m, d, d)."""

    cost: float
    gradient: np.ndarray
    hessian: np.ndarray
    constraints: np.ndarray
    jacobian: np.ndarray
    curvatures: np.ndarray


# One run


class _Walk:
    """One run from event to event, for all columns of theta at once."""

    def __init__(self, run: Run, theta: np.ndarray, base: np.ndarray, p: Any, p_base: Any, side: int) -> None:
        self.run, self.p = run, p
        zero = np.zeros(theta.shape[1], dtype=theta.dtype)
        self.tau = [theta[at] if isinstance(at, int) else at + zero for at in run.times]
        tau_base = [base[at] if isinstance(at, int) else at for at in run.times]
        if callable(run.initial):
            self.x = np.stack(np.broadcast_arrays(*[entry + zero for entry in run.initial(p)]))
        else:
            self.x = np.stack([theta[at] if isinstance(at, int) else at + zero for at in run.initial])
        self.cost, self.zero = zero, zero
        self.t = run.t0 + zero
        self.segment = 0
        self.cell = (run.t0, run.t0)
        self.events = self._ordered(tau_base, p_base, side)

    def _ordered(self, tau: list[float], p: Any, side: int) -> list[tuple[Any, ...]]:
        """Events as (place in the order, kind, ...): nodes, samples and transitions."""
        run = self.run
        knots = [signal.knots for signal in (*[item.signal for item in run.tracking], run.input) if signal is not None]
        times = [item.times - (0.0 if isinstance(item.delay, str) else item.delay) for item in run.samples]
        prompt = [t for item, t in zip(run.samples, times, strict=True) if not isinstance(item.delay, str)]
        nodes = np.unique(np.concatenate([[run.t0, run.tf], *knots, *prompt]))
        nodes = nodes[(nodes >= run.t0) & (nodes <= run.tf)]

        def place(t: float) -> float:
            """Nothing happens before t0 or after tf."""
            return -np.inf if t == run.t0 else np.inf if t == run.tf else float(t)

        events: list[tuple[Any, ...]] = [((place(t), 0, 0), "node", float(t)) for t in nodes]
        for item, seen in zip(run.samples, times, strict=True):
            late = float(p[item.delay][0]) if isinstance(item.delay, str) else 0.0
            for k, t in enumerate(seen):
                # A sample at a node belongs to it; a late one is seen wherever it falls.
                key = (place(t), 0, 1) if not isinstance(item.delay, str) else (float(t) - late, 0, 1)
                events.append((key, "sample", item, k, float(t)))
        events += [((float(t), side, i), "transition", i) for i, t in enumerate(tau)]
        return sorted(events, key=lambda event: event[0])

    def outputs(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """J (B,) and the constraints, guards first."""
        run = self.run
        nodes = [event[2] for event in self.events if event[1] == "node"]
        passed, guards = 0, []
        for _, kind, *what in self.events:
            if kind == "node":
                self._go(what[0] + self.zero)
                self.cell = (what[0], nodes[min(passed + 1, len(nodes) - 1)])
                passed += 1
            elif kind == "sample":
                self._sample(*what)
            else:
                guards += self._transition(what[0])
        p = self.p
        for phi in run.terminal:
            self.cost = self.cost + phi(self.x, p)
        ends = [entry + self.zero for psi in run.constraints for entry in psi(self.x, p)]
        return self.cost, [*guards, *ends]

    def _transition(self, i: int) -> list[np.ndarray]:
        self._go(self.tau[i])
        guard, reset = self.run.guards[i], self.run.resets[i]
        value = [] if guard is None else [guard(self.t, self.x, self.p) + self.zero]
        if reset is not None:
            self.x = np.stack([entry + self.zero for entry in reset(self.t, self.x, self.p)])
        self.segment = i + 1
        return value

    def _sample(self, item: Samples, k: int, time: float) -> None:
        seen = time - self.p[item.delay] if isinstance(item.delay, str) else time + self.zero
        self._go(seen)
        y = item.observe(seen, self.x, self.p)
        for channel, value in enumerate(item.values[k]):
            if not np.isnan(value):
                sigma, named = self._sigma(item, k, channel)
                u = ((y[channel] - value) / sigma) ** 2
                self.cost = self.cost + 0.5 * _robust(item.loss, item.loss_scale, u)
                if named:
                    self.cost = self.cost + np.log(sigma)

    def _sigma(self, item: Samples, k: int, channel: int) -> tuple[Any, bool]:
        if item.sigma is None:
            return 1.0, False
        if isinstance(item.sigma, list):
            entry = item.sigma[channel]
            return (self.p[entry], True) if isinstance(entry, str) else (entry, False)
        return np.broadcast_to(item.sigma, item.values.shape)[k, channel], False

    def _go(self, to: np.ndarray) -> None:
        """Integrate from the present time to `to`, both (B,), in the present mode and cell."""
        start, span = self.t, to - self.t
        if np.any(span):
            y = np.concatenate([self.x, self.cost[None]])

            def slope(s: float, flat: np.ndarray) -> np.ndarray:
                return (span * self._slope(start + s * span, flat.reshape(y.shape))).ravel()

            found = solve_ivp(slope, (0.0, 1.0), y.ravel(), "DOP853", rtol=TOLERANCE, atol=TOLERANCE).y[:, -1]
            self.x, self.cost = found.reshape(y.shape)[:-1], found.reshape(y.shape)[-1]
        self.t = to

    def _slope(self, t: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Of the states and of the cost, at times (B,) and y (n + 1, B)."""
        run, p, x = self.run, self.p, y[:-1]
        middle = 0.5 * (self.cell[0] + self.cell[1])
        given = (t, x, p) if run.input is None else (t, x, p, run.input.at(t, middle))
        rates = [entry + self.zero for entry in run.modes[self.segment](*given)]
        density = self.zero
        for ell in run.running:
            density = density + ell(t, x, p)
        for item in run.tracking:
            r = np.stack([entry + self.zero for entry in item.observe(t, x, p)]) - item.signal.at(t, middle)
            density = density + 0.5 * np.einsum("ib,ij,jb->b", r, item.weights, r)
        return np.stack([*rates, density])


def _robust(loss: str, C: float, u: np.ndarray) -> np.ndarray:
    """``C² rho(u / C²)``, as for `switchfit.problem.data`; which branch of Huber's is decided by the real part."""
    z = u / C**2
    if loss == "linear":
        return u
    if loss == "soft_l1":
        return C**2 * 2 * (np.sqrt(1 + z) - 1)
    if loss == "cauchy":
        return C**2 * np.log(1 + z)
    inside = z.real <= 1
    return C**2 * np.where(inside, z, 2 * np.sqrt(np.where(inside, 1, z)) - 1)
