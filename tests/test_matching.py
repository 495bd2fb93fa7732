"""Derivative matching: the best partition against all partitions, and what it makes of logs."""

from __future__ import annotations

from itertools import combinations, pairwise, product

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from switchfit.modes.library import Library, build_library
from switchfit.modes.matching import explain_no_matching, find_partitions, match_derivatives


def free_library(modes="abc", switches=3, durations=None, first=None, last=None, successions=None):
    names = tuple(modes)
    follow = successions or {name: tuple(other for other in names if other != name) for name in names}
    lasts = durations or dict.fromkeys(names, 0.0)
    return Library(names, first or names, last or names, follow, lasts, switches)


LIBRARIES = {
    "free": free_library(),
    "durations": free_library(durations={"a": 0.25, "b": 0.5, "c": 0.0}),
    "successions": free_library(successions={"a": ("b",), "b": ("a", "c"), "c": ("a",)}),
    "ends": free_library(first=("b",), last=("a", "c"), durations={"a": 0.0, "b": 0.3, "c": 0.6}),
    "chain": free_library(successions={"a": ("b",), "b": ("c",), "c": ()}, switches=4),
}


def enumerate_partitions(costs, times, library, switches):
    """The lowest cost of all partitions with a number of switches; infinite if there is none."""
    n, best = len(costs), np.inf
    for starts in combinations(range(1, n), switches):
        edges = [0, *starts, n]
        for modes in product(range(len(library.modes)), repeat=switches + 1):
            names = [library.modes[k] for k in modes]
            pieces = list(zip(names, modes, pairwise(edges), strict=True))
            if not library.admits(names) or any(
                times[b] - times[a] < library.min_duration(name) - 1e-9 for name, _, (a, b) in pieces
            ):
                continue
            best = min(best, sum(costs[a:b, k].sum() for _, k, (a, b) in pieces))
    return best


@pytest.mark.parametrize("name", LIBRARIES)
def test_partitions_are_the_best_of_all(name):
    library, some = LIBRARIES[name], 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        n = 8
        times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.05, 0.3, n))])
        costs = rng.exponential(size=(n, 3))
        found = {len(each.modes) - 1: each for each in find_partitions(costs, times, library)}
        for switches in range(library.max_switches + 1):
            expected = enumerate_partitions(costs, times, library, switches)
            assert (switches in found) == np.isfinite(expected)
            if switches not in found:
                continue
            some += 1
            each = found[switches]
            assert each.cost == pytest.approx(expected, rel=1e-12)
            own = costs[np.arange(n), each.spread_modes(n)].sum()
            assert own == pytest.approx(expected, rel=1e-12)
            names = [library.modes[k] for k in each.modes]
            assert library.admits(names)
            lasted = np.diff(times[[*each.starts, n]])
            assert all(d >= library.min_duration(m) - 1e-9 for d, m in zip(lasted, names, strict=True))
    assert some >= 12


def test_durations_that_do_not_fit_leave_nothing():
    library = free_library(durations=dict.fromkeys("abc", 2.0))
    assert find_partitions(np.ones((4, 3)), np.linspace(0.0, 1.0, 5), library) == []


MATRICES = {
    "a": [[-0.5, 2.0], [-2.0, -0.5]],
    "b": [[-0.3, 0.5], [0.2, -0.8]],
    "c": [[0.1, -3.0], [3.0, 0.1]],
}


def linear(matrix, k):
    return lambda t, x, p: p["s"] * jnp.asarray(matrix) @ x + jnp.array([1.0 * k, 0.5])


SYSTEM = sf.HybridSystem({name: linear(M, k) for k, (name, M) in enumerate(MATRICES.items())}, [1.0, -0.5])
TIMES = np.linspace(0.0, 8.0, 81)
TRUTH, SWITCHES = ("a", "c", "b", "a"), (2.03, 4.31, 6.08)


def states_of(times, sequence=TRUTH, switches=SWITCHES, system=SYSTEM, **settings):
    data = sf.Measurements(times, np.zeros((len(times), 2)), sigma=0.1)
    run = sf.Experiment(data, sequence, switches, 0.0, 8.0, **settings)
    return sf.simulate(sf.Problem(system, run, {"s": 1.0}), times=times).states


def problem_of(data, system=SYSTEM, start=0.8, runs=None, **settings):
    given = runs or sf.Experiment(data, ("a",), (), 0.0, 8.0, **settings)
    return sf.Problem(system, given, {"s": sf.Parameter(start, lower=0.1)})


def match(problem, **settings):
    library = build_library(problem, **{"max_switches": 5, "min_duration": 0.5} | settings)
    return match_derivatives(problem, library, problem.initial_theta)


def test_without_noise_times_and_parameters_are_exact_up_to_the_differences():
    found = match(problem_of(sf.Measurements(TIMES, states_of(TIMES), sigma=0.01)))
    best = found[0]
    assert best.sequences == (TRUTH,)
    np.testing.assert_allclose(best.parameters, [1.0], atol=1e-3)
    np.testing.assert_allclose(best.transition_times[0], SWITCHES, atol=0.01)
    assert sorted(len(each.sequences[0]) for each in found) == [1, 2, 3, 4, 5, 6]
    kept = [each.cost + 0.5 * np.log(162) * (len(each.sequences[0]) - 1) for each in found]
    assert kept == sorted(kept)


