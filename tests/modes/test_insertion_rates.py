"""The insertion rate: dJ/d(length of a pulse), against derivatives of sequences with that pulse; proposals."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.models import FISHING, LATE_RAMP, RAMP, fishing
from support.swings import BOUNCE, DATA, GUARDS, MODES, MORE, problem, samples
from switchfit.meshes.evaluator import Evaluator
from switchfit.modes.criterion import Score
from switchfit.modes.fitter import Fitter
from switchfit.modes.moves import Improver
from switchfit.modes.pool import Pool
from switchfit.modes.pulses import insert_modes, list_pulses
from switchfit.modes.rates import add_all_modes, compute_rates
from switchfit.modes.schedule import Schedule
from switchfit.strategy.library import build_library


def between(mu):
    """A cost of the transition of the sequence that a pulse of rest does not add another time."""
    return sf.TransitionCost(mu, before="swing", after="fall")


KINDS = {
    "late, robust, transitions, end": [
        DATA["late, robust"],
        between(lambda t, x, p: p["k"] * x[0] ** 2 * x[1] + (t - 1.2) ** 2 * x[1]),
        sf.TerminalCost(lambda x, p: p["k"] * x[0] ** 2 * x[1]),
    ],
    "reference, running": DATA["reference, running"],
    "samples": samples(),
}


def driven(data):
    """Modes with an input that jumps at its knots, which are rows' starts."""
    modes = {
        "pushed": lambda t, x, p, u: jnp.array([x[1] + u, -p["k"] * x[0] * u]),
        "free": lambda t, x, p, u: jnp.array([x[1], -p["g"] * x[1] + u**2 * x[0]]),
        "still": lambda t, x, p, u: jnp.array([-u * x[1], 0.3 * t]),
    }
    inputs = sf.Input([0.0, 0.5, 1.0, 2.0, 3.0], [1.0, -2.0, 0.7, 1.9, 0.4], kind="hold")
    run = sf.Experiment(data, ("pushed", "free", "pushed"), (1.1, 2.3), 0.0, 3.0, inputs=inputs)
    return sf.Problem(sf.HybridSystem(modes, [0.4, 0.1]), run, {"k": 1.2, "g": 0.8}, rtol=1e-11, atol=1e-13)


def dosed():
    """Rows after a jump have the costate behind it; there are none after tf."""
    dose = sf.Jump([0.2, 1.0], lambda t, x, p: jnp.array([x[0] * x[1], x[1] - 0.2 * p["k"]]))
    costs = [sf.RunningCost(lambda t, x, p: x[0] ** 2), sf.TerminalCost(lambda x, p: x[0] ** 2 + p["k"] * x[1])]
    tf = sf.Parameter(2.5, upper=3.0)
    run = sf.Experiment(costs, ("swing", "fall"), (1.1,), 0.0, tf, jumps=dose)
    return sf.Problem(sf.HybridSystem(MODES, [0.4, 0.1]), run, {"k": 1.2, "g": 0.8}, rtol=1e-11, atol=1e-13)


def rates_of(given):
    """The rates, and the meshes that they were computed on."""
    whole = add_all_modes(given)
    evaluator = Evaluator(whole, given.initial_theta)
    return compute_rates(evaluator, given.initial_theta), evaluator.meshes


def with_pulse(given, e, mode, time):
    """The problem and theta with a pulse of no length behind the transitions up to `time`, and its end's place."""
    run, theta = given.experiments[e], given.initial_theta
    tau = theta[given.unknowns.times[e]]
    i = int(np.searchsorted(tau, time, "right"))
    sequence = [*run.mode_sequence[: i + 1], mode, *run.mode_sequence[i:]]
    count = len(run.transition_times)
    times = np.concatenate([np.insert(tau[:count], i, [time, time]), tau[count:]])
    guess = tuple(np.sort(times[: count + 2]) + 1e-4 * np.arange(1, count + 3))
    runs = list(given.experiments)
    runs[e] = replace(run, mode_sequence=sequence, transition_times=guess)
    longest = max(len(r.transition_times) + len(r.jump_times) for r in given.experiments)
    more = replace(given, experiments=runs, max_transitions=longest + 2)
    where, at = more.unknowns.times[e], np.zeros(len(more.theta_names))
    at[np.setdiff1d(np.arange(len(at)), where)] = np.delete(theta, given.unknowns.times[e])
    at[where] = times
    return more, at, int(where[i + 1])


