"""The verdict on fits: every rule with a fit that it is about and one just beside it, and known ends."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from benchmarks.starts.problems import build_case
from support.models import STILL, curve, fishing, fit_problem, heated_room, linear, one_run, temperature
from switchfit.fit.search_record import Step
from switchfit.report.shares import format_share
from switchfit.uncertainty.chi_square import compare_with_sigma
from switchfit.uncertainty.doubts import Numbers, find_doubts

pytestmark = pytest.mark.usefixtures("fits_one_by_one")

TIMES = np.linspace(0.1, 10.0, 100)


def line(t, x, p):
    return jnp.stack([p["a"] + p["b"] * t])


def straight(values, *, sigma=None, times=TIMES, a=1.0, b=1.0, **settings) -> sf.Estimate:
    """Fit a straight line to values."""
    parameters = {"a": sf.Parameter(a), "b": sf.Parameter(b, **settings)}
    posed = curve(line, times, np.asarray(values)[:, None], parameters, tf=float(times[-1]), sigma=sigma)
    return sf.estimate(posed, strategy="local")


def noise(size=1.0, count=100, seed=0) -> np.ndarray:
    return size * np.random.default_rng(seed).standard_normal(count)


def rooms(times, logs, sigma=None, k=0.5) -> sf.Estimate:
    """Fit rooms that are heated until about 3 s to a log each."""
    data = [sf.Measurements(times, values, sigma=sigma) for values in logs]
    runs = [sf.Experiment(each, ("on", "off"), (3.0,), 0.0, 6.0) for each in data]
    return sf.estimate(sf.Problem(heated_room(), runs, {"power": 2.0, "k": k}), strategy="local")


def kinds(fit: sf.Estimate) -> list[str]:
    return [reason.kind for reason in fit.verdict.reasons]


def steps(fit: sf.Estimate) -> list[str]:
    return [step.kind for step in fit.verdict.next_steps]


# --- the rules, on numbers --------------------------------------------------------------------------------------------

NOISE = {"explained": 0.99, "probability": 0.5, "known": True, "freedom": 98.0}
"""A fit of a known sigma that leaves noise."""
WHITE = NOISE | {"known": False}
"""The same, with sigma unknown."""
FEW = WHITE | {"probability": np.nan}
"""The same, with too few values to tell whether it is noise."""
FOLLOWED = WHITE | {"tried": 40, "agreeing": 2, "explained": 0.9991}
"""A fit of an unknown sigma that explains nearly all, and was found from another start too."""
REFERENCE = {"references": True, "explained": 0.9991}
EXACT = NOISE | {"explained": 1 - 0.9e-10, "probability": 0.0}
"""A fit that leaves rounding."""


def levels(*, references=False, **changes) -> dict[str, str]:
    """Return the doubts about one fit and their levels, by kind."""
    numbers = {
        "converged": True, "error": 1e-8, "lower": 0, "tried": 0, "agreeing": 0, "explained": np.nan,
        "probability": np.nan, "known": False, "freedom": np.inf, "collapsed": 0, "at_bounds": 0, "smallest": 0.1,
    }  # fmt: skip
    one = Numbers(**{name: np.array([value]) for name, value in (numbers | changes).items()}, references=references)
    return {doubt.kind: doubt.level for doubt in find_doubts(one)}


@pytest.mark.parametrize(
    ("inside", "outside", "doubts"),
    [
        # Did it converge, on a mesh that is fine enough?
        ({}, {"converged": False}, {"not converged": "bad"}),
        ({"error": 0.99e-3}, {"error": 1.01e-3}, {"integration error": "bad"}),
        ({"error": 0.99e-3}, {"error": np.nan}, {"integration error": "bad"}),
        # Is it the best that was found, and who looked?
        ({"tried": 40, "agreeing": 4}, {"tried": 40, "agreeing": 4, "lower": 1}, {"other starts are better": "bad"}),
        ({"tried": 40, "agreeing": 4}, {"tried": 40, "agreeing": 3}, {"few starts agree": "doubtful"}),
        (NOISE | {"tried": 40}, WHITE | {"tried": 40}, {"few starts agree": "doubtful"}),
        (FOLLOWED, FOLLOWED | {"explained": 0.9989}, {"few starts agree": "doubtful"}),
        (FOLLOWED, FOLLOWED | {"agreeing": 1}, {"few starts agree": "doubtful"}),
        # Does the model explain the data?
        (NOISE | {"probability": 1.1e-3}, NOISE | {"probability": 0.9e-3}, {"no noise": "doubtful"}),
        (NOISE | {"explained": 0.1}, NOISE | {"explained": 0.1, "probability": 0.0}, {"unexplained": "bad"}),
        (WHITE | {"explained": 0.51}, WHITE | {"explained": 0.49}, {"little explained": "doubtful"}),
        (FEW | {"explained": 0.91}, FEW | {"explained": 0.89}, {"little explained": "doubtful"}),
        (FEW | {"explained": 0.91}, FEW | {"explained": 0.49}, {"unexplained": "bad"}),
        (NOISE, NOISE | {"freedom": 0.0}, {"too few samples": "doubtful"}),
        (REFERENCE, REFERENCE | {"explained": 0.9989}, {"little explained": "doubtful"}),
        (EXACT, EXACT | {"explained": 1 - 1.1e-10}, {"no noise": "doubtful"}),
        # Is it determined?
        ({"smallest": 1.1e-6}, {"smallest": 0.9e-6}, {"not determined": "doubtful"}),
        ({}, {"at_bounds": 1}, {"at bounds": "doubtful"}),
        ({}, {"collapsed": 1}, {"a mode collapsed": "doubtful"}),
    ],
)
def test_each_threshold_has_two_sides(inside, outside, doubts):
    assert levels(**inside) == {}
    assert levels(**outside) == doubts


@pytest.mark.parametrize(
    ("chi_square", "freedom", "fits", "known"),
    [(140.0, 98, True, True), (150.0, 98, False, True), (10_990.0, 10_000, True, True), (11_010.0, 10_000, False, True),
     (63.0, 98, True, True), (57.0, 98, True, False), (9_010.0, 10_000, True, True), (8_990.0, 10_000, True, False)],
)  # fmt: skip
def test_chi_square_is_beyond_chance_and_clearly_off(chi_square, freedom, fits, known):
    """Of 98 degrees of freedom a thousandth is above 146 and below 60; of 10,000, the ratio decides."""
    probability, is_size = compare_with_sigma(chi_square, freedom)
    assert (probability >= 1e-3, is_size) == (fits, known)


# --- situations -------------------------------------------------------------------------------------------------------

LINE, WAVE = 2.0 + 0.5 * TIMES, np.sin(2 * TIMES)
SPIKES = np.where(np.arange(100) % 50 == 20, 2.0, 0.0)
"""Outliers in a fiftieth of the samples."""

FEW_TIMES = {"times": TIMES[::9]}
IS_NOISE, IS_WRONG = "what is left is noise", "is correlated: the minimum or the model is wrong"
GIVE_LOSS = "has outliers: values or the model are wrong there: give the Measurements a robust loss"

SITUATIONS = {
    # values and settings, level, kinds of the reasons, words
    "right, sigma known": (LINE + noise(0.1), {"sigma": 0.1}, "good", "fits", IS_NOISE),
    "right, sigma unknown": (LINE + noise(0.1), {}, "good", "fits", IS_NOISE),
    "nothing but noise": (2 + 0.1 * TIMES + noise(), {}, "doubtful", "little explained", "explains only"),
    "sigma too small by 2": (LINE + noise(0.1), {"sigma": 0.05}, "doubtful", "sigma suspected", "sigma is too small"),
    "sigma too small by 2, fewer than 20 values": (
        LINE[::6] + noise(0.1, 17), {"sigma": 0.04, "times": TIMES[::6]}, "doubtful", "model suspected",
        "sigma: the minimum or the model is wrong",
    ),
    "sigma too large by 2": (LINE + noise(0.1), {"sigma": 0.2}, "good", "fits", IS_NOISE),
    "outliers, sigma known": (
        LINE + noise(0.1) + SPIKES, {"sigma": 0.1}, "doubtful", "outliers suspected", GIVE_LOSS,
    ),
    "model slightly wrong": (
        LINE + 0.02 * WAVE + noise(0.005), {"sigma": 0.005}, "doubtful", "model suspected",
        "is correlated: the model is slightly wrong",
    ),
    "model wrong": (LINE + 0.5 * WAVE + noise(0.02), {"sigma": 0.02}, "doubtful", "model suspected", IS_WRONG),
    "far from the data": (2 + 0.1 * TIMES + WAVE, {}, "bad", "unexplained", "explains only 6 %"),
    "far from the data, sigma far too large": (
        2 + 0.1 * TIMES + WAVE, {"sigma": 10.0}, "doubtful", "little explained", "explains only 6 %",
    ),
    "few values": (0.5 * TIMES[::9] + 0.05 * WAVE[::9], FEW_TIMES, "good", "fits", "of the variance."),
    "as many values as unknowns": (
        np.array([1.0, 2.5]), {"times": np.array([1.0, 2.0])}, "doubtful", "too few samples", "nothing to check",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SITUATIONS)
def test_situations(name):
    values, settings, level, reason, words = SITUATIONS[name]
    fit = straight(values, **settings)
    assert (fit.verdict.level, kinds(fit)) == (level, [reason])
    assert words in str(fit.verdict)
    assert str(fit.verdict).startswith(f"{level.capitalize()}: converged; one fit; ")
    assert (fit.verdict.next_steps == (), fit.success) == (level == "good", level != "bad")


def test_an_estimated_sigma_confirms_no_fit():
    """It grows with whatever is left."""
    values = (LINE + noise(0.1))[:, None]
    parameters = {"a": 1.0, "b": 1.0, "size": sf.Parameter(0.2, lower=1e-3)}
    estimated = sf.estimate(curve(line, TIMES, values, parameters, tf=10.0, sigma="size"), strategy="local")
    given = straight(LINE + noise(0.1), sigma=0.1)
    assert estimated.verdict.level == given.verdict.level == "good"
    assert [fit.verdict.answers[-1].figures["known"] for fit in (estimated, given)] == [0.0, 1.0]


def test_the_resolution_of_times_beside_a_kink_is_no_doubt():
    """Seconds since 1970 have 24 bits behind the point: the slope in one time stays at 1e-4, the other is at a kink."""
    times, epoch = np.linspace(0.25, 10.0, 40), 1.7e9

    def run(tau, seed):
        log = temperature(times, tau, 1.0, 0.3) + noise(0.02, 40, seed)
        return sf.Experiment(sf.Measurements(epoch + times, log, sigma=0.02), ("on", "off"), (epoch + 2.0,), epoch)

    fit = sf.estimate(sf.Problem(heated_room(), [run(3.0, 4), run(4.1, 104)], {"power": 2.0, "k": 0.1}))
    assert (fit.status, fit.verdict.level) == (sf.Status.CONVERGED_AT_KINK, "good")
    assert fit.optimality > fit.tolerance


def test_one_wrong_run_of_many_is_found_and_named():
    """Its chi-square is lost in that of all."""
    times = np.linspace(0.25, 6.0, 24)

    def fit(wrong: float) -> sf.Estimate:
        logs = [temperature(times, 3.0, 2.0, 0.5) + noise(0.5, 24, seed=e) for e in range(30)]
        logs[7] += wrong * np.sin(3 * times)
        return rooms(times, logs, 0.5)

    assert fit(0.0).verdict.level == "good"
    found = fit(1.5)
    assert (found.verdict.level, found.verdict.reasons[0].subjects) == ("doubtful", ("run8 T",))
    assert " of run8 T" in str(found.verdict)


def test_nothing_is_read_from_residuals_that_are_rounding():
    fit = straight(LINE)
    assert str(fit.verdict) == "Good: converged; one fit; the model explains all of the variance."
    assert replace(fit, integration_error=1.0).verdict.level == "good"
    wave = straight(LINE + 1e-4 * WAVE)
    assert replace(wave, integration_error=1.0).verdict.level == "bad"
    assert kinds(wave) == ["model suspected"]


def test_outliers_that_a_robust_loss_weighs_down_are_not_missed():
    values = LINE + noise(0.1)
    values[::10] += 20.0
    data = sf.Measurements(TIMES, values, observe=line, sigma=0.1, loss="huber")

    def fit(slope: sf.Parameter) -> sf.Estimate:
        return sf.estimate(one_run(STILL, data, ("still",), (), 10.0, {"a": 1.0, "b": slope}), strategy="local")

    assert fit(sf.Parameter(0.3)).verdict.level == "good"
    wrong = fit(sf.Parameter(-0.2, fixed=True))  # nearly all samples are beyond the scale
    assert (wrong.verdict.level, kinds(wrong)) == ("bad", ["unexplained"])
    near = fit(sf.Parameter(0.476, fixed=True))  # half of them is
    assert (near.verdict.level != "good", "next: more starts" in steps(near)) == (True, True)


def test_what_a_robust_loss_weighs_down_of_a_wrong_model_counts_as_unexplained():
    """Nearly half of the samples are far from the line, and few of the others near it."""
    values = 10 * LINE + noise(0.1) + np.where(TIMES > 6.0, 3 * np.sin(5 * TIMES), 0.2 * WAVE)
    posed = curve(line, TIMES, values, {"a": 20.0, "b": 5.0}, tf=10.0, sigma=0.1, loss="cauchy", loss_scale=2.5)
    fit = sf.estimate(posed, strategy="local")
    assert 0.4 < np.mean(fit.comparisons[0][0].downweighted) < 0.5
    assert (fit.verdict.level, kinds(fit)) == ("doubtful", ["model suspected"])
    assert "explains 99.11 %" in str(fit.verdict)
    assert IS_WRONG in str(fit.verdict)


# --- corrected standard errors ----------------------------------------------------------------------------------------


def test_the_error_of_a_time_is_corrected_by_its_own_run():
    times = np.linspace(0.1, 6.0, 60)
    logs = [temperature(times, 3.0 + 0.01 * e, 2.0, 0.5) + noise(0.02, 60, seed=e) for e in range(2)]
    logs[1] += 0.05 * np.sin(2 * times)
    fit = rooms(times, logs)
    factors = fit.corrected_standard_errors / fit.standard_errors
    assert factors[0] == 1.0
    assert factors[1] > 1.5
    np.testing.assert_allclose(factors[2:], factors[1], rtol=1e-14)


# --- integration, derivatives, starts ---------------------------------------------------------------------------------


def test_other_starts_count(heater):
    assert kinds(replace(heater, starts=(40, 0, 0))) == ["fits"]  # chi-square confirms it
    assert "; the lowest J was found from 12 of 40 other starts; " in str(replace(heater, starts=(40, 0, 12)).verdict)
    worse = replace(heater, starts=(40, 12, 3)).verdict
    assert (worse.level, worse.reasons[0].kind) == ("bad", "other starts are better")
    assert str(worse).startswith("Bad: converged; 12 of 40 other starts are better; the model explains ")


def test_correlated_residuals_doubt_the_minimum_where_sigma_is_unknown():
    fit = straight(2.0 + 0.5 * TIMES + 0.1 * np.sin(3 * TIMES), sigma=None)
    assert (fit.verdict.level, kinds(fit)) == ("doubtful", ["model suspected"])
    assert steps(fit) == ["next: more starts", "next: look at the residuals", "next: corrected errors"]
    assert steps(replace(fit, starts=(40, 0, 40))) == ["next: look at the residuals", "next: corrected errors"]
    slight = straight(2.0 + 0.5 * TIMES + 0.01 * np.sin(3 * TIMES), sigma=None)  # as most real logs at high precision
    assert steps(slight) == ["next: look at the residuals", "next: corrected errors"]


def test_a_search_that_found_nothing_lower_is_named():
    """Who looked is said; a search that was cut short has not looked."""
    local, search = Step("local", 2.0, 10, 0.1), Step("beam", 2.0, 10, 0.1)
    fit = straight(LINE + WAVE, sigma=0.1)
    for steps_of, words, wrong in (
        ((), "one fit", "the minimum or the model"),
        ((local, search), "beam found nothing lower", "the model"),
        ((local, replace(search, cost=1.0)), "the lowest of local and beam", "the minimum or the model"),
        ((local, replace(search, ended="time")), "beam ended by its limit of time", "the minimum or the model"),
    ):
        found = replace(fit, steps=steps_of)
        assert f"converged; {words}; " in str(found.verdict)
        assert f": {wrong} is wrong" in str(found.verdict)
        assert ("next: more starts" in steps(found)) == (wrong != "the model")


def test_a_search_that_was_cut_short_is_doubtful_unless_noise_of_a_known_size_is_left(heater):
    """Nobody has looked everywhere; but chi-square alone says that there is nothing to look for."""
    cut = (Step("local", heater.cost, 5, 0.1), Step("many starts", heater.cost, 50, 2.0, "time"))
    assert replace(heater, steps=cut).verdict.level == "good"
    unknown = straight(LINE + noise(0.1), a=1.2)
    doubted = replace(unknown, steps=cut)
    assert (unknown.verdict.level, doubted.verdict.level) == ("good", "doubtful")
    assert (kinds(doubted), steps(doubted)) == (["search cut short"], ["next: more time"])
    for starts, level in (((40, 0, 30), "good"), ((40, 0, 1), "doubtful"), ((40, 1, 30), "bad")):
        assert replace(doubted, starts=starts).verdict.level == level


# --- costs without noise ----------------------------------------------------------------------------------------------


def test_channels_of_no_weight_and_constant_references_are_not_judged():
    times = np.linspace(0.0, 6.0, 61)
    values = np.stack([temperature(times, 3.0, 2.0, 0.5), np.cos(9 * times), np.full(61, 3.0)], axis=1)

    def observe(t, x, p):
        return jnp.stack([x[0], 0.0 * x[0], 2.9 + 0.0 * x[0]])

    def fit(weight):
        data = sf.ReferenceSignal.from_samples(times, values, observe=observe, weights=[1.0, weight, 1.0])
        run = sf.Experiment(data, ("on", "off"), (2.5,), 0.0, 6.0)
        return sf.estimate(sf.Problem(heated_room(), run, {"power": 1.5, "k": 0.4}), strategy="local")

    assert fit(0.0).verdict.level == "good"
    seen = fit(1.0)
    assert (seen.verdict.level, kinds(seen)[0]) == ("doubtful", "little explained")


def test_a_cost_without_data_is_judged_by_its_minimum():
    fit = sf.estimate(linear(), strategy="local")
    assert str(fit.verdict).startswith("Good: converged; one fit; a minimum (KKT residual ")
    collapsed = sf.estimate(fishing(), strategy="local")
    assert kinds(collapsed) == ["a mode collapsed"]
    assert "No standard errors" not in collapsed.report(full=True)  # nothing can be done about it


# --- known right and wrong ends ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["thermostat", pytest.param("two-turns-anywhere", marks=pytest.mark.slow)])
def test_wrong_ends_are_never_good(name):
    """Nine tenths of those of two turns explain 99 % of positions that go over hundreds of metres."""
    case = build_case(name)
    right = fit_problem(case.problem, start=case.near, strategy="local", level="good")
    seen = []
    for start in case.starts[:8]:
        end = sf.estimate(case.problem, start=start, strategy="local")
        if end.cost < 1.01 * right.cost:
            assert end.verdict.level == "good"
        else:
            seen.append(end.verdict.level)
    assert "good" not in seen
    assert "bad" in seen


# --- texts ------------------------------------------------------------------------------------------------------------


def test_shares_are_never_rounded_up():
    """0.29 * 100 is below 29."""
    texts = {1.0: "all", 0.9999999: "all but 1e-6", 0.99985999: "99.985 %", 0.61: "61 %", 0.0: "none", 0.29: "29 %"}
    assert {share: format_share(share) for share in texts} == texts
