"""What an online estimator said, as text and as a figure."""

from dataclasses import replace
from itertools import pairwise

import matplotlib
import numpy as np
import pytest

import switchfit as sf

matplotlib.use("agg")


def make_problem(**settings):
    """A temperature that rises and falls, sampled every 0.1 s, with a change at 2 s; two rates that are unknown."""
    times = np.arange(0.1, 5.0, 0.1)
    rise = 3.0 * (1 - np.exp(-0.7 * np.minimum(times, 2.0)))
    values = rise * np.exp(-0.4 * np.maximum(times - 2.0, 0.0))
    values += 0.02 * np.random.default_rng(0).normal(size=len(times))
    system = sf.HybridSystem(
        {"heat": lambda t, x, p: p["rate"][0] * (3.0 - x), "cool": lambda t, x, p: -p["rate"][1] * x}, [0.0]
    )
    run = sf.Experiment(sf.Measurements(times, values, sigma=0.02), ("heat",), t0=0.0, tf=5.0, **settings)
    return sf.Problem(system, run, {"rate": sf.Parameter([0.6, 0.5], lower=0.0, unit="1/s")})


@pytest.fixture(scope="module")
def log():
    return sf.replay(make_problem())


def test_text(log):
    """The numbers are those of the log, rounded by their standard errors."""
    lines = str(log).splitlines()
    now, (alarm,) = log.now, log.alarms
    rows = [line.split() for line in lines]
    assert ["mode", "from", "(s)", "to", "(s)"] in rows
    (begin,) = (row for row in rows[1:] if row[:1] == ["cool"])
    assert lines[0] == f"cool since {begin[1]} s, after 1 change of mode up to 4.9 s. The model follows the samples."
    assert float(begin[1]) == pytest.approx(now.transition_times[0], abs=0.1 * now.time_errors[0])
    assert float(begin[3]) == pytest.approx(now.time_errors[0], rel=0.05)
    for k in (0, 1):
        (row,) = (row for row in rows if row[:1] == [f"rate[{k}]"])
        assert float(row[1]) == pytest.approx(now.parameters["rate"][k], abs=0.1 * now.standard_errors["rate"][k])
        assert row[4] == "1/s"
    assert [f"{alarm.time:.6g}", "cool"] in [row[:2] for row in rows]
    assert "49 updates: " in str(log)
    assert sum(int(row[k]) for row in rows if row[1:2] == ["updates:"] for k in range(2, len(row), 2)) == 49


def test_without_an_alarm_and_with_an_unknown_parameter():
    """What no sample has said anything about has no standard error."""
    log = sf.replay(make_problem(), callback=lambda now: now.time > 1.0)
    assert "  no alarm" in str(log).splitlines()
    assert "rate[1] 0.5 not known yet 1/s" in [" ".join(line.split()) for line in str(log).splitlines()]
    assert log.plot() is not None


def test_times_that_are_dates():
    log = sf.replay(make_problem(origin="2024-05-01T12:00:00Z", time_unit="s"))
    assert str(log).startswith("cool since 2024-05-01 12:00:0")
    assert "mode from to" in [" ".join(line.split()) for line in str(log).splitlines()]
    assert log.plot().axes[-1].get_xlabel() == "time (UTC)"


def test_what_was_retracted_is_marked(log):
    text = str(replace(log, retracted=log.alarms))
    assert any(line.endswith("retracted") for line in text.splitlines())
    dots = [line for line in replace(log, retracted=log.alarms).plot().axes[1].lines if line.get_marker() == "o"]
    assert [dot.get_markerfacecolor() for dot in dots] == ["none"]


def test_figure(log):
    """Probabilities, statistic with threshold, and a panel with a band for each entry of the free parameters."""
    figure = log.plot()
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert labels == ["probability", "statistic", "rate[0] (1/s)", "rate[1] (1/s)"]
    assert figure.axes[-1].get_xlabel() == "time (s)"
    statistic = figure.axes[1]
    assert [*statistic.lines[0].get_xdata()] == [*log.times]
    assert 12.0 in [line.get_ydata()[0] for line in statistic.lines]
    for k, ax in enumerate(figure.axes[2:]):
        np.testing.assert_array_equal(ax.lines[0].get_ydata(), log.parameters["rate"][:, k])
        band = ax.collections[0].get_paths()[-1].vertices
        value, error = log.parameters["rate"][-1, k], log.standard_errors["rate"][-1, k]
        at_the_end = band[band[:, 0] == log.times[-1], 1]
        np.testing.assert_allclose([at_the_end.min(), at_the_end.max()], [value - 1.96 * error, value + 1.96 * error])
    figure.canvas.draw()
    spans = [ax.get_position() for ax in figure.axes]
    assert all(below.y1 < above.y0 for above, below in pairwise(spans))


def test_a_statistic_far_above_the_threshold_is_logarithmic(log):
    assert log.plot().axes[1].get_yscale() == "linear"
    huge = replace(log, statistic=np.where(log.times > 3.0, 1e6, log.statistic))
    assert huge.plot().axes[1].get_yscale() == "symlog"


def test_units_and_dates_of_a_log(log):
    assert (log.time_unit, log.origin, log.units) == ("s", None, {"rate": "1/s"})


def test_delays(log):
    """Of a change, how late it was declared; NaN where it was not before the next; of no change, none."""
    (alarm,) = log.alarms
    np.testing.assert_allclose(log.delays([2.0, 4.0]), [alarm.time - 2.0, np.nan])
    assert np.isnan(log.delays([1.0, 1.5])[0])
    assert log.delays([]).shape == (0,)
    assert np.isnan(replace(log, retracted=log.alarms).delays([2.0]))
