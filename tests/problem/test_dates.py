"""Dates on the way in and out: against pandas, zoneinfo and exact arithmetic."""

import csv
import datetime as dt
import json
import re
from dataclasses import replace
from fractions import Fraction
from zoneinfo import ZoneInfo

import matplotlib
import numpy as np
import pandas as pd
import polars as pl
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

import switchfit as sf
from support.commands import run
from support.models import charge, decay, first_state, refused, temperature
from support.places import EXAMPLES
from switchfit.cli.summaries import summarize_estimate
from switchfit.cli.tables import write_runs, write_unknowns
from switchfit.io.problem_file.loading import load_problem
from switchfit.problem.dates import Dates, from_epoch, read_dates
from switchfit.problem.origin import Origin, make_origin
from switchfit.problem.time_units import SECONDS_OF_UNIT
from switchfit.report.date_axis import DateLocator
from switchfit.report.style import label_axis
from switchfit.report.times import format_date, format_time
from switchfit.runtime.errors import InputError

pytestmark = pytest.mark.usefixtures("fits_one_by_one")

matplotlib.use("agg")

BERLIN = ZoneInfo("Europe/Berlin")
DAYS = ["2020-03-28", "2020-03-29", "2020-03-30", "2020-03-31"]
VALUES = [1.0, 2.0, 1.5, 1.0]
ROOM = sf.HybridSystem({"on": charge, "off": decay}, [0.0])
DATED = sf.Parameter("2020-03-29")
EPOCH, BARE = (make_origin(np.datetime64(0, "us"), zone) for zone in ("UTC", ""))


def log(times, **more):
    return sf.Measurements(times, VALUES[: len(times)], sigma=0.1, **more)


def in_berlin(reading):
    return run_of(["2020-01-01", reading, "2021-01-01"], time_zone="Europe/Berlin")


def run_of(times, transition=None, **more):
    return sf.Experiment(log(times), ("on", "off"), transition, **{"time_unit": "h"} | more)


# --- what is a date ---------------------------------------------------------------------------------------------------

NAIVE = {
    "text": DAYS,
    "an array of text": np.array(DAYS),
    "datetime64[D]": np.array(DAYS, dtype="datetime64[D]"),
    "a list of datetime64": [np.datetime64(day) for day in DAYS],
    "datetime": [dt.datetime.fromisoformat(day) for day in DAYS],
    "date": [dt.date.fromisoformat(day) for day in DAYS],
    "an array of objects": np.array([dt.date.fromisoformat(day) for day in DAYS], dtype=object),
    "a column of pandas": pd.Series(pd.to_datetime(DAYS)),
    "days of polars": pl.Series([dt.date.fromisoformat(day) for day in DAYS]),
    "text of polars": pl.Series(DAYS),
    "an array of xarray": xr.DataArray(np.array(DAYS, dtype="datetime64[ns]")),
}
AWARE = {
    "text": ["2020-03-28T00:00+01:00", "2020-03-29T00:00+01:00", "2020-03-30T00:00+02:00", "2020-03-31T00:00+02:00"],
    "datetime": [dt.datetime.fromisoformat(day).replace(tzinfo=BERLIN) for day in DAYS],
    "an index": pd.DatetimeIndex(DAYS, tz="Europe/Berlin"),
    "a column of polars": pl.Series(pd.DatetimeIndex(DAYS, tz="Europe/Berlin")),
    "numbers since 1970": from_epoch([1585350000, 1585436400, 1585519200, 1585605600]),
}


@pytest.mark.parametrize("kind", NAIVE)
def test_dates_without_a_zone_have_days_of_24_hours(kind):
    run = run_of(NAIVE[kind])
    np.testing.assert_array_equal(run.data[0].times, [0.0, 24.0, 48.0, 72.0])
    assert (run.origin, run.time_zone) == (Origin("2020-03-28T00:00:00", ""), None)
    assert run.tf == run_of(NAIVE[kind], time_unit="hours").tf == 72.0
    np.testing.assert_array_equal(run_of(NAIVE[kind], time_zone="Europe/Berlin").data[0].times, [0.0, 24.0, 47.0, 71.0])


@pytest.mark.parametrize("kind", AWARE)
def test_dates_with_a_zone_are_moments(kind):
    """And are shown in their zone; in UTC where they have two offsets."""
    run = run_of(AWARE[kind], time_unit="d")
    np.testing.assert_array_equal(run.data[0].times, np.array([0.0, 24.0, 47.0, 71.0]) / 24)
    assert run.time_zone == ("UTC" if kind in ("text", "numbers since 1970") else "Europe/Berlin")
    zoned = run_of(AWARE[kind], time_zone="Europe/Berlin")
    assert zoned.origin == Origin("2020-03-28T00:00:00+01:00", "Europe/Berlin")
    assert run.origin.instant == zoned.origin.instant


