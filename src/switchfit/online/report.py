"""Text and figure of the log of an online estimator: modes, parameters, alarms and the time of updates."""

from __future__ import annotations

from collections import Counter

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.modes.search_figure import stack_probabilities
from switchfit.modes.search_report import tabulate_segments
from switchfit.online.log import OnlineLog
from switchfit.problem.validation.messages import unit_suffix
from switchfit.report import numbers, panels, style, tables
from switchfit.report import times as times_module
from switchfit.report.style import FIT_COLOUR, LINE, SHADE_COLOUR, SMALL, THIN, TRANSITION_COLOUR
from switchfit.report.tables import format_table, wrap_text
from switchfit.report.times import format_estimate, format_time, label_time
from switchfit.report.wording import capitalise
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_count, format_text

LISTED_LAST = 12
"""Modes and alarms in a report of an online estimator, the last ones; and values of parameters, also in its figure."""

LOG_AXIS_FROM_THRESHOLDS = 10.0
"""Thresholds above which the axis of the statistic is logarithmic, beyond the threshold."""

INCHES_BETWEEN_AXES = 0.08
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
    unit = times_module.suffix_time(log)
    now, end = log.now, format_time(log.now.time, log)
    # Without a change since the start there is no transition whose time could be uncertain.
    error = now.time_errors[-1] if len(now.time_errors) else np.nan
    since = format_estimate(now.since, float(error), log)[0]
    changes = format_count(len(now.transition_times), "change")
    first = f"{now.mode} since {since}{unit}, after {changes} of mode up to {end}{unit}."
    head = wrap_text(f"{first} {capitalise(now.status.value)}.")
    counts, took = Counter(status.name for status in log.status), log.latency()
    counted = ", ".join(f"{number} {name}" for name, number in counts.items())
    p50, p90, p99, most = (f"{1e3 * took[name]:.3g}" for name in ("p50", "p90", "p99", "max"))
    effort = wrap_text(f"{format_count(len(log.times), 'update')}: {counted}")
    effort.append(f"an update took {p50} ms (median), {p90} (90 %), {p99} (99 %), {most} (the longest)")
    return tables.join_sections(head, _list_modes(log), _list_parameters(log), _list_alarms(log), effort)


def _list_modes(log: OnlineLog) -> list[str]:
    """Return a line for each of the last modes: from, the standard error of that, and to."""
    now = log.now
    ends = format_time(float(log.since[0]), log), "now"
    table = tabulate_segments(now.mode_sequence, now.transition_times, now.time_errors, ends, log)
    return format_table(*table._replace(rows=table.rows[-LISTED_LAST:]))


def _list_values(log: OnlineLog) -> list[tuple[str, str, FloatArray, FloatArray]]:
    """Return name, unit, value (K,) and standard error (K,) of each entry of the free parameters."""
    found = []
    for name, errors in log.standard_errors.items():
        unit = log.units[name]
        for k, index in enumerate(np.ndindex(errors.shape[1:])):
            # A parameter with several entries has a row for each: its history is (K, *shape).
            label = f"{name}[{k}]" if errors[0].size > 1 else name
            found.append((label, unit, log.parameters[name][:, *index], errors[:, *index]))
    return found


def _list_parameters(log: OnlineLog) -> list[str]:
    rows = []
    for name, unit, value, error in _list_values(log):
        shown, spread = format_estimate(float(value[-1]), float(error[-1]), None)
        rows.append([name, shown, spread or "not known yet", unit_suffix(unit).strip()])
    return format_table(rows, "<>><", most=LISTED_LAST, where=" in .parameters")