def derivative(given, meshes, e, mode, time):
    """dJ/d(length) of a pulse, as the gradient in the second of two equal transition times."""
    more, theta, place = with_pulse(given, e, mode, time)
    return Evaluator(more, meshes=meshes)(theta).gradient[place]


CASES = {name: lambda data=data: problem(data, parameters=MORE, rtol=1e-11, atol=1e-13) for name, data in KINDS.items()}
CASES["inputs"] = lambda: driven(samples())
CASES["jumps, free tf"] = lambda: dosed()
SLOW = ("reference, running", "jumps, free tf")
CHOSEN = [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in CASES]


@pytest.mark.parametrize("name", CHOSEN)
def test_rates_are_derivatives_of_sequences_with_a_pulse_of_no_length(name):
    given = CASES[name]()
    (found,), meshes = rates_of(given)
    scale = np.nanmax(abs(found.rate))
    knots = {0.5, 1.0, 2.0} if name == "inputs" else {0.2, 1.0, 2.4}
    rows = [r for r, t in enumerate(found.times) if any(abs(t - knot) < 1e-9 for knot in (0.0, 1.1, 2.3, *knots))]
    assert len(rows) >= 4
    rows += [*(r - 1 for r in rows[1:]), 1, len(found.times) // 2, len(found.times) - 1]  # also before a knot
    compared = 0
    for r in rows:
        assert found.rate[r, found.active[r]] == 0.0
        for k in set(np.flatnonzero(np.isfinite(found.rate[r]))) - {found.active[r]}:
            expected = derivative(given, meshes, 0, found.modes[k], found.times[r])
            assert found.rate[r, k] == pytest.approx(expected, abs=2e-8 * scale)
            compared += abs(expected) > 1e-3 * scale
    assert compared >= 8


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "samples")) for name in CASES])
def test_engines_agree(name):
    """On two runs, each of which has its own rates."""
    one = CASES[name]()
    given = replace(one, experiments=[*one.experiments, replace(one.experiments[0], name="second")])
    native = Evaluator(add_all_modes(replace(given, engine="native")))
    by_jax = Evaluator(add_all_modes(replace(given, engine="jax")), meshes=native.meshes)
    theta = given.initial_theta
    theta[given.unknowns.times[1][0]] -= 0.05
    for found, expected in zip(compute_rates(native, theta), compute_rates(by_jax, theta), strict=True):
        np.testing.assert_array_equal(found.times, expected.times)
        np.testing.assert_array_equal(found.active, expected.active)
        np.testing.assert_allclose(found.rate, expected.rate, rtol=1e-10, atol=1e-11 * np.nanmax(abs(found.rate)))


@pytest.mark.parametrize("system", [None, sf.HybridSystem(MODES, [0.4, 0.1], guards=GUARDS)], ids=["reset", "guard"])
def test_rates_are_not_defined_where_a_pulse_would_end_with_a_reset_map_or_guard(system):
    """A bounce from falling to swinging: a pulse of falling in swinging would end with it, one of resting would not."""
    found = sf.insertion(problem(samples(), **({} if system is None else {"system": system})))
    names = np.array(found.modes)[found.active]
    swing, fall, rest = (found.rate[:, found.modes.index(mode)] for mode in ("swing", "fall", "rest"))
    np.testing.assert_array_equal(np.isnan(fall), names == "swing")
    assert np.isfinite(rest).all()
    if system is None:
        np.testing.assert_array_equal(np.isnan(swing), names == "fall")


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_guards_move_with_the_pulse(engine):
    """tau_1 follows the guard: the rate is the derivative of J along it, which multipliers of the Lagrangian give."""
    system = sf.HybridSystem(MODES, [0.4, 0.1], BOUNCE, guards=GUARDS)
    fixed = {name: sf.Parameter(value, fixed=True) for name, value in (("k", 1.2), ("g", 0.8))}
    run = sf.Experiment(samples(), ("swing", "fall"), (1.1,), 0.0, 3.0)
    given = sf.Problem(system, run, fixed, rtol=1e-11, atol=1e-13, engine=engine)

    def solve(given, theta):
        """Newton's method on the guard."""
        for _ in range(20):
            at = sf.evaluate(given, theta)
            theta = theta - at.constraints[0] / at.jacobian[0, 0]
        assert abs(sf.evaluate(given, theta).constraints[0]) < 1e-12
        return theta

    theta = solve(given, np.array([0.9]))
    found = sf.insertion(given, theta)
    r = int(np.argmin(abs(found.times - 0.4)))
    costs = []
    for length in (1e-9, 2e-4, 4e-4):
        pulse = [sf.Parameter(found.times[r] + s, fixed=True) for s in (0.0, length)]
        longer = replace(run, mode_sequence=("swing", "rest", "swing", "fall"), transition_times=(*pulse, theta[0]))
        pulsed = replace(given, experiments=longer, engine="auto")
        costs.append(sf.evaluate(pulsed, solve(pulsed, theta)).cost)
    slope = (4 * costs[1] - 3 * costs[0] - costs[2]) / 4e-4
    assert found.rate[r, found.modes.index("rest")] == pytest.approx(slope, rel=1e-4)