def test_numbers_are_numbers_as_ever():
    assert run_of([0.0, 1.0, 2.0], [1.5], time_unit="fortnight").origin is None
    assert run_of([1.7e12, 1.8e12, 1.9e12]).origin is None, "never told by their size"


def test_dates_are_exact_to_the_microsecond():
    """As seconds since 1970, some of these would be one float64; what is finer is cut off, and no year overflows."""
    instants = np.datetime64("2024-05-01T12:00:00", "us") + np.array([0, 1, 2, 500])
    run = sf.Experiment(log(instants), ("on",), (), time_unit="us")
    np.testing.assert_array_equal(run.data[0].times, [0.0, 1.0, 2.0, 500.0])
    finer = instants.astype("datetime64[ns]") + np.array([0, 1, 999, 500])
    for dates in (finer, list(pd.DatetimeIndex(finer)), finer.astype(str)):
        np.testing.assert_array_equal(read_dates(dates, "times").instants, instants)
    far = log(np.array(["0001-01-01", "1850-01-01", "9999-12-31"], dtype="datetime64[D]"))
    days = [dt.date(1850, 1, 1).toordinal() - 1, dt.date.max.toordinal() - 1]
    np.testing.assert_array_equal(sf.Experiment(far, ("on",), (), time_unit="d").data[0].times, [0, *days])


# --- round trips ------------------------------------------------------------------------------------------------------

MICROSECONDS = st.integers(-6 * 10**15, 8 * 10**15).map(lambda micros: np.datetime64(micros, "us"))
ZONES = st.sampled_from(["UTC", "Europe/Berlin", "Asia/Kathmandu", "America/St_Johns", "Australia/Lord_Howe", "-03:30"])


@settings(max_examples=30)
@given(MICROSECONDS, MICROSECONDS, ZONES, st.sampled_from(list(SECONDS_OF_UNIT)))
def test_a_number_is_the_exact_difference_rounded_once(start, instant, zone, unit):
    origin = make_origin(start, zone)
    assert origin.instant == start
    assert Origin(origin.date, origin.time_zone) == origin
    number = origin.to_numbers(Dates(np.array(instant), "UTC"), unit)
    exact = Fraction(int((instant - start).astype(int))) / Fraction(round(1e9 * SECONDS_OF_UNIT[unit]), 1000)
    assert abs(Fraction(float(number)) - exact) <= abs(exact) * Fraction(2, 2**53)


@given(st.integers(-4 * 10**15, 4 * 10**15), st.integers(-(10**9), 10**9), ZONES)
def test_dates_come_back(start, seconds, zone):
    origin = make_origin(np.datetime64(start, "us"), zone)
    (date,) = origin.to_dates([seconds], "s")
    moment = dt.datetime(1970, 1, 1, tzinfo=dt.UTC) + dt.timedelta(microseconds=start + 10**6 * seconds)
    assert date == moment
    assert date.utcoffset() == moment.astimezone(origin.zone).utcoffset()
    assert origin.to_numbers(read_dates(date, "date"), "s") == seconds


READINGS = st.datetimes(dt.datetime(1985, 1, 1), dt.datetime(2037, 1, 1))


@given(READINGS, st.sampled_from(["Europe/Berlin", "America/New_York"]))
def test_wall_clocks_agree_with_pandas(reading, zone):
    given = read_dates(reading, "times")
    try:
        expected = pd.Timestamp(reading).tz_localize(zone)
    except ValueError:
        with pytest.raises(ValueError, match=r"times: .* (is skipped|occurs twice)"):
            given.localize(zone, "times")
    else:
        found = given.localize(zone, "times")
        assert found.instants == expected.tz_convert("UTC").tz_localize(None)
        assert make_origin(found.instants, zone).zone == ZoneInfo(zone)


@given(st.lists(st.integers(0, 4 * 10**12), min_size=1, max_size=20), st.sampled_from(["ms", "us"]))
def test_numbers_since_1970_agree_with_pandas(numbers, unit):
    expected = pd.to_datetime(numbers, unit=unit, utc=True).as_unit("us").asi8
    np.testing.assert_array_equal(from_epoch(numbers, unit).instants.astype(np.int64), expected)
    np.testing.assert_array_equal(from_epoch(np.array(numbers, dtype=float), unit).instants.astype(np.int64), expected)
    assert from_epoch(1585000800.25).instants == from_epoch(1585000800250000000, "ns").instants


# --- zones ------------------------------------------------------------------------------------------------------------


