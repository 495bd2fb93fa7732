"""What an online estimator said, as text and as a figure."""

from dataclasses import replace

import numpy as np
import pytest

import switchfit as sf
from support.models import approach


def make_problem(**settings):
    """A temperature that rises and falls, sampled every 0.1 s, with a change at 2 s; two rates that are unknown."""
    times = np.arange(0.1, 5.0, 0.1)
    values = approach(times, [2.0], (0.7, 0.4), (3.0, 0.0), start=0.0)
    values += 0.02 * np.random.default_rng(0).normal(size=len(times))
    modes = {"heat": lambda t, x, p: p["rate"][0] * (3.0 - x), "cool": lambda t, x, p: -p["rate"][1] * x}
    system = sf.HybridSystem(modes, [0.0])
    run = sf.Experiment(sf.Measurements(times, values, sigma=0.02), ("heat",), t0=0.0, tf=5.0, **settings)
    return sf.Problem(system, run, {"rate": sf.Parameter([0.6, 0.5], lower=0.0, unit="1/s")})


@pytest.fixture(scope="module")
def log():
    return sf.replay(make_problem())


def test_text(log):
    """The numbers are those of the log, rounded by their standard errors; an alarm that was retracted is marked."""
    now, (alarm,) = log.now, log.alarms
    rows = [line.split() for line in str(log).splitlines()]
    (begin,) = (row for row in rows[1:] if row[:1] == ["cool"])
    assert str(log).startswith(f"cool since {begin[1]} s, after 1 change of mode up to 4.9 s. The model follows the ")
    assert float(begin[1]) == pytest.approx(now.transition_times[0], abs=0.1 * now.time_errors[0])
    assert float(begin[3]) == pytest.approx(now.time_errors[0], rel=0.05)
    (row,) = (row for row in rows if row[:1] == ["rate[1]"])
    assert float(row[1]) == pytest.approx(now.parameters["rate"][1], abs=0.1 * now.standard_errors["rate"][1])
    assert row[4] == "1/s"
    assert [f"{alarm.time:.6g}", "cool"] in [row[:2] for row in rows]
    assert str(replace(log, retracted=log.alarms)).rstrip().count("retracted") > str(log).count("retracted")


def test_without_an_alarm_and_with_an_unknown_parameter_and_dates():
    """What no sample has said anything about has no standard error."""
    problem = make_problem(origin="2024-05-01T12:00:00Z", time_unit="s")
    early, log = sf.replay(make_problem(), callback=lambda now: now.time > 1.0), sf.replay(problem)
    lines = [" ".join(line.split()) for line in str(early).splitlines()]
    assert "no alarm" in lines
    assert "rate[1] 0.5 not known yet 1/s" in lines
    assert early.plot() is not None
    assert str(log).startswith("cool since 2024-05-01 12:00:0")
    assert log.plot().axes[-1].get_xlabel() == "time (UTC)"


def test_figure(log):
    """Probabilities, statistic with threshold, and a panel with a band for each entry of the free parameters."""
    figure = log.plot()
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert labels == ["probability", "statistic", "rate[0] (1/s)", "rate[1] (1/s)"]
    assert 12.0 in [line.get_ydata()[0] for line in figure.axes[1].lines]
    for k, ax in enumerate(figure.axes[2:]):
        np.testing.assert_array_equal(ax.lines[0].get_ydata(), log.parameters["rate"][:, k])
        band = ax.collections[0].get_paths()[-1].vertices
        value, error = log.parameters["rate"][-1, k], log.standard_errors["rate"][-1, k]
        at_the_end = band[band[:, 0] == log.times[-1], 1]
        np.testing.assert_allclose([at_the_end.min(), at_the_end.max()], [value - 1.96 * error, value + 1.96 * error])
    huge = replace(log, statistic=np.where(log.times > 3.0, 1e6, log.statistic))
    assert [each.plot().axes[1].get_yscale() for each in (log, huge)] == ["linear", "symlog"]


def test_delays(log):
    """Of a change, how late it was declared; NaN where it was not before the next; of no change, none."""
    (alarm,) = log.alarms
    np.testing.assert_allclose(log.delays([2.0, 4.0]), [alarm.time - 2.0, np.nan])
    assert np.isnan(log.delays([1.0, 1.5])[0])
    assert log.delays([]).shape == (0,)
    assert np.isnan(replace(log, retracted=log.alarms).delays([2.0]))
