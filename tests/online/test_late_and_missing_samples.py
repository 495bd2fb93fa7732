"""Samples that come late, at their own rates, with values missing, and inputs between them."""

import numpy as np
import pytest

import switchfit as sf
from support.models import decay
from support.online_drives import MODES, SWITCHES, TIMES, assert_same, feed_all, measure, simulate, track, vehicle


@pytest.fixture(scope="module")
def log() -> np.ndarray:
    return measure(simulate(), 0)


@pytest.fixture(scope="module")
def problem(log: np.ndarray) -> sf.Problem:
    return vehicle(log)


@pytest.fixture(scope="module")
def batch(log: np.ndarray) -> sf.Estimate:
    """The fit of all samples at once."""
    return sf.estimate(vehicle(log, MODES, SWITCHES))


@pytest.mark.parametrize("settings", [{}, {"window": 4.0}])
@pytest.mark.parametrize("late", [3, 35])
def test_samples_that_come_late_change_nothing_in_the_end(problem, log, batch, settings, late):
    last = feed_all(sf.OnlineEstimator(problem, **settings), log)[-1]
    online = sf.OnlineEstimator(problem, **settings)
    order = sorted(range(len(log)), key=lambda k: k + (late + 0.5) * (k in (70, 100)) if k + late < len(log) else k)
    for k in order:
        now = online.update(TIMES[k], log[k])
    assert now.mode_sequence == last.mode_sequence
    away = (now.transition_times - last.transition_times) / last.time_errors
    assert np.abs(away[1:]).max() < 0.02
    assert np.abs(away[0]) < (0.02 if not settings else 1.0)  # it left the window before its late neighbours came
    if not settings:
        np.testing.assert_allclose(online.estimate().theta, batch.theta, rtol=1e-9)


def test_missing_values_are_as_if_left_out(problem, log):
    one, other = sf.OnlineEstimator(problem), sf.OnlineEstimator(problem)
    holes = log.copy()
    holes[::3, 1] = np.nan
    holes[::7] = np.nan
    for t, y in zip(TIMES, holes, strict=True):
        a = one.update(t, y)
        named = {name: v for name, v in zip(("X", "Y", "heading"), y, strict=True) if not np.isnan(v)}
        b = other.update(t, named or None)
    assert_same(a, b)


def test_sensors_at_their_own_rates_with_a_delay():
    """A slow sensor whose samples come 0.25 s late: each is put where the state was measured."""
    rng = np.random.default_rng(1)
    quick, slow = 0.1 * np.arange(1, 61), np.round(0.4 * np.arange(1, 15) + 0.25, 10)

    def truth(t):
        return np.where(t < 3.0, 1 - np.exp(-t), (1 - np.exp(-3.0)) * np.exp(3.0 - t))

    a = sf.Measurements(quick, truth(quick) + 0.05 * rng.standard_normal(60), sigma=0.05, names=["a"])
    b = sf.Measurements(slow, truth(slow - 0.25) + 0.01 * rng.standard_normal(14), sigma=0.01, names=["b"], delay=0.25)
    system = sf.HybridSystem({"on": lambda t, x, p: p["k"] - x, "off": lambda t, x, p: -x}, [0.0])
    problem = sf.Problem(system, sf.Experiment([a, b], ("on",), (), 0.0, 6.0), {"k": 1.2})
    replayed = sf.replay(problem)
    batch = sf.estimate(sf.Problem(system, sf.Experiment([a, b], ("on", "off"), (2.9,), 0.0, 6.0), {"k": 1.0}))
    np.testing.assert_allclose(replayed.now.transition_times, batch.transition_times[0], atol=1e-4)
    np.testing.assert_allclose(replayed.parameters["k"][-1], batch.parameters["k"], atol=1e-4)
    assert len(replayed.times) == len(np.union1d(quick, slow))
    online = sf.OnlineEstimator(problem)  # each sensor by itself, the slow one as soon as something else has come
    for k, (t, y) in enumerate(zip(quick, a.values, strict=True)):
        online.update(t, {"a": y[0]})
        for seen, value in zip(slow, b.values, strict=True):
            if k and quick[k - 1] < seen <= t:
                now = online.update(seen, {"b": value[0]})
    np.testing.assert_allclose(now.parameters["k"], batch.parameters["k"], atol=1e-4)
    np.testing.assert_allclose(online.estimate().theta, batch.theta, rtol=1e-6)
    assert 0 < replayed.delays([3.0])[0] < 0.6
    assert replayed.latency()["p50"] > 0