def test_sources_in_different_zones_meet_as_moments():
    berlin = pd.date_range("2020-03-28", periods=3, tz="Europe/Berlin")
    data = [log(berlin), log(pd.date_range("2020-03-28 08:00", periods=3, tz="Asia/Tokyo"))]
    run = sf.Experiment(data, ("on", "off"), ["2020-03-28 09:00+09:00"], time_unit="h")
    np.testing.assert_array_equal(run.data[0].times, [0.0, 24.0, 47.0])
    np.testing.assert_array_equal(run.data[1].times, [0.0, 24.0, 48.0])
    assert (run.initial_times, run.time_zone) == ([1.0], "UTC")
    here = sf.Experiment(data, ("on", "off"), ["2020-03-28 01:00"], time_unit="h", time_zone="Europe/Berlin")
    assert (here.initial_times, here.origin.date) == ([1.0], "2020-03-28T00:00:00+01:00")


# --- origin, horizon, guesses and bounds ------------------------------------------------------------------------------


def test_the_origin_is_the_first_sample_or_t0_or_what_is_stated():
    assert run_of(DAYS).origin.date == "2020-03-28T00:00:00"
    early = run_of(DAYS, t0="2020-03-27 18:00")
    assert (early.origin.date, early.t0, early.data[0].times[0]) == ("2020-03-27T18:00:00", 0.0, 6.0)
    stated = run_of(DAYS, origin="2020-03-01", time_unit="d")
    assert (stated.t0, stated.tf, stated.initial_times) == (27.0, 30.0, [28.5])
    numbers = run_of([0.0, 1.0, 2.0], [1.0], origin="2020-03-28", time_unit="d", tf="2020-03-31")
    assert (numbers.t0, numbers.tf, numbers.origin.date) == (0.0, 3.0, "2020-03-28T00:00:00")
    assert run_of(DAYS, [30.0]).initial_times == [30.0], "numbers beside dates count from the origin"


def test_guesses_bounds_and_priors_are_dates():
    tau = sf.Parameter("2020-03-29T12:00Z", lower="2020-03-29", upper=47.0, prior=sf.Normal("2020-03-29 10:00Z", 2.0))
    end = sf.Parameter("2020-03-31", lower="2020-03-31", upper="2020-04-02")
    run = sf.Experiment(log(DAYS), ("on", "off"), [tau], tf=end, time_unit="h", time_zone="Europe/Berlin")
    (found, tf) = run.times
    assert (found.value, found.lower, found.upper, found.prior.mean, found.prior.sd) == (37.0, 24.0, 47.0, 35.0, 2.0)
    assert (tf.value, tf.lower, tf.upper) == (71.0, 71.0, 119.0)


def test_a_copy_keeps_its_origin():
    run = run_of(DAYS, time_zone="Europe/Berlin")
    copy = replace(run, data=log(["2020-03-29 12:00", "2020-03-30"]))
    assert (copy.origin, copy.time_zone) == (run.origin, "Europe/Berlin")
    np.testing.assert_array_equal(copy.data[0].times, [35.0, 47.0])


def test_signals_and_inputs():
    """A cut-off is in cycles per time unit: in Hz, this one would need ten million points."""
    numbers = np.arange(24.0)
    dates, values = np.datetime64("2020-03-01") + numbers.astype(int), np.sin(numbers)
    given = sf.ReferenceSignal.from_samples(dates, values, lowpass_hz=0.45)
    run = sf.Experiment(given, ("on",), (), time_unit="d", inputs=sf.Input(dates, {"u": values}, kind="cubic"))
    expected = sf.ReferenceSignal.from_samples(numbers, values, lowpass_hz=0.45)
    np.testing.assert_array_equal(run.data[0].signal.knots, expected.signal.knots)
    np.testing.assert_array_equal(run.data[0].signal.coefficients, expected.signal.coefficients)
    np.testing.assert_array_equal(run.inputs.times, numbers)


