"""Search for the mode sequence: what is found, how the search ends, what is refused, what is saved."""

from __future__ import annotations

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from benchmarks.modes.truths import random_modes, three_modes
from support.mode_libraries import fall, pull, rise
from support.models import first_state, one_run, refused, simulate_log
from switchfit.engine.native.program_cache import _program_of
from switchfit.models import heater_problem
from switchfit.modes import certifier
from switchfit.modes.criterion import Score, compute_weights
from switchfit.modes.fitter import Fitter
from switchfit.modes.neighbours import list_neighbours
from switchfit.modes.schedule import Schedule, space_evenly
from switchfit.strategy.library import build_library
from switchfit.uncertainty.profile_trace import limit_unknowns

TIMES = np.linspace(0.0, 8.0, 81)
SIGMA = 0.05
FREE = {"rate": sf.Parameter(0.8, lower=0.1, upper=3.0)}


def turn(t, x, p):
    return p["rate"] * jnp.stack([-x[1], x[0]])


SYSTEM = sf.HybridSystem({"rise": rise, "fall": fall, "turn": turn}, [0.2, 1.0])


SEQUENCE, SWITCHES = ("rise", "turn", "fall"), (2.5, 5.5)


def simulate(sequence=SEQUENCE, times=SWITCHES, seed=0, sigma=SIGMA, system=SYSTEM, force=5.0):
    """Values of both states with noise, rate being 1."""
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: x[0]), sequence, times, 0.0, 8.0)
    problem = sf.Problem(system, run, {"rate": 1.0, "force": force}, max_transitions=3)
    states = sf.simulate(problem, times=TIMES).states
    return states + sigma * np.random.default_rng(seed).standard_normal(states.shape)


def make_run(
    sequence=SEQUENCE, times=SWITCHES, seed=0, name=None, given=("rise",), values=None, at=TIMES, start=None, **log
):
    values = simulate(sequence, times, seed) if values is None else values
    data = sf.Measurements(at, values, **({"sigma": SIGMA} | log))
    return sf.Experiment(data, given, (), 0.0, 8.0, initial_state=start, name=name)


def make_problem(*, system=SYSTEM, parameters=FREE, **changes):
    return sf.Problem(system, make_run(**changes), parameters)


def kinds_of(warnings, kind):
    return [warning for warning in warnings if warning.kind == kind]


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


# --- how a search ends ------------------------------------------------------------------------------------------------


CHAIN = {"first": "rise", "last": "fall", "successions": {"rise": "turn", "turn": "fall"}}


@pytest.mark.parametrize(("sigma", "reason"), [(SIGMA, "chi-square"), (None, "correlated residuals")])
def test_a_missing_mode_is_not_explained(sigma, reason):
    """Off by so much that nothing says what the values are worth: none are discounted."""
    missing = sf.find_modes(make_problem(sigma=sigma), ("rise", "fall"), max_switches=3)
    assert missing.status is sf.ModeStatus.NOT_EXPLAINED
    assert missing.ending.reason == reason
    assert {"discounted", "outliers"}.isdisjoint(warning.kind for warning in missing.warnings) or sigma is None


def test_a_fit_that_does_not_converge_is_said_to_be_so(monkeypatch):
    fit = certifier.fit_locally
    begin = lambda problem, start: fit(problem, start=start + 0.01, max_iterations=0)  # noqa: E731
    monkeypatch.setattr(certifier, "fit_locally", begin)
    found = sf.find_modes(make_problem(), max_switches=3)
    assert found.status is sf.ModeStatus.NOT_CONVERGED
    assert found.best.message in found.message


def test_a_parameter_of_an_absent_mode_is_held_without_a_standard_error():
    system = sf.HybridSystem({"rise": rise, "fall": fall, "pull": pull}, [0.2, 1.0])
    values = simulate(("rise", "fall"), (3.0,), system=system)
    problem = make_problem(system=system, parameters=FREE | {"force": 4.0}, values=values)
    found = sf.find_modes(problem, max_switches=3)
    assert found.mode_sequence == ("rise", "fall")
    assert found.status is sf.ModeStatus.FOUND
    [note] = found.warnings
    assert str(note) == "force acts in modes that do not occur: it keeps its guess, without a standard error."
    assert found.best.fixed == ("force",)
    assert found.parameters["force"] == 4.0
    row = found.chosen[0]
    assert abs(row.bic - (2 * row.cost + 2 * np.log(162))) < 1e-4  # force does not count


