"""Online estimation: drives, modes and parameters are followed, against batch fits and closed forms."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.models import decay, one_run, simulate_log
from support.online_drives import (
    MODES,
    SIGMA,
    SWITCHES,
    TIMES,
    assert_same,
    feed_all,
    measure,
    simulate,
    track,
    vehicle,
)
from switchfit.engine.hypotheses import Hypotheses
from switchfit.models import skid_steer
from switchfit.online.window_start import Past, Start, forget


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


# --- a drive ----------------------------------------------------------------------------------------------------------


def test_the_vehicle_is_followed_and_ends_where_the_batch_fit_does(problem, log, batch):
    said = feed_all(sf.OnlineEstimator(problem), log)
    alarms = [now.alarm for now in said if now.alarm]
    assert [alarm.mode for alarm in alarms] == ["slip", "stick"]
    assert alarms[0].time - 6.0 < 0.85
    assert alarms[1].time - 10.0 < 0.65
    last = said[-1]
    found = np.append(last.transition_times, last.parameters["mu"])
    errors = batch.standard_errors
    np.testing.assert_allclose(found, batch.theta, atol=0.01 * errors.min())
    np.testing.assert_allclose(np.append(last.time_errors, last.standard_errors["mu"]), errors, rtol=0.01)
    path = sf.simulate(batch.problem, batch.theta)
    np.testing.assert_allclose(last.state, path.states[-1], atol=1e-3)
    assert last.mode_probability["stick"] > 0.99


def test_a_window_is_exact_for_a_linear_model():
    """Both parameters enter linearly, and no time is unknown: the samples that have left are a quadratic cost."""
    modes = {"on": lambda t, x, p: jnp.stack([x[1], p["a"] + p["b"] * t])}  # integrated exactly
    rng, times = np.random.default_rng(3), 0.1 * np.arange(1, 101)
    values = 0.2 * times**2 + 0.05 * rng.standard_normal(100)
    data = sf.Measurements(times, values, lambda t, x, p: x[:1], 0.05)
    problem = track(modes, [sf.Parameter(0.1), 0.0], data, {"a": 1.0, "b": 0.2}, 10.0)
    online = sf.OnlineEstimator(problem, window=2.0)
    now = feed_all(online, values, times)[-1]
    batch = sf.estimate(problem)
    for name in ("a", "b"):
        np.testing.assert_allclose(now.parameters[name], batch.parameters[name], rtol=1e-10, atol=1e-11)
    fit = online.estimate()
    np.testing.assert_allclose(fit.theta[-3:-1], batch.theta[:2], rtol=1e-6)
    np.testing.assert_allclose(now.standard_errors["a"], batch.standard_errors[0], rtol=1e-9)


def test_a_mode_can_begin_with_a_new_value():
    """The vehicle slips on two kinds of ground; a constant mu would be between them."""
    modes, taus = ("stick", "slip", "stick", "slip"), (4.0, 7.0, 9.0)
    first = simulate(modes, taus, TIMES[:90])
    later = sf.Experiment(sf.RunningCost(lambda t, x, p: 0.0), ("slip",), (), 9.0, 13.0, initial_state=first[-1])
    second = sf.simulate(sf.Problem(skid_steer(), later, {"mu": 0.5}), times=TIMES[90:]).states
    log = measure(np.vstack([first, second]), 5)
    problem = vehicle(log)
    renewed = feed_all(sf.OnlineEstimator(problem, renews={"slip": "mu"}), log)
    before = next(now for now in renewed if now.time > 8.9)
    assert abs(float(before.parameters["mu"]) - 0.7) < 4 * float(before.standard_errors["mu"])
    last = renewed[-1]
    assert [now.alarm.mode for now in renewed if now.alarm] == ["slip", "stick", "slip"]
    assert float(last.standard_errors["mu"]) < 0.02
    assert abs(float(last.parameters["mu"]) - 0.5) < 4 * float(last.standard_errors["mu"])
    constant = feed_all(sf.OnlineEstimator(problem), log)[-1]
    assert abs(float(constant.parameters["mu"]) - 0.5) > 4 * float(constant.standard_errors["mu"])


def test_a_parameter_that_drifts_is_followed():
    """x' = a(t): what is known of a from before the window is forgotten at the rate of its drift."""
    rng, times = np.random.default_rng(0), 0.1 * np.arange(1, 601)
    a = 1.0 + np.cumsum(0.01 * np.sqrt(0.1) * rng.standard_normal(600))
    x = np.cumsum(0.1 * a)
    log = x + 0.05 * rng.standard_normal(600)
    data = sf.Measurements(times, log, sigma=0.05)
    problem = track({"on": lambda t, x, p: jnp.stack([p["a"]])}, [0.0], data, {"a": 1.0}, 60.0)
    errors = {}
    for drift in (None, {"a": 0.01}):
        said = feed_all(sf.OnlineEstimator(problem, window=2.0, drift=drift), log, times)
        away = np.array([float(now.parameters["a"]) for now in said]) - a
        spread = np.array([float(now.standard_errors["a"]) for now in said])
        errors[drift is None] = np.sqrt((away[100:] ** 2).mean()), np.sqrt(((away / spread)[100:] ** 2).mean())
    assert errors[False][0] < 0.5 * errors[True][0]
    assert errors[False][1] < 2.2 < 4.0 < errors[True][1]  # in standard errors