# Proposals where the rate is lowest, and the search from an empty schedule


EMPTY = Schedule(("idle",), np.zeros(0), 0.0, 12.0)
TWO = Schedule(("idle", "fishing", "idle"), np.array([2.6, 4.34]), 0.0, 12.0)
NONE = np.zeros(0)


def search(given, schedules, parameters=NONE, **settings):
    """Return the best fit for each number of switches, and how many were fitted."""
    fitter = Fitter(given, build_library(given, **settings))
    improver = Improver(fitter, Pool(Score.of(given, 0.0), "cost"), lambda what: None)
    insert_modes(improver, schedules, parameters)
    return improver.pool.by_switches, fitter.fits


def rate(given, schedule, **settings):
    """Return the insertion rate of a schedule."""
    fitter = Fitter(given, build_library(given, **settings))
    (found,) = compute_rates(fitter.get_evaluator([schedule]), schedule.times)
    return found


def pulses(given, schedules, parameters=NONE, library=None, **settings):
    return list_pulses(Fitter(given, build_library(given, library, **settings)), schedules, parameters)


def cost_of(given, schedule):
    """J of a schedule on a mesh of its own."""
    own = given.with_sequences([schedule.sequence], [schedule.times])
    return Evaluator(own, schedule.times).cost(schedule.times)


def test_a_problem_to_search_may_have_nothing_to_estimate():
    given = fishing((), max_transitions=10)
    assert sf.evaluate(given).cost == pytest.approx(6.062277, abs=1e-6)
    assert sf.simulate(given).states.shape[1] == 2
    calls = sf.estimate, sf.check_derivatives, lambda p: sf.multistart(p, 3), lambda p: sf.monte_carlo(p, 3)
    for call in (*calls, lambda p: sf.estimate_many([p])):
        with pytest.raises(ValueError, match=r"Nothing to estimate.*set max_transitions"):
            call(given)


def test_proposals_lower_j_as_the_rate_says():
    given = fishing((), max_transitions=10)
    found = pulses(given, [TWO], max_switches=10)
    changes, compared = [change for change, _ in found], 0
    assert changes == sorted(changes)
    assert changes[-1] < 0
    assert {schedule.sequence.count("fishing") for _, [schedule] in found} == {2}
    for change, [schedule] in found:
        begin, end = np.append(np.setdiff1d(schedule.times, TWO.times), 12.0)[:2]  # the last ends with the horizon
        assert np.isclose(end - begin, [0.02 * 12.0, 0.1 * 12.0, 0.75 * 1.74]).any()
        if len(schedule.sequence) == 5:
            short = TWO.replace(schedule.sequence, np.where(schedule.times == end, begin + 1e-3, schedule.times))
            fell = cost_of(given, short) - cost_of(given, TWO)
            assert fell == pytest.approx(change / (end - begin) * 1e-3, rel=2e-2)
            compared += 1
    assert compared >= 3


def test_a_library_is_respected():
    given = fishing((), max_transitions=10)
    found = pulses(given, [TWO], max_switches=3)
    assert {each.sequence for _, [each] in found} == {("idle", "fishing", "idle", "fishing")}  # inside it takes four
    assert pulses(given, [EMPTY], library=("idle",), max_switches=10) == []
    for _, [each] in pulses(given, [TWO], max_switches=10, min_duration={"fishing": 2.0}):
        pairs = zip(each.durations, each.sequence, strict=True)
        assert all(lasted >= 2.0 for lasted, mode in pairs if mode == "fishing")
    assert all(each.sequence[-1] == "idle" for _, [each] in pulses(given, [TWO], max_switches=10, last="idle"))


