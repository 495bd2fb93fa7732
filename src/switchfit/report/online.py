"""Text and figure of what an online estimator said."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from switchfit.online.log import OnlineLog
from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import unit_suffix
from switchfit.report import style
from switchfit.report.formats import format_estimate, format_table, format_time, label_quantity, name_columns, wrap_text
from switchfit.report.modes import stack_probabilities
from switchfit.report.plot import plot_transitions
from switchfit.report.style import FIT, LINE, REFERENCE, SHADE, SMALL, THIN, TRANSITION
from switchfit.runtime.presentation import draw_figure, format_count, format_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LISTED = 12
"""Modes and alarms in a report, the last ones; and values of parameters, of which a figure draws as many."""

FAR = 10.0
"""Thresholds above which the axis of the statistic is logarithmic, beyond the threshold."""

ROOM = 0.08
"""Inches between axes, and above the legend of the first."""

QUANTILE = 1.96
"""Half the width of a 95 % band, in standard errors."""


@format_text.register(OnlineLog)
def write_log(log: OnlineLog) -> str:
    """Return the present mode, the modes with their times, parameters, alarms, and how long updates took.

    Parameters
    ----------
    log : OnlineLog
    """
    run = None if log.origin is None else log
    unit = "" if run is not None else unit_suffix(log.time_unit)
    now, end = log.now, format_time(log.now.time, log)
    error = now.time_errors[-1] if len(now.time_errors) else np.nan
    since = format_estimate(now.since, float(error), run)[0]
    changes = format_count(len(now.transition_times), "change")
    first = f"{now.mode} since {since}{unit}, after {changes} of mode up to {end}{unit}."
    lines = wrap_text(f"{first} {now.status.value[0].upper()}{now.status.value[1:]}.")
    lines += ["", *_list_modes(log), *_list_parameters(log), *_list_alarms(log), ""]
    counts = Counter(status.name for status in log.status)
    counted = ", ".join(f"{number} {name}" for name, number in counts.items())
    lines += wrap_text(f"{format_count(len(log.times), 'update')}: {counted}")
    took = log.latency()
    p50, p90, p99, most = (f"{1e3 * took[name]:.3g}" for name in ("p50", "p90", "p99", "max"))
    lines.append(f"an update took {p50} ms (median), {p90} (90 %), {p99} (99 %), {most} (the longest)")
    return "\n".join(lines)


def _list_modes(log: OnlineLog) -> list[str]:
    """Return a line for each of the last modes: from, the standard error of that, and to."""
    now, run = log.now, None if log.origin is None else log
    unit, spread_unit = (f" ({log.time_unit})", "") if run is None else ("", f" {log.time_unit}")
    pairs = zip(now.transition_times.tolist(), now.time_errors.tolist(), strict=True)
    known = [format_estimate(time, error, run) for time, error in pairs]
    shown = [format_time(float(log.since[0]), log), *(time for time, _ in known), "now"]
    spreads = ["", *(spread and f"{spread}{spread_unit}" for _, spread in known)]
    rows = list(zip(now.mode_sequence, shown[:-1], spreads, shown[1:], strict=True))[-LISTED:]
    return format_table([("mode", f"from{unit}", "", f"to{unit}"), *rows], "<>>>")


def _list_values(log: OnlineLog) -> list[tuple[str, str, FloatArray, FloatArray]]:
    """Return name, unit, value (K,) and standard error (K,) of each entry of the free parameters."""
    found = []
    for name, errors in log.standard_errors.items():
        unit = log.units[name]
        for k, index in enumerate(np.ndindex(errors.shape[1:])):
            label = f"{name}[{k}]" if errors[0].size > 1 else name
            found.append((label, unit, log.parameters[name][:, *index], errors[:, *index]))
    return found


def _list_parameters(log: OnlineLog) -> list[str]:
    found = _list_values(log)
    rows = []
    for name, unit, value, error in found[:LISTED]:
        shown, spread = format_estimate(float(value[-1]), float(error[-1]), None)
        rows.append([name, shown, spread or "not known yet", unit_suffix(unit).strip()])
    more = [f"  and {len(found) - LISTED} more in .parameters"] if len(found) > LISTED else []
    return ["", *format_table(rows, "<>><"), *more] if rows else []


def _list_alarms(log: OnlineLog) -> list[str]:
    """Return a line for each of the last alarms: when it came, what it said then, and whether it was retracted."""
    run, unit = None if log.origin is None else log, "" if log.origin is not None else f" ({log.time_unit})"
    rows = []
    for alarm in log.alarms[-LISTED:]:
        began, spread = format_estimate(alarm.transition_time, alarm.standard_error, run)
        began = began if spread else format_time(alarm.transition_time, log)
        refuted = "retracted" if alarm in log.retracted else ""
        rows.append([format_time(alarm.time, log), alarm.mode, began, spread, f"{alarm.statistic:.1f}", refuted])
    titles = name_columns([f"alarm at{unit}", "mode", f"since{unit}", " ", "statistic", "and then"], rows)
    more = [f"  {len(log.alarms) - LISTED} earlier ones in .alarms"] if len(log.alarms) > LISTED else []
    return ["", *format_table([titles, *rows], "><>>><"), *more] if rows else ["", "  no alarm"]


@draw_figure.register(OnlineLog)
def plot_log(log: OnlineLog) -> Figure:
    """Draw the probability of each mode, the statistic, and the parameters with their 95 % bands over time.

    Parameters
    ----------
    log : OnlineLog
    """
    from switchfit.report.axes import label_axis, put_ticks  # here, since it imports matplotlib

    values = _list_values(log)[:LISTED]
    figure = style.make_figure(8.0, 4.2 + 1.5 * len(values))
    figure.get_layout_engine().set(h_pad=ROOM)  # type: ignore[union-attr,call-arg]
    axes = figure.subplots(2 + len(values), 1, sharex=True, squeeze=False)[:, 0]
    plot_probability(log, axes[0])
    plot_statistic(log, axes[1])
    for ax, (name, unit, value, error) in zip(axes[2:], values, strict=True):
        _plot_value(log.times, value, error, ax)
        ax.set_ylabel(label_quantity(name, unit))
    for ax in axes[:-1]:
        put_ticks(ax, log)
    label_axis(axes[-1], log)
    return style.turn_off_formulas(figure)


def plot_probability(log: OnlineLog, ax: Axes) -> Axes:
    """Draw the probability of each mode as it was known at each time, and the transition times as they are known now.

    Parameters
    ----------
    log : OnlineLog
    ax : matplotlib.axes.Axes
    """
    stack_probabilities(log.times, log.modes, log.probability, ax)
    now = log.now
    reach = QUANTILE * np.where(np.isfinite(now.time_errors), now.time_errors, np.nan)
    ends = np.stack([now.transition_times - reach, now.transition_times + reach], axis=1)
    return plot_transitions(now.transition_times, ends, ax)


def plot_statistic(log: OnlineLog, ax: Axes) -> Axes:
    """Draw the statistic with its threshold, and a dot for each alarm, an empty one if it was retracted.

    Parameters
    ----------
    log : OnlineLog
    ax : matplotlib.axes.Axes
    """
    ax.plot(log.times, np.maximum(log.statistic, 0.0), "-", color=SHADE, linewidth=THIN)
    for alarm in log.alarms:
        face = "none" if alarm in log.retracted else FIT
        ax.plot(alarm.time, alarm.statistic, "o", markersize=4, color=FIT, markerfacecolor=face)
    ax.axhline(log.threshold, color=REFERENCE, linestyle="--", linewidth=THIN)
    style.name_line(ax, "threshold", log.threshold, "left", color=REFERENCE)
    if np.max(log.statistic) > FAR * log.threshold:
        ax.set_yscale("symlog", linthresh=log.threshold, linscale=2.0)
    ax.set_ylim(0.0, max(1.5 * log.threshold, ax.get_ylim()[1]))
    ax.set_ylabel("statistic")
    return ax


def _plot_value(times: FloatArray, value: FloatArray, error: FloatArray, ax: Axes) -> Axes:
    """Draw a parameter with its 95 % band, which is cut off where it is much wider than at the end."""
    known = np.isfinite(error)
    low, high = value - QUANTILE * error, value + QUANTILE * error
    ax.plot(times, value, "-", color=FIT, linewidth=LINE, zorder=3)
    reach = 3.0 * QUANTILE * error[-1] if known[-1] else 0.0
    ax.set_ylim(*ax.get_ylim() + reach * np.array([-1.0, 1.0]))
    ax.set_autoscaley_on(False)
    ax.fill_between(times, low, high, where=known, color=FIT, alpha=0.2, linewidth=0, zorder=2, label="95 %")
    ax.axhline(value[-1], color=TRANSITION, linestyle=":", linewidth=THIN, zorder=1)
    ax.tick_params(labelsize=SMALL)
    return ax