@pytest.mark.parametrize("window", [None, 3.0])
def test_without_changes_there_is_one_hypothesis(problem, log, window):
    online = sf.OnlineEstimator(problem, max_switches=0, window=window)
    now = feed_all(online, log[:50])[-1]
    assert now.mode_sequence == ("stick",)
    assert now.mode_probability["stick"] == 1.0


def test_the_data_of_the_problem_may_be_empty(problem, log):
    """The time between samples is that from the first to the second one."""
    gps = sf.Measurements([], np.empty((0, 3)), lambda t, x, p: x[:3], SIGMA, names=("X", "Y", "heading"))
    empty = sf.Problem(skid_steer(), sf.Experiment(gps, ("stick",), t0=0.0), problem.parameters)
    online, known = sf.OnlineEstimator(empty), sf.OnlineEstimator(problem)
    with pytest.raises(ValueError, match="how often the sensors measure is not known yet"):
        sf.calibrate(online, 0.01)
    online.update(0.001), known.update(0.001)
    now, same = feed_all(online, log)[-1], feed_all(known, log)[-1]
    assert online.spacing == pytest.approx(known.spacing, rel=0.02)
    np.testing.assert_allclose(now.transition_times, same.transition_times, atol=1e-4)
    np.testing.assert_allclose(now.parameters["mu"], same.parameters["mu"], rtol=1e-4)
    assert sf.calibrate(online, 0.01, seconds=2.0, runs=10).seconds == 2.0
    for call in (sf.estimate, sf.multistart, sf.find_modes, sf.design, lambda each: sf.estimate_many([each])):
        with pytest.raises(ValueError, match="the Measurements of run1 have no samples: give times and values"):
            call(empty)
    with pytest.raises(ValueError, match="no samples to replay"):
        sf.replay(empty)


def test_the_fit_of_what_is_kept_knows_corners_and_updates_warn():
    """A block that is pushed until 2 s comes to rest by dry friction at 5.2 s."""
    modes = {
        "push": lambda t, x, p: jnp.stack([x[1], 1.0 - 0.5 * x[1]]),
        "slide": lambda t, x, p: jnp.stack([x[1], -p["b"] * jnp.sign(x[1])]),
    }
    times = np.linspace(0.05, 10.0, 200)
    log = sf.Measurements(times, np.zeros((200, 2)), sigma=0.01)
    problem = one_run(sf.HybridSystem(modes, [0.0, 0.0]), log, ("push", "slide"), (2.0,), 10.0, {"b": 0.4})
    problem = simulate_log(problem, [2.0, 0.4], 0)
    with pytest.warns(RuntimeWarning, match=r"corners of the state \(test_\w+.py:\d+\): the steps of updates"):
        online = sf.OnlineEstimator(problem)
    feed_all(online, problem.experiments[0].data[0].values, times)
    found, whole = online.estimate(), sf.estimate(problem)
    np.testing.assert_allclose(found.theta, whole.theta, rtol=1e-6)
    np.testing.assert_allclose(found.standard_errors, whole.standard_errors, rtol=1e-3)


