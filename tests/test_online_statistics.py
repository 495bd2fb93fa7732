"""How often online estimation is wrong, over many simulated runs: `make coverage` prints the figures of the page."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2
from test_online import SWITCHES, drive, vehicle

import switchfit as sf
from switchfit.models import skid_steer

pytestmark = pytest.mark.slow


def correlate(rng: np.random.Generator, count: int, phi: float) -> np.ndarray:
    """Noise of variance 1 whose correlation from one sample to the next is phi."""
    noise = rng.standard_normal(count)
    for k in range(1, count):
        noise[k] = phi * noise[k - 1] + np.sqrt(1 - phi**2) * noise[k]
    return noise


def require_chi_square(name: str, errors: np.ndarray, count: int) -> None:
    """The sum of squared errors, in their standard errors, is inside the 95 % band of chi-square; `count` of them."""
    total = float(np.sum(errors))
    low, high = chi2.ppf([0.025, 0.975], count)
    print(f"{name}: {total / count:.2f}, 95 % band {low / count:.2f} to {high / count:.2f}")
    assert low < total < high


# --- false alarms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_false_alarms_come_as_often_as_was_asked(correlation):
    """Within a factor of two: 40 are expected in 200 runs of 20 s, of which a Poisson variable is within 28 to 53."""
    modes = {"full": lambda t, x, p: p["k"] * (3.0 - x), "part": lambda t, x, p: p["k"] * (2.8 - x)}
    times = 0.1 * np.arange(1, 201)
    run = sf.Experiment(sf.Measurements(times, 0.0 * times, sigma=0.05), ("full",), t0=0.0)
    problem = sf.Problem(sf.HybridSystem(modes, [0.0]), run, {"k": sf.Parameter(0.7, lower=0.0)})
    online = sf.OnlineEstimator(problem)
    online.set_threshold(sf.calibrate(online, 0.01, correlation=correlation).threshold)
    rng, clean, alarms, retracted = np.random.default_rng(1000), 3.0 * (1.0 - np.exp(-0.7 * times)), 0, 0
    for _ in range(200):
        online.reset()
        for t, y in zip(times, clean + 0.05 * correlate(rng, 200, correlation), strict=True):
            now = online.update(t, [y])
            alarms += now.alarm is not None
            retracted += now.retracted is not None
    print(f"correlation {correlation}: {alarms} alarms for 40, {retracted} retracted, threshold {online.threshold:.1f}")
    assert 20 <= alarms <= 80
    assert retracted >= 0.8 * alarms


# --- errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("window", [None, 4.0])
def test_errors_of_a_drive_are_those_that_are_said(window):
    """Of transition times and friction together, and of each entry of the state; 200 drives, of which a few end with a
    change that a later sample would have refuted.
    """
    end = len(drive()) * 0.1
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: 0.0), ("stick", "slip", "stick"), SWITCHES, 0.0, 15.0)
    state = sf.simulate(sf.Problem(skid_steer(), run, {"mu": 0.7}), times=[end]).states[0]
    online = sf.OnlineEstimator(vehicle(drive()), window=window)
    joint, apart, late, others = [], [], [], 0
    for seed in range(200):
        online.reset()
        said = [online.update(0.1 * k, y) for k, y in enumerate(drive(seed=seed), 1)]
        now, alarms = said[-1], [each.alarm for each in said if each.alarm]
        others += len(alarms) - 2
        late.append([min(a.time - t for a in alarms if a.mode == mode and a.time > t)
                     for t, mode in zip(SWITCHES, ("slip", "stick"), strict=True)])  # fmt: skip
        if len(now.transition_times) > 2:
            continue
        of = np.r_[now.best.times, now.best.parameters["mu"]]
        away = np.array([*now.transition_times, now.parameters["mu"]]) - [*SWITCHES, 0.7]
        joint.append(away[-len(of) :] @ now.best.matrix[np.ix_(of, of)] @ away[-len(of) :])
        apart.append((now.state - state) ** 2 / np.diag(now.covariance))
    print(f"window {window}: known after {np.median(late, 0)} s, at most {np.max(late, 0)} s; other alarms: {others}")
    assert len(joint) >= 190
    require_chi_square("times and friction", joint, len(joint) * len(of))
    for k, name in enumerate(skid_steer().state_names):
        require_chi_square(name, np.array(apart)[:, k], len(joint))
    assert (np.median(late, 0) <= [0.75, 0.55]).all()
    assert np.max(late) < 1.2
    assert others <= 0.1 * 200