def test_inputs_that_are_held_are_those_of_the_batch(tmp_path):
    rng, times = np.random.default_rng(2), 0.1 * np.arange(1, 41)
    u = np.where(np.floor(times) % 2 == 0, 1.0, 3.0)
    x, states = 0.0, []
    for each in u:
        x = each / 2 + (x - each / 2) * np.exp(-0.2)
        states.append(x)
    log = np.array(states) + 0.01 * rng.standard_normal(40)
    system = sf.HybridSystem({"on": lambda t, x, p, u: u - p["k"] * x}, [0.0])
    data = sf.Measurements(times, log, sigma=0.01)
    known, unknown = sf.Input(np.append(0.0, times[:-1]), u), sf.Input([0.0], [0.0])
    problem, later = (
        sf.Problem(system, sf.Experiment(data, ("on",), (), 0.0, 4.0, inputs=inputs), {"k": 1.5})
        for inputs in (known, unknown)
    )
    k = sf.estimate(problem).parameters["k"]
    online = sf.OnlineEstimator(later)
    online.update(0.0)
    online.save(tmp_path / "state")
    online.keep_journal(tmp_path / "journal")
    online.update(times[0], [log[0]], u=u[0])
    online.update(times[0] + 1e-9, None, u=u[1])
    for t, y, held in zip(times[1:], log[1:], [*u[2:], u[-1]], strict=True):
        now = online.update(t, [y], u=held)
    np.testing.assert_allclose(now.parameters["k"], k, rtol=1e-5)
    np.testing.assert_allclose(online.estimate().parameters["k"], k, rtol=1e-6)
    loaded = sf.OnlineEstimator.load(tmp_path / "state", later)
    loaded.keep_journal(tmp_path / "journal")
    assert loaded.now.parameters["k"] == now.parameters["k"]
    np.testing.assert_allclose(sf.replay(problem).now.parameters["k"], k, rtol=1e-5)  # the inputs of the problem


def test_a_second_sensor_at_a_time_that_there_is():
    """Its sample is put in by an update of its own."""
    times = 0.1 * np.arange(1, 31)
    values = np.exp(-times) + 0.01 * np.random.default_rng(0).standard_normal((2, 30))
    sensors = [sf.Measurements(times, v, sigma=0.01, names=[n]) for v, n in zip(values, "ab", strict=True)]
    problem = track({"on": decay}, [1.0], sensors, {"k": 0.7}, 3.0)
    online = sf.OnlineEstimator(problem)
    for t, y in zip(times, values.T, strict=True):
        online.update(t, {"a": y[0]})
        now = online.update(t, {"b": y[1]})
    together = sf.replay(problem).now
    np.testing.assert_allclose(now.parameters["k"], together.parameters["k"], rtol=1e-6)
    np.testing.assert_allclose(now.standard_errors["k"], together.standard_errors["k"], rtol=1e-6)


BAD_SAMPLES = {
    "too many": (1.0, [0.0, 0.0], "must have 3 values"),
    "infinite": (1.0, [np.inf, 0.0, 0.0], "must be finite"),
    "unknown": (1.0, {"Z": 1.0}, "no channel"),
    "sensor": (1.0, {3: [1.0]}, "the position of a sensor must lie in 0..0"),
    "twice": (0.1, [0.0, 0.0, 0.0], "two samples"),
    "early": (-0.1, [0.0, 0.0, 0.0], "too late"),
    "time": (np.nan, [0.0, 0.0, 0.0], "t must"),
}


@pytest.mark.parametrize(("t", "y", "message"), BAD_SAMPLES.values(), ids=BAD_SAMPLES)
def test_bad_samples_are_refused_and_change_nothing(problem, log, t, y, message):
    online = sf.OnlineEstimator(problem)
    first = online.update(0.1, log[0])
    with pytest.raises(ValueError, match=message):
        online.update(t, y)
    assert online.now is first
    assert online.update(0.2, log[1]).time == 0.2