test_what_is_wrong_is_said = refused(
    (lambda: log(["2020-03-28", "soon"]), ValueError, "Measurements times must be numbers or dates; got 'soon' at"),
    (lambda: log(["2020-03-28", 3.0]), TypeError, "Measurements times must be numbers or dates, not both; got 3.0"),
    (lambda: log(["2020-03-28", None]), ValueError, "times must not be missing; the date at index 1 is. Leave"),
    (lambda: log(pd.DatetimeIndex(["2020", None])), ValueError, "must not be missing; the date at index 1"),
    (lambda: log(["2020-03-28", "2020-03-29T00:00Z"]), ValueError, "must all have a time zone, or none; got"),
    (lambda: log(DAYS[::-1]), ValueError, "must increase strictly; got 2020-03-31T00:00:00 followed by 2020-03-30"),
    (lambda: log(np.array(["12000-01-01"], dtype="datetime64[D]")), ValueError, "must lie in the years 1 to 9999;"),
    (lambda: log(pd.to_timedelta([0, 1], "h")), TypeError, "dates and time differences are not supported"),
    (lambda: run_of(DAYS, t0="2020-03-28T00Z"), ValueError, "t0 has a time zone .*, but times of .*time_zone="),
    (lambda: in_berlin("2020-03-29 02:30"), ValueError, "times of Measurements: 2020-03-29 02:30 is skipped as"),
    (lambda: in_berlin("2020-10-25 02:30"), ValueError, "02:30 occurs twice as clocks are set back in Europe/Ber"),
    (lambda: run_of(DAYS, time_zone="Europe/Berln"), ValueError, "time_zone 'Europe/Berln' is not known; give a"),
    (lambda: run_of(DAYS, time_zone=2), TypeError, "time_zone must be the name of a time zone"),
    (lambda: run_of(DAYS, time_unit="week"), ValueError, "time_unit must be one of ns, us, ms, s, min, h, d where"),
    (lambda: run_of(DAYS, origin=3.0), TypeError, "origin must be a date, such as .*; got 3.0"),
    (lambda: run_of(DAYS, origin=DAYS), ValueError, "origin must be one date; got 4 dates from"),
    (lambda: run_of([0.0, 1.0], time_zone="UTC"), ValueError, "time_zone is 'UTC', but no time is a date: give"),
    (lambda: run_of([0.0, 9.0], ["2020-03-29"]), ValueError, "a transition time is a date, but not all times of t"),
    (lambda: sf.Experiment([log(DAYS), log([0.0, 1.0])], ("on",), ()), ValueError, "times of Measurements is a"),
    (lambda: run_of(DAYS, ["2020-04-02"]), ValueError, r"inside .t0, tf. = .2020-03-28 00:00:00, 2020-03-31"),
    (lambda: run_of(DAYS, tf="2020-03-30"), ValueError, "= .2020-03-28 .*; 1 of 4 do not, the first is 2020-03-31"),
    (lambda: sf.Parameter(DAYS), ValueError, "Parameter value must be one date"),
    (lambda: run_of(DAYS, [sf.Parameter("2020-03-29", lower="2020-03-30")]), ValueError, "24.0.* outside its boun"),
    (lambda: run_of(DAYS, initial_state=[DATED]), ValueError, "must be a number; got the"),
    (lambda: sf.Problem(ROOM, run_of(DAYS), {"k": DATED}), ValueError, "'k' must be a number; got the date 20"),
    (lambda: from_epoch([1e30]), ValueError, "numbers since 1970 in s must lie in the years"),
    (lambda: from_epoch([1.0], "weeks"), ValueError, "unit must be one of ns, us"),
    (lambda: from_epoch(["2020"]), ValueError, "numbers since 1970 must be"),
    (lambda: EPOCH.to_dates([np.nan], "s"), ValueError, "nan s since 1970-01-01T00:00:00.00:00 is"),
    (lambda: BARE.to_numbers(read_dates("2020-01-01T00Z", "t"), "s"), ValueError, "has a time"),
)


# --- a fit ------------------------------------------------------------------------------------------------------------

START = dt.datetime(2020, 3, 20, tzinfo=BERLIN)


def room(dated, **more):
    """A room that is heated for 9.3 days, with samples every 12 hours; over the night in which clocks are set."""
    t = np.arange(40) / 2
    values = temperature(t, 9.3, 1.0, 1.0, start=0.0) + 0.02 * np.random.default_rng(1).normal(size=40)
    dates = pd.Timestamp(START).tz_convert("UTC") + pd.to_timedelta(t, "D")
    data = sf.Measurements(dates if dated else t, values, observe=first_state, sigma=0.02, names=("x",))
    guess = sf.Parameter("2020-03-28T00:00", lower="2020-03-22") if dated else sf.Parameter(8.0, lower=2.0)
    zone = "Europe/Berlin" if dated else None
    run = sf.Experiment(data, ("on", "off"), [guess], time_unit="d", time_zone=zone, **more)
    return sf.Problem(ROOM, run, {"k": 0.9})


@pytest.fixture(scope="module")
def fits():
    return sf.estimate(room(dated=True)), sf.estimate(room(dated=False))


def test_the_numbers_are_those_of_a_fit_to_numbers_and_the_transition_is_a_date(fits):
    dated, plain = fits
    assert dated.theta_names == plain.theta_names == ("tau_1", "k")
    np.testing.assert_array_equal(dated.theta, plain.theta)
    np.testing.assert_array_equal(dated.covariance, plain.covariance)
    assert (plain.transition_dates, plain.trajectory.dates) == ((None,), None)
    ((date,),) = dated.transition_dates
    moment = START.astimezone(dt.UTC) + dt.timedelta(days=float(dated.transition_times[0][0]))
    assert abs(date - moment) <= dt.timedelta(microseconds=1)
    assert (date.tzinfo, date.utcoffset()) == (BERLIN, dt.timedelta(hours=2)), "summer time by then"
    assert dated.trajectory.dates[0] == START


