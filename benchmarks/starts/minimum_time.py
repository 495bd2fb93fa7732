"""Minimum time between two states with a bounded control, which jumps between its bounds: tf is an unknown.

rest-to-rest  x'' = u, |u| <= 1, over 1 m: Pontryagin et al., The Mathematical Theory of Optimal Processes, 1962,
              section 5, example 1; Bryson and Ho, Applied Optimal Control, 1975, section 3.9.
pendulum      x'' + x = u, |u| <= 1, to rest at 0: Pontryagin et al., the same, example 2. All arcs between the first
              and the last take pi.
van-der-pol   x'' = -x - (x² - 1) x' + u, |u| <= 1: Maurer and Osmolovskii, Second order sufficient conditions for
              time-optimal bang-bang control, SIAM J. Control Optim. 42 (2004), 2239-2263.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks.starts.case import Case

SPREAD = 1.5
"""The time of each arc at a start is up to 2 to this power times that of the answer, or a part of it as small."""

LONGEST = 4.0
"""Upper bound of tf, in units of the answer; no start is longer."""

PENDULUM_ARCS = (1.0, np.pi, np.pi, 2.0)
VAN_DER_POL_ARCS = (0.15832014228746, 1.09575458704915)
"""DOP853 at 1e-13."""


def rest_to_rest(count: int = 30) -> Case:
    """Push for 1 s, brake for 1 s."""
    return _case(lambda x, u: [x[1], u + 0.0 * x[0]], (1, -1), (1.0, 1.0), [0.0, 0.0], [1.0, 0.0], count, seed=0)


def pendulum(count: int = 30) -> Case:
    """Four arcs about (-1, 0) and (1, 0) in turn, from where the last of them leads to the origin."""
    signs = (-1, 1, -1, 1)
    start = np.zeros(2)
    for u, arc in zip(signs[::-1], PENDULUM_ARCS[::-1], strict=True):
        back = np.array([[np.cos(arc), -np.sin(arc)], [np.sin(arc), np.cos(arc)]])
        start = [u, 0.0] + back @ (start - [u, 0.0])
    return _case(lambda x, u: [x[1], u - x[0]], signs, PENDULUM_ARCS, start.tolist(), [0.0, 0.0], count, seed=1)


def van_der_pol(count: int = 30) -> Case:
    """One switch on the way from (-0.4, 0.6) to (0.6, 0.4)."""

    def field(x: Any, u: float) -> list[Any]:
        return [x[1], -x[0] - (x[0] ** 2 - 1.0) * x[1] + u]

    return _case(field, (1, -1), VAN_DER_POL_ARCS, [-0.4, 0.6], [0.6, 0.4], count, seed=2)


def _case(
    field: Callable[[Any, float], list[Any]],
    signs: Sequence[int],
    arcs: Sequence[float],
    start: Sequence[float],
    goal: Sequence[float],
    count: int,
    seed: int,
) -> Case:
    """Return a problem whose answer has arcs of these times with these signs of the control."""
    modes = {name: lambda t, x, p, u=u: jnp.stack(field(x, u)) for name, u in (("up", 1.0), ("down", -1.0))}
    system = sf.HybridSystem(modes, list(start), state_names=("x", "dx"))
    factors = 2.0 ** np.random.default_rng(seed).uniform(-SPREAD, SPREAD, (count, len(arcs)))
    starts = np.cumsum(factors * arcs, axis=1)
    costs = [
        sf.RunningCost(lambda t, x, p: jnp.ones(())),
        sf.TerminalConstraint(lambda x, p: x - jnp.array(goal)),
    ]
    sequence = tuple("up" if u > 0 else "down" for u in signs)
    tf = sf.Parameter(starts[0, -1], upper=LONGEST * sum(arcs))
    problem = sf.Problem(system, sf.Experiment(costs, sequence, tuple(starts[0, :-1]), 0.0, tf))
    return Case(problem, np.cumsum(arcs), starts)