def test_entries_of_an_array_that_modes_do_not_read_are_held():
    system = sf.HybridSystem({name: lambda t, x, p, k=k: -p["k"][k] * x for k, name in enumerate("abc")}, [0.2, 1.0])
    rates = sf.Parameter([1.0, 2.0, 3.0], prior=sf.Normal(2.5, 0.5))  # which would move them to its mean
    problem = sf.Problem(system, make_run(given=("a",)), {"k": rates})
    library = build_library(problem, max_switches=2)
    fitter = Fitter(problem, library)
    assert fitter.find_acting((("a", "c"),)).tolist() == [True, False, True]
    fitted = fitter.fit([space_evenly(("a", "c"), 0.0, 8.0, library)], np.array([0.9, 2.2, 3.1]))
    assert fitted.parameters[1] == 2.2
    assert np.isfinite(fitted.cost)


@pytest.mark.parametrize("how", ["callback", "Ctrl-C"])
def test_an_interrupted_search_returns_the_best_so_far(how):
    seen = []

    def stop(progress):
        seen.append(progress)
        if progress.sequences and how == "Ctrl-C":
            raise KeyboardInterrupt
        return bool(progress.sequences)

    found = sf.find_modes(make_problem(), max_switches=3, callback=stop)
    assert found.status is sf.ModeStatus.INTERRUPTED
    assert found.mode_sequences == seen[-1].sequences
    assert found.best.cost < seen[-1].cost * (1 + 1e-4)
    with pytest.raises(KeyboardInterrupt):  # before anything is found
        sf.find_modes(make_problem(), max_switches=3, callback=lambda progress: True)


@pytest.mark.parametrize("sigma", [SIGMA, None])
def test_modes_that_make_up_for_correlated_noise_do_not_win(sigma):
    """As they stand, BIC and mBIC want more switches; n correlated values are not worth n independent ones."""
    clean = simulate(sigma=0.0)
    noise = 0.6 * np.random.default_rng(2).standard_normal(clean.shape)  # and 0.8 of the one before: variance 1
    for i in range(1, len(noise)):
        noise[i] += 0.8 * noise[i - 1]
    found = sf.find_modes(make_problem(values=clean + SIGMA * noise, sigma=sigma), max_switches=4)
    assert min(found.fitted, key=lambda fit: fit.bic).switches == 4
    assert found.mode_sequence == SEQUENCE
    assert found.status is sf.ModeStatus.NOT_EXPLAINED
    [note] = kinds_of(found.warnings, "discounted")
    assert note.samples < 60
    assert "2 switches by the discounted mBIC" in str(note)
    assert np.all(found.best.corrected_standard_errors > 1.5 * found.best.standard_errors)
    assert "Standard errors allow for the correlation of the residuals." in str(found)


def test_no_sequence_at_all_is_said_to_be_so():
    found = sf.find_modes(make_problem(), max_switches=1, **CHAIN)
    assert found.status is sf.ModeStatus.NO_SUCCESSION
    assert found.best is None
    assert str(found).startswith("No succession")
    with pytest.raises(ValueError, match="no mode sequence was found"):
        _ = found.mode_sequence


def test_a_mode_of_few_samples_is_warned_of():
    values = simulate(("rise", "turn", "rise"), (3.0, 3.25), sigma=0.002)
    found = sf.find_modes(make_problem(values=values, sigma=0.002), max_switches=3)
    assert found.mode_sequence == ("rise", "turn", "rise")
    [warning] = kinds_of(found.warnings, "short segment")
    assert warning.mode == "turn"
    assert warning.samples < 5
    assert "it may make up for an error of the model" in str(warning)


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


def spoil(values, kind):
    """Outliers of 2 in every ninth sample, or 30 % of the values missing."""
    if kind == "outliers":
        values[::9] += np.random.default_rng(1).choice([-2.0, 2.0], values[::9].shape)
    else:
        values[np.random.default_rng(0).random(values.shape) < 0.3] = np.nan
    return values


NOISE, DELAY = {"s": sf.Parameter(0.1, lower=0.001, upper=2.0)}, {"d": sf.Parameter(0.9, lower=0.5, upper=1.0)}
UNREAD = "unused acts in no mode of the library, and cannot be estimated. Fix it"
ENDINGS = {
    "as many switches as allowed": (lambda: {}, {"max_switches": 2}, "AT_LIMIT", "Raise max_switches"),
    "no sequence has more": (lambda: {}, {"max_switches": 2} | CHAIN, "FOUND", ""),
    "a parameter that nothing reads": (lambda: {"parameters": FREE | {"unused": 4.0}}, {}, "UNIDENTIFIED", UNREAD),
    "no noise": (lambda: {"values": simulate(sigma=0.0)}, {}, "FOUND", ""),
    "outliers": (lambda: {"values": spoil(simulate(), "outliers"), "loss": "huber"}, {}, "FOUND", ""),
    "unknown initial state": (lambda: {"start": [sf.Parameter(0.5), sf.Parameter(0.5)]}, {}, "FOUND", ""),
    "sigma is a parameter": (lambda: {"sigma": "s", "parameters": FREE | NOISE}, {}, "FOUND", ""),
    "logarithmic scale": (lambda: {"parameters": {"rate": sf.Parameter(0.8, scale="log")}}, {}, "FOUND", ""),
    "missing values": (lambda: {"values": spoil(simulate(), "missing")}, {}, "FOUND", ""),
    "unknown delay": (
        lambda: {"at": TIMES[10:], "values": simulate()[:-10], "delay": "d", "parameters": FREE | DELAY},
        {}, "FOUND", "",
    ),
}  # fmt: skip
"""What sets a problem apart, and a search; how it ends, and what it says."""