def test_the_report_shows_dates(fits):
    dated, plain = fits
    text = str(dated)
    assert re.search(r"on -> off, 2020-03-20 to 2020-04-08 13:00(.|\n)*times +d since 2020-03-20, Europe/Berlin", text)
    (shown,) = re.findall(r"tau_1 +(2020-03-\d\d \d\d:\d\d) +± \S+ +d +2020-03-28 +t = \S+, on -> off", text)
    off = dt.datetime.fromisoformat(shown).replace(tzinfo=BERLIN) - dated.transition_dates[0][0]
    assert abs(off) <= dt.timedelta(seconds=30)
    assert "2020" not in str(plain)


def test_tables_frames_and_json_have_dates_beside_numbers(fits):
    dated, plain = fits
    row, *_ = csv.DictReader(write_unknowns(dated).splitlines())
    end = dated.transition_dates[0][0].isoformat()
    assert row["date"] == end
    assert row["date_low"] < end < row["date_high"]
    assert next(csv.DictReader(write_runs(dated).splitlines()))["origin"] == "2020-03-20T00:00:00+01:00"
    content, (run,) = summarize_estimate(dated), summarize_estimate(dated)["runs"]
    assert {key: content["unknowns"][0][key] for key in ("date", "date_low", "date_high")}.items() <= row.items()
    assert run["origin"] == "2020-03-20T00:00:00+01:00"
    assert [mode["date_end"] for mode in run["modes"]] == [end, "2020-04-08T13:00:00+02:00"]
    assert list(dated.to_pandas()["date"]) == [end, ""]
    prediction = dated.predict(["2020-03-21"])
    assert list(prediction.to_pandas()["date (UTC)"]) == [pd.Timestamp("2020-03-20T23:00")]
    numbers = json.dumps(summarize_estimate(plain), default=np.ndarray.tolist)
    for text in (write_unknowns(plain), numbers, str(list(plain.to_pandas())), str(plain.predict([1.0]).to_pandas())):
        assert "date" not in text


@pytest.mark.usefixtures("quick_certificates")
def test_a_saved_fit_has_the_dates(fits, tmp_path):
    dated, _ = fits
    dated.save(tmp_path / "fit.json")
    loaded = sf.Estimate.load(tmp_path / "fit.json", problem=dated.problem)
    assert loaded.transition_dates == dated.transition_dates
    assert str(loaded) == str(dated)
    for problem in (room(dated=True, origin="2020-03-19"), room(dated=False)):
        with pytest.raises(ValueError, match=r"since 2020-03-20T00:00:00\+01:00, the problem has them in"):
            sf.Estimate.load(tmp_path / "fit.json", problem=problem)


def test_predictions_and_simulations_at_dates(fits):
    dated, plain = fits
    dates = ["2020-03-21", "2020-03-29T12:00"]
    found, path = dated.predict(dates), sf.simulate(dated.problem, dated.theta, times=dates)
    numbers = [1.0, 9.5 - 1 / 24]
    np.testing.assert_allclose(found.outputs, plain.predict(numbers).outputs, rtol=1e-9)
    np.testing.assert_array_equal(path.states, sf.simulate(plain.problem, dated.theta, times=numbers).states)
    for result in (found, path):
        assert [str(date) for date in result.dates] == ["2020-03-21 00:00:00+01:00", "2020-03-29 12:00:00+02:00"]
    with pytest.raises(ValueError, match=r"not lie before t0 = 2020-03-20 00:00:00\+01:00, .*; got 2019-01-01"):
        dated.predict(["2019-01-01"])
    with pytest.raises(ValueError, match=r"times are dates .*, but the times of the experiment are numbers"):
        plain.predict(["2020-03-21"])
    with pytest.raises(ValueError, match=r"inside \[t0, tf\] = \[2020-03-20 00:00:00\+01:00, .*; got 2019-01-01"):
        sf.simulate(dated.problem, dated.theta, times="2019-01-01")
    with pytest.raises(ValueError, match=r"times must be a number or a date; got 'sampels'"):
        sf.simulate(plain.problem, plain.theta, times="sampels")


# --- figures ----------------------------------------------------------------------------------------------------------


def labels_of(ax):
    ax.get_figure(root=True).draw_without_rendering()
    return [label.get_text() for label in ax.get_xticklabels()]


