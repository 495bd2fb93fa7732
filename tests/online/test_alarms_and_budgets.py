"""What is said online: alarms and their retraction, thresholds, budgets, models that have lost the samples."""

from types import SimpleNamespace

import numpy as np
import pytest

import switchfit as sf
from support.online_drives import feed_all, measure, simulate, track, vehicle


@pytest.fixture(scope="module")
def log() -> np.ndarray:
    return measure(simulate(), 0)


@pytest.fixture(scope="module")
def problem(log: np.ndarray) -> sf.Problem:
    return vehicle(log)


@pytest.mark.parametrize(("seed", "sigma"), [(20, 0.035), (1, 0.025)], ids=["moved far", "no time"])
def test_alarms_by_noise_that_is_larger_than_sigma_are_refuted(seed, sigma):
    """What is left without them is fitted anew, and no mode lasts less than no time."""
    times, noise = np.arange(60.0), 0.05 * np.random.default_rng(seed).normal(size=60)
    peak = 16.0 - 15.0 * np.exp(-np.minimum(times, 22.3) / 20.0)
    levels = np.where(times < 22.3, peak, (peak + 2.0) * np.exp(-(times - 22.3) / 20.0) - 2.0) + noise
    fields = {m: lambda t, x, p, m=m: (p[m] - x) / p["T"] for m in ("before", "after")}
    data = sf.Measurements(times, levels, sigma=sigma)
    run = sf.Experiment(data, ("before",), initial_state=[sf.Parameter(1.0)])
    guesses = {"before": sf.Parameter(7.0), "after": sf.Parameter(0.8), "T": sf.Parameter(3.0, lower=0.1)}
    log = sf.replay(sf.Problem(sf.HybridSystem(fields, [0.0]), run, guesses))
    assert log.now.mode_sequence == ("before", "after")
    assert log.now.since == pytest.approx(22.3, abs=0.1)


def test_an_alarm_that_later_samples_refute_is_retracted(problem, log):
    online = sf.OnlineEstimator(problem, threshold=8.0)
    wrong = log.copy()
    wrong[40:44] -= [0.1, 0.1, 0.0]
    said = feed_all(online, wrong[:58])
    alarms, retracted = [now.alarm for now in said if now.alarm], [now.retracted for now in said if now.retracted]
    assert retracted[0] == alarms[0]
    assert said[-1].mode_sequence == ("stick",)
    assert next(now for now in said if now.retracted).status is sf.OnlineStatus.RETRACTED


@pytest.mark.parametrize("window", [None, 0.3])
def test_a_model_that_cannot_be_simulated_any_more_is_said(window, tmp_path):
    """x' = x^2 from 1 is infinite at t = 1."""
    data = sf.Measurements([], np.empty((0, 1)), sigma=0.1)
    modes = {"grow": lambda t, x, p: p["k"] * x**2, "more": lambda t, x, p: 2.0 * p["k"] * x**2}
    parameters = {"k": sf.Parameter(1.0, prior=sf.Normal(1.0, 1e-6))}
    problem = track(modes, [1.0], data, parameters)
    online = sf.OnlineEstimator(problem, window=window)
    for k in range(1, 9):
        online.update(0.1 * k, [1 / (1 - 0.1 * k)])
    for t in (2.0, 2.1):
        with pytest.raises(ValueError, match=r"the model cannot be simulated from t = .*begin anew with reset\(\)"):
            online.update(t, [10.0])
        assert online.now.status is sf.OnlineStatus.STOPPED
    with pytest.raises(ValueError, match="the model cannot be simulated"):
        online.save(tmp_path / "state")
    online.reset()
    assert online.update(0.1, [1 / 0.9]).status is sf.OnlineStatus.TRACKING


def test_a_budget_leaves_out_work_and_says_so(problem, log):
    online = sf.OnlineEstimator(problem, budget=1e-7)
    said = feed_all(online, log)
    count = [now.status for now in said].count
    assert count(sf.OnlineStatus.OVERRUN) > 50
    assert count(sf.OnlineStatus.OVERRUN) + count(sf.OnlineStatus.LOST) > 100  # without births no change is seen


def test_a_model_that_has_lost_the_samples_stays_so():
    """The parameter goes where each later sample is near again; those before are still not explained."""
    times = 0.1 * np.arange(1, 101)
    noise = 0.1 * np.random.default_rng(0).standard_normal(100)
    log = np.where(times < 3, 1 - np.exp(-0.7 * times), (1 - np.exp(-2.1)) * np.exp(-0.7 * (times - 3))) / 0.7 + noise
    modes = {"rise": lambda t, x, p: 1 - p["k"] * x, "fall": lambda t, x, p: -p["k"] * x}
    data = sf.Measurements(times, log, sigma=0.1)
    problem = track(modes, [0.0], data, {"k": sf.Parameter(0.7, lower=0.01)}, 10.0)
    said = sf.replay(problem, successions={"rise": ()}).status
    first = said.index(sf.OnlineStatus.LOST)
    assert set(said[first:]) == {sf.OnlineStatus.LOST}
    assert sf.OnlineStatus.LOST not in sf.replay(problem).status  # with the mode that explains them


def test_a_threshold_is_set_after_calibration(problem):
    online = sf.OnlineEstimator(problem)
    found, rarer = (sf.calibrate(online, rate, seconds=3.0, runs=10) for rate in (0.01, 0.0001))
    assert 0 < found.threshold < min(rarer.threshold, 40)
    assert "10 runs" in str(found)
    online.set_threshold(found.threshold)
    assert online.threshold == found.threshold


def test_a_threshold_for_a_rate_that_falls_exponentially(problem, monkeypatch):
    """Maxima of 20 s of alarms at the rate exp(-(h - 5) / 2) / s: for one an hour, h = 5 + 2 log(3600)."""
    from switchfit.online import calibration

    rng = np.random.default_rng(0)
    drawn = iter(5 + 2 * (np.log(20) - np.log(rng.exponential(size=4000))))

    def update(t, y=None):
        return SimpleNamespace(status=sf.OnlineStatus.TRACKING, statistic=next(drawn))

    quiet = SimpleNamespace(reset=lambda: None, update=update)
    monkeypatch.setattr(sf.OnlineEstimator, "_build_like", lambda online, problem, threshold: quiet)
    monkeypatch.setattr(calibration, "list_updates", lambda noisy: [(0.0, {})])
    found = sf.calibrate(sf.OnlineEstimator(problem), 1 / 3600, runs=4000)
    assert found.threshold == pytest.approx(5 + 2 * np.log(3600), abs=0.5)  # 1.8 more without the factor