@pytest.mark.parametrize("how", ENDINGS)
def test_how_a_search_ends(how):
    build, settings, status, said = ENDINGS[how]
    found = sf.find_modes(make_problem(**build()), **({"max_switches": 3} | settings))
    assert (found.status, found.mode_sequence) == (sf.ModeStatus[status], SEQUENCE)
    np.testing.assert_allclose(found.transition_times[0], [2.5, 5.5], atol=0.2)
    assert said in found.message


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


def test_a_hidden_switch_is_refused():
    late = {"late": lambda t, x, p: jnp.where(t < p["rate"], jnp.ones(2), jnp.zeros(2))}
    problem = make_problem(system=sf.HybridSystem({"rise": rise} | late, [0.2, 1.0]), given=("late",))
    with pytest.raises(ValueError, match=r"mode .late. compares with rate at test_modes.py"):
        sf.find_modes(problem, "late", max_switches=0)


# --- saving, reports --------------------------------------------------------------------------------------------------


@pytest.fixture
def saved(found, tmp_path):
    found.save(tmp_path / "modes.json")
    return tmp_path / "modes.json"


def test_a_search_is_saved_and_loaded(found, saved):
    loaded = sf.ModeSearch.load(saved)
    assert str(loaded) == str(found)
    assert (loaded.ending, loaded.warnings) == (found.ending, found.warnings)
    t = np.linspace(0.0, 8.0, 33)
    np.testing.assert_array_equal(loaded.mode_probability(t), found.mode_probability(t))
    with pytest.raises(ValueError, match="was loaded without its model"):
        loaded.by_switches[0]
    whole = sf.ModeSearch.load(saved, problem=make_problem())
    assert abs(whole.by_switches[1].cost - found.by_switches[1].cost) < 1e-9
    assert whole.best.predict([1.0]).outputs.shape == (1, 2)


def test_files_of_other_kinds_are_refused(saved):
    other = sf.Problem(SYSTEM, make_run(name="other"), FREE)
    for problem, message in ((heater_problem(), "it is another problem's"), (other, "holds the runs")):
        with pytest.raises(ValueError, match=message):
            sf.ModeSearch.load(saved, problem=problem)
    content = json.loads(saved.read_text())
    for changes, message in (
        ({"format": "switchfit fit"}, "is not a saved search"),
        ({"version": 1}, "of version 1; this switchfit reads version 5"),
        ({"search": content["search"] | {"fits": "many"}}, "is damaged"),
    ):
        saved.write_text(json.dumps(content | changes))
        with pytest.raises(ValueError, match=message):
            sf.ModeSearch.load(saved)


def test_the_report_and_the_figure_have_the_sequence_and_the_criteria(found):
    assert str(found).startswith("Found: rise -> turn -> fall.")
    [line] = [line for line in str(found).splitlines() if line.lstrip().startswith("*")]
    assert line.split()[1] == "2"
    numbers, _, probabilities = found.plot().axes
    assert [line.get_label() for line in numbers.lines[:3]] == ["BIC", "mBIC", "AICc"]
    assert [text.get_text() for text in probabilities.get_legend().get_texts()] == ["rise", "fall", "turn"]


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


def test_modes_that_can_take_each_other_s_place_are_said_to_do_so():
    """No data decide which is which: with k_a and k_b exchanged, the curve is the same."""
    times = np.arange(0.0, 30.0)
    values = np.exp(-0.1 * np.minimum(times, 10.0) - 0.02 * np.maximum(times - 10.0, 0.0))
    data = sf.Measurements(times, values + 0.01 * np.random.default_rng(1).normal(size=30), sigma=0.01)
    system = sf.HybridSystem({name: lambda t, x, p, k=f"k_{name}": -p[k] * x for name in "ab"}, [1.0])
    rates = {name: sf.Parameter(0.05, lower=0.0) for name in ("k_a", "k_b")}
    problem = sf.Problem(system, sf.Experiment(data, ("a", "b"), (12.0,)), rates)
    found, named = sf.find_modes(problem, max_switches=2), sf.find_modes(problem, max_switches=2, first=["a"])
    assert found.status is sf.ModeStatus.AMBIGUOUS
    assert "which is the same with other values of the parameters" in " ".join(str(found).split())
    assert (named.status, named.mode_sequence) == (sf.ModeStatus.FOUND, ("a", "b"))