def test_ticks_are_at_midnight_of_the_zone(fits):
    dated, plain = fits
    ax = dated.plot().axes[-1]
    labels = labels_of(ax)
    assert len(labels) >= 3
    assert all(re.fullmatch(r"\d\d (Mar|Apr)", label) for label in labels), labels
    assert ax.xaxis.get_offset_text().get_text() == "2020"
    for tick, label in zip(ax.get_xticks(), labels, strict=True):
        (date,) = dated.trajectory.origin.to_dates([tick], "d")
        nearest = (date + dt.timedelta(seconds=1)).replace(microsecond=0)
        assert (nearest.hour, nearest.minute, f"{nearest:%d %b}") == (0, 0, label)
    assert ax.get_xlabel() == "time (Europe/Berlin)"
    assert plain.plot().axes[-1].get_xlabel() == "time (d)"


@pytest.mark.parametrize("span", [1e-3, 1.0, 30.0, 1e4, 1e5, 1e7, 3e9])
def test_ticks_of_any_span(span):
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: x[0]), ("on",), (), 0.0, span, origin="2020-03-28T12:00Z")
    ax = Figure(figsize=(6, 2)).subplots()
    ax.set_xlim(0.0, span)
    label_axis(ax, run)
    assert isinstance(ax.xaxis.get_major_locator(), DateLocator)
    ticks = np.array([tick for tick in ax.get_xticks() if 0 <= tick <= span])
    assert 2 <= len(ticks) <= 10
    assert len(set(labels_of(ax))) > 1
    assert ax.format_coord(0.0, 0.0).count("2020-03-28 12:00:00") == 1


@pytest.mark.parametrize("span", [90.0, 3600.0, 10_000.0])
@pytest.mark.parametrize("day", ["2026-03-29", "2026-10-25"])
def test_ticks_of_a_short_axis_pass_over_the_change_to_and_from_summer_time(day, span):
    locators = (DateLocator(Origin(f"{own}T00:59:30", "Europe/Berlin"), "s") for own in (day, "2026-06-10"))
    changing, usual = (locator.tick_values(0.0, span) for locator in locators)
    np.testing.assert_allclose(changing, usual, atol=1e-3)


def test_profiles_residuals_and_many_fits_show_dates(fits):
    dated, _ = fits
    profile, study = dated.profile("tau_1"), sf.bootstrap(dated, 40)
    assert re.search(r"95 % interval +\[2020-03-29 \d\d:\d\d, 2020-03-29 \d\d:\d\d\]", str(profile))
    assert re.search(r"tau_1 \(d\) +2020-03-29 \d\d:\d\d", str(study))
    for figure, what in ((profile.plot(), "tau_1"), (dated.plot_residuals(), "time"), (study.plot(), "tau_1")):
        assert figure.axes[0].get_xlabel() == f"{what} (Europe/Berlin)"
    assert study.date_origins == (dated.trajectory.origin, None)


def test_many_logs_with_origins_of_their_own_are_not_shown_as_dates():
    other = sf.estimate_many([room(dated=True), room(dated=True, origin="2020-03-19")])
    assert other.date_origins == (None, None)
    np.testing.assert_allclose(other.theta[1, 0] - other.theta[0, 0], 1.0, rtol=1e-6)


@pytest.mark.slow
def test_the_browser_agrees_with_zoneinfo(browser, fits, tmp_path):
    dated, _ = fits
    dated.save_report(tmp_path / "report.html")
    browser.open(tmp_path / "report.html")
    shown = browser.evaluate("document.querySelector('[data-slider=\"0\"] output').textContent")
    assert shown == format_date(dated.transition_dates[0][0], 600)
    start = dated.trajectory.origin.instant.astype(int) / 1e3
    for low, high in ((0, 19), (8.5, 10), (9, 9.01), (0, 900), (-3000, 3000)):
        ticks = browser.evaluate(f"switchfitDates.findTicks({low}, {high}, {start}, 864e5, 'Europe/Berlin')")
        assert 3 <= len(ticks) <= 10
        dates = [dated.trajectory.origin.find_date(round(tick * 864e5) / 864e5, "d") for tick in ticks]
        if high - low > 0.1:
            assert not any(date.second or date.microsecond for date in dates), dates
    assert browser.errors == []


# --- texts ------------------------------------------------------------------------------------------------------------


def in_utc(hour):
    """A moment of the night in which clocks of Berlin are set back."""
    return dt.datetime(2020, 10, 25, hour, 30, tzinfo=dt.UTC).astimezone(BERLIN)