@pytest.mark.parametrize("engine", ["native", "jax"])
def test_a_problem_without_samples_is_simulated_and_costs_nothing(engine):
    data = sf.Measurements([], np.empty((0, 1)), sigma=0.1)
    run = sf.Experiment(data, ("on",), t0=0.5, tf=1.5)
    problem = sf.Problem(sf.HybridSystem({"on": decay}, [1.0]), run, {"k": 0.7}, engine=engine)
    assert sf.evaluate(problem).cost == 0.0
    np.testing.assert_allclose(sf.simulate(problem, times=[1.5]).states[0], np.exp(-0.7), rtol=1e-8)


# --- samples ----------------------------------------------------------------------------------------------------------


def test_reset_begins_anew(problem, log):
    online = sf.OnlineEstimator(problem)
    first = feed_all(online, log)[-1]
    online.reset()
    assert online.now is None
    assert online.update(0.05).status is sf.OnlineStatus.WAITING
    online.reset()
    again = feed_all(online, log)[-1]
    assert_same(again, first)


def test_a_window_gives_back_the_room_of_what_has_left(problem, log):
    large, small = (sf.OnlineEstimator(problem, window=4.0, capacity=capacity) for capacity in (4096, 95))
    assert_same(feed_all(small, log)[-1], feed_all(large, log)[-1])
    assert small._feed.nodes[0] > large._feed.nodes[0] == 0.0


@pytest.mark.parametrize("settings", [{}, {"window": 4.0}])
def test_a_saved_estimator_goes_on_bit_by_bit(problem, log, tmp_path, settings):
    online = sf.OnlineEstimator(problem, **settings)
    online.keep_journal(tmp_path / "journal")
    for k, (t, y) in enumerate(zip(TIMES, log, strict=True)):
        last = online.update(t, {"X": y[0], "Y": y[1], "heading": y[2]} if k % 2 else y)
        if k == 80:
            online.save(tmp_path / "state")
    with pytest.raises(ValueError, match="comes too late"):
        online.update(-1.0, log[0])  # in the journal, too
    with (tmp_path / "journal").open("ab") as file:
        file.write(b'{"t": 13.1, "y": [0')  # the process was killed here
    loaded = sf.OnlineEstimator.load(tmp_path / "state", problem, **settings)
    loaded.keep_journal(tmp_path / "journal")
    assert_same(loaded.now, last)


def test_a_file_of_something_else_is_refused(problem, log, tmp_path):
    (tmp_path / "text").write_text("{}")
    with pytest.raises(ValueError, match="not a saved"):
        sf.OnlineEstimator.load(tmp_path / "text", problem)
    online = sf.OnlineEstimator(problem)
    online.save(tmp_path / "state")
    assert sf.OnlineEstimator.load(tmp_path / "state", problem).now is None
    online.update(0.1, log[0])
    online.save(tmp_path / "state")
    with pytest.raises(ValueError, match="other settings"):
        sf.OnlineEstimator.load(tmp_path / "state", problem, width=10)
    modes = dict(reversed(problem.system.modes.items()))
    swapped = replace(problem, system=replace(problem.system, modes=modes))
    with pytest.raises(ValueError, match="another problem"):
        sf.OnlineEstimator.load(tmp_path / "state", swapped)
    (tmp_path / "cut off").write_bytes((tmp_path / "state").read_bytes()[:100])
    with pytest.raises(ValueError, match="not a saved"):
        sf.OnlineEstimator.load(tmp_path / "cut off", problem)


