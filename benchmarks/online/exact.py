"""The likelihood ratio of slip since any time with any mu against stick, exact on a fine grid of both.

It knows of one change alone, in the last seconds. No test of the same samples is much sooner at as many false alarms.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.online.drives import BOUNDS, PERIOD, SENSORS, SIGMA, SYSTEM, Drive
from switchfit.problem.functions import use_float64

BACK, PARTS, FRICTIONS = 3.0, 4, np.geomspace(*BOUNDS, 17)
"""How long ago the change may have been, s; times of a change in a sample interval; values of mu."""
SEEN = np.array(SENSORS["positions"])


@cache
def simulate_slides(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions without a change up to so many samples, (T + 1, 2), in steps of a part of their interval,
    and those up to BACK after a change at each of these times for each mu: (T, mu, steps, 2).
    """
    h = PERIOD / PARTS
    times, after = h * np.arange(PARTS * count + 1), h * np.arange(round(BACK / h))

    def advance(mode: str, t: Any, x: Any, mu: Any) -> Any:
        f, p = SYSTEM.modes[mode], {"mu": mu}
        k1 = f(t, x, p)
        k2 = f(t + h / 2, x + h / 2 * k1, p)
        k3 = f(t + h / 2, x + h / 2 * k2, p)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(t + h, x + h * k3, p))

    def slide(t: Any, x: Any, mu: Any) -> Any:
        def one(x: Any, s: Any) -> Any:
            following = advance("slip", t + s, x, mu)
            return following, following[SEEN]

        return jax.lax.scan(one, x, jnp.asarray(after))[1]

    with use_float64():
        begin = jnp.asarray(SYSTEM.initial_state, dtype=float)
        drive = jax.jit(lambda: jax.lax.scan(lambda x, t: (advance("stick", t, x, 1.0), x), begin, jnp.asarray(times)))
        states = drive()[1]
        slides = jax.jit(jax.vmap(jax.vmap(slide, (None, None, 0)), (0, 0, None)))
        found = slides(jnp.asarray(times[:-1]), states[:-1], jnp.asarray(FRICTIONS))
    return np.asarray(states)[:, SEEN], np.asarray(found)


def find_ratios(drive: Drive) -> np.ndarray:
    """Return twice the logarithm of the largest ratio at each sample, (K,)."""
    straight, slides = simulate_slides(len(drive.times))
    straight = straight[PARTS::PARTS]
    away, found = drive.values[:, : len(SEEN)] - straight, np.zeros(len(straight))
    for k, slide in enumerate(slides):
        first = k // PARTS  # sample after the change
        samples = slide[:, PARTS * (first + 1) - k - 1 :: PARTS][:, : len(found) - first]
        seen = slice(first, first + samples.shape[1])
        moved = samples - straight[seen]
        ratios = ((2 * away[seen] - moved) * moved / SIGMA**2).sum(2).cumsum(1)
        found[seen] = np.maximum(found[seen], ratios.max(0))
    return found