@pytest.mark.parametrize(
    ("date", "error", "text"),
    [
        (dt.datetime(2020, 3, 23, 17, 41, 12, 356700), 30 * 86400, "2020-03-23"),
        (dt.datetime(2020, 3, 23, 17, 41, 12, 356700), 2 * 86400, "2020-03-23 18h"),
        (dt.datetime(2020, 3, 23, 17, 41, 12, 356700), 3600, "2020-03-23 17:41"),
        (dt.datetime(2020, 3, 23, 17, 41, 12, 356700), 0.004, "2020-03-23 17:41:12.3567"),
        (dt.datetime(2020, 3, 23, 17, 41, 12, 356700), 1e-9, "2020-03-23 17:41:12.356700"),
        (dt.datetime(2020, 2, 29, 23, 59, 58), 60, "2020-02-29 23:59:58"),
        (dt.datetime(2020, 2, 29, 23, 59, 58), 3600, "2020-03-01 00:00"),
        (in_utc(0), 600, "2020-10-25 02:30+0200"),
        (in_utc(1), 600, "2020-10-25 02:30+0100"),
    ],
)
def test_a_date_is_rounded_to_the_places_that_its_error_allows(date, error, text):
    """With its offset where clocks show it twice."""
    assert format_date(date, error) == text
    assert format_date(date, error, short=True) == text.removesuffix(" 00:00").replace("356700", "3567")


def test_a_time_beyond_all_calendars_is_a_number():
    run = run_of(DAYS)
    assert [format_time(t, run) for t in (1e9, np.inf, 12.0)] == ["1e+09", "inf", "2020-03-28 12:00"]
    assert format_time(12.0, run_of([0.0, 20.0])) == "12"


# --- logs and problem files -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cells", "zone", "first"),
    [
        (["2020-03-28T00:00:00.000001", "2020-03-28T12:00"], "", "2020-03-28T00:00:00.000001"),
        (["2020-03-28T00:00Z", "2020-03-28T12:00Z"], "UTC", "2020-03-28T00:00:00+00:00"),
        (["2020-03-28T00:00+02:00", "2020-03-28T12:00+02:00"], "+02:00", "2020-03-28T00:00:00+02:00"),
        (["2020-03-28T00:00+01:00", "2020-03-28T13:00+02:00"], "UTC", "2020-03-27T23:00:00+00:00"),
    ],
)
def test_a_log_hands_over_its_dates(cells, zone, first, tmp_path):
    (tmp_path / "a.csv").write_text("time;x\n" + "".join(f"{cell};1\n" for cell in cells))
    found = sf.read_log(tmp_path / "a.csv", time_unit="h")
    assert found.dates.time_zone == found.time_zone == zone
    assert repr(found.dates[0]) == first
    assert (found.dates.instants[1] - found.dates.instants[0]) / np.timedelta64(1, "h") == pytest.approx(12.0)
    run = sf.Experiment(sf.Measurements(found.dates, found[["x"]]), ("on",), (), time_unit="h")
    np.testing.assert_allclose(run.data[0].times, found.times, atol=1e-9)


FILE = """
model = "heater.py:HEATER"
parameters = {{ power = 1.5, loss = 0.1 }}
[[experiments]]
mode_sequence = ["on", "off"]
time_unit = "d"
{experiment}
[[experiments.data]]
file = "{log}"
columns = ["warmth"]
sigma = 0.3
{data}
"""


@pytest.fixture
def write(tmp_path):
    (tmp_path / "heater.py").write_text((EXAMPLES / "dates" / "heater.py").read_text())
    rows = [f"2020-03-{day:02d}T12:00,{day % 7}" for day in range(10, 28)]
    stamps = [f"{1583841600000 + 86400000 * k},{k % 7}" for k in range(18)]  # the same noons, since 1970
    (tmp_path / "naive.csv").write_text("\n".join(["time,warmth", *rows]))
    (tmp_path / "utc.csv").write_text("\n".join(["time,warmth", *rows]).replace("00,", "00Z,"))
    (tmp_path / "stamps.csv").write_text("\n".join(["time_ms,warmth", *stamps]))

    def write(experiment, log="naive.csv", data=""):
        (tmp_path / "problem.toml").write_text(FILE.format(experiment=experiment, log=log, data=data))
        return tmp_path / "problem.toml"

    return write


def load(path):
    (run,) = load_problem(path).problem.experiments
    return run


@pytest.mark.parametrize("date", ["2020-03-20", '"2020-03-20"', "2020-03-20T00:00:00", "{ value = 2020-03-20 }"])
def test_dates_of_toml(date, write):
    run = load(write(f"transition_times = [{date}]\nt0 = 2020-03-10"))
    assert (run.t0, run.initial_times, run.data[0].times[0]) == (0.0, [10.0], 0.5)
    assert run.origin.date == "2020-03-10T00:00:00"


