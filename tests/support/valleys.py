"""Problems whose unknowns are hardly determined: the way to their ends bends, or ends at a bound."""

from __future__ import annotations

import numpy as np

import switchfit as sf


def leaky(seed, scale):
    """A tank is filled and drained, and leaks hardly: the leak ends near its bound, or at it."""
    times, tau, q, r, k = np.arange(0.5, 10.0, 0.5), 4.3, 1.0, 0.5, 0.02
    since = np.maximum(times - tau, 0.0)
    filled = -q * np.expm1(-k * np.minimum(times, tau)) / k
    level = filled * np.exp(-k * since) + r * np.expm1(-k * since) / k
    values = level + 0.15 * np.random.default_rng(seed).standard_normal(len(times))
    modes = {"fill": lambda t, x, p: p["q"] - p["leak"] * x, "drain": lambda t, x, p: -p["r"] - p["leak"] * x}
    run = sf.Experiment(sf.Measurements(times, values, sigma=0.15), ("fill", "drain"), (4.0,), t0=0.0)
    leak = sf.Parameter(0.1, lower=0.0, scale=scale)
    return sf.Problem(sf.HybridSystem(modes, [0.0]), run, {"q": 0.8, "r": 0.4, "leak": leak})


def eaten(seed, scale):
    """Michaelis-Menten: what is well known of V and K is V / K, so that they follow a curved valley."""
    times, clock = np.arange(0.5, 14.0, 0.5), np.linspace(0.0, 14.0, 14001)
    level = [8.0]
    for t in clock[1:]:
        level.append(level[-1] + 0.001 * (0.5 * (t > 6.2) - 0.6 * level[-1] / (1.5 + level[-1])))
    values = np.interp(times, clock, level) + 0.2 * np.random.default_rng(seed).standard_normal(len(times))
    eat = lambda x, p: -p["V"] * x / (p["K"] + x)  # noqa: E731
    modes = {"eat": lambda t, x, p: eat(x, p), "fed": lambda t, x, p: p["feed"] + eat(x, p)}
    run = sf.Experiment(sf.Measurements(times, values, sigma=0.2), ("eat", "fed"), (5.0,), t0=0.0)
    parameters = {"V": 0.5, "feed": 0.4, "K": sf.Parameter(1.0, lower=0.0, scale=scale)}
    return sf.Problem(sf.HybridSystem(modes, [8.0]), run, parameters)