def test_parameters_are_estimated_from_half_their_value():
    y = states_of(TIMES) + np.random.default_rng(3).normal(size=(81, 2)) * 0.02
    best = match(problem_of(sf.Measurements(TIMES, y, sigma=0.02), start=0.5))[0]
    assert best.sequences == (TRUTH,)
    np.testing.assert_allclose(best.parameters, [1.0], atol=0.02)


@pytest.mark.parametrize("kind", ["missing", "sensor", "sigma left out", "outliers"])
def test_kinds_of_logs(kind):
    rng = np.random.default_rng(1)
    y = states_of(TIMES)
    settings = {"sigma": 0.03}
    noise = 0.03 * rng.normal(size=y.shape)
    if kind == "missing":
        values = y + noise
        values[rng.choice(81, 12, replace=False), rng.integers(0, 2, 12)] = np.nan
    elif kind == "sensor":
        H = np.array([[1.0, 2.0], [-0.5, 1.0], [0.3, 0.0]])
        values = y @ H.T + [0.0, 3.0, 0.0] + 0.03 * rng.normal(size=(81, 3))
        settings["observe"] = lambda t, x, p: jnp.asarray(H) @ x + jnp.array([0.0, 3.0, 0.0])
    elif kind == "sigma left out":
        values, settings = y + noise, {}
    else:
        values = y + noise
        values[[13, 37, 66]] += 2.0
        settings |= {"loss": "cauchy", "loss_scale": 2.0}
    best = match(problem_of(sf.Measurements(TIMES, values, **settings), start=0.9))[0]
    assert best.sequences == (TRUTH,)
    np.testing.assert_allclose(best.transition_times[0], SWITCHES, atol=0.25)


def test_intervals_with_jumps_are_left_out():
    """Doses at known times, one of them at a sample, which is before it."""
    jump = sf.Jump([1.05, 5.0], lambda t, x, p: x + jnp.array([1.5, -2.0]))
    y = states_of(TIMES, jumps=jump)
    found = match(problem_of(sf.Measurements(TIMES, y, sigma=0.01), jumps=jump))
    assert found[0].sequences == (TRUTH,)
    np.testing.assert_allclose(found[0].transition_times[0], SWITCHES, atol=0.01)
    assert match(problem_of(sf.Measurements(TIMES, y, sigma=0.01)))[0].cost > found[0].cost + 1000


def test_inputs_are_those_of_the_interval():
    """A held input jumps at a sample: the interval before it has the input before, that behind it the one behind."""
    modes = {"a": lambda t, x, p, u: u - p["s"] * x, "idle": lambda t, x, p, u: -p["s"] * x}
    system = sf.HybridSystem(modes, [0.3, 1.0])
    inputs = sf.Input([0.0, 2.0, 4.0, 6.0], [[1.0, 2.0], [-3.0, 5.0], [9.0, -6.0], [2.0, 2.0]], kind="hold")
    y = states_of(TIMES, ("a", "idle"), (7.02,), system, inputs=inputs)
    found = match(problem_of(sf.Measurements(TIMES, y, sigma=0.001), system, 1.0, inputs=inputs))
    assert found[0].sequences == (("a", "idle"),)
    assert found[0].cost < 10.0  # thousands with the input of the other interval
    np.testing.assert_allclose(found[0].transition_times[0], [7.02], atol=1e-3)


def test_several_experiments_share_parameters_and_initial_states_are_measured():
    runs = []
    for seed, (sequence, switches) in enumerate([(TRUTH, SWITCHES), (("b", "a"), (3.3,))]):
        y = states_of(TIMES, sequence, switches) + 0.02 * np.random.default_rng(seed).normal(size=(81, 2))
        log = sf.Measurements(TIMES, y, sigma=0.02)
        start = [sf.Parameter(0.0), sf.Parameter(0.0, lower=-0.2)] if seed else None
        runs.append(sf.Experiment(log, ("a",), (), 0.0, 8.0, initial_state=start))
    problem = problem_of(None, runs=runs)
    best = match(problem)[0]
    assert best.sequences == (TRUTH, ("b", "a"))
    assert best.parameters[0] == pytest.approx(1.0, abs=0.01)
    assert best.parameters[1] == pytest.approx(1.0, abs=0.1)
    assert best.parameters[2] == -0.2  # its bound


def test_what_cannot_be_matched_is_refused_with_the_reason():
    y = states_of(TIMES)
    part = sf.Measurements(TIMES, y[:, :1], lambda t, x, p: x[:1], sigma=0.1)
    curved = sf.Measurements(TIMES, y, lambda t, x, p: x**2, sigma=0.1)
    for data in (part, curved):
        problem = problem_of(data)
        with pytest.raises(ValueError, match=r"whole state.*no Measurements see the whole state at two times"):
            match(problem)
    bounce = sf.HybridSystem(SYSTEM.modes, [1.0, -0.5], {("a", "b"): lambda t, x, p: -x})
    problem = problem_of(sf.Measurements(TIMES, y, sigma=0.1), system=bounce)
    with pytest.raises(ValueError, match="'a' -> 'b' has a reset map or a guard"):
        match(problem)
    without = build_library(problem, successions={"a": ("c",), "c": ("b", "a"), "b": ("c",)})
    assert explain_no_matching(problem, without) is None
    end = problem_of(
        None,
        runs=sf.Experiment(
            sf.Measurements(TIMES[:40], y[:40], sigma=0.1), ("a",), (), 0.0, sf.Parameter(7.0, upper=8.0, lower=4.0)
        ),
    )
    assert "tf is estimated" in explain_no_matching(end, build_library(end))