GUESS = "transition_times = [2020-03-14]"
MILLIS = 'epoch = "ms"\nwindow = [1583841600000, 1584532800000]'
UTC_KEYS = f"time_zone = 'UTC'\n{GUESS}"
BERLIN_KEYS = """time_zone = 'Europe/Berlin'
origin = 2020-03-01
transition_times = [{ value = 2020-03-20T01:00:00+01:00, lower = 2020-03-15 }]"""


@pytest.mark.parametrize(
    ("experiment", "log", "data", "origin", "first_last_guess"),
    [
        (BERLIN_KEYS, "utc.csv", "", "2020-03-01T00:00:00+01:00", (9 + 13 / 24, 26 + 13 / 24, 19 + 1 / 24)),
        ("transition_times = [3.0]", "naive.csv", "", "2020-03-10T12:00:00", (0.0, 17.0, 3.0)),
        (GUESS, "naive.csv", "window = [2020-03-12, 2020-03-16T12:00:00]", "2020-03-12T12:00:00", (0.0, 4.0, 1.5)),
        (UTC_KEYS, "utc.csv", "window = [2020-03-12, 2020-03-17]", "2020-03-12T12:00:00+00:00", (0.0, 4.0, 1.5)),
        (f"{GUESS[:-1]}T00:00:00Z]", "stamps.csv", MILLIS, "2020-03-10T12:00:00+00:00", (0.0, 8.0, 3.5)),
    ],
    ids=["zones", "numbers count from the first of the log", "window", "window in a zone", "numbers since 1970"],
)
def test_origin_and_times_of_a_log(experiment, log, data, origin, first_last_guess, write):
    run = load(write(experiment, log, data))
    assert run.origin.date == origin
    times = run.data[0].times
    assert (times[0], times[-1], run.initial_times[0]) == pytest.approx(first_last_guess, rel=1e-15)


@pytest.mark.parametrize(
    ("experiment", "log", "data", "message"),
    [
        ("transition_times = [3.0]", "stamps.csv", "", "the times are in ms, but time_unit"),
        ("t0 = true", "naive.csv", "", r"'experiments\[1\]\.t0' must be a number or a date such as 2024-05-01"),
        ("t0 = 2020-03-10", "naive.csv", "time_scale = 2.0", r"naive\.csv has dates, which are converted to time_unit"),
        ("", "naive.csv", 'epoch = "ms"', r"naive\.csv has dates already: leave out epoch = 'ms'"),
        ("", "stamps.csv", 'epoch = "s"', r"stamps\.csv: the times are in ms, but epoch is 's'"),
        ("", "stamps.csv", "time_scale = 1\nwindow = [2020-03-12, 2020-03-16]", "has dates, and .*stamps.csv has"),
        ("", "naive.csv", "window = [2020-03-12, 3.0]", "has dates, and .*naive.csv has dates, of which the window"),
        ("", "naive.csv", "window = [2021-03-12, 2022-01-01]", "they reach from 2020-03-10T12:00:00 to 2020-03-27T12"),
        ("", "naive.csv", "window = [2020-03-12T00:00:00Z, 2022-01-01]", "window: 2020-03-12T00:00:00.00:00 has a"),
    ],
)
def test_mistakes_in_a_problem_file(experiment, log, data, message, write):
    with pytest.raises(InputError, match=message):
        load(write(experiment, log, data))


def test_the_command_line(tmp_path):
    problem = EXAMPLES / "dates" / "problem.toml"

    checked = run("check", problem, code=0).output
    assert "on -> off on [2020-03-10, 2020-04-04 13:00] (tf from the data), at 2020-03-20" in checked
    run("simulate", problem, "--out", tmp_path / "out.csv", code=0)
    rows = list(csv.DictReader((tmp_path / "out.csv").read_text().splitlines()))
    assert rows[0]["date"] == "2020-03-10T00:00:00+01:00"
    for row in (rows[0], rows[-1]):
        moment = dt.datetime(2020, 3, 9, 23, tzinfo=dt.UTC) + dt.timedelta(days=float(row["t (d)"]))
        assert abs(dt.datetime.fromisoformat(row["date"]) - moment) <= dt.timedelta(microseconds=1)
    run("fit", problem.with_name("warmth.csv"), "--problem", problem, "--table", tmp_path / "t.csv", code=0)
    (row,) = csv.DictReader((tmp_path / "t.csv").read_text().splitlines())
    assert row["tau_1 (date)"].startswith("2020-03-2")
    off = dt.datetime.fromisoformat(row["tau_1 (date)"]) - dt.datetime(2020, 3, 22, 6, tzinfo=dt.UTC)
    assert abs(off) < 3 * dt.timedelta(days=float(row["tau_1 (d) std. error"]))