def test_bad_settings_are_refused(problem, log):
    for settings, message in (
        ({"window": -1.0}, "window must be positive; got -1.0"),
        ({"threshold": 1.0, "false_alarms": 1.0}, "give threshold or false_alarms, not both: one follows from the ot"),
        ({"drift": {"mu": 0.1}}, "window="),
        ({"renews": {"slip": "nu"}}, "no free parameter"),
        ({"renews": {"skid": "mu"}}, "renews names the unknown mode 'skid'"),
        ({"renews": {"slip": ()}}, "renews of 'slip' is empty"),
        ({"drift": {"mu": 0.0}, "window": 1.0}, "drift of mu must be positive; got 0.0"),
        ({"capacity": 0}, "capacity must be 1 or more; got 0"),
        ({"width": 0}, "width must be 1 or more; got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            sf.OnlineEstimator(problem, **settings)
    for settings in ({"renews": "mu"}, {"drift": 0.1, "window": 1.0}):
        with pytest.raises(TypeError, match=f"{next(iter(settings))} must be a dict of a (mode|parameter) and the"):
            sf.OnlineEstimator(problem, **settings)
    with pytest.raises(ValueError, match="capacity"):
        feed_all(sf.OnlineEstimator(problem, capacity=20), log)
    with pytest.raises(ValueError, match="nothing has been measured"):
        sf.OnlineEstimator(problem).estimate()


def test_data_without_a_known_sigma_are_refused(log):
    for sigma, message in ((None, "left out"), ("s", "is a parameter")):
        gps = sf.Measurements(TIMES, log, lambda t, x, p: x[:3], sigma)
        parameters = {"mu": sf.Parameter(0.8)} | ({"s": sf.Parameter(0.1, lower=1e-3)} if sigma else {})
        with pytest.raises(ValueError, match=message):
            sf.OnlineEstimator(one_run(skid_steer(), gps, ("stick",), (), 13.0, parameters))


# --- parts ------------------------------------------------------------------------------------------------------------


def quadratic(rng: np.random.Generator, D: int) -> tuple[np.ndarray, np.ndarray]:
    R = rng.standard_normal((D + 3, D))
    return rng.standard_normal(D), R.T @ R


def test_a_time_that_leaves_the_window_takes_its_minimum():
    """Of ``J + g'd + d'Hd/2`` with the state ``Z d`` held, against the minimum over all d with that state."""
    rng, A, births, M = np.random.default_rng(0), 2, 2, 1
    D, prior = A + births + M, 0.0
    g, H = quadratic(rng, D)
    Z = rng.standard_normal((2, D))
    Z[:, A + 1], H[A + 1], H[:, A + 1], g[A + 1] = 0.0, 0.0, 0.0, 0.0
    past = Past.of(Z, A, births)
    one = Hypotheses(*(np.array([v]) for v in (0.0, 1.0)), g[None].copy(), H[None].copy(), np.zeros((1, D)),
                     np.zeros((1, 2)), Z[None].copy())  # fmt: skip
    H0 = H + np.diag(np.arange(D) == A + 1)
    past.absorb(one, prior)
    for _ in range(5):
        state, p = rng.standard_normal(2), rng.standard_normal()
        own = [0, 1, 2, 4]  # all but the empty slot; of these p is the last
        C, b = np.vstack([Z[:, own], [0, 0, 0, 1]]), np.append(state, p)
        K = np.block([[H0[np.ix_(own, own)], C.T], [C, np.zeros((3, 3))]])
        d = np.linalg.solve(K, np.append(-g[own], b))[:4]
        cost = 1.0 + g[own] @ d + 0.5 * d @ H0[np.ix_(own, own)] @ d
        Zn, Hn, gn = one.tangents[0], one.matrices[0], one.gradients[0]
        e = np.linalg.solve(Zn[:, :2], state - Zn[:, 4] * p)
        d = np.array([*e, 0.0, 0.0, p])
        assert one.costs[0] + gn @ d + 0.5 * d @ Hn @ d == pytest.approx(cost, rel=1e-9)


@pytest.mark.parametrize("variance", [0.3, np.inf])
def test_a_parameter_with_a_new_value_is_joined_to_its_old_one(variance):
    rng, A = np.random.default_rng(1), 2
    g, H = quadratic(rng, 4)  # two entries, two parameters, of which the last gets a new value
    Z = rng.standard_normal((2, 4))
    start = Start(np.zeros(4), 1.0, g, H, np.zeros(2), Z)
    found, turn = forget(start, A, np.array([3]), np.array([variance]))
    for _ in range(5):
        state, p, new = rng.standard_normal(2), rng.standard_normal(), rng.standard_normal()
        C, b = np.vstack([Z, [0, 0, 1, 0]]), np.append(state, p)
        link = np.diag([0, 0, 0, 1 / variance])
        K = np.block([[H + link, C.T], [C, np.zeros((3, 3))]])
        d = np.linalg.solve(K, np.append(-g + [0, 0, 0, new / variance], b))[:4]
        cost = 1.0 + g @ d + 0.5 * d @ H @ d + (d[3] - new) ** 2 / (2 * variance)
        e = np.linalg.solve(found.tangent[:, :2], state - found.tangent[:, 2] * p)
        assert not found.tangent[:, 3].any()
        there = np.array([*e, p, new])
        value = found.cost + found.gradient @ there + 0.5 * there @ found.matrix @ there
        assert value == pytest.approx(cost, rel=1e-9)
        np.testing.assert_allclose(np.append(d[:2], d[3]) @ turn, e, atol=1e-9)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_wrong_model_of_a_log_with_outliers_is_followed_to_the_end(seed):
    """A sine, of which a model knows only straight lines: times of changes leave the window, and would leave order."""
    rng, modes = np.random.default_rng(seed), {"up": lambda t, x, p: p["rate"] + 0.0 * x}
    modes["down"] = lambda t, x, p: -p["rate"] + 0.0 * x
    gps = sf.Measurements([], np.empty((0, 1)), sigma=0.05)
    problem = track(modes, [sf.Parameter(0.0)], gps, {"rate": 0.5})
    online = sf.OnlineEstimator(problem, window=3.0)
    for k in range(1, 300):
        outlier = 2.0 * rng.standard_normal() if k % 20 == 10 else 0.0
        now = online.update(0.1 * k, [0.3 * np.sin(0.08 * k) + 0.05 * rng.standard_normal() + outlier])
        assert (np.diff(now.transition_times) >= 0.0).all()


# --- any log ---------------------------------------------------------------------------------------------------------


TOLD = [20, 21, 41, 45]
"""Seeds that have ended in an error of switchfit itself."""


def draw_estimator(seed):
    rng = np.random.default_rng(seed)
    A = rng.uniform(-1, 1, (3, 2, 2)) - np.eye(2)
    b = rng.uniform(-2, 2, (3, 2))
    modes = {f"m{i}": lambda t, x, p, i=i: jnp.asarray(A[i]) @ x + p["g"] * b[i] for i in range(2 + seed % 2)}
    loss = {"loss": "huber"} if seed % 3 == 0 else {}
    position = sf.Measurements([], np.empty((0, 1)), lambda t, x, p: x[:1], 0.05, names=("a",), **loss)
    speed = sf.Measurements([], np.empty((0, 1)), lambda t, x, p: x[1:], 0.1, names=("b",))
    data = [position, speed] if seed % 2 else [position]
    system = sf.HybridSystem(modes, [sf.Parameter(0.0), 0.0])
    problem = sf.Problem(system, sf.Experiment(data, ("m0",), t0=0.0), {"g": sf.Parameter(1.0, lower=0.05)})
    settings = {"window": [None, 1.0, 3.0, 6.0][rng.integers(4)], "threshold": [6.0, 12.0][seed % 2]}
    if seed % 5 == 1:
        settings["renews"] = {"m1": "g"}
    if seed % 5 == 2 and settings["window"]:
        settings["drift"] = {"g": 0.05}
    if seed % 7 == 3:
        settings["min_duration"] = 0.4
    if seed % 7 == 4:
        settings["max_switches"] = 2
    return rng, sf.OnlineEstimator(problem, **settings)


@pytest.mark.parametrize("seed", [pytest.param(k, marks=() if k in TOLD else pytest.mark.fuzz) for k in range(160)])
def test_any_log_is_followed_and_fitted(seed):
    """Outliers, gaps, late samples; random models, none of which explains the log, and settings."""
    rng, online = draw_estimator(seed)
    late = []
    for k in range(1, 151):
        t = 0.1 * k
        outlier = 3.0 * rng.standard_normal() if rng.random() < 0.03 else 0.0
        y = {"a": np.sin(0.7 * t) * rng.choice([1.0, 1.0, 1.5]) + 0.05 * rng.standard_normal() + outlier}
        if rng.random() < 0.05:
            y["a"] = np.nan
        if seed % 2 and k % 2:
            y["b"] = np.cos(t) + 0.1 * rng.standard_normal()
        if rng.random() < 0.05:
            late.append((t, y))
            continue
        now = online.update(t, y)
        assert len(now.mode_sequence) == len(now.transition_times) + 1
        assert (np.diff(now.transition_times) >= 0.0).all()
        assert np.isfinite([*now.state, now.parameters["g"]]).all()
        while late and rng.random() < 0.5:
            before, sample = late.pop(0)
            try:
                online.update(before, sample)
            except ValueError as error:  # the window begins with the mode that has renewed g
                if "comes too late" not in str(error):
                    raise
    assert np.isfinite(online.estimate().cost)
