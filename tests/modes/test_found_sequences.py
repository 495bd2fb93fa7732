"""Search for the mode sequence: what is found, in which of several runs, at which cost."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from benchmarks.modes.truths import random_modes, three_modes
from support.mode_libraries import fall, rise
from support.models import first_state, one_run, refused, simulate_log
from support.turning_modes import CHAIN, FREE, SEQUENCE, SWITCHES, SYSTEM, TIMES, kinds_of, make_problem, make_run
from switchfit.engine.native.program_cache import _program_of
from switchfit.models import heater_problem
from switchfit.modes.criterion import Score, compute_weights
from switchfit.modes.fitter import Fitter
from switchfit.modes.neighbours import list_neighbours
from switchfit.modes.schedule import Schedule, space_evenly
from switchfit.strategy.library import build_library
from switchfit.uncertainty.profile_trace import limit_unknowns

SEEN: list[sf.SearchProgress] = []
"""What the search of `found` has told on its way."""


@pytest.fixture(scope="module")
def found():
    return sf.find_modes(make_problem(), max_switches=3, callback=SEEN.append)


def test_the_sequence_is_found_with_its_times_and_parameters(found):
    assert found.mode_sequence == SEQUENCE
    assert found.status is sf.ModeStatus.FOUND
    assert found.success
    np.testing.assert_allclose(found.transition_times[0], [2.5, 5.5], atol=0.1)
    assert abs(found.parameters["rate"] - 1.0) < 0.02
    assert found.best.success
    assert found.fits == SEEN[-1].fits > 3
    assert [progress.fits for progress in SEEN] == sorted(progress.fits for progress in SEEN)
    assert list(found.by_switches) == [0, 1, 2, 3]
    assert found.by_switches[2] is found.best
    run = replace(make_run(), mode_sequence=SEQUENCE, transition_times=SWITCHES)
    fit = sf.estimate(sf.Problem(SYSTEM, run, FREE))
    assert abs(found.best.cost - fit.cost) < 1e-6 * fit.cost


def test_alternatives_have_weights_and_modes_the_probabilities_of_these(found):
    criteria = [criterion for _, criterion, _ in found.alternatives]
    assert criteria == sorted(criteria) == [fit.bic for fit in found.chosen]
    assert found.alternatives[0][0] is found.best
    # Of mBIC: BIC does not count that the places of switches were searched for.
    mbic = np.array([fit.mbic for fit in found.chosen])
    assert len(mbic) > 1
    assert mbic.max() <= mbic.min() + 10.0
    expected = np.exp(-0.5 * (mbic - mbic[0]))
    np.testing.assert_allclose([w for _, _, w in found.alternatives], expected / expected.sum())
    probability = found.mode_probability([1.0, 4.0, 7.0])
    np.testing.assert_allclose(probability.sum(axis=1), 1.0)
    assert probability.argmax(axis=1).tolist() == [found.modes.index(m) for m in SEQUENCE]
    with pytest.raises(ValueError, match="t must lie inside the horizon"):
        found.mode_probability([9.0])
    with pytest.raises(ValueError, match="experiment"):
        found.mode_probability([1.0], experiment=1)


KNOWN, UNKNOWN = Score(100, True, 0.5, 1e-12, True), Score(100, False, 0.5, 1e-12, False)
DISCOUNTED = replace(KNOWN, worth=0.4, dispersion=1.5), replace(UNKNOWN, worth=0.4)


@pytest.mark.parametrize(
    ("score", "name", "expected"),
    [
        (KNOWN, "bic", 2 * 30.0 + 5 * np.log(100)),
        (KNOWN, "mbic", 2 * 30.0 + 8 * np.log(100)),
        (KNOWN, "aicc", 2 * 30.0 + 10 + 60 / 94),
        (KNOWN, "cost", 30.0 + 0.5 * 3),
        (UNKNOWN, "bic", 100 * np.log(0.6) + 6 * np.log(100)),
        (UNKNOWN, "mbic", 100 * np.log(0.6) + 9 * np.log(100)),
        (UNKNOWN, "aicc", 100 * np.log(0.6) + 12 + 84 / 93),
        (UNKNOWN, "cost", 30.0 + 0.5 * 3),
        # Correlated values are worth less, and their residuals' variance may be larger
        (DISCOUNTED[0], "mbic", 0.4 * 60.0 / 1.5 + 8 * np.log(40)),
        (DISCOUNTED[1], "mbic", 40 * np.log(0.6) + 9 * np.log(40)),
    ],
)
def test_each_criterion(score, name, expected):
    assert abs(score.compute(name, 30.0, 2, 3) - expected) < 1e-12
    assert score.compute(name, np.inf, 2, 3) == np.inf


def test_chi_square_and_weights():
    score = replace(KNOWN, values=12)
    assert abs(score.measure_probability(5.0, 2) - 0.44049) < 1e-5  # chi-square 10 with 10 degrees of freedom
    assert np.isnan(UNKNOWN.measure_probability(5.0, 2))
    assert DISCOUNTED[0].measure_probability(30.0, 5) == KNOWN.measure_probability(30.0, 5)
    assert [DISCOUNTED[0].measure_dispersion(cost, 20) for cost in (60.0, 30.0)] == [1.5, 1.0]
    assert DISCOUNTED[1].measure_dispersion(60.0, 20) == 1.0
    np.testing.assert_allclose(compute_weights([3.0, 5.0, np.inf]), [1 / (1 + np.exp(-1)), 1 / (1 + np.e), 0.0])


def test_another_sequence_and_another_log_compile_nothing():
    problem, other = make_problem(), make_problem(seed=3)
    library = build_library(problem, max_switches=3)
    before = None
    for given in (problem, other):
        fitter = Fitter(given, library)
        for sequence in (sequence for switches in range(4) for sequence in library.list_sequences(switches)):
            fitter.fit([space_evenly(sequence, 0.0, 8.0, library)], fitter.start)
            before = before or _program_of.cache_info().misses
    assert _program_of.cache_info().misses == before


@pytest.mark.slow
def test_without_machine_code_the_sequence_is_found_by_insertion():
    def spin(t, x, p):
        return jnp.linalg.eigvalsh(jnp.array([[0.0, 1.0], [1.0, 0.0]]) * p["rate"])[1] * jnp.stack([-x[1], x[0]])

    stages, system = [], sf.HybridSystem({"rise": rise, "turn": spin, "fall": fall}, [0.2, 1.0])
    found = sf.find_modes(make_problem(system=system), max_switches=3, callback=lambda now: stages.append(now.stage))
    assert found.status is sf.ModeStatus.FOUND
    assert found.mode_sequence == SEQUENCE
    assert "insertion" in stages
    assert "beam" not in stages
    assert "mode 'turn' calls jnp.linalg.eigvalsh" in str(found.best.engine)


# --- structure, several runs, costs -----------------------------------------------------------------------------------


def test_a_log_that_begins_in_the_middle_of_a_mode():
    """min_duration holds for the first and the last mode as well, as in a fit; the search says where that matters."""
    problem = sf.Problem(SYSTEM, make_run(times=(0.6, 5.0)), FREE, min_duration=2.0)
    bound = sf.find_modes(problem, max_switches=2, **CHAIN)
    assert abs(bound.transition_times[0][0] - 2.0) < 1e-6
    [warning] = kinds_of(bound.warnings, "cut off")
    assert str(warning).startswith("rise from 0 to 2 s is as short as its min_duration allows")
    free = sf.find_modes(problem, max_switches=2, min_duration={"rise": 0.0})
    assert free.mode_sequence == SEQUENCE
    np.testing.assert_allclose(free.transition_times[0], [0.6, 5.0], atol=0.1)
    assert free.best.problem.min_duration == {"rise": 0.0, "fall": 2.0, "turn": 2.0}
    assert not kinds_of(free.warnings, "cut off")


def test_a_problem_may_have_a_shortest_duration_for_each_mode():
    run = replace(make_run(), mode_sequence=SEQUENCE, transition_times=(2.0, 6.0))
    fit = sf.estimate(sf.Problem(SYSTEM, run, FREE, min_duration={"turn": 3.5}))
    assert abs(np.diff(fit.transition_times[0])[0] - 3.5) < 1e-9
    for shortest, message in (
        ({"jump": 1.0}, "min_duration names the unknown mode 'jump'"),
        ({"turn": -1.0}, "min_duration of 'turn' must be 0 or more"),
    ):
        with pytest.raises(ValueError, match=message):
            sf.Problem(SYSTEM, run, FREE, min_duration=shortest)
    limits = limit_unknowns(sf.Problem(SYSTEM, run, FREE, min_duration={"rise": 1.0, "turn": 3.5, "fall": 0.5}))
    assert [each[:2].tolist() for each in limits] == [[1.0, 4.5], [4.0, 7.5]]


def test_guarded_transitions_are_found_on_their_guards():
    """A tank fills up to a level and drains down to another; the times of both follow."""
    modes = {"fill": lambda t, x, p: p["inflow"] - 0.5 * x, "drain": lambda t, x, p: -0.5 * x}
    guards = {("fill", "drain"): lambda t, x, p: x[0] - p["high"], ("drain", "fill"): lambda t, x, p: x[0] - 0.4}
    system = sf.HybridSystem(modes, [0.2], guards=guards)
    switches = np.cumsum(2 * np.log([1.8, 2.5, 1.6, 2.5, 1.6]))  # from 0.2 to 1, to 0.4, to 1 and so on
    cost = sf.RunningCost(lambda t, x, p: x[0])
    truth = sf.Experiment(cost, ("fill", "drain") * 3, tuple(switches), 0.0, 8.0)
    values = sf.simulate(sf.Problem(system, truth, {"inflow": 1.0, "high": 1.0}), times=TIMES).states[:, 0]
    log = sf.Measurements(TIMES, values + 0.02 * np.random.default_rng(0).standard_normal(81), sigma=0.02)
    problem = one_run(system, log, ("fill",), (), 8.0, {"inflow": 1.1, "high": sf.Parameter(0.9, lower=0.5, upper=1.5)})
    found = sf.find_modes(problem, max_switches=7)
    np.testing.assert_allclose(found.transition_times[0], switches, atol=0.05)
    assert abs(found.parameters["high"] - 1.0) < 0.02
    row = found.chosen[0]
    assert abs(row.bic - (2 * row.cost + 2 * np.log(81))) < 1e-3  # their times do not count


def test_several_runs_have_sequences_of_their_own_and_share_parameters():
    runs = [make_run(name="one"), make_run(("fall", "rise"), (4.0,), seed=1, name="two")]
    found = sf.find_modes(sf.Problem(SYSTEM, runs, FREE), max_switches=3)
    assert found.mode_sequences == (SEQUENCE, ("fall", "rise"))
    assert found.status is sf.ModeStatus.FOUND
    assert list(found.best.parameters) == ["rate"]
    assert found.mode_probability([2.0], experiment=1).argmax() == found.modes.index("fall")
    with pytest.raises(ValueError, match="there are 2 experiments"):
        _ = found.mode_sequence
    assert {"one:", "two:"} <= set(str(found).split())


def test_a_running_cost_has_a_cost_of_switches_and_others_a_criterion_of_ones_own():
    cost = sf.RunningCost(lambda t, x, p: (x[0] - 0.5) ** 2)
    run, rate = sf.Experiment(cost, ("fall",), (), 0.0, 4.0), sf.Parameter(1.0, fixed=True)
    problem = sf.Problem(SYSTEM, run, {"rate": rate}, max_transitions=6)
    dear = sf.find_modes(problem, switch_cost=10.0, max_switches=4)
    cheap = sf.find_modes(problem, switch_cost=1e-3, max_switches=4)
    assert dear.chosen[0].switches == 0
    row = cheap.chosen[0]
    assert row.switches > 0
    assert abs(row.criterion - (row.cost + 1e-3 * row.switches)) < 1e-6
    assert "J + cost of switches" in str(cheap)
    assert len(cheap.plot().axes) == 3
    few = sf.find_modes(make_problem(), max_switches=2, criterion=lambda fit: 2 * fit.cost + 1e9 * len(fit.theta))
    assert few.chosen[0].switches == 0


def test_parameters_far_off_are_found_from_other_starts():
    far = replace(make_problem(), parameters={"rate": sf.Parameter(2.2, lower=0.1, upper=3.0)})
    assert sf.find_modes(far, max_switches=3).mode_sequence == SEQUENCE
    assert sf.find_modes(far, max_switches=3, starts=[[1.1]]).mode_sequence == SEQUENCE


# --- what is refused --------------------------------------------------------------------------------------------------


test_wrong_settings_are_refused = refused(
    ({"library": ("rise", "jump")}, "library names the unknown mode 'jump'; the modes are"),
    ({"library": ()}, "library is empty"),
    ({"first": ()}, "first is empty"),
    ({"successions": {"rise": "jump"}}, "successions of 'rise' names the unknown mode 'jump'"),
    ({"successions": {"rise": "rise"}}, "names the mode itself"),
    ({"min_duration": -1.0}, "min_duration must be 0 or more; got -1.0"),
    ({"min_duration": 9.0}, "leaves no room"),
    ({"width": 2}, "width must be 3 or more; got 2"),
    ({"criterion": "aic"}, "criterion must be one of"),
    ({"criterion": "cost"}, "criterion='cost' needs switch_cost"),
    ({"criterion": "mbic", "switch_cost": 1.0}, "switch_cost is the cost of a switch for criterion='cost'"),
    ({"switch_cost": -1.0}, "switch_cost must be zero or positive"),
    ({"method": "guess"}, "method must be 'auto', 'beam' or 'insertion'"),
    ({"starts": [[1.0, 2.0]]}, "starts must have a row for each start with 1 finite values"),
    by=lambda arguments: sf.find_modes(make_problem(), **arguments),
)


BOUNDED = {"mode_sequence": ("rise", "fall"), "transition_times": (sf.Parameter(3.0, lower=1.0),)}


test_problems_that_cannot_be_searched_are_refused = refused(
    ({"data": sf.RunningCost(lambda t, x, p: x[0] ** 2)}, r"is no likelihood\. Give switch_cost"),
    (BOUNDED, "transition time 1 of run1 is fixed, or has bounds"),
    by=lambda changes: sf.find_modes(sf.Problem(SYSTEM, replace(make_run(), **changes), FREE)),
    error=ValueError,
)


# --- statistics -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_random_truths_are_found_and_never_something_else_called_found(optimised_machine_code):
    """Nor is anything, where a mode is missing."""
    right = same = wrong = 0
    for seed in range(100):
        truth = three_modes(seed)
        found = sf.find_modes(truth.problem, ("A", "B", "C"), criterion="mbic")
        right += found.chosen[0].switches == 5
        same += found.mode_sequence == truth.sequence
        wrong += found.success and found.mode_sequence != truth.sequence
    assert right >= 99
    assert same >= 99
    assert wrong == 0
    for seed in range(1000, 1010):
        missing = sf.find_modes(three_modes(seed).problem, ("A", "B"))
        assert missing.status is sf.ModeStatus.NOT_EXPLAINED


def test_the_best_is_the_lowest_among_the_sample_intervals():
    """Two transitions have to move by intervals at once: hops of one at a time end at 111.4595, 0.07 too high."""
    truth = random_modes(400)
    found = sf.find_modes(truth.problem, criterion="mbic", **truth.settings)
    assert found.mode_sequence == truth.sequence
    assert found.best.cost <= truth.fit_from_truth().cost + 1e-6


def test_all_neighbours_of_what_is_found_are_fitted():
    """Every sequence with two modes exchanged, one replaced, left out or put in; exchanged in two ways."""
    library = build_library(heater_problem(), max_switches=3)
    neighbours = list(list_neighbours(Schedule(("on", "off"), np.array([2.0]), 0.0, 6.0), library))
    names = {"-".join(changed.sequence) for changed in neighbours}
    assert names == {"off-on", "on", "off", "on-off-on", "off-on-off", "on-off-on-off"}
    assert [changed.times.tolist() for changed in neighbours if changed.switches == 1] == [[4.0], [2.0]]


def test_costs_of_modes_with_corners_are_those_of_an_estimate():
    """A block that is driven, and comes to rest by dry friction."""

    def drive(t, x, p):
        return jnp.stack([x[1], p["a"] - 0.5 * x[1]])

    def brake(t, x, p):
        return jnp.stack([x[1], -p["b"] * jnp.sign(x[1])])

    system = sf.HybridSystem({"drive": drive, "brake": brake}, [0.0, 0.0])
    log, truth = sf.Measurements(TIMES[1:], np.zeros(80), first_state, sigma=0.02), ("drive", "brake") * 2
    parameters = {"a": 1.2, "b": sf.Parameter(0.6, lower=0.0)}
    given = simulate_log(one_run(system, log, truth, (2.0, 4.0, 6.0), 8.0, parameters), [2.0, 4.0, 6.0, 1.0, 1.1], 0)
    search = sf.find_modes(given.with_sequences([("drive",)], [()]), max_switches=4)
    assert (search.status, search.mode_sequence) == (sf.ModeStatus.FOUND, truth)
    for fitted in search.fitted:
        own = given.with_sequences(fitted.sequences, fitted.transition_times)
        theta = np.concatenate([*fitted.transition_times, fitted.parameters])
        assert fitted.cost == pytest.approx(sf.evaluate(own, theta).cost, rel=1e-6)
