"""How a search for the mode sequence ends: what is ambiguous, missing, held or warned of."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.mode_libraries import fall, pull, rise
from support.turning_modes import CHAIN, FREE, SEQUENCE, SIGMA, TIMES, kinds_of, make_problem, make_run, simulate
from switchfit.modes import certifier
from switchfit.modes.fitter import Fitter
from switchfit.modes.schedule import space_evenly
from switchfit.strategy.library import build_library


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