def test_rates_beside_jumps_and_collapsed_modes():
    jump = sf.Jump([5.9], lambda t, x, p: x + jnp.array([0.3, 0.0]))
    run = replace(fishing((6.0,)).experiments[0], jumps=jump)
    given = sf.Problem(FISHING, run, min_duration=0.5)
    close = Schedule(("idle", "fishing", "idle", "fishing"), np.array([3.0, 3.6, 4.2]), 0.0, 12.0)
    assert rate(given, close).trajectory.jump_times.tolist() == [5.9]
    gone = Schedule(TWO.sequence, np.array([3.0, 3.0]), 0.0, 12.0)
    found, expected = (rate(fishing((), max_transitions=10), each).best() for each in (gone, EMPTY))
    assert found[0] == expected[0]
    assert found[1] == pytest.approx(expected[1], abs=0.5)


def test_fishing_from_the_empty_schedule():
    """J by the number of switches is that of published times."""
    found, fits = search(fishing((), max_transitions=10), [EMPTY], max_switches=10)
    table = {0: 6.062277, 1: 3.136445, 2: 1.382755, 4: 1.349674, 6: 1.346318, 8: 1.345295218, 10: 1.344846158}
    assert {switches: found[switches].cost for switches in table} == pytest.approx(table, abs=1e-6, rel=0)
    assert fits < 200


def test_two_experiments_with_shared_parameters():
    """A pulse is inserted in the run that lacks it."""
    times = np.linspace(0.0, 4.0, 21)

    def run(begin, end, sequence, switches):
        log = sf.Measurements(times, 0.9 * np.clip(times - begin, 0.0, end - begin), sigma=0.05)
        return sf.Experiment(log, sequence, switches, 0.0, 4.0)

    pulse = ("rest", "up", "rest")
    given = sf.Problem(RAMP, [run(1.0, 2.0, pulse, (1.0, 2.0)), run(1.5, 3.0, ("rest",), ())], {"v": 0.9})
    pair = [Schedule(pulse, np.array([1.0, 2.0]), 0.0, 4.0), Schedule(("rest",), NONE, 0.0, 4.0)]
    _, best = pulses(given, pair, np.array([0.9]), max_switches=4)[0]
    assert [schedule.sequence for schedule in best] == [pulse] * 2
    np.testing.assert_array_equal(best[0].times, [1.0, 2.0])
    ends, _ = search(given, pair, np.array([0.9]), max_switches=4)
    np.testing.assert_allclose(ends[4].schedules[1].times, [1.5, 3.0], atol=1e-3)


# Text and figure


def test_the_report_names_the_best_pulse_or_says_that_there_is_none():
    found = sf.insertion(fishing((2.6, 4.34)))
    mode, time = found.best()
    assert (mode, time) == (found.minima()[0].mode, found.minima()[0].time)
    assert str(found).startswith(f"A short pulse of fishing at {time:.6g} s lowers J fastest: by 0.2727 per s of its l")
    assert len(found.plot().axes) == 1
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: x[0] ** 2), ("wait",), (), 0.0, 2.0)
    nothing = sf.insertion(sf.Problem(LATE_RAMP, run, max_transitions=1))
    assert (nothing.best(), nothing.minima()) == (None, [])
    assert str(nothing) == "No short pulse of any mode lowers J."


def test_minima_are_local_ones():
    rate = np.array([[0.0, -1.0], [-2.0, -3.0], [-2.0, np.nan], [-1.0, -2.0], [-4.0, -5.0], [0.5, -0.5]])
    found = sf.insertion(fishing((2.6, 4.34)))
    found = replace(found, times=np.arange(6.0), rate=rate, active=np.zeros(6, dtype=int))
    minima = [("fishing", 4.0, -5.0), ("idle", 4.0, -4.0), ("fishing", 1.0, -3.0), ("idle", 2.0, -2.0)]
    assert [(p.mode, p.time, p.rate) for p in found.minima()] == minima
    assert [p.rate for p in found.minima(1)] == [-5.0, -4.0]