def fill_tanks(pump, valve):
    """Return the levels' rates: a pump fills the upper tank, a valve lets it run into the lower one, which leaks."""

    def rates(t, x, p):
        flow = valve * p["c"] * jnp.sqrt(jnp.maximum(x[0], 1e-6))
        return jnp.stack([pump * p["q"] - flow, flow - p["d"] * x[1]])

    return rates


TANKS = {"closed": (0, 0), "fill": (1, 0), "open": (0, 1), "fill_open": (1, 1)}
LEAKING = {"c": 0.35, "q": 0.5, "d": 0.25}


def search_tanks(sequence, times, library=tuple(TANKS)):
    """Search a log of the lower level, with 1 cm of noise at 10 Hz, for what pump and valve have done."""
    at = np.round(np.arange(0.1, 20.05, 0.1), 6)
    system = sf.HybridSystem({name: fill_tanks(*acts) for name, acts in TANKS.items()}, [1.0, 0.3])
    truth = sf.Experiment(sf.RunningCost(lambda t, x, p: x[0]), sequence, times, 0.0, 20.0)
    states = sf.simulate(sf.Problem(system, truth, LEAKING), times=at).states
    level = states[:, 1:] + 0.01 * np.random.default_rng(0).standard_normal((len(at), 1))
    data = sf.Measurements(at, level, observe=lambda t, x, p: x[1:], sigma=0.01)
    guesses = {name: sf.Parameter(1.2 * value, lower=0.01, upper=5.0) for name, value in LEAKING.items()}
    problem = sf.Problem(system, sf.Experiment(data, ("closed",), (), 0.0, 20.0), guesses)
    return sf.find_modes(problem, library, max_switches=4)


def test_an_order_that_leaves_no_trace_is_ambiguous():
    """Whether the upper tank was filled before or after it was shut does not matter to the lower level."""
    found = search_tanks(("fill_open", "closed", "fill", "open"), (3.1, 9.7, 13.7))
    assert found.status is sf.ModeStatus.AMBIGUOUS
    orders = {(("fill_open", "closed", "fill", "open"),), (("fill_open", "fill", "closed", "open"),)}
    assert {found.ending.sequences, found.ending.other} == orders
    assert "leaves no trace in what is measured" in str(found)
    assert orders <= {fit.sequences for fit in found.chosen}


def test_a_mode_that_leaves_no_trace_is_a_warning():
    """Behind a valve that stays closed the pump may run or not."""
    found = search_tanks(("fill_open", "open", "closed"), (5.0, 9.0), library=("fill_open", "open", "closed", "fill"))
    assert found.status is sf.ModeStatus.AMBIGUOUS
    [untraced] = kinds_of(found.warnings, "no trace")
    assert (untraced.mode, untraced.end) in (("fill", 20.0), ("closed", 20.0))
    assert 9.0 < untraced.begin < 11.0
    assert f"{untraced.mode} from" in str(untraced)


def test_all_neighbours_of_what_is_found_are_fitted():
    """Every sequence with two modes exchanged, one replaced, left out or put in; exchanged in two ways."""
    library = build_library(heater_problem(), max_switches=3)
    neighbours = list(list_neighbours(Schedule(("on", "off"), np.array([2.0]), 0.0, 6.0), library))
    names = {"-".join(changed.sequence) for changed in neighbours}
    assert names == {"off-on", "on", "off", "on-off-on", "off-on-off", "on-off-on-off"}
    assert [changed.times.tolist() for changed in neighbours if changed.switches == 1] == [[4.0], [2.0]]


def test_outliers_are_told_from_modes():
    """Two values in a hundred are off by 20 sigma: the search weighs them by a robust loss, and says so."""
    values = simulate(times=(2.0, 5.0))
    off = np.random.default_rng(3).random(values.shape) < 0.02
    found = sf.find_modes(make_problem(values=values + 20 * SIGMA * off), max_switches=5)
    assert (found.status, found.mode_sequence) == (sf.ModeStatus.FOUND, SEQUENCE)
    [warning] = kinds_of(found.warnings, "outliers")
    assert warning.samples == off.sum()
    assert found.best.problem.experiments[0].data[0].loss == "huber"


def test_a_wrong_sigma_is_told_from_modes():
    """The sequence is right, but whether it is sigma or the model that is wrong, the data cannot say."""
    found = sf.find_modes(make_problem(times=(2.0, 5.0), sigma=0.3 * SIGMA), max_switches=5)
    assert (found.status, found.mode_sequence) == (sf.ModeStatus.NOT_EXPLAINED, SEQUENCE)
    assert found.ending.reason == "sigma"
    assert abs(0.3 * found.ending.ratio - 1.0) < 0.15
    assert abs(found.best.residual_variance - 1.0) < 0.25


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