def _list_alarms(log: OnlineLog) -> list[str]:
    """Return a line for each of the last alarms: when it came, what it said then, and whether it was retracted."""
    rows = []
    for alarm in log.alarms[-LISTED_LAST:]:
        began, spread = format_estimate(alarm.transition_time, alarm.standard_error, log)
        began = began if spread else format_time(alarm.transition_time, log)
        refuted = "retracted" if alarm in log.retracted else ""
        rows.append([format_time(alarm.time, log), alarm.mode, began, spread, f"{alarm.statistic:.1f}", refuted])
    titles = [label_time(log, "alarm at"), "mode", label_time(log, "since"), "", "statistic", "and then"]
    more = [f"  {len(log.alarms) - LISTED_LAST} earlier ones in .alarms"] if len(log.alarms) > LISTED_LAST else []
    return [*format_table(rows, "><>>><", titles), *more] or ["  no alarm"]


@draw_figure.register(OnlineLog)
def plot_log(log: OnlineLog) -> Figure:
    """Draw the probability of each mode, the statistic, and the parameters with their 95 % bands over time.

    Parameters
    ----------
    log : OnlineLog
    """
    values = _list_values(log)[:LISTED_LAST]
    figure = style.make_figure(8.0, 4.2 + 1.5 * len(values))
    figure.get_layout_engine().set(h_pad=INCHES_BETWEEN_AXES)  # type: ignore[union-attr,call-arg]
    axes = figure.subplots(2 + len(values), 1, sharex=True, squeeze=False)[:, 0]
    stack_probabilities(log.times, log.modes, log.probability, axes[0])
    now = log.now
    reach = QUANTILE * now.time_errors
    # Intervals of the last answer: earlier ones are in the log, but the last has seen most.
    ends = np.stack([now.transition_times - reach, now.transition_times + reach], axis=1)
    panels.plot_transitions(now.transition_times, ends, axes[0])
    _plot_statistic(log, axes[1])
    for ax, (name, unit, value, error) in zip(axes[2:], values, strict=True):
        _plot_value(log.times, value, error, ax)
        ax.set_ylabel(numbers.wrap_quantity(name, unit))
    for ax in axes:
        style.label_axis(ax, log)
        ax.label_outer()
    return style.turn_off_formulas(figure)


def _plot_statistic(log: OnlineLog, ax: Axes) -> None:
    """Draw the statistic with its threshold, and a dot for each alarm, an empty one if it was retracted."""
    ax.plot(log.times, np.maximum(log.statistic, 0.0), "-", color=SHADE_COLOUR, linewidth=THIN)
    for alarm in log.alarms:
        face = "none" if alarm in log.retracted else FIT_COLOUR
        ax.plot(alarm.time, alarm.statistic, "o", markersize=4, color=FIT_COLOUR, markerfacecolor=face)
    style.draw_level(ax, "threshold", log.threshold, "left")
    # Linear up to the threshold, where it is read; a real change goes on to thousands.
    if np.max(log.statistic) > LOG_AXIS_FROM_THRESHOLDS * log.threshold:
        ax.set_yscale("symlog", linthresh=log.threshold, linscale=2.0)
    ax.set_ylim(0.0, max(1.5 * log.threshold, ax.get_ylim()[1]))
    ax.set_ylabel("statistic")


def _plot_value(times: FloatArray, value: FloatArray, error: FloatArray, ax: Axes) -> None:
    """Draw a parameter with its 95 % band, which is cut off where it is much wider than at the end."""
    band = np.stack([value - QUANTILE * error, value + QUANTILE * error], axis=1)
    ax.plot(times, value, "-", color=FIT_COLOUR, linewidth=LINE, zorder=3)
    # In the beginning a parameter is not known at all, and its band would make the curve a straight line.
    reach = 3.0 * QUANTILE * np.nan_to_num(error[-1], posinf=0.0)
    ax.set_ylim(*ax.get_ylim() + reach * np.array([-1.0, 1.0]))
    ax.set_autoscaley_on(False)
    panels.plot_band(times, panels.replace_infinities(band), ax, alpha=0.2, label="95 %")
    ax.axhline(value[-1], color=TRANSITION_COLOUR, linestyle=":", linewidth=THIN, zorder=1)
    ax.tick_params(labelsize=SMALL)
