"""Drives of the paper's vehicle that are followed online."""

import numpy as np

import switchfit as sf
from support.models import one_run
from switchfit.models import skid_steer

SIGMA = 0.05
TIMES = 0.1 * np.arange(1, 131)
MODES, SWITCHES = ("stick", "slip", "stick"), (6.0, 10.0)


def simulate(modes=MODES, taus=SWITCHES, times=TIMES) -> np.ndarray:
    """States of the vehicle, mu being 0.7."""
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: 0.0), modes, taus, 0.0, 15.0)
    return sf.simulate(sf.Problem(skid_steer(), run, {"mu": 0.7}), times=times).states


def measure(states: np.ndarray, seed: int) -> np.ndarray:
    """Noisy positions and headings."""
    return states[:, :3] + SIGMA * np.random.default_rng(seed).standard_normal((len(states), 3))


def vehicle(values: np.ndarray, modes: tuple[str, ...] = ("stick",), taus: tuple = ()) -> sf.Problem:
    times = TIMES[: len(values)]
    gps = sf.Measurements(times, values, lambda t, x, p: x[:3], SIGMA, names=("X", "Y", "heading"))
    return one_run(skid_steer(), gps, modes, taus, float(times[-1]), {"mu": sf.Parameter(0.8, lower=0.05, upper=2.0)})


def track(modes: dict, start: list, data, parameters: dict, tf: float | None = None) -> sf.Problem:
    """Return the problem of a log that begins in the first mode."""
    return one_run(sf.HybridSystem(modes, start), data, (next(iter(modes)),), (), tf, parameters, name="log")


def feed_all(online: sf.OnlineEstimator, log: np.ndarray, times: np.ndarray = TIMES) -> list[sf.Now]:
    """Give a log to an estimator, as far as there are values."""
    return [online.update(t, np.atleast_1d(y)) for t, y in zip(times, log, strict=False)]


def assert_same(now: sf.Now, other: sf.Now) -> None:
    """To the last bit."""
    np.testing.assert_array_equal(now.best.theta, other.best.theta)
    np.testing.assert_array_equal(now.transition_times, other.transition_times)
    np.testing.assert_array_equal(now.covariance, other.covariance)
    assert now.statistic == other.statistic
